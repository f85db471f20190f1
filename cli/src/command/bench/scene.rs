//! `radome bench scene`: times of frames, or, for one scene with skinned people, error against time over tolerances.

use std::path::{Path, PathBuf};

use anyhow::bail;
use radome_dsp::spectrum::complex_fft;
use radome_dsp::{FrameShape, Window};
use radome_sim::receiver::noise::density_lsb2;
use radome_sim::scene_file::BodyFile;
use radome_sim::{Scene, SimulateOptions, Simulator};
use rustfft::num_complex::Complex64;
use serde::Serialize;

use super::point::least_ms;
use super::scene_speed;
use super::stored_dense::DenseFrame;
use crate::output;
use crate::source::DEFAULT_SEED;

#[derive(clap::Args)]
pub struct Arguments {
    /// Scene file, with `body = "mesh"`: compare people as skins, at several tolerances, with dense physical optics. Without it,
    /// compare the times of frames of five scenes with scipy's maps
    scene: Option<PathBuf>,
    /// Python with numpy and scipy, and sionna-rt to time it too; `python3` if absent
    #[arg(long, conflicts_with = "scene")]
    python: Option<PathBuf>,
    /// Indices of the frames to compute also by dense physical optics, which takes up to half an hour for each
    #[arg(long, value_delimiter = ',', default_value = "10,30,50", requires = "scene")]
    frames: Vec<u64>,
    /// Tolerances, dB
    #[arg(long, value_name = "DB,...", value_delimiter = ',', default_value = "2,0.5,0.2", requires = "scene")]
    tolerances_db: Vec<f64>,
    /// Number of people, instead of the scene's own; a script has at most its own people
    #[arg(long, requires = "scene")]
    people: Option<usize>,
    /// Seed of all random draws
    #[arg(long, default_value_t = DEFAULT_SEED, requires = "scene")]
    seed: u64,
    /// Dense physical optics leaves out paths by walls that are further below the noise than this, dB
    #[arg(long, value_name = "DB", default_value_t = 10.0, requires = "scene")]
    dense_margin_db: f64,
    /// Folder that stores frames of dense physical optics for later runs
    #[arg(long, value_name = "DIR", requires = "scene")]
    dense_frames: Option<PathBuf>,
    /// Print a JSON list of objects
    #[arg(long)]
    json: bool,
}

/// Time and error of a frame at a tolerance.
#[derive(Serialize)]
struct Row {
    frame: u64,
    tolerance_db: f64,
    /// Time on one thread, ms.
    milliseconds: f64,
    dense_over_this: f64,
    /// Rms error over the cells of the map in which the echoes of the dense reference exceed the receiver's noise.
    error_db: f64,
    estimate_db: Option<f64>,
    /// Number of those cells, and the fraction of them that is more than 1 dB off.
    cells: usize,
    beyond_1_db: f64,
}

/// Measures error against time of one scene, or, if none is named, the times of several scenes.
///
/// # Errors
/// A scene cannot be read or simulated, or the dense frames cannot be stored.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    match &arguments.scene {
        Some(path) => run_tolerances(arguments, path),
        None => scene_speed::run(arguments.python.as_deref(), arguments.json),
    }
}

/// Compares the maps of frames at every tolerance, on one thread, with those of the dense reference.
fn run_tolerances(arguments: &Arguments, path: &Path) -> anyhow::Result<()> {
    let scene = Scene::load(path)?;
    if scene.file().people.body != BodyFile::Mesh {
        bail!("{}: people are ellipsoids, not meshes\n\nhint: body = \"mesh\" under [people]", path.display());
    }
    let simulator = |tolerance_db: f64| {
        let (seed, people) = (arguments.seed, arguments.people);
        Simulator::new(&scene, SimulateOptions { seed, people, tolerance_db, ..SimulateOptions::default() })
    };
    let shape = scene.waveform().shape();
    let floor = noise_floor(&density_lsb2(scene.receiver(), scene.waveform()), shape);
    let one_thread = rayon::ThreadPoolBuilder::new().num_threads(1).build()?;
    output::catch_interrupts()?;
    let settings = format!("{} {:?}", arguments.seed, arguments.people);
    let mut rows = Vec::new();
    for &frame in &arguments.frames {
        let margin_db = arguments.dense_margin_db;
        let dense = DenseFrame { simulator: &simulator(0.5)?, index: frame, margin_db, settings: &settings }
            .samples(arguments.dense_frames.as_deref())?;
        let exact = map(&dense.samples, shape);
        for &tolerance_db in &arguments.tolerances_db {
            let simulator = simulator(tolerance_db)?;
            let samples: Vec<f64> = simulator.echo_samples(frame).into_iter().map(f64::from).collect();
            let MapError { error_db, cells, beyond_1_db } = compare(&exact, &map(&samples, shape), &floor, shape);
            let milliseconds = one_thread.install(|| {
                least_ms(5, || {
                    simulator.frame(frame);
                    Ok(())
                })
            })?;
            rows.push(Row {
                frame,
                tolerance_db,
                milliseconds,
                dense_over_this: dense.milliseconds / milliseconds,
                error_db,
                estimate_db: simulator.frame_with_report(frame).1.estimate_db,
                cells,
                beyond_1_db,
            });
        }
    }
    if arguments.json { output::json_line(&rows) } else { print(&rows) }
}

fn print(rows: &[Row]) -> anyhow::Result<()> {
    output::text_line(&format!(
        "{:>6} {:>7} {:>9} {:>11} {:>9} {:>9} {:>7} {:>11}",
        "frame", "tol dB", "ms", "dense/this", "error dB", "estimate", "cells", "beyond 1 dB"
    ))?;
    for r in rows {
        let estimate = output::or_dash(r.estimate_db, 3);
        output::text_line(&format!(
            "{:6} {:7} {:9.1} {:11.0} {:9.3} {estimate:>9} {:7} {:10.1} %",
            r.frame,
            r.tolerance_db,
            r.milliseconds,
            r.dense_over_this,
            r.error_db,
            r.cells,
            100.0 * r.beyond_1_db
        ))?;
    }
    Ok(())
}

/// Map of a frame: Hann windows over both axes and Fourier sums, `[rx][doppler][range]` over half of the ranges.
fn map(samples: &[f64], shape: FrameShape) -> Vec<Complex64> {
    let (chirps, length) = (shape.chirps, shape.samples);
    let (fast, slow) = (Window::Hann.weights(length), Window::Hann.weights(chirps));
    let (over_samples, over_chirps) = (complex_fft(length), complex_fft(chirps));
    let mut cells = Vec::with_capacity(samples.len() / 2);
    for channel in samples.chunks(chirps * length) {
        let mut rows: Vec<Complex64> =
            channel.iter().enumerate().map(|(i, x)| Complex64::from(x * fast[i % length] * slow[i / length])).collect();
        over_samples.process(&mut rows);
        let columns: Vec<Vec<Complex64>> = (0..length / 2)
            .map(|range| {
                let mut column: Vec<Complex64> = (0..chirps).map(|chirp| rows[chirp * length + range]).collect();
                over_chirps.process(&mut column);
                column
            })
            .collect();
        cells.extend((0..chirps).flat_map(|doppler| columns.iter().map(move |column| column[doppler])));
    }
    cells
}

/// Mean noise power in the cells of each range.
fn noise_floor(density_lsb2: &[f64], shape: FrameShape) -> Vec<f64> {
    let energy = |length: usize| -> f64 { Window::Hann.weights(length).iter().map(|weight| weight.powi(2)).sum() };
    let gain = energy(shape.samples) * energy(shape.chirps);
    density_lsb2.iter().take(shape.samples / 2).map(|d| d * gain).collect()
}

/// Error of a map over the cells above noise.
struct MapError {
    /// Rms error, dB.
    error_db: f64,
    /// Number of cells above noise.
    cells: usize,
    /// Fraction of them that is more than 1 dB off.
    beyond_1_db: f64,
}

fn compare(exact: &[Complex64], computed: &[Complex64], floor: &[f64], shape: FrameShape) -> MapError {
    let (mut squares, mut cells, mut beyond) = (0.0, 0usize, 0usize);
    for (i, (exact, computed)) in exact.iter().zip(computed).enumerate() {
        if exact.norm_sqr() <= floor[i % (shape.samples / 2)] {
            continue;
        }
        let difference_db = 20.0 * (computed.norm() / exact.norm()).log10();
        squares += difference_db * difference_db;
        cells += 1;
        beyond += usize::from(difference_db.abs() > 1.0);
    }
    let count = cells.max(1) as f64;
    MapError { error_db: (squares / count).sqrt(), cells, beyond_1_db: beyond as f64 / count }
}
