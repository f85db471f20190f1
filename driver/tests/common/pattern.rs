//! Source of known frames, random numbers, and recordings as another program writes them. Each test binary uses a part of this
//! module.

#![allow(dead_code)]

use std::collections::BTreeMap;
use std::io::Cursor;

use mcap::WriteOptions;
use mcap::records::MessageHeader;
use radome_dsp::{
    Frame, FrameSource, Gap, RxMask, SourceError, SourceEvent, Truth, Waveform, WaveformRequest, split_mix_64,
};

/// Random number generator: splitmix64.
#[derive(Debug, Clone)]
pub struct Random(pub u64);

impl Random {
    /// Next number.
    pub fn next(&mut self) -> u64 {
        let number = split_mix_64(self.0);
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        number
    }

    /// Number below `end`.
    pub fn below(&mut self, end: u64) -> u64 {
        self.next() % end.max(1)
    }

    /// One of some values.
    pub fn one_of<T: Copy>(&mut self, values: &[T]) -> T {
        values[self.below(values.len() as u64) as usize]
    }
}

/// Source of frames whose codes are a function of frame, receiver, chirp and sample.
pub struct Pattern {
    pub waveform: Waveform,
    pub frames: u64,
    pub next: u64,
    /// Gap to report before the frame that follows it.
    pub gap: Option<Gap>,
    /// Truth of every frame.
    pub truth: Option<Truth>,
}

impl Pattern {
    pub fn new(waveform: Waveform, frames: u64) -> Self {
        Pattern { waveform, frames, next: 0, gap: None, truth: None }
    }

    /// Makes the frame with this number.
    pub fn fill(&self, sequence: u64, frame: &mut Frame) {
        frame.shape = self.waveform.shape();
        frame.codes.resize(frame.shape.codes(), 0);
        for (i, code) in frame.codes.iter_mut().enumerate() {
            *code = ((i as u64).wrapping_mul(2_654_435_761).wrapping_add(sequence * 977) >> 5 & 0xFFF) as u16;
        }
        frame.sequence = sequence;
        frame.time_ns = self.waveform.frame_time_ns(sequence);
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

/// Waveform with this shape and a frame every `frame_interval_s`.
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

/// Waveform of the captured session.
pub fn captured_waveform() -> Waveform {
    Waveform::realise(WaveformRequest {
        start_frequency_hz: 58e9,
        end_frequency_hz: 63e9,
        samples_per_chirp: 64,
        chirps_per_frame: 64,
        sample_rate_hz: 2e6,
        chirp_interval_s: 591.125e-6,
        frame_interval_s: 0.0772688,
        if_gain_db: 23.0,
        high_pass_cutoff_hz: 80e3,
        ..WaveformRequest::paper()
    })
    .expect("valid")
}

/// Reads this number of frames of a board that measures a [`Pattern`]. Asserts that each is a whole frame of the
/// pattern, later than the one before, and that sequence numbers have no holes other than the gaps. Returns the gaps.
pub fn read_frames(stream: &mut dyn FrameSource, frames: usize, check: impl Fn(&Frame)) -> Vec<Gap> {
    let pattern = Pattern::new(stream.waveform().clone(), 0);
    let mut frame = Frame::zeroed(pattern.waveform.shape());
    let mut expected = frame.clone();
    let (mut received, mut next_sequence, mut next_of_source, mut gaps) = (0, 0, 0, Vec::new());
    while received < frames {
        match stream.next_frame(&mut frame).expect("stream") {
            SourceEvent::Frame => {
                let found = (next_of_source..next_of_source + 5000).find(|sequence| {
                    pattern.fill(*sequence, &mut expected);
                    expected.codes == frame.codes
                });
                next_of_source = found.expect("a frame of the source") + 1;
                assert_eq!(frame.sequence, next_sequence);
                check(&frame);
                next_sequence += 1;
                received += 1;
            }
            SourceEvent::Gap(gap) => {
                assert!(gap.first_sequence == next_sequence && gap.frames > 0, "{gap:?}");
                next_sequence += gap.frames;
                gaps.push(gap);
            }
            SourceEvent::End => panic!("a board does not end"),
        }
    }
    gaps
}

/// Writes the messages of a recording again, each in a chunk of its own if there are chunks. A channel is named where it is
/// first used, as by MCAP's library for Python.
pub fn rewritten(recording: &[u8], options: WriteOptions) -> Vec<u8> {
    let summary = mcap::Summary::read(recording).expect("reads").expect("a summary");
    let mut writer = options.create(Cursor::new(Vec::new())).expect("starts");
    let metadata = mcap::read::metadata(recording, &summary.metadata_indexes[0]).expect("metadata");
    writer.write_metadata(&metadata).expect("writes");
    for message in mcap::MessageStream::new(recording).expect("opens") {
        let message = message.expect("reads");
        let (topic, encoding) = (&message.channel.topic, &message.channel.message_encoding);
        let channel_id = writer.add_channel(0, topic, encoding, &BTreeMap::new()).expect("writes");
        let (log_time, publish_time) = (message.log_time, message.publish_time);
        let header = MessageHeader { channel_id, sequence: message.sequence, log_time, publish_time };
        writer.write_to_known_channel(&header, &message.data).expect("writes");
        writer.flush().expect("writes");
    }
    writer.finish().expect("finishes");
    writer.into_inner().into_inner()
}
