//! The two-qubit circuit of the HQNN in closed form: ZZFeatureMap and RealAmplitudes, one repetition each, full
//! entanglement, measured in `<ZI>` and `<IZ>`.
//!
//! # Conventions
//! Qiskit's: qubit 0 is the rightmost letter of a Pauli string, so `zi` is Z on **qubit 1** (which encodes `x[1]`) and
//! `iz` is Z on qubit 0. `theta` is in circuit order: RY(theta0) on qubit 0, RY(theta1) on qubit 1, CX(0 -> 1),
//! RY(theta2) on qubit 0, RY(theta3) on qubit 1.
//!
//! # Formula
//! With `w = 2 (pi - x0)(pi - x1)`, both expectations are linear in five trigonometric features of the input,
//! ```text
//! a = sin 2x1 sin w   b = sin 2x0 sin w   c = cos 2x0 cos 2x1   d = cos 2x1 cos w   e = cos 2x0 cos w
//! <ZI> = cos t3 [cos t0 sin t1 a + sin t0 cos t1 b + sin t0 sin t1 c] - sin t3 cos t1 d
//! <IZ> = -cos t2 sin t0 e - sin t2 [cos t0 cos t1 c - cos t0 sin t1 b - sin t0 cos t1 a]
//! ```
//! (derived by hand from the circuit of Havlicek et al., Nature 567 (2019) 209, figure 1; it agrees with Qiskit to
//! 1e-15). `P(2x)` over `[0, pi]` is a full turn, so inputs 0 and pi of one qubit coincide up to `w`.
//!
//! [`state_vector`] holds the slow obvious simulation and the parameter-shift gradients that this is tested against.

pub mod shots;
pub mod state_vector;
#[cfg(test)]
mod tests;

/// Expectations of the circuit at one point and all their gradients.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct CircuitPoint<T = f64> {
    /// <ZI>: Z on qubit 1.
    pub zi: T,
    /// <IZ>: Z on qubit 0.
    pub iz: T,
    /// d<ZI>/dtheta.
    pub zi_grad_theta: [T; 4],
    /// d<IZ>/dtheta.
    pub iz_grad_theta: [T; 4],
    /// d<ZI>/dx.
    pub zi_grad_x: [T; 2],
    /// d<IZ>/dx.
    pub iz_grad_x: [T; 2],
}

macro_rules! closed_form {
    ($float:ident, $circuit:ident, $expectations:ident, $circuit_doc:literal, $expectations_doc:literal) => {
        #[doc = $expectations_doc]
        pub fn $expectations(x: [$float; 2], theta: [$float; 4]) -> [$float; 2] {
            let [x0, x1] = x;
            let pi = std::$float::consts::PI;
            let (sw, cw) = (2.0 * (pi - x0) * (pi - x1)).sin_cos();
            let (s0x, c0x) = (2.0 * x0).sin_cos();
            let (s1x, c1x) = (2.0 * x1).sin_cos();
            let [(s0, c0), (s1, c1), (s2, c2), (s3, c3)] = theta.map($float::sin_cos);
            let (a, b, c, d, e) = (s1x * sw, s0x * sw, c0x * c1x, c1x * cw, c0x * cw);
            [
                c3 * (c0 * s1 * a + s0 * c1 * b + s0 * s1 * c) - s3 * c1 * d,
                -c2 * s0 * e - s2 * (c0 * c1 * c - c0 * s1 * b - s0 * c1 * a),
            ]
        }

        #[doc = $circuit_doc]
        pub fn $circuit(x: [$float; 2], theta: [$float; 4]) -> CircuitPoint<$float> {
            let [x0, x1] = x;
            let pi = std::$float::consts::PI;
            let (sw, cw) = (2.0 * (pi - x0) * (pi - x1)).sin_cos();
            let (w0, w1) = (-2.0 * (pi - x1), -2.0 * (pi - x0)); // dw/dx0, dw/dx1
            let (s0x, c0x) = (2.0 * x0).sin_cos();
            let (s1x, c1x) = (2.0 * x1).sin_cos();
            let [(s0, c0), (s1, c1), (s2, c2), (s3, c3)] = theta.map($float::sin_cos);

            // The features and their derivatives by x0 and x1.
            let (a, a0, a1) = (s1x * sw, s1x * cw * w0, 2.0 * c1x * sw + s1x * cw * w1);
            let (b, b0, b1) = (s0x * sw, 2.0 * c0x * sw + s0x * cw * w0, s0x * cw * w1);
            let (c, c_0, c_1) = (c0x * c1x, -2.0 * s0x * c1x, -2.0 * c0x * s1x);
            let (d, d0, d1) = (c1x * cw, -c1x * sw * w0, -2.0 * s1x * cw - c1x * sw * w1);
            let (e, e0, e1) = (c0x * cw, -2.0 * s0x * cw - c0x * sw * w0, -c0x * sw * w1);

            let zi_of = |a: $float, b: $float, c: $float, d: $float| {
                c3 * (c0 * s1 * a + s0 * c1 * b + s0 * s1 * c) - s3 * c1 * d
            };
            let iz_of = |a: $float, b: $float, c: $float, e: $float| {
                -c2 * s0 * e - s2 * (c0 * c1 * c - c0 * s1 * b - s0 * c1 * a)
            };
            CircuitPoint {
                zi: zi_of(a, b, c, d),
                iz: iz_of(a, b, c, e),
                zi_grad_theta: [
                    c3 * (-s0 * s1 * a + c0 * c1 * b + c0 * s1 * c),
                    c3 * (c0 * c1 * a - s0 * s1 * b + s0 * c1 * c) + s3 * s1 * d,
                    0.0,
                    -s3 * (c0 * s1 * a + s0 * c1 * b + s0 * s1 * c) - c3 * c1 * d,
                ],
                iz_grad_theta: [
                    -c2 * c0 * e - s2 * (-s0 * c1 * c + s0 * s1 * b - c0 * c1 * a),
                    -s2 * (-c0 * s1 * c - c0 * c1 * b + s0 * s1 * a),
                    s2 * s0 * e - c2 * (c0 * c1 * c - c0 * s1 * b - s0 * c1 * a),
                    0.0,
                ],
                zi_grad_x: [zi_of(a0, b0, c_0, d0), zi_of(a1, b1, c_1, d1)],
                iz_grad_x: [iz_of(a0, b0, c_0, e0), iz_of(a1, b1, c_1, e1)],
            }
        }
    };
}

closed_form!(
    f64,
    circuit,
    expectations,
    "Expectations and exact gradients at input `x` (radians, in `[0, pi]` in the HQNN) and angles `theta` (radians).",
    "`[<ZI>, <IZ>]` alone."
);
closed_form!(
    f32,
    circuit_f32,
    expectations_f32,
    "[`circuit`] in single precision.",
    "[`expectations`] in single precision."
);
