//! Range-Doppler maps.

use std::sync::{Arc, Mutex};

use numpy::ndarray::ArrayView3;
use numpy::{IntoPyArray, PyArray1, PyArray3};
use pyo3::prelude::*;
use radome_dsp::{MapStatus, Rdm, RdmProcessor, RdmSpec};

use crate::error::{Outcome, detached, from_python, lock, text_to_exception, to_exception, to_python};
use crate::frame::{Frame, read_only};
use crate::waveform::Waveform;

/// Largest number of idle processors that [`rdm`] keeps for the next call.
const MAX_IDLE_PROCESSORS: usize = 8;

/// Range-Doppler map. It does not change.
#[pyclass(frozen, module = "radome._radome")]
pub struct Map {
    /// The map.
    pub inner: Rdm,
    /// Settings that made the map.
    pub spec: RdmSpec,
    /// Waveform of the frames.
    pub waveform: Arc<radome_dsp::Waveform>,
}

#[pymethods]
impl Map {
    /// Cells in dB, `[rx][doppler][range]`, float32, a read-only view.
    #[getter]
    fn db<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyArray3<f32>>> {
        let map = &slf.get().inner;
        let shape = (map.shape.rx, map.shape.doppler, map.shape.range);
        let view = ArrayView3::from_shape(shape, &map.db).map_err(|error| to_exception(slf.py(), &error))?;
        // SAFETY: the class is frozen, so that the cells stay where they are until the map is dropped.
        unsafe { read_only(&view, slf.clone().into_any()) }
    }

    /// Range of each range bin, m.
    #[getter]
    fn range_m<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        let ranges: Vec<f64> = (0..self.inner.shape.range).map(|bin| self.inner.range_m(bin)).collect();
        ranges.into_pyarray(py)
    }

    /// Radial velocity of each Doppler bin, m/s, positive when receding.
    #[getter]
    fn velocity_m_per_s<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        let bins = 0..self.inner.shape.doppler;
        let velocities: Vec<f64> = bins.map(|bin| self.inner.velocity_m_per_s(bin)).collect();
        velocities.into_pyarray(py)
    }

    /// Channels, Doppler bins and range bins.
    #[getter]
    fn shape(&self) -> (usize, usize, usize) {
        let shape = self.inner.shape;
        (shape.rx, shape.doppler, shape.range)
    }

    /// Sequence number of the frame, or of the last one that the map is made of.
    #[getter]
    fn sequence(&self) -> u64 {
        self.inner.sequence
    }

    /// Codes at either end of the ADC.
    #[getter]
    fn saturated_samples(&self) -> u32 {
        self.inner.flags.saturated_samples
    }

    /// Motion of echoes over the last frames, a dict of seven quantities; `None` unless the spec has `motion_over_s`.
    #[getter]
    fn motion<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        to_python(py, &self.inner.motion)
    }

    fn __repr__(&self) -> String {
        format!("<radome.Map of frame {}, {}>", self.inner.sequence, self.inner.shape)
    }
}

/// Specification of a map: the name of a preset, a dict of keys that differ from the default, or `None` for the
/// default.
///
/// # Errors
/// The preset or key does not exist.
pub fn spec(object: Option<&Bound<'_, PyAny>>, waveform: &radome_dsp::Waveform) -> PyResult<RdmSpec> {
    let Some(object) = object else { return Ok(RdmSpec::default()) };
    let py = object.py();
    if let Ok(name) = object.extract::<String>() {
        return match name.as_str() {
            "default" => Ok(RdmSpec::default()),
            "paper" => Ok(RdmSpec::paper()),
            "sdk" => Ok(RdmSpec::sdk(waveform)),
            _ => Err(text_to_exception(
                py,
                format!("'{name}' is no kind of map\n\nhint: it is 'default', 'paper', 'sdk' or a dict of keys"),
            )),
        };
    }
    let keys_to_change: serde_json::Map<String, serde_json::Value> = from_python("map spec", object)?;
    let invalid = |error: serde_json::Error| text_to_exception(py, format!("map spec: {error}"));
    let mut keys = serde_json::to_value(RdmSpec::default()).map_err(invalid)?;
    if let Some(keys) = keys.as_object_mut() {
        keys.extend(keys_to_change);
    }
    serde_json::from_value(keys).map_err(invalid)
}

/// Next map of a processor; `None` while its window over frames fills.
pub fn next_map(processor: &mut RdmProcessor, frame: &radome_dsp::Frame) -> Outcome<Option<Rdm>> {
    let mut map = processor.empty_map();
    Ok(match processor.process(frame, &mut map)? {
        MapStatus::Ready => Some(map),
        MapStatus::WarmingUp { .. } => None,
    })
}

/// Maker of maps from a stream of frames, with the state between frames that the spec asks for.
///
/// Call it with the frames of one source in their order. It returns the `Map` of each, or `None` while a window over frames
/// fills. `spec` is the name of a preset, a dict of keys or `None`; `radome.rdm` lists them. Call `gap` where frames are missing, and
/// `reset` before frames of another scene.
#[pyclass(frozen, module = "radome._radome")]
pub struct MapProcessor {
    processor: Mutex<RdmProcessor>,
    spec: RdmSpec,
    waveform: Arc<radome_dsp::Waveform>,
}

#[pymethods]
impl MapProcessor {
    #[new]
    #[pyo3(signature = (waveform, spec=None))]
    fn new(py: Python<'_>, waveform: &Bound<'_, Waveform>, spec: Option<&Bound<'_, PyAny>>) -> PyResult<Self> {
        let waveform = waveform.get().0.clone();
        let spec = self::spec(spec, &waveform)?;
        let processor = RdmProcessor::new(&spec, &waveform).map_err(|error| to_exception(py, &error))?;
        Ok(MapProcessor { processor: Mutex::new(processor), spec, waveform })
    }

    /// Map of the next frame, `[rx][doppler][range]`, float32, dB; `None` while a window over frames fills.
    fn __call__(&self, py: Python<'_>, frame: &Bound<'_, Frame>) -> PyResult<Option<Map>> {
        let frame = &frame.get().inner;
        let map = detached(py, || next_map(&mut lock(&self.processor), frame))?;
        Ok(map.map(|inner| Map { inner, spec: self.spec, waveform: self.waveform.clone() }))
    }

    /// Forgets what needs consecutive frames, as where some are missing. Motion stays unless more than a second is missing.
    fn gap(&self, py: Python<'_>) {
        py.detach(|| lock(&self.processor).reset_at_gap());
    }

    /// Forgets all frames before.
    fn reset(&self, py: Python<'_>) {
        py.detach(|| lock(&self.processor).reset());
    }

    /// Specification of the maps, a dict.
    #[getter]
    fn spec<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        to_python(py, &self.spec)
    }

    /// Waveform of the frames.
    #[getter]
    fn waveform(&self) -> Waveform {
        Waveform(self.waveform.clone())
    }
}

/// Processor for frames of a waveform: an idle one, or a new one.
fn processor(spec: &RdmSpec, waveform: &Arc<radome_dsp::Waveform>) -> Outcome<RdmProcessor> {
    if let Ok(mut idle) = PROCESSORS.try_lock()
        && let Some(index) = idle.iter().position(|(known, processor)| known == waveform && processor.spec() == spec)
    {
        return Ok(idle.swap_remove(index).1);
    }
    Ok(RdmProcessor::new(spec, waveform)?)
}

/// Idle processors of [`rdm`]. Callers do not wait for the mutex: a fork may have copied it while another thread held it.
static PROCESSORS: Mutex<Vec<(Arc<radome_dsp::Waveform>, RdmProcessor)>> = Mutex::new(Vec::new());

/// Map of one frame alone: its `db` is `[rx][doppler][range]`, float32, dB.
///
/// `spec` is the name of a preset, or a dict of keys that differ from the default. `None` is `"default"`.
///
/// Presets:
/// - `"default"`: all channels in dB of full scale, Hann windows, nothing removed.
/// - `"paper"`: channel 0 without normalisation, samples from -1 to 1, the mean over slow time removed.
/// - `"sdk"`: the vendor's example, with memory between frames: moving-target indication, symmetric Blackman-Harris windows, twice
///   as many points on both axes. `rdm` gives its first map alone; give a stream to a `MapProcessor`.
///
/// Keys, the default first:
/// - `scale`: `"full_scale"`, `"zero_to_one"`, `"minus_one_to_one"`: the numbers that codes become.
/// - `channels`: `"all"`, `{"one": 0}` (index of the channel), `"incoherent_sum"` (mean power of all).
/// - `chirp_mean_removal`: `False`, `True`: subtracts the mean of each chirp.
/// - `static_removal`: `"none"`, `"slow_time_mean"`, `{"recursive_mti": {"alpha": 0.8}}`.
/// - `range_window`, `doppler_window`: `"hann"`, `"rectangular"`, `"hamming"`, `"blackman_harris"`, `"blackman_harris_symmetric"`.
/// - `range_fft_length`, `doppler_fft_length`: `None` (the data's own) or a number of points; zeros are appended.
/// - `physical_axes`: `None` (the axes of the waveform) or a dict of `range_step_m`, m, `range_bins`, `velocity_step_m_per_s`, m/s,
///   and `velocity_bins`.
/// - `change_over_s`: `None` or the time constant, s, of change in cells of zero velocity; with `physical_axes` and a stream.
/// - `motion_over_s`: `None` or the time constant, s, over which the motion of echoes is averaged (`Map.motion`); with one channel
///   and a stream.
/// - `max_range_m`: `None` or the greatest range that is measured, m; with `physical_axes`. Cells beyond hold noise.
/// - `slow_time`: `"chirps"`, `{"frames": {"frames": 64}}` (a window over frames; with a stream).
/// - `amplitude`: `"full_scale_sine"`, `"unnormalised"`, `"vendor"`: the amplitude that reads 0 dB.
/// - `floor_db`: -200, the lowest level of a cell, dB.
#[pyfunction]
#[pyo3(signature = (frame, spec=None))]
pub fn rdm(py: Python<'_>, frame: &Bound<'_, Frame>, spec: Option<&Bound<'_, PyAny>>) -> PyResult<Map> {
    let Frame { inner: frame, waveform } = frame.get();
    let spec = self::spec(spec, waveform)?;
    let map = detached(py, || {
        let mut processor = processor(&spec, waveform)?;
        processor.reset();
        let map = next_map(&mut processor, frame)?;
        if let Ok(mut idle) = PROCESSORS.try_lock() {
            idle.truncate(MAX_IDLE_PROCESSORS - 1);
            idle.push((waveform.clone(), processor));
        }
        map.ok_or_else(|| "this map is made of more than one frame\n\nhint: give the frames to a MapProcessor".into())
    })?;
    Ok(Map { inner: map, spec, waveform: waveform.clone() })
}
