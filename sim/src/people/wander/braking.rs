//! Choice of motions that leave time to stop. The test simulates braking of all people with the dynamics of the step
//! itself.

use super::setting::Setting;
use super::walker::{Command, Limits, Pose};

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

/// Returns the first of several motions that leaves time to stop, and its index. If there is none, returns braking.
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

/// Whether a person that brakes from a pose stays on the ground and away from other braking people.
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
