//! Single training steps on given maps, for benchmarks.

use candle_core::{Device, Result, Tensor, Var};
use rand::Rng;

use super::adam::Adam;
use crate::layer::{KernelLevel, backward, cross_entropy};
use crate::network::{Mode, Network, NetworkSpec};
use crate::random::stream;

/// Network with its optimiser.
pub struct Trainer {
    network: Network,
    adam: Adam,
    rates: Vec<f32>,
    steps: u64,
}

impl Trainer {
    /// Makes a network with random parameters.
    ///
    /// # Errors
    /// A tensor operation failed.
    pub fn new(spec: &NetworkSpec, seed: u64, learning_rate: f32, level: KernelLevel) -> Result<Self> {
        let network = Network::initialise(spec, seed, 0, level)?;
        let adam = Adam::new(network.trained().iter().map(|p| &p.variable));
        let rates = vec![learning_rate; network.trained().len()];
        Ok(Trainer { network, adam, rates, steps: 0 })
    }

    /// The network as it is.
    pub fn network(&self) -> &Network {
        &self.network
    }

    /// Runs a forward pass, a backward pass and Adam's step on the inputs of [`Trainer::random_inputs`]. Returns the loss before the
    /// step.
    ///
    /// # Errors
    /// Maps or labels do not fit the network, or a gradient is not finite.
    pub fn step(&mut self, maps: &Tensor, labels: &[usize]) -> Result<f32> {
        self.steps += 1;
        let output = self.network.graph().output;
        let mut values = self.network.run(maps, output, Mode::Training { seed: 1, step: self.steps, penalty: 0.0 })?;
        let logits = values.take(output)?;
        let classes = logits.dim(1)?;
        let loss = cross_entropy(&logits, labels, &vec![1.0; classes])?;
        let gradients = backward(&loss)?;
        drop(values);
        let variables: Vec<&Var> = self.network.trained().iter().map(|p| &p.variable).collect();
        if let Some(bad) = self.adam.step(variables.into_iter(), &gradients, &self.rates, &[])? {
            let name = self.network.trained().get(bad).map_or("a parameter", |p| &p.name);
            candle_core::bail!("gradient of {name} is not finite in step {}", self.steps);
        }
        loss.to_scalar()
    }

    /// Random inputs of a network for maps of `range x doppler` bins, and labels in turn: `[batch][range][doppler]`, or
    /// `[batch][1][descriptor]`.
    ///
    /// # Errors
    /// A tensor operation failed.
    pub fn random_inputs(
        spec: &NetworkSpec,
        batch: usize,
        range: usize,
        doppler: usize,
    ) -> Result<(Tensor, Vec<usize>)> {
        let [rows, columns] = spec.kind.input_size([range, doppler]);
        let mut rng = stream(1, "made-up maps", 0);
        let cells: Vec<f32> = (0..batch * rows * columns).map(|_| rng.random_range(-1.5..1.5)).collect();
        let inputs = Tensor::from_vec(cells, (batch, rows, columns), &Device::Cpu)?;
        Ok((inputs, (0..batch).map(|index| index % 3).collect()))
    }
}
