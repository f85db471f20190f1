//! Reference simulation of any circuit: gate by gate on a state vector in f64, gradients by parameter shift.

use std::f64::consts::{FRAC_1_SQRT_2, FRAC_PI_2};

use num_complex::Complex64;

use super::gates::{Circuit, Gate};
use super::spec::CircuitError;

/// Amplitudes of some qubits; bit `q` of an index is qubit `q` (Qiskit's little-endian order).
#[derive(Debug, Clone, PartialEq)]
pub struct State(pub(super) Vec<Complex64>);

impl State {
    /// All qubits 0.
    pub(super) fn zero(qubits: usize) -> Self {
        let mut amplitudes = vec![Complex64::ZERO; 1 << qubits];
        amplitudes[0] = Complex64::ONE;
        State(amplitudes)
    }

    /// Replaces each pair of amplitudes that differ in this qubit, 0 first.
    fn apply_to_qubit(&mut self, qubit: usize, gate: impl Fn(Complex64, Complex64) -> (Complex64, Complex64)) {
        for pair in self.0.chunks_exact_mut(2 << qubit) {
            let (zeros, ones) = pair.split_at_mut(1 << qubit);
            zeros.iter_mut().zip(ones).for_each(|(a, b)| (*a, *b) = gate(*a, *b));
        }
    }

    pub(super) fn hadamard(&mut self, qubit: usize) {
        self.apply_to_qubit(qubit, |a, b| ((a + b) * FRAC_1_SQRT_2, (a - b) * FRAC_1_SQRT_2));
    }

    pub(super) fn phase(&mut self, qubit: usize, angle: f64) {
        let turn = Complex64::cis(angle);
        self.apply_to_qubit(qubit, |a, b| (a, turn * b));
    }

    pub(super) fn rotation_y(&mut self, qubit: usize, angle: f64) {
        let (s, c) = (0.5 * angle).sin_cos();
        self.apply_to_qubit(qubit, |a, b| (a * c - b * s, a * s + b * c));
    }

    /// Flips the target where the control, the lower qubit, is 1.
    pub(super) fn controlled_not(&mut self, control: usize, target: usize) {
        for pair in self.0.chunks_exact_mut(2 << target) {
            let (zeros, ones) = pair.split_at_mut(1 << target);
            for (zeros, ones) in zeros.chunks_exact_mut(2 << control).zip(ones.chunks_exact_mut(2 << control)) {
                zeros[1 << control..].swap_with_slice(&mut ones[1 << control..]);
            }
        }
    }

    pub(super) fn apply(&mut self, gate: Gate, angles: &[f64]) {
        match gate {
            Gate::Hadamard { qubit } => self.hadamard(qubit),
            Gate::Phase { qubit, angle } => self.phase(qubit, angles[angle]),
            Gate::RotationY { qubit, angle } => self.rotation_y(qubit, angles[angle]),
            Gate::ControlledNot { control, target } => self.controlled_not(control, target),
        }
    }

    /// Probability of each outcome.
    #[cfg(test)]
    pub fn probabilities(&self) -> Vec<f64> {
        self.0.iter().map(|z| z.norm_sqr()).collect()
    }

    /// `<Z>` of each qubit, the highest first.
    #[cfg(test)]
    pub fn expectations(&self) -> Vec<f64> {
        z_expectations(&self.probabilities())
    }
}

/// `<Z>` of each qubit, the highest first, from the probabilities of all outcomes. After each qubit, the probabilities are summed
/// over it.
pub(super) fn z_expectations(probabilities: &[f64]) -> Vec<f64> {
    let (mut remaining, mut expectations) = (probabilities.to_vec(), Vec::new());
    while remaining.len() > 1 {
        let (zeros, ones) = remaining.split_at(remaining.len() / 2);
        expectations.push(zeros.iter().sum::<f64>() - ones.iter().sum::<f64>());
        remaining = zeros.iter().zip(ones).map(|(a, b)| a + b).collect();
    }
    expectations
}

/// State at the end of the circuit at inputs `x` and angles `theta`, before the measurement, without noise and shots.
///
/// # Errors
/// [`CircuitError::Count`] if the number of inputs or of angles is not the circuit's.
#[cfg(test)]
pub fn run(circuit: &Circuit, x: &[f64], theta: &[f64]) -> Result<State, CircuitError> {
    circuit.check_counts(x, theta)?;
    Ok(run_at(circuit, &circuit.gate_angles(x, theta)))
}

/// State at the end of the circuit at these angles of all rotation gates.
#[cfg(test)]
pub(super) fn run_at(circuit: &Circuit, angles: &[f64]) -> State {
    let mut state = State::zero(circuit.qubits());
    for &gate in circuit.gates.iter() {
        state.apply(gate, angles);
    }
    state
}

impl Circuit {
    /// The trained part of the circuit at angles `theta`, a real orthogonal matrix `[from][to]` over the `2^qubits`
    /// basis states: row `k` is the image of state `k`.
    ///
    /// # Errors
    /// [`CircuitError::Count`] if the number of angles is not the circuit's.
    pub fn trained_matrix(&self, theta: &[f64]) -> Result<Vec<f64>, CircuitError> {
        let zero_inputs = vec![0.0; self.qubits()];
        self.check_counts(&zero_inputs, theta)?;
        let angles = self.gate_angles(&zero_inputs, theta);
        let entanglers = self.spec.depth * self.qubits() * (self.qubits() - 1) / 2;
        let encoding = self.gates.len() - entanglers - self.angle_count();
        let mut matrix = Vec::with_capacity(1 << (2 * self.qubits()));
        for from in 0..1usize << self.qubits() {
            let mut state = State(vec![Complex64::ZERO; 1 << self.qubits()]);
            state.0[from] = Complex64::ONE;
            self.gates.iter().skip(encoding).for_each(|&gate| state.apply(gate, &angles));
            matrix.extend(state.0.iter().map(|amplitude| amplitude.re));
        }
        Ok(matrix)
    }
}

/// Derivatives of the result of `run` by the angle of each rotation gate, `[observable][gate]`: half the difference at
/// `+- pi/2`. This is exact for gates with two eigenvalues (Mitarai et al., Phys. Rev. A 98 (2018) 032309), through any
/// linear noise that follows them.
pub(super) fn parameter_shift(angles: &[f64], mut run: impl FnMut(&[f64]) -> Vec<f64>) -> Vec<Vec<f64>> {
    let (mut shifted, mut jacobian) = (angles.to_vec(), Vec::new());
    for (gate, &angle) in angles.iter().enumerate() {
        shifted[gate] = angle + FRAC_PI_2;
        let plus = run(&shifted);
        shifted[gate] = angle - FRAC_PI_2;
        let minus = run(&shifted);
        shifted[gate] = angle;
        jacobian.resize_with(plus.len(), Vec::new);
        for (row, (plus, minus)) in jacobian.iter_mut().zip(plus.iter().zip(&minus)) {
            row.push(0.5 * (plus - minus));
        }
    }
    jacobian
}
