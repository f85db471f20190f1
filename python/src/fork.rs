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
pub struct CreatorProcess(u32);

impl CreatorProcess {
    /// The current process.
    pub fn current() -> Self {
        CreatorProcess(std::process::id())
    }

    /// Returns whether the object was created in the current process.
    pub fn is_current(self) -> bool {
        self.0 == std::process::id()
    }

    /// Checks that an object with threads is used in the process that created it, and not in a fork.
    ///
    /// # Errors
    /// The current process is not the one in which the object was created.
    pub fn check(self, what: &str) -> Outcome<()> {
        if self.is_current() {
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

/// Checks that the current process is the one that imported the module: a fork has no threads in the process-wide pools.
///
/// # Errors
/// The current process is a fork of the one that imported the module.
pub fn check_pools(what: &str) -> Outcome<()> {
    CreatorProcess(IMPORTED_IN.load(Ordering::Relaxed)).check(what)
}
