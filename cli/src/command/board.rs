//! `radome board`: attached and emulated boards.

mod config;
mod emulate;
mod list;
mod reset;

// There is one in a program: its size does not matter.
#[allow(clippy::large_enum_variant)]
#[derive(clap::Subcommand)]
pub enum Action {
    /// List attached boards and debug probes: their identity, or what to do where one cannot be used
    List(list::Arguments),
    /// Show what follows from a waveform: ranges, resolutions, data rate; with --registers also the registers
    Config(config::Arguments),
    /// Emulate a board on a pseudo-terminal, with the frames of any source, until stopped
    Emulate(emulate::Arguments),
    /// Reset the chip of a kit through its debug probe
    Reset(reset::Arguments),
}

/// Runs a command of the group.
///
/// # Errors
/// Those of the command.
pub fn run(action: &Action) -> anyhow::Result<()> {
    match action {
        Action::List(arguments) => list::run(arguments),
        Action::Config(arguments) => config::run(arguments),
        Action::Emulate(arguments) => emulate::run(arguments),
        Action::Reset(arguments) => reset::run(arguments),
    }
}
