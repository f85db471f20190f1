//! Receivers that share a path against paths of their own.

use std::sync::Arc;

use num_complex::Complex;
use radome_sim::actor::motion::{Motion, MotionBuilder, Person};
use radome_sim::echo::{EchoReport, Paths, Snapshot, audible_pairs};
use radome_sim::slow_time::{Bend, Key, Stretch};
use radome_sim::stage::Stage;
use radome_sim::synthesis::{CHIRPS, Places, SynthesisScratch, Synthesiser, Tone, exact_chirp};
use radome_sim::tracks::Track;

use crate::common::scene;

const SAMPLES: usize = 256;
const STRETCH_S: f64 = 0.032;
const APART_S: f64 = 1e-3;

/// Keys of every path to every receiver at a time, and how they bend there: `[path][receiver]`.
fn keys(stage: &Stage, motion: &Arc<Motion>, time_s: f64) -> Vec<Vec<(Key, Bend)>> {
    let pairs = audible_pairs(stage, motion, 1.5);
    let paths = Paths::new(stage, motion, 0, &pairs);
    let trace = |path: usize, time_s: f64| {
        let (mut keys, mut report) = (Vec::new(), EchoReport::default());
        paths.trace(path, &[Snapshot::new(motion, time_s)], None, &mut keys, &mut report);
        keys
    };
    let bent = |path: usize| {
        let [before, now, after] = [-APART_S, 0.0, APART_S].map(|apart_s| trace(path, time_s + apart_s));
        let three = before.iter().zip(&now).zip(&after);
        three.map(|((before, now), after)| (*now, Bend::between(before, now, after, APART_S))).collect()
    };
    (0..paths.count()).map(bent).collect()
}

/// A walker in the corridor, over half a frame: what all receivers hear of tracks that they share against the sum of each one's
/// own stretches.
#[test]
fn receivers_that_share_a_path_hear_their_own() {
    let stage = Stage::new(&scene("corridor"), 0, 10.0);
    let walk = MotionBuilder::new(Person::draw(1, [0, 0], 1.75), 0.0, [9.0, 1.2], 3.1).walk_to([2.0, 0.9], 1.3);
    let motion = Arc::new(walk.stay());
    let synthesiser = Synthesiser::new(SAMPLES);
    for start_s in [1.5, 1.7, 3.3, 4.4] {
        let ends = [start_s, start_s + STRETCH_S].map(|time_s| keys(&stage, &motion, time_s));
        let heard = |keys: &[(Key, Bend)]| keys[0].0.amplitude.norm() > 0.5 * stage.threshold_lsb;
        let paths = ends[0].iter().zip(&ends[1]).filter(|(a, b)| heard(a) && heard(b));
        let (mut tracks, mut own) = (Vec::new(), vec![Vec::new(); stage.rx.len()]);
        for (a, b) in paths {
            tracks.push(Track::between(a, b, STRETCH_S).expect("a receiver"));
            for ((a, b), own) in a.iter().zip(b).zip(&mut own) {
                own.push(Stretch::between(a, b, STRETCH_S));
            }
        }
        assert!(tracks.len() > 20 && own.len() == 3, "{} paths, {} receivers", tracks.len(), own.len());
        let place = |chirp: usize| (chirp as f64 + 0.3) / CHIRPS as f64;
        let mut grids = vec![synthesiser.grids(); own.len()];
        synthesiser.spread_tracks(&stage.chirp, &tracks, &Places::new(0..CHIRPS, place), &mut grids);
        for (receiver, (grids, own)) in grids.iter().zip(&own).enumerate() {
            let (mut error, mut power) = (0.0, 0.0);
            for chirp in 0..CHIRPS {
                let tone = |path: &Stretch| {
                    let (delay_s, rate) = path.delay(place(chirp));
                    let amplitude: Complex<f32> = path.amplitude(place(chirp));
                    let cycles_per_sample = stage.chirp.beat_hz(delay_s, rate) / stage.chirp.sample_rate_hz;
                    Tone { phase_cycles: stage.chirp.phase_cycles(delay_s), cycles_per_sample, amplitude }
                };
                let exact = exact_chirp(&own.iter().map(tone).collect::<Vec<Tone>>(), SAMPLES);
                let (mut grid, mut fast) = (synthesiser.grid(), vec![0f32; SAMPLES]);
                grids.extract(chirp, &mut grid);
                synthesiser.transform(&grid, &mut fast, &mut SynthesisScratch::default());
                error += exact.iter().zip(&fast).map(|(e, f)| (e - f64::from(*f)).powi(2)).sum::<f64>();
                power += exact.iter().map(|e| e * e).sum::<f64>();
            }
            let error_db = 10.0 * (error / power).log10();
            assert!(error_db < -50.0, "at {start_s} s, receiver {receiver}: {error_db} dB");
        }
    }
}
