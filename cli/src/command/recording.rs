//! `radome recording`: recordings and their contents.

mod answers;
mod convert;
mod echoes;
mod info;
mod label;
mod labels;
mod maps;
mod repair;

use crate::exit::Completion;

#[derive(clap::Subcommand)]
pub enum Action {
    /// Show format, length, waveform, board, labels and model of a recording
    Info(info::Arguments),
    /// Convert a recording to another format: MCAP, Infineon's folder, text, or a file for viewers
    Convert(convert::Arguments),
    /// Save what can be read of a cut or damaged recording to a new file, and report what is lost
    Repair(repair::Arguments),
    /// Label a recording by hand, from a file, from its truth, or by a classical detector
    Label(label::Arguments),
    // Replaced by `label`.
    /// Show, export or import labels. Former command
    #[command(hide = true)]
    Labels(labels::Arguments),
    /// Show the answers that `live -o` recorded with the frames, as CSV or JSON
    Answers(answers::Arguments),
    /// Compute range-Doppler maps of a source, as an array or a picture
    Maps(maps::Arguments),
    /// Measure range, speed, azimuth and elevation of echoes, or phase offsets between the receivers
    Echoes(echoes::Arguments),
}

/// Runs a command of the group.
///
/// # Errors
/// Those of the command.
pub fn run(action: &Action) -> anyhow::Result<Completion> {
    let done: anyhow::Result<()> = match action {
        Action::Info(arguments) => info::run(arguments),
        Action::Convert(arguments) => return convert::run(arguments),
        Action::Repair(arguments) => return repair::run(arguments),
        Action::Label(arguments) => label::run(arguments),
        Action::Labels(arguments) => labels::run(arguments),
        Action::Answers(arguments) => answers::run(arguments),
        Action::Maps(arguments) => maps::run(arguments),
        Action::Echoes(arguments) => echoes::run(arguments),
    };
    done.map(|()| Completion::Done)
}
