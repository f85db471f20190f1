//! Answers of the last minutes, for the timeline of pages.

use std::collections::VecDeque;

use serde_json::json;

use crate::live::answer::{Answer, Probabilities};

/// Number of answers that a page gets when it opens: ten minutes of the paper's frames.
pub const HISTORY: usize = 6_000;

/// Answer to one frame, for the timeline.
#[derive(Debug, Clone, Copy)]
pub struct Point {
    sequence: u64,
    time_s: f64,
    probabilities: Option<Probabilities>,
    label: Option<usize>,
    occupied: bool,
    truth: Option<(usize, bool)>,
    /// Whether frames are missing before it.
    pub after_gap: bool,
}

impl Point {
    /// Takes the values of an answer that no gap precedes.
    pub fn of(answer: &Answer) -> Self {
        Point {
            sequence: answer.sequence,
            time_s: answer.time_s,
            probabilities: answer.probabilities,
            label: answer.label.map(|label| label.index()),
            occupied: answer.occupied,
            truth: answer.truth.map(|truth| (truth.index(), answer.transition == Some(true))),
            after_gap: false,
        }
    }

    /// Returns the values in the order of the arguments of `History.add` in `timeline.js`.
    fn row(&self) -> serde_json::Value {
        let p = self.probabilities.map(|p| p.values().map(|v| (v * 1e3).round() / 1e3));
        json!([
            self.sequence,
            (self.time_s * 1e6).round() / 1e6,
            p,
            self.label,
            u8::from(self.occupied),
            self.truth.map(|(class, _)| class),
            u8::from(self.truth.is_some_and(|(_, transition)| transition)),
            u8::from(self.after_gap),
        ])
    }
}

/// The newest answers in order, at most [`HISTORY`].
pub struct History(VecDeque<Point>);

impl Default for History {
    /// Creates an empty history of full capacity, so that answers are added without allocation, under a lock.
    fn default() -> Self {
        History(VecDeque::with_capacity(HISTORY))
    }
}

impl History {
    /// Adds an answer, and removes the oldest if there are too many.
    pub fn push(&mut self, point: Point) {
        if self.0.len() == HISTORY {
            self.0.pop_front();
        }
        self.0.push_back(point);
    }

    /// Moves all answers of `newer` to the end. Returns their number.
    pub fn append(&mut self, newer: &mut History) -> u64 {
        let count = newer.0.len() as u64;
        newer.0.drain(..).for_each(|point| self.push(point));
        count
    }

    /// Returns the rows of the newest `count` answers, or of all if there are fewer.
    pub fn newest_rows(&self, count: u64) -> Vec<serde_json::Value> {
        let older = (self.0.len() as u64).saturating_sub(count) as usize;
        self.0.iter().skip(older).map(Point::row).collect()
    }
}
