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
    /// MCAP file to write; without one the frames are made, and what it took is told
    #[arg(short, long)]
    output: Option<PathBuf>,
    /// Frames
    #[arg(long, default_value_t = 400)]
    frames: u64,
    /// Seed of everything random
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// People that the scene is forced to have; the scene's own program if absent
    #[arg(long)]
    people: Option<usize>,
    /// Error of the echoes in the maps that is asked for, dB; 0.5 if absent
    #[arg(long)]
    tolerance_db: Option<f64>,
    /// One object at the end
    #[arg(long)]
    json: bool,
}

/// Simulates a scene into a recording.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    output::catch_interrupts()?;
    if let Some(output) = &arguments.output {
        files::check_parent(output)?;
    }
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
    let header = RecordingHeader::new(scene.waveform().clone());
    let mut recorder = arguments.output.as_ref().map(|path| Recorder::create(path, &header)).transpose()?;
    let bar = output::progress(arguments.frames, "simulating");
    let mut frame = Frame::zeroed(scene.waveform().shape());
    let (mut frames, mut estimate_db, mut clamped, mut clipped) = (0u64, None::<f64>, 0, 0);
    let started = Instant::now();
    while !output::interrupted() {
        match simulator.next_frame(&mut frame).map_err(anyhow::Error::from_boxed)? {
            SourceEvent::Frame => recorder.as_mut().map_or(Ok(()), |r| r.frame(&frame))?,
            SourceEvent::Gap(gap) => recorder.as_mut().map_or(Ok(()), |r| r.gap(&gap))?,
            SourceEvent::End => break,
        }
        if let Some(report) = simulator.last_report() {
            estimate_db = report.estimate_db.map(|e| estimate_db.map_or(e, |worst| worst.max(e))).or(estimate_db);
            clamped += report.clamped;
            clipped += report.clipped;
        }
        frames += 1;
        bar.inc(1);
    }
    if let Some(recorder) = recorder {
        recorder.finish()?;
    }
    bar.finish_and_clear();
    let seconds = started.elapsed().as_secs_f64();
    let rate = frames as f64 / seconds;
    if arguments.json {
        return output::json_line(&json!({
            "file": arguments.output.as_ref().map(|path| path.display().to_string()),
            "seed": arguments.seed,
            "frames": frames,
            "seconds": seconds,
            "frames_per_second": rate,
            "tolerance_db": options.tolerance_db,
            "worst_estimate_db": estimate_db,
            "clamped_amplitudes": clamped,
            "clipped_codes": clipped,
        }));
    }
    let estimate = estimate_db.map_or_else(String::new, |e| format!(", echoes within {e:.2} dB by estimate"));
    let what = arguments.output.as_ref().unwrap_or(&arguments.scene).display();
    output::text_line(&format!("{what}: {frames} frames in {seconds:.2} s, {rate:.0} frames/s{estimate}"))
}
