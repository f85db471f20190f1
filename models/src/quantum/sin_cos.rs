//! Sine and cosine of many angles at once, in loops that compilers turn into vector instructions.

use std::f64::consts::FRAC_PI_2;

/// Largest angle that [`reduced_sin_cos`] takes.
const MAX_ANGLE: f64 = 1e5;
/// pi/2 in three parts. Multiples up to 2^20 of the first two, of 33 and 20 bits, are exact.
const HEAD: f64 = f64::from_bits(FRAC_PI_2.to_bits() & !((1 << 20) - 1));
const MIDDLE: f64 = FRAC_PI_2 - HEAD;
const TAIL: f64 = 6.123_233_995_736_766e-17;
/// Adding 1.5 * 2^52 rounds to an integer and leaves it in the lowest bits.
const ROUND: f64 = 6_755_399_441_055_744.0;

/// 1 / n!
const fn inverse_factorial(n: u32) -> f64 {
    let (mut product, mut k) = (1.0, 2);
    while k <= n {
        product *= k as f64;
        k += 1;
    }
    1.0 / product
}

/// Taylor's series to the 15th and 16th power in `z = y^2`, lowest first: within 5e-17 up to pi/4.
const SINE: [f64; 7] = {
    let f = inverse_factorial;
    [-f(3), f(5), -f(7), f(9), -f(11), f(13), -f(15)]
};
const COSINE: [f64; 8] = {
    let f = inverse_factorial;
    [-f(2), f(4), -f(6), f(8), -f(10), f(12), -f(14), f(16)]
};

/// `(sin, cos)` of an angle of magnitude up to 1e5, within 3e-16; NaN for NaN. Multiplies and adds are never fused, so
/// that every machine gives the same result.
#[inline(always)]
pub(super) fn reduced_sin_cos(angle: f64) -> (f64, f64) {
    let rounded = angle * std::f64::consts::FRAC_2_PI + ROUND;
    let quarter_turns = rounded - ROUND;
    let y = ((angle - quarter_turns * HEAD) - quarter_turns * MIDDLE) - quarter_turns * TAIL;
    let z = y * y;
    let polynomial = |c: &[f64]| c.iter().rev().fold(0.0, |sum, c| sum * z + c);
    let (sine, cosine) = (y + y * z * polynomial(&SINE), 1.0 + z * polynomial(&COSINE));
    let quadrant = rounded.to_bits();
    let (s, c) = if quadrant & 1 == 0 { (sine, cosine) } else { (cosine, sine) };
    let sign = |value: f64, negative: u64| f64::from_bits(value.to_bits() ^ (negative << 63));
    (sign(s, (quadrant >> 1) & 1), sign(c, ((quadrant >> 1) ^ quadrant) & 1))
}

/// Returns whether [`reduced_sin_cos`] is accurate: false for infinities and NaN.
#[inline(always)]
pub(super) fn is_reducible(angle: f64) -> bool {
    angle.abs() <= MAX_ANGLE
}

/// Writes `(sin, cos)` of each of `angles`. The standard library computes those beyond [`MAX_ANGLE`].
#[inline(always)]
pub(super) fn sin_cos(angles: &[f64], sines: &mut [f64], cosines: &mut [f64]) {
    let mut fits = true;
    for ((&angle, sine), cosine) in angles.iter().zip(sines.iter_mut()).zip(cosines.iter_mut()) {
        (*sine, *cosine) = reduced_sin_cos(angle);
        fits &= is_reducible(angle);
    }
    if !fits {
        for ((&angle, sine), cosine) in angles.iter().zip(sines).zip(cosines).filter(|((a, _), _)| !is_reducible(**a)) {
            (*sine, *cosine) = angle.sin_cos();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn agrees_with_the_standard_library() {
        assert_eq!(HEAD + MIDDLE, FRAC_PI_2);
        let quarters = (-40..=40).map(|k| f64::from(k) * 0.5 * FRAC_PI_2);
        let angles: Vec<f64> = quarters
            .flat_map(|a| [a, a + 1e-9, a - 1e-9])
            .chain((0..20_000).map(|k| f64::from(k) * 0.0012345 - 12.0))
            .chain((0..2000).map(|k| f64::from(k) * 100.001 - 1e5))
            .chain([1e5, -1e5, 1e5 + 1.0, 1e30, -1e300, 0.0, -0.0])
            .collect();
        let (mut s, mut c) = (vec![0.0; angles.len()], vec![0.0; angles.len()]);
        sin_cos(&angles, &mut s, &mut c);
        for ((a, s), c) in angles.iter().zip(s).zip(c) {
            assert!((s - a.sin()).abs() < 3e-16 && (c - a.cos()).abs() < 3e-16, "{a}: {s} {c}");
        }
    }

    #[test]
    fn infinities_and_nan_become_nan() {
        let (mut s, mut c) = ([0.0; 3], [0.0; 3]);
        sin_cos(&[f64::NAN, f64::INFINITY, f64::NEG_INFINITY], &mut s, &mut c);
        assert!(s.iter().chain(&c).all(|v| v.is_nan()));
    }
}
