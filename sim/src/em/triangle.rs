//! Fourier integral of a triangle, `I(a, b, c) = int exp(j (l0 a + l1 b + l2 c))` over the unit simplex (whose area is
//! 1/2). A triangle of area A whose phase is linear between vertex phases a, b, c integrates to `2 A I`.
//!
//! By the Hermite-Genocchi formula, `I` is minus the divided difference of `exp(j .)` at a, b, c. Its quotient form
//! suffers from cancellation where phases are close, as do Gordon's edge sums near specular directions. Two forms
//! together avoid this. For phases within one radian of each other, `I` is computed by a power series about their mean.
//! Otherwise it is a difference of edge integrals, divided by the largest phase difference, which is then not small.
//! The result does not depend on the order of the vertices.

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

/// Computes `int exp(j phase)` over the unit simplex for the phases at its vertices, rad.
#[inline]
pub fn integral(a: f64, b: f64, c: f64) -> Complex64 {
    // Sorted, so that the result does not depend on the order of the vertices.
    let (a, b) = if a <= b { (a, b) } else { (b, a) };
    let (b, c) = if b <= c { (b, c) } else { (c, b) };
    let (a, b) = if a <= b { (a, b) } else { (b, a) };
    let longest = c - a;
    if longest < 1.0 { series(a, b, c) } else { (edge(b, c) - edge(a, b)) / Complex64::new(0.0, longest) }
}

/// Computes `int l_i exp(j phase)` over the unit simplex for each corner i. The integral of a strength that is linear
/// between the corners is the sum of its corner values times these moments. They are the derivatives of [`integral`] by
/// the phases, over j, and add up to it.
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
    let inverse = Complex64::new(0.0, longest).inv();
    let whole = (upper.value - lower.value) * inverse;
    let sorted = [
        -lower.by_first * inverse + whole / longest,
        (upper.by_first - lower.by_second) * inverse,
        upper.by_second * inverse - whole / longest,
    ];
    let mut moments = [Complex64::ZERO; 3];
    for (corner, value) in order.into_iter().zip(sorted) {
        moments[corner] = Complex64::new(value.im, -value.re);
    }
    moments
}

/// `int_0^1 exp(j (a + t (b - a))) dt` and its derivatives by a and b.
struct Edge {
    value: Complex64,
    by_first: Complex64,
    by_second: Complex64,
}

impl Edge {
    #[inline]
    fn new(a: f64, b: f64) -> Self {
        let (half, phasor) = (0.5 * (b - a), Complex64::from_polar(1.0, 0.5 * (a + b)));
        let (sine, cosine) = half.sin_cos();
        let (sinc, slope) = if half.abs() < 0.03 {
            let square = half * half;
            let slope = -half / 3.0 * (1.0 - square / 10.0 * (1.0 - square / 28.0 * (1.0 - square / 54.0)));
            (1.0 - square / 6.0 * (1.0 - square / 20.0 * (1.0 - square / 42.0)), slope)
        } else {
            (sine / half, (cosine - sine / half) / half)
        };
        Edge {
            value: phasor * sinc,
            by_first: phasor * Complex64::new(-0.5 * slope, 0.5 * sinc),
            by_second: phasor * Complex64::new(0.5 * slope, 0.5 * sinc),
        }
    }
}

/// Sums the moments by the series of [`series`], in which each corner's own phase is counted twice: `h_n(x, y, z, x) =
/// h_n(x, y, z) + x h_{n-1}(x, y, z, x)`.
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

/// Sums the series of complete homogeneous symmetric polynomials `h_n` of the phases about their mean, by their
/// recursion. The first order vanishes there.
fn series(a: f64, b: f64, c: f64) -> Complex64 {
    let mean = (a + b + c) / 3.0;
    let (x, y, z) = (a - mean, b - mean, c - mean);
    let (e2, e3) = (x * y + y * z + z * x, x * y * z);
    let (mut h2, mut h1, mut h0) = (0.0, 0.0, 1.0);
    let (mut re, mut im) = (0.5, 0.0);
    for (n, inverse) in INVERSE_FACTORIALS.iter().enumerate().skip(1) {
        let h = -e2 * h1 + e3 * h2;
        (h2, h1, h0) = (h1, h0, h);
        match n % 4 {
            0 => re += h0 * inverse,
            1 => im += h0 * inverse,
            2 => re -= h0 * inverse,
            _ => im -= h0 * inverse,
        }
    }
    // The first order does not quite vanish at the rounded mean: for a hundred radians the last digit is 1e-14.
    let residual = (x + y + z) / 3.0;
    Complex64::from_polar(1.0, mean) * Complex64::new(re - residual * im, im + residual * re)
}

/// Computes `int_0^1 exp(j (a + t (b - a))) dt`.
#[inline]
fn edge(a: f64, b: f64) -> Complex64 {
    let sum = a + b;
    // Rounding error of the sum (Knuth), applied as a rotation.
    let rounded_b = sum - a;
    let residual = 0.5 * ((a - (sum - rounded_b)) + (b - rounded_b));
    Complex64::from_polar(sinc(0.5 * (b - a)), 0.5 * sum) * Complex64::new(1.0, residual)
}

/// Computes `sin x / x`.
#[inline]
pub fn sinc(x: f64) -> f64 {
    if x.abs() < 1e-4 { 1.0 - x * x / 6.0 } else { x.sin() / x }
}

/// Integral in arithmetic of 32 digits, for tests. Numbers are unevaluated sums of two f64 (Dekker, "A floating-point
/// technique for extending the available precision", Numerische Mathematik 18, 1971). Exponentials use Taylor series
/// and repeated squaring.
#[cfg(test)]
mod double_double {
    /// Number `high + low`, with low within half a unit in the last place of high.
    #[derive(Debug, Clone, Copy)]
    pub struct Double(f64, f64);

    impl Double {
        fn sum(a: f64, b: f64) -> Self {
            let sum = a + b;
            let of_b = sum - a;
            Double(sum, (a - (sum - of_b)) + (b - of_b))
        }

        fn plus(self, other: Double) -> Self {
            let Double(high, low) = Double::sum(self.0, other.0);
            let Double(second, third) = Double::sum(self.1, other.1);
            let Double(high, low) = Double::sum(high, low + second);
            Double::sum(high, low + third)
        }

        fn times(self, other: Double) -> Self {
            let product = self.0 * other.0;
            let rest = self.0.mul_add(other.0, -product);
            Double::sum(product, rest + (self.0 * other.1 + self.1 * other.0))
        }

        fn minus(self) -> Self {
            Double(-self.0, -self.1)
        }

        fn over(self, other: Double) -> Self {
            let first = self.0 / other.0;
            let rest = self.plus(other.times(Double(first, 0.0)).minus());
            let second = rest.0 / other.0;
            let rest = rest.plus(other.times(Double(second, 0.0)).minus());
            Double(first, 0.0).plus(Double(second, 0.0)).plus(Double(rest.0 / other.0, 0.0))
        }
    }

    #[derive(Clone, Copy)]
    struct Complex(Double, Double);

    const ZERO: Double = Double(0.0, 0.0);
    const ONE: Complex = Complex(Double(1.0, 0.0), ZERO);

    impl Complex {
        fn plus(self, o: Complex) -> Self {
            Complex(self.0.plus(o.0), self.1.plus(o.1))
        }

        fn minus(self, o: Complex) -> Self {
            self.plus(Complex(o.0.minus(), o.1.minus()))
        }

        fn times(self, o: Complex) -> Self {
            let re = self.0.times(o.0).plus(self.1.times(o.1).minus());
            Complex(re, self.0.times(o.1).plus(self.1.times(o.0)))
        }

        fn scaled(self, by: Double) -> Self {
            Complex(self.0.times(by), self.1.times(by))
        }

        /// Returns the quotient by `j by`.
        fn over_j(self, by: Double) -> Self {
            Complex(self.1.over(by), self.0.over(by).minus())
        }

        /// Computes `e^{j x}`.
        fn turn(x: Double) -> Self {
            let small = Complex(ZERO, Double(x.0 / 1024.0, x.1 / 1024.0));
            let mut power = (1..20).rev().fold(ONE, |sum, n| {
                ONE.plus(small.times(sum).scaled(Double(1.0, 0.0).over(Double(f64::from(n), 0.0))))
            });
            for _ in 0..10 {
                power = power.times(power);
            }
            power
        }
    }

    /// Computes `int_0^1 exp(j (a + t (b - a))) dt`.
    fn edge(a: f64, b: f64) -> Complex {
        let length = Double::sum(b, -a);
        if length.0.abs() >= 1.0 {
            return Complex::turn(Double(b, 0.0)).minus(Complex::turn(Double(a, 0.0))).over_j(length);
        }
        let step = Complex(ZERO, length);
        let sum = (1..30)
            .rev()
            .fold(ONE, |sum, n| ONE.plus(step.times(sum).scaled(Double(1.0, 0.0).over(Double(f64::from(n + 1), 0.0)))));
        sum.times(Complex::turn(Double(a, 0.0)))
    }

    /// See [`super::integral`].
    pub fn integral(a: f64, b: f64, c: f64) -> num_complex::Complex64 {
        let mut x = [a, b, c];
        x.sort_by(f64::total_cmp);
        let [a, b, c] = x;
        let longest = Double::sum(c, -a);
        let value = if longest.0 >= 1.0 {
            edge(b, c).minus(edge(a, b)).over_j(longest)
        } else {
            // Power series about the first phase: sum of h_n(0, p, q) j^n/(n + 2)!, with h_n = p h_{n-1} + q^n.
            let (p, q) = (Double::sum(b, -a), longest);
            let (mut h, mut power, mut factor) = (Double(1.0, 0.0), Double(1.0, 0.0), Complex(Double(0.5, 0.0), ZERO));
            let mut sum = factor;
            for n in 1..32 {
                power = power.times(q);
                h = h.times(p).plus(power);
                let Complex(re, im) = factor;
                factor = Complex(im.minus(), re).scaled(Double(1.0, 0.0).over(Double(f64::from(n + 2), 0.0)));
                sum = sum.plus(factor.scaled(h));
            }
            sum.times(Complex::turn(Double(a, 0.0)))
        };
        num_complex::Complex64::new(value.0.0 + value.0.1, value.1.0 + value.1.1)
    }
}

#[cfg(test)]
mod hard_cases {
    use super::*;

    /// Compares with arithmetic of 160 digits.
    #[test]
    fn the_reference_has_more_digits_than_it_needs() {
        // from decimal import *: the power series about the first phase, 700 terms, 160 digits, rounded to f64.
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
            let error = (double_double::integral(a, b, c) - Complex64::new(re, im)).norm();
            assert!(error < 1e-16, "{a} {b} {c}: {error:e}");
        }
    }

    /// Compares with the reference to 1e-15 of the integral without phase. Phases range from zero to a hundred radians
    /// along every direction in which two or three of them coincide, or nearly do, and in between.
    #[test]
    fn degenerate_directions_are_right_to_the_last_digits() {
        let mut sizes =
            vec![0.0, 1e-300, 1e-16, 1e-12, 1e-8, 1e-4, 0.999_999, 1.0 - 1e-16, 1.0, 1.0 + 2e-16, 1.000_001];
        sizes.extend((1..=400).map(|i| 0.25 * f64::from(i)));
        sizes.extend((1..=12).map(|i| std::f64::consts::TAU * f64::from(i)));
        let mut worst: (f64, [f64; 3]) = (0.0, [0.0; 3]);
        let mut check = |x: [f64; 3]| {
            let error = (integral(x[0], x[1], x[2]) - double_double::integral(x[0], x[1], x[2])).norm() / 0.5;
            if error > worst.0 {
                worst = (error, x);
            }
        };
        for &w in &sizes {
            // Directions along an edge, from a corner, along the height, and slightly off each.
            for x in [[0.0, 0.0, w], [0.0, w, w], [0.0, 0.5 * w, w], [-w, 0.0, w], [w, w, w]] {
                check(x);
                for off in [1e-16, 1e-12, 1e-8, 1e-4, 1e-2] {
                    check([x[0], x[1] + off, x[2]]);
                    check([x[0], x[1] * (1.0 - off), x[2]]);
                }
            }
            for &v in sizes.iter().step_by(7) {
                check([0.0, v, w]);
                check([-v, 0.0, w]);
            }
        }
        let (error, x) = worst;
        assert!(error < 1e-15, "{x:?}: {error:e}");
    }

    /// Moments add up to the integral, permute with their corners, and match the difference quotients of the integral.
    #[test]
    fn moments_are_derivatives_of_the_integral() {
        let sizes = [0.0, 1e-12, 1e-6, 1e-3, 0.05, 0.3, 0.99, 1.0, 1.01, 2.0, 6.3, 20.0, 60.0];
        let mut worst: f64 = 0.0;
        for p in sizes {
            for q in sizes {
                for [a, b, c] in [[0.3, 0.3 + p, 0.3 + q], [p, 0.0, -q], [p, p + q, 0.1]] {
                    let [x, y, z] = moments(a, b, c);
                    worst = worst.max((x + y + z - integral(a, b, c)).norm());
                    let [v, w, u] = moments(b, c, a);
                    assert!((u - x).norm() + (v - y).norm() + (w - z).norm() < 1e-14);
                    let step = 1e-4;
                    let slope = (integral(a + step, b, c) - integral(a - step, b, c)) / Complex64::new(0.0, 2.0 * step);
                    assert!((slope - x).norm() < 1e-9, "{a} {b} {c}: {slope} {x}");
                }
            }
        }
        assert!(worst < 2e-15, "{worst:e}");
    }

    #[test]
    fn the_order_of_vertices_changes_no_bit() {
        for (a, b, c) in [(0.1, 0.2, 0.3), (5.0, -12.0, 30.0), (1.0, 1.0, 2.0), (0.0, 0.5, 1.01)] {
            let expected = integral(a, b, c);
            for (x, y, z) in [(a, c, b), (b, a, c), (b, c, a), (c, a, b), (c, b, a)] {
                assert_eq!(integral(x, y, z), expected);
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
