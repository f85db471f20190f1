//! `radome bench synthesis`: conversion of paths to samples.

use std::time::Instant;

use radome_dsp::{Waveform, WaveformRequest};
use radome_sim::chirp::Chirp;
use radome_sim::path_segment::{PathDerivatives, PathSample, PathSegment};
use radome_sim::random::{Purpose, generator};
use radome_sim::synthesis::{CHIRPS, ChirpPositions, SynthesisScratch, Synthesiser, Tone, exact_chirp};
use radome_sim::tracks::Track;
use rand::Rng;
use rustfft::num_complex::Complex64;
use serde::Serialize;

use super::point::Point;
use crate::output;

#[derive(clap::Args)]
pub struct Arguments {
    /// Numbers of paths
    #[arg(long, value_delimiter = ',', default_value = "30,300,3000")]
    paths: Vec<usize>,
    /// Rounds; the fastest counts
    #[arg(long, default_value_t = 20)]
    rounds: usize,
    /// Print a JSON list of objects
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct Row {
    paths: usize,
    /// Time of all 128 chirps of a receiver, transforms included, us.
    microseconds: f64,
    /// Time per path without the transforms, us.
    microseconds_a_path: f64,
    /// Rms difference from the exact sum, relative to the rms of that sum.
    relative_error: f64,
    /// Time of the sum of exponentials in double precision, divided by this time.
    exact_over_this: f64,
}

const FRAME_CHIRPS: usize = 128;

/// Measures paths of walkers over the paper's chirps, within one segment.
///
/// # Errors
/// The samples cannot be computed, or standard output cannot be written.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let rows = measure(&arguments.paths, arguments.rounds)?;
    if arguments.json {
        return output::json_line(&rows);
    }
    output::text_line(&format!(
        "{:>6} {:>13} {:>12} {:>11} {:>11}",
        "paths", "us/128 chirps", "us/path", "error", "exact/this"
    ))?;
    for r in rows {
        output::text_line(&format!(
            "{:6} {:13.1} {:12.3} {:11.1e} {:11.0}",
            r.paths, r.microseconds, r.microseconds_a_path, r.relative_error, r.exact_over_this
        ))?;
    }
    Ok(())
}

/// Measures the same for the table of all stages.
///
/// # Errors
/// The samples cannot be computed.
pub fn points() -> anyhow::Result<Vec<Point>> {
    let mut points = Vec::new();
    for row in measure(&[300], 20)? {
        let point = |way: &str, milliseconds: f64, error: Option<f64>| Point {
            stage: "300 paths to 128 chirps",
            way: way.to_owned(),
            milliseconds,
            error,
            error_unit: "relative rms",
            is_peer: false,
        };
        let milliseconds = 1e-3 * row.microseconds;
        points.push(point("non-uniform FFT by chirp, f32", milliseconds, Some(row.relative_error)));
        points.push(point("sum of exponentials, f64, the reference", milliseconds * row.exact_over_this, None));
    }
    Ok(points)
}

fn measure(counts: &[usize], rounds: usize) -> anyhow::Result<Vec<Row>> {
    let waveform = Waveform::realise(WaveformRequest::paper())?;
    let chirp = Chirp::new(&waveform);
    let samples = waveform.request.samples_per_chirp;
    let synthesiser = Synthesiser::new(samples);
    let position = |i: usize| i as f64 / FRAME_CHIRPS as f64;
    let mut rows = Vec::new();
    for &count in counts {
        let paths = walkers(count);
        let (mut grids, mut grid) = ([synthesiser.grids()], synthesiser.grid());
        let mut scratch = SynthesisScratch::default();
        let mut fast = vec![0f32; FRAME_CHIRPS * samples];
        let (mut all_us, mut spread_us) = (f64::INFINITY, f64::INFINITY);
        for _ in 0..rounds.max(1) {
            fast.fill(0.0);
            let started = Instant::now();
            let mut spreading = 0.0;
            for (block, out) in fast.chunks_mut(CHIRPS * samples).enumerate() {
                let spreading_started = Instant::now();
                grids[0].clear();
                let places = ChirpPositions::new(0..CHIRPS, |lane| position(block * CHIRPS + lane));
                synthesiser.spread_tracks(&chirp, &paths, &places, &mut grids);
                spreading += spreading_started.elapsed().as_secs_f64() * 1e6;
                for (lane, out) in out.chunks_mut(samples).enumerate() {
                    grids[0].extract(lane, &mut grid);
                    synthesiser.transform(&grid, out, &mut scratch);
                }
            }
            all_us = all_us.min(started.elapsed().as_secs_f64() * 1e6);
            spread_us = spread_us.min(spreading);
        }
        // A subset of the chirps is compared.
        let (mut squared_error, mut power, mut exact_us, mut compared) = (0.0, 0.0, 0.0, 0.0);
        for i in (0..FRAME_CHIRPS).step_by(16) {
            let tones: Vec<Tone> = paths.iter().map(|path| tone(&path.first, &chirp, position(i))).collect();
            let started = Instant::now();
            let exact = exact_chirp(&tones, samples);
            exact_us += started.elapsed().as_secs_f64() * 1e6;
            compared += 1.0;
            for (exact, fast) in exact.iter().zip(fast.iter().skip(i * samples)) {
                squared_error += (exact - f64::from(*fast)).powi(2);
                power += exact * exact;
            }
        }
        rows.push(Row {
            paths: count,
            microseconds: all_us,
            microseconds_a_path: spread_us / count.max(1) as f64,
            relative_error: (squared_error / power).sqrt(),
            exact_over_this: exact_us / compared * FRAME_CHIRPS as f64 / all_us,
        });
    }
    Ok(rows)
}

fn tone(path: &PathSegment, chirp: &Chirp, position: f64) -> Tone {
    let (delay_s, rate) = path.delay(position);
    Tone {
        phase_cycles: chirp.phase_cycles(delay_s),
        cycles_per_sample: chirp.beat_hz(delay_s, rate) / chirp.sample_rate_hz,
        amplitude: path.amplitude(position),
    }
}

/// Paths of walkers to one receiver: ranges from half a metre to fifteen, radial speeds up to three metres per second
/// either way, over 64 ms.
fn walkers(count: usize) -> Vec<Track> {
    const INTERVAL_S: f64 = 0.064;
    let mut rng = generator(1, Purpose::Noise, [0, 0]);
    let mut paths = Vec::with_capacity(count);
    for _ in 0..count {
        let delay_s = rng.random_range(3e-9..100e-9);
        let delay_rate = rng.random_range(-2e-8..2e-8);
        let mut sample = |delay_s| {
            let amplitude = Complex64::new(rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0));
            (PathSample { delay_s, delay_rate, amplitude }, PathDerivatives::default())
        };
        let (first, last) = (sample(delay_s), sample(delay_s + delay_rate * INTERVAL_S));
        paths.push(Track { first: PathSegment::between(&first, &last, INTERVAL_S), others: Default::default() });
    }
    paths
}
