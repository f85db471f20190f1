//! Differences between simulations and recordings, with the differences between recordings as the reference for their
//! size.
//!
//! Confidence intervals come from resampling recordings, not cells, which are far from independent. For a single
//! recording, contiguous blocks are resampled; for the simulation, simulated copies.

use std::collections::BTreeMap;

use radome_dsp::Waveform;
use radome_dsp::detect::LEAKAGE_BINS;
use radome_dsp::statistics::{MapStatistics, Regions};
use radome_sim::receiver::calibration::ChannelFit;
use rand::rngs::StdRng;
use rand::{Rng, SeedableRng};
use rustfft::num_complex::Complex;
use serde::Serialize;

use super::copies::Simulated;
use super::recordings::Recordings;
use super::sample::{Sample, Sampler, cell_noise_db, regions};

/// Number of blocks that a single recording's part is cut into.
const BLOCKS: usize = 8;
/// Number of draws for an interval.
const DRAWS: usize = 400;
/// Fraction of the draws that the interval holds.
const CONFIDENCE: f64 = 0.95;

/// Figures of a comparison by name; figures that these maps cannot give are left out.
pub type Figures = BTreeMap<&'static str, f64>;

/// Maps of the parts of the recordings that simulations are compared with.
pub struct HeldOutMaps {
    waveform: Waveform,
    pub regions: Regions,
    channels: Vec<ChannelFit>,
    /// Samples of the recordings, or of the blocks of a single one.
    units: Vec<Sample>,
    /// Parts that the receiver was fitted to, by recording.
    fitted: Vec<Sample>,
    /// Name of the units that were resampled for the intervals.
    pub resampled: &'static str,
}

/// Comparison of one channel between recordings and simulations.
#[derive(Serialize)]
pub struct Channel {
    /// Receive antenna, from 1.
    pub rx: u8,
    /// Difference of the noise densities, dB: the largest of all range bins but the first and last, and the mean.
    pub noise_worst_db: f64,
    pub noise_mean_db: f64,
    /// Difference by range bin, from the second to the last but one, dB.
    pub noise_by_bin_db: Vec<f64>,
    /// Difference between the mean chirps' lowest range bins, relative to those of the recording.
    pub leakage_error: f64,
    #[serde(flatten)]
    pub figures: Figures,
    /// Interval that holds 95 of 100 draws, by name of the figure.
    pub interval: BTreeMap<&'static str, [f64; 2]>,
}

impl HeldOutMaps {
    /// Reads the recordings' maps. `target` is the range bin of the person.
    ///
    /// # Errors
    /// A recording cannot be read.
    pub fn new(recordings: &Recordings, channels: Vec<ChannelFit>, target: Option<usize>) -> anyhow::Result<Self> {
        let regions = regions(target);
        let mut sampler = Sampler::new(&recordings.waveform, &regions)?;
        let is_single = recordings.all.len() == 1;
        let (mut units, mut fitted) = (Vec::new(), Vec::new());
        for recording in &recordings.all {
            let mut first = Sample::default();
            let mut blocks = vec![Sample::default(); if is_single { BLOCKS } else { 1 }];
            recording.for_each_frame("making maps", |position, frame| {
                let block = ((position.in_part * blocks.len() as f64) as usize).min(blocks.len() - 1);
                sampler.add(frame, if position.is_fitted { &mut first } else { &mut blocks[block] })
            })?;
            units.extend(blocks);
            fitted.push(first);
        }
        let resampled = if is_single { "contiguous blocks of the one recording" } else { "recordings" };
        Ok(HeldOutMaps { waveform: recordings.waveform.clone(), regions, channels, units, fitted, resampled })
    }

    /// Returns the differences between real recordings by channel: the mean over all pairs, or those between the two parts of a single
    /// recording.
    pub fn differences_between_recordings(&self) -> Vec<Figures> {
        let pairs: Vec<(&Sample, Sample)> = match self.fitted.as_slice() {
            [fitted] => vec![(fitted, merged(&self.units))],
            _ => {
                let pair = |(i, a): (usize, _)| self.units[i + 1..].iter().map(move |b: &Sample| (a, b.clone()));
                self.units.iter().enumerate().flat_map(pair).collect()
            }
        };
        let channel = |rx: usize| {
            let mut sums: BTreeMap<&'static str, (f64, f64)> = BTreeMap::new();
            for (a, b) in &pairs {
                for (name, value) in self.figures(rx, &merge_channel([*a], rx), &merge_channel([b], rx), &self.channels)
                {
                    let (sum, count) = sums.entry(name).or_default();
                    // The order within a pair is arbitrary, so a difference counts by its absolute value.
                    *sum += if name.ends_with("difference_db") { value.abs() } else { value };
                    *count += 1.0;
                }
            }
            sums.into_iter().map(|(name, (sum, count))| (name, sum / count)).collect()
        };
        (0..self.channels.len()).map(channel).collect()
    }

    /// Compares the recordings with simulated copies, by channel.
    pub fn compare(&self, simulated: &Simulated) -> Vec<Channel> {
        let antennas = self.waveform.request.rx_antennas.antennas();
        let both = self.channels.iter().zip(&simulated.channels);
        antennas.iter().zip(both).enumerate().map(|(i, (&rx, both))| self.channel(i, rx, both, simulated)).collect()
    }

    fn channel(&self, i: usize, rx: u8, (real, fit): (&ChannelFit, &ChannelFit), simulated: &Simulated) -> Channel {
        let bins = real.density_lsb2.len();
        let densities = real.density_lsb2.iter().zip(&fit.density_lsb2);
        let differences: Vec<f64> =
            densities.map(|(real, fit)| 10.0 * (fit / real).log10()).take(bins.saturating_sub(1)).skip(1).collect();
        let samples = [merge_channel(&self.units, i), merge_channel(&simulated.samples, i)];
        let figures = self.figures(i, &samples[0], &samples[1], &simulated.channels);
        let mut rng = StdRng::seed_from_u64(i as u64);
        let mut drawn: BTreeMap<&'static str, Vec<f64>> = BTreeMap::new();
        for _ in 0..DRAWS {
            let (real, copies) = (resample(&self.units, i, &mut rng), resample(&simulated.samples, i, &mut rng));
            for (name, value) in self.figures(i, &real, &copies, &simulated.channels) {
                drawn.entry(name).or_default().push(value);
            }
        }
        let interval = |mut values: Vec<f64>| {
            values.sort_unstable_by(f64::total_cmp);
            let at = |part: f64| values[((values.len() - 1) as f64 * part).round() as usize];
            [at(0.5 - 0.5 * CONFIDENCE), at(0.5 + 0.5 * CONFIDENCE)]
        };
        Channel {
            rx,
            noise_worst_db: differences.iter().map(|d| d.abs()).fold(0.0, f64::max),
            noise_mean_db: differences.iter().sum::<f64>() / differences.len().max(1) as f64,
            noise_by_bin_db: differences,
            leakage_error: leakage_error(&real.chirp_lsb, &fit.chirp_lsb),
            figures,
            interval: drawn.into_iter().map(|(name, values)| (name, interval(values))).collect(),
        }
    }

    /// Computes all figures of one channel of two samples, the second with its own noise.
    fn figures(&self, rx: usize, a: &MapStatistics, b: &MapStatistics, other_noise: &[ChannelFit]) -> Figures {
        let mut figures = Figures::new();
        let noise = |channels: &[ChannelFit]| {
            channels.get(rx).map(|c| cell_noise_db(&c.density_lsb2, &self.waveform)).unwrap_or_default()
        };
        let raised = |sample: &MapStatistics, channels: &[ChannelFit]| sample.raised(&noise(channels));
        let raised = [raised(a, &self.channels), raised(b, other_noise)];
        figures.extend([
            ("mean_real_db", a.all.mean_db()),
            ("mean_simulated_db", b.all.mean_db()),
            ("sigma_real_db", a.all.sigma_db()),
            ("sigma_simulated_db", b.all.sigma_db()),
            ("raised_fraction_real", raised[0].map_or(0.0, |r| r.fraction)),
            ("raised_fraction_simulated", raised[1].map_or(0.0, |r| r.fraction)),
            ("raised_level_real_db", raised[0].map_or(0.0, |r| r.level_db)),
            ("raised_level_simulated_db", raised[1].map_or(0.0, |r| r.level_db)),
        ]);
        let Some(distance) = a.distance_to(b) else { return figures };
        let range_step_m = self.waveform.range_step_m(self.waveform.request.samples_per_chirp);
        let velocity_step = self.waveform.velocity_step_m_per_s(self.waveform.request.chirps_per_frame);
        figures.extend([
            ("mean_difference_db", distance.all.mean_db),
            ("sigma_difference_db", distance.all.sigma_db),
            ("kolmogorov_smirnov", distance.all.kolmogorov_smirnov),
            ("wasserstein_db", distance.all.wasserstein_db),
            ("doppler_m_per_s", distance.doppler_cells * velocity_step),
            ("range_m", distance.range_cells * range_step_m),
        ]);
        if let Some(target) = distance.target {
            figures.insert("target_kolmogorov_smirnov", target.kolmogorov_smirnov);
            figures.insert("target_wasserstein_db", target.wasserstein_db);
        }
        if let Some(still) = distance.zero_doppler {
            figures.insert("zero_doppler_kolmogorov_smirnov", still.kolmogorov_smirnov);
            figures.insert("zero_doppler_wasserstein_db", still.wasserstein_db);
        }
        figures
    }
}

fn merged(samples: &[Sample]) -> Sample {
    let mut all = Sample::default();
    samples.iter().for_each(|sample| all.merge(sample));
    all
}

/// Merges one channel of all samples.
fn merge_channel<'a>(samples: impl IntoIterator<Item = &'a Sample>, rx: usize) -> MapStatistics {
    let mut all = MapStatistics::default();
    samples.into_iter().filter_map(|sample| sample.maps.get(rx)).for_each(|maps| all.merge(maps));
    all
}

/// Draws as many samples as there are, with replacement, and merges one channel of them.
fn resample(samples: &[Sample], rx: usize, rng: &mut StdRng) -> MapStatistics {
    merge_channel((0..samples.len()).filter_map(|_| samples.get(rng.random_range(0..samples.len()))), rx)
}

/// Relative difference between two mean chirps in the range bins that hold leakage: complex difference over the content
/// of the first. Both are taken without their means, under a Hann window.
fn leakage_error(real: &[f64], simulated: &[f64]) -> f64 {
    let bins = |chirp: &[f64]| {
        let (n, mean) = (chirp.len() as f64, chirp.iter().sum::<f64>() / chirp.len().max(1) as f64);
        let bin = |k: usize| {
            let cell = |(i, x): (usize, &f64)| {
                let turn = std::f64::consts::TAU * i as f64 / n;
                Complex::from_polar((0.5 - 0.5 * turn.cos()) * (x - mean), -turn * k as f64)
            };
            chirp.iter().enumerate().map(cell).sum::<Complex<f64>>()
        };
        (0..LEAKAGE_BINS).map(bin).collect::<Vec<_>>()
    };
    let (real, simulated) = (bins(real), bins(simulated));
    let difference: f64 = real.iter().zip(&simulated).map(|(a, b)| (a - b).norm_sqr()).sum();
    (difference / real.iter().map(|z| z.norm_sqr()).sum::<f64>()).sqrt()
}
