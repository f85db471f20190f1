//! Times of the frames of scenes, compared with scipy's maps of frames of the same shape and sionna-rt's paths of the
//! empty room.

use std::io::Write;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Instant;

use radome_dsp::Frame;
use radome_sim::{Scene, SimulateOptions, Simulator};
use serde::Serialize;

use super::rdm::scipy_ms;
use crate::output::or_dash;
use crate::{files, output, source};

/// Scenes, each with the maximum number of people where that differs from the scene's own.
const SCENES: [(&str, Option<usize>); 5] =
    [("corridor", None), ("room", None), ("hall", Some(2)), ("corridor-mesh", None), ("open-plan", None)];
const FRAMES: u64 = 150;
const SEED: u64 = 5;
const TOLERANCE_DB: f64 = 0.5;
/// Number of rays that sionna-rt launches.
const SIONNA_RAYS: u32 = 100_000;

/// Times of a scene.
#[derive(Serialize)]
struct Row {
    scene: &'static str,
    seed: u64,
    frames: u64,
    tolerance_db: f64,
    threads: usize,
    /// Receivers, chirps and samples of a frame.
    shape: [usize; 3],
    /// Time from the scene file to a simulator.
    prepare_milliseconds: f64,
    /// Time of a frame on all threads.
    milliseconds: f64,
    /// Time of a map of such a frame by scipy in f32 on one thread.
    scipy_milliseconds: Option<f64>,
    over_scipy: Option<f64>,
    /// Time of one search by sionna-rt for the static paths of the room without people.
    sionna_milliseconds: Option<f64>,
}

/// Measures the scenes of the fixtures one after another.
///
/// # Errors
/// A scene is not here or cannot be simulated, or standard output cannot be written.
pub fn run(python: Option<&Path>, json: bool) -> anyhow::Result<()> {
    let bar = output::progress(SCENES.len() as u64, "scenes");
    let mut rows = Vec::new();
    for (scene, people) in SCENES {
        rows.push(measure(scene, people, python)?);
        bar.inc(1);
    }
    bar.finish_and_clear();
    if json {
        return output::json_line(&rows);
    }
    output::text_line(&format!(
        "{:14} {:>11} {:>12} {:>10} {:>10} {:>12} {:>8} {:>13}",
        "scene", "frame", "set-up ms", "ms/frame", "frames/s", "scipy map ms", "x scipy", "sionna-rt ms"
    ))?;
    for row in rows {
        let [rx, chirps, samples] = row.shape;
        output::text_line(&format!(
            "{:14} {:>11} {:12.0} {:10.2} {:10.1} {:>12} {:>8} {:>13}",
            row.scene,
            format!("{rx}x{chirps}x{samples}"),
            row.prepare_milliseconds,
            row.milliseconds,
            1e3 / row.milliseconds,
            or_dash(row.scipy_milliseconds, 3),
            or_dash(row.over_scipy, 1),
            or_dash(row.sionna_milliseconds, 0),
        ))?;
    }
    Ok(())
}

fn measure(name: &'static str, people: Option<usize>, python: Option<&Path>) -> anyhow::Result<Row> {
    let path = files::fixture(&format!("scenes/{name}.toml"))?;
    let started = Instant::now();
    let scene = Scene::load(&path)?;
    let options = SimulateOptions { seed: SEED, people, frames: Some(FRAMES), tolerance_db: TOLERANCE_DB };
    let mut simulator = Simulator::new(&scene, options)?;
    let prepare_milliseconds = started.elapsed().as_secs_f64() * 1e3;
    let shape = scene.waveform().shape();
    // Measured before and after the simulation, so that both run under the same load of the machine.
    let before = scipy_ms(python, shape);
    let mut frame = Frame::zeroed(shape);
    let started = Instant::now();
    while source::next_frame(&mut simulator, &mut frame)? {}
    let milliseconds = started.elapsed().as_secs_f64() * 1e3 / FRAMES as f64;
    let scipy_milliseconds = before.into_iter().chain(scipy_ms(python, shape)).reduce(f64::min);
    Ok(Row {
        scene: name,
        seed: SEED,
        frames: FRAMES,
        tolerance_db: TOLERANCE_DB,
        threads: rayon::current_num_threads(),
        shape: [shape.rx, shape.chirps, shape.samples],
        prepare_milliseconds,
        milliseconds,
        scipy_milliseconds,
        over_scipy: scipy_milliseconds.map(|map| milliseconds / map),
        sionna_milliseconds: sionna_ms(python, simulator.scene()),
    })
}

/// Time of sionna-rt; `None` where it is not installed or fails.
fn sionna_ms(python: Option<&Path>, scene: &Scene) -> Option<f64> {
    let mesh = scene.surfaces().triangles();
    let corners = (0..mesh.triangles.len()).filter_map(|triangle| mesh.corners(triangle));
    let triangles: Vec<[[f64; 3]; 3]> = corners.map(|corners| corners.map(|corner| corner.to_array())).collect();
    let request = serde_json::json!({
        "triangles": triangles,
        "antenna_m": scene.file().radar.position_m,
        "reflections": scene.file().room.max_reflections,
        "rays": SIONNA_RAYS,
    });
    let mut command = Command::new(python.unwrap_or(Path::new("python3")));
    // The script is embedded in the program, so it is found from any working directory.
    command.args(["-c", include_str!("../../../bench/sionna_paths.py")]);
    let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::null()).spawn().ok()?;
    // Without sionna-rt the script exits before it reads its input.
    let written = child.stdin.take()?.write_all(request.to_string().as_bytes());
    let output = child.wait_with_output().ok()?;
    written.ok()?;
    let response: serde_json::Value = serde_json::from_slice(&output.stdout).ok()?;
    response.get("sionna_milliseconds")?.as_f64()
}
