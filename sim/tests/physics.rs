//! Physical effects that frames must show: signs, levels and laws.

use std::f64::consts::TAU;

use num_complex::{Complex, Complex64};
use radome_dsp::{Occupancy, SPEED_OF_LIGHT_M_PER_S};
use radome_sim::material::Material;
use radome_sim::prepared_scene::{PreparedScene, StaticTone};
use radome_sim::receiver::adc::quantise;
use radome_sim::receiver::budget::Filters;
use radome_sim::receiver::noise::{NoiseScratch, NoiseShaper, density_lsb2};
use radome_sim::synthesis::{SynthesisScratch, Synthesiser, Tone};
use radome_sim::{Receiver, random};

use crate::common::{self, NOBODY, hall, map_db, parse, peak, post, range_profiles, simulator, statistics};

/// The hall with a person who walks along x, ahead of the radar.
fn hall_with_walker(from_m: f64, to_m: f64, speed_m_per_s: f64) -> String {
    hall(&format!(
        "[people]\nactor = [{{ step = [{{ walk_to_m = [{from_m}, 10.0] }}, {{ walk_to_m = [{to_m}, 10.0], speed_m_per_s = {speed_m_per_s} }}] }}]\n"
    ))
}

#[test]
fn a_receding_person_has_positive_velocity_at_the_true_range() {
    for (from, to, sign) in [(4.0, 9.0, 1.0), (9.0, 4.0, -1.0)] {
        let scene = parse(&hall_with_walker(from, to, 1.2));
        let simulator = simulator(&scene, 3, None);
        let frame = simulator.frame(20);
        let (doppler, range) = peak(&map_db(&frame, 0), 128);
        let w = scene.waveform();
        let velocity = (doppler as f64 - 64.0) * w.velocity_step_m_per_s(128);
        let person = simulator.people(20)[0];
        assert!((velocity - sign * 1.2).abs() < 0.7, "{velocity} m/s");
        assert!((person.radial_speed_m_per_s - sign * 1.2).abs() < 0.25, "{person:?}");
        let distance = range as f64 * w.range_step_m(256);
        assert!((distance - person.range_m).abs() < 0.6, "{distance} m for {person:?}");
    }
}

/// Reflection of a slab at normal incidence, from the sum of its internal bounces.
fn slab_reflection(permittivity: Complex64, thickness_m: f64, wavenumber_per_m: f64) -> Complex64 {
    let n = permittivity.sqrt();
    let surface = (1.0 - n) / (1.0 + n);
    let transmitted = Complex64::from(1.0) - surface * surface;
    let round_trip = (Complex64::new(0.0, -2.0 * wavenumber_per_m * thickness_m) * n).exp();
    let bounce = |i: u32| transmitted * surface * round_trip * (surface * surface * round_trip).powu(i);
    surface - (0..400).map(bounce).sum::<Complex64>()
}

/// A metal wall on one side and a lossy one on the other: two echoes whose sum has a null where the closed form
/// predicts it, with the lossy wall's complex coefficient. A sign error in conjugation moves the null by twice that
/// coefficient's angle.
#[test]
fn the_echo_null_of_a_lossy_wall_agrees_with_the_closed_form() {
    let material = Material::Glass;
    // The wall is thin relative to the wavelength: the coefficient is nearly imaginary, so that conjugation shows.
    let thickness_m = 0.0003;
    let text = hall(NOBODY)
        .replace("y_low = { material = \"open\" }", "y_low = { material = \"metal\" }")
        .replace("y_high = { material = \"open\" }", "y_high = { material = \"glass\", thickness_m = 0.0003 }")
        .replace("position_m = [1.0, 10.0, 1.2]", "position_m = [1.0, 9.53, 1.2]")
        .replace("[receiver.noise]", "[receiver.antenna]\nside_lobe_floor_db = 0.0\n[receiver.noise]")
        .replace("[room]", "[room]\nmax_reflections = 1");
    let scene = parse(&text);
    let prepared = PreparedScene::new(&scene, 0, 40.0);
    assert_eq!(prepared.static_paths.len(), 2);

    // Minimum of the simulated envelope, with in-phase and quadrature samples from the sampled synthesis.
    let synthesiser = Synthesiser::new(256);
    let quadrature = |rotation: Complex<f32>| {
        let mut grid = synthesiser.grid();
        for path in &prepared.static_paths {
            let StaticTone { phase_cycles, cycles_per_sample, amplitude } = path.tones[0];
            let amplitude = Complex::new(amplitude.re as f32, amplitude.im as f32) * rotation;
            synthesiser.add(&Tone { phase_cycles, cycles_per_sample, amplitude }, &mut grid);
        }
        let mut samples = vec![0f32; 256];
        synthesiser.transform(&grid, &mut samples, &mut SynthesisScratch::default());
        samples
    };
    let (re, im) = (quadrature(Complex::new(1.0, 0.0)), quadrature(Complex::new(0.0, -1.0)));
    let envelope: Vec<f64> = re.iter().zip(&im).map(|(a, b)| f64::from(a.hypot(*b))).collect();

    // Independent closed form: the reflection of glass, and amplitudes of 1/length.
    let w = scene.waveform();
    let permittivity = material.permittivity(w.centre_frequency_hz()).expect("dielectric");
    let wavenumber_per_m = TAU * w.centre_frequency_hz() / SPEED_OF_LIGHT_M_PER_S;
    let glass = slab_reflection(permittivity, thickness_m, wavenumber_per_m);
    let filters = Filters::new(scene.receiver(), w);
    // Mirrored antennas: TX 3 mm to one side of the package's middle, RX1 4.5 mm to the other.
    let lengths = (2.0 * 9.53 - 0.003 + 0.0045, 2.0 * 10.47 + 0.003 - 0.0045);
    let closed_form_envelope = |conjugate: bool| -> Vec<f64> {
        (0..256)
            .map(|n| {
                let t = n as f64 / w.sample_rate_hz;
                let field: Complex64 = [(lengths.0, Complex64::from(-1.0)), (lengths.1, glass)]
                    .into_iter()
                    .map(|(length, reflection)| {
                        let tau = length / SPEED_OF_LIGHT_M_PER_S;
                        let s = w.slope_hz_per_s;
                        let f = w.sampled_start_frequency_hz;
                        let cycles = f * tau + s * tau * t - 0.5 * s * tau * tau;
                        let a = if conjugate { reflection.conj() } else { reflection };
                        a / length * filters.response(s * tau) * Complex64::from_polar(1.0, TAU * cycles)
                    })
                    .sum();
                field.norm()
            })
            .collect()
    };
    let null_sample = |x: &[f64]| (20..236).min_by(|&a, &b| x[a].total_cmp(&x[b])).expect("samples") as f64;
    // Nulls repeat every c / (difference of lengths) / slope.
    let period = SPEED_OF_LIGHT_M_PER_S / (lengths.1 - lengths.0) / w.slope_hz_per_s * w.sample_rate_hz;
    let null_distance = |a: f64, b: f64| ((a - b + 0.5 * period).rem_euclid(period) - 0.5 * period).abs();
    let [expected, conjugated] = [true, false].map(|conjugate| null_sample(&closed_form_envelope(conjugate)));
    let simulated = null_sample(&envelope);
    assert!(
        null_distance(expected, conjugated) > 0.08 * period,
        "the wall's coefficient is complex enough: {expected} {conjugated}"
    );
    assert!(
        null_distance(simulated, expected) < 0.03 * period,
        "null at {simulated}, expected {expected}, {conjugated} if conjugated"
    );
}

/// The radar equation, in LSB: a point of 0 dBsm on boresight at 2, 4 and 8 m.
#[test]
fn echo_levels_follow_the_radar_equation() {
    let mut previous: Option<f64> = None;
    for range in [2.0f64, 4.0, 8.0] {
        let scene = parse(&hall(&(post(range, 0.0) + NOBODY)));
        let prepared = PreparedScene::new(&scene, 0, 20.0);
        assert_eq!(prepared.static_paths.len(), 1);
        let tone = prepared.static_paths[0].tones[0];
        let lsb = tone.amplitude.norm()
            / prepared.filters.response(tone.cycles_per_sample * scene.waveform().sample_rate_hz).norm();
        // 4 dBm + 3.5 + 3.5 dBi, 14 + 33 dB to 50 ohm, 1.31 V over 4096 codes.
        let wavelength = scene.waveform().wavelength_m();
        let received_dbm = 4.0 + 7.0 + 20.0 * wavelength.log10() - 30.0 * (2.0 * TAU).log10() - 40.0 * range.log10();
        let volt = (1e-3 * 10f64.powf(0.1 * (received_dbm + 47.0)) * 50.0 * 2.0).sqrt();
        let expected_db = 20.0 * (volt / (1.31 / 4096.0)).log10();
        assert!((20.0 * lsb.log10() - expected_db).abs() < 0.05, "{range} m: {lsb} LSB");
        if let Some(previous) = previous {
            assert!((20.0 * (previous / lsb).log10() - 12.04).abs() < 0.05);
        }
        previous = Some(lsb);
    }
}

/// Power |X|^2 of thermal noise is exponential. The standard deviation of its decibels is 5.57, and their mean is 2.51
/// below the decibels of the mean.
#[test]
fn empty_maps_have_exponential_power() {
    let scene = parse(&hall(NOBODY));
    let simulator = simulator(&scene, 5, Some(0));
    let mut all = Vec::new();
    for index in 0..6 {
        let map = map_db(&simulator.frame(index), 0);
        // Zero Doppler has lost its mean, and bin 0 is not one-sided.
        all.extend(
            map.chunks(128).enumerate().filter(|(d, _)| d.abs_diff(64) > 1).flat_map(|(_, row)| row[2..].to_vec()),
        );
    }
    let (mean, sigma) = statistics(&all);
    let power = all.iter().map(|v| 10f64.powf(0.1 * v)).sum::<f64>() / all.len() as f64;
    assert!((sigma - 5.570).abs() < 0.06, "{sigma}");
    assert!((mean - 10.0 * power.log10() + 2.507).abs() < 0.05);
    // 2 LSB rms in the scale 2/4095 through two periodic Hann windows (sum of squares 3/8 N M).
    let expected = 10.0 * (4.0 * (2.0f64 / 4095.0).powi(2) * (0.375 * 256.0) * (0.375 * 128.0)).log10();
    assert!((10.0 * power.log10() - expected).abs() < 0.15, "{} {expected}", 10.0 * power.log10());
}

/// Levels of public recordings: density at 23 dB gain (64 samples, 2 MHz), sigma of a sample at 48 dB (128 samples, 2
/// MHz).
#[test]
fn noise_has_the_measured_spectrum_at_both_gains() {
    let mut scene = parse(&hall(NOBODY));
    let mut request = scene.waveform().request.clone();
    request.sample_rate_hz = 2e6;
    request.high_pass_cutoff_hz = 80e3;
    request.end_frequency_hz = 60.5e9;
    let receiver = Receiver { anti_alias_cutoff_scale: 1.06, ..Receiver::typical() };
    scene = scene.with_receiver(receiver.clone());
    let density = |samples, gain| {
        let mut changed = request.clone();
        changed.samples_per_chirp = samples;
        changed.if_gain_db = gain;
        density_lsb2(scene.receiver(), &radome_dsp::Waveform::realise(changed).expect("valid"))
    };
    let at_23_db = density(64, 23.0);
    for (bin, measured) in
        [(1, 3.5), (2, 2.4), (3, 1.9), (4, 1.7), (6, 1.6), (8, 1.4), (16, 1.4), (20, 1.2), (24, 0.9), (32, 0.8)]
    {
        let error_db = 10.0 * (at_23_db[bin] / measured).log10();
        assert!(error_db.abs() < 1.5, "23 dB, bin {bin}: {} for {measured}", at_23_db[bin]);
    }
    let at_48_db = density(128, 48.0);
    for (bin, measured) in [(3, 10.3), (10, 8.4), (20, 7.5), (30, 6.0), (40, 3.8), (50, 1.8), (60, 1.2)] {
        let error_db = 20.0 * (at_48_db[bin].sqrt() / measured).log10();
        assert!(error_db.abs() < 1.5, "48 dB, bin {bin}: {} for {measured}", at_48_db[bin].sqrt());
    }
}

#[test]
fn drawn_noise_has_the_requested_density() {
    let density: Vec<f64> = (0..=32).map(|bin| 1.0 + 20.0 / (1.0 + f64::from(bin))).collect();
    let shaper = NoiseShaper::new(&density, 64);
    let mut rng = random::generator(9, random::Purpose::Noise, [0, 0]);
    let mut scratch = NoiseScratch::default();
    let fft = radome_dsp::spectrum::real_fft(64);
    let mut power = vec![0.0; 33];
    let chirps = 6000;
    for _ in 0..chirps {
        let mut x = vec![0f32; 64];
        shaper.add(&mut rng, 1.0, &mut x, &mut scratch);
        let mut x: Vec<f64> = x.into_iter().map(f64::from).collect();
        let mut spectrum = fft.make_output_vec();
        fft.process(&mut x, &mut spectrum).expect("lengths agree");
        for (p, s) in power.iter_mut().zip(&spectrum) {
            *p += s.norm_sqr() / 64.0 / f64::from(chirps);
        }
    }
    for (bin, (found, expected)) in power.iter().zip(&density).enumerate() {
        // Rounding's twelfth is left to the quantiser; 6000 draws are accurate to 2 %.
        assert!((found / (expected - 1.0 / 12.0) - 1.0).abs() < 0.07, "bin {bin}: {found} for {expected}");
    }
}

/// A beat beyond half the rate folds, attenuated by the filter at its true frequency.
#[test]
fn a_beat_beyond_half_the_sample_rate_is_folded() {
    let scene = parse(
        &hall(NOBODY)
            .replace("size_m = [20.0, 20.0, 3.0]", "size_m = [27.0, 20.0, 3.0]")
            .replace("x_high = { material = \"open\" }", "x_high = { material = \"metal\" }")
            .replace("if_gain_db = 33.0", "if_gain_db = 60.0"),
    );
    let prepared = PreparedScene::new(&scene, 0, 20.0);
    let cycles = prepared.static_paths[0].tones[0].cycles_per_sample;
    assert!(cycles > 0.55 && cycles < 0.7, "beyond Nyquist: {cycles}");
    let frame = simulator(&scene, 0, Some(0)).frame(0);
    let chirp: Vec<f64> = frame.chirp(0, 0).iter().map(|&c| f64::from(c) - 2048.0).collect();
    let spectrum = &range_profiles(&chirp, 256)[0];
    let strongest = (3..129).max_by(|&a, &b| spectrum[a].norm().total_cmp(&spectrum[b].norm())).expect("bins");
    let folded_bin = (1.0 - cycles) * 256.0;
    assert!((strongest as f64 - folded_bin).abs() < 1.0, "bin {strongest}, folded {folded_bin}");
}

#[test]
fn truth_counts_people_who_are_partly_in_the_room() {
    let text = hall(
        "[people]\nactor = [{ step = [{ walk_to_m = [-2.0, 10.0] }, { walk_to_m = [6.0, 10.0], speed_m_per_s = 1.0 }] },\n\
         { step = [{ walk_to_m = [8.0, 6.0] }, { stand_s = 5.0 }, { walk_to_m = [8.0, -9.0], speed_m_per_s = 1.0 }] }]\n",
    );
    let scene = parse(&text);
    let simulator = simulator(&scene, 1, None);
    let truth_at = |seconds: f64| simulator.truth((seconds * 10.0) as u64);
    assert_eq!((truth_at(0.5).occupancy, truth_at(0.5).transition), (Occupancy::One, false));
    assert_eq!((truth_at(2.0).occupancy, truth_at(2.0).transition), (Occupancy::Two, true));
    assert_eq!((truth_at(5.0).occupancy, truth_at(5.0).transition), (Occupancy::Two, false));
    assert_eq!((truth_at(11.0).occupancy, truth_at(11.0).transition), (Occupancy::Two, true));
    assert_eq!((truth_at(13.0).occupancy, truth_at(13.0).transition), (Occupancy::One, false));
    assert_eq!(common::simulator(&scene, 1, Some(1)).truth(130).occupancy, Occupancy::One);
}

#[test]
fn a_person_in_front_shades_the_one_behind() {
    // Power in the cells around the walker behind, over that of noise, in several phases of a step: 6.5 to 8.5 m, approaching.
    let excess_power_behind = |front_y_m: f64| {
        let text = hall(&format!(
            "[people]\nactor = [{{ step = [{{ walk_to_m = [4.0, {front_y_m}] }}] }},\n\
             {{ step = [{{ walk_to_m = [9.0, 10.0] }}, {{ walk_to_m = [7.0, 10.0], speed_m_per_s = 1.0 }}] }}]\n"
        ));
        let power = |people: usize| {
            let simulator = simulator(&parse(&text), 2, Some(people));
            let maps = (8..14).map(|frame| map_db(&simulator.frame(frame), 0));
            let in_cells = |map: Vec<f64>| {
                let cells = (10..58).flat_map(|d| (38..50).map(move |r| d * 128 + r));
                cells.map(|cell| 10f64.powf(0.1 * map[cell])).sum::<f64>()
            };
            maps.map(in_cells).sum::<f64>()
        };
        let noise = power(0);
        (power(2) - noise).max(0.02 * noise)
    };
    let (behind, beside) = (excess_power_behind(10.0), excess_power_behind(14.0));
    assert!(10.0 * (beside / behind).log10() > 8.0, "{} dB", 10.0 * (beside / behind).log10());
}

mod hard_cases {
    use super::*;
    use radome_sim::SimulateOptions;

    #[test]
    fn the_quantiser_rounds_clips_and_accepts_non_finite_values() {
        let cases = [(0.4, 0), (0.5, 1), (2047.5, 2048), (4094.6, 4095), (9e9, 4095), (-9e9, 0), (-0.4, 0)];
        for (lsb, code) in cases {
            assert_eq!(quantise(lsb), code, "{lsb}");
        }
        assert_eq!(quantise(f32::NAN), 0);
        assert_eq!(quantise(f32::INFINITY), 4095);
        assert_eq!(quantise(f32::NEG_INFINITY), 0);
    }

    /// People at 5 cm, at the antenna and beyond: frames are complete, and paths with limited levels are counted.
    #[test]
    fn people_at_and_through_the_radar_are_simulated_and_counted() {
        let close = hall("[people]\nactor = [{ step = [{ walk_to_m = [1.17, 10.0] }] }]\n");
        let (frame, report) = simulator(&parse(&close), 4, None).frame_with_report(0);
        assert!(report.clamped > 0, "{report:?}");
        assert!(frame.codes.iter().any(|&c| c.abs_diff(2048) > 15), "a strong echo");
        let through = parse(&hall_with_walker(3.0, -1.5, 1.0));
        let simulator = simulator(&through, 4, None);
        for index in 0..50 {
            let (frame, _) = simulator.frame_with_report(index);
            assert_eq!(frame.codes.len(), frame.shape.codes());
        }
        assert!((0..50).any(|i| simulator.frame_with_report(i).1.clamped > 0));
    }

    /// Leakage that nearly fills the range of the ADC does not hide a walker 90 dB below it.
    #[test]
    fn a_walker_90_db_below_the_leakage_is_the_strongest_cell() {
        let text = hall_with_walker(12.0, 10.0, 1.0).replace(
            "rx = [{ dc_code = 2048.0 },",
            "rx = [{ dc_code = 2048.0, leakage = [{ delay_s = 0.3e-9, amplitude_lsb = 1900.0 }] },",
        );
        let scene = parse(&text);
        let (frame, report) = simulator(&scene, 6, None).frame_with_report(10);
        assert_eq!(report.clipped, 0);
        let map = map_db(&frame, 0);
        assert!(map.iter().all(|v| v.is_finite()));
        let (doppler, range) = peak(&map, 128);
        let w = scene.waveform();
        assert!((range as f64 * w.range_step_m(256) - 10.1).abs() < 0.8, "range bin {range}");
        assert!(doppler < 64, "approaching: {doppler}");
    }

    #[test]
    fn invalid_options_are_errors() {
        let scene = parse(&hall_with_walker(4.0, 5.0, 1.0));
        let new = |options| radome_sim::Simulator::new(&scene, options).map(|_| ());
        let many = new(SimulateOptions { people: Some(3), ..SimulateOptions::default() });
        assert!(many.expect_err("one actor").to_string().contains("at most 1"));
        assert!(new(SimulateOptions { tolerance_db: f64::NAN, ..SimulateOptions::default() }).is_err());
    }
}
