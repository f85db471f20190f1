//! A walking cycle after Boulic, Magnenat-Thalmann and Thalmann, "A global human walking model with real-time kinematic
//! personification" (The Visual Computer 6, 1990).
//!
//! Cycle length grows with the root of the relative speed. Joint angles are smooth periodic functions of the cycle's
//! phase, and their amplitudes grow with speed. The curves are our own fits of textbook gait data (hip +-25 deg, knee
//! 15 deg in stance and 60 deg in swing), not the paper's splines.

use std::f64::consts::TAU;

use super::body::Posture;

/// Frequency of the cycle of steps on the spot, Hz. A cycle has two steps.
pub(super) const MARCH_HZ: f64 = 0.9;

/// Cycles (two steps) per second at a speed: `R_c = 1.346 sqrt(v_r)` with lengths in units of `leg_m`.
pub fn cycles_per_second(speed_m_per_s: f64, leg_m: f64) -> f64 {
    let relative = speed_m_per_s / leg_m;
    relative.sqrt() / 1.346
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

/// Adds walking to a posture. `phase` is in cycles, 0 at left heel strike. `intensity` is 0 when standing and 1
/// at 1.3 m/s.
pub fn walk(posture: &mut Posture, phase: f64, intensity: f64, height_m: f64, style: &Style) {
    for side in 0..2 {
        let leg_phase = phase + if side == 0 { 0.0 } else { 0.5 };
        let swing = (TAU * leg_phase).cos();
        posture.hip_rad[side] += intensity * (0.40 * style.stride * swing + 0.05);
        posture.knee_rad[side] +=
            intensity * (0.08 + 0.22 * bump(leg_phase, 0.14, 4.0) + 0.95 * bump(leg_phase, 0.73, 2.6));
        posture.ankle_rad[side] +=
            intensity * (0.12 * (TAU * (leg_phase - 0.9)).cos() - 0.28 * bump(leg_phase, 0.63, 7.0));
        posture.shoulder_rad[side] -= intensity * (0.38 * style.arm_swing * swing + 0.04);
        posture.elbow_rad[side] += intensity * (0.25 - 0.18 * style.arm_swing * swing);
    }
    posture.twist_rad += 0.09 * intensity * (TAU * phase).cos();
    posture.lean_rad += 0.05 * intensity;
    posture.hip_height_m += intensity * height_m * (-0.012 + 0.011 * (2.0 * TAU * (phase - 0.25)).cos());
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

    /// At 1.3 m/s people make 0.9 to 1.0 cycles a second (about 110 steps a minute).
    #[test]
    fn cadence_at_walking_speed_is_that_of_people() {
        let cycles = cycles_per_second(1.3, 0.53 * 1.75);
        assert!((0.8..1.05).contains(&cycles), "{cycles}");
    }
}
