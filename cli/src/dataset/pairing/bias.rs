//! Bias of followed trajectories, measured by following the people of the mirror.
//!
//! An echo's range is not that of the chest alone: hips and thighs lie lower, floor and walls add their own ways, and near
//! walls the direction is pulled towards repeats. All of that is in the simulation too. Where a mirror's people are is known,
//! so that following them says by how much following misses at that place, and the recording's trajectory is shifted back.

use glam::DVec2;

use super::follow::Tracklet;
use super::script::Role;

/// The miss is averaged over this either way, s: it is a matter of the place, what is not is noise.
const HALF_S: f64 = 1.5;
/// Slower people stand, m/s.
const MOVING_M_PER_S: f64 = 0.3;
/// Distance from a person of the mirror beyond which a followed one is somebody else, m.
const NEAR_M: f64 = 0.8;

/// Shifts the trajectories of `roles`, along which the mirror's people went, by what `seen` says that following misses.
pub fn correct(roles: &mut [Role], seen: &[Tracklet]) {
    for state in roles.iter_mut().flat_map(|role| &mut role.tracklets) {
        let misses: Vec<(f64, DVec2)> = state
            .track
            .iter()
            .filter_map(|at| {
                // Who stands is told by small motions of parts that differ from person to person.
                let place = (at.vx.hypot(at.vy) > MOVING_M_PER_S).then_some(DVec2::new(at.x, at.y))?;
                let same = seen.iter().flat_map(|s| &s.track).filter(|s| s.frame == at.frame);
                let miss =
                    same.map(|s| DVec2::new(s.x, s.y) - place).min_by(|a, b| a.length().total_cmp(&b.length()))?;
                (miss.length() < NEAR_M).then_some((at.time_s, miss))
            })
            .collect();
        for at in &mut state.track {
            // About the time itself, or the time nearest to it at which they moved.
            let about = misses.iter().min_by(|a, b| (a.0 - at.time_s).abs().total_cmp(&(b.0 - at.time_s).abs()));
            let about_s = about.map_or(at.time_s, |(t, _)| *t);
            let near = misses.iter().filter(|(t, _)| (t - about_s).abs() <= HALF_S);
            let (sum, count) = near.fold((DVec2::ZERO, 0.0), |(sum, n), (_, miss)| (sum + *miss, n + 1.0));
            if count > 0.0 {
                (at.x, at.y) = (at.x - sum.x / count, at.y - sum.y / count);
            }
        }
    }
}
