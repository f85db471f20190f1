//! Recordings on disk: the native MCAP file, the vendor's folder and the vendor's text file. [`Recording`] reads all of
//! them, [`RecordingWriter`] writes them. A recording is locked by its writer: other writers get
//! [`RecordingError::Locked`].

mod disk;
mod error;
mod format;
pub mod infineon;
mod input;
pub mod label_text;
mod lock;
pub mod mcap;
mod opened;
mod partial;
mod position;
mod report;
pub mod span_check;
pub mod text;
pub mod utc;
mod vendor_config;
mod vendor_fields;
mod vendor_scene;
mod writer;

use std::collections::BTreeSet;
use std::sync::{Mutex, PoisonError};

pub use error::RecordingError;
pub use format::Format;
pub use opened::Recording;
pub use partial::{Existing, Partial, rename_synced};
pub use position::{Extent, Position};
use position::{first_index, time_ns};
pub use report::WriteReport;
use report::{Tally, check_frame};
pub use writer::RecordingWriter;

/// Logs a warning once in a process, because a command opens a recording several times.
fn warn_once(message: String) {
    static WARNED: Mutex<BTreeSet<String>> = Mutex::new(BTreeSet::new());
    let mut warned = WARNED.lock().unwrap_or_else(PoisonError::into_inner);
    if warned.insert(message.clone()) {
        tracing::warn!("{message}");
    }
}
