//! Asserts that a running stream does not allocate: this test program's allocator counts by thread.

mod common;
#[path = "../../dsp/tests/counting/mod.rs"]
mod counting;

use common::{board, waveform};
use counting::ALLOCATIONS;
use radome_driver::{DeepcraftBoard, Kind, Mcu7Board};
use radome_dsp::{Frame, FrameSource, SourceEvent};

/// Asserts that a stream does not allocate after its first frames, which determine the sizes of the buffers.
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
    // One packet a frame; 48 packets a frame, as in the paper; frames that share slices.
    for (antennas, chirps, samples) in [(&[1u8, 2, 3][..], 8, 64), (&[1, 2, 3], 128, 256), (&[3], 3, 33)] {
        let waveform = waveform(antennas, chirps, samples, 0.1);
        let board = board(&waveform, u64::MAX, Kind::default(), &[]);
        assert_steady(&mut Mcu7Board::open(board.address()).expect("opens").start(&waveform).expect("starts"));
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
