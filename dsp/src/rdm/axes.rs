//! Axes of a map in m and m/s, the same for every waveform.

use std::ops::Range;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::error::SpecError;
use crate::Waveform;

/// Largest number of bins of a physical axis.
pub const MOST_AXIS_BINS: usize = 1024;
/// Narrowest sampled band of a waveform whose maps are on physical axes, Hz: its range resolution is 0.5 m.
pub const LEAST_SAMPLED_BAND_HZ: f64 = 0.3e9;
/// Fewest samples of a chirp of a waveform whose maps are on physical axes.
pub const LEAST_SAMPLES: usize = 32;
/// Fewest chirps of a frame of a waveform whose maps are on physical axes.
pub const LEAST_CHIRPS: usize = 8;
/// Largest number of samples of a chirp, and of chirps of a frame: the limit of the chip.
const MOST_SAMPLES: usize = 4095;
/// Fewest samples or chirps that are transformed, however coarse the axis.
const LEAST_TRANSFORMED: usize = 8;
/// Relative error that rounding leaves in a step; half a cell of the longest axis is a thousand times as much.
const ROUNDING: f64 = 1e-9;

/// Fixed axes of a map: range `k * range_step_m`, velocity `(j - velocity_bins / 2) * velocity_step_m_per_s`.
///
/// Frames of any waveform within limits are brought onto them: the discrete Fourier transform of the frame is evaluated at
/// exactly these ranges and velocities. The limits are [`LEAST_SAMPLED_BAND_HZ`], [`LEAST_SAMPLES`] and [`LEAST_CHIRPS`].
///
/// - Where a frame resolves finer than a step, only the fewest samples or chirps in its middle are used whose resolution is the
///   step. With all of them, an echo between two cells would show in neither.
/// - Where a frame resolves coarser than a step, an echo covers more cells, and neighbouring cells are correlated. So is noise.
/// - Cells beyond the unambiguous range or speed of a frame hold noise, see [`RdmProcessor`](super::RdmProcessor).
/// - Fewer samples or chirps lower an echo over noise by their processing gain. Nothing compensates for that.
///
/// The velocity axis is over the chirps of a frame only: velocities across frames would depend on the frame rate.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PhysicalAxes {
    /// Distance between neighbouring range cells, m.
    pub range_step_m: f64,
    /// Range cells, the first at 0 m.
    pub range_bins: usize,
    /// Difference between neighbouring velocity cells, m/s.
    pub velocity_step_m_per_s: f64,
    /// Velocity cells; the cell with index `velocity_bins / 2` is at 0 m/s.
    pub velocity_bins: usize,
}

/// Part of physical axes that frames of a waveform measure, and the part of the frames that is used.
#[derive(Debug, Clone, PartialEq)]
pub struct AxesCoverage {
    /// Indices of the samples of a chirp that are transformed.
    pub samples: Range<usize>,
    /// Indices of the chirps of a frame that are transformed.
    pub chirps: Range<usize>,
    /// Number of range cells that are measured, counted from the nearest.
    pub range_bins: usize,
    /// Indices of the velocity cells that are measured.
    pub velocity_bins: Range<usize>,
    /// Range resolution `c / 2B` of the transformed samples, m.
    pub range_resolution_m: f64,
    /// Velocity resolution of the transformed chirps, m/s.
    pub velocity_resolution_m_per_s: f64,
}

impl PhysicalAxes {
    /// Checks the axes themselves.
    ///
    /// # Errors
    /// [`SpecError::Axis`] if a step is not finite and above zero, or if a number of bins is out of range.
    pub(super) fn check(&self) -> Result<(), SpecError> {
        let expected_step = "a finite number above zero";
        let expected_bins = "2 to 1024 bins";
        for (key, value, is_allowed, expected) in [
            ("range_step_m", self.range_step_m, is_positive(self.range_step_m), expected_step),
            ("range_bins", self.range_bins as f64, is_bin_count(self.range_bins), expected_bins),
            (
                "velocity_step_m_per_s",
                self.velocity_step_m_per_s,
                is_positive(self.velocity_step_m_per_s),
                expected_step,
            ),
            ("velocity_bins", self.velocity_bins as f64, is_bin_count(self.velocity_bins), expected_bins),
        ] {
            if !is_allowed {
                return Err(SpecError::Axis { key, value, expected });
            }
        }
        Ok(())
    }

    /// Checks that frames of a waveform can be brought onto the axes.
    ///
    /// # Errors
    /// [`SpecError::Waveform`] if the sampled band, the samples, the chirps or the unambiguous speed are out of the limits.
    pub(super) fn check_waveform(&self, waveform: &Waveform) -> Result<(), SpecError> {
        let out_of_limits =
            |quantity, given: String, needed: String| Err(SpecError::Waveform { quantity, given, needed });
        let band_hz = waveform.sampled_bandwidth_hz();
        if !is_positive(band_hz) || band_hz < LEAST_SAMPLED_BAND_HZ {
            return out_of_limits(
                "the sampled band",
                format!("{:.3} GHz", band_hz * 1e-9),
                format!("{:.3} GHz or more", LEAST_SAMPLED_BAND_HZ * 1e-9),
            );
        }
        let request = &waveform.request;
        for (quantity, given, least) in [
            ("the number of samples of a chirp", request.samples_per_chirp, LEAST_SAMPLES),
            ("the number of chirps of a frame", request.chirps_per_frame, LEAST_CHIRPS),
        ] {
            if !(least..=MOST_SAMPLES).contains(&given) {
                return out_of_limits(quantity, given.to_string(), format!("{least} to {MOST_SAMPLES}"));
            }
        }
        let speed = waveform.max_velocity_m_per_s();
        if !is_positive(speed) || !is_positive(waveform.max_range_m()) {
            return out_of_limits(
                "the unambiguous speed",
                format!("{speed} m/s"),
                "a finite speed above zero".to_owned(),
            );
        }
        Ok(())
    }

    /// Part of the axes that frames of a waveform measure, for axes and waveforms within the limits.
    pub fn coverage(&self, waveform: &Waveform) -> AxesCoverage {
        let request = &waveform.request;
        let samples = central_interval(request.samples_per_chirp, waveform.range_step_m(1) / self.range_step_m);
        let chirps =
            central_interval(request.chirps_per_frame, waveform.velocity_step_m_per_s(1) / self.velocity_step_m_per_s);
        // The end of the range axis is the Nyquist frequency, which an ordinary map does not have either. Velocities within half a
        // cell of the unambiguous speed belong to the cells at the ends.
        let range_cells = waveform.max_range_m() / self.range_step_m * (1.0 - ROUNDING);
        let velocity_cells = waveform.max_velocity_m_per_s() / self.velocity_step_m_per_s + 0.5;
        let zero = self.velocity_bins / 2;
        let (below, above) = (velocity_cells.floor() as usize, velocity_cells.ceil() as usize);
        AxesCoverage {
            range_bins: (range_cells.ceil() as usize).max(1).min(self.range_bins),
            velocity_bins: zero.saturating_sub(below)..zero.saturating_add(above).min(self.velocity_bins),
            range_resolution_m: waveform.range_step_m(samples.len()),
            velocity_resolution_m_per_s: waveform.velocity_step_m_per_s(chirps.len()),
            samples,
            chirps,
        }
    }

    /// Number of range cells up to a range, at least one.
    pub(super) fn range_bins_up_to(&self, range_m: f64) -> usize {
        // A bound at a cell includes the cell, however it is rounded.
        ((range_m / self.range_step_m * (1.0 + ROUNDING)) as usize).saturating_add(1)
    }
}

fn is_positive(value: f64) -> bool {
    value.is_finite() && value > 0.0
}

fn is_bin_count(bins: usize) -> bool {
    (2..=MOST_AXIS_BINS).contains(&bins)
}

/// Interval in the middle of `length` samples or chirps with the fewest of them that resolve a step: `needed`, rounded up.
fn central_interval(length: usize, needed: f64) -> Range<usize> {
    let count = ((needed * (1.0 - ROUNDING)).ceil() as usize).max(LEAST_TRANSFORMED).min(length);
    let first = (length - count) / 2;
    first..first + count
}
