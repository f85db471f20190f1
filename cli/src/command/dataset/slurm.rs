//! `radome dataset slurm`.

use std::path::PathBuf;

use crate::dataset::plan::Plan;
use crate::output;
use crate::shard::Shard;
use crate::slurm::{Array, word};

/// `radome dataset slurm`
#[derive(clap::Args)]
pub struct Arguments {
    /// Dataset spec
    spec: PathBuf,
    #[command(flatten)]
    array: Array,
}

/// Prints the script of an array job; `sbatch` takes it.
///
/// # Errors
/// The spec cannot be planned, a number is zero, or a path has no full form or cannot stand in a script.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let Arguments { spec, array } = arguments;
    array.check()?;
    // Errors in the spec are reported here once rather than by every task.
    let plan = Plan::new(spec, Shard { index: 0, count: array.tasks })?;
    if plan.units.len() < array.tasks {
        message!("there are {} units for {} tasks: some will have nothing to do", plan.units.len(), array.tasks);
    }
    let folder = word(&array.output)?;
    let shard = format!("dataset build {} -o {folder}", word(spec)?);
    let merge = format!("dataset merge {folder}/shard-*-of-{:05} -o DATASET", array.tasks);
    output::text_line(&array.script(spec, &shard, &merge)?)
}
