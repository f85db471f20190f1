//! Echoes of each frame.

use radome_dsp::detect::Detection;

#[derive(Debug, Clone)]
pub struct Detections {
    /// Middle of the frame, s.
    pub time_s: f64,
    /// Number of people by label; 2 without a label.
    pub people: usize,
    /// Echoes, moving and still.
    pub echoes: Vec<Detection>,
}

/// Index of a frame and index of an echo in its list.
pub type Place = (usize, usize);
