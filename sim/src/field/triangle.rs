//! The Fourier integral of a triangle: `I(a, b, c) = int exp(j (l0 a + l1 b + l2 c))` over the unit simplex (whose area is
//! 1/2), so that a triangle of area A whose phase is linear between vertex phases a, b, c integrates to `2 A I`.
//!
//! By Hermite and Genocchi `I` is minus the divided difference of `exp(j .)` at a, b, c. The quotient form of that cancels
//! where phases come close (Gordon's edge sums have the same trouble near specular directions); two forms together do not:
//! for phases within one radian of each other a power series about their mean, else a difference of edge integrals over the
//! longest difference, which is then no small number. The result does not depend on the order of the vertices.

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

/// `int exp(j phase)` over the unit simplex for the phases at its vertices, rad.
#[inline]
pub fn integral(a: f64, b: f64, c: f64) -> Complex64 {
    // Sorted: what the result is must not depend on which vertex comes first.
    let (a, b) = if a <= b { (a, b) } else { (b, a) };
    let (b, c) = if b <= c { (b, c) } else { (c, b) };
    let (a, b) = if a <= b { (a, b) } else { (b, a) };
    let longest = c - a;
    if longest < 1.0 { series(a, b, c) } else { (edge(b, c) - edge(a, b)) / Complex64::new(0.0, longest) }
}

/// `int l_i exp(j phase)` over the unit simplex for each corner i: what a strength that is linear between the corners
/// integrates to is their sum weighted by it. They are the derivatives of [`integral`] by the phases, over j, and add up to it.
#[inline]
pub fn moments(a: f64, b: f64, c: f64) -> [Complex64; 3] {
    let (low, high) = (a.min(b).min(c), a.max(b).max(c));
    if high - low < 1.0 {
        return series_moments([a, b, c]);
    }
    // Sorted by exchanges, which are undone in the result.
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

/// The same series with each corner's phase counted twice: `h_n(x, y, z, x) = h_n(x, y, z) + x h_{n-1}(x, y, z, x)`.
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

/// Complete homogeneous symmetric polynomials `h_n` of the phases about their mean, by their recursion: their first order
/// vanishes there.
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
    Complex64::from_polar(1.0, mean) * Complex64::new(re, im)
}

/// `int_0^1 exp(j (a + t (b - a))) dt`.
#[inline]
fn edge(a: f64, b: f64) -> Complex64 {
    Complex64::from_polar(sinc(0.5 * (b - a)), 0.5 * (a + b))
}

/// `sin x / x`.
#[inline]
pub fn sinc(x: f64) -> f64 {
    if x.abs() < 1e-4 { 1.0 - x * x / 6.0 } else { x.sin() / x }
}

/// The same integral the slow, obvious way: Gauss-Legendre quadrature in both directions, panels of at most a radian.
pub fn by_quadrature(a: f64, b: f64, c: f64) -> Complex64 {
    // int_0^1 du u int_0^1 dv exp(j (a + u ((b - a) + v (c - b)))): the unit square, folded into the simplex.
    let panels = |span: f64| 1 + span.abs().ceil() as usize;
    let outer = panels((b - a).abs().max((c - a).abs()));
    let inner = panels(c - b);
    let mut sum = Complex64::ZERO;
    for (u, wu) in gauss_legendre(outer) {
        for (v, wv) in gauss_legendre(inner) {
            sum += Complex64::from_polar(wu * wv * u, a + u * ((b - a) + v * (c - b)));
        }
    }
    sum
}

/// Nodes and weights of the 10-point rule on equal panels of 0..1.
pub(crate) fn gauss_legendre(panels: usize) -> impl Iterator<Item = (f64, f64)> {
    const NODES: [f64; 5] = [
        0.148_874_338_981_631_22,
        0.433_395_394_129_247_2,
        0.679_409_568_299_024_4,
        0.865_063_366_688_984_5,
        0.973_906_528_517_171_7,
    ];
    const WEIGHTS: [f64; 5] = [
        0.295_524_224_714_752_87,
        0.269_266_719_309_996_35,
        0.219_086_362_515_982_04,
        0.149_451_349_150_580_6,
        0.066_671_344_308_688_14,
    ];
    let width = 1.0 / panels.max(1) as f64;
    (0..panels.max(1)).flat_map(move |panel| {
        let centre = (panel as f64 + 0.5) * width;
        (0..10).map(move |i| {
            let (node, weight) = (NODES[i % 5], WEIGHTS[i % 5]);
            let sign = if i < 5 { 1.0 } else { -1.0 };
            (centre + 0.5 * width * sign * node, 0.5 * width * weight)
        })
    })
}

#[cfg(test)]
mod hard_cases {
    use super::*;

    /// Everything from no phase at all to a hundred radians, with every way in which two or three phases can coincide or
    /// nearly do. The quadrature itself is good to some 1e-14 at the far end.
    #[test]
    fn degenerate_directions_agree_with_quadrature() {
        let sizes = [0.0, 1e-300, 1e-16, 1e-12, 1e-8, 1e-4, 0.1, 0.5, 0.999_999, 1.0, 1.000_001, 2.0, 3.1, 6.3, 20.0];
        let mut worst: f64 = 0.0;
        for p in sizes {
            for q in sizes {
                for offset in [0.0, 0.7, -3.0] {
                    for [a, b, c] in [[0.0, p, q], [0.0, p, p + q], [0.0, p, -q], [p, p, q], [0.0, p, p * (1.0 + 1e-9)]]
                    {
                        let (a, b, c) = (a + offset, b + offset, c + offset);
                        worst = worst.max((integral(a, b, c) - by_quadrature(a, b, c)).norm() / 0.5);
                    }
                }
            }
        }
        assert!(worst < 3e-15, "{worst:e}");
    }

    /// Moments add up to the integral, follow their corners, and each is the quadrature's difference quotient.
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

    /// No modulus exceeds the simplex's area, and both forms meet where one hands over to the other.
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
