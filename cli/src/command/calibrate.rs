use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use radome_driver::recording::Recording;
use radome_dsp::distance::{Distance, MapSample};
use radome_dsp::rdm::StaticRemoval;
use radome_dsp::{Frame, FrameSource, MapStatus, Rdm, RdmProcessor, RdmSpec, SourceEvent, Waveform};
use radome_sim::receiver::Receiver;
use radome_sim::receiver::calibration::{Calibration, ChannelFit, Fit, LEAST_FRAMES};
use radome_sim::{Scene, SimulateOptions, Simulator};
use rustfft::num_complex::Complex;
use serde::Serialize;
use serde_json::json;

use crate::{files, output};

/// Range bins that hold leakage: no map says anything there.
const LEAKAGE_BINS: usize = 3;

/// `radome calibrate`
#[derive(clap::Args)]
pub struct Arguments {
    /// Recording: MCAP file, Infineon folder or text file
    recording: PathBuf,
    /// Receiver file to write
    #[arg(short, long)]
    output: Option<PathBuf>,
    /// The scene that the recording shows; an empty space without one. Its waveform must be the recording's
    #[arg(long)]
    scene: Option<PathBuf>,
    /// Receiver file that what is not measured is taken from; datasheet typicals without one
    #[arg(long)]
    base: Option<PathBuf>,
    /// The first part of the recording, to which the receiver is fitted; the rest judges
    #[arg(long, default_value_t = 0.5, value_name = "0..1")]
    part: f64,
    /// People in the scene; the scene's own number without
    #[arg(long)]
    people: Option<usize>,
    /// Seed of what is random in the simulated copy
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Name of the receiver; the recording's without
    #[arg(long)]
    name: Option<String>,
    /// One object
    #[arg(long)]
    json: bool,
}

/// One channel of the rest of the recording beside the same of a simulation.
#[derive(Serialize)]
struct Channel {
    /// Receive antenna, from 1.
    rx: u8,
    /// Greatest difference of the noise densities of any range bin but the first and last, dB, and the mean of all.
    noise_worst_db: f64,
    noise_mean_db: f64,
    /// By range bin, from the second to the last but one, dB.
    noise_by_bin_db: Vec<f64>,
    /// What differs between the mean chirps' lowest range bins, over what is there in the recording.
    leakage_error: f64,
    /// Standard deviation of the map's cells, dB, in the recording and in the simulation.
    sigma_real_db: f64,
    sigma_simulated_db: f64,
    mean_difference_db: f64,
    kolmogorov_smirnov: f64,
    wasserstein_db: f64,
    /// Between the profiles of power along velocity and range.
    doppler_m_per_s: f64,
    range_m: f64,
}

/// Fits a receiver to the first part of a recording and says how far simulations with it, and without, are from the rest.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let Arguments { recording: path, .. } = arguments;
    if let Some(output) = &arguments.output {
        files::check_parent(output)?;
    }
    if !(arguments.part > 0.0 && arguments.part < 1.0) {
        bail!("--part is {}, expected a number between 0 and 1", arguments.part);
    }
    let base = match &arguments.base {
        Some(path) => radome_sim::scene::load_receiver(path)?,
        None => Receiver::typical(),
    };
    let (waveform, frames) = read(path)?;
    let first = (frames.len() as f64 * arguments.part).round() as usize;
    let (fitted, rest) = frames.split_at(first.min(frames.len()));
    if fitted.len() < LEAST_FRAMES || rest.len() < LEAST_FRAMES {
        bail!(
            "{}: {} frames to fit and {} to judge by, {LEAST_FRAMES} of each are needed\n\nhint: record ten seconds or more",
            path.display(),
            fitted.len(),
            rest.len()
        );
    }
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    let name = arguments.name.clone().unwrap_or_else(|| stem.clone().into_owned());
    let measured_from = format!("{stem}: {} of {} frames", fitted.len(), frames.len());
    let fit = measure(&waveform, fitted)?.fit(&base, &name, &measured_from)?;
    let real = Sample::new(&waveform, rest)?;
    let judge = |receiver: &Receiver| -> anyhow::Result<Vec<Channel>> {
        // More than were recorded, so that what chance makes of the simulation does not count.
        let simulated = simulate(arguments, &waveform, receiver, 4 * rest.len())?;
        real.beside(&Sample::new(&waveform, &simulated)?, &waveform)
    };
    let (before, after) = (judge(&base)?, judge(&fit.receiver)?);
    if let Some(output) = &arguments.output {
        write(output, &fit, arguments)?;
    }
    report(arguments, &fit, rest.len(), &before, &after)
}

/// All frames of a recording; one that has gaps is as good as several.
fn read(path: &Path) -> anyhow::Result<(Waveform, Vec<Frame>)> {
    let mut source = Recording::open(path)?;
    let waveform = source.waveform().clone();
    let bar = output::progress(source.frame_count().unwrap_or(0), "reading");
    let mut frames = Vec::new();
    let mut frame = Frame::zeroed(waveform.shape());
    loop {
        match source.next_frame(&mut frame).map_err(anyhow::Error::from_boxed)? {
            SourceEvent::End => break,
            SourceEvent::Gap(_) => {}
            SourceEvent::Frame => frames.push(frame.clone()),
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    Ok((waveform, frames))
}

fn measure(waveform: &Waveform, frames: &[Frame]) -> anyhow::Result<Calibration> {
    let mut calibration = Calibration::new(waveform, frames.len())?;
    frames.iter().try_for_each(|frame| calibration.push(frame))?;
    Ok(calibration)
}

/// Frames of the scene, or of nothing, through a receiver.
fn simulate(
    arguments: &Arguments,
    waveform: &Waveform,
    receiver: &Receiver,
    frames: usize,
) -> anyhow::Result<Vec<Frame>> {
    let scene = match &arguments.scene {
        Some(path) => {
            let scene = Scene::load(path)?;
            scene.waveform().check_compatible(waveform).context("the scene's waveform is not the recording's")?;
            scene
        }
        None => Scene::nothing(waveform)?,
    };
    let options = SimulateOptions { seed: arguments.seed, people: arguments.people, ..SimulateOptions::default() };
    let simulator = Simulator::new(&scene.with_receiver(receiver.clone()), options)?;
    Ok((0..frames as u64).map(|index| simulator.render(index)).collect())
}

/// What is compared of some frames.
struct Sample {
    channels: Vec<ChannelFit>,
    maps: Vec<MapSample>,
}

impl Sample {
    fn new(waveform: &Waveform, frames: &[Frame]) -> anyhow::Result<Self> {
        let channels = measure(waveform, frames)?.fit(&Receiver::typical(), "", "")?.channels;
        let spec = RdmSpec { static_removal: StaticRemoval::SlowTimeMean, ..RdmSpec::default() };
        let mut processor = RdmProcessor::new(&spec, waveform)?;
        let mut maps: Vec<Rdm> = Vec::new();
        for frame in frames {
            let mut map = processor.empty_map();
            if processor.process(frame, &mut map)? == MapStatus::Ready {
                maps.push(map);
            }
        }
        let maps = (0..channels.len()).map(|rx| MapSample::of(&maps, rx, LEAKAGE_BINS)).collect();
        Ok(Sample { channels, maps })
    }

    /// This one, the real one, beside a simulated one.
    fn beside(&self, other: &Sample, waveform: &Waveform) -> anyhow::Result<Vec<Channel>> {
        let antennas = waveform.request.rx_antennas.antennas();
        let (range_m, velocity_m_per_s) = (
            waveform.range_step_m(waveform.request.samples_per_chirp),
            waveform.velocity_step_m_per_s(waveform.request.chirps_per_frame),
        );
        let mut all = Vec::new();
        for (i, (&rx, (real, simulated))) in antennas.iter().zip(self.channels.iter().zip(&other.channels)).enumerate()
        {
            let bins = real.density_lsb2.len();
            let differences: Vec<f64> = (1..bins.saturating_sub(1))
                .map(|bin| 10.0 * (simulated.density_lsb2[bin] / real.density_lsb2[bin]).log10())
                .collect();
            let distance: Distance =
                self.maps[i].distance_to(&other.maps[i]).context("a recording without cells to compare")?;
            all.push(Channel {
                rx,
                noise_worst_db: differences.iter().map(|d| d.abs()).fold(0.0, f64::max),
                noise_mean_db: differences.iter().sum::<f64>() / differences.len().max(1) as f64,
                noise_by_bin_db: differences,
                leakage_error: leakage_error(&real.chirp_lsb, &simulated.chirp_lsb),
                sigma_real_db: self.maps[i].sigma_db(),
                sigma_simulated_db: other.maps[i].sigma_db(),
                mean_difference_db: distance.mean_db,
                kolmogorov_smirnov: distance.kolmogorov_smirnov,
                wasserstein_db: distance.wasserstein_db,
                doppler_m_per_s: distance.doppler_cells * velocity_m_per_s,
                range_m: distance.range_cells * range_m,
            });
        }
        Ok(all)
    }
}

/// What differs between two mean chirps in the range bins that hold leakage, complex, over what is there in the first; both
/// without their means, under Hann's window.
fn leakage_error(real: &[f64], simulated: &[f64]) -> f64 {
    let bins = |chirp: &[f64]| {
        let (n, mean) = (chirp.len() as f64, chirp.iter().sum::<f64>() / chirp.len().max(1) as f64);
        let bin = |k: usize| {
            let cell = |(i, x): (usize, &f64)| {
                let turn = std::f64::consts::TAU * i as f64 / n;
                Complex::from_polar((0.5 - 0.5 * turn.cos()) * (x - mean), -turn * k as f64)
            };
            chirp.iter().enumerate().map(cell).sum::<Complex<f64>>()
        };
        (0..LEAKAGE_BINS).map(bin).collect::<Vec<_>>()
    };
    let (real, simulated) = (bins(real), bins(simulated));
    let miss: f64 = real.iter().zip(&simulated).map(|(a, b)| (a - b).norm_sqr()).sum();
    (miss / real.iter().map(|z| z.norm_sqr()).sum::<f64>()).sqrt()
}

fn write(path: &Path, fit: &Fit, arguments: &Arguments) -> anyhow::Result<()> {
    let text = toml::to_string(&fit.receiver).context("the receiver as TOML")?;
    let header = format!(
        "# A BGT60TR13C as one recording shows it. Made by:\n#     radome calibrate {} --part {} -o {}\n# Schema: \
         sim/src/receiver/file.rs.\n",
        arguments.recording.display(),
        arguments.part,
        path.display()
    );
    files::write_atomically(path, |file| file.write_all((header + &text).as_bytes()).context("writing"))
}

fn report(
    arguments: &Arguments,
    fit: &Fit,
    judged: usize,
    before: &[Channel],
    after: &[Channel],
) -> anyhow::Result<()> {
    let residuals: Vec<f64> = fit.channels.iter().map(|channel| channel.residual_lsb).collect();
    if arguments.json {
        return output::json_line(&json!({
            "receiver": arguments.output, "frames_fitted": fit.frames, "frames_judged": judged,
            "fit_residual_lsb": residuals, "before": before, "after": after,
        }));
    }
    output::text_line(&format!("fitted to {} frames, judged by the {judged} after them", fit.frames))?;
    output::text_line(&format!(
        "{:>9} {:>4} {:>16} {:>9} {:>16} {:>9} {:>6} {:>8} {:>9} {:>7}",
        "receiver", "RX", "noise worst/mean", "leakage", "sigma real/sim", "mean dB", "KS", "W1 dB", "m/s", "m"
    ))?;
    for (which, channels) in [("before", before), ("fitted", after)] {
        for c in channels {
            output::text_line(&format!(
                "{which:>9} {:>4} {:>7.2}/{:>5.2} dB {:>7.1} % {:>7.2}/{:>5.2} dB {:>9.2} {:>6.3} {:>8.2} {:>9.3} {:>7.2}",
                c.rx,
                c.noise_worst_db,
                c.noise_mean_db,
                100.0 * c.leakage_error,
                c.sigma_real_db,
                c.sigma_simulated_db,
                c.mean_difference_db,
                c.kolmogorov_smirnov,
                c.wasserstein_db,
                c.doppler_m_per_s,
                c.range_m
            ))?;
        }
    }
    let residuals: Vec<String> = residuals.iter().map(|r| format!("{r:.1}")).collect();
    output::text_line(&format!("the fit leaves {} LSB rms of the mean chirps", residuals.join(", ")))?;
    match &arguments.output {
        Some(path) => output::text_line(&format!("{} written", path.display())),
        None => Ok(()),
    }
}
