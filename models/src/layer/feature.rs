//! Feature maps of inference, without a graph of gradients.

use candle_core::{Result, bail};

/// Maps `[batch][row][column][channel]` in a buffer that keeps its memory between uses.
#[derive(Debug, Clone, Default)]
pub struct Feature {
    pub(super) dims: [usize; 4],
    pub(super) values: Vec<f32>,
}

impl Feature {
    /// Makes maps of these values.
    ///
    /// # Errors
    /// The number of values is not the product of `dims`.
    pub fn new(dims: [usize; 4], values: Vec<f32>) -> Result<Self> {
        if dims.iter().product::<usize>() != values.len() {
            bail!("feature: {dims:?} needs {} values, got {}", dims.iter().product::<usize>(), values.len());
        }
        Ok(Feature { dims, values })
    }

    /// Batch, rows, columns, channels.
    pub fn dims(&self) -> [usize; 4] {
        self.dims
    }

    /// The values, in row-major order.
    pub fn values(&self) -> &[f32] {
        &self.values
    }

    /// The values, to be overwritten.
    pub fn values_mut(&mut self) -> &mut [f32] {
        &mut self.values
    }

    /// Changes the shape. Values are arbitrary and must be overwritten.
    pub fn reshape(&mut self, dims: [usize; 4]) {
        self.dims = dims;
        self.values.resize(dims.iter().product(), 0.0);
    }
}

/// `x scale + shift` for each channel behind a convolution: batch normalisation in evaluation.
#[derive(Debug, Clone, Copy)]
pub struct Affine<'a> {
    /// Factor for each output.
    pub scale: &'a [f32],
    /// Summand for each output.
    pub shift: &'a [f32],
}

/// Folds an affine function behind a convolution into its weights `[o][..]` and its biases.
pub(super) fn fold_affine(
    weight: &[f32],
    outputs: usize,
    bias: Option<&[f32]>,
    affine: Option<Affine<'_>>,
) -> (Vec<f32>, Vec<f32>) {
    let scale = |o: usize| affine.map_or(1.0, |a| a.scale[o]);
    let length = weight.len() / outputs;
    let weight = weight.iter().enumerate().map(|(k, w)| w * scale(k / length)).collect();
    let bias = |o: usize| bias.map_or(0.0, |b| b[o]) * scale(o) + affine.map_or(0.0, |a| a.shift[o]);
    (weight, (0..outputs).map(bias).collect())
}
