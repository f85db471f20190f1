//! Errors as Python exceptions, and JSON as the form of everything that is not an array.

use std::error::Error;
use std::fmt;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};

use pyo3::prelude::*;
use radome_driver::{BoardError, RecordingError};
use radome_files::{TEXT_LIMIT_BYTES, read_text};
use radome_models::dataset::DatasetError;
use serde::Serialize;
use serde::de::DeserializeOwned;

/// Any error of the libraries, or a text, which may contain `\n\nhint: `.
pub type Failure = radome_dsp::SourceError;

/// Result of work without the interpreter lock.
pub type Outcome<T> = Result<T, Failure>;

/// Runs work without the interpreter lock.
///
/// # Errors
/// The error of the work, as an exception.
pub fn detached<T: Send>(py: Python<'_>, work: impl FnOnce() -> Outcome<T> + Send) -> PyResult<T> {
    py.detach(work).map_err(|failure| to_exception(py, &*failure))
}

/// Locks a mutex, also after a panic of a thread that held it.
pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Exception for an error: message, hint and causes, as `radome._errors.make` builds it. A Python exception stays what it is.
pub fn to_exception(py: Python<'_>, error: &(dyn Error + 'static)) -> PyErr {
    if let Some(exception) = error.downcast_ref::<PyErr>() {
        return exception.clone_ref(py);
    }
    let mut messages = Vec::new();
    let mut kind = "";
    let mut next = Some(error);
    while let Some(error) = next {
        messages.push(error.to_string());
        if kind.is_empty() {
            kind = kind_of(error);
        }
        next = error.source();
    }
    match py.import("radome._errors").and_then(|module| module.call_method1("make", (messages, kind))) {
        Ok(exception) => PyErr::from_value(exception),
        Err(error) => error,
    }
}

/// Exception for a text, which may contain a hint.
pub fn text_to_exception(py: Python<'_>, text: String) -> PyErr {
    let failure: Failure = text.into();
    to_exception(py, &*failure)
}

/// Kind of a file error, as `radome._errors.make` expects it; empty for other errors.
fn kind_of(error: &(dyn Error + 'static)) -> &'static str {
    if let Some(error) = error.downcast_ref::<io::Error>() {
        return match error.kind() {
            io::ErrorKind::NotFound => "not_found",
            io::ErrorKind::PermissionDenied => "permission",
            io::ErrorKind::AlreadyExists => "exists",
            _ => "file",
        };
    }
    match error.downcast_ref::<RecordingError>() {
        Some(RecordingError::Missing { .. }) => return "not_found",
        Some(RecordingError::Occupied { .. }) => return "exists",
        _ => {}
    }
    match error.downcast_ref::<DatasetError>() {
        Some(DatasetError::Exists { .. }) => return "exists",
        Some(DatasetError::NoDataset { .. }) => return "not_found",
        _ => {}
    }
    match error.downcast_ref::<BoardError>() {
        Some(BoardError::Absent { .. }) => "not_found",
        Some(BoardError::PermissionDenied { .. }) => "permission",
        _ => "",
    }
}

/// Error of a text file that cannot be read.
#[derive(Debug)]
struct Unreadable {
    path: PathBuf,
    source: io::Error,
}

impl fmt::Display for Unreadable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: cannot be read", self.path.display())
    }
}

impl Error for Unreadable {
    fn source(&self) -> Option<&(dyn Error + 'static)> {
        Some(&self.source)
    }
}

/// Text of a settings or label file.
///
/// # Errors
/// The file cannot be read, is too long or is not UTF-8. The message names the file.
pub fn read_text_file(path: &Path) -> Outcome<String> {
    read_text(path, TEXT_LIMIT_BYTES).map_err(|source| Unreadable { path: path.to_owned(), source }.into())
}

/// Converts a value to a Python object, by way of JSON.
///
/// # Errors
/// The value has no JSON form.
pub fn to_python<'py>(py: Python<'py>, value: &impl Serialize) -> PyResult<Bound<'py, PyAny>> {
    let text = serde_json::to_string(value).map_err(|error| to_exception(py, &error))?;
    py.import("json")?.call_method1("loads", (text,))
}

/// Converts a Python object to a value, by way of JSON; `what` begins the error message.
///
/// # Errors
/// The object has no JSON form, contains a number that is not finite, or does not match the type.
pub fn from_python<T: DeserializeOwned>(what: &str, object: &Bound<'_, PyAny>) -> PyResult<T> {
    let py = object.py();
    let text: String = py.import("radome._json")?.call_method1("text", (what, object))?.extract()?;
    let invalid = |error: serde_json::Error| {
        let (prefix, message) = (format!("{what}: "), error.to_string());
        // Error messages of waveforms already begin with this prefix.
        text_to_exception(py, if message.starts_with(&prefix) { message } else { prefix + &message })
    };
    let value: serde_json::Value = serde_json::from_str(&text).map_err(invalid)?;
    serde_json::from_value(value).map_err(invalid)
}
