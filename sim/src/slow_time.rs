//! From a few key times to every chirp: cubic Hermite in delay (values and rates) and in complex amplitude.

use num_complex::{Complex, Complex64};

/// A path at one key time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Key {
    /// Delay, s.
    pub delay_s: f64,
    /// Rate of the delay, s/s.
    pub delay_rate: f64,
    /// Amplitude at the ADC, LSB, as it multiplies `exp(+j 2 pi ...)`.
    pub amplitude: Complex64,
}

/// A path within one stretch between keys, as cubics of `u` in 0..1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stretch {
    delay_s: [f64; 4],
    amplitude: [Complex<f32>; 4],
    stretch_s: f64,
}

fn cubic(y0: f64, m0: f64, y1: f64, m1: f64) -> [f64; 4] {
    [y0, m0, 3.0 * (y1 - y0) - 2.0 * m0 - m1, 2.0 * (y0 - y1) + m0 + m1]
}

/// Cubics for every stretch between keys `stretch_s` apart. Amplitude slopes are differences of neighbouring keys.
pub fn stretches(keys: &[Key], stretch_s: f64, out: &mut Vec<Stretch>) {
    let n = keys.len();
    let slope = |i: usize| -> Complex64 {
        let at = |i: usize| keys.get(i).map_or(Complex64::ZERO, |k| k.amplitude);
        match (i, n) {
            (_, 0 | 1) => Complex64::ZERO,
            (_, 2) => at(1) - at(0),
            (0, _) => -1.5 * at(0) + 2.0 * at(1) - 0.5 * at(2),
            (i, n) if i + 1 == n => 1.5 * at(i) - 2.0 * at(i - 1) + 0.5 * at(i - 2),
            (i, _) => 0.5 * (at(i + 1) - at(i - 1)),
        }
    };
    stretches_with(keys, stretch_s, slope, out);
}

/// The same with slopes of the amplitude that are known, in amplitudes for a stretch.
pub fn stretches_with(
    keys: &[Key],
    stretch_s: f64,
    slope: impl Fn(usize) -> Complex64,
    out: &mut Vec<Stretch>,
) {
    for (i, pair) in keys.windows(2).enumerate() {
        let [a, b] = pair else { continue };
        let delay_s = cubic(a.delay_s, a.delay_rate * stretch_s, b.delay_s, b.delay_rate * stretch_s);
        let (m0, m1) = (slope(i), slope(i + 1));
        let re = cubic(a.amplitude.re, m0.re, b.amplitude.re, m1.re);
        let im = cubic(a.amplitude.im, m0.im, b.amplitude.im, m1.im);
        let amplitude = std::array::from_fn(|p| Complex::new(re[p] as f32, im[p] as f32));
        out.push(Stretch { delay_s, amplitude, stretch_s });
    }
}

impl Stretch {
    /// Delay, s, and its rate, s/s.
    #[inline(always)]
    pub fn delay(&self, u: f64) -> (f64, f64) {
        let [a, b, c, d] = self.delay_s;
        let value = a + u * (b + u * (c + u * d));
        let rate = (b + u * (2.0 * c + u * 3.0 * d)) / self.stretch_s;
        (value, rate)
    }

    /// Amplitude, LSB.
    #[inline(always)]
    pub fn amplitude(&self, u: f64) -> Complex<f32> {
        let u = u as f32;
        let [a, b, c, d] = self.amplitude;
        a + (b + (c + d * u) * u) * u
    }
}

/// How far the middle one of three delays is from what cubic Hermite makes of its neighbours, s.
pub fn midpoint_error_s(first: &Key, middle: &Key, last: &Key, between_s: f64) -> f64 {
    let span = 2.0 * between_s;
    let predicted = 0.5 * (first.delay_s + last.delay_s) + 0.125 * span * (first.delay_rate - last.delay_rate);
    predicted - middle.delay_s
}
