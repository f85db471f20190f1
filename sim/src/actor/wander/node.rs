//! Motion at the end of a step, and between two steps.

use super::walker::{Limits, Pose, STEP_S};

/// A value and its rate.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Knot {
    /// Value.
    pub value: f64,
    /// Rate, 1/s.
    pub rate: f64,
}

impl Knot {
    /// Cubic through two knots that are a step apart, at a part of the step.
    pub fn between(self, next: Knot, part: f64) -> f64 {
        let (square, rest) = (part * part, 1.0 - part);
        let change = (next.value - self.value) * square * (3.0 - 2.0 * part);
        self.value + change + STEP_S * (self.rate * part * rest * rest - next.rate * square * rest)
    }
}

/// Motion of one person at the end of a step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Node {
    /// Place and motion on the ground plan.
    pub pose: Pose,
    /// Shoulder and elbow flexion beside those of the gait: `[side]`, rad.
    pub arms_rad: [[Knot; 2]; 2],
    /// Hips (forward, left) off the middle of the feet, m.
    pub shift_m: [Knot; 2],
    /// Part of the way down to a seat.
    pub down: f64,
    /// Index of the seat.
    pub seat: usize,
}

/// Motion on the ground plan between two steps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Place {
    /// Place, m.
    pub position_m: [f64; 2],
    /// Speed along the heading, m/s.
    pub speed_m_per_s: f64,
    /// Heading, rad.
    pub heading_rad: f64,
    /// Rate of the heading, rad/s.
    pub turn_rad_per_s: f64,
    /// Cycles (two steps) made.
    pub phase: f64,
}

impl Place {
    /// Motion at a part of a step. Position, velocity and acceleration are continuous from step to step.
    pub fn between(a: &Pose, b: &Pose, part: f64, limits: &Limits) -> Place {
        let (first, last) = (a.velocity_m_per_s(), b.velocity_m_per_s());
        let (bend, next_bend) = (a.ground_acceleration_m_per_s2(), b.ground_acceleration_m_per_s2());
        let position_m = [0, 1].map(|i| {
            // Quintic through place, velocity and acceleration at both ends.
            let (velocity, half) = (first[i] * STEP_S, 0.5 * bend[i] * STEP_S * STEP_S);
            let d = b.position_m[i] - a.position_m[i] - velocity - half;
            let e = last[i] * STEP_S - velocity - 2.0 * half;
            let f = next_bend[i] * STEP_S * STEP_S - 2.0 * half;
            let third = 10.0 * d - 4.0 * e + 0.5 * f;
            let fourth = -15.0 * d + 7.0 * e - f;
            let fifth = 6.0 * d - 3.0 * e + 0.5 * f;
            a.position_m[i] + part * (velocity + part * (half + part * (third + part * (fourth + part * fifth))))
        });
        let knot = |value: f64, rate: f64| Knot { value, rate };
        let speed = |p: &Pose| knot(p.speed_m_per_s, p.acceleration_m_per_s2);
        let heading = |p: &Pose| knot(p.heading_rad, p.turn_rad_per_s);
        let phase = |p: &Pose| knot(p.phase, limits.cycles_per_s(p.speed_m_per_s, p.turn_rad_per_s));
        Place {
            position_m,
            speed_m_per_s: speed(a).between(speed(b), part).max(0.0),
            heading_rad: heading(a).between(heading(b), part),
            turn_rad_per_s: a.turn_rad_per_s + part * (b.turn_rad_per_s - a.turn_rad_per_s),
            phase: phase(a).between(phase(b), part),
        }
    }
}
