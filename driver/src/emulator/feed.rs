//! Feed of an emulated board: a source of frames, and a way to restart it or to make it in another waveform.

use std::time::Duration;

use radome_dsp::{FrameSource, SourceError, Waveform};

type Made = Result<Box<dyn FrameSource>, SourceError>;
type MakeWaveform = Box<dyn FnMut(&Waveform, Duration) -> Made + Send>;

/// The frames of an emulated board. Any boxed [`FrameSource`] is one, with frames of its own waveform until it ends.
pub struct Feed {
    pub(super) source: Box<dyn FrameSource>,
    pub(super) maker: Maker,
}

/// Way to make more sources like the first.
pub(super) enum Maker {
    /// There is only the first.
    None,
    /// Opens the same frames again.
    Again(Box<dyn FnMut() -> Made + Send>),
    /// Makes frames of a waveform, the first of them at this time of the source or at the next frame after it.
    Waveforms(MakeWaveform),
}

impl Feed {
    /// Frames that can be opened again, such as a recording's: with
    /// [`repeat`](super::EmulatorOptions::repeat) they are, each time that they end.
    pub fn that_begins_again(source: Box<dyn FrameSource>, open: impl FnMut() -> Made + Send + 'static) -> Self {
        Feed { source, maker: Maker::Again(Box::new(open)) }
    }

    /// Frames that can be made in any waveform, such as a simulation's. `source` has those of the waveform that the board
    /// is left with; `make` is called, on a thread of its own, when a client programs another one. It is given the time
    /// at which the first frame is to begin.
    pub fn of_any_waveform(
        source: Box<dyn FrameSource>,
        make: impl FnMut(&Waveform, Duration) -> Made + Send + 'static,
    ) -> Self {
        Feed { source, maker: Maker::Waveforms(Box::new(make)) }
    }
}

impl<S: FrameSource + ?Sized + 'static> From<Box<S>> for Feed {
    fn from(source: Box<S>) -> Self {
        Feed { source: Box::new(source), maker: Maker::None }
    }
}
