//! State of a person's motion at a time, before it becomes a posture.

use super::body::{Build, Posture};
use super::postures::{Crouch, Lying};

/// State of a motion at a time.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct MotionState {
    /// Position without sway, m.
    pub position_m: [f64; 2],
    /// Heading, rad.
    pub heading_rad: f64,
    /// Number of cycles (two steps each) completed.
    pub phase: f64,
    /// Intensity of walking: 0 standing, 1 walking.
    pub walk_intensity: f64,
    /// Degree of sitting: 0 standing, 1 sitting with the feet ahead.
    pub sit_fraction: f64,
    /// Intensity of steps on the spot.
    pub march_intensity: f64,
    /// Fraction of the descent into the crouch, on feet that stay in place.
    pub crouch_fraction: f64,
    /// Crouch to which `crouch_fraction` refers.
    pub crouch: Option<Crouch>,
    /// Fraction of the motion from the crouch to lying.
    pub lying_fraction: f64,
    /// Place at which the person lies.
    pub lying: Option<Lying>,
    /// Small motions in addition to those of the person.
    pub small_motion: Option<SmallMotion>,
}

/// Small motions of a wandering person.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct SmallMotion {
    /// Hips forward of the feet, which stay in place, m.
    pub forward_m: f64,
    /// Hips to the left of the feet, which stay in place, m.
    pub left_m: f64,
    /// Forward lean of the trunk, rad.
    pub lean_rad: f64,
    /// Rotation of the shoulders relative to the hips, rad.
    pub twist_rad: f64,
    /// Shoulder flexion (left, right), rad.
    pub shoulder_rad: [f64; 2],
    /// Elbow flexion (left, right), rad.
    pub elbow_rad: [f64; 2],
}

impl SmallMotion {
    /// Adds the motion to a posture.
    pub(super) fn add_to(&self, build: &Build, posture: &mut Posture) {
        let (sine, cosine) = posture.heading_rad.sin_cos();
        posture.position_m[0] += self.forward_m * cosine - self.left_m * sine;
        posture.position_m[1] += self.forward_m * sine + self.left_m * cosine;
        // The legs tilt, since the feet stay in place.
        let leg_m = build.thigh_m() + build.shank_m();
        let tilt_rad = self.forward_m / leg_m;
        posture.legs_left_rad -= self.left_m / leg_m;
        for side in 0..2 {
            posture.hip_rad[side] -= tilt_rad;
            posture.ankle_rad[side] += tilt_rad;
            posture.shoulder_rad[side] += self.shoulder_rad[side];
            posture.elbow_rad[side] = (posture.elbow_rad[side] + self.elbow_rad[side]).max(0.0);
        }
        posture.lean_rad += self.lean_rad;
        posture.twist_rad += self.twist_rad;
    }
}
