//! Echoes of each frame.

use radome_dsp::detect::Detection;

/// Echoes of a frame.
#[derive(Debug, Clone)]
pub struct Detections {
    /// Middle of the frame, s.
    pub time_s: f64,
    /// Number of people by label; 2 without a label.
    pub people: usize,
    /// Echoes, moving and still.
    pub echoes: Vec<Detection>,
}

/// Position of an echo in a list of frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EchoIndex {
    /// Index of the frame.
    pub frame: usize,
    /// Index among the echoes of the frame.
    pub echo: usize,
}
