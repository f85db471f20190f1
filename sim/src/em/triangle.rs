//! Fourier integral of a triangle, `I(a, b, c) = int exp(j (l0 a + l1 b + l2 c))` over the unit simplex (whose area is
//! 1/2). A triangle of area A whose phase is linear between vertex phases a, b, c integrates to `2 A I`.
//!
//! By the Hermite-Genocchi formula, `I` is minus the divided difference of `exp(j .)` at a, b, c. Its quotient form
//! suffers from cancellation where phases are close, as do Gordon's edge sums near specular directions. Two forms
//! together avoid this. For phases within one radian of each other it is a power series about their mean. Otherwise it
//! is a difference of edge integrals over the longest phase difference, which is then not small. The result does not
//! depend on the order of the vertices.

use num_complex::Complex64;

/// Coefficients `1/(n + 2)!` of the series, n from 0.
const INVERSE_FACTORIALS: [f64; 17] = {
    let mut all = [0.5; 17];
    let mut n = 1;
    while n < all.len() {
        all[n] = all[n - 1] / (n as f64 + 2.0);
        n += 1;
    }
    all
};

/// Computes `int l_i exp(j phase)` over the unit simplex for each corner i. The integral of a strength that is linear
/// between the corners is the sum of its corner values times these moments. They add up to `I`, and are its derivatives by
/// the phases, over j.
#[inline]
pub fn moments(a: f64, b: f64, c: f64) -> [Complex64; 3] {
    let (low, high) = (a.min(b).min(c), a.max(b).max(c));
    if high - low < 1.0 {
        return series_moments([a, b, c]);
    }
    // Sorted by exchanges that are undone in the result.
    let (mut x, mut order) = ([a, b, c], [0usize, 1, 2]);
    for (i, j) in [(0, 1), (1, 2), (0, 1)] {
        if x[i] > x[j] {
            x.swap(i, j);
            order.swap(i, j);
        }
    }
    let [p, q, r] = x;
    let longest = r - p;
    let (lower, upper) = (Edge::new(p, q), Edge::new(q, r));
    let over = Complex64::new(0.0, longest).inv();
    let whole = (upper.value - lower.value) * over;
    let sorted = [
        -lower.to_first * over + whole / longest,
        (upper.to_first - lower.to_second) * over,
        upper.to_second * over - whole / longest,
    ];
    let mut moments = [Complex64::ZERO; 3];
    for (to, value) in order.into_iter().zip(sorted) {
        moments[to] = Complex64::new(value.im, -value.re);
    }
    moments
}

/// `int_0^1 exp(j (a + t (b - a))) dt` and its derivatives by a and b.
struct Edge {
    value: Complex64,
    to_first: Complex64,
    to_second: Complex64,
}

impl Edge {
    #[inline]
    fn new(a: f64, b: f64) -> Self {
        let (half, turn) = (0.5 * (b - a), Complex64::from_polar(1.0, 0.5 * (a + b)));
        let (sine, cosine) = half.sin_cos();
        let (sinc, slope) = if half.abs() < 0.03 {
            let square = half * half;
            let slope = -half / 3.0 * (1.0 - square / 10.0 * (1.0 - square / 28.0 * (1.0 - square / 54.0)));
            (1.0 - square / 6.0 * (1.0 - square / 20.0 * (1.0 - square / 42.0)), slope)
        } else {
            (sine / half, (cosine - sine / half) / half)
        };
        Edge {
            value: turn * sinc,
            to_first: turn * Complex64::new(-0.5 * slope, 0.5 * sinc),
            to_second: turn * Complex64::new(0.5 * slope, 0.5 * sinc),
        }
    }
}

/// Sums the series of complete homogeneous symmetric polynomials `h_n` of the phases about their mean, by their
/// recursion, with each corner's phase counted twice: `h_n(x, y, z, x) = h_n(x, y, z) + x h_{n-1}(x, y, z, x)`.
fn series_moments(phases: [f64; 3]) -> [Complex64; 3] {
    let mean = (phases[0] + phases[1] + phases[2]) / 3.0;
    let x = phases.map(|p| p - mean);
    let (e2, e3) = (x[0] * x[1] + x[1] * x[2] + x[2] * x[0], x[0] * x[1] * x[2]);
    let (mut h2, mut h1, mut h0) = (0.0, 0.0, 1.0);
    let mut twice = [1.0; 3];
    let mut sums = [(INVERSE_FACTORIALS[1], 0.0); 3];
    for (n, inverse) in INVERSE_FACTORIALS.iter().skip(2).enumerate().map(|(i, inverse)| (i + 1, inverse)) {
        let h = -e2 * h1 + e3 * h2;
        (h2, h1, h0) = (h1, h0, h);
        for ((twice, sum), x) in twice.iter_mut().zip(&mut sums).zip(x) {
            *twice = h0 + x * *twice;
            match n % 4 {
                0 => sum.0 += *twice * inverse,
                1 => sum.1 += *twice * inverse,
                2 => sum.0 -= *twice * inverse,
                _ => sum.1 -= *twice * inverse,
            }
        }
    }
    let turn = Complex64::from_polar(1.0, mean);
    sums.map(|(re, im)| turn * Complex64::new(re, im))
}

/// Computes `sin x / x`.
#[inline]
pub fn sinc(x: f64) -> f64 {
    if x.abs() < 1e-4 { 1.0 - x * x / 6.0 } else { x.sin() / x }
}

#[cfg(test)]
mod hard_cases {
    use super::*;

    fn integral(a: f64, b: f64, c: f64) -> Complex64 {
        moments(a, b, c).iter().sum()
    }

    /// Compares with arithmetic of 160 digits: the power series about the first phase, 700 terms (Python's `decimal`).
    #[test]
    fn phases_that_coincide_lose_no_digits() {
        let cases = [
            ([0.0, 0.0, 0.0], 0.5, 0.0),
            ([0.3, 0.3, 0.3], 0.477668244562803, 0.14776010333066977),
            ([0.0, 1e-09, 2e-09], 0.5, 5e-10),
            ([0.0, 0.0, 1.0], 0.4596976941318603, 0.1585290151921035),
            ([0.0, 1.0, 1.0], 0.3817732906760362, 0.3011686789397568),
            ([0.1, 0.7, 0.9], 0.41569724801653035, 0.2647012571280956),
            ([0.0, 3.1, 3.1], -0.19461343358273453, 0.32662847328620775),
            ([-2.0, 5.5, 20.0], 0.007759351599055734, -0.003838730973472704),
            ([0.0, 50.0, 100.0], 1.3522636939308523e-05, -3.676813259619756e-06),
            ([0.0, 99.0, 100.0], -0.00832196770880473, -0.005029341914017096),
            ([100.0, 100.0, 100.0], 0.43115943614384195, -0.2531828205548794),
        ];
        for ([a, b, c], re, im) in cases {
            let error = (integral(a, b, c) - Complex64::new(re, im)).norm();
            assert!(error < 3e-15, "{a} {b} {c}: {error:e}");
        }
    }

    /// Moments permute with their corners and match the difference quotients of the integral.
    #[test]
    fn moments_are_derivatives_of_the_integral() {
        let sizes = [0.0, 1e-12, 1e-6, 1e-3, 0.05, 0.3, 0.99, 1.0, 1.01, 2.0, 6.3, 20.0, 60.0];
        for p in sizes {
            for q in sizes {
                for [a, b, c] in [[0.3, 0.3 + p, 0.3 + q], [p, 0.0, -q], [p, p + q, 0.1]] {
                    let [x, y, z] = moments(a, b, c);
                    let [v, w, u] = moments(b, c, a);
                    assert!((u - x).norm() + (v - y).norm() + (w - z).norm() < 1e-14);
                    let step = 1e-4;
                    let slope = (integral(a + step, b, c) - integral(a - step, b, c)) / Complex64::new(0.0, 2.0 * step);
                    assert!((slope - x).norm() < 1e-9, "{a} {b} {c}: {slope} {x}");
                }
            }
        }
    }

    /// No modulus exceeds the simplex's area, and both forms agree at the boundary between them.
    #[test]
    fn both_forms_meet() {
        for i in 0..200 {
            let b = f64::from(i) / 199.0;
            let (below, above) = (integral(0.0, b, 1.0 - 1e-15), integral(0.0, b, 1.0 + 1e-15));
            assert!((below - above).norm() < 1e-15, "{b}");
            assert!(above.norm() <= 0.5);
        }
    }
}
