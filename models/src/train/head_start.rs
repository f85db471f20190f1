//! Initialisation of a head: its parameters and an affine map of the latent, fitted to latents that a linear head has already
//! separated.
//!
//! The backbone is first trained with the linear head, which never failed. Its latent shows the classes as clusters. Then a few
//! numbers are fitted to a few hundred points, from several random angles and rotations, and the best fit is taken. Every head is
//! initialised in this way.

use candle_core::{Device, Tensor, Var};
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};

use super::adam::Adam;
use super::error::TrainError;
use crate::layer::{backward, cross_entropy};
use crate::network::{Mode, Network, Parameter, Value, names};
use crate::random::stream;

/// Random starts of the search.
const SEARCHES: u64 = 24;
/// Adam steps of each start.
const STEPS: usize = 200;
/// Adam's step size.
const RATE: f32 = 0.05;

/// Points that the head is fitted to.
pub(super) struct Points<'a> {
    /// Standardised latents, `[map][component]`.
    pub latents: &'a [Vec<f32>],
    pub labels: &'a [usize],
    pub class_weights: &'a [f32],
    /// Weight of the mean square of the mapped latent; 0 for heads without `pi * sigmoid`.
    pub penalty: f64,
    /// Whether an affine map of the latent is fitted too.
    pub fit_latent_map: bool,
    /// Standard deviation of the latent at the start.
    pub sigma: f32,
}

/// The map `u = matrix z + offset` of the latent, row by row.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct AffineMap {
    pub matrix: Vec<f32>,
    pub offset: Vec<f32>,
    /// Loss that was reached.
    pub loss: f64,
}

/// Fits the layers behind the latent, leaves the parameters of the best fit in the network, and returns its map of the latent.
pub(super) fn search(
    network: &Network,
    latent: Value,
    points: &Points,
    seed: u64,
    start: u64,
) -> Result<AffineMap, TrainError> {
    let head = parameters_behind(network, latent);
    let width = points.latents.first().map_or(0, Vec::len);
    let flat: Vec<f32> = points.latents.iter().flatten().copied().collect();
    let latents = Tensor::from_vec(flat, (points.latents.len(), width), &Device::Cpu)?;
    let mut best: Option<(AffineMap, Vec<Vec<f32>>)> = None;
    for index in 0..SEARCHES {
        let mut rng = stream(seed, "head start", start * SEARCHES + index);
        for Parameter { name, variable } in head.iter().copied().filter(|p| is_trained(network, p)) {
            let bound = if names::layer_of(name) == names::CIRCUIT { std::f32::consts::PI } else { 1.0 };
            let values: Vec<f32> = if name.ends_with(".bias") {
                vec![0.0; variable.elem_count()]
            } else {
                (0..variable.elem_count()).map(|_| rng.random_range(-bound..bound)).collect()
            };
            variable.set(&Tensor::from_vec(values, variable.shape(), &Device::Cpu)?)?;
        }
        let matrix = if points.fit_latent_map { rotation(width, points.sigma, &mut rng) } else { identity(width) };
        let matrix = Var::from_tensor(&Tensor::from_vec(matrix, (width, width), &Device::Cpu)?)?;
        let offset = Var::zeros(width, candle_core::DType::F32, &Device::Cpu)?;
        let loss = fit(network, latent, points, &latents, &head, &matrix, &offset)?;
        // The first of equal losses is kept; any loss is better than a NaN.
        if best.as_ref().is_none_or(|(b, _)| loss < b.loss || (b.loss.is_nan() && !loss.is_nan())) {
            let latent_map =
                AffineMap { matrix: matrix.flatten_all()?.to_vec1()?, offset: offset.flatten_all()?.to_vec1()?, loss };
            let values = head.iter().map(|p| p.variable.flatten_all()?.to_vec1()).collect::<Result<_, _>>()?;
            best = Some((latent_map, values));
        }
    }
    let Some((latent_map, values)) = best else {
        return Ok(AffineMap { matrix: identity(width), offset: vec![0.0; width], loss: f64::NAN });
    };
    for (Parameter { variable, .. }, values) in head.iter().zip(values) {
        variable.set(&Tensor::from_vec(values, variable.shape(), &Device::Cpu)?)?;
    }
    Ok(latent_map)
}

/// Fits once from the present parameters. Returns the loss at the end.
fn fit(
    network: &Network,
    latent: Value,
    points: &Points,
    latents: &Tensor,
    head: &[&Parameter],
    matrix: &Var,
    offset: &Var,
) -> Result<f64, TrainError> {
    let output = network.graph().output;
    let map_latents = || latents.matmul(&matrix.t()?)?.broadcast_add(offset);
    let penalty = points.penalty as f32;
    let mode = Mode::Training { seed: 0, step: 0, penalty };
    let loss = |mapped: &Tensor| {
        let logits = network.run_from(latent, mapped, &[output], mode)?.take(output)?;
        cross_entropy(&logits, points.labels, points.class_weights)
    };
    let variables: Vec<Var> = head.iter().map(|p| p.variable.clone()).chain([matrix.clone(), offset.clone()]).collect();
    let mut rates: Vec<f32> = head.iter().map(|p| if is_trained(network, p) { RATE } else { 0.0 }).collect();
    rates.extend([if points.fit_latent_map { RATE } else { 0.0 }; 2]);
    let mut adam = Adam::new(variables.iter());
    for _ in 0..STEPS {
        // A fit that diverges is not the best one.
        if adam.step(variables.iter(), &backward(&loss(&map_latents()?)?)?, &rates, &[])?.is_some() {
            return Ok(f64::NAN);
        }
    }
    let mapped = map_latents()?;
    let square = f64::from(mapped.sqr()?.mean_all()?.to_scalar::<f32>()?);
    Ok(f64::from(loss(&mapped)?.to_scalar::<f32>()?) + points.penalty * square)
}

/// Parameters of the layers between the latent and the logits.
pub(super) fn parameters_behind(network: &Network, latent: Value) -> Vec<&Parameter> {
    let graph = network.graph();
    let needed = graph.needed(&[graph.output], &[latent]);
    let nodes = graph.nodes.iter().zip(needed).filter(|(_, needed)| *needed);
    let declarations = nodes.flat_map(|(node, _)| node.declarations());
    let names: Vec<String> = declarations.map(|declaration| declaration.name).collect();
    network.trained().iter().filter(|parameter| names.contains(&parameter.name)).collect()
}

/// Returns whether an array is trained; angles may be frozen.
pub(super) fn is_trained(network: &Network, parameter: &Parameter) -> bool {
    let layer = names::layer_of(&parameter.name);
    !network.graph().nodes.iter().any(|node| node.name == layer && node.is_frozen())
}

fn identity(width: usize) -> Vec<f32> {
    (0..width * width).map(|k| if k / width.max(1) == k % width.max(1) { 1.0 } else { 0.0 }).collect()
}

/// A random orthogonal matrix times `scale`: Gaussian rows, each made orthogonal to those before it.
fn rotation(width: usize, scale: f32, rng: &mut impl Rng) -> Vec<f32> {
    let mut rows: Vec<Vec<f64>> = Vec::with_capacity(width);
    while rows.len() < width {
        let mut row: Vec<f64> = (0..width).map(|_| StandardNormal.sample(rng)).collect();
        for other in &rows {
            let along: f64 = row.iter().zip(other).map(|(a, b)| a * b).sum();
            row.iter_mut().zip(other).for_each(|(a, b)| *a -= along * b);
        }
        let length = row.iter().map(|a| a * a).sum::<f64>().sqrt();
        if length > 1e-6 {
            rows.push(row.into_iter().map(|a| a / length).collect());
        }
    }
    rows.into_iter().flatten().map(|a| scale * a as f32).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::layer::KernelLevel;
    use crate::network::NetworkSpec;
    use rand_distr::Normal;

    fn clusters() -> (Vec<Vec<f32>>, Vec<usize>) {
        let mut rng = stream(4, "clusters", 0);
        let normal = Normal::new(0.0f32, 0.25).expect("normal");
        let centres = [[-1.2, -0.7], [1.2, -0.7], [0.0, 1.4]];
        (0..150).map(|k| (centres[k % 3].iter().map(|c| c + normal.sample(&mut rng)).collect(), k % 3)).unzip()
    }

    #[test]
    fn rotations_are_orthogonal() {
        let q = rotation(5, 2.0, &mut stream(1, "rotation", 0));
        for (a, b) in (0..5).flat_map(|a| (0..5).map(move |b| (a, b))) {
            let product: f32 = (0..5).map(|k| q[5 * a + k] * q[5 * b + k]).sum();
            assert!((product - if a == b { 4.0 } else { 0.0 }).abs() < 1e-5);
        }
    }

    /// Every head that can separate three clusters in general position does so from any random start.
    #[test]
    fn three_clusters_are_separated() {
        let (latents, labels) = clusters();
        for (name, seed) in [("hqnn", 0), ("hqnn", 1), ("estimator_matched", 0), ("trigonometric", 0)] {
            let spec = NetworkSpec::named(name).expect("known");
            let network = Network::initialise(&spec, seed, 0, KernelLevel::detect()).expect("network");
            let points = Points {
                latents: &latents,
                labels: &labels,
                class_weights: &[1.0; 3],
                penalty: if spec.head.uses_scaled_sigmoid() { 0.02 } else { 0.0 },
                fit_latent_map: true,
                sigma: 0.7,
            };
            let latent = network.graph().value("latent").expect("latent");
            let found = search(&network, latent, &points, seed, 0).expect("search");
            assert!(found.loss < 0.15, "{name} seed {seed}: {}", found.loss);
        }
    }
}
