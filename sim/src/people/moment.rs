//! State of a person's motion at a time, before it becomes a posture.

use super::body::{Build, Posture};
use super::postures::{Crouch, Lying};

/// State of a motion at a time.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Moment {
    /// Place without sway, m.
    pub position_m: [f64; 2],
    /// Facing, rad.
    pub heading_rad: f64,
    /// Cycles (two steps) made.
    pub phase: f64,
    /// 0 standing, 1 walking.
    pub vigour: f64,
    /// 0 standing, 1 sitting with feet ahead.
    pub sit: f64,
    /// Vigour of steps on the spot.
    pub march: f64,
    /// Part of the way down on feet that stay.
    pub low: f64,
    /// Way down to planted feet.
    pub crouch: Option<Crouch>,
    /// Part of the way from there to lying.
    pub lie: f64,
    /// Place to lie.
    pub lying: Option<Lying>,
    /// Small motions beside those of the person.
    pub small: Option<Small>,
}

/// Small motions of somebody who wanders.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Small {
    /// Hips forward over feet that stay, m.
    pub forward_m: f64,
    /// Hips to the left over feet that stay, m.
    pub left_m: f64,
    /// Trunk forward, rad.
    pub lean_rad: f64,
    /// Shoulders against hips, rad.
    pub twist_rad: f64,
    /// Shoulder flexion (left, right), rad.
    pub shoulder_rad: [f64; 2],
    /// Elbow flexion (left, right), rad.
    pub elbow_rad: [f64; 2],
}

impl Small {
    pub(super) fn add(&self, build: &Build, posture: &mut Posture) {
        let (sine, cosine) = posture.heading_rad.sin_cos();
        posture.position_m[0] += self.forward_m * cosine - self.left_m * sine;
        posture.position_m[1] += self.forward_m * sine + self.left_m * cosine;
        // Legs lean over feet that stay.
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
