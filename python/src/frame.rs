//! Frames and the arrays over them.

use std::sync::Arc;

use numpy::ndarray::{ArrayView, Dimension};
use numpy::{Element, PyArray, PyArray3, PyReadonlyArray3};
use pyo3::prelude::*;
use radome_dsp::{Occupancy, Truth};

use crate::error::text_to_exception;
use crate::waveform::Waveform;

/// Frame of raw 12-bit codes. It does not change, and it does not need the source that it came from.
#[pyclass(frozen, module = "radome._radome")]
pub struct Frame {
    /// The frame.
    pub inner: radome_dsp::Frame,
    /// Waveform of its source.
    pub waveform: Arc<radome_dsp::Waveform>,
}

/// NumPy array over memory of `owner`, which it keeps alive. It cannot be written to, and Python cannot make it so.
///
/// # Safety
/// `owner` must own the memory and neither change nor free it before it is dropped itself.
///
/// # Errors
/// NumPy fails.
pub unsafe fn read_only<'py, T: Element, D: Dimension>(
    view: &ArrayView<'_, T, D>,
    owner: Bound<'py, PyAny>,
) -> PyResult<Bound<'py, PyArray<T, D>>> {
    // SAFETY: the caller guarantees that the memory lives and does not change as long as `owner` lives.
    let array = unsafe { PyArray::<T, D>::borrow_from_array(view, owner) };
    array.call_method1("setflags", (false,))?;
    Ok(array)
}

/// Class by its name.
///
/// # Errors
/// There is no class of this name.
pub fn occupancy(py: Python<'_>, name: &str) -> PyResult<Occupancy> {
    Occupancy::from_name(name)
        .ok_or_else(|| text_to_exception(py, format!("'{name}' is no class\n\nhint: it is 'empty', 'one' or 'two'")))
}

#[pymethods]
impl Frame {
    /// Frame of an array of codes, of which it keeps a copy.
    #[staticmethod]
    #[pyo3(signature = (codes, waveform, *, sequence=0, time_ns=None, truth=None, transition=false))]
    fn from_array(
        codes: &Bound<'_, PyAny>,
        waveform: &Bound<'_, Waveform>,
        sequence: u64,
        time_ns: Option<u64>,
        truth: Option<&str>,
        transition: bool,
    ) -> PyResult<Self> {
        let py = codes.py();
        let waveform = waveform.get().0.clone();
        let shape = waveform.shape();
        let arrays = py.import("radome._arrays")?;
        let codes = arrays.call_method1("codes", (codes, (shape.rx, shape.chirps, shape.samples)))?;
        let array: PyReadonlyArray3<'_, u16> = codes.extract()?;
        let truth = truth.map(|name| occupancy(py, name)).transpose()?;
        let interval_ns = waveform.frame_interval_s() * 1e9;
        let inner = radome_dsp::Frame {
            sequence,
            time_ns: time_ns.unwrap_or((sequence as f64 * interval_ns) as u64),
            codes: array.as_slice()?.to_vec(),
            truth: truth.map(|occupancy| Truth { occupancy, transition }),
            ..radome_dsp::Frame::zeroed(shape)
        };
        Ok(Frame { inner, waveform })
    }

    /// Codes 0 to 4095, `[rx][chirp][sample]`, uint16, a read-only view.
    #[getter]
    fn codes<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyArray3<u16>>> {
        let frame = &slf.get().inner;
        let view = frame.view().ok_or_else(|| {
            text_to_exception(
                slf.py(),
                format!("frame {} holds {} codes, not {}", frame.sequence, frame.codes.len(), frame.shape),
            )
        })?;
        // SAFETY: the class is frozen, so that the codes stay where they are until the frame is dropped.
        unsafe { read_only(&view, slf.clone().into_any()) }
    }

    /// Frames since the acquisition started, lost ones counted too.
    #[getter]
    fn sequence(&self) -> u64 {
        self.inner.sequence
    }

    /// Time of the first chirp since the acquisition started, ns, by the source's own clock.
    #[getter]
    fn time_ns(&self) -> u64 {
        self.inner.time_ns
    }

    /// The same in seconds.
    #[getter]
    fn time_s(&self) -> f64 {
        self.inner.time_s()
    }

    /// Time at which the host received the frame, ns since 1970; 0 where it is unknown.
    #[getter]
    fn host_time_ns(&self) -> u64 {
        self.inner.host_time_ns
    }

    /// Receivers, chirps and samples.
    #[getter]
    fn shape(&self) -> (usize, usize, usize) {
        let shape = self.inner.shape;
        (shape.rx, shape.chirps, shape.samples)
    }

    /// Class that is true of the frame (`"empty"`, `"one"`, `"two"`), or `None` where it is unknown.
    #[getter]
    fn truth(&self) -> Option<&'static str> {
        self.inner.truth.map(|truth| truth.occupancy.name())
    }

    /// Whether a person enters or leaves during the frame; `None` where it is unknown.
    #[getter]
    fn transition(&self) -> Option<bool> {
        self.inner.truth.map(|truth| truth.transition)
    }

    /// Chip temperature, degrees Celsius; `None` where the source does not report it.
    #[getter]
    fn temperature_c(&self) -> Option<f64> {
        self.inner.temperature_millicelsius.map(|millicelsius| f64::from(millicelsius) * 1e-3)
    }

    /// Whether at least one receiver gives a signal.
    #[getter]
    pub fn has_signal(&self) -> bool {
        (0..self.inner.shape.rx).any(|rx| !self.inner.is_receiver_dead(rx))
    }

    /// Waveform of the frame.
    #[getter]
    fn waveform(&self) -> Waveform {
        Waveform(self.waveform.clone())
    }

    fn __repr__(&self) -> String {
        let frame = &self.inner;
        format!("<radome.Frame {} at {:.3} s, {}>", frame.sequence, frame.time_s(), frame.shape)
    }
}
