//! Warnings that are given once: a dataset reads and simulates the same scene thousands of times.

use std::collections::BTreeSet;
use std::sync::{Mutex, PoisonError};

/// Returns whether this is the first call of the process with these words.
pub(crate) fn is_first_warning(words: &[&str]) -> bool {
    static SAID: Mutex<BTreeSet<Vec<String>>> = Mutex::new(BTreeSet::new());
    let words = words.iter().map(|word| (*word).to_owned()).collect();
    SAID.lock().unwrap_or_else(PoisonError::into_inner).insert(words)
}
