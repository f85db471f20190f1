//! Fits a receiver to a recording: what the chip shows with anything or nothing in front of it.
//!
//! - *Noise.* Second differences of three chirps in a row: what stands still, and what moves evenly, cancels (a breathing chest
//!   to far below noise, somebody who walks only while he is in a bin). The median over a recording of their periodograms over
//!   ln 2 is the density of Gaussian noise, whatever a few frames held (reference: median of an exponential distribution).
//! - *Offset, settling and leakage.* Median over the frames of each sample's mean over chirps, so that what moves is left out;
//!   fitted by a constant, two exponentials and four tones of up to two cycles a chirp, by least squares. Echoes of what stands
//!   still lie at higher beats and are left alone.
//! - *Jitter and drift* of offset and leakage, between frames and over the recording, noise subtracted.
//!
//! Echo levels are not fitted: without a target of known size in the recording they cannot be told from what it reflects.

mod leakage;

use std::sync::Arc;

use num_complex::Complex64;
use radome_dsp::{Frame, Waveform};
use realfft::{RealFftPlanner, RealToComplex};
use thiserror::Error;

use super::{Receiver, RxChannel};
use leakage::{Shape, fit_shape};

/// Frames without which nothing is fitted.
pub const LEAST_FRAMES: usize = 16;
/// Of a recording's noise so many periodograms a channel are kept, evenly spread.
const MOST_PERIODOGRAMS: usize = 20_000;
/// From the median of a normal distribution's deviations to its standard deviation.
const MAD: f64 = 1.4826;

/// A recording to which no receiver can be fitted.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum CalibrationError {
    /// Too little of it.
    #[error("calibration: {got} frames, at least {LEAST_FRAMES} are needed\n\nhint: record ten seconds or more")]
    TooShort {
        /// Frames.
        got: usize,
    },
    /// Frames that cannot be differenced.
    #[error("calibration: {chirps} chirps of {samples} samples a frame, at least 3 of 16 are needed")]
    Shape {
        /// Chirps a frame.
        chirps: usize,
        /// Samples a chirp.
        samples: usize,
    },
    /// A frame of another shape than the first.
    #[error("calibration: frame {sequence} has another shape than the waveform says")]
    Frame {
        /// Its number.
        sequence: u64,
    },
    /// No noise at all: codes that stand still are no receiver's.
    #[error("calibration: channel {rx} shows no noise\n\nhint: is it a recording of raw codes of a powered receiver?")]
    Silent {
        /// Index of the channel in the frame.
        rx: usize,
    },
}

/// What is kept of one channel.
struct Channel {
    /// `[kept][bin]`, LSB^2 a sample.
    periodograms: Vec<Vec<f32>>,
    /// Mean chirp of each frame, LSB.
    chirps: Vec<Vec<f32>>,
}

/// Takes frames in, fits a receiver to them.
pub struct Calibration {
    waveform: Waveform,
    channels: Vec<Channel>,
    fft: Arc<dyn RealToComplex<f64>>,
    seen: usize,
    stride: usize,
}

/// A fitted channel, and how well it was met.
#[derive(Debug, Clone, PartialEq)]
pub struct ChannelFit {
    /// Measured noise density for bins 0..=N/2, LSB^2 a sample.
    pub density_lsb2: Vec<f64>,
    /// Median of the frames' mean chirps, LSB.
    pub chirp_lsb: Vec<f64>,
    /// What the fit of that leaves, LSB rms.
    pub residual_lsb: f64,
}

/// A fitted receiver.
#[derive(Debug, Clone, PartialEq)]
pub struct Fit {
    /// The receiver: the base with what was measured in place of its own.
    pub receiver: Receiver,
    /// The channels as they were measured, in the order of the frame.
    pub channels: Vec<ChannelFit>,
    /// Frames it was fitted to.
    pub frames: usize,
}

impl Calibration {
    /// Nothing yet, for recordings of a waveform of about so many frames.
    pub fn new(waveform: &Waveform, frames: usize) -> Result<Self, CalibrationError> {
        let shape = waveform.shape();
        if shape.chirps < 3 || shape.samples < 16 {
            return Err(CalibrationError::Shape { chirps: shape.chirps, samples: shape.samples });
        }
        let channels = (0..shape.rx).map(|_| Channel { periodograms: Vec::new(), chirps: Vec::new() }).collect();
        Ok(Calibration {
            waveform: waveform.clone(),
            channels,
            fft: RealFftPlanner::new().plan_fft_forward(shape.samples),
            seen: 0,
            stride: (frames * (shape.chirps / 3)).div_ceil(MOST_PERIODOGRAMS).max(1),
        })
    }

    /// Takes in a frame.
    pub fn push(&mut self, frame: &Frame) -> Result<(), CalibrationError> {
        let shape = self.waveform.shape();
        if frame.shape != shape || frame.codes.len() != shape.codes() {
            return Err(CalibrationError::Frame { sequence: frame.sequence });
        }
        let n = shape.samples;
        let mut spectrum = self.fft.make_output_vec();
        for (channel, codes) in self.channels.iter_mut().zip(frame.codes.chunks(shape.chirps * n)) {
            let chirps: Vec<&[u16]> = codes.chunks(n).collect();
            let mut mean = vec![0f32; n];
            for (sample, mean) in mean.iter_mut().enumerate() {
                let sum: u64 = chirps.iter().map(|chirp| u64::from(chirp[sample])).sum();
                *mean = (sum as f64 / chirps.len() as f64) as f32;
            }
            channel.chirps.push(mean);
            for (triple, three) in chirps.chunks_exact(3).enumerate() {
                if !(self.seen * (shape.chirps / 3) + triple).is_multiple_of(self.stride) {
                    continue;
                }
                let [a, b, c] = [three[0], three[1], three[2]].map(|chirp| chirp.iter().map(|&code| f64::from(code)));
                // 1 + 4 + 1 times a sample's variance.
                let second = |((a, b), c): ((f64, f64), f64)| (a - 2.0 * b + c) / 6f64.sqrt();
                let mut difference: Vec<f64> = a.zip(b).zip(c).map(second).collect();
                if self.fft.process(&mut difference, &mut spectrum).is_ok() {
                    let power = spectrum.iter().map(|x| (x.norm_sqr() / n as f64) as f32);
                    channel.periodograms.push(power.collect());
                }
            }
        }
        self.seen += 1;
        Ok(())
    }

    /// The receiver that made these frames: `base` with what they show.
    pub fn fit(&self, base: &Receiver, name: &str, measured_from: &str) -> Result<Fit, CalibrationError> {
        if self.seen < LEAST_FRAMES {
            return Err(CalibrationError::TooShort { got: self.seen });
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
        for ((fit, shape), antenna) in channels.iter().zip(antennas) {
            if let Some(rx) = receiver.rx.get_mut(usize::from(antenna).saturating_sub(1)) {
                rx.dc_code = shape.constant_lsb.clamp(0.0, 4095.0);
                rx.noise_db = 0.0;
                rx.psd_lsb2 = Some(fit.density_lsb2.clone());
                rx.leakage.clone_from(&shape.leakage);
                rx.transient.clone_from(&shape.transient);
            }
        }
        let count = channels.len().max(1) as f64;
        let bins = self.waveform.request.samples_per_chirp / 2 + 1;
        let mean = |bin: usize| channels.iter().map(|(fit, _)| fit.density_lsb2[bin]).sum::<f64>() / count;
        receiver.noise.psd_lsb2 = Some((0..bins).map(mean).collect());
        self.fit_changes(&mut receiver);
        Ok(Fit { receiver, channels: channels.into_iter().map(|(fit, _)| fit).collect(), frames: self.seen })
    }

    fn measure(&self, channel: &Channel) -> (ChannelFit, Shape) {
        let n = self.waveform.request.samples_per_chirp;
        let density_lsb2 = (0..=n / 2)
            .map(|bin| {
                let powers = channel.periodograms.iter().map(|powers| f64::from(powers[bin])).collect();
                // Real at both ends: the median of a squared normal number.
                let median_of_one = if bin == 0 || 2 * bin == n { 0.454_936 } else { std::f64::consts::LN_2 };
                median(powers) / median_of_one
            })
            .collect();
        let sample = |i: usize| median(channel.chirps.iter().map(|chirp| f64::from(chirp[i])).collect());
        let chirp_lsb: Vec<f64> = (0..n).map(sample).collect();
        let shape = fit_shape(&chirp_lsb, &self.waveform);
        (ChannelFit { density_lsb2, residual_lsb: shape.residual_lsb, chirp_lsb }, shape)
    }

    /// Jitter and drift of offsets and of the leakage: the median of the channels'.
    fn fit_changes(&self, receiver: &mut Receiver) {
        let interval_s = self.waveform.frame_interval_s();
        let (n, chirps) = (self.waveform.request.samples_per_chirp, self.waveform.request.chirps_per_frame as f64);
        let ten_seconds = ((10.0 / interval_s).round() as usize).clamp(1, self.seen.saturating_sub(1) / 2);
        let per_10_s = 10.0 / (ten_seconds as f64 * interval_s);
        let (mut dc_jitter, mut dc_rate, mut jitter, mut drift) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        for channel in &self.channels {
            let offsets: Vec<f64> = channel
                .chirps
                .iter()
                .map(|chirp| chirp.iter().map(|&x| f64::from(x)).sum::<f64>() / n as f64)
                .collect();
            let density = |bin: usize| median(channel.periodograms.iter().map(|p| f64::from(p[bin])).collect());
            let noise_lsb2 = density(0) / 0.454_936 / (n as f64 * chirps);
            dc_jitter.push((step_variance(&offsets) - noise_lsb2).max(0.0).sqrt());
            let half = offsets.len() / 2;
            let slopes =
                offsets.iter().zip(offsets.iter().skip(half)).map(|(a, b)| (b - a) / (half as f64 * interval_s));
            dc_rate.push(median(slopes.collect()).abs());
            // One cycle a chirp: where the leakage is, and few echoes.
            let levels: Vec<Complex64> = channel
                .chirps
                .iter()
                .map(|chirp| {
                    let turn = |i: usize| Complex64::from_polar(1.0, -std::f64::consts::TAU * i as f64 / n as f64);
                    let hann = |i: usize| 0.5 - 0.5 * (std::f64::consts::TAU * i as f64 / n as f64).cos();
                    chirp.iter().enumerate().map(|(i, &x)| turn(i) * (hann(i) * f64::from(x))).sum()
                })
                .collect();
            let mean = levels.iter().sum::<Complex64>() / levels.len().max(1) as f64;
            let along: Vec<f64> = levels.iter().map(|z| (z * mean.conj()).re / mean.norm_sqr()).collect();
            let noise = density(1) / std::f64::consts::LN_2 * 0.375 * n as f64 / chirps / mean.norm_sqr() / 2.0;
            jitter.push((step_variance(&along) - noise).max(0.0).sqrt());
            let later = along.iter().zip(along.iter().skip(ten_seconds)).map(|(a, b)| (b - a).abs());
            drift.push(median(later.collect()) * MAD * per_10_s.sqrt());
        }
        receiver.drift.dc_jitter_lsb = median(dc_jitter);
        receiver.drift.dc_lsb_per_s = median(dc_rate);
        receiver.clutter.leakage_jitter = median(jitter).min(1.0);
        receiver.clutter.leakage_drift_per_10s = median(drift).min(1.0);
    }
}

/// Variance of what changes from one value to the next, half a step's, without regard to the few that jump.
fn step_variance(values: &[f64]) -> f64 {
    let steps = values.windows(2).map(|pair| (pair[1] - pair[0]).abs()).collect();
    (median(steps) * MAD).powi(2) / 2.0
}

/// The value in the middle; zero of nothing.
fn median(mut values: Vec<f64>) -> f64 {
    let middle = values.len() / 2;
    if values.is_empty() {
        return 0.0;
    }
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}
