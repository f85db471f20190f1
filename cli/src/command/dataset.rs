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
    /// Build maps, labels and a manifest from simulated and recorded sources; resumes where it was stopped
    Build(build::Arguments),
    /// Merge all shards of a build, or several datasets, into one dataset
    Merge(merge::Arguments),
    /// Show mean and sigma of the cells by scene, class and domain, and by how much people raise them
    Stats(stats::Arguments),
    /// Check hashes; find duplicates, maps in more than one split, and pairs whose two parts differ
    Verify(verify::Arguments),
    /// Print the script of a Slurm array that builds a dataset
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
