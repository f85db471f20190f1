//! Labelled range-Doppler maps: a folder with a header, shards of maps and a manifest.
//!
//! ```text
//! dataset.json      format version, waveform, map spec, shape, names of axes and classes   (DatasetHeader)
//! manifest.jsonl    one row a map, in order                                               (ManifestRow)
//! maps-00000.npy    f32 dB, [map][rx][doppler][range], up to 256 maps a shard
//! ```
//! A folder is written under a temporary name and renamed when complete, so what has the right name is whole.

mod error;
mod features;
mod header;
mod manifest;
mod merge;
mod reader;
mod split;
mod statistics;
#[cfg(test)]
mod tests;
mod verify;
mod writer;

pub use error::DatasetError;
pub use features::{ClassFeatures, FeatureError, Features, LEAKAGE_BINS, Spread, features};
pub use header::{DatasetHeader, FORMAT_VERSION};
pub use manifest::{Domain, ManifestRow, Split};
pub use merge::merge;
pub use reader::{Dataset, MANIFEST_LIMIT_BYTES};
pub use split::{SplitBy, SplitSpec};
pub use statistics::{CellStatistics, Moments, statistics};
pub use verify::{Damage, Duplicate, Leak, PairFault, VerifyReport, verify};
pub use writer::{DatasetWriter, lock_folder};

use radome_dsp::RdmShape;

/// Maps in one shard.
const MAPS_PER_SHARD: usize = 256;

fn shard_name(shard: usize) -> String {
    format!("maps-{shard:05}.npy")
}

/// One channel of a map as a network sees it: `[doppler][range]` of channel `rx` transposed to `[range][doppler]`.
///
/// `None` if the cells do not match the shape or there is no such channel.
pub fn network_input(db: &[f32], shape: RdmShape, rx: usize) -> Option<Vec<f32>> {
    if db.len() != shape.cells() || rx >= shape.rx {
        return None;
    }
    let plane = db.get(rx * shape.doppler * shape.range..(rx + 1) * shape.doppler * shape.range)?;
    let mut out = Vec::with_capacity(plane.len());
    for range in 0..shape.range {
        out.extend(plane.iter().skip(range).step_by(shape.range.max(1)));
    }
    Some(out)
}
