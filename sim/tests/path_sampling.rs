//! Accuracy of maps for echoes traced at a few samples of a frame, compared with tracing at every chirp.
#![allow(clippy::print_stderr)]

use radome_sim::{Scene, SimulateOptions, Simulator};

use crate::common::{doppler_power, hall, map_db, parse, range_profiles, scene, simulator};

const CHIRPS: usize = 128;
const SAMPLES: usize = 256;
/// Depth below the strongest pixel within which pixels count, dB.
const DEPTH_DB: f64 = 40.0;

/// Rms difference in dB over the pixels near the reference's peak.
fn rms_db(map: &[f64], reference: &[f64]) -> f64 {
    let floor = reference.iter().copied().fold(0.0, f64::max) * 10f64.powf(-0.1 * DEPTH_DB);
    let pixels = map.iter().zip(reference).filter(|(_, r)| **r > floor);
    let squares: Vec<f64> = pixels.map(|(m, r)| (10.0 * (m / r).log10()).powi(2)).collect();
    (squares.iter().sum::<f64>() / squares.len() as f64).sqrt()
}

/// First receiver's map of the echoes of people.
fn map_of(samples: &[f32]) -> Vec<f64> {
    let samples: Vec<f64> = samples[..CHIRPS * SAMPLES].iter().map(|&x| f64::from(x)).collect();
    doppler_power(&range_profiles(&samples, SAMPLES))
}

/// Frames with the sample times that the simulator chooses, compared with frames that trace every chirp.
/// Walls, diffraction by limbs and by other people, and the omission of inaudible paths are included.
#[test]
fn maps_from_path_samples_agree_with_tracing_every_chirp() {
    let walker = |from: [f64; 2], to: [f64; 2]| {
        let [a, b] = [from, to].map(|[x, y]| format!("{{ walk_to_m = [{x}, {y}] }}"));
        parse(&hall(&format!("[people]\nactor = [{{ step = [{a}, {b}] }}]\n")))
    };
    let scenes: [(&str, Scene, u64, std::ops::Range<u64>); 5] = [
        ("comes", walker([9.0, 10.2], [2.0, 10.2]), 1, 15..27),
        ("goes", walker([2.0, 9.9], [9.0, 9.9]), 1, 15..27),
        ("crosses", walker([5.0, 7.0], [6.5, 13.0]), 1, 15..27),
        ("corridor", scene("corridor"), 3, 66..78),
        ("room", scene("room"), 1, 44..56),
    ];
    eprintln!("rms dB over pixels within {DEPTH_DB} dB of the peak:");
    eprintln!("{:>8} {:>6} {:>8} {:>8} {:>8}", "scene", "frame", "chosen", "2 each", "3 each");
    for (name, scene, seed, frames) in scenes {
        let simulator: Simulator = simulator(&scene, seed, None);
        let (mut worst, mut squares) = (0.0f64, 0.0);
        let count = frames.clone().count() as f64;
        for frame in frames {
            let reference = map_of(&simulator.echo_samples_halved(frame, CHIRPS.ilog2()));
            let error = |samples: Vec<f32>| rms_db(&map_of(&samples), &reference);
            let chosen = error(simulator.echo_samples(frame));
            let [two, three] = [0, 1].map(|halvings| error(simulator.echo_samples_halved(frame, halvings)));
            eprintln!("{name:>8} {frame:>6} {chosen:>8.4} {two:>8.4} {three:>8.4}");
            worst = worst.max(chosen);
            squares += chosen * chosen / count;
        }
        eprintln!("{name:>8}  worst {worst:.4} dB, all {:.4} dB", squares.sqrt());
        assert!(worst < 0.15 && squares.sqrt() < 0.05, "{name}: {worst} dB at worst");
    }
}

/// Frames at the default tolerance compared with frames of a tenth of it, without the slow-time mean, since static paths
/// draw other jitters if there are more of them. Over the cells that are 10 dB above the noise, all approximations
/// together are within the tolerance. The other cells have the same mean power.
#[test]
fn frames_differ_from_finer_ones_by_less_than_the_tolerance() {
    for name in ["corridor", "room", "hall"] {
        let scene = scene(name).drawn(5).expect("a scene");
        let simulator = |tolerance_db: f64| {
            let people = (name == "hall").then_some(2);
            let options = SimulateOptions { seed: 5, people, tolerance_db, ..SimulateOptions::default() };
            Simulator::new(&scene, options).expect("a simulator")
        };
        let [default, exact] = [0.5, 0.05].map(simulator);
        let map = |simulator: &Simulator, index: u64| -> Vec<f64> {
            map_db(&simulator.frame(index), 0).iter().map(|db| 10f64.powf(0.1 * db)).collect()
        };
        let (mut squares, mut cells, mut powers) = (0.0, 0, [0.0; 2]);
        for index in (10..40).step_by(2) {
            let (default, exact) = (map(&default, index), map(&exact, index));
            let mut sorted = exact.clone();
            sorted.sort_by(f64::total_cmp);
            let noise = sorted[sorted.len() / 2] / std::f64::consts::LN_2;
            for (default, exact) in default.iter().zip(&exact).filter(|(_, exact)| **exact > 10.0 * noise) {
                squares += (10.0 * (default / exact).log10()).powi(2);
                cells += 1;
            }
            let weak = |map: &[f64]| {
                map.iter().zip(&exact).filter(|(_, exact)| **exact <= 10.0 * noise).map(|(cell, _)| cell).sum::<f64>()
            };
            powers = [powers[0] + weak(&default), powers[1] + weak(&exact)];
        }
        let rms_db = (squares / f64::from(cells)).sqrt();
        let mean_db = 10.0 * (powers[0] / powers[1]).log10();
        eprintln!("{name}: {rms_db:.3} dB rms over {cells} cells, others {mean_db:+.3} dB in the mean");
        assert!(cells > 300 && rms_db < 0.5, "{name}: {rms_db} dB rms over {cells} cells");
        assert!(mean_db.abs() < 0.05, "{name}: {mean_db} dB in the mean of weak cells");
    }
}
