//! Why the source of an emulated board failed: no board can say it, so it goes past the board.

use std::sync::Arc;

use radome_dsp::{Frame, FrameSource, SourceError, SourceEvent, Waveform};

use super::Shared;

/// A source whose failure is kept for who asks the board. To the board it is the source's end.
pub(super) struct Watched {
    source: Box<dyn FrameSource>,
    shared: Arc<Shared>,
}

impl Watched {
    pub fn new(source: Box<dyn FrameSource>, shared: &Arc<Shared>) -> Self {
        Watched { source, shared: shared.clone() }
    }
}

impl FrameSource for Watched {
    fn waveform(&self) -> &Waveform {
        self.source.waveform()
    }

    fn next_frame(&mut self, frame: &mut Frame) -> Result<SourceEvent, SourceError> {
        self.source.next_frame(frame).or_else(|error| {
            self.shared.fail(error);
            Ok(SourceEvent::End)
        })
    }

    fn frame_count(&self) -> Option<u64> {
        self.source.frame_count()
    }
}

impl Drop for Watched {
    /// The source's thread unwinds: its source has panicked.
    fn drop(&mut self) {
        if std::thread::panicking() {
            self.shared.fail("the source of the emulated board panicked".into());
        }
    }
}
