//! Motion at the end of a step, and interpolation between steps.

use super::dynamics::{Limits, Pose, STEP_S};
use crate::math::quintic;

/// A value and its rate.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Knot {
    /// Value.
    pub value: f64,
    /// Rate, 1/s.
    pub rate: f64,
}

impl Knot {
    /// Cubic through two knots that are one step apart, at a fraction of the step.
    pub fn interpolate(self, next: Knot, fraction: f64) -> f64 {
        let (square, rest) = (fraction * fraction, 1.0 - fraction);
        let change = (next.value - self.value) * square * (3.0 - 2.0 * fraction);
        self.value + change + STEP_S * (self.rate * fraction * rest * rest - next.rate * square * rest)
    }
}

/// Motion of one person at the end of a step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Node {
    /// Place and motion on the ground plan.
    pub pose: Pose,
    /// Shoulder and elbow flexion in addition to the gait: `[side]`, rad.
    pub arms_rad: [[Knot; 2]; 2],
    /// Displacement of the hips (forward, left) from the middle of the feet, m.
    pub shift_m: [Knot; 2],
    /// Fraction of the descent to a seat.
    pub seat_descent: f64,
    /// Index of the seat.
    pub seat: usize,
}

impl Pose {
    /// Motion at a fraction of the step to the next pose. Position, velocity and acceleration are continuous from step
    /// to step.
    pub fn interpolate(&self, next: &Pose, fraction: f64, limits: &Limits) -> Pose {
        let (a, b) = (self, next);
        let (velocity, next_velocity) = (a.velocity_m_per_s(), b.velocity_m_per_s());
        let (acceleration, next_acceleration) = (a.ground_acceleration_m_per_s2(), b.ground_acceleration_m_per_s2());
        let position_m = [0, 1].map(|i| {
            let end = |pose: &Pose, velocity: [f64; 2], acceleration: [f64; 2]| {
                [pose.position_m[i], velocity[i] * STEP_S, acceleration[i] * STEP_S * STEP_S]
            };
            let coefficients = quintic(end(a, velocity, acceleration), end(b, next_velocity, next_acceleration));
            coefficients.into_iter().rev().fold(0.0, |sum, coefficient| sum * fraction + coefficient)
        });
        let knot = |value: f64, rate: f64| Knot { value, rate };
        let speed = |p: &Pose| knot(p.speed_m_per_s, p.acceleration_m_per_s2);
        let heading = |p: &Pose| knot(p.heading_rad, p.turn_rad_per_s);
        let phase = |p: &Pose| knot(p.phase, limits.cycles_per_s(p.speed_m_per_s, p.turn_rad_per_s));
        Pose {
            position_m,
            speed_m_per_s: speed(a).interpolate(speed(b), fraction).max(0.0),
            acceleration_m_per_s2: a.acceleration_m_per_s2
                + fraction * (b.acceleration_m_per_s2 - a.acceleration_m_per_s2),
            heading_rad: heading(a).interpolate(heading(b), fraction),
            turn_rad_per_s: a.turn_rad_per_s + fraction * (b.turn_rad_per_s - a.turn_rad_per_s),
            phase: phase(a).interpolate(phase(b), fraction),
        }
    }
}
