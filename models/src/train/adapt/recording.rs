//! Recordings that a model is adapted to.

use radome_dsp::Occupancy;

use crate::metrics::CLASSES;

/// Longest time that a frame counts for, s.
const INDEPENDENT_S: f64 = 1.0;
/// Approximate number of labelled frames in a fit, and largest number of simulated maps.
pub(super) const MOST_FRAMES: usize = 2000;

/// Labelled time of a recording at which its share within a class is half of the largest possible, s.
pub(super) const LONG_S: f64 = 10.0;
/// Least labelled time of one or two people, as a share of that of the class with most; [`LONG_S`] is always enough. A few seconds in
/// which somebody comes or goes do not represent a class, and would weigh as much as another class. An empty room looks the same at all
/// times.
const LEAST_SHARE: f64 = 0.2;

/// Returns which classes are labelled for long enough to learn from them, given their labelled seconds.
pub(super) fn learnable_classes(seconds: [f64; CLASSES]) -> [bool; CLASSES] {
    let least_s = LONG_S.min(LEAST_SHARE * seconds.into_iter().fold(0.0, f64::max));
    std::array::from_fn(|class| {
        seconds[class] > 0.0 && (class == Occupancy::Empty.index() || seconds[class] >= least_s)
    })
}

/// Input of the adapted layers for one frame of a recording.
#[derive(Debug, Clone)]
pub struct AdaptFrame {
    /// Start of the frame on the recording's clock, s.
    pub time_s: f64,
    /// Result of [`Adapter::features`](super::Adapter::features).
    pub features: Vec<f32>,
    /// Number of people; absent without a label.
    pub label: Option<Occupancy>,
}

/// Recording of the room.
#[derive(Debug, Clone)]
pub struct AdaptRecording {
    /// Time from frame to frame, s.
    pub frame_interval_s: f64,
    /// Frames in the order of time.
    pub frames: Vec<AdaptFrame>,
}

impl AdaptRecording {
    /// Labelled seconds of empty, one and two. A frame counts for the frame interval, 1 s at most. The time since the frame before it
    /// may be longer: that of frames that are missing or have no features.
    pub fn seconds(&self) -> [f64; CLASSES] {
        let frame_s = self.frame_interval_s.min(INDEPENDENT_S);
        std::array::from_fn(|class| {
            let labelled = self.frames.iter().filter(|frame| frame.label.map(Occupancy::index) == Some(class));
            labelled.count() as f64 * frame_s
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Regression test: the frame behind a second without features counted for this second, and weighed as much in the fit.
    #[test]
    fn only_frames_with_features_count() {
        let frame = |index: u32| AdaptFrame {
            time_s: 0.1 * f64::from(index),
            features: Vec::new(),
            label: Some(if index < 30 { Occupancy::One } else { Occupancy::Empty }),
        };
        let frames = (0..60).filter(|index| !(20..40).contains(index)).map(frame).collect();
        let seconds = AdaptRecording { frame_interval_s: 0.1, frames }.seconds();
        assert!((seconds[0] - 2.0).abs() < 1e-9 && (seconds[1] - 2.0).abs() < 1e-9 && seconds[2] == 0.0, "{seconds:?}");
        let slow = AdaptRecording { frame_interval_s: 3.0, frames: vec![frame(0), frame(30)] };
        assert_eq!(slow.seconds(), [1.0, 1.0, 0.0]);
    }

    #[test]
    fn classes_with_few_seconds_are_not_learnable() {
        for (seconds, expected) in [
            ([60.0, 60.0, 60.0], [true; 3]),
            ([0.0, 60.0, 60.0], [false, true, true]),
            ([2.0, 2.0, 11.0], [true, false, true]),
            ([3.0, 3.0, 11.0], [true; 3]),
            ([600.0, 9.0, 10.0], [true, false, true]),
            ([0.0; 3], [false; 3]),
        ] {
            assert_eq!(learnable_classes(seconds), expected, "{seconds:?}");
        }
    }
}
