//! Weights in the order in which tiles read them.

use std::ops::Range;

use rayon::prelude::*;

use super::buffer::uninitialised;
use super::tile::Tiles;

/// Weights `[panel][offset][channel][column of the panel]`. Each panel is as wide as a tile; the last one is a single vector
/// if that is enough. It is padded with zeros.
pub(crate) struct Packed {
    pub values: Vec<f32>,
    /// Offsets times channels.
    pub depth: usize,
    pub columns: usize,
    pub tiles: Tiles,
}

/// Direction of a product.
#[derive(Clone, Copy)]
pub(crate) enum Side {
    /// Columns are outputs, channels inputs.
    Forward,
    /// Columns are inputs, channels outputs.
    Backward,
}

impl Packed {
    /// Packs weights `[output][input][offset]`.
    pub fn new(weight: &[f32], [outputs, inputs, offsets]: [usize; 3], side: Side, tiles: Tiles) -> Self {
        let (columns, channels) = match side {
            Side::Forward => (outputs, inputs),
            Side::Backward => (inputs, outputs),
        };
        let depth = offsets * channels;
        Self::with_panels(columns, depth, tiles, |columns, width, target| {
            match side {
                Side::Forward => {
                    // One stream for each column, so that both sides access memory in order.
                    let streams: Vec<&[f32]> = columns.map(|o| &weight[o * depth..(o + 1) * depth]).collect();
                    for channel in 0..channels {
                        for offset in 0..offsets {
                            let target = &mut target[(offset * channels + channel) * width..][..streams.len()];
                            for (value, stream) in target.iter_mut().zip(&streams) {
                                *value = stream[channel * offsets + offset];
                            }
                        }
                    }
                }
                Side::Backward => {
                    for o in 0..outputs {
                        let source = &weight[o * inputs * offsets..(o + 1) * inputs * offsets];
                        for offset in 0..offsets {
                            let target = &mut target[(offset * channels + o) * width..][..columns.len()];
                            for (value, i) in target.iter_mut().zip(columns.clone()) {
                                *value = source[i * offsets + offset];
                            }
                        }
                    }
                }
            }
        })
    }

    /// Makes weights of `columns` columns, `depth` for each. `fill` gets a range of columns, the width of a panel, and the panel
    /// `[depth][width]`, to which it writes the weights of these columns. Padding is zero.
    pub fn with_panels(
        columns: usize,
        depth: usize,
        tiles: Tiles,
        fill: impl Fn(Range<usize>, usize, &mut [f32]) + Sync,
    ) -> Self {
        let mut values = uninitialised(Self::padded_columns(columns, tiles) * depth);
        values.par_chunks_mut((tiles.width() * depth).max(1)).enumerate().for_each(|(panel, target)| {
            let first = panel * tiles.width();
            let (columns, width) = (first..columns.min(first + tiles.width()), target.len() / depth);
            if columns.len() < width {
                target.fill(0.0);
            }
            fill(columns, width, target);
        });
        Packed { values, depth, columns, tiles }
    }

    /// Number of columns with padding.
    fn padded_columns(columns: usize, tiles: Tiles) -> usize {
        columns.next_multiple_of(tiles.lanes)
    }

    /// Copies `values`, one for each column, and adds zeros as padding.
    pub fn pad(&self, values: &[f32]) -> Vec<f32> {
        let mut padded = values.to_vec();
        padded.resize(Self::padded_columns(self.columns, self.tiles), 0.0);
        padded
    }

    /// Number of panels.
    pub fn panels(&self) -> usize {
        self.columns.div_ceil(self.tiles.width())
    }
}
