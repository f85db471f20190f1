//! `radome scene preview`.

use std::path::{Path, PathBuf};

use radome_sim::path_list::PathListOptions;
use radome_sim::{Scene, Simulator};
use serde_json::json;

use super::SceneArgs;
use crate::exit::wrong_use;
use crate::output_file::{Overwrite, check_is_picture};
use crate::picture::scene::{self, Preview};
use crate::{files, output};

/// `radome scene preview`
#[derive(clap::Args)]
pub struct Arguments {
    /// Picture to write: PNG, or SVG if its name ends in .svg
    #[arg(short, long, value_name = "FILE.png")]
    output: PathBuf,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Number of frames for which people are drawn
    #[arg(long, default_value_t = 400)]
    frames: u64,
    #[command(flatten)]
    scene: SceneArgs,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// Draws a scene without simulating it.
///
/// # Errors
/// The scene is not valid, or the picture cannot be written.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let SceneArgs { ref scene, seed, people } = arguments.scene;
    arguments.overwrite.check(&arguments.output, &[scene])?;
    check_is_picture(&arguments.output)?;
    draw(&Scene::load(scene)?, seed, people, arguments.frames, &arguments.output)?;
    report(scene, seed, &arguments.output, arguments.json)
}

/// Draws a scene with the random draws of its seed, and with the people of its first `frames` frames.
///
/// # Errors
/// The scene has no room for the people, the seed gives no valid scene, or the picture cannot be written.
pub fn draw(scene: &Scene, seed: u64, people: Option<usize>, frames: u64, path: &Path) -> anyhow::Result<()> {
    files::check_parent(path)?;
    Simulator::check_people(scene, people)?;
    let scene = scene.drawn(seed)?;
    let until_s = frames as f64 * scene.waveform().frame_interval_s();
    if until_s > PathListOptions::LATEST_S {
        wrong_use!("--frames {frames} last {until_s:.0} s\n\nhint: a picture shows at most a day");
    }
    scene::draw(&Preview { scene: &scene, seed, people, until_s, paths: &[] }, path)
}

/// Prints the name of the drawn picture.
///
/// # Errors
/// Standard output cannot be written.
pub fn report(scene: &Path, seed: u64, picture: &Path, as_json: bool) -> anyhow::Result<()> {
    if as_json {
        return output::json_line(&json!({ "preview": picture.display().to_string(), "seed": seed }));
    }
    output::text_line(&format!("{}: {}, seed {seed}", picture.display(), scene.display()))
}
