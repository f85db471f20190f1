//! Quantum circuit as a layer: inputs and expectations in f32, computation in f64.
//!
//! Expectations are computed in f64 and rounded once, within 6e-8. Gradients by inputs are within 6e-8 of their magnitude.
//! Gradients by angles are summed over rows in f64.

use candle_core::{Error, Result, Shape, Tensor, bail};
use rayon::prelude::*;

use super::operation::{Argument, Gradients, Operation, apply};
use crate::quantum::{Circuit, CircuitError, ClosedForm, Draw, expectations_of_rows, gradients_of_rows};

const NAME: &str = "circuit";
/// Number of rows of the closed form in one task. Fewer are not worth another thread.
const ROWS: usize = 1024;

/// `<Z>` of each qubit of `circuit` for each row of `input` `[batch][qubits]` (radians) at `theta` `[angles]` (radians),
/// in the order of [`CircuitSpec::observables`](crate::quantum::CircuitSpec::observables).
///
/// With shots, outcomes are a function of the seed, of the number of the call, and of the row.
///
/// # Errors
/// Shapes differ from those above, or a tensor is not f32 on the CPU.
pub fn circuit(input: &Tensor, theta: &Tensor, circuit: &Circuit, call: u64) -> Result<Tensor> {
    apply(NAME, &[input, theta], CircuitLayer { circuit: circuit.clone(), call })
}

/// Expectations `[row][qubit]` of any circuit at inputs of the same shape.
pub(crate) fn run_circuit(circuit: &Circuit, theta: &[f64], call: u64, x: &[f32], output: &mut [f32]) -> Result<()> {
    let qubits = circuit.qubits();
    let rows = x.par_chunks_exact(qubits).zip(output.par_chunks_exact_mut(qubits)).enumerate();
    rows.try_for_each(|(row, (x, output))| {
        let expectations = circuit.expectations(&to_f64(x), theta, Draw { call, row: row as u64 })?;
        output.iter_mut().zip(expectations).for_each(|(output, v)| *output = v as f32);
        Ok(())
    })
    .map_err(to_candle_error)
}

fn to_candle_error(error: CircuitError) -> Error {
    Error::wrap(error)
}

struct CircuitLayer {
    circuit: Circuit,
    call: u64,
}

fn to_f64(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&v| f64::from(v)).collect()
}

impl CircuitLayer {
    /// Checks the shapes. Returns the number of rows.
    fn check(&self, input: &[usize], theta: &[usize]) -> Result<usize> {
        let (qubits, angles) = (self.circuit.qubits(), self.circuit.angle_count());
        match (input, theta) {
            (&[batch, width], &[count]) if width == qubits && count == angles => Ok(batch),
            _ => bail!("{NAME}: expected input [batch, {qubits}] and {angles} angles, got {input:?} and {theta:?}"),
        }
    }

    /// Closed form at these angles, if the circuit has one.
    fn closed_form(&self, theta: &[f32]) -> Option<ClosedForm> {
        match *theta {
            [a, b, c, d] if self.circuit.is_closed_form() => Some(ClosedForm::new([a, b, c, d].map(f64::from))),
            _ => None,
        }
    }

    fn expectations(&self, input: &[f32], theta: &[f32]) -> Result<Vec<f32>> {
        let mut result = vec![0.0f32; input.len()];
        if let Some(closed_form) = self.closed_form(theta) {
            let chunks =
                input.as_chunks::<2>().0.par_chunks(ROWS).zip(result.as_chunks_mut::<2>().0.par_chunks_mut(ROWS));
            chunks.for_each(|(input, result)| expectations_of_rows(&closed_form, input, result));
            return Ok(result);
        }
        run_circuit(&self.circuit, &to_f64(theta), self.call, input, &mut result)?;
        Ok(result)
    }

    /// Gradients by the input and by the angles.
    fn gradients(&self, input: &[f32], theta: &[f32], cotangents: &[f32]) -> Result<(Vec<f32>, Vec<f32>)> {
        let mut by_input = vec![0.0f32; input.len()];
        // Partial sums are added in the order of rows, independently of the threads.
        let partials: Vec<Vec<f64>> = if let Some(closed_form) = self.closed_form(theta) {
            let (input, cotangents) = (input.as_chunks::<2>().0, cotangents.as_chunks::<2>().0);
            let chunks = input.par_chunks(ROWS).zip(cotangents.par_chunks(ROWS));
            chunks
                .zip(by_input.as_chunks_mut::<2>().0.par_chunks_mut(ROWS))
                .map(|((x, g), by_x)| gradients_of_rows(&closed_form, x, g, by_x).to_vec())
                .collect()
        } else {
            let (qubits, theta) = (self.circuit.qubits(), to_f64(theta));
            let rows = input.par_chunks_exact(qubits).zip(cotangents.par_chunks_exact(qubits));
            rows.zip(by_input.par_chunks_exact_mut(qubits))
                .enumerate()
                .map(|(row, ((x, g), by_input))| {
                    let draw = Draw { call: self.call, row: row as u64 };
                    let (by_x, by_theta) = self.circuit.gradients(&to_f64(x), &theta, &to_f64(g), draw)?;
                    by_input.iter_mut().zip(by_x).for_each(|(to, v)| *to = v as f32);
                    Ok(by_theta)
                })
                .collect::<std::result::Result<_, _>>()
                .map_err(to_candle_error)?
        };
        let mut by_theta = vec![0.0f64; theta.len()];
        for partial in partials {
            by_theta.iter_mut().zip(partial).for_each(|(sum, v)| *sum += v);
        }
        Ok((by_input, by_theta.into_iter().map(|v| v as f32).collect()))
    }
}

impl Operation for CircuitLayer {
    fn forward(&self, inputs: &[Argument<'_>]) -> Result<(Vec<f32>, Shape)> {
        let [input, theta] = inputs else { bail!("{NAME}: expected inputs and angles") };
        let batch = self.check(input.dims, theta.dims)?;
        Ok((self.expectations(input.values, theta.values)?, Shape::from((batch, self.circuit.qubits()))))
    }

    fn backward(&self, inputs: &[Argument<'_>], _output: &[f32], gradient: Vec<f32>) -> Result<Gradients> {
        let [input, theta] = inputs else { bail!("{NAME}: expected inputs and angles") };
        let (by_input, by_theta) = self.gradients(input.values, theta.values, &gradient)?;
        Ok(vec![Some(by_input), Some(by_theta)])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::layer::tests::{flat, same_bits, var};
    use crate::quantum::{self, CircuitSpec, Encoding, Execution, Noise, ShotGradient, Shots, state_vector};
    use crate::random::stream;
    use candle_core::Device;
    use rand::Rng;
    use std::f32::consts::PI;

    fn build(spec: CircuitSpec) -> Circuit {
        Circuit::new(&spec).expect("a good spec")
    }

    fn shots(count: u32) -> Execution {
        Execution::Shots(Shots { count, seed: 3, gradient: ShotGradient::Shots })
    }

    fn numbers(count: usize, what: &str, low: f32, high: f32) -> Vec<f32> {
        let mut rng = stream(5, what, 0);
        (0..count).map(|_| rng.random_range(low..high)).collect()
    }

    /// Output and gradients of a weighted sum of it.
    fn run(circuit: &Circuit, x: &[f32], theta: &[f32], weights: &[f32], call: u64) -> [Vec<f32>; 3] {
        let shape = [x.len() / circuit.qubits(), circuit.qubits()];
        let (input, theta) = (var(x, &shape), var(theta, &[theta.len()]));
        let out = super::circuit(&input, &theta, circuit, call).expect("forward");
        let weights = Tensor::from_slice(weights, &shape, &Device::Cpu).expect("tensor");
        let grads = (&out * weights).and_then(|t| t.sum_all()).and_then(|t| t.backward()).expect("backward");
        [flat(&out), flat(grads.get(&input).expect("gradient")), flat(grads.get(&theta).expect("gradient"))]
    }

    /// Compares the closed form in vector loops with the scalar one in f64, at the same f32 inputs, within the errors that the
    /// module states. Batches have different lengths.
    #[test]
    fn rows_follow_the_closed_form_to_the_last_bit_of_f32() {
        let paper = build(CircuitSpec::default());
        for batch in [1, 2, 31, 32, 33, 1025, 3000] {
            let (x, theta) = (numbers(2 * batch, "x", 0.0, PI), numbers(4, "theta", -PI, PI));
            let weights = numbers(2 * batch, "weights", -1.0, 1.0);
            let [out, by_x, by_theta] = run(&paper, &x, &theta, &weights, 0);
            let angles = [theta[0], theta[1], theta[2], theta[3]].map(f64::from);
            let mut want_theta = [0.0; 4];
            for (row, x) in x.chunks(2).enumerate() {
                let point = quantum::circuit([x[0], x[1]].map(f64::from), angles);
                let w = [weights[2 * row], weights[2 * row + 1]].map(f64::from);
                for (got, want) in out[2 * row..].iter().zip(point.expectations) {
                    assert!((f64::from(*got) - want).abs() < 6e-8, "{x:?}: {got} {want}");
                }
                for (k, got) in by_x[2 * row..].iter().take(2).enumerate() {
                    let want = w[0] * point.by_x[0][k] + w[1] * point.by_x[1][k];
                    assert!((f64::from(*got) - want).abs() < 6e-8 * want.abs() + 1e-13, "{x:?}: {got} {want}");
                }
                for (k, sum) in want_theta.iter_mut().enumerate() {
                    *sum += w[0] * point.by_theta[0][k] + w[1] * point.by_theta[1][k];
                }
            }
            for (got, want) in by_theta.iter().zip(want_theta) {
                assert!((f64::from(*got) - want).abs() < 6e-8 * want.abs() + 1e-12 * batch as f64, "{got} {want}");
            }
        }
    }

    #[test]
    fn any_circuit_is_a_layer() {
        for spec in [
            CircuitSpec { qubits: 4, ..CircuitSpec::default() },
            CircuitSpec { qubits: 2, repetitions: 2, ..CircuitSpec::default() },
            CircuitSpec { qubits: 3, encoding: Encoding::Angle, depth: 2, ..CircuitSpec::default() },
        ] {
            let circuit = build(spec);
            let (qubits, batch) = (circuit.qubits(), 5);
            let x = numbers(qubits * batch, "x", 0.0, PI);
            let theta = numbers(circuit.angle_count(), "theta", -PI, PI);
            let weights = numbers(qubits * batch, "weights", -1.0, 1.0);
            let [out, by_x, by_theta] = run(&circuit, &x, &theta, &weights, 0);
            let loss = |x: &[f64], theta: &[f64]| -> f64 {
                let rows = x.chunks(qubits).map(|x| state_vector::run(&circuit, x, theta).expect("run").expectations());
                rows.flatten().zip(&weights).map(|(z, w)| z * f64::from(*w)).sum()
            };
            let (x, theta) = (to_f64(&x), to_f64(&theta));
            let slow = |row: &[f64]| state_vector::run(&circuit, row, &theta).expect("run").expectations();
            for (got, want) in out.iter().zip(x.chunks(qubits).flat_map(slow)) {
                assert!((f64::from(*got) - want).abs() < 6e-8, "{got} {want}");
            }
            let difference = |values: &[f64], k: usize, f: &dyn Fn(&[f64]) -> f64| {
                let (mut up, mut down) = (values.to_vec(), values.to_vec());
                up[k] += 1e-5;
                down[k] -= 1e-5;
                (f(&up) - f(&down)) / 2e-5
            };
            for (k, got) in by_x.iter().enumerate() {
                let want = difference(&x, k, &|x| loss(x, &theta));
                assert!((f64::from(*got) - want).abs() < 1e-6 * (1.0 + want.abs()), "{got} {want}");
            }
            for (k, got) in by_theta.iter().enumerate() {
                let want = difference(&theta, k, &|theta| loss(&x, theta));
                assert!((f64::from(*got) - want).abs() < 1e-6 * (1.0 + want.abs()), "{got} {want}");
            }
        }
    }

    #[test]
    fn shots_differ_by_call_and_by_row_and_are_reproducible() {
        let measured = build(CircuitSpec { execution: shots(100), ..CircuitSpec::default() });
        let (x, theta) = (var(&[1.0; 6], &[3, 2]), var(&[0.5; 4], &[4]));
        let run = |call| flat(&circuit(&x, &theta, &measured, call).expect("forward"));
        let first = run(0);
        assert_ne!(first, run(1));
        assert!(first[..2] != first[2..4] || first[2..4] != first[4..], "each row has its own outcomes");
        assert_eq!(first, run(0));
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn any_number_of_threads_gives_the_same_bits() {
            let noise = Noise { depolarising_one_qubit: 0.01, depolarising_two_qubit: 0.02, readout_flip: 0.03 };
            let default = CircuitSpec::default;
            let specs = [
                (default(), 5000),
                (CircuitSpec { qubits: 5, ..default() }, 9),
                (CircuitSpec { qubits: 3, execution: shots(50), ..default() }, 9),
                (CircuitSpec { qubits: 3, noise, ..default() }, 9),
            ];
            for (spec, batch) in specs {
                let circuit = build(spec);
                let x = numbers(circuit.qubits() * batch, "x", 0.0, PI);
                let weights = numbers(circuit.qubits() * batch, "weights", -1.0, 1.0);
                let theta = numbers(circuit.angle_count(), "theta", -PI, PI);
                same_bits(&format!("{circuit:?}"), || run(&circuit, &x, &theta, &weights, 7));
            }
        }

        /// A NaN in a row makes the results and gradients of this row NaN, and the gradients by the angles, but no other row.
        #[test]
        fn a_nan_stays_visible_and_in_its_row() {
            for spec in [
                CircuitSpec::default(),
                CircuitSpec { repetitions: 2, ..CircuitSpec::default() },
                CircuitSpec { execution: shots(9), ..CircuitSpec::default() },
            ] {
                for bad in [f32::NAN, f32::INFINITY] {
                    let mut x = numbers(12, "x", 0.0, PI);
                    x[5] = bad;
                    let [out, by_x, by_theta] = run(&build(spec.clone()), &x, &[0.3; 4], &[1.0; 12], 0);
                    for (k, (out, by_x)) in out.iter().zip(&by_x).enumerate() {
                        assert_eq!(out.is_nan(), k / 2 == 2, "{spec:?} {k} {out}");
                        assert_eq!(by_x.is_nan(), k / 2 == 2, "{spec:?} {k} {by_x}");
                    }
                    assert!(by_theta.iter().any(|v| v.is_nan()));
                }
                let out = run(&build(spec), &[1.0; 4], &[f32::NAN; 4], &[1.0; 4], 0);
                assert!(out.iter().flatten().all(|v| v.is_nan()));
            }
        }

        /// Inputs far outside the range that the vector sines reduce are still angles.
        #[test]
        fn enormous_inputs_are_still_angles() {
            let x = [1e30f32, 2.0, 1e5, 4e4, 1.0, 2.0];
            let [out, by_x, _] = run(&build(CircuitSpec::default()), &x, &[0.3; 4], &[1.0; 6], 0);
            for (row, x) in x.chunks(2).enumerate() {
                let point = quantum::circuit([f64::from(x[0]), f64::from(x[1])], [f64::from(0.3f32); 4]);
                assert!((f64::from(out[2 * row]) - point.expectations[0]).abs() < 6e-8);
                let want = point.by_x[0][0] + point.by_x[1][0];
                assert!((f64::from(by_x[2 * row]) - want).abs() <= 1e-6 * want.abs().max(1.0));
            }
        }

        #[test]
        fn wrong_shapes_say_what_was_expected() {
            let circuit = build(CircuitSpec { qubits: 3, ..CircuitSpec::default() });
            let error = |x: &[usize], theta: usize| {
                let zeros =
                    |shape: &[usize]| Tensor::zeros(shape, candle_core::DType::F32, &Device::Cpu).expect("zeros");
                super::circuit(&zeros(x), &zeros(&[theta]), &circuit, 0).expect_err("wrong shape").to_string()
            };
            for error in [error(&[5, 2], 6), error(&[5, 3], 4), error(&[3], 6)] {
                assert!(error.contains("expected input [batch, 3] and 6 angles"), "{error}");
            }
            assert_eq!(run(&circuit, &[], &[0.0; 6], &[], 0)[2], [0.0; 6]);
        }
    }
}
