//! Detection: cells above a threshold, echoes with range, speed and direction, and a classical counter of people.

mod angle;
mod cfar;
mod counter;
mod detections;

pub use angle::{AngleCalibration, Baseline, Direction, RECEIVER_SPACING_M, Receivers};
pub use cfar::{CellDetection, CellReach, Cfar, CfarError, CfarSpec};
pub use counter::{CfarCounter, CounterError, Observation};
pub use detections::{Detection, Detector, LEAKAGE_BINS, RangeProfile};
