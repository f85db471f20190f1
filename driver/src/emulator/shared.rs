//! Counts and state of a running emulated board.

use std::sync::atomic::{AtomicBool, AtomicU64};
use std::sync::{Mutex, PoisonError};

/// Counts of an emulated board.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct EmulatorCounts {
    /// Data packets, faulty ones included.
    pub packets: u64,
    /// FIFO overflows.
    pub overflows: u64,
    /// Number of whole frames sent.
    pub frames: u64,
    /// Number of times the last client has closed the port or vanished.
    pub departures: u64,
}

/// State that the thread of an emulated board shares with its handle.
#[derive(Default)]
pub(super) struct Shared {
    /// Whether the board has to stop.
    pub(super) stop: AtomicBool,
    /// Whether the thread has ended without a panic.
    pub(super) has_ended: AtomicBool,
    /// Whether the source has ended and all of it has been sent.
    pub(super) finished: AtomicBool,
    pub(super) packets: AtomicU64,
    pub(super) overflows: AtomicU64,
    pub(super) frames: AtomicU64,
    pub(super) departures: AtomicU64,
    pub(super) refusal: Mutex<Option<String>>,
    pub(super) failure: Mutex<Option<String>>,
}

impl Shared {
    /// Sets the refusal: a client's request cannot be served.
    pub(super) fn refuse(&self, reason: &str) {
        tracing::warn!("the emulated board sends no frames: {reason}");
        *self.refusal.lock().unwrap_or_else(PoisonError::into_inner) = Some(reason.to_owned());
    }

    /// Clears the refusal: the client's request can be served.
    pub(super) fn accept(&self) {
        *self.refusal.lock().unwrap_or_else(PoisonError::into_inner) = None;
    }

    pub(super) fn refusal(&self) -> Option<String> {
        self.refusal.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Sets the failure of the board itself; the first one counts.
    pub(super) fn fail(&self, reason: String) {
        self.failure.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(reason);
    }
}
