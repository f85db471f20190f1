//! Frames pass unchanged through the text lines of an ESP32 on a pseudo-terminal.

use std::time::Duration;

use radome_driver::{EmulatedBoard, Esp32Stream, Fault, Kind};
use radome_dsp::{Frame, FrameSource, Gap, GapReason};

use crate::common::{POLICY, Pattern, board, linked, options, read_frames, spawn, waveform};

#[test]
fn frames_and_gaps_pass_unchanged_through_lines() {
    let w = waveform(&[1, 2, 3], 16, 32, 0.05);
    let mut source = Pattern::new(w.clone(), 30);
    source.gap = Some(Gap { first_sequence: 10, frames: 3, reason: GapReason::Recorded });
    let reference = Pattern::new(w.clone(), 30);
    let board = EmulatedBoard::spawn(Box::new(source), options(Kind::Esp32, &[])).expect("a pty");
    let mut stream = Esp32Stream::open(board.path(), Some(&w)).expect("opens");
    let gaps = read_frames(&mut stream, 27, |frame| {
        let mut expected = frame.clone();
        reference.fill(frame.sequence, &mut expected);
        assert!(frame.codes == expected.codes && frame.time_ns == expected.time_ns, "frame {}", frame.sequence);
    });
    assert_eq!(gaps, [Gap { first_sequence: 10, frames: 3, reason: GapReason::PacketLost }]);
}

/// Asserts that a board that is unplugged is found again, and that its restarted numbers continue those of the stream.
#[test]
fn the_stream_of_a_printing_board_continues_after_replugging() {
    let folder = tempfile::tempdir().expect("folder");
    let w = waveform(&[1, 2, 3], 16, 32, 0.05);
    let fault = Fault::Unplug { packet: 60, duration: Duration::from_millis(50) };
    let board = spawn(&w, u64::MAX, linked(Kind::Esp32, &[fault], folder.path()));
    let mut stream = Esp32Stream::open(board.path(), Some(&w)).expect("opens").with_reconnect(POLICY);
    let gaps = read_frames(&mut stream, 100, |_| {});
    assert!(!gaps.is_empty() && gaps.iter().all(|gap| gap.reason == GapReason::Disconnected), "{gaps:?}");
}

mod hard_cases {
    use super::*;

    /// Regression test: the error did not name the waveform as the cause if lines were longer than any of that waveform.
    #[test]
    fn lines_of_another_waveform_are_an_error_that_names_the_cause() {
        for (built_for, named, words) in [
            (waveform(&[1], 16, 32, 0.02), waveform(&[1, 2], 16, 32, 0.02), "512 codes, expected 1024"),
            (waveform(&[1, 2, 3], 16, 64, 0.02), waveform(&[1], 4, 32, 0.02), "longer than any frame"),
        ] {
            let board = board(&built_for, 5, Kind::Esp32, &[]);
            let mut stream = Esp32Stream::open(board.path(), Some(&named)).expect("opens");
            let error = stream.next_frame(&mut Frame::zeroed(named.shape())).expect_err("no frame fits");
            let reason = error.source().expect("a reason").to_string();
            assert!(reason.contains(words) && reason.contains("hint: name the waveform"), "{error}: {reason}");
        }
    }
}
