//! Paths to all receivers: one segment for the first receiver, and the differences of the others from it.
//!
//! Receivers are some millimetres apart. Between them, a path's delay differs by some picoseconds and its amplitude by
//! gains and filters. Both differences change slowly, so polynomials of low degree represent them. The costly parts of
//! a path (its polynomials in f64, its position on the frequency grid) are computed for the first receiver only.

use num_complex::{Complex, Complex64};

use crate::path_segment::{FiveSamples, PathDerivatives, PathSample, PathSegment, cubic_of_four};

/// Largest number of receivers besides the first.
pub const OTHERS: usize = 2;
/// Largest number of receivers.
pub const RECEIVERS: usize = 1 + OTHERS;
/// Relative power of an amplitude below which no ratio to it is computed.
const MIN_POWER: f64 = 1e-6;

/// Difference between a path to another receiver and the path to the first one, within a segment.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct ReceiverOffset {
    /// Delay relative to the first receiver's, s, by powers of `u` in 0..1.
    pub(crate) delay_s: [f32; 4],
    /// Amplitude ratio to the first receiver at the beginning, and its change over the segment.
    pub(crate) ratio: [Complex<f32>; 2],
}

impl ReceiverOffset {
    /// Interpolates between samples of the first receiver and of another one at both ends of a segment: a cubic in
    /// delay, a line in the ratio of amplitudes.
    pub fn between(first: [&PathSample; 2], other: [&PathSample; 2], interval_s: f64) -> Self {
        let difference = |end: usize| {
            let rate = other[end].delay_rate - first[end].delay_rate;
            (other[end].delay_s - first[end].delay_s, rate * interval_s)
        };
        let ((begin_s, begin_rate), (end_s, end_rate)) = (difference(0), difference(1));
        let step_s = end_s - begin_s;
        let quadratic = 3.0 * step_s - 2.0 * begin_rate - end_rate;
        let cubic = begin_rate + end_rate - 2.0 * step_s;
        let delay_s = [begin_s, begin_rate, quadratic, cubic].map(|c| c as f32);
        ReceiverOffset {
            delay_s,
            ratio: ratio(first.map(|sample| sample.amplitude), other.map(|sample| sample.amplitude)),
        }
    }

    /// Interpolates samples of the first receiver and of another one at the ends, quarters and middle of a segment.
    pub fn through(first: &FiveSamples, other: &FiveSamples) -> Self {
        let difference = |i: usize| other[i].delay_s - first[i].delay_s;
        let (delay_s, _) = cubic_of_four([0, 1, 3, 4].map(difference));
        let ratio = ratio(first.map(|sample| sample.amplitude), other.map(|sample| sample.amplitude));
        ReceiverOffset { delay_s: delay_s.map(|c| c as f32), ratio }
    }

    /// Delay relative to the first receiver's, s.
    #[inline(always)]
    pub fn delay(&self, u: f32) -> f32 {
        let [a, b, c, d] = self.delay_s;
        a + u * (b + u * (c + u * d))
    }

    /// Amplitude ratio to the first receiver.
    #[inline(always)]
    pub fn ratio(&self, u: f32) -> Complex<f32> {
        let [begin, step] = self.ratio;
        begin + step * u
    }
}

/// Ratio of amplitudes at the beginning, and its change until the end. Where one of these amplitudes is too weak for a
/// ratio, the ratio at the loudest time is used.
fn ratio<const N: usize>(first: [Complex64; N], other: [Complex64; N]) -> [Complex<f32>; 2] {
    let loudest = (0..N).max_by(|&a, &b| first[a].norm_sqr().total_cmp(&first[b].norm_sqr())).unwrap_or(0);
    let most = first[loudest].norm_sqr();
    let at = |time: usize| {
        let time = if first[time].norm_sqr() > MIN_POWER * most { time } else { loudest };
        if most > 0.0 { other[time] / first[time] } else { Complex64::ONE }
    };
    let (begin, end) = (at(0), at(N - 1));
    [begin, end - begin].map(|c| Complex::new(c.re as f32, c.im as f32))
}

/// Path to all receivers within one segment between samples.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Track {
    /// Path to the first receiver.
    pub first: PathSegment,
    /// Differences of the other receivers, in their order.
    pub others: [ReceiverOffset; OTHERS],
}

impl Track {
    /// Interpolates between the samples of every receiver at both ends of a segment, `interval_s` apart; `None` without
    /// a receiver.
    pub fn between(
        begin: &[(PathSample, PathDerivatives)],
        end: &[(PathSample, PathDerivatives)],
        interval_s: f64,
    ) -> Option<Self> {
        let (first_begin, first_end) = (begin.first()?, end.first()?);
        let mut others = [ReceiverOffset::default(); OTHERS];
        for (offset, (a, b)) in others.iter_mut().zip(begin.iter().zip(end).skip(1)) {
            *offset = ReceiverOffset::between([&first_begin.0, &first_end.0], [&a.0, &b.0], interval_s);
        }
        Some(Track { first: PathSegment::between(first_begin, first_end, interval_s), others })
    }

    /// Interpolates the samples of every receiver at the ends, quarters and middle of a segment. Also returns the error
    /// estimate of the first receiver ([`PathSegment::through`]); `None` without a receiver.
    pub fn through(receivers: &[FiveSamples], interval_s: f64, frequency_hz: f64) -> Option<(Self, f64)> {
        let samples_of_first = receivers.first()?;
        let (first, error_lsb) = PathSegment::through(samples_of_first, interval_s, frequency_hz);
        let mut others = [ReceiverOffset::default(); OTHERS];
        for (offset, samples) in others.iter_mut().zip(receivers.iter().skip(1)) {
            *offset = ReceiverOffset::through(samples_of_first, samples);
        }
        Some((Track { first, others }, error_lsb))
    }

    /// Interpolates the samples of every receiver at the ends and in the middle of a segment. Also returns the error
    /// estimate of the first receiver ([`PathSegment::through_three`]); `None` without a receiver.
    pub fn through_three(receivers: [&[PathSample]; 3], interval_s: f64, frequency_hz: f64) -> Option<(Self, f64)> {
        let [begin, middle, end] = receivers;
        let first = [begin.first()?, middle.first()?, end.first()?];
        let (segment, error_lsb) = PathSegment::through_three(&first.map(|sample| *sample), interval_s, frequency_hz);
        let mut others = [ReceiverOffset::default(); OTHERS];
        for (offset, (a, b)) in others.iter_mut().zip(begin.iter().zip(end).skip(1)) {
            *offset = ReceiverOffset::between([first[0], first[2]], [a, b], interval_s);
        }
        Some((Track { first: segment, others }, error_lsb))
    }

    /// Returns the same path multiplied by its delays ([`PathSegment::by_delay`]).
    pub fn by_delay(&self) -> Self {
        let delays_s = [0.0, 1.0].map(|u| self.first.delay(u).0);
        let others = self.others.map(|offset| {
            // Factor by which the delay of another receiver is longer.
            let longer = |end: usize| 1.0 + offset.delay(end as f32) / (delays_s[end] as f32).max(f32::MIN_POSITIVE);
            let (begin, end) = (offset.ratio(0.0) * longer(0), offset.ratio(1.0) * longer(1));
            ReceiverOffset { ratio: [begin, end - begin], ..offset }
        });
        Track { first: self.first.by_delay(), others }
    }
}

/// Paths of a frame, grouped by the length of their segments: the whole frame, halves, quarters and so on.
#[derive(Debug, Clone, Default)]
pub struct Tracks {
    /// `[halvings][segment]`.
    levels: Vec<Vec<Vec<Track>>>,
}

impl Tracks {
    /// Adds a path in number `segment` of the segments of a frame that is halved `halvings` times.
    pub fn push(&mut self, halvings: u32, segment: usize, track: Track) {
        while self.levels.len() <= halvings as usize {
            self.levels.push(vec![Vec::new(); 1 << self.levels.len()]);
        }
        if let Some(tracks) = self.levels.get_mut(halvings as usize).and_then(|level| level.get_mut(segment)) {
            tracks.push(track);
        }
    }

    /// Returns the same paths multiplied by their delays ([`PathSegment::by_delay`]).
    pub fn by_delay(&self) -> Self {
        let of = |tracks: &Vec<Track>| tracks.iter().map(Track::by_delay).collect();
        Tracks { levels: self.levels.iter().map(|level| level.iter().map(of).collect()).collect() }
    }

    /// Number of halvings of the shortest segments.
    pub fn max_halvings(&self) -> u32 {
        self.levels.len().saturating_sub(1) as u32
    }

    /// Returns whether no path has segments of this many halvings.
    pub fn is_empty_at(&self, halvings: u32) -> bool {
        self.levels.get(halvings as usize).is_none_or(|level| level.iter().all(Vec::is_empty))
    }

    /// Paths in number `segment` of the segments of a frame that is halved `halvings` times.
    pub fn at(&self, halvings: u32, segment: usize) -> &[Track] {
        self.levels.get(halvings as usize).and_then(|level| level.get(segment)).map(Vec::as_slice).unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(delay_s: f64, delay_rate: f64, amplitude: Complex64) -> PathSample {
        PathSample { delay_s, delay_rate, amplitude }
    }

    /// An offset reproduces a cubic difference in delay, and the ratio at both ends.
    #[test]
    fn an_offset_is_the_difference_of_two_receivers() {
        let cubic = |t: f64| 1e-12 * (3.0 - 2.0 * t + 4.0 * t * t - t * t * t);
        let rate = |t: f64| 1e-12 * (-2.0 + 8.0 * t - 3.0 * t * t);
        let (first, ratio) = (|t: f64| sample(1e-8 + 1e-9 * t, 1e-9, Complex64::new(1.0, t)), Complex64::new(0.8, 0.1));
        let other = |t: f64| {
            let first = first(t);
            sample(first.delay_s + cubic(t), first.delay_rate + rate(t), first.amplitude * (ratio * (1.0 + 0.1 * t)))
        };
        let interval_s = 0.5;
        let offset =
            ReceiverOffset::between([&first(0.0), &first(interval_s)], [&other(0.0), &other(interval_s)], interval_s);
        for u in [0.0, 0.3, 1.0] {
            let found = f64::from(offset.delay(u as f32));
            assert!((found - cubic(interval_s * u)).abs() < 1e-17, "{u}: {found}");
            let factor = ratio * (1.0 + 0.1 * interval_s * u);
            let found = offset.ratio(u as f32);
            assert!((Complex64::new(found.re.into(), found.im.into()) - factor).norm() < 1e-5, "{u}: {found}");
        }
    }

    #[test]
    fn ratios_come_from_the_end_that_has_an_amplitude() {
        let (none, some) = (Complex64::ZERO, Complex64::new(2.0, 0.0));
        let half = Complex::new(0.5f32, 0.0);
        assert_eq!(ratio([none, some], [none, some * 0.5]), [half, Complex::default()]);
        assert_eq!(ratio([some, none], [some * 0.5, none]), [half, Complex::default()]);
        assert_eq!(ratio([none, none], [none, none]), [Complex::new(1.0, 0.0), Complex::default()]);
    }
}
