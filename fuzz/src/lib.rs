//! Helpers of the fuzz targets: a limit on memory, inputs divided into pieces and files, folders in memory, and the
//! checks of each crate.

use std::alloc::{GlobalAlloc, Layout, System};
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Source file of the program, included because the program is no library.
#[allow(dead_code)]
#[path = "../../cli/src/dataset/spec.rs"]
mod dataset_spec;
mod learning;
mod recordings;
mod scenes;

pub use learning::{check_card, check_dataset, check_model, check_onnx, check_specs, with_card};
pub use recordings::{INFINEON_FILES, check_mcap, check_vendors, waveform};
pub use scenes::{SCENE_FILES, check_bvh, check_collada, check_gltf, check_obj, check_scene, check_stl};

/// System allocator that counts the allocated bytes and panics beyond a limit.
struct LimitedAllocator;

/// Allocated bytes.
static ALLOCATED: AtomicUsize = AtomicUsize::new(0);
/// Largest permitted number of allocated bytes.
static LIMIT: AtomicUsize = AtomicUsize::new(usize::MAX);

/// Counts an allocation.
fn count_allocation(bytes: usize) {
    let allocated = ALLOCATED.fetch_add(bytes, Ordering::Relaxed) + bytes;
    if allocated > LIMIT.load(Ordering::Relaxed) {
        // The fuzzer ends the program here, so that the backtrace shows the allocation.
        LIMIT.store(usize::MAX, Ordering::Relaxed);
        panic!("{bytes} bytes more make {allocated}, which is too much");
    }
}

// SAFETY: every call is passed on to the system's allocator unchanged; counting does not allocate.
unsafe impl GlobalAlloc for LimitedAllocator {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count_allocation(layout.size());
        // SAFETY: the caller's promise about `layout` is passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        count_allocation(layout.size());
        // SAFETY: the caller's promise about `layout` is passed on.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        ALLOCATED.fetch_sub(layout.size(), Ordering::Relaxed);
        // SAFETY: `pointer` came from `System` with this `layout`.
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count_allocation(size);
        ALLOCATED.fetch_sub(layout.size(), Ordering::Relaxed);
        // SAFETY: `pointer` came from `System` with this `layout`; the promise about `size` is passed on.
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: LimitedAllocator = LimitedAllocator;

/// Runs `action`, which may allocate at most this number of bytes more than are allocated already.
pub fn with_memory_limit<T>(bytes: usize, action: impl FnOnce() -> T) -> T {
    LIMIT.store(ALLOCATED.load(Ordering::Relaxed) + bytes, Ordering::Relaxed);
    let result = action();
    LIMIT.store(usize::MAX, Ordering::Relaxed);
    result
}

/// Divides bytes into pieces of 1 to `longest` bytes, as a function of the bytes.
pub fn pieces(bytes: &[u8], longest: usize) -> impl Iterator<Item = &[u8]> {
    let mut state =
        bytes.iter().fold(0x9E37_79B9_7F4A_7C15u64, |s, b| (s ^ u64::from(*b)).wrapping_mul(0x100_0000_01B3));
    let mut rest = bytes;
    std::iter::from_fn(move || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        let length = 1 + (state >> 33) as usize % longest;
        let (piece, after) = rest.split_at(length.min(rest.len()));
        rest = after;
        (!piece.is_empty()).then_some(piece)
    })
}

/// Separator between the files of one input.
pub const SEPARATOR: &[u8] = b"\n====\n";

/// Divides an input into its files, at most `max_parts`; the last one has the rest.
pub fn parts(input: &[u8], max_parts: usize) -> Vec<&[u8]> {
    let (mut parts, mut rest) = (Vec::new(), input);
    while parts.len() + 1 < max_parts
        && let Some(at) = rest.windows(SEPARATOR.len()).position(|w| w == SEPARATOR)
    {
        parts.push(&rest[..at]);
        rest = &rest[at + SEPARATOR.len()..];
    }
    parts.push(rest);
    parts
}

/// Files of an input; absent ones are empty.
pub fn sections<const N: usize>(input: &[u8]) -> [&[u8]; N] {
    let mut parts = parts(input, N).into_iter();
    std::array::from_fn(|_| parts.next().unwrap_or_default())
}

/// Empty folder, in memory where the system supports it, otherwise among the temporary files.
pub fn folder() -> tempfile::TempDir {
    let memory = Path::new("/dev/shm");
    let parent = if memory.is_dir() { memory.to_owned() } else { std::env::temp_dir() };
    tempfile::tempdir_in(parent).expect("a folder")
}

/// Folder with the files of an input under these names, without the empty ones.
pub fn files<const N: usize>(names: &[&str; N], input: &[u8]) -> tempfile::TempDir {
    let folder = folder();
    for (name, bytes) in names.iter().zip(sections::<N>(input)) {
        if !bytes.is_empty() {
            std::fs::write(folder.path().join(name), bytes).expect("writes");
        }
    }
    folder
}
