//! Script of a Slurm array whose tasks are the shards of one command.

use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};

use crate::exit::wrong_use;
use crate::shell;

/// Options of commands that print the script of an array.
#[derive(clap::Args)]
pub struct Array {
    /// Folder for the shards, on a file system that all nodes share
    #[arg(short, long, value_name = "DIR")]
    pub output: PathBuf,
    /// Tasks of the array
    #[arg(long, default_value_t = 8)]
    pub tasks: usize,
    /// Processor cores of a task
    #[arg(long, default_value_t = 1)]
    pub cpus: usize,
}

impl Array {
    /// Refuses an array without tasks.
    ///
    /// # Errors
    /// A number is zero.
    pub fn check(&self) -> anyhow::Result<()> {
        if self.tasks == 0 || self.cpus == 0 {
            wrong_use!("an array has at least one task, and a task one core");
        }
        Ok(())
    }

    /// Returns the script for `sbatch`. `shard` is the command of a shard without its `--shard`. `merge` is the command
    /// that runs after all shards. Both lack the program's name. The array is named after `spec`.
    ///
    /// # Errors
    /// The program's own path is unknown or cannot stand in a script.
    pub fn script(&self, spec: &Path, shard: &str, merge: &str) -> anyhow::Result<String> {
        let program = word(&std::env::current_exe().context("cannot find this program's own path")?)?;
        let name = spec.file_stem().unwrap_or_default().to_string_lossy();
        let is_plain = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
        let name: String = name.chars().map(|c| if is_plain(c) { c } else { '-' }).collect();
        let (tasks, cpus, last) = (self.tasks, self.cpus, self.tasks.saturating_sub(1));
        Ok(format!(
            "#!/bin/sh
#SBATCH --job-name=radome-{name}
#SBATCH --array=0-{last}
#SBATCH --cpus-per-task={cpus}
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --output=radome-{name}-%A_%a.log
# Every task makes its shard, whole or not at all; one that was killed goes on where it was. When all are done:
#     {program} {merge}
# which can be queued behind the array:
#     sbatch --dependency=afterok:$(sbatch --parsable THIS_SCRIPT) --wrap '...'
set -eu
export RAYON_NUM_THREADS=\"${{SLURM_CPUS_PER_TASK:-{cpus}}}\"
exec {program} {shard} --shard auto/{tasks}"
        ))
    }
}

/// Formats the full form of a path as one word of a shell.
///
/// # Errors
/// The path has no full form, is not UTF-8, or has a line's end in it.
pub fn word(path: &Path) -> anyhow::Result<String> {
    word_with("", path)
}

/// Formats a text followed by the full form of a path, as one word of a shell.
///
/// # Errors
/// Those of [`word`].
pub fn word_with(text: &str, path: &Path) -> anyhow::Result<String> {
    let path = std::path::absolute(path).with_context(|| format!("{} has no full path", path.display()))?;
    let full = path
        .to_str()
        .with_context(|| format!("{}: a path that is not UTF-8 cannot go into a script", path.display()))?;
    let text = format!("{text}{full}");
    ensure!(!text.contains('\n'), "{text:?}: a path with a line's end cannot go into a script");
    Ok(shell::word(&text))
}
