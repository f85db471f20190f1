//! Squatting, sitting down and lying: postures other than walking.
//!
//! Both feet stay in place when a person goes down. The knee flexion is a smooth function of time. Hips and ankles
//! follow from it and from the backward motion of the hips. The knee flexion is prescribed rather than the hip height,
//! because the rate of a straight knee is not finite when the hips begin to sink.

use std::f64::consts::{FRAC_PI_2, PI};

use super::body::{Build, Posture};

/// Height of the hips over the seat when sitting, m.
pub const HIPS_OVER_SEAT_M: f64 = 0.09;
/// Distance of the hips behind the ankles in a full squat, as a part of the body's height.
const SQUAT_BACK: f64 = 0.10;
/// Lean of a squat divided by the sinking of the head as a part of the body's height, rad.
const SQUAT_LEAN_RAD: f64 = 1.8;
/// Deepest squat as a part of the body's height: the calves meet the thighs.
pub const DEEPEST_SQUAT: f64 = 0.36;
/// Lean of a standing person, rad.
const UPRIGHT_LEAN_RAD: f64 = 0.02;
/// Height of the middle of the head over the hips, as a part of the body's height, and its distance before the neck's
/// axis.
const HEAD_UP: f64 = 0.288 + 0.108;
const HEAD_AHEAD_M: f64 = 0.01;

/// A descent on feet that stay in place, given by the hips and arms at its end.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Crouch {
    /// Knee flexion at the end, rad.
    pub knee_rad: f64,
    /// Distance of the hips behind the ankles at the end, m.
    pub back_m: f64,
    /// Forward lean of the trunk at the end, rad.
    pub lean_rad: f64,
    /// Largest additional forward lean of the trunk during the descent, rad.
    pub bow_rad: f64,
    /// Shoulder and elbow flexion at the end, rad.
    pub arm_rad: [f64; 2],
}

impl Crouch {
    /// A squat in which the head sinks by `depth_m`. The depth is limited by the folding of the legs.
    pub fn squat(build: &Build, depth_m: f64) -> Self {
        let depth = (depth_m / build.height_m).clamp(0.0, DEEPEST_SQUAT);
        let lean_rad = UPRIGHT_LEAN_RAD + SQUAT_LEAN_RAD * depth;
        let head_m = |lean: f64| HEAD_UP * build.height_m * lean.cos() - HEAD_AHEAD_M * lean.sin();
        // The hips sink by the part that the lean does not provide.
        let hip_height_m =
            build.standing_hip_height_m() - depth * build.height_m + head_m(UPRIGHT_LEAN_RAD) - head_m(lean_rad);
        // The hips move back less in shallow squats.
        let back_m = SQUAT_BACK * build.height_m * (depth / 0.25).min(1.0);
        let knee_rad = knee_flexion_rad(build, hip_height_m, back_m);
        Crouch { knee_rad, back_m, lean_rad, bow_rad: 0.0, arm_rad: [0.7, 0.5] }
    }

    /// Sitting down on a seat of this height, with the hips this far behind the feet, m.
    pub fn sit(build: &Build, seat_height_m: f64, back_m: f64) -> Self {
        let knee_rad = knee_flexion_rad(build, seat_height_m + HIPS_OVER_SEAT_M, back_m);
        Crouch { knee_rad, back_m, lean_rad: UPRIGHT_LEAN_RAD - 0.06, bow_rad: 0.5, arm_rad: [0.40, 1.15] }
    }

    /// Lowers a standing posture by a fraction of the descent.
    pub fn apply(&self, build: &Build, fraction: f64, posture: &mut Posture) {
        let (thigh, shank) = (build.thigh_m(), build.shank_m());
        let (knee_rad, back_m) = (self.knee_rad * fraction, self.back_m * fraction);
        let (sine, cosine) = knee_rad.sin_cos();
        let reach = (thigh * thigh + shank * shank + 2.0 * thigh * shank * cosine).sqrt();
        let hips_over_ankles_m = (reach * reach - back_m * back_m).max(0.0).sqrt();
        // The line from hip to ankle points forward, and the thigh is ahead of that line.
        let hip_rad = back_m.atan2(hips_over_ankles_m) + (shank * sine).atan2(thigh + shank * cosine);
        let (sine, cosine) = posture.heading_rad.sin_cos();
        posture.position_m[0] -= back_m * cosine;
        posture.position_m[1] -= back_m * sine;
        posture.hip_height_m += build.ankle_height_m() + hips_over_ankles_m - build.standing_hip_height_m();
        let bow = (PI * fraction).sin();
        posture.lean_rad += (self.lean_rad - UPRIGHT_LEAN_RAD) * fraction + self.bow_rad * bow * bow;
        for side in 0..2 {
            posture.hip_rad[side] += hip_rad;
            posture.knee_rad[side] += knee_rad;
            posture.ankle_rad[side] += knee_rad - hip_rad;
            posture.shoulder_rad[side] += self.arm_rad[0] * fraction;
            posture.elbow_rad[side] += self.arm_rad[1] * fraction;
        }
    }
}

/// Knee flexion, rad, for which the hips are at a height and behind ankles that stand on the floor.
fn knee_flexion_rad(build: &Build, hip_height_m: f64, back_m: f64) -> f64 {
    let (thigh, shank) = (build.thigh_m(), build.shank_m());
    let hips_over_ankles_m = hip_height_m - build.ankle_height_m();
    let cosine = (hips_over_ankles_m * hips_over_ankles_m + back_m * back_m - thigh * thigh - shank * shank)
        / (2.0 * thigh * shank);
    cosine.clamp(-0.95, 1.0).acos()
}

/// Place at which a person lies on the back.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lying {
    /// Middle of the hips on the ground plan, m.
    pub position_m: [f64; 2],
    /// Height of the lying surface, m.
    pub height_m: f64,
}

impl Lying {
    /// Moves a sitting posture by a fraction towards lying. The caller turns the heading, which is the direction of the
    /// feet.
    pub fn apply(&self, build: &Build, fraction: f64, posture: &mut Posture) {
        let move_towards = |value: &mut f64, end: f64| *value += fraction * (end - *value);
        for (value, end) in posture.position_m.iter_mut().zip(self.position_m) {
            move_towards(value, end);
        }
        move_towards(&mut posture.hip_height_m, self.height_m + 0.11 * build.girth);
        // A pillow raises the trunk a little.
        move_towards(&mut posture.lean_rad, 0.12 - FRAC_PI_2);
        move_towards(&mut posture.pelvis_rad, -FRAC_PI_2);
        for side in 0..2 {
            move_towards(&mut posture.hip_rad[side], FRAC_PI_2 - 0.02);
            move_towards(&mut posture.knee_rad[side], 0.04);
            move_towards(&mut posture.ankle_rad[side], -0.3);
            move_towards(&mut posture.shoulder_rad[side], 0.0);
            move_towards(&mut posture.elbow_rad[side], 0.25);
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::{DVec2, DVec3};

    use super::*;
    use crate::people::body::{FOOT, HEAD, PELVIS, half_extent};

    const BUILDS: [Build; 3] = [
        Build { height_m: 1.55, girth: 0.9 },
        Build { height_m: 1.75, girth: 1.0 },
        Build { height_m: 1.95, girth: 1.1 },
    ];

    fn crouched(build: &Build, crouch: &Crouch, fraction: f64) -> Posture {
        let mut posture = Posture { lean_rad: UPRIGHT_LEAN_RAD, ..build.standing() };
        crouch.apply(build, fraction, &mut posture);
        posture
    }

    #[test]
    fn feet_stay_in_place_in_a_crouch() {
        for build in BUILDS {
            let standing = build.segments(&build.standing());
            for crouch in [Crouch::squat(&build, 0.3 * build.height_m), Crouch::sit(&build, 0.45, 0.38)] {
                for i in 0..=20 {
                    let now = build.segments(&crouched(&build, &crouch, f64::from(i) / 20.0));
                    for foot in [FOOT, FOOT + 1] {
                        let moved = (now[foot].centre - standing[foot].centre).length();
                        assert!(moved < 1e-9, "{moved} m at {i}");
                        assert!((now[foot].axes.x_axis - standing[foot].axes.x_axis).length() < 1e-9, "flat");
                    }
                }
            }
        }
    }

    #[test]
    fn a_squat_lowers_the_head_by_its_depth_and_keeps_the_centre_over_the_feet() {
        for build in BUILDS {
            for depth_m in [0.1, 0.3, 0.5] {
                let head = |fraction| {
                    build.segments(&crouched(&build, &Crouch::squat(&build, depth_m), fraction))[HEAD].centre.z
                };
                assert!((head(0.0) - head(1.0) - depth_m).abs() < 1e-9, "{} m", head(0.0) - head(1.0));
                let head_drops = (0..20).map(|i| head(f64::from(i) / 20.0) - head(f64::from(i + 1) / 20.0));
                assert!(head_drops.into_iter().all(|drop| drop > 0.0), "down all the way");
                // The centre of the body's volume lies over the length of the feet.
                let all = build.segments(&crouched(&build, &Crouch::squat(&build, depth_m), 1.0));
                let volume = |i: usize| all[i].semi_axes_m.x * all[i].semi_axes_m.y * all[i].semi_axes_m.z;
                let total: f64 = (0..all.len()).map(volume).sum();
                let centre = (0..all.len()).map(|i| volume(i) * all[i].centre.x).sum::<f64>() / total;
                assert!((-0.06..0.18).contains(&centre), "{centre} m ahead of the ankles");
            }
        }
    }

    #[test]
    fn a_lying_body_is_as_long_as_its_height_and_rests_on_the_mattress() {
        for build in BUILDS {
            let mut posture = crouched(&build, &Crouch::sit(&build, 0.5, 0.38), 1.0);
            Lying { position_m: [2.0, 1.0], height_m: 0.5 }.apply(&build, 1.0, &mut posture);
            let all = build.segments(&posture);
            let (mut least, mut most) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
            for e in &all {
                (least, most) = (least.min(e.centre - half_extent(e)), most.max(e.centre + half_extent(e)));
            }
            let length = most.x - least.x;
            assert!((length / build.height_m - 1.0).abs() < 0.08, "{length} m long");
            assert!((0.38..0.53).contains(&least.z), "lowest at {} m", least.z);
            assert!(
                (all[PELVIS].centre.truncate() - DVec2::new(2.0, 1.0)).length() < 0.1,
                "hips are where they were asked"
            );
            assert!(all[HEAD].centre.x < 1.5 && all[FOOT].centre.x > 2.5, "feet ahead, head behind");
        }
    }
}
