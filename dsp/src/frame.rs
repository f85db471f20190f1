//! A frame of raw codes, and where frames come from.

use ndarray::ArrayView3;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::Waveform;

/// Largest code of the 12-bit ADC.
pub const MAX_CODE: u16 = 4095;

/// Receivers, chirps and samples of a frame: the lengths of its axes, in order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct FrameShape {
    /// Receive channels.
    pub rx: usize,
    /// Chirps.
    pub chirps: usize,
    /// Samples of a chirp.
    pub samples: usize,
}

impl FrameShape {
    /// Codes in a frame.
    pub fn codes(self) -> usize {
        self.rx * self.chirps * self.samples
    }
}

impl std::fmt::Display for FrameShape {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} rx x {} chirps x {} samples", self.rx, self.chirps, self.samples)
    }
}

/// How many people a room holds, as far as this program distinguishes: nobody, one, or two or more. The class of a map.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Occupancy {
    /// Nobody.
    Empty,
    /// One person.
    One,
    /// Two people or more.
    Two,
}

impl Occupancy {
    /// All classes, in the order of their index.
    pub const ALL: [Occupancy; 3] = [Occupancy::Empty, Occupancy::One, Occupancy::Two];

    /// Index of the class: the number of people, or 2 if there are more.
    pub fn index(self) -> usize {
        self as usize
    }

    /// Class with this index.
    pub fn from_index(index: usize) -> Option<Self> {
        Self::ALL.get(index).copied()
    }

    /// Name as files and answers spell it.
    pub fn name(self) -> &'static str {
        match self {
            Occupancy::Empty => "empty",
            Occupancy::One => "one",
            Occupancy::Two => "two",
        }
    }

    /// The class with this name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|o| o.name() == name)
    }
}

impl std::fmt::Display for Occupancy {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

/// What is known to be true of a frame, from a simulator or from someone who labelled it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Truth {
    /// A person counts while any part of them is in the room, seen or not.
    pub occupancy: Occupancy,
    /// Someone is entering or leaving (partly in the room) during this frame.
    pub transition: bool,
}

/// Reason why the codes of a receiver cannot be relied on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Error)]
pub enum ReceiverFault {
    /// All codes of a frame are the same: it gives no signal.
    #[error("all of its samples are the same")]
    Constant,
    /// At least half of the codes of a frame lie at the ends of the ADC: it gives no signal.
    #[error("half or more of its samples lie at the ends of the ADC")]
    Saturated,
    /// At least a hundredth of the codes of a frame lie at the ends of the ADC: strong echoes are distorted.
    #[error("a hundredth or more of its samples lie at the ends of the ADC, which distorts strong echoes")]
    Clipped,
}

impl ReceiverFault {
    /// Whether the receiver gives no signal at all.
    pub fn is_dead(self) -> bool {
        self != ReceiverFault::Clipped
    }
}

/// One frame of raw 12-bit codes. Raw codes are the master copy of all data.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Frame {
    /// Frames since the acquisition started, lost ones counted too.
    pub sequence: u64,
    /// Time of the first chirp since the acquisition started, by the source's own clock, ns.
    pub time_ns: u64,
    /// Wall-clock time at which the host had the frame, ns since 1970; 0 where nobody knows.
    pub host_time_ns: u64,
    /// Lengths of the axes of `codes`.
    pub shape: FrameShape,
    /// Codes 0..=4095, `[rx][chirp][sample]`.
    pub codes: Vec<u16>,
    /// What is known to be true of it.
    pub truth: Option<Truth>,
    /// Chip temperature where the source gives one, degrees Celsius in thousandths.
    pub temperature_millicelsius: Option<i32>,
}

impl Frame {
    /// An all-zero frame: something to read into.
    pub fn zeroed(shape: FrameShape) -> Self {
        Frame {
            sequence: 0,
            time_ns: 0,
            host_time_ns: 0,
            shape,
            codes: vec![0; shape.codes()],
            truth: None,
            temperature_millicelsius: None,
        }
    }

    /// Codes of one chirp.
    ///
    /// # Panics
    /// If the indices exceed the shape, as slices do.
    pub fn chirp(&self, rx: usize, chirp: usize) -> &[u16] {
        let start = (rx * self.shape.chirps + chirp) * self.shape.samples;
        &self.codes[start..start + self.shape.samples]
    }

    /// The codes as an array `[rx][chirp][sample]`; `None` if their number disagrees with the shape.
    pub fn view(&self) -> Option<ArrayView3<'_, u16>> {
        ArrayView3::from_shape((self.shape.rx, self.shape.chirps, self.shape.samples), &self.codes).ok()
    }

    /// Fault of the receive channel with this index, 0-based, by its codes in this frame alone; `None` if they are as they should
    /// be, or if there is no such channel.
    pub fn receiver_fault(&self, rx: usize) -> Option<ReceiverFault> {
        let length = self.shape.chirps * self.shape.samples;
        let codes = self.codes.chunks_exact(length.max(1)).nth(rx)?;
        let at_ends = codes.iter().filter(|code| **code == 0 || **code >= MAX_CODE).count();
        if codes.iter().all(|code| Some(code) == codes.first()) {
            Some(ReceiverFault::Constant)
        } else if 2 * at_ends >= codes.len() {
            Some(ReceiverFault::Saturated)
        } else if 100 * at_ends >= codes.len() {
            Some(ReceiverFault::Clipped)
        } else {
            None
        }
    }

    /// Whether the receive channel with this index gives no signal in this frame.
    pub fn is_receiver_dead(&self, rx: usize) -> bool {
        self.receiver_fault(rx).is_some_and(ReceiverFault::is_dead)
    }

    /// Seconds since the acquisition started.
    pub fn time_s(&self) -> f64 {
        self.time_ns as f64 * 1e-9
    }
}

/// Why frames are missing.
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
    /// The board was unplugged, stalled or restarted. Where its own clock or count has not run on, the host's clock says how
    /// many frames were lost: one more or less may be the truth, and so the numbers of the frames that follow.
    Disconnected,
    /// The recording itself lacks them.
    Recorded,
}

impl GapReason {
    /// Name as files and answers spell it.
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

/// A hole in a stream of frames. No frame is ever assembled across one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Gap {
    /// Sequence number of the first frame lost.
    pub first_sequence: u64,
    /// Frames lost; 0 if unknown.
    pub frames: u64,
    /// Why.
    pub reason: GapReason,
}

/// What a source hands out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SourceEvent {
    /// The frame passed in has been filled.
    Frame,
    /// Frames are missing here; the frame passed in is untouched.
    Gap(Gap),
    /// No more frames.
    End,
}

/// Errors of sources are their own; a consumer can show them and see whether to give up.
pub type SourceError = Box<dyn std::error::Error + Send + Sync>;

/// Where frames come from: a board, a recording, a simulator. The one thing that `driver` and `sim` share.
pub trait FrameSource: Send {
    /// Waveform of every frame of this source.
    fn waveform(&self) -> &Waveform;

    /// Fills `frame` (reusing its memory) with the next one, waiting for it if need be.
    fn next_frame(&mut self, frame: &mut Frame) -> Result<SourceEvent, SourceError>;

    /// Frames in total, where the source knows.
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

#[cfg(test)]
mod tests {
    use super::*;

    /// Fault of a receiver with these codes, beside one that is as it should be.
    fn fault(code: impl Fn(usize) -> u16) -> Option<ReceiverFault> {
        let mut frame = Frame::zeroed(FrameShape { rx: 2, chirps: 10, samples: 20 });
        for (index, value) in frame.codes.iter_mut().enumerate() {
            *value = if index < 200 { 2000 + index as u16 % 7 } else { code(index - 200) };
        }
        assert_eq!((frame.receiver_fault(0), frame.receiver_fault(2)), (None, None));
        assert_eq!(frame.is_receiver_dead(1), frame.receiver_fault(1).is_some_and(ReceiverFault::is_dead));
        frame.receiver_fault(1)
    }

    #[test]
    fn faults_of_a_receiver_are_told_apart() {
        let wave = |index: usize| 1500 + index as u16;
        assert_eq!(fault(wave), None);
        assert_eq!(fault(|_| 2048), Some(ReceiverFault::Constant));
        assert_eq!(fault(|_| 0), Some(ReceiverFault::Constant));
        assert_eq!(fault(|index| if index % 2 == 0 { 0 } else { MAX_CODE }), Some(ReceiverFault::Saturated));
        assert_eq!(fault(|index| if index < 100 { MAX_CODE } else { wave(index) }), Some(ReceiverFault::Saturated));
        assert_eq!(fault(|index| if index < 99 { MAX_CODE } else { wave(index) }), Some(ReceiverFault::Clipped));
        assert_eq!(fault(|index| if index < 2 { 0 } else { wave(index) }), Some(ReceiverFault::Clipped));
        assert_eq!(fault(|index| if index < 1 { 0 } else { wave(index) }), None);
    }

    #[test]
    fn a_frame_without_codes_has_no_fault() {
        let shape = FrameShape { rx: 1, chirps: 0, samples: 0 };
        assert_eq!(Frame::zeroed(shape).receiver_fault(0), None);
    }
}
