//! `radome dataset slurm`.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};

use crate::dataset::plan::Plan;
use crate::output;
use crate::shard::Shard;

/// `radome dataset slurm`
#[derive(clap::Args)]
pub struct Arguments {
    /// Dataset spec
    spec: PathBuf,
    /// Folder that the shards come into; on a file system that all nodes see
    #[arg(short, long)]
    output: PathBuf,
    /// Tasks of the array
    #[arg(long, default_value_t = 8)]
    tasks: usize,
    /// Processor cores of a task
    #[arg(long, default_value_t = 1)]
    cpus: usize,
}

/// Prints the script of an array job; `sbatch` takes it.
///
/// # Errors
/// The spec cannot be planned, a number is zero, or a path has no full form or cannot stand in a script.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    if arguments.tasks == 0 || arguments.cpus == 0 {
        bail!("an array has at least one task, and a task one core");
    }
    // What is wrong with the spec is said here rather than by every task.
    let plan = Plan::new(&arguments.spec, Shard { index: 0, count: arguments.tasks })?;
    if plan.units.len() < arguments.tasks {
        eprintln!("there are {} units for {} tasks: some will have nothing to do", plan.units.len(), arguments.tasks);
    }
    let program = std::env::current_exe().context("cannot find this program's own path")?;
    let absolute =
        |path: &Path| std::path::absolute(path).with_context(|| format!("{} has no full path", path.display()));
    let name = arguments.spec.file_stem().unwrap_or_default().to_string_lossy();
    let name: String =
        name.chars().map(|c| if c.is_ascii_alphanumeric() || "-_.".contains(c) { c } else { '-' }).collect();
    let (spec, folder) = (quoted(&absolute(&arguments.spec)?)?, quoted(&absolute(&arguments.output)?)?);
    let program = quoted(&program)?;
    let (tasks, cpus, last) = (arguments.tasks, arguments.cpus, arguments.tasks - 1);
    output::text_line(&format!(
        "#!/bin/sh
#SBATCH --job-name=radome-{name}
#SBATCH --array=0-{last}
#SBATCH --cpus-per-task={cpus}
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --output=radome-{name}-%A_%a.log
# Every task makes its shard, whole or not at all; one that was killed goes on where it was. When all are done:
#     {program} dataset merge {folder}/shard-*-of-{tasks:05} -o DATASET
# which can be queued behind the array:
#     sbatch --dependency=afterok:$(sbatch --parsable THIS_SCRIPT) --wrap '...'
set -eu
export RAYON_NUM_THREADS=\"${{SLURM_CPUS_PER_TASK:-{cpus}}}\"
exec {program} dataset build {spec} -o {folder} --shard auto/{tasks}"
    ))
}

/// A path as one word of a shell.
fn quoted(path: &Path) -> anyhow::Result<String> {
    let text = path
        .to_str()
        .with_context(|| format!("{}: a path that is not UTF-8 cannot go into a script", path.display()))?;
    let plain = |c: char| c.is_ascii_alphanumeric() || "/-_.+,@%".contains(c);
    if text.contains('\n') {
        bail!("{text:?}: a path with a line's end cannot go into a script");
    }
    Ok(if text.chars().all(plain) { text.to_owned() } else { format!("'{}'", text.replace('\'', "'\\''")) })
}
