//! From a few key times to every chirp: cubic Hermite in delay (values and rates) and in complex amplitude, or a quintic in
//! delay where its acceleration is known too. On a walker a quintic's two keys do about what three of the cubic do
//! (`tests/slow_time.rs`).

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

/// How a path bends at a key time.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Bend {
    /// Rate of the delay's rate, 1/s.
    pub delay_acceleration_per_s: f64,
    /// Rate of the amplitude, LSB/s.
    pub amplitude_rate: Complex64,
}

impl Bend {
    /// From the same path a little before and a little after the key, `apart_s` between the two.
    pub fn between(before: &Key, after: &Key, apart_s: f64) -> Self {
        Bend {
            delay_acceleration_per_s: (after.delay_rate - before.delay_rate) / apart_s,
            amplitude_rate: (after.amplitude - before.amplitude) / apart_s,
        }
    }
}

/// A path within one stretch between keys, as polynomials of `u` in 0..1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stretch {
    delay_s: [f64; 6],
    amplitude: [Complex<f32>; 4],
    stretch_s: f64,
}

/// Cubic Hermite over 0..1 by powers, from values and slopes at the ends.
pub(crate) fn cubic(y0: f64, m0: f64, y1: f64, m1: f64) -> [f64; 4] {
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
    for (i, pair) in keys.windows(2).enumerate() {
        let [a, b] = pair else { continue };
        let [p, q, r, s] = cubic(a.delay_s, a.delay_rate * stretch_s, b.delay_s, b.delay_rate * stretch_s);
        let amplitude = amplitude_cubic(a, slope(i), b, slope(i + 1));
        out.push(Stretch { delay_s: [p, q, r, s, 0.0, 0.0], amplitude, stretch_s });
    }
}

fn amplitude_cubic(a: &Key, m0: Complex64, b: &Key, m1: Complex64) -> [Complex<f32>; 4] {
    let re = cubic(a.amplitude.re, m0.re, b.amplitude.re, m1.re);
    let im = cubic(a.amplitude.im, m0.im, b.amplitude.im, m1.im);
    std::array::from_fn(|p| Complex::new(re[p] as f32, im[p] as f32))
}

/// Quintics of delay and cubics of amplitude for every stretch between keys `stretch_s` apart, whose bends are known. The
/// delay errs by its sixth derivative times `stretch^6 / 46080`, where a cubic errs by the fourth times `stretch^4 / 384`.
pub fn bent_stretches(keys: &[(Key, Bend)], stretch_s: f64, out: &mut Vec<Stretch>) {
    for pair in keys.windows(2) {
        let [(a, at_a), (b, at_b)] = pair else { continue };
        let (v0, v1) = (a.delay_rate * stretch_s, b.delay_rate * stretch_s);
        let square = stretch_s * stretch_s;
        let (w0, w1) = (at_a.delay_acceleration_per_s * square, at_b.delay_acceleration_per_s * square);
        // What the parabola of the first key misses at the second: value, slope, bend.
        let value = b.delay_s - a.delay_s - v0 - 0.5 * w0;
        let (slope, bend) = (v1 - v0 - w0, w1 - w0);
        let delay_s = [
            a.delay_s,
            v0,
            0.5 * w0,
            10.0 * value - 4.0 * slope + 0.5 * bend,
            -15.0 * value + 7.0 * slope - bend,
            6.0 * value - 3.0 * slope + 0.5 * bend,
        ];
        let amplitude = amplitude_cubic(a, at_a.amplitude_rate * stretch_s, b, at_b.amplitude_rate * stretch_s);
        out.push(Stretch { delay_s, amplitude, stretch_s });
    }
}

impl Stretch {
    /// Delay, s, and its rate, s/s.
    #[inline(always)]
    pub fn delay(&self, u: f64) -> (f64, f64) {
        let [a, b, c, d, e, f] = self.delay_s;
        let value = a + u * (b + u * (c + u * (d + u * (e + u * f))));
        let rate = (b + u * (2.0 * c + (u * 3.0 * d + u * u * (4.0 * e + u * 5.0 * f)))) / self.stretch_s;
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

#[cfg(test)]
mod tests {
    use super::*;

    /// Any quintic is met between its ends, value and rate, and any cubic of amplitude.
    #[test]
    fn two_bent_keys_hold_a_quintic() {
        let c = [1e-8, -2e-8, 3e-7, 4e-7, -5e-6, 6e-6];
        let delay = |t: f64| c.iter().rev().fold(0.0, |sum, c| sum * t + c);
        let rate = |t: f64| (1..6).rev().fold(0.0, |sum, i| sum * t + i as f64 * c[i]);
        let acceleration = |t: f64| (2..6).rev().fold(0.0, |sum, i| sum * t + (i * (i - 1)) as f64 * c[i]);
        let amplitude = |t: f64| Complex64::new(1.0 + t * t, t * t * t - 2.0);
        let slope = |t: f64| Complex64::new(2.0 * t, 3.0 * t * t);
        let at = |t: f64| {
            let key = Key { delay_s: delay(t), delay_rate: rate(t), amplitude: amplitude(t) };
            (key, Bend { delay_acceleration_per_s: acceleration(t), amplitude_rate: slope(t) })
        };
        let mut found = Vec::new();
        bent_stretches(&[at(0.1), at(0.4), at(0.7)], 0.3, &mut found);
        for (stretch, start) in found.iter().zip([0.1, 0.4]) {
            for u in [0.0, 0.2, 0.5, 0.9, 1.0] {
                let t = start + 0.3 * u;
                let (value, slope) = stretch.delay(u);
                assert!((value - delay(t)).abs() < 1e-20 && (slope - rate(t)).abs() < 1e-19, "{t}");
                let a = stretch.amplitude(u);
                assert!((Complex64::new(a.re.into(), a.im.into()) - amplitude(t)).norm() < 1e-6, "{t}");
            }
        }
    }
}
