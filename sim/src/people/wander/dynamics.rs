//! Dynamics of a walker on the ground plan: a speed along the heading and a turning rate, which follow the commands
//! smoothly and within bounds.
//!
//! The acceleration along the heading is linear in time within a step, and so is the turning rate. Between two steps,
//! speed and heading are cubics that their values and rates at both ends determine exactly.

use crate::math::wrapped;
use crate::people::gait;

/// Duration of a step, s.
pub(super) const STEP_S: f64 = 0.05;

/// Time constant with which the speed approaches the commanded one, s. It is at least four times [`LAG_S`], so the
/// speed never overshoots.
const SPEED_S: f64 = 0.7;
/// Time constant with which the heading approaches the commanded one, s.
const TURN_S: f64 = 0.5;
/// Time constant of the accelerations, s.
const LAG_S: f64 = 0.15;
/// Largest angular acceleration, rad/s^2.
const LARGEST_RAD_PER_S2: f64 = 6.0;
/// Speed below which a walker that is commanded to stop stands still, m/s.
const STILL_M_PER_S: f64 = 1e-4;
/// Speed added when steps are counted and measured, so that slow steps do not become infinitely short, m/s.
const STEP_SPEED_OFFSET_M_PER_S: f64 = 0.03;
/// Speed at which a walk has half of its intensity, m/s.
const HALF_WALK_M_PER_S: f64 = 0.04;
/// Turning rate at which steps on the spot have half of their intensity, rad/s.
const HALF_MARCH_RAD_PER_S: f64 = 0.5;
/// Speed of a walk of intensity 1, m/s.
const FULL_WALK_M_PER_S: f64 = 1.3;

/// Position and motion at the end of a step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Pose {
    /// Position on the ground plan, m.
    pub position_m: [f64; 2],
    /// Speed along the heading, never negative, m/s.
    pub speed_m_per_s: f64,
    /// Rate of change of the speed, m/s^2.
    pub acceleration_m_per_s2: f64,
    /// Heading from +x towards +y, not wrapped, rad.
    pub heading_rad: f64,
    /// Rate of the heading, rad/s.
    pub turn_rad_per_s: f64,
    /// Number of cycles (two steps each) completed.
    pub phase: f64,
}

/// Commanded motion of a walker in a step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Command {
    /// Speed, m/s.
    pub speed_m_per_s: f64,
    /// Heading, rad; `None` ends all turning.
    pub heading_rad: Option<f64>,
}

impl Command {
    /// Stops as soon as the bounds allow.
    pub const STOP: Command = Command { speed_m_per_s: 0.0, heading_rad: None };
}

/// Bounds of a walker's motion, and the length of the steps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Limits {
    /// Largest acceleration along the heading and, separately, across it, m/s^2.
    pub acceleration_m_per_s2: f64,
    /// Largest turning rate, rad/s.
    pub turn_rad_per_s: f64,
    /// Length of the legs, m.
    pub leg_m: f64,
    /// Ratio of the stride to the average one.
    pub stride: f64,
}

impl Limits {
    /// Cycles per second at a speed and a turning rate.
    pub fn cycles_per_s(&self, speed_m_per_s: f64, turn_rad_per_s: f64) -> f64 {
        let speed = speed_m_per_s + STEP_SPEED_OFFSET_M_PER_S;
        let cycles_per_m = gait::cycles_per_second(speed, self.leg_m) / (speed * self.stride);
        speed_m_per_s * cycles_per_m + gait::MARCH_HZ * march_intensity(speed_m_per_s, turn_rad_per_s)
    }
}

/// Share of walking in the motion of the legs at a speed, 0 to 1.
fn walking_share(speed_m_per_s: f64) -> f64 {
    let square = speed_m_per_s * speed_m_per_s;
    square / (square + HALF_WALK_M_PER_S * HALF_WALK_M_PER_S)
}

/// Intensity of the gait at a speed. Its steps are as long as [`Limits::cycles_per_s`] assumes.
pub(super) fn walk_intensity(speed_m_per_s: f64) -> f64 {
    ((speed_m_per_s + STEP_SPEED_OFFSET_M_PER_S) / FULL_WALK_M_PER_S).sqrt().min(1.35) * walking_share(speed_m_per_s)
}

/// Intensity of steps on the spot at a speed and a turning rate.
pub(super) fn march_intensity(speed_m_per_s: f64, turn_rad_per_s: f64) -> f64 {
    let square = turn_rad_per_s * turn_rad_per_s;
    square / (square + HALF_MARCH_RAD_PER_S * HALF_MARCH_RAD_PER_S) * (1.0 - walking_share(speed_m_per_s))
}

impl Pose {
    /// Pose of a standing walker.
    pub fn standing(position_m: [f64; 2], heading_rad: f64) -> Self {
        Pose {
            position_m,
            speed_m_per_s: 0.0,
            acceleration_m_per_s2: 0.0,
            heading_rad,
            turn_rad_per_s: 0.0,
            phase: 0.0,
        }
    }

    /// Velocity, m/s.
    pub fn velocity_m_per_s(&self) -> [f64; 2] {
        let (sine, cosine) = self.heading_rad.sin_cos();
        [self.speed_m_per_s * cosine, self.speed_m_per_s * sine]
    }

    /// Acceleration over the ground, m/s^2.
    pub fn ground_acceleration_m_per_s2(&self) -> [f64; 2] {
        let (sine, cosine) = self.heading_rad.sin_cos();
        let across = self.speed_m_per_s * self.turn_rad_per_s;
        [self.acceleration_m_per_s2 * cosine - across * sine, self.acceleration_m_per_s2 * sine + across * cosine]
    }

    /// Direction to a place, rad.
    pub fn bearing_rad(&self, to: [f64; 2]) -> f64 {
        (to[1] - self.position_m[1]).atan2(to[0] - self.position_m[0])
    }

    /// Distance to a place, m.
    pub fn distance_m(&self, to: [f64; 2]) -> f64 {
        (to[0] - self.position_m[0]).hypot(to[1] - self.position_m[1])
    }

    /// Position at a distance ahead and a distance to the left, m.
    pub fn beside(&self, ahead_m: f64, left_m: f64) -> [f64; 2] {
        let (sine, cosine) = self.heading_rad.sin_cos();
        [self.position_m[0] + ahead_m * cosine - left_m * sine, self.position_m[1] + ahead_m * sine + left_m * cosine]
    }

    /// Pose one step later.
    pub fn advance(&self, command: &Command, limits: &Limits) -> Pose {
        let lag_gain = 1.0 - (-STEP_S / LAG_S).exp();
        let largest_m_per_s2 = limits.acceleration_m_per_s2;
        let target =
            ((command.speed_m_per_s - self.speed_m_per_s) / SPEED_S).clamp(-largest_m_per_s2, largest_m_per_s2);
        let mut acceleration = self.acceleration_m_per_s2 + (target - self.acceleration_m_per_s2) * lag_gain;
        let mut speed = self.speed_m_per_s + 0.5 * STEP_S * (self.acceleration_m_per_s2 + acceleration);
        if speed <= 0.0 || (command.speed_m_per_s <= 0.0 && speed < STILL_M_PER_S) {
            (speed, acceleration) = (0.0, 0.0);
        }
        // Fast walkers turn in wide curves.
        let lateral_limit = if speed > 0.0 { largest_m_per_s2 / speed } else { f64::INFINITY };
        let largest_turn = limits.turn_rad_per_s.min(lateral_limit);
        let target = command
            .heading_rad
            .map_or(0.0, |heading| (wrapped(heading - self.heading_rad) / TURN_S).clamp(-largest_turn, largest_turn));
        let change = (target - self.turn_rad_per_s) * lag_gain;
        let largest_change = LARGEST_RAD_PER_S2 * STEP_S;
        let turn =
            (self.turn_rad_per_s + change.clamp(-largest_change, largest_change)).clamp(-largest_turn, largest_turn);
        let heading = self.heading_rad + 0.5 * STEP_S * (self.turn_rad_per_s + turn);

        // The distance is integrated by Simpson's rule, with speed and heading in the middle of the step.
        let middle_speed =
            0.5 * (self.speed_m_per_s + speed) + 0.125 * STEP_S * (self.acceleration_m_per_s2 - acceleration);
        let middle_heading = 0.5 * (self.heading_rad + heading) + 0.125 * STEP_S * (self.turn_rad_per_s - turn);
        let velocity = |speed: f64, heading: f64| [speed * heading.cos(), speed * heading.sin()];
        let first = velocity(self.speed_m_per_s, self.heading_rad);
        let middle = velocity(middle_speed, middle_heading);
        let last = velocity(speed, heading);
        let displacement = [0, 1].map(|i| STEP_S / 6.0 * (first[i] + 4.0 * middle[i] + last[i]));
        let cycles = limits.cycles_per_s(self.speed_m_per_s, self.turn_rad_per_s)
            + 4.0 * limits.cycles_per_s(middle_speed.max(0.0), 0.5 * (self.turn_rad_per_s + turn))
            + limits.cycles_per_s(speed, turn);
        Pose {
            position_m: [self.position_m[0] + displacement[0], self.position_m[1] + displacement[1]],
            speed_m_per_s: speed,
            acceleration_m_per_s2: acceleration,
            heading_rad: heading,
            turn_rad_per_s: turn,
            phase: self.phase + STEP_S / 6.0 * cycles,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMITS: Limits = Limits { acceleration_m_per_s2: 0.7, turn_rad_per_s: 2.1, leg_m: 0.93, stride: 1.0 };

    #[test]
    fn accelerations_and_turning_rates_stay_within_their_limits() {
        let mut pose = Pose::standing([0.0; 2], 0.0);
        let go = Command { speed_m_per_s: 1.0, heading_rad: Some(2.5) };
        let mut last = pose;
        for step in 0..400 {
            let command = if step < 200 { go } else { Command::STOP };
            pose = pose.advance(&command, &LIMITS);
            let [x, y] = pose.ground_acceleration_m_per_s2();
            assert!(x.hypot(y) <= 0.7 * 1.4143, "{} m/s^2", x.hypot(y));
            assert!((0.0..=1.0).contains(&pose.speed_m_per_s), "{} m/s: no overshoot", pose.speed_m_per_s);
            assert!(pose.turn_rad_per_s.abs() <= LIMITS.turn_rad_per_s);
            assert!((pose.turn_rad_per_s - last.turn_rad_per_s).abs() < 0.31);
            assert!(pose.phase >= last.phase);
            if step == 199 {
                assert!(pose.speed_m_per_s > 0.98 && (pose.heading_rad - 2.5).abs() < 0.02, "{pose:?}");
            }
            last = pose;
        }
        assert_eq!((pose.speed_m_per_s, pose.acceleration_m_per_s2), (0.0, 0.0));
        let stood = pose.advance(&Command::STOP, &LIMITS);
        assert_eq!((stood.position_m, stood.speed_m_per_s), (pose.position_m, 0.0));
    }

    /// At every speed, the stride that follows from the angle of the hips equals the ground covered in a cycle.
    #[test]
    fn stride_matches_the_ground_covered_in_a_cycle() {
        for speed in [0.2, 0.5, 0.9, 1.3] {
            let per_cycle_m = speed / LIMITS.cycles_per_s(speed, 0.0);
            // Half a cycle moves a foot from 0.4 rad before the hip to 0.4 rad behind it, at intensity 1.
            let stride_m = 4.0 * LIMITS.leg_m * (0.4 * walk_intensity(speed)).sin();
            assert!((stride_m / per_cycle_m - 1.0).abs() < 0.12, "{stride_m} m for {per_cycle_m} m at {speed} m/s");
        }
        assert_eq!((walk_intensity(0.0), LIMITS.cycles_per_s(0.0, 0.0), march_intensity(0.0, 0.0)), (0.0, 0.0, 0.0));
    }
}
