//! Weak paths as echoes with held positions on the frequency grid ([`HeldEcho`]), which are synthesised much faster.
//!
//! The error of a held echo is a few per cent of its amplitude. That of a weak path is therefore far below the noise.

use num_complex::Complex64;

use crate::chirp::Chirp;
use crate::lanes::cos_sin_of_turns;
use crate::synthesis::{HeldEcho, HeldEchoes};
use crate::tracks::{RECEIVERS, Track};

/// Largest amplitude of a weak path, relative to the amplitude below which a path is invisible. With that limit 10 dB
/// below the noise, such a path is 10 dB above it, and 4 % of its amplitude are 18 dB below it.
const MOST: f64 = 10.0;
/// Largest deviation of a weak path's amplitude from a straight line over an interval, in the same unit.
const MOST_BEND: f64 = 0.3;

/// Adds a path to the held echoes of each of the frame's intervals that its segment covers, if it is weak there. The
/// segment is `place` of a frame that is halved `halvings` times. Returns whether the path was added; a path in a part
/// of an interval is not.
pub fn add(
    track: &Track,
    [halvings, place]: [usize; 2],
    chirp: &Chirp,
    threshold_lsb: f64,
    intervals: &mut [HeldEchoes],
) -> bool {
    let count = intervals.len() >> halvings;
    let Some(intervals) = intervals.get_mut(place * count..(place + 1) * count).filter(|_| count > 0) else {
        return false;
    };
    let place = |half: usize| half as f64 / (2 * count) as f64;
    let is_weak = (0..count).all(|i| {
        let [a, middle, b] = [0, 1, 2].map(|half| track.first.amplitude(place(2 * i + half)));
        let loudest = a.norm_sqr().max(middle.norm_sqr()).max(b.norm_sqr()).sqrt();
        let bend = (middle - (a + b) * 0.5).norm();
        f64::from(loudest) <= MOST * threshold_lsb && f64::from(bend) <= MOST_BEND * threshold_lsb
    });
    if is_weak {
        let mut begin = end_at(track, place(0), chirp);
        for (i, interval) in intervals.iter_mut().enumerate() {
            let end = end_at(track, place(2 * i + 2), chirp);
            let amplitudes = std::array::from_fn(|receiver| [begin.1[receiver], end.1[receiver]]);
            interval.push(&HeldEcho { delay: [begin.0, end.0], amplitudes });
            begin = end;
        }
    }
    is_weak
}

/// Returns the delay of a path at `u`, s, with two derivatives, and its amplitude at each receiver as a factor of the
/// first receiver's phase.
fn end_at(track: &Track, u: f64, chirp: &Chirp) -> ([f64; 3], [Complex64; RECEIVERS]) {
    let delay = track.first.bent_delay(u);
    let carrier_hz = chirp.start_hz + chirp.slope_hz_per_s * (chirp.middle_s - delay[0]);
    let wide = |re: f32, im: f32| Complex64::new(re.into(), im.into());
    let first = track.first.amplitude(u);
    let first = wide(first.re, first.im);
    let mut amplitudes = [first; RECEIVERS];
    for (amplitude, aside) in amplitudes.iter_mut().skip(1).zip(&track.others) {
        let (cosine, sine) = cos_sin_of_turns(aside.delay(u as f32) * carrier_hz as f32);
        let ratio = aside.ratio(u as f32);
        *amplitude = first * wide(ratio.re, ratio.im) * wide(cosine, sine);
    }
    (delay, amplitudes)
}
