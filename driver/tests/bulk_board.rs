//! Tests of the bulk variant of the board with emulated endpoints: the same frames, faults and recovery.

use std::time::Duration;

use radome_driver::{Address, BoardError, EmulatedSource, Fault, Kind, Mcu7Board, UsbAddress};
use radome_dsp::{Frame, Gap, GapReason, Waveform};

use crate::common::{POLICY, Pattern, board, options, read, read_frames, reasons, waveform};
use crate::emulated_board::start_and_stop;

/// Sequence numbers of frames with the source's codes, those of other frames, and the gaps, up to the end of the
/// source.
fn stream(waveform: &Waveform, frames: u64, faults: &[Fault]) -> (Vec<u64>, Vec<u64>, Vec<Gap>) {
    let pattern = Pattern::new(waveform.clone(), frames);
    let mut source =
        EmulatedSource::start(Box::new(Pattern::new(waveform.clone(), frames)), options(Kind::Mcu7Bulk, faults))
            .expect("starts");
    let (received, gaps, error) = read(&mut source);
    assert!(error.is_none(), "{error:?}");
    let (good, bad): (Vec<Frame>, Vec<Frame>) = received.into_iter().partition(|frame| {
        let mut expected = frame.clone();
        pattern.fill(frame.sequence, &mut expected);
        frame.codes == expected.codes
    });
    let numbers = |frames: Vec<Frame>| frames.iter().map(|frame| frame.sequence).collect::<Vec<_>>();
    (numbers(good), numbers(bad), gaps)
}

#[test]
fn the_board_identifies_itself_as_the_bulk_variant() {
    let waveform = waveform(&[1, 2, 3], 8, 64, 0.1);
    let board = board(&waveform, 1000, Kind::Mcu7Bulk, &[]);
    let client = Mcu7Board::open(board.address()).expect("opens");
    let identity = client.identity().clone();
    assert_eq!((identity.vendor_id, identity.product_id, identity.chip_id), (0x058B, 0x0252, 0x303));
    assert_eq!((identity.chip.as_str(), identity.extended_version.as_str()), ("BGT60TR13C", "emulated"));
    drop(start_and_stop(client, &waveform).start(&waveform).expect("starts"));
    // A query of the identity does not change the chip; opening the board resets it.
    assert_eq!(Mcu7Board::identity_at(board.address()).expect("answers"), identity);
    let (client, programmed) = Mcu7Board::open_with_waveform(board.address()).expect("opens again");
    programmed.expect("programmed").check_compatible(&waveform).expect("the same");
    drop(client);
    assert_eq!(Mcu7Board::open_with_waveform(board.address()).expect("opens again").1, None);
}

mod hard_cases {
    use super::*;

    #[test]
    fn damage_that_is_detectable_without_a_checksum_loses_only_its_frame() {
        let waveform = waveform(&[1, 2, 3], 8, 64, 0.1);
        use GapReason::{Crc, FifoOverflow, PacketLost};
        for (fault, reason) in [
            (Fault::DropPacket(4), Some(PacketLost)),
            (Fault::DoublePacket(4), None),
            (Fault::ReorderPacket(4), Some(PacketLost)),
            (Fault::TruncatePacket { packet: 4, bytes: 700 }, Some(Crc)),
            (Fault::TruncatePacket { packet: 4, bytes: 3 }, Some(Crc)),
            (Fault::FlipBit { packet: 4, bit: 7 }, Some(Crc)),
            (Fault::FlipBit { packet: 4, bit: 8 }, Some(Crc)),
            (Fault::Overflow(4), Some(FifoOverflow)),
        ] {
            let (good, bad, gaps) = stream(&waveform, 20, &[fault]);
            assert!(bad.is_empty(), "{fault:?}: {bad:?}");
            assert_eq!(reasons(&gaps), Vec::from_iter(reason), "{fault:?}");
            let lost: u64 = gaps.iter().map(|g| g.frames).sum();
            assert_eq!(good.len() as u64 + lost, 20, "{fault:?}: {gaps:?}");
            assert!(lost <= 2, "{fault:?}: {gaps:?}");
        }
    }

    /// Asserts that a bit flipped after the USB transfer is undetected and appears in the frame: USB checks only the
    /// transfer.
    #[test]
    fn damage_that_is_undetectable_without_a_checksum_is_in_the_frame() {
        let waveform = waveform(&[1, 2, 3], 8, 64, 0.1);
        let (good, bad, gaps) = stream(&waveform, 10, &[Fault::FlipBit { packet: 4, bit: 999 }]);
        assert_eq!((good.len(), bad, gaps), (9, vec![4], vec![]));
    }

    /// Asserts that a slightly wrong length is detected, since it differs from the slice's, and that the board is
    /// restarted.
    #[test]
    fn a_wrong_length_is_detected() {
        let waveform = waveform(&[1, 2, 3], 8, 64, 0.1);
        // Bits 32 and 33 of the header are the lowest of the length.
        for bit in [32, 33, 40] {
            // More frames than the sockets hold, since a restart discards their content.
            let (_, bad, gaps) = stream(&waveform, 1000, &[Fault::FlipBit { packet: 4, bit }]);
            assert!(bad.is_empty() && !gaps.is_empty(), "bit {bit}: {bad:?}, {gaps:?}");
        }
    }

    #[test]
    fn the_stream_continues_after_replugging_and_stalls() {
        let waveform = waveform(&[1, 2, 3], 8, 64, 0.1);
        let unplug = |packet| Fault::Unplug { packet, duration: Duration::from_millis(100) };
        // The board is ahead of its host by the content of the socket, about ninety packets. The first fault must
        // therefore come late enough to follow a slow start.
        let faults = [unplug(300), Fault::Stall(320), unplug(340)];
        let board = board(&waveform, u64::MAX, Kind::Mcu7Bulk, &faults);
        let client = Mcu7Board::open(board.address()).expect("opens");
        let mut stream = client.start(&waveform).expect("starts").with_reconnect(POLICY);
        let gaps = read_frames(&mut stream, 420, |_| {});
        assert_eq!(reasons(&gaps), [GapReason::Disconnected; 3]);
    }

    #[test]
    fn an_absent_board_is_an_error() {
        let nowhere = Address::Usb(UsbAddress::Emulated("/no/such/board".into()));
        let Err(error) = Mcu7Board::open(&nowhere) else { panic!("opened") };
        assert!(matches!(error, BoardError::Absent { .. }) && error.to_string().contains("hint:"), "{error}");
        // This error also occurs on a machine without USB.
        let Err(error) = Mcu7Board::open(&Address::Usb(UsbAddress::Serial("no such serial number".into()))) else {
            panic!("opened")
        };
        assert!(matches!(error, BoardError::Absent { .. }), "{error}");
    }
}
