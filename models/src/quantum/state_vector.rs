//! The same circuit gate by gate on a vector of four amplitudes: slow, obvious, f64. Gradients by parameter shift.

use num_complex::Complex64;
use std::f64::consts::{FRAC_1_SQRT_2, FRAC_PI_2, PI};

/// Amplitudes of two qubits; index is `2 q1 + q0` (Qiskit's little-endian order).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct State([Complex64; 4]);

impl State {
    /// |00>.
    pub fn zero() -> Self {
        let o = Complex64::ZERO;
        State([Complex64::ONE, o, o, o])
    }

    /// Amplitudes at `2 q1 + q0`.
    pub fn amplitudes(&self) -> [Complex64; 4] {
        self.0
    }

    /// Applies a 2x2 unitary to one qubit (0 or 1).
    fn single(self, qubit: Qubit, u: [[Complex64; 2]; 2]) -> Self {
        let [a, b, c, d] = self.0;
        let rotate = |p: Complex64, q: Complex64| (u[0][0] * p + u[0][1] * q, u[1][0] * p + u[1][1] * q);
        match qubit {
            Qubit::Zero => {
                let ((a, b), (c, d)) = (rotate(a, b), rotate(c, d));
                State([a, b, c, d])
            }
            Qubit::One => {
                let ((a, c), (b, d)) = (rotate(a, c), rotate(b, d));
                State([a, b, c, d])
            }
        }
    }

    fn hadamard(self, qubit: Qubit) -> Self {
        let h = Complex64::from(FRAC_1_SQRT_2);
        self.single(qubit, [[h, h], [h, -h]])
    }

    fn phase(self, qubit: Qubit, angle: f64) -> Self {
        let o = Complex64::ZERO;
        self.single(qubit, [[Complex64::ONE, o], [o, Complex64::cis(angle)]])
    }

    fn ry(self, qubit: Qubit, angle: f64) -> Self {
        let (s, c) = (0.5 * angle).sin_cos();
        let (s, c) = (Complex64::from(s), Complex64::from(c));
        self.single(qubit, [[c, -s], [s, c]])
    }

    /// Control qubit 0, target qubit 1: exchanges |01> and |11>.
    fn cx(self) -> Self {
        let [a, b, c, d] = self.0;
        State([a, d, c, b])
    }

    /// Probabilities of the four outcomes, index `2 q1 + q0`.
    pub fn probabilities(&self) -> [f64; 4] {
        self.0.map(|z| z.norm_sqr())
    }

    /// `[<ZI>, <IZ>]`.
    pub fn expectations(&self) -> [f64; 2] {
        let [p00, p01, p10, p11] = self.probabilities();
        [p00 + p01 - p10 - p11, p00 - p01 + p10 - p11]
    }
}

#[derive(Clone, Copy)]
enum Qubit {
    Zero,
    One,
}

/// State at the end of the circuit, before measurement.
pub fn run(x: [f64; 2], theta: [f64; 4]) -> State {
    use Qubit::{One, Zero};
    State::zero()
        .hadamard(Zero)
        .hadamard(One)
        .phase(Zero, 2.0 * x[0])
        .phase(One, 2.0 * x[1])
        .cx()
        .phase(One, 2.0 * (PI - x[0]) * (PI - x[1]))
        .cx()
        .ry(Zero, theta[0])
        .ry(One, theta[1])
        .cx()
        .ry(Zero, theta[2])
        .ry(One, theta[3])
}

/// Gradients of `[<ZI>, <IZ>]` by the four angles, exact by the parameter-shift rule (Mitarai et al., Phys. Rev. A 98
/// (2018) 032309): half the difference at `theta +- pi/2`. `[observable][angle]`.
pub fn parameter_shift(x: [f64; 2], theta: [f64; 4]) -> [[f64; 4]; 2] {
    let mut gradient = [[0.0; 4]; 2];
    for angle in 0..4 {
        let shifted = |by: f64| {
            let mut t = theta;
            t[angle] += by;
            run(x, t).expectations()
        };
        let (plus, minus) = (shifted(FRAC_PI_2), shifted(-FRAC_PI_2));
        for observable in 0..2 {
            gradient[observable][angle] = 0.5 * (plus[observable] - minus[observable]);
        }
    }
    gradient
}
