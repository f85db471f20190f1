use super::*;

fn activated(act: Activation, x: f64) -> f64 {
    match act {
        Activation::None => x,
        Activation::Relu => x.max(0.0),
        Activation::Silu => reference::silu(x),
        Activation::Sigmoid => 1.0 / (1.0 + (-x).exp()),
    }
}

#[test]
fn batch_norm_agrees_with_the_reference_and_with_finite_differences() {
    let epsilon = 1e-3;
    for (dims, act) in [
        (vec![3, 5, 4, 7], Activation::Relu),
        (vec![2, 3, 3, 40], Activation::Silu),
        (vec![9, 300], Activation::None),
        (vec![2, 1, 1, 5], Activation::Relu),
        (vec![4, 30, 31, 16], Activation::Silu),
    ] {
        let channels = dims[dims.len() - 1];
        let count: usize = dims.iter().product();
        // A mean far from zero: sums of squares would lose the variance.
        let x: Vec<f32> = random(count, "x").iter().map(|v| 100.0 + v).collect();
        let (w, b, upstream) = (random(channels, "w"), random(channels, "b"), random(count, "g"));
        let (xd, wd, bd, gd) = (to_f64(&x), to_f64(&w), to_f64(&b), to_f64(&upstream));
        let forward = |x: &[f64], w: &[f64], b: &[f64]| -> Vec<f64> {
            reference::batch_norm(x, w, b, epsilon).0.into_iter().map(|v| activated(act, v)).collect()
        };
        let (_, mean, variance) = reference::batch_norm(&xd, &wd, &bd, epsilon);
        for level in KernelLevel::ALL {
            let constants = BatchNormConstants { epsilon: epsilon as f32, momentum: 0.1 };
            let statistics = RunningStatistics::new(channels, constants);
            let (input, weight, bias) = (var(&x, &dims), var(&w, &[channels]), var(&b, &[channels]));
            let check = |mode: BatchNormMode, forward: &dyn Fn(&[f64], &[f64], &[f64]) -> Vec<f64>| {
                let loss = |x: &[f64], w: &[f64], b: &[f64]| weighted_sum(&forward(x, w, b), &gd);
                let out = batch_norm(&input, &weight, &bias, &statistics, mode, act, level).expect("forward");
                assert_near(&format!("output, {mode:?}"), &flat(&out), &forward(&xd, &wd, &bd), 2e-4);
                let got = gradients(&out, &upstream, [&input, &weight, &bias]);
                assert_near(&format!("dx, {mode:?}"), &got[0], &differences(&xd, |x| loss(x, &wd, &bd)), 1e-3);
                assert_near(&format!("dw, {mode:?}"), &got[1], &differences(&wd, |w| loss(&xd, w, &bd)), 1e-3);
                assert_near(&format!("db, {mode:?}"), &got[2], &differences(&bd, |b| loss(&xd, &wd, b)), 1e-3);
            };
            check(BatchNormMode::Training, &forward);
            // As in PyTorch, running statistics move by a tenth, and their variance is unbiased.
            let n = (count / channels) as f64;
            let want: Vec<f64> = mean.iter().map(|m| 0.1 * m).collect();
            assert_near("running mean", &statistics.mean(), &want, 1e-6);
            let want: Vec<f64> = variance.iter().map(|v| 0.9 + 0.1 * v * n / (n - 1.0)).collect();
            assert_near("running variance", &statistics.variance(), &want, 1e-5);

            // Evaluation is an affine function of each value.
            statistics
                .set(mean.iter().map(|&v| v as f32 + 0.1).collect(), variance.iter().map(|&v| v as f32 + 0.5).collect())
                .expect("set");
            let (m, v) = (to_f64(&statistics.mean()), to_f64(&statistics.variance()));
            let forward = |x: &[f64], w: &[f64], b: &[f64]| -> Vec<f64> {
                let normal = |(k, x): (usize, &f64)| {
                    (x - m[k % channels]) / (v[k % channels] + epsilon).sqrt() * w[k % channels] + b[k % channels]
                };
                x.iter().enumerate().map(normal).map(|v| activated(act, v)).collect()
            };
            check(BatchNormMode::Evaluation, &forward);
        }
    }
}

#[test]
fn activations_agree_with_their_formulas_and_finite_differences() {
    let x: Vec<f32> = random(3000, "x").iter().map(|v| 30.0 * v * v * v).chain([-100.0, 100.0, -87.5, 88.5]).collect();
    let (xd, upstream) = (to_f64(&x), random(x.len(), "g"));
    for &act in Activation::ALL {
        for level in KernelLevel::ALL {
            let input = var(&x, &[x.len()]);
            let out = activation(&input, act, level).expect("forward");
            let [got] = gradients(&out, &upstream, [&input]);
            let out = flat(&out);
            for (k, &x) in xd.iter().enumerate() {
                let want = activated(act, x);
                for y in [out[k], act.apply(x as f32)].map(f64::from) {
                    assert!((y - want).abs() <= 1e-6 * want.abs() + 1e-30, "{act:?}({x}) is {want}, not {y}");
                }
                if act == Activation::Relu && x.abs() < 1e-4 {
                    // Differences across the kink are between the two slopes.
                    continue;
                }
                let slope = (activated(act, x + 1e-5) - activated(act, x - 1e-5)) / 2e-5;
                let want = slope * f64::from(upstream[k]);
                assert!((f64::from(got[k]) - want).abs() <= 1e-5, "{act:?}'({x}) is {want}, not {}", got[k]);
            }
        }
    }
}

#[test]
fn sums_scales_and_pools_agree_with_references_and_finite_differences() {
    for (batch, [rows, columns], channels, kernel, stride, padding) in
        [(2, [8, 6], 5, 2, 2, 0), (1, [9, 7], 18, 3, 2, 1), (2, [5, 6], 16, 3, 1, 1), (1, [7, 7], 33, 5, 3, 2)]
    {
        let cells = rows * columns;
        let x = random(batch * channels * cells, "x");
        let forward = |x: &[f64]| -> Vec<f64> {
            x.chunks_exact(channels * cells)
                .flat_map(|s| reference::max_pool(s, [rows, columns], kernel, stride, padding))
                .collect()
        };
        let want = forward(&to_f64(&x));
        let upstream = random(want.len(), "g");
        let gd = to_f64(&upstream);
        let pooled = want.len() / (batch * channels);
        let dx = differences(&to_f64(&x), |x| weighted_sum(&forward(x), &gd));
        let want: Vec<f32> = want.iter().map(|&v| v as f32).collect();
        for level in KernelLevel::ALL {
            let input = var(&channel_last(&x, channels, cells), &[batch, rows, columns, channels]);
            let out = max_pool2d(&input, kernel, stride, padding, level).expect("forward");
            assert_eq!(flat(&out), channel_last(&want, channels, pooled));
            let [got] = gradients(&out, &channel_last(&upstream, channels, pooled), [&input]);
            assert_near("dx", &got, &channel_last(&dx, channels, cells), 1e-5);
        }
    }

    let dims = [2, 3, 4, 21];
    let count: usize = dims.iter().product();
    let (a, b, scale, upstream) = (random(count, "a"), random(count, "b"), random(2 * 21, "s"), random(count, "g"));
    let gd = to_f64(&upstream);
    let sum = |a: &[f64], b: &[f64]| -> f64 { a.iter().zip(b).zip(&gd).map(|((a, b), g)| (a + b).max(0.0) * g).sum() };
    let scaled = |a: &[f64], s: &[f64]| -> f64 {
        a.iter().zip(&gd).enumerate().map(|(k, (a, g))| a * s[k / (12 * 21) * 21 + k % 21] * g).sum()
    };
    let (ad, bd, sd) = (to_f64(&a), to_f64(&b), to_f64(&scale));
    let (va, vb, vs) = (var(&a, &dims), var(&b, &dims), var(&scale, &[2, 21]));
    for level in KernelLevel::ALL {
        let out = add_relu(&va, &vb, level).expect("forward");
        let got = gradients(&out, &upstream, [&va, &vb]);
        assert_near("da", &got[0], &differences(&ad, |a| sum(a, &bd)), 1e-5);
        assert_near("db", &got[1], &differences(&bd, |b| sum(&ad, b)), 1e-5);
    }
    let out = scale_channels(&va, &vs).expect("forward");
    let got = gradients(&out, &upstream, [&va, &vs]);
    assert_near("da", &got[0], &differences(&ad, |a| scaled(a, &sd)), 1e-5);
    assert_near("ds", &got[1], &differences(&sd, |s| scaled(&ad, s)), 1e-5);
}

#[test]
fn dropout_zeroes_its_fraction_of_values_and_their_gradients() {
    let input = var(&vec![1.0; 50_000], &[50, 1000]);
    let run = |draw| dropout(&input, 0.3, 5, draw).expect("forward");
    let out = flat(&run(0));
    let kept = out.iter().filter(|&&v| v != 0.0).count() as f64 / 50_000.0;
    assert!((kept - 0.7).abs() < 0.01, "{kept}");
    assert!(out.iter().all(|&v| v == 0.0 || (v - 1.0 / 0.7).abs() < 1e-6));
    assert_eq!(gradients(&run(0), &[1.0; 50_000], [&input])[0], out);
    assert_ne!(flat(&run(1)), out);
    assert!(dropout(&input, 1.0, 5, 0).is_err());
}

/// A network in which two layers read one tensor, with candle's own operations between layers.
#[test]
fn the_backward_pass_gives_candles_gradients() {
    let level = KernelLevel::detect();
    let (x, w, b) =
        (var(&random(4 * 20, "x"), &[4, 20]), var(&random(400, "w"), &[20, 20]), var(&random(20, "b"), &[20]));
    let y = linear(&x, &w, &b, level).expect("linear");
    let y = add_relu(&linear(&y, &w, &b, level).expect("linear"), &y, level).expect("sum");
    let y = linear(&y.affine(0.5, 0.1).and_then(|y| y.tanh()).expect("candle"), &w, &b, level).expect("linear");
    let loss = cross_entropy(&y, &[0, 5, 19, 3], &[1.0; 20]).expect("loss");
    let (ours, theirs) = (backward(&loss).expect("backward"), loss.backward().expect("backward"));
    for v in [&x, &w, &b] {
        assert_near(
            "gradient",
            &flat(ours.get(v).expect("ours")),
            &to_f64(&flat(theirs.get(v).expect("theirs"))),
            1e-5,
        );
    }
}

#[test]
fn inference_on_features_agrees_with_the_layers() {
    let level = KernelLevel::detect();
    let dims = [2, 9, 7, 21];
    let (x, scale) = (random(2 * 9 * 7 * 21, "x"), random(2 * 21, "s"));
    let (input, factors) = (var(&x, &dims), var(&scale, &[2, 21]));
    let mut feature = Feature::new(dims, x).expect("feature");
    let mut output = Feature::new([1, 1, 1, 5000], vec![f32::NAN; 5000]).expect("feature");
    feature.max_pool2d(3, 2, 1, level, &mut output).expect("pool");
    assert_eq!(output.dims(), [2, 5, 4, 21]);
    assert_eq!(output.values(), flat(&max_pool2d(&input, 3, 2, 1, level).expect("pool")));
    feature.adaptive_average_pool(2, 3, &mut output).expect("mean");
    assert_eq!(output.dims(), [2, 1, 1, 21 * 6]);
    assert_eq!(output.values(), flat(&adaptive_average_pool(&input, 2, 3).expect("mean")));
    let factor = Feature::new([2, 1, 1, 21], scale).expect("feature");
    feature.scale_channels(&factor).expect("scale");
    assert_eq!(feature.values(), flat(&scale_channels(&input, &factors).expect("scale")));
    let error = feature.scale_channels(&output).expect_err("other channels").to_string();
    assert!(error.contains("scale_channels: expected"), "{error}");
}

mod hard_cases {
    use super::*;

    #[test]
    fn a_batch_with_one_value_a_channel_has_no_variance() {
        let statistics = RunningStatistics::new(6, BatchNormConstants::default());
        let (x, w) = (var(&random(6, "x"), &[1, 6]), var(&[1.0; 6], &[6]));
        let run = |mode| batch_norm(&x, &w, &w, &statistics, mode, Activation::None, KernelLevel::detect());
        let error = run(BatchNormMode::Training).expect_err("no variance").to_string();
        assert!(error.contains("batch_norm: expected more than one value") && error.contains("[1, 6]"), "{error}");
        assert_eq!(statistics.variance(), [1.0; 6]);
        assert!(run(BatchNormMode::Evaluation).is_ok());
    }

    #[test]
    fn every_layer_propagates_nan() {
        let mut x = random(2 * 4 * 4 * 20, "x");
        x[5] = f32::NAN;
        let input = var(&x, &[2, 4, 4, 20]);
        let one = var(&[1.0; 20], &[20]);
        for level in KernelLevel::ALL {
            let statistics = RunningStatistics::new(20, BatchNormConstants::default());
            for &act in Activation::ALL {
                let out = activation(&input, act, level).expect("forward");
                assert!(flat(&out)[5].is_nan(), "{act:?}");
                let out = batch_norm(&input, &one, &one, &statistics, BatchNormMode::Training, act, level);
                assert!(flat(&out.expect("forward"))[5].is_nan(), "{act:?}");
            }
            assert!(statistics.mean()[5].is_nan() && statistics.mean()[6].is_finite());
            assert!(flat(&max_pool2d(&input, 2, 2, 0, level).expect("forward"))[5].is_nan());
            assert!(flat(&add_relu(&input, &input, level).expect("forward"))[5].is_nan());
        }
        assert!(flat(&adaptive_average_pool(&input, 1, 1).expect("forward"))[5].is_nan());
    }

    #[test]
    fn any_number_of_threads_gives_the_same_bits() {
        same_bits("a network", || {
            let level = KernelLevel::detect();
            let (x, w) = (var(&random(7 * 60 * 58 * 16, "x"), &[7, 60, 58, 16]), var(&random(24, "w"), &[24]));
            let (cw, cb) = (var(&random(24 * 144, "cw"), &[24, 16, 3, 3]), var(&random(24, "cb"), &[24]));
            let (fw, fb) = (var(&random(24 * 8 * 70, "fw"), &[70, 24 * 8]), var(&random(70, "fb"), &[70]));
            let statistics = RunningStatistics::new(24, BatchNormConstants::default());
            let y = conv_relu_pool(&x, &cw, &cb, InputGradient::Needed, level).expect("convolution");
            let y = batch_norm(&y, &w, &w, &statistics, BatchNormMode::Training, Activation::Silu, level);
            let y = max_pool2d(&y.expect("norm"), 3, 2, 1, level).expect("pool");
            let y = dropout(&y, 0.2, 1, 2).expect("dropout");
            let y = linear(&adaptive_average_pool(&y, 2, 4).expect("mean"), &fw, &fb, level).expect("linear");
            let loss = cross_entropy(&y, &[0, 1, 2, 3, 4, 5, 6], &[1.0; 70]).expect("loss");
            let gradients = backward(&loss).expect("backward");
            [&x, &cw, &cb, &w, &fw, &fb].map(|v| flat(gradients.get(v).expect("gradient")))
        });
    }

    #[test]
    fn wrong_shapes_name_the_layer_and_what_was_expected() {
        let level = KernelLevel::detect();
        let (x, y) = (var(&random(32, "x"), &[1, 4, 4, 2]), var(&random(6, "y"), &[2, 3]));
        let (z, w, b) = (var(&[0.0; 6], &[3, 2]), var(&random(27, "w"), &[1, 3, 3, 3]), var(&[0.0], &[1]));
        let statistics = RunningStatistics::new(3, BatchNormConstants::default());
        let errors = [
            ("add_relu: expected equal shapes", add_relu(&x, &y, level)),
            ("scale_channels: expected input", scale_channels(&x, &y)),
            ("max_pool2d: expected [batch", max_pool2d(&x, 5, 1, 0, level)),
            ("max_pool2d: expected [batch", max_pool2d(&y, 1, 1, 0, level)),
            (
                "batch_norm: expected input",
                batch_norm(&x, &y, &y, &statistics, BatchNormMode::Training, Activation::None, level),
            ),
            ("conv_relu_pool: expected input", conv_relu_pool(&x, &w, &b, InputGradient::Needed, level)),
            ("linear: expected input", linear(&x, &w, &b, level)),
            ("labels below 3", cross_entropy(&y, &[0, 3], &[1.0; 3])),
            ("add: expected equal shapes, got [2, 3] and [3, 2]", add(&y, &z)),
            ("concatenate: expected [batch, a] and [batch, b], got [[2, 3], [3, 2]]", concatenate(&y, &z)),
            ("trigonometric: expected input", trigonometric(&y)),
            ("standardise: expected input", standardise(&y, &[0.0; 2], &[1.0; 2])),
        ];
        for (want, result) in errors {
            let error = result.expect_err(want).to_string();
            assert!(error.contains(want) && (error.contains("[1, 4, 4, 2]") || error.contains("[2, 3]")), "{error}");
        }
        assert!(statistics.set(vec![0.0; 2], vec![0.0; 3]).is_err());
    }
}
