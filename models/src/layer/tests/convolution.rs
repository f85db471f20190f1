use super::*;

/// Batch, rows, columns, inputs, outputs, kernel, geometry.
type Case = (usize, [usize; 2], usize, usize, [usize; 2], ConvGeometry);

/// Kernels 1, 3, 5, 7 and oblong; strides 1 to 3; odd sizes; channel counts of less than a vector, of one, and of more
/// than a tile; depthwise; a batch of one; more rows than one task takes.
fn cases() -> Vec<Case> {
    let (dense, depthwise) = (ConvGeometry::dense, ConvGeometry::depthwise);
    vec![
        (2, [5, 7], 3, 5, [3, 3], dense(1, 1)),
        (1, [9, 8], 16, 20, [3, 3], dense(2, 1)),
        (2, [11, 10], 1, 33, [7, 7], dense(2, 3)),
        (3, [4, 4], 40, 70, [3, 3], dense(1, 1)),
        (2, [5, 7], 17, 33, [3, 3], dense(1, 1)),
        (1, [4, 3], 16, 16, [3, 3], dense(1, 1)),
        (2, [6, 5], 17, 49, [1, 1], dense(1, 0)),
        (2, [7, 6], 24, 10, [1, 1], dense(2, 0)),
        (1, [8, 9], 12, 9, [5, 5], dense(3, 2)),
        (2, [6, 9], 9, 7, [3, 5], dense(1, 1)),
        (1, [40, 31], 8, 16, [3, 3], dense(1, 1)),
        (2, [3, 3], 2, 3, [3, 3], dense(2, 0)),
        (2, [7, 9], 24, 24, [3, 3], depthwise(1, 1, 24)),
        (1, [8, 7], 37, 37, [5, 5], depthwise(2, 2, 37)),
        (2, [9, 9], 5, 5, [3, 3], depthwise(2, 1, 5)),
        (1, [30, 20], 16, 16, [7, 7], depthwise(1, 3, 16)),
    ]
}

fn tensors((batch, [rows, columns], inputs, outputs, kernel, geometry): &Case) -> (Vec<f32>, Vec<f32>, Vec<f32>) {
    let weights = outputs * inputs / geometry.groups * kernel[0] * kernel[1];
    (random(batch * inputs * rows * columns, "x"), random(weights, "w"), random(*outputs, "b"))
}

#[test]
fn conv2d_agrees_with_the_reference_and_with_finite_differences() {
    for case in cases() {
        let (batch, [rows, columns], inputs, outputs, kernel, geometry) = case;
        let (x, w, b) = tensors(&case);
        let (xd, wd, bd) = (to_f64(&x), to_f64(&w), to_f64(&b));
        let forward = |x: &[f64], w: &[f64], b: &[f64]| -> Vec<f64> {
            let ConvGeometry { stride, padding, groups } = geometry;
            x.chunks_exact(inputs * rows * columns)
                .flat_map(|s| reference::conv2d(s, [rows, columns], w, kernel, b, stride, padding, groups))
                .collect()
        };
        let want = forward(&xd, &wd, &bd);
        let upstream = random(want.len(), "g");
        let gd = to_f64(&upstream);
        let cells = want.len() / (batch * outputs);
        let loss = |x: &[f64], w: &[f64], b: &[f64]| weighted_sum(&forward(x, w, b), &gd);
        let [dx, dw, db] = [
            differences(&xd, |x| loss(x, &wd, &bd)),
            differences(&wd, |w| loss(&xd, w, &bd)),
            differences(&bd, |b| loss(&xd, &wd, b)),
        ];
        for level in KernelLevel::ALL {
            let name = |what: &str| format!("{what} of {case:?} at {level:?}");
            let input = var(&channel_last(&x, inputs, rows * columns), &[batch, rows, columns, inputs]);
            let weight = var(&w, &[outputs, inputs / geometry.groups, kernel[0], kernel[1]]);
            let bias = var(&b, &[outputs]);
            let out = conv2d(&input, &weight, Some(&bias), geometry, InputGradient::Needed, level).expect("forward");
            assert_near(&name("output"), &flat(&out), &channel_last(&want, outputs, cells), 1e-5);
            let [gx, gw, gb] = gradients(&out, &channel_last(&upstream, outputs, cells), [&input, &weight, &bias]);
            assert_near(&name("dx"), &gx, &channel_last(&dx, inputs, rows * columns), 1e-5);
            assert_near(&name("dw"), &gw, &dw, 1e-5);
            assert_near(&name("db"), &gb, &db, 1e-5);
        }
    }
}

/// Compares every instruction set with the portable one at every coordinate; finite differences cover only a hundred.
#[test]
fn levels_agree_at_every_coordinate() {
    for case in cases() {
        let (batch, [rows, columns], inputs, outputs, kernel, geometry) = case;
        let (x, w, _) = tensors(&case);
        let run = |level| {
            let input = var(&x, &[batch, rows, columns, inputs]);
            let weight = var(&w, &[outputs, inputs / geometry.groups, kernel[0], kernel[1]]);
            let out = conv2d(&input, &weight, None, geometry, InputGradient::Needed, level).expect("forward");
            let [dx, dw] = gradients_of_squares(&out, [&input, &weight]);
            [flat(&out), dx, dw]
        };
        let plain = run(KernelLevel::Portable);
        for level in KernelLevel::ALL {
            for (got, want) in run(level).iter().zip(&plain) {
                assert_near(&format!("{case:?} at {level:?}"), got, &to_f64(want), 1e-5);
            }
        }
    }
}

/// Kernels of 3x3 are computed in windows, those of 5x5 cell by cell. The map has more windows than one block of the
/// weights' gradient.
#[test]
fn a_kernel_of_3x3_is_one_of_5x5_with_zeros_around() {
    let (batch, [rows, columns], inputs, outputs) = (2, [23, 22], 96, 170);
    let x = random(batch * rows * columns * inputs, "x");
    let (w, b) = (random(outputs * inputs * 9, "w"), random(outputs, "b"));
    let upstream = random(batch * rows * columns * outputs, "g");
    let inside = |kernel: usize| kernel / 9 * 25 + (kernel % 9 / 3 + 1) * 5 + kernel % 3 + 1;
    let mut wide = vec![0.0; outputs * inputs * 25];
    w.iter().enumerate().for_each(|(k, &value)| wide[inside(k)] = value);
    let run = |weight: &[f32], size: usize, level| {
        let input = var(&x, &[batch, rows, columns, inputs]);
        let weight = var(weight, &[outputs, inputs, size, size]);
        let bias = var(&b, &[outputs]);
        let geometry = ConvGeometry::dense(1, size / 2);
        let out = conv2d(&input, &weight, Some(&bias), geometry, InputGradient::Needed, level).expect("forward");
        let [gx, gw] = gradients(&out, &upstream, [&input, &weight]);
        [flat(&out), gx, gw]
    };
    for level in KernelLevel::ALL {
        let [out, gx, gw] = run(&w, 3, level);
        let [want_out, want_gx, want_gw] = run(&wide, 5, level);
        let want_gw: Vec<f32> = (0..w.len()).map(|k| want_gw[inside(k)]).collect();
        assert_near(&format!("output at {level:?}"), &out, &to_f64(&want_out), 1e-5);
        assert_near(&format!("dx at {level:?}"), &gx, &to_f64(&want_gx), 1e-5);
        assert_near(&format!("dw at {level:?}"), &gw, &to_f64(&want_gw), 1e-5);
    }
}

#[test]
fn an_empty_batch_has_no_output_and_no_gradient_of_weights() {
    for level in KernelLevel::ALL {
        let (input, weight) = (var(&[], &[0, 4, 4, 16]), var(&random(16 * 16 * 9, "w"), &[16, 16, 3, 3]));
        let geometry = ConvGeometry::dense(1, 1);
        let out = conv2d(&input, &weight, None, geometry, InputGradient::Needed, level).expect("forward");
        assert_eq!(out.dims(), [0, 4, 4, 16]);
        let [gw] = gradients(&out, &[], [&weight]);
        assert_eq!(gw, vec![0.0; 16 * 16 * 9]);
    }
}

#[test]
fn a_prepared_convolution_agrees_with_the_separate_layers() {
    for case in cases() {
        let (batch, [rows, columns], inputs, outputs, kernel, geometry) = case;
        let (x, w, b) = tensors(&case);
        let level = KernelLevel::detect();
        let (scale, shift) = (random(outputs, "scale"), random(outputs, "shift"));
        let weight_dims = [outputs, inputs / geometry.groups, kernel[0], kernel[1]];
        let input = var(&x, &[batch, rows, columns, inputs]);
        let out =
            conv2d(&input, &var(&w, &weight_dims), Some(&var(&b, &[outputs])), geometry, InputGradient::Unused, level)
                .and_then(|t| t.broadcast_mul(&var(&scale, &[outputs])))
                .and_then(|t| t.broadcast_add(&var(&shift, &[outputs])))
                .expect("layers");
        let residual = random(out.elem_count(), "r");
        let dims = [out.dims()[0], out.dims()[1], out.dims()[2], out.dims()[3]];
        let sum = (&out + var(&residual, out.dims()).as_tensor()).expect("sum");
        let affine = Some(Affine { scale: &scale, shift: &shift });
        let feature = Feature::new([batch, rows, columns, inputs], x).expect("feature");
        let residual = Feature::new(dims, residual).expect("feature");
        for (act, residual, want) in [
            (Activation::None, None, out.clone()),
            (Activation::Relu, Some(&residual), sum.relu().expect("relu")),
            (Activation::Silu, Some(&residual), sum.silu().expect("silu")),
        ] {
            let prepared = PreparedConv::new(&w, weight_dims, Some(&b), affine, geometry, act, level).expect("prepare");
            // A buffer that held a larger result before.
            let mut output = Feature::new([1, 1, 1, 9000], vec![f32::NAN; 9000]).expect("feature");
            prepared.run(&feature, residual, &mut output).expect("run");
            assert_eq!(output.dims(), dims);
            assert_near(&format!("{act:?} of {case:?}"), output.values(), &to_f64(&flat(&want)), 1e-5);
        }
    }
}

/// `[sample][row][column][channel]` to `[sample][channel][row][column]`.
fn channel_first(values: &[f32], channels: usize, cells: usize) -> Vec<f64> {
    let samples = values.chunks_exact(channels * cells);
    samples.flat_map(|s| (0..channels * cells).map(move |k| f64::from(s[k % cells * channels + k / cells]))).collect()
}

/// Windows of two by two cells, at all levels: odd sizes, maps smaller than a window, channel counts below a vector's
/// width, several panels, more windows than one task takes. Convolutions and blocks of one input channel have separate
/// code.
#[test]
fn convolutions_by_windows_agree_with_the_reference() {
    let windows = [
        (2, 5, 7, 9, 5),
        (3, 2, 3, 16, 33),
        (1, 1, 1, 20, 3),
        (1, 1, 6, 8, 16),
        (1, 23, 30, 16, 32),
        (2, 8, 8, 40, 70),
    ];
    let one_channel = [(2, 8, 6, 1, 16), (1, 7, 5, 1, 20), (3, 2, 3, 1, 3), (1, 30, 21, 1, 32)];
    for (batch, rows, columns, inputs, outputs) in windows.into_iter().chain(one_channel) {
        let (x, w, b) =
            (random(batch * rows * columns * inputs, "x"), random(outputs * inputs * 9, "w"), random(outputs, "b"));
        let plain: Vec<f64> = channel_first(&x, inputs, rows * columns)
            .chunks_exact(inputs * rows * columns)
            .flat_map(|s| reference::conv3x3(s, rows, columns, &to_f64(&w), &to_f64(&b)))
            .collect();
        let pooled = reference::max_pool2(&reference::relu(&plain), rows, columns);
        let input = Feature::new([batch, rows, columns, inputs], x).expect("feature");
        let mut output = Feature::new([1, 1, 1, 9000], vec![f32::NAN; 9000]).expect("feature");
        for level in KernelLevel::ALL {
            let case = format!("{rows} x {columns}, {inputs} to {outputs} at {level:?}");
            for act in [Activation::None, Activation::Relu] {
                let geometry = ConvGeometry::dense(1, 1);
                let conv = PreparedConv::new(&w, [outputs, inputs, 3, 3], Some(&b), None, geometry, act, level);
                conv.expect("prepare").run(&input, None, &mut output).expect("run");
                let want = if act == Activation::None { plain.clone() } else { reference::relu(&plain) };
                let got: Vec<f32> =
                    channel_first(output.values(), outputs, rows * columns).iter().map(|&v| v as f32).collect();
                assert_near(&case, &got, &want, 1e-6);
            }
            if rows >= 2 && columns >= 2 {
                let block = PreparedBlock::new(&w, [outputs, inputs], Some(&b), None, level).expect("prepare");
                block.run(&input, &mut output).expect("run");
                let cells = rows / 2 * (columns / 2);
                let got: Vec<f32> = channel_first(output.values(), outputs, cells).iter().map(|&v| v as f32).collect();
                assert_near(&case, &got, &pooled, 1e-6);
            }
        }
    }
}

mod hard_cases {
    use super::*;

    /// A NaN in any cell of a pooling window reaches the output.
    #[test]
    fn a_prepared_block_propagates_nan() {
        for level in KernelLevel::ALL {
            for inputs in [1, 9] {
                let block =
                    PreparedBlock::new(&random(3 * 9 * inputs, "w"), [3, inputs], None, None, level).expect("prepare");
                for cell in 0..64 {
                    let mut x = random(64 * inputs, "x");
                    x[cell * inputs] = f32::NAN;
                    let mut output = Feature::default();
                    block.run(&Feature::new([1, 8, 8, inputs], x).expect("feature"), &mut output).expect("run");
                    let window = cell / 16 * 4 + cell % 8 / 2;
                    assert!(output.values()[window * 3..][..3].iter().all(|v| v.is_nan()), "{level:?} {inputs} {cell}");
                }
            }
        }
    }

    #[test]
    fn any_number_of_threads_gives_the_same_bits() {
        // The last has several blocks of windows.
        for case in cases().into_iter().chain([(2, [23, 22], 96, 170, [3, 3], ConvGeometry::dense(1, 1))]) {
            let (batch, [rows, columns], inputs, outputs, kernel, geometry) = case;
            let (x, w, b) = tensors(&case);
            same_bits(&format!("{case:?}"), || {
                let input = var(&x, &[batch, rows, columns, inputs]);
                let weight = var(&w, &[outputs, inputs / geometry.groups, kernel[0], kernel[1]]);
                let bias = var(&b, &[outputs]);
                let level = KernelLevel::detect();
                let out =
                    conv2d(&input, &weight, Some(&bias), geometry, InputGradient::Needed, level).expect("forward");
                gradients_of_squares(&out, [&input, &weight, &bias])
            });
        }
    }

    #[test]
    fn nan_reaches_every_output_that_reads_it() {
        for level in KernelLevel::ALL {
            for (inputs, geometry) in [
                (3, ConvGeometry::dense(1, 1)),
                (16, ConvGeometry::dense(1, 1)),
                (20, ConvGeometry::depthwise(1, 1, 20)),
            ] {
                let mut x = random(5 * 5 * inputs, "x");
                x[(2 * 5 + 2) * inputs + 1] = f32::NAN;
                let input = var(&x, &[1, 5, 5, inputs]);
                let weight =
                    var(&random(inputs * inputs / geometry.groups * 9, "w"), &[inputs, inputs / geometry.groups, 3, 3]);
                let out = conv2d(&input, &weight, None, geometry, InputGradient::Needed, level).expect("forward");
                for (cell, values) in flat(&out).chunks_exact(inputs).enumerate() {
                    let near = (1..4).contains(&(cell / 5)) && (1..4).contains(&(cell % 5));
                    assert_eq!(values[1].is_nan(), near, "cell {cell}");
                }
            }
        }
    }

    #[test]
    fn wrong_shapes_name_the_layer_and_what_was_expected() {
        let level = KernelLevel::detect();
        let x = var(&random(2 * 4 * 4 * 6, "x"), &[2, 4, 4, 6]);
        let conv = |dims: &[usize], geometry| {
            let w = var(&random(dims.iter().product(), "w"), dims);
            conv2d(&x, &w, None, geometry, InputGradient::Needed, level).expect_err("wrong").to_string()
        };
        for (dims, geometry, why) in [
            (vec![6, 2, 3, 3], ConvGeometry { stride: 1, padding: 1, groups: 3 }, "groups must be 1 or the number"),
            (vec![5, 4, 3, 3], ConvGeometry::dense(1, 1), "channels of input and weight differ"),
            (vec![5, 6, 7, 7], ConvGeometry::dense(1, 1), "the kernel does not fit"),
            (vec![5, 6, 3, 3], ConvGeometry::dense(0, 1), "a stride of 0"),
            (vec![5, 6, 9], ConvGeometry::dense(1, 1), "wrong number of axes"),
        ] {
            let error = conv(&dims, geometry);
            assert!(error.contains("conv2d") && error.contains(why) && error.contains("[2, 4, 4, 6]"), "{error}");
        }
    }
}

/// Sums are rounded once: sums of large numbers that nearly cancel are exact to the last bit at every level.
#[test]
fn dense_layers_round_once() {
    for [batch, inputs, outputs] in [[1, 960, 64], [3, 64, 2], [2, 7, 33], [1, 1, 1]] {
        let (x, w, b) = (random(batch * inputs, "x"), random(outputs * inputs, "w"), random(outputs, "b"));
        let x: Vec<f32> = x.iter().map(|x| 1000.0 + x).collect();
        let input = Feature::new([batch, 1, 1, inputs], x.clone()).expect("feature");
        for level in KernelLevel::ALL {
            let dense = PreparedDense::new(&w, [outputs, inputs], &b, Activation::Relu, level).expect("prepare");
            let mut output = Feature::default();
            dense.run(&input, &mut output).expect("run");
            assert_eq!(output.dims(), [batch, 1, 1, outputs]);
            for (k, &found) in output.values().iter().enumerate() {
                let (row, o) = (k / outputs, k % outputs);
                let products = x[row * inputs..][..inputs].iter().zip(&w[o * inputs..]);
                let sum = products.fold(f64::from(b[o]), |sum, (&x, &w)| sum + f64::from(x) * f64::from(w));
                assert_eq!(found, (sum as f32).max(0.0), "{batch} {inputs} {outputs} {level:?}");
            }
            let wrong = Feature::new([1, 1, 1, inputs + 1], vec![0.0; inputs + 1]).expect("feature");
            assert!(dense.run(&wrong, &mut output).expect_err("too wide").to_string().contains("expected input"));
        }
    }
    assert!(PreparedDense::new(&[1.0], [1, 1], &[], Activation::None, KernelLevel::detect()).is_err());
}
