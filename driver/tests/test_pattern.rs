//! Test of the chip's test pattern through registers, board, link and unpacking.

use radome_driver::chip::test_pattern::PatternCheck;
use radome_driver::{Fault, Kind, Mcu7Board};
use radome_dsp::{Frame, FrameSource, SourceEvent, Waveform};

use crate::common::{Pattern, board, waveform};

/// Result of the check over a number of frames, and the last of them.
fn check(waveform: &Waveform, frames: u64, faults: &[Fault]) -> (PatternCheck, Frame) {
    let board = board(waveform, u64::MAX, Kind::default(), faults);
    let mut stream = Mcu7Board::open(board.address()).expect("opens").start_test_pattern(waveform).expect("starts");
    let mut frame = Frame::zeroed(waveform.shape());
    let (mut check, mut received) = (PatternCheck::new(), 0);
    while received < frames {
        match stream.next_frame(&mut frame).expect("stream") {
            SourceEvent::Frame => {
                let shape = waveform.shape();
                check.check(&frame.codes[..shape.chirps * shape.samples]);
                received += 1;
            }
            SourceEvent::Gap(_) => check.after_gap(),
            SourceEvent::End => panic!("a board does not end"),
        }
    }
    (check, frame)
}

#[test]
fn one_million_samples_arrive_without_a_wrong_bit() {
    let (check, _) = check(&waveform(&[1], 64, 256, 0.1), 62, &[]);
    assert!(check.samples >= 1_000_000);
    assert_eq!(check.wrong_bits, 0);
}

#[test]
fn only_the_first_receiver_has_the_pattern() {
    let waveform = waveform(&[1, 2, 3], 32, 64, 0.1);
    let (check, last) = check(&waveform, 5, &[]);
    assert_eq!((check.samples, check.wrong_bits), (5 * 32 * 64, 0));
    let mut expected = last.clone();
    Pattern::new(waveform, 1).fill(last.sequence, &mut expected);
    assert_eq!(last.codes[32 * 64..], expected.codes[32 * 64..]);
}

mod hard_cases {
    use super::*;

    #[test]
    fn damage_on_the_line_costs_samples_but_no_bits() {
        let faults = [Fault::DropPacket(3), Fault::FlipBit { packet: 7, bit: 1000 }, Fault::DoublePacket(9)];
        let (check, _) = check(&waveform(&[1], 32, 64, 0.1), 20, &faults);
        assert_eq!((check.samples, check.wrong_bits), (20 * 32 * 64, 0));
    }
}
