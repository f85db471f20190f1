//! Range-Doppler maps.

use serde::{Deserialize, Serialize};

use super::motion::Motion;

/// Shape of a map: the lengths of its axes, in order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct RdmShape {
    /// Receive channels (1 for a single channel or an incoherent sum).
    pub rx: usize,
    /// Doppler bins, zero velocity at `doppler / 2`.
    pub doppler: usize,
    /// Range bins, zero range first.
    pub range: usize,
}

impl RdmShape {
    /// Number of cells in a map.
    pub fn cells(self) -> usize {
        self.rx * self.doppler * self.range
    }
}

impl std::fmt::Display for RdmShape {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} rx x {} doppler x {} range", self.rx, self.doppler, self.range)
    }
}

/// Counts of suspicious samples and cells of a map.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct MapFlags {
    /// Codes at either end of the ADC (0 or 4095) in the frame's used channels.
    pub saturated_samples: u32,
    /// Cells that are NaN or infinite.
    pub non_finite_cells: u32,
}

/// One range-Doppler map, f32 dB `[rx][doppler][range]`.
///
/// [`RdmProcessor::empty_map`](super::RdmProcessor::empty_map) creates one of the right shape.
#[derive(Debug, Clone, PartialEq)]
pub struct Rdm {
    /// Lengths of the axes.
    pub shape: RdmShape,
    /// Cells in dB, `[rx][doppler][range]`.
    pub db: Vec<f32>,
    /// Range of bin 1, m.
    pub range_step_m: f64,
    /// Velocity of one Doppler bin, m/s.
    pub velocity_step_m_per_s: f64,
    /// Sequence number of the frame, or of the last frame, that the map was computed from.
    pub sequence: u64,
    /// Counts of saturated samples and of cells that are not finite.
    pub flags: MapFlags,
    /// Motion of echoes over the last frames; `None` unless the spec asks for it ([`RdmSpec::motion_over_s`](super::RdmSpec)).
    pub motion: Option<Motion>,
}

impl Rdm {
    /// Value of a cell, dB.
    ///
    /// # Panics
    /// If the position that the indices give is beyond the end of `db`.
    pub fn at(&self, rx: usize, doppler: usize, range: usize) -> f32 {
        self.db[(rx * self.shape.doppler + doppler) * self.shape.range + range]
    }

    /// Radial velocity of a Doppler index, m/s; positive is receding.
    pub fn velocity_m_per_s(&self, doppler: usize) -> f64 {
        (doppler as f64 - (self.shape.doppler / 2) as f64) * self.velocity_step_m_per_s
    }

    /// Range of a range index, m.
    pub fn range_m(&self, range: usize) -> f64 {
        range as f64 * self.range_step_m
    }

    /// Index `(rx, doppler, range)` of the strongest finite cell; `None` if there is none.
    pub fn peak(&self) -> Option<(usize, usize, usize)> {
        let (index, _) = self.db.iter().enumerate().filter(|(_, v)| v.is_finite()).max_by(|a, b| a.1.total_cmp(b.1))?;
        let RdmShape { doppler, range, .. } = self.shape;
        Some((index / (doppler * range), index / range % doppler, index % range))
    }
}
