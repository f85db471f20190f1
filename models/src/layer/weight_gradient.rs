//! Gradients of weights: a product over all cells of a sweep.

use rayon::prelude::*;

use super::operation::unwritten;
use super::sweep::Sweep;
use super::tile::{OuterTile, Shared, Tiles, part};

/// Cells whose operands stay in the caches while all tiles go by.
const BLOCK: usize = 256;
/// Parts that the work is cut into, where it can be.
const TASKS: usize = 8;
/// Weights up to this many values are summed by parts of the batch; larger ones by parts of the outputs.
const SMALL_WEIGHTS: usize = 1 << 17;

/// Gradient `[output][channel][tap]` of a convolution's weights, where `gradient` `[cell][output]` belongs to what
/// `sweep` computes from `source`.
///
/// The parts depend on shapes only and are added up in their order: the same bits for any number of threads.
pub(super) fn weight_gradient(
    sweep: &Sweep,
    source: &[f32],
    gradient: &[f32],
    outputs: usize,
    tiles: Tiles,
) -> Vec<f32> {
    let cells = sweep.cells();
    let gathered = sweep.is_gathered();
    let all_taps = sweep.taps.len();
    let (taps, channels) = if gathered { (1, all_taps * sweep.channels) } else { (all_taps, sweep.channels) };
    assert_eq!(gradient.len(), cells * outputs);
    assert_eq!(source.len(), sweep.batch * sweep.source[0] * sweep.source[1] * sweep.channels);
    let size = taps * outputs * channels;
    let groups = if size <= SMALL_WEIGHTS { TASKS.min(cells.div_ceil(BLOCK)).max(1) } else { 1 };
    let output_tiles = outputs.div_ceil(tiles.rows);
    let splits = TASKS.div_ceil(groups).min(output_tiles);
    // [group][tap][output][channel]
    let mut sums = vec![0.0f32; groups * size];
    let shared = Shared::new(&mut sums);
    let zeros = vec![0.0f32; sweep.channels];
    let task = |scratch: &mut Scratch, index: usize| {
        let (group, split) = (index / splits, index % splits);
        let cells = part(cells, groups, group);
        let blocks = cells.len().div_ceil(BLOCK);
        for block in 0..blocks {
            let block = part(cells.len(), blocks, block);
            let block = cells.start + block.start..cells.start + block.end;
            scratch.addresses.resize(taps * block.len(), std::ptr::null());
            scratch.patches.resize(if gathered { channels * block.len() } else { 0 }, 0.0);
            sweep.addresses(block.clone(), source, &zeros, &mut scratch.patches, &mut scratch.addresses);
            for tap in 0..taps {
                for first_channel in (0..channels).step_by(tiles.width()) {
                    for output_tile in part(output_tiles, splits, split) {
                        let rows = part(outputs, output_tiles, output_tile);
                        let at = group * size + (tap * outputs + rows.start) * channels + first_channel;
                        let tile = OuterTile {
                            left: gradient[block.start * outputs + rows.start..].as_ptr(),
                            left_stride: outputs,
                            right: scratch.addresses[tap * block.len()..].as_ptr(),
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
    let (total, others) = sums.split_at_mut(size);
    const CHUNK: usize = 1 << 14;
    total.par_chunks_mut(CHUNK).enumerate().for_each(|(chunk, total)| {
        for other in others.chunks_exact(size.max(1)) {
            let other = &other[chunk * CHUNK..][..total.len()];
            total.iter_mut().zip(other).for_each(|(t, &o)| *t += o);
        }
    });
    sums.truncate(size);
    if all_taps == 1 {
        return sums;
    }
    let mut ordered = unwritten(size);
    let row = all_taps * sweep.channels;
    ordered.par_chunks_exact_mut(row).enumerate().for_each(|(output, to)| {
        for tap in 0..all_taps {
            let from = if gathered {
                &sums[output * row + tap * sweep.channels..][..sweep.channels]
            } else {
                &sums[(tap * outputs + output) * channels..][..channels]
            };
            for (channel, &value) in from.iter().enumerate() {
                to[channel * all_taps + tap] = value;
            }
        }
    });
    ordered
}

/// Sums over cells of each column of `[cell][column]`, in blocks added up in f64: a bias's gradient.
pub(super) fn column_sums(values: &[f32], columns: usize) -> Vec<f32> {
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
