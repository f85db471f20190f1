//! The training of a network, from a dataset to a model.

use std::path::Path;

use radome_dsp::Occupancy;

use super::error::TrainError;
use super::maps::Maps;
use super::memory::check_memory;
use super::outcome::{EpochReport, StepTimes, TrainOutcome};
use super::spec::TrainSpec;
use super::{checkpoint, data, run, temperature};
use crate::dataset::{Dataset, sequence_hash};
use crate::evaluate::evaluate;
use crate::kernel::KernelLevel;
use crate::metrics::Metrics;
use crate::model::{Classifier, MODEL_FORMAT_VERSION, Model, ModelCard, TrainingSummary, input_axes, input_shape};
use crate::network::{Network, TorchvisionWeights};
use crate::standardise::Standardisation;

/// Trains a network. `report` is called after each epoch.
///
/// The same dataset, spec and kernel level give the same model, bit for bit, on any number of threads.
///
/// # Errors
/// [`TrainError`] if a setting is out of range, the dataset cannot be read, split or standardised or does not fit the network,
/// weights to start from do not fit, or a number becomes NaN or infinite.
pub fn train(
    dataset: &Dataset,
    spec: &TrainSpec,
    report: &mut dyn FnMut(EpochReport),
) -> Result<TrainOutcome, TrainError> {
    train_with_checkpoint(dataset, spec, None, report)
}

/// [`train`] that writes `checkpoint` after each epoch and continues from it if it exists. A training that was killed and continued
/// gives the same model as one that was not. The file remains at the end, and another call gives the model again. Remove it when the
/// model is saved, and keep its [`CheckpointLock`](super::CheckpointLock) until then.
///
/// # Errors
/// Those of [`train`], [`TrainError::Checkpoint`] if the checkpoint cannot be read, [`TrainError::OtherTraining`] if it is of another
/// training, and [`TrainError::CheckpointWrite`] if it cannot be written.
pub fn train_with_checkpoint(
    dataset: &Dataset,
    spec: &TrainSpec,
    checkpoint: Option<&Path>,
    report: &mut dyn FnMut(EpochReport),
) -> Result<TrainOutcome, TrainError> {
    train_on(&Maps::new(dataset, spec.reference), spec, checkpoint, report)
}

/// Trains as [`train_with_checkpoint`] does, on maps that other trainings may share. `maps` must have the reference of
/// `spec`.
pub(crate) fn train_on(
    maps: &Maps,
    spec: &TrainSpec,
    checkpoint: Option<&Path>,
    report: &mut dyn FnMut(EpochReport),
) -> Result<TrainOutcome, TrainError> {
    let dataset = maps.dataset();
    spec.check()?;
    spec.check_network()?;
    let Prepared { weights, data, level } = Prepared::new(maps, spec)?;
    let (run, history) =
        Training { data: &data, spec, weights: weights.as_ref(), level, checkpoint, dataset_hash: dataset.hash() }
            .run(report)?;

    let chosen_start = run.start_index();
    let (network, best_epoch) = run.finish()?;
    let temperature = temperature::fit(&network, &data)?;
    let training = TrainingSummary {
        epochs: spec.epochs,
        best_epoch,
        training_maps: data.train.labels.len(),
        seen_sequences: [&data.train, &data.validation]
            .into_iter()
            .flat_map(|part| part.indices.iter().filter_map(|&index| dataset.rows().get(index)))
            .map(|row| sequence_hash(&row.sequence))
            .collect(),
        weights_hash: weights.as_ref().map(|weights| weights.hash().to_owned()),
        chosen_start,
        kernel_level: level,
        validation: Metrics::from_predictions([]),
        test: None,
    };
    let card = card(dataset, spec, &data.standardisation, &network, temperature, training);
    let mut warnings = data.warnings.clone();
    warnings.extend(weights.iter().flat_map(TorchvisionWeights::warnings));
    // Scores are computed by the same code as in live use.
    let mut classifier = Classifier::new(Model { card, network });
    let validation = evaluate(&mut classifier, dataset, &data.validation.indices)?;
    let test = match data.test.as_slice() {
        [] => None,
        indices => Some(evaluate(&mut classifier, dataset, indices)?),
    };
    let Some(mut model) = classifier.into_model() else {
        return Err(candle_core::Error::Msg("a trained network is no ONNX file".to_owned()).into());
    };
    model.card.training.validation = validation.clone();
    model.card.training.test = test.clone();
    Ok(TrainOutcome { model, history, validation, test, warnings })
}

/// The card of a trained network.
fn card(
    dataset: &Dataset,
    spec: &TrainSpec,
    standardisation: &Standardisation,
    network: &Network,
    temperature: f64,
    training: TrainingSummary,
) -> ModelCard {
    let header = dataset.header();
    ModelCard {
        format_version: MODEL_FORMAT_VERSION,
        network: spec.network,
        head: spec.head.clone(),
        classes: Occupancy::ALL.to_vec(),
        input_shape: input_shape(header.shape.range, header.shape.doppler, spec.transposed),
        axes: input_axes(spec.transposed),
        waveform: header.waveform.clone(),
        rdm_spec: header.rdm_spec,
        standardisation: standardisation.clone(),
        memory_s: spec.memory_s,
        smoothing: spec.smoothing,
        pooled: spec.pooled,
        latent: network.latent_constants(),
        temperature,
        dataset_hash: dataset.hash(),
        split: spec.split.counts(dataset.rows()).then(|| spec.split.clone()),
        seed: spec.seed,
        training,
        adapted: None,
    }
}

/// A training's data, weights to start from and instruction set.
struct Prepared {
    weights: Option<TorchvisionWeights>,
    data: data::Data,
    level: KernelLevel,
}

impl Prepared {
    /// Checks memory, and reads data and weights.
    fn new(maps: &Maps, spec: &TrainSpec) -> Result<Self, TrainError> {
        check_memory(maps.dataset(), spec)?;
        let load = |path| TorchvisionWeights::load(path, &spec.network_spec());
        let weights = spec.weights.as_deref().map(load).transpose()?;
        let data = data::Data::load(maps, spec)?;
        Ok(Prepared { weights, data, level: spec.kernel_level.unwrap_or_else(KernelLevel::detect).available() })
    }
}

/// Largest learning rate at which steps are timed. The time of a step does not depend on it, but a large one may diverge.
const TIMED_RATE: f64 = 1e-4;

/// Measures how long the parts of a training take, by a few steps of it.
///
/// # Errors
/// Those of [`train`].
pub(crate) fn time_steps(maps: &Maps, spec: &TrainSpec) -> Result<StepTimes, TrainError> {
    spec.check()?;
    let spec = &TrainSpec { learning_rate: spec.learning_rate.min(TIMED_RATE), ..spec.clone() };
    let Prepared { weights, data, level } = Prepared::new(maps, spec)?;
    run::Run::start(&data, spec, weights.as_ref(), 0, level)?.time_steps()
}

/// Training of all starts, in their order.
struct Training<'a> {
    data: &'a data::Data,
    spec: &'a TrainSpec,
    weights: Option<&'a TorchvisionWeights>,
    level: KernelLevel,
    checkpoint: Option<&'a Path>,
    dataset_hash: String,
}

impl<'a> Training<'a> {
    fn run(&self, report: &mut dyn FnMut(EpochReport)) -> Result<(run::Run<'a>, Vec<EpochReport>), TrainError> {
        let Training { data, spec, weights, level, .. } = *self;
        let trials = spec.trial_epochs();
        let resume = |state| run::Run::resume(data, spec, state, level);
        let (mut leader, mut trial, mut history, mut next_start) = match self.load()? {
            None => (None, None, Vec::new(), 0),
            Some(checkpoint) => (
                checkpoint.leader.map(resume).transpose()?,
                checkpoint.trial.map(resume).transpose()?,
                checkpoint.history,
                checkpoint.next_start,
            ),
        };
        while trial.is_some() || next_start < spec.starts {
            let mut run = match trial.take() {
                Some(run) => run,
                None => {
                    next_start += 1;
                    run::Run::start(data, spec, weights, next_start - 1, level)?
                }
            };
            while run.epochs_done() < trials {
                let epoch = run.epoch(false)?;
                history.push(epoch.clone());
                report(epoch);
                self.save(leader.as_ref(), Some(&run), &history, next_start)?;
            }
            if leader.as_ref().is_none_or(|leader: &run::Run| run.validation_loss() < leader.validation_loss()) {
                leader = Some(run);
            }
        }
        let Some(mut run) = leader else {
            return Err(TrainError::Setting { name: "starts", value: "0".into(), expected: "at least 1" });
        };
        while run.epochs_done() < spec.epochs {
            let epoch = run.epoch(true)?;
            history.push(epoch.clone());
            report(epoch);
            self.save(Some(&run), None, &history, next_start)?;
        }
        Ok((run, history))
    }

    /// Text of everything that decides the outcome.
    fn fingerprint(&self) -> Result<String, TrainError> {
        let spec = TrainSpec { weights: None, ..self.spec.clone() };
        let spec = serde_json::to_string(&spec).map_err(|e| TrainError::Checkpoint { what: e.to_string() })?;
        let weights = self.weights.map(|weights| format!(" {}", weights.hash())).unwrap_or_default();
        Ok(format!("{spec} {:?} {}{weights}", self.level, self.dataset_hash))
    }

    fn load(&self) -> Result<Option<checkpoint::Checkpoint>, TrainError> {
        let Some(path) = self.checkpoint else { return Ok(None) };
        let Some(checkpoint) = checkpoint::Checkpoint::load(path)? else { return Ok(None) };
        if checkpoint.fingerprint != self.fingerprint()? {
            return Err(TrainError::OtherTraining { path: path.to_owned() });
        }
        Ok(Some(checkpoint))
    }

    fn save(
        &self,
        leader: Option<&run::Run>,
        trial: Option<&run::Run>,
        history: &[EpochReport],
        next_start: u64,
    ) -> Result<(), TrainError> {
        let Some(path) = self.checkpoint else { return Ok(()) };
        let state = |run: Option<&run::Run>| run.map(run::Run::state).transpose();
        let history = history.to_vec();
        checkpoint::Checkpoint {
            fingerprint: self.fingerprint()?,
            leader: state(leader)?,
            trial: state(trial)?,
            history,
            next_start,
        }
        .save(path)
    }
}
