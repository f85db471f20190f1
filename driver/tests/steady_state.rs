//! A running stream allocates nothing: counted by the allocator of this test program, by thread.

mod common;

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use common::{Pattern, waveform};
use radome_driver::{Board, DeepcraftBoard, EmulatedBoard, EmulatorOptions, Kind, Pace};
use radome_dsp::{Frame, FrameSource, SourceEvent};

struct Counting;

thread_local! {
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
}

fn count() {
    // A thread that is ending has no counter any more; nobody asks for it then.
    let _ = ALLOCATIONS.try_with(|counter| counter.set(counter.get() + 1));
}

// SAFETY: every call goes on to the system's allocator unchanged; counting does not allocate.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: the caller's promise about `layout` is passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: `pointer` came from `System` with this `layout`.
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count();
        // SAFETY: `pointer` came from `System` with this `layout`; the promise about `size` is passed on.
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

#[test]
fn the_client_allocates_nothing_per_frame() {
    // One packet a frame; the paper's 48 packets a frame; frames that share slices.
    for (antennas, chirps, samples) in [(&[1u8, 2, 3][..], 8, 64), (&[1, 2, 3], 128, 256), (&[3], 3, 33)] {
        let waveform = waveform(antennas, chirps, samples, 0.1);
        let options = EmulatorOptions { pace: Pace::AsFastAsRead, ..EmulatorOptions::default() };
        let source = Pattern::new(waveform.clone(), u64::MAX);
        let board = EmulatedBoard::spawn(Box::new(source), options).expect("spawns");
        let mut stream = Board::open(board.path()).expect("opens").start(&waveform).expect("starts");
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
