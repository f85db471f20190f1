//! `radome model`: training, evaluation, adaptation and export of networks.

mod adapt;
mod background;
mod evaluate;
mod export;
mod list;
mod slurm;
mod study;
mod train;

pub use study::StudyFile;

#[derive(clap::Subcommand)]
pub enum Action {
    /// Train a network on a dataset
    Train(train::Arguments),
    /// Adapt a model to one room with labelled recordings of the room, or with a recording of the empty room
    Adapt(adapt::Arguments),
    /// Measure what a model reads in an empty room, so that fans and curtains do not count as people
    Background(background::Arguments),
    /// Measure a model on a dataset or on labelled recordings; compare models on simulated recordings
    Evaluate(evaluate::Arguments),
    /// Compare networks over seeds, noise and shares of the labels in one report; resumes where it was stopped
    Study(study::Arguments),
    /// Print the script of a Slurm array that runs a study
    Slurm(slurm::Arguments),
    /// Export a model as ONNX
    Export(export::Arguments),
    /// List the networks: parameters, multiply-adds, input
    List(list::Arguments),
}

/// Runs a command of the group.
///
/// # Errors
/// Those of the command.
pub fn run(action: &Action) -> anyhow::Result<()> {
    match action {
        Action::Train(arguments) => train::run(arguments),
        Action::Adapt(arguments) => adapt::run(arguments),
        Action::Background(arguments) => background::run(arguments),
        Action::Evaluate(arguments) => evaluate::run(arguments),
        Action::Study(arguments) => study::run(arguments),
        Action::Slurm(arguments) => slurm::run(arguments),
        Action::Export(arguments) => export::run(arguments),
        Action::List(arguments) => list::run(arguments),
    }
}
