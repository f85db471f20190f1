//! Fields of the vendor's JSON files.

use std::path::Path;

use radome_dsp::RxMask;
use serde_json::Value;

use super::RecordingError;

/// Fields of a configuration under their new and old names.
pub(super) struct Fields<'a> {
    pub(super) path: &'a Path,
    pub(super) object: &'a Value,
}

impl Fields<'_> {
    /// Error of a field.
    pub(super) fn error(&self, field: &str, reason: impl Into<String>) -> RecordingError {
        RecordingError::Field { path: self.path.to_owned(), field: field.to_owned(), reason: reason.into() }
    }

    /// Value of a field; `None` if it is absent or null.
    pub(super) fn optional(&self, field: &str) -> Result<Option<f64>, RecordingError> {
        match self.object.get(field) {
            None | Some(Value::Null) => Ok(None),
            // Some recorders write numbers as text.
            Some(Value::String(text)) => match text.trim().parse::<f64>() {
                Ok(number) if number.is_finite() => Ok(Some(number)),
                _ => Err(self.error(field, format!("is \"{text}\", expected a number"))),
            },
            Some(value) => match value.as_f64() {
                Some(number) => Ok(Some(number)),
                None => Err(self.error(field, format!("is {value}, expected a number"))),
            },
        }
    }

    /// Value of a field, which may have an old name.
    pub(super) fn number(&self, field: &str, old_name: Option<&str>) -> Result<f64, RecordingError> {
        let value = match (self.optional(field)?, old_name) {
            (None, Some(old_name)) => self.optional(old_name)?,
            (value, _) => value,
        };
        value.ok_or_else(|| match old_name {
            Some(old_name) => self.error(field, format!("is absent, and so is its old name `{old_name}`")),
            None => self.error(field, "is absent"),
        })
    }

    /// Value of a field that is a whole number.
    pub(super) fn count(&self, field: &str) -> Result<usize, RecordingError> {
        let number = self.number(field, None)?;
        if number < 0.0 || number > f64::from(u32::MAX) || number.fract() != 0.0 {
            return Err(self.error(field, format!("is {number}, expected a whole number")));
        }
        Ok(number as usize)
    }

    /// Receive antennas.
    pub(super) fn antennas(&self) -> Result<RxMask, RecordingError> {
        let field = "rx_antennas";
        let malformed = |this: &Self| this.error(field, "expected a list of antenna numbers such as [1, 2, 3]");
        let list = self.object.get(field).and_then(Value::as_array).ok_or_else(|| malformed(self))?;
        let number =
            |value: &Value| value.as_f64().filter(|antenna| antenna.fract() == 0.0).map(|antenna| antenna as u8);
        let antennas: Option<Vec<u8>> = list.iter().map(number).collect();
        let antennas = antennas.ok_or_else(|| malformed(self))?;
        RxMask::from_antennas(&antennas).map_err(|e| self.error(field, e.to_string()))
    }
}
