use std::ops::Range;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, bail, ensure};
use radome_driver::recording::mcap::{Recorder, RecorderOptions, RecordingHeader};
use radome_driver::recording::{Existing, rename_synced};
use radome_dsp::{Frame, FrameSource, Waveform};
use radome_sim::{Scene, SimulateOptions, Simulator};
use serde_json::json;

use super::{SceneArgs, preview};
use crate::exit::wrong_use;
use crate::live::recorder::failure_message;
use crate::output_file::{Overwrite, check_is_mcap, check_is_picture};
use crate::shard::Shard;
use crate::{output, source, stored_simulation};

/// `radome scene simulate`
#[derive(clap::Args)]
#[command(mut_arg("overwrite", |overwrite| overwrite.help("Replace the output file, at the start, if it exists")))]
pub struct Arguments {
    /// MCAP file to write. Without it, simulate the frames and only report the time taken
    #[arg(short, long, value_name = "FILE.mcap")]
    output: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Number of frames to simulate
    #[arg(long, default_value_t = 400)]
    frames: u64,
    #[command(flatten)]
    scene: SceneArgs,
    /// Target error of the echoes in the maps, rms over the cells above noise, dB; 0.5 if absent
    #[arg(long, value_name = "DB")]
    tolerance_db: Option<f64>,
    /// Simulate only part I of N (from 0) of the frames, into a file such as NAME-shard-00003-of-00008.mcap; `auto/N` takes
    /// I from a Slurm, HyperQueue or Kubernetes array, `auto` takes I and N from a Slurm array
    #[arg(long, value_name = "I/N", requires = "output")]
    shard: Option<Shard>,
    /// PNG file to draw the scene into. Former option, replaced by `radome scene preview`
    #[arg(long, hide = true, value_name = "FILE.png")]
    preview: Option<PathBuf>,
    /// Print one JSON object at the end
    #[arg(long)]
    json: bool,
}

impl Arguments {
    /// Returns the first frame, and the frame after the last.
    fn range(&self) -> (u64, u64) {
        let Shard { index, count } = self.shard.unwrap_or(Shard::WHOLE);
        let cut = |i: usize| (u128::from(self.frames) * i as u128 / count as u128) as u64;
        (cut(index), cut(index + 1))
    }

    /// Returns the file to write.
    fn file(&self) -> Option<PathBuf> {
        let output = self.output.clone()?;
        let Some(shard) = self.shard else { return Some(output) };
        let stem = output.file_stem().unwrap_or_default().to_string_lossy();
        let extension = output.extension().unwrap_or("mcap".as_ref()).to_string_lossy();
        Some(output.with_file_name(format!("{stem}-{}.{extension}", shard.name())))
    }

    /// Returns the file that is written while the simulation runs. A shard gets its final name when it is complete, so that an
    /// interrupted run can be repeated.
    fn running_file(&self) -> Option<PathBuf> {
        let file = self.file()?;
        Some(if self.shard.is_some() { file.with_extension("partial") } else { file })
    }

    /// Refuses a tolerance that no simulation has, and outputs that cannot be written.
    fn check(&self) -> anyhow::Result<()> {
        if let Some(tolerance_db) = self.tolerance_db.filter(|db| Simulator::check_tolerance(*db).is_err()) {
            wrong_use!("--tolerance-db is {tolerance_db}, expected 0.01 to 20 dB");
        }
        self.preview.iter().try_for_each(|path| check_is_picture(path))?;
        let Some(file) = self.file() else { return Ok(()) };
        check_is_mcap(&file)?;
        // An existing shard is reused or made again.
        let overwrite = if self.shard.is_some() { Overwrite::yes() } else { self.overwrite };
        overwrite.check(&file, &[&self.scene.scene])
    }

    /// Returns the options of a simulation of the frames up to `end`.
    fn options(&self, end: u64) -> SimulateOptions {
        let tolerance_db = self.tolerance_db.unwrap_or(SimulateOptions::default().tolerance_db);
        SimulateOptions { seed: self.scene.seed, people: self.scene.people, frames: Some(end), tolerance_db }
    }

    /// Starts the recording, if an output is named.
    fn recorder(&self, waveform: &Waveform) -> anyhow::Result<Option<Recorder>> {
        let Some(path) = self.running_file() else { return Ok(None) };
        // An unfinished shard of an interrupted run is made again.
        let existing = if self.shard.is_some() { Existing::Replace } else { self.overwrite.existing() };
        let options = RecorderOptions { existing, ..RecorderOptions::default() };
        Ok(Some(Recorder::with_options(&path, &RecordingHeader::new(waveform.clone()), &options)?))
    }
}

/// Simulates a scene into a recording.
///
/// # Errors
/// The scene cannot be read or simulated, the recording cannot be written, or the user interrupts.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    output::catch_interrupts()?;
    arguments.check()?;
    let (first, end) = arguments.range();
    let file = arguments.file();
    let shard_file = file.as_deref().filter(|_| arguments.shard.is_some());
    let SceneArgs { scene: ref scene_file, seed, people } = arguments.scene;
    let scene = Scene::load(scene_file)?;
    if let Some(path) = &arguments.preview {
        preview::draw(&scene, seed, people, arguments.frames, path)?;
        if arguments.output.is_none() {
            return preview::report(scene_file, seed, path, arguments.json);
        }
    }
    let options = arguments.options(end);
    let mut simulator = Simulator::new(&scene, options)?;
    if let Some(output) = shard_file
        && output.exists()
        && shard_exists(arguments.overwrite, output, &simulator, first..end)?
    {
        return print_shard(arguments, output, end - first);
    }
    print_estimate(&simulator, end - first);
    simulator.seek(first);
    let simulated = Simulated::record(&mut simulator, arguments.recorder(scene.waveform())?, end - first)?;
    let is_interrupted = simulated.frames < end - first && output::interrupted();
    if let (Some(running), Some(file)) = (arguments.running_file(), shard_file) {
        if is_interrupted {
            let _ = std::fs::remove_file(&running);
            bail!("interrupted: {} was not finished", file.display());
        }
        rename_synced(&running, file)?;
    }
    simulated.print_report(arguments, file.as_deref(), options.tolerance_db)?;
    if is_interrupted {
        let place = file.map_or_else(|| "simulated".to_owned(), |path| format!("in {}", path.display()));
        bail!("interrupted: {} of {} frames are {place}", simulated.frames, end - first);
    }
    Ok(())
}

/// Share of clipped codes above which a warning is given.
const CLIPPED_SHARE: f64 = 0.01;

struct Simulated {
    frames: u64,
    /// Largest error estimate of any frame.
    estimate_db: Option<f64>,
    clamped: usize,
    clipped: usize,
    /// Number of codes of all frames.
    codes: usize,
    seconds: f64,
}

impl Simulated {
    /// Simulates until the end or until the user interrupts, and finishes the recording.
    fn record(simulator: &mut Simulator, mut recorder: Option<Recorder>, frames: u64) -> anyhow::Result<Self> {
        let started = Instant::now();
        let bar = output::progress(frames, "simulating");
        let mut frame = Frame::zeroed(simulator.waveform().shape());
        let mut all = Simulated { frames: 0, estimate_db: None, clamped: 0, clipped: 0, codes: 0, seconds: 0.0 };
        while !output::interrupted() && source::next_frame(simulator, &mut frame)? {
            if let Some(recorder) = &mut recorder {
                recorder.frame(&frame).with_context(|| failure_message(recorder))?;
            }
            if let Some(report) = simulator.last_report() {
                let worst = all.estimate_db;
                all.estimate_db = report.estimate_db.map(|e| worst.map_or(e, |worst| worst.max(e))).or(worst);
                all.clamped += report.clamped;
                all.clipped += report.clipped;
            }
            all.codes += frame.codes.len();
            all.frames += 1;
            bar.inc(1);
        }
        if let Some(recorder) = recorder {
            recorder.finish()?;
        }
        bar.finish_and_clear();
        all.seconds = started.elapsed().as_secs_f64();
        Ok(all)
    }

    fn print_report(&self, arguments: &Arguments, file: Option<&Path>, tolerance_db: f64) -> anyhow::Result<()> {
        let Simulated { frames, estimate_db, clamped, clipped, codes, seconds } = *self;
        if clipped as f64 > CLIPPED_SHARE * codes as f64 {
            tracing::warn!(
                "{:.0} % of the codes are at the ends of the ADC's range: people and walls are too near for this gain\n\nhint: a lower \
                 if_gain_db in [waveform]",
                100.0 * clipped as f64 / codes as f64
            );
        }
        let rate = frames as f64 / seconds;
        if arguments.json {
            return output::json_line(&json!({
                "file": file.map(|path| path.display().to_string()),
                "seed": arguments.scene.seed,
                "frames": frames,
                "seconds": seconds,
                "frames_per_second": rate,
                "tolerance_db": tolerance_db,
                "worst_estimate_db": estimate_db,
                "clamped_amplitudes": clamped,
                "clipped_codes": clipped,
            }));
        }
        let estimate = estimate_db.map_or_else(String::new, |e| {
            format!(", echoes by the strongest path within {e:.2} dB by its own estimate")
        });
        let what = file.unwrap_or(&arguments.scene.scene).display();
        output::text_line(&format!("{what}: {frames} frames in {seconds:.2} s, {rate:.0} frames/s{estimate}"))
    }
}

/// Returns whether a shard already exists. A shard gets its name when it is complete, and the same arguments give the
/// same bytes.
///
/// # Errors
/// A file of its name holds something else, and is not to be replaced.
fn shard_exists(
    overwrite: Overwrite,
    output: &Path,
    simulator: &Simulator,
    frames: Range<u64>,
) -> anyhow::Result<bool> {
    /// Number of frames that are simulated again for comparison, evenly spaced over the shard.
    const COMPARED: u64 = 5;
    let last = (frames.end - frames.start).saturating_sub(1);
    let mut compared: Vec<u64> = (0..COMPARED).map(|i| frames.start + last * i / (COMPARED - 1)).collect();
    compared.dedup();
    if frames.is_empty() {
        compared.clear();
    }
    if stored_simulation::is_recording_of(output, simulator, frames, &compared) {
        message!("{} is there already", output.display());
        return Ok(true);
    }
    ensure!(
        overwrite.existing() != Existing::Refuse,
        "{} is there already, but was made of another scene, or with another --frames, --seed, --people or --tolerance-db\n\n\
         hint: --overwrite replaces it; or move it away",
        output.display()
    );
    Ok(false)
}

fn print_shard(arguments: &Arguments, file: &Path, frames: u64) -> anyhow::Result<()> {
    if arguments.json {
        let file = file.display().to_string();
        return output::json_line(
            &json!({ "file": file, "seed": arguments.scene.seed, "frames": frames, "found": true }),
        );
    }
    output::text_line(&format!("{}: {frames} frames", file.display()))
}

/// Estimates the time and size of a long run from its first frame, and prints them.
fn print_estimate(simulator: &Simulator, frames: u64) {
    /// Duration below which a run needs no estimate, s.
    const LONG_S: f64 = 15.0;
    let started = Instant::now();
    let frame = simulator.frame(0);
    let threads = rayon::current_num_threads().max(1);
    let seconds = started.elapsed().as_secs_f64() * frames as f64 / threads as f64;
    if seconds < LONG_S {
        return;
    }
    let frame_mb = (frame.codes.len() * size_of::<u16>()) as f64 * 1e-6;
    let (file_mb, memory_mb) = (frame_mb * frames as f64, resident_mb().unwrap_or(0.0) * threads as f64);
    message!(
        "about {:.0} min on {threads} threads; {file_mb:.0} MB of frames, up to {memory_mb:.0} MB of memory",
        (seconds / 60.0).max(1.0).round()
    );
}

/// Peak memory of this process, MB; `None` where the system does not report it.
fn resident_mb() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    Some(line.split_whitespace().next()?.parse::<f64>().ok()? * 1e-3)
}
