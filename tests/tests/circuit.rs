//! Tests of `radome bench circuit` with circuits other than the paper's.

use radome_tests::{command, json_lines, outcome, subcommand, wrong_use_with};

fn evaluate_circuit(arguments: &str) -> serde_json::Value {
    json_lines(command!("bench circuit --json", ..arguments.split(' '))).remove(0)
}

fn numbers(value: &serde_json::Value) -> Vec<f64> {
    value.as_array().expect("a list").iter().map(|v| v.as_f64().expect("a number")).collect()
}

/// Asserts cosines for circuits without entangler; the first output belongs to the highest qubit.
#[test]
fn circuits_without_entangler_give_cosines_of_summed_angles() {
    let got = evaluate_circuit("--qubits 3 --encoding angle --depth 0 --x 0.1,0.2,0.3 --theta 1,-2,0.5");
    for (key, angle) in [("zii", 0.8f64), ("izi", -1.8), ("iiz", 1.1)] {
        assert!((got[key].as_f64().expect("number") - angle.cos()).abs() < 1e-14, "{key}");
    }
    assert!((numbers(&got["zii_grad_x"])[2] + 0.8f64.sin()).abs() < 1e-14);
    let noisy =
        evaluate_circuit("--qubits 3 --encoding angle --depth 0 --x 0.1,0.2,0.3 --theta 1,-2,0.5 --readout-flip 0.25");
    assert!((noisy["iiz"].as_f64().expect("number") - 0.5 * 1.1f64.cos()).abs() < 1e-14);
}

/// Asserts variances 1/4 and 1 for one qubit without entangler, `-cos(2x) sin(theta)`, and smaller gradients for more
/// qubits at the depth that scrambles most.
#[test]
fn gradients_shrink_with_qubits() {
    let bench = |arguments: &str| json_lines(command!("bench trainability --json", ..arguments.split(' '))).remove(0);
    let one = &bench("--qubits 1 --depths 0 --points 4000")[0];
    for (key, want) in [("angle_gradient_square", 0.25), ("input_gradient_square", 1.0)] {
        let got = one[key].as_f64().expect("a number");
        // Tolerance of five standard errors.
        assert!((got - want).abs() < 5.0 * 1.2 * want / 4000f64.sqrt(), "{key}: {got}");
    }
    let deep = bench("--qubits 8 --depths 8 --points 300");
    let squares: Vec<f64> =
        [1, 3, 5, 7].map(|index| deep[index]["angle_gradient_square"].as_f64().expect("a number")).into();
    assert!(squares.windows(2).all(|pair| pair[1] < pair[0]), "{squares:?}");
    assert_eq!(bench("--qubits 2 --points 3"), bench("--qubits 2 --points 3"));
}

#[test]
fn shots_are_seeded_and_defaults_are_those_of_the_paper() {
    let at = |rest: &str| evaluate_circuit(&format!("--x 0.8,2.1 --theta 0.4,-1.2,2,0.7 {rest}"));
    let exact = at("--depth 1");
    assert_eq!(exact, at("--qubits 2 --encoding zz --repetitions 1"));
    assert_ne!(exact, at("--repetitions 2"));
    let (one, two) = (at("--shots 4096 --seed 1"), at("--shots 4096 --seed 2"));
    assert_eq!(one, at("--shots 4096 --seed 1"));
    assert_ne!(one["zi"], two["zi"]);
    // Exact gradients come from the state vector here and from the closed form in the reference.
    let gradient = numbers(&at("--shots 4096 --gradient exact")["zi_grad_theta"]);
    for (got, want) in gradient.iter().zip(numbers(&exact["zi_grad_theta"])) {
        assert!((got - want).abs() < 1e-14);
    }
    assert_eq!(at("--shots 1")["iz"].as_f64().map(f64::abs), Some(1.0));
}

mod hard_cases {
    use super::*;

    #[test]
    fn invalid_circuits_are_refused_with_their_reason() {
        for (arguments, part) in [
            ("--x 1,2,3 --theta 1,2,3,4,5,6", "--x takes two numbers and --theta four, got 3 and 6"),
            ("--qubits 3 --x 1,2,3 --theta 1,2,3,4", "--x takes three numbers and --theta six, got 3 and 4"),
            ("--qubits 12 --x 1 --theta 1", "--x takes twelve numbers and --theta 24, got 1 and 1"),
            ("--qubits 13 --x 1 --theta 1", "qubits is 13, expected 1 to 12"),
            ("--repetitions 3 --x 1,2 --theta 1,2,3,4", "repetitions is 3, expected 1 or 2"),
            ("--shots 0 --x 1,2 --theta 1,2,3,4", "shots is 0, expected at least 1"),
            ("--readout-flip -0.5 --x 1,2 --theta 1,2,3,4", "readout_flip is -0.5, expected a probability"),
            ("--qubits 8 --depolarising-two-qubit 0.1 --x 1 --theta 1", "at most 6 with depolarising gates"),
            ("--x nan,2 --theta 1,2,3,4", "must be finite"),
        ] {
            wrong_use_with(command!("bench circuit", ..arguments.split(' ')), &[part]);
        }
        wrong_use_with(subcommand("bench trainability --qubits 0"), &["--qubits is 0, expected at least 1"]);
        let (status, ..) = outcome(subcommand("bench circuit --x 1,2 --theta 1,2,3,4 --seed 3"));
        assert_eq!(status, Some(2), "a seed of nothing");
    }
}
