//! `radome dataset merge`.

use std::path::PathBuf;

use super::counts;
use crate::dataset::merge::merge;

/// `radome dataset merge`
#[derive(clap::Args)]
pub struct Arguments {
    /// All shards of one build, or datasets with the same kind of maps, in the order of the result
    #[arg(required = true)]
    parts: Vec<PathBuf>,
    /// Folder to make
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Print one JSON object at the end
    #[arg(long)]
    json: bool,
}

/// Merges shards or datasets.
///
/// # Errors
/// Those of [`merge`].
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    counts::print(&merge(&arguments.parts, &arguments.output)?, None, arguments.json)
}
