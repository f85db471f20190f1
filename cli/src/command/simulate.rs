use std::path::PathBuf;
use std::time::Instant;

use radome_driver::recording::mcap::{Recorder, RecordingHeader};
use radome_dsp::{Frame, FrameSource, SourceEvent};
use radome_sim::{Scene, SimulateOptions, Simulator};
use serde_json::json;

use crate::{files, output};

/// `radome simulate`
#[derive(clap::Args)]
pub struct Arguments {
    /// Scene file
    scene: PathBuf,
    /// MCAP file to write
    #[arg(short, long)]
    output: PathBuf,
    /// Frames
    #[arg(long, default_value_t = 400)]
    frames: u64,
    /// Seed of everything random
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// People that the scene is forced to have; the scene's own program if absent
    #[arg(long)]
    people: Option<usize>,
    /// Error to spend on what is left out, dB
    #[arg(long)]
    tolerance_db: Option<f64>,
    /// One object at the end
    #[arg(long)]
    json: bool,
}

/// Simulates a scene into a recording.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    output::catch_interrupts()?;
    files::check_parent(&arguments.output)?;
    let scene = Scene::load(&arguments.scene)?;
    let mut options = SimulateOptions {
        seed: arguments.seed,
        people: arguments.people,
        frames: Some(arguments.frames),
        ..Default::default()
    };
    if let Some(tolerance_db) = arguments.tolerance_db {
        options.tolerance_db = tolerance_db;
    }
    let mut simulator = Simulator::new(&scene, options)?;
    let mut recorder = Recorder::create(&arguments.output, &RecordingHeader::new(scene.waveform().clone()))?;
    let bar = output::progress(arguments.frames, "simulating");
    let mut frame = Frame::zeroed(scene.waveform().shape());
    let mut frames = 0u64;
    let started = Instant::now();
    while !output::interrupted() {
        match simulator.next_frame(&mut frame).map_err(anyhow::Error::from_boxed)? {
            SourceEvent::Frame => recorder.frame(&frame)?,
            SourceEvent::Gap(gap) => recorder.gap(&gap)?,
            SourceEvent::End => break,
        }
        frames += 1;
        bar.inc(1);
    }
    recorder.finish()?;
    bar.finish_and_clear();
    let seconds = started.elapsed().as_secs_f64();
    let rate = frames as f64 / seconds;
    if arguments.json {
        return output::json_line(&json!({
            "file": arguments.output.display().to_string(),
            "seed": arguments.seed,
            "frames": frames,
            "seconds": seconds,
            "frames_per_second": rate,
        }));
    }
    output::text_line(&format!("{}: {frames} frames in {seconds:.2} s, {rate:.0} frames/s", arguments.output.display()))
}
