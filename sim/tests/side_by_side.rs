//! Paths that are traced together, compared with paths that are traced one by one.

use radome_dsp::SPEED_OF_LIGHT_M_PER_S;
use radome_sim::echo::{EchoReport, Paths, Snapshot, audible_paths};
use radome_sim::prepared_scene::PreparedScene;
use radome_sim::scenario::Scenario;

use crate::common;

const FRAME_S: f64 = 0.064;

/// Compares all paths of a person at an instant, traced together and one by one. Returns the number of paths, and the
/// number of those louder than `least_lsb`.
fn compare(paths: &Paths, people: &[Snapshot], least_lsb: f64, at: &str) -> [usize; 2] {
    let asked: Vec<_> = (0..paths.count()).map(|path| (path, None)).collect();
    let (mut report, mut report_of_one) = (EchoReport::default(), EchoReport::default());
    let bare = paths.trace_all(&asked, people, &mut report);
    let mut met = bare.clone();
    paths.obstruct_by_people((0..).zip(&mut met), people);
    let (mut keys, mut loud) = (Vec::new(), 0);
    for (path, (met, bare)) in met.iter().zip(&bare).enumerate() {
        keys.clear();
        let place = paths.trace(path, people, None, &mut keys, &mut report_of_one);
        assert_eq!(met.samples().len(), keys.len(), "{at}, path {path}");
        assert_eq!(met.unit.is_some(), place.is_some(), "{at}, path {path}");
        if let Some((met, one)) = met.unit.zip(place) {
            assert!((met - one).length() < 1e-6, "{at}, path {path}: {met} {one}");
        }
        for ((met, bare), one) in met.samples().iter().zip(bare.samples()).zip(&keys) {
            assert!((met.delay_s - one.delay_s).abs() < 1e-19, "{at}, path {path}: {met:?} {one:?}");
            assert!((met.delay_rate - one.delay_rate).abs() < 1e-14, "{at}, path {path}: {met:?} {one:?}");
            let (error_lsb, lsb) = ((met.amplitude - one.amplitude).norm(), one.amplitude.norm());
            assert!(error_lsb < 1e-6 * lsb + 1e-9 * least_lsb, "{at}, path {path}: {met:?} {one:?}");
            // People increase no amplitude: a path that is inaudible without them is inaudible with them.
            assert!(met.amplitude.norm() <= bare.amplitude.norm() * (1.0 + 1e-12), "{at}, path {path}");
        }
        loud += usize::from(keys.first().is_some_and(|key| key.amplitude.norm() > least_lsb));
    }
    assert_eq!(report, report_of_one, "{at}");
    [met.len(), loud]
}

/// Walkers, sitters and passers-by in rooms of several sizes and walls, by all pairs of images.
#[test]
fn paths_side_by_side_are_those_one_by_one() {
    for (name, seeds) in [("corridor", 1..3), ("room", 1..3), ("hall", 1..7)] {
        let mut sums = [0; 2];
        for seed in seeds {
            let scene = common::scene(name).drawn(seed).expect("a scene");
            let prepared = PreparedScene::new(&scene, seed, 10.0);
            let scenario = Scenario::new(&scene, seed, None);
            for i in 0..12 {
                let time_s = 2.0 + 2.74 * f64::from(i);
                let everybody = scenario.between(time_s, time_s + FRAME_S);
                let people: Vec<Snapshot> = everybody.iter().map(|(_, motion)| Snapshot::new(motion, time_s)).collect();
                for (me, (_, motion)) in everybody.iter().enumerate() {
                    let paths = Paths::new(&prepared, motion, me, &prepared.body_pairs);
                    let at = format!("{name}, seed {seed}, person {me} at {time_s} s");
                    let counts = compare(&paths, &people, prepared.threshold_lsb, &at);
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
            let everybody = scenario.between(time_s, time_s + FRAME_S);
            let people: Vec<Snapshot> = everybody.iter().map(|(_, motion)| Snapshot::new(motion, time_s)).collect();
            for (me, (_, motion)) in everybody.iter().enumerate() {
                let kept = audible_paths(&prepared, motion, &[time_s]);
                let paths = Paths::new(&prepared, motion, me, &kept);
                let opposite: Vec<_> = kept
                    .iter()
                    .map(|kept| radome_sim::echo::AudiblePair {
                        pair: (kept.pair.1, kept.pair.0),
                        both_ways: false,
                        ..*kept
                    })
                    .collect();
                let opposite = Paths::new(&prepared, motion, me, &opposite);
                let asked: Vec<_> = (0..paths.count()).map(|path| (path, None)).collect();
                let mut met = paths.trace_all(&asked, &people, &mut EchoReport::default());
                paths.obstruct_by_people((0..).zip(&mut met), &people);
                for (path, met) in met.iter().enumerate().filter(|&(path, _)| paths.is_both_ways(path)) {
                    let mut keys = Vec::new();
                    let place = opposite.trace(path, &people, None, &mut keys, &mut EchoReport::default());
                    let is_heard = keys.first().is_some_and(|key| key.amplitude.norm() > prepared.threshold_lsb);
                    if place.is_none() || met.unit.is_none() || !is_heard {
                        continue;
                    }
                    let at = format!("{name}, person {me} at {time_s} s, path {path}");
                    for (ours, key) in met.reversed().samples().iter().zip(&keys) {
                        let apart_m = (ours.delay_s - key.delay_s).abs() * SPEED_OF_LIGHT_M_PER_S;
                        let rate = (ours.delay_rate - key.delay_rate).abs() * SPEED_OF_LIGHT_M_PER_S;
                        assert!(apart_m < 3e-5 && rate < 0.02, "{at}: {apart_m} m, {rate} m/s");
                        error += (ours.amplitude - key.amplitude).norm_sqr();
                        power += key.amplitude.norm_sqr();
                    }
                    compared += 1;
                }
            }
        }
        let error_db = 10.0 * (error / power).log10();
        assert!(compared > 100 && error_db < -30.0, "{name}: {compared} paths, {error_db} dB");
    }
}
