//! `calibrate`: fits a receiver to recordings, and says how far simulations with it, and without, are from what it has not seen.

use std::path::PathBuf;

use anyhow::bail;
use radome_dsp::statistics::SlowTimeStatistics;
use radome_sim::receiver::Receiver;
use radome_sim::receiver::calibration::{Calibration, Fit, LEAST_FRAMES};

use crate::output_file::Overwrite;
use copies::Copies;
use recordings::Recordings;

mod copies;
mod gap;
mod line;
mod recordings;
mod report;
mod sample;
mod still;

/// Windows of slow time, s.
const WINDOW_S: f64 = 10.0;

/// `radome calibrate`
#[derive(clap::Args)]
pub struct Arguments {
    /// Recordings by one receiver with one waveform: MCAP files, Infineon folders or text files
    #[arg(required = true, value_name = "RECORDING")]
    recordings: Vec<PathBuf>,
    /// Receiver file to write
    #[arg(short, long)]
    output: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
    /// The scene that the recordings show; an empty space without one. Its waveform must be theirs. What stands still in it and
    /// in them says how strong echoes are, and who moves is compared
    #[arg(long)]
    scene: Option<PathBuf>,
    /// Receiver file that what is not measured is taken from; datasheet typicals without one
    #[arg(long)]
    base: Option<PathBuf>,
    /// The first part of each recording, to which the receiver is fitted; the rest judges
    #[arg(long, default_value_t = 0.5, value_name = "0..1")]
    part: f64,
    /// People in the scene; the scene's own number without
    #[arg(long)]
    people: Option<usize>,
    /// First seed of what is random in the simulated copies
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Simulated copies of ten seconds, each of another seed
    #[arg(long, default_value_t = 16)]
    copies: u64,
    /// Name of the receiver; the first recording's without
    #[arg(long)]
    name: Option<String>,
    /// One object
    #[arg(long)]
    json: bool,
}

/// What recordings show of their receiver.
struct Measured {
    fit: Fit,
    /// The parts that judge.
    judged: Fit,
    /// Slow time of the parts that were fitted, and of whole recordings.
    fitted_slow_time: SlowTimeStatistics,
    slow_time: SlowTimeStatistics,
}

/// Fits a receiver to the first part of recordings and says how far simulations with it, and without, are from the rest.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    if let Some(output) = &arguments.output {
        arguments.overwrite.check(output)?;
    }
    if !(arguments.part > 0.0 && arguments.part < 1.0) {
        bail!("--part is {}, expected a number between 0 and 1", arguments.part);
    }
    if !(1..=10_000).contains(&arguments.copies) {
        bail!("--copies is {}, expected 1 to 10000", arguments.copies);
    }
    let base = match &arguments.base {
        Some(path) => radome_sim::scene::load_receiver(path)?,
        None => Receiver::typical(),
    };
    let recordings = Recordings::open(&arguments.recordings, arguments.part)?;
    let copies = Copies::new(arguments, recordings.waveform())?;
    let mut measured = measure(arguments, &recordings, &base)?;
    let clutter = still::fit_clutter(recordings.waveform(), &mut measured);
    let gain = match copies.has_scene() {
        true => Some(still::fit_level(recordings.waveform(), &copies, &mut measured)?),
        false => None,
    };
    report::round(&mut measured.fit.receiver);
    let line = measured.slow_time.line();
    let real = gap::Real::new(&recordings, measured.judged.channels.clone(), line.map(|line| line.bin))?;
    let before = copies.sample(&base, real.regions())?;
    let after = copies.sample(&measured.fit.receiver, real.regions())?;
    if let Some(output) = &arguments.output {
        report::write_receiver(output, &measured.fit.receiver, arguments)?;
    }
    let answer = report::Answer {
        receiver: arguments.output.as_deref(),
        frames_fitted: recordings.frames_fitted(),
        frames_judged: recordings.frames_judged(),
        copies: arguments.copies,
        fit_residual_lsb: measured.fit.channels.iter().map(|channel| channel.residual_lsb).collect(),
        clutter,
        gain: gain.map(report::Gain::from),
        resampled: real.resampled(),
        between_real: real.between(),
        before: real.beside(&before),
        after: real.beside(&after),
        line: copies.has_scene().then(|| line::Lines::new(line, &before.lines, &after.lines)),
    };
    report::print(&answer, arguments.json)
}

/// Everything but maps: what noise, leakage and slow time are.
fn measure(arguments: &Arguments, recordings: &Recordings, base: &Receiver) -> anyhow::Result<Measured> {
    let waveform = recordings.waveform();
    let mut fitted = Calibration::new(waveform, recordings.frames_fitted() as usize)?;
    let mut judged = Calibration::new(waveform, recordings.frames_judged() as usize)?;
    let (mut fitted_slow_time, mut slow_time) =
        (SlowTimeStatistics::new(waveform, WINDOW_S), SlowTimeStatistics::new(waveform, WINDOW_S));
    for recording in recordings.all() {
        fitted.begin_recording();
        judged.begin_recording();
        recording.each_frame("measuring", |place, frame| {
            if place.is_fitted {
                fitted.push(frame)?;
                fitted_slow_time.push(frame);
            } else {
                judged.push(frame)?;
            }
            slow_time.push(frame);
            Ok(())
        })?;
        fitted_slow_time.end();
        slow_time.end();
    }
    let name = arguments.name.clone().unwrap_or_else(|| recordings.name());
    Ok(Measured {
        fit: fitted.fit(base, &name, &recordings.measured_from())?,
        judged: judged.fit(&Receiver::typical(), "", "")?,
        fitted_slow_time,
        slow_time,
    })
}
