mod kept_dense;
mod networks;
mod scene;
mod solver;
mod synthesis;

use std::time::Instant;

use radome_dsp::rdm::reference;
use radome_dsp::{Frame, KernelLevel, RdmProcessor, RdmSpec, Waveform, WaveformRequest};
use serde::Serialize;

use crate::output;

/// `radome bench`
#[derive(clap::Args)]
pub struct Arguments {
    #[command(subcommand)]
    stage: Stage,
}

#[derive(clap::Subcommand)]
enum Stage {
    /// Range-Doppler maps: 3 receivers x 128 chirps x 256 samples on one thread
    Rdm {
        /// A list of objects
        #[arg(long)]
        json: bool,
        /// Rounds; the fastest counts
        #[arg(long, default_value_t = 200)]
        rounds: usize,
    },
    /// Cross-sections of canonical targets by every method that suits them, beside plain sums over patches
    Solver(solver::Arguments),
    /// From paths to samples: 128 chirps of 256 samples on one thread, beside the sum of exponentials
    Synthesis(synthesis::Arguments),
    /// People with skins in a scene at several tolerances, beside dense physical optics in every chirp
    Scene(scene::Arguments),
    /// A training step of the networks at maps of 128 x 128, beside PyTorch's
    Train(networks::Arguments),
    /// Networks at work on one map of 128 x 128, beside onnxruntime and PyTorch
    Infer(networks::Arguments),
}

/// One way to make the maps of a frame.
#[derive(Serialize)]
struct Row {
    variant: String,
    microseconds: f64,
    /// Worst amplitude error of a cell against the strongest cell, dBc.
    worst_error_dbc: f64,
}

/// Speed against error.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    match &arguments.stage {
        Stage::Rdm { json, rounds } => rdm(*json, *rounds),
        Stage::Solver(arguments) => solver::run(arguments),
        Stage::Synthesis(arguments) => synthesis::run(arguments),
        Stage::Scene(arguments) => scene::run(arguments),
        Stage::Train(arguments) => networks::train(arguments),
        Stage::Infer(arguments) => networks::infer(arguments),
    }
}

fn rdm(json: bool, rounds: usize) -> anyhow::Result<()> {
    let waveform = Waveform::realise(WaveformRequest::paper())?;
    let spec = RdmSpec::default();
    let frame = test_frame(&waveform);
    let started = Instant::now();
    let exact = reference::map(&spec, &waveform, std::slice::from_ref(&frame))?;
    let reference_us = started.elapsed().as_secs_f64() * 1e6;
    let mut variants = Vec::new();
    // The product's own path first.
    for level in KernelLevel::ALL.into_iter().rev().filter(|level| level.is_available()) {
        variants.push((format!("lanes f32, {level}"), RdmProcessor::with_kernel(&spec, &waveform, level)?));
    }
    for (variant, library) in [("realfft f64, polynomial decibels", false), ("realfft f64, library log10", true)] {
        let mut processor = RdmProcessor::new(&spec, &waveform)?;
        processor.use_realfft();
        if library {
            processor.use_library_logarithm();
        }
        variants.push((variant.to_owned(), processor));
    }
    let mut rows = Vec::new();
    for (variant, mut processor) in variants {
        let mut map = processor.empty_map();
        let mut fastest = f64::MAX;
        for _ in 0..rounds.max(1) {
            let started = Instant::now();
            processor.process(&frame, &mut map)?;
            fastest = fastest.min(started.elapsed().as_secs_f64() * 1e6);
        }
        rows.push(Row { variant, microseconds: fastest, worst_error_dbc: worst_error_dbc(&map.db, &exact) });
    }
    rows.push(Row {
        variant: "Fourier sums f64 (the reference)".to_owned(),
        microseconds: reference_us,
        worst_error_dbc: f64::NEG_INFINITY,
    });
    if json {
        // JSON has no infinity: the reference's error is null.
        return output::json_line(&rows);
    }
    output::text_line(&format!("{:36} {:>12} {:>18}", "3 x 128 x 256, one thread", "us/frame", "worst error dBc"))?;
    for row in rows {
        output::text_line(&format!("{:36} {:12.1} {:18.1}", row.variant, row.microseconds, row.worst_error_dbc))?;
    }
    output::text_line("the same job in scipy: python3 cli/bench/rdm.py")
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
