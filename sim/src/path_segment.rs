//! From a few key times to every chirp: polynomials in delay and complex amplitude over a stretch of time.
//!
//! Where it is known how a path bends at both ends of a stretch ([`PathSegment::between`]), it is a septic Hermite in delay and a
//! quintic in amplitude: on a walker two such keys do what seven or more of a cubic would (`tests/slow_time.rs`). Where it is not
//! ([`PathSegment::through`]), keys at the ends, quarters and middle of the stretch give a septic in delay, a quartic in amplitude,
//! and an estimate of what is missed between them.

use num_complex::{Complex, Complex64};

use crate::math::quintic;

/// A path at one key time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PathSample {
    /// Delay, s.
    pub delay_s: f64,
    /// Rate of the delay, s/s.
    pub delay_rate: f64,
    /// Amplitude at the ADC, LSB, as it multiplies `exp(+j 2 pi ...)`.
    pub amplitude: Complex64,
}

/// Curvature of a path at a key time.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct PathDerivatives {
    /// Second and third derivative of the delay, 1/s and 1/s^2.
    pub delay: [f64; 2],
    /// First and second derivative of the amplitude, LSB/s and LSB/s^2.
    pub amplitude: [Complex64; 2],
}

impl PathDerivatives {
    /// By differences to the same path `apart_s` before and after the key.
    pub fn between(before: &PathSample, now: &PathSample, after: &PathSample, apart_s: f64) -> Self {
        let square = apart_s * apart_s;
        PathDerivatives {
            delay: [
                (after.delay_rate - before.delay_rate) / (2.0 * apart_s),
                (after.delay_rate - 2.0 * now.delay_rate + before.delay_rate) / square,
            ],
            amplitude: [
                (after.amplitude - before.amplitude) / (2.0 * apart_s),
                (after.amplitude - 2.0 * now.amplitude + before.amplitude) / square,
            ],
        }
    }
}

/// A path within one stretch between keys, as polynomials of `u` in 0..1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PathSegment {
    delay_s: [f64; 8],
    amplitude: [Complex<f32>; 6],
    stretch_s: f64,
}

/// Septic Hermite over 0..1 by powers, from values and three derivatives at the ends.
fn septic([y0, v0, w0, j0]: [f64; 4], [y1, v1, w1, j1]: [f64; 4]) -> [f64; 8] {
    // What the cubic of the first end misses at the second.
    let y = y1 - y0 - v0 - 0.5 * w0 - j0 / 6.0;
    let (v, w, j) = (v1 - v0 - w0 - 0.5 * j0, w1 - w0 - j0, j1 - j0);
    [
        y0,
        v0,
        0.5 * w0,
        j0 / 6.0,
        35.0 * y - 15.0 * v + 2.5 * w - j / 6.0,
        -84.0 * y + 39.0 * v - 7.0 * w + 0.5 * j,
        70.0 * y - 34.0 * v + 6.5 * w - 0.5 * j,
        -20.0 * y + 10.0 * v - 2.0 * w + j / 6.0,
    ]
}

/// Keys of a path at the ends, quarters and middle of a stretch, in their order.
pub type FiveSamples = [PathSample; 5];

/// Squares of the distances of quarters and ends from the middle, in stretches.
const QUARTER: f64 = 1.0 / 16.0;
const END: f64 = 1.0 / 4.0;

/// Powers of a polynomial of `x + by`, given those of `x`.
fn shifted<const N: usize>(mut powers: [f64; N], by: f64) -> [f64; N] {
    for low in 0..N {
        for power in (low..N - 1).rev() {
            powers[power] += by * powers[power + 1];
        }
    }
    powers
}

/// Cubic by powers of `z` from values and slopes at the squares of quarters and ends.
fn cubic_of_square([y0, v0]: [f64; 2], [y1, v1]: [f64; 2]) -> [f64; 4] {
    let apart = END - QUARTER;
    let slope = (y1 - y0) / apart;
    shifted([y0, v0, (3.0 * slope - 2.0 * v0 - v1) / apart, (v0 + v1 - 2.0 * slope) / (apart * apart)], -QUARTER)
}

/// Line by powers of `z` from values at the squares of quarters and ends.
fn line_of_square(at_quarter: f64, at_end: f64) -> [f64; 2] {
    let slope = (at_end - at_quarter) / (END - QUARTER);
    [at_quarter - slope * QUARTER, slope]
}

/// Septic by powers of `u` from values and slopes by `u` at both ends and quarters: even and odd parts about the middle are each a
/// cubic of the square of the distance from there. Also its value in the middle.
fn septic_of_four([a, b, c, d]: [[f64; 2]; 4]) -> ([f64; 8], f64) {
    let even = |low: [f64; 2], high: [f64; 2], x: f64| [0.5 * (low[0] + high[0]), (high[1] - low[1]) / (4.0 * x)];
    let odd = |low: [f64; 2], high: [f64; 2], x: f64| {
        let value = (high[0] - low[0]) / (2.0 * x);
        [value, (0.5 * (low[1] + high[1]) - value) / (2.0 * x * x)]
    };
    let e = cubic_of_square(even(b, c, 0.25), even(a, d, 0.5));
    let o = cubic_of_square(odd(b, c, 0.25), odd(a, d, 0.5));
    (shifted([e[0], o[0], e[1], o[1], e[2], o[2], e[3], o[3]], -0.5), e[0])
}

/// Cubic by powers of `u` through values at both ends and quarters. Also its value in the middle.
pub(crate) fn cubic_of_four([a, b, c, d]: [f64; 4]) -> ([f64; 4], f64) {
    let e = line_of_square(0.5 * (b + c), 0.5 * (a + d));
    let o = line_of_square(2.0 * (c - b), d - a);
    (shifted([e[0], o[0], e[1], o[1]], -0.5), e[0])
}

/// Quartic by powers of `u` through values at both ends, quarters and the middle. Also the value in the middle of the cubic
/// through the others.
fn quartic_of_five([a, b, m, c, d]: [f64; 5]) -> ([f64; 5], f64) {
    let (cubic, predicted) = cubic_of_four([a, b, c, d]);
    // (x^2 - 1/16) (x^2 - 1/4), which is 1/64 in the middle.
    let factor = (m - predicted) / (QUARTER * END);
    let rest = shifted([QUARTER * END, 0.0, -(QUARTER + END), 0.0, 1.0], -0.5);
    let at = |power: usize| cubic.get(power).copied().unwrap_or(0.0) + factor * rest[power];
    (std::array::from_fn(at), predicted)
}

/// A sixth of the fourth difference of the amplitude as third differences let expect it, LSB.
fn missed_by_third_differences(keys: &FiveSamples) -> f64 {
    let a = keys.map(|key| key.amplitude);
    let third = |i: usize| (a[i + 3] - a[i] + 3.0 * (a[i + 1] - a[i + 2])).norm();
    let loudest = a.iter().map(|a| a.norm()).fold(0.0, f64::max);
    let relative = third(0).max(third(1)) / loudest.max(f64::MIN_POSITIVE);
    loudest * relative * relative.cbrt() / 6.0
}

impl PathSegment {
    /// Through keys at the ends, quarters and middle of a stretch, and an estimate of what is missed, LSB. The middle adds its amplitude
    /// to what the other four give.
    ///
    /// The estimate is how far from the key in the middle the other four alone would be, as a field at `frequency_hz`. A step about
    /// the middle, as shadows make, is met there by symmetry: third differences of the amplitude, which then are large, give a second
    /// estimate, and the larger one counts. In smooth amplitudes fourth differences are to third ones about as these are to the
    /// cube of the amplitude's change.
    pub fn through(keys: &FiveSamples, stretch_s: f64, frequency_hz: f64) -> (Self, f64) {
        let delay = |i: usize| [keys[i].delay_s, keys[i].delay_rate * stretch_s];
        let (delay_s, middle_s) = septic_of_four([0, 1, 3, 4].map(delay));
        let [(re, middle_re), (im, middle_im)] =
            [(|c| c.re) as fn(Complex64) -> f64, |c| c.im].map(|of| quartic_of_five(keys.map(|key| of(key.amplitude))));
        let at = |of: [f64; 5], power: usize| of.get(power).copied().unwrap_or(0.0) as f32;
        let amplitude = std::array::from_fn(|power| Complex::new(at(re, power), at(im, power)));
        let turn = Complex64::from_polar(1.0, std::f64::consts::TAU * frequency_hz * (middle_s - keys[2].delay_s));
        let missed_lsb = (Complex64::new(middle_re, middle_im) * turn - keys[2].amplitude).norm();
        (PathSegment { delay_s, amplitude, stretch_s }, missed_lsb.max(missed_by_third_differences(keys)))
    }

    /// Between two keys `stretch_s` apart.
    pub fn between(a: &(PathSample, PathDerivatives), b: &(PathSample, PathDerivatives), stretch_s: f64) -> Self {
        let (first, second, third) = (stretch_s, stretch_s * stretch_s, stretch_s * stretch_s * stretch_s);
        let delay = |(key, bend): &(PathSample, PathDerivatives)| {
            [key.delay_s, key.delay_rate * first, bend.delay[0] * second, bend.delay[1] * third]
        };
        let part = |(key, bend): &(PathSample, PathDerivatives), of: fn(Complex64) -> f64| {
            [of(key.amplitude), of(bend.amplitude[0]) * first, of(bend.amplitude[1]) * second]
        };
        let [re, im] = [(|c| c.re) as fn(Complex64) -> f64, |c| c.im].map(|of| quintic(part(a, of), part(b, of)));
        PathSegment {
            delay_s: septic(delay(a), delay(b)),
            amplitude: std::array::from_fn(|p| Complex::new(re[p] as f32, im[p] as f32)),
            stretch_s,
        }
    }

    /// Time between its ends, s.
    #[inline(always)]
    pub fn stretch_s(&self) -> f64 {
        self.stretch_s
    }

    /// Delay, s, and its rate, s/s.
    #[inline(always)]
    pub fn delay(&self, u: f64) -> (f64, f64) {
        let c = &self.delay_s;
        let (mut value, mut slope) = (c[7], 0.0);
        for p in (0..7).rev() {
            slope = slope * u + value;
            value = value * u + c[p];
        }
        (value, slope / self.stretch_s)
    }

    /// Amplitude, LSB.
    #[inline(always)]
    pub fn amplitude(&self, u: f64) -> Complex<f32> {
        let u = u as f32;
        let [a, b, c, d, e, f] = self.amplitude;
        a + (b + (c + (d + (e + f * u) * u) * u) * u) * u
    }

    /// The same path with its amplitude times `j` and its delay, LSB s: what phase noise multiplies. The delay is taken as a
    /// straight line between the ends, and the highest power of the product left out.
    pub fn by_delay(&self) -> Self {
        let (begin, end) = (self.delay(0.0).0, self.delay(1.0).0);
        let [first, step] = [begin, end - begin].map(|delay_s| Complex::new(0.0, delay_s as f32));
        let below = |power: usize| power.checked_sub(1).map(|p| self.amplitude[p] * step).unwrap_or_default();
        PathSegment { amplitude: std::array::from_fn(|p| self.amplitude[p] * first + below(p)), ..*self }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Any septic is met between its ends, value and rate, and any quintic of amplitude.
    #[test]
    fn two_keys_hold_a_septic_and_a_quintic() {
        let delay_s = [1e-8, -2e-8, 3e-7, 4e-7, -5e-6, 6e-6, 3e-6, -2e-6];
        let parts = [[1.0, -2.0, 3.0, 0.5, -1.0, 2.0], [0.3, 1.0, -4.0, 2.0, 1.0, -3.0]];
        // A derivative of a polynomial.
        let at = |c: &[f64], order: usize, t: f64| {
            let falling = |p: usize| (0..order).map(|k| (p - k) as f64).product::<f64>();
            (order..c.len()).map(|p| c[p] * falling(p) * t.powi((p - order) as i32)).sum::<f64>()
        };
        let amplitude = |order: usize, t: f64| Complex64::new(at(&parts[0], order, t), at(&parts[1], order, t));
        let key = |t: f64| {
            let key =
                PathSample { delay_s: at(&delay_s, 0, t), delay_rate: at(&delay_s, 1, t), amplitude: amplitude(0, t) };
            let bend = PathDerivatives {
                delay: [at(&delay_s, 2, t), at(&delay_s, 3, t)],
                amplitude: [amplitude(1, t), amplitude(2, t)],
            };
            (key, bend)
        };
        let stretch = PathSegment::between(&key(0.1), &key(0.5), 0.4);
        for u in [0.0, 0.2, 0.5, 0.9, 1.0] {
            let (t, (value, slope)) = (0.1 + 0.4 * u, stretch.delay(u));
            assert!((value - at(&delay_s, 0, t)).abs() < 1e-20 && (slope - at(&delay_s, 1, t)).abs() < 1e-19, "{t}");
            let a = stretch.amplitude(u);
            assert!((Complex64::new(a.re.into(), a.im.into()) - amplitude(0, t)).norm() < 1e-5, "{t}");
        }
    }

    /// Any septic is met through five keys, and any quartic of amplitude; what the middle adds to a cubic is what is missed.
    #[test]
    fn five_keys_hold_a_septic_and_a_quartic() {
        let delay_s = [1e-8, -2e-8, 3e-7, 4e-7, -5e-6, 6e-6, 3e-6, -2e-6];
        // Of no third derivative in the middle of the stretch.
        let parts = [[1.0, -2.0, 3.0, 1.2, -1.0], [0.3, 1.0, -4.0, -1.2, 1.0]];
        let at = |c: &[f64], t: f64| c.iter().rev().fold(0.0, |sum, c| sum * t + c);
        let rate = |t: f64| (1..8).map(|p| p as f64 * delay_s[p] * t.powi(p as i32 - 1)).sum::<f64>();
        let amplitude = |t: f64| Complex64::new(at(&parts[0], t), at(&parts[1], t));
        let key = |t: f64| PathSample { delay_s: at(&delay_s, t), delay_rate: rate(t), amplitude: amplitude(t) };
        let stretch_s = 0.4;
        let keys = [0.0, 0.25, 0.5, 0.75, 1.0].map(|u| key(0.1 + stretch_s * u));
        let (stretch, missed_lsb) = PathSegment::through(&keys, stretch_s, 60e9);
        for u in [0.0, 0.1, 0.3, 0.5, 0.9, 1.0] {
            let (t, (value, slope)) = (0.1 + stretch_s * u, stretch.delay(u));
            assert!((value - at(&delay_s, t)).abs() < 1e-19 && (slope - rate(t)).abs() < 1e-18, "{t}");
            let a = stretch.amplitude(u);
            assert!((Complex64::new(a.re.into(), a.im.into()) - amplitude(t)).norm() < 1e-5, "{t}");
        }
        // A quartic's fourth difference over a quarter is 24 times its coefficient; the middle is a sixth of that off.
        let expected = 24.0 * Complex64::new(parts[0][4], parts[1][4]).norm() * (0.25 * stretch_s).powi(4) / 6.0;
        assert!((missed_lsb / expected - 1.0).abs() < 1e-3, "{missed_lsb} {expected}");
    }

    /// A step about the middle, on which a cubic through the other four keys lies, is told by third differences.
    #[test]
    fn a_step_is_not_taken_for_smooth() {
        let step = [1.0, 1.0, 0.5, 0.0, 0.0];
        let keys = step.map(|a| PathSample { delay_s: 1e-8, delay_rate: 0.0, amplitude: Complex64::from(a) });
        assert!(PathSegment::through(&keys, 0.01, 60e9).1 > 0.05);
        let smooth = [0.0f64, 0.1, 0.2, 0.3, 0.4].map(|t| t.cos());
        let keys = smooth.map(|a| PathSample { delay_s: 1e-8, delay_rate: 0.0, amplitude: Complex64::from(a) });
        assert!(PathSegment::through(&keys, 0.01, 60e9).1 < 1e-4);
    }

    /// Differences find the bends of a cubic exactly.
    #[test]
    fn differences_are_derivatives() {
        let key = |t: f64| PathSample {
            delay_s: t * t * t,
            delay_rate: 3.0 * t * t,
            amplitude: Complex64::new(t * t, 1.0 - 2.0 * t),
        };
        let bend = PathDerivatives::between(&key(0.9), &key(1.0), &key(1.1), 0.1);
        assert!((bend.delay[0] - 6.0).abs() < 1e-12 && (bend.delay[1] - 6.0).abs() < 1e-11, "{bend:?}");
        assert!((bend.amplitude[0] - Complex64::new(2.0, -2.0)).norm() < 1e-12);
        assert!((bend.amplitude[1] - Complex64::new(2.0, 0.0)).norm() < 1e-11);
    }
}
