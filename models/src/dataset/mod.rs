//! Labelled range-Doppler maps: a folder with a header, shards of maps and a manifest.
//!
//! ```text
//! dataset.json      format version, waveform, map spec, shape, names of axes and classes   (DatasetHeader)
//! manifest.jsonl    one row a map, in order                                               (ManifestRow)
//! maps-00000.npy    f32 dB, [map][rx][doppler][range], up to 256 maps a shard
//! ```
//! A folder is written under a temporary name and renamed when complete. A folder with the final name is therefore
//! complete.

mod error;
mod features;
mod header;
mod layout;
mod lock;
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
pub use layout::network_input;
pub use lock::{lock_file, lock_folder, share_folder};
pub(crate) use manifest::sequence_hash;
pub use manifest::{Domain, ManifestRow, Split, SplitBy};
pub use merge::merge;
pub use reader::{Dataset, MANIFEST_LIMIT_BYTES};
pub use split::SplitSpec;
pub use statistics::{GroupStatistics, Moments, statistics};
pub use verify::{Damage, Duplicate, Leak, PairMismatch, VerifyReport, verify};
pub use writer::DatasetWriter;
