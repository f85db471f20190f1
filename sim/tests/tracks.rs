//! Receivers that share a path, compared with separate paths for each receiver.

use std::sync::Arc;

use num_complex::Complex;
use radome_sim::echo::{EchoReport, Paths, Snapshot, audible_pairs};
use radome_sim::path_segment::{FiveSamples, PathSample, PathSegment};
use radome_sim::people::motion::{Motion, MotionBuilder, Person};
use radome_sim::prepared_scene::PreparedScene;
use radome_sim::synthesis::{CHIRPS, ChirpPositions, SynthesisScratch, Synthesiser, Tone, exact_chirp};
use radome_sim::tracks::Track;

use crate::common::scene;

const SAMPLES: usize = 256;
const INTERVAL_S: f64 = 0.032;

/// Samples of every path to every receiver at a time: `[path][receiver]`.
fn path_samples(prepared: &PreparedScene, motion: &Arc<Motion>, time_s: f64) -> Vec<Vec<PathSample>> {
    let pairs = audible_pairs(prepared, motion, 1.5);
    let paths = Paths::new(prepared, motion, 0, &pairs);
    let trace = |path: usize| {
        let (mut samples, mut report) = (Vec::new(), EchoReport::default());
        paths.trace(path, &[Snapshot::new(motion, time_s)], None, &mut samples, &mut report);
        samples
    };
    (0..paths.count()).map(trace).collect()
}

/// A walker in the corridor, over half a frame: the samples of all receivers from shared tracks, compared with the sum
/// of each receiver's own segments.
#[test]
fn shared_tracks_agree_with_separate_segments_of_each_receiver() {
    let prepared = PreparedScene::new(&scene("corridor"), 0, 10.0);
    let walk = MotionBuilder::new(Person::draw(1, [0, 0], 1.75), 0.0, [9.0, 1.2], 3.1).walk_to([2.0, 0.9], 1.3);
    let motion = Arc::new(walk.stay());
    let synthesiser = Synthesiser::new(SAMPLES);
    for start_s in [1.5, 1.7, 3.3, 4.4] {
        let five_samples = [0.0, 0.25, 0.5, 0.75, 1.0]
            .map(|fraction| path_samples(&prepared, &motion, start_s + fraction * INTERVAL_S));
        let is_received = |path: &usize| {
            five_samples.iter().all(|samples| samples[*path][0].amplitude.norm() > 0.5 * prepared.threshold_lsb)
        };
        let (mut tracks, mut own_segments) = (Vec::new(), vec![Vec::new(); prepared.rx.len()]);
        for path in (0..five_samples[0].len()).filter(is_received) {
            let samples_of_receiver = |rx: usize| five_samples.each_ref().map(|samples| samples[path][rx]);
            let receivers: Vec<FiveSamples> = (0..prepared.rx.len()).map(samples_of_receiver).collect();
            tracks.push(Track::through(&receivers, INTERVAL_S, 60e9).expect("a receiver").0);
            for (samples, own_segments) in receivers.iter().zip(&mut own_segments) {
                own_segments.push(PathSegment::through(samples, INTERVAL_S, 60e9).0);
            }
        }
        assert!(
            tracks.len() > 20 && own_segments.len() == 3,
            "{} paths, {} receivers",
            tracks.len(),
            own_segments.len()
        );
        let chirp_position = |chirp: usize| (chirp as f64 + 0.3) / CHIRPS as f64;
        let mut grids = vec![synthesiser.grids(); own_segments.len()];
        synthesiser.spread_tracks(
            &prepared.chirp,
            &tracks,
            &ChirpPositions::new(0..CHIRPS, chirp_position),
            &mut grids,
        );
        for (receiver, (grids, own_segments)) in grids.iter().zip(&own_segments).enumerate() {
            let (mut error, mut power) = (0.0, 0.0);
            for chirp in 0..CHIRPS {
                let tone = |path: &PathSegment| {
                    let (delay_s, rate) = path.delay(chirp_position(chirp));
                    let amplitude: Complex<f32> = path.amplitude(chirp_position(chirp));
                    let cycles_per_sample = prepared.chirp.beat_hz(delay_s, rate) / prepared.chirp.sample_rate_hz;
                    Tone { phase_cycles: prepared.chirp.phase_cycles(delay_s), cycles_per_sample, amplitude }
                };
                let exact = exact_chirp(&own_segments.iter().map(tone).collect::<Vec<Tone>>(), SAMPLES);
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
