//! Bias of estimated trajectories, measured by tracking the people of the mirrored simulation.
//!
//! The range of an echo is not that of the chest alone. Hips and thighs lie lower, floor and walls add their own paths,
//! and near walls ghosts bias the direction. The simulation shows the same effects. The positions of its people are
//! known, so tracking them gives the tracking error at each position. The recording's trajectory is corrected by that
//! error.

use glam::DVec2;

use super::script::PersonTrack;
use super::tracking::Tracklet;

/// Half the averaging time of the error, s. The bias depends on the position; other differences are noise.
const HALF_S: f64 = 1.5;
/// Speed below which a person counts as standing, m/s.
const MOVING_M_PER_S: f64 = 0.3;
/// Distance beyond which a tracklet belongs to another person than the mirror's, m.
const NEAR_M: f64 = 0.8;

/// Fraction of the distance to the corrected trajectory that one correction covers. Near walls, the bias depends so strongly on
/// the position that whole steps would overshoot.
const STEP: f64 = 0.5;

/// Corrects the trajectories of `tracks`, which the people of the mirror followed. Moves them towards the tracked ones less the
/// tracking error, which tracking the mirror (`mirror_tracklets`) shows. `tracked` are the tracks before any correction.
pub fn correct(tracks: &mut [PersonTrack], tracked: &[PersonTrack], mirror_tracklets: &[Tracklet]) {
    let tracked = tracked.iter().flat_map(|track| &track.tracklets);
    for (tracklet, tracked) in tracks.iter_mut().flat_map(|track| &mut track.tracklets).zip(tracked) {
        // Times, s, and tracking errors, m.
        let errors: Vec<(f64, DVec2)> = tracklet
            .states
            .iter()
            .filter_map(|state| {
                // A standing person is detected by small motions of body parts, which differ between people.
                let position = (state.vx.hypot(state.vy) > MOVING_M_PER_S).then_some(DVec2::new(state.x, state.y))?;
                let same_frame = mirror_tracklets.iter().flat_map(|s| &s.states).filter(|s| s.frame == state.frame);
                let error = same_frame
                    .map(|s| DVec2::new(s.x, s.y) - position)
                    .min_by(|a, b| a.length().total_cmp(&b.length()))?;
                (error.length() < NEAR_M).then_some((state.time_s, error))
            })
            .collect();
        for (state, tracked) in tracklet.states.iter_mut().zip(&tracked.states) {
            // Errors around the time itself, or around the nearest time at which the person moved.
            let nearest =
                errors.iter().min_by(|a, b| (a.0 - state.time_s).abs().total_cmp(&(b.0 - state.time_s).abs()));
            let nearest_s = nearest.map_or(state.time_s, |(t, _)| *t);
            let near = errors.iter().filter(|(t, _)| (t - nearest_s).abs() <= HALF_S);
            let (sum, count) = near.fold((DVec2::ZERO, 0.0), |(sum, n), (_, error)| (sum + *error, n + 1.0));
            if count > 0.0 {
                state.x += STEP * (tracked.x - sum.x / count - state.x);
                state.y += STEP * (tracked.y - sum.y / count - state.y);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::smooth::PersonState;
    use super::*;

    /// Largest position error of a walker after a number of corrections, m. The tracking error is `bias_m`, a function of the
    /// position across the path.
    fn remaining_m(corrections: u8, bias_m: impl Fn(f64) -> f64) -> f64 {
        const TRUE_M: f64 = 0.8;
        let walk = |across_m: f64| {
            let state = |frame: usize| {
                let time_s = 0.1 * frame as f64;
                let (x, vx) = (1.0 + time_s, 1.0);
                PersonState { frame, time_s, x, y: across_m, vx, vy: 0.0, sigma_m: 0.0, snr_db: None, is_visible: true }
            };
            Tracklet { echoes: Vec::new(), states: (0..40).map(state).collect() }
        };
        let tracked = [PersonTrack { tracklets: vec![walk(TRUE_M + bias_m(TRUE_M))], path: Vec::new() }];
        let mut tracks = tracked.clone();
        for _ in 0..corrections {
            let across_m = tracks[0].tracklets[0].states[0].y;
            correct(&mut tracks, &tracked, &[walk(across_m + bias_m(across_m))]);
        }
        tracks[0].tracklets[0].states.iter().map(|state| (state.y - TRUE_M).abs()).fold(0.0, f64::max)
    }

    /// Corrections do not add up, and converge even if the bias grows faster than the position.
    #[test]
    fn corrections_converge() {
        for bias_m in [|_: f64| 0.2, |y: f64| 1.5 * (y - 1.0)] {
            let remaining: Vec<f64> = (0..=4).map(|corrections| remaining_m(corrections, bias_m)).collect();
            assert!(remaining.windows(2).all(|two| two[1] < 0.6 * two[0]), "{remaining:?}");
        }
    }
}
