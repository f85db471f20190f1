//! Maps on physical axes.

use super::*;
use crate::SPEED_OF_LIGHT_M_PER_S;

pub(super) const AXES: PhysicalAxes =
    PhysicalAxes { range_step_m: 0.15, range_bins: 64, velocity_step_m_per_s: 0.098, velocity_bins: 64 };

pub(super) fn on_axes(axes: PhysicalAxes) -> RdmSpec {
    RdmSpec {
        channels: Channels::IncoherentSum,
        chirp_mean_removal: true,
        physical_axes: Some(axes),
        ..RdmSpec::default()
    }
}

/// 1 GHz, 128 samples, 64 chirps, one receiver; changed as `change` says.
pub(super) fn realised(change: impl FnOnce(&mut WaveformRequest)) -> Waveform {
    let mut request = WaveformRequest {
        start_frequency_hz: 60.5e9,
        end_frequency_hz: 61.5e9,
        samples_per_chirp: 128,
        chirps_per_frame: 64,
        sample_rate_hz: 2e6,
        chirp_interval_s: 391.55e-6,
        frame_interval_s: 0.1,
        rx_antennas: one_antenna(),
        ..WaveformRequest::paper()
    };
    change(&mut request);
    Waveform::realise(request).expect("valid")
}

/// Waveforms of real recordings and beyond, by name.
fn waveforms() -> [(&'static str, Waveform); 7] {
    let receivers = |antennas: &[u8]| RxMask::from_antennas(antennas).expect("receivers");
    [
        ("1 GHz, 128 x 64", realised(|_| ())),
        (
            "1 GHz, 64 x 64, 3 receivers",
            realised(|w| (w.samples_per_chirp, w.rx_antennas, w.if_gain_db) = (64, RxMask::ALL, 38.0)),
        ),
        (
            "64 x 16, 2 receivers, 50 ms",
            realised(|w| {
                (w.samples_per_chirp, w.chirps_per_frame, w.rx_antennas) = (64, 16, receivers(&[1, 3]));
                w.frame_interval_s = 0.05;
            }),
        ),
        ("64 x 8", realised(|w| (w.samples_per_chirp, w.chirps_per_frame) = (64, 8))),
        ("512 chirps", realised(|w| (w.chirps_per_frame, w.frame_interval_s) = (512, 0.25))),
        ("0.33 GHz", realised(|w| w.end_frequency_hz = w.start_frequency_hz + 0.33e9)),
        // Chirps 2 % farther apart: the outermost speeds are not measured.
        ("2 % slower", realised(|w| w.chirp_interval_s *= 1.02)),
    ]
}

/// Samples of one receiver at unit amplitude from a point at `range_m` in the middle of the frame.
fn echo(w: &Waveform, range_m: f64, velocity_m_per_s: f64, chirp: usize, sample: usize) -> f64 {
    let middle_s = 0.5 * w.request.chirps_per_frame as f64 * w.chirp_interval_s;
    let t = sample as f64 / w.sample_rate_hz;
    let way_m = range_m + velocity_m_per_s * (chirp as f64 * w.chirp_interval_s + t - middle_s);
    let tau = 2.0 * way_m / SPEED_OF_LIGHT_M_PER_S;
    (TAU * (w.sampled_start_frequency_hz * tau + w.slope_hz_per_s * tau * t - 0.5 * w.slope_hz_per_s * tau * tau)).cos()
}

fn power(db: f32) -> f64 {
    10f64.powf(0.1 * f64::from(db))
}

/// Worst amplitude error of the measured cells of one map against the strongest, dBc.
fn measured_error_dbc(map: &Rdm, expected: &[f64], coverage: &AxesCoverage) -> f64 {
    let cells =
        coverage.velocity_bins.clone().flat_map(|d| (0..coverage.range_bins).map(move |r| d * AXES.range_bins + r));
    let (got, expected): (Vec<f32>, Vec<f64>) = cells.map(|cell| (map.db[cell], expected[cell])).unzip();
    error_dbc(&got, &expected)
}

#[test]
fn every_waveform_agrees_with_the_formula_in_f64() {
    for (title, w) in waveforms() {
        let coverage = AXES.coverage(&w);
        for static_removal in [StaticRemoval::None, StaticRemoval::SlowTimeMean] {
            for amplitude in [AmplitudeScale::FullScaleSine, AmplitudeScale::Vendor, AmplitudeScale::Unnormalised] {
                let spec = RdmSpec { static_removal, amplitude, ..on_axes(AXES) };
                let frame = busy_frame(w.shape(), 5);
                let expected = reference::map(&spec, &w, std::slice::from_ref(&frame)).expect("spec fits");
                let mut first: Option<Vec<f32>> = None;
                for mut processor in levels().map(|l| RdmProcessor::with_kernel(&spec, &w, l).expect("spec fits")) {
                    let map = last_map(&mut processor, std::slice::from_ref(&frame));
                    let error = measured_error_dbc(&map, &expected, &coverage);
                    assert!(error < -100.0, "{error} dBc: {title}, {spec:?}, {}", name(&processor));
                    // Levels differ in the rounding of the logarithm only.
                    let first = first.get_or_insert_with(|| map.db.clone());
                    assert!(first.iter().zip(&map.db).all(|(a, b)| (a - b).abs() < 1e-3), "{title}");
                }
            }
        }
    }
}

#[test]
fn natural_axes_give_the_ordinary_map() {
    for (title, w) in waveforms() {
        let natural = RdmSpec { static_removal: StaticRemoval::SlowTimeMean, ..on_axes(AXES) };
        let ordinary = RdmSpec { physical_axes: None, ..natural };
        let (range_step_m, velocity_step_m_per_s) = ordinary.steps(&w);
        let shape = ordinary.shape(&w).expect("fits");
        let (range_bins, velocity_bins) = (shape.range, shape.doppler);
        let axes = PhysicalAxes { range_step_m, range_bins, velocity_step_m_per_s, velocity_bins };
        let natural = RdmSpec { physical_axes: Some(axes), ..natural };
        assert_eq!((natural.steps(&w), natural.shape(&w)), (ordinary.steps(&w), Ok(shape)));
        let frame = busy_frame(w.shape(), 2);
        let [got, expected] = [natural, ordinary].map(|spec| map_of(&spec, &w, &frame));
        let error = error_dbc(&got.db, &to_f64(&expected.db));
        assert!(error < -100.0, "{title}: {error} dBc");
    }
}

/// Within half a step of the truth: between two cells, receding and approaching.
#[test]
fn a_point_is_at_its_range_and_velocity_in_every_waveform() {
    for (title, w) in waveforms() {
        for (range_m, velocity) in [(2.42, 0.62), (3.3, -1.17), (1.58, 2.03)] {
            let frame = frame_of(w.shape(), 0, |_, m, n| 0.3 * echo(&w, range_m, velocity, m, n));
            let map = map_of(&on_axes(AXES), &w, &frame);
            assert_eq!((map.range_step_m, map.velocity_step_m_per_s), (0.15, 0.098));
            let (_, doppler, range) = map.peak().expect("finite");
            let (at_m, at_speed) = (map.range_m(range), map.velocity_m_per_s(doppler));
            assert!((at_m - range_m).abs() <= 0.5 * 0.15, "{title}: {at_m} m for {range_m} m");
            assert!((at_speed - velocity).abs() <= 0.5 * 0.098, "{title}: {at_speed} m/s for {velocity} m/s");
        }
    }
}

/// An echo of the same power over noise after the processing gain has the same sum over all cells, counted in resolution cells,
/// and the same peak.
#[test]
fn echoes_of_equal_power_over_noise_are_equal_in_all_waveforms() {
    let sigma = 0.02;
    for (title, w) in waveforms() {
        let coverage = AXES.coverage(&w);
        let (n, m) = (coverage.samples.len() as f64, coverage.chirps.len() as f64);
        // Noise of a cell is 4 sigma^2 1.5^2 / (n m) for Hann on both axes: 30 dB over it.
        let amplitude = (1000.0 * 9.0 * sigma * sigma / (n * m)).sqrt();
        let mut random = Random(11);
        let mut processor = RdmProcessor::new(&on_axes(AXES), &w).expect("spec fits");
        // On a cell: between cells the window's own shape would count.
        let (range, doppler) = (16, 40);
        let (range_m, velocity) = (0.15 * range as f64, 0.098 * 8.0);
        let mut sums = [[0.0; 2]; 2];
        for (index, amplitude) in [0.0, amplitude].into_iter().enumerate() {
            for sequence in 0..8 {
                let frame = frame_of(w.shape(), sequence, |_, m, n| {
                    amplitude * echo(&w, range_m, velocity, m, n) + sigma * random.normal()
                });
                let map = last_map(&mut processor, std::slice::from_ref(&frame));
                // Bins 0 and 1 lose some noise with the mean of a chirp.
                let cells = coverage.velocity_bins.clone();
                sums[index][0] += cells
                    .flat_map(|d| (4..coverage.range_bins).map(move |r| (d, r)))
                    .map(|(d, r)| power(map.at(0, d, r)))
                    .sum::<f64>();
                sums[index][1] += power(map.at(0, doppler, range));
            }
        }
        let count = (coverage.velocity_bins.len() * (coverage.range_bins - 4)) as f64;
        let noise = sums[0][0] / 8.0 / count;
        // In units of resolution cells of a Hann window, of which a point fills 1.5 x 1.5.
        let cells = 2.25 * coverage.range_resolution_m / 0.15 * coverage.velocity_resolution_m_per_s / 0.098;
        let total_db = 10.0 * ((sums[1][0] - sums[0][0]) / noise / 8.0 / cells).log10();
        let peak_db = 10.0 * ((sums[1][1] / 8.0 - noise) / noise).log10();
        assert!((total_db - 30.0).abs() < 1.0, "{title}: {total_db} dB in all cells");
        assert!((peak_db - 30.0).abs() < 1.0, "{title}: {peak_db} dB at the peak");
    }
}

/// Cells that are not measured look like noise: their level and quartile are those of the same range bin, and frames differ.
#[test]
fn cells_that_are_not_measured_hold_noise() {
    for (antennas, quartile) in [(&[1u8][..], 0.287_682), (&[1, 2][..], 0.480_639), (&[1, 2, 3][..], 0.575_766)] {
        // 4.3 m and 1.6 m/s are measured of 9.6 m and 3.1 m/s.
        let w = realised(|w| {
            w.samples_per_chirp = 64;
            w.chirp_interval_s = 780e-6;
            w.end_frequency_hz = w.start_frequency_hz + 1.2e9;
            w.rx_antennas = RxMask::from_antennas(antennas).expect("receivers");
        });
        let coverage = AXES.coverage(&w);
        assert!(coverage.range_bins < 40 && coverage.velocity_bins.len() < 40, "{coverage:?}");
        let mut random = Random(3);
        let mut processor = RdmProcessor::new(&on_axes(AXES), &w).expect("spec fits");
        let (mut inside, mut outside) = (Vec::new(), Vec::new());
        let mut maps = Vec::new();
        for sequence in 0..40 {
            let frame = frame_of(w.shape(), sequence, |_, _, _| 0.02 * random.normal());
            let map = last_map(&mut processor, std::slice::from_ref(&frame));
            for (index, db) in map.db.iter().enumerate() {
                let (d, r) = (index / 64, index % 64);
                if r < 4 {
                    continue;
                }
                let is_measured = coverage.velocity_bins.contains(&d) && r < coverage.range_bins;
                let cells = if is_measured { &mut inside } else { &mut outside };
                cells.push(power(*db));
            }
            maps.push(map);
        }
        for powers in [&mut inside, &mut outside] {
            powers.sort_unstable_by(f64::total_cmp);
        }
        let mean = |powers: &[f64]| powers.iter().sum::<f64>() / powers.len() as f64;
        let level_db = 10.0 * (mean(&outside) / mean(&inside)).log10();
        assert!(level_db.abs() < 1.0, "{} receivers: {level_db} dB", antennas.len());
        let ratio = outside[outside.len() / 4] / mean(&outside);
        assert!((ratio / quartile - 1.0f64).abs() < 0.15, "{} receivers: {ratio} for {quartile}", antennas.len());
        // Cells that are not measured differ from frame to frame. The same frame gives the same map.
        assert!(maps.windows(2).all(|pair| pair[0].at(0, 3, 60) != pair[1].at(0, 3, 60)));
        let frame = frame_of(w.shape(), 7, |_, m, n| ((m * 31 + n * 17) % 13) as f64 * 0.01);
        let twice = [0, 1].map(|_| last_map(&mut processor, std::slice::from_ref(&frame)).db);
        assert_eq!(twice[0], twice[1]);
    }
}

/// Up to the greatest range, a map is the same as without one. Cells beyond it show no echo and hold noise.
#[test]
fn echoes_beyond_the_greatest_range_do_not_show() {
    for (title, w) in waveforms() {
        let whole = RdmSpec { change_over_s: Some(0.3), ..on_axes(AXES) };
        for (max_range_m, bins) in [(1.5, 11), (1.64, 11), (0.01, 1), (1e300, AXES.coverage(&w).range_bins)] {
            let spec = RdmSpec { max_range_m: Some(max_range_m), ..whole };
            let coverage = spec.coverage(&w).expect("physical axes");
            assert_eq!(coverage.range_bins, bins, "{title}, {max_range_m} m");
            let mut random = Random(5);
            let mut frame = |sequence| {
                frame_of(w.shape(), sequence, |_, m, n| {
                    0.2 * echo(&w, 0.9, 0.3, m, n) + 0.4 * echo(&w, 2.6, -0.7, m, n) + 0.01 * random.normal()
                })
            };
            let frames: Vec<Frame> = (0..3).map(&mut frame).collect();
            let map_by = |spec: &RdmSpec| last_map(&mut RdmProcessor::new(spec, &w).expect("spec fits"), &frames);
            let (map, unlimited) = (map_by(&spec), map_by(&whole));
            for (cell, (db, unlimited_db)) in map.db.iter().zip(&unlimited.db).enumerate() {
                let (d, r) = (cell / AXES.range_bins, cell % AXES.range_bins);
                if r < bins && coverage.velocity_bins.contains(&d) {
                    assert_eq!(db, unlimited_db, "{title}, {max_range_m} m");
                }
            }
            let expected = reference::map(&spec, &w, &frames).expect("spec fits");
            assert!(measured_error_dbc(&map, &expected, &coverage) < -100.0, "{title}, {max_range_m} m");
            if max_range_m == 1.5 {
                let strongest = |map: &Rdm, bins: std::ops::Range<usize>| {
                    let cells = (0..AXES.velocity_bins).flat_map(|d| bins.clone().map(move |r| (d, r)));
                    cells.map(|(d, r)| map.at(0, d, r)).fold(f32::MIN, f32::max)
                };
                assert!(strongest(&unlimited, 12..64) > strongest(&unlimited, 0..11), "{title}");
                assert!(strongest(&map, 12..64) < strongest(&map, 0..11) - 10.0, "{title}");
            }
        }
    }
}

#[test]
fn a_dead_receiver_is_left_out() {
    let w = realised(|w| w.rx_antennas = RxMask::ALL);
    let two = realised(|w| w.rx_antennas = RxMask::from_antennas(&[1, 3]).expect("receivers"));
    let sample = |rx: usize, m: usize, n: usize| 0.1 * echo(&w, 2.0 + 0.1 * rx as f64, 0.4, m, n);
    let alive = frame_of(two.shape(), 0, |rx, m, n| sample(2 * rx, m, n));
    let expected = to_f64(&map_of(&on_axes(AXES), &two, &alive).db);
    let mut processor = RdmProcessor::new(&on_axes(AXES), &w).expect("spec fits");
    // Constant, and at the ends of the ADC most of the time.
    let kinds: [fn(usize) -> f64; 2] =
        [|_| 0.3, |n| if n.is_multiple_of(3) { 0.1 } else { 1.0 - 2.0 * (n % 2) as f64 }];
    for dead in kinds {
        let frame = frame_of(w.shape(), 0, |rx, m, n| if rx == 1 { dead(n) } else { sample(rx, m, n) });
        let map = last_map(&mut processor, std::slice::from_ref(&frame));
        assert!(error_dbc(&map.db, &expected) < -100.0);
        let reference = reference::map(&on_axes(AXES), &w, std::slice::from_ref(&frame)).expect("spec fits");
        assert!(measured_error_dbc(&map, &reference, &AXES.coverage(&w)) < -100.0);
    }
    // All of them: the map is finite and empty.
    let frame = frame_of(w.shape(), 1, |_, _, _| 0.3);
    let map = last_map(&mut processor, &[frame]);
    assert!(map.db.iter().all(|db| db.is_finite() && *db < -100.0));
}

/// Noise that fills the range of the ADC does not exclude a receiver from the mean.
#[test]
fn a_receiver_with_strong_noise_stays_in_the_mean() {
    let w = realised(|w| w.rx_antennas = RxMask::ALL);
    let received = frame_of(w.shape(), 0, |rx, m, n| 0.1 * echo(&w, 2.0 + 0.1 * rx as f64, 0.4, m, n));
    let peak = |map: &Rdm| map.db.iter().copied().fold(f32::MIN, f32::max);
    let spec = on_axes(AXES);
    let mut processor = RdmProcessor::new(&spec, &w).expect("spec fits");
    let clean_db = peak(&last_map(&mut processor, std::slice::from_ref(&received)));
    // The third receiver's samples, 40 dB stronger.
    let (factor, offset) = spec.scale.affine();
    let third = 2 * w.shape().chirps * w.shape().samples;
    let gain = |index: usize| if index < third { 1.0 } else { 100.0 };
    let sample = |(index, code): (usize, &u16)| gain(index) * (f64::from(*code) * factor + offset);
    let samples: Vec<f64> = received.codes.iter().enumerate().map(sample).collect();
    let mut map = processor.empty_map();
    let as_f32: Vec<f32> = samples.iter().map(|x| *x as f32).collect();
    processor.process_changed_samples(&received, &as_f32, &mut map).expect("fits");
    assert!(peak(&map) > clean_db + 30.0, "{} dB, {clean_db} dB", peak(&map));
    // Where the samples are codes again, they are cut off at 20 dB.
    let code = |x: &f64| ((x - offset) / factor).round().clamp(0.0, 4095.0) as u16;
    let changed = Frame { codes: samples.iter().map(code).collect(), ..received.clone() };
    assert!(changed.is_receiver_dead(2));
    processor.process_changed(&received, &changed, &mut map).expect("fits");
    assert!(peak(&map) > clean_db + 12.0, "{} dB, {clean_db} dB", peak(&map));
}

/// The first receiver that gives a signal replaces a receiver that gives none. Receivers with a signal are not replaced.
#[test]
fn a_dead_receiver_is_replaced_by_another() {
    let w = realised(|w| w.rx_antennas = RxMask::ALL);
    let spec = |channel: usize| RdmSpec { channels: Channels::One(channel), ..on_axes(AXES) };
    let sample = |rx: usize, m: usize, n: usize| 0.1 * echo(&w, 2.0 + 0.1 * rx as f64, 0.4, m, n);
    let map = |channel: usize, frame: &Frame| map_of(&spec(channel), &w, frame);
    let alive = frame_of(w.shape(), 0, sample);
    let dead = frame_of(w.shape(), 0, |rx, m, n| if rx == 0 { 0.3 } else { sample(rx, m, n) });
    assert_eq!(map(0, &dead).db, map(1, &alive).db);
    assert_eq!(map(2, &dead).db, map(2, &alive).db);
    // With changed samples, the frame as it was received decides which receiver is dead.
    let mut processor = RdmProcessor::new(&spec(0), &w).expect("spec fits");
    let (factor, offset) = spec(0).scale.affine();
    let samples: Vec<f32> = dead.codes.iter().map(|code| f32::from(*code) * factor as f32 + offset as f32).collect();
    let mut of_samples = processor.empty_map();
    processor.process_changed_samples(&dead, &samples, &mut of_samples).expect("fits");
    assert_eq!(of_samples.db, map(0, &dead).db);
    let reference = reference::map(&spec(0), &w, std::slice::from_ref(&dead)).expect("spec fits");
    assert!(measured_error_dbc(&map(0, &dead), &reference, &AXES.coverage(&w)) < -100.0);
    // All of them: the map is finite and empty.
    let frame = frame_of(w.shape(), 0, |_, _, _| 0.3);
    assert!(map(0, &frame).db.iter().all(|db| db.is_finite() && *db < -100.0));
}

#[test]
fn a_finer_frame_is_used_in_part() {
    let all = waveforms();
    let coverage = |title: &str| {
        let (_, w) = all.iter().find(|(name, _)| *name == title).expect("a waveform");
        AXES.coverage(w)
    };
    let long = coverage("512 chirps");
    assert!((60..70).contains(&long.chirps.len()) && long.samples.len() == 128, "{long:?}");
    assert!(long.velocity_resolution_m_per_s <= 0.098, "{long:?}");
    assert!(((long.chirps.start + long.chirps.end) / 2).abs_diff(256) <= 1, "{long:?}");
    let short = coverage("64 x 8");
    assert!(short.chirps == (0..8) && short.samples == (0..64), "{short:?}");
    assert_eq!(coverage("1 GHz, 128 x 64").velocity_bins, 0..64);
    let slower = coverage("2 % slower").velocity_bins;
    assert!(slower.start > 0 && slower.end < 65 && slower.contains(&32), "{slower:?}");
}

#[test]
fn frames_beyond_the_limits_are_refused_by_quantity() {
    let nominal = realised(|_| ());
    let spec = on_axes(AXES);
    for (w, quantity, needed) in [
        (realised(|w| w.end_frequency_hz = w.start_frequency_hz + 0.25e9), "sampled band", "0.300 GHz or more"),
        (realised(|w| w.samples_per_chirp = LEAST_SAMPLES - 1), "samples of a chirp", "32 to"),
        (realised(|w| w.chirps_per_frame = LEAST_CHIRPS - 1), "chirps of a frame", "8 to"),
    ] {
        let error = RdmProcessor::new(&spec, &w).err().expect("refused");
        assert!(matches!(error, SpecError::Waveform { .. }), "{error}");
        let text = error.to_string();
        assert!(text.contains(quantity) && text.contains(needed) && text.contains("\n\nhint: "), "{text}");
        assert_eq!(spec.check_compatible(&w, &nominal), Err(MapMismatch::Spec(error)));
    }
    assert!(waveforms().iter().all(|(_, w)| w.sampled_bandwidth_hz() > LEAST_SAMPLED_BAND_HZ));
    for (title, w) in waveforms() {
        assert_eq!(spec.check_compatible(&w, &nominal), Ok(()), "{title}");
    }
    // A map for each receiver has another shape with other receivers.
    let each = RdmSpec { channels: Channels::All, ..spec };
    let all = realised(|w| w.rx_antennas = RxMask::ALL);
    assert!(matches!(each.check_compatible(&all, &nominal), Err(MapMismatch::Waveform(_))));
    // Without physical axes, waveforms themselves are compared.
    let ordinary = RdmSpec { physical_axes: None, ..spec };
    let short = realised(|w| w.chirps_per_frame = 16);
    assert!(matches!(ordinary.check_compatible(&short, &nominal), Err(MapMismatch::Waveform(_))));
}

#[test]
fn invalid_axes_are_refused_by_key() {
    let w = realised(|_| ());
    for (axes, key) in [
        (PhysicalAxes { range_step_m: 0.0, ..AXES }, "range_step_m"),
        (PhysicalAxes { range_step_m: f64::NAN, ..AXES }, "range_step_m"),
        (PhysicalAxes { velocity_step_m_per_s: f64::INFINITY, ..AXES }, "velocity_step_m_per_s"),
        (PhysicalAxes { range_bins: 1, ..AXES }, "range_bins"),
        (PhysicalAxes { velocity_bins: 1 << 40, ..AXES }, "velocity_bins"),
    ] {
        let error = on_axes(axes).shape(&w).expect_err("refused").to_string();
        assert!(error.contains(key), "{error}");
    }
    for range_m in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        let spec = RdmSpec { max_range_m: Some(range_m), ..on_axes(AXES) };
        assert!(matches!(spec.shape(&w), Err(SpecError::MaxRange { .. })), "{range_m}");
    }
    let spec = RdmSpec { max_range_m: Some(1.0), physical_axes: None, ..on_axes(AXES) };
    assert!(matches!(spec.shape(&w), Err(SpecError::MaxRangeWithoutAxes)));
    for spec in [
        RdmSpec { range_fft_length: Some(256), ..on_axes(AXES) },
        RdmSpec { doppler_fft_length: Some(64), ..on_axes(AXES) },
        RdmSpec { slow_time: SlowTime::Frames { frames: 16 }, ..on_axes(AXES) },
    ] {
        assert!(matches!(spec.shape(&w), Err(SpecError::AxesExclude { .. })), "{spec:?}");
    }
    // Steps that leave one cell, or hardly any samples to resolve.
    let coarse = PhysicalAxes { range_step_m: 1e6, velocity_step_m_per_s: 1e6, range_bins: 2, velocity_bins: 3 };
    let fine = PhysicalAxes { range_step_m: 1e-9, velocity_step_m_per_s: 1e-9, range_bins: 7, velocity_bins: 7 };
    for axes in [coarse, fine] {
        let map = map_of(&on_axes(axes), &w, &busy_frame(w.shape(), 0));
        assert!(map.db.iter().all(|db| db.is_finite()), "{axes:?}");
    }
}

proptest::proptest! {
    #![proptest_config(proptest::prelude::ProptestConfig::with_cases(48))]
    #[test]
    fn any_valid_waveform_gives_finite_maps(
        band_hz in 0.4e9f64..5.9e9, samples in 32usize..300, chirps in 8usize..300, interval_s in 300e-6f64..3e-3,
        rx in 1usize..4, range_bins in 2usize..80, velocity_bins in 2usize..80,
        steps in (0.01f64..1.0, 0.005f64..1.0), seed in 0u64..1000, is_flat in proptest::prelude::any::<bool>(),
    ) {
        let w = realised(|w| {
            (w.start_frequency_hz, w.end_frequency_hz) = (57.5e9, 57.5e9 + band_hz);
            (w.samples_per_chirp, w.chirps_per_frame) = (samples, chirps);
            (w.chirp_interval_s, w.frame_interval_s) = (interval_s, 1.0);
            w.rx_antennas = RxMask::from_antennas(&[1, 2, 3][..rx]).expect("1 to 3");
        });
        let axes = PhysicalAxes {
            range_step_m: steps.0, range_bins, velocity_step_m_per_s: steps.1, velocity_bins,
        };
        let spec = RdmSpec { static_removal: StaticRemoval::SlowTimeMean, ..on_axes(axes) };
        let frame = if is_flat { frame_of(w.shape(), seed, |_, _, _| 0.1) } else { busy_frame(w.shape(), seed) };
        let map = map_of(&spec, &w, &frame);
        proptest::prop_assert_eq!(map.db.len(), range_bins * velocity_bins);
        proptest::prop_assert_eq!(map.flags.non_finite_cells, 0);
        proptest::prop_assert!(map.db.iter().all(|db| db.is_finite()));
    }
}
