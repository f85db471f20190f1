//! Models, and the filter for their predictions.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard};

use numpy::{IntoPyArray, PyArray1};
use pyo3::prelude::*;
use radome_driver::RecordingError;
use radome_driver::recording::{Existing, Partial};
use radome_dsp::RdmProcessor;
use radome_models::evaluate::evaluate;
use radome_models::evidence_mean::EvidenceMean;
use radome_models::model::BUILT_IN;
use radome_models::occupancy_filter::OccupancyFilter;
use radome_models::{Classifier, ModelCard, onnx};

use crate::dataset::Dataset;
use crate::error::{Outcome, detached, lock, to_exception, to_python};
use crate::fork::CreatorProcess;
use crate::frame::Frame;
use crate::map::{Map, next_map};
use crate::waveform::Waveform;

/// Probabilities of the classes empty, one and two.
type Probabilities = [f32; 3];

/// State that one thread at a time may use.
struct Work {
    classifier: Classifier,
    /// Processor for the waveform of the last frame.
    maps: Option<(Arc<radome_dsp::Waveform>, RdmProcessor)>,
    /// Mean of the evidence of past frames.
    mean: EvidenceMean,
}

/// Trained model: a file, or `"room-hqnn"` for the built-in one.
///
/// Called with a `Frame` or a `Map` it returns the probabilities of empty, one and two (`radome.CLASSES`), `[class]`, float32. Give
/// it the frames of one source in their order. Call `gap` where frames are missing, and `reset` before another source. It returns `None` while a window over frames fills, and
/// for a frame in which no receiver that the model needs gives a signal. A map must be made by the model's `rdm_spec`.
#[pyclass(frozen, module = "radome._radome")]
pub struct Model {
    work: Mutex<Work>,
    card: ModelCard,
    creator: CreatorProcess,
}

impl Model {
    /// Wraps a classifier.
    pub fn of(classifier: Classifier) -> Self {
        let card = classifier.card().clone();
        let mean = EvidenceMean::new(card.memory_s);
        Model { work: Mutex::new(Work { classifier, maps: None, mean }), card, creator: CreatorProcess::current() }
    }

    fn lock(&self) -> Outcome<MutexGuard<'_, Work>> {
        self.creator.check("the model")?;
        Ok(lock(&self.work))
    }

    fn classify(&self, map: &Map) -> Outcome<Probabilities> {
        self.card.check_maps(&map.spec, &map.waveform)?;
        Ok(self.lock()?.classifier.classify(&map.inner)?)
    }

    /// Probabilities for the next frame; `None` while a window over frames fills, and for frames without a signal.
    fn classify_frame(&self, frame: &Frame) -> Outcome<Option<Probabilities>> {
        let mut work = self.lock()?;
        let Work { classifier, maps, mean } = &mut *work;
        if maps.as_ref().is_none_or(|(waveform, _)| *waveform != frame.waveform) {
            self.card.rdm_spec.check_compatible(&frame.waveform, &self.card.waveform)?;
            let processor = RdmProcessor::new(&self.card.rdm_spec, &frame.waveform)?;
            *maps = Some((frame.waveform.clone(), processor));
        }
        let Some((_, processor)) = maps else { return Ok(None) };
        if !processor.spec().has_signal(&frame.inner) {
            processor.reset();
            return Ok(None);
        }
        let map = next_map(processor, &frame.inner)?;
        let Some(map) = map else { return Ok(None) };
        Ok(Some(mean.update(frame.inner.time_s(), classifier.classify(&map)?)))
    }

    /// Runs `work` on the network and its card.
    fn with_network<T>(&self, work: impl FnOnce(&radome_models::Model) -> Outcome<T>) -> Outcome<T> {
        let guard = self.lock()?;
        let Some(model) = guard.classifier.model() else {
            return Err(
                "the model is an ONNX file\n\nhint: open the .safetensors file that it was exported from".into()
            );
        };
        work(model)
    }
}

fn check_free(path: &Path, overwrite: bool) -> Outcome<()> {
    if !overwrite && path.exists() {
        return Err(RecordingError::Occupied { path: path.to_owned() }.into());
    }
    Ok(())
}

#[pymethods]
impl Model {
    #[new]
    #[pyo3(signature = (name=PathBuf::from(BUILT_IN)))]
    fn new(py: Python<'_>, name: PathBuf) -> PyResult<Self> {
        detached(py, || Ok(Self::of(Classifier::load(&name)?)))
    }

    /// Probabilities of empty, one and two, `[class]`, float32, of the next frame or of a map; `None` as the class says.
    fn __call__<'py>(&self, py: Python<'py>, frame: &Bound<'py, PyAny>) -> PyResult<Option<Bound<'py, PyArray1<f32>>>> {
        let probabilities = if let Ok(map) = frame.cast::<Map>() {
            let map = map.get();
            Some(detached(py, || self.classify(map))?)
        } else {
            let frame = frame.cast::<Frame>()?.get();
            detached(py, || self.classify_frame(frame))?
        };
        Ok(probabilities.map(|probabilities| probabilities.to_vec().into_pyarray(py)))
    }

    /// Forgets what needs consecutive frames, as where some are missing. Motion and evidence stay; their weights decay with time.
    fn gap(&self, py: Python<'_>) -> PyResult<()> {
        detached(py, || {
            if let Some((_, processor)) = &mut self.lock()?.maps {
                processor.reset_at_gap();
            }
            Ok(())
        })
    }

    /// Forgets all frames before.
    fn reset(&self, py: Python<'_>) -> PyResult<()> {
        detached(py, || {
            let Work { maps, mean, .. } = &mut *self.lock()?;
            if let Some((_, processor)) = maps {
                processor.reset();
            }
            mean.reset();
            Ok(())
        })
    }

    /// Raises an error if the model cannot judge frames of a waveform.
    fn check_waveform(&self, py: Python<'_>, waveform: &Bound<'_, Waveform>) -> PyResult<()> {
        let checked = self.card.rdm_spec.check_compatible(&waveform.get().0, &self.card.waveform);
        checked.map_err(|error| to_exception(py, &error))
    }

    /// Filter over the probabilities of single frames, with the settings of the model's card. `frame_interval_s` is the time from
    /// frame to frame, s.
    fn filter(&self, frame_interval_s: f64) -> Filter {
        Filter(Mutex::new(OccupancyFilter::new(self.card.smoothing, frame_interval_s)))
    }

    /// Everything about the model but its numbers, a dict.
    #[getter]
    fn card<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        to_python(py, &self.card)
    }

    /// Waveform that the model is best with.
    #[getter]
    fn waveform(&self) -> Waveform {
        Waveform(Arc::new(self.card.waveform.clone()))
    }

    /// Specification of the maps that the model needs, a dict.
    #[getter]
    fn rdm_spec<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        to_python(py, &self.card.rdm_spec)
    }

    /// Writes the model file.
    #[pyo3(signature = (path, *, overwrite=false))]
    fn save(&self, py: Python<'_>, path: PathBuf, overwrite: bool) -> PyResult<()> {
        detached(py, || {
            check_free(&path, overwrite)?;
            self.with_network(|model| Ok(model.save(&path)?))
        })
    }

    /// Writes the model as ONNX.
    #[pyo3(signature = (path, *, overwrite=false))]
    fn export(&self, py: Python<'_>, path: PathBuf, overwrite: bool) -> PyResult<()> {
        detached(py, || {
            let bytes = self.with_network(|model| Ok(onnx::export(model)?))?;
            let existing = if overwrite { Existing::Replace } else { Existing::Refuse };
            let partial = Partial::file(&path, existing)?;
            partial.open()?.write_all(&bytes)?;
            Ok(partial.finish()?)
        })
    }

    /// Scores over the maps of a dataset with these indices, a dict; `radome.evaluate` gives them.
    #[pyo3(name = "_evaluate")]
    fn evaluate<'py>(
        &self,
        py: Python<'py>,
        dataset: &Bound<'py, Dataset>,
        indices: Vec<usize>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let dataset = &dataset.get().inner;
        let metrics = detached(py, || Ok(evaluate(&mut self.lock()?.classifier, dataset, &indices)?))?;
        to_python(py, &metrics)
    }

    fn __repr__(&self) -> String {
        let [_, rows, columns] = self.card.input_shape;
        format!("<radome.Model {:?}, maps of {rows} x {columns}>", self.card.network)
    }
}

/// Filter over the probabilities of single frames.
#[pyclass(frozen, module = "radome._radome")]
pub struct Filter(Mutex<OccupancyFilter>);

#[pymethods]
impl Filter {
    /// Takes the probabilities of empty, one and two of the frame at `time_s`, s; returns the filtered ones, `[class]`, float32.
    /// Frames come in the order of their times.
    fn update<'py>(&self, py: Python<'py>, time_s: f64, probabilities: [f32; 3]) -> Bound<'py, PyArray1<f32>> {
        let mut filter = lock(&self.0);
        filter.update(time_s, probabilities).to_vec().into_pyarray(py)
    }

    /// Forgets all frames.
    fn reset(&self) {
        lock(&self.0).reset();
    }
}
