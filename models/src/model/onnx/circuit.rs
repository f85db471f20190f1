//! Quantum circuit as ONNX operators, by a matrix of `4^qubits` numbers.
//!
//! The ZZ feature map turns a uniform state by phases that are sums of `2 x_i` and `2 (pi - x_i)(pi - x_j)` over the bits of each
//! basis state: a constant matrix times the terms. RealAmplitudes is a real orthogonal matrix once its angles are trained.
//! Probabilities are squares, and expectations sums of them with signs.

use super::writer::{ExportError, Writer, int};
use crate::quantum::{Circuit, CircuitSpec, Encoding, Execution};

/// Largest number of qubits of a circuit that is written. Its matrices have 65,536 numbers.
const MOST_QUBITS: usize = 8;

/// Adds the operators of a circuit. Returns the name of its expectations.
pub(super) fn write(
    w: &mut Writer,
    name: &str,
    spec: &CircuitSpec,
    theta: &[f32],
    input: &str,
    output: &str,
) -> Result<String, ExportError> {
    let refuse = |reason: String| ExportError::Circuit { layer: name.to_owned(), reason, most: MOST_QUBITS };
    if spec.qubits > MOST_QUBITS {
        return Err(refuse(format!("a circuit of {} qubits is too large to write out", spec.qubits)));
    }
    if spec.noise.is_depolarising() {
        return Err(refuse("its gates err".to_owned()));
    }
    if !matches!(spec.execution, Execution::Exact) {
        return Err(refuse("its expectations are measured with shots".to_owned()));
    }
    let circuit = Circuit::new(spec)?;
    let (qubits, states) = (spec.qubits, 1usize << spec.qubits);
    let prefixed = |what: &str| format!("{name}.{what}");
    let theta: Vec<f64> = theta.iter().map(|&t| f64::from(t)).collect();
    // [from][to], so that rows of states multiply from the left.
    let trained: Vec<f32> = circuit.trained_matrix(&theta)?.into_iter().map(|v| v as f32).collect();
    let trained = w.constant(&prefixed("trained"), &[states, states], &trained);
    let probabilities = match spec.encoding {
        Encoding::ZzFeatureMap => {
            let [real, imaginary] = feature_map(w, name, spec, input);
            let parts = [("real", real), ("imaginary", imaginary)].map(|(part, state)| {
                let turned = w.op("MatMul", &[&state, &trained], &prefixed(&format!("turned_{part}")));
                w.op("Mul", &[&turned, &turned], &prefixed(&format!("squared_{part}")))
            });
            w.op("Add", &[&parts[0], &parts[1]], &prefixed("probabilities"))
        }
        Encoding::Angle => {
            let state = product_state(w, name, qubits, input);
            let turned = w.op("MatMul", &[&state, &trained], &prefixed("turned"));
            w.op("Mul", &[&turned, &turned], &prefixed("probabilities"))
        }
    };
    // Z on the highest qubit first; an error of the readout shrinks every expectation alike.
    let shrink = 1.0 - 2.0 * spec.noise.readout_flip as f32;
    let sign = |state: usize, qubit: usize| if state >> qubit & 1 == 0 { shrink } else { -shrink };
    let signs: Vec<f32> = (0..states).flat_map(|s| (0..qubits).rev().map(move |q| sign(s, q))).collect();
    let signs = w.constant(&prefixed("signs"), &[states, qubits], &signs);
    Ok(w.op("MatMul", &[&probabilities, &signs], output))
}

/// Real and imaginary parts `[batch][state]` after the ZZ feature map.
fn feature_map(w: &mut Writer, name: &str, spec: &CircuitSpec, input: &str) -> [String; 2] {
    let (qubits, states) = (spec.qubits, 1usize << spec.qubits);
    let prefixed = |what: &str| format!("{name}.{what}");
    let pairs: Vec<(usize, usize)> = (0..qubits).flat_map(|i| (i + 1..qubits).map(move |j| (i, j))).collect();
    let terms = phase_terms(w, name, qubits, &pairs, input);
    let count = qubits + pairs.len();
    let bit = |state: usize, qubit: usize| state >> qubit & 1;
    let mut phases = vec![0.0f32; count * states];
    for state in 0..states {
        for qubit in 0..qubits {
            phases[qubit * states + state] = 2.0 * bit(state, qubit) as f32;
        }
        for (k, &(i, j)) in pairs.iter().enumerate() {
            // CX, P, CX shifts the phase of the states in which the two qubits differ.
            phases[(qubits + k) * states + state] = 2.0 * (bit(state, i) ^ bit(state, j)) as f32;
        }
    }
    let phases = w.constant(&prefixed("phases"), &[count, states], &phases);
    let angle = w.op("MatMul", &[&terms, &phases], &prefixed("angle"));
    let cosine = w.op("Cos", &[&angle], &prefixed("cosine"));
    let sine = w.op("Sin", &[&angle], &prefixed("sine"));
    let uniform = w.constant(&prefixed("uniform"), &[1], &[(states as f32).sqrt().recip()]);
    let mut real = w.op("Mul", &[&cosine, &uniform], &prefixed("real_1"));
    let mut imaginary = w.op("Mul", &[&sine, &uniform], &prefixed("imaginary_1"));
    for repetition in 2..=spec.repetitions {
        let hadamard: Vec<f32> = (0..states * states)
            .map(|k| {
                let even = ((k / states) & (k % states)).count_ones().is_multiple_of(2);
                if even { (states as f32).sqrt().recip() } else { -(states as f32).sqrt().recip() }
            })
            .collect();
        let part = |what: &str| prefixed(&format!("{what}_{repetition}"));
        let hadamard = w.constant(&part("hadamard"), &[states, states], &hadamard);
        let a = w.op("MatMul", &[&real, &hadamard], &part("a"));
        let b = w.op("MatMul", &[&imaginary, &hadamard], &part("b"));
        let ac = w.op("Mul", &[&a, &cosine], &part("ac"));
        let bs = w.op("Mul", &[&b, &sine], &part("bs"));
        let bc = w.op("Mul", &[&b, &cosine], &part("bc"));
        let as_ = w.op("Mul", &[&a, &sine], &part("as"));
        real = w.op("Sub", &[&ac, &bs], &part("real"));
        imaginary = w.op("Add", &[&bc, &as_], &part("imaginary"));
    }
    [real, imaginary]
}

/// Terms of the phases: each `x_i`, then `(pi - x_i)(pi - x_j)` of each pair less a multiple of pi.
fn phase_terms(w: &mut Writer, name: &str, qubits: usize, pairs: &[(usize, usize)], input: &str) -> String {
    let prefixed = |what: &str| format!("{name}.{what}");
    let pi = w.constant(&prefixed("pi"), &[1], &[std::f32::consts::PI]);
    let rest = w.op("Sub", &[&pi, input], &prefixed("rest"));
    if pairs.is_empty() {
        return input.to_owned();
    }
    // Columns of (pi - x) by products with zeros and ones.
    let mut pick = |side: &str, of: &dyn Fn(&(usize, usize)) -> usize| {
        let mut matrix = vec![0.0f32; qubits * pairs.len()];
        for (k, pair) in pairs.iter().enumerate() {
            matrix[of(pair) * pairs.len() + k] = 1.0;
        }
        let matrix = w.constant(&prefixed(&format!("pick_{side}")), &[qubits, pairs.len()], &matrix);
        w.op("MatMul", &[&rest, &matrix], &prefixed(&format!("rest_{side}")))
    };
    let (first, second) = (pick("first", &|pair| pair.0), pick("second", &|pair| pair.1));
    let products = w.op("Mul", &[&first, &second], &prefixed("products"));
    // Twice a product is an angle, so multiples of pi are subtracted before large sums lose precision.
    let per_turn = w.constant(&prefixed("per_turn"), &[1], &[std::f32::consts::FRAC_1_PI]);
    let turns = w.op("Mul", &[&products, &per_turn], &prefixed("turns"));
    let whole = w.op("Round", &[&turns], &prefixed("whole_turns"));
    let whole_turns = w.op("Mul", &[&whole, &pi], &prefixed("off"));
    let products = w.op("Sub", &[&products, &whole_turns], &prefixed("rests"));
    w.op_with("Concat", &[input, &products], &prefixed("terms"), vec![int("axis", 1)])
}

/// Amplitudes `[batch][state]` after RY(x_i) on each qubit: products of `cos(x/2)` and `sin(x/2)` by the bits, qubit by qubit.
fn product_state(w: &mut Writer, name: &str, qubits: usize, input: &str) -> String {
    let prefixed = |what: &str| format!("{name}.{what}");
    let half = w.constant(&prefixed("half"), &[1], &[0.5]);
    let halves = w.op("Mul", &[input, &half], &prefixed("halves"));
    let mut state = String::new();
    for qubit in 0..qubits {
        let mut pick = vec![0.0f32; qubits];
        pick[qubit] = 1.0;
        let pick = w.constant(&prefixed(&format!("pick_{qubit}")), &[qubits, 1], &pick);
        let part = |what: &str| prefixed(&format!("{what}_{qubit}"));
        let x = w.op("MatMul", &[&halves, &pick], &part("x"));
        let cosine = w.op("Cos", &[&x], &part("cosine"));
        let sine = w.op("Sin", &[&x], &part("sine"));
        let [low, high] = if qubit == 0 {
            [cosine, sine]
        } else {
            [w.op("Mul", &[&state, &cosine], &part("low")), w.op("Mul", &[&state, &sine], &part("high"))]
        };
        // The newest qubit is the highest bit so far.
        state = w.op_with("Concat", &[&low, &high], &part("state"), vec![int("axis", 1)]);
    }
    state
}

/// Adds the five trigonometric features of the two-qubit circuit. Returns their name.
pub(super) fn write_features(w: &mut Writer, name: &str, input: &str, output: &str) -> String {
    let prefixed = |what: &str| format!("{name}.{what}");
    let pi = w.constant(&prefixed("pi"), &[1], &[std::f32::consts::PI]);
    let two = w.constant(&prefixed("two"), &[1], &[2.0]);
    let picks = [0, 1].map(|k| {
        let column = if k == 0 { [1.0, 0.0] } else { [0.0, 1.0] };
        let pick = w.constant(&prefixed(&format!("pick_{k}")), &[2, 1], &column);
        w.op("MatMul", &[input, &pick], &prefixed(&format!("x_{k}")))
    });
    let rests = [0, 1].map(|k| w.op("Sub", &[&pi, &picks[k]], &prefixed(&format!("rest_{k}"))));
    let product = w.op("Mul", &[&rests[0], &rests[1]], &prefixed("product"));
    let w_angle = w.op("Mul", &[&product, &two], &prefixed("w"));
    let doubles = [0, 1].map(|k| w.op("Mul", &[&picks[k], &two], &prefixed(&format!("double_{k}"))));
    let mut op = |kind: &str, angle: &str, what: &str| w.op(kind, &[angle], &prefixed(what));
    let (sw, cw) = (op("Sin", &w_angle, "sw"), op("Cos", &w_angle, "cw"));
    let (s0, c0) = (op("Sin", &doubles[0], "s0"), op("Cos", &doubles[0], "c0"));
    let (s1, c1) = (op("Sin", &doubles[1], "s1"), op("Cos", &doubles[1], "c1"));
    let pairs = [("a", &s1, &sw), ("b", &s0, &sw), ("c", &c0, &c1), ("d", &c1, &cw), ("e", &c0, &cw)];
    let features = pairs.map(|(what, x, y)| w.op("Mul", &[x, y], &prefixed(what)));
    w.op_with("Concat", &features.each_ref().map(String::as_str), output, vec![int("axis", 1)])
}
