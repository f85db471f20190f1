//! Change from frame to frame, in the cells of zero velocity.

use super::physical::{AXES, on_axes, realised};
use super::*;
use crate::SPEED_OF_LIGHT_M_PER_S;

const TIME_S: f64 = 1.0;

fn spec() -> RdmSpec {
    RdmSpec { static_removal: StaticRemoval::SlowTimeMean, change_over_s: Some(TIME_S), ..on_axes(AXES) }
}

/// Samples of a frame: echoes of reflectors `(range_m, amplitude)` that do not move within the frame, and noise.
fn samples(w: &Waveform, reflectors: &[(f64, f64)], noise: f64, random: &mut Random) -> Vec<f32> {
    let shape = w.shape();
    let mut samples = Vec::with_capacity(shape.codes());
    for _ in 0..shape.rx * shape.chirps {
        for n in 0..shape.samples {
            let t = n as f64 / w.sample_rate_hz;
            let echo = |(range_m, amplitude): &(f64, f64)| {
                let tau = 2.0 * range_m / SPEED_OF_LIGHT_M_PER_S;
                amplitude * (TAU * (w.sampled_start_frequency_hz * tau + w.slope_hz_per_s * tau * t)).cos()
            };
            samples.push((reflectors.iter().map(echo).sum::<f64>() + noise * random.normal()) as f32);
        }
    }
    samples
}

/// Cells of zero velocity after each of `frames`.
fn zero_velocity(spec: &RdmSpec, w: &Waveform, frames: &[Vec<f32>]) -> Vec<Vec<f32>> {
    let mut processor = RdmProcessor::new(spec, w).expect("spec fits");
    let mut map = processor.empty_map();
    let row = AXES.velocity_bins / 2 * AXES.range_bins;
    frames
        .iter()
        .enumerate()
        .map(|(sequence, frame)| {
            processor.process_samples(sequence as u64, frame, &mut map).expect("length fits");
            map.db[row..row + AXES.range_bins].to_vec()
        })
        .collect()
}

fn strongest(cells: &[f32]) -> (usize, f32) {
    cells.iter().copied().enumerate().skip(3).fold((0, f32::MIN), |best, x| if x.1 > best.1 { x } else { best })
}

#[test]
fn change_agrees_with_the_reference() {
    for w in [realised(|_| ()), realised(|w| (w.rx_antennas, w.frame_interval_s) = (RxMask::ALL, 0.05))] {
        let mut random = Random(7);
        let shape = w.shape();
        let frames: Vec<Frame> = (0..14)
            .map(|k| {
                let reflectors = [(1.5, 0.2), (3.0 + 0.0003 * f64::from(k), 0.05)];
                let samples = samples(&w, &reflectors, 0.01, &mut random);
                let codes = samples.iter().map(|x| (f64::from(*x) * 2048.0 + 2048.0).round() as u16).collect();
                Frame { codes, sequence: k as u64, ..Frame::zeroed(shape) }
            })
            .collect();
        for channels in [Channels::One(0), Channels::IncoherentSum] {
            let spec = RdmSpec { channels, ..spec() };
            let mut processor = RdmProcessor::new(&spec, &w).expect("spec fits");
            let mut map = processor.empty_map();
            for count in 1..=frames.len() {
                processor.process(&frames[count - 1], &mut map).expect("shape fits");
                if ![1, 2, 5, 14].contains(&count) {
                    continue;
                }
                let expected = reference::map(&spec, &w, &frames[..count]).expect("spec fits");
                let row = AXES.velocity_bins / 2 * AXES.range_bins;
                let coverage = AXES.coverage(&w);
                for bin in 0..coverage.range_bins {
                    let (got, expected) = (f64::from(map.db[row + bin]), expected[row + bin]);
                    // Below -110 dBFS, f32 sums hold rounding errors.
                    assert!(
                        (got - expected).abs() < 0.05 || got.max(expected) < -110.0,
                        "frame {count}, bin {bin}: {got}, {expected}"
                    );
                }
            }
        }
    }
}

/// A chest that moves by millimetres in seconds shows. A wall of a hundred times its power that drifts by a hundredth does not.
#[test]
fn breathing_shows_and_drifting_clutter_does_not() {
    let w = realised(|_| ());
    let mut random = Random(11);
    let mut frames = |breath_m: f64| -> Vec<Vec<f32>> {
        (0..40)
            .map(|k| {
                let t = k as f64 * w.frame_interval_s();
                let person = (1.5 + breath_m * (TAU * 0.25 * t).sin(), 0.002);
                let wall = (4.5, 0.02 * (1.0 + 0.01 * (TAU * 0.1 * t).sin()));
                samples(&w, &[person, wall], 0.001, &mut random)
            })
            .collect()
    };
    let (breathing, at_rest) = (frames(0.004), frames(0.0));
    let noise_db = -86.0;
    let (person, wall) = (10, 30);
    let changes = zero_velocity(&spec(), &w, &breathing);
    for cells in &changes[10..] {
        assert_eq!(strongest(cells).0, person);
        assert!(cells[person] > noise_db + 20.0, "{} dB", cells[person]);
        assert!(cells[wall] < cells[person] - 15.0, "{} and {} dB", cells[wall], cells[person]);
    }
    for cells in &zero_velocity(&spec(), &w, &at_rest)[10..] {
        assert!(cells[person] < noise_db, "{} dB", cells[person]);
    }
    // One frame alone shows no change, nor does the first one after a gap.
    assert!(changes[0].iter().all(|cell| f64::from(*cell) == spec().floor_db));
    let mut processor = RdmProcessor::new(&spec(), &w).expect("spec fits");
    let mut map = processor.empty_map();
    let row = AXES.velocity_bins / 2 * AXES.range_bins;
    for sequence in [0, 1, 2, 5] {
        processor.process_samples(sequence, &breathing[sequence as usize], &mut map).expect("length fits");
    }
    assert!(map.db[row..row + AXES.range_bins].iter().all(|cell| f64::from(*cell) == spec().floor_db));
}

/// If only noise changes and nothing is static, the change has the level of noise.
#[test]
fn change_of_noise_has_the_level_of_noise() {
    let w = realised(|_| ());
    let mut random = Random(13);
    let frames: Vec<Vec<f32>> = (0..200).map(|_| samples(&w, &[], 0.01, &mut random)).collect();
    let cells = zero_velocity(&spec(), &w, &frames);
    let mean_db = |cells: &[Vec<f32>]| {
        let powers = cells.iter().flatten().map(|db| 10f64.powf(0.1 * f64::from(*db)));
        10.0 * (powers.sum::<f64>() / (cells.len() * AXES.range_bins) as f64).log10()
    };
    // Mean power of a cell: 4 sigma^2 1.5^2 / (N M); a tenth of the variance goes into the running mean.
    let expected = 10.0 * (4.0 * 1e-4 * 2.25 / (128.0 * 64.0_f64)).log10();
    let found = mean_db(&cells[50..]);
    assert!((found - expected).abs() < 1.0, "{found} dB, expected {expected}");
}

#[test]
fn a_nan_sample_is_counted_and_does_not_affect_later_frames() {
    let w = realised(|_| ());
    let mut random = Random(17);
    let mut frames: Vec<Vec<f32>> = (0..12).map(|_| samples(&w, &[(2.0, 0.1)], 0.001, &mut random)).collect();
    frames[5][100] = f32::NAN;
    let cells = zero_velocity(&spec(), &w, &frames);
    assert!(cells[5].iter().any(|cell| !cell.is_finite()));
    assert!(cells[6..].iter().flatten().all(|cell| cell.is_finite()));
}

#[test]
fn change_without_axes_or_with_an_invalid_time_is_refused() {
    let w = realised(|_| ());
    let refused = |spec: RdmSpec| spec.shape(&w).expect_err("refused").to_string();
    assert!(refused(RdmSpec { physical_axes: None, ..spec() }).contains("physical_axes"));
    for time_s in [0.0, -1.0, f64::NAN, 1e9] {
        assert!(refused(RdmSpec { change_over_s: Some(time_s), ..spec() }).contains("change_over_s"));
    }
}
