//! Feed of an emulated board: a source of frames, and a way to open it again or to make frames of another waveform.

use std::time::Duration;

use radome_dsp::{FrameSource, SourceError, Waveform};

type SourceResult = Result<Box<dyn FrameSource>, SourceError>;
type MakeWaveform = Box<dyn FnMut(&Waveform, Duration) -> SourceResult + Send>;

/// Frames for an emulated board. Any boxed [`FrameSource`] converts into one, with frames of its own waveform until it
/// ends.
pub struct Feed {
    pub(super) source: Box<dyn FrameSource>,
    pub(super) maker: Maker,
}

/// Method of making more sources like the first.
pub(super) enum Maker {
    /// No further source can be made.
    None,
    /// Opens the same frames again.
    Reopen(Box<dyn FnMut() -> SourceResult + Send>),
    /// Makes frames of a waveform, the first of them at this time of the source or at the next frame after it.
    Waveforms(MakeWaveform),
}

impl Feed {
    /// Creates a feed whose source can be opened again, such as a recording. With
    /// [`repeat`](super::EmulatorOptions::repeat) the source is opened again each time that it ends.
    pub fn reopenable(source: Box<dyn FrameSource>, open: impl FnMut() -> SourceResult + Send + 'static) -> Self {
        Feed { source, maker: Maker::Reopen(Box::new(open)) }
    }

    /// Creates a feed whose frames can be made for any waveform, such as a simulation's. `source` has frames of the
    /// waveform that the board is programmed with at the start. `make` is called on a thread of its own when a client
    /// programs another waveform. It is given the time at which the first frame has to begin.
    pub fn of_any_waveform(
        source: Box<dyn FrameSource>,
        make: impl FnMut(&Waveform, Duration) -> SourceResult + Send + 'static,
    ) -> Self {
        Feed { source, maker: Maker::Waveforms(Box::new(make)) }
    }
}

impl<S: FrameSource + ?Sized + 'static> From<Box<S>> for Feed {
    fn from(source: Box<S>) -> Self {
        Feed { source: Box::new(source), maker: Maker::None }
    }
}
