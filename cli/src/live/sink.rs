//! Destinations of answers: the terminal, the page, the integrations, a recording.

use std::sync::Arc;

use radome_dsp::{Frame, Gap, Rdm};

use super::answer::{Answer, Summary};
use super::health::Health;

/// A frame that has been judged, and everything that is known then.
pub struct Moment<'a> {
    pub answer: &'a Answer,
    /// The frame; a sink that keeps it longer takes it out of the pool, which then grows by one.
    pub frame: &'a Arc<Frame>,
    /// Its map; what it shows means nothing while the answer warms up.
    pub map: &'a Rdm,
    pub health: &'a Health,
}

/// Takes answers in their order, on the classifier's thread: what may wait for a network or a person does so on a thread of
/// its own. An error ends the run.
pub trait Sink {
    /// A frame has been judged.
    ///
    /// # Errors
    /// The answer cannot be passed on.
    fn answer(&mut self, moment: &Moment) -> anyhow::Result<()>;

    /// Frames are missing here.
    ///
    /// # Errors
    /// The gap cannot be passed on.
    fn gap(&mut self, gap: &Gap, health: &Health) -> anyhow::Result<()>;

    /// The run is over, however it ended.
    ///
    /// # Errors
    /// The summary cannot be passed on, or earlier answers were lost.
    fn end(&mut self, summary: &Summary) -> anyhow::Result<()> {
        let _ = summary;
        Ok(())
    }
}
