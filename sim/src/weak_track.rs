//! Weak paths as echoes with held positions on the frequency grid ([`HeldEcho`]), which are synthesised much faster.
//!
//! The error of a held echo is a few per cent of its amplitude. That of a weak path is therefore far below the noise.

use std::f64::consts::PI;

use num_complex::{Complex, Complex64};

use crate::chirp::Chirp;
use crate::lanes::cos_sin_of_turns;
use crate::synthesis::{HeldEcho, HeldEchoes};
use crate::tracks::{RECEIVERS, Track};

/// Largest amplitude of a weak path, relative to the amplitude below which a path is invisible. With that limit 10 dB
/// below the noise, such a path is 10 dB above it, and 4 % of its amplitude are 18 dB below it.
const MOST: f64 = 30.0;
/// Largest deviation of a weak path's amplitude from a straight line over an interval, in the same unit.
const MOST_BEND: f64 = 0.3;

/// Adds a path, in one direction or both, to the held echoes of each of the frame's intervals that its segment covers, if
/// it is weak there. The segment is `place` of a frame that is halved `halvings` times. Returns whether the path was
/// added; a path in a part of an interval is not. Both directions are one echo, since they have nearly the same delay.
pub fn add(
    ways: &[Option<Track>; 2],
    [halvings, place]: [usize; 2],
    chirp: &Chirp,
    threshold_lsb: f64,
    intervals: &mut [HeldEchoes],
) -> bool {
    let count = intervals.len() >> halvings;
    let Some(intervals) = intervals.get_mut(place * count..(place + 1) * count).filter(|_| count > 0) else {
        return false;
    };
    let [Some(first), exchanged] = ways else { return false };
    // Largest values for each direction.
    let part = if exchanged.is_some() { 0.5 } else { 1.0 };
    let [most, most_bend] = [MOST, MOST_BEND].map(|limit| (part * limit * threshold_lsb) as f32);
    let place = |half: usize| half as f64 / (2 * count) as f64;
    let is_straight = |i: usize| {
        let [a, middle, b] = [0, 1, 2].map(|half| first.first.amplitude(place(2 * i + half)));
        let loudest = a.norm_sqr().max(middle.norm_sqr()).max(b.norm_sqr());
        loudest <= most * most && (middle - (a + b) * 0.5).norm_sqr() <= most_bend * most_bend
    };
    if !(0..count).all(is_straight) {
        return false;
    }
    let ends: Vec<End> = (0..=count).map(|i| End::new(first, exchanged.as_ref(), place(2 * i), chirp)).collect();
    // A phasor that turns between two ends deviates from a straight line by an eighth of the square of the angle.
    let turned_rad = |[a, b]: &[End; 2]| PI * (b.apart_cycles - a.apart_cycles);
    if ends.array_windows().any(|ends| turned_rad(ends).powi(2) > 8.0 * MOST_BEND / MOST) {
        return false;
    }
    for ([begin, end], interval) in ends.array_windows().zip(intervals) {
        let amplitudes = std::array::from_fn(|receiver| [begin.amplitudes[receiver], end.amplitudes[receiver]]);
        interval.push(&HeldEcho { delay: [begin.delay, end.delay], amplitudes });
    }
    true
}

/// Path at an end of an interval.
struct End {
    /// Mean delay of both directions to the first receiver, s, with two derivatives.
    delay: [f64; 3],
    /// Amplitude at each receiver, as a factor of the phase of that delay.
    amplitudes: [Complex64; RECEIVERS],
    /// Phase of the first direction relative to the other one, cycles.
    apart_cycles: f64,
}

impl End {
    fn new(first: &Track, exchanged: Option<&Track>, u: f64, chirp: &Chirp) -> Self {
        let own = first.first.bent_delay(u);
        let other = exchanged.map_or(own, |track| track.first.bent_delay(u));
        let delay: [f64; 3] = std::array::from_fn(|order| 0.5 * (own[order] + other[order]));
        let carrier_hz = chirp.start_hz + chirp.slope_hz_per_s * (chirp.middle_s - delay[0]);
        let mut amplitudes = [Complex64::ZERO; RECEIVERS];
        for (track, own) in [(Some(first), own), (exchanged, other)] {
            let Some(track) = track else { continue };
            let beside_s = own[0] - delay[0];
            let amplitude = track.first.amplitude(u);
            amplitudes[0] += turned(amplitude, beside_s * carrier_hz);
            for (sum, aside) in amplitudes.iter_mut().skip(1).zip(&track.others) {
                let later_s = beside_s + f64::from(aside.delay(u as f32));
                *sum += turned(amplitude * aside.ratio(u as f32), later_s * carrier_hz);
            }
        }
        End { delay, amplitudes, apart_cycles: (own[0] - other[0]) * carrier_hz }
    }
}

/// Returns an amplitude turned by a phase.
fn turned(amplitude: Complex<f32>, cycles: f64) -> Complex64 {
    let (cosine, sine) = cos_sin_of_turns(cycles as f32);
    let turned = amplitude * Complex::new(cosine, sine);
    Complex64::new(turned.re.into(), turned.im.into())
}
