//! Networks that tell how many people a map shows.

mod hqnn;

pub use hqnn::{Bypass, FeatureScale, Hqnn, LatentConstants, MOST_POOLED, PAPER_POOLED, Stages};

use serde::{Deserialize, Serialize};

/// What a network is and costs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NetworkInfo {
    /// Name, as model files and commands spell it.
    pub name: String,
    /// Trained numbers.
    pub parameters: usize,
    /// Multiply-adds of one map of the size `input`.
    pub multiply_adds: u64,
    /// `[channel][range][doppler]` that `multiply_adds` is for; other sizes work too.
    pub input: [usize; 3],
}

/// All networks of this crate.
pub fn networks() -> Vec<NetworkInfo> {
    vec![Hqnn::info([1, 128, 128])]
}
