//! Frames through the whole driver: source, emulated PSoC 6 kit, pseudo-terminal, client.

mod common;

use std::time::Duration;

use common::{Pattern, waveform};
use radome_driver::protocol::deepcraft::Preset;
use radome_driver::{
    BoardError, DeepcraftBoard, DeepcraftError, DeepcraftStream, EmulatedBoard, EmulatorOptions, Fault, Kind, Pace,
    Reconnect,
};
use radome_dsp::{Frame, FrameSource, Gap, GapReason, SourceEvent, Waveform};

/// Patient enough for any machine.
const POLICY: Reconnect = Reconnect {
    first_wait: Duration::from_millis(10),
    longest_wait: Duration::from_millis(50),
    give_up_after: Duration::from_secs(60),
};

fn options(faults: &[Fault]) -> EmulatorOptions {
    EmulatorOptions {
        pace: Pace::AsFastAsRead,
        kind: Kind::Deepcraft,
        faults: faults.to_vec(),
        ..EmulatorOptions::default()
    }
}

fn board(waveform: &Waveform, faults: &[Fault]) -> EmulatedBoard {
    let source = Pattern::new(waveform.clone(), u64::MAX);
    EmulatedBoard::spawn(Box::new(source), options(faults)).expect("spawns")
}

fn start(board: &EmulatedBoard, waveform: &Waveform) -> DeepcraftStream {
    DeepcraftBoard::open(board.path()).expect("opens").start(waveform).expect("starts")
}

/// Reads so many frames. Each must be a whole frame of the source, later than the one before, and sequence numbers must
/// leave no hole but the gaps. Gives the gaps.
fn read(stream: &mut DeepcraftStream, frames: usize) -> Vec<Gap> {
    let waveform = stream.waveform().clone();
    let mut frame = Frame::zeroed(waveform.shape());
    let mut expected = frame.clone();
    let pattern = Pattern::new(waveform.clone(), 0);
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
                let expected_ns = next_sequence as f64 * waveform.frame_interval_s() * 1e9;
                assert!((frame.time_ns as f64 - expected_ns).abs() < 1.0);
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
    for reason in [GapReason::Disconnected, GapReason::PacketLost, GapReason::Crc, GapReason::FifoOverflow] {
        let frames: u64 = gaps.iter().filter(|g| g.reason == reason).map(|g| g.frames).sum();
        assert_eq!(stream.lost_frames(reason), frames, "{reason:?}");
    }
    gaps
}

/// The payload is in FIFO order although the stream's shape says otherwise: three receivers and unlike axes would show it.
#[test]
fn frames_come_through_sample_for_sample() {
    for (antennas, chirps, samples) in
        [(&[1u8, 2, 3][..], 8, 64), (&[1, 2, 3], 64, 64), (&[2], 3, 34), (&[1, 3], 5, 100), (&[3], 1, 8)]
    {
        let w = waveform(antennas, chirps, samples, 0.1);
        let board = board(&w, &[]);
        let mut stream = start(&board, &w);
        assert!(read(&mut stream, 200).is_empty(), "{}", w.shape());
    }
}

#[test]
fn a_board_says_who_it_is_and_what_it_is_set_to() {
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

/// What the emulated firmware reads at once completes four of these frames.
fn small() -> Waveform {
    waveform(&[1, 2, 3], 8, 64, 0.1)
}

/// One frame in three reads.
fn large() -> Waveform {
    waveform(&[1, 2, 3], 32, 128, 0.1)
}

/// Gaps that these faults cost.
fn gaps_with(waveform: &Waveform, faults: &[Fault], frames: usize) -> Vec<Gap> {
    let board = board(waveform, faults);
    read(&mut start(&board, waveform), frames)
}

#[test]
fn a_lost_message_costs_its_frames() {
    let gaps = gaps_with(&small(), &[Fault::DropPacket(3)], 40);
    assert_eq!(gaps, [Gap { first_sequence: 12, frames: 4, reason: GapReason::PacketLost }]);
    let gaps = gaps_with(&large(), &[Fault::DropPacket(3), Fault::DropPacket(4)], 10);
    assert_eq!(gaps, [Gap { first_sequence: 3, frames: 2, reason: GapReason::PacketLost }]);
    // The first one of all: the board has said what number it will have.
    let gaps = gaps_with(&large(), &[Fault::DropPacket(0)], 10);
    assert_eq!(gaps, [Gap { first_sequence: 0, frames: 1, reason: GapReason::PacketLost }]);
}

#[test]
fn a_doubled_message_costs_nothing() {
    for w in [small(), large()] {
        assert_eq!(gaps_with(&w, &[Fault::DoublePacket(0), Fault::DoublePacket(3)], 40), []);
    }
}

#[test]
fn messages_in_the_wrong_order_cost_one() {
    let gaps = gaps_with(&large(), &[Fault::ReorderPacket(3)], 10);
    assert_eq!(gaps, [Gap { first_sequence: 4, frames: 1, reason: GapReason::Crc }]);
}

#[test]
fn a_counter_that_jumps_is_a_gap_of_that_length() {
    let gaps = gaps_with(&large(), &[Fault::SkipCounter { packet: 3, by: 7 }], 10);
    assert_eq!(gaps, [Gap { first_sequence: 3, frames: 7, reason: GapReason::PacketLost }]);
}

#[test]
fn damage_costs_what_was_under_way_and_the_stream_goes_on() {
    let mut faults = Vec::new();
    for bytes in [1, 2, 3, 5, 9, 11, 12, 13, 100, 4095, 6000, 24_575, 24_580] {
        faults.push(Fault::TruncatePacket { packet: 3, bytes });
    }
    // Bits of the length, of the tags and of the numbers.
    for bit in (0..13 * 8).step_by(5) {
        faults.push(Fault::FlipBit { packet: 3, bit });
    }
    for fault in faults {
        let gaps = gaps_with(&large(), &[fault], 8);
        assert_eq!(gaps.len(), 1, "{fault:?}: {gaps:?}");
        let Gap { first_sequence, reason, .. } = gaps[0];
        // Its predecessor goes with it if nothing is left to confirm that by.
        assert!((2..=3).contains(&first_sequence) && reason == GapReason::Crc, "{fault:?}: {gaps:?}");
    }
}

#[test]
fn a_board_that_is_plugged_in_again_goes_on() {
    let folder = tempfile::tempdir().expect("folder");
    let (w, duration) = (large(), Duration::from_millis(100));
    let faults = [10, 30, 50].map(|packet| Fault::Unplug { packet, duration });
    let options = EmulatorOptions { link: Some(folder.path().join("board")), ..options(&faults) };
    let board = EmulatedBoard::spawn(Box::new(Pattern::new(w.clone(), u64::MAX)), options).expect("spawns");
    let mut stream = start(&board, &w).with_reconnect(POLICY);
    let gaps = read(&mut stream, 60);
    assert_eq!(gaps.iter().map(|g| g.reason).collect::<Vec<_>>(), [GapReason::Disconnected; 3]);
}

#[test]
fn a_board_that_stalls_is_started_anew() {
    let w = large();
    let board = board(&w, &[Fault::Stall(4)]);
    let mut stream = start(&board, &w).with_reconnect(POLICY);
    let gaps = read(&mut stream, 10);
    assert_eq!(gaps.iter().map(|g| (g.first_sequence, g.reason)).collect::<Vec<_>>(), [(4, GapReason::Disconnected)]);
    // By the host's clock: the deadline is 1.3 s.
    assert!(gaps[0].frames >= 12, "{gaps:?}");
}

/// At the pace of the source every chunk is followed by silence, which confirms it.
#[test]
fn frames_of_a_slow_stream_come_as_they_are_measured() {
    let w = waveform(&[1, 2, 3], 32, 128, 0.05);
    let source = Pattern::new(w.clone(), 12);
    let options =
        EmulatorOptions { pace: Pace::RealTime(1.0), ..options(&[Fault::TruncatePacket { packet: 5, bytes: 999 }]) };
    let board = EmulatedBoard::spawn(Box::new(source), options).expect("spawns");
    let mut stream = start(&board, &w);
    let (mut frame, mut expected) = (Frame::zeroed(w.shape()), Frame::zeroed(w.shape()));
    let (mut last, mut gaps) = (None, 0);
    // The last frame has no successor.
    while last != Some(11) {
        match stream.next_frame(&mut frame).expect("no error") {
            SourceEvent::Frame => {
                let pattern = Pattern::new(w.clone(), 0);
                last = (0..12).find(|sequence| {
                    pattern.fill(*sequence, &mut expected);
                    expected.codes == frame.codes
                });
                assert!(last.is_some(), "a frame of the source");
            }
            SourceEvent::Gap(gap) => {
                assert_eq!((gap.first_sequence, gap.reason), (5, GapReason::Crc));
                gaps += 1;
            }
            SourceEvent::End => panic!("a board does not end"),
        }
    }
    assert_eq!(gaps, 1);
}
