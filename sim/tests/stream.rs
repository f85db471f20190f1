//! Streams of frames: determinism, threads, fixture scenes.

use num_complex::Complex64;
use radome_dsp::{Frame, FrameSource, Occupancy, SourceEvent};
use radome_sim::{SimulateOptions, Simulator};

use crate::common::{map_db, on_threads, range_bin, scene, simulator, statistics};

fn stream(simulator: &Simulator, from: u64, frames: usize, threads: usize) -> Vec<Frame> {
    let mut simulator = simulator.clone();
    simulator.seek(from);
    on_threads(threads, || {
        (0..frames)
            .map(|_| {
                let mut frame = Frame::zeroed(simulator.waveform().shape());
                assert_eq!(simulator.next_frame(&mut frame).expect("simulated"), SourceEvent::Frame);
                frame
            })
            .collect()
    })
}

#[test]
fn a_stream_continues_from_its_position_after_seek_and_clone() {
    let mut simulator = simulator(&scene("desk"), 4, Some(1));
    let mut frame = Frame::zeroed(simulator.waveform().shape());
    let mut next = |simulator: &mut Simulator| {
        assert_eq!(simulator.next_frame(&mut frame).expect("simulated"), SourceEvent::Frame);
        frame.clone()
    };
    let first: Vec<Frame> = (0..3).map(|_| next(&mut simulator)).collect();
    let mut other = simulator.clone();
    assert_eq!(next(&mut simulator), next(&mut other));
    simulator.seek(1);
    assert_eq!(next(&mut simulator), first[1]);
    assert_eq!(next(&mut simulator), first[2]);
    assert_eq!(next(&mut other).sequence, 4);
}

#[test]
fn a_stream_ends_after_the_requested_frames() {
    let options = SimulateOptions { frames: Some(5), ..SimulateOptions::default() };
    let mut simulator = Simulator::new(&scene("desk"), options).expect("valid");
    assert_eq!(simulator.frame_count(), Some(5));
    let mut frame = Frame::zeroed(simulator.waveform().shape());
    for expected in 0..5 {
        assert_eq!(simulator.next_frame(&mut frame).expect("simulated"), SourceEvent::Frame);
        assert_eq!(frame.sequence, expected);
        assert!(frame.truth.is_some());
    }
    assert_eq!(simulator.next_frame(&mut frame).expect("simulated"), SourceEvent::End);
}

#[test]
fn twenty_seconds_of_the_corridor_contain_all_three_classes() {
    let scene = scene("corridor");
    let mut complete = 0;
    for seed in 0..20 {
        let simulator = simulator(&scene, seed, None);
        let labels: Vec<Occupancy> = (0..200).map(|i| simulator.truth(i).occupancy).collect();
        assert!(labels[..15].iter().all(|&l| l == Occupancy::Empty), "begins empty (seed {seed})");
        complete += usize::from(Occupancy::ALL.iter().all(|class| labels.contains(class)));
        let empty = self::simulator(&scene, seed, Some(0));
        assert!((0..200).all(|i| empty.truth(i).occupancy == Occupancy::Empty));
    }
    assert!(complete >= 18, "{complete} of 20");
}

/// The frames are those in which people enter and leave.
#[test]
fn the_truth_of_any_time_is_that_of_its_frame() {
    let simulator = simulator(&scene("corridor"), 3, None);
    let ends = (1..300).filter(|i| simulator.truth(*i) != simulator.truth(i - 1));
    let mut compared = 0;
    for index in ends.take(8) {
        let start_s = 0.1 * index as f64 - 0.037;
        assert_eq!(Some(simulator.truth_at(start_s)), simulator.frame_at(index, start_s).truth, "{start_s} s");
        compared += 1;
    }
    assert_eq!(compared, 8);
}

#[test]
fn people_walk_at_human_speed_and_hip_height() {
    for name in ["corridor", "room"] {
        let simulator = simulator(&scene(name), 3, None);
        for index in 0..400 {
            for person in simulator.people(index) {
                assert!(person.velocity.length() < 2.5, "{name} {index}: {person:?}");
                assert!(person.position.z > 0.6 && person.position.z < 1.6, "{name} {index}: {person:?}");
            }
        }
    }
}

/// Empty fixture maps are noise; people raise a few per cent of the cells by many decibels.
#[test]
fn corridor_maps_are_noise_without_people_and_raised_with_them() {
    let scene = scene("corridor");
    let empty = simulator(&scene, 1, Some(0));
    let noise = map_db(&empty.frame(9), 0);
    let (_, sigma) = statistics(&noise);
    assert!((5.4..5.9).contains(&sigma), "{sigma}");
    let mean =
        |range: usize| 10.0 * ((0..128).map(|d| 10f64.powf(0.1 * noise[d * 128 + range])).sum::<f64>() / 128.0).log10();
    let noise_db: Vec<f64> = (0..128).map(mean).collect();
    let with_people = simulator(&scene, 1, None);
    let index = (0..300)
        .find(|&i| with_people.truth(i).occupancy == Occupancy::Two && with_people.people(i).len() == 2)
        .expect("two");
    let map = map_db(&with_people.frame(index + 10), 0);
    let raised = map.iter().enumerate().filter(|(i, v)| **v - noise_db[i % 128] > 9.0).count();
    let strongest =
        map.iter().enumerate().filter(|(i, _)| i % 128 > 2).map(|(i, v)| v - noise_db[i % 128]).fold(0.0, f64::max);
    assert!(raised > 60, "{raised} cells");
    assert!(strongest > 20.0, "{strongest} dB");
}

#[test]
fn the_number_of_people_at_a_desk_is_drawn_or_given() {
    let scene = scene("desk");
    let mut counts = [0; 3];
    for seed in 0..30 {
        let simulator = simulator(&scene, seed, None);
        counts[simulator.truth(0).occupancy.index()] += 1;
        for person in simulator.people(0) {
            assert!((0.2..1.5).contains(&person.range_m), "seed {seed}: {person:?}");
        }
    }
    assert!(counts.iter().all(|&n| n >= 4), "{counts:?}");
    for people in 0..3 {
        assert_eq!(simulator(&scene, 7, Some(people)).truth(3).occupancy.index(), people);
    }
}

/// A breathing chest shows its rate in slow time over frames.
#[test]
fn breathing_is_the_strongest_frequency_over_forty_seconds() {
    let scene = scene("desk");
    let quiet = (0..50).find(|&seed| {
        let s = simulator(&scene, seed, Some(1));
        let fastest = (0..400).step_by(5).map(|i| s.people(i)[0].velocity.length()).fold(0.0, f64::max);
        fastest < 0.02
    });
    let simulator = simulator(&scene, quiet.expect("somebody sits still"), Some(1));
    let w = scene.waveform();
    let bin =
        (2.0 * simulator.people(0)[0].range_m * w.slope_hz_per_s / 299_792_458.0 / w.sample_rate_hz * 64.0).round();
    let phases: Vec<Complex64> =
        (0..400).map(|i| range_bin(&simulator.frame(i), bin - 3.0).iter().take(8).sum()).collect();
    // Centimetres are several turns at 60 GHz, so the phase is unwrapped before the rate is estimated.
    let mut unwrapped = vec![0.0];
    for pair in phases.windows(2) {
        let last = unwrapped[unwrapped.len() - 1];
        unwrapped.push(last + (pair[1] * pair[0].conj()).arg());
    }
    let (mean, sigma) = statistics(&unwrapped);
    let spectrum = |hz: f64| -> f64 {
        let step = std::f64::consts::TAU * hz * w.frame_interval_s();
        let rotated = |i: usize| Complex64::from_polar(unwrapped[i] - mean, -step * i as f64);
        (0..unwrapped.len()).map(rotated).sum::<Complex64>().norm()
    };
    let strongest =
        |low: f64, high: f64| (0..60).map(|i| spectrum(low + (high - low) * f64::from(i) / 59.0)).fold(0.0, f64::max);
    assert!(strongest(0.18, 0.37) > 2.0 * strongest(0.7, 4.0), "{} {}", strongest(0.18, 0.37), strongest(0.7, 4.0));
    // 4 to 12 mm peak to peak, with sway on top: a few radians.
    assert!((1.0..30.0).contains(&sigma), "{sigma} rad");
}

mod hard_cases {
    use super::*;

    #[test]
    fn frames_do_not_depend_on_threads_and_order() {
        let scene = scene("corridor");
        let one = stream(&simulator(&scene, 11, None), 55, 9, 1);
        let two = stream(&simulator(&scene, 11, None), 55, 9, 2);
        assert_eq!(one, two);
        let alone = simulator(&scene, 11, None);
        assert_eq!(alone.frame(60), one[5]);
        assert_eq!(alone.frame(57), one[2]);
        let other = simulator(&scene, 12, None).frame(60);
        assert_ne!(other.codes, one[5].codes);
        assert_eq!(one[5].sequence, 60);
        assert_eq!(one[5].time_ns, 6_000_000_000);
    }
}
