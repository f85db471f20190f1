//! Settings of the quantum layer, as files hold them, and their checks.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

// The documentation of `CircuitSpec`, which schemas hold, repeats these numbers.
/// Largest number of qubits of a circuit.
pub const MOST_QUBITS: usize = 12;
/// Largest number of qubits of a circuit with depolarising gates: its density matrix has `4^qubits` entries.
pub const MOST_DEPOLARISED_QUBITS: usize = 6;
/// Largest number of repetitions of the trained part.
pub const MOST_DEPTH: usize = 1000;

/// A circuit that encodes one input a qubit, turns it by trained angles and measures Z on each qubit.
///
/// The default is the paper's: two qubits, ZZ feature map and RealAmplitudes, one repetition each, exact.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct CircuitSpec {
    /// Qubits, 1 to 12, with errors of gates 1 to 6; also the number of inputs and of outputs.
    pub qubits: usize,
    /// Encoding of inputs as a state.
    pub encoding: Encoding,
    /// Repetitions of the ZZ feature map, 1 or 2; 1 with angle encoding.
    pub repetitions: usize,
    /// Repetitions of RealAmplitudes, 0 to 1000; each but the last layer of turns is followed by an entangler.
    pub depth: usize,
    /// Exact expectations or measured ones.
    pub execution: Execution,
    /// Errors of gates and of the measurement.
    pub noise: Noise,
}

impl Default for CircuitSpec {
    fn default() -> Self {
        CircuitSpec {
            qubits: 2,
            encoding: Encoding::ZzFeatureMap,
            repetitions: 1,
            depth: 1,
            execution: Execution::Exact,
            noise: Noise::default(),
        }
    }
}

/// Encoding of inputs as a state.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Encoding {
    /// Qiskit's ZZFeatureMap with full entanglement (Havlicek et al., Nature 567 (2019) 209): H on each qubit, P(2 x_i),
    /// and for each pair P(2 (pi - x_i)(pi - x_j)) between two CX.
    ZzFeatureMap,
    /// RY(x_i) on each qubit.
    Angle,
}

/// Source of expectations.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Execution {
    /// The expectations themselves.
    Exact,
    /// Means over a finite number of measurements of all qubits.
    Shots(Shots),
}

/// Measurements.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Shots {
    /// Measurements of each circuit that is run, at least 1.
    pub count: u32,
    /// Seed of their outcomes.
    #[serde(default)]
    pub seed: u64,
    /// Source of gradients.
    #[serde(default)]
    pub gradient: ShotGradient,
}

/// Gradients of measured expectations.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ShotGradient {
    /// Parameter shift from separate shots, as on hardware: two runs of `count` shots for each rotation gate.
    #[default]
    Shots,
    /// The gradients of the exact expectations.
    Exact,
}

/// Errors of gates and of the measurement, none by default.
///
/// A depolarising gate of strength `p` replaces the state of the qubits that it acts on by the maximally mixed one with
/// probability `p` (Qiskit's `depolarizing_error`): `rho -> (1 - p) rho + p I / d`.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Noise {
    /// Strength after each gate on one qubit (H, P, RY), 0 to 1.
    pub depolarising_one_qubit: f64,
    /// Strength after each gate on two qubits (CX), 0 to 1.
    pub depolarising_two_qubit: f64,
    /// Probability that a qubit's outcome is read inverted, 0 to 1.
    pub readout_flip: f64,
}

impl Noise {
    /// Returns whether gates have errors, which need a density matrix. Readout errors alone do not.
    pub fn is_depolarising(&self) -> bool {
        self.depolarising_one_qubit > 0.0 || self.depolarising_two_qubit > 0.0
    }
}

/// Error of a circuit's settings or of its inputs.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[allow(missing_docs, reason = "the message says what each field is")]
pub enum CircuitError {
    /// A setting is out of range.
    #[error("circuit: {key} is {value}, expected {expected}")]
    Setting { key: &'static str, value: String, expected: String },
    /// The number of inputs, angles or cotangents is not the circuit's.
    #[error("circuit: expected {expected} {what}, got {got}")]
    Count { what: &'static str, expected: usize, got: usize },
}

impl CircuitSpec {
    /// Number of trained angles: one for each qubit in each of `depth + 1` layers.
    pub fn angle_count(&self) -> usize {
        self.qubits.saturating_mul(self.depth.saturating_add(1))
    }

    /// Names of the outputs in their order, as Qiskit prints Pauli strings: qubit 0 is the rightmost letter, and the
    /// first output is Z on the highest qubit.
    pub fn observables(&self) -> Vec<String> {
        let letters = self.qubits.min(MOST_QUBITS);
        (0..letters).map(|o| (0..letters).map(|k| if k == o { 'Z' } else { 'I' }).collect()).collect()
    }

    /// Checks all settings.
    ///
    /// # Errors
    /// [`CircuitError::Setting`] for the first setting that is out of range.
    pub fn check(&self) -> Result<(), CircuitError> {
        let require = |fits: bool, key: &'static str, value: &dyn std::fmt::Display, expected: &str| match fits {
            true => Ok(()),
            false => Err(CircuitError::Setting { key, value: value.to_string(), expected: expected.to_owned() }),
        };
        require((1..=MOST_QUBITS).contains(&self.qubits), "qubits", &self.qubits, &format!("1 to {MOST_QUBITS}"))?;
        let (most, expected) = match self.encoding {
            Encoding::ZzFeatureMap => (2, "1 or 2"),
            Encoding::Angle => (1, "1 with angle encoding"),
        };
        require((1..=most).contains(&self.repetitions), "repetitions", &self.repetitions, expected)?;
        require(self.depth <= MOST_DEPTH, "depth", &self.depth, &format!("0 to {MOST_DEPTH}"))?;
        if let Execution::Shots(shots) = self.execution {
            require(shots.count > 0, "shots", &shots.count, "at least 1")?;
        }
        for (key, p) in [
            ("depolarising_one_qubit", self.noise.depolarising_one_qubit),
            ("depolarising_two_qubit", self.noise.depolarising_two_qubit),
            ("readout_flip", self.noise.readout_flip),
        ] {
            require((0.0..=1.0).contains(&p), key, &p, "a probability, 0 to 1")?;
        }
        let expected = format!(
            "at most {MOST_DEPOLARISED_QUBITS} with depolarising gates, which take a density matrix of 4^qubits entries\n\n\
             hint: use fewer qubits, or errors of the readout alone"
        );
        let fits = !self.noise.is_depolarising() || self.qubits <= MOST_DEPOLARISED_QUBITS;
        require(fits, "qubits", &self.qubits, &expected)
    }
}
