//! `radome bench rdm`: time of the maps of a frame of 3 receivers, 128 chirps and 256 samples on one thread, compared
//! with other libraries.

use std::path::{Path, PathBuf};
use std::process::Command;

use radome_dsp::rdm::{LibraryChain, reference};
use radome_dsp::{Frame, FrameShape, KernelLevel, RdmProcessor, RdmSpec, Waveform, WaveformRequest};

use super::point::{Point, least_ms};
use crate::output;

const STAGE: &str = "range-Doppler map";

#[derive(clap::Args)]
pub struct Arguments {
    /// Print a JSON list of objects
    #[arg(long)]
    json: bool,
    /// Rounds; the fastest counts
    #[arg(long, default_value_t = 200)]
    rounds: usize,
    /// Python with numpy and scipy; `python3` if absent. Without these packages, only radome is measured
    #[arg(long)]
    python: Option<PathBuf>,
}

/// Measures maps by this program's kernels and by other libraries.
///
/// # Errors
/// A map cannot be computed, or standard output cannot be written.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let points = points(arguments.rounds, arguments.python.as_deref())?;
    if arguments.json {
        return output::json_line(&points);
    }
    output::text_line(&format!(
        "{:36} {:>12} {:>18} {:>10}",
        "3 x 128 x 256, one thread", "us/frame", "worst error dBc", "x ours"
    ))?;
    let ours = points.first().map_or(f64::NAN, |point| point.milliseconds);
    for point in points {
        let error = output::or_dash(point.error, 1);
        let ratio = point.milliseconds / ours;
        output::text_line(&format!("{:36} {:12.1} {error:>18} {ratio:10.1}", point.way, 1e3 * point.milliseconds))?;
    }
    Ok(())
}

/// Measures this program's kernels, the fastest first, and then other libraries.
///
/// # Errors
/// A map cannot be computed.
pub fn points(rounds: usize, python: Option<&Path>) -> anyhow::Result<Vec<Point>> {
    let waveform = Waveform::realise(WaveformRequest::paper())?;
    let spec = RdmSpec::default();
    let frame = test_frame(&waveform);
    let mut exact = Vec::new();
    let reference_ms = least_ms(1, || {
        exact = reference::map(&spec, &waveform, std::slice::from_ref(&frame))?;
        Ok(())
    })?;
    let mut points = Vec::new();
    let mut add = |way: String, milliseconds: f64, error: Option<f64>, is_peer: bool| {
        points.push(Point { stage: STAGE, way, milliseconds, error, error_unit: "dBc", is_peer });
    };
    for level in KernelLevel::ALL.into_iter().rev().filter(|level| level.is_available()) {
        let mut processor = RdmProcessor::with_kernel(&spec, &waveform, level)?;
        let mut map = processor.empty_map();
        let ms = least_ms(rounds, || Ok(processor.process(&frame, &mut map).map(drop)?))?;
        add(format!("lanes f32, {level}"), ms, Some(worst_error_dbc(&map.db, &exact)), false);
    }
    let mut library = LibraryChain::new(&waveform);
    let mut cells = vec![0.0; exact.len()];
    let ms = least_ms(rounds, || {
        library.maps(&frame, &mut cells);
        Ok(())
    })?;
    add("realfft and rustfft f32".into(), ms, Some(worst_error_dbc(&cells, &exact)), true);
    for (way, uses_library_logarithm) in [("any length: realfft f64", false), ("the same, library log10", true)] {
        let mut processor = RdmProcessor::new(&spec, &waveform)?;
        processor.use_realfft();
        if uses_library_logarithm {
            processor.use_library_logarithm();
        }
        let mut map = processor.empty_map();
        let ms = least_ms(rounds, || Ok(processor.process(&frame, &mut map).map(drop)?))?;
        add(way.into(), ms, Some(worst_error_dbc(&map.db, &exact)), false);
    }
    if let Some(ms) = scipy_ms(python, waveform.shape()) {
        add("scipy f32".into(), ms, None, true);
    }
    add("Fourier sums f64, the reference".into(), reference_ms, None, false);
    Ok(points)
}

/// Time in which scipy computes the maps of a frame of a shape in f32 on one thread, ms; `None` where it cannot run.
pub fn scipy_ms(python: Option<&Path>, shape: FrameShape) -> Option<f64> {
    let FrameShape { rx, chirps, samples } = shape;
    let mut command = Command::new(python.unwrap_or(Path::new("python3")));
    // The script is embedded in the program, so it is found from any working directory.
    command.args(["-c", include_str!("../../../bench/rdm.py"), &format!("{rx}x{chirps}x{samples}")]);
    let response: serde_json::Value = serde_json::from_slice(&command.output().ok()?.stdout).ok()?;
    Some(response.get("scipy_f32_microseconds")?.as_f64()? * 1e-3)
}

/// Test frame with leakage, offset, three targets and a pseudo-random last bit.
fn test_frame(waveform: &Waveform) -> Frame {
    let shape = waveform.shape();
    let mut frame = Frame::zeroed(shape);
    let mut state = 1u64;
    for (i, code) in frame.codes.iter_mut().enumerate() {
        let (m, n) = ((i / shape.samples % shape.chirps) as f64, (i % shape.samples) as f64);
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        let noise = (state >> 40) as f64 / (1u64 << 24) as f64 - 0.5;
        let tone = |amplitude: f64, range: f64, doppler: f64| {
            amplitude
                * (std::f64::consts::TAU * (range * n / shape.samples as f64 + doppler * m / shape.chirps as f64)).cos()
        };
        let x = 1700.0
            + tone(600.0, 0.7, 0.0)
            + tone(60.0, 20.3, 11.7)
            + tone(8.0, 45.0, -20.2)
            + tone(2.0, 90.4, 3.3)
            + 3.0 * noise;
        *code = x.round().clamp(0.0, 4095.0) as u16;
    }
    frame
}

fn worst_error_dbc(db: &[f32], exact: &[f64]) -> f64 {
    let amplitude = |db: f64| 10f64.powf(db / 20.0);
    let peak = exact.iter().map(|e| amplitude(*e)).fold(0.0, f64::max);
    let worst = db.iter().zip(exact).map(|(a, e)| (amplitude(f64::from(*a)) - amplitude(*e)).abs()).fold(0.0, f64::max);
    20.0 * (worst / peak).log10()
}
