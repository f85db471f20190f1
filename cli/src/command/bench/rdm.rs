//! `radome bench rdm`: the maps of a frame of 3 receivers, 128 chirps and 256 samples on one thread, and the same job by others.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;

use radome_dsp::rdm::reference;
use radome_dsp::spectrum::{complex_fft_f32, real_fft_f32};
use radome_dsp::{Frame, FrameShape, KernelLevel, RdmProcessor, RdmSpec, Waveform, WaveformRequest, Window, decibel};
use realfft::RealToComplex;
use rustfft::Fft;
use rustfft::num_complex::Complex32;

use super::point::{Point, least_ms};
use crate::output;

const STAGE: &str = "range-Doppler map";

#[derive(clap::Args)]
pub struct Arguments {
    /// A list of objects
    #[arg(long)]
    json: bool,
    /// Rounds; the fastest counts
    #[arg(long, default_value_t = 200)]
    rounds: usize,
    /// Python with numpy and scipy; `python3` if not given, and nothing beside ours if it has none
    #[arg(long)]
    python: Option<PathBuf>,
}

/// Measures maps by our kernels and by others.
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
        let error = point.error.map_or_else(|| "-".to_owned(), |error| format!("{error:.1}"));
        let ratio = point.milliseconds / ours;
        output::text_line(&format!("{:36} {:12.1} {error:>18} {ratio:10.1}", point.way, 1e3 * point.milliseconds))?;
    }
    Ok(())
}

/// Our kernels, the fastest first, then libraries.
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
    for (way, library_logarithm) in [("any length: realfft f64", false), ("the same, library log10", true)] {
        let mut processor = RdmProcessor::new(&spec, &waveform)?;
        processor.use_realfft();
        if library_logarithm {
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

/// Milliseconds in which scipy makes the maps of a frame of a shape in f32 on one thread; `None` where it cannot run.
pub fn scipy_ms(python: Option<&Path>, shape: FrameShape) -> Option<f64> {
    let FrameShape { rx, chirps, samples } = shape;
    let mut command = Command::new(python.unwrap_or(Path::new("python3")));
    // The script is in the program, so that it is found wherever that runs.
    command.args(["-c", include_str!("../../../bench/rdm.py"), "--peer", &format!("{rx}x{chirps}x{samples}")]);
    let said: serde_json::Value = serde_json::from_slice(&command.output().ok()?.stdout).ok()?;
    Some(said.get("scipy_f32_microseconds")?.as_f64()? * 1e-3)
}

/// The chain as one would write it with the libraries: f32 throughout, plans and buffers kept, a copy between the axes in
/// blocks, our logarithm.
struct LibraryChain {
    range: Arc<dyn RealToComplex<f32>>,
    doppler: Arc<dyn Fft<f32>>,
    /// `[chirp][sample]`
    window: Vec<f32>,
    samples: Vec<f32>,
    spectrum: Vec<Complex32>,
    /// `[range][chirp]`
    columns: Vec<Complex32>,
    scratch: Vec<Complex32>,
    range_scratch: Vec<Complex32>,
}

impl LibraryChain {
    fn new(waveform: &Waveform) -> Self {
        let shape = waveform.shape();
        let (range_window, doppler_window) = (Window::Hann.weights(shape.samples), Window::Hann.weights(shape.chirps));
        let gain = 2.0 / (range_window.iter().sum::<f64>() * doppler_window.iter().sum::<f64>()) / 2048.0;
        let window = doppler_window.iter().flat_map(|d| range_window.iter().map(move |r| (gain * d * r) as f32));
        let range = real_fft_f32(shape.samples);
        let doppler = complex_fft_f32(shape.chirps);
        LibraryChain {
            window: window.collect(),
            samples: range.make_input_vec(),
            spectrum: range.make_output_vec(),
            columns: vec![Complex32::default(); shape.samples / 2 * shape.chirps],
            scratch: vec![Complex32::default(); doppler.get_inplace_scratch_len()],
            range_scratch: range.make_scratch_vec(),
            range,
            doppler,
        }
    }

    /// Maps of all receivers into `cells`, `[rx][doppler][range]`, dB.
    fn maps(&mut self, frame: &Frame, cells: &mut [f32]) {
        let shape = frame.shape;
        let (chirps, bins) = (shape.chirps, shape.samples / 2);
        for (codes, cells) in
            frame.codes.chunks_exact(chirps * shape.samples).zip(cells.chunks_exact_mut(chirps * bins))
        {
            for (chirp, codes) in codes.chunks_exact(shape.samples).enumerate() {
                let window = &self.window[chirp * shape.samples..(chirp + 1) * shape.samples];
                for ((x, code), w) in self.samples.iter_mut().zip(codes).zip(window) {
                    *x = (f32::from(*code) - 2048.0) * w;
                }
                let done =
                    self.range.process_with_scratch(&mut self.samples, &mut self.spectrum, &mut self.range_scratch);
                debug_assert!(done.is_ok(), "buffers have the planned lengths");
                // Offset has one line where a sine has two.
                self.spectrum[0] *= 0.5;
                for (bin, x) in self.spectrum[..bins].iter().enumerate() {
                    self.columns[bin * chirps + chirp] = *x;
                }
            }
            self.doppler.process_with_scratch(&mut self.columns, &mut self.scratch);
            for first in (0..bins).step_by(8) {
                for doppler in 0..chirps {
                    let row = (doppler + chirps / 2) % chirps * bins;
                    for bin in first..(first + 8).min(bins) {
                        cells[row + bin] = self.columns[bin * chirps + doppler].norm_sqr();
                    }
                }
            }
            decibel::power_to_db(cells, 1e-20);
        }
    }
}

/// Leakage, offset, three targets and a pseudo-random last bit: what a map has to cope with.
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
