//! Detection of forked processes: a fork copies memory, but no threads.

use std::sync::atomic::{AtomicU32, Ordering};

use crate::error::Outcome;

/// Process that imported the module.
static IMPORTED_IN: AtomicU32 = AtomicU32::new(0);

/// Remembers the current process as the one that imported the module.
pub fn remember_process() {
    IMPORTED_IN.store(std::process::id(), Ordering::Relaxed);
}

/// Process in which an object was created.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Birthplace(u32);

impl Birthplace {
    /// The current process.
    pub fn here() -> Self {
        Birthplace(std::process::id())
    }

    /// Whether the object was made in the current process.
    pub fn is_here(self) -> bool {
        self.0 == std::process::id()
    }

    /// Refuses the use of an object with threads in a fork of the process that made it.
    ///
    /// # Errors
    /// The current process is not the one in which the object was made.
    pub fn check(self, what: &str) -> Outcome<()> {
        if self.is_here() {
            return Ok(());
        }
        let text = format!(
            "{what} does not work in process {}, a fork of process {}: a fork has no threads\n\nhint: start processes with \
             multiprocessing's 'spawn' or 'forkserver', or open sources and models in the process that uses them",
            std::process::id(),
            self.0
        );
        Err(text.into())
    }
}

/// Refuses work on the process-wide thread pools in a fork of the process that imported the module.
///
/// # Errors
/// The current process is a fork of the one that imported the module.
pub fn check_pools(what: &str) -> Outcome<()> {
    Birthplace(IMPORTED_IN.load(Ordering::Relaxed)).check(what)
}
