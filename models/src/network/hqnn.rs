//! The hybrid quantum-classical network (paper.md section 6), 66,447 parameters.
//!
//! ```text
//! map [1][range][doppler]
//!   conv 3x3  1 -> 16, ReLU, max-pool 2        160
//!   conv 3x3 16 -> 32, ReLU, max-pool 2      4,640
//!   adaptive average pool to (2, 15)
//!   linear 960 -> 64, ReLU                  61,504
//!   linear 64 -> 2: the latent                 130
//!   standardise by constants, pi * sigmoid
//!   two-qubit circuit, <ZI> and <IZ>             4
//!   linear 2 -> 3: logits                        9
//! ```
//! These are the paper's sizes; the pooled grid is a setting, for a map of which half the range is a room.
//!
//! The paper does not say whether a nonlinearity stands between the two dense layers. Without one they are a single
//! linear map and 61,504 of the parameters would be pointless, so there is a ReLU here.

use candle_core::{Device, Result, Tensor, Var};
use rand::Rng;
use serde::{Deserialize, Serialize};

use super::NetworkInfo;
use crate::layer::{InputGradient, KernelLevel, adaptive_average_pool, circuit, conv_relu_pool, linear};
use crate::stream;

/// Rows and columns (range, Doppler) after the adaptive pooling, in the paper.
pub const PAPER_POOLED: [usize; 2] = [2, 15];
/// Rows or columns that may be pooled to at most.
pub const MOST_POOLED: usize = 64;
/// Channels of the second block.
const CHANNELS: usize = 32;
const HIDDEN: usize = 64;

/// Names and shapes of the parameters in their order in files, of a network that pools to `pooled`; shapes as PyTorch's.
fn parameters(pooled: [usize; 2]) -> [(&'static str, Vec<usize>); 11] {
    [
        ("conv1.weight", vec![16, 1, 3, 3]),
        ("conv1.bias", vec![16]),
        ("conv2.weight", vec![CHANNELS, 16, 3, 3]),
        ("conv2.bias", vec![CHANNELS]),
        ("fc1.weight", vec![HIDDEN, CHANNELS * pooled[0] * pooled[1]]),
        ("fc1.bias", vec![HIDDEN]),
        ("fc2.weight", vec![2, HIDDEN]),
        ("fc2.bias", vec![2]),
        ("circuit.theta", vec![4]),
        ("head.weight", vec![3, 2]),
        ("head.bias", vec![3]),
    ]
}

/// Constants that standardise the latent before the squash: `(z - mean) / sigma`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct LatentConstants {
    /// Subtracted, for each of the two components.
    pub mean: [f32; 2],
    /// Divided by.
    pub sigma: [f32; 2],
}

impl Default for LatentConstants {
    /// No standardisation.
    fn default() -> Self {
        LatentConstants { mean: [0.0; 2], sigma: [1.0; 2] }
    }
}

/// What stands between latent and head.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Bypass {
    /// Squash and circuit.
    No,
    /// Nothing: the linear control head, with which the backbone is warmed up.
    Circuit,
}

/// Centre and scale of the pooled features, used while training only.
///
/// The features are averages of rectified values: all positive, with means far larger than what distinguishes one map
/// from another, which makes the dense layer behind them badly conditioned. Centring and scaling them is a change of
/// variables of that layer ([`Hqnn::fold`] undoes it exactly), so the network stays the paper's.
#[derive(Debug, Clone, PartialEq)]
pub struct FeatureScale {
    /// Subtracted from each of the pooled features.
    pub mean: Vec<f32>,
    /// Multiplied to each.
    pub scale: Vec<f32>,
}

/// What each stage of the network puts out, for a batch.
pub struct Stages {
    /// After the first block, `[batch][range/2][doppler/2][16]`.
    pub block1: Tensor,
    /// After the second block, `[batch][range/4][doppler/4][32]`.
    pub block2: Tensor,
    /// Pooled features `[batch][32 * rows * columns]`, before [`FeatureScale`].
    pub features: Tensor,
    /// Hidden layer `[batch][64]` after its ReLU.
    pub hidden: Tensor,
    /// Latent `[batch][2]`, before its standardisation.
    pub latent: Tensor,
    /// Latent after its standardisation `[batch][2]`: what is squashed.
    pub standardised: Tensor,
    /// `[<ZI>, <IZ>]` of the circuit `[batch][2]`.
    pub expectations: Tensor,
    /// `[batch][3]`.
    pub logits: Tensor,
}

impl Stages {
    /// Name of the first stage that holds a NaN or an infinity.
    pub fn first_non_finite(&self) -> Result<Option<&'static str>> {
        let stages = [
            ("conv1", &self.block1),
            ("conv2", &self.block2),
            ("pool", &self.features),
            ("fc1", &self.hidden),
            ("fc2 (latent)", &self.latent),
            ("circuit", &self.expectations),
            ("head", &self.logits),
        ];
        for (name, tensor) in stages {
            if tensor.flatten_all()?.to_vec1::<f32>()?.iter().any(|v| !v.is_finite()) {
                return Ok(Some(name));
            }
        }
        Ok(None)
    }
}

/// The network and its parameters.
pub struct Hqnn {
    variables: Vec<Var>,
    pooled: [usize; 2],
    /// Standardisation of the latent.
    pub latent: LatentConstants,
    feature_scale: Option<FeatureScale>,
    /// Whether the head sees the circuit's expectations or the standardised latent itself.
    pub bypass: Bypass,
    level: KernelLevel,
}

impl Hqnn {
    /// Name in model files.
    pub const NAME: &'static str = "hqnn";

    /// A network with random parameters: He's uniform (He et al., ICCV 2015, equation 10) before a ReLU, `1/sqrt(n)`
    /// for the latent and the head, angles in +-pi; biases zero.
    pub fn initialise(seed: u64, attempt: u64, pooled: [usize; 2], level: KernelLevel) -> Result<Self> {
        let values = parameters(pooled).map(|(name, shape)| {
            let mut rng = stream(seed, name, attempt);
            let count: usize = shape.iter().product();
            let fan_in: usize = shape.iter().skip(1).product();
            let bound = match name {
                "conv1.weight" | "conv2.weight" | "fc1.weight" => (6.0 / fan_in as f32).sqrt(),
                "fc2.weight" | "head.weight" => (3.0 / fan_in as f32).sqrt(),
                "circuit.theta" => std::f32::consts::PI,
                _ => return vec![0.0; count],
            };
            (0..count).map(|_| rng.random_range(-bound..bound)).collect()
        });
        Self::from_values(&values, pooled, LatentConstants::default(), level)
    }

    /// A network with these parameters, in the order and with the lengths of [`Hqnn::layout`].
    pub fn from_values(
        values: &[Vec<f32>],
        pooled: [usize; 2],
        latent: LatentConstants,
        level: KernelLevel,
    ) -> Result<Self> {
        let parameters = parameters(pooled);
        if values.len() != parameters.len() {
            candle_core::bail!("hqnn: expected {} parameter arrays, got {}", parameters.len(), values.len());
        }
        let variables = parameters
            .into_iter()
            .zip(values)
            .map(|((name, shape), values)| {
                Var::from_tensor(&Tensor::from_slice(values, shape, &Device::Cpu)?).map_err(|e| e.context(name))
            })
            .collect::<Result<_>>()?;
        Ok(Hqnn { variables, pooled, latent, feature_scale: None, bypass: Bypass::No, level: level.available() })
    }

    /// Names and shapes of the parameters, in order, of a network that pools to `pooled` rows and columns.
    pub fn layout(pooled: [usize; 2]) -> [(&'static str, Vec<usize>); 11] {
        parameters(pooled)
    }

    /// Rows and columns that the second block's output is averaged to.
    pub fn pooled(&self) -> [usize; 2] {
        self.pooled
    }

    /// The parameters, in the order of [`Hqnn::layout`].
    pub fn variables(&self) -> &[Var] {
        &self.variables
    }

    /// Copies of all parameters, in order.
    pub fn values(&self) -> Result<Vec<Vec<f32>>> {
        self.variables.iter().map(|v| v.flatten_all()?.to_vec1()).collect()
    }

    /// Overwrites all parameters with copies made by [`Hqnn::values`].
    pub fn set_values(&self, values: &[Vec<f32>]) -> Result<()> {
        for (variable, values) in self.variables.iter().zip(values) {
            variable.set(&Tensor::from_slice(values, variable.shape(), &Device::Cpu)?)?;
        }
        Ok(())
    }

    /// Trained numbers.
    pub fn parameter_count(pooled: [usize; 2]) -> usize {
        parameters(pooled).iter().map(|(_, shape)| shape.iter().product::<usize>()).sum()
    }

    /// Size and cost of the paper's network for maps `[1][range][doppler]`.
    pub fn info(input: [usize; 3]) -> NetworkInfo {
        let [_, range, doppler] = input;
        let conv1 = 9 * 16 * range * doppler;
        let conv2 = 9 * 16 * 32 * (range / 2) * (doppler / 2);
        let dense = CHANNELS * PAPER_POOLED[0] * PAPER_POOLED[1] * HIDDEN + HIDDEN * 2 + 2 * 3;
        NetworkInfo {
            name: Self::NAME.to_owned(),
            parameters: Self::parameter_count(PAPER_POOLED),
            multiply_adds: (conv1 + conv2 + dense) as u64,
            input,
        }
    }

    /// Sets or removes the centring and scaling of the features.
    pub fn set_feature_scale(&mut self, scale: Option<FeatureScale>) {
        self.feature_scale = scale;
    }

    /// Moves the centring and scaling of the features into the weights and the bias of the dense layer behind them.
    pub fn fold(&mut self) -> Result<()> {
        let Some(scale) = self.feature_scale.take() else { return Ok(()) };
        let mut values = self.values()?;
        if let [_, _, _, _, weight, bias, ..] = values.as_mut_slice() {
            for (row, bias) in weight.chunks_exact_mut(scale.mean.len().max(1)).zip(bias) {
                let mut shift = 0.0f64;
                for ((w, s), m) in row.iter_mut().zip(&scale.scale).zip(&scale.mean) {
                    *w *= s;
                    shift += f64::from(*w) * f64::from(*m);
                }
                *bias -= shift as f32;
            }
        }
        self.set_values(&values)
    }

    fn variable(&self, index: usize) -> Result<&Tensor> {
        match self.variables.get(index) {
            Some(variable) => Ok(variable.as_tensor()),
            None => candle_core::bail!("hqnn: parameter {index} is missing"),
        }
    }

    /// Everything the network computes for `input` `[batch][range][doppler]` (standardised dB).
    pub fn stages(&self, input: &Tensor) -> Result<Stages> {
        let input = input.unsqueeze(3)?;
        let p = |index| self.variable(index);
        let block1 = conv_relu_pool(&input, p(0)?, p(1)?, InputGradient::Unused, self.level)?;
        let block2 = conv_relu_pool(&block1, p(2)?, p(3)?, InputGradient::Needed, self.level)?;
        let features = adaptive_average_pool(&block2, self.pooled[0], self.pooled[1])?;
        let centred = match &self.feature_scale {
            Some(scale) => {
                let mean = Tensor::from_slice(&scale.mean, scale.mean.len(), &Device::Cpu)?;
                let factor = Tensor::from_slice(&scale.scale, scale.scale.len(), &Device::Cpu)?;
                features.broadcast_sub(&mean)?.broadcast_mul(&factor)?
            }
            None => features.clone(),
        };
        let hidden = linear(&centred, p(4)?, p(5)?, self.level)?.relu()?;
        let latent = linear(&hidden, p(6)?, p(7)?, self.level)?;
        let LatentConstants { mean, sigma } = self.latent;
        let mean = Tensor::new(&mean, &Device::Cpu)?;
        let factor = Tensor::new(&sigma.map(|s| 1.0 / s), &Device::Cpu)?;
        let standardised = latent.broadcast_sub(&mean)?.broadcast_mul(&factor)?;
        let expectations = match self.bypass {
            Bypass::No => circuit(&squash(&standardised)?, p(8)?)?,
            Bypass::Circuit => standardised.clone(),
        };
        let logits = linear(&expectations, p(9)?, p(10)?, self.level)?;
        Ok(Stages { block1, block2, features, hidden, latent, standardised, expectations, logits })
    }
}

/// `pi * sigmoid(u)`: the circuit's input, radians in (0, pi). The sigmoid is half a hyperbolic tangent of half its
/// argument, which does not overflow.
fn squash(standardised: &Tensor) -> Result<Tensor> {
    let half_pi = 0.5 * std::f64::consts::PI;
    standardised.affine(0.5, 0.0)?.tanh()?.affine(half_pi, half_pi)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parameters_are_the_papers() {
        assert_eq!(Hqnn::parameter_count(PAPER_POOLED), 66_447);
        let network = Hqnn::initialise(1, 0, PAPER_POOLED, KernelLevel::detect()).expect("network");
        assert_eq!(network.variables().iter().map(|v| v.elem_count()).sum::<usize>(), 66_447);
        assert_eq!(Hqnn::info([1, 128, 128]).parameters, 66_447);
    }

    #[test]
    fn folding_the_feature_scale_leaves_the_answer_alone() {
        let pooled = [3, 4];
        let features = CHANNELS * 3 * 4;
        let mut network = Hqnn::initialise(5, 0, pooled, KernelLevel::detect()).expect("network");
        let mut rng = stream(5, "maps", 0);
        let maps: Vec<f32> = (0..2 * 40 * 48).map(|_| rng.random_range(-1.0..1.0)).collect();
        let input = Tensor::from_vec(maps, (2, 40, 48), &Device::Cpu).expect("tensor");
        network.set_feature_scale(Some(FeatureScale {
            mean: (0..features).map(|_| rng.random_range(0.0..1.0)).collect(),
            scale: (0..features).map(|_| rng.random_range(0.5..2.0)).collect(),
        }));
        let latent = |n: &Hqnn| n.stages(&input).and_then(|s| s.latent.flatten_all()?.to_vec1::<f32>()).expect("run");
        let before = latent(&network);
        network.fold().expect("fold");
        for (a, b) in before.iter().zip(latent(&network)) {
            assert!((a - b).abs() < 1e-4 * a.abs().max(1.0), "{a} {b}");
        }
    }
}
