//! `radome scene`: scenes, their simulation, and their comparison with recordings.

mod calibrate;
mod pair;
mod paths;
mod people;
mod preview;
mod simulate;

use std::path::PathBuf;

use crate::source::DEFAULT_SEED;

/// Scene of a command, and the options that decide who is in it.
#[derive(clap::Args)]
struct SceneArgs {
    /// Scene file
    scene: PathBuf,
    /// Seed of all random draws
    #[arg(long, default_value_t = DEFAULT_SEED)]
    seed: u64,
    /// Number of people, instead of the scene's own; a script has at most its own people
    #[arg(long)]
    people: Option<usize>,
}

#[derive(clap::Subcommand)]
pub enum Action {
    /// Simulate a scene: raw frames with truth
    Simulate(simulate::Arguments),
    /// List every path between the antennas at one time: surfaces, length, delay, Doppler shift, gain, phase
    Paths(paths::Arguments),
    /// List where each person is in each frame: place, velocity, range, azimuth and elevation
    People(people::Arguments),
    /// Draw a scene without simulating it: objects, the radar's beam, and the path of each person
    Preview(preview::Arguments),
    /// Fit a receiver to a recording; report the difference between simulation and recording before and after
    Calibrate(calibrate::Arguments),
    /// Simulate the people of a recording in a scene, and store the maps of both as one dataset
    Pair(pair::Arguments),
}

/// Runs a command of the group.
///
/// # Errors
/// Those of the command.
pub fn run(action: &Action) -> anyhow::Result<()> {
    match action {
        Action::Simulate(arguments) => simulate::run(arguments),
        Action::Paths(arguments) => paths::run(arguments),
        Action::People(arguments) => people::run(arguments),
        Action::Preview(arguments) => preview::run(arguments),
        Action::Calibrate(arguments) => calibrate::run(arguments),
        Action::Pair(arguments) => pair::run(arguments),
    }
}
