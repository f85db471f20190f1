//! A running stream allocates nothing: counted by the allocator of this test program, by thread.

mod common;
#[path = "../../dsp/tests/counting/mod.rs"]
mod counting;

use common::{board, waveform};
use counting::ALLOCATIONS;
use radome_driver::{DeepcraftBoard, Kind, Mcu7Board};
use radome_dsp::{Frame, FrameSource, SourceEvent};

/// Asserts that a stream allocates nothing once its first frames have shown how large the buffers must be.
fn assert_steady(stream: &mut dyn FrameSource) {
    let shape = stream.waveform().shape();
    let mut frame = Frame::zeroed(shape);
    let mut read = |frames: u64| {
        for _ in 0..frames {
            assert_eq!(stream.next_frame(&mut frame).expect("frame"), SourceEvent::Frame);
        }
    };
    read(300);
    let before = ALLOCATIONS.get();
    assert!(before > 0, "the allocator counts");
    read(200);
    assert_eq!(ALLOCATIONS.get() - before, 0, "{shape}");
}

#[test]
fn the_client_allocates_nothing_per_frame() {
    // One packet a frame; the paper's 48 packets a frame; frames that share slices.
    for (antennas, chirps, samples) in [(&[1u8, 2, 3][..], 8, 64), (&[1, 2, 3], 128, 256), (&[3], 3, 33)] {
        let waveform = waveform(antennas, chirps, samples, 0.1);
        let board = board(&waveform, u64::MAX, Kind::default(), &[]);
        assert_steady(&mut Mcu7Board::open(board.path()).expect("opens").start(&waveform).expect("starts"));
    }
}

#[test]
fn the_deepcraft_client_allocates_nothing_per_frame() {
    // Four frames a chunk; a frame in nine reads; 48 frames a chunk.
    for (antennas, chirps, samples) in [(&[1u8, 2, 3][..], 8, 64), (&[1, 2, 3], 64, 256), (&[3], 1, 128)] {
        let waveform = waveform(antennas, chirps, samples, 0.1);
        let board = board(&waveform, u64::MAX, Kind::Deepcraft, &[]);
        assert_steady(&mut DeepcraftBoard::open(board.path()).expect("opens").start(&waveform).expect("starts"));
    }
}
