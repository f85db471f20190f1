//! Training.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::path::{Path, PathBuf};

use pyo3::prelude::*;
use radome_files::{named_by_spec, parse_toml};
use radome_models::{
    CheckpointLock, Classifier, EpochReport, NetworkSpec, TrainOutcome, TrainSpec, train_with_checkpoint,
};
use serde_json::json;

use crate::dataset::Dataset;
use crate::error::{Failure, Outcome, detached, from_python, read_text_file, text_to_exception, to_python};
use crate::fork;
use crate::model::Model;

/// Panic payload that carries the Python exception out of a training.
struct Stopped(PyErr);

/// Reads the settings of a training from a TOML file.
fn read_spec(path: &Path) -> Outcome<TrainSpec> {
    let text = read_text_file(path)?;
    let invalid = |error: toml::de::Error| format!("{} is no training spec: {}", path.display(), error.message());
    let mut spec: TrainSpec = parse_toml(&text).map_err(invalid)?;
    if let Some(weights) = &spec.weights {
        spec.weights = Some(named_by_spec(path.parent().unwrap_or(Path::new("")), weights)?);
    }
    Ok(spec)
}

/// Settings from the path of a TOML file, or from a dict of keys that differ from the defaults.
fn spec(py: Python<'_>, given: &Bound<'_, PyAny>, network: Option<&str>) -> PyResult<TrainSpec> {
    let mut spec: TrainSpec = match given.extract::<PathBuf>() {
        Ok(path) => detached(py, || read_spec(&path))?,
        Err(_) => from_python("training", given)?,
    };
    if let Some(name) = network {
        let Some(network) = NetworkSpec::named(name) else {
            return Err(text_to_exception(
                py,
                format!("there is no network '{name}'\n\nhint: radome.networks() lists them"),
            ));
        };
        spec.set_network(network).map_err(|error| text_to_exception(py, error.to_string()))?;
    }
    Ok(spec)
}

/// Reports an epoch to Python, and checks for Ctrl-C.
fn report_epoch(py: Python<'_>, epoch: &EpochReport, report: Option<&Py<PyAny>>) -> PyResult<()> {
    if let Some(report) = report {
        report.call1(py, (to_python(py, epoch)?,))?;
    }
    py.check_signals()
}

/// Trains a network; returns the model and a dict with history and scores. `report` is called with a dict after each epoch.
/// Ctrl-C and an exception of `report` end the training behind the epoch; with a checkpoint the next call goes on there.
#[pyfunction]
#[pyo3(signature = (dataset, settings, network=None, checkpoint=None, report=None))]
pub fn train<'py>(
    py: Python<'py>,
    dataset: &Bound<'py, Dataset>,
    settings: &Bound<'py, PyAny>,
    network: Option<&str>,
    checkpoint: Option<PathBuf>,
    report: Option<Py<PyAny>>,
) -> PyResult<(Model, Bound<'py, PyAny>)> {
    let spec = spec(py, settings, network)?;
    let dataset = &dataset.get().inner;
    let outcome = detached(py, || {
        fork::check_pools("training")?;
        let _lock = checkpoint.as_deref().map(CheckpointLock::new).transpose()?;
        let run = || {
            train_with_checkpoint(dataset, &spec, checkpoint.as_deref(), &mut |epoch| {
                let result = Python::attach(|py| report_epoch(py, &epoch, report.as_ref()));
                if let Err(exception) = result {
                    // A panic is the only way to end a training between epochs.
                    resume_unwind(Box::new(Stopped(exception)));
                }
            })
        };
        match catch_unwind(AssertUnwindSafe(run)) {
            Ok(outcome) => {
                let outcome = outcome?;
                if let Some(file) = &checkpoint {
                    // A file that cannot be removed does no harm: a new training repeats the last step.
                    let _ = std::fs::remove_file(file);
                }
                Ok(outcome)
            }
            Err(payload) => Err(stop_exception(payload)),
        }
    })?;
    let TrainOutcome { model, history, validation, test, warnings } = outcome;
    let scores = json!({ "history": history, "validation": validation, "test": test, "warnings": warnings });
    Ok((Model::of(Classifier::new(model)), to_python(py, &scores)?))
}

/// Exception that stopped a training; resumes any other panic.
fn stop_exception(payload: Box<dyn Any + Send>) -> Failure {
    match payload.downcast::<Stopped>() {
        Ok(stopped) => stopped.0.into(),
        Err(payload) => resume_unwind(payload),
    }
}

/// Networks that can be trained, a list of dicts.
#[pyfunction]
pub fn networks(py: Python<'_>) -> PyResult<Bound<'_, PyAny>> {
    to_python(py, &radome_models::networks())
}
