//! Allocator that keeps freed large blocks for reuse.
//!
//! A training step allocates and frees hundreds of blocks of tens of megabytes. The system's allocator maps each of
//! them again, and the kernel fills its pages with zeros. This took longer than the arithmetic.

use std::alloc::{GlobalAlloc, Layout, System};
use std::ptr::null_mut;
use std::sync::{Mutex, MutexGuard};

/// Size from which blocks are kept, bytes.
const SMALLEST: usize = 1 << 18;
/// Size from which blocks are aligned to cache lines, bytes. Otherwise every second store of a full register crosses a line, which
/// costs 5 % of the time of a map.
const SMALLEST_ALIGNED: usize = 1 << 14;
/// Length of a cache line, bytes.
const CACHE_LINE: usize = 64;
/// Largest total size of free blocks that are kept, bytes.
const MOST_KEPT: usize = 4 << 30;
/// Number of size classes in an octave.
const STEPS: usize = 8;
/// Number of size classes, for sizes up to 2^40 bytes.
const CLASSES: usize = (40 - SMALLEST.ilog2() as usize) * STEPS;
/// Size of the processor's large pages, bytes.
const LARGE_PAGE: usize = 1 << 21;

/// Allocator that keeps freed blocks of 256 KiB and more for the next request of about their size. Smaller blocks come from the
/// system's allocator, aligned to cache lines from 16 KiB on. A program that trains declares it:
///
/// ```
/// #[global_allocator]
/// static ALLOCATOR: radome_models::LargeBlocks = radome_models::LargeBlocks::new();
/// ```
pub struct LargeBlocks {
    free_lists: Mutex<FreeLists>,
}

/// Linked lists of free blocks.
struct FreeLists {
    /// First free block of each class; each block begins with the address of the next.
    first: [*mut u8; CLASSES],
    /// Total size of the free blocks.
    bytes: usize,
}

// SAFETY: the blocks belong to the thread that holds the lock.
unsafe impl Send for FreeLists {}

/// Index and block size of the smallest size class for `size` bytes; `None` above the largest class.
fn size_class(size: usize) -> Option<(usize, usize)> {
    let octave = size.max(SMALLEST).ilog2() as usize;
    let step = (1usize << octave) / STEPS;
    let steps = size.max(SMALLEST).div_ceil(step);
    let index = (octave - SMALLEST.ilog2() as usize) * STEPS + steps - STEPS;
    (index < CLASSES).then(|| (index, steps * step))
}

impl LargeBlocks {
    /// Makes an allocator that holds no blocks.
    #[allow(clippy::new_without_default)]
    pub const fn new() -> Self {
        LargeBlocks { free_lists: Mutex::new(FreeLists { first: [null_mut(); CLASSES], bytes: 0 }) }
    }

    fn lock_free_lists(&self) -> MutexGuard<'_, FreeLists> {
        self.free_lists.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
    }

    /// Size class of a block that is kept when it is freed, and the layout requested from the system. `None` if blocks of this
    /// layout are not kept.
    fn kept_layout(layout: Layout) -> Option<(usize, Layout)> {
        if layout.size() < SMALLEST || layout.align() > 4096 {
            return None;
        }
        let (index, size) = size_class(layout.size())?;
        let align = if size >= LARGE_PAGE { LARGE_PAGE } else { 4096 };
        Some((index, Layout::from_size_align(size, align).ok()?))
    }

    /// Layout requested from the system for a block that is not kept.
    fn unkept_layout(layout: Layout) -> Layout {
        if layout.size() < SMALLEST_ALIGNED || layout.align() >= CACHE_LINE {
            return layout;
        }
        Layout::from_size_align(layout.size(), CACHE_LINE).unwrap_or(layout)
    }

    /// Takes a free block of the class, whose blocks have this layout. Null if there is none.
    fn take(&self, index: usize, kept_layout: Layout) -> *mut u8 {
        let mut free_lists = self.lock_free_lists();
        let first = free_lists.first[index];
        if !first.is_null() {
            // SAFETY: a free block begins with the address of the next; `dealloc` wrote it.
            free_lists.first[index] = unsafe { first.cast::<*mut u8>().read() };
            free_lists.bytes -= kept_layout.size();
        }
        first
    }
}

// SAFETY: blocks come from the system with the size and alignment of their class, which cover the requested layout, and
// go back with the same.
unsafe impl GlobalAlloc for LargeBlocks {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let Some((index, kept_layout)) = Self::kept_layout(layout) else {
            // SAFETY: passed on, with at least the requested alignment.
            return unsafe { System.alloc(Self::unkept_layout(layout)) };
        };
        let reused = self.take(index, kept_layout);
        if !reused.is_null() {
            return reused;
        }
        // SAFETY: the size is not zero.
        let fresh = unsafe { System.alloc(kept_layout) };
        #[cfg(target_os = "linux")]
        if !fresh.is_null() && kept_layout.align() == LARGE_PAGE {
            let whole_pages = kept_layout.size() & !(LARGE_PAGE - 1);
            // SAFETY: advice on pages that are this block's own; refused advice does no harm.
            let _ = unsafe { rustix::mm::madvise(fresh.cast(), whole_pages, rustix::mm::Advice::LinuxHugepage) };
        }
        fresh
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        let Some((index, kept_layout)) = Self::kept_layout(layout) else {
            // SAFETY: passed on, with the layout that `alloc` passed on.
            return unsafe { System.dealloc(pointer, Self::unkept_layout(layout)) };
        };
        let mut free_lists = self.lock_free_lists();
        if free_lists.bytes + kept_layout.size() > MOST_KEPT {
            drop(free_lists);
            // SAFETY: `alloc` requested the block with this layout.
            return unsafe { System.dealloc(pointer, kept_layout) };
        }
        // SAFETY: the block is free, and longer and better aligned than an address.
        unsafe { pointer.cast::<*mut u8>().write(free_lists.first[index]) };
        free_lists.first[index] = pointer;
        free_lists.bytes += kept_layout.size();
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        if Self::kept_layout(layout).is_none() {
            // SAFETY: passed on, with at least the requested alignment.
            return unsafe { System.alloc_zeroed(Self::unkept_layout(layout)) };
        }
        // SAFETY: the caller's layout.
        let pointer = unsafe { self.alloc(layout) };
        if !pointer.is_null() {
            // SAFETY: the block is at least this long.
            unsafe { pointer.write_bytes(0, layout.size()) };
        }
        pointer
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        let Ok(new) = Layout::from_size_align(size, layout.align()) else { return null_mut() };
        match (Self::kept_layout(layout), Self::kept_layout(new)) {
            // SAFETY: passed on, with the layout that `alloc` passed on.
            (None, None) if Self::unkept_layout(layout).align() == Self::unkept_layout(new).align() => unsafe {
                System.realloc(pointer, Self::unkept_layout(layout), size)
            },
            (Some((old, _)), Some((new, _))) if old == new => pointer,
            _ => {
                // SAFETY: a valid layout, whose size is not zero by the caller's contract.
                let moved = unsafe { self.alloc(new) };
                if !moved.is_null() {
                    // SAFETY: two blocks, both as long as the shorter layout; the old one is freed once.
                    unsafe {
                        std::ptr::copy_nonoverlapping(pointer, moved, layout.size().min(size));
                        self.dealloc(pointer, layout);
                    }
                }
                moved
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn size_classes_are_large_enough_and_waste_an_eighth_at_most() {
        let mut last = 0;
        for size in (SMALLEST..SMALLEST * 40).step_by(999) {
            let (index, block_size) = size_class(size).expect("class");
            assert!(block_size >= size && block_size <= size + size / STEPS + 1, "{size} in {block_size}");
            assert!(index >= last);
            assert_eq!(size_class(block_size), Some((index, block_size)));
            last = index;
        }
        assert_eq!(size_class(usize::MAX), None);
    }

    #[test]
    fn blocks_of_more_than_a_few_pages_are_aligned_to_cache_lines_after_every_reallocation() {
        let blocks = LargeBlocks::new();
        let layout = |size: usize| Layout::from_size_align(size, 4).expect("layout");
        // SAFETY: the block is freed once, with its last layout, and written inside its size.
        unsafe {
            let mut block = blocks.alloc(layout(1000));
            block.write(5);
            let mut old_size = 1000;
            for size in [20_000, 30_000, 300_000, 40_000, 900] {
                block = blocks.realloc(block, layout(old_size), size);
                old_size = size;
                assert_eq!(block.read(), 5, "{size}");
                assert!(size < SMALLEST_ALIGNED || block.addr().is_multiple_of(CACHE_LINE), "{size}");
            }
            blocks.dealloc(block, layout(old_size));
            let zeros = blocks.alloc_zeroed(layout(50_000));
            assert!(zeros.addr().is_multiple_of(CACHE_LINE) && (0..50_000).all(|k| zeros.add(k).read() == 0));
            blocks.dealloc(zeros, layout(50_000));
        }
    }

    #[test]
    fn a_freed_block_comes_back_and_zeros_are_zeros() {
        let blocks = LargeBlocks::new();
        let layout = Layout::from_size_align(3 << 20, 16).expect("layout");
        // SAFETY: every block is freed once, with its layout, and written inside its size.
        unsafe {
            let first = blocks.alloc(layout);
            first.write_bytes(7, layout.size());
            blocks.dealloc(first, layout);
            let again = blocks.alloc_zeroed(layout);
            assert_eq!(again, first);
            assert!((0..layout.size()).all(|k| again.add(k).read() == 0));
            again.write(9);
            let grown = blocks.realloc(again, layout, 9 << 20);
            assert_eq!(grown.read(), 9);
            assert_eq!(blocks.alloc(layout), first);
            blocks.dealloc(first, layout);
            let layout = Layout::from_size_align(9 << 20, 16).expect("layout");
            let small = blocks.realloc(grown, layout, 100);
            assert_eq!(small.read(), 9);
            blocks.dealloc(small, Layout::from_size_align(100, 16).expect("layout"));
        }
    }
}
