//! Benchmark of people as ellipsoids: frames at several tolerances and sampling intervals, compared with tracing every
//! chirp.

use radome_dsp::Frame;
use radome_sim::{Scene, SimulateOptions, Simulator};

use super::point::{Point, least_ms};
use crate::files;

const STAGE: &str = "a frame of two walkers";
/// Frames that are compared.
const FRAMES: [u64; 3] = [40, 60, 80];
/// Number of times that segments of a frame are halved for the reference, which gives 128 segments.
const HALVINGS: u32 = 7;

/// Measures the corridor with two walkers on all threads. The error is the rms of the samples' difference, relative to
/// the samples' rms.
///
/// # Errors
/// The scene cannot be read or simulated.
pub fn points(rounds: usize) -> anyhow::Result<Vec<Point>> {
    let scene = Scene::load(&files::fixture("scenes/corridor.toml")?)?;
    let simulator = |tolerance_db: f64| {
        let options = SimulateOptions { seed: 100_001, people: Some(2), tolerance_db, ..Default::default() };
        Simulator::new(&scene, options)
    };
    let exact: Vec<Vec<f32>> = {
        let simulator = simulator(0.02)?;
        FRAMES.iter().map(|&index| simulator.echo_samples_halved(index, HALVINGS)).collect()
    };
    let mut points = Vec::new();
    for tolerance_db in [0.5, 2.0, 0.2] {
        let simulator = simulator(tolerance_db)?;
        let (mut squared_error, mut power) = (0.0, 0.0);
        for (&index, exact) in FRAMES.iter().zip(&exact) {
            for (a, b) in simulator.echo_samples(index).iter().zip(exact) {
                squared_error += f64::from(a - b).powi(2);
                power += f64::from(*b).powi(2);
            }
        }
        let ms = least_ms(rounds, || {
            for index in FRAMES {
                let frame: Frame = simulator.frame(index);
                std::hint::black_box(frame);
            }
            Ok(())
        })?;
        points.push(Point {
            stage: STAGE,
            way: format!("tolerance {tolerance_db} dB"),
            milliseconds: ms / FRAMES.len() as f64,
            error: Some(10.0 * (squared_error / power).log10()),
            error_unit: "dB of echoes",
            is_peer: false,
        });
    }
    Ok(points)
}
