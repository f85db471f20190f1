//! Paths that are traced together, compared with paths that are traced one by one.

use radome_dsp::SPEED_OF_LIGHT_M_PER_S;
use radome_sim::echo::{EchoReport, Paths, Snapshot, audible_paths};
use radome_sim::prepared_scene::PreparedScene;
use radome_sim::scenario::Scenario;

use crate::common;

const FRAME_S: f64 = 0.064;

/// Compares all paths of a person at an instant, traced together and one by one. Returns the number of paths, and the
/// number of those stronger than `threshold_lsb`.
fn compare(paths: &Paths, people: &[Snapshot], threshold_lsb: f64, context: &str) -> [usize; 2] {
    let requests: Vec<_> = (0..paths.count()).map(|path| (path, None)).collect();
    let (mut report, mut report_of_single) = (EchoReport::default(), EchoReport::default());
    let without_people = paths.trace_all(&requests, people, &mut report);
    let mut traced = without_people.clone();
    paths.obstruct_by_people((0..).zip(&mut traced), people);
    let (mut samples, mut audible) = (Vec::new(), 0);
    for (path, (traced, without_people)) in traced.iter().zip(&without_people).enumerate() {
        samples.clear();
        let specular_point = paths.trace(path, people, None, &mut samples, &mut report_of_single);
        assert_eq!(traced.samples().len(), samples.len(), "{context}, path {path}");
        assert_eq!(traced.unit.is_some(), specular_point.is_some(), "{context}, path {path}");
        if let Some((traced, single)) = traced.unit.zip(specular_point) {
            assert!((traced - single).length() < 1e-6, "{context}, path {path}: {traced} {single}");
        }
        for ((traced, without_people), single) in traced.samples().iter().zip(without_people.samples()).zip(&samples) {
            assert!((traced.delay_s - single.delay_s).abs() < 1e-19, "{context}, path {path}: {traced:?} {single:?}");
            assert!(
                (traced.delay_rate - single.delay_rate).abs() < 1e-14,
                "{context}, path {path}: {traced:?} {single:?}"
            );
            let (error_lsb, lsb) = ((traced.amplitude - single.amplitude).norm(), single.amplitude.norm());
            assert!(error_lsb < 1e-6 * lsb + 1e-9 * threshold_lsb, "{context}, path {path}: {traced:?} {single:?}");
            // People increase no amplitude: a path that is inaudible without them is inaudible with them.
            assert!(
                traced.amplitude.norm() <= without_people.amplitude.norm() * (1.0 + 1e-12),
                "{context}, path {path}"
            );
        }
        audible += usize::from(samples.first().is_some_and(|sample| sample.amplitude.norm() > threshold_lsb));
    }
    assert_eq!(report, report_of_single, "{context}");
    [traced.len(), audible]
}

/// Walkers, sitters and passers-by in rooms of several sizes and walls, by all pairs of images.
#[test]
fn paths_traced_together_agree_with_paths_traced_one_by_one() {
    for (name, seeds) in [("corridor", 1..3), ("room", 1..3), ("hall", 1..7)] {
        let mut sums = [0; 2];
        for seed in seeds {
            let scene = common::scene(name).drawn(seed).expect("a scene");
            let prepared = PreparedScene::new(&scene, seed, 10.0);
            let scenario = Scenario::new(&scene, seed, None);
            for i in 0..12 {
                let time_s = 2.0 + 2.74 * f64::from(i);
                let people_and_motions = scenario.between(time_s, time_s + FRAME_S);
                let people: Vec<Snapshot> =
                    people_and_motions.iter().map(|(_, motion)| Snapshot::new(motion, time_s)).collect();
                for (person_index, (_, motion)) in people_and_motions.iter().enumerate() {
                    let paths = Paths::new(&prepared, motion, person_index, &prepared.body_pairs);
                    let context = format!("{name}, seed {seed}, person {person_index} at {time_s} s");
                    let counts = compare(&paths, &people, prepared.threshold_lsb, &context);
                    sums.iter_mut().zip(counts).for_each(|(sum, count)| *sum += count);
                }
            }
        }
        assert!(sums[1] > 0 && sums[0] > sums[1], "{name}: {sums:?}");
    }
}

/// Paths that stand for both directions, compared with separate paths of the opposite direction: length, rate of the
/// length, and amplitude of every audible path.
#[test]
fn opposite_directions_share_specular_point_and_amplitude() {
    for name in ["corridor", "room", "hall", "glass-wall"] {
        let scene = common::scene(name).drawn(1).expect("a scene");
        let prepared = PreparedScene::new(&scene, 1, 10.0);
        let scenario = Scenario::new(&scene, 1, None);
        let (mut compared, mut error, mut power) = (0, 0.0, 0.0);
        for i in 0..12 {
            let time_s = 2.0 + 2.74 * f64::from(i);
            let people_and_motions = scenario.between(time_s, time_s + FRAME_S);
            let people: Vec<Snapshot> =
                people_and_motions.iter().map(|(_, motion)| Snapshot::new(motion, time_s)).collect();
            for (person_index, (_, motion)) in people_and_motions.iter().enumerate() {
                let kept_pairs = audible_paths(&prepared, motion, &[time_s]);
                let paths = Paths::new(&prepared, motion, person_index, &kept_pairs);
                let opposite: Vec<_> = kept_pairs
                    .iter()
                    .map(|kept| radome_sim::echo::AudiblePair {
                        pair: (kept.pair.1, kept.pair.0),
                        both_ways: false,
                        ..*kept
                    })
                    .collect();
                let opposite = Paths::new(&prepared, motion, person_index, &opposite);
                let requests: Vec<_> = (0..paths.count()).map(|path| (path, None)).collect();
                let mut traced = paths.trace_all(&requests, &people, &mut EchoReport::default());
                paths.obstruct_by_people((0..).zip(&mut traced), &people);
                for (path, traced) in traced.iter().enumerate().filter(|&(path, _)| paths.is_both_ways(path)) {
                    let mut samples = Vec::new();
                    let specular_point = opposite.trace(path, &people, None, &mut samples, &mut EchoReport::default());
                    let is_audible =
                        samples.first().is_some_and(|sample| sample.amplitude.norm() > prepared.threshold_lsb);
                    if specular_point.is_none() || traced.unit.is_none() || !is_audible {
                        continue;
                    }
                    let context = format!("{name}, person {person_index} at {time_s} s, path {path}");
                    for (reversed, sample) in traced.reversed().samples().iter().zip(&samples) {
                        let difference_m = (reversed.delay_s - sample.delay_s).abs() * SPEED_OF_LIGHT_M_PER_S;
                        let rate_difference_m_per_s =
                            (reversed.delay_rate - sample.delay_rate).abs() * SPEED_OF_LIGHT_M_PER_S;
                        assert!(
                            difference_m < 3e-5 && rate_difference_m_per_s < 0.02,
                            "{context}: {difference_m} m, {rate_difference_m_per_s} m/s"
                        );
                        error += (reversed.amplitude - sample.amplitude).norm_sqr();
                        power += sample.amplitude.norm_sqr();
                    }
                    compared += 1;
                }
            }
        }
        let error_db = 10.0 * (error / power).log10();
        assert!(compared > 100 && error_db < -30.0, "{name}: {compared} paths, {error_db} dB");
    }
}
