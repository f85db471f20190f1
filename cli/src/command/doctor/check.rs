//! Checks of the doctor.

use serde::Serialize;

use crate::output;

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// No problem.
    Ok,
    /// Something will be missing or slow.
    Warn,
    /// The program will not work.
    Fail,
}

#[derive(Debug, Clone, Serialize)]
pub struct Check {
    pub check: &'static str,
    #[serde(rename = "verdict")]
    pub outcome: Outcome,
    /// Finding in words.
    pub found: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    /// Remedy, if there is one.
    pub hint: Option<String>,
}

impl Check {
    pub fn ok(check: &'static str, found: impl Into<String>) -> Self {
        Check { check, outcome: Outcome::Ok, found: found.into(), hint: None }
    }

    pub fn warn(check: &'static str, found: impl Into<String>, hint: impl Into<String>) -> Self {
        Check { check, outcome: Outcome::Warn, found: found.into(), hint: Some(hint.into()) }
    }

    pub fn fail(check: &'static str, found: impl Into<String>, hint: impl Into<String>) -> Self {
        Check { check, outcome: Outcome::Fail, found: found.into(), hint: Some(hint.into()) }
    }

    /// Creates a check that failed with an error. The error's hint becomes the remedy.
    pub fn error(check: &'static str, error: &anyhow::Error) -> Self {
        let text = output::chain(error);
        let (found, hint) = match text.split_once("\n\nhint: ") {
            Some((found, hint)) => (found.to_owned(), Some(hint.to_owned())),
            None => (text, None),
        };
        Check { check, outcome: Outcome::Fail, found, hint }
    }
}
