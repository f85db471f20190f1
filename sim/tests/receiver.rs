//! Effects of the receiver on echoes: phase noise, and clutter that fluctuates.

use num_complex::Complex64;
use radome_dsp::Frame;
use radome_dsp::statistics::SlowTimeStatistics;
use radome_sim::random::{Purpose, generator};
use radome_sim::receiver::phase_noise::PhaseRates;
use radome_sim::receiver::{ClutterDrift, PhaseNoise, Receiver};
use radome_sim::{Scene, SimulateOptions, Simulator};

use crate::common::{NOBODY, hall, parse, range_bin, rms, scene, simulator};

/// Board in front of a metal wall 2.4 m away, without other objects, with a quiet and stable receiver.
fn scene_with_wall(clutter: &str, receiver: &str) -> Scene {
    let text = hall(NOBODY)
        .replace("x_high = { material = \"open\" }", "x_high = { material = \"metal\" }")
        .replace("position_m = [1.0, 10.0, 1.2]", "position_m = [17.6, 10.0, 1.2]")
        .replace("adc_white_lsb = 2.0", "adc_white_lsb = 0.5")
        .replace("[receiver.clutter]", &format!("{receiver}\n[receiver.clutter]"));
    let text = clutter.lines().fold(text, |text, line| {
        let key = line.split(' ').next().unwrap_or_default();
        let known: Vec<&str> = text.lines().filter(|l| !l.starts_with(key)).collect();
        known.join("\n").replace("[receiver.clutter]", &format!("[receiver.clutter]\n{line}"))
    });
    parse(&text)
}

/// Echo of a frame's mean chirp in the range bin at a distance (Hann window): amplitude, and phase in rad.
fn echo_at(scene: &Scene, frame: &Frame, range_m: f64) -> (f64, f64) {
    let bin = (range_m / scene.waveform().range_step_m(frame.shape.samples)).round();
    let sum: Complex64 = range_bin(frame, bin).iter().sum();
    (sum.norm(), sum.arg())
}

fn wrapped_to_half_a_turn(angle_rad: f64) -> f64 {
    angle_rad - std::f64::consts::TAU * (angle_rad / std::f64::consts::TAU).round()
}

/// Unwrapped phase (rad) and amplitude of the wall's range bin in the mean chirp of successive frames.
fn phases_and_amplitudes(scene: &Scene, seed: u64, frames: u64) -> Vec<(f64, f64)> {
    let simulator = simulator(scene, seed, Some(0));
    let (mut last, mut unwrapped_rad, mut all) = (0.0, 0.0, Vec::new());
    for index in 0..frames {
        let (amplitude, angle) = echo_at(scene, &simulator.frame(index), 2.4);
        unwrapped_rad += wrapped_to_half_a_turn(angle - last);
        last = angle;
        all.push((unwrapped_rad, amplitude));
    }
    all
}

/// Rms of the changes over `frames` frames.
fn rms_change(values: &[f64], frames: usize) -> f64 {
    let square = |(a, b): (&f64, &f64)| (b - a).powi(2);
    let count = values.len() - frames;
    (values.iter().zip(&values[frames..]).map(square).sum::<f64>() / count as f64).sqrt()
}

/// Drift and jitter are as measured in real rooms: 20 to 60 mrad between frames, 0.1 to 0.6 rad in ten seconds, 0.6 to
/// 4 % of amplitude. In an empty room more than noise remains after static removal, though far less than a person.
#[test]
fn clutter_has_the_measured_jitter_and_drift() {
    let typical = "phase_jitter_rad = 0.03\nphase_drift_rad_per_10s = 0.3\namplitude_jitter = 0.01";
    let (mut jitters, mut drifts, mut amplitudes) = (Vec::new(), Vec::new(), Vec::new());
    for seed in 0..4 {
        let series = phases_and_amplitudes(&scene_with_wall(typical, ""), seed, 300);
        let phase: Vec<f64> = series.iter().map(|(phase, _)| *phase).collect();
        let mean = series.iter().map(|(_, level)| level).sum::<f64>() / series.len() as f64;
        let level: Vec<f64> = series.iter().map(|(_, level)| level / mean).collect();
        jitters.push(rms_change(&phase, 1) / 2f64.sqrt());
        // Values are averaged over seconds, so that jitter does not count as drift.
        let seconds: Vec<f64> = phase.chunks(10).map(|of| of.iter().sum::<f64>() / 10.0).collect();
        drifts.push(rms_change(&seconds, 10));
        amplitudes.push(rms_change(&level, 1) / 2f64.sqrt());
    }
    assert!(jitters.iter().all(|j| (0.02..0.06).contains(j)), "{jitters:?}");
    assert!(drifts.iter().all(|d| (0.1..0.6).contains(d)), "{drifts:?}");
    assert!(amplitudes.iter().all(|a| (0.006..0.04).contains(a)), "{amplitudes:?}");
    let still = phases_and_amplitudes(&scene_with_wall("", ""), 1, 40);
    let phase: Vec<f64> = still.iter().map(|(phase, _)| *phase).collect();
    assert!(rms_change(&phase, 1) < 1e-3 && rms_change(&phase, 20) < 1e-3);
    // Residual after static removal.
    let residual_db = |scene: &Scene| {
        let simulator = simulator(scene, 1, Some(0));
        let mut slow_time = SlowTimeStatistics::new(scene.waveform(), 10.0);
        (0..100).for_each(|index| slow_time.push(&simulator.frame(index)));
        let bin = (2.4 / scene.waveform().range_step_m(256)).round() as usize;
        let power = |of: Option<f64>| 10.0 * of.expect("a window").log10();
        power(slow_time.moving(0, bin)) - power(slow_time.still(0, bin))
    };
    let (jittering_residual_db, still_residual_db) =
        (residual_db(&scene_with_wall(typical, "")), residual_db(&scene_with_wall("", "")));
    assert!(
        (-30.0..-8.0).contains(&jittering_residual_db) && still_residual_db < -50.0,
        "{jittering_residual_db} dB, at rest {still_residual_db} dB"
    );
}

/// Half of the power of the echoes' drift comes from the chip and is common to all echoes: two posts, 400 boards, ten
/// seconds.
#[test]
fn half_of_the_drift_is_common_to_all_echoes() {
    let post = |x: f64| {
        format!(
            "[[furniture]]\nname = \"post\"\nposition_m = [{x}, 9.99, 1.19]\nsize_m = [0.02, 0.02, 0.02]\npoints = 1\n"
        ) + "cross_section_dbsm = 0.0\n"
    };
    let scene = parse(
        &hall(&(post(4.0) + &post(6.0) + NOBODY))
            .replace("phase_drift_rad_per_10s = 0.0", "phase_drift_rad_per_10s = 0.3"),
    );
    let (mut squares, mut product) = ([0.0; 2], 0.0);
    const BOARDS: u64 = 400;
    for seed in 0..BOARDS {
        let simulator = simulator(&scene, seed, Some(0));
        let [before, after] = [0, 100].map(|index| simulator.frame(index));
        let changes = [3.0, 5.0].map(|range_m| {
            let [before, after] = [&before, &after].map(|frame| echo_at(&scene, frame, range_m).1);
            wrapped_to_half_a_turn(after - before)
        });
        squares.iter_mut().zip(changes).for_each(|(square, change)| *square += change * change);
        product += changes[0] * changes[1];
    }
    let typical = squares.map(|square| (square / BOARDS as f64).sqrt());
    assert!(typical.iter().all(|rad| (0.2..0.4).contains(rad)), "{typical:?} rad");
    let correlation = product / (squares[0] * squares[1]).sqrt();
    assert!((correlation - 0.5).abs() < 0.15, "{correlation}");
}

/// Datasets whose maps use one receiver are simulated without the receivers behind it: its samples are bit-identical.
#[test]
fn samples_of_a_receiver_do_not_depend_on_the_other_receivers() {
    for (name, people) in [("corridor", 2), ("room", 1), ("bathroom", 1)] {
        let all = scene(name);
        for last in 0..all.waveform().shape().rx {
            let some = all.clone().with_receivers(all.waveform().request.rx_antennas.up_to(last));
            assert_eq!(some.waveform().shape().rx, last + 1);
            let (of_all, of_some) = (simulator(&all, 5, Some(people)), simulator(&some, 5, Some(people)));
            for index in [0, 60, 90, 120] {
                let (all, some) = (of_all.frame(index), of_some.frame(index));
                assert_eq!((all.truth, some.shape), (some.truth, of_some.scene().waveform().shape()));
                assert!(all.codes[..some.codes.len()] == some.codes, "{name}, {last} of the receivers, frame {index}");
            }
        }
    }
}

/// Skins are evaluated from the middle of all antennas, which differs by millimetres for fewer antennas.
#[test]
fn skin_echoes_of_a_receiver_depend_on_the_other_receivers_within_their_tolerance() {
    let all = scene("corridor-mesh");
    let one = all.clone().with_receivers(all.waveform().request.rx_antennas.up_to(0));
    let (of_all, of_one) = (simulator(&all, 5, Some(1)), simulator(&one, 5, Some(1)));
    for index in [40, 60] {
        let (all, one) = (of_all.echo_samples(index), of_one.echo_samples(index));
        let power = |x: &mut dyn Iterator<Item = f32>| x.map(|x| f64::from(x).powi(2)).sum::<f64>();
        let (echo, difference) =
            (power(&mut one.iter().copied()), power(&mut one.iter().zip(&all).map(|(one, all)| one - all)));
        assert!(echo > 0.0 && difference < 1e-3 * echo, "frame {index}: {:.1} dB", 10.0 * (difference / echo).log10());
    }
}

/// Steps have about the requested rate and size, and nothing changes between them.
#[test]
fn clutter_steps_have_the_requested_rate_and_size() {
    let scene = scene_with_wall("phase_step_rad = 0.6\nphase_step_interval_s = 4.0", "");
    let mut steps = Vec::new();
    for seed in 0..6 {
        let series = phases_and_amplitudes(&scene, seed, 400);
        steps.extend(series.windows(2).map(|pair| (pair[1].0 - pair[0].0).abs()).filter(|step| *step > 5e-3));
    }
    // Six times 40 s.
    assert!((48..=62).contains(&steps.len()), "{}", steps.len());
    let typical = rms(&steps);
    assert!((0.4..0.85).contains(&typical), "{typical} rad");
}

/// The phase noise of a wall is proportional to its delay: its contribution to the codes agrees with the closed form.
#[test]
fn phase_noise_of_a_wall_is_proportional_to_its_delay() {
    let noise = PhaseNoise { level_dbc_per_hz: -50.0, offset_hz: 1e5 };
    let key = format!("[receiver.phase_noise]\nlevel_dbc_per_hz = {}", noise.level_dbc_per_hz);
    let (with, without) = (scene_with_wall("", &key), scene_with_wall("", ""));
    assert_eq!(with.receiver().phase_noise, Some(noise));
    let frames = [&with, &without].map(|scene| simulator(scene, 1, Some(0)).frame(0));
    let shape = with.waveform().shape();
    let per_rx = shape.chirps * shape.samples;
    let added: Vec<f64> =
        frames[0].codes.iter().zip(&frames[1].codes).map(|(a, b)| f64::from(*a) - f64::from(*b)).collect();
    let dc = 2048.0;
    let wall_rms = rms(&frames[1].codes[..per_rx].iter().map(|&c| f64::from(c) - dc).collect::<Vec<_>>());
    let delay_s = 2.0 * 2.4 / radome_dsp::SPEED_OF_LIGHT_M_PER_S;
    let rate = std::f64::consts::TAU * noise.offset_hz * (1e-5 * with.waveform().sample_rate_hz).sqrt();
    // Each of the two frames is rounded separately.
    let expected = ((wall_rms * delay_s * rate).powi(2) + 1.0 / 6.0).sqrt();
    let found = rms(&added[..per_rx]);
    assert!(wall_rms > 20.0 && expected > 1.0, "{wall_rms} LSB, {expected} LSB");
    assert!((found / expected - 1.0).abs() < 0.08, "{found} LSB, expected {expected} LSB");
    // All receivers share one oscillator and see the wall at nearly the same phase.
    let product: f64 = added[..per_rx].iter().zip(&added[per_rx..2 * per_rx]).map(|(a, b)| a * b).sum();
    assert!(product / per_rx as f64 > 0.5 * found * found, "{product}");
}

/// People, as ellipsoids and as skins: the phase-noise contribution is the phase's rate times the derivative of the
/// echoes over `2 pi` times the slope, since a beat frequency is the slope times its delay.
#[test]
fn phase_noise_of_people_is_proportional_to_their_delays() {
    let noise = PhaseNoise { level_dbc_per_hz: -30.0, offset_hz: 1e5 };
    for (name, frames) in [("corridor", &[40u64, 60, 80, 100][..]), ("corridor-mesh", &[60])] {
        let quiet = scene(name);
        let still = ClutterDrift::default();
        let receiver = Receiver {
            phase_noise: Some(noise),
            clutter: ClutterDrift { leakage_jitter: 0.0, ..still.clone() },
            ..quiet.receiver().clone()
        };
        let noiseless = Receiver { phase_noise: None, ..receiver.clone() };
        let people = |receiver: &Receiver, people: usize| {
            let options = SimulateOptions { seed: 7, people: Some(people), ..SimulateOptions::default() };
            Simulator::new(&quiet.clone().with_receiver(receiver.clone()), options).expect("a simulator")
        };
        let with = people(&receiver, 1);
        let others = [people(&noiseless, 1), people(&receiver, 0), people(&noiseless, 0)];
        let w = quiet.waveform();
        let (shape, per_cycle) = (w.shape(), std::f64::consts::TAU * w.slope_hz_per_s / w.sample_rate_hz);
        let rates = PhaseRates::new(&noise, w.sample_rate_hz);
        let (mut product, mut expected_power, mut found_power) = (0.0, 0.0, 0.0);
        for &frame in frames {
            let noisy = with.frame(frame);
            let [plain, empty_noisy, empty] = others.each_ref().map(|simulator| simulator.frame(frame));
            let echo = with.echo_samples(frame);
            let mut rng = generator(7, Purpose::PhaseNoise, [frame, 0]);
            for chirp in 0..shape.chirps {
                let mut rate = vec![0f32; shape.samples];
                rates.add(&mut rng, &vec![1.0; shape.samples], &mut rate);
                let at = |n: usize| f64::from(echo[chirp * shape.samples + n]);
                for (n, rate) in rate.iter().enumerate().take(shape.samples - 2).skip(2) {
                    let slope = (8.0 * (at(n + 1) - at(n - 1)) - at(n + 2) + at(n - 2)) / 12.0;
                    let expected = f64::from(*rate) * slope / per_cycle;
                    let i = chirp * shape.samples + n;
                    // Contribution of people to the phase noise; clutter in their shadow is tested elsewhere.
                    let code = |frame: &radome_dsp::Frame| f64::from(frame.codes[i]);
                    let found = code(&noisy) - code(&plain) - (code(&empty_noisy) - code(&empty));
                    product += expected * found;
                    expected_power += expected * expected;
                    found_power += found * found;
                }
            }
            eprintln!("{name} to frame {frame}: {}", product / expected_power);
        }
        let ratio = product / expected_power;
        let rms = (expected_power / (frames.len() * shape.chirps * shape.samples) as f64).sqrt();
        assert!(rms > 0.05, "{name}: nothing to see, {rms} LSB");
        assert!((ratio - 1.0).abs() < 0.1, "{name}: {ratio}, {rms} LSB of {found_power}");
    }
}
