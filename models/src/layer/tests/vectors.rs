//! Layers on vectors, against their formulas and finite differences.

use super::*;

fn vector(rows: usize, columns: usize, what: &str) -> Var {
    let values: Vec<f32> = random(rows * columns, what).iter().map(|v| 2.0 * v).collect();
    var(&values, &[rows, columns])
}

/// Compares a layer's output with the formula, and the gradient of its weighted sum with central differences.
fn check(layer: &str, input: &Var, output: &dyn Fn(&Tensor) -> Tensor, formula: &dyn Fn(&[f64]) -> Vec<f64>) {
    let x = to_f64(&flat(input));
    let out = output(input.as_tensor());
    assert_near(layer, &flat(&out), &formula(&x), 3e-6);
    let weights = random(out.elem_count(), layer);
    let [found] = gradients(&out, &weights, [input]);
    assert_near(layer, &found, &differences(&x, |x| weighted_sum(&formula(x), &to_f64(&weights))), 1e-5);
}

#[test]
fn outputs_and_gradients_are_those_of_the_formulas() {
    let pi = std::f64::consts::PI;
    let x = vector(3, 2, "x");
    check("scaled_sigmoid", &x, &|x| scaled_sigmoid(x, 0.0).expect("scaled_sigmoid"), &|x| {
        x.iter().map(|u| pi / (1.0 + (-u).exp())).collect()
    });
    let (mean, sigma) = ([0.3f32, -0.2], [0.5f32, 2.0]);
    check("standardise", &x, &|x| standardise(x, &mean, &sigma).expect("standardise"), &|x| {
        x.iter().enumerate().map(|(k, v)| (v - f64::from(mean[k % 2])) / f64::from(sigma[k % 2])).collect()
    });
    check("trigonometric", &x, &|x| trigonometric(x).expect("trigonometric"), &|x| {
        let row = |x: &[f64]| {
            let w = 2.0 * (pi - x[0]) * (pi - x[1]);
            let (p, q) = (2.0 * x[0], 2.0 * x[1]);
            [q.sin() * w.sin(), p.sin() * w.sin(), p.cos() * q.cos(), q.cos() * w.cos(), p.cos() * w.cos()]
        };
        x.chunks_exact(2).flat_map(row).collect()
    });
    let other = vector(3, 2, "other");
    let y = to_f64(&flat(&other));
    check("add", &x, &|x| add(x, &other).expect("add"), &|x| x.iter().zip(&y).map(|(a, b)| a + b).collect());
    check("concatenate", &x, &|x| concatenate(x, &other).expect("concatenate"), &|x| {
        x.chunks_exact(2).zip(y.chunks_exact(2)).flat_map(|(a, b)| [a[0], a[1], b[0], b[1]]).collect()
    });
}

/// The penalty of the scaled sigmoid adds the gradient of its weight times the mean square, and leaves the output.
#[test]
fn the_penalty_changes_only_the_gradient() {
    let x = vector(4, 2, "x");
    let gradient = |penalty: f32| {
        let loss = scaled_sigmoid(&x, penalty).and_then(|t| t.sum_all()).expect("loss");
        (flat(&loss)[0], flat(backward(&loss).expect("backward").get(&x).expect("gradient")))
    };
    let ((with, a), (without, b)) = (gradient(0.7), gradient(0.0));
    assert_eq!(with, without);
    for ((a, b), x) in a.iter().zip(b).zip(flat(&x)) {
        assert!((a - b - 0.7 * 2.0 * x / 8.0).abs() < 1e-6);
    }
}

mod hard_cases {
    use super::*;

    #[test]
    fn a_saturated_sigmoid_is_finite_and_has_no_gradient() {
        let x = Var::new(&[[1e4f32, -1e4], [f32::MAX, f32::MIN]], &Device::Cpu).expect("variable");
        let loss = scaled_sigmoid(&x, 0.0).and_then(|t| t.sum_all()).expect("loss");
        let gradient = flat(backward(&loss).expect("backward").get(&x).expect("gradient"));
        assert!(flat(&loss)[0].is_finite() && gradient.iter().all(|g| g.abs() < 1e-6), "{gradient:?}");
    }

    #[test]
    fn nan_propagates() {
        let x = Tensor::new(&[[f32::NAN, 0.0]], &Device::Cpu).expect("tensor");
        for output in [scaled_sigmoid(&x, 0.0), trigonometric(&x), add(&x, &x), standardise(&x, &[0.0; 2], &[1.0; 2])] {
            assert!(flat(&output.expect("output")).iter().any(|v| v.is_nan()));
        }
    }
}
