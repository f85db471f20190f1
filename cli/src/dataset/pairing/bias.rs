//! Bias of estimated trajectories, measured by tracking the people of the mirrored simulation.
//!
//! The range of an echo is not that of the chest alone. Hips and thighs lie lower, floor and walls add their own paths,
//! and near walls ghosts bias the direction. The simulation shows the same effects. The positions of its people are
//! known, so tracking them gives the tracking error at each place. The recording's trajectory is corrected by that
//! error.

use glam::DVec2;

use super::follow::Tracklet;
use super::script::Role;

/// Half the averaging time of the error, s. The bias depends on the place; other differences are noise.
const HALF_S: f64 = 1.5;
/// Speed below which a person counts as standing, m/s.
const MOVING_M_PER_S: f64 = 0.3;
/// Distance beyond which a tracklet belongs to another person than the mirror's, m.
const NEAR_M: f64 = 0.8;

/// Part of the way to the corrected trajectory that a correction goes. The bias depends on the place, near walls so
/// strongly that whole steps would overshoot.
const STEP: f64 = 0.5;

/// Moves the trajectories of `roles`, which the mirror's people followed, towards the tracked ones less the tracking
/// error that `seen` shows. `tracked` are the roles as they were tracked, before any correction.
pub fn correct(roles: &mut [Role], tracked: &[Role], seen: &[Tracklet]) {
    let tracked = tracked.iter().flat_map(|role| &role.tracklets);
    for (state, tracked) in roles.iter_mut().flat_map(|role| &mut role.tracklets).zip(tracked) {
        let misses: Vec<(f64, DVec2)> = state
            .track
            .iter()
            .filter_map(|at| {
                // A standing person is detected by small motions of body parts, which differ between people.
                let place = (at.vx.hypot(at.vy) > MOVING_M_PER_S).then_some(DVec2::new(at.x, at.y))?;
                let same = seen.iter().flat_map(|s| &s.track).filter(|s| s.frame == at.frame);
                let miss =
                    same.map(|s| DVec2::new(s.x, s.y) - place).min_by(|a, b| a.length().total_cmp(&b.length()))?;
                (miss.length() < NEAR_M).then_some((at.time_s, miss))
            })
            .collect();
        for (at, tracked) in state.track.iter_mut().zip(&tracked.track) {
            // Errors around the time itself, or around the nearest time at which the person moved.
            let about = misses.iter().min_by(|a, b| (a.0 - at.time_s).abs().total_cmp(&(b.0 - at.time_s).abs()));
            let about_s = about.map_or(at.time_s, |(t, _)| *t);
            let near = misses.iter().filter(|(t, _)| (t - about_s).abs() <= HALF_S);
            let (sum, count) = near.fold((DVec2::ZERO, 0.0), |(sum, n), (_, miss)| (sum + *miss, n + 1.0));
            if count > 0.0 {
                at.x += STEP * (tracked.x - sum.x / count - at.x);
                at.y += STEP * (tracked.y - sum.y / count - at.y);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::smooth::Smoothed;
    use super::*;

    /// Largest error of the places of a walker after a number of corrections, m, where tracking is off by `bias_m` of
    /// the place across the way.
    fn left_m(corrections: u8, bias_m: impl Fn(f64) -> f64) -> f64 {
        const TRUE_M: f64 = 0.8;
        let walk = |across_m: f64| {
            let state = |frame: usize| {
                let time_s = 0.1 * frame as f64;
                let (x, vx) = (1.0 + time_s, 1.0);
                Smoothed { frame, time_s, x, y: across_m, vx, vy: 0.0, sigma_m: 0.0, snr_db: None, is_visible: true }
            };
            Tracklet { places: Vec::new(), track: (0..40).map(state).collect() }
        };
        let tracked = [Role { tracklets: vec![walk(TRUE_M + bias_m(TRUE_M))], knots: Vec::new() }];
        let mut roles = tracked.clone();
        for _ in 0..corrections {
            let place = roles[0].tracklets[0].track[0].y;
            correct(&mut roles, &tracked, &[walk(place + bias_m(place))]);
        }
        roles[0].tracklets[0].track.iter().map(|at| (at.y - TRUE_M).abs()).fold(0.0, f64::max)
    }

    /// Corrections do not add up, and converge also where the bias grows faster than the place.
    #[test]
    fn corrections_converge() {
        for bias_m in [|_: f64| 0.2, |y: f64| 1.5 * (y - 1.0)] {
            let left: Vec<f64> = (0..=4).map(|corrections| left_m(corrections, bias_m)).collect();
            assert!(left.windows(2).all(|two| two[1] < 0.6 * two[0]), "{left:?}");
        }
    }
}
