//! Arguments of `radome scene calibrate`.

use std::path::PathBuf;

use crate::output_file::Overwrite;
use crate::source::DEFAULT_SEED;

/// Length of the slow-time windows, s.
pub const WINDOW_S: f64 = 10.0;

/// `radome scene calibrate`
#[derive(clap::Args)]
pub struct Arguments {
    /// Recordings of one receiver with one waveform: MCAP files, Infineon folders or text files
    #[arg(required = true, value_name = "RECORDING")]
    pub recordings: Vec<PathBuf>,
    /// Receiver file to write
    #[arg(short, long, value_name = "FILE.toml")]
    pub output: Option<PathBuf>,
    #[command(flatten)]
    pub overwrite: Overwrite,
    /// Scene that the recordings show, with their waveform; empty space if absent. With a scene, its static echoes give the
    /// strength of echoes, and moving people are compared
    #[arg(long, value_name = "FILE.toml")]
    pub scene: Option<PathBuf>,
    /// Receiver file with the values that are not measured; typical values of the datasheet if absent
    #[arg(long, value_name = "FILE.toml")]
    pub base: Option<PathBuf>,
    /// Fraction of each recording, from its start, that the receiver is fitted to; the rest tests the fit
    #[arg(long, default_value_t = 0.5, value_name = "0..1")]
    pub part: f64,
    /// Number of people, instead of the scene's own; a script has at most its own people
    #[arg(long)]
    pub people: Option<usize>,
    /// First seed of the simulated copies
    #[arg(long, default_value_t = DEFAULT_SEED)]
    pub seed: u64,
    /// Number of simulated copies of ten seconds, each with its own seed
    #[arg(long, default_value_t = 16)]
    pub copies: u64,
    /// Name of the receiver; the name of the first recording if absent
    #[arg(long)]
    pub name: Option<String>,
    /// Print one JSON object
    #[arg(long)]
    pub json: bool,
}
