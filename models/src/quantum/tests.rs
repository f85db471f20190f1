use super::*;
use crate::stream;
use rand::Rng;
use std::f64::consts::PI;
use std::path::PathBuf;

fn random_points(count: usize) -> Vec<([f64; 2], [f64; 4])> {
    let mut rng = stream(7, "circuit points", 0);
    (0..count)
        .map(|_| {
            (std::array::from_fn(|_| rng.random_range(0.0..PI)), std::array::from_fn(|_| rng.random_range(-PI..PI)))
        })
        .collect()
}

fn shared(name: &str) -> Option<PathBuf> {
    let root = std::env::var_os("RADOME_SHARED")
        .map(PathBuf::from)
        .unwrap_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../shared"));
    let path = root.join("data").join(name);
    path.exists().then_some(path)
}

/// Points computed with Qiskit 2.6.2: values from its Statevector, gradients by parameter shift and autograd.
#[test]
fn agrees_with_qiskit_at_every_recorded_point() {
    let Some(path) = shared("qiskit_pqc.json") else {
        #[allow(clippy::print_stderr)]
        {
            eprintln!("SKIPPED: data/qiskit_pqc.json not found; set RADOME_SHARED to the folder that contains data/");
        }
        return;
    };
    let text = std::fs::read_to_string(path).expect("readable");
    let json: serde_json::Value = serde_json::from_str(&text).expect("JSON");
    let points = json["reps"]["1"]["points"].as_array().expect("points");
    assert!(points.len() >= 25);
    let list = |v: &serde_json::Value| -> Vec<f64> {
        v.as_array().expect("array").iter().map(|n| n.as_f64().expect("number")).collect()
    };
    for point in points {
        let x: [f64; 2] = list(&point["x"]).try_into().expect("two inputs");
        let theta: [f64; 4] = list(&point["theta"]).try_into().expect("four angles");
        let ours = circuit(x, theta);
        for (name, value, grad_theta, grad_x) in
            [("ZI", ours.zi, ours.zi_grad_theta, ours.zi_grad_x), ("IZ", ours.iz, ours.iz_grad_theta, ours.iz_grad_x)]
        {
            assert!((value - point["exp"][name].as_f64().expect("number")).abs() < 1e-12, "{name} at {x:?} {theta:?}");
            for (got, want) in grad_theta.iter().zip(list(&point["grad_theta"][name])) {
                assert!((got - want).abs() < 1e-9, "d{name}/dtheta at {x:?} {theta:?}: {got} {want}");
            }
            for (got, want) in grad_x.iter().zip(list(&point["grad_x"][name])) {
                assert!((got - want).abs() < 1e-9, "d{name}/dx at {x:?} {theta:?}: {got} {want}");
            }
        }
    }
}

#[test]
fn closed_form_is_the_state_vector_with_its_parameter_shift() {
    for (x, theta) in random_points(300) {
        let (fast, slow) = (circuit(x, theta), state_vector::run(x, theta));
        assert!((slow.probabilities().iter().sum::<f64>() - 1.0).abs() < 1e-14);
        let [zi, iz] = slow.expectations();
        assert!((fast.zi - zi).abs() < 1e-13 && (fast.iz - iz).abs() < 1e-13);
        assert_eq!(expectations(x, theta), [fast.zi, fast.iz]);
        let [zi_shift, iz_shift] = state_vector::parameter_shift(x, theta);
        for k in 0..4 {
            assert!((fast.zi_grad_theta[k] - zi_shift[k]).abs() < 1e-13);
            assert!((fast.iz_grad_theta[k] - iz_shift[k]).abs() < 1e-13);
        }
        let h = 1e-6;
        for k in 0..2 {
            let at = |by: f64| {
                let mut moved = x;
                moved[k] += by;
                state_vector::run(moved, theta).expectations()
            };
            let (p, m) = (at(h), at(-h));
            assert!((fast.zi_grad_x[k] - (p[0] - m[0]) / (2.0 * h)).abs() < 1e-7);
            assert!((fast.iz_grad_x[k] - (p[1] - m[1]) / (2.0 * h)).abs() < 1e-7);
        }
    }
}

#[test]
fn single_precision_follows_double() {
    for (x, theta) in random_points(300) {
        let x32 = x.map(|v| v as f32);
        let theta32 = theta.map(|v| v as f32);
        let fast = circuit_f32(x32, theta32);
        let exact = circuit(x32.map(f64::from), theta32.map(f64::from));
        // w reaches 2 pi^2 = 19.7, where one unit in the last place of f32 is 1.9e-6.
        assert!((f64::from(fast.zi) - exact.zi).abs() < 1e-5 && (f64::from(fast.iz) - exact.iz).abs() < 1e-5);
        assert_eq!(expectations_f32(x32, theta32), [fast.zi, fast.iz]);
        for k in 0..2 {
            assert!((f64::from(fast.zi_grad_x[k]) - exact.zi_grad_x[k]).abs() < 1e-4);
        }
    }
}

mod hard_cases {
    use super::*;

    #[test]
    fn observables_are_in_qiskit_order() {
        // Only theta[3] turns qubit 1 after the entangler; IZ (qubit 0) must not depend on it, nor ZI on theta[2].
        for (x, theta) in random_points(20) {
            let p = circuit(x, theta);
            assert_eq!((p.zi_grad_theta[2], p.iz_grad_theta[3]), (0.0, 0.0));
        }
    }

    #[test]
    fn non_finite_input_stays_visible() {
        assert!(circuit([f64::NAN, 1.0], [0.1; 4]).zi.is_nan());
        assert!(circuit([f64::INFINITY, 1.0], [0.1; 4]).iz.is_nan());
    }
}
