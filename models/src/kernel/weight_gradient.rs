//! Gradients of weights: products over all cells of an implicit GEMM.

use rayon::prelude::*;

use super::buffer::uninitialised;
use super::implicit_gemm::ImplicitGemm;
use super::tile::{OuterTile, SharedBuffer, Tiles, part};

/// Number of cells of a block, whose operands stay in the caches over all tiles.
const BLOCK: usize = 256;
/// Number of tasks, where the product is large enough.
const TASKS: usize = 8;
/// Number of weights up to which tasks divide the cells. With more weights, tasks divide the outputs.
const SMALL_WEIGHTS: usize = 1 << 17;

/// Gradient `[output][channel][offset]` of a convolution's weights, where `gradient` `[cell][output]` is that of the result of
/// `gemm` on `source`.
///
/// The division into tasks depends on shapes only, and sums are added in order: the same bits for any number of threads.
pub(crate) fn weight_gradient(
    gemm: &ImplicitGemm,
    source: &[f32],
    gradient: &[f32],
    outputs: usize,
    tiles: Tiles,
) -> Vec<f32> {
    let cells = gemm.cells();
    let gathered = gemm.is_gathered();
    let all_offsets = gemm.offsets.len();
    let (offsets, channels) = if gathered { (1, all_offsets * gemm.channels) } else { (all_offsets, gemm.channels) };
    assert_eq!(gradient.len(), cells * outputs);
    assert_eq!(source.len(), gemm.batch * gemm.source[0] * gemm.source[1] * gemm.channels);
    let size = offsets * outputs * channels;
    let groups = if size <= SMALL_WEIGHTS { TASKS.min(cells.div_ceil(BLOCK)).max(1) } else { 1 };
    let output_tiles = outputs.div_ceil(tiles.rows);
    let splits = TASKS.div_ceil(groups).min(output_tiles);
    // [group][offset][output][channel]
    let mut sums = vec![0.0f32; groups * size];
    let shared = SharedBuffer::new(&mut sums);
    let zeros = vec![0.0f32; gemm.channels];
    let task = |scratch: &mut Scratch, index: usize| {
        let (group, split) = (index / splits, index % splits);
        let cells = part(cells, groups, group);
        let blocks = cells.len().div_ceil(BLOCK);
        for block in 0..blocks {
            let block = part(cells.len(), blocks, block);
            let block = cells.start + block.start..cells.start + block.end;
            scratch.addresses.resize(offsets * block.len(), std::ptr::null());
            scratch.patches.resize(if gathered { channels * block.len() } else { 0 }, 0.0);
            let patches = gathered.then_some(&mut scratch.patches[..]);
            gemm.addresses(block.clone(), source, &zeros, patches, &mut scratch.addresses);
            for offset in 0..offsets {
                for first_channel in (0..channels).step_by(tiles.width()) {
                    for output_tile in part(output_tiles, splits, split) {
                        let rows = part(outputs, output_tiles, output_tile);
                        let at = group * size + (offset * outputs + rows.start) * channels + first_channel;
                        let tile = OuterTile {
                            left: gradient[block.start * outputs + rows.start..].as_ptr(),
                            left_stride: outputs,
                            right: scratch.addresses[offset * block.len()..].as_ptr(),
                            right_offset: first_channel,
                            cells: block.len(),
                            // SAFETY: inside `sums`: at most its last row of channels.
                            target: unsafe { shared.get().add(at) },
                            target_stride: channels,
                            columns: tiles.width().min(channels - first_channel),
                        };
                        // SAFETY: all addresses are of whole cells; no other task has this group and these outputs.
                        unsafe { tiles.outer_tile(rows.len(), &tile) };
                    }
                }
            }
        }
    };
    (0..groups * splits).into_par_iter().for_each_init(Scratch::default, task);
    add_groups(&mut sums, size);
    if all_offsets == 1 { sums } else { offsets_last(gemm, &sums, outputs, gathered) }
}

/// Adds the sums of all groups, each of `size` values, in their order, and keeps the totals.
fn add_groups(sums: &mut Vec<f32>, size: usize) {
    const CHUNK: usize = 1 << 14;
    let (total, others) = sums.split_at_mut(size);
    total.par_chunks_mut(CHUNK).enumerate().for_each(|(chunk, total)| {
        for other in others.chunks_exact(size.max(1)) {
            let other = &other[chunk * CHUNK..][..total.len()];
            total.iter_mut().zip(other).for_each(|(t, &o)| *t += o);
        }
    });
    sums.truncate(size);
}

/// Transposes sums `[offset][output][channel]`, or `[output][offset][channel]` of gathered cells, to `[output][channel][offset]`.
fn offsets_last(gemm: &ImplicitGemm, sums: &[f32], outputs: usize, gathered: bool) -> Vec<f32> {
    let (offsets, channels) = (gemm.offsets.len(), gemm.channels);
    let row = offsets * channels;
    let mut transposed = uninitialised(sums.len());
    transposed.par_chunks_exact_mut(row).enumerate().for_each(|(output, target)| {
        for offset in 0..offsets {
            let index = if gathered { output * offsets + offset } else { offset * outputs + output };
            let source = &sums[index * channels..][..channels];
            for (channel, &value) in source.iter().enumerate() {
                target[channel * offsets + offset] = value;
            }
        }
    });
    transposed
}

/// Sums over cells of each column of `[cell][column]`, in blocks added in f64: the gradient of a bias.
pub(crate) fn column_sums(values: &[f32], columns: usize) -> Vec<f32> {
    if columns == 0 {
        return Vec::new();
    }
    let partials: Vec<Vec<f32>> = values
        .par_chunks(BLOCK * columns)
        .map(|block| {
            let mut sums = vec![0.0f32; columns];
            for row in block.chunks_exact(columns) {
                sums.iter_mut().zip(row).for_each(|(s, &v)| *s += v);
            }
            sums
        })
        .collect();
    let mut sums = vec![0.0f64; columns];
    for partial in &partials {
        sums.iter_mut().zip(partial).for_each(|(s, &v)| *s += f64::from(v));
    }
    sums.into_iter().map(|s| s as f32).collect()
}

#[derive(Default)]
struct Scratch {
    addresses: Vec<*const f32>,
    patches: Vec<f32>,
}
