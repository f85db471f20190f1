use radome_models::quantum::{Circuit, CircuitSpec, Draw, Encoding, Execution, Jacobian, Noise, ShotGradient, Shots};
use serde::{Serialize, Serializer};

use crate::exit::wrong_use;
use crate::one_of::one_of;
use crate::output;
use crate::source::DEFAULT_SEED;

/// `radome bench circuit`
#[derive(clap::Args)]
pub struct Arguments {
    /// Inputs X0,X1,... in radians, one for each qubit
    #[arg(long, value_delimiter = ',', num_args = 1, allow_hyphen_values = true, required = true)]
    x: Vec<f64>,
    /// Angles T0,T1,... in radians, one for each qubit and each of depth + 1 layers
    #[arg(long, value_delimiter = ',', num_args = 1, allow_hyphen_values = true, required = true)]
    theta: Vec<f64>,
    /// Qubits, 1 to 12
    #[arg(long, default_value_t = 2)]
    qubits: usize,
    /// Encoding of inputs: the ZZ feature map, or RY(x)
    #[arg(long, value_parser = one_of(ENCODINGS), default_value = "zz")]
    encoding: Encoding,
    /// Repetitions of the feature map, 1 or 2
    #[arg(long, default_value_t = 1)]
    repetitions: usize,
    /// Repetitions of the trained part
    #[arg(long, default_value_t = 1)]
    depth: usize,
    /// Number of measurements for estimates instead of exact expectations
    #[arg(long, value_name = "COUNT")]
    shots: Option<u32>,
    /// Seed of the measurements' outcomes
    #[arg(long, default_value_t = DEFAULT_SEED, requires = "shots")]
    seed: u64,
    /// Gradients with --shots: by parameter shift from separate shots, or exact
    #[arg(long, value_parser = one_of(GRADIENTS), default_value = "shots", requires = "shots")]
    gradient: ShotGradient,
    /// Depolarising probability after each gate on one qubit
    #[arg(long, value_name = "P", default_value_t = 0.0, allow_hyphen_values = true)]
    depolarising_one_qubit: f64,
    /// Depolarising probability after each gate on two qubits
    #[arg(long, value_name = "P", default_value_t = 0.0, allow_hyphen_values = true)]
    depolarising_two_qubit: f64,
    /// Probability that an outcome is read wrongly
    #[arg(long, value_name = "P", default_value_t = 0.0, allow_hyphen_values = true)]
    readout_flip: f64,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

const ENCODINGS: &[(&str, Encoding)] = &[("zz", Encoding::ZzFeatureMap), ("angle", Encoding::Angle)];

const GRADIENTS: &[(&str, ShotGradient)] = &[("shots", ShotGradient::Shots), ("exact", ShotGradient::Exact)];

/// Evaluates a quantum circuit at one point.
///
/// # Errors
/// The circuit is not valid, or inputs and angles are not as many as it takes.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let spec = arguments.spec();
    let circuit = match Circuit::new(&spec) {
        Ok(circuit) => circuit,
        Err(error) => wrong_use!("{error}"),
    };
    let (x, theta) = (&arguments.x, &arguments.theta);
    let (inputs, angles) = (circuit.qubits(), circuit.angle_count());
    if (x.len(), theta.len()) != (inputs, angles) {
        wrong_use!(
            "--x takes {} {} and --theta {}, got {} and {}\n\n\
             hint: an input for each of --qubits, and as many angles for each of --depth + 1 layers",
            in_words(inputs),
            if inputs == 1 { "number" } else { "numbers" },
            in_words(angles),
            x.len(),
            theta.len()
        );
    }
    if !x.iter().chain(theta).all(|v| v.is_finite()) {
        wrong_use!("--x and --theta must be finite numbers");
    }
    let jacobian = circuit.jacobian(x, theta, Draw::default())?;
    let answer = Answer { names: spec.observables(), jacobian };
    if arguments.json { output::json_line(&answer) } else { answer.print() }
}

impl Arguments {
    fn spec(&self) -> CircuitSpec {
        CircuitSpec {
            qubits: self.qubits,
            encoding: self.encoding,
            repetitions: self.repetitions,
            depth: self.depth,
            execution: match self.shots {
                None => Execution::Exact,
                Some(count) => Execution::Shots(Shots { count, seed: self.seed, gradient: self.gradient }),
            },
            noise: Noise {
                depolarising_one_qubit: self.depolarising_one_qubit,
                depolarising_two_qubit: self.depolarising_two_qubit,
                readout_flip: self.readout_flip,
            },
        }
    }
}

/// Expectations and gradients, keyed by the names of observables: `ZI`, `IZ`.
struct Answer {
    names: Vec<String>,
    jacobian: Jacobian,
}

impl Answer {
    fn print(&self) -> anyhow::Result<()> {
        let (names, j) = (&self.names, &self.jacobian);
        let values = names.iter().zip(&j.expectations).map(|(name, v)| format!("<{name}> {v:+.12}"));
        output::text_line(&values.collect::<Vec<_>>().join("   "))?;
        for (name, gradient) in names.iter().zip(&j.by_theta) {
            output::text_line(&format!("d<{name}>/dtheta {gradient:?}"))?;
        }
        for (name, gradient) in names.iter().zip(&j.by_x) {
            output::text_line(&format!("d<{name}>/dx     {gradient:?}"))?;
        }
        Ok(())
    }
}

impl Serialize for Answer {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        use serde::ser::SerializeMap;
        let (j, mut map) = (&self.jacobian, serializer.serialize_map(None)?);
        let names: Vec<String> = self.names.iter().map(|n| n.to_lowercase()).collect();
        for (name, value) in names.iter().zip(&j.expectations) {
            map.serialize_entry(name, value)?;
        }
        for (rows, by) in [(&j.by_theta, "theta"), (&j.by_x, "x")] {
            for (name, row) in names.iter().zip(rows) {
                map.serialize_entry(&format!("{name}_grad_{by}"), row)?;
            }
        }
        map.end()
    }
}

fn in_words(count: usize) -> String {
    const WORDS: [&str; 13] =
        ["no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve"];
    WORDS.get(count).map_or_else(|| count.to_string(), |word| (*word).to_owned())
}
