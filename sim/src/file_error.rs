//! Error in a file that a scene names.

use thiserror::Error;

/// Error in a file: its place, the expected content and the remedy. The caller that reads the file adds its name.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("{place}: {problem}\n\nhint: {hint}")]
pub struct FileError {
    /// Place in the file: a line, an accessor, a node, a clip, a part.
    pub place: String,
    /// Content that was found, and the content that was expected.
    pub problem: String,
    /// Remedy.
    pub hint: String,
}

impl FileError {
    /// Makes the error of a file that cannot be read; a hint in the I/O error becomes the hint.
    pub(crate) fn unreadable(error: &std::io::Error) -> Self {
        let text = error.to_string();
        let (problem, hint) = text.split_once("\n\nhint: ").unwrap_or((&text, "paths are relative to the scene file"));
        FileError::new("file", format!("cannot be read: {problem}"), hint)
    }

    pub(crate) fn new(place: impl Into<String>, problem: impl Into<String>, hint: impl Into<String>) -> Self {
        FileError { place: place.into(), problem: problem.into(), hint: hint.into() }
    }
}

pub(crate) fn utf8<'a>(bytes: &'a [u8], hint: &str) -> Result<&'a str, FileError> {
    std::str::from_utf8(bytes).map_err(|e| {
        let line = 1 + bytes.iter().take(e.valid_up_to()).filter(|&&b| b == b'\n').count();
        FileError::new(format!("line {line}"), "this is no UTF-8 text", hint)
    })
}
