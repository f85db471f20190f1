//! `radome dataset build`.

use std::path::PathBuf;

use super::counts;
use crate::dataset::build::build;
use crate::output;
use crate::shard::Shard;

/// `radome dataset build`
#[derive(clap::Args)]
pub struct Arguments {
    /// TOML file with the kind of map and the sources (examples in fixtures/datasets)
    spec: PathBuf,
    /// Folder to make; with --shard, the folder for the shards
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Make part I of N (from 0) for `dataset merge`; `auto/N` takes I from a Slurm, HyperQueue or Kubernetes
    /// array, `auto` takes I and N from a Slurm array
    #[arg(long, value_name = "I/N")]
    shard: Option<Shard>,
    /// Print one JSON object at the end
    #[arg(long)]
    json: bool,
}

/// Builds a dataset, or one shard of it.
///
/// # Errors
/// Those of [`build`].
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    output::catch_interrupts()?;
    let built = build(&arguments.spec, &arguments.output, arguments.shard)?;
    counts::print(&built, arguments.shard, arguments.json)
}
