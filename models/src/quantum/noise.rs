//! Exact simulation of circuits with gate errors, by density matrix.
//!
//! A density matrix of `n` qubits is kept as a [`State`] of `2n` qubits: bit `q` of an index is bit `q` of the column,
//! and bit `q + n` is bit `q` of the row. A gate acts on both, conjugated on the column; a depolarising channel mixes
//! them.

use std::f64::consts::FRAC_PI_2;

use num_complex::Complex64;

use super::gates::{Circuit, Gate};
use super::spec::Noise;
use super::state_vector::State;

/// A density matrix, or an observable.
#[derive(Debug, Clone)]
pub(super) struct Density {
    qubits: usize,
    entries: State,
}

impl Density {
    /// A diagonal matrix.
    fn diagonal(qubits: usize, values: impl IntoIterator<Item = f64>) -> Self {
        let mut entries = State::zero(2 * qubits);
        for (k, value) in values.into_iter().take(1 << qubits).enumerate() {
            entries.0[k << qubits | k] = value.into();
        }
        Density { qubits, entries }
    }

    /// Probability of each outcome.
    fn probabilities(&self) -> Vec<f64> {
        (0..1 << self.qubits).map(|k| self.entries.0[k << self.qubits | k].re).collect()
    }

    /// Applies the gate, with `angle` if it is a rotation.
    fn apply(&mut self, gate: Gate, angle: f64) {
        let n = self.qubits;
        match gate {
            Gate::Hadamard { qubit } => [qubit, qubit + n].map(|q| self.entries.hadamard(q)),
            Gate::Phase { qubit, .. } => [(qubit, -angle), (qubit + n, angle)].map(|(q, a)| self.entries.phase(q, a)),
            Gate::RotationY { qubit, .. } => [qubit, qubit + n].map(|q| self.entries.rotation_y(q, angle)),
            Gate::ControlledNot { control, target } => {
                [(control, target), (control + n, target + n)].map(|(c, t)| self.entries.controlled_not(c, t))
            }
        };
    }

    /// Depolarising channel behind the gate: `rho -> (1 - p) rho + p I / d` on its qubits. It is its own adjoint.
    fn depolarise(&mut self, gate: Gate, noise: &Noise) {
        let (p, qubits) = match gate {
            Gate::Hadamard { qubit } | Gate::Phase { qubit, .. } | Gate::RotationY { qubit, .. } => {
                (noise.depolarising_one_qubit, [Some(qubit), None])
            }
            Gate::ControlledNot { control, target } => (noise.depolarising_two_qubit, [Some(control), Some(target)]),
        };
        if p > 0.0 {
            let mut mixed = self.clone();
            qubits.into_iter().flatten().for_each(|qubit| mixed.mix(qubit));
            for (entry, mixed) in self.entries.0.iter_mut().zip(mixed.entries.0) {
                *entry = *entry * (1.0 - p) + mixed * p;
            }
        }
    }

    /// Replaces a qubit by the maximally mixed state: entries with equal row and column bit become their mean, the others zero.
    fn mix(&mut self, qubit: usize) {
        for rows in self.entries.0.chunks_exact_mut(2 << (qubit + self.qubits)) {
            let (row0, row1) = rows.split_at_mut(1 << (qubit + self.qubits));
            for (row0, row1) in row0.chunks_exact_mut(2 << qubit).zip(row1.chunks_exact_mut(2 << qubit)) {
                let ((same0, other0), (other1, same1)) = (row0.split_at_mut(1 << qubit), row1.split_at_mut(1 << qubit));
                for (a, b) in same0.iter_mut().zip(same1) {
                    (*a, *b) = ((*a + *b) * 0.5, (*a + *b) * 0.5);
                }
                other0.fill(Complex64::ZERO);
                other1.fill(Complex64::ZERO);
            }
        }
    }

    /// `Re tr(self^dagger other)`.
    fn overlap(&self, other: &Density) -> f64 {
        self.entries.0.iter().zip(&other.entries.0).map(|(a, b)| a.re * b.re + a.im * b.im).sum()
    }
}

fn angle_of(gate: Gate, angles: &[f64]) -> Option<(usize, f64)> {
    match gate {
        Gate::Phase { angle, .. } | Gate::RotationY { angle, .. } => Some((angle, angles[angle])),
        Gate::Hadamard { .. } | Gate::ControlledNot { .. } => None,
    }
}

fn apply_with_noise(circuit: &Circuit, rho: &mut Density, gate: Gate, angle: f64) {
    rho.apply(gate, angle);
    rho.depolarise(gate, &circuit.spec.noise);
}

/// Probability of each outcome before it is read.
pub(super) fn probabilities(circuit: &Circuit, angles: &[f64]) -> Vec<f64> {
    let mut rho = Density::diagonal(circuit.qubits(), [1.0]);
    for &gate in circuit.gates.iter() {
        apply_with_noise(circuit, &mut rho, gate, angle_of(gate, angles).map_or(0.0, |(_, angle)| angle));
    }
    rho.probabilities()
}

/// Gradient by the angle of each rotation gate of the expectations' sum weighted by `cotangent`, by parameter shift. It
/// is exact because channels are linear. Gates behind a shifted gate are not run again: the observable is propagated
/// back to it.
pub(super) fn gradient(circuit: &Circuit, angles: &[f64], cotangent: &[f64]) -> Vec<f64> {
    let qubits = circuit.qubits();
    // State before each rotation gate: 64 KiB each with six qubits.
    let mut before = Vec::with_capacity(angles.len());
    let mut rho = Density::diagonal(qubits, [1.0]);
    for &gate in circuit.gates.iter() {
        let rotation = angle_of(gate, angles);
        if rotation.is_some() {
            before.push(rho.clone());
        }
        apply_with_noise(circuit, &mut rho, gate, rotation.map_or(0.0, |(_, angle)| angle));
    }
    let weight = |k: usize| {
        let signed = |(o, g): (usize, &f64)| if k >> (qubits - 1 - o) & 1 == 0 { *g } else { -g };
        cotangent.iter().enumerate().map(signed).sum()
    };
    let mut observable = Density::diagonal(qubits, (0..1 << qubits).map(weight));
    let mut gradient = vec![0.0; angles.len()];
    for &gate in circuit.gates.iter().rev() {
        observable.depolarise(gate, &circuit.spec.noise);
        let rotation = angle_of(gate, angles);
        if let Some((index, angle)) = rotation
            && let Some(before) = before.pop()
        {
            let shifted = |by: f64| {
                let mut after = before.clone();
                after.apply(gate, angle + by);
                observable.overlap(&after)
            };
            gradient[index] = 0.5 * (shifted(FRAC_PI_2) - shifted(-FRAC_PI_2));
        }
        // H and CX are their own inverses.
        observable.apply(gate, rotation.map_or(0.0, |(_, angle)| -angle));
    }
    gradient
}

/// Probabilities of the outcomes that are read, where each qubit's outcome is inverted with probability `flip`.
pub(super) fn read_out(probabilities: &mut [f64], flip: f64) {
    let mut bit = 1;
    while flip > 0.0 && bit < probabilities.len() {
        for low in (0..probabilities.len()).filter(|k| k & bit == 0) {
            let (zero, one) = (probabilities[low], probabilities[low | bit]);
            probabilities[low] = (1.0 - flip) * zero + flip * one;
            probabilities[low | bit] = flip * zero + (1.0 - flip) * one;
        }
        bit <<= 1;
    }
}
