//! Frames of raw codes, with their time and ground truth.

use ndarray::ArrayView3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use thiserror::Error;

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

/// Class of a frame: nobody in the room, one person, or two people or more.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema)]
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

    /// Class with this index; `None` above 2.
    pub fn from_index(index: usize) -> Option<Self> {
        Self::ALL.get(index).copied()
    }

    /// Name in files and answers.
    pub fn name(self) -> &'static str {
        match self {
            Occupancy::Empty => "empty",
            Occupancy::One => "one",
            Occupancy::Two => "two",
        }
    }

    /// Class with this name; `None` if there is none.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|o| o.name() == name)
    }
}

impl std::fmt::Display for Occupancy {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

/// Ground truth of a frame, from a simulator or from a person who labelled it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Truth {
    /// People in the room. A person counts while any part of the body is in the room, visible to the radar or not.
    pub occupancy: Occupancy,
    /// Whether a person enters or leaves during this frame, and so is partly in the room.
    pub transition: bool,
}

/// Reason why the codes of a receiver cannot be relied on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Error)]
pub enum ReceiverFault {
    /// All codes of a frame are the same: it gives no signal.
    #[error("all of its samples are the same")]
    Constant,
    /// At least half of the codes of a frame lie at the ends of the ADC's range: it gives no signal.
    #[error("half or more of its samples lie at the ends of the ADC")]
    Saturated,
    /// At least a hundredth of the codes of a frame lie at the ends of the ADC's range: strong echoes are distorted.
    #[error("a hundredth or more of its samples lie at the ends of the ADC, which distorts strong echoes")]
    Clipped,
}

impl ReceiverFault {
    /// Returns whether the receiver gives no signal at all.
    pub fn is_dead(self) -> bool {
        self != ReceiverFault::Clipped
    }
}

/// One frame of raw 12-bit codes, the master copy of all data.
///
/// ```
/// use radome_dsp::{Frame, FrameShape};
///
/// let mut frame = Frame::zeroed(FrameShape { rx: 3, chirps: 2, samples: 4 });
/// frame.codes.copy_from_slice(&(0..24).collect::<Vec<u16>>());
/// assert_eq!(frame.chirp(1, 0), [8, 9, 10, 11]);
/// let codes = frame.view().expect("as many codes as the shape says");
/// assert_eq!(codes[[1, 0, 3]], 11);
/// ```
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Frame {
    /// Frames since the acquisition started, lost ones counted too.
    pub sequence: u64,
    /// Time of the first chirp since the acquisition started, by the source's own clock, ns.
    pub time_ns: u64,
    /// Wall-clock time at which the host received the frame, ns since 1970; 0 where it is unknown.
    pub host_time_ns: u64,
    /// Lengths of the axes of `codes`.
    pub shape: FrameShape,
    /// Codes 0..=4095, `[rx][chirp][sample]`.
    pub codes: Vec<u16>,
    /// Ground truth, where it is known.
    pub truth: Option<Truth>,
    /// Chip temperature in thousandths of a degree Celsius, where the source reports it.
    pub temperature_millicelsius: Option<i32>,
}

impl Frame {
    /// Creates a frame of zeros, a buffer for [`FrameSource::next_frame`](crate::FrameSource::next_frame).
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

    /// Codes of one chirp, `[sample]`.
    ///
    /// # Panics
    /// If an index is out of the shape, or if `codes` is shorter than the shape says.
    pub fn chirp(&self, rx: usize, chirp: usize) -> &[u16] {
        let start = (rx * self.shape.chirps + chirp) * self.shape.samples;
        &self.codes[start..start + self.shape.samples]
    }

    /// Number of codes of all receivers that are 0, or [`MAX_CODE`] or above (the chip cannot send more).
    pub fn saturated_samples(&self) -> u32 {
        // One comparison for both ends: 0 wraps to the largest number.
        self.codes.iter().map(|code| u32::from(code.wrapping_sub(1) >= MAX_CODE - 1)).sum()
    }

    /// View of the codes as an array `[rx][chirp][sample]`; `None` if their number disagrees with the shape.
    pub fn view(&self) -> Option<ArrayView3<'_, u16>> {
        ArrayView3::from_shape((self.shape.rx, self.shape.chirps, self.shape.samples), &self.codes).ok()
    }

    /// Fault of the receive channel with this 0-based index, judged by its codes in this frame alone; `None` if it has no fault,
    /// or if there is no such channel.
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

    /// Returns whether the receive channel with this index gives no signal in this frame.
    pub fn is_receiver_dead(&self, rx: usize) -> bool {
        self.receiver_fault(rx).is_some_and(ReceiverFault::is_dead)
    }

    /// Seconds since the acquisition started.
    pub fn time_s(&self) -> f64 {
        self.time_ns as f64 * 1e-9
    }
}

/// Error for a frame that does not fit the waveform of a processor, a detector or a counter.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[allow(missing_docs, reason = "the message says what each field is")]
pub enum FrameMismatch {
    /// The shape of the frame is not that of the waveform.
    #[error("frame {sequence} is {got}, expected {expected}: is this from another waveform?")]
    Shape { sequence: u64, expected: FrameShape, got: FrameShape },
    /// The frame has fewer or more samples than the shape says.
    #[error("frame {sequence} holds {got} samples, expected {expected}")]
    Length { sequence: u64, expected: usize, got: usize },
}

impl FrameMismatch {
    /// Checks that a frame has this shape and the number of codes of the shape.
    pub(crate) fn check(frame: &Frame, expected: FrameShape) -> Result<(), Self> {
        if frame.shape != expected {
            return Err(Self::Shape { sequence: frame.sequence, expected, got: frame.shape });
        }
        Self::check_length(frame.sequence, frame.codes.len(), expected)
    }

    /// Checks that `got` is the number of samples of a frame of this shape.
    pub(crate) fn check_length(sequence: u64, got: usize, shape: FrameShape) -> Result<(), Self> {
        let expected = shape.codes();
        if got == expected { Ok(()) } else { Err(Self::Length { sequence, expected, got }) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Fault of the second receiver with these codes; the first receiver has no fault.
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
    fn faults_of_a_receiver_are_distinguished() {
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
