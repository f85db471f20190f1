//! Segments that an image pair cannot make heard are left out before they are traced: none that can be heard is among them.

use radome_sim::actor::body::SEGMENTS;
use radome_sim::actor::motion::Motion;
use radome_sim::actor::program::Program;
use radome_sim::echo::{EchoReport, HEARD, Paths, Snapshot, audible_paths};
use radome_sim::stage::Stage;

use crate::common;

const FRAME_S: f64 = 0.064;

/// Counts a person's highlights in a frame: all, those that are kept, and those that are heard.
fn count(stage: &Stage, motion: &Motion, start_s: f64) -> [usize; 3] {
    let instants_s = [0.0, 0.5, 1.0].map(|part| start_s + part * FRAME_S);
    let kept = audible_paths(stage, motion, &instants_s);
    assert_eq!(kept.first().map(|first| first.pair), stage.body_pairs.first().copied(), "the direct pair is the first");
    let all = Paths::new(stage, motion, 0, &stage.body_pairs);
    let mut heard = 0;
    for (number, &pair) in stage.body_pairs.iter().enumerate() {
        for segment in 0..SEGMENTS {
            let is_kept = kept.iter().any(|kept| kept.pair == pair && kept.has(segment));
            let strongest = instants_s.map(|time_s| {
                let (people, mut keys) = ([Snapshot::new(motion, time_s)], Vec::new());
                all.trace(number * SEGMENTS + segment, &people, None, &mut keys, &mut EchoReport::default());
                keys.first().map_or(0.0, |key| key.amplitude.norm())
            });
            let strongest = strongest.into_iter().fold(0.0, f64::max);
            let is_heard = strongest > HEARD * stage.threshold_lsb;
            let over = strongest / stage.threshold_lsb;
            assert!(is_kept || !is_heard, "{pair:?} {segment} at {start_s} s: {over} of the threshold");
            heard += usize::from(is_heard);
        }
    }
    let kept = kept.iter().map(|pair| pair.segments.count_ones() as usize).sum();
    [stage.body_pairs.len() * SEGMENTS, kept, heard]
}

/// Walkers, sitters and passers-by in rooms of several sizes and walls: whatever is heard is kept, and something is left out.
#[test]
fn what_is_heard_is_kept() {
    for (name, seeds) in [("corridor", 1..3), ("room", 1..3), ("hall", 1..7)] {
        let mut sums = [0; 3];
        for seed in seeds {
            let scene = common::scene(name).drawn(seed).expect("a scene");
            let stage = Stage::new(&scene, seed, 10.0);
            let program = Program::new(&scene, seed, None);
            for i in 0..24 {
                let start_s = 2.0 + 1.37 * f64::from(i);
                for (_, motion) in program.between(start_s, start_s + FRAME_S) {
                    let counts = count(&stage, &motion, start_s);
                    sums.iter_mut().zip(counts).for_each(|(sum, count)| *sum += count);
                }
            }
        }
        let [all, kept, heard] = sums;
        assert!(heard > 0, "{name}: somebody is there");
        assert!(kept < all, "{name}: {kept} of {all} kept");
    }
}

/// Pairs of images alone stand for all segments.
#[test]
fn plain_pairs_leave_nothing_out() {
    let scene = common::scene("corridor");
    let stage = Stage::new(&scene, 1, 10.0);
    let program = Program::new(&scene, 1, None);
    let mut seconds = (0..100).map(f64::from);
    let motion = seconds.find_map(|time_s| program.between(time_s, time_s).pop()).map(|(_, motion)| motion);
    let motion = motion.expect("somebody comes");
    assert_eq!(Paths::new(&stage, &motion, 0, &stage.body_pairs).count(), stage.body_pairs.len() * SEGMENTS);
}
