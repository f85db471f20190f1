use candle_core::{Device, Tensor, Var};
use rand::Rng;

use super::*;
use crate::random::stream;

mod convolution;
mod maps;
mod reference;
mod vectors;

fn random(count: usize, purpose: &str) -> Vec<f32> {
    let mut rng = stream(3, purpose, 0);
    (0..count).map(|_| rng.random_range(-1.0..1.0)).collect()
}

pub(super) fn var(values: &[f32], shape: &[usize]) -> Var {
    Var::from_tensor(&Tensor::from_slice(values, shape, &Device::Cpu).expect("tensor")).expect("var")
}

fn to_f64(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&v| f64::from(v)).collect()
}

pub(super) fn flat(tensor: &Tensor) -> Vec<f32> {
    tensor.flatten_all().expect("flat").to_vec1().expect("f32")
}

fn assert_near(name: &str, got: &[f32], want: &[f64], tolerance: f64) {
    assert_eq!(got.len(), want.len(), "{name}");
    let scale = want.iter().fold(1e-3f64, |m, v| m.max(v.abs()));
    for (k, (g, w)) in got.iter().zip(want).enumerate() {
        assert!(
            w.is_nan() || (f64::from(*g) - w).abs() <= tolerance * scale,
            "{name}[{k}]: {g} instead of {w} (scale {scale})"
        );
    }
}

/// Central differences of a scalar function in f64 at about a hundred evenly spread coordinates at most. Others are NaN,
/// which [`assert_near`] skips.
fn differences(at: &[f64], f: impl Fn(&[f64]) -> f64) -> Vec<f64> {
    let h = 1e-6;
    let step = at.len().div_ceil(100);
    // A step that shares factors with the axes would test the same channels and offsets repeatedly.
    let step = (step..).find(|s| [2, 3, 5, 7].iter().all(|p| s % p != 0) || *s == 1).unwrap_or(1);
    let mut moved = at.to_vec();
    (0..at.len())
        .map(|k| {
            if k % step != 0 {
                return f64::NAN;
            }
            moved[k] = at[k] + h;
            let plus = f(&moved);
            moved[k] = at[k] - h;
            let minus = f(&moved);
            moved[k] = at[k];
            (plus - minus) / (2.0 * h)
        })
        .collect()
}

/// Gradient of `sum(output * upstream)` by this crate's backward pass and by candle's, which must be the same bits.
fn gradients<const N: usize>(output: &Tensor, upstream: &[f32], variables: [&Var; N]) -> [Vec<f32>; N] {
    let weights = Tensor::from_slice(upstream, output.elem_count(), &Device::Cpu).expect("weights");
    let loss = (output.flatten_all().expect("flat") * weights).and_then(|t| t.sum_all()).expect("loss");
    let (ours, theirs) = (backward(&loss).expect("backward"), loss.backward().expect("backward"));
    variables.map(|v| {
        let [ours, theirs] = [&ours, &theirs].map(|s| flat(s.get(v).expect("gradient")));
        assert_eq!(ours, theirs);
        ours
    })
}

/// Gradient of the sum of squares of an output.
fn gradients_of_squares<const N: usize>(output: &Tensor, variables: [&Var; N]) -> [Vec<f32>; N] {
    let found = output.sqr().and_then(|t| t.sum_all()).and_then(|t| t.backward()).expect("backward");
    variables.map(|v| flat(found.get(v).expect("gradient")))
}

fn weighted_sum(values: &[f64], weights: &[f64]) -> f64 {
    values.iter().zip(weights).map(|(v, w)| v * w).sum()
}

/// `[sample][channel][row][column]` to `[sample][row][column][channel]`.
fn channel_last<T: Copy>(values: &[T], channels: usize, cells: usize) -> Vec<T> {
    values
        .chunks_exact(channels * cells)
        .flat_map(|s| (0..cells).flat_map(move |p| (0..channels).map(move |c| s[c * cells + p])))
        .collect()
}

/// Asserts that a computation gives the same bits on any number of threads.
pub(super) fn same_bits<const N: usize>(what: &str, run: impl Fn() -> [Vec<f32>; N] + Sync) {
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("pool");
        let bits = |values: Vec<f32>| -> Vec<u32> { values.into_iter().map(f32::to_bits).collect() };
        pool.install(&run).map(bits)
    };
    let one = on(1);
    for threads in [2, 3, 5] {
        assert!(on(threads) == one, "{what}, {threads} threads");
    }
}

/// (batch, rows, columns, inputs, outputs): first layer, second layer, odd sizes, channel counts below a vector's width.
const CASES: [(usize, usize, usize, usize, usize); 4] =
    [(3, 8, 6, 1, 16), (2, 6, 8, 16, 32), (2, 7, 5, 3, 5), (1, 4, 4, 2, 20)];

#[test]
fn conv_relu_pool_agrees_with_the_reference_and_with_finite_differences() {
    for (batch, rows, columns, inputs, outputs) in CASES {
        let x = random(batch * inputs * rows * columns, "x");
        let w = random(outputs * inputs * 9, "w");
        let b = random(outputs, "b");
        let pooled = (rows / 2) * (columns / 2);
        let upstream = random(batch * outputs * pooled, "g");
        let (xd, wd, bd, gd) = (to_f64(&x), to_f64(&w), to_f64(&b), to_f64(&upstream));
        let forward = |x: &[f64], w: &[f64], b: &[f64]| -> Vec<f64> {
            x.chunks_exact(inputs * rows * columns)
                .flat_map(|s| {
                    let conv = reference::conv3x3(s, rows, columns, w, b);
                    reference::max_pool2(&reference::relu(&conv), rows, columns)
                })
                .collect()
        };
        let loss = |x: &[f64], w: &[f64], b: &[f64]| weighted_sum(&forward(x, w, b), &gd);
        for level in KernelLevel::ALL {
            let input = var(&channel_last(&x, inputs, rows * columns), &[batch, rows, columns, inputs]);
            let (weight, bias) = (var(&w, &[outputs, inputs, 3, 3]), var(&b, &[outputs]));
            let out = conv_relu_pool(&input, &weight, &bias, InputGradient::Needed, level).expect("forward");
            assert_near("output", &flat(&out), &channel_last(&forward(&xd, &wd, &bd), outputs, pooled), 1e-6);
            let [gx, gw, gb] = gradients(&out, &channel_last(&upstream, outputs, pooled), [&input, &weight, &bias]);
            let dx = differences(&xd, |x| loss(x, &wd, &bd));
            assert_near("dx", &gx, &channel_last(&dx, inputs, rows * columns), 1e-5);
            assert_near("dw", &gw, &differences(&wd, |w| loss(&xd, w, &bd)), 1e-5);
            assert_near("db", &gb, &differences(&bd, |b| loss(&xd, &wd, b)), 1e-5);
        }
    }
}

/// The first layer has its own backward pass, because no gradient of the data is needed.
#[test]
fn gradients_do_not_depend_on_whether_the_input_needs_one() {
    for (batch, rows, columns, inputs, outputs) in CASES {
        for level in KernelLevel::ALL {
            let input = var(&random(batch * inputs * rows * columns, "x"), &[batch, rows, columns, inputs]);
            let (weight, bias) = (
                var(&random(outputs * inputs * 9, "w"), &[outputs, inputs, 3, 3]),
                var(&random(outputs, "b"), &[outputs]),
            );
            let run = |input_gradient| {
                let out = conv_relu_pool(&input, &weight, &bias, input_gradient, level).expect("forward");
                gradients_of_squares(&out, [&weight, &bias])
            };
            let (with, without) = (run(InputGradient::Needed), run(InputGradient::Unused));
            assert_near("dw", &without[0], &to_f64(&with[0]), 1e-5);
            assert_near("db", &without[1], &to_f64(&with[1]), 1e-5);
        }
    }
}

/// The maximum of a window gets the whole gradient. candle's own max-pooling gives 0.25, because it scales the gradient by
/// the fraction of maxima in the window.
#[test]
fn pooling_passes_the_whole_gradient_to_the_maximum() {
    let input = var(&[1.0, 2.0, 3.0, 4.0], &[1, 2, 2, 1]);
    let mut identity = [0.0; 9];
    identity[4] = 1.0;
    let (weight, bias) = (var(&identity, &[1, 1, 3, 3]), var(&[0.0], &[1]));
    let out = conv_relu_pool(&input, &weight, &bias, InputGradient::Needed, KernelLevel::detect()).expect("forward");
    let grads = out.sum_all().and_then(|s| s.backward()).expect("backward");
    assert_eq!(flat(grads.get(&input).expect("gradient")), [0.0, 0.0, 0.0, 1.0]);
}

#[test]
fn adaptive_average_pool_agrees_with_the_reference_and_with_finite_differences() {
    for (rows, columns, channels, to) in [
        (32, 32, 3, (2, 15)),
        (7, 20, 3, (2, 15)),
        (3, 5, 3, (2, 15)),
        (4, 4, 3, (4, 4)),
        (5, 6, 32, (2, 3)),
        (3, 3, 21, (1, 1)),
    ] {
        let batch = 2;
        let x = random(batch * channels * rows * columns, "x");
        let upstream = random(batch * channels * to.0 * to.1, "g");
        let gd = to_f64(&upstream);
        let forward = |x: &[f64]| -> Vec<f64> {
            x.chunks_exact(channels * rows * columns)
                .flat_map(|s| reference::adaptive_average_pool(s, rows, columns, to))
                .collect()
        };
        let input = var(&channel_last(&x, channels, rows * columns), &[batch, rows, columns, channels]);
        let out = adaptive_average_pool(&input, to.0, to.1).expect("forward");
        assert_near("output", &flat(&out), &forward(&to_f64(&x)), 1e-6);
        let [got] = gradients(&out, &upstream, [&input]);
        let dx = differences(&to_f64(&x), |x| weighted_sum(&forward(x), &gd));
        assert_near("dx", &got, &channel_last(&dx, channels, rows * columns), 1e-5);
    }
}

#[test]
fn linear_agrees_with_the_reference_and_with_finite_differences() {
    let (batch, inputs, outputs) = (5, 37, 6);
    let (x, w, b) = (random(batch * inputs, "x"), random(outputs * inputs, "w"), random(outputs, "b"));
    let upstream = random(batch * outputs, "g");
    let (xd, wd, bd, gd) = (to_f64(&x), to_f64(&w), to_f64(&b), to_f64(&upstream));
    let forward = |x: &[f64], w: &[f64], b: &[f64]| -> Vec<f64> {
        x.chunks_exact(inputs).flat_map(|s| reference::linear(s, w, b)).collect()
    };
    for level in KernelLevel::ALL {
        let (input, weight, bias) = (var(&x, &[batch, inputs]), var(&w, &[outputs, inputs]), var(&b, &[outputs]));
        let out = linear(&input, &weight, &bias, level).expect("forward");
        assert_near("output", &flat(&out), &forward(&xd, &wd, &bd), 1e-6);
        let [gx, gw, gb] = gradients(&out, &upstream, [&input, &weight, &bias]);
        assert_near("dx", &gx, &differences(&xd, |x| weighted_sum(&forward(x, &wd, &bd), &gd)), 1e-5);
        assert_near("dw", &gw, &differences(&wd, |w| weighted_sum(&forward(&xd, w, &bd), &gd)), 1e-5);
        assert_near("db", &gb, &differences(&bd, |b| weighted_sum(&forward(&xd, &wd, b), &gd)), 1e-5);
    }
}

#[test]
fn cross_entropy_agrees_with_finite_differences() {
    let (logits, labels, weights) = (random(4 * 3, "logits"), [0, 2, 1, 2], [0.5f32, 1.0, 2.0]);
    let loss = |z: &[f64]| {
        let terms =
            z.chunks_exact(3).zip(labels).map(|(row, l)| f64::from(weights[l]) * reference::cross_entropy(row, l));
        terms.sum::<f64>() / labels.iter().map(|&l| f64::from(weights[l])).sum::<f64>()
    };
    let z = var(&logits, &[4, 3]);
    let out = cross_entropy(&z, &labels, &weights).expect("loss");
    assert_near("loss", &flat(&out), &[loss(&to_f64(&logits))], 1e-6);
    let grads = out.backward().expect("backward");
    assert_near("dz", &flat(grads.get(&z).expect("gradient")), &differences(&to_f64(&logits), loss), 1e-5);
}

mod hard_cases {
    use super::*;

    /// A NaN in any cell of a pooling window reaches the output.
    #[test]
    fn fused_pooling_propagates_nan() {
        let (w, b) = (var(&random(9, "w"), &[1, 1, 3, 3]), var(&[0.0], &[1]));
        for cell in 0..64 {
            let mut x = random(64, "x");
            x[cell] = f32::NAN;
            let x = var(&x, &[1, 8, 8, 1]);
            for level in KernelLevel::ALL {
                let out = conv_relu_pool(&x, &w, &b, InputGradient::Needed, level).expect("forward");
                assert!(flat(&out)[cell / 16 * 4 + cell % 8 / 2].is_nan(), "{cell}");
            }
        }
    }

    #[test]
    fn a_batch_of_one_class_and_enormous_logits_keep_the_loss_finite() {
        let logits = var(&[1e30, -1e30, 0.0, 0.0, 1e4, -1e4], &[2, 3]);
        let loss = cross_entropy(&logits, &[0, 0], &[1.0, 0.0, 0.0]).expect("loss");
        let grads = loss.backward().expect("backward");
        assert!(
            flat(&loss)[0].is_finite() && flat(grads.get(&logits).expect("gradient")).iter().all(|v| v.is_finite())
        );
        // Every class of the batch has weight zero: the loss is zero, without a division by zero.
        let loss = cross_entropy(&logits, &[1, 1], &[1.0, 0.0, 0.0]).expect("loss");
        assert_eq!(flat(&loss), [0.0]);
    }
}
