//! Sources of frames: the interface that boards, recordings and simulations share.

use serde::{Deserialize, Serialize};

use crate::{Frame, Waveform};

/// Reason why frames are missing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GapReason {
    /// The chip's FIFO overflowed: the host or the board was too slow.
    FifoOverflow,
    /// Packets are missing by their counter.
    PacketLost,
    /// A packet arrived damaged.
    Crc,
    /// A consumer's queue was full.
    QueueFull,
    /// The board was unplugged, stalled or restarted. If its own clock and counter restarted too, the number of lost frames is
    /// computed from the host's clock. That number, and with it the sequence numbers that follow, may be off by one.
    Disconnected,
    /// The recording does not contain them.
    Recorded,
}

impl GapReason {
    /// Name in files and answers.
    pub fn name(self) -> &'static str {
        match self {
            GapReason::FifoOverflow => "fifo_overflow",
            GapReason::PacketLost => "packet_lost",
            GapReason::Crc => "crc",
            GapReason::QueueFull => "queue_full",
            GapReason::Disconnected => "disconnected",
            GapReason::Recorded => "recorded",
        }
    }
}

/// Run of missing frames in a stream. No frame is assembled from samples on both sides of a gap.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Gap {
    /// Sequence number of the first frame lost.
    pub first_sequence: u64,
    /// Frames lost; 0 if unknown.
    pub frames: u64,
    /// Reason.
    pub reason: GapReason,
}

/// Result of asking a source for the next frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SourceEvent {
    /// The frame passed in has been filled.
    Frame,
    /// Frames are missing here; the frame passed in is unchanged.
    Gap(Gap),
    /// No more frames.
    End,
}

/// Error of a source. Each source has its own type; a consumer can show it or downcast it.
pub type SourceError = Box<dyn std::error::Error + Send + Sync>;

/// Source of frames of one waveform: a board, a recording or a simulation.
///
/// ```
/// use radome_dsp::{Frame, FrameSource, SourceEvent, Waveform, WaveformRequest, source_from_fn};
///
/// // Two frames of silence.
/// let waveform = Waveform::realise(WaveformRequest::paper()).expect("the chip can produce it");
/// let mut frame = Frame::zeroed(waveform.shape());
/// let mut left = 2;
/// let mut source = source_from_fn(waveform, move |frame| {
///     if left == 0 {
///         return Ok(SourceEvent::End);
///     }
///     left -= 1;
///     frame.codes.fill(2048);
///     Ok(SourceEvent::Frame)
/// });
/// let mut frames = 0;
/// loop {
///     match source.next_frame(&mut frame).expect("no error") {
///         SourceEvent::Frame => frames += 1,
///         SourceEvent::Gap(gap) => eprintln!("{} frames are missing", gap.frames),
///         SourceEvent::End => break,
///     }
/// }
/// assert_eq!(frames, 2);
/// ```
pub trait FrameSource: Send {
    /// Waveform of every frame of this source.
    fn waveform(&self) -> &Waveform;

    /// Fills `frame` with the next one and reuses its memory. Blocks until there is one.
    ///
    /// # Errors
    /// If the source cannot be read, or if its data are invalid. The conditions are those of the implementation.
    fn next_frame(&mut self, frame: &mut Frame) -> Result<SourceEvent, SourceError>;

    /// Number of frames in total; `None` where the source does not know it. Of a recording that is cut, it may be the
    /// number that its header states, which is more than can be read.
    fn frame_count(&self) -> Option<u64> {
        None
    }
}

impl<S: FrameSource + ?Sized> FrameSource for Box<S> {
    fn waveform(&self) -> &Waveform {
        (**self).waveform()
    }
    fn next_frame(&mut self, frame: &mut Frame) -> Result<SourceEvent, SourceError> {
        (**self).next_frame(frame)
    }
    fn frame_count(&self) -> Option<u64> {
        (**self).frame_count()
    }
}

/// Source whose next frame or gap a function gives: see [`source_from_fn`].
struct FromFn<F> {
    waveform: Waveform,
    next: F,
}

impl<F: FnMut(&mut Frame) -> Result<SourceEvent, SourceError> + Send> FrameSource for FromFn<F> {
    fn waveform(&self) -> &Waveform {
        &self.waveform
    }
    fn next_frame(&mut self, frame: &mut Frame) -> Result<SourceEvent, SourceError> {
        (self.next)(frame)
    }
}

/// Returns a source of this waveform that calls `next` as its [`FrameSource::next_frame`].
pub fn source_from_fn(
    waveform: Waveform,
    next: impl FnMut(&mut Frame) -> Result<SourceEvent, SourceError> + Send,
) -> impl FrameSource {
    FromFn { waveform, next }
}
