use std::f64::consts::PI;

use rand::Rng;

use super::state_vector::{parameter_shift, run_at, z_expectations};
use super::*;
use crate::random::stream;

/// Draw of all circuits, which only those with shots depend on.
const FIRST_DRAW: Draw = Draw { call: 0, row: 0 };

fn zz(qubits: usize, repetitions: usize, depth: usize) -> CircuitSpec {
    CircuitSpec { qubits, repetitions, depth, ..CircuitSpec::default() }
}

fn by_angle(qubits: usize, depth: usize) -> CircuitSpec {
    CircuitSpec { qubits, depth, encoding: Encoding::Angle, ..CircuitSpec::default() }
}

fn with_shots(count: u32, seed: u64, gradient: ShotGradient) -> Execution {
    Execution::Shots(Shots { count, seed, gradient })
}

fn build(spec: &CircuitSpec) -> Circuit {
    Circuit::new(spec).expect("a good spec")
}

/// Inputs in the HQNN's range and any angles.
fn point(circuit: &Circuit, index: u64) -> (Vec<f64>, Vec<f64>) {
    let mut rng = stream(7, "circuit points", index);
    let x = (0..circuit.qubits()).map(|_| rng.random_range(0.0..PI)).collect();
    (x, (0..circuit.angle_count()).map(|_| rng.random_range(-PI..PI)).collect())
}

fn assert_near(what: &str, got: &[f64], want: &[f64], tolerance: f64) {
    assert_eq!(got.len(), want.len(), "{what}");
    for (k, (got, want)) in got.iter().zip(want).enumerate() {
        assert!((got - want).abs() <= tolerance, "{what} [{k}]: {got} against {want}");
    }
}

/// Circuits of many sizes on which every method is compared with the reference.
fn sample_specs() -> Vec<CircuitSpec> {
    let mut specs = vec![zz(2, 1, 1), zz(2, 2, 1), zz(1, 1, 0), zz(1, 2, 3), zz(12, 1, 1), zz(9, 2, 2)];
    specs.extend((1..=7).flat_map(|n| [zz(n, 1, n % 3), zz(n, 2, 2), by_angle(n, n % 4)]));
    specs
}

/// Points computed with Qiskit 2.6.2: values from its Statevector, gradients by parameter shift and autograd.
#[test]
fn agrees_with_qiskit_at_every_recorded_point() {
    let text = include_str!("../../../fixtures/circuit/qiskit_pqc.json");
    let json: serde_json::Value = serde_json::from_str(text).expect("JSON");
    let list = |v: &serde_json::Value| -> Vec<f64> {
        v.as_array().expect("array").iter().map(|n| n.as_f64().expect("number")).collect()
    };
    for repetitions in [1, 2] {
        let circuit = build(&zz(2, repetitions, 1));
        let points = json["reps"][repetitions.to_string()]["points"].as_array().expect("points");
        assert_eq!(points.len(), 25);
        for point in points {
            let (x, theta) = (list(&point["x"]), list(&point["theta"]));
            let ours = circuit.jacobian(&x, &theta, FIRST_DRAW).expect("answer");
            let slow = state_vector::run(&circuit, &x, &theta).expect("answer").expectations();
            for (o, name) in ["ZI", "IZ"].into_iter().enumerate() {
                let want = point["exp"][name].as_f64().expect("number");
                assert_near(name, &[ours.expectations[o], slow[o]], &[want; 2], 1e-12);
                assert_near("by theta", &ours.by_theta[o], &list(&point["grad_theta"][name]), 1e-9);
                assert_near("by x", &ours.by_x[o], &list(&point["grad_x"][name]), 1e-9);
            }
        }
    }
}

#[test]
fn all_methods_agree_with_gate_by_gate_simulation_and_parameter_shift() {
    for (index, spec) in sample_specs().iter().enumerate() {
        let circuit = build(spec);
        let (x, theta) = point(&circuit, index as u64);
        let angles = circuit.gate_angles(&x, &theta);
        let slow = run_at(&circuit, &angles);
        assert!((slow.probabilities().iter().sum::<f64>() - 1.0).abs() < 1e-13);
        let cotangent: Vec<f64> = (0..spec.qubits).map(|k| (k as f64 + 0.3).sin()).collect();
        let expectations = circuit.expectations(&x, &theta, FIRST_DRAW).expect("answer");
        assert_near("expectations", &expectations, &slow.expectations(), 1e-12);

        let by_gate: Vec<f64> = if spec.qubits > 9 {
            continue; // Hundreds of slow runs; `twelve_qubits` tests some of them.
        } else {
            let jacobian = parameter_shift(&angles, |angles| run_at(&circuit, angles).expectations());
            (0..angles.len()).map(|k| jacobian.iter().zip(&cotangent).map(|(row, g)| row[k] * g).sum()).collect()
        };
        let (want_x, want_theta) = circuit.pull_back(&x, &by_gate);
        let (by_x, by_theta) = circuit.gradients(&x, &theta, &cotangent, FIRST_DRAW).expect("answer");
        assert_near("by x", &by_x, &want_x, 1e-11);
        assert_near("by theta", &by_theta, &want_theta, 1e-12);

        let jacobian = circuit.jacobian(&x, &theta, FIRST_DRAW).expect("answer");
        let mixed = |rows: &[Vec<f64>], k: usize| rows.iter().zip(&cotangent).map(|(row, g)| row[k] * g).sum::<f64>();
        assert_near("rows by x", &(0..x.len()).map(|k| mixed(&jacobian.by_x, k)).collect::<Vec<_>>(), &want_x, 1e-11);
        let rows_by_theta: Vec<f64> = (0..theta.len()).map(|k| mixed(&jacobian.by_theta, k)).collect();
        assert_near("rows by theta", &rows_by_theta, &want_theta, 1e-12);
    }
}

/// One input feeds a phase of its own and one with each other input, twice with two repetitions.
#[test]
fn gradients_by_inputs_are_those_of_finite_differences() {
    for spec in [zz(2, 1, 1), zz(2, 2, 1), zz(4, 1, 1), zz(3, 2, 2), by_angle(3, 1)] {
        let circuit = build(&spec);
        let (x, theta) = point(&circuit, 3);
        let jacobian = circuit.jacobian(&x, &theta, FIRST_DRAW).expect("answer");
        let h = 1e-5;
        for k in 0..x.len() {
            let at = |by: f64| {
                let mut moved = x.clone();
                moved[k] += by;
                state_vector::run(&circuit, &moved, &theta).expect("answer").expectations()
            };
            let (p, m) = (at(h), at(-h));
            for o in 0..spec.qubits {
                let want = (p[o] - m[o]) / (2.0 * h);
                assert!((jacobian.by_x[o][k] - want).abs() < 1e-6, "{spec:?} {o} {k}: {want}");
            }
        }
    }
}

/// RY(x) on |0> has <Z> = cos x, and rotations about one axis add up.
#[test]
fn angle_encoding_without_an_entangler_is_cosines() {
    let circuit = build(&by_angle(3, 0));
    let (x, theta) = ([0.3, 1.1, 2.9], [0.5, -1.0, 2.0]);
    let got = circuit.jacobian(&x, &theta, FIRST_DRAW).expect("answer");
    for o in 0..3 {
        let q = 2 - o;
        assert!((got.expectations[o] - (x[q] + theta[q]).cos()).abs() < 1e-15);
        for k in 0..3 {
            let want = if k == q { -(x[q] + theta[q]).sin() } else { 0.0 };
            assert!((got.by_x[o][k] - want).abs() < 1e-15 && (got.by_theta[o][k] - want).abs() < 1e-15);
        }
    }
}

mod measured {
    use super::*;

    /// Two-sided threshold that a normal variable exceeds once in a million.
    const Z_ONE_IN_A_MILLION: f64 = 4.892;

    /// Means of estimates are tested as normal variables, sums of their squares as chi-squared ones of `runs` degrees of
    /// freedom (normal to a few per cent at 2000, hence the wider threshold). Under 40 comparisons: a false alarm once in
    /// 25,000 seeds at most, and the seed is fixed.
    #[test]
    fn estimates_scatter_as_the_binomial_law_says() {
        let runs = 2000u64;
        for (qubits, count) in [(2, 1), (2, 4096), (3, 100), (5, 64)] {
            let spec = CircuitSpec { execution: with_shots(count, 3, ShotGradient::Shots), ..zz(qubits, 1, 1) };
            let (circuit, exact) = (build(&spec), build(&zz(qubits, 1, 1)));
            let (x, theta) = point(&circuit, 11);
            let want = exact.expectations(&x, &theta, FIRST_DRAW).expect("answer");
            let estimates: Vec<Vec<f64>> =
                (0..runs).map(|row| circuit.expectations(&x, &theta, Draw { call: 5, row }).expect("answer")).collect();
            for o in 0..qubits {
                let variance = (1.0 - want[o] * want[o]) / f64::from(count);
                let mean = estimates.iter().map(|e| e[o]).sum::<f64>() / runs as f64;
                let z = (mean - want[o]) / (variance / runs as f64).sqrt();
                assert!(z.abs() < Z_ONE_IN_A_MILLION, "{qubits} qubits, {count} shots: {mean} {} z {z}", want[o]);
                // Kurtosis of a mean of `count` outcomes of +-1: 3 + (1 / (1 - <Z>^2) 4 - 6) / count.
                let excess = (4.0 / (1.0 - want[o] * want[o]) - 6.0) / f64::from(count);
                let found = estimates.iter().map(|e| (e[o] - want[o]).powi(2)).sum::<f64>() / runs as f64;
                let z = (found / variance - 1.0) / ((2.0 + excess) / runs as f64).sqrt();
                assert!(z.abs() < 1.1 * Z_ONE_IN_A_MILLION, "{qubits} qubits, {count} shots: {found} {variance} z {z}");
            }
        }
    }

    /// Pearson's chi-squared of all outcomes of three qubits against their probabilities, 7 degrees of freedom: above
    /// 40.5 once in a million.
    #[test]
    fn outcomes_have_their_probabilities() {
        let circuit = build(&zz(3, 1, 1));
        let (x, theta) = point(&circuit, 2);
        let p = run_at(&circuit, &circuit.gate_angles(&x, &theta)).probabilities();
        // The signs of a single shot's expectations are its outcome.
        let (shots, mut rng) = (1u32, stream(9, "outcomes", 0));
        let mut counts = [0u32; 8];
        let runs = 20_000;
        for _ in 0..runs {
            let z = super::super::shots::estimate(&p, shots, &mut rng);
            let outcome = z.iter().fold(0, |k, &z| 2 * k + usize::from(z < 0.0));
            assert!(z.iter().all(|z| z.abs() == 1.0));
            counts[outcome] += 1;
        }
        let chi_squared: f64 = counts
            .iter()
            .zip(&p)
            .map(|(&n, &p)| (f64::from(n) - p * f64::from(runs)).powi(2) / (p * f64::from(runs)))
            .sum();
        assert!(chi_squared < 40.5, "{chi_squared} {counts:?} {p:?}");
    }

    /// Mean over many draws is the exact gradient, within the standard error: at most 16 gate derivatives, each half a
    /// difference of two means with variance up to 1 / shots.
    #[test]
    fn gradients_from_shots_are_unbiased_and_exact_ones_exact() {
        let (count, runs) = (200u32, 400u64);
        for spec in [zz(2, 1, 1), zz(2, 2, 0), by_angle(3, 1)] {
            let (x, theta) = point(&build(&spec), 4);
            let cotangent: Vec<f64> = (0..spec.qubits).map(|k| 1.0 - 0.6 * k as f64).collect();
            let want = build(&spec).gradients(&x, &theta, &cotangent, FIRST_DRAW).expect("answer");
            let of = |gradient| build(&CircuitSpec { execution: with_shots(count, 1, gradient), ..spec.clone() });
            let exact = of(ShotGradient::Exact).gradients(&x, &theta, &cotangent, FIRST_DRAW).expect("answer");
            // The paper's circuit has a closed form for expectations, gradients are the state vector's for both.
            assert_eq!(exact, want);

            let circuit = of(ShotGradient::Shots);
            let draws: Vec<_> = (0..runs)
                .map(|call| circuit.gradients(&x, &theta, &cotangent, Draw { call, row: 0 }).expect("answer"))
                .collect();
            let norm: f64 = cotangent.iter().map(|g| g.abs()).sum();
            // Variance for one gate. For an input, the squares of the chain rule's factors add up.
            let gate_variance = norm * norm * 0.5 / f64::from(count);
            for (k, want) in want.1.iter().enumerate() {
                let mean = draws.iter().map(|d| d.1[k]).sum::<f64>() / runs as f64;
                let bound = Z_ONE_IN_A_MILLION * (gate_variance / runs as f64).sqrt();
                assert!((mean - want).abs() < bound, "theta {k}: {mean} {want}");
            }
            for (k, want) in want.0.iter().enumerate() {
                let mean = draws.iter().map(|d| d.0[k]).sum::<f64>() / runs as f64;
                let others: f64 =
                    x.iter().enumerate().filter(|(j, _)| *j != k).map(|(_, x)| 4.0 * (PI - x).powi(2)).sum();
                let factors = if spec.encoding == Encoding::Angle { 1.0 } else { 2.0 * (4.0 + others) };
                let bound = Z_ONE_IN_A_MILLION * (factors * gate_variance / runs as f64).sqrt();
                assert!((mean - want).abs() < bound, "x {k}: {mean} {want}");
            }
        }
    }

    #[test]
    fn outcomes_depend_on_seed_call_and_row_only() {
        let circuit = build(&CircuitSpec { execution: with_shots(1000, 1, ShotGradient::Shots), ..zz(3, 1, 1) });
        let other = build(&CircuitSpec { execution: with_shots(1000, 2, ShotGradient::Shots), ..zz(3, 1, 1) });
        let (x, theta) = point(&circuit, 4);
        let at = |c: &Circuit, call, row| c.expectations(&x, &theta, Draw { call, row }).expect("answer");
        let one = at(&circuit, 4, 7);
        assert_eq!(one, at(&circuit, 4, 7));
        for another in [at(&circuit, 7, 4), at(&circuit, 5, 7), at(&circuit, 4, 8), at(&other, 4, 7)] {
            assert_ne!(one, another);
        }
    }
}

mod noisy {
    use super::*;
    use crate::quantum::gates::Gate;
    use crate::quantum::state_vector::State;

    fn noise(one: f64, two: f64, readout: f64) -> Noise {
        Noise { depolarising_one_qubit: one, depolarising_two_qubit: two, readout_flip: readout }
    }

    /// Every gate on a single qubit shrinks its Bloch vector by `1 - p`, its readout by `1 - 2q`.
    #[test]
    fn a_single_qubit_shrinks_by_each_gate_and_by_readout_errors() {
        let (p, q) = (0.03, 0.1);
        let quiet = zz(1, 2, 2);
        let gates = 2 * 2 + 3;
        let loud = CircuitSpec { noise: noise(p, 0.5, q), ..quiet.clone() };
        let (x, theta) = point(&build(&quiet), 1);
        let want = build(&quiet).jacobian(&x, &theta, FIRST_DRAW).expect("answer");
        let got = build(&loud).jacobian(&x, &theta, FIRST_DRAW).expect("answer");
        let factor = (1.0f64 - p).powi(gates) * (1.0 - 2.0 * q);
        assert_near("<Z>", &got.expectations, &[want.expectations[0] * factor], 1e-14);
        assert_near(
            "by theta",
            &got.by_theta[0],
            &want.by_theta[0].iter().map(|g| g * factor).collect::<Vec<_>>(),
            1e-13,
        );
        assert_near("by x", &got.by_x[0], &[want.by_x[0][0] * factor], 1e-13);
    }

    /// With depolarising one-qubit gates and no entangler the qubits are independent.
    #[test]
    fn qubits_without_entangler_are_depolarised_independently() {
        let spec = CircuitSpec { noise: noise(0.2, 0.9, 0.0), ..by_angle(3, 0) };
        let (x, theta) = point(&build(&spec), 5);
        let got = build(&spec).expectations(&x, &theta, FIRST_DRAW).expect("answer");
        for (o, got) in got.iter().enumerate() {
            assert!((got - 0.64 * (x[2 - o] + theta[2 - o]).cos()).abs() < 1e-14);
        }
    }

    /// Readout errors alone need no density matrix, so any number of qubits can have them.
    #[test]
    fn readout_errors_shrink_every_expectation() {
        let spec = CircuitSpec { noise: noise(0.0, 0.0, 0.07), ..zz(8, 1, 1) };
        let (x, theta) = point(&build(&spec), 6);
        let (got, want) =
            (build(&spec).jacobian(&x, &theta, FIRST_DRAW), build(&zz(8, 1, 1)).jacobian(&x, &theta, FIRST_DRAW));
        let (got, want) = (got.expect("answer"), want.expect("answer"));
        let shrunk = |v: &[f64]| v.iter().map(|v| 0.86 * v).collect::<Vec<_>>();
        assert_near("<Z>", &got.expectations, &shrunk(&want.expectations), 1e-13);
        assert_near("by x", &got.by_x[3], &shrunk(&want.by_x[3]), 1e-11);
    }

    /// The last entangler's CX depolarise both of their qubits fully, so no output depends on the input.
    #[test]
    fn gates_that_depolarise_fully_leave_nothing() {
        let spec = CircuitSpec { noise: noise(0.0, 1.0, 0.0), ..zz(3, 1, 1) };
        let (x, theta) = point(&build(&spec), 7);
        let got = build(&spec).jacobian(&x, &theta, FIRST_DRAW).expect("answer");
        assert_near("<Z>", &got.expectations, &[0.0; 3], 1e-15);
        assert_near("by x", &got.by_x.concat(), &[0.0; 9], 1e-15);
    }

    #[test]
    fn a_density_matrix_without_noise_is_the_state() {
        // Noise below rounding selects the density matrix.
        for spec in [zz(2, 1, 1), zz(3, 2, 1), by_angle(4, 2)] {
            let faint = CircuitSpec { noise: noise(1e-300, 0.0, 0.0), ..spec.clone() };
            let (x, theta) = point(&build(&spec), 8);
            let want = build(&spec).jacobian(&x, &theta, FIRST_DRAW).expect("answer");
            let got = build(&faint).jacobian(&x, &theta, FIRST_DRAW).expect("answer");
            assert_near("expectations", &got.expectations, &want.expectations, 1e-13);
            assert_near("by x", &got.by_x.concat(), &want.by_x.concat(), 1e-11);
            assert_near("by theta", &got.by_theta.concat(), &want.by_theta.concat(), 1e-12);
        }
    }

    /// Propagation of the observable agrees with whole runs of the shifted circuit.
    #[test]
    fn gradients_are_those_of_parameter_shift() {
        let spec = CircuitSpec { noise: noise(0.02, 0.05, 0.03), ..zz(3, 2, 2) };
        let circuit = build(&spec);
        let (x, theta) = point(&circuit, 9);
        let run = |angles: &[f64]| {
            let mut p = super::super::noise::probabilities(&circuit, angles);
            super::super::noise::read_out(&mut p, 0.03);
            z_expectations(&p)
        };
        let rows = parameter_shift(&circuit.gate_angles(&x, &theta), run);
        let got = circuit.jacobian(&x, &theta, FIRST_DRAW).expect("answer");
        for (o, row) in rows.iter().enumerate() {
            let (by_x, by_theta) = circuit.pull_back(&x, row);
            assert_near("by x", &got.by_x[o], &by_x, 1e-12);
            assert_near("by theta", &got.by_theta[o], &by_theta, 1e-13);
        }
    }

    /// A depolarising gate of strength p is, with probability p, a Pauli string drawn from all 4 or 16, the identity
    /// among them. 20,000 trajectories; a mean is further out than 4.892 standard errors once in a million.
    #[test]
    fn density_matrices_are_the_mean_of_pauli_trajectories() {
        let (one, two) = (0.05, 0.15);
        let spec = CircuitSpec { noise: noise(one, two, 0.0), ..zz(3, 1, 1) };
        let circuit = build(&spec);
        let (x, theta) = point(&circuit, 10);
        let angles = circuit.gate_angles(&x, &theta);
        let (runs, mut rng) = (20_000, stream(2, "trajectories", 0));
        let (mut sums, mut squares) = ([0.0; 3], [0.0; 3]);
        for _ in 0..runs {
            let mut state = State::zero(3);
            for &gate in circuit.gates.iter() {
                state.apply(gate, &angles);
                let (p, qubits) = match gate {
                    Gate::ControlledNot { control, target } => (two, vec![control, target]),
                    Gate::Hadamard { qubit } | Gate::Phase { qubit, .. } | Gate::RotationY { qubit, .. } => {
                        (one, vec![qubit])
                    }
                };
                if rng.random_bool(p) {
                    for qubit in qubits {
                        // X is H Z H, and Y their product but for a global phase.
                        if rng.random_bool(0.5) {
                            state.phase(qubit, PI);
                        }
                        if rng.random_bool(0.5) {
                            state.hadamard(qubit);
                            state.phase(qubit, PI);
                            state.hadamard(qubit);
                        }
                    }
                }
            }
            for (o, z) in state.expectations().into_iter().enumerate() {
                sums[o] += z;
                squares[o] += z * z;
            }
        }
        let want = circuit.expectations(&x, &theta, FIRST_DRAW).expect("answer");
        let quiet = build(&zz(3, 1, 1)).expectations(&x, &theta, FIRST_DRAW).expect("answer");
        for o in 0..3 {
            let mean = sums[o] / f64::from(runs);
            let error = ((squares[o] / f64::from(runs) - mean * mean) / f64::from(runs)).sqrt();
            assert!((mean - want[o]).abs() < 4.892 * error, "{o}: {mean} {} error {error}", want[o]);
            assert!((quiet[o] - want[o]).abs() > 4.892 * error, "the noise is seen: {quiet:?} {want:?} {error}");
        }
    }

    #[test]
    fn shots_of_noisy_circuits_are_biased_as_the_noise_is() {
        let exact = CircuitSpec { noise: noise(0.02, 0.05, 0.1), ..zz(2, 1, 1) };
        let spec = CircuitSpec { execution: with_shots(1_000_000, 4, ShotGradient::Shots), ..exact.clone() };
        let (x, theta) = point(&build(&spec), 12);
        let got = build(&spec).expectations(&x, &theta, FIRST_DRAW).expect("answer");
        // Standard error of at most 1e-3; five of them.
        assert_near("<Z>", &got, &build(&exact).expectations(&x, &theta, FIRST_DRAW).expect("answer"), 5e-3);
    }
}

mod hard_cases {
    use super::*;

    #[test]
    fn observables_are_in_qiskit_order() {
        assert_eq!(zz(3, 1, 1).observables(), ["ZII", "IZI", "IIZ"]);
        // A qubit's last rotation follows the entangler, so only this qubit's observable depends on it.
        for n in [2, 3, 5] {
            let circuit = build(&zz(n, 1, 1));
            let (x, theta) = point(&circuit, 1);
            let by_theta = circuit.jacobian(&x, &theta, FIRST_DRAW).expect("answer").by_theta;
            for (o, row) in by_theta.iter().enumerate() {
                for q in (0..n).filter(|&q| q != n - 1 - o) {
                    assert!(row[n + q].abs() < 1e-15, "{n} qubits: observable {o} of qubit {q}: {}", row[n + q]);
                }
                assert!(row[2 * n - 1 - o].abs() > 1e-3);
            }
        }
    }

    /// At 0 and pi a single phase is a full turn, so expectations are derived by hand.
    #[test]
    fn angles_at_zero_and_pi() {
        for n in 1..=5 {
            let circuit = build(&zz(n, 1, 0));
            // Phases alone leave every qubit on the equator.
            let level = circuit.expectations(&vec![0.4; n], &vec![0.0; n], FIRST_DRAW).expect("answer");
            assert_near("equator", &level, &vec![0.0; n], 1e-14);
            // At pi all phases vanish: |+>, which RY(pi / 2) takes to |1>, RY(-pi/2) to |0>.
            let down = circuit.expectations(&vec![PI; n], &vec![PI / 2.0; n], FIRST_DRAW).expect("answer");
            assert_near("down", &down, &vec![-1.0; n], 1e-14);
            let turned = build(&by_angle(n, 0));
            for (x, theta, want) in [(0.0, 0.0, 1.0), (PI, 0.0, -1.0), (PI, PI, 1.0), (0.0, PI, -1.0)] {
                let got = turned.jacobian(&vec![x; n], &vec![theta; n], FIRST_DRAW).expect("answer");
                assert_near("poles", &got.expectations, &vec![want; n], 1e-14);
                assert_near("flat", &got.by_x.concat(), &vec![0.0; n * n], 1e-14);
            }
        }
        let [zi, iz] = expectations([0.0, PI], [0.0; 4]);
        assert!(zi.abs() <= 1.0 && iz.abs() <= 1.0);
    }

    #[test]
    fn nan_and_infinite_inputs_give_nan() {
        let base = [zz(2, 1, 1), zz(3, 2, 1), zz(1, 1, 0), by_angle(3, 1)];
        let noise = Noise { depolarising_one_qubit: 0.1, depolarising_two_qubit: 0.1, readout_flip: 0.1 };
        let specs = base.iter().flat_map(|spec| {
            let shots = [ShotGradient::Shots, ShotGradient::Exact].map(|g| with_shots(10, 1, g));
            let executions = [Execution::Exact, shots[0], shots[1]];
            executions.into_iter().flat_map(move |execution| {
                [noise, Noise::default()].map(|noise| CircuitSpec { execution, noise, ..spec.clone() })
            })
        });
        for spec in specs {
            let circuit = build(&spec);
            let (x, theta) = point(&circuit, 1);
            for bad in [f64::NAN, f64::INFINITY] {
                let (mut bad_x, mut bad_theta) = (x.clone(), theta.clone());
                bad_x[0] = bad;
                bad_theta[0] = bad;
                for (x, theta) in [(&bad_x, &theta), (&x, &bad_theta)] {
                    let z = circuit.expectations(x, theta, FIRST_DRAW).expect("answer");
                    let (by_x, by_theta) =
                        circuit.gradients(x, theta, &vec![1.0; x.len()], FIRST_DRAW).expect("answer");
                    assert!(z.iter().all(|v| v.is_nan()), "{spec:?} {z:?}");
                    assert!(by_x.iter().chain(&by_theta).all(|v| v.is_nan()), "{spec:?}");
                    let all = circuit.jacobian(x, theta, FIRST_DRAW).expect("answer");
                    assert!(all.by_x.concat().iter().chain(&all.by_theta.concat()).any(|v| v.is_nan()));
                    let state = state_vector::run(&circuit, x, theta).expect("answer");
                    assert!(state.expectations().iter().any(|v| v.is_nan()));
                }
            }
        }
        assert!(super::super::shots::estimate(&[0.5, f64::NAN], 9, &mut stream(1, "bad", 0))[0].is_nan());
        assert!(circuit([f64::NAN, 1.0], [0.1; 4]).expectations[0].is_nan());
        assert!(circuit([f64::INFINITY, 1.0], [0.1; 4]).expectations[1].is_nan());
    }

    /// One shot is an outcome: every expectation is +1 or -1, every derivative by a turned gate 0 or +-1.
    #[test]
    fn one_shot() {
        for qubits in [1, 2, 4, 12] {
            let circuit =
                build(&CircuitSpec { execution: with_shots(1, 5, ShotGradient::Shots), ..by_angle(qubits, 1) });
            let (x, theta) = point(&circuit, 1);
            let got = circuit.jacobian(&x, &theta, FIRST_DRAW).expect("answer");
            assert!(got.expectations.iter().all(|z| z.abs() == 1.0));
            assert!(got.by_theta.concat().iter().chain(&got.by_x.concat()).all(|g| [0.0, 1.0].contains(&g.abs())));
        }
    }

    /// A state that is one outcome for sure is measured as that, whatever rounding leaves elsewhere.
    #[test]
    fn certain_outcomes_are_certain() {
        let circuit = build(&CircuitSpec { execution: with_shots(100_000, 5, ShotGradient::Shots), ..by_angle(4, 0) });
        let z = circuit.expectations(&[0.0, PI, 0.0, PI], &[0.0; 4], FIRST_DRAW).expect("answer");
        assert_eq!(z, [-1.0, 1.0, -1.0, 1.0]);
    }

    #[test]
    fn twelve_qubits() {
        let circuit = build(&zz(12, 2, 1));
        let (x, theta) = point(&circuit, 1);
        let angles = circuit.gate_angles(&x, &theta);
        let fast = circuit.expectations(&x, &theta, FIRST_DRAW).expect("answer");
        assert_near("expectations", &fast, &run_at(&circuit, &angles).expectations(), 1e-12);
        // Some gates of each kind by parameter shift.
        let cotangent: Vec<f64> = (0..12).map(|k| (f64::from(k) + 0.5).cos()).collect();
        let weighted = |angles: &[f64]| -> f64 {
            run_at(&circuit, angles).expectations().iter().zip(&cotangent).map(|(z, g)| z * g).sum()
        };
        let (_, by_theta) = circuit.gradients(&x, &theta, &cotangent, FIRST_DRAW).expect("answer");
        for k in [0, 7, 11, 12, 23] {
            let at = |by: f64| {
                let mut moved = angles.clone();
                moved[angles.len() - 24 + k] += by;
                weighted(&moved)
            };
            assert!((0.5 * (at(PI / 2.0) - at(-PI / 2.0)) - by_theta[k]).abs() < 1e-12, "{k}");
        }
    }

    #[test]
    fn smallest_and_largest_depth() {
        let flat = build(&zz(3, 1, 0));
        assert_eq!(flat.angle_count(), 3);
        let deep = build(&zz(2, 1, MOST_DEPTH));
        let (x, theta) = point(&deep, 1);
        let slow = state_vector::run(&deep, &x, &theta).expect("answer").expectations();
        assert_near("deep", &deep.expectations(&x, &theta, FIRST_DRAW).expect("answer"), &slow, 1e-11);
    }

    #[test]
    fn wrong_counts_are_errors() {
        let circuit = build(&zz(3, 1, 1));
        let error = |x: usize, theta: usize| {
            circuit.expectations(&vec![0.0; x], &vec![0.0; theta], FIRST_DRAW).expect_err("wrong counts").to_string()
        };
        assert_eq!(error(2, 6), "circuit: expected 3 inputs, one for each qubit, got 2");
        assert_eq!(error(3, 4), "circuit: expected 6 angles, qubits x (depth + 1), got 4");
        assert!(circuit.jacobian(&[], &[], FIRST_DRAW).is_err() && state_vector::run(&circuit, &[], &[]).is_err());
        assert!(circuit.gradients(&[0.0; 3], &[0.0; 6], &[1.0; 2], FIRST_DRAW).is_err());
    }

    #[test]
    fn settings_out_of_range_are_errors() {
        let noise = |p: f64| Noise { depolarising_one_qubit: p, ..Noise::default() };
        let paper = CircuitSpec::default();
        for (spec, part) in [
            (zz(0, 1, 1), "qubits is 0, expected 1 to 12"),
            (zz(13, 1, 1), "qubits is 13, expected 1 to 12"),
            (zz(usize::MAX, 1, usize::MAX), "qubits is"),
            (zz(2, 0, 1), "repetitions is 0, expected 1 or 2"),
            (zz(2, 3, 1), "repetitions is 3, expected 1 or 2"),
            (CircuitSpec { repetitions: 2, ..by_angle(2, 1) }, "repetitions is 2, expected 1 with angle encoding"),
            (zz(2, 1, usize::MAX), "expected 0 to 1000"),
            (CircuitSpec { execution: with_shots(0, 1, ShotGradient::Shots), ..paper.clone() }, "shots is 0"),
            (CircuitSpec { noise: noise(-0.1), ..paper.clone() }, "depolarising_one_qubit is -0.1"),
            (CircuitSpec { noise: noise(f64::NAN), ..paper.clone() }, "depolarising_one_qubit is NaN"),
            (CircuitSpec { noise: Noise { readout_flip: 1.5, ..Noise::default() }, ..paper.clone() }, "readout_flip"),
            (CircuitSpec { noise: noise(0.1), ..zz(7, 1, 1) }, "qubits is 7, expected at most 6 with depolarising"),
        ] {
            let error = Circuit::new(&spec).expect_err("refused").to_string();
            assert!(error.contains(part), "{error}");
            let _ = (spec.angle_count(), spec.observables());
        }
    }

    #[test]
    fn settings_survive_serialisation() {
        let spec = CircuitSpec {
            execution: with_shots(4096, 3, ShotGradient::Exact),
            noise: Noise { readout_flip: 0.02, ..Noise::default() },
            ..by_angle(4, 2)
        };
        let text = serde_json::to_string(&spec).expect("text");
        assert_eq!(serde_json::from_str::<CircuitSpec>(&text).expect("spec"), spec);
        assert_eq!(serde_json::from_str::<CircuitSpec>("{}").expect("spec"), CircuitSpec::default());
        let few = serde_json::from_str::<CircuitSpec>(r#"{"execution": {"shots": {"count": 7}}}"#).expect("spec");
        assert_eq!(few.execution, with_shots(7, 0, ShotGradient::Shots));
        for wrong in [r#"{"qbits": 2}"#, r#"{"noise": {"flip": 0.1}}"#, r#"{"execution": {"shots": {"number": 7}}}"#] {
            assert!(serde_json::from_str::<CircuitSpec>(wrong).is_err(), "{wrong}");
        }
    }
}
