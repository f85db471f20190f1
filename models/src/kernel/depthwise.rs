//! Depthwise convolution. Channels are contiguous, so they are the vector lanes.

use std::cell::RefCell;

use rayon::prelude::*;

use super::implicit_gemm::ImplicitGemm;
use super::spin_pool::for_each_task;
use super::tile::{ChannelTile, OffsetTile, SharedBuffer, Tiles, part};

/// Largest number of cells of a task, and the smallest number for which another task is worth its cost.
const CELLS_PER_TASK: [usize; 2] = [256, 16];
/// Least number of tasks, where the map is large enough.
const TASKS: usize = 8;

/// Transposes a matrix `[row][column]` with this number of columns, such as weights `[channel][offset]` to `[offset][channel]`.
pub(crate) fn transposed(values: &[f32], columns: usize) -> Vec<f32> {
    let rows = values.len() / columns;
    let mut transposed = vec![0.0; values.len()];
    for (row, values) in values.chunks_exact(columns).enumerate() {
        for (column, &value) in values.iter().enumerate() {
            transposed[column * rows + row] = value;
        }
    }
    transposed
}

/// Computes `target = init + sum over offsets of source * weight` for all cells of a product; `weight` is `[offset][channel]`, and
/// `init` has a value for each channel.
pub(crate) fn run(
    gemm: &ImplicitGemm,
    source: &[f32],
    weight: &[f32],
    init: Option<&[f32]>,
    target: &mut [f32],
    tiles: Tiles,
) {
    let (cells, channels, offsets) = (gemm.cells(), gemm.channels, gemm.offsets.len());
    assert_eq!(source.len(), gemm.batch * gemm.source[0] * gemm.source[1] * channels);
    assert_eq!(target.len(), gemm.batch * gemm.target[0] * gemm.target[1] * channels);
    assert!(gemm.offsets.iter().all(|t| (t.index as usize + 1) * channels <= weight.len()));
    let indices: Vec<u32> = gemm.offsets.iter().map(|t| t.index).collect();
    let zeros = vec![0.0f32; channels];
    let [most, least] = CELLS_PER_TASK;
    let tasks = cells.div_ceil(most).max(cells.div_ceil(least).min(TASKS));
    let shared = SharedBuffer::new(target);
    let task = |scratch: &mut Scratch, index: usize| {
        let cells = part(cells, tasks, index);
        scratch.addresses.resize(offsets * cells.len(), std::ptr::null());
        gemm.addresses(cells.clone(), source, &zeros, None, &mut scratch.addresses);
        gemm.targets(cells.clone(), channels, shared, &mut scratch.targets);
        let row_tiles = cells.len().div_ceil(ChannelTile::ROWS);
        for tile in 0..row_tiles {
            let rows = part(cells.len(), row_tiles, tile);
            let tile = ChannelTile {
                cells: scratch.addresses[rows.start..].as_ptr(),
                cell_stride: cells.len(),
                offsets: indices.as_ptr(),
                offset_count: offsets,
                weights: weight.as_ptr(),
                init: init.map_or(std::ptr::null(), <[f32]>::as_ptr),
                targets: scratch.targets[rows.start..].as_ptr(),
                channels,
            };
            // SAFETY: all addresses are of `channels` values; no other task has these cells.
            unsafe { tiles.channel_tile(rows.len(), &tile) };
        }
    };
    for_each_task(tasks, |index| SCRATCH.with_borrow_mut(|scratch| task(scratch, index)));
}

/// Gradient `[channel][offset]` of the weights, where `gradient` is that of the result of `gemm` on `source`. Partial sums over a
/// fixed number of cells are added in order.
pub(crate) fn weight_gradient(gemm: &ImplicitGemm, source: &[f32], gradient: &[f32], tiles: Tiles) -> Vec<f32> {
    const BLOCK: usize = 64;
    const BLOCKS_PER_TASK: usize = 16;
    let (cells, channels, offsets) = (gemm.cells(), gemm.channels, gemm.offsets.len());
    assert_eq!(source.len(), gemm.batch * gemm.source[0] * gemm.source[1] * channels);
    assert_eq!(gradient.len(), cells * channels);
    let zeros = vec![0.0f32; channels];
    let offset_tiles = offsets.div_ceil(tiles.rows);
    let tasks = cells.div_ceil(BLOCK * BLOCKS_PER_TASK);
    let partials: Vec<Vec<f32>> = (0..tasks)
        .into_par_iter()
        .map_init(Scratch::default, |scratch, index| {
            let mut sums = vec![0.0f32; offsets * channels];
            let cells = part(cells, tasks, index);
            let blocks = cells.len().div_ceil(BLOCK);
            for block in 0..blocks {
                let block = part(cells.len(), blocks, block);
                let block = cells.start + block.start..cells.start + block.end;
                scratch.addresses.resize(offsets * block.len(), std::ptr::null());
                gemm.addresses(block.clone(), source, &zeros, None, &mut scratch.addresses);
                for offset_tile in 0..offset_tiles {
                    let rows = part(offsets, offset_tiles, offset_tile);
                    let tile = OffsetTile {
                        cells: scratch.addresses[rows.start * block.len()..].as_ptr(),
                        cell_count: block.len(),
                        gradient: gradient[block.start * channels..].as_ptr(),
                        target: sums[rows.start * channels..].as_mut_ptr(),
                        channels,
                    };
                    // SAFETY: all addresses are of `channels` values.
                    unsafe { tiles.offset_tile(rows.len(), &tile) };
                }
            }
            sums
        })
        .collect();
    let mut total = vec![0.0f32; offsets * channels];
    for partial in &partials {
        total.iter_mut().zip(partial).for_each(|(t, &p)| *t += p);
    }
    transposed(&total, channels)
}

#[derive(Default)]
struct Scratch {
    addresses: Vec<*const f32>,
    targets: Vec<*mut f32>,
}

thread_local! {
    static SCRATCH: RefCell<Scratch> = RefCell::default();
}
