//! A running stream allocates nothing: counted by the allocator of this test program, by thread.

mod common;
#[path = "../../dsp/tests/counting/mod.rs"]
mod counting;

use common::{Pattern, waveform};
use counting::ALLOCATIONS;
use radome_driver::{DeepcraftBoard, EmulatedBoard, EmulatorOptions, Kind, Mcu7Board, Pace};
use radome_dsp::{Frame, FrameSource, SourceEvent};

#[test]
fn the_client_allocates_nothing_per_frame() {
    // One packet a frame; the paper's 48 packets a frame; frames that share slices.
    for (antennas, chirps, samples) in [(&[1u8, 2, 3][..], 8, 64), (&[1, 2, 3], 128, 256), (&[3], 3, 33)] {
        let waveform = waveform(antennas, chirps, samples, 0.1);
        let options = EmulatorOptions { pace: Pace::AsFastAsRead, ..EmulatorOptions::default() };
        let source = Pattern::new(waveform.clone(), u64::MAX);
        let board = EmulatedBoard::spawn(Box::new(source), options).expect("spawns");
        let mut stream = Mcu7Board::open(board.path()).expect("opens").start(&waveform).expect("starts");
        let mut frame = Frame::zeroed(waveform.shape());
        let mut read = |frames: u64| {
            for _ in 0..frames {
                assert_eq!(stream.next_frame(&mut frame).expect("frame"), SourceEvent::Frame);
            }
        };
        // The first frames find out how large the buffers must be.
        read(300);
        let before = ALLOCATIONS.get();
        assert!(before > 0, "the allocator counts");
        read(200);
        assert_eq!(ALLOCATIONS.get() - before, 0, "{}", waveform.shape());
    }
}

#[test]
fn the_deepcraft_client_allocates_nothing_per_frame() {
    // Four frames a chunk; a frame in nine reads; 48 frames a chunk.
    for (antennas, chirps, samples) in [(&[1u8, 2, 3][..], 8, 64), (&[1, 2, 3], 64, 256), (&[3], 1, 128)] {
        let waveform = waveform(antennas, chirps, samples, 0.1);
        let options = EmulatorOptions { pace: Pace::AsFastAsRead, kind: Kind::Deepcraft, ..EmulatorOptions::default() };
        let source = Pattern::new(waveform.clone(), u64::MAX);
        let board = EmulatedBoard::spawn(Box::new(source), options).expect("spawns");
        let mut stream = DeepcraftBoard::open(board.path()).expect("opens").start(&waveform).expect("starts");
        let mut frame = Frame::zeroed(waveform.shape());
        let mut read = |frames: u64| {
            for _ in 0..frames {
                assert_eq!(stream.next_frame(&mut frame).expect("frame"), SourceEvent::Frame);
            }
        };
        read(300);
        let before = ALLOCATIONS.get();
        read(200);
        assert_eq!(ALLOCATIONS.get() - before, 0, "{}", waveform.shape());
    }
}
