//! Training of one initialisation over the epochs.

use std::time::Instant;

use candle_core::{Tensor, Var};
use radome_dsp::Occupancy;
use rand::seq::SliceRandom;

use super::adam::Adam;
use super::checkpoint::{Best, RunState};
use super::data::Data;
use super::error::TrainError;
use super::full_batch;
use super::head_start;
use super::outcome::{EpochReport, StepTimes};
use super::spec::{LatentStandardisation, TrainSpec};
use super::start::{
    self, descriptor_normalisation, feature_normalisation, latent_arrays, moments, rows_of, scale_hidden, scale_latent,
};
use crate::layer::{KernelLevel, backward, cross_entropy};
use crate::metrics::{Metrics, most_probable};
use crate::network::{MissingLayer, Mode, Network, Normalisation, TorchvisionWeights, Value, names};
use crate::random::stream;

/// Steps that are timed.
const TIMED_STEPS: usize = 4;

/// Training of one initialisation.
pub(super) struct Run<'a> {
    data: &'a Data,
    spec: &'a TrainSpec,
    start: u64,
    network: Network,
    adam: Adam,
    epoch: usize,
    step: usize,
    /// Whether the linear head of the warm-up replaces the head.
    warming_up: bool,
    /// Step at which the head was initialised: the step size warms up again from there.
    head_step: usize,
    latest_loss: f64,
    best: Option<Best>,
}

impl<'a> Run<'a> {
    /// Initialises a network and scales its features and its latent.
    pub(super) fn start(
        data: &'a Data,
        spec: &'a TrainSpec,
        weights: Option<&TorchvisionWeights>,
        start: u64,
        level: KernelLevel,
    ) -> Result<Self, TrainError> {
        let network = Network::initialise(&spec.network_spec(), spec.seed, start, level)?;
        if let Some(weights) = weights {
            weights.apply(&network)?;
        }
        let mut run = Self::new(data, spec, start, network);
        if spec.network.reads_descriptors() {
            run.normalise_descriptors()?;
        }
        if spec.network.has_latent() {
            run.start_latent()?;
        }
        Ok(run)
    }

    /// Gives each descriptor mean 0 and standard deviation 1.
    fn normalise_descriptors(&mut self) -> Result<(), TrainError> {
        // Measured on all maps, because some descriptors are non-zero on few of them.
        let all: Vec<usize> = (0..self.data.train.maps.len()).collect();
        let descriptors = self.results(names::DESCRIPTORS, &all)?;
        self.set_feature_constants(descriptor_normalisation(&descriptors))
    }

    /// Scales the layers up to the latent by some maps, and begins the warm-up.
    fn start_latent(&mut self) -> Result<(), TrainError> {
        let mut positions: Vec<usize> = (0..self.data.train.maps.len()).collect();
        positions.shuffle(&mut stream(self.spec.seed, "start maps", self.start));
        positions.truncate(start::START_MAPS);
        if !self.spec.network.reads_descriptors() {
            let pooled = self.results(names::POOL, &positions)?;
            self.set_feature_constants(feature_normalisation(&pooled, self.spec.feature_sigma))?;
        }
        if self.has_hidden_before_latent()? {
            scale_hidden(&self.network, &self.results(names::HIDDEN, &positions)?)?;
        }
        scale_latent(&self.network, &self.results(names::LATENT_DENSE, &positions)?, self.spec.latent_sigma)?;
        if self.spec.latent != LatentStandardisation::None {
            self.measure_latent()?;
        }
        self.warming_up = true;
        if self.spec.linear_epochs() == 0 {
            self.start_head()?;
        }
        Ok(())
    }

    /// Returns whether a hidden layer comes before the latent. There may be none, or one behind the circuit.
    fn has_hidden_before_latent(&self) -> Result<bool, MissingLayer> {
        if self.network.graph().value(names::HIDDEN_DENSE).is_none() {
            return Ok(false);
        }
        Ok(self.network.value_of(names::HIDDEN)? < self.network.value_of(names::LATENT)?)
    }

    /// Output of a layer for the training maps at `positions`, row by row.
    fn results(&self, layer: &'static str, positions: &[usize]) -> Result<Vec<Vec<f32>>, TrainError> {
        rows_of(&self.network, self.data, &self.data.train, positions, self.network.value_of(layer)?)
    }

    /// Sets the constants by which the features are standardised until the end of the training.
    fn set_feature_constants(&mut self, constants: Normalisation) -> Result<(), TrainError> {
        self.network.value_of(names::FEATURES)?;
        self.network.parameters_mut().set_normalisation(names::FEATURES, constants);
        Ok(())
    }

    fn new(data: &'a Data, spec: &'a TrainSpec, start: u64, network: Network) -> Self {
        let adam = Adam::new(network.trained().iter().map(|p| &p.variable));
        Run {
            data,
            spec,
            start,
            network,
            adam,
            epoch: 0,
            step: 0,
            warming_up: false,
            head_step: 0,
            latest_loss: f64::INFINITY,
            best: None,
        }
    }

    /// Continues from the result of [`Run::state`]. Errors name the array that does not fit.
    pub(super) fn resume(
        data: &'a Data,
        spec: &'a TrainSpec,
        state: RunState,
        level: KernelLevel,
    ) -> Result<Self, TrainError> {
        let network = Network::initialise(&spec.network_spec(), spec.seed, state.start, level)?;
        let mut run = Self::new(data, spec, state.start, network);
        // The checkpoint is unusable if the network has changed since; a study then begins the training again.
        let result = run.network.parameters().set_values(&state.values);
        result.map_err(|error| TrainError::Checkpoint { what: error.to_string() })?;
        for (name, normalisation) in state.normalisations {
            run.network.parameters_mut().set_normalisation(&name, normalisation);
        }
        let names: Vec<String> = run.network.trained().iter().map(|p| p.name.clone()).collect();
        run.adam
            .restore(names.iter().map(String::as_str), &state.moments, state.adam_steps)
            .map_err(|missing| TrainError::Checkpoint { what: format!("array {missing} is missing or too short") })?;
        run.epoch = state.epoch;
        run.step = state.step;
        run.warming_up = state.warming_up;
        run.head_step = state.head_step;
        run.latest_loss = state.latest_loss;
        run.best = state.best;
        Ok(run)
    }

    /// Everything that [`Run::resume`] needs.
    pub(super) fn state(&self) -> Result<RunState, TrainError> {
        let parameters = self.network.parameters();
        let normalisations = [names::FEATURES, names::LATENT]
            .into_iter()
            .filter_map(|name| Some((name.to_owned(), parameters.normalisation(name)?.clone())));
        Ok(RunState {
            start: self.start,
            epoch: self.epoch,
            step: self.step,
            warming_up: self.warming_up,
            head_step: self.head_step,
            adam_steps: self.adam.steps(),
            latest_loss: self.latest_loss,
            normalisations: normalisations.collect(),
            values: parameters.values(true)?,
            moments: self.adam.arrays(self.network.trained().iter().map(|p| p.name.as_str())),
            best: self.best.clone(),
        })
    }

    /// Ends the warm-up: [`head_start`] gives the parameters of the head and the map of the latent.
    fn start_head(&mut self) -> Result<(), TrainError> {
        if !self.spec.network.has_latent() {
            return Ok(());
        }
        let latent = self.network.value_of(names::LATENT)?;
        let mut positions: Vec<usize> = (0..self.data.train.maps.len()).collect();
        positions.shuffle(&mut stream(self.spec.seed, "circuit maps", self.start));
        positions.truncate(start::START_MAPS);
        let fit_latent_map = self.spec.latent == LatentStandardisation::None;
        let mut rows = rows_of(&self.network, self.data, &self.data.train, &positions, latent)?;
        let normalisation = if fit_latent_map { moments(&rows) } else { Normalisation::default() };
        for row in &mut rows {
            for ((z, mean), sigma) in row.iter_mut().zip(&normalisation.mean).zip(&normalisation.sigma) {
                *z = (*z - mean) / sigma;
            }
        }
        let labels: Vec<usize> = positions.iter().filter_map(|&p| self.data.train.labels.get(p)).copied().collect();
        let points = head_start::Points {
            latents: &rows,
            labels: &labels,
            class_weights: &self.data.class_weights,
            penalty: self.penalty(),
            fit_latent_map,
            sigma: self.spec.latent_sigma,
        };
        let latent_map = head_start::search(&self.network, latent, &points, self.spec.seed, self.start)?;
        if fit_latent_map {
            self.fold_latent_map(&latent_map, &normalisation)?;
        }
        self.warming_up = false;
        self.adam = Adam::new(self.network.trained().iter().map(|p| &p.variable));
        self.head_step = self.step;
        self.best = None;
        Ok(())
    }

    /// Folds `u = matrix (z - mean) / sigma + offset` with `z = weight h + bias` into weight and bias.
    fn fold_latent_map(
        &self,
        latent_map: &head_start::AffineMap,
        normalisation: &Normalisation,
    ) -> Result<(), TrainError> {
        let parameters = self.network.parameters();
        let [weight_name, bias_name] = latent_arrays();
        let (weight, bias) = (parameters.numbers(&weight_name)?, parameters.numbers(&bias_name)?);
        let width = bias.len();
        let inputs = weight.len() / width.max(1);
        let (mut new_weight, mut new_bias) = (vec![0.0f32; weight.len()], latent_map.offset.clone());
        for (k, matrix) in latent_map.matrix.chunks_exact(width.max(1)).enumerate() {
            for (j, &m) in matrix.iter().enumerate() {
                let m = m / normalisation.sigma[j];
                new_bias[k] += m * (bias[j] - normalisation.mean[j]);
                let row = weight.get(j * inputs..(j + 1) * inputs).unwrap_or_default();
                new_weight.iter_mut().skip(k * inputs).zip(row).for_each(|(new, old)| *new += m * old);
            }
        }
        parameters.set_numbers(&weight_name, &new_weight)?;
        parameters.set_numbers(&bias_name, &new_bias)?;
        Ok(())
    }

    pub(super) fn start_index(&self) -> u64 {
        self.start
    }

    /// Number of trained epochs.
    pub(super) fn epochs_done(&self) -> usize {
        self.epoch
    }

    /// Loss on the validation split after the latest epoch.
    pub(super) fn validation_loss(&self) -> f64 {
        self.latest_loss
    }

    /// Logits that are trained: the head's, or those of the linear head in the warm-up.
    fn output(&self) -> Result<Value, MissingLayer> {
        if self.warming_up { self.network.value_of(names::WARM_UP) } else { Ok(self.network.graph().output) }
    }

    /// Weight of the penalty on the mean square of the latent, for heads with `pi * sigmoid`.
    fn penalty(&self) -> f64 {
        if self.spec.network.has_latent() && self.spec.head.uses_scaled_sigmoid() {
            self.spec.latent_penalty
        } else {
            0.0
        }
    }

    /// Trains for one epoch.
    pub(super) fn epoch(&mut self, chosen: bool) -> Result<EpochReport, TrainError> {
        let started = Instant::now();
        if self.spec.latent == LatentStandardisation::FrozenByEpoch {
            self.measure_latent()?;
        }
        if self.warming_up && self.epoch >= self.spec.linear_epochs() {
            self.start_head()?;
        }
        self.epoch += 1;
        let mut order: Vec<usize> = (0..self.data.train.maps.len()).collect();
        order.shuffle(&mut stream(self.spec.seed, "order", self.epoch as u64));
        let (mut loss, mut pairs, mut maps) = (0.0, Vec::with_capacity(order.len()), 0);
        for batch in order.chunks(self.spec.batch_size) {
            // A batch of one map has no variance for batch normalisation. The map is in another batch in the next epoch.
            if batch.len() == 1 && order.len() > 1 && self.network.graph().batch_norms().next().is_some() {
                continue;
            }
            loss += self.train_batch(batch, &mut pairs)? * batch.len() as f64;
            maps += batch.len();
        }
        let training = Metrics::from_predictions(pairs);
        let (validation_loss, validation) = self.validate()?;
        self.latest_loss = validation_loss;
        let is_best = self.best.as_ref().is_none_or(|b| {
            let score = validation.balanced_accuracy;
            score > b.balanced_accuracy || (score == b.balanced_accuracy && validation_loss < b.loss)
        });
        if is_best {
            self.best = Some(Best {
                balanced_accuracy: validation.balanced_accuracy,
                loss: validation_loss,
                epoch: self.epoch,
                values: self.network.values()?,
                latent: self.network.latent_constants(),
            });
        }
        Ok(EpochReport {
            start: self.start,
            chosen,
            epoch: self.epoch,
            epochs: self.spec.epochs,
            training_loss: loss / maps.max(1) as f64,
            training_balanced_accuracy: training.balanced_accuracy,
            validation_loss,
            validation_balanced_accuracy: validation.balanced_accuracy,
            seconds: started.elapsed().as_secs_f64(),
        })
    }

    /// Measures the fit of the head, steps on the first batch after it, and the validation of one batch. The first step and the first
    /// validation are not counted.
    pub(super) fn time_steps(mut self) -> Result<StepTimes, TrainError> {
        let started = Instant::now();
        self.start_head()?;
        let head_s = started.elapsed().as_secs_f64();
        self.epoch = 1;
        let batch: Vec<usize> = (0..self.data.train.maps.len().min(self.spec.batch_size)).collect();
        let step_s = mean_s(TIMED_STEPS, || self.train_batch(&batch, &mut Vec::new()).map(|_| ()))?;
        let part = &self.data.validation;
        let positions: Vec<usize> = (0..part.maps.len().min(start::EVALUATION_BATCH)).collect();
        let output = self.output()?;
        let batch_s = mean_s(1, || rows_of(&self.network, self.data, part, &positions, output).map(|_| ()))?;
        Ok(StepTimes { head_s, step_s, validation_map_s: batch_s / positions.len().max(1) as f64 })
    }

    /// The network (with its head) as it was after its best epoch, and that epoch.
    pub(super) fn finish(mut self) -> Result<(Network, usize), TrainError> {
        if self.warming_up {
            self.start_head()?;
        }
        let mut epoch = self.epoch;
        if let Some(best) = self.best.take() {
            self.network.parameters().set_values(&best.values)?;
            self.network.set_latent_constants(best.latent);
            epoch = best.epoch;
        }
        if let Some(settings) = self.spec.full_batch
            && !full_batch::fit(&self.network, self.data, settings, self.penalty())?
        {
            return Err(self.non_finite("loss of the training split".to_owned()));
        }
        self.network.fold_features()?;
        Ok((self.network, epoch))
    }

    /// Takes one step. Returns the loss and appends (truth, prediction).
    fn train_batch(&mut self, batch: &[usize], pairs: &mut Vec<(Occupancy, Occupancy)>) -> Result<f64, TrainError> {
        self.step += 1;
        let (input, labels) = self.data.augmented(batch, &self.spec.augmentation, self.spec.seed, self.epoch)?;
        // Dropout draws other values for each start.
        let step = (self.start << 32) + self.step as u64;
        let output = self.output()?;
        let penalty = if self.warming_up { 0.0 } else { self.penalty() as f32 };
        let mode = Mode::Training { seed: self.spec.seed, step, penalty };
        let values = self.network.run(&input, output, mode)?;
        let logits = values.get(output)?;
        let loss = cross_entropy(logits, &labels, &self.data.class_weights)?;
        let value = f64::from(loss.to_scalar::<f32>()?);
        if !value.is_finite() {
            let what = values.first_non_finite()?.unwrap_or("loss").to_owned();
            return Err(self.non_finite(format!("output of {what}")));
        }
        add_predictions(logits, &labels, pairs)?;
        let gradients = backward(&loss)?;
        let latent_rows: Option<Vec<Vec<f32>>> = match (self.spec.latent, self.network.raw_latent()?) {
            (LatentStandardisation::Running { .. }, Some(raw)) => Some(values.get(raw)?.to_vec2()?),
            _ => None,
        };
        drop(values);
        let rates = self.rates();
        let decays = self.decays(&rates);
        let variables: Vec<&Var> = self.network.trained().iter().map(|p| &p.variable).collect();
        if let Some(bad) = self.adam.step(variables.into_iter(), &gradients, &rates, &decays)? {
            let name = self.network.trained().get(bad).map_or("a parameter", |p| &p.name).to_owned();
            return Err(self.non_finite(format!("gradient of {name}")));
        }
        if let (LatentStandardisation::Running { momentum }, Some(rows)) = (self.spec.latent, latent_rows) {
            let (batch, mut latent) = (moments(&rows), self.network.latent_constants());
            for (old, new) in latent.mean.iter_mut().zip(&batch.mean) {
                *old += momentum * (new - *old);
            }
            for (old, new) in latent.sigma.iter_mut().zip(&batch.sigma) {
                let (a, b) = (*old * *old, new * new);
                *old = (a + momentum * (b - a)).sqrt().max(start::LEAST_LATENT_SIGMA);
            }
            self.network.set_latent_constants(latent);
        }
        Ok(value)
    }

    /// Step size of each array at this step.
    fn rates(&self) -> Vec<f32> {
        let steps = self.data.train.maps.len().div_ceil(self.spec.batch_size) * self.spec.epochs;
        let progress = self.step as f64 / steps as f64;
        let warm_up = ((self.step - self.head_step) as f64 / self.spec.warm_up_steps.max(1) as f64).min(1.0);
        let cosine = 0.5 * (1.0 + (std::f64::consts::PI * progress.min(1.0)).cos());
        let rate = self.spec.learning_rate * warm_up * (0.05 + 0.95 * cosine);
        let rate_of = |parameter: &crate::network::Parameter| {
            if !head_start::is_trained(&self.network, parameter) {
                return 0.0;
            }
            let factor = match names::layer_of(&parameter.name) {
                names::CIRCUIT => self.spec.angle_rate,
                names::HEAD | names::HEAD_HIDDEN | names::WARM_UP => self.spec.head_rate,
                // No layer before it is trained, so it learns at the head's rate.
                names::LATENT_DENSE if self.spec.network.reads_descriptors() => self.spec.head_rate,
                _ => 1.0,
            };
            (rate * factor) as f32
        };
        self.network.trained().iter().map(rate_of).collect()
    }

    /// Weight decay of each array in a step, as a share of its values.
    fn decays(&self, rates: &[f32]) -> Vec<f32> {
        let decay_of = |(parameter, rate): (&crate::network::Parameter, &f32)| {
            if full_batch::is_weight(parameter) { rate * self.spec.weight_decay as f32 } else { 0.0 }
        };
        self.network.trained().iter().zip(rates).map(decay_of).collect()
    }

    fn validate(&self) -> Result<(f64, Metrics), TrainError> {
        let part = &self.data.validation;
        let output = self.output()?;
        let (mut loss, mut weight, mut pairs) = (0.0, 0.0, Vec::new());
        let positions: Vec<usize> = (0..part.maps.len()).collect();
        for batch in positions.chunks(start::EVALUATION_BATCH) {
            let labels: Vec<usize> = batch.iter().filter_map(|&p| part.labels.get(p)).copied().collect();
            let input = self.data.batch(part, batch)?;
            let logits = self.network.run(&input, output, Mode::Evaluation)?.take(output)?;
            let batch_loss = f64::from(cross_entropy(&logits, &labels, &self.data.class_weights)?.to_scalar::<f32>()?);
            if !batch_loss.is_finite() {
                return Err(self.non_finite("loss of the validation split".to_owned()));
            }
            let batch_weight: f64 =
                labels.iter().filter_map(|&l| self.data.class_weights.get(l)).map(|&w| f64::from(w)).sum();
            loss += batch_loss * batch_weight;
            weight += batch_weight;
            add_predictions(&logits, &labels, &mut pairs)?;
        }
        Ok((if weight > 0.0 { loss / weight } else { 0.0 }, Metrics::from_predictions(pairs)))
    }

    /// Measures mean and sigma of the latent over the training split.
    fn measure_latent(&mut self) -> Result<(), TrainError> {
        let Some(raw) = self.network.raw_latent()? else { return Ok(()) };
        let positions: Vec<usize> = (0..self.data.train.maps.len()).collect();
        let latent = rows_of(&self.network, self.data, &self.data.train, &positions, raw)?;
        self.network.set_latent_constants(moments(&latent));
        Ok(())
    }

    fn non_finite(&self, what: String) -> TrainError {
        TrainError::NonFinite {
            what,
            start: self.start,
            epoch: self.epoch,
            step: self.step,
            learning_rate: self.spec.learning_rate,
        }
    }
}

/// Mean time of `count` calls, s, after one call that is not counted.
fn mean_s(count: usize, mut call: impl FnMut() -> Result<(), TrainError>) -> Result<f64, TrainError> {
    call()?;
    let started = Instant::now();
    for _ in 0..count {
        call()?;
    }
    Ok(started.elapsed().as_secs_f64() / count.max(1) as f64)
}

/// Appends (truth, prediction) of each row of logits.
fn add_predictions(
    logits: &Tensor,
    labels: &[usize],
    pairs: &mut Vec<(Occupancy, Occupancy)>,
) -> Result<(), TrainError> {
    for (row, &label) in logits.to_vec2::<f32>()?.iter().zip(labels) {
        if let (&[a, b, c], Some(truth)) = (row.as_slice(), Occupancy::from_index(label)) {
            pairs.push((truth, most_probable(&[a, b, c])));
        }
    }
    Ok(())
}

#[cfg(test)]
mod hard_cases {
    use super::super::data::tests::dataset_of;
    use super::*;
    use crate::network::NetworkKind;
    use crate::standardise::MapReference;
    use crate::train::Maps;

    /// Regression test: the error was that of a tensor, so a study stopped each time instead of beginning the training again.
    #[test]
    fn a_checkpoint_of_fewer_descriptors_is_unusable() {
        let mut cell = 0u32;
        let dataset = dataset_of(16, 36, 24, || {
            cell += 1;
            -80.0 - (cell * 7 % 31) as f32
        });
        let reference = MapReference::OverNoise { skip_range_bins: 2, most_db: None };
        let spec = TrainSpec { network: NetworkKind::DescriptorLinear, reference, ..TrainSpec::default() };
        let data = Data::load(&Maps::new(&dataset, reference), &spec).expect("data");
        let level = KernelLevel::detect();
        let network = Network::initialise(&spec.network_spec(), spec.seed, 0, level).expect("a network");
        let mut state = Run::new(&data, &spec, 0, network).state().expect("a state");
        // One descriptor fewer for each of the three classes.
        let weights = state.values.get_mut("head.weight").expect("a parameter");
        weights.truncate(weights.len() - 3);
        let error = Run::resume(&data, &spec, state, level).err().expect("refused");
        assert!(matches!(&error, TrainError::Checkpoint { what } if what.contains("head.weight")), "{error}");
    }
}
