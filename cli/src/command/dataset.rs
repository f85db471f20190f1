//! `radome dataset`: builds labelled maps from a spec, on one machine or many.

mod build;
mod counts;
mod features;
mod merge;
mod slurm;
mod stats;
mod verify;

#[derive(clap::Subcommand)]
pub enum Action {
    /// Maps, labels and manifest from simulated and recorded sources; goes on where an earlier run was stopped
    Build(build::Arguments),
    /// One dataset of all shards of a build, or of several datasets
    Merge(merge::Arguments),
    /// Mean and sigma of the cells by scene, class and domain, and how much people raise them
    Stats(stats::Arguments),
    /// Hashes, duplicates, and what lies in more than one split
    Verify(verify::Arguments),
    /// The script of a Slurm array that builds a dataset
    Slurm(slurm::Arguments),
}

/// Runs a command of the group.
///
/// # Errors
/// Those of the command.
pub fn run(action: &Action) -> anyhow::Result<()> {
    match action {
        Action::Build(arguments) => build::run(arguments),
        Action::Merge(arguments) => merge::run(arguments),
        Action::Stats(arguments) => stats::run(arguments),
        Action::Verify(arguments) => verify::run(arguments),
        Action::Slurm(arguments) => slurm::run(arguments),
    }
}
