//! One initialisation on its way through the epochs.

use std::time::Instant;

use candle_core::Tensor;
use radome_dsp::Occupancy;
use rand::seq::SliceRandom;

use super::adam::Adam;
use super::circuit_start;
use super::data::Data;
use super::start::{self, collect, feature_scale, moments, place_hidden, place_latent};
use super::{EpochReport, LatentStandardisation, TrainError, TrainSpec};
use crate::evaluate::Metrics;
use crate::layer::{KernelLevel, cross_entropy};
use crate::network::{Bypass, Hqnn, LatentConstants};
use crate::stream;

pub(super) struct Run<'a> {
    data: &'a Data,
    spec: &'a TrainSpec,
    start: u64,
    network: Hqnn,
    adam: Adam,
    epoch: usize,
    step: usize,
    /// Step at which the circuit came in: the step size warms up again from there.
    circuit_step: usize,
    latest_loss: f64,
    best: Option<Best>,
}

struct Best {
    balanced_accuracy: f64,
    loss: f64,
    epoch: usize,
    values: Vec<Vec<f32>>,
    latent: LatentConstants,
}

impl<'a> Run<'a> {
    /// Initialises a network and puts its features and its latent where they belong.
    pub(super) fn start(
        data: &'a Data,
        spec: &'a TrainSpec,
        start: u64,
        level: KernelLevel,
    ) -> Result<Self, TrainError> {
        let mut network = Hqnn::initialise(spec.seed, start, spec.pooled, level)?;
        let mut positions: Vec<usize> = (0..data.train.maps.len()).collect();
        positions.shuffle(&mut stream(spec.seed, "start maps", start));
        positions.truncate(start::START_MAPS);
        let features = collect(&network, data, &data.train, &positions, |s| &s.features)?;
        network.set_feature_scale(Some(feature_scale(&features, spec.feature_sigma)));
        let hidden = collect(&network, data, &data.train, &positions, |s| &s.hidden)?;
        place_hidden(&network, &hidden)?;
        let latent = collect(&network, data, &data.train, &positions, |s| &s.latent)?;
        place_latent(&network, &latent, spec.latent_sigma)?;
        let adam = Adam::new(network.variables());
        let mut run = Run {
            data,
            spec,
            start,
            network,
            adam,
            epoch: 0,
            step: 0,
            circuit_step: 0,
            latest_loss: f64::INFINITY,
            best: None,
        };
        if spec.latent != LatentStandardisation::None {
            run.measure_latent()?;
        }
        if spec.linear_epochs() > 0 {
            run.network.bypass = Bypass::Circuit;
        } else {
            run.start_circuit()?;
        }
        Ok(run)
    }

    /// Puts the circuit between latent and head: angles, head and placement of the latent from [`circuit_start`].
    fn start_circuit(&mut self) -> Result<(), TrainError> {
        let mut positions: Vec<usize> = (0..self.data.train.maps.len()).collect();
        positions.shuffle(&mut stream(self.spec.seed, "circuit maps", self.start));
        positions.truncate(start::START_MAPS);
        let move_latent = self.spec.latent == LatentStandardisation::None;
        let rows = collect(&self.network, self.data, &self.data.train, &positions, |s| &s.standardised)?;
        let found = if move_latent { moments(&rows) } else { LatentConstants::default() };
        let centred = |k: usize, row: &[f32]| {
            row.get(k).map_or(0.0, |&v| f64::from(v - found.mean[k]) / f64::from(found.sigma[k]))
        };
        let latents: Vec<[f64; 2]> = rows.iter().map(|r| [centred(0, r), centred(1, r)]).collect();
        let labels: Vec<usize> = positions.iter().filter_map(|&p| self.data.train.labels.get(p)).copied().collect();
        let points = circuit_start::Points {
            latents: &latents,
            labels: &labels,
            class_weights: &self.data.class_weights,
            penalty: self.spec.latent_penalty,
            move_latent,
            sigma: f64::from(self.spec.latent_sigma),
        };
        let best = circuit_start::search(&points, self.spec.seed, self.start);
        let mut values = self.network.values()?;
        if let [_, _, _, _, _, _, weight, bias, theta, head_weight, head_bias] = values.as_mut_slice() {
            *theta = best.theta.map(|v| v as f32).to_vec();
            *head_weight = best.head_weight.map(|v| v as f32).to_vec();
            *head_bias = best.head_bias.map(|v| v as f32).to_vec();
            if move_latent && let [old_a, old_b] = bias.as_mut_slice() {
                // u = matrix (z - mean) / sigma + offset with z = weight h + bias, folded into weight and bias.
                let m: [f32; 4] = std::array::from_fn(|k| best.matrix[k] as f32 / found.sigma[k % 2]);
                let half = weight.len() / 2;
                let (row_a, row_b) = weight.split_at_mut(half);
                for (a, b) in row_a.iter_mut().zip(row_b) {
                    (*a, *b) = (m[0] * *a + m[1] * *b, m[2] * *a + m[3] * *b);
                }
                let (a, b) = (*old_a - found.mean[0], *old_b - found.mean[1]);
                *old_a = m[0] * a + m[1] * b + best.offset[0] as f32;
                *old_b = m[2] * a + m[3] * b + best.offset[1] as f32;
            }
        }
        self.network.set_values(&values)?;
        self.network.bypass = Bypass::No;
        self.adam = Adam::new(self.network.variables());
        self.circuit_step = self.step;
        self.best = None;
        Ok(())
    }

    pub(super) fn start_index(&self) -> u64 {
        self.start
    }

    /// Loss on the validation split after the latest epoch.
    pub(super) fn validation_loss(&self) -> f64 {
        self.latest_loss
    }

    /// Trains for one epoch.
    pub(super) fn epoch(&mut self, chosen: bool) -> Result<EpochReport, TrainError> {
        let began = Instant::now();
        if self.spec.latent == LatentStandardisation::FrozenByEpoch {
            self.measure_latent()?;
        }
        if self.network.bypass == Bypass::Circuit && self.epoch >= self.spec.linear_epochs() {
            self.start_circuit()?;
        }
        self.epoch += 1;
        let mut order: Vec<usize> = (0..self.data.train.maps.len()).collect();
        order.shuffle(&mut stream(self.spec.seed, "order", self.epoch as u64));
        let (mut loss, mut pairs) = (0.0, Vec::with_capacity(order.len()));
        for batch in order.chunks(self.spec.batch_size) {
            loss += self.train_batch(batch, &mut pairs)? * batch.len() as f64;
        }
        let training = Metrics::from_predictions(pairs);
        let (validation_loss, validation) = self.validate()?;
        self.latest_loss = validation_loss;
        let better = self.best.as_ref().is_none_or(|b| {
            let score = validation.balanced_accuracy;
            score > b.balanced_accuracy || (score == b.balanced_accuracy && validation_loss < b.loss)
        });
        if better {
            self.best = Some(Best {
                balanced_accuracy: validation.balanced_accuracy,
                loss: validation_loss,
                epoch: self.epoch,
                values: self.network.values()?,
                latent: self.network.latent,
            });
        }
        Ok(EpochReport {
            start: self.start,
            chosen,
            epoch: self.epoch,
            epochs: self.spec.epochs,
            training_loss: loss / order.len() as f64,
            training_balanced_accuracy: training.balanced_accuracy,
            validation_loss,
            validation_balanced_accuracy: validation.balanced_accuracy,
            seconds: began.elapsed().as_secs_f64(),
        })
    }

    /// The network (with its circuit) as it was after its best epoch, and that epoch.
    pub(super) fn finish(mut self) -> Result<(Hqnn, usize), TrainError> {
        if self.network.bypass == Bypass::Circuit {
            self.start_circuit()?;
        }
        let mut epoch = self.epoch;
        if let Some(best) = self.best.take() {
            self.network.set_values(&best.values)?;
            self.network.latent = best.latent;
            epoch = best.epoch;
        }
        self.network.fold()?;
        Ok((self.network, epoch))
    }

    /// One step; gives the loss and appends (truth, prediction).
    fn train_batch(&mut self, batch: &[usize], pairs: &mut Vec<(Occupancy, Occupancy)>) -> Result<f64, TrainError> {
        self.step += 1;
        let labels: Vec<usize> = batch.iter().filter_map(|&p| self.data.train.labels.get(p)).copied().collect();
        let input = self.data.augmented(batch, self.spec.augmentation, self.spec.seed, self.epoch)?;
        let stages = self.network.stages(&input)?;
        let loss = cross_entropy(&stages.logits, &labels, &self.data.class_weights)?;
        let value = f64::from(loss.to_scalar::<f32>()?);
        if !value.is_finite() {
            let what = stages.first_non_finite()?.unwrap_or("loss");
            return Err(self.non_finite(format!("output of {what}")));
        }
        predictions(&stages.logits, &labels, pairs)?;
        let loss = match self.network.bypass {
            Bypass::No => (loss + (stages.standardised.sqr()?.mean_all()? * self.spec.latent_penalty)?)?,
            Bypass::Circuit => loss,
        };
        let rates = self.rates();
        if let Some(bad) = self.adam.step(self.network.variables(), &loss.backward()?, &rates)? {
            let name = Hqnn::layout(self.spec.pooled).get(bad).map_or("a parameter", |(name, _)| *name);
            return Err(self.non_finite(format!("gradient of {name}")));
        }
        if let LatentStandardisation::Running { momentum } = self.spec.latent {
            let rows: Vec<Vec<f32>> = stages.latent.to_vec2()?;
            let batch = moments(&rows);
            let old = self.network.latent;
            self.network.latent = LatentConstants {
                mean: std::array::from_fn(|k| old.mean[k] + momentum * (batch.mean[k] - old.mean[k])),
                sigma: std::array::from_fn(|k| {
                    let (a, b) = (old.sigma[k] * old.sigma[k], batch.sigma[k] * batch.sigma[k]);
                    (a + momentum * (b - a)).sqrt().max(start::LEAST_LATENT_SIGMA)
                }),
            };
        }
        Ok(value)
    }

    /// Step size of each parameter at this step.
    fn rates(&self) -> Vec<f32> {
        let steps = self.data.train.maps.len().div_ceil(self.spec.batch_size) * self.spec.epochs;
        let progress = self.step as f64 / steps as f64;
        let warm_up = ((self.step - self.circuit_step) as f64 / self.spec.warm_up_steps.max(1) as f64).min(1.0);
        let cosine = 0.5 * (1.0 + (std::f64::consts::PI * progress.min(1.0)).cos());
        let rate = self.spec.learning_rate * warm_up * (0.05 + 0.95 * cosine);
        Hqnn::layout(self.spec.pooled)
            .iter()
            .map(|(name, _)| match *name {
                "circuit.theta" => (rate * self.spec.angle_rate) as f32,
                "head.weight" | "head.bias" => (rate * self.spec.head_rate) as f32,
                _ => rate as f32,
            })
            .collect()
    }

    fn validate(&self) -> Result<(f64, Metrics), TrainError> {
        let part = &self.data.validation;
        let (mut loss, mut weight, mut pairs) = (0.0, 0.0, Vec::new());
        let positions: Vec<usize> = (0..part.maps.len()).collect();
        for batch in positions.chunks(start::EVALUATION_BATCH) {
            let labels: Vec<usize> = batch.iter().filter_map(|&p| part.labels.get(p)).copied().collect();
            let stages = self.network.stages(&self.data.batch(part, batch)?)?;
            let batch_loss =
                f64::from(cross_entropy(&stages.logits, &labels, &self.data.class_weights)?.to_scalar::<f32>()?);
            if !batch_loss.is_finite() {
                let what = stages.first_non_finite()?.unwrap_or("loss");
                return Err(self.non_finite(format!("output of {what} (validation)")));
            }
            let batch_weight: f64 =
                labels.iter().filter_map(|&l| self.data.class_weights.get(l)).map(|&w| f64::from(w)).sum();
            loss += batch_loss * batch_weight;
            weight += batch_weight;
            predictions(&stages.logits, &labels, &mut pairs)?;
        }
        Ok((if weight > 0.0 { loss / weight } else { 0.0 }, Metrics::from_predictions(pairs)))
    }

    /// Takes mean and sigma of the latent over the training split.
    fn measure_latent(&mut self) -> Result<(), TrainError> {
        let positions: Vec<usize> = (0..self.data.train.maps.len()).collect();
        let latent = collect(&self.network, self.data, &self.data.train, &positions, |s| &s.latent)?;
        self.network.latent = moments(&latent);
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

fn predictions(logits: &Tensor, labels: &[usize], pairs: &mut Vec<(Occupancy, Occupancy)>) -> Result<(), TrainError> {
    for (row, &label) in logits.to_vec2::<f32>()?.iter().zip(labels) {
        if let (&[a, b, c], Some(truth)) = (row.as_slice(), Occupancy::from_index(label)) {
            pairs.push((truth, crate::evaluate::most_probable(&[a, b, c])));
        }
    }
    Ok(())
}
