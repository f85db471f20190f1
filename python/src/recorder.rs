//! Recordings that Python writes, and import of labels from other tools.

use std::path::PathBuf;
use std::sync::Mutex;

use pyo3::prelude::*;
use radome_driver::recording::{Existing, Format, RecordingWriter, label_text};
use radome_driver::{LabelSpan, RecordingHeader};
use radome_dsp::Gap;
use serde_json::json;

use crate::error::{Outcome, detached, from_python, lock, read_text_file, to_python};
use crate::frame::Frame;
use crate::waveform::Waveform;

/// Writer of a recording.
#[pyclass(frozen, module = "radome._radome")]
pub struct Recorder {
    writer: Mutex<Option<RecordingWriter>>,
}

impl Recorder {
    fn with<T: Send>(
        &self,
        py: Python<'_>,
        work: impl FnOnce(&mut RecordingWriter) -> Outcome<T> + Send,
    ) -> PyResult<T> {
        detached(py, || match lock(&self.writer).as_mut() {
            Some(writer) => work(writer),
            None => Err("the recording is finished".into()),
        })
    }
}

#[pymethods]
impl Recorder {
    #[new]
    #[pyo3(signature = (path, waveform, *, overwrite=false))]
    fn new(py: Python<'_>, path: PathBuf, waveform: &Bound<'_, Waveform>, overwrite: bool) -> PyResult<Self> {
        let waveform = &waveform.get().0;
        let writer = detached(py, || {
            let format = Format::of_output(&path).ok_or_else(|| {
                let path = path.display();
                format!(
                    "{path}: which format?\n\nhint: end its name in .mcap or .txt, or name a folder for the vendor's"
                )
            })?;
            let existing = if overwrite { Existing::Replace } else { Existing::Refuse };
            let header = RecordingHeader::new(radome_dsp::Waveform::clone(waveform));
            Ok(RecordingWriter::create_with(&path, format, &header, existing)?)
        })?;
        Ok(Recorder { writer: Mutex::new(Some(writer)) })
    }

    /// Adds a frame.
    fn frame(&self, py: Python<'_>, frame: &Bound<'_, Frame>) -> PyResult<()> {
        let frame = &frame.get().inner;
        self.with(py, |writer| Ok(writer.frame(frame)?))
    }

    /// Adds a gap, a dict.
    fn gap(&self, py: Python<'_>, gap: &Bound<'_, PyAny>) -> PyResult<()> {
        let gap: Gap = from_python("gap", gap)?;
        self.with(py, |writer| Ok(writer.gap(&gap)?))
    }

    /// Adds a label, a dict.
    fn label(&self, py: Python<'_>, label: &Bound<'_, PyAny>) -> PyResult<()> {
        let label: LabelSpan = from_python("label", label)?;
        self.with(py, |writer| Ok(writer.label(&label)?))
    }

    /// Completes the recording; returns a dict with what was written. `None` if it is finished already.
    fn finish<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyAny>>> {
        let report = detached(py, || {
            let writer = lock(&self.writer).take();
            Ok(writer.map(RecordingWriter::finish).transpose()?)
        })?;
        let Some(report) = report else { return Ok(None) };
        let report = json!({
            "frames": report.frames,
            "gaps": report.gaps,
            "frames_lost": report.frames_lost,
            "bytes": report.bytes,
            "omitted": report.omitted,
        });
        to_python(py, &report).map(Some)
    }

    /// Removes what has been written, unless the recording is finished.
    fn discard(&self, py: Python<'_>) {
        py.detach(|| drop(lock(&self.writer).take()));
    }
}

/// Labels of a file of another tool, a list of dicts: `.txt` is an Audacity label track, `.label` a DEEPCRAFT file, `.json` a JSON array.
#[pyfunction]
pub fn read_labels<'py>(py: Python<'py>, path: PathBuf) -> PyResult<Bound<'py, PyAny>> {
    let labels = detached(py, || {
        let kind = path.extension().and_then(|extension| extension.to_str());
        let parse = match kind {
            Some("txt") => label_text::from_audacity,
            Some("label") => label_text::from_deepcraft,
            Some("json") => label_text::from_json,
            _ => {
                let path = path.display();
                let text = format!(
                    "{path}: which kind of labels?\n\nhint: .txt is an Audacity label track, .label DEEPCRAFT's, .json a JSON array"
                );
                return Err(text.into());
            }
        };
        let text = read_text_file(&path)?;
        parse(&text).map_err(|error| format!("{}: {error}", path.display()).into())
    })?;
    to_python(py, &labels)
}
