//! Waveforms.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use pyo3::prelude::*;
use pyo3::types::PyDict;
use radome_driver::RecordingError;
use radome_driver::chip::{ChipConfiguration, register};
use radome_driver::protocol::mcu7::SliceLayout;
use radome_driver::recording::Recording;
use radome_dsp::{FrameSource, WaveformRequest};
use radome_models::ModelCard;
use radome_models::model::is_built_in;

use crate::error::{Outcome, detached, from_python, read_text_file, to_exception, to_python};

/// Waveform as the chip realises it. Keyword arguments are the keys of a waveform in scene files:
/// `start_frequency_hz`, `end_frequency_hz`, `samples_per_chirp`, `chirps_per_frame`, `sample_rate_hz`, `chirp_interval_s`,
/// `frame_interval_s`, and with defaults `rx_antennas`, `tx_power_level`, `if_gain_db`, `high_pass_cutoff_hz`,
/// `anti_alias_cutoff_hz`.
#[pyclass(frozen, eq, module = "radome._radome")]
#[derive(PartialEq)]
pub struct Waveform(pub Arc<radome_dsp::Waveform>);

impl Waveform {
    fn realise(py: Python<'_>, request: WaveformRequest) -> PyResult<Self> {
        let waveform = radome_dsp::Waveform::realise(request).map_err(|error| to_exception(py, &error))?;
        Ok(Waveform(Arc::new(waveform)))
    }
}

/// Waveform by name (`paper`), or that of a model file or the built-in model, a recording, or a TOML file with a waveform's keys.
fn load(path: &Path) -> Outcome<radome_dsp::Waveform> {
    if path == Path::new("paper") {
        return Ok(radome_dsp::Waveform::realise(WaveformRequest::paper())?);
    }
    let path_text = path.display();
    if is_built_in(path) || path.extension().is_some_and(|e| e == "safetensors" || e == "onnx") {
        return Ok(ModelCard::load(path)?.waveform);
    }
    if path.extension().is_some_and(|e| e == "toml") {
        let text = read_text_file(path)?;
        let request = radome_files::parse_toml(&text)
            .map_err(|error| format!("{path_text} is no waveform: {}", error.message()))?;
        return Ok(radome_dsp::Waveform::realise(request)?);
    }
    match Recording::open(path) {
        Ok(recording) => Ok(recording.waveform().clone()),
        Err(RecordingError::Unknown { .. }) => Err(format!(
            "{path_text}: no waveform\n\nhint: it is 'paper', a .toml file with the keys of a waveform, a model file, 'room-hqnn' or a recording"
        )
        .into()),
        Err(error) => Err(error.into()),
    }
}

#[pymethods]
impl Waveform {
    #[new]
    #[pyo3(signature = (**keys))]
    fn new(py: Python<'_>, keys: Option<&Bound<'_, PyDict>>) -> PyResult<Self> {
        let keys = keys.cloned().unwrap_or_else(|| PyDict::new(py));
        Self::realise(py, from_python("waveform", keys.as_any())?)
    }

    /// Waveform by name (`"paper"`), or that of a model file or the built-in model (`"room-hqnn"`), a recording, or a TOML file
    /// with a waveform's keys.
    #[staticmethod]
    #[pyo3(name = "load")]
    fn load_from(py: Python<'_>, spec: PathBuf) -> PyResult<Self> {
        let waveform = detached(py, || load(&spec))?;
        Ok(Waveform(Arc::new(waveform)))
    }

    /// The same waveform with other values of some keys.
    #[pyo3(signature = (**keys))]
    fn replace(&self, py: Python<'_>, keys: Option<&Bound<'_, PyDict>>) -> PyResult<Self> {
        let request = self.request(py)?;
        if let Some(keys) = keys {
            request.call_method1("update", (keys,))?;
        }
        Self::realise(py, from_python("waveform", &request)?)
    }

    /// Keys and values of the request, a dict.
    #[getter]
    fn request<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        to_python(py, &self.0.request)
    }

    /// Receivers, chirps and samples of a frame.
    #[getter]
    fn shape(&self) -> (usize, usize, usize) {
        let shape = self.0.shape();
        (shape.rx, shape.chirps, shape.samples)
    }

    /// Time from frame to frame, s.
    #[getter]
    fn frame_interval_s(&self) -> f64 {
        self.0.frame_interval_s()
    }

    /// Time from chirp to chirp as realised, s.
    #[getter]
    fn chirp_interval_s(&self) -> f64 {
        self.0.chirp_interval_s
    }

    /// ADC rate as realised, Hz.
    #[getter]
    fn sample_rate_hz(&self) -> f64 {
        self.0.sample_rate_hz
    }

    /// Slope of the ramp as realised, Hz/s.
    #[getter]
    fn slope_hz_per_s(&self) -> f64 {
        self.0.slope_hz_per_s
    }

    /// Band that is sampled, Hz; narrower than the one requested.
    #[getter]
    fn sampled_bandwidth_hz(&self) -> f64 {
        self.0.sampled_bandwidth_hz()
    }

    /// Middle of the sampled band, Hz.
    #[getter]
    fn centre_frequency_hz(&self) -> f64 {
        self.0.centre_frequency_hz()
    }

    /// Range resolution of the sampled band, m.
    #[getter]
    fn range_resolution_m(&self) -> f64 {
        self.0.range_resolution_m()
    }

    /// Range at which the beat reaches half the ADC rate, m.
    #[getter]
    fn max_range_m(&self) -> f64 {
        self.0.max_range_m()
    }

    /// Largest radial speed without ambiguity, m/s.
    #[getter]
    fn max_velocity_m_per_s(&self) -> f64 {
        self.0.max_velocity_m_per_s()
    }

    /// Registers of the chip for the waveform: triples of name, address and 24-bit content.
    fn registers(&self, py: Python<'_>) -> PyResult<Vec<(&'static str, u8, u32)>> {
        let slice_samples = SliceLayout::for_frame(self.0.shape().codes()).samples;
        let configuration = ChipConfiguration { waveform: radome_dsp::Waveform::clone(&self.0), slice_samples };
        let registers = configuration.compile().map_err(|error| to_exception(py, &error))?;
        let name = |address: u8| register(address).map_or("", |register| register.name);
        Ok(registers.iter().map(|r| (name(r.address), r.address, r.value)).collect())
    }

    fn __repr__(&self) -> String {
        let ghz = |hz: f64| hz * 1e-9;
        let waveform = &self.0;
        format!(
            "<radome.Waveform {} at {:.3} GHz, {:.3} GHz sampled, every {} s>",
            waveform.shape(),
            ghz(waveform.centre_frequency_hz()),
            ghz(waveform.sampled_bandwidth_hz()),
            waveform.frame_interval_s()
        )
    }

    fn __reduce__<'py>(slf: &Bound<'py, Self>) -> PyResult<(Bound<'py, PyAny>, (String,))> {
        let text = serde_json::to_string(&*slf.get().0).map_err(|error| to_exception(slf.py(), &error))?;
        Ok((slf.get_type().getattr("_from_json")?, (text,)))
    }

    #[staticmethod]
    fn _from_json(py: Python<'_>, text: &str) -> PyResult<Self> {
        let waveform = serde_json::from_str(text).map_err(|error| to_exception(py, &error))?;
        Ok(Waveform(Arc::new(waveform)))
    }
}
