//! Choice of motions that leave time to stop. The test simulates braking of all people with the dynamics of the step
//! itself.

use super::dynamics::{Command, Limits, Pose};
use super::setting::Setting;

/// Number of simulated braking steps: more than any stop takes.
const BRAKE_STEPS: usize = 200;

/// Another person that brakes, to which a distance must be kept.
#[derive(Debug, Clone, Copy)]
pub(super) struct Braking {
    /// Position and motion at the end of this step.
    pub pose: Pose,
    /// Bounds of the person's motion.
    pub limits: Limits,
    /// Position of the seat that the person uses, if any, m.
    pub seat_m: Option<[f64; 2]>,
}

/// Returns the pose after the first of several commands that leaves time to stop, and the command's index. If there is
/// none, returns the pose after braking and the number of commands.
pub(super) fn choose(
    setting: &Setting,
    from: &Pose,
    limits: &Limits,
    commands: &[Command; 3],
    others: &[Braking],
) -> (Pose, usize) {
    for (index, command) in commands.iter().enumerate() {
        let next = from.advance(command, limits);
        if stops_in_time(setting, next, limits, others) {
            return (next, index);
        }
    }
    (from.advance(&Command::STOP, limits), commands.len())
}

/// Whether a person that brakes from a pose stays on the ground and away from other braking people.
fn stops_in_time(setting: &Setting, from: Pose, limits: &Limits, others: &[Braking]) -> bool {
    let least_distance_m = setting.file.least_distance_m;
    let (mut pose, mut others) = (from, others.to_vec());
    for _ in 0..BRAKE_STEPS {
        if !setting.ground.is_free(pose.position_m) {
            return false;
        }
        let is_too_near = |at: [f64; 2]| pose.distance_m(at) < least_distance_m;
        if others.iter().any(|other| is_too_near(other.pose.position_m) || other.seat_m.is_some_and(is_too_near)) {
            return false;
        }
        if pose.speed_m_per_s <= 0.0 && others.iter().all(|other| other.pose.speed_m_per_s <= 0.0) {
            return true;
        }
        pose = pose.advance(&Command::STOP, limits);
        others.iter_mut().for_each(|other| other.pose = other.pose.advance(&Command::STOP, &other.limits));
    }
    false
}
