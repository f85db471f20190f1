//! Circuit as a list of gates, each with the value that its angle depends on.

use std::f64::consts::PI;
use std::sync::Arc;

use super::spec::{CircuitError, CircuitSpec, Encoding};

/// One gate. `angle` of a rotation gate is an index of the list of angles ([`Circuit::gate_angles`]).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Gate {
    /// H.
    Hadamard { qubit: usize },
    /// P(angle) = diag(1, e^{i angle}).
    Phase { qubit: usize, angle: usize },
    /// exp(-i angle Y / 2).
    RotationY { qubit: usize, angle: usize },
    /// CX.
    ControlledNot { control: usize, target: usize },
}

/// Layer of gates that [`super::layers`] runs together.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Layer {
    /// H on each qubit.
    Hadamards,
    /// All phases of one repetition of the ZZ feature map. `angle` is the index of the first of their angles: one for
    /// each qubit, then one for each pair.
    Phases { angle: usize },
    /// RY on each qubit; `angle` is the index of the first of their angles.
    Rotations { angle: usize },
    /// CX on each pair.
    Entangler,
}

/// Value that the angle of a gate is computed from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Angle {
    /// `x_i`.
    Input(usize),
    /// `2 x_i`.
    TwiceInput(usize),
    /// `2 (pi - x_i)(pi - x_j)`.
    InputPair(usize, usize),
    /// A trained angle.
    Theta(usize),
}

/// Quantum circuit, built from its settings.
///
/// # Examples
/// ```
/// use radome_models::quantum::{Circuit, CircuitSpec, Draw};
///
/// let circuit = Circuit::new(&CircuitSpec { qubits: 3, ..CircuitSpec::default() })?;
/// let theta = vec![0.1; circuit.angle_count()];
/// let expectations = circuit.expectations(&[0.5, 1.0, 1.5], &theta, Draw::default())?;
/// assert_eq!(expectations.len(), 3);
/// # Ok::<(), radome_models::quantum::CircuitError>(())
/// ```
#[derive(Debug, Clone)]
pub struct Circuit {
    pub(super) spec: CircuitSpec,
    pub(super) gates: Arc<[Gate]>,
    pub(super) layers: Arc<[Layer]>,
    angles: Arc<[Angle]>,
}

/// Pairs of qubits in the order of Qiskit's full entanglement: (0, 1), (0, 2), ... (1, 2), ...
pub(super) fn pairs(qubits: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..qubits).flat_map(move |i| (i + 1..qubits).map(move |j| (i, j)))
}

impl Circuit {
    /// Builds the circuit of these settings.
    ///
    /// # Errors
    /// Those of [`CircuitSpec::check`].
    pub fn new(spec: &CircuitSpec) -> Result<Self, CircuitError> {
        spec.check()?;
        let qubits = spec.qubits;
        let (mut gates, mut layers, mut angles) = (Vec::new(), Vec::new(), Vec::new());
        let rotate = |gates: &mut Vec<Gate>, layers: &mut Vec<Layer>, first: usize| {
            layers.push(Layer::Rotations { angle: first });
            gates.extend((0..qubits).map(|qubit| Gate::RotationY { qubit, angle: first + qubit }));
        };
        match spec.encoding {
            Encoding::ZzFeatureMap => {
                for _ in 0..spec.repetitions {
                    layers.extend([Layer::Hadamards, Layer::Phases { angle: angles.len() }]);
                    gates.extend((0..qubits).map(|qubit| Gate::Hadamard { qubit }));
                    for qubit in 0..qubits {
                        gates.push(Gate::Phase { qubit, angle: angles.len() });
                        angles.push(Angle::TwiceInput(qubit));
                    }
                    for (control, target) in pairs(qubits) {
                        gates.push(Gate::ControlledNot { control, target });
                        gates.push(Gate::Phase { qubit: target, angle: angles.len() });
                        gates.push(Gate::ControlledNot { control, target });
                        angles.push(Angle::InputPair(control, target));
                    }
                }
            }
            Encoding::Angle => {
                rotate(&mut gates, &mut layers, angles.len());
                angles.extend((0..qubits).map(Angle::Input));
            }
        }
        for layer in 0..=spec.depth {
            rotate(&mut gates, &mut layers, angles.len());
            angles.extend((0..qubits).map(|qubit| Angle::Theta(layer * qubits + qubit)));
            if layer < spec.depth {
                layers.push(Layer::Entangler);
                gates.extend(pairs(qubits).map(|(control, target)| Gate::ControlledNot { control, target }));
            }
        }
        Ok(Circuit { spec: spec.clone(), gates: gates.into(), layers: layers.into(), angles: angles.into() })
    }

    /// Settings of the circuit.
    pub fn spec(&self) -> &CircuitSpec {
        &self.spec
    }

    /// Number of qubits, inputs and outputs.
    pub fn qubits(&self) -> usize {
        self.spec.qubits
    }

    /// Number of trained angles.
    pub fn angle_count(&self) -> usize {
        self.spec.angle_count()
    }

    /// Checks the number of inputs and of angles.
    pub(super) fn check_counts(&self, x: &[f64], theta: &[f64]) -> Result<(), CircuitError> {
        let count = |what, expected, got| match expected == got {
            true => Ok(()),
            false => Err(CircuitError::Count { what, expected, got }),
        };
        count("inputs, one for each qubit", self.qubits(), x.len())?;
        count("angles, qubits x (depth + 1)", self.angle_count(), theta.len())
    }

    /// Angle of each rotation gate in its order, at inputs and trained angles of the right numbers.
    pub(super) fn gate_angles(&self, x: &[f64], theta: &[f64]) -> Vec<f64> {
        let angle = |angle: &Angle| match *angle {
            Angle::Input(i) => x[i],
            Angle::TwiceInput(i) => 2.0 * x[i],
            Angle::InputPair(i, j) => 2.0 * (PI - x[i]) * (PI - x[j]),
            Angle::Theta(k) => theta[k],
        };
        self.angles.iter().map(angle).collect()
    }

    /// Gradients by inputs and trained angles from those by the gates' angles (chain rule), summed over gates.
    pub(super) fn pull_back(&self, x: &[f64], by_gate: &[f64]) -> (Vec<f64>, Vec<f64>) {
        let (mut by_x, mut by_theta) = (vec![0.0; self.qubits()], vec![0.0; self.angle_count()]);
        for (angle, gradient) in self.angles.iter().zip(by_gate) {
            match *angle {
                Angle::Input(i) => by_x[i] += gradient,
                Angle::TwiceInput(i) => by_x[i] += 2.0 * gradient,
                Angle::InputPair(i, j) => {
                    by_x[i] -= 2.0 * (PI - x[j]) * gradient;
                    by_x[j] -= 2.0 * (PI - x[i]) * gradient;
                }
                Angle::Theta(k) => by_theta[k] += gradient,
            }
        }
        (by_x, by_theta)
    }
}
