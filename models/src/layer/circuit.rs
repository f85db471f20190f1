//! The quantum circuit as a layer: rows of f32 in, expectations out, everything between in f64.
//!
//! Expectations are those of f64 at the same inputs, rounded once: within 6e-8. So are gradients by inputs, within 6e-8
//! of their magnitude, and gradients by angles, which are summed over rows in f64.

use candle_core::{CpuStorage, CustomOp2, Error, Layout, Result, Shape, Tensor};
use rayon::prelude::*;

use super::{values, with_values};
use crate::quantum::{Circuit, CircuitError, CircuitSpec, Draw, Trained, expectations_of_rows, gradients_of_rows};

const NAME: &str = "circuit";
/// Rows of the closed form that a thread takes at once: fewer are not worth another thread.
const ROWS: usize = 1024;

/// `[<ZI>, <IZ>]` of [`crate::quantum::circuit`] for each row of `input` `[batch][2]` (radians) at `theta` `[4]`
/// (radians).
pub fn circuit(input: &Tensor, theta: &Tensor) -> Result<Tensor> {
    circuit_of(input, theta, &Circuit::new(&CircuitSpec::default()).map_err(failed)?)
}

/// `<Z>` of each qubit of `circuit` for each row of `input` `[batch][qubits]` (radians) at `theta` `[angles]` (radians),
/// in the order of [`CircuitSpec::observables`].
///
/// With shots, outcomes are a function of the seed, of how many calls the circuit has had, and of the row.
pub fn circuit_of(input: &Tensor, theta: &Tensor, circuit: &Circuit) -> Result<Tensor> {
    circuit_of_call(input, theta, circuit, circuit.next_call())
}

/// [`circuit_of`] with a call's number of the caller's choice: the same number, the same shots.
pub fn circuit_of_call(input: &Tensor, theta: &Tensor, circuit: &Circuit, call: u64) -> Result<Tensor> {
    input.apply_op2(theta, CircuitLayer { circuit: circuit.clone(), call })
}

fn failed(error: CircuitError) -> Error {
    Error::wrap(error)
}

struct CircuitLayer {
    circuit: Circuit,
    call: u64,
}

fn widen(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&v| f64::from(v)).collect()
}

impl CircuitLayer {
    /// Number of rows.
    fn check(&self, input: &[usize], theta: &[usize]) -> Result<usize> {
        let (qubits, angles) = (self.circuit.qubits(), self.circuit.angle_count());
        match (input, theta) {
            (&[batch, width], &[count]) if width == qubits && count == angles => Ok(batch),
            _ => Err(Error::Msg(format!(
                "{NAME}: expected input [batch, {qubits}] and {angles} angles, got {input:?} and {theta:?}"
            ))
            .bt()),
        }
    }

    /// What the closed form needs, if it serves.
    fn trained(&self, theta: &[f32]) -> Option<Trained> {
        match *theta {
            [a, b, c, d] if self.circuit.is_closed_form() => Some(Trained::new([a, b, c, d].map(f64::from))),
            _ => None,
        }
    }

    fn draw(&self, row: usize) -> Draw {
        Draw { call: self.call, row: row as u64 }
    }

    fn forward(&self, input: &[f32], theta: &[f32]) -> Result<Vec<f32>> {
        let mut result = vec![0.0f32; input.len()];
        if let Some(trained) = self.trained(theta) {
            let pieces =
                input.as_chunks::<2>().0.par_chunks(ROWS).zip(result.as_chunks_mut::<2>().0.par_chunks_mut(ROWS));
            pieces.for_each(|(input, result)| expectations_of_rows(&trained, input, result));
            return Ok(result);
        }
        let (qubits, theta) = (self.circuit.qubits(), widen(theta));
        let rows = input.par_chunks_exact(qubits).zip(result.par_chunks_exact_mut(qubits)).enumerate();
        rows.try_for_each(|(row, (x, result))| {
            let expectations = self.circuit.expectations(&widen(x), &theta, self.draw(row))?;
            result.iter_mut().zip(expectations).for_each(|(result, v)| *result = v as f32);
            Ok(())
        })
        .map_err(failed)?;
        Ok(result)
    }

    /// Gradients by the input and by the angles.
    fn backward(&self, input: &[f32], theta: &[f32], cotangents: &[f32]) -> Result<(Vec<f32>, Vec<f32>)> {
        let mut by_input = vec![0.0f32; input.len()];
        // Summed in the order of rows, whichever thread was first.
        let parts: Vec<Vec<f64>> = if let Some(trained) = self.trained(theta) {
            let (input, cotangents) = (input.as_chunks::<2>().0, cotangents.as_chunks::<2>().0);
            let pieces = input.par_chunks(ROWS).zip(cotangents.par_chunks(ROWS));
            pieces
                .zip(by_input.as_chunks_mut::<2>().0.par_chunks_mut(ROWS))
                .map(|((x, g), by_x)| gradients_of_rows(&trained, x, g, by_x).to_vec())
                .collect()
        } else {
            let (qubits, theta) = (self.circuit.qubits(), widen(theta));
            let rows = input.par_chunks_exact(qubits).zip(cotangents.par_chunks_exact(qubits));
            rows.zip(by_input.par_chunks_exact_mut(qubits))
                .enumerate()
                .map(|(row, ((x, g), by_input))| {
                    let (by_x, by_theta) = self.circuit.gradients(&widen(x), &theta, &widen(g), self.draw(row))?;
                    by_input.iter_mut().zip(by_x).for_each(|(to, v)| *to = v as f32);
                    Ok(by_theta)
                })
                .collect::<std::result::Result<_, _>>()
                .map_err(failed)?
        };
        let mut by_theta = vec![0.0f64; theta.len()];
        for part in parts {
            by_theta.iter_mut().zip(part).for_each(|(sum, v)| *sum += v);
        }
        Ok((by_input, by_theta.into_iter().map(|v| v as f32).collect()))
    }
}

impl CustomOp2 for CircuitLayer {
    fn name(&self) -> &'static str {
        NAME
    }

    fn cpu_fwd(
        &self,
        input: &CpuStorage,
        input_layout: &Layout,
        theta: &CpuStorage,
        theta_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let batch = self.check(input_layout.dims(), theta_layout.dims())?;
        let result = self.forward(values(NAME, input, input_layout)?, values(NAME, theta, theta_layout)?)?;
        Ok((CpuStorage::F32(result), Shape::from((batch, self.circuit.qubits()))))
    }

    fn bwd(
        &self,
        input: &Tensor,
        theta: &Tensor,
        _result: &Tensor,
        gradient: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let (by_input, by_theta) = with_values(NAME, input, |input| {
            with_values(NAME, theta, |theta| with_values(NAME, gradient, |g| self.backward(input, theta, g)))
        })?;
        let device = input.device();
        Ok((
            Some(Tensor::from_vec(by_input, input.shape(), device)?),
            Some(Tensor::from_vec(by_theta, theta.shape(), device)?),
        ))
    }
}
