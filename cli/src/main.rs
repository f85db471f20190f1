//! Program `radome`: occupancy from a 60 GHz radar. Answers go to stdout, messages to stderr.

// Only the program prints; the libraries below it return results.
#![allow(clippy::print_stdout)]

#[macro_use]
mod message;

mod command;
mod dataset;
mod exit;
mod files;
mod judge;
mod kept;
mod labels;
mod live;
mod map_preset;
mod one_of;
mod output;
mod output_file;
mod panics;
mod picture;
mod shard;
mod shell;
mod slurm;
mod source;
mod viewers;

use std::io::IsTerminal;
use std::process::ExitCode;

use clap::{CommandFactory, FromArgMatches, Parser};
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::prelude::*;

/// A training step allocates and frees hundreds of large blocks. The system allocator would clear each one again.
#[global_allocator]
static ALLOCATOR: radome_models::LargeBlocks = radome_models::LargeBlocks::new();

#[derive(Parser)]
#[command(name = "radome", version, about, propagate_version = true, max_term_width = 100, after_help = exit::HELP)]
struct Arguments {
    /// Print more messages on stderr: -v for events, -vv for every detail
    // Listed behind a command's own options, before --help.
    #[arg(short, long, global = true, display_order = 900, action = clap::ArgAction::Count)]
    verbose: u8,
    #[command(subcommand)]
    command: command::Command,
}

fn main() -> ExitCode {
    panics::remember_places();
    output::catch_file_size_limit();
    let given = std::env::args_os().collect();
    let given = command::former_names::with_present_names(given);
    let matches = taking_negative_numbers(Arguments::command()).get_matches_from(given);
    let arguments = Arguments::from_arg_matches(&matches).unwrap_or_else(|error| error.exit());
    let wire = match &arguments.command {
        command::Command::Doctor(doctor) => doctor.wire_log(),
        _ => None,
    };
    start_log(arguments.verbose, wire);
    let outcome = panics::caught(|| command::run(arguments.command, Arguments::command));
    exit::report(&outcome.unwrap_or_else(|panicked| Err(panicked.into())))
}

/// Lets options have negative numbers, so that a wrong one is refused as the value that it is, and not as an unknown option.
fn taking_negative_numbers(command: clap::Command) -> clap::Command {
    command.allow_negative_numbers(true).mut_subcommands(taking_negative_numbers)
}

fn start_log(verbose: u8, wire: Option<&command::WireLog>) {
    let level = [LevelFilter::WARN, LevelFilter::INFO, LevelFilter::DEBUG][usize::from(verbose.min(2))];
    let given: Option<Targets> = std::env::var("RADOME_LOG").ok().and_then(|targets| targets.parse().ok());
    let has_targets = verbose > 0 || given.is_some();
    let filter = given.unwrap_or_else(|| Targets::new().with_default(level));
    // Files and journals get no colour codes; https://no-color.org.
    let is_plain = std::env::var_os("NO_COLOR").is_some_and(|value| !value.is_empty());
    let has_colours = std::io::stderr().is_terminal() && !is_plain;
    let talk =
        tracing_subscriber::fmt::layer().with_writer(std::io::stderr).with_ansi(has_colours).log_internal_errors(false);
    // Modules are of use to those who look for details.
    let talk = talk.without_time().with_target(has_targets).with_filter(filter);
    tracing_subscriber::registry().with(talk).with(wire.map(command::WireLog::layer)).init();
}
