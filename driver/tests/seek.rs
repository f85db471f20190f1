//! Asserts that reading after a seek gives the same events as reading from the start.

use std::path::Path;

use proptest::prelude::*;
use radome_driver::recording::{Format, Recording, RecordingWriter};
use radome_driver::{Recorder, RecordingHeader};
use radome_dsp::{Frame, FrameSource, Gap, GapReason, SourceEvent};

use crate::common::{Pattern, cases, chunks, in_folder, waveform};

#[derive(Debug, Clone, PartialEq)]
enum Event {
    Frame(Frame),
    Gap(Gap),
}

fn read_rest(source: &mut Recording) -> Vec<Event> {
    let mut frame = Frame::zeroed(source.waveform().shape());
    let mut events = Vec::new();
    loop {
        match source.next_frame(&mut frame).expect("reads") {
            SourceEvent::Frame => events.push(Event::Frame(frame.clone())),
            SourceEvent::Gap(gap) => events.push(Event::Gap(gap)),
            SourceEvent::End => return events,
        }
    }
}

/// All events after the last earlier frame.
fn after_last(events: &[Event], is_earlier: impl Fn(&Frame) -> bool) -> &[Event] {
    let last = events.iter().rposition(|e| matches!(e, Event::Frame(frame) if is_earlier(frame)));
    &events[last.map_or(0, |last| last + 1)..]
}

/// Events that [`Recording::seek_frame`] must lead to.
fn expected_from_frame(events: &[Event], sequence: u64) -> &[Event] {
    let mut found = after_last(events, |frame| frame.sequence < sequence);
    while let [Event::Gap(gap), rest @ ..] = found
        && gap.frames > 0
        && gap.first_sequence + gap.frames <= sequence
    {
        found = rest;
    }
    found
}

/// Asserts that the events after each seek are those that a reader from the start finds there.
fn check_seeks(source: &mut Recording, numbers: std::ops::Range<u64>, tenths: impl Iterator<Item = i32>) {
    let events = read_rest(source);
    for sequence in numbers.rev().chain([u64::MAX]) {
        source.seek_frame(sequence).expect("seeks");
        assert_eq!(read_rest(source), expected_from_frame(&events, sequence), "frame {sequence}");
    }
    for tenths in tenths {
        let time_s = f64::from(tenths) / 10.0;
        source.seek_time_s(time_s).expect("seeks");
        let expected = after_last(&events, |frame| frame.time_ns < (time_s.max(0.0) * 1e9).round() as u64);
        assert_eq!(read_rest(source), expected, "at {time_s} s");
    }
}

/// Number of the first frame from this one on.
fn next_from(source: &mut Recording, sequence: u64) -> u64 {
    let mut frame = Frame::zeroed(source.waveform().shape());
    source.seek_frame(sequence).expect("seeks");
    source.next_frame(&mut frame).expect("reads");
    frame.sequence
}

/// Writes a recording of several chunks without the frames that `lost` selects.
fn record(path: &Path, finish: bool, lost: impl Fn(u64) -> bool) {
    let pattern = Pattern::new(waveform(&[1], 4, 16, 0.17), 0);
    let mut recorder = Recorder::create(path, &RecordingHeader::new(pattern.waveform.clone())).expect("creates");
    let mut frame = Frame::zeroed(pattern.waveform.shape());
    let mut first_lost = None;
    for sequence in 0..90 {
        if lost(sequence) {
            first_lost.get_or_insert(sequence);
            continue;
        }
        if let Some(first_sequence) = first_lost.take() {
            let gap = Gap { first_sequence, frames: sequence - first_sequence, reason: GapReason::FifoOverflow };
            recorder.gap(&gap).expect("records");
        }
        pattern.fill(sequence, &mut frame);
        recorder.frame(&frame).expect("records");
    }
    if finish {
        recorder.finish().expect("finishes");
    }
}

proptest! {
    #![proptest_config(cases(24))]

    #[test]
    fn seeks_in_an_mcap_file_lead_anywhere(lost in prop::collection::vec(0..90u64, 0..30), finish in any::<bool>()) {
        let (_folder, path) = in_folder("a.mcap");
        record(&path, finish, |sequence| lost.contains(&sequence) || (40..55).contains(&sequence));
        check_seeks(&mut Recording::open(&path).expect("opens"), 0..95, (-3..170).step_by(3));
    }
}

#[test]
fn seeks_in_the_vendors_formats_lead_anywhere() {
    let folder = tempfile::tempdir().expect("folder");
    let pattern = Pattern::new(waveform(&[1, 2], 4, 16, 0.17), 0);
    for (name, format) in [("a", Format::Infineon), ("a.txt", Format::Text)] {
        let path = folder.path().join(name);
        let header = RecordingHeader::new(pattern.waveform.clone());
        let mut writer = RecordingWriter::create(&path, format, &header).expect("creates");
        let mut frame = Frame::zeroed(pattern.waveform.shape());
        for sequence in 0..40 {
            pattern.fill(sequence, &mut frame);
            // Times differ from the nominal ones, so that the folder must look them up.
            frame.time_ns += sequence.pow(3) * 1000;
            writer.frame(&frame).expect("writes");
        }
        writer.finish().expect("finishes");
        check_seeks(&mut Recording::open(&path).expect("opens"), 0..45, -3..80);
    }
}

/// Asserts, by the number of bytes read, that a seek to the middle reads the chunks of a bisection and not the file.
#[test]
fn a_seek_does_not_read_the_whole_file() {
    let (_folder, path) = in_folder("long.mcap");
    let pattern = Pattern::new(waveform(&[1, 2, 3], 8, 128, 1.0), 0);
    let mut recorder = Recorder::create(&path, &RecordingHeader::new(pattern.waveform.clone())).expect("creates");
    let mut frame = Frame::zeroed(pattern.waveform.shape());
    for sequence in 0..2000 {
        pattern.fill(sequence, &mut frame);
        recorder.frame(&frame).expect("records");
    }
    let bytes = recorder.finish().expect("finishes").bytes;
    // Number of bytes that this thread has read so far, according to the kernel.
    let read = || {
        let text = std::fs::read_to_string("/proc/thread-self/io").expect("a count");
        text.lines().find_map(|l| l.strip_prefix("rchar: ")?.parse::<u64>().ok()).expect("rchar")
    };
    let before = read();
    let mut source = Recording::open(&path).expect("opens");
    source.seek_frame(1234).expect("seeks");
    source.next_frame(&mut frame).expect("reads");
    let cost = read() - before;
    assert_eq!(frame.sequence, 1234);
    assert!(cost < bytes / 20, "{cost} of {bytes} bytes");
    source.seek_time_s(777.0).expect("seeks");
    source.next_frame(&mut frame).expect("reads");
    assert_eq!(frame.sequence, 777);
}

mod hard_cases {
    use super::*;

    #[test]
    fn seeks_skip_damage() {
        let (_folder, path) = in_folder("a.mcap");
        record(&path, true, |_| false);
        let mut bytes = std::fs::read(&path).expect("reads");
        let middle = bytes.len() / 2;
        bytes[middle] ^= 0x10;
        std::fs::write(&path, bytes).expect("writes");
        let mut source = Recording::open(&path).expect("opens");
        for sequence in [0, 1, 88, 89] {
            assert_eq!(next_from(&mut source, sequence), sequence);
        }
    }

    /// Asserts that an index with wrong positions does not lead to frames before or after the requested one (found by
    /// fuzzing).
    #[test]
    fn an_index_with_a_wrong_position_does_not_mislead() {
        let (_folder, path) = in_folder("a.mcap");
        record(&path, true, |_| false);
        let bytes = std::fs::read(&path).expect("reads");
        for (start, end) in chunks(&bytes).into_iter().skip(1) {
            let (start, end) = (start as u64, end as u64);
            // Position of the record after the chunk, which is neither a chunk nor damaged.
            let wrong = end.to_le_bytes();
            let at = bytes.windows(8).rposition(|w| w == start.to_le_bytes()).expect("in the index");
            let mut bytes = bytes.clone();
            bytes[at..at + 8].copy_from_slice(&wrong);
            // Without a CRC the index is believed.
            let crc = bytes.len() - 12..bytes.len() - 8;
            bytes[crc].fill(0);
            std::fs::write(&path, bytes).expect("writes");
            let mut source = Recording::open(&path).expect("opens");
            for sequence in 0..90 {
                assert_eq!(next_from(&mut source, sequence), sequence);
            }
        }
    }
}
