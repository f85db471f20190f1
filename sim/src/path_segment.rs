//! Interpolation from a few path samples to every chirp: polynomials in delay and complex amplitude over a segment of
//! time.
//!
//! Where the derivatives at both ends of a segment are known, as of a swaying reflector ([`PathSegment::between`]),
//! delay is a septic Hermite polynomial and amplitude a quintic. Otherwise ([`PathSegment::through`]) samples at the
//! ends, quarters and middle give a septic in delay, a quartic in amplitude, and an error estimate.

use num_complex::{Complex, Complex64};

use crate::math::{magnitude, quintic};

/// State of a path at one sample time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PathSample {
    /// Delay, s.
    pub delay_s: f64,
    /// Rate of the delay, s/s.
    pub delay_rate: f64,
    /// Amplitude at the ADC, LSB, as the factor of `exp(+j 2 pi ...)`.
    pub amplitude: Complex64,
}

/// Higher derivatives of a path at a sample time.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct PathDerivatives {
    /// Second and third derivative of the delay, 1/s and 1/s^2.
    pub delay: [f64; 2],
    /// First and second derivative of the amplitude, LSB/s and LSB/s^2.
    pub amplitude: [Complex64; 2],
}

/// Path within one segment between samples, as polynomials of `u` in 0..1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PathSegment {
    delay_s: [f64; 8],
    amplitude: [Complex<f32>; 6],
    interval_s: f64,
}

/// Power coefficients of the septic Hermite polynomial over 0..1, from values and three derivatives at the ends.
fn septic([y0, v0, w0, j0]: [f64; 4], [y1, v1, w1, j1]: [f64; 4]) -> [f64; 8] {
    // Residual at the second end of the cubic that fits the first end.
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

/// Samples of a path at the ends, quarters and middle of a segment, in order of time.
pub type FiveSamples = [PathSample; 5];

/// Squares of the distances of quarters and ends from the middle, in segment lengths.
const QUARTER: f64 = 1.0 / 16.0;
const END: f64 = 1.0 / 4.0;

/// Power coefficients of the polynomial `p(x + by)`, given those of `p(x)`.
fn shifted<const N: usize>(mut powers: [f64; N], by: f64) -> [f64; N] {
    for low in 0..N {
        for power in (low..N - 1).rev() {
            powers[power] += by * powers[power + 1];
        }
    }
    powers
}

/// Power coefficients of a cubic of `z`, from values and slopes at the squares of quarters and ends.
fn cubic_of_square([y0, v0]: [f64; 2], [y1, v1]: [f64; 2]) -> [f64; 4] {
    let apart = END - QUARTER;
    let slope = (y1 - y0) / apart;
    shifted([y0, v0, (3.0 * slope - 2.0 * v0 - v1) / apart, (v0 + v1 - 2.0 * slope) / (apart * apart)], -QUARTER)
}

/// Power coefficients of a line of `z`, from values at the squares of quarters and ends.
fn line_of_square(at_quarter: f64, at_end: f64) -> [f64; 2] {
    let slope = (at_end - at_quarter) / (END - QUARTER);
    [at_quarter - slope * QUARTER, slope]
}

/// Power coefficients of a septic of `u`, from values and slopes at both ends and quarters, and its value in the
/// middle. The even and odd parts about the middle are each a cubic of the squared distance from the middle.
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

/// Power coefficients of a cubic of `u` through values at both ends and quarters, and its value in the middle.
pub(crate) fn cubic_of_four([a, b, c, d]: [f64; 4]) -> ([f64; 4], f64) {
    let e = line_of_square(0.5 * (b + c), 0.5 * (a + d));
    let o = line_of_square(2.0 * (c - b), d - a);
    (shifted([e[0], o[0], e[1], o[1]], -0.5), e[0])
}

/// Power coefficients of a quartic of `u` through values at both ends, quarters and the middle. Also returns the middle
/// value of the cubic through the other four.
fn quartic_of_five([a, b, m, c, d]: [f64; 5]) -> ([f64; 5], f64) {
    let (cubic, predicted) = cubic_of_four([a, b, c, d]);
    // `rest` is (x^2 - 1/16) (x^2 - 1/4), which is 1/64 in the middle.
    let factor = (m - predicted) / (QUARTER * END);
    let rest = shifted([QUARTER * END, 0.0, -(QUARTER + END), 0.0, 1.0], -0.5);
    let at = |power: usize| cubic.get(power).copied().unwrap_or(0.0) + factor * rest[power];
    (std::array::from_fn(at), predicted)
}

/// Power coefficients of a quintic of `u`, from values and slopes at both ends and in the middle.
fn quintic_of_three([a, m, b]: [[f64; 2]; 3]) -> [f64; 8] {
    // The even and odd parts about the middle, at the ends: values, and slopes.
    let (even, bend) = (0.5 * (a[0] + b[0]) - m[0], 0.5 * (b[1] - a[1]));
    let (odd, slope) = (b[0] - a[0] - m[1], 0.5 * (a[1] + b[1]) - m[1]);
    let about_middle = [
        m[0],
        m[1],
        8.0 * even - bend,
        10.0 * odd - 2.0 * slope,
        4.0 * bend - 16.0 * even,
        8.0 * slope - 24.0 * odd,
        0.0,
        0.0,
    ];
    shifted(about_middle, -0.5)
}

/// A sixth of the fourth difference of the amplitude as estimated from third differences, LSB.
fn error_by_third_differences(samples: &FiveSamples) -> f64 {
    let a = samples.map(|sample| sample.amplitude);
    let third = |i: usize| magnitude(a[i + 3] - a[i] + 3.0 * (a[i + 1] - a[i + 2]));
    let loudest = a.iter().map(|&a| magnitude(a)).fold(0.0, f64::max);
    let relative = third(0).max(third(1)) / loudest.max(f64::MIN_POSITIVE);
    loudest * relative * relative.cbrt() / 6.0
}

impl PathSegment {
    /// Interpolates samples at the ends, quarters and middle of a segment, and estimates the error, LSB. The middle
    /// adds only its amplitude to the other four samples.
    ///
    /// The estimate is the distance between the middle sample and the prediction of the other four, as a field at
    /// `frequency_hz`. This misses a step about the middle, as diffraction makes, because symmetry predicts its middle.
    /// Third differences of the amplitude, which are large for a step, give a second estimate; the larger one counts.
    /// In smooth amplitudes, fourth differences relate to third ones about as these relate to the cube of the
    /// amplitude's change.
    pub fn through(samples: &FiveSamples, interval_s: f64, frequency_hz: f64) -> (Self, f64) {
        let delay = |i: usize| [samples[i].delay_s, samples[i].delay_rate * interval_s];
        let (delay_s, middle_s) = septic_of_four([0, 1, 3, 4].map(delay));
        let [(re, middle_re), (im, middle_im)] = [(|c| c.re) as fn(Complex64) -> f64, |c| c.im]
            .map(|of| quartic_of_five(samples.map(|sample| of(sample.amplitude))));
        let at = |of: [f64; 5], power: usize| of.get(power).copied().unwrap_or(0.0) as f32;
        let amplitude = std::array::from_fn(|power| Complex::new(at(re, power), at(im, power)));
        let rotation =
            Complex64::from_polar(1.0, std::f64::consts::TAU * frequency_hz * (middle_s - samples[2].delay_s));
        let error_lsb = magnitude(Complex64::new(middle_re, middle_im) * rotation - samples[2].amplitude);
        (PathSegment { delay_s, amplitude, interval_s }, error_lsb.max(error_by_third_differences(samples)))
    }

    /// Interpolates samples at the ends and in the middle of a segment: a quintic in delay, a parabola in amplitude.
    /// Also estimates the error, LSB.
    ///
    /// The estimate compares the middle with the prediction of the ends, a cubic in delay and a line in amplitude. The
    /// quintic's error is taken as a sixteenth of the cubic's. The parabola's error is of third order. For an amplitude
    /// that bends, it is the second difference to the power of 3/2. For one that rises like a step about the middle,
    /// where the second difference is zero, it is the cube of its change.
    pub fn through_three(samples: &[PathSample; 3], interval_s: f64, frequency_hz: f64) -> (Self, f64) {
        let delay = |i: usize| [samples[i].delay_s, samples[i].delay_rate * interval_s];
        let [a, m, b] = samples.map(|sample| sample.amplitude);
        let (bend, step) = (0.5 * (a + b) - m, b - a);
        let about_middle = [m, step, 4.0 * bend];
        let part = |of: fn(Complex64) -> f64| shifted(about_middle.map(of), -0.5);
        let (re, im) = (part(|c| c.re), part(|c| c.im));
        let at = |of: &[f64; 3], power: usize| of.get(power).copied().unwrap_or(0.0) as f32;
        let segment = PathSegment {
            delay_s: quintic_of_three([0, 1, 2].map(delay)),
            amplitude: std::array::from_fn(|power| Complex::new(at(&re, power), at(&im, power))),
            interval_s,
        };
        let loudest = [a, m, b].map(magnitude).into_iter().fold(0.0, f64::max);
        let per_loudest = 1.0 / loudest.max(f64::MIN_POSITIVE);
        let [[y0, v0], [middle_s, _], [y1, v1]] = [0, 1, 2].map(delay);
        let delay_error_s = 0.5 * (y0 + y1) + 0.125 * (v0 - v1) - middle_s;
        let by_phase = std::f64::consts::TAU * frequency_hz * delay_error_s.abs() / 16.0;
        let (second, first) = (magnitude(bend) * per_loudest, magnitude(step) * per_loudest);
        (segment, loudest * (second * second.sqrt() + first * first * first + by_phase))
    }

    /// Interpolates between two samples `interval_s` apart.
    pub fn between(a: &(PathSample, PathDerivatives), b: &(PathSample, PathDerivatives), interval_s: f64) -> Self {
        // Factors that convert time derivatives to derivatives by `u`.
        let (first, second, third) = (interval_s, interval_s * interval_s, interval_s * interval_s * interval_s);
        let delay = |(sample, derivatives): &(PathSample, PathDerivatives)| {
            [sample.delay_s, sample.delay_rate * first, derivatives.delay[0] * second, derivatives.delay[1] * third]
        };
        let part = |(sample, derivatives): &(PathSample, PathDerivatives), of: fn(Complex64) -> f64| {
            [of(sample.amplitude), of(derivatives.amplitude[0]) * first, of(derivatives.amplitude[1]) * second]
        };
        let [re, im] = [(|c| c.re) as fn(Complex64) -> f64, |c| c.im].map(|of| quintic(part(a, of), part(b, of)));
        PathSegment {
            delay_s: septic(delay(a), delay(b)),
            amplitude: std::array::from_fn(|p| Complex::new(re[p] as f32, im[p] as f32)),
            interval_s,
        }
    }

    /// Duration of the segment, s.
    #[inline(always)]
    pub fn interval_s(&self) -> f64 {
        self.interval_s
    }

    /// Delay, s, and its rate, s/s, at `u`.
    #[inline(always)]
    pub fn delay(&self, u: f64) -> (f64, f64) {
        let c = &self.delay_s;
        let (mut value, mut slope) = (c[7], 0.0);
        for p in (0..7).rev() {
            slope = slope * u + value;
            value = value * u + c[p];
        }
        (value, slope / self.interval_s)
    }

    /// Delay, s, with its first and second time derivative, at `u`.
    pub fn delay_with_derivatives(&self, u: f64) -> [f64; 3] {
        let (mut value, mut slope, mut half_curve) = (0.0, 0.0, 0.0);
        for c in self.delay_s.iter().rev() {
            half_curve = half_curve * u + slope;
            slope = slope * u + value;
            value = value * u + c;
        }
        let per_s = 1.0 / self.interval_s;
        [value, slope * per_s, 2.0 * half_curve * per_s * per_s]
    }

    /// Amplitude at `u`, LSB.
    #[inline(always)]
    pub fn amplitude(&self, u: f64) -> Complex<f32> {
        let u = u as f32;
        let [a, b, c, d, e, f] = self.amplitude;
        a + (b + (c + (d + (e + f * u) * u) * u) * u) * u
    }

    /// Returns the same path with its amplitude multiplied by `j` and its delay, LSB s; phase noise multiplies this
    /// product. The delay is approximated by a straight line between the ends, and the highest power of the product is
    /// omitted.
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

    /// Two samples reproduce any septic in delay, with its rate, and any quintic in amplitude.
    #[test]
    fn two_samples_hold_a_septic_and_a_quintic() {
        let delay_s = [1e-8, -2e-8, 3e-7, 4e-7, -5e-6, 6e-6, 3e-6, -2e-6];
        let parts = [[1.0, -2.0, 3.0, 0.5, -1.0, 2.0], [0.3, 1.0, -4.0, 2.0, 1.0, -3.0]];
        // Derivative of a polynomial.
        let at = |c: &[f64], order: usize, t: f64| {
            let falling = |p: usize| (0..order).map(|k| (p - k) as f64).product::<f64>();
            (order..c.len()).map(|p| c[p] * falling(p) * t.powi((p - order) as i32)).sum::<f64>()
        };
        let amplitude = |order: usize, t: f64| Complex64::new(at(&parts[0], order, t), at(&parts[1], order, t));
        let sample = |t: f64| {
            let sample =
                PathSample { delay_s: at(&delay_s, 0, t), delay_rate: at(&delay_s, 1, t), amplitude: amplitude(0, t) };
            let derivatives = PathDerivatives {
                delay: [at(&delay_s, 2, t), at(&delay_s, 3, t)],
                amplitude: [amplitude(1, t), amplitude(2, t)],
            };
            (sample, derivatives)
        };
        let segment = PathSegment::between(&sample(0.1), &sample(0.5), 0.4);
        for u in [0.0, 0.2, 0.5, 0.9, 1.0] {
            let (t, (value, slope)) = (0.1 + 0.4 * u, segment.delay(u));
            assert!((value - at(&delay_s, 0, t)).abs() < 1e-20 && (slope - at(&delay_s, 1, t)).abs() < 1e-19, "{t}");
            let a = segment.amplitude(u);
            assert!((Complex64::new(a.re.into(), a.im.into()) - amplitude(0, t)).norm() < 1e-5, "{t}");
        }
    }

    /// Five samples reproduce any septic in delay and any quartic in amplitude; the middle's correction to the cubic is
    /// the error.
    #[test]
    fn five_samples_hold_a_septic_and_a_quartic() {
        let delay_s = [1e-8, -2e-8, 3e-7, 4e-7, -5e-6, 6e-6, 3e-6, -2e-6];
        // The coefficients give no third derivative in the middle of the segment.
        let parts = [[1.0, -2.0, 3.0, 1.2, -1.0], [0.3, 1.0, -4.0, -1.2, 1.0]];
        let at = |c: &[f64], t: f64| c.iter().rev().fold(0.0, |sum, c| sum * t + c);
        let rate = |t: f64| (1..8).map(|p| p as f64 * delay_s[p] * t.powi(p as i32 - 1)).sum::<f64>();
        let amplitude = |t: f64| Complex64::new(at(&parts[0], t), at(&parts[1], t));
        let sample = |t: f64| PathSample { delay_s: at(&delay_s, t), delay_rate: rate(t), amplitude: amplitude(t) };
        let interval_s = 0.4;
        let samples = [0.0, 0.25, 0.5, 0.75, 1.0].map(|u| sample(0.1 + interval_s * u));
        let (segment, error_lsb) = PathSegment::through(&samples, interval_s, 60e9);
        for u in [0.0, 0.1, 0.3, 0.5, 0.9, 1.0] {
            let (t, (value, slope)) = (0.1 + interval_s * u, segment.delay(u));
            assert!((value - at(&delay_s, t)).abs() < 1e-19 && (slope - rate(t)).abs() < 1e-18, "{t}");
            let a = segment.amplitude(u);
            assert!((Complex64::new(a.re.into(), a.im.into()) - amplitude(t)).norm() < 1e-5, "{t}");
        }
        // A quartic's fourth difference over a quarter is 24 times its coefficient; the middle is off by a sixth of
        // that.
        let expected = 24.0 * Complex64::new(parts[0][4], parts[1][4]).norm() * (0.25 * interval_s).powi(4) / 6.0;
        assert!((error_lsb / expected - 1.0).abs() < 1e-3, "{error_lsb} {expected}");
    }

    /// Three samples reproduce any quintic in delay and any parabola in amplitude. The error of an amplitude that
    /// bends, and of one that rises about the middle like a step, is not underestimated.
    #[test]
    fn three_samples_hold_a_quintic_and_a_parabola() {
        let delay_s = [1e-8, -2e-8, 3e-7, 4e-7, -5e-6, 6e-6];
        let at = |t: f64| delay_s.iter().rev().fold(0.0, |sum, c| sum * t + c);
        let rate = |t: f64| (1..6).map(|p| p as f64 * delay_s[p] * t.powi(p as i32 - 1)).sum::<f64>();
        let interval_s = 0.4;
        let through = |amplitude: &dyn Fn(f64) -> Complex64| {
            let samples = [0.0, 0.5, 1.0].map(|u| {
                let t = 0.1 + interval_s * u;
                PathSample { delay_s: at(t), delay_rate: rate(t), amplitude: amplitude(u) }
            });
            PathSegment::through_three(&samples, interval_s, 60e6)
        };
        let parabola = |u: f64| Complex64::new(1.0 - 0.02 * u + 0.03 * u * u, 0.3 + 0.01 * u);
        let segment = through(&parabola).0;
        for u in [0.0, 0.1, 0.3, 0.5, 0.9, 1.0] {
            let (t, (value, slope)) = (0.1 + interval_s * u, segment.delay(u));
            assert!((value - at(t)).abs() < 1e-19 && (slope - rate(t)).abs() < 1e-18, "{t}");
            let a = segment.amplitude(u);
            assert!((Complex64::new(a.re.into(), a.im.into()) - parabola(u)).norm() < 1e-6, "{t}");
        }
        let fades = |u: f64| Complex64::from((-2.0 * u).exp());
        let steps = |u: f64| Complex64::from(1.0 + 0.2 * (std::f64::consts::PI * (u - 0.5)).sin());
        for amplitude in [&fades as &dyn Fn(f64) -> Complex64, &steps] {
            let (segment, error_lsb) = through(amplitude);
            let miss = |i: u32| {
                let u = f64::from(i) / 40.0;
                let a = segment.amplitude(u);
                (Complex64::new(a.re.into(), a.im.into()) - amplitude(u)).norm()
            };
            let worst = (0..=40).map(miss).fold(0.0, f64::max);
            assert!(worst > 0.01 && error_lsb > worst, "{error_lsb} {worst}");
        }
    }

    /// Third differences detect a step about the middle, although the cubic through the other four samples predicts the
    /// middle.
    #[test]
    fn a_step_is_not_taken_for_smooth() {
        let step = [1.0, 1.0, 0.5, 0.0, 0.0];
        let samples = step.map(|a| PathSample { delay_s: 1e-8, delay_rate: 0.0, amplitude: Complex64::from(a) });
        assert!(PathSegment::through(&samples, 0.01, 60e9).1 > 0.05);
        let smooth = [0.0f64, 0.1, 0.2, 0.3, 0.4].map(|t| t.cos());
        let samples = smooth.map(|a| PathSample { delay_s: 1e-8, delay_rate: 0.0, amplitude: Complex64::from(a) });
        assert!(PathSegment::through(&samples, 0.01, 60e9).1 < 1e-4);
    }
}
