//! Paths that are traced together, compared with paths that are traced one by one.

use radome_sim::echo::{EchoReport, Paths, Snapshot};
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
    paths.shade((0..).zip(&mut met), people);
    let (mut keys, mut loud) = (Vec::new(), 0);
    for (path, (met, bare)) in met.iter().zip(&bare).enumerate() {
        keys.clear();
        let place = paths.trace(path, people, None, &mut keys, &mut report_of_one);
        assert_eq!(met.keys().len(), keys.len(), "{at}, path {path}");
        assert_eq!(met.place.is_some(), place.is_some(), "{at}, path {path}");
        if let Some((met, one)) = met.place.zip(place) {
            assert!((met - one).length() < 1e-6, "{at}, path {path}: {met} {one}");
        }
        for ((met, bare), one) in met.keys().iter().zip(bare.keys()).zip(&keys) {
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
