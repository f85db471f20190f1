//! Commands for standing, walking to a place and staying with another person. Each function returns three, from the
//! preferred to the most careful one.

use super::dynamics::{Command, Pose};
use super::errand::{Facing, Walker};
use super::setting::Setting;
use crate::math::wrapped;

/// Distance from which on other people are avoided, m.
const AVOID_M: f64 = 1.6;
/// Deceleration before a goal, m/s^2.
const SOFT_M_PER_S2: f64 = 0.35;

impl Walker {
    /// Commands for standing.
    pub(super) fn stand(&self, facing: Facing, other: Option<Pose>) -> [Command; 3] {
        let heading_rad = match (facing, other) {
            (Facing::Heading(heading_rad), _) => Some(heading_rad),
            (Facing::Other, Some(other)) => Some(self.pose.bearing_rad(other.position_m)),
            _ => None,
        };
        [Command { speed_m_per_s: 0.0, heading_rad }, Command::STOP, Command::STOP]
    }

    /// Highest walking speed, m/s.
    fn fastest_m_per_s(setting: &Setting) -> f64 {
        1.3 * setting.file.speed_m_per_s[1]
    }

    /// Commands for walking to a place at the speed of the current walk. The speed is lower before stops and in
    /// curves. The other person is avoided.
    pub(super) fn steer(&self, setting: &Setting, goal: [f64; 2], stops: bool, other: Option<Pose>) -> [Command; 3] {
        let (distance_m, bearing_rad) = (self.pose.distance_m(goal), self.pose.bearing_rad(goal));
        let [noise_of_speed, noise_of_heading] = self.noise;
        let mut speed = self.walk_speed_m_per_s * (1.0 + 0.35 * noise_of_speed).max(0.2);
        speed = speed.min(Self::fastest_m_per_s(setting));
        if stops {
            speed = speed.min((2.0 * SOFT_M_PER_S2 * distance_m).sqrt());
        }
        let wobble_rad = 0.35 * noise_of_heading * distance_m.min(1.0);
        let mut heading_rad = bearing_rad + wobble_rad;
        if let Some(other) = other {
            let other_distance_m = self.pose.distance_m(other.position_m);
            let other_aside_rad = wrapped(bearing_rad - self.pose.bearing_rad(other.position_m));
            if other_distance_m < AVOID_M && other_distance_m < distance_m + 0.3 && other_aside_rad.abs() < 1.2 {
                let side = if other_aside_rad >= 0.0 { 1.0 } else { -1.0 };
                heading_rad += side * (1.0 - other_distance_m / AVOID_M);
            }
        }
        let turn_rad = wrapped(heading_rad - self.pose.heading_rad);
        // The goal lies on a circle tangent to the heading, whose radius must be large enough for the speed.
        let radius_m = distance_m / (2.0 * turn_rad.sin().abs().max(0.05));
        let speed = (speed * speed_factor_in_turn(turn_rad))
            .min(0.9 * (self.limits.acceleration_m_per_s2 * radius_m).sqrt())
            .min(0.9 * self.limits.turn_rad_per_s * radius_m);
        [
            Command { speed_m_per_s: speed, heading_rad: Some(heading_rad) },
            Command { speed_m_per_s: 0.5 * speed, heading_rad: Some(bearing_rad) },
            Command { speed_m_per_s: 0.0, heading_rad: Some(heading_rad) },
        ]
    }

    /// Commands for walking beside the other person.
    pub(super) fn go_beside(&self, setting: &Setting, side: f64, lead: &Pose) -> [Command; 3] {
        let beside_m = setting.file.least_distance_m + 0.25;
        let candidates =
            [lead.beside(0.0, side * beside_m), lead.beside(0.0, -side * beside_m), lead.beside(-1.0, 0.0)];
        let place = candidates.into_iter().find(|at| setting.ground.is_free(*at)).unwrap_or(self.pose.position_m);
        let distance_m = self.pose.distance_m(place);
        if lead.speed_m_per_s < 0.05 && distance_m < 0.35 {
            return self.stand(Facing::Other, Some(*lead));
        }
        let corner = self.corner_towards(setting, place, distance_m);
        let lead_velocity = lead.velocity_m_per_s();
        let gain = 0.8 * distance_m / self.pose.distance_m(corner).max(1e-3);
        let target_velocity = [0, 1].map(|i| lead_velocity[i] + gain * (corner[i] - self.pose.position_m[i]));
        self.head_for(
            setting,
            target_velocity[1].atan2(target_velocity[0]),
            target_velocity[0].hypot(target_velocity[1]),
        )
    }

    /// Commands for walking behind the other person.
    pub(super) fn go_behind(&self, setting: &Setting, gap_m: f64, lead: &Pose) -> [Command; 3] {
        let distance_m = self.pose.distance_m(lead.position_m);
        if lead.speed_m_per_s < 0.05 && distance_m < gap_m + 0.2 {
            return self.stand(Facing::Other, Some(*lead));
        }
        let corner = self.corner_towards(setting, lead.position_m, distance_m);
        let speed = (lead.speed_m_per_s + 0.8 * (distance_m - gap_m)).max(0.0);
        self.head_for(setting, self.pose.bearing_rad(corner), speed)
    }

    /// Next corner of the route to a place at this distance.
    fn corner_towards(&self, setting: &Setting, to: [f64; 2], distance_m: f64) -> [f64; 2] {
        if distance_m < 1.0 {
            return to;
        }
        setting.route_ground.route(self.pose.position_m, to).first().copied().unwrap_or(to)
    }

    /// Commands for walking in a direction.
    fn head_for(&self, setting: &Setting, heading_rad: f64, speed_m_per_s: f64) -> [Command; 3] {
        let turn_rad = wrapped(heading_rad - self.pose.heading_rad);
        let speed = speed_m_per_s.min(Self::fastest_m_per_s(setting)) * speed_factor_in_turn(turn_rad);
        [1.0, 0.4, 0.0].map(|factor| Command { speed_m_per_s: factor * speed, heading_rad: Some(heading_rad) })
    }
}

/// Factor on the speed while the heading is off by an angle.
fn speed_factor_in_turn(turn_rad: f64) -> f64 {
    (0.5 + 0.5 * turn_rad.cos()).powi(2)
}
