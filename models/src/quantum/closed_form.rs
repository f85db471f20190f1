//! The paper's circuit in closed form: two qubits, ZZFeatureMap and RealAmplitudes, one repetition each, full
//! entanglement, measured in `<ZI>` and `<IZ>`.
//!
//! With `w = 2 (pi - x0)(pi - x1)`, both expectations are linear in five trigonometric features of the input,
//! ```text
//! a = sin 2x1 sin w   b = sin 2x0 sin w   c = cos 2x0 cos 2x1   d = cos 2x1 cos w   e = cos 2x0 cos w
//! <ZI> = cos t3 [cos t0 sin t1 a + sin t0 cos t1 b + sin t0 sin t1 c] - sin t3 cos t1 d
//! <IZ> = -cos t2 sin t0 e - sin t2 [cos t0 cos t1 c - cos t0 sin t1 b - sin t0 cos t1 a]
//! ```
//! (derived by hand from the circuit of Havlicek et al., Nature 567 (2019) 209, figure 1; it agrees with Qiskit to
//! 1e-15). `P(2x)` over `[0, pi]` is a full turn, so inputs 0 and pi of one qubit coincide up to `w`.

use std::f64::consts::PI;

use super::sin_cos;

/// Expectations of the circuit at one point and all their gradients.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CircuitPoint {
    /// `[<ZI>, <IZ>]`: Z on qubit 1 and Z on qubit 0.
    pub expectations: [f64; 2],
    /// Derivatives of the expectations by the angles, `[observable][angle]`.
    pub by_theta: [[f64; 4]; 2],
    /// Derivatives of the expectations by the inputs, `[observable][input]`.
    pub by_x: [[f64; 2]; 2],
}

/// Coefficients of the features a, b, c, d, e in `[<ZI>, <IZ>]`.
type Coefficients = [[f64; 5]; 2];

fn coefficients(angles: [(f64, f64); 4]) -> Coefficients {
    let [(s0, c0), (s1, c1), (s2, c2), (s3, c3)] = angles;
    [
        [c3 * c0 * s1, c3 * s0 * c1, c3 * s0 * s1, -s3 * c1, 0.0],
        [s2 * s0 * c1, s2 * c0 * s1, -s2 * c0 * c1, 0.0, -c2 * s0],
    ]
}

/// Coefficients of the expectations at fixed trained angles, for many inputs.
#[derive(Debug, Clone, Copy)]
pub struct ClosedForm {
    coefficients: Coefficients,
    /// Derivatives of the coefficients by each angle.
    by_angle: [Coefficients; 4],
}

impl ClosedForm {
    /// Computes the coefficients at these angles (radians).
    pub fn new(theta: [f64; 4]) -> Self {
        let angles = theta.map(f64::sin_cos);
        // Each coefficient depends on each angle once or not at all, so parameter shift gives its derivative, and an exact zero
        // where there is no dependence.
        let by_angle = std::array::from_fn(|k| {
            let (s, c) = angles[k];
            let (mut plus, mut minus) = (angles, angles);
            (plus[k], minus[k]) = ((c, -s), (-c, s));
            let (plus, minus) = (coefficients(plus), coefficients(minus));
            std::array::from_fn(|o| std::array::from_fn(|f| 0.5 * (plus[o][f] - minus[o][f])))
        });
        ClosedForm { coefficients: coefficients(angles), by_angle }
    }

    /// Expectations and exact gradients at input `x` (radians).
    pub fn evaluate(&self, x: [f64; 2]) -> CircuitPoint {
        let (features, by_x) = features(x);
        CircuitPoint {
            expectations: self.coefficients.map(|c| dot(&c, &features)),
            by_theta: [0, 1].map(|o| self.by_angle.map(|by| dot(&by[o], &features))),
            by_x: self.coefficients.map(|c| by_x.map(|f| dot(&c, &f))),
        }
    }

    /// Gradient by the angles, given for each observable the sum over samples of cotangent times features.
    fn gradient(&self, sums: &Coefficients) -> [f64; 4] {
        self.by_angle.map(|by| (0..2).map(|o| dot(&by[o], &sums[o])).sum())
    }
}

#[inline(always)]
fn dot(a: &[f64; 5], b: &[f64; 5]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3] + a[4] * b[4]
}

/// Sines and cosines of `2 x0`, `2 x1` and `w`.
type SinesCosines = [(f64, f64); 3];

#[inline(always)]
fn arguments([x0, x1]: [f64; 2]) -> [f64; 3] {
    [2.0 * x0, 2.0 * x1, 2.0 * (PI - x0) * (PI - x1)]
}

#[inline(always)]
fn features_from([(s0, c0), (s1, c1), (sw, cw)]: SinesCosines) -> [f64; 5] {
    [s1 * sw, s0 * sw, c0 * c1, c1 * cw, c0 * cw]
}

/// Derivatives of the features by x0 and x1.
#[inline(always)]
fn feature_gradients([x0, x1]: [f64; 2], [(s0, c0), (s1, c1), (sw, cw)]: SinesCosines) -> [[f64; 5]; 2] {
    let (w0, w1) = (-2.0 * (PI - x1), -2.0 * (PI - x0)); // dw/dx0, dw/dx1
    [
        [s1 * cw * w0, 2.0 * c0 * sw + s0 * cw * w0, -2.0 * s0 * c1, -c1 * sw * w0, -2.0 * s0 * cw - c0 * sw * w0],
        [2.0 * c1 * sw + s1 * cw * w1, s0 * cw * w1, -2.0 * c0 * s1, -2.0 * s1 * cw - c1 * sw * w1, -c0 * sw * w1],
    ]
}

/// The features at input `x`, and their derivatives by x0 and x1.
pub(crate) fn features(x: [f64; 2]) -> ([f64; 5], [[f64; 5]; 2]) {
    let sines_cosines = arguments(x).map(f64::sin_cos);
    (features_from(sines_cosines), feature_gradients(x, sines_cosines))
}

/// `[<ZI>, <IZ>]` alone.
pub fn expectations(x: [f64; 2], theta: [f64; 4]) -> [f64; 2] {
    let features = features_from(arguments(x).map(f64::sin_cos));
    coefficients(theta.map(f64::sin_cos)).map(|c| dot(&c, &features))
}

/// Expectations and exact gradients at input `x` (radians, in `[0, pi]` in the HQNN) and angles `theta` (radians).
pub fn circuit(x: [f64; 2], theta: [f64; 4]) -> CircuitPoint {
    ClosedForm::new(theta).evaluate(x)
}

/// Samples that a vector loop takes at once.
const LANES: usize = 32;

/// Sines and cosines of up to [`LANES`] samples.
#[inline(always)]
fn sines_cosines(x: &[[f64; 2]; LANES]) -> [[[f64; LANES]; 2]; 3] {
    let mut sines_cosines = [[[0.0; LANES]; 2]; 3];
    for (k, [sines, cosines]) in sines_cosines.iter_mut().enumerate() {
        let mut angles = [0.0; LANES];
        angles.iter_mut().zip(x).for_each(|(angle, &x)| *angle = arguments(x)[k]);
        sin_cos::sin_cos(&angles, sines, cosines);
    }
    sines_cosines
}

#[inline(always)]
fn lane(sines_cosines: &[[[f64; LANES]; 2]; 3], lane: usize) -> SinesCosines {
    [
        (sines_cosines[0][0][lane], sines_cosines[0][1][lane]),
        (sines_cosines[1][0][lane], sines_cosines[1][1][lane]),
        (sines_cosines[2][0][lane], sines_cosines[2][1][lane]),
    ]
}

/// The first samples of `rows` in f64, zeros beyond.
#[inline(always)]
fn widen(rows: &[[f32; 2]]) -> [[f64; 2]; LANES] {
    let mut wide = [[0.0; 2]; LANES];
    wide.iter_mut().zip(rows).for_each(|(wide, row)| *wide = row.map(f64::from));
    wide
}

/// Compiles a function of slices once for each instruction set, and calls the version of the widest one that the processor
/// has. Multiply and add are not fused, so all versions give the same result.
macro_rules! vectorised {
    ($(#[$doc:meta])* $vis:vis fn $name:ident($($arg:ident: $type:ty),* $(,)?) $(-> $ret:ty)? $body:block) => {
        $(#[$doc])*
        $vis fn $name($($arg: $type),*) $(-> $ret)? {
            $crate::kernel::level::for_each_level! { fn at_level($($arg: $type),*) $(-> $ret)? $body }
            at_level($crate::kernel::KernelLevel::detect(), $($arg),*)
        }
    };
}
pub(super) use vectorised;

vectorised! {
    /// Writes `[<ZI>, <IZ>]` of each of `x` into `result`, which has the same length.
    pub fn expectations_of_rows(closed_form: &ClosedForm, x: &[[f32; 2]], result: &mut [[f32; 2]]) {
        for (x, result) in x.chunks(LANES).zip(result.chunks_mut(LANES)) {
            let sines_cosines = sines_cosines(&widen(x));
            let mut values = [[0.0f32; 2]; LANES];
            for (l, value) in values.iter_mut().enumerate() {
                let features = features_from(lane(&sines_cosines, l));
                *value = [0, 1].map(|o| dot(&closed_form.coefficients[o], &features) as f32);
            }
            result.copy_from_slice(&values[..result.len()]);
        }
    }
}

vectorised! {
    /// Writes the gradients by each of `x` into `by_x`, and returns the gradient by the angles, summed over rows.
    /// `cotangents` are the gradients of a loss by the expectations.
    pub fn gradients_of_rows(
        closed_form: &ClosedForm,
        x: &[[f32; 2]],
        cotangents: &[[f32; 2]],
        by_x: &mut [[f32; 2]],
    ) -> [f64; 4] {
        let mut sums = [[[0.0; LANES]; 5]; 2];
        for ((x, cotangents), by_x) in x.chunks(LANES).zip(cotangents.chunks(LANES)).zip(by_x.chunks_mut(LANES)) {
            let (x, cotangents) = (widen(x), widen(cotangents));
            let sines_cosines = sines_cosines(&x);
            let mut gradients = [[0.0f32; 2]; LANES];
            for l in 0..LANES {
                let sines_cosines = lane(&sines_cosines, l);
                let (features, [by_x0, by_x1]) = (features_from(sines_cosines), feature_gradients(x[l], sines_cosines));
                let mut mixed = [0.0; 5];
                for f in 0..5 {
                    for o in 0..2 {
                        sums[o][f][l] += cotangents[l][o] * features[f];
                        mixed[f] += cotangents[l][o] * closed_form.coefficients[o][f];
                    }
                }
                gradients[l] = [dot(&mixed, &by_x0) as f32, dot(&mixed, &by_x1) as f32];
            }
            by_x.copy_from_slice(&gradients[..by_x.len()]);
        }
        closed_form.gradient(&sums.map(|o| o.map(|lanes| lanes.iter().sum())))
    }
}
