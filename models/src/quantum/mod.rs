//! Quantum layer: a circuit that encodes one input per qubit, rotates the qubits by trained angles, and measures Z on each qubit.
//!
//! [`CircuitSpec`] has the settings of a circuit, [`Circuit`] is built from them. The paper's circuit of two qubits has a closed
//! form ([`circuit`], [`expectations`]).
//!
//! # Conventions
//! Qiskit's. Bit `q` of an outcome is qubit `q`, and qubit 0 is the rightmost letter of a Pauli string. Input `x[q]` is
//! encoded on qubit `q`. Outputs are in the order of the strings read from left to right: the first is Z on the
//! **highest** qubit, so that two qubits answer `[<ZI>, <IZ>]` with `zi` on qubit 1. `theta` is in circuit order: RY on
//! qubits 0, 1, ..., entangler, RY on qubits 0, 1, ... again. The entangler is CX on every pair, the lower qubit in
//! control, (0, 1), (0, 2), ..., (1, 2), ...
//!
//! # Files
//! `spec.rs` and `gates.rs` define the circuit. `evaluate.rs` chooses the method: `closed_form.rs`, `layers.rs` (state vector with
//! adjoint gradients) or `noise.rs` (density matrix), each with `shots.rs` for measurements. `state_vector.rs` is the reference
//! simulation, gate by gate with parameter shift, that all methods are tested against.

mod closed_form;
mod evaluate;
mod gates;
mod layers;
mod noise;
mod shots;
mod sin_cos;
mod spec;
pub(crate) mod state_vector;
#[cfg(test)]
mod tests;

pub(crate) use closed_form::features;
pub use closed_form::{CircuitPoint, ClosedForm, circuit, expectations, expectations_of_rows, gradients_of_rows};
pub use evaluate::{Draw, Jacobian};
pub use gates::Circuit;
pub use spec::{
    CircuitError, CircuitSpec, Encoding, Execution, MOST_DEPOLARISED_QUBITS, MOST_DEPTH, MOST_QUBITS, Noise,
    ShotGradient, Shots,
};
