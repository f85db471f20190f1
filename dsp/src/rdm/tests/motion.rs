//! Motion of echoes over frames.

use super::physical::{AXES, on_axes, realised};
use super::*;
use crate::SPEED_OF_LIGHT_M_PER_S;
use crate::rdm::Motion;

const OVER_S: f64 = 1.0;
const NOISE: f64 = 0.002;

fn spec() -> RdmSpec {
    RdmSpec { static_removal: StaticRemoval::SlowTimeMean, motion_over_s: Some(OVER_S), ..on_axes(AXES) }
}

/// A reflector: range at the start of the recording, m, velocity, m/s, and amplitude.
type Reflector = (f64, f64, f64);

/// Samples of the frame that begins at `start_s`, with reflectors that move at constant velocity, and noise.
fn samples(w: &Waveform, start_s: f64, reflectors: &[Reflector], random: &mut Random) -> Vec<f32> {
    let shape = w.shape();
    let mut samples = Vec::with_capacity(shape.codes());
    for _ in 0..shape.rx {
        for chirp in 0..shape.chirps {
            let time_s = start_s + chirp as f64 * w.chirp_interval_s;
            for n in 0..shape.samples {
                let t = n as f64 / w.sample_rate_hz;
                let echo = |(range_m, velocity, amplitude): &Reflector| {
                    let tau = 2.0 * (range_m + velocity * time_s) / SPEED_OF_LIGHT_M_PER_S;
                    amplitude * (TAU * (w.sampled_start_frequency_hz * tau + w.slope_hz_per_s * tau * t)).cos()
                };
                samples.push((reflectors.iter().map(echo).sum::<f64>() + NOISE * random.normal()) as f32);
            }
        }
    }
    samples
}

/// Specification of maps whose cells of zero velocity hold change.
fn spec_with_change() -> RdmSpec {
    RdmSpec { change_over_s: Some(OVER_S), ..spec() }
}

/// Maps of the frames with these sequence numbers.
fn maps(w: &Waveform, sequences: impl IntoIterator<Item = u64>, reflectors: &[Reflector]) -> Vec<Rdm> {
    maps_by(&spec(), w, sequences, reflectors)
}

fn maps_by(
    spec: &RdmSpec,
    w: &Waveform,
    sequences: impl IntoIterator<Item = u64>,
    reflectors: &[Reflector],
) -> Vec<Rdm> {
    let mut random = Random(3);
    let mut processor = RdmProcessor::new(spec, w).expect("spec fits");
    let map = |sequence: u64| {
        let samples = samples(w, sequence as f64 * w.frame_interval_s(), reflectors, &mut random);
        let mut map = processor.empty_map();
        processor.process_samples(sequence, &samples, &mut map).expect("length fits");
        map
    };
    sequences.into_iter().map(map).collect()
}

fn last_motion(maps: &[Rdm]) -> Motion {
    maps.last().and_then(|map| map.motion).expect("motion")
}

fn ten_frames_a_second() -> Waveform {
    realised(|w| w.frame_interval_s = 0.1)
}

/// A walker and two multipath echoes of this walker: they keep their distances.
const GHOSTS: [Reflector; 3] = [(2.0, 0.6, 0.1), (3.2, 0.6, 0.05), (4.7, 0.6, 0.03)];
/// Two walkers, who meet.
const WALKERS: [Reflector; 2] = [(2.0, 0.6, 0.1), (4.5, -0.7, 0.06)];

/// Somebody who sits: strong, and 1.5 mm farther away in each frame of ten a second.
const SITS: Reflector = (1.0, 0.015, 0.1);
/// Somebody who walks behind.
const WALKS: Reflector = (3.0, 0.6, 0.03);

#[test]
fn motion_agrees_with_the_reference() {
    for interval_s in [0.03, 0.1, 0.25, 0.7] {
        let w = realised(|w| w.frame_interval_s = interval_s);
        // Three frames are missing, and later more than a second.
        let sequences = (0..12).chain(15..22).chain(70..76);
        let mut random = Random(9);
        let mut reflectors: Vec<Reflector> = (0..5)
            .map(|_| (1.5 + 4.0 * random.uniform(), 3.0 * random.uniform() - 1.5, 0.1 * random.uniform()))
            .collect();
        reflectors.push(SITS);
        for (spec, has_change) in [(spec(), false), (spec_with_change(), true)] {
            let maps = maps_by(&spec, &w, sequences.clone(), &reflectors);
            for count in 1..=maps.len() {
                let maps = &maps[..count];
                let expected = reference::motion(maps, w.frame_interval_s(), OVER_S, has_change).to_array();
                for (found, expected) in last_motion(maps).to_array().into_iter().zip(expected) {
                    assert!((found - expected).abs() < 1e-3, "{interval_s} {count}: {found} {expected}");
                }
            }
        }
    }
}

#[test]
fn who_sits_nearer_than_a_walker_is_seen_by_change() {
    let w = ten_frames_a_second();
    let nearer_change =
        |reflectors: &[Reflector]| last_motion(&maps_by(&spec_with_change(), &w, 0..12, reflectors)).nearer_change;
    assert!(nearer_change(&[SITS, WALKS]) > 0.9);
    assert_eq!(nearer_change(&[SITS]), 0.0, "nobody walks");
    assert_eq!(nearer_change(&[WALKS]), 0.0, "nobody sits");
    let behind = (WALKS.0 + 1.5, SITS.1, SITS.2);
    assert_eq!(nearer_change(&[behind, WALKS]), 0.0, "change behind a walker may be a shadow");
    assert_eq!(last_motion(&maps(&w, 0..12, &[SITS, WALKS])).nearer_change, 0.0, "a map without change");
}

#[test]
fn change_nearer_than_a_walker_is_held_for_a_while() {
    let w = ten_frames_a_second();
    let mut random = Random(3);
    let mut processor = RdmProcessor::new(&spec_with_change(), &w).expect("spec fits");
    let mut map = processor.empty_map();
    let mut held = Vec::new();
    for sequence in 0..20 {
        let reflectors = if sequence < 13 { &[SITS, WALKS][..] } else { &[SITS] };
        let samples = samples(&w, sequence as f64 * w.frame_interval_s(), reflectors, &mut random);
        processor.process_samples(sequence, &samples, &mut map).expect("length fits");
        held.push(map.motion.expect("motion").nearer_change);
    }
    // After 0.7 s it is 1/e.
    assert!((held[19] / held[12] - (-1.0f32).exp()).abs() < 0.01, "{held:?}");
}

#[test]
fn echoes_of_one_walker_keep_their_distances() {
    let motion = last_motion(&maps(&ten_frames_a_second(), 0..12, &GHOSTS));
    assert!(motion.spacing_change_rad < 0.25, "{motion:?}");
    // Bins are 0.15 m apart.
    assert!(motion.shift_error_m < 0.1 && motion.nearest_error_m < 0.1, "{motion:?}");
    assert!(motion.separation_change_m < 0.1 && motion.velocity_difference_m_per_s < 0.1, "{motion:?}");
    assert_eq!(motion.second_share, 1.0);
}

#[test]
fn two_walkers_move_independently() {
    let [one, two] =
        [&GHOSTS[..], &WALKERS].map(|reflectors| last_motion(&maps(&ten_frames_a_second(), 0..12, reflectors)));
    assert!(two.spacing_change_rad > one.spacing_change_rad + 0.3, "{one:?} {two:?}");
    // In 0.3 s they approach each other by 0.39 m.
    assert!((two.separation_change_m - 0.39).abs() < 0.15, "{two:?}");
    assert!((two.velocity_difference_m_per_s - 1.3).abs() < 0.15, "{two:?}");
}

#[test]
fn a_room_without_motion_has_none() {
    let w = ten_frames_a_second();
    let expected = Motion::default();
    assert_eq!(last_motion(&maps(&w, 0..9, &[])), expected);
    assert_eq!(last_motion(&maps(&w, 0..9, &[(2.0, 0.0, 0.2), (4.0, 0.0, 0.1)])), expected);
}

#[test]
fn the_frame_rate_hardly_matters() {
    let motions = |spec: &RdmSpec, reflectors: &[Reflector]| {
        [0.05, 0.1, 0.15].map(|interval_s| {
            let w = realised(|w| w.frame_interval_s = interval_s);
            last_motion(&maps_by(spec, &w, 0..(1.8 / interval_s) as u64, reflectors))
        })
    };
    for reflectors in [&GHOSTS[..], &WALKERS] {
        let motions = motions(&spec(), reflectors).map(Motion::to_array);
        for k in 0..Motion::QUANTITIES {
            let all = motions.map(|motion| motion[k]);
            let spread = all.iter().fold(f32::MIN, |a, b| a.max(*b)) - all.iter().fold(f32::MAX, |a, b| a.min(*b));
            assert!(spread < 0.15, "{k}: {all:?}");
        }
    }
    let motions = motions(&spec_with_change(), &[SITS, WALKS]);
    assert!(motions.iter().all(|motion| motion.nearer_change > 0.85), "{motions:?}");
}

mod hard_cases {
    use super::*;

    #[test]
    fn missing_frames_change_little() {
        let w = ten_frames_a_second();
        let all = last_motion(&maps(&w, 0..30, &WALKERS)).to_array();
        let some = last_motion(&maps(&w, (0..30).filter(|k| k % 4 != 1), &WALKERS)).to_array();
        assert!(all.iter().zip(some).all(|(a, b)| (a - b).abs() < 0.15), "{all:?} {some:?}");
    }

    /// Change needs consecutive frames, and is held over the missing ones.
    #[test]
    fn change_nearer_than_a_walker_outlasts_missing_frames() {
        let w = ten_frames_a_second();
        let sequences = (0..24).filter(|k| *k != 20 && *k != 21);
        let held = last_motion(&maps_by(&spec_with_change(), &w, sequences, &[SITS, WALKS])).nearer_change;
        assert!(held > 0.5, "{held}");
    }

    #[test]
    fn more_than_a_second_or_a_reset_forgets() {
        let w = ten_frames_a_second();
        let first = last_motion(&maps(&w, [40], &WALKERS));
        for before in [0..9, 20..29] {
            let after_gap = last_motion(&maps(&w, before.chain([40]), &WALKERS));
            assert_eq!((after_gap.spacing_change_rad, first.spacing_change_rad), (0.0, 0.0), "nothing to compare with");
        }
        let mut processor = RdmProcessor::new(&spec(), &w).expect("spec fits");
        let mut random = Random(3);
        let mut map = processor.empty_map();
        assert_eq!(map.motion, Some(Motion::default()));
        for (sequence, resets) in [(5, false), (6, true), (3, false)] {
            if resets {
                processor.reset();
            }
            let samples = samples(&w, sequence as f64 * 0.1, &WALKERS, &mut random);
            processor.process_samples(sequence, &samples, &mut map).expect("length fits");
            assert_eq!(map.motion.map(|motion| motion.spacing_change_rad), Some(0.0), "{sequence}");
        }
    }

    #[test]
    fn a_gap_keeps_motion_and_a_reset_does_not() {
        let w = ten_frames_a_second();
        for (forget, is_kept) in
            [(RdmProcessor::reset_at_gap as fn(&mut RdmProcessor), true), (RdmProcessor::reset, false)]
        {
            let mut processor = RdmProcessor::new(&spec(), &w).expect("spec fits");
            let (mut random, mut map) = (Random(3), processor.empty_map());
            for sequence in 0..9 {
                if sequence == 8 {
                    forget(&mut processor);
                }
                let samples = samples(&w, sequence as f64 * 0.1, &WALKERS, &mut random);
                processor.process_samples(sequence, &samples, &mut map).expect("length fits");
            }
            assert_eq!(map.motion.is_some_and(|motion| motion.separation_change_m > 0.1), is_kept);
        }
    }

    #[test]
    fn a_map_that_is_not_finite_is_left_out() {
        let w = ten_frames_a_second();
        let mut processor = RdmProcessor::new(&spec(), &w).expect("spec fits");
        let (mut random, mut map) = (Random(3), processor.empty_map());
        let mut before = None;
        for sequence in 0..8 {
            let mut samples = samples(&w, sequence as f64 * 0.1, &WALKERS, &mut random);
            if sequence == 5 {
                samples[7] = f32::NAN;
            }
            processor.process_samples(sequence, &samples, &mut map).expect("length fits");
            if sequence == 5 {
                assert_eq!(map.motion, before);
            }
            before = map.motion;
            assert!(before.is_some_and(|motion| motion.to_array().iter().all(|v| v.is_finite())));
        }
    }

    #[test]
    fn maps_of_several_channels_or_across_frames_and_odd_times_are_refused() {
        let w = realised(|w| w.rx_antennas = RxMask::ALL);
        let refused = |spec: RdmSpec| RdmProcessor::new(&spec, &w).err().expect("refused").to_string();
        assert!(refused(RdmSpec { channels: Channels::All, ..spec() }).contains("one channel"));
        let across_frames = RdmSpec { physical_axes: None, slow_time: SlowTime::Frames { frames: 32 }, ..spec() };
        assert!(refused(across_frames).contains("leave slow_time out"));
        for time_s in [0.0, -1.0, f64::NAN, 1e4] {
            assert!(refused(RdmSpec { motion_over_s: Some(time_s), ..spec() }).contains("motion_over_s"));
        }
    }

    #[test]
    fn maps_of_any_size_have_finite_motion() {
        for (range_bins, velocity_bins) in [(2, 2), (5, 64), (64, 4), (100, 90)] {
            let axes = PhysicalAxes { range_bins, velocity_bins, ..AXES };
            let w = ten_frames_a_second();
            let mut processor = RdmProcessor::new(&RdmSpec { physical_axes: Some(axes), ..spec() }, &w).expect("fits");
            let (mut random, mut map) = (Random(3), processor.empty_map());
            for sequence in 0..6 {
                let samples = samples(&w, sequence as f64 * 0.1, &WALKERS, &mut random);
                processor.process_samples(sequence, &samples, &mut map).expect("length fits");
                assert!(map.motion.expect("motion").to_array().iter().all(|v| v.is_finite()));
            }
        }
    }
}
