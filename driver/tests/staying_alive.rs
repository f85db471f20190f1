//! Boards that disconnect, stall and lose alignment: the stream continues, and each loss is counted once.

use std::time::Duration;

use radome_driver::{Fault, Kind, Mcu7Board};
use radome_dsp::{Gap, GapReason};

use crate::common::{POLICY, board, linked, open, read, read_frames, reasons, spawn, waveform};

#[test]
fn the_stream_continues_after_replugging() {
    let folder = tempfile::tempdir().expect("folder");
    // Unread data are lost with the terminal, so that the board is unplugged rarely enough for frames to arrive in
    // between.
    for (kind, chirps, samples, packets, frames) in [
        (Kind::Mcu7V4, 8, 64, 1, [100, 300, 500]),
        (Kind::Mcu7V4, 128, 256, 48, [3, 7, 12]),
        (Kind::Deepcraft, 32, 128, 1, [10, 30, 50]),
    ] {
        let waveform = waveform(&[1, 2, 3], chirps, samples, 0.1);
        let duration = Duration::from_millis(100);
        let faults = frames.map(|frame| Fault::Unplug { packet: frame * packets + packets / 2, duration });
        let board = spawn(&waveform, u64::MAX, linked(kind, &faults, folder.path()));
        let mut stream = open(kind, &board, &waveform, POLICY).expect("starts");
        let gaps = read_frames(&mut stream, frames[2] as usize + 20, |_| {});
        assert_eq!(reasons(&gaps), [GapReason::Disconnected; 3]);
    }
}

#[test]
fn a_stalled_board_is_restarted() {
    for (kind, chirps, samples) in [(Kind::Mcu7V4, 8, 64), (Kind::Deepcraft, 32, 128)] {
        let waveform = waveform(&[1, 2, 3], chirps, samples, 0.1);
        let board = board(&waveform, u64::MAX, kind, &[Fault::Stall(4)]);
        let mut stream = open(kind, &board, &waveform, POLICY).expect("starts");
        let gaps = read_frames(&mut stream, 10, |_| {});
        assert_eq!(reasons(&gaps), [GapReason::Disconnected]);
        // According to the host's clock, the first frame after the deadline of 1.3 s has at least number 13.
        assert!(gaps[0].first_sequence == 4 && gaps[0].frames >= 12, "{gaps:?}");
    }
}

/// Asserts that a counter that jumps by less than a slice, which gives a packet an impossible position, leads to a
/// restart.
#[test]
fn lost_alignment_leads_to_a_restart() {
    let waveform = waveform(&[1, 2, 3], 128, 256, 0.1);
    for by in [1, 2, 3, 5] {
        let fault = Fault::SkipCounter { packet: 48 + 6, by };
        let board = board(&waveform, u64::MAX, Kind::default(), &[fault]);
        let mut stream = Mcu7Board::open(board.address()).expect("opens").start(&waveform).expect("starts");
        let gaps = read_frames(&mut stream, 5, |_| {});
        // A middle packet may be mistaken for another one, but the last packet of its slice may not.
        assert!((1..=2).contains(&gaps.len()), "{gaps:?}");
        assert!(gaps.iter().all(|gap| gap.reason == GapReason::PacketLost), "{gaps:?}");
        assert_eq!(gaps[0].first_sequence, 1);
    }
}

mod hard_cases {
    use super::*;

    #[test]
    fn packets_in_the_wrong_order_lose_only_their_frames() {
        let small = waveform(&[1, 2, 3], 8, 64, 0.1);
        let board = board(&small, u64::MAX, Kind::default(), &[Fault::ReorderPacket(3)]);
        let mut stream = Mcu7Board::open(board.address()).expect("opens").start(&small).expect("starts");
        let gaps = read_frames(&mut stream, 8, |_| {});
        assert_eq!(gaps, [Gap { first_sequence: 3, frames: 1, reason: GapReason::PacketLost }]);
    }

    #[test]
    fn the_stream_survives_all_faults_together() {
        let folder = tempfile::tempdir().expect("folder");
        let waveform = waveform(&[1, 2, 3], 8, 64, 0.1);
        let faults = [
            Fault::DropPacket(2),
            Fault::FlipBit { packet: 5, bit: 999 },
            Fault::TruncatePacket { packet: 11, bytes: 700 },
            Fault::Overflow(14),
            Fault::DoublePacket(16),
            Fault::ReorderPacket(18),
            Fault::SkipCounter { packet: 22, by: 3 },
            // Until the stream is restarted, the board continues to send: some tens of packets, on a fast machine 80.
            Fault::Unplug { packet: 1000, duration: Duration::from_millis(50) },
            Fault::DropPacket(1100),
        ];
        let board = spawn(&waveform, u64::MAX, linked(Kind::default(), &faults, folder.path()));
        let client = Mcu7Board::open(board.address()).expect("opens");
        let mut stream = client.start(&waveform).expect("starts").with_reconnect(POLICY);
        let gaps = read_frames(&mut stream, 1150, |_| {});
        use GapReason::{Crc, Disconnected, FifoOverflow, PacketLost};
        assert_eq!(
            reasons(&gaps),
            [PacketLost, Crc, Crc, FifoOverflow, PacketLost, PacketLost, Disconnected, PacketLost]
        );
    }

    #[test]
    fn without_reconnection_the_error_is_returned_at_once() {
        let folder = tempfile::tempdir().expect("folder");
        let waveform = waveform(&[1, 2, 3], 8, 64, 0.1);
        let fault = Fault::Unplug { packet: 100, duration: Duration::from_millis(20) };
        let board = spawn(&waveform, u64::MAX, linked(Kind::default(), &[fault], folder.path()));
        let mut stream = Mcu7Board::open(board.address()).expect("opens").start(&waveform).expect("starts");
        read_frames(&mut stream, 10, |_| {});
        let (_, _, error) = read(&mut stream);
        let error = error.expect("the board is away");
        assert!(error.to_string().contains("connection broke"), "{error}");
    }
}
