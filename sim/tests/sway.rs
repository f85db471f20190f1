//! Empty rooms and receivers that change within a frame: swaying reflectors, vibration, settling, spurious tones, and
//! people who disturb static echoes.

use std::f64::consts::TAU;

use num_complex::Complex64;
use radome_dsp::{Frame, Occupancy};
use radome_sim::Scene;

use crate::common::{
    NOBODY, error_message, fixture, hall, map_db, parse, post, range_bin, rms, scene, simulator, statistics,
};

/// Hall with a quiet receiver, and further tables.
fn quiet_hall(extra: &str) -> Scene {
    parse(&hall(extra).replace("adc_white_lsb = 2.0", "adc_white_lsb = 0.5"))
}

/// The first receiver's range bin at a distance in every chirp.
fn slow_time(scene: &Scene, frame: &Frame, range_m: f64) -> Vec<Complex64> {
    range_bin(frame, (range_m / scene.waveform().range_step_m(frame.shape.samples)).round())
}

/// Phase change of a range bin from the first chirp of a frame to its last, from a straight-line fit, rad.
fn phase_slope_rad(bins: &[Complex64]) -> f64 {
    let mean = bins.iter().sum::<Complex64>();
    let middle = 0.5 * (bins.len() as f64 - 1.0);
    let (mut product, mut square) = (0.0, 0.0);
    for (i, bin) in bins.iter().enumerate() {
        let position = i as f64 - middle;
        product += position * (bin * mean.conj()).arg();
        square += position * position;
    }
    product / square * (bins.len() as f64 - 1.0)
}

/// Variation of a range bin within a frame, relative to its mean.
fn relative_variation(bins: &[Complex64]) -> f64 {
    let mean = bins.iter().sum::<Complex64>() / bins.len() as f64;
    let square: f64 = bins.iter().map(|bin| (bin - mean).norm_sqr()).sum();
    (square / bins.len() as f64).sqrt() / mean.norm()
}

/// A reflector on a sinusoid of 2 Hz and 10 mm rms: its echo has the Doppler of its speed in every frame.
#[test]
fn a_swaying_reflector_has_the_doppler_of_its_speed() {
    let sway = "[[room.sway]]\nreflectors = 1\nposition_m = [4.0, 10.0, 1.2]\ncross_section_dbsm = 0.0\nspread_db = 0.0\n\
                amplitude_m = [0.01, 0.01]\nfrequency_hz = [2.0, 2.0]\nbandwidth = 0.0\n";
    let scene = quiet_hall(&format!("{sway}{NOBODY}"));
    let simulator = simulator(&scene, 3, None);
    let w = scene.waveform();
    let speeds: Vec<f64> = (0..40)
        .map(|index| {
            let frame = simulator.frame(index);
            assert_eq!(frame.truth.map(|truth| truth.occupancy), Some(Occupancy::Empty));
            let bins = slow_time(&scene, &frame, 3.0);
            let chirp_correlation: Complex64 = bins.windows(2).map(|pair| pair[1] * pair[0].conj()).sum();
            chirp_correlation.arg() * w.wavelength_m() / (2.0 * TAU * w.chirp_interval_s)
        })
        .collect();
    // 2 pi times 2 Hz times 10 mm; a frame of 64 ms averages over an eighth of a period.
    let expected = TAU * 2.0 * 0.01 * 0.974;
    assert!((rms(&speeds) / expected - 1.0).abs() < 0.05, "{} m/s, expected {expected} m/s", rms(&speeds));
    // Five frames are one period.
    for (now, later) in speeds.iter().zip(&speeds[5..]) {
        assert!((now - later).abs() < 0.01, "{now} {later}");
    }
}

/// A reflector 25 dB below a static echo, both in one range bin. The phase of the bin turns within frames, in either
/// direction, by the amount given by the weak echo's amplitude and phase rate. Without the reflector the bin is
/// constant.
#[test]
fn weak_sway_changes_the_phase_of_a_strong_bin_within_a_frame() {
    let sway = "[[room.sway]]\nreflectors = 1\nposition_m = [4.0, 10.0, 1.2]\ncross_section_dbsm = -25.0\nspread_db = 0.0\n\
                amplitude_m = [0.0002, 0.0002]\nfrequency_hz = [2.0, 2.0]\nbandwidth = 0.3\n";
    let slopes = |scene: &Scene| -> Vec<f64> {
        (0..60)
            .flat_map(|seed| {
                let simulator = simulator(scene, seed, None);
                [0, 7].map(|index| phase_slope_rad(&slow_time(scene, &simulator.frame(index), 3.0)))
            })
            .collect()
    };
    let [with, without] = [sway, ""].map(|sway| slopes(&quiet_hall(&format!("{}{sway}{NOBODY}", post(3.0, 0.0)))));
    let active_s = 0.064;
    let wavelength_m = quiet_hall(NOBODY).waveform().wavelength_m();
    // Phase rate of the weak echo, rms, times its relative amplitude, times the mean of a cosine over all phases.
    let rate_rad_per_s = 2.0 * TAU / wavelength_m * (TAU * 2.0 * 0.0002);
    let expected = 10f64.powf(-25.0 / 20.0) * rate_rad_per_s * active_s * 0.5f64.sqrt();
    assert!((0.6..1.4).contains(&(rms(&with) / expected)), "{} rad, expected {expected} rad", rms(&with));
    assert!(rms(&without) < 0.3 * rms(&with), "{} rad without", rms(&without));
    let upward = with.iter().filter(|slope| **slope > 0.0).count();
    assert!((30..90).contains(&upward), "{upward} of 120 turn upwards");
}

/// Motion at the frame rate, as of objects driven by the mains: the slope of the phase is the same in every frame, and
/// the mean phase does not change.
#[test]
fn sway_at_the_frame_rate_is_the_same_in_every_frame() {
    let sway = "[[room.sway]]\nreflectors = 1\nposition_m = [4.0, 10.0, 1.2]\ncross_section_dbsm = -10.0\nspread_db = 0.0\n\
                amplitude_m = [0.0001, 0.0001]\nfrequency_hz = [10.0, 10.0]\nbandwidth = 0.0\n";
    let scene = quiet_hall(&format!("{}{sway}{NOBODY}", post(3.0, 0.0)));
    let simulator = simulator(&scene, 2, None);
    let frames: Vec<Vec<Complex64>> = (0..12).map(|index| slow_time(&scene, &simulator.frame(index), 3.0)).collect();
    let slopes: Vec<f64> = frames.iter().map(|bins| phase_slope_rad(bins)).collect();
    let means: Vec<f64> = frames.iter().map(|bins| bins.iter().sum::<Complex64>().arg()).collect();
    let (_, slope_spread) = statistics(&slopes);
    let (_, mean_spread) = statistics(&means);
    assert!(slope_spread < 5e-3 && mean_spread < 5e-3, "{slopes:?} {means:?}");
    assert!(relative_variation(&frames[0]) > 0.01, "{}", relative_variation(&frames[0]));
}

/// Power at one velocity bin either side of zero relative to that far from it, dB, over range bins with clutter.
fn beside_zero_doppler_db(scene: &Scene) -> f64 {
    let (mut slow, mut noise) = (0.0, 0.0);
    for seed in 0..6 {
        let simulator = simulator(scene, seed, Some(0));
        for index in [0, 9] {
            let frame = simulator.frame(index);
            let (chirps, ranges) = (frame.shape.chirps, frame.shape.samples / 2);
            let map = map_db(&frame, 0);
            let power =
                |doppler: usize| -> f64 { (10..45).map(|range| 10f64.powf(0.1 * map[doppler * ranges + range])).sum() };
            slow += 0.5 * (power(chirps / 2 - 1) + power(chirps / 2 + 1));
            noise += 0.25 * [6, 7, chirps - 7, chirps - 6].into_iter().map(power).sum::<f64>();
        }
    }
    10.0 * (slow / noise).log10()
}

/// Halls of the training set with swaying reflectors: cells beside zero Doppler rise with the strength of the
/// reflectors, from zero.
#[test]
fn swaying_reflectors_raise_the_cells_beside_zero_doppler() {
    let (path, text) = fixture("hall");
    let text = text.replace("passer_by_probability = 0.7", "passer_by_probability = 0.0");
    let level_db = |sway: &str| {
        let text = text.replace("[radar]\n", &format!("{sway}[radar]\n"));
        beside_zero_doppler_db(&Scene::parse(&text, &path).expect("a hall"))
    };
    let without_sway = level_db("");
    let [below_noise, weak, strong] = [-120.0, -30.0, -15.0].map(|dbsm: f64| {
        level_db(&format!(
            "[[room.sway]]\nreflectors = 8\ncross_section_dbsm = {dbsm:.1}\nspread_db = 5.0\n\
             amplitude_m = [0.002, 0.01]\nfrequency_hz = [0.5, 2.0]\n"
        ))
    });
    assert!(without_sway < 1.0, "{without_sway} dB without sway");
    assert_eq!(below_noise, without_sway, "reflectors below the noise change nothing");
    assert!(weak > without_sway + 0.1, "{weak} dB, without sway {without_sway} dB");
    assert!(
        strong > without_sway + 6.0 && strong > weak + 3.0,
        "{strong} dB, weak {weak} dB, without sway {without_sway} dB"
    );
}

/// All echoes share the phase of the radar's own displacement.
#[test]
fn vibration_of_the_radar_changes_the_phase_of_all_echoes_alike() {
    let vibration = "[radar.vibration]\namplitude_m = 2e-5\nfrequency_hz = 30.0\nbandwidth = 0.0\n";
    let scene = quiet_hall(&format!("{}{}{vibration}{NOBODY}", post(3.0, 10.0), post(5.0, 20.0)));
    let simulator = simulator(&scene, 1, None);
    let (mut near, mut far) = (Vec::new(), Vec::new());
    for index in 0..20 {
        let frame = simulator.frame(index);
        for (range_m, phases) in [(3.0, &mut near), (5.0, &mut far)] {
            let bins = slow_time(&scene, &frame, range_m);
            let mean = bins.iter().sum::<Complex64>();
            phases.extend(bins.iter().map(|bin| (bin * mean.conj()).arg()));
        }
    }
    let expected = 2.0 * TAU / scene.waveform().wavelength_m() * 2e-5;
    for (range_m, phases) in [(3.0, &near), (5.0, &far)] {
        assert!((rms(phases) / expected - 1.0).abs() < 0.15, "{range_m} m: {} rad, expected {expected}", rms(phases));
    }
    let product = near.iter().zip(&far).map(|(a, b)| a * b).sum::<f64>() / near.len() as f64;
    assert!(product > 0.9 * rms(&near) * rms(&far), "{product}");
}

/// Posts 3 m and 6 m away and a quiet receiver, with further clutter keys.
fn two_posts(clutter: &str) -> Scene {
    let text = hall(&format!("{}{}{NOBODY}", post(3.0, 10.0), post(6.0, 20.0)))
        .replace("adc_white_lsb = 2.0", "adc_white_lsb = 0.5")
        .replace("[receiver.clutter]\n", &format!("[receiver.clutter]\n{clutter}"));
    parse(&text)
}

/// If the frequency settles within each frame, the phases of echoes change in proportion to their delay, alike in every
/// frame.
#[test]
fn settling_changes_the_phase_of_echoes_by_their_delay_in_every_frame() {
    let scene = two_posts("settling_frequency_hz = 1e6\nsettling_time_s = 0.01\n");
    let simulator = simulator(&scene, 1, None);
    for index in [0, 5] {
        let frame = simulator.frame(index);
        for range_m in [3.0, 6.0] {
            let bins = slow_time(&scene, &frame, range_m);
            // Phase change from the first chirp to the last, six time constants later.
            let phase_change_rad = (bins[0] * bins[bins.len() - 1].conj()).arg();
            let expected = TAU * 1e6 * 2.0 * range_m / radome_dsp::SPEED_OF_LIGHT_M_PER_S;
            assert!(
                (phase_change_rad / expected - 1.0).abs() < 0.2,
                "{range_m} m: {phase_change_rad} rad, expected {expected} rad"
            );
        }
    }
}

/// The gain drifts over seconds, and jitter of chirp times turns far echoes more than near ones.
#[test]
fn gain_drift_and_chirp_jitter_have_the_requested_size() {
    let drifting = two_posts("gain_drift_per_10s = 0.1\n");
    let changes: Vec<f64> = (0..24)
        .map(|seed| {
            let simulator = simulator(&drifting, seed, None);
            let [before, after] = [0, 100]
                .map(|index| slow_time(&drifting, &simulator.frame(index), 3.0).iter().sum::<Complex64>().norm());
            after / before - 1.0
        })
        .collect();
    assert!((0.05..0.2).contains(&rms(&changes)), "{changes:?}");
    let jittering = two_posts("chirp_jitter_s = 2e-8\n");
    let frame = simulator(&jittering, 1, None).frame(0);
    let w = jittering.waveform();
    for range_m in [3.0, 6.0] {
        let beat_hz = w.slope_hz_per_s * 2.0 * range_m / radome_dsp::SPEED_OF_LIGHT_M_PER_S;
        let expected = TAU * beat_hz * 2e-8;
        let found = relative_variation(&slow_time(&jittering, &frame, range_m));
        assert!((found / expected - 1.0).abs() < 0.25, "{range_m} m: {found} rad, expected {expected} rad");
    }
}

/// A spurious tone with a free-running clock appears in one cell of the map, above the noise.
#[test]
fn a_free_running_spur_is_one_cell_of_the_map() {
    let text = hall(NOBODY)
        .replace("[receiver.noise]\n", "[receiver.noise]\nspurs = 1\nspur_lsb = 2.0\nspur_phase = \"free\"\n");
    let strongest = |scene: &Scene| {
        let map = map_db(&simulator(scene, 1, None).frame(0), 0);
        let mean = 10.0 * (map.iter().map(|db| 10f64.powf(0.1 * db)).sum::<f64>() / map.len() as f64).log10();
        let (strongest_cell, _) = map.iter().enumerate().max_by(|a, b| a.1.total_cmp(b.1)).expect("cells");
        (map[strongest_cell] - mean, strongest_cell % 128)
    };
    let (over_db, range) = strongest(&parse(&text));
    assert!(over_db > 18.0 && range > 2, "{over_db} dB in range bin {range}");
    assert!(strongest(&parse(&hall(NOBODY))).0 < 15.0);
}

/// A static echo 5 m away while a person walks past 2 m in front of the radar. Beside the body, a single knife edge
/// leaves it unchanged, and both sides of a strip make it fluctuate. Behind the body both models weaken it strongly.
#[test]
fn people_change_static_echoes_behind_and_beside_them() {
    let people = |shadow: &str| {
        format!(
            "{}[people]\nshadow = \"{shadow}\"\n[[people.actor]]\nstep = [{{ walk_to_m = [3.0, 8.0] }}, \
             {{ walk_to_m = [3.0, 12.0], speed_m_per_s = 1.0 }}]\n",
            post(5.0, 20.0)
        )
    };
    let [edge, strip] = ["edge", "strip"].map(|shadow| quiet_hall(&people(shadow)));
    let [of_edge, of_strip] = [&edge, &strip].map(|scene| simulator(scene, 1, None));
    let without_people = simulator(&strip, 1, Some(0));
    let level = |bins: &[Complex64]| bins.iter().sum::<Complex64>().norm() / bins.len() as f64;
    let free_level = level(&slow_time(&strip, &without_people.frame(0), 5.0));
    assert_eq!(without_people.frame(3), simulator(&edge, 1, Some(0)).frame(3), "without people both models agree");
    let (mut variations_beside, mut least_level) = (Vec::new(), f64::INFINITY);
    for index in 0..60 {
        let Some(person) = of_strip.people(index).first().copied() else { continue };
        let offset_m = (person.position.y - 10.0).abs();
        if offset_m > 0.45 {
            continue;
        }
        let bins = [(&edge, &of_edge), (&strip, &of_strip)]
            .map(|(scene, simulator)| slow_time(scene, &simulator.frame(index), 5.0));
        if offset_m > 0.3 {
            variations_beside.push(bins.each_ref().map(|bins| relative_variation(bins)));
        }
        least_level = least_level.min(level(&bins[1]));
    }
    assert!(least_level < 0.1 * free_level, "{least_level} of {free_level}");
    assert!(!variations_beside.is_empty(), "no person passes beside the path");
    let mean = |model: usize| {
        variations_beside.iter().map(|variations| variations[model]).sum::<f64>() / variations_beside.len() as f64
    };
    assert!(mean(1) > 0.02 && mean(1) > 3.0 * mean(0), "strip {}, edge {}", mean(1), mean(0));
}

#[test]
fn neutral_keys_change_no_frame() {
    let (path, text) = fixture("hall");
    let neutral = text
        .replace("[radar]\n", "[[room.sway]]\nreflectors = 0\n[[room.sway]]\nprobability = 0.0\n[radar]\n")
        .replace("[waveform]", "[radar.vibration]\namplitude_m = 0.0\n[waveform]")
        .replace("[people.visits]", "[people]\nshadow = \"edge\"\n[people.visits]")
        .replace(
            "[random]\n",
            "[random]\n\"receiver.noise.spurs\" = { of = [0] }\n\"receiver.clutter.gain_drift_per_10s\" = { of = [0.0] }\n\
             \"receiver.clutter.chirp_jitter_s\" = { of = [0.0] }\n\"receiver.clutter.settling_gain\" = { of = [0.0] }\n",
        );
    let neutral = Scene::parse(&neutral, &path).expect("a scene");
    let plain = scene("hall");
    for seed in [1, 2] {
        let (plain, neutral) = (simulator(&plain, seed, Some(2)), simulator(&neutral, seed, Some(2)));
        for index in [0, 40, 80] {
            assert!(plain.frame(index) == neutral.frame(index), "seed {seed}, frame {index}");
        }
    }
}

#[test]
fn every_key_of_sway_and_receiver_can_be_drawn() {
    let (path, text) = fixture("hall");
    let text = text
        .replace("[radar]\n", "[[room.sway]]\n[radar]\n")
        .replace("[waveform]", "[radar.vibration]\n[waveform]")
        .replace(
            "[random]\n",
            "[random]\n\"room.sway.0.reflectors\" = { of = [0, 0, 3, 8] }\n\
             \"room.sway.0.cross_section_dbsm\" = { between = [-75.0, -25.0] }\n\
             \"room.sway.0.frequency_hz\" = { of = [[0.2, 3.0], [50.0, 50.0]] }\n\
             \"radar.vibration.amplitude_m\" = { of = [0.0, 5e-6, 5e-5] }\n\
             \"people.shadow\" = { of = [\"edge\", \"strip\"] }\n\
             \"receiver.noise.spurs\" = { between = [0, 3] }\n\
             \"receiver.noise.spur_lsb\" = { between = [0.1, 3.0] }\n\
             \"receiver.clutter.settling_frequency_hz\" = { between = [-5e5, 5e5] }\n",
        );
    let all = Scene::parse(&text, &path).expect("a scene");
    let mut counts = std::collections::BTreeSet::new();
    for seed in 0..30 {
        let drawn = all.drawn(seed).expect("a draw");
        counts.insert(drawn.file().room.sway[0].reflectors);
        if seed < 4 {
            let simulator = simulator(&all, seed, Some(0));
            assert_eq!(simulator.frame(3), simulator.frame(3));
        }
    }
    assert_eq!(counts.into_iter().collect::<Vec<_>>(), [0, 3, 8]);
}

mod hard_cases {
    use super::*;

    #[test]
    fn invalid_keys_are_refused_by_name() {
        let cases = [
            ("[[room.sway]]\nreflectors = 65\n", "reflectors", "64"),
            ("[[room.sway]]\nprobability = 1.5\n", "probability", "0 to 1"),
            ("[[room.sway]]\namplitude_m = [0.01, 0.001]\n", "amplitude_m", "least, largest"),
            ("[[room.sway]]\namplitude_m = [0.0, 0.001]\n", "amplitude_m", "least, largest"),
            ("[[room.sway]]\nfrequency_hz = [1.0, 1e9]\n", "frequency_hz", "200 Hz"),
            ("[[room.sway]]\nbandwidth = nan\n", "bandwidth", "0 to 1"),
            ("[[room.sway]]\ncross_section_dbsm = 50.0\n", "cross_section_dbsm", "dBsm"),
            ("[[room.sway]]\nposition_m = [1.0, 50.0, 1.0]\n", "position_m", "in the room"),
            ("[[room.sway]]\nat = \"ceiling\"\n", "ceiling", "clutter"),
            ("[[room.sway]]\nspeed_m_per_s = 1.0\n", "speed_m_per_s", "amplitude_m"),
            ("[radar.vibration]\namplitude_m = 1.0\n", "amplitude_m", "0.01 m"),
            ("[radar.vibration]\nfrequency_hz = 0.0\n", "frequency_hz", "200 Hz"),
        ];
        for (extra, key, expected) in cases {
            let message = error_message(&hall(&format!("{extra}{NOBODY}")));
            assert!(message.starts_with("a/b.toml:"), "{message}");
            assert!(message.contains(key) && message.contains(expected), "{extra}: {message}");
        }
        for (table, line, key) in [
            ("noise", "spurs = 33", "spurs"),
            ("noise", "spur_lsb = -1.0", "spur_lsb"),
            ("noise", "spur_phase = \"late\"", "late"),
            ("clutter", "settling_time_s = 0.0", "settling_time_s"),
            ("clutter", "chirp_jitter_s = 1.0", "chirp_jitter_s"),
            ("clutter", "gain_drift_per_10s = nan", "gain_drift_per_10s"),
        ] {
            let table = format!("[receiver.{table}]\n");
            let message = error_message(&hall(NOBODY).replace(&table, &format!("{table}{line}\n")));
            assert!(message.contains(key), "{line}: {message}");
        }
    }

    /// Reflectors in a corner, at the antenna and with the largest motions: frames are made, and codes are valid.
    #[test]
    fn reflectors_with_extreme_values_are_simulated() {
        for position_m in ["[0.0, 0.0, 0.0]", "[1.0, 10.0, 1.2]", "[20.0, 20.0, 3.0]"] {
            for (amplitude_m, frequency_hz) in [(1e-7, 0.01), (0.5, 200.0)] {
                let sway = format!(
                    "[[room.sway]]\nreflectors = 2\nposition_m = {position_m}\ncross_section_dbsm = 20.0\n\
                     amplitude_m = [{amplitude_m}, {amplitude_m}]\nfrequency_hz = [{frequency_hz}, {frequency_hz}]\n"
                );
                let scene = quiet_hall(&format!("{sway}{NOBODY}"));
                let frame = simulator(&scene, 1, None).frame(2);
                assert!(frame.codes.iter().all(|&code| code <= radome_dsp::MAX_CODE));
            }
        }
    }
}
