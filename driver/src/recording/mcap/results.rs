//! What a classifier said while a recording was made: the channel `/radome/results`.

use radome_dsp::Occupancy;
use serde::{Deserialize, Serialize};

/// Version of the results that are written, and the newest that is read.
pub const RESULTS_VERSION: u32 = 1;

/// Who judged the frames of a recording.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Judge {
    /// [`RESULTS_VERSION`] of the writer.
    pub version: u32,
    /// Name of the model's file.
    pub model: String,
    /// SHA-256 of that file, hexadecimal; the program's version, if it judges without a file.
    pub model_hash: String,
    /// Agreement after which the room counted as occupied, s.
    pub on_delay_s: f64,
    /// Agreement after which it no longer did, s.
    pub off_delay_s: f64,
}

/// What was said about a frame. Frames without a result were not judged in time.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct FrameResult {
    /// Sequence number of the frame.
    pub sequence: u64,
    /// The frame's own time ([`radome_dsp::Frame::time_ns`]), ns.
    pub time_ns: u64,
    /// When the host had the frame, ns since 1970; 0 where nobody knows.
    pub host_time_ns: u64,
    /// Most likely class; `None` while a window over frames filled.
    pub label: Option<Occupancy>,
    /// Probabilities of empty, one and two, over the frames so far.
    pub probabilities: Option<[f32; 3]>,
    /// The same by this frame alone.
    pub frame_probabilities: Option<[f32; 3]>,
    /// Whether the room counted as occupied, after the judge's delays.
    pub occupied: bool,
    /// People that it counted as holding, after the same delays.
    pub people: u8,
    /// From the frame's last byte to its label, ns.
    pub latency_ns: u64,
}

impl FrameResult {
    /// Time since the acquisition started, s.
    pub fn time_s(&self) -> f64 {
        self.time_ns as f64 * 1e-9
    }
}
