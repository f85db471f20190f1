//! Steps that leave time to stop: the dynamics of the step itself are run on while everybody brakes.

use super::setting::Setting;
use super::walker::{Command, Limits, Pose};

/// Steps of braking that are looked at: more than a stop ever takes.
const BRAKE_STEPS: usize = 200;

/// Somebody whom others must not come near while both brake.
#[derive(Debug, Clone, Copy)]
pub(super) struct Braking {
    /// Place and motion at the end of this step.
    pub pose: Pose,
    /// Bounds of their motion.
    pub limits: Limits,
    /// Place of the seat on which they sit besides, m.
    pub seat_m: Option<[f64; 2]>,
}

/// The first of some motions that leaves time to stop, and its place among them; braking if none does.
pub(super) fn choose(
    setting: &Setting,
    from: &Pose,
    limits: &Limits,
    commands: &[Command; 3],
    others: &[Braking],
) -> (Pose, usize) {
    for (number, command) in commands.iter().enumerate() {
        let next = from.advance(command, limits);
        if stops_in_time(setting, next, limits, others) {
            return (next, number);
        }
    }
    (from.advance(&Command::STOP, limits), commands.len())
}

/// Whether somebody who brakes from a pose on stays on the ground and off others who brake as well.
fn stops_in_time(setting: &Setting, from: Pose, limits: &Limits, others: &[Braking]) -> bool {
    let least_m = setting.file.least_distance_m;
    let (mut pose, mut others) = (from, others.to_vec());
    for _ in 0..BRAKE_STEPS {
        if !setting.ground.is_free(pose.position_m) {
            return false;
        }
        let is_near = |at: [f64; 2]| pose.distance_m(at) < least_m;
        if others.iter().any(|o| is_near(o.pose.position_m) || o.seat_m.is_some_and(is_near)) {
            return false;
        }
        if pose.speed_m_per_s <= 0.0 && others.iter().all(|o| o.pose.speed_m_per_s <= 0.0) {
            return true;
        }
        pose = pose.advance(&Command::STOP, limits);
        others.iter_mut().for_each(|o| o.pose = o.pose.advance(&Command::STOP, &o.limits));
    }
    false
}
