//! Receiver output for a frame's grids: samples, leakage, noise, spurious tones, codes.

use radome_dsp::{Frame, KernelLevel};
use rand_distr::{Distribution, StandardNormal};
use rand_xoshiro::Xoshiro256PlusPlus;

use super::FrameSimulator;
use super::chirp_distortion::ChirpDistortion;
use super::clutter::Clutter;
use super::paths::FramePaths;
use crate::prepared_scene::{drift, drift_phases};
use crate::random::{Purpose, generator};
use crate::receiver::RxChannel;
use crate::receiver::adc::{leakage_by_delay_lsb_s, quantise_all};
use crate::receiver::noise::{NoiseScratch, NoiseShaper};
use crate::receiver::phase_noise::PhaseRates;
use crate::receiver::spurs::Spurs;
use crate::synthesis::SynthesisScratch;

/// Buffers of one frame.
#[derive(Default)]
struct Scratch {
    synthesis: SynthesisScratch,
    noise: NoiseScratch,
    chirp: Vec<f32>,
}

/// Inputs of phase noise in a frame: the paths of all people times their delays, and the rates of the phase.
pub(super) struct PhaseNoiseInputs<'a> {
    pub(super) paths: FramePaths,
    pub(super) rates: &'a PhaseRates,
}

/// Inputs of a frame that all receivers share.
pub(super) struct FrameInputs<'a> {
    pub(super) index: u64,
    /// Time of the first sample, s.
    pub(super) start_s: f64,
    pub(super) paths: &'a FramePaths,
    pub(super) phase: Option<&'a PhaseNoiseInputs<'a>>,
    pub(super) clutter: &'a Clutter,
    /// Errors of the chirps; empty where there are none.
    pub(super) distortions: &'a [ChirpDistortion],
}

/// Additions of one receiver to the echoes of a frame, in the order of its chirps.
struct Channel<'a> {
    noise: Xoshiro256PlusPlus,
    phase_noise: Xoshiro256PlusPlus,
    /// Spurious tones, and their phases.
    spurs: Option<(&'a Spurs, Xoshiro256PlusPlus)>,
    offset_lsb: f32,
    /// Leakage in a chirp, LSB, and a factor on it.
    leakage: &'a [f32],
    leakage_factor: f32,
    /// Noise, and a factor on it.
    shaper: Option<&'a (NoiseShaper, f32)>,
}

impl FrameSimulator {
    /// Computes the samples of all receivers of a frame. Returns the number of samples at an end of the ADC's range.
    pub(super) fn simulate_channels(&self, inputs: &FrameInputs, frame: &mut Frame) -> usize {
        let &FrameInputs { index, start_s, paths, phase, clutter, distortions } = inputs;
        let shape = self.waveform().shape();
        let static_grids = self.static_grids(clutter, false);
        let by_delay = phase.map(|phase| self.by_delay(phase, clutter, distortions)).unwrap_or_default();
        let mut channels: Vec<Channel> = (0..shape.rx).map(|rx| self.channel(rx, index, start_s)).collect();
        let (mut scratch, mut clipped, level) = (Scratch::default(), 0, KernelLevel::detect());
        self.each_chirp(paths, &static_grids, distortions, |rx, chirp, grid| {
            let Some(channel) = channels.get_mut(rx) else { return };
            let (offset, leakage_factor) = (channel.offset_lsb, channel.leakage_factor);
            scratch.chirp.clear();
            scratch.chirp.extend(channel.leakage.iter().map(|leakage| offset + leakage * leakage_factor));
            self.synthesiser.transform(grid, &mut scratch.chirp, &mut scratch.synthesis);
            let first = (rx * shape.chirps + chirp) * shape.samples;
            if let (Some(phase), Some(by_delay)) = (phase, by_delay.get(first..first + shape.samples)) {
                phase.rates.add(&mut channel.phase_noise, by_delay, &mut scratch.chirp);
            }
            if let Some((spurs, phases)) = &mut channel.spurs {
                let first_s = start_s + chirp as f64 * self.waveform().chirp_interval_s;
                spurs.add(first_s, phases, &mut scratch.chirp);
            }
            if let Some((shaper, scale)) = channel.shaper {
                shaper.add(&mut channel.noise, *scale, &mut scratch.chirp, &mut scratch.noise);
            }
            if let Some(codes) = frame.codes.get_mut(first..first + shape.samples) {
                quantise_all(level, &scratch.chirp, codes);
                clipped += codes.iter().filter(|code| **code == 0 || **code == radome_dsp::MAX_CODE).count();
            }
        });
        clipped
    }

    /// Prepares the additions of a receiver to the echoes of a frame.
    fn channel(&self, rx: usize, index: u64, start_s: f64) -> Channel<'_> {
        let seed = self.options.seed;
        // Runs of one seed with other numbers of people use other noise, so that their empty frames are not copies.
        let people = self.options.people.map_or(0, |people| people as u64 + 1) << 32;
        let (offset_lsb, leakage_factor) = self.offset_and_leakage(rx, index, start_s);
        Channel {
            noise: generator(seed, Purpose::Noise, [index, people | rx as u64]),
            // Phase noise is the same in all receivers.
            phase_noise: generator(seed, Purpose::PhaseNoise, [index, 0]),
            spurs: self.spurs.get(rx).map(|spurs| (spurs, spurs.phases(index))),
            offset_lsb,
            leakage: self.leakage.get(rx).map(Vec::as_slice).unwrap_or_default(),
            leakage_factor,
            shaper: self.noise.get(rx),
        }
    }

    /// Computes the factor on the phase's rate in every sample, LSB s: `[rx][chirp][sample]`.
    fn by_delay(&self, phase: &PhaseNoiseInputs, clutter: &Clutter, distortions: &[ChirpDistortion]) -> Vec<f32> {
        let shape = self.waveform().shape();
        let grids = self.static_grids(clutter, true);
        let leakage = |channel: &RxChannel| leakage_by_delay_lsb_s(channel, self.waveform());
        let leakage: Vec<Vec<f32>> = self.prepared.channels.iter().map(leakage).collect();
        let mut scratch = SynthesisScratch::default();
        let mut all = vec![0f32; shape.codes()];
        self.each_chirp(&phase.paths, &grids, distortions, |rx, chirp, grid| {
            let first = (rx * shape.chirps + chirp) * shape.samples;
            if let (Some(samples), Some(leakage)) = (all.get_mut(first..first + shape.samples), leakage.get(rx)) {
                samples.iter_mut().zip(leakage).for_each(|(sample, leakage)| *sample = *leakage);
                self.synthesiser.transform(grid, samples, &mut scratch);
            }
        });
        all
    }

    /// Returns the offset (LSB) and the factor on leakage of a channel in a frame.
    fn offset_and_leakage(&self, rx: usize, index: u64, start_s: f64) -> (f32, f32) {
        let receiver = self.scene.receiver();
        let mut rng = generator(self.options.seed, Purpose::FrameJitter, [index, 1 + rx as u64]);
        let (offset_draw, leakage_draw): (f64, f64) =
            (StandardNormal.sample(&mut rng), StandardNormal.sample(&mut rng));
        let phases = drift_phases(self.options.seed, [rx as u64, 1]);
        let dc = self.prepared.channels.get(rx).map_or(2048.0, |c| c.dc_code);
        // The offset moves back and forth between the limits.
        let limit = receiver.drift.dc_limit_lsb.max(1e-9);
        let cycle = (receiver.drift.dc_lsb_per_s * start_s + limit).rem_euclid(4.0 * limit);
        let drifted = if cycle < 2.0 * limit { cycle - limit } else { 3.0 * limit - cycle };
        let offset = dc + drifted + receiver.drift.dc_jitter_lsb * offset_draw;
        let leakage = 1.0
            + self.leakage_jitter * receiver.clutter.leakage_jitter * leakage_draw
            + receiver.clutter.leakage_drift_per_10s * drift(start_s, &phases);
        (offset as f32, leakage as f32)
    }
}
