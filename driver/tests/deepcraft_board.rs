//! Tests of frames through the whole driver: source, emulated PSoC 6 kit, pseudo-terminal and client.

use std::io::{Read, Write};
use std::time::Duration;

use prost::Message;
use radome_driver::protocol::deepcraft::{
    Answer, CapabilitiesRequest, Command, MAX_RESPONSE, MessageParser, Preset, Request, Response, device_status,
};
use radome_driver::{
    BoardError, DeepcraftBoard, DeepcraftError, DeepcraftStream, EmulatedBoard, EmulatorError, EmulatorOptions, Fault,
    Feed, Kind, Pace,
};
use radome_dsp::{Frame, FrameSource, Gap, GapReason, SourceEvent, Waveform};

use crate::common::{self, POLICY, Pattern, linked, options, read_frames, reasons, spawn, waveform};

fn board(waveform: &Waveform, faults: &[Fault]) -> EmulatedBoard {
    common::board(waveform, u64::MAX, Kind::Deepcraft, faults)
}

fn start(board: &EmulatedBoard, waveform: &Waveform) -> DeepcraftStream {
    DeepcraftBoard::open(board.path()).expect("opens").start(waveform).expect("starts")
}

/// Opens the port of a board without a client; reads wait this long.
fn raw_port(board: &EmulatedBoard, timeout: Duration) -> Box<dyn serialport::SerialPort> {
    serialport::new(board.path().to_string_lossy(), 115_200).timeout(timeout).open().expect("opens")
}

/// Reads this number of frames; asserts that each has the time of its number. Returns the gaps.
fn read(stream: &mut DeepcraftStream, frames: usize) -> Vec<Gap> {
    let interval_ns = stream.waveform().frame_interval_s() * 1e9;
    read_frames(stream, frames, |frame| {
        assert!((frame.time_ns as f64 - frame.sequence as f64 * interval_ns).abs() < 1.0);
    })
}

/// Asserts that the payload is in FIFO order, although the stream's shape states another order. Three receivers and
/// axes of different lengths reveal any error.
#[test]
fn frames_arrive_bit_exact() {
    for (antennas, chirps, samples) in
        [(&[1u8, 2, 3][..], 8, 64), (&[1, 2, 3], 64, 64), (&[2], 3, 34), (&[1, 3], 5, 100), (&[3], 1, 8)]
    {
        let w = waveform(antennas, chirps, samples, 0.1);
        let board = board(&w, &[]);
        let mut stream = start(&board, &w);
        assert!(read(&mut stream, 200).is_empty(), "{}", w.shape());
    }
}

/// Regression test: the times of frames followed the requested interval instead of that of the registers.
#[test]
fn frames_have_the_times_of_the_registers() {
    let w = waveform(&[1, 2, 3], 8, 64, 0.1);
    let board = board(&w, &[]);
    let mut stream = start(&board, &w);
    let expected = common::realised(&w).frame_interval_s();
    assert!(expected > 1.0005 * w.frame_interval_s());
    assert_eq!(stream.waveform().frame_interval_s(), expected);
    assert!(read(&mut stream, 30).is_empty());
}

#[test]
fn a_board_reports_its_identity_and_its_waveform() {
    let w = waveform(&[1, 2], 8, 64, 0.1);
    let custom = board(&w, &[]);
    let client = DeepcraftBoard::open(custom.path()).expect("opens");
    let identity = client.identity();
    assert_eq!((identity.firmware_version.as_str(), identity.protocol_version.as_str()), ("1.2.0", "2.3.20241218"));
    assert_eq!((identity.chip.as_str(), identity.uuid.as_str()), ("BGT60TR13C", "000102030405060708090a0b0c0d0e0f"));
    let configured = client.configured_waveform().expect("a waveform");
    configured.check_compatible(&w).expect("the same axes");
    assert_eq!(configured.request.rx_antennas, w.request.rx_antennas);
    assert_eq!(configured.request.frame_interval_s, 0.1);
    assert!(read(&mut client.start(&configured).expect("starts"), 30).is_empty());
    for preset in Preset::ALL {
        let w = preset.waveform().expect("valid");
        let board = board(&w, &[]);
        let client = DeepcraftBoard::open(board.path()).expect("opens");
        assert_eq!(client.configured_waveform().as_ref(), Some(&w), "{preset:?}");
        let mut stream = client.start(&w).expect("starts");
        assert!(stream.registers().is_empty(), "the firmware has its own");
        assert!(read(&mut stream, 60).is_empty());
    }
}

/// Regression test: the board reported a waveform that its firmware cannot have, and no client could start it.
#[test]
fn a_source_whose_frames_the_firmware_cannot_hold_is_refused_or_measured_in_a_preset() {
    let large = waveform(&[1, 2, 3], 128, 256, 0.1);
    let pattern = || Box::new(Pattern::new(large.clone(), u64::MAX));
    let error = EmulatedBoard::spawn(pattern(), options(Kind::Deepcraft, &[])).err().expect("a refusal");
    assert!(matches!(error, EmulatorError::Frame { codes: 98_304 }), "{error}");
    assert!(error.to_string().contains("hint:"), "{error}");
    let any = Feed::of_any_waveform(pattern(), |waveform, _| Ok(Box::new(Pattern::new(waveform.clone(), u64::MAX))));
    let board = EmulatedBoard::spawn(any, options(Kind::Deepcraft, &[])).expect("spawns");
    let client = DeepcraftBoard::open(board.path()).expect("opens");
    let configured = client.configured_waveform().expect("a waveform");
    assert_eq!(Preset::of(&configured), Some(Preset::Default));
    assert!(read(&mut client.start(&configured).expect("starts"), 30).is_empty());
    let other = waveform(&[1, 2, 3], 8, 64, 0.1);
    assert!(read(&mut start(&board, &other), 30).is_empty());
}

/// Compares the emulated board's answer with bytes written by hand from the rules of protobuf and the captured
/// messages. Client, emulated board and codec therefore cannot share an error.
#[test]
fn the_emulated_board_answers_as_written_by_hand() {
    let board = board(&Preset::Gesture.waveform().expect("valid"), &[]);
    let mut port = raw_port(&board, Duration::from_secs(60));
    // Request for the capabilities of all devices (-1, zig-zag) with tag 2^24 + 1.
    port.write_all(&[9, 0x0A, 7, 0x08, 1, 0x10, 0x81, 0x80, 0x80, 0x08]).expect("asks");
    let expected: [&[u8]; 31] = [
        &[0xA4, 0x02, 0x0A, 0xA1, 0x02, 0x0A, 0x99, 0x02], // 292 bytes; capabilities; board
        &[0x0A, 18, 0x0A, 16, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15],
        &[0x12, 16],
        b"CY8CKIT-062S2-AI",
        &[0x1A, 4, 0x08, 1, 0x10, 2],                            // firmware 1.2
        &[0x22, 9, 0x08, 2, 0x10, 3, 0x18, 0xC2, 0xB6, 0xD3, 9], // protocol 2.3.20241218
        &[0x28, 0xB8, 0x17],                                     // watchdog 3000 ms
        &[0x32, 0xDC, 0x01, 0x12, 5],                            // a device of 220 bytes
        b"Radar",
        &[0x1A, 24],
        b"Radar device (bgt60trxx)",
        &[0x20, 1],                      // a sensor
        &[0x2A, 0x53, 0x08, 1, 0x12, 8], // option 1
        b"Use case",
        &[0x1A, 7],
        b"Presets",
        &[0x3A, 60, 0x10, 1], // one of these, the second now
        b"\x1A\x07Default\x1A\x07Gesture\x1A\x0EMacro Presence\x1A\x0EMicro Presence\x1A\x06Custom",
        &[0x2A, 37, 0x08, 2, 0x12, 11], // option 2
        b"Custom data",
        &[0x1A, 18],
        b"Binary Custom data",
        &[0x42, 0],           // an empty blob
        &[0x32, 59, 0x0A, 5], // a stream
        b"Radar",
        &[0x10, 2, 0x18, 4], // output, S16
        b"\x22\x0B\x0A\x07Antenna\x10\x03\x22\x09\x0A\x05Chirp\x10\x20\x22\x0A\x0A\x06Sample\x10\x40",
        &[0x2D, 0x00, 0x00, 0x04, 0x42], // 33.0 Hz
        &[0x30, 1, 0x3A, 3],
        b"???",
        &[0x10, 0x81, 0x80, 0x80, 0x08], // the tag
    ];
    let expected = expected.concat();
    let mut received = vec![0; expected.len()];
    port.read_exact(&mut received).expect("answers");
    assert_eq!(received, expected);
}

/// Asserts that chunks hold all frames that one read of the FIFO completes, although the stream announces at most one
/// frame a chunk. The vendor's firmware announces and does the same: its `dev_bgt60trxx.c` adds the stream with 1 and
/// sends all its frames. A client that relies on the number fails with the real board and must fail with this one.
#[test]
fn chunks_hold_all_frames_of_a_read_whatever_the_stream_announces() {
    let w = small();
    let board = board(&w, &[]);
    let mut port = raw_port(&board, Duration::from_secs(60));
    let mut requests = Vec::new();
    Request::from(Command::Capabilities(CapabilitiesRequest { device: 0, tag: 1 })).encode_to(&mut requests);
    // Starts device 0.
    requests.extend([2, 0x1A, 0]);
    port.write_all(&requests).expect("asks");
    let mut parser = MessageParser::new(MAX_RESPONSE);
    let (mut buffer, mut stated, mut frame_count) = (vec![0; 4096], None, None);
    while frame_count.is_none() {
        let count = port.read(&mut buffer).expect("answers");
        parser.push(&buffer[..count]);
        while let Some(message) = parser.next_message() {
            match Response::decode(message.expect("a length")).expect("a message").answer {
                Some(Answer::Capabilities(answer)) => {
                    stated = Some(answer.board.expect("a board").devices[0].streams[0].max_frame_count);
                }
                Some(Answer::Data(chunk)) => frame_count = frame_count.or(Some(chunk.frame_count)),
                other => panic!("{other:?}"),
            }
        }
    }
    assert_eq!((stated, frame_count), (Some(1), Some(4)));
}

/// Waveform of which one read of the emulated firmware completes four frames.
fn small() -> Waveform {
    waveform(&[1, 2, 3], 8, 64, 0.1)
}

/// Waveform of which a frame takes three reads.
fn large() -> Waveform {
    waveform(&[1, 2, 3], 32, 128, 0.1)
}

/// Gaps of a stream with these faults.
fn gaps_with(waveform: &Waveform, faults: &[Fault], frames: usize) -> Vec<Gap> {
    let board = board(waveform, faults);
    read(&mut start(&board, waveform), frames)
}

#[test]
fn a_lost_message_loses_its_frames() {
    let gaps = gaps_with(&small(), &[Fault::DropPacket(3)], 40);
    assert_eq!(gaps, [Gap { first_sequence: 12, frames: 4, reason: GapReason::PacketLost }]);
    let gaps = gaps_with(&large(), &[Fault::DropPacket(3), Fault::DropPacket(4)], 10);
    assert_eq!(gaps, [Gap { first_sequence: 3, frames: 2, reason: GapReason::PacketLost }]);
    // The first message of all can be counted as lost, since the board has announced its number.
    let gaps = gaps_with(&large(), &[Fault::DropPacket(0)], 10);
    assert_eq!(gaps, [Gap { first_sequence: 0, frames: 1, reason: GapReason::PacketLost }]);
}

#[test]
fn a_doubled_message_loses_nothing() {
    for w in [small(), large()] {
        assert_eq!(gaps_with(&w, &[Fault::DoublePacket(0), Fault::DoublePacket(3)], 40), []);
    }
}

#[test]
fn messages_in_the_wrong_order_lose_one_frame() {
    let gaps = gaps_with(&large(), &[Fault::ReorderPacket(3)], 10);
    assert_eq!(gaps, [Gap { first_sequence: 4, frames: 1, reason: GapReason::PacketLost }]);
}

#[test]
fn a_counter_that_jumps_is_a_gap_of_that_length() {
    let gaps = gaps_with(&large(), &[Fault::SkipCounter { packet: 3, by: 7 }], 10);
    assert_eq!(gaps, [Gap { first_sequence: 3, frames: 7, reason: GapReason::PacketLost }]);
}

/// Asserts that the reason of a gap is right: the board reports the frames that it dropped itself. The client asks when
/// frames are missing, so that faults must be further apart than the board can be ahead of the line.
#[test]
fn frames_dropped_by_the_board_are_distinguished_from_those_lost_on_the_line() {
    let faults = [Fault::Overflow(20), Fault::DropPacket(60), Fault::Overflow(100), Fault::DropPacket(101)];
    for (w, frames) in [(small(), 4), (large(), 1)] {
        let board = board(&w, &faults);
        let gaps = read(&mut start(&board, &w), 140 * frames);
        use GapReason::{FifoOverflow, PacketLost};
        let gap = |chunk, reason| Gap { first_sequence: chunk * frames as u64, frames: frames as u64, reason };
        // The order of two reasons within one gap is unknown.
        assert_eq!(gaps, [gap(20, FifoOverflow), gap(60, PacketLost), gap(100, FifoOverflow), gap(101, PacketLost)]);
        assert_eq!(board.counts().overflows, 2);
    }
}

#[test]
fn damage_loses_the_frames_in_transit_and_the_stream_continues() {
    let mut faults = Vec::new();
    for bytes in [1, 2, 3, 5, 9, 11, 12, 13, 100, 4095, 6000, 24_575, 24_580] {
        faults.push(Fault::TruncatePacket { packet: 3, bytes });
    }
    // Flips bits of the length, the tags and the numbers.
    for bit in (0..13 * 8).step_by(5) {
        faults.push(Fault::FlipBit { packet: 3, bit });
    }
    for fault in faults {
        let gaps = gaps_with(&large(), &[fault], 8);
        assert_eq!(gaps.len(), 1, "{fault:?}: {gaps:?}");
        let Gap { first_sequence, reason, .. } = gaps[0];
        // The previous frame is lost too if nothing is left to confirm its end.
        assert!((2..=3).contains(&first_sequence) && reason == GapReason::Crc, "{fault:?}: {gaps:?}");
    }
}

/// Asserts that frames of a slow stream arrive as they are measured: silence after a chunk confirms it without a
/// successor.
#[test]
fn frames_of_a_slow_stream_arrive_as_they_are_measured() {
    const FRAMES: u64 = 24;
    let w = small();
    let faults = [Fault::TruncatePacket { packet: 2, bytes: 999 }];
    let options = EmulatorOptions { pace: Pace::RealTime(1.0), ..options(Kind::Deepcraft, &faults) };
    let board = spawn(&w, FRAMES, options);
    let mut stream = start(&board, &w);
    let (mut frame, mut expected) = (Frame::zeroed(w.shape()), Frame::zeroed(w.shape()));
    let pattern = Pattern::new(w.clone(), 0);
    let (mut next_source, mut damaged) = (0, 0);
    while next_source < FRAMES {
        match stream.next_frame(&mut frame).expect("no error") {
            SourceEvent::Frame => {
                let found = (next_source..FRAMES).find(|sequence| {
                    pattern.fill(*sequence, &mut expected);
                    expected.codes == frame.codes
                });
                next_source = found.expect("a frame of the source") + 1;
            }
            SourceEvent::Gap(gap) => damaged += u32::from(gap.reason == GapReason::Crc),
            SourceEvent::End => panic!("a board does not end"),
        }
    }
    assert_eq!(damaged, 1);
}

mod hard_cases {
    use super::*;

    fn open_error(board: &EmulatedBoard) -> BoardError {
        DeepcraftBoard::open(board.path()).err().expect("an error")
    }

    #[test]
    fn the_stream_survives_all_faults_together() {
        let folder = tempfile::tempdir().expect("folder");
        let w = large();
        let faults = [
            Fault::DropPacket(2),
            Fault::FlipBit { packet: 25, bit: 12 },
            Fault::TruncatePacket { packet: 50, bytes: 700 },
            Fault::Overflow(75),
            Fault::DoublePacket(100),
            Fault::ReorderPacket(125),
            Fault::SkipCounter { packet: 150, by: 3 },
            Fault::Unplug { packet: 175, duration: Duration::from_millis(50) },
            Fault::TruncatePacket { packet: 200, bytes: 24_575 },
            Fault::SlowHost { packet: 210, duration: Duration::from_millis(50) },
            Fault::DropPacket(225),
        ];
        let board = spawn(&w, u64::MAX, linked(Kind::Deepcraft, &faults, folder.path()));
        let mut stream = start(&board, &w).with_reconnect(POLICY);
        let gaps = read(&mut stream, 230);
        use GapReason::{Crc, Disconnected, FifoOverflow, PacketLost};
        assert_eq!(
            reasons(&gaps),
            [PacketLost, Crc, Crc, FifoOverflow, PacketLost, PacketLost, Disconnected, Crc, PacketLost]
        );
    }

    #[test]
    fn another_device_and_another_version_are_named() {
        let w = small();
        let error = open_error(&board(&w, &[Fault::ForeignChip(0x606)])).to_string();
        assert!(error.contains("none of the board's devices is a radar") && error.contains("0x000606"), "{error}");
        let error = open_error(&board(&w, &[Fault::WrongVersion(3)]));
        assert!(!error.is_transient() && error.to_string().contains("version 3.3"), "{error}");
    }

    #[test]
    fn another_waveform_than_that_of_the_source_is_refused_with_both() {
        let w = small();
        let board = board(&w, &[]);
        let requested = waveform(&[1, 2, 3], 16, 64, 0.1);
        let error = DeepcraftBoard::open(board.path()).expect("opens").start(&requested).err().expect("refused");
        assert!(matches!(&error, BoardError::Deepcraft { source: DeepcraftError::Device { .. }, .. }), "{error}");
        assert!(error.to_string().contains("16 chirps") && error.to_string().contains("8 chirps"), "{error}");
        assert!(board.refusal().is_some_and(|reason| reason.contains("map size")));
        // The board accepts further requests.
        assert!(read(&mut start(&board, &w), 10).is_empty());
        assert_eq!(board.refusal(), None);
    }

    #[test]
    fn fewer_receivers_than_those_of_the_source_are_sent_on_request() {
        let source = waveform(&[1, 2, 3], 8, 64, 0.1);
        let requested = waveform(&[3], 8, 64, 0.1);
        let board = board(&source, &[]);
        let mut stream = start(&board, &requested);
        let (mut frame, mut whole) = (Frame::zeroed(requested.shape()), Frame::zeroed(source.shape()));
        for sequence in 0..30 {
            assert_eq!(stream.next_frame(&mut frame).expect("stream"), SourceEvent::Frame);
            Pattern::new(source.clone(), 0).fill(sequence, &mut whole);
            assert_eq!(frame.codes, whole.codes[2 * 8 * 64..]);
        }
    }

    #[test]
    fn frames_that_the_firmware_cannot_hold_are_refused() {
        for w in [waveform(&[1, 2, 3], 128, 256, 0.1), waveform(&[1, 2, 3], 3, 33, 0.1)] {
            let board = board(&small(), &[]);
            let client = DeepcraftBoard::open(board.path()).expect("opens");
            let error = client.start(&w).err().expect("too large, or odd").to_string();
            assert!(error.contains(&format!("a frame has {} codes", w.shape().codes())), "{error}");
        }
    }

    /// Asserts that a board can be opened while it still measures. It can also be opened while it waits for the rest of
    /// another program's request: the `AT` of a modem manager announces 65 bytes.
    #[test]
    fn a_board_in_any_state_is_opened() {
        let w = small();
        let board = board(&w, &[]);
        let mut port = raw_port(&board, Duration::from_millis(200));
        port.write_all(b"AT+GCAP\r").expect("writes");
        drop(port);
        DeepcraftBoard::open(board.path()).expect("opens after a modem manager");
        // Another program keeps the port open, so that the board does not stop: it stops when the last client leaves.
        let mut port = std::fs::File::options().read(true).write(true).open(board.path()).expect("opens");
        port.write_all(&[2, 0x1A, 0]).expect("starts");
        let mut buffer = [0; 100];
        port.read_exact(&mut buffer).expect("measures");
        assert!(read(&mut start(&board, &w), 20).is_empty(), "opens while it measures");
        drop(port);
        // Opens the board again after a dropped stream.
        assert!(read(&mut start(&board, &w), 20).is_empty());
        let stream = start(&board, &w);
        let client = stream.stop().expect("stops");
        assert!(read(&mut client.start(&w).expect("starts again"), 20).is_empty());
    }

    #[test]
    fn a_board_of_another_protocol_is_refused_and_not_disturbed() {
        let w = small();
        for kind in [Kind::Mcu7V4, Kind::Mcu7V3, Kind::Esp32] {
            let board = common::board(&w, u64::MAX, kind, &[]);
            let error = open_error(&board);
            assert!(matches!(error, BoardError::NoAnswer { command: "capabilities", .. }), "{kind:?}: {error}");
            match kind {
                Kind::Esp32 => {
                    let mut stream = radome_driver::Esp32Stream::open(board.path(), Some(&w)).expect("opens");
                    let mut frame = Frame::zeroed(w.shape());
                    while stream.next_frame(&mut frame).expect("lines") != SourceEvent::Frame {}
                }
                _ => drop(radome_driver::Mcu7Board::open(board.address()).expect("opens").start(&w).expect("starts")),
            }
        }
    }

    #[test]
    fn the_watchdog_stops_a_board_whose_host_is_silent() {
        let w = small();
        let options = EmulatorOptions { pace: Pace::RealTime(1.0), ..options(Kind::Deepcraft, &[]) };
        let board = spawn(&w, u64::MAX, options);
        let mut port = raw_port(&board, Duration::from_millis(200));
        port.write_all(&[2, 0x1A, 0]).expect("starts");
        // The status between chunks is first active and later ready again.
        let mut parser = MessageParser::new(MAX_RESPONSE);
        let mut buffer = vec![0; 4096];
        let (mut chunks, mut states) = (0, Vec::new());
        while states.last() != Some(&device_status::READY) {
            let mut request = Vec::new();
            Request::from(Command::Capabilities(CapabilitiesRequest { device: 0, tag: 1 })).encode_to(&mut request);
            port.write_all(&request).expect("asks");
            let count = port.read(&mut buffer).unwrap_or(0);
            parser.push(&buffer[..count]);
            while let Some(message) = parser.next_message() {
                match Response::decode(message.expect("a length")).expect("a message").answer {
                    Some(Answer::Data(_)) => chunks += 1,
                    Some(Answer::Capabilities(answer)) => {
                        states.push(answer.board.expect("a board").devices[0].status);
                    }
                    other => panic!("{other:?}"),
                }
            }
            std::thread::sleep(Duration::from_millis(50));
        }
        assert!(chunks > 0 && states.first() == Some(&device_status::ACTIVE), "{chunks} chunks, {states:?}");
        drop(port);

        // A client that is polled keeps the board running for longer than the watchdog's time.
        let mut stream = start(&board, &w);
        let gaps = read_for(&mut stream, Duration::from_secs(4));
        assert_eq!(gaps, []);
        // A client that is not polled finds a gap.
        std::thread::sleep(Duration::from_millis(3100));
        let gaps = read_for(&mut stream, Duration::from_secs(1));
        assert!(matches!(gaps[..], [Gap { reason: GapReason::Disconnected, .. }]), "{gaps:?}");
    }

    /// Reads for some time; returns the gaps.
    fn read_for(stream: &mut DeepcraftStream, duration: Duration) -> Vec<Gap> {
        let mut frame = Frame::zeroed(stream.waveform().shape());
        let end = std::time::Instant::now() + duration;
        let mut gaps = Vec::new();
        while std::time::Instant::now() < end {
            if let SourceEvent::Gap(gap) = stream.next_frame(&mut frame).expect("stream") {
                gaps.push(gap);
            }
        }
        gaps
    }

    #[test]
    fn without_reconnection_the_error_is_returned_at_once() {
        let folder = tempfile::tempdir().expect("folder");
        let w = large();
        let fault = Fault::Unplug { packet: 10, duration: Duration::from_millis(20) };
        let board = spawn(&w, u64::MAX, linked(Kind::Deepcraft, &[fault], folder.path()));
        let (_, _, error) = common::read(&mut start(&board, &w));
        let error = error.expect("the board is away");
        assert!(error.to_string().contains("connection broke"), "{error}");
    }
}
