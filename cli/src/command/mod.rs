//! One file per command.

mod adapt;
mod background;
mod bench;
mod calibrate;
mod circuit;
mod config;
mod convert;
mod dataset;
mod demo;
mod devices;
mod doctor;
mod echoes;
mod emulate;
mod evaluate;
mod export;
mod labels;
mod live;
mod manual;
mod models;
mod paths;
mod rcs;
mod rdm;
mod record;
mod repair;
mod results;
mod simulate;
mod study;
mod train;

use clap::Subcommand;
pub use doctor::WireLog;

use crate::exit::Ended;

/// What the program can do.
// There is one in a program: its size does not matter.
#[allow(clippy::large_enum_variant)]
#[derive(Subcommand)]
pub enum Command {
    /// The main job with nothing attached: an emulated board streams a simulated corridor, a trained network watches
    Demo(demo::Arguments),
    /// Boards and debug probes on this machine: who they say they are, or what to do about those that cannot be used
    Devices(devices::Arguments),
    /// What could keep the program from working here: permissions, ports, library, model against board, disk
    Doctor(doctor::Arguments),
    /// Check a waveform: derived ranges, resolutions, data rate
    Config(config::Arguments),
    /// Capture a source to a file, lossless or loud
    Record(record::Arguments),
    /// Say while it happens whether the room is empty, holds one person, or holds two or more
    Live(live::Arguments),
    /// Capture what an empty room shows, so that fans and curtains are not taken for people
    Background(background::Arguments),
    /// An emulated board on a pty that serves any source until stopped
    Emulate(emulate::Arguments),
    /// A recording in another format: MCAP, Infineon's folder, text
    Convert(convert::Arguments),
    /// What can be read of a cut or damaged recording, as a new file, and what is lost
    Repair(repair::Arguments),
    /// What was said about the frames of a recording, as CSV
    Results(results::Arguments),
    /// Labels of a recording, to and from Audacity tracks and DEEPCRAFT files
    Labels(labels::Arguments),
    /// One target through the solver: radar cross-section, analytic value, error, time
    Rcs(rcs::Arguments),
    /// Range-Doppler maps of a source as an array
    Rdm(rdm::Arguments),
    /// Range, speed, azimuth and elevation of what moves, frame by frame; and what a board's receivers are unlike in
    Echoes(echoes::Arguments),
    /// Every path between the antennas of a scene at one time: surfaces, length, delay, Doppler shift, gain, phase
    Paths(paths::Arguments),
    /// Simulate a scene: raw frames, truth and labels
    Simulate(simulate::Arguments),
    /// Fit a receiver to a recording; how far simulations are from it, before and after
    Calibrate(calibrate::Arguments),
    /// Datasets of labelled maps
    Dataset(dataset::Arguments),
    /// Train a network on a dataset
    Train(train::Arguments),
    /// Metrics of a model on a dataset or on labelled recordings; several models compared on a ladder of simulated recordings
    Evaluate(evaluate::Arguments),
    /// Adapt a model to one room by labelled recordings of it, or by a minute of it empty
    Adapt(adapt::Arguments),
    /// Compare networks over seeds, noise and shares of the labels: one report, carried on with where it was stopped
    Study(study::Arguments),
    /// A model as ONNX
    Export(export::Arguments),
    /// The networks: parameters, multiply-adds, input
    Models(models::Arguments),
    /// The quantum layer at one point: expectations and gradients
    Circuit(circuit::Arguments),
    /// Speed against error: every stage in one table, or one stage in detail
    Bench(bench::Arguments),
    /// A script that completes commands and options in a shell
    Completions(manual::CompletionArguments),
    /// Manual pages of all commands
    Man(manual::ManArguments),
}

/// Runs a command.
pub fn run(command: Command) -> anyhow::Result<Ended> {
    let done: anyhow::Result<()> = match command {
        Command::Demo(arguments) => return demo::run(arguments),
        Command::Devices(arguments) => devices::run(&arguments),
        Command::Doctor(arguments) => doctor::run(&arguments),
        Command::Config(arguments) => config::run(&arguments),
        Command::Record(arguments) => return record::run(&arguments),
        Command::Live(arguments) => return live::run(&arguments),
        Command::Background(arguments) => background::run(&arguments),
        Command::Emulate(arguments) => emulate::run(&arguments),
        Command::Convert(arguments) => convert::run(&arguments),
        Command::Repair(arguments) => return repair::run(&arguments),
        Command::Results(arguments) => results::run(&arguments),
        Command::Labels(arguments) => labels::run(&arguments),
        Command::Rcs(arguments) => rcs::run(&arguments),
        Command::Rdm(arguments) => rdm::run(&arguments),
        Command::Echoes(arguments) => echoes::run(&arguments),
        Command::Paths(arguments) => paths::run(&arguments),
        Command::Simulate(arguments) => simulate::run(&arguments),
        Command::Calibrate(arguments) => calibrate::run(&arguments),
        Command::Dataset(arguments) => dataset::run(&arguments),
        Command::Train(arguments) => train::run(&arguments),
        Command::Evaluate(arguments) => evaluate::run(&arguments),
        Command::Adapt(arguments) => adapt::run(&arguments),
        Command::Study(arguments) => study::run(&arguments),
        Command::Export(arguments) => export::run(&arguments),
        Command::Models(arguments) => models::run(&arguments),
        Command::Circuit(arguments) => circuit::run(&arguments),
        Command::Bench(arguments) => bench::run(&arguments),
        Command::Completions(arguments) => manual::completions(&arguments),
        Command::Man(arguments) => manual::man(&arguments),
    };
    done.map(|()| Ended::Done)
}
