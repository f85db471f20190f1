//! Commands, grouped by noun: one file per group and one per command.

mod bench;
mod board;
mod dataset;
mod demo;
mod doctor;
pub mod former_names;
mod live;
mod manual;
mod model;
mod record;
mod recording;
mod scene;
mod schema;

use clap::Subcommand;
pub use doctor::WireLog;

use crate::exit::Completion;

/// Commands of the program.
// There is one in a program: its size does not matter.
#[allow(clippy::large_enum_variant)]
#[derive(Subcommand)]
pub enum Command {
    /// Watch an emulated board that streams a simulated corridor; nothing has to be attached
    Demo(demo::Arguments),
    /// Classify a source as it comes: the room is empty, holds one person, or holds two or more
    Live(live::Arguments),
    /// Record a source to a file, with a gap where frames are lost
    Record(record::Arguments),
    /// Check this machine for problems: permissions, ports, ONNX Runtime, board, disk; with --model also a model
    Doctor(doctor::Arguments),
    /// Boards: list, config, emulate, reset
    #[command(subcommand)]
    Board(board::Action),
    /// Recordings: info, convert, repair, label, answers, maps, echoes
    #[command(subcommand)]
    Recording(recording::Action),
    /// Scenes: simulate, paths, preview, calibrate, pair
    #[command(subcommand)]
    Scene(scene::Action),
    /// Datasets of labelled maps: build, merge, stats, verify, slurm
    #[command(subcommand)]
    Dataset(dataset::Action),
    /// Networks and models: train, adapt, background, evaluate, study, slurm, export, list
    #[command(subcommand)]
    Model(model::Action),
    /// Measure speed and error of every stage in one table, or of one stage; for developers
    Bench(bench::Arguments),
    /// Print the JSON schema of a kind of TOML file, by which editors complete and check keys
    Schema(schema::Arguments),
    /// Print a script that completes commands and options in a shell
    Completions(manual::CompletionArguments),
    /// Write manual pages of all commands
    Man(manual::ManArguments),
}

/// Runs a command. `program` describes all commands and options.
///
/// # Errors
/// Those of the command.
pub fn run(command: Command, program: fn() -> clap::Command) -> anyhow::Result<Completion> {
    let done: anyhow::Result<()> = match command {
        Command::Demo(arguments) => return demo::run(arguments),
        Command::Live(arguments) => return live::run(&arguments),
        Command::Record(arguments) => return record::run(&arguments),
        Command::Doctor(arguments) => doctor::run(&arguments),
        Command::Board(action) => board::run(&action),
        Command::Recording(action) => return recording::run(&action),
        Command::Scene(action) => scene::run(&action),
        Command::Dataset(action) => dataset::run(&action),
        Command::Model(action) => model::run(&action),
        Command::Bench(arguments) => bench::run(&arguments),
        Command::Schema(arguments) => schema::run(&arguments),
        Command::Completions(arguments) => manual::completions(&arguments, program()),
        Command::Man(arguments) => manual::man(&arguments, program()),
    };
    done.map(|()| Completion::Done)
}
