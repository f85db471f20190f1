//! Results of a classifier that ran while a recording was made: the channel `/radome/results`.

use radome_dsp::Occupancy;
use serde::{Deserialize, Serialize};

/// Version of the results that are written, and the newest that is read.
pub const RESULTS_VERSION: u32 = 1;

/// Classifier of the frames of a recording.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Judge {
    /// [`RESULTS_VERSION`] of the writer.
    pub version: u32,
    /// Name of the model's file.
    pub model: String,
    /// SHA-256 of that file, hexadecimal; the program's version for a classifier without a file.
    pub model_hash: String,
    /// Delay until the state becomes occupied, s.
    pub on_delay_s: f64,
    /// Delay until the state becomes empty, s.
    pub off_delay_s: f64,
    /// Greatest range at which people counted, m; `None` for the whole room.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_range_m: Option<f64>,
}

/// Result of the classifier for a frame. Frames without a result were not classified in time.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct FrameResult {
    /// Sequence number of the frame.
    pub sequence: u64,
    /// The frame's own time ([`radome_dsp::Frame::time_ns`]), ns.
    pub time_ns: u64,
    /// Host time of the frame, ns since 1970; 0 if unknown.
    pub host_time_ns: u64,
    /// Most likely class; `None` while the window over frames is not full.
    pub label: Option<Occupancy>,
    /// Probabilities of empty, one and two people, over the frames so far.
    pub probabilities: Option<[f32; 3]>,
    /// Probabilities by this frame alone.
    pub frame_probabilities: Option<[f32; 3]>,
    /// Whether the room is occupied, after the classifier's delays.
    pub occupied: bool,
    /// Number of people, after the same delays.
    pub people: u8,
    /// Latency from the frame's last byte to its label, ns.
    pub latency_ns: u64,
}

impl FrameResult {
    /// Time since the acquisition started, s.
    pub fn time_s(&self) -> f64 {
        self.time_ns as f64 * 1e-9
    }
}
