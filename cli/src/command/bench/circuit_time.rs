//! Benchmark of the quantum layer: exact in f32 and f64, by state vector, and from shots.

use std::f64::consts::PI;

use radome_models::quantum::{
    Circuit, CircuitSpec, ClosedForm, Draw, Execution, ShotGradient, Shots, circuit, expectations_of_rows,
    gradients_of_rows,
};

use super::point::{Point, least_ms};

const STAGE: &str = "a sample by the circuit";
const BATCH: usize = 256;

/// Measures a batch of the paper's circuit, forward and all gradients. The error is the rms of the expectations.
///
/// # Errors
/// The circuit is not valid.
pub fn points(rounds: usize) -> anyhow::Result<Vec<Point>> {
    let x: Vec<[f32; 2]> = (0..BATCH).map(|k| [(0.37 * k as f64 % PI) as f32, (1.91 * k as f64 % PI) as f32]).collect();
    let theta = [0.4, -1.2, 2.0, 0.7];
    let exact: Vec<[f64; 2]> = x.iter().map(|x| circuit(x.map(f64::from), theta).expectations).collect();
    let rms = |of: &dyn Fn(usize) -> [f64; 2]| {
        let square: f64 =
            (0..BATCH).map(|k| exact[k].iter().zip(of(k)).map(|(a, b)| (a - b).powi(2)).sum::<f64>()).sum();
        (square / (2 * BATCH) as f64).sqrt()
    };
    let point = |way: String, milliseconds: f64, error: Option<f64>| Point {
        stage: STAGE,
        way,
        milliseconds: milliseconds / BATCH as f64,
        error,
        error_unit: "rms of <Z>",
        is_peer: false,
    };
    let mut points = Vec::new();
    let (mut out, mut by_x) = (vec![[0.0f32; 2]; BATCH], vec![[0.0f32; 2]; BATCH]);
    let cotangents = vec![[0.3f32, -0.5]; BATCH];
    let ms = least_ms(rounds, || {
        let closed_form = ClosedForm::new(theta);
        expectations_of_rows(&closed_form, &x, &mut out);
        std::hint::black_box(gradients_of_rows(&closed_form, &x, &cotangents, &mut by_x));
        Ok(())
    })?;
    points.push(point("closed form, f32 lanes".into(), ms, Some(rms(&|k| out[k].map(f64::from)))));
    let ms = least_ms(rounds, || {
        for x in &x {
            std::hint::black_box(circuit(x.map(f64::from), theta));
        }
        Ok(())
    })?;
    points.push(point("closed form, f64, the reference".into(), ms, None));
    for count in [100, 1_000, 4_096] {
        let execution = Execution::Shots(Shots { count, seed: 1, gradient: ShotGradient::Shots });
        let circuit = Circuit::new(&CircuitSpec { execution, ..CircuitSpec::default() })?;
        let mut estimates = vec![[0.0; 2]; BATCH];
        let ms = least_ms(rounds.min(10), || {
            for (row, (x, estimate)) in x.iter().zip(&mut estimates).enumerate() {
                let draw = Draw { call: 0, row: row as u64 };
                let x = x.map(f64::from);
                if let [a, b] = circuit.expectations(&x, &theta, draw)?[..] {
                    *estimate = [a, b];
                }
                std::hint::black_box(circuit.gradients(&x, &theta, &[0.3, -0.5], draw)?);
            }
            Ok(())
        })?;
        points.push(point(format!("{count} shots"), ms, Some(rms(&|k| estimates[k]))));
    }
    Ok(points)
}
