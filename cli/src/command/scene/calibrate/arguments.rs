//! Arguments of `radome scene calibrate`.

use std::path::PathBuf;

use crate::output_file::Overwrite;
use crate::source::DEFAULT_SEED;

/// Length of the slow-time windows, s.
pub const WINDOW_S: f64 = 10.0;

/// `radome scene calibrate`
#[derive(clap::Args)]
pub struct Arguments {
    /// Recordings by one receiver with one waveform: MCAP files, Infineon folders or text files
    #[arg(required = true, value_name = "RECORDING")]
    pub recordings: Vec<PathBuf>,
    /// Receiver file to write
    #[arg(short, long)]
    pub output: Option<PathBuf>,
    #[command(flatten)]
    pub overwrite: Overwrite,
    /// The scene that the recordings show; an empty space without one. Its waveform must be theirs. What stands still in it and
    /// in them says how strong echoes are, and who moves is compared
    #[arg(long)]
    pub scene: Option<PathBuf>,
    /// Receiver file that what is not measured is taken from; datasheet typicals without one
    #[arg(long)]
    pub base: Option<PathBuf>,
    /// The first part of each recording, to which the receiver is fitted; the rest judges
    #[arg(long, default_value_t = 0.5, value_name = "0..1")]
    pub part: f64,
    /// People in the scene; the scene's own number without
    #[arg(long)]
    pub people: Option<usize>,
    /// First seed of what is random in the simulated copies
    #[arg(long, default_value_t = DEFAULT_SEED)]
    pub seed: u64,
    /// Simulated copies of ten seconds, each of another seed
    #[arg(long, default_value_t = 16)]
    pub copies: u64,
    /// Name of the receiver; the first recording's without
    #[arg(long)]
    pub name: Option<String>,
    /// One object
    #[arg(long)]
    pub json: bool,
}
