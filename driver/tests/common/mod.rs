//! A source of known frames. Each test binary uses a part.

#![allow(dead_code)]

use radome_dsp::{Frame, FrameSource, Gap, RxMask, SourceError, SourceEvent, Truth, Waveform, WaveformRequest};

/// Frames in which every code follows from frame, receiver, chirp and sample.
pub struct Pattern {
    pub waveform: Waveform,
    pub frames: u64,
    pub next: u64,
    /// A gap to report before the frame that follows it.
    pub gap: Option<Gap>,
    pub truth: Option<Truth>,
}

impl Pattern {
    pub fn new(waveform: Waveform, frames: u64) -> Self {
        Pattern { waveform, frames, next: 0, gap: None, truth: None }
    }

    pub fn fill(&self, sequence: u64, frame: &mut Frame) {
        frame.shape = self.waveform.shape();
        frame.codes.resize(frame.shape.codes(), 0);
        for (i, code) in frame.codes.iter_mut().enumerate() {
            *code = ((i as u64).wrapping_mul(2_654_435_761).wrapping_add(sequence * 977) >> 5 & 0xFFF) as u16;
        }
        frame.sequence = sequence;
        frame.time_ns = (sequence as f64 * self.waveform.frame_interval_s() * 1e9).round() as u64;
        frame.host_time_ns = 0;
        frame.truth = self.truth;
        frame.temperature_millicelsius = None;
    }
}

impl FrameSource for Pattern {
    fn waveform(&self) -> &Waveform {
        &self.waveform
    }

    fn next_frame(&mut self, frame: &mut Frame) -> Result<SourceEvent, SourceError> {
        if self.next >= self.frames {
            return Ok(SourceEvent::End);
        }
        if let Some(gap) = self.gap
            && gap.first_sequence == self.next
        {
            self.next += gap.frames;
            self.gap = None;
            return Ok(SourceEvent::Gap(gap));
        }
        self.fill(self.next, frame);
        self.next += 1;
        Ok(SourceEvent::Frame)
    }

    fn frame_count(&self) -> Option<u64> {
        Some(self.frames)
    }
}

/// A waveform with this shape; a frame every `frame_interval_s`.
pub fn waveform(antennas: &[u8], chirps: usize, samples: usize, frame_interval_s: f64) -> Waveform {
    Waveform::realise(WaveformRequest {
        rx_antennas: RxMask::from_antennas(antennas).expect("antennas"),
        chirps_per_frame: chirps,
        samples_per_chirp: samples,
        frame_interval_s,
        ..WaveformRequest::paper()
    })
    .expect("valid")
}
