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

/// Returns the pairs that a pair stands for: itself, and the reverse pair if it counts both ways.
fn directions(audible_pair: &AudiblePair) -> impl Iterator<Item = AudiblePair> {
    let (p, q) = audible_pair.pair;
    let reverse = audible_pair.both_ways.then_some(AudiblePair { pair: (q, p), ..*audible_pair });
    [Some(*audible_pair), reverse].into_iter().flatten()
}

/// Counts a person's specular points in a frame: all, those that are kept, and those that are audible.
fn count_specular_points(prepared: &PreparedScene, motion: &Motion, start_s: f64) -> [usize; 3] {
    let instants_s = [0.0, 0.5, 1.0].map(|fraction| start_s + fraction * FRAME_S);
    let kept_pairs: Vec<_> = audible_paths(prepared, motion, &instants_s).iter().flat_map(directions).collect();
    assert_eq!(
        kept_pairs.first().map(|first| first.pair),
        prepared.body_pairs.first().copied(),
        "the direct pair is the first"
    );
    let all = Paths::new(prepared, motion, 0, &prepared.body_pairs);
    let mut audible = 0;
    for (pair_index, &pair) in prepared.body_pairs.iter().enumerate() {
        for segment in 0..SEGMENTS {
            let is_kept = kept_pairs.iter().any(|kept| kept.pair == pair && kept.has(segment));
            let strongest = instants_s.map(|time_s| {
                let (people, mut samples) = ([Snapshot::new(motion, time_s)], Vec::new());
                all.trace(pair_index * SEGMENTS + segment, &people, None, &mut samples, &mut EchoReport::default());
                samples.first().map_or(0.0, |sample| sample.amplitude.norm())
            });
            let strongest = strongest.into_iter().fold(0.0, f64::max);
            let is_audible = strongest > AUDIBLE_FRACTION * prepared.threshold_lsb;
            let ratio = strongest / prepared.threshold_lsb;
            assert!(is_kept || !is_audible, "{pair:?} {segment} at {start_s} s: {ratio} of the threshold");
            audible += usize::from(is_audible);
        }
    }
    let kept = kept_pairs.iter().map(|pair| pair.segments.count_ones() as usize).sum();
    [prepared.body_pairs.len() * SEGMENTS, kept, audible]
}

/// Walkers, sitters and passers-by in rooms of several sizes and walls: every audible path is kept, and some paths are
/// left out.
#[test]
fn every_audible_path_is_kept() {
    for (name, seeds) in [("corridor", 1..3), ("room", 1..3), ("hall", 1..7)] {
        let mut sums = [0; 3];
        for seed in seeds {
            let scene = common::scene(name).drawn(seed).expect("a scene");
            let prepared = PreparedScene::new(&scene, seed, 10.0);
            let scenario = Scenario::new(&scene, seed, None);
            for i in 0..24 {
                let start_s = 2.0 + 1.37 * f64::from(i);
                for (_, motion) in scenario.between(start_s, start_s + FRAME_S) {
                    let counts = count_specular_points(&prepared, &motion, start_s);
                    sums.iter_mut().zip(counts).for_each(|(sum, count)| *sum += count);
                }
            }
        }
        let [all, kept, audible] = sums;
        assert!(audible > 0, "{name}: somebody is there");
        assert!(kept < all, "{name}: {kept} of {all} kept");
    }
}

/// Returns powers of a person at an instant in a room of plane faces, and the numbers of possible and kept image pairs.
/// The first power is that of all specular points by possible image pairs, each with its own obstructions. The second
/// is that of audible points that frames leave out. The third is that of the difference to the points in frames, which
/// share the obstructions of a segment.
fn compare_powers(prepared: &PreparedScene, motion: &Motion, time_s: f64, only_direct: bool) -> ([f64; 3], [usize; 2]) {
    let people = [Snapshot::new(motion, time_s)];
    let middle = people[0].body[CHEST].centre;
    let reach = |e: &radome_sim::em::specular::Ellipsoid| e.semi_axes_m.max_element() + e.centre.distance(middle);
    let reach_m = people[0].body.iter().map(reach).fold(0.0, f64::max);
    let mut pairs = prepared.pairs_near(middle, reach_m).into_owned();
    let kept_pairs = audible_paths(prepared, motion, &[time_s; 3]);
    let counts = [pairs.len(), kept_pairs.iter().flat_map(directions).count()];
    pairs.retain(|(p, q)| !only_direct || *p == [0; 3] || *q == [0; 3]);

    let paths_of_frame = Paths::new(prepared, motion, 0, &kept_pairs);
    let specular_points =
        kept_pairs.iter().flat_map(|kept| (0..SEGMENTS).filter(move |&s| kept.has(s)).map(move |s| (kept.pair, s)));
    let specular_points: Vec<_> = specular_points.collect();
    assert_eq!(paths_of_frame.count(), specular_points.len(), "nobody of these sits at a desk");
    let requests: Vec<_> = (0..specular_points.len()).map(|path| (path, None)).collect();
    let traced = paths_of_frame.trace_all(&requests, &people, &mut EchoReport::default());
    let amplitudes =
        traced.iter().map(|traced| traced.samples().first().map_or(Complex64::ZERO, |sample| sample.amplitude));
    let mut frame_amplitudes: HashMap<_, Complex64> = HashMap::new();
    for (((p, q), segment), amplitude) in specular_points.into_iter().zip(amplitudes) {
        // By reciprocity, the opposite direction has the same amplitude.
        frame_amplitudes.insert(((p, q), segment), amplitude);
        frame_amplitudes.insert(((q, p), segment), amplitude);
    }

    let all_paths = Paths::new(prepared, motion, 0, &pairs);
    let mut powers = [0.0; 3];
    for (pair_index, &pair) in pairs.iter().enumerate() {
        for segment in 0..SEGMENTS {
            let mut samples = Vec::new();
            all_paths.trace(pair_index * SEGMENTS + segment, &people, None, &mut samples, &mut EchoReport::default());
            let amplitude = samples.first().map_or(Complex64::ZERO, |sample| sample.amplitude);
            powers[0] += amplitude.norm_sqr();
            match frame_amplitudes.get(&(pair, segment)) {
                Some(of_frame) => powers[2] += (amplitude - of_frame).norm_sqr(),
                None if amplitude.norm() > AUDIBLE_FRACTION * prepared.threshold_lsb => {
                    powers[1] += amplitude.norm_sqr()
                }
                None => {}
            }
        }
    }
    (powers, counts)
}

/// Level relative to the power of all paths, dB.
fn db(fraction: f64, all: f64) -> f64 {
    10.0 * (fraction / all).max(1e-30).log10()
}

/// Half a decibel is 6 percent of an amplitude, -24.6 dB: the neglected paths and the shared obstructions change less.
#[test]
fn paths_left_out_behind_faces_are_inaudible() {
    for name in ["cupboard", "half-open-door", "glass-wall", "l-corridor"] {
        let scene = common::scene(name).drawn(1).expect("a scene");
        let prepared = PreparedScene::new(&scene, 1, 10.0);
        let scenario = Scenario::new(&scene, 1, None);
        let mut sums = [0.0; 3];
        for i in 0..8 {
            let time_s = 0.3 + 0.7 * f64::from(i);
            for (_, motion) in scenario.between(time_s, time_s) {
                let (powers, _) = compare_powers(&prepared, &motion, time_s, false);
                sums.iter_mut().zip(powers).for_each(|(sum, power)| *sum += power);
            }
        }
        let [all, left_out, difference] = sums;
        assert!(all > 0.0, "{name}: somebody is there");
        assert!(db(left_out, all) < -24.6, "{name}: {:.1} dB left out", db(left_out, all));
        assert!(db(difference, all) < -24.6, "{name}: {:.1} dB of difference", db(difference, all));
    }
}

/// Of an office's thousands of image pairs only a few are visible.
#[test]
fn few_image_pairs_of_an_office_are_kept() {
    let scene = common::scene("open-plan").drawn(1).expect("a scene");
    let prepared = PreparedScene::new(&scene, 1, 10.0);
    let scenario = Scenario::new(&scene, 1, None);
    for time_s in [1.0, 4.0] {
        for (_, motion) in scenario.between(time_s, time_s) {
            let ([all, left_out, difference], [pairs, kept]) = compare_powers(&prepared, &motion, time_s, true);
            assert!(kept < pairs / 4, "at {time_s} s {kept} of {pairs} kept");
            assert!(db(left_out, all) < -24.6, "at {time_s} s {:.1} dB left out", db(left_out, all));
            assert!(db(difference, all) < -24.6, "at {time_s} s {:.1} dB of difference", db(difference, all));
        }
    }
}

/// Image pairs without segments represent all segments.
#[test]
fn image_pairs_without_segments_stand_for_all_segments() {
    let scene = common::scene("corridor");
    let prepared = PreparedScene::new(&scene, 1, 10.0);
    let scenario = Scenario::new(&scene, 1, None);
    let mut seconds = (0..100).map(f64::from);
    let motion = seconds.find_map(|time_s| scenario.between(time_s, time_s).pop()).map(|(_, motion)| motion);
    let motion = motion.expect("somebody comes");
    assert_eq!(Paths::new(&prepared, &motion, 0, &prepared.body_pairs).count(), prepared.body_pairs.len() * SEGMENTS);
}
