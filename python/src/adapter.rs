//! Adaptation of a model to a room.

use std::path::PathBuf;
use std::sync::Mutex;

use pyo3::prelude::*;
use radome_models::Classifier;
use radome_models::train::{self, AdaptFrame, AdaptRecording, Adaptation};
use serde_json::json;

use crate::dataset::Dataset;
use crate::error::{Outcome, detached, lock, to_python};
use crate::fork;
use crate::frame::occupancy;
use crate::map::Map;
use crate::model::Model;

/// Model to adapt, and the recordings so far.
struct Work {
    adapter: train::Adapter,
    recordings: Vec<AdaptRecording>,
}

/// Adaptation of a model by labelled maps of recordings.
#[pyclass(frozen, module = "radome._radome")]
pub struct Adapter {
    work: Mutex<Option<Work>>,
}

impl Adapter {
    fn with<T: Send>(&self, py: Python<'_>, work: impl FnOnce(&mut Work) -> Outcome<T> + Send) -> PyResult<T> {
        detached(py, || {
            fork::check_pools("adapting")?;
            match lock(&self.work).as_mut() {
                Some(state) => work(state),
                None => Err("the model has been adapted\n\nhint: begin anew".into()),
            }
        })
    }
}

#[pymethods]
impl Adapter {
    #[new]
    fn new(py: Python<'_>, model: PathBuf) -> PyResult<Self> {
        let adapter = detached(py, || {
            fork::check_pools("adapting")?;
            Ok(train::Adapter::new(radome_models::Model::load(&model)?)?)
        })?;
        Ok(Adapter { work: Mutex::new(Some(Work { adapter, recordings: Vec::new() })) })
    }

    /// Mixes in the maps of a dataset's training split; returns their number.
    fn mix(&self, py: Python<'_>, dataset: &Bound<'_, Dataset>) -> PyResult<usize> {
        let dataset = &dataset.get().inner;
        self.with(py, |work| Ok(work.adapter.mix(dataset)?))
    }

    /// Begins a recording.
    fn begin(&self, py: Python<'_>, frame_interval_s: f64) -> PyResult<()> {
        self.with(py, |work| {
            work.recordings.push(AdaptRecording { frame_interval_s, frames: Vec::new() });
            Ok(())
        })
    }

    /// Adds the map of a frame to the recording, with its label or `None`.
    #[pyo3(signature = (map, time_s, label))]
    fn add(&self, py: Python<'_>, map: &Bound<'_, Map>, time_s: f64, label: Option<&str>) -> PyResult<()> {
        let label = label.map(|name| occupancy(py, name)).transpose()?;
        let map = &map.get().inner;
        self.with(py, |work| {
            let features = work.adapter.features(map)?;
            let recording = work.recordings.last_mut().ok_or("no recording has begun")?;
            recording.frames.push(AdaptFrame { time_s, features, label });
            Ok(())
        })
    }

    /// Adapts; returns the model and a dict with what it is adapted to and its scores.
    fn adapt<'py>(&self, py: Python<'py>) -> PyResult<(Model, Bound<'py, PyAny>)> {
        let adaptation = detached(py, || {
            fork::check_pools("adapting")?;
            let state = lock(&self.work).take();
            let Work { adapter, recordings } = state.ok_or("the model has been adapted\n\nhint: begin anew")?;
            Ok(adapter.adapt(&recordings)?)
        })?;
        let Adaptation { model, adapted, held_out, recordings_by_class, is_measured, .. } = adaptation;
        let scores = json!({
            "adapted": adapted,
            "is_worse": adapted.held_out.is_some_and(|scores| scores.is_worse()),
            "held_out": held_out,
            "recordings_by_class": recordings_by_class,
            "is_measured": is_measured,
        });
        Ok((Model::of(Classifier::new(model)), to_python(py, &scores)?))
    }
}
