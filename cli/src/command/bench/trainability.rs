use std::f64::consts::{PI, TAU};

use radome_models::quantum::{Circuit, CircuitSpec, Draw, MOST_QUBITS};
use rand::rngs::StdRng;
use rand::{Rng, SeedableRng};
use serde::Serialize;

use crate::exit::wrong_use;
use crate::output;
use crate::source::DEFAULT_SEED;

/// `radome bench trainability`
#[derive(clap::Args)]
pub struct Arguments {
    /// Largest number of qubits, at most 12; circuits of all numbers up to it are measured
    #[arg(long, default_value_t = MOST_QUBITS)]
    qubits: usize,
    /// Repetitions of the trained part, D0,D1,...
    #[arg(long, value_delimiter = ',', num_args = 1, default_value = "1,5,12")]
    depths: Vec<usize>,
    /// Random points for each circuit
    #[arg(long, default_value_t = 1000)]
    points: u64,
    /// Seed of the points
    #[arg(long, default_value_t = DEFAULT_SEED)]
    seed: u64,
    /// Print a JSON list of objects
    #[arg(long)]
    json: bool,
}

/// Gradients of a circuit's first expectation at random points: angles over a full turn, inputs over half a turn.
#[derive(Serialize)]
struct Row {
    qubits: usize,
    depth: usize,
    points: u64,
    /// Mean squared norm of the gradient by the trained angles. The gradients have zero mean, so this is the sum of
    /// their variances.
    angle_gradient_square: f64,
    /// Mean squared norm of the gradient by the inputs, through which the preceding layers are trained.
    input_gradient_square: f64,
}

/// Measures gradients of circuits by their number of qubits. They show how well circuits can be trained from a random
/// start (McClean, Boixo, Smelyanskiy, Babbush and Neven, "Barren plateaus in quantum neural network training
/// landscapes", 2018).
///
/// # Errors
/// A circuit is not valid, there are no points or no qubits, or standard output cannot be written.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    for (option, count) in [("--points", arguments.points), ("--qubits", arguments.qubits as u64)] {
        if count == 0 {
            wrong_use!("{option} is 0, expected at least 1");
        }
    }
    let mut rows = Vec::new();
    for &depth in &arguments.depths {
        for qubits in 1..=arguments.qubits {
            rows.push(row(&CircuitSpec { qubits, depth, ..CircuitSpec::default() }, arguments)?);
        }
    }
    if arguments.json {
        return output::json_line(&rows);
    }
    output::text_line(&format!("{:>6} {:>6} {:>18} {:>18}", "depth", "qubits", "by angles", "by inputs"))?;
    for Row { qubits, depth, angle_gradient_square, input_gradient_square, .. } in rows {
        output::text_line(&format!(
            "{depth:>6} {qubits:>6} {angle_gradient_square:>18.3e} {input_gradient_square:>18.3e}"
        ))?;
    }
    Ok(())
}

fn row(spec: &CircuitSpec, arguments: &Arguments) -> anyhow::Result<Row> {
    let circuit = Circuit::new(spec)?;
    let mut rng = StdRng::seed_from_u64(arguments.seed);
    let mut first = vec![0.0; spec.qubits];
    first[0] = 1.0;
    let length = |gradient: &[f64]| gradient.iter().map(|value| value * value).sum::<f64>();
    let (mut by_angles, mut by_inputs) = (0.0, 0.0);
    for _ in 0..arguments.points {
        let inputs: Vec<f64> = (0..circuit.qubits()).map(|_| rng.random_range(0.0..PI)).collect();
        let angles: Vec<f64> = (0..circuit.angle_count()).map(|_| rng.random_range(0.0..TAU)).collect();
        let (input_gradient, angle_gradient) = circuit.gradients(&inputs, &angles, &first, Draw::default())?;
        by_inputs += length(&input_gradient);
        by_angles += length(&angle_gradient);
    }
    Ok(Row {
        qubits: spec.qubits,
        depth: spec.depth,
        points: arguments.points,
        angle_gradient_square: by_angles / arguments.points as f64,
        input_gradient_square: by_inputs / arguments.points as f64,
    })
}
