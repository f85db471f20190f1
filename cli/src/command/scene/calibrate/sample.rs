//! Samples of frames for comparison: their maps, receiver by receiver.

use radome_dsp::detect::LEAKAGE_BINS;
use radome_dsp::rdm::StaticRemoval;
use radome_dsp::statistics::{MapStatistics, Regions};
use radome_dsp::{Frame, MapStatus, Rdm, RdmProcessor, RdmSpec, Waveform, Window};

/// Number of range bins on either side of the person that are compared separately.
const TARGET_BINS: usize = 2;

/// Regions of maps to compare, given the positions of people.
pub fn regions(target_bin: Option<usize>) -> Regions {
    let target = target_bin.map_or(0..0, |bin| bin.saturating_sub(TARGET_BINS)..bin + TARGET_BINS + 1);
    Regions { first_bin: LEAKAGE_BINS, target }
}

/// Computes samples of frames.
pub struct Sampler {
    regions: Regions,
    /// Processors without static echoes, and with them.
    processors: [RdmProcessor; 2],
    map: Rdm,
}

/// Maps of some frames, by receiver.
#[derive(Default, Clone)]
pub struct Sample {
    pub maps: Vec<MapStatistics>,
}

impl Sampler {
    /// Creates a sampler for frames of a waveform.
    ///
    /// # Errors
    /// The map is not valid for the waveform.
    pub fn new(waveform: &Waveform, regions: &Regions) -> anyhow::Result<Self> {
        let moving = RdmSpec { static_removal: StaticRemoval::SlowTimeMean, ..RdmSpec::default() };
        let processors = [RdmProcessor::new(&moving, waveform)?, RdmProcessor::new(&RdmSpec::default(), waveform)?];
        let map = processors[0].empty_map();
        Ok(Sampler { regions: regions.clone(), processors, map })
    }

    /// Adds a frame to a sample.
    ///
    /// # Errors
    /// The frame does not have the shape of the waveform.
    pub fn add(&mut self, frame: &Frame, sample: &mut Sample) -> anyhow::Result<()> {
        sample.maps.resize(frame.shape.rx, MapStatistics::default());
        let [moving, all] = &mut self.processors;
        if moving.process(frame, &mut self.map)? == MapStatus::Ready {
            for (rx, maps) in sample.maps.iter_mut().enumerate() {
                maps.add(&self.map, rx, &self.regions);
            }
        }
        if all.process(frame, &mut self.map)? == MapStatus::Ready {
            for (rx, maps) in sample.maps.iter_mut().enumerate() {
                maps.add_zero_doppler(&self.map, rx, &self.regions);
            }
        }
        Ok(())
    }
}

impl Sample {
    pub fn merge(&mut self, other: &Sample) {
        self.maps.resize(self.maps.len().max(other.maps.len()), MapStatistics::default());
        self.maps.iter_mut().zip(&other.maps).for_each(|(a, b)| a.merge(b));
    }
}

/// Mean noise power in the cells of each range bin of a map, dB, from its density in LSB^2 per sample.
pub fn cell_noise_db(density_lsb2: &[f64], waveform: &Waveform) -> Vec<f64> {
    let sums = |length: usize| {
        let weights = Window::Hann.weights(length);
        (weights.iter().sum::<f64>(), weights.iter().map(|w| w * w).sum::<f64>())
    };
    let (range, range_squares) = sums(waveform.request.samples_per_chirp);
    let (doppler, doppler_squares) = sums(waveform.request.chirps_per_frame);
    let scale = range_squares * doppler_squares * (2.0 / (range * doppler * 2048.0)).powi(2);
    density_lsb2.iter().map(|density| 10.0 * (density * scale).max(1e-30).log10()).collect()
}
