//! A walking cycle after Boulic, Magnenat-Thalmann and Thalmann, "A global human walking model with real-time kinematic
//! personification" (The Visual Computer 6, 1990).
//!
//! Cycle length grows with the root of the relative speed. The ankles follow prescribed curves, and hips and knees bend
//! so that the legs reach them. While a foot carries the body, it rests on the floor. The curves are our own fits of
//! textbook gait data, not the paper's splines: at 1.2 m/s the hip bends from -16 to 30 deg, the knee by 21 deg under load
//! and 56 deg in swing, and the foot moves at most 2.9 times as fast as the body.

use std::f64::consts::TAU;

use super::body::{Build, Posture};

/// Speed at which the intensity of walking is 1, m/s.
const FULL_WALK_M_PER_S: f64 = 1.3;
/// Cycle length in lengths of a leg at a speed of one leg a second.
const CYCLE_LENGTH: f64 = 1.346;

/// Phase at which an ankle passes below the hip while the foot stands.
const PASSING_PHASE: f64 = 0.255;
/// Phase at which an ankle begins to move forward: the heel rises.
const HEEL_OFF_PHASE: f64 = 0.43;
/// Part of the cycle in which an ankle moves forward.
const SWING: f64 = 0.65;

/// Frequency of the cycle of steps on the spot, Hz. A cycle has two steps.
pub(super) const MARCH_HZ: f64 = 0.9;

/// Cycles (two steps) per second at a speed: `R_c = 1.346 sqrt(v_r)` with lengths in units of `leg_m`.
pub fn cycles_per_second(speed_m_per_s: f64, leg_m: f64) -> f64 {
    let relative = speed_m_per_s / leg_m;
    relative.sqrt() / CYCLE_LENGTH
}

/// Length of a cycle (two steps) at an intensity, which is the root of the speed over 1.3 m/s, m.
fn cycle_m(intensity: f64, leg_m: f64, style: &Style) -> f64 {
    style.stride * CYCLE_LENGTH * (FULL_WALK_M_PER_S * leg_m).sqrt() * intensity
}

/// Periodic bump of height 1 at the phase `centre`. Phases are in cycles. The standard deviation is about
/// `1 / (2 pi sqrt(sharpness))`.
fn bump(phase: f64, centre: f64, sharpness: f64) -> f64 {
    (sharpness * ((TAU * (phase - centre)).cos() - 1.0)).exp()
}

/// Style of walking relative to the average.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Style {
    /// Ratio of the stride to the average stride at the same leg length and speed. A larger one means fewer and longer
    /// steps.
    pub stride: f64,
    /// Ratio of the arm swing to the average one.
    pub arm_swing: f64,
}

impl Style {
    /// Style of the average walker.
    pub const AVERAGE: Style = Style { stride: 1.0, arm_swing: 1.0 };
}

/// Position of an ankle relative to the hip's mean position: (ahead, above the ankle of a standing person), m. `phase` is
/// in cycles, 0 at heel strike.
fn ankle_m(phase: f64, cycle_m: f64, lift_m: f64) -> (f64, f64) {
    // Part of a cycle's length by which the ankle has moved over the floor since heel strike.
    let phase = phase.rem_euclid(1.0);
    let swing_end = HEEL_OFF_PHASE + SWING - 1.0;
    let advance = if phase < swing_end {
        least_jerk((phase + 1.0 - HEEL_OFF_PHASE) / SWING) - 1.0
    } else {
        least_jerk((phase - HEEL_OFF_PHASE) / SWING)
    };
    let above_m = lift_m * (bump(phase, 0.655, 5.0) + 0.1 * bump(phase, 0.985, 8.0));
    (cycle_m * (PASSING_PHASE - phase + advance), above_m)
}

/// Smooth step from 0 to 1 whose slope and curvature are zero at both ends, as of movements with the least jerk.
fn least_jerk(t: f64) -> f64 {
    let t = t.clamp(0.0, 1.0);
    t * t * t * (10.0 - 15.0 * t + 6.0 * t * t)
}

/// Hip and knee flexion by which a leg reaches an ankle `ahead_m` of the hip and `below_m` under it, rad. A target that is
/// nearly out of reach is approached. `slack` is the part of the leg's length that it never stretches over.
fn leg_to(build: &Build, ahead_m: f64, below_m: f64, slack: f64) -> (f64, f64) {
    let (thigh, shank) = (build.thigh_m(), build.shank_m());
    let (longest_m, softness_m) = ((thigh + shank) * (1.0 - slack), (thigh + shank) * slack.max(1e-9));
    let distance_m = ahead_m.hypot(below_m);
    // The smooth minimum of both.
    let reached_m =
        distance_m.min(longest_m) - softness_m * (-(longest_m - distance_m).abs() / softness_m).exp().ln_1p();
    let knee_cosine = (reached_m * reached_m - thigh * thigh - shank * shank) / (2.0 * thigh * shank);
    let knee_rad = knee_cosine.clamp(-1.0, 1.0).acos();
    // The thigh is ahead of the line from hip to ankle.
    let hip_rad = ahead_m.atan2(below_m) + (shank * knee_rad.sin()).atan2(thigh + shank * knee_rad.cos());
    (hip_rad, knee_rad)
}

/// Adds walking to a posture. `phase` is in cycles, 0 at left heel strike. `intensity` is 0 when standing and 1
/// at 1.3 m/s.
pub fn walk(posture: &mut Posture, phase: f64, intensity: f64, build: &Build, style: &Style) {
    if intensity <= 0.0 {
        return;
    }
    let height_m = build.height_m;
    let leg_m = build.standing_hip_height_m();
    // Steps grow with the intensity, and heights with its square, so that slow walkers keep their knees as straight.
    let square = intensity * intensity;
    let hips_up_m = square * height_m * (-0.020 + 0.013 * (2.0 * TAU * (phase - 0.25)).cos());
    let (cycle_m, lift_m) = (cycle_m(intensity, leg_m, style), 0.07 * height_m * square.min(intensity));
    let (forward_m, left_m) = sway(phase, intensity);
    for side in 0..2 {
        let leg_phase = phase + if side == 0 { 0.0 } else { 0.5 };
        let (ahead_m, above_m) = ankle_m(leg_phase, cycle_m, lift_m);
        let below_m = build.thigh_m() + build.shank_m() + hips_up_m - above_m;
        let (hip_rad, knee_rad) = leg_to(build, ahead_m - forward_m, below_m, 0.0045 * square);
        let pitch_rad = intensity.min(1.0) * (0.28 * bump(leg_phase, 0.96, 10.0) - 0.85 * bump(leg_phase, 0.63, 6.0));
        posture.hip_rad[side] += hip_rad;
        posture.knee_rad[side] += knee_rad;
        posture.ankle_rad[side] += pitch_rad + knee_rad - hip_rad;
        let swing = (TAU * leg_phase).cos();
        posture.shoulder_rad[side] -= intensity * (0.38 * style.arm_swing * swing + 0.04);
        posture.elbow_rad[side] += intensity * (0.25 - 0.18 * style.arm_swing * swing);
    }
    posture.twist_rad += 0.09 * intensity * (TAU * phase).cos();
    posture.lean_rad += 0.05 * intensity;
    posture.hip_height_m += hips_up_m;
    // The legs tilt, since the feet stay in place.
    posture.legs_left_rad -= left_m / (build.thigh_m() + build.shank_m());
}

/// Largest knee flexion of steps on the spot, rad.
const MARCH_KNEE_RAD: f64 = 0.55;

/// Adds steps on the spot: the feet move straight up and stay level, in turn. `intensity` is 0 when standing and 1
/// while turning.
pub fn march(posture: &mut Posture, phase: f64, intensity: f64) {
    for side in 0..2 {
        let leg_phase = phase + if side == 0 { 0.0 } else { 0.5 };
        // Thigh and shank have about the same length, so half the knee's angle keeps the ankle under the hip.
        let knee_rad = intensity * MARCH_KNEE_RAD * bump(leg_phase, 0.75, 2.6);
        posture.knee_rad[side] += knee_rad;
        posture.hip_rad[side] += 0.5 * knee_rad;
        posture.ankle_rad[side] += 0.5 * knee_rad;
    }
}

/// Displacement of the hips by walking: (forward, left), m.
pub fn sway(phase: f64, intensity: f64) -> (f64, f64) {
    (0.010 * intensity * (2.0 * TAU * (phase - 0.1)).sin(), 0.018 * intensity * (TAU * (phase - 0.25)).cos())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::people::body::{FOOT, half_extent};

    const BUILD: Build = Build { height_m: 1.75, girth: 1.0 };

    /// Left ankle relative to the floor and its pitch, m and rad, after `cycles` of a straight walk.
    fn ankle_on_floor(cycles: f64, speed_m_per_s: f64) -> ([f64; 3], f64) {
        let leg_m = BUILD.standing_hip_height_m();
        let (forward_m, left_m) = sway(cycles, intensity(speed_m_per_s));
        let way_m = cycles * speed_m_per_s / cycles_per_second(speed_m_per_s, leg_m);
        let mut posture = Posture { position_m: [way_m + forward_m, left_m], ..BUILD.standing() };
        walk(&mut posture, cycles, intensity(speed_m_per_s), &BUILD, &Style::AVERAGE);
        let foot = BUILD.segments(&posture)[FOOT];
        let ankle = foot.centre - foot.axes * glam::DVec3::new(0.05, 0.0, -0.02);
        (ankle.to_array(), foot.axes.x_axis.z.asin())
    }

    fn intensity(speed_m_per_s: f64) -> f64 {
        (speed_m_per_s / FULL_WALK_M_PER_S).sqrt()
    }

    /// The foot that carries the body neither slides nor sinks, at the speeds of people who walk.
    #[test]
    fn standing_feet_rest_on_the_floor() {
        for speed in [0.3, 0.7, 1.2, 1.6, 2.0] {
            let (start, _) = ankle_on_floor(0.15, speed);
            for i in 0..=25 {
                let ([x, y, z], pitch) = ankle_on_floor(0.15 + 0.01 * f64::from(i), speed);
                assert!((x - start[0]).abs() < 0.006, "{speed} m/s: slides by {} m", x - start[0]);
                assert!((y - start[1]).abs() < 0.004, "{speed} m/s: aside by {} m", y - start[1]);
                assert!((z - BUILD.ankle_height_m()).abs() < 0.007, "{speed} m/s: ankle at {z} m");
                assert!(pitch.abs() < 0.3, "{speed} m/s: pitch {pitch}");
            }
        }
    }

    /// In swing a foot moves at three times the speed of the body (Winter, "Biomechanics and Motor Control of Human
    /// Movement", 2009).
    #[test]
    fn feet_swing_at_three_times_the_speed_of_the_body() {
        for speed in [0.7, 1.2, 1.6] {
            let cycles_per_s = cycles_per_second(speed, BUILD.standing_hip_height_m());
            let rate = |i: i32| {
                let x = |cycles| ankle_on_floor(cycles, speed).0[0];
                let at = 0.001 * f64::from(i);
                (x(at + 0.001) - x(at)) / 0.001 * cycles_per_s
            };
            let fastest = (0..1000).map(rate).fold(0.0, f64::max);
            assert!((2.7..3.3).contains(&(fastest / speed)), "{} times {speed} m/s", fastest / speed);
        }
    }

    #[test]
    fn soles_stay_above_the_floor() {
        for speed in [0.3, 0.7, 1.2, 1.6, 2.0] {
            for i in 0..200 {
                let mut posture = BUILD.standing();
                walk(&mut posture, 0.005 * f64::from(i), intensity(speed), &BUILD, &Style::AVERAGE);
                let feet = BUILD.segments(&posture);
                for foot in [&feet[FOOT], &feet[FOOT + 1]] {
                    let lowest_m = foot.centre.z - half_extent(foot).z;
                    assert!(lowest_m > -0.012, "{speed} m/s: {lowest_m} m at {i}");
                }
            }
        }
    }

    /// Knees bend as gait laboratories measure: little at heel strike, 15 to 25 deg under load and about 60 deg in swing.
    #[test]
    fn knees_bend_as_those_of_people() {
        let knee_deg = |phase| {
            let mut posture = BUILD.standing();
            walk(&mut posture, phase, intensity(1.3), &BUILD, &Style::AVERAGE);
            posture.knee_rad[0].to_degrees()
        };
        let most = (0..100).map(|i| knee_deg(0.01 * f64::from(i))).fold(0.0, f64::max);
        assert!((2.0..15.0).contains(&knee_deg(0.0)), "{}", knee_deg(0.0));
        assert!((12.0..26.0).contains(&knee_deg(0.15)), "{}", knee_deg(0.15));
        assert!((52.0..68.0).contains(&most), "{most}");
    }

    /// At 1.3 m/s people make 0.9 to 1.0 cycles a second (about 110 steps a minute).
    #[test]
    fn cadence_at_walking_speed_is_that_of_people() {
        let cycles = cycles_per_second(1.3, 0.53 * 1.75);
        assert!((0.8..1.05).contains(&cycles), "{cycles}");
    }
}
