//! Receiver output for a frame's grids: samples, leakage, noise, spurious tones, codes.

use radome_dsp::{Frame, KernelLevel};
use rand_distr::{Distribution, StandardNormal};
use rand_xoshiro::Xoshiro256PlusPlus;

use super::FrameSimulator;
use super::chirp_turn::ChirpTurn;
use super::clutter::Clutter;
use super::paths::Traced;
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
pub(super) struct NoisyPhase<'a> {
    pub(super) traced: Traced,
    pub(super) rates: &'a PhaseRates,
}

/// Inputs of a frame that all receivers share.
pub(super) struct OfFrame<'a> {
    pub(super) index: u64,
    /// Time of the first sample, s.
    pub(super) start_s: f64,
    pub(super) traced: &'a Traced,
    pub(super) phase: Option<&'a NoisyPhase<'a>>,
    pub(super) clutter: &'a Clutter,
    /// Errors of the chirps; empty where there are none.
    pub(super) turns: &'a [ChirpTurn],
}

/// Additions of one receiver to the echoes of a frame, in the order of its chirps.
struct Channel<'a> {
    noise: Xoshiro256PlusPlus,
    phase_noise: Xoshiro256PlusPlus,
    /// Spurious tones, and their phases.
    spurs: Option<(&'a Spurs, Xoshiro256PlusPlus)>,
    /// Offset, LSB, and factor on leakage.
    offset: (f32, f32),
    leakage: &'a [f32],
    shaper: Option<&'a (NoiseShaper, f32)>,
}

impl FrameSimulator {
    /// Computes the samples of all receivers of a frame. Returns the number of samples at an end of the ADC's range.
    pub(super) fn simulate_channels(&self, of_frame: &OfFrame, frame: &mut Frame) -> usize {
        let &OfFrame { index, start_s, traced, phase, clutter, turns } = of_frame;
        let shape = self.waveform().shape();
        let static_grids = self.static_grids(clutter, false);
        let by_delay = phase.map(|phase| self.by_delay(phase, clutter, turns)).unwrap_or_default();
        let mut channels: Vec<Channel> = (0..shape.rx).map(|rx| self.channel(rx, index, start_s)).collect();
        let (mut scratch, mut clipped, level) = (Scratch::default(), 0, KernelLevel::detect());
        self.each_chirp(traced, &static_grids, turns, |rx, chirp, grid| {
            let Some(channel) = channels.get_mut(rx) else { return };
            let (offset, leakage_scale) = channel.offset;
            scratch.chirp.clear();
            scratch.chirp.extend(channel.leakage.iter().map(|l| offset + l * leakage_scale));
            self.synthesiser.transform(grid, &mut scratch.chirp, &mut scratch.synthesis);
            let first = (rx * shape.chirps + chirp) * shape.samples;
            if let (Some(phase), Some(beside)) = (phase, by_delay.get(first..first + shape.samples)) {
                phase.rates.add(&mut channel.phase_noise, beside, &mut scratch.chirp);
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
        Channel {
            noise: generator(seed, Purpose::Noise, [index, people | rx as u64]),
            // Phase noise is the same in all receivers.
            phase_noise: generator(seed, Purpose::PhaseNoise, [index, 0]),
            spurs: self.spurs.get(rx).map(|spurs| (spurs, spurs.phases(index))),
            offset: self.offset(rx, index, start_s),
            leakage: self.leakage.get(rx).map(Vec::as_slice).unwrap_or_default(),
            shaper: self.noise.get(rx),
        }
    }

    /// Computes the factor on the phase's rate in every sample, LSB s: `[rx][chirp][sample]`.
    fn by_delay(&self, phase: &NoisyPhase, clutter: &Clutter, turns: &[ChirpTurn]) -> Vec<f32> {
        let shape = self.waveform().shape();
        let grids = self.static_grids(clutter, true);
        let leakage = |channel: &RxChannel| leakage_by_delay_lsb_s(channel, self.waveform());
        let leakage: Vec<Vec<f32>> = self.prepared.channels.iter().map(leakage).collect();
        let mut scratch = SynthesisScratch::default();
        let mut all = vec![0f32; shape.codes()];
        self.each_chirp(&phase.traced, &grids, turns, |rx, chirp, grid| {
            let first = (rx * shape.chirps + chirp) * shape.samples;
            if let (Some(samples), Some(leakage)) = (all.get_mut(first..first + shape.samples), leakage.get(rx)) {
                samples.iter_mut().zip(leakage).for_each(|(sample, leakage)| *sample = *leakage);
                self.synthesiser.transform(grid, samples, &mut scratch);
            }
        });
        all
    }

    /// Returns the offset (LSB) and the factor on leakage of a channel in a frame.
    fn offset(&self, rx: usize, index: u64, start_s: f64) -> (f32, f32) {
        let receiver = self.scene.receiver();
        let mut rng = generator(self.options.seed, Purpose::FrameJitter, [index, 1 + rx as u64]);
        let (a, b): (f64, f64) = (StandardNormal.sample(&mut rng), StandardNormal.sample(&mut rng));
        let phases = drift_phases(self.options.seed, [rx as u64, 1]);
        let dc = self.prepared.channels.get(rx).map_or(2048.0, |c| c.dc_code);
        // The offset moves back and forth between the limits.
        let limit = receiver.drift.dc_limit_lsb.max(1e-9);
        let walked = (receiver.drift.dc_lsb_per_s * start_s + limit).rem_euclid(4.0 * limit);
        let wander = if walked < 2.0 * limit { walked - limit } else { 3.0 * limit - walked };
        let offset = dc + wander + receiver.drift.dc_jitter_lsb * a;
        let leakage = 1.0
            + self.leakage_jitter * receiver.clutter.leakage_jitter * b
            + receiver.clutter.leakage_drift_per_10s * drift(start_s, &phases);
        (offset as f32, leakage as f32)
    }
}
