//! `radome scene pair`.

use std::path::PathBuf;

use crate::dataset::pairing::{Settings, pair};
use crate::map_preset::MapPreset;
use crate::output;
use crate::source::DEFAULT_SEED;

/// `radome scene pair`
#[derive(clap::Args)]
pub struct Arguments {
    /// Recording of any kind, or another source with --frames
    #[arg(value_hint = clap::ValueHint::AnyPath)]
    recording: String,
    /// Scene file: room, furniture, radar, receiver. Its people and waveform are not used
    scene: PathBuf,
    /// Dataset folder to make
    #[arg(short, long)]
    output: PathBuf,
    /// File with labels instead of the recording's own: .txt is an Audacity label track, .label a DEEPCRAFT file
    #[arg(long)]
    labels: Option<PathBuf>,
    /// Number of people wherever no label says otherwise
    #[arg(long, value_parser = clap::value_parser!(u8).range(0..=2))]
    people: Option<u8>,
    /// Positions of people at times when they were not seen: TOML, [[person]] with point = [{ time_s = 1.5, position_m = [2.0, 1.0] }, ...]
    #[arg(long)]
    waypoints: Option<PathBuf>,
    /// Body height of the people, m
    #[arg(long, default_value_t = 1.75)]
    height_m: f64,
    /// Those who stay in one place sit
    #[arg(long)]
    seated: bool,
    /// Kind of map
    #[arg(long, alias = "map", value_enum, default_value_t)]
    preset: MapPreset,
    /// Name of the pair; the recording's without
    #[arg(long)]
    name: Option<String>,
    /// Name of the person in the recording
    #[arg(long)]
    subject: Option<String>,
    /// Number of times that the trajectory is corrected by following the mirror
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u8).range(0..=4))]
    corrections: u8,
    /// End after this many frames
    #[arg(long)]
    frames: Option<u64>,
    /// Seed of what is random in the mirror
    #[arg(long, default_value_t = DEFAULT_SEED)]
    seed: u64,
    /// One object
    #[arg(long)]
    json: bool,
}

/// Mirrors a recording and prints how near the mirror is.
///
/// # Errors
/// Those of [`pair`].
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    output::catch_interrupts()?;
    let paired = pair(&Settings {
        recording: arguments.recording.clone(),
        scene: arguments.scene.clone(),
        output: arguments.output.clone(),
        labels: arguments.labels.clone(),
        people: arguments.people,
        waypoints: arguments.waypoints.clone(),
        height_m: arguments.height_m,
        seated: arguments.seated,
        map: arguments.preset,
        name: arguments.name.clone(),
        subject: arguments.subject.clone(),
        corrections: arguments.corrections,
        frames: arguments.frames,
        seed: arguments.seed,
    })?;
    paired.report.tell(&arguments.output, &paired.name, paired.maps, arguments.json)
}
