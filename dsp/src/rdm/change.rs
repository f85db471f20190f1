//! Change from frame to frame. It shows people who stand, sit or breathe, whom the chirps of one frame do not show.
//!
//! Breathing and balance turn the phase of a person's echo by radians within a second. Clutter keeps its phase, except for drifts
//! that are small against its own level. The change of a range bin is therefore weighted by its share of the bin's power.

/// State of one receive channel, by range bin.
///
/// `z` is the sum over the chirps of a frame at zero velocity, with nothing removed. `m` is the mean of `z`, and `v` is
/// the mean of `|z - m|^2`, both with weights that fade exponentially over frames. The power of change is
/// `v * v / (v + |m|^2)`. It is `v` where the phase turns, and lower by the factor `v / (v + |m|^2)` where a strong
/// echo moves a little. `v` has the level of the map's noise where only noise changes.
pub(super) struct Change {
    /// Weight of the newest frame, once there are enough frames.
    alpha: f32,
    /// Number of frames since the beginning or a gap.
    frames: u32,
    mean: Vec<[f32; 2]>,
    variance: Vec<f32>,
}

impl Change {
    /// Creates the state for `range` bins. Weights fall by `1/e` over `time_s`.
    pub(super) fn new(range: usize, time_s: f64, frame_interval_s: f64) -> Self {
        let alpha = -(-frame_interval_s / time_s).exp_m1();
        Change { alpha: alpha as f32, frames: 0, mean: vec![[0.0; 2]; range], variance: vec![0.0; range] }
    }

    pub(super) fn reset(&mut self) {
        self.frames = 0;
        self.mean.fill([0.0; 2]);
        self.variance.fill(0.0);
    }

    /// Takes the real and imaginary parts of the next frame's `z`, and writes or adds the power of change by range bin.
    ///
    /// The weights are equal until there are enough frames for `alpha`. A bin that is not finite gets a power that is
    /// not finite, and does not enter the state. The method is Welford's update with weights (Finch, "Incremental
    /// calculation of weighted mean and variance", 2009).
    pub(super) fn push(&mut self, real: &[f32], imaginary: &[f32], adds: bool, powers: &mut [f32]) {
        self.frames = self.frames.saturating_add(1);
        let alpha = self.alpha.max(1.0 / self.frames as f32);
        let state = self.mean.iter_mut().zip(&mut self.variance);
        for (((re, im), (mean, variance)), power) in real.iter().zip(imaginary).zip(state).zip(powers) {
            let step = [re - mean[0], im - mean[1]];
            let square = step[0] * step[0] + step[1] * step[1];
            if square.is_finite() {
                *variance = (1.0 - alpha) * (*variance + alpha * square);
                mean.iter_mut().zip(step).for_each(|(m, step)| *m += alpha * step);
            }
            let static_power = mean[0] * mean[0] + mean[1] * mean[1];
            let share = *variance / (*variance + static_power).max(f32::MIN_POSITIVE);
            let change = if square.is_finite() { *variance * share } else { square };
            *power = if adds { *power + change } else { change };
        }
    }
}
