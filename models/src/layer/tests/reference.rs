//! Reference layers in f64, written from their formulas, channel-first. The fast layers are tested against them.

/// 3x3 convolution, padding 1. `input` `[i][rows][columns]`, `weight` `[o][i][3][3]`; result `[o][rows][columns]`.
pub fn conv3x3(input: &[f64], rows: usize, columns: usize, weight: &[f64], bias: &[f64]) -> Vec<f64> {
    conv2d(input, [rows, columns], weight, [3, 3], bias, 1, 1, 1)
}

/// `max(x, 0)`.
pub fn relu(input: &[f64]) -> Vec<f64> {
    input.iter().map(|v| v.max(0.0)).collect()
}

/// 2x2 max-pooling with stride 2 of `[channel][rows][columns]`; an odd last row or column is dropped.
pub fn max_pool2(input: &[f64], rows: usize, columns: usize) -> Vec<f64> {
    max_pool(input, [rows, columns], 2, 2, 0)
}

/// Adaptive average pooling of `[channel][rows][columns]` to `[channel][pooled_rows][pooled_columns]`.
pub fn adaptive_average_pool(
    input: &[f64],
    rows: usize,
    columns: usize,
    (pooled_rows, pooled_columns): (usize, usize),
) -> Vec<f64> {
    let mut out = Vec::new();
    for plane in input.chunks_exact(rows * columns) {
        for i in 0..pooled_rows {
            let (top, bottom) = (i * rows / pooled_rows, ((i + 1) * rows).div_ceil(pooled_rows));
            for j in 0..pooled_columns {
                let (left, right) = (j * columns / pooled_columns, ((j + 1) * columns).div_ceil(pooled_columns));
                let cells = (top..bottom).flat_map(|y| (left..right).map(move |x| plane[y * columns + x]));
                out.push(cells.sum::<f64>() / ((bottom - top) * (right - left)) as f64);
            }
        }
    }
    out
}

/// `weight x + bias` for one sample.
pub fn linear(input: &[f64], weight: &[f64], bias: &[f64]) -> Vec<f64> {
    let rows = weight.chunks_exact(input.len());
    rows.zip(bias).map(|(w, b)| b + w.iter().zip(input).map(|(w, x)| w * x).sum::<f64>()).collect()
}

/// Cross-entropy of one sample.
pub fn cross_entropy(logits: &[f64], label: usize) -> f64 {
    logits.iter().map(|z| z.exp()).sum::<f64>().ln() - logits[label]
}

/// Convolution of one sample with zero padding. `input` `[i][rows][columns]`, `weight` `[o][i / groups][kernel]`; result
/// `[o][rows'][columns']`.
#[allow(clippy::too_many_arguments)]
pub fn conv2d(
    input: &[f64],
    [rows, columns]: [usize; 2],
    weight: &[f64],
    kernel: [usize; 2],
    bias: &[f64],
    stride: usize,
    padding: usize,
    groups: usize,
) -> Vec<f64> {
    let outputs = bias.len();
    let inputs = weight.len() / (outputs * kernel[0] * kernel[1]);
    let length = |input: usize, kernel: usize| (input + 2 * padding - kernel) / stride + 1;
    let mut out = Vec::new();
    for o in 0..outputs {
        let first = o / (outputs / groups) * inputs;
        for y in 0..length(rows, kernel[0]) {
            for x in 0..length(columns, kernel[1]) {
                let mut sum = bias[o];
                for i in 0..inputs {
                    for ky in 0..kernel[0] {
                        for kx in 0..kernel[1] {
                            let (row, column) = (y * stride + ky, x * stride + kx);
                            let inside = (padding..rows + padding).contains(&row)
                                && (padding..columns + padding).contains(&column);
                            if inside {
                                let cell = ((first + i) * rows + row - padding) * columns + column - padding;
                                sum += weight[((o * inputs + i) * kernel[0] + ky) * kernel[1] + kx] * input[cell];
                            }
                        }
                    }
                }
                out.push(sum);
            }
        }
    }
    out
}

/// Max-pooling of `[channel][rows][columns]`; padding is never a maximum.
pub fn max_pool(input: &[f64], [rows, columns]: [usize; 2], kernel: usize, stride: usize, padding: usize) -> Vec<f64> {
    // 0 where the window is larger than the plane.
    let positions = |length: usize| (length + 2 * padding).checked_sub(kernel).map_or(0, |rest| rest / stride + 1);
    let mut out = Vec::new();
    for plane in input.chunks_exact(rows * columns) {
        for y in 0..positions(rows) {
            for x in 0..positions(columns) {
                let window = |position: usize, length: usize| {
                    (position * stride).saturating_sub(padding)..(position * stride + kernel - padding).min(length)
                };
                let cells = window(y, rows).flat_map(|r| window(x, columns).map(move |c| plane[r * columns + c]));
                out.push(cells.fold(f64::NEG_INFINITY, f64::max));
            }
        }
    }
    out
}

/// Batch normalisation of `[row][channel]` by its own mean and biased variance, which are also returned.
pub fn batch_norm(input: &[f64], weight: &[f64], bias: &[f64], epsilon: f64) -> (Vec<f64>, Vec<f64>, Vec<f64>) {
    let channels = weight.len();
    let count = (input.len() / channels) as f64;
    let column = |k: usize| input.iter().skip(k).step_by(channels);
    let mean: Vec<f64> = (0..channels).map(|k| column(k).sum::<f64>() / count).collect();
    let variance: Vec<f64> =
        (0..channels).map(|k| column(k).map(|x| (x - mean[k]).powi(2)).sum::<f64>() / count).collect();
    let normal = |(index, x): (usize, &f64)| {
        let k = index % channels;
        (x - mean[k]) / (variance[k] + epsilon).sqrt() * weight[k] + bias[k]
    };
    (input.iter().enumerate().map(normal).collect(), mean, variance)
}

/// `x / (1 + exp(-x))`.
pub fn silu(x: f64) -> f64 {
    x / (1.0 + (-x).exp())
}
