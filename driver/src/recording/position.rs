//! Positions of frames in recordings, and the search for them.

/// Position of a frame in its recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Position {
    /// Sequence number of the frame.
    pub sequence: u64,
    /// Time on the frames' own clock, ns.
    pub time_ns: u64,
}

impl Position {
    /// Time on the frames' own clock, s.
    pub fn time_s(self) -> f64 {
        self.time_ns as f64 * 1e-9
    }
}

/// First and last frame of a recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Extent {
    /// First frame.
    pub first: Position,
    /// Last frame.
    pub last: Position,
}

/// Converts a time to nanoseconds; 0 if it is negative or not a number.
pub(super) fn time_ns(time_s: f64) -> u64 {
    (time_s * 1e9).round() as u64
}

/// Finds by bisection the first of `count` indices for which `holds` is true; `count` if there is none. It must hold
/// for all indices behind one for which it holds.
pub(super) fn first_index(count: u64, mut holds: impl FnMut(u64) -> bool) -> u64 {
    let (mut low, mut high) = (0, count);
    while low < high {
        let middle = low + (high - low) / 2;
        if holds(middle) {
            high = middle;
        } else {
            low = middle + 1;
        }
    }
    low
}
