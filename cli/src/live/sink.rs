//! Destinations of answers: the terminal, the page, the integrations and a recording.

use std::sync::Arc;

use radome_dsp::{Frame, Gap, Rdm};

use super::answer::{Answer, Summary};
use super::health::Health;

/// Classified frame with its map, answer and counters.
pub struct ClassifiedFrame<'a> {
    pub answer: &'a Answer,
    /// The frame. A sink that keeps it takes it from the pool, which then grows by one.
    pub frame: &'a Arc<Frame>,
    /// Map of the frame. It is meaningless while the answer warms up.
    pub map: &'a Rdm,
    pub health: &'a Health,
}

/// Consumer of answers in their order, on the classifier's thread. Work that may wait for a network or a user needs a
/// thread of its own. An error ends the run.
pub trait Sink {
    /// Receives the answer to a frame.
    ///
    /// # Errors
    /// The answer cannot be passed on.
    fn answer(&mut self, classified: &ClassifiedFrame) -> anyhow::Result<()>;

    /// Receives a gap: frames are missing at this position.
    ///
    /// # Errors
    /// The gap cannot be passed on.
    fn gap(&mut self, gap: &Gap, health: &Health) -> anyhow::Result<()>;

    /// Receives the summary when the run is over, however it ended.
    ///
    /// # Errors
    /// The summary cannot be passed on, or earlier answers were lost.
    fn end(&mut self, _summary: &Summary) -> anyhow::Result<()> {
        Ok(())
    }
}
