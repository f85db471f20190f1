//! Fits a receiver to a recording. The scene before the chip may be anything, or empty.
//!
//! - *Noise.* Second differences of three consecutive chirps cancel static echoes and changes that are linear from
//!   chirp to chirp. A breathing chest is cancelled to far below noise. A walking person only disturbs the range bins
//!   around that person. The values of noise periodograms are exponentially distributed. Their density is the mean of
//!   the lower seven tenths of the values, divided by its expectation. Disturbed values do not change it, because they
//!   are among the upper ones. A receiver's density is smooth over neighbouring bins.
//! - *Offset, settling and leakage.* The median over frames of the mean chirp leaves out moving echoes. It is fitted by
//!   a constant, two exponentials and four tones of up to two cycles a chirp, by least squares. Static echoes have
//!   higher beat frequencies and do not take part.
//! - *Jitter and drift* of offset and leakage, between frames and over the recording, with noise subtracted.
//!
//! Echo levels are not fitted here: without a target of known size in the recording, the receiver's gain cannot be
//! separated from the targets' reflectivity. If a scene is a copy of the recorded one, [`gain`] fits the levels to
//! static echoes.
//!
//! A recording may be larger than memory. A few numbers are kept of each frame, and an evenly spaced subset of its
//! chirps and noise.

pub mod gain;
mod leakage;

use std::sync::Arc;

use num_complex::Complex64;
use radome_dsp::spectrum::real_fft;
use radome_dsp::{Frame, Waveform};
use realfft::RealToComplex;
use thiserror::Error;

use super::{Receiver, RxChannel};
use crate::math::{median, weighted_median};
use leakage::{ChirpModel, fit_chirp_model};

/// Least number of frames for a fit.
pub const LEAST_FRAMES: usize = 16;
/// Upper limit of evenly spaced periodograms of a recording's noise that are kept for each channel.
const MOST_PERIODOGRAMS: usize = 20_000;
/// Upper limit of frames whose mean chirps are kept.
const MOST_CHIRPS: usize = 4096;
/// Least power of a channel's leakage over the noise of one frame. A channel without leakage reaches a few hundred: the
/// fitted tones and settling exponentials are nearly dependent, so that noise gives small tones.
const LEAST_LEAKAGE_RATIO: f64 = 1e3;
/// Ratio of a normal distribution's standard deviation to its median absolute deviation.
const SIGMA_PER_MAD: f64 = 1.4826;
/// Median of the square of a normal variable of variance 1.
const MEDIAN_OF_SQUARED_NORMAL: f64 = 0.454_936;

/// Error of a recording to which no receiver can be fitted.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum CalibrationError {
    /// The recording has too few frames.
    #[error("calibration: {got} frames, at least {LEAST_FRAMES} are needed\n\nhint: record ten seconds or more")]
    TooShort {
        /// Number of frames.
        got: usize,
    },
    /// The frames cannot be differenced.
    #[error("calibration: {chirps} chirps of {samples} samples a frame, at least 3 of 16 are needed")]
    Shape {
        /// Number of chirps in a frame.
        chirps: usize,
        /// Number of samples in a chirp.
        samples: usize,
    },
    /// A frame has another shape than the first one.
    #[error("calibration: frame {sequence} has another shape than the waveform says")]
    Frame {
        /// Sequence number of the frame.
        sequence: u64,
    },
    /// A channel has no noise. Codes that never change do not come from a receiver.
    #[error("calibration: channel {rx} shows no noise\n\nhint: is it a recording of raw codes of a powered receiver?")]
    Silent {
        /// Index of the channel in the frame.
        rx: usize,
    },
}

/// Data that are kept of one channel's frames.
struct Channel {
    /// Periodograms of second differences, `[periodogram][bin]`, LSB^2 per sample.
    periodograms: Vec<Vec<f32>>,
    /// Mean chirps of the frames, LSB.
    chirps: Vec<Vec<f32>>,
    /// Offset and leakage of every frame, `[recording][frame]`.
    levels: Vec<Vec<Level>>,
}

/// Data that are kept of every frame's mean chirp.
#[derive(Debug, Clone, Copy)]
struct Level {
    /// Mean of the chirp, LSB.
    offset_lsb: f64,
    /// Component at one cycle a chirp, LSB. It contains the leakage and few echoes.
    leakage: Complex64,
}

impl Level {
    /// Level of a mean chirp, with a Hann window for the leakage.
    fn of(chirp_lsb: impl ExactSizeIterator<Item = f64>) -> Self {
        let sample_count = chirp_lsb.len() as f64;
        let (mut sum, mut leakage) = (0.0, Complex64::default());
        for (i, x) in chirp_lsb.enumerate() {
            let angle = std::f64::consts::TAU * i as f64 / sample_count;
            sum += x;
            leakage += Complex64::from_polar((0.5 - 0.5 * angle.cos()) * x, -angle);
        }
        Level { offset_lsb: sum / sample_count, leakage }
    }
}

/// Accumulator of frames, to which a receiver is fitted.
pub struct Calibration {
    waveform: Waveform,
    channels: Vec<Channel>,
    fft: Arc<dyn RealToComplex<f64>>,
    /// Number of frames that were added.
    frame_count: usize,
    /// Number of periodograms of which one is kept.
    periodogram_stride: usize,
    /// Number of mean chirps of which one is kept.
    chirp_stride: usize,
}

/// A fitted channel with the error of the fit.
#[derive(Debug, Clone, PartialEq)]
pub struct ChannelFit {
    /// Measured noise density for bins 0..=N/2, LSB^2 per sample.
    pub density_lsb2: Vec<f64>,
    /// Median of the frames' mean chirps, LSB.
    pub chirp_lsb: Vec<f64>,
    /// Error of the fit of `chirp_lsb`, LSB rms.
    pub residual_lsb: f64,
}

/// A fitted receiver.
#[derive(Debug, Clone, PartialEq)]
pub struct Fit {
    /// Receiver: the base with the measured values in place of its own.
    pub receiver: Receiver,
    /// Measured channels, in the order of the frame.
    pub channels: Vec<ChannelFit>,
}

impl Calibration {
    /// Makes an empty calibration for recordings of a waveform with about `frames` frames in all.
    ///
    /// # Errors
    /// [`CalibrationError::Shape`] if a frame has too few chirps or samples.
    pub fn new(waveform: &Waveform, frames: usize) -> Result<Self, CalibrationError> {
        let shape = waveform.shape();
        if shape.chirps < 3 || shape.samples < 16 {
            return Err(CalibrationError::Shape { chirps: shape.chirps, samples: shape.samples });
        }
        let channel = |_| Channel { periodograms: Vec::new(), chirps: Vec::new(), levels: vec![Vec::new()] };
        let channels = (0..shape.rx).map(channel).collect();
        Ok(Calibration {
            waveform: waveform.clone(),
            channels,
            fft: real_fft(shape.samples),
            frame_count: 0,
            periodogram_stride: frames.saturating_mul(shape.chirps - 2).div_ceil(MOST_PERIODOGRAMS).max(1),
            chirp_stride: frames.div_ceil(MOST_CHIRPS).max(1),
        })
    }

    /// Begins another recording. Changes from the last frame to its first one are not counted.
    pub fn begin_recording(&mut self) {
        self.channels.iter_mut().for_each(|channel| channel.levels.push(Vec::new()));
    }

    /// Adds a frame.
    ///
    /// # Errors
    /// [`CalibrationError::Frame`] if the frame has another shape than the waveform states.
    pub fn push(&mut self, frame: &Frame) -> Result<(), CalibrationError> {
        let shape = self.waveform.shape();
        if frame.shape != shape || frame.codes.len() != shape.codes() {
            return Err(CalibrationError::Frame { sequence: frame.sequence });
        }
        let sample_count = shape.samples;
        let mut spectrum = self.fft.make_output_vec();
        for (channel, codes) in self.channels.iter_mut().zip(frame.codes.chunks(shape.chirps * sample_count)) {
            let chirps: Vec<&[u16]> = codes.chunks(sample_count).collect();
            let mut mean = vec![0f32; sample_count];
            for (sample, mean) in mean.iter_mut().enumerate() {
                let sum: u64 = chirps.iter().map(|chirp| u64::from(chirp[sample])).sum();
                *mean = (sum as f64 / chirps.len() as f64) as f32;
            }
            if let Some(levels) = channel.levels.last_mut() {
                levels.push(Level::of(mean.iter().map(|&x| f64::from(x))));
            }
            if self.frame_count.is_multiple_of(self.chirp_stride) {
                channel.chirps.push(mean);
            }
            for (triple_index, triple) in chirps.windows(3).enumerate() {
                if !(self.frame_count * (shape.chirps - 2) + triple_index).is_multiple_of(self.periodogram_stride) {
                    continue;
                }
                let [a, b, c] =
                    [triple[0], triple[1], triple[2]].map(|chirp| chirp.iter().map(|&code| f64::from(code)));
                // The sum of squared weights, 1 + 4 + 1, scales a sample's variance.
                let second_difference = |((a, b), c): ((f64, f64), f64)| (a - 2.0 * b + c) / 6f64.sqrt();
                let mut difference: Vec<f64> = a.zip(b).zip(c).map(second_difference).collect();
                if self.fft.process(&mut difference, &mut spectrum).is_ok() {
                    let power = spectrum.iter().map(|x| (x.norm_sqr() / sample_count as f64) as f32);
                    channel.periodograms.push(power.collect());
                }
            }
        }
        self.frame_count += 1;
        Ok(())
    }

    /// Fits the receiver that recorded the frames: `base` with the measured values.
    ///
    /// # Errors
    /// [`CalibrationError::TooShort`] if there are too few frames, and [`CalibrationError::Silent`] if a channel has no
    /// noise.
    pub fn fit(&self, base: &Receiver, name: &str, measured_from: &str) -> Result<Fit, CalibrationError> {
        if self.frame_count < LEAST_FRAMES {
            return Err(CalibrationError::TooShort { got: self.frame_count });
        }
        let channels = self.channels.iter().map(|channel| self.measure(channel)).collect::<Vec<_>>();
        for (rx, (fit, _)) in channels.iter().enumerate() {
            let interior = fit.density_lsb2.iter().skip(1);
            if interior.fold(0f64, |most, d| most.max(*d)) < 1e-4 {
                return Err(CalibrationError::Silent { rx });
            }
        }
        let mut receiver = Receiver { name: name.to_owned(), measured_from: measured_from.to_owned(), ..base.clone() };
        let antennas = self.waveform.request.rx_antennas.antennas();
        while receiver.rx.len() < 3 {
            receiver.rx.push(RxChannel::default());
        }
        for ((fit, model), antenna) in channels.iter().zip(antennas) {
            if let Some(rx) = receiver.rx.get_mut(usize::from(antenna).saturating_sub(1)) {
                rx.dc_code = model.constant_lsb.clamp(0.0, 4095.0);
                rx.noise_db = 0.0;
                rx.psd_lsb2 = Some(smoothed(&fit.density_lsb2));
                rx.leakage.clone_from(&model.leakage);
                rx.transient.clone_from(&model.transient);
            }
        }
        let count = channels.len().max(1) as f64;
        let bins = self.waveform.request.samples_per_chirp / 2 + 1;
        let mean = |bin: usize| channels.iter().map(|(fit, _)| fit.density_lsb2[bin]).sum::<f64>() / count;
        receiver.noise.psd_lsb2 = Some(smoothed(&(0..bins).map(mean).collect::<Vec<_>>()));
        let models: Vec<&ChirpModel> = channels.iter().map(|(_, model)| model).collect();
        self.fit_changes(&models, &mut receiver);
        Ok(Fit { receiver, channels: channels.into_iter().map(|(fit, _)| fit).collect() })
    }

    /// Measures a channel's noise density and mean chirp, and fits the mean chirp.
    fn measure(&self, channel: &Channel) -> (ChannelFit, ChirpModel) {
        let n = self.waveform.request.samples_per_chirp;
        let density_lsb2: Vec<f64> = (0..=n / 2)
            .map(|bin| {
                let powers = channel.periodograms.iter().map(|powers| f64::from(powers[bin])).collect();
                // At both ends the spectrum is real, and its powers are squares of a normal variable.
                let is_real = bin == 0 || 2 * bin == n;
                if is_real { median(powers) / MEDIAN_OF_SQUARED_NORMAL } else { exponential_mean(powers) }
            })
            .collect();
        let sample = |i: usize| median(channel.chirps.iter().map(|chirp| f64::from(chirp[i])).collect());
        let chirp_lsb: Vec<f64> = (0..n).map(sample).collect();
        let model = fit_chirp_model(&chirp_lsb, &self.waveform);
        (ChannelFit { density_lsb2, residual_lsb: model.residual_lsb, chirp_lsb }, model)
    }

    /// Fits jitter and drift of offsets and of the leakage: medians over channels and recordings. Those of the leakage
    /// are weighted by its power, because the same error is larger relative to weaker leakage. Without leakage, the
    /// receiver keeps its values.
    fn fit_changes(&self, models: &[&ChirpModel], receiver: &mut Receiver) {
        let interval_s = self.waveform.frame_interval_s();
        let (samples, chirps) =
            (self.waveform.request.samples_per_chirp, self.waveform.request.chirps_per_frame as f64);
        let frames_per_second = ((1.0 / interval_s).round() as usize).max(1);
        let (mut dc_jitters, mut dc_drifts, mut leakage_jitters, mut leakage_drifts) =
            (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        for (channel, model) in self.channels.iter().zip(models) {
            let density = |bin: usize| median(channel.periodograms.iter().map(|p| f64::from(p[bin])).collect());
            let noise_lsb2 = density(0) / MEDIAN_OF_SQUARED_NORMAL / (samples as f64 * chirps);
            let template = Level::of(model.leakage_lsb(samples, &self.waveform).into_iter()).leakage;
            // Hann's window keeps three eighths of the power, of which half is in phase with the leakage.
            let noise_power = density(1) / std::f64::consts::LN_2 * 0.1875 * samples as f64 / chirps;
            let template_power = template.norm_sqr();
            for levels in channel.levels.iter().filter(|levels| levels.len() > 1) {
                let offsets: Vec<f64> = levels.iter().map(|level| level.offset_lsb).collect();
                dc_jitters.push((step_variance(&offsets) - noise_lsb2).max(0.0).sqrt());
                let half = offsets.len() / 2;
                let slopes =
                    offsets.iter().zip(offsets.iter().skip(half)).map(|(a, b)| (b - a) / (half as f64 * interval_s));
                dc_drifts.push(median(slopes.collect()).abs());
                if template_power <= LEAST_LEAKAGE_RATIO * noise_power {
                    continue;
                }
                let amplitudes: Vec<f64> =
                    levels.iter().map(|level| (level.leakage * template.conj()).re / template_power).collect();
                leakage_jitters.push((
                    (step_variance(&amplitudes) - noise_power / template_power).max(0.0).sqrt(),
                    template_power,
                ));
                // Means over seconds replace frames, so that jitter does not count as drift.
                let means: Vec<f64> =
                    amplitudes.chunks(frames_per_second).map(|of| of.iter().sum::<f64>() / of.len() as f64).collect();
                let lag = 10.min(means.len().saturating_sub(1));
                let changes = means.iter().zip(means.iter().skip(lag)).map(|(a, b)| (b - a).abs());
                let jitter_variance = 2.0 * step_variance(&amplitudes) / frames_per_second as f64;
                let drift_variance = (median(changes.collect()) * SIGMA_PER_MAD).powi(2) - jitter_variance;
                leakage_drifts.push(((drift_variance.max(0.0) * 10.0 / lag.max(1) as f64).sqrt(), template_power));
            }
        }
        receiver.drift.dc_jitter_lsb = median(dc_jitters);
        receiver.drift.dc_lsb_per_s = median(dc_drifts);
        let clutter = &mut receiver.clutter;
        clutter.leakage_jitter =
            weighted_median(leakage_jitters).map_or(clutter.leakage_jitter, |jitter| jitter.min(1.0));
        clutter.leakage_drift_per_10s =
            weighted_median(leakage_drifts).map_or(clutter.leakage_drift_per_10s, |drift| drift.min(1.0));
    }
}

/// Variance of jitter: half of the variance of the steps between values. A few large steps hardly change it.
fn step_variance(values: &[f64]) -> f64 {
    let steps = values.windows(2).map(|pair| (pair[1] - pair[0]).abs()).collect();
    (median(steps) * SIGMA_PER_MAD).powi(2) / 2.0
}

/// Smooths a density by the binomial mean of five logarithms. The steep lowest bins are kept.
fn smoothed(density: &[f64]) -> Vec<f64> {
    /// First bin that is smoothed. Leakage and 1/f noise are steep below it.
    const FIRST: usize = 3;
    const WEIGHTS: [f64; 5] = [1.0, 4.0, 6.0, 4.0, 1.0];
    let smoothed_at = |bin: usize| {
        let neighbours = WEIGHTS.iter().enumerate().filter_map(|(i, weight)| {
            let neighbour = (bin + i).checked_sub(2).filter(|&neighbour| neighbour >= FIRST)?;
            Some((weight, density.get(neighbour)?.max(1e-12).ln()))
        });
        let (log_sum, weight_sum) = neighbours
            .fold((0.0, 0.0), |(log_sum, weight_sum), (weight, ln)| (log_sum + weight * ln, weight_sum + weight));
        (log_sum / weight_sum).exp()
    };
    density.iter().enumerate().map(|(bin, &value)| if bin < FIRST { value } else { smoothed_at(bin) }).collect()
}

/// Mean of exponentially distributed values, robust against outliers among the upper ones.
fn exponential_mean(mut values: Vec<f64>) -> f64 {
    /// Fraction of values that is used, from below. Its mean is `1 + ln(1 - q) (1 - q) / q` if the mean of all is one.
    const USED_FRACTION: f64 = 0.7;
    let count = (values.len() as f64 * USED_FRACTION) as usize;
    if count == 0 {
        return median(values);
    }
    values.select_nth_unstable_by(count, f64::total_cmp);
    let expected_mean = 1.0 + (1.0 - USED_FRACTION).ln() * (1.0 - USED_FRACTION) / USED_FRACTION;
    values[..count].iter().sum::<f64>() / count as f64 / expected_mean
}

#[cfg(test)]
mod tests {
    use radome_dsp::WaveformRequest;

    use super::*;
    use crate::receiver::Leakage;
    use crate::receiver::noise::channel_density_lsb2;
    use crate::{Scene, SimulateOptions, Simulator};

    fn waveform() -> Waveform {
        let request: WaveformRequest = toml::from_str(
            r#"
            start_frequency_hz = 58e9
            end_frequency_hz = 63.5e9
            samples_per_chirp = 64
            chirps_per_frame = 16
            sample_rate_hz = 2e6
            chirp_interval_s = 591e-6
            frame_interval_s = 0.077
            rx_antennas = [1, 2, 3]
            tx_power_level = 31
            if_gain_db = 23.0
            high_pass_cutoff_hz = 80e3
            anti_alias_cutoff_hz = 500e3
            "#,
        )
        .expect("a request");
        Waveform::realise(request).expect("a waveform")
    }

    fn frames(receiver: &Receiver, count: u64) -> Vec<Frame> {
        let scene = Scene::empty_space(&waveform()).expect("nothing").with_receiver(receiver.clone());
        let simulator = Simulator::new(&scene, SimulateOptions::default()).expect("a simulator");
        (0..count).map(|index| simulator.frame(index)).collect()
    }

    fn fit(frames: &[Frame]) -> Result<Fit, CalibrationError> {
        let mut calibration = Calibration::new(&waveform(), frames.len())?;
        frames.iter().try_for_each(|frame| calibration.push(frame))?;
        calibration.fit(&Receiver::typical(), "fitted", "a test")
    }

    /// Noise by bin, offsets, mean chirps and jitter.
    #[test]
    fn the_parameters_of_a_simulated_receiver_are_recovered() {
        let mut receiver = Receiver::typical();
        receiver.rx[1].noise_db = 2.0;
        receiver.drift.dc_jitter_lsb = 0.8;
        receiver.clutter.leakage_jitter = 0.004;
        let all = frames(&receiver, 160);
        let found = fit(&all).expect("a fit");
        for (channel, rx) in found.channels.iter().zip(&receiver.rx) {
            let exact = channel_density_lsb2(&receiver, rx, &waveform());
            for (bin, (got, exact)) in channel.density_lsb2.iter().zip(&exact).enumerate().skip(1).take(31) {
                let off_db = 10.0 * (got / exact).log10();
                assert!(off_db.abs() < 0.8, "bin {bin}: {got} beside {exact}");
            }
            assert!(channel.residual_lsb < 1.0, "{}", channel.residual_lsb);
        }
        // The fitted receiver, simulated again, has the same chirps and the same noise.
        let again = fit(&frames(&found.receiver, 160)).expect("a fit of the fit");
        for (first, second) in found.channels.iter().zip(&again.channels) {
            let differences: Vec<f64> = first.chirp_lsb.iter().zip(&second.chirp_lsb).map(|(a, b)| a - b).collect();
            // Offsets drift, so their differences have wide limits.
            let mean = differences.iter().sum::<f64>() / differences.len() as f64;
            assert!(mean.abs() < 10.0, "{mean} LSB");
            assert!(differences.iter().all(|d| (d - mean).abs() < 4.0), "{differences:?}");
        }
        // The part of a mean chirp that is called leakage is ambiguous, but the amplitude of its jitter is not.
        let jitters = [&found, &again].map(|fit| fit.receiver.clutter.leakage_jitter);
        assert!(jitters[0] > 0.002 && (0.5..2.0).contains(&(jitters[1] / jitters[0])), "{jitters:?}");
        let dc = found.receiver.drift.dc_jitter_lsb;
        assert!((0.5..1.1).contains(&dc), "{dc}");
        assert_eq!(found.receiver.first_invalid(), None);
    }

    /// Regression test: in channels without leakage, noise was taken for a jitter and a drift of 1.
    #[test]
    fn without_leakage_its_jitter_and_drift_stay_those_of_the_base() {
        let mut receiver = Receiver::typical();
        (receiver.drift.dc_jitter_lsb, receiver.drift.dc_lsb_per_s) = (0.0, 0.0);
        receiver.clutter.leakage_jitter = 0.004;
        for rx in &mut receiver.rx {
            rx.transient.clear();
            rx.leakage.clear();
        }
        let kept = fit(&frames(&receiver, 160)).expect("a fit").receiver.clutter;
        assert_eq!(kept, Receiver::typical().clutter);
        receiver.rx[0].leakage = vec![Leakage { delay_s: 0.18e-9, amplitude_lsb: 200.0, phase_rad: 1.0 }];
        let found = fit(&frames(&receiver, 160)).expect("a fit").receiver.clutter;
        assert!((0.002..0.008).contains(&found.leakage_jitter), "{found:?}");
        assert!(found.leakage_drift_per_10s < 0.02, "{found:?}");
    }

    #[test]
    fn a_difference_of_offsets_between_recordings_is_neither_jitter_nor_drift() {
        let mut second = Receiver::typical();
        second.rx.iter_mut().for_each(|rx| rx.dc_code += 200.0);
        let recordings = [frames(&Receiver::typical(), 60), frames(&second, 60)];
        let mut calibration = Calibration::new(&waveform(), 120).expect("a calibration");
        for recording in &recordings {
            calibration.begin_recording();
            recording.iter().try_for_each(|frame| calibration.push(frame)).expect("frames");
        }
        let found = calibration.fit(&Receiver::typical(), "fitted", "a test").expect("a fit").receiver.drift;
        assert!(found.dc_lsb_per_s < 1.0 && found.dc_jitter_lsb < 1.0, "{found:?}");
    }

    mod hard_cases {
        use super::*;

        /// Most chirps of a long recording are not kept. The result is the same except for random errors.
        #[test]
        fn keeping_a_fraction_of_the_chirps_gives_the_same_fit() {
            let all = frames(&Receiver::typical(), 96);
            let fits = [all.len(), 40 * MOST_CHIRPS].map(|announced| {
                let mut calibration = Calibration::new(&waveform(), announced).expect("a calibration");
                all.iter().try_for_each(|frame| calibration.push(frame)).expect("frames");
                calibration.fit(&Receiver::typical(), "fitted", "a test").expect("a fit")
            });
            for (all, kept) in fits[0].channels.iter().zip(&fits[1].channels) {
                let differences = all.chirp_lsb.iter().zip(&kept.chirp_lsb).map(|(a, b)| (a - b).abs());
                assert!(differences.fold(0.0, f64::max) < 3.0);
            }
        }

        #[test]
        fn short_silent_and_misshapen_recordings_are_refused() {
            let all = frames(&Receiver::typical(), 17);
            assert!(matches!(fit(&all[..15]), Err(CalibrationError::TooShort { got: 15 })));
            let mut silent = all.clone();
            silent.iter_mut().for_each(|frame| frame.codes.fill(2048));
            assert_eq!(fit(&silent).err(), Some(CalibrationError::Silent { rx: 0 }));
            let mut cut = all;
            cut[3].codes.pop();
            assert!(matches!(fit(&cut), Err(CalibrationError::Frame { sequence: 3 })));
        }

        /// Codes that saturate in some frames, as with a hand before the antenna, do not change the result.
        #[test]
        fn clipped_frames_hardly_change_the_noise_density() {
            let clean = frames(&Receiver::typical(), 80);
            let mut spoiled = clean.clone();
            for frame in spoiled.iter_mut().step_by(5) {
                frame.codes.iter_mut().step_by(3).for_each(|code| *code = 4095);
            }
            let (clean, spoiled) = (fit(&clean).expect("clean"), fit(&spoiled).expect("spoiled"));
            for (a, b) in clean.channels.iter().zip(&spoiled.channels) {
                for (a, b) in a.density_lsb2.iter().zip(&b.density_lsb2).skip(1).take(30) {
                    assert!((10.0 * (b / a).log10()).abs() < 2.5, "{a} {b}");
                }
            }
        }
    }
}
