//! Frames through the lines of an ESP32, sample for sample, on a pseudo-terminal.

use std::time::Duration;

use radome_driver::{EmulatedBoard, EmulatorOptions, Esp32Stream, Fault, Kind, Pace, Reconnect};
use radome_dsp::{Frame, FrameSource, Gap, GapReason, SourceEvent};

use crate::common::{Pattern, waveform};

fn board(source: Pattern) -> EmulatedBoard {
    let options = EmulatorOptions { pace: Pace::AsFastAsRead, kind: Kind::Esp32, ..EmulatorOptions::default() };
    EmulatedBoard::spawn(Box::new(source), options).expect("a pty")
}

#[test]
fn frames_come_through_lines_sample_for_sample_and_a_gap_in_its_place() {
    let w = waveform(&[1, 2, 3], 16, 32, 0.05);
    let mut source = Pattern::new(w.clone(), 30);
    source.gap = Some(Gap { first_sequence: 10, frames: 3, reason: GapReason::Recorded });
    let reference = Pattern::new(w.clone(), 30);
    let board = board(source);
    let mut stream = Esp32Stream::open(board.path(), Some(&w)).expect("opens");
    let (mut frame, mut expected) = (Frame::zeroed(w.shape()), Frame::zeroed(w.shape()));
    let (mut frames, mut gaps) = (Vec::new(), Vec::new());
    while frames.last() != Some(&29) {
        match stream.next_frame(&mut frame).expect("no error") {
            SourceEvent::Frame => {
                reference.fill(frame.sequence, &mut expected);
                assert_eq!(frame.codes, expected.codes, "frame {}", frame.sequence);
                assert_eq!(frame.time_ns, expected.time_ns);
                frames.push(frame.sequence);
            }
            SourceEvent::Gap(gap) => gaps.push(gap),
            SourceEvent::End => panic!("boards do not end"),
        }
    }
    assert_eq!(frames, (0..10).chain(13..30).collect::<Vec<_>>());
    assert_eq!(gaps, [Gap { first_sequence: 10, frames: 3, reason: GapReason::PacketLost }]);
}

/// A board that is unplugged is found again; what it counts from its beginning goes on where the stream was.
#[test]
fn a_printing_board_that_is_plugged_in_again_goes_on() {
    let folder = tempfile::tempdir().expect("folder");
    let w = waveform(&[1, 2, 3], 16, 32, 0.05);
    let fault = Fault::Unplug { packet: 60, duration: Duration::from_millis(50) };
    let options = EmulatorOptions {
        pace: Pace::AsFastAsRead,
        kind: Kind::Esp32,
        faults: vec![fault],
        link: Some(folder.path().join("board")),
        ..EmulatorOptions::default()
    };
    let board = EmulatedBoard::spawn(Box::new(Pattern::new(w.clone(), u64::MAX)), options).expect("a pty");
    let policy = Reconnect { longest_wait: Duration::from_millis(50), ..Reconnect::default() };
    let mut stream = Esp32Stream::open(board.path(), Some(&w)).expect("opens").with_reconnect(policy);
    let mut frame = Frame::zeroed(w.shape());
    let (mut next, mut lost) = (0, 0);
    while next < 100 {
        match stream.next_frame(&mut frame).expect("comes back") {
            SourceEvent::Frame => {
                assert_eq!(frame.sequence, next);
                next += 1;
            }
            SourceEvent::Gap(gap) => {
                assert_eq!((gap.first_sequence, gap.reason), (next, GapReason::Disconnected));
                lost += gap.frames;
                next += gap.frames;
            }
            SourceEvent::End => panic!("boards do not end"),
        }
    }
    assert!(lost > 0);
}

mod hard_cases {
    use super::*;

    #[test]
    fn lines_of_another_waveform_are_refused_with_both_lengths() {
        let built_for = waveform(&[1], 16, 32, 0.02);
        let named = waveform(&[1, 2], 16, 32, 0.02);
        let board = board(Pattern::new(built_for, 5));
        let mut stream = Esp32Stream::open(board.path(), Some(&named)).expect("opens");
        let error = stream.next_frame(&mut Frame::zeroed(named.shape())).expect_err("no frame fits");
        let reason = error.source().expect("a reason").to_string();
        assert!(reason.contains("512 codes, expected 1024"), "{error}: {reason}");
    }

    #[test]
    fn a_port_that_is_not_there_is_named() {
        let w = waveform(&[1], 16, 32, 0.02);
        let error = Esp32Stream::open(std::path::Path::new("/dev/nowhere"), Some(&w)).err().expect("no such port");
        assert!(error.to_string().contains("/dev/nowhere"), "{error}");
    }
}
