//! Weak paths as echoes with held positions on the frequency grid ([`HeldEcho`]), which are synthesised much faster.
//!
//! The error of a held echo is a few per cent of its amplitude. That of a weak path is therefore below the noise.

use std::f64::consts::PI;

use num_complex::{Complex, Complex64};

use crate::chirp::Chirp;
use crate::lanes::cos_sin_of_turns;
use crate::synthesis::{HeldEcho, HeldEchoes};
use crate::tracks::{RECEIVERS, Track};

/// Largest amplitude of a weak path, relative to the amplitude below which a path is invisible. If the latter is 10 dB
/// below the noise, such a path is 19.5 dB above the noise, and an error of 4 % of its amplitude is 8.5 dB below it.
const MAX_AMPLITUDE: f64 = 30.0;
/// Largest deviation of a weak path's amplitude from a straight line over an interval, in the same unit.
const MAX_BEND: f64 = 0.3;

/// Adds a path, in one direction or both, to the held echoes of each of the frame's intervals that its segment covers,
/// if it is weak there. Both directions are one echo, since they have nearly the same delay. The segment is number
/// `segment` of a frame that is halved `halvings` times. Returns whether the path was added; one whose segment is
/// shorter than an interval is not.
pub fn add(
    directions: &[Option<Track>; 2],
    [halvings, segment]: [usize; 2],
    chirp: &Chirp,
    threshold_lsb: f64,
    intervals: &mut [HeldEchoes],
) -> bool {
    let count = intervals.len() >> halvings;
    let Some(intervals) = intervals.get_mut(segment * count..(segment + 1) * count).filter(|_| count > 0) else {
        return false;
    };
    let [Some(first), reverse] = directions else { return false };
    // Limits for each direction.
    let share = if reverse.is_some() { 0.5 } else { 1.0 };
    let [max_amplitude, max_bend] = [MAX_AMPLITUDE, MAX_BEND].map(|limit| (share * limit * threshold_lsb) as f32);
    // Position in the segment of a multiple of half an interval.
    let position = |half: usize| half as f64 / (2 * count) as f64;
    let is_straight = |i: usize| {
        let [a, middle, b] = [0, 1, 2].map(|half| first.first.amplitude(position(2 * i + half)));
        let loudest = a.norm_sqr().max(middle.norm_sqr()).max(b.norm_sqr());
        loudest <= max_amplitude * max_amplitude && (middle - (a + b) * 0.5).norm_sqr() <= max_bend * max_bend
    };
    if !(0..count).all(is_straight) {
        return false;
    }
    let ends: Vec<IntervalEnd> =
        (0..=count).map(|i| IntervalEnd::new(first, reverse.as_ref(), position(2 * i), chirp)).collect();
    // Relative to the mean phase, each direction rotates by half of the change of their phase difference. A rotation
    // deviates from a straight line by an eighth of the square of its angle.
    let rotation_rad = |[a, b]: &[IntervalEnd; 2]| PI * (b.phase_difference_cycles - a.phase_difference_cycles);
    if ends.array_windows().any(|ends| rotation_rad(ends).powi(2) > 8.0 * MAX_BEND / MAX_AMPLITUDE) {
        return false;
    }
    for ([begin, end], interval) in ends.array_windows().zip(intervals) {
        let amplitudes = std::array::from_fn(|receiver| [begin.amplitudes[receiver], end.amplitudes[receiver]]);
        interval.push(&HeldEcho { delay: [begin.delay, end.delay], amplitudes });
    }
    true
}

/// Path at an end of an interval.
struct IntervalEnd {
    /// Mean delay of both directions to the first receiver, s, with two derivatives.
    delay: [f64; 3],
    /// Amplitude at each receiver, as a factor of the phase of that delay.
    amplitudes: [Complex64; RECEIVERS],
    /// Phase of the first direction relative to the other one, cycles.
    phase_difference_cycles: f64,
}

impl IntervalEnd {
    fn new(first: &Track, reverse: Option<&Track>, u: f64, chirp: &Chirp) -> Self {
        let own = first.first.delay_with_derivatives(u);
        let other = reverse.map_or(own, |track| track.first.delay_with_derivatives(u));
        let delay: [f64; 3] = std::array::from_fn(|order| 0.5 * (own[order] + other[order]));
        let carrier_hz = chirp.start_hz + chirp.slope_hz_per_s * (chirp.middle_s - delay[0]);
        let mut amplitudes = [Complex64::ZERO; RECEIVERS];
        for (track, own) in [(Some(first), own), (reverse, other)] {
            let Some(track) = track else { continue };
            let excess_s = own[0] - delay[0];
            let amplitude = track.first.amplitude(u);
            amplitudes[0] += rotated(amplitude, excess_s * carrier_hz);
            for (sum, offset) in amplitudes.iter_mut().skip(1).zip(&track.others) {
                let excess_s = excess_s + f64::from(offset.delay(u as f32));
                *sum += rotated(amplitude * offset.ratio(u as f32), excess_s * carrier_hz);
            }
        }
        IntervalEnd { delay, amplitudes, phase_difference_cycles: (own[0] - other[0]) * carrier_hz }
    }
}

/// Returns an amplitude rotated by a phase.
fn rotated(amplitude: Complex<f32>, cycles: f64) -> Complex64 {
    let (cosine, sine) = cos_sin_of_turns(cycles as f32);
    let rotated = amplitude * Complex::new(cosine, sine);
    Complex64::new(rotated.re.into(), rotated.im.into())
}

#[cfg(test)]
mod tests {
    use radome_dsp::SPEED_OF_LIGHT_M_PER_S;

    use super::*;
    use crate::path_segment::PathSample;
    use crate::synthesis::{CHIRPS, ChirpPositions, Grids, SynthesisScratch, Synthesiser};

    const CHIRP: Chirp = Chirp { start_hz: 59.6e9, slope_hz_per_s: 3.45e12, sample_rate_hz: 1e6, middle_s: 128e-6 };
    const SAMPLES: usize = 256;
    const FRAME_S: f64 = 0.032;
    const FRAME_CHIRPS: usize = 64;

    /// Path to three receivers, with its length at the frame's beginning, m, and its rate and acceleration, m/s and
    /// m/s^2.
    fn track([length_m, rate, bend]: [f64; 3], grown: f64) -> Track {
        let samples = [0.0, 0.5, 1.0].map(|u| {
            let t = FRAME_S * u;
            [0.0, 0.003, -0.002].map(|beside_m: f64| PathSample {
                delay_s: (length_m + beside_m + t * (rate + 0.5 * t * bend)) / SPEED_OF_LIGHT_M_PER_S,
                delay_rate: (rate + t * bend) / SPEED_OF_LIGHT_M_PER_S,
                amplitude: Complex64::new(0.6, -0.8) * (1.0 + 20.0 * beside_m + grown * u),
            })
        });
        Track::through_three(samples.each_ref().map(|at| at.as_slice()), FRAME_S, CHIRP.start_hz).expect("a receiver").0
    }

    /// Samples of a block of chirps of all receivers.
    fn samples(synthesiser: &Synthesiser, all: &[Grids]) -> Vec<f32> {
        let (mut grid, mut samples) = (synthesiser.grid(), Vec::new());
        for grids in all {
            for lane in 0..CHIRPS {
                let mut chirp = vec![0f32; SAMPLES];
                grids.extract(lane, &mut grid);
                synthesiser.transform(&grid, &mut chirp, &mut SynthesisScratch::default());
                samples.extend(chirp);
            }
        }
        samples
    }

    /// Weak paths as held echoes differ from the same paths as tracks by less than -26 dB, in one direction and in
    /// both, in either half of the frame.
    #[test]
    fn weak_paths_are_what_their_tracks_are() {
        let synthesiser = Synthesiser::new(SAMPLES);
        let one = [Some(track([7.1, 1.3, 8.0], 0.1)), None];
        let both = [Some(track([7.1, 1.3, 8.0], 0.1)), Some(track([7.106, 1.302, 8.0], 0.1))];
        for directions in [one, both] {
            let mut halves = vec![HeldEchoes::new(0.5 * FRAME_S); 2];
            assert!(add(&directions, [0, 0], &CHIRP, 1.0, &mut halves), "these paths are weak");
            assert_eq!(halves.iter().map(HeldEchoes::len).collect::<Vec<_>>(), [1, 1], "both directions are one echo");
            for begin in [8, 16, 40] {
                let at = |lane: usize| (begin + lane) as f64 / FRAME_CHIRPS as f64;
                let half = usize::from(begin >= FRAME_CHIRPS / 2);
                let [mut exact, mut fast] = [0, 1].map(|_| vec![synthesiser.grids(); RECEIVERS]);
                let tracks: Vec<Track> = directions.iter().flatten().copied().collect();
                synthesiser.spread_tracks(&CHIRP, &tracks, &ChirpPositions::new(0..CHIRPS, at), &mut exact);
                let in_half = ChirpPositions::new(0..CHIRPS, |lane| 2.0 * at(lane) - half as f64);
                synthesiser.spread_held(&CHIRP, &halves[half], &in_half, &mut fast);
                let (exact, fast) = (samples(&synthesiser, &exact), samples(&synthesiser, &fast));
                let power = |of: &mut dyn Iterator<Item = f32>| of.map(|x| f64::from(x * x)).sum::<f64>();
                let error = power(&mut exact.iter().zip(&fast).map(|(exact, fast)| exact - fast));
                let error_db = 10.0 * (error / power(&mut exact.iter().copied())).log10();
                assert!(error_db < -26.0, "{directions:?}, chirp {begin}: {error_db} dB");
            }
        }
    }

    /// Strong paths, those whose amplitude bends, and segments shorter than an interval stay tracks.
    #[test]
    fn other_paths_stay_tracks() {
        let mut halves = vec![HeldEchoes::new(0.5 * FRAME_S); 2];
        let directions = [Some(track([7.1, 1.3, 8.0], 0.0)), None];
        assert!(!add(&directions, [0, 0], &CHIRP, 0.9 / MAX_AMPLITUDE, &mut halves), "it is strong");
        assert!(!add(&directions, [2, 1], &CHIRP, 1.0, &mut halves), "it lasts for a quarter of the frame");
        assert!(!add(&directions, [0, 0], &CHIRP, 1.0, &mut []), "there is no list");
        let turning = [directions[0], Some(track([7.1, 1.8, 8.0], 0.0))];
        assert!(!add(&turning, [0, 0], &CHIRP, 1.0, &mut halves), "the directions turn against each other");
        assert!(halves.iter().all(HeldEchoes::is_empty));
        assert!(add(&directions, [1, 1], &CHIRP, 1.0, &mut halves) && halves[0].is_empty() && halves[1].len() == 1);
    }
}
