//! Expectations and gradients of any circuit: chooses the method for each.

use super::closed_form;
use super::gates::Circuit;
use super::layers::Workspace;
use super::spec::{CircuitError, CircuitSpec, Execution, ShotGradient, Shots};
use super::state_vector::{parameter_shift, z_expectations};
use super::{noise, shots};
use crate::random::stream;

/// Index of a random draw of measurements. Outcomes of a circuit with shots are a function of the seed, of these two numbers and of
/// the purpose (expectations or gradients). Exact expectations do not depend on it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Draw {
    /// Number of the call.
    pub call: u64,
    /// Row of the batch.
    pub row: u64,
}

impl Draw {
    fn stream(self, seed: u64, purpose: &str) -> rand_xoshiro::Xoshiro256PlusPlus {
        stream(seed, &format!("circuit {purpose} in row {}", self.row), self.call)
    }
}

/// Expectations at one point and all their gradients.
#[derive(Debug, Clone, PartialEq)]
pub struct Jacobian {
    /// `[observable]`, in the order of [`CircuitSpec::observables`].
    pub expectations: Vec<f64>,
    /// `[observable][angle]`
    pub by_theta: Vec<Vec<f64>>,
    /// `[observable][input]`
    pub by_x: Vec<Vec<f64>>,
}

/// Returns whether all numbers are finite. If not, all results are NaN, even those that do not depend on the bad
/// number, so that no caller uses them.
fn are_finite(x: &[f64], theta: &[f64]) -> bool {
    x.iter().chain(theta).all(|v| v.is_finite())
}

impl Circuit {
    /// Returns whether [`closed_form`] applies: to the paper's circuit, exact and without noise.
    pub(crate) fn is_closed_form(&self) -> bool {
        self.spec == CircuitSpec::default()
    }

    fn shots(&self) -> Option<Shots> {
        match self.spec.execution {
            Execution::Exact => None,
            Execution::Shots(shots) => Some(shots),
        }
    }

    /// Exact probability of each outcome, readout errors included; bit `q` of an index is qubit `q`.
    fn probabilities(&self, angles: &[f64]) -> Vec<f64> {
        let mut probabilities = if self.spec.noise.is_depolarising() {
            noise::probabilities(self, angles)
        } else {
            Workspace::run(self, angles).probabilities()
        };
        noise::read_out(&mut probabilities, self.spec.noise.readout_flip);
        probabilities
    }

    /// `<Z>` of each qubit at inputs `x` (radians) and angles `theta` (radians), in the order of
    /// [`CircuitSpec::observables`]. All NaN if one of the numbers is not finite.
    ///
    /// # Errors
    /// [`CircuitError::Count`] if the number of inputs or of angles is not the circuit's.
    pub fn expectations(&self, x: &[f64], theta: &[f64], draw: Draw) -> Result<Vec<f64>, CircuitError> {
        self.check_counts(x, theta)?;
        if !are_finite(x, theta) {
            return Ok(vec![f64::NAN; self.qubits()]);
        }
        if self.is_closed_form()
            && let (&[x0, x1], &[t0, t1, t2, t3]) = (x, theta)
        {
            return Ok(closed_form::expectations([x0, x1], [t0, t1, t2, t3]).to_vec());
        }
        let probabilities = self.probabilities(&self.gate_angles(x, theta));
        Ok(match self.shots() {
            None => z_expectations(&probabilities),
            Some(Shots { count, seed, .. }) => {
                shots::estimate(&probabilities, count, &mut draw.stream(seed, "expectations"))
            }
        })
    }

    /// Gradients by `x` and by `theta` of the expectations' sum weighted by `cotangent`. All NaN if a number is not finite.
    ///
    /// # Errors
    /// [`CircuitError::Count`] if the number of inputs, of angles or of cotangents is not the circuit's.
    pub fn gradients(
        &self,
        x: &[f64],
        theta: &[f64],
        cotangent: &[f64],
        draw: Draw,
    ) -> Result<(Vec<f64>, Vec<f64>), CircuitError> {
        self.check_counts(x, theta)?;
        let (what, expected, got) = ("cotangents, one for each observable", self.qubits(), cotangent.len());
        if got != expected {
            return Err(CircuitError::Count { what, expected, got });
        }
        if !are_finite(x, theta) {
            return Ok((vec![f64::NAN; x.len()], vec![f64::NAN; theta.len()]));
        }
        let angles = self.gate_angles(x, theta);
        let by_gate = match self.shots() {
            Some(shots @ Shots { gradient: ShotGradient::Shots, .. }) => {
                let mut sum = vec![0.0; angles.len()];
                for (row, weight) in self.measured_jacobian(&angles, shots, draw).iter().zip(cotangent) {
                    sum.iter_mut().zip(row).for_each(|(sum, v)| *sum += weight * v);
                }
                sum
            }
            _ => self.exact_gradient(&angles, cotangent),
        };
        Ok(self.pull_back(x, &by_gate))
    }

    /// Expectations and all their gradients.
    ///
    /// # Errors
    /// [`CircuitError::Count`] if the number of inputs or of angles is not the circuit's.
    pub fn jacobian(&self, x: &[f64], theta: &[f64], draw: Draw) -> Result<Jacobian, CircuitError> {
        let expectations = self.expectations(x, theta, draw)?;
        if self.is_closed_form()
            && let (&[x0, x1], &[t0, t1, t2, t3]) = (x, theta)
        {
            let point = closed_form::circuit([x0, x1], [t0, t1, t2, t3]);
            return Ok(Jacobian {
                expectations,
                by_theta: point.by_theta.map(|row| row.to_vec()).to_vec(),
                by_x: point.by_x.map(|row| row.to_vec()).to_vec(),
            });
        }
        if !are_finite(x, theta) {
            let (by_theta, by_x) = (vec![f64::NAN; theta.len()], vec![f64::NAN; x.len()]);
            let rows = self.qubits();
            return Ok(Jacobian { expectations, by_theta: vec![by_theta; rows], by_x: vec![by_x; rows] });
        }
        let angles = self.gate_angles(x, theta);
        let by_gate = match self.shots() {
            Some(shots @ Shots { gradient: ShotGradient::Shots, .. }) => self.measured_jacobian(&angles, shots, draw),
            _ => (0..self.qubits())
                .map(|o| {
                    let unit: Vec<f64> = (0..self.qubits()).map(|k| f64::from(u8::from(k == o))).collect();
                    self.exact_gradient(&angles, &unit)
                })
                .collect(),
        };
        let (by_x, by_theta) = by_gate.iter().map(|by_gate| self.pull_back(x, by_gate)).unzip();
        Ok(Jacobian { expectations, by_theta, by_x })
    }

    /// Gradient by the angle of each rotation gate of the exact expectations' weighted sum.
    fn exact_gradient(&self, angles: &[f64], cotangent: &[f64]) -> Vec<f64> {
        // Readout errors scale every expectation by the same factor.
        let scaled: Vec<f64> = cotangent.iter().map(|g| g * (1.0 - 2.0 * self.spec.noise.readout_flip)).collect();
        if self.spec.noise.is_depolarising() {
            return noise::gradient(self, angles, &scaled);
        }
        Workspace::run(self, angles).gradient(self, angles, &scaled)
    }

    /// Derivatives as hardware measures them, `[observable][gate]`.
    fn measured_jacobian(&self, angles: &[f64], shots: Shots, draw: Draw) -> Vec<Vec<f64>> {
        let mut rng = draw.stream(shots.seed, "gradients");
        parameter_shift(angles, |angles| shots::estimate(&self.probabilities(angles), shots.count, &mut rng))
    }
}
