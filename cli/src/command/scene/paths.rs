//! `radome scene paths`.

use std::path::{Path, PathBuf};

use anyhow::bail;
use glam::DVec3;
use radome_sim::path_list::{ListedPath, PathKind, PathList, PathListOptions};
use radome_sim::{Scene, Simulator};

use super::SceneArgs;
use crate::exit::wrong_use;
use crate::output_file::{Overwrite, check_is_picture};
use crate::picture::scene::{DrawnPath, Preview, draw};
use crate::{files, output};

/// Text below the options in the help.
const NOTES: &str = "\
The Doppler shift is positive if a path becomes shorter; velocities in maps are positive if the range increases. Gain is \
received over transmitted power, with antennas of gain 1 on boresight. Phase is that of the received field in the middle of \
the chirp.";

/// `radome scene paths`
#[derive(clap::Args)]
#[command(after_help = NOTES)]
pub struct Arguments {
    /// Time since the first frame, s
    #[arg(long, default_value_t = 0.0, value_name = "SECONDS")]
    time: f64,
    /// List only paths that meet the person with this number. People are numbered from 0; messages of `scene pair` number them from 1
    #[arg(long, value_name = "N")]
    person: Option<usize>,
    #[command(flatten)]
    scene: SceneArgs,
    /// Leave out paths that are further below the noise of a map cell than this, dB. Simulations with a tolerance of 0.5 dB use
    /// 10
    #[arg(long, value_name = "DB", default_value_t = 10.0, allow_hyphen_values = true)]
    margin_db: f64,
    /// Picture to write, of the paths of the first receiver from above and from the side: PNG, or SVG if its name ends in .svg
    #[arg(short, long, alias = "preview", value_name = "FILE.png")]
    output: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// Lists the paths of a scene.
///
/// # Errors
/// An argument or the scene is not valid, the person is not there, or the picture cannot be written.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let SceneArgs { scene: ref scene_file, seed, people } = arguments.scene;
    if !(0.0..=PathListOptions::LATEST_S).contains(&arguments.time) {
        wrong_use!("--time {} is not within a day\n\nhint: seconds from the first frame on", arguments.time);
    }
    if !arguments.margin_db.is_finite() {
        wrong_use!("--margin-db {} is no number of decibels", arguments.margin_db);
    }
    if let Some(path) = &arguments.output {
        arguments.overwrite.check(path, &[scene_file])?;
        check_is_picture(path)?;
    }
    let scene = Scene::load(scene_file)?;
    Simulator::check_people(&scene, people)?;
    let options = PathListOptions {
        seed,
        people,
        person: arguments.person,
        time_s: arguments.time,
        margin_db: arguments.margin_db,
    };
    let list = PathList::new(&scene, &options)?;
    if let Some(person) = arguments.person.filter(|person| !list.people.contains(person)) {
        let present: Vec<String> = list.people.iter().map(usize::to_string).collect();
        let present = match present.as_slice() {
            [] => "nobody is there".to_owned(),
            numbers => format!("those who are there have the numbers {}", numbers.join(", ")),
        };
        bail!("person {person} is not there at {} s\n\nhint: at that time {present}", arguments.time);
    }
    if let Some(path) = &arguments.output {
        draw_preview(arguments, &scene, &list, path)?;
    }
    if arguments.json { output::json_line(&list) } else { print(&list) }
}

fn print(list: &PathList) -> anyhow::Result<()> {
    output::text_line(&format!(
        "{}, seed {}, {:.3} s: {} paths at {:.6} GHz",
        list.scene,
        list.seed,
        list.time_s,
        list.paths.len(),
        list.frequency_hz * 1e-9
    ))?;
    output::text_line("rx   length/m  delay/ns  Doppler/Hz  gain/dB  phase/rad  by")?;
    for path in &list.paths {
        output::text_line(&format!(
            "{:2} {:10.4} {:9.4} {:11.2} {:8.2} {:10.4}  {}",
            path.rx,
            path.length_m,
            path.delay_s * 1e9,
            // Adding 0 turns a negative zero after rounding into a positive one.
            (path.doppler_hz * 100.0).round() / 100.0 + 0.0,
            path.gain_db,
            path.phase_rad,
            path.surfaces.join(" > ")
        ))?;
    }
    Ok(())
}

/// Draws the paths of the first receiver; stronger paths are darker.
fn draw_preview(arguments: &Arguments, scene: &Scene, list: &PathList, path: &Path) -> anyhow::Result<()> {
    /// Level below the strongest path of the same kind at which lines are faintest, dB.
    const RANGE_DB: f64 = 40.0;
    files::check_parent(path)?;
    let scene = scene.drawn(arguments.scene.seed)?;
    let first = list.paths.first().map(|path| path.rx);
    let drawn: Vec<&ListedPath> = list.paths.iter().filter(|path| Some(path.rx) == first).collect();
    let strongest_db = |kind: PathKind| {
        drawn.iter().filter(|path| path.kind == kind).map(|path| path.gain_db).fold(f64::NEG_INFINITY, f64::max)
    };
    let paths: Vec<DrawnPath> = drawn
        .iter()
        .filter(|path| !path.points_m.is_empty())
        .map(|path| DrawnPath {
            points: path.points_m.iter().map(|p| DVec3::from_array(*p)).collect(),
            is_moving: path.kind == PathKind::Person,
            strength: (1.0 + (path.gain_db - strongest_db(path.kind)) / RANGE_DB).clamp(0.0, 1.0),
        })
        .collect();
    let preview = Preview {
        scene: &scene,
        seed: arguments.scene.seed,
        people: arguments.scene.people,
        until_s: arguments.time,
        paths: &paths,
    };
    draw(&preview, path)
}
