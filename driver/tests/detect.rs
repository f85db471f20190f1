//! Tests of board detection on a serial port by listening and asking.

use radome_driver::{Address, BoardError, Detected, Fault, Kind};
use radome_dsp::{Frame, FrameSource, SourceEvent};

use crate::common::{Pattern, board, waveform};

#[test]
fn an_mcu7_of_either_protocol_reports_the_programmed_waveform() {
    let w = waveform(&[1, 3], 16, 32, 0.05);
    for kind in [Kind::Mcu7V4, Kind::Mcu7V3] {
        let board = board(&w, 20, kind, &[]);
        let Detected::Mcu7(_, programmed) = Detected::open(board.address(), None).expect("answers") else {
            panic!("another kind of board");
        };
        let programmed = programmed.expect("programmed");
        programmed.check_compatible(&w).expect("the same");
        assert_eq!(programmed.request.rx_antennas, w.request.rx_antennas);
    }
}

#[test]
fn a_psoc_kit_reports_its_configured_waveform() {
    let w = waveform(&[1, 3], 16, 32, 0.05);
    let board = board(&w, 20, Kind::Deepcraft, &[]);
    let Detected::Deepcraft(client) = Detected::open(board.address(), None).expect("answers") else {
        panic!("another kind of board");
    };
    let programmed = client.configured_waveform().expect("a waveform");
    programmed.check_compatible(&w).expect("the same");
    assert_eq!(programmed.request.rx_antennas, w.request.rx_antennas);
    let mut stream = client.start(&programmed).expect("starts");
    assert_eq!(stream.next_frame(&mut Frame::zeroed(w.shape())).expect("frame"), SourceEvent::Frame);
}

#[test]
fn a_printing_board_is_read_from_its_first_frame_on() {
    let w = waveform(&[1, 2, 3], 16, 32, 0.05);
    let board = board(&w, 20, Kind::Esp32, &[]);
    let Detected::Esp32(mut stream) = Detected::open(board.address(), None).expect("speaks") else {
        panic!("another kind of board");
    };
    assert_eq!(stream.waveform(), &w);
    let reference = Pattern::new(w.clone(), 20);
    let (mut frame, mut expected) = (Frame::zeroed(w.shape()), Frame::zeroed(w.shape()));
    for sequence in 0..20 {
        assert_eq!(stream.next_frame(&mut frame).expect("frame"), SourceEvent::Frame);
        reference.fill(sequence, &mut expected);
        assert_eq!((frame.sequence, &frame.codes), (sequence, &expected.codes));
    }
}

mod hard_cases {
    use std::error::Error;
    use std::io::Write;
    use std::path::Path;
    use std::sync::Arc;
    use std::sync::atomic::{AtomicBool, Ordering};
    use std::time::Duration;

    use radome_driver::protocol::ascii;
    use serialport::{SerialPort, TTYPort};

    use super::*;

    /// Regression test: the error was the system's "Not a typewriter".
    #[test]
    fn a_device_that_is_no_serial_port_is_an_error() {
        let error = Detected::open(&Address::Serial(Path::new("/dev/null").into()), None).err().expect("refused");
        assert!(error.source().is_some_and(|source| source.to_string() == "it is not a serial port"), "{error:?}");
    }

    /// Asserts that a printing board can be opened again: opening the port resets it, and the client reads from its
    /// start.
    #[test]
    fn a_printing_board_can_be_opened_again() {
        let w = waveform(&[1], 16, 32, 0.05);
        let board = board(&w, 20, Kind::Esp32, &[]);
        drop(Detected::open(board.address(), None).expect("speaks"));
        std::thread::sleep(std::time::Duration::from_millis(50));
        let Detected::Esp32(mut stream) = Detected::open(board.address(), Some(&w)).expect("speaks") else {
            panic!("another kind of board");
        };
        assert_eq!(stream.next_frame(&mut Frame::zeroed(w.shape())).expect("frame"), SourceEvent::Frame);
    }

    #[test]
    fn a_silent_port_counts_as_stalled() {
        let w = waveform(&[1], 16, 32, 0.05);
        let board = board(&w, 20, Kind::Esp32, &[Fault::Stall(0)]);
        // The board prints its banner and waveform but no frame.
        let Detected::Esp32(mut stream) = Detected::open(board.address(), None).expect("speaks") else {
            panic!("another kind of board");
        };
        let error = stream.next_frame(&mut Frame::zeroed(w.shape())).expect_err("silent");
        assert!(error.to_string().contains("stalled"), "{error}");
    }

    /// Regression test: a board that was printing already, with frames further apart than the first listening lasts,
    /// was not found. Unlike the emulated board, such a board does not restart when its port is opened.
    #[test]
    fn a_rarely_printing_board_is_found() {
        let w = waveform(&[1], 4, 32, 0.8);
        let (mut board, port) = TTYPort::pair().expect("a pty");
        let path = port.name().expect("a path");
        drop(port);
        let is_done = Arc::new(AtomicBool::new(false));
        let (printer_done, codes) = (is_done.clone(), vec![2048; w.shape().codes()]);
        let printer = std::thread::spawn(move || {
            let mut number = 0;
            while !printer_done.load(Ordering::Relaxed) {
                std::thread::sleep(Duration::from_millis(800));
                let mut line = Vec::new();
                ascii::encode(number, &codes, &mut line);
                // Nobody may have the port open.
                let _ = board.write_all(&line);
                number += 1;
            }
        });
        let found = Detected::open(&Address::Serial(path.into()), Some(&w));
        let read = found.map(|found| {
            let Detected::Esp32(mut stream) = found else { panic!("another kind of board") };
            stream.next_frame(&mut Frame::zeroed(w.shape())).map_err(|error| error.to_string())
        });
        is_done.store(true, Ordering::Relaxed);
        printer.join().expect("prints");
        assert_eq!(read.expect("found"), Ok(SourceEvent::Frame));
    }

    #[test]
    fn a_foreign_chip_is_named() {
        let board = board(&waveform(&[1], 16, 32, 0.05), 20, Kind::Mcu7V4, &[Fault::ForeignChip(0x504)]);
        let error = Detected::open(board.address(), None).err().expect("refused");
        assert!(matches!(error, BoardError::OtherChip { chip: "BGT60ATR24C", .. }), "{error}");
    }
}
