//! Time of the quantum layer per sample on one thread: the paper's circuit, and other circuits by number of qubits.
//!
//! `cargo run --release -p radome-models --example circuit_time`
#![allow(clippy::print_stdout)]

use std::hint::black_box;
use std::time::Instant;

use candle_core::{Device, Tensor, Var};
use radome_models::quantum::{
    Circuit, CircuitSpec, ClosedForm, Draw, Execution, Noise, ShotGradient, Shots, expectations_of_rows,
    gradients_of_rows,
};
use radome_models::{layer, quantum};

const BATCH: usize = 32;

/// Seconds of one run of `f`: the least of 20 means over 10 ms each.
fn seconds(mut f: impl FnMut()) -> f64 {
    let mut fastest = f64::INFINITY;
    for _ in 0..20 {
        let (started, mut runs) = (Instant::now(), 0u32);
        while started.elapsed().as_secs_f64() < 0.01 {
            f();
            runs += 1;
        }
        fastest = fastest.min(started.elapsed().as_secs_f64() / f64::from(runs));
    }
    fastest
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    // The pool must be configured before its first use.
    rayon::ThreadPoolBuilder::new().num_threads(1).build_global()?;
    let x: Vec<[f32; 2]> = (0..BATCH).map(|k| [0.09 * k as f32, 3.0 - 0.08 * k as f32]).collect();
    let theta = [0.4f32, -1.2, 2.0, 0.7];
    let cotangents = vec![[0.3f32, -0.5]; BATCH];
    let (mut out, mut by_x) = (vec![[0.0f32; 2]; BATCH], vec![[0.0f32; 2]; BATCH]);
    let ns_per_sample = 1e9 / BATCH as f64;

    let forward = seconds(|| {
        expectations_of_rows(&ClosedForm::new(black_box(theta).map(f64::from)), black_box(&x), &mut out);
        black_box(&out);
    });
    let backward = seconds(|| {
        let closed_form = ClosedForm::new(black_box(theta).map(f64::from));
        black_box(gradients_of_rows(&closed_form, black_box(&x), black_box(&cotangents), &mut by_x));
        black_box(&by_x);
    });
    println!(
        "closed form, batch {BATCH}: forward {:.1} ns a sample, gradients {:.1}, together {:.1}",
        ns_per_sample * forward,
        ns_per_sample * backward,
        ns_per_sample * (forward + backward)
    );

    let one = seconds(|| {
        black_box(quantum::circuit(black_box([0.8, 2.1]), black_box(theta).map(f64::from)));
    });
    println!("the scalar closed form in f64, all gradients: {:.1} ns", 1e9 * one);

    let input = Var::from_tensor(&Tensor::from_slice(x.as_flattened(), (BATCH, 2), &Device::Cpu)?)?;
    let angles = Var::from_tensor(&Tensor::new(&theta, &Device::Cpu)?)?;
    let paper = CircuitSpec::default();
    let circuit = Circuit::new(&paper)?;
    let layer_time = seconds(|| {
        let loss = layer::circuit(&input, &angles, &circuit, 0).and_then(|out| out.sum_all());
        let _ = black_box(loss.and_then(|loss| loss.backward()));
    });
    println!("the layer in candle, with a sum and its backward pass: {:.1} ns a sample", ns_per_sample * layer_time);

    let shots = Execution::Shots(Shots { count: 4096, seed: 1, gradient: ShotGradient::Shots });
    let noise = Noise { depolarising_one_qubit: 0.001, depolarising_two_qubit: 0.01, readout_flip: 0.02 };
    let of = |qubits: usize| CircuitSpec { qubits, ..CircuitSpec::default() };
    for (name, spec) in [
        ("2 qubits, repetitions 2", CircuitSpec { repetitions: 2, ..paper.clone() }),
        ("3 qubits", of(3)),
        ("4 qubits", of(4)),
        ("8 qubits", of(8)),
        ("12 qubits", of(12)),
        ("2 qubits, 4096 shots", CircuitSpec { execution: shots, ..paper.clone() }),
        ("4 qubits, 4096 shots", CircuitSpec { execution: shots, ..of(4) }),
        ("2 qubits, noise", CircuitSpec { noise, ..paper.clone() }),
        ("4 qubits, noise", CircuitSpec { noise, ..of(4) }),
        ("6 qubits, noise", CircuitSpec { noise, ..of(6) }),
    ] {
        let circuit = Circuit::new(&spec)?;
        let x: Vec<f64> = (0..spec.qubits).map(|k| 0.3 + 0.2 * k as f64).collect();
        let theta: Vec<f64> = (0..spec.angle_count()).map(|k| 0.1 * k as f64 - 1.0).collect();
        let cotangent = vec![0.5; spec.qubits];
        let forward = seconds(|| {
            let _ = black_box(circuit.expectations(black_box(&x), &theta, Draw::default()));
        });
        let backward = seconds(|| {
            let _ = black_box(circuit.gradients(black_box(&x), &theta, &cotangent, Draw::default()));
        });
        println!(
            "{name}: forward {:.2} us, gradients {:.2}, together {:.2}",
            1e6 * forward,
            1e6 * backward,
            1e6 * (forward + backward)
        );
    }
    Ok(())
}
