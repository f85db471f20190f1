//! Body segments that an image pair cannot make audible are left out before tracing; no audible segment is left out.

use std::collections::HashMap;

use num_complex::Complex64;
use radome_sim::echo::{AUDIBLE_FRACTION, AudiblePair, EchoReport, Paths, Snapshot, audible_paths};
use radome_sim::people::body::{CHEST, SEGMENTS};
use radome_sim::people::motion::Motion;
use radome_sim::prepared_scene::PreparedScene;
use radome_sim::scenario::Scenario;

use crate::common;

const FRAME_S: f64 = 0.064;

/// Returns the pairs that a pair stands for: itself, and in the opposite direction.
fn directions(of: &AudiblePair) -> impl Iterator<Item = AudiblePair> {
    let (p, q) = of.pair;
    let exchanged = of.both_ways.then_some(AudiblePair { pair: (q, p), ..*of });
    [Some(*of), exchanged].into_iter().flatten()
}

/// Counts a person's specular points in a frame: all, those that are kept, and those that are audible.
fn count(prepared: &PreparedScene, motion: &Motion, start_s: f64) -> [usize; 3] {
    let instants_s = [0.0, 0.5, 1.0].map(|part| start_s + part * FRAME_S);
    let kept: Vec<_> = audible_paths(prepared, motion, &instants_s).iter().flat_map(directions).collect();
    assert_eq!(
        kept.first().map(|first| first.pair),
        prepared.body_pairs.first().copied(),
        "the direct pair is the first"
    );
    let all = Paths::new(prepared, motion, 0, &prepared.body_pairs);
    let mut received = 0;
    for (number, &pair) in prepared.body_pairs.iter().enumerate() {
        for segment in 0..SEGMENTS {
            let is_kept = kept.iter().any(|kept| kept.pair == pair && kept.has(segment));
            let strongest = instants_s.map(|time_s| {
                let (people, mut keys) = ([Snapshot::new(motion, time_s)], Vec::new());
                all.trace(number * SEGMENTS + segment, &people, None, &mut keys, &mut EchoReport::default());
                keys.first().map_or(0.0, |key| key.amplitude.norm())
            });
            let strongest = strongest.into_iter().fold(0.0, f64::max);
            let is_heard = strongest > AUDIBLE_FRACTION * prepared.threshold_lsb;
            let over = strongest / prepared.threshold_lsb;
            assert!(is_kept || !is_heard, "{pair:?} {segment} at {start_s} s: {over} of the threshold");
            received += usize::from(is_heard);
        }
    }
    let kept = kept.iter().map(|pair| pair.segments.count_ones() as usize).sum();
    [prepared.body_pairs.len() * SEGMENTS, kept, received]
}

/// Walkers, sitters and passers-by in rooms of several sizes and walls: every audible path is kept, and some paths are
/// left out.
#[test]
fn what_is_heard_is_kept() {
    for (name, seeds) in [("corridor", 1..3), ("room", 1..3), ("hall", 1..7)] {
        let mut sums = [0; 3];
        for seed in seeds {
            let scene = common::scene(name).drawn(seed).expect("a scene");
            let prepared = PreparedScene::new(&scene, seed, 10.0);
            let scenario = Scenario::new(&scene, seed, None);
            for i in 0..24 {
                let start_s = 2.0 + 1.37 * f64::from(i);
                for (_, motion) in scenario.between(start_s, start_s + FRAME_S) {
                    let counts = count(&prepared, &motion, start_s);
                    sums.iter_mut().zip(counts).for_each(|(sum, count)| *sum += count);
                }
            }
        }
        let [all, kept, received] = sums;
        assert!(received > 0, "{name}: somebody is there");
        assert!(kept < all, "{name}: {kept} of {all} kept");
    }
}

/// Power of a person at an instant in a room of plane faces, and the number of image pairs, possible and kept. The
/// three powers are: that of all specular points by geometrically possible image pairs, each with its own obstructions;
/// that of audible points that frames leave out; and that of the difference to the points in frames, which share the
/// obstructions of a segment.
fn compared(prepared: &PreparedScene, motion: &Motion, time_s: f64, only_direct: bool) -> ([f64; 3], [usize; 2]) {
    let people = [Snapshot::new(motion, time_s)];
    let middle = people[0].body[CHEST].centre;
    let reach = |e: &radome_sim::em::specular::Ellipsoid| e.semi_axes_m.max_element() + e.centre.distance(middle);
    let reach_m = people[0].body.iter().map(reach).fold(0.0, f64::max);
    let mut pairs = prepared.pairs_near(middle, reach_m).into_owned();
    let kept = audible_paths(prepared, motion, &[time_s; 3]);
    let counts = [pairs.len(), kept.iter().flat_map(directions).count()];
    pairs.retain(|(p, q)| !only_direct || *p == [0; 3] || *q == [0; 3]);

    let of_frame = Paths::new(prepared, motion, 0, &kept);
    let specular_points =
        kept.iter().flat_map(|kept| (0..SEGMENTS).filter(move |&s| kept.has(s)).map(move |s| (kept.pair, s)));
    let specular_points: Vec<_> = specular_points.collect();
    assert_eq!(of_frame.count(), specular_points.len(), "nobody of these sits at a desk");
    let asked: Vec<_> = (0..specular_points.len()).map(|path| (path, None)).collect();
    let met = of_frame.trace_all(&asked, &people, &mut EchoReport::default());
    let amplitudes = met.iter().map(|met| met.samples().first().map_or(Complex64::ZERO, |key| key.amplitude));
    let mut shared: HashMap<_, Complex64> = HashMap::new();
    for (((p, q), segment), amplitude) in specular_points.into_iter().zip(amplitudes) {
        // By reciprocity, the opposite direction has the same amplitude.
        shared.insert(((p, q), segment), amplitude);
        shared.insert(((q, p), segment), amplitude);
    }

    let each = Paths::new(prepared, motion, 0, &pairs);
    let mut powers = [0.0; 3];
    for (number, &pair) in pairs.iter().enumerate() {
        for segment in 0..SEGMENTS {
            let mut keys = Vec::new();
            each.trace(number * SEGMENTS + segment, &people, None, &mut keys, &mut EchoReport::default());
            let own = keys.first().map_or(Complex64::ZERO, |key| key.amplitude);
            powers[0] += own.norm_sqr();
            match shared.get(&(pair, segment)) {
                Some(shared) => powers[2] += (own - shared).norm_sqr(),
                None if own.norm() > AUDIBLE_FRACTION * prepared.threshold_lsb => powers[1] += own.norm_sqr(),
                None => {}
            }
        }
    }
    (powers, counts)
}

/// Level relative to the power of all paths, dB.
fn db(part: f64, all: f64) -> f64 {
    10.0 * (part / all).max(1e-30).log10()
}

/// Half a decibel is 6 percent of an amplitude, -24.6 dB: the neglected paths and the shared obstructions change less.
#[test]
fn faces_in_the_way_leave_out_what_is_not_heard() {
    for name in ["cupboard", "half-open-door", "glass-wall", "l-corridor"] {
        let scene = common::scene(name).drawn(1).expect("a scene");
        let prepared = PreparedScene::new(&scene, 1, 10.0);
        let scenario = Scenario::new(&scene, 1, None);
        let mut sums = [0.0; 3];
        for i in 0..8 {
            let time_s = 0.3 + 0.7 * f64::from(i);
            for (_, motion) in scenario.between(time_s, time_s) {
                let (powers, _) = compared(&prepared, &motion, time_s, false);
                sums.iter_mut().zip(powers).for_each(|(sum, power)| *sum += power);
            }
        }
        let [all, left_out, apart] = sums;
        assert!(all > 0.0, "{name}: somebody is there");
        assert!(db(left_out, all) < -24.6, "{name}: {:.1} dB left out", db(left_out, all));
        assert!(db(apart, all) < -24.6, "{name}: {:.1} dB apart", db(apart, all));
    }
}

/// Of an office's thousands of image pairs only a few are visible.
#[test]
fn in_an_office_few_images_are_seen() {
    let scene = common::scene("open-plan").drawn(1).expect("a scene");
    let prepared = PreparedScene::new(&scene, 1, 10.0);
    let scenario = Scenario::new(&scene, 1, None);
    for time_s in [1.0, 4.0] {
        for (_, motion) in scenario.between(time_s, time_s) {
            let ([all, left_out, apart], [pairs, kept]) = compared(&prepared, &motion, time_s, true);
            assert!(kept < pairs / 4, "at {time_s} s {kept} of {pairs} kept");
            assert!(db(left_out, all) < -24.6, "at {time_s} s {:.1} dB left out", db(left_out, all));
            assert!(db(apart, all) < -24.6, "at {time_s} s {:.1} dB apart", db(apart, all));
        }
    }
}

/// Image pairs without segments represent all segments.
#[test]
fn plain_pairs_leave_nothing_out() {
    let scene = common::scene("corridor");
    let prepared = PreparedScene::new(&scene, 1, 10.0);
    let scenario = Scenario::new(&scene, 1, None);
    let mut seconds = (0..100).map(f64::from);
    let motion = seconds.find_map(|time_s| scenario.between(time_s, time_s).pop()).map(|(_, motion)| motion);
    let motion = motion.expect("somebody comes");
    assert_eq!(Paths::new(&prepared, &motion, 0, &prepared.body_pairs).count(), prepared.body_pairs.len() * SEGMENTS);
}
