//! Boards that stay lost, over every transport, and emulated boards whose sources fail. The stream ends with an error
//! that states the cause, without a regular end and without a hang.

use std::time::Duration;

use radome_driver::{BoardError, EmulatedBoard, EmulatedSource, Kind, Mcu7Board, Reconnect};
use radome_dsp::{Frame, FrameSource, SourceError, SourceEvent, source_from_fn};

use crate::common::{Pattern, linked, open, spawn, waveform};

const POLICY: Reconnect = Reconnect {
    first_wait: Duration::from_millis(10),
    longest_wait: Duration::from_millis(50),
    give_up_after: Duration::from_millis(300),
};

/// Error of a stream whose board of this kind disappears after three frames.
fn error_of_lost_board(kind: Kind) -> SourceError {
    let folder = tempfile::tempdir().expect("a folder");
    let waveform = waveform(&[1, 2, 3], 8, 64, 0.1);
    let board = spawn(&waveform, u64::MAX, linked(kind, &[], folder.path()));
    let mut stream = open(kind, &board, &waveform, POLICY).expect("starts");
    let mut frame = Frame::zeroed(waveform.shape());
    let mut frames = 0;
    while frames < 3 {
        frames += u64::from(stream.next_frame(&mut frame).expect("a frame") == SourceEvent::Frame);
    }
    drop(board);
    loop {
        match stream.next_frame(&mut frame) {
            Ok(SourceEvent::End) => panic!("a board does not end"),
            // Frames in transit still arrive.
            Ok(_) => {}
            Err(error) => {
                // Later calls return the error too.
                assert!(stream.next_frame(&mut frame).is_err());
                return error;
            }
        }
    }
}

#[test]
fn the_stream_of_a_lost_board_ends_with_the_broken_connection() {
    for kind in [Kind::Mcu7V4, Kind::Mcu7Bulk, Kind::Deepcraft, Kind::Esp32] {
        let error = error_of_lost_board(kind);
        assert!(matches!(error.downcast_ref(), Some(BoardError::Disconnected { .. })), "{kind:?}: {error:?}");
        assert!(error.to_string().contains("board: the connection broke"), "{kind:?}: {error}");
    }
}

/// Source that fails after five frames, by an error or by a panic.
fn failing(panics: bool) -> Box<dyn FrameSource> {
    let mut pattern = Pattern::new(waveform(&[1, 2, 3], 8, 64, 0.1), 5);
    Box::new(source_from_fn(pattern.waveform.clone(), move |frame| match pattern.next_frame(frame)? {
        SourceEvent::End if panics => panic!("chunk 3 is damaged"),
        SourceEvent::End => Err("chunk 3 is damaged".into()),
        event => Ok(event),
    }))
}

#[test]
fn the_failure_of_a_source_reaches_the_client_of_its_emulated_board() {
    for panics in [false, true] {
        for kind in [Kind::Mcu7V4, Kind::Mcu7Bulk] {
            let folder = tempfile::tempdir().expect("a folder");
            let mut source = EmulatedSource::start(failing(panics), linked(kind, &[], folder.path())).expect("starts");
            let mut frame = Frame::zeroed(source.waveform().shape());
            for sequence in 0..5 {
                assert_eq!(source.next_frame(&mut frame).expect("a frame"), SourceEvent::Frame);
                assert_eq!(frame.sequence, sequence);
            }
            let error = source.next_frame(&mut frame).expect_err("the source has failed").to_string();
            let is_whole = error.contains("chunk 3 is damaged") && error.contains("panicked") == panics;
            assert!(is_whole, "{kind:?}: {error}");
        }
    }
}

#[test]
fn an_emulated_board_keeps_the_failure_of_its_source_and_answers_until_it_is_stopped() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut board = EmulatedBoard::spawn(failing(false), linked(Kind::Mcu7V4, &[], folder.path())).expect("spawns");
    let client = Mcu7Board::open(board.address()).expect("opens");
    let waveform = waveform(&[1, 2, 3], 8, 64, 0.1);
    let mut stream = client.start(&waveform).expect("starts");
    let mut frame = Frame::zeroed(waveform.shape());
    for _ in 0..5 {
        assert_eq!(stream.next_frame(&mut frame).expect("a frame"), SourceEvent::Frame);
    }
    board.wait();
    assert!(board.failure().is_some_and(|reason| reason.contains("chunk 3 is damaged")), "{:?}", board.failure());
    // The board still answers.
    drop(stream);
    assert!(Mcu7Board::open(board.address()).is_ok());
    board.stop();
}
