//! Program `radome`: occupancy from a 60 GHz radar. Answers go to stdout, messages to stderr.

// Only the program prints; the libraries below it return results.
#![allow(clippy::print_stdout)]

#[macro_use]
mod message;

mod classifier;
mod command;
mod dataset;
mod exit;
mod files;
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
mod stored_simulation;
mod viewers;

use std::io::IsTerminal;
use std::process::ExitCode;

use clap::{CommandFactory, FromArgMatches, Parser};
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::prelude::*;

/// Allocator that keeps large blocks: a training step allocates and frees hundreds, and the system would clear each one again.
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
    panics::install_hook();
    output::catch_file_size_limit();
    let raw_arguments = std::env::args_os().collect();
    let raw_arguments = command::former_names::with_present_names(raw_arguments);
    let matches = allow_negative_numbers(Arguments::command()).get_matches_from(raw_arguments);
    let arguments = Arguments::from_arg_matches(&matches).unwrap_or_else(|error| error.exit());
    let wire = match &arguments.command {
        command::Command::Doctor(doctor) => doctor.wire_log(),
        _ => None,
    };
    start_log(arguments.verbose, wire);
    let outcome = panics::catch_panic(|| command::run(arguments.command, Arguments::command));
    exit::report(&outcome.unwrap_or_else(|panicked| Err(panicked.into())))
}

/// Allows negative numbers as values of options, so that a wrong one is refused as a value and not as an unknown option.
fn allow_negative_numbers(command: clap::Command) -> clap::Command {
    command.allow_negative_numbers(true).mut_subcommands(allow_negative_numbers)
}

fn start_log(verbose: u8, wire: Option<&command::WireLog>) {
    let level = [LevelFilter::WARN, LevelFilter::INFO, LevelFilter::DEBUG][usize::from(verbose.min(2))];
    let targets: Option<Targets> = std::env::var("RADOME_LOG").ok().and_then(|targets| targets.parse().ok());
    let has_targets = verbose > 0 || targets.is_some();
    let filter = targets.unwrap_or_else(|| Targets::new().with_default(level));
    // Files and journals get no colour codes; https://no-color.org.
    let is_plain = std::env::var_os("NO_COLOR").is_some_and(|value| !value.is_empty());
    let has_colours = std::io::stderr().is_terminal() && !is_plain;
    let stderr_layer =
        tracing_subscriber::fmt::layer().with_writer(std::io::stderr).with_ansi(has_colours).log_internal_errors(false);
    // Names of modules only help users who look for details.
    let stderr_layer = stderr_layer.without_time().with_target(has_targets).with_filter(filter);
    tracing_subscriber::registry().with(stderr_layer).with(wire.map(command::WireLog::layer)).init();
}
