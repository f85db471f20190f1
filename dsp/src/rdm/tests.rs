use std::f64::consts::TAU;

use super::*;
use crate::{Frame, FrameShape, Window, noise_floor_db};
use crate::{RxMask, Waveform, WaveformRequest};

fn waveform(rx: usize, chirps: usize, samples: usize) -> Waveform {
    Waveform::realise(WaveformRequest {
        samples_per_chirp: samples,
        chirps_per_frame: chirps,
        rx_antennas: RxMask::from_antennas(&[1, 2, 3][..rx]).expect("1 to 3"),
        sample_rate_hz: 2e6,
        chirp_interval_s: 1e-3,
        frame_interval_s: 1.0,
        ..WaveformRequest::paper()
    })
    .expect("valid")
}

/// SplitMix64: enough randomness for tests, and seeded.
struct Random(u64);
impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }
    fn uniform(&mut self) -> f64 {
        (self.next() >> 11) as f64 / (1u64 << 53) as f64
    }
    fn normal(&mut self) -> f64 {
        (-2.0 * (1.0 - self.uniform()).ln()).sqrt() * (TAU * self.uniform()).cos()
    }
}

/// Codes from a function of (rx, chirp, sample) in full-scale units.
fn frame_of(shape: FrameShape, sequence: u64, mut value: impl FnMut(usize, usize, usize) -> f64) -> Frame {
    let mut frame = Frame { sequence, ..Frame::zeroed(shape) };
    let mut codes = frame.codes.iter_mut();
    for rx in 0..shape.rx {
        for chirp in 0..shape.chirps {
            for (sample, code) in (0..shape.samples).zip(&mut codes) {
                *code = (2048.0 + 2048.0 * value(rx, chirp, sample)).round().clamp(0.0, 4095.0) as u16;
            }
        }
    }
    frame
}

/// A scene with leakage, DC, targets that move both ways and noise.
fn busy_frame(shape: FrameShape, sequence: u64) -> Frame {
    let mut random = Random(sequence + 17);
    frame_of(shape, sequence, |rx, m, n| {
        let (m, n) = (m as f64 / shape.chirps as f64, n as f64 / shape.samples as f64);
        -0.2 + 0.05 * rx as f64
            + 0.4 * (TAU * 0.7 * n).cos()
            + 0.05 * (TAU * (5.3 * n + 3.2 * m) + sequence as f64).cos()
            + 0.01 * (TAU * (8.0 * n - 2.0 * m)).cos()
            + 0.001 * random.normal()
    })
}

/// Worst amplitude error of a cell against the strongest cell, dBc.
fn worst_error_dbc(spec: &RdmSpec, waveform: &Waveform, frames: &[Frame]) -> f64 {
    let mut processor = RdmProcessor::new(spec, waveform).expect("spec fits");
    let mut map = processor.empty_map();
    let mut status = MapStatus::WarmingUp { have: 0, need: 1 };
    for frame in frames {
        status = processor.process(frame, &mut map).expect("frame fits");
    }
    assert_eq!(status, MapStatus::Ready);
    let expected = reference::map(spec, waveform, frames).expect("spec fits");
    let amplitude = |db: f64| 10f64.powf(db / 20.0);
    let peak = expected.iter().copied().map(amplitude).fold(0.0, f64::max);
    let errors = map.db.iter().zip(&expected).map(|(got, e)| (amplitude(f64::from(*got)) - amplitude(*e)).abs());
    20.0 * (errors.fold(1e-12, f64::max) / peak).log10()
}

#[test]
fn every_option_agrees_with_the_formula_in_f64() {
    let w = waveform(3, 16, 32);
    let base = RdmSpec::default();
    let specs = [
        base,
        RdmSpec::paper(),
        RdmSpec::sdk(&w),
        RdmSpec { channels: Channels::One(2), chirp_mean_removal: true, ..base },
        RdmSpec { channels: Channels::IncoherentSum, static_removal: StaticRemoval::SlowTimeMean, ..base },
        RdmSpec { range_window: Window::BlackmanHarris, doppler_window: Window::Rectangular, ..base },
        RdmSpec { range_fft_length: Some(48), doppler_fft_length: Some(33), ..base },
        RdmSpec { scale: SampleScale::ZeroToOne, amplitude: AmplitudeScale::Vendor, ..base },
    ];
    for spec in specs {
        let frames: Vec<Frame> = (0..3).map(|s| busy_frame(w.shape(), s)).collect();
        let frames =
            if matches!(spec.static_removal, StaticRemoval::RecursiveMti { .. }) { &frames } else { &frames[2..] };
        let worst = worst_error_dbc(&spec, &w, frames);
        // Static removal lowers the peak by some 20 dB but not the rounding of what it removes.
        let bound = if spec.static_removal == StaticRemoval::None { -125.0 } else { -110.0 };
        assert!(worst < bound, "{worst} dBc in {spec:?}");
    }
}

#[test]
fn maps_over_frames_agree_with_the_formula_in_f64() {
    let w = waveform(2, 4, 32);
    let spec = RdmSpec {
        slow_time: SlowTime::Frames { frames: 12 },
        channels: Channels::IncoherentSum,
        static_removal: StaticRemoval::SlowTimeMean,
        ..RdmSpec::default()
    };
    // More frames than the window: the ring has turned.
    let frames: Vec<Frame> = (0..19).map(|s| busy_frame(w.shape(), s)).collect();
    let mut processor = RdmProcessor::new(&spec, &w).expect("spec fits");
    let mut map = processor.empty_map();
    for (i, frame) in frames.iter().enumerate() {
        let status = processor.process(frame, &mut map).expect("frame fits");
        let expected = if i < 11 { MapStatus::WarmingUp { have: i + 1, need: 12 } } else { MapStatus::Ready };
        assert_eq!(status, expected);
    }
    let expected = reference::map(&spec, &w, &frames[7..]).expect("spec fits");
    for (got, e) in map.db.iter().zip(&expected) {
        assert!((f64::from(*got) - e).abs() < 0.01 || *e < -90.0, "{got} against {e}");
    }
}

proptest::proptest! {
    #![proptest_config(proptest::prelude::ProptestConfig::with_cases(24))]
    #[test]
    fn any_size_agrees_with_the_formula(chirps in 2usize..20, samples in 8usize..40, rx in 1usize..4, seed in 0u64..1000) {
        let w = waveform(rx, chirps, samples);
        let frame = busy_frame(w.shape(), seed);
        let worst = worst_error_dbc(&RdmSpec::default(), &w, &[frame]);
        proptest::prop_assert!(worst < -125.0, "{worst} dBc");
    }
}

#[test]
fn full_scale_sine_reads_zero_dbfs_and_its_bin_is_its_range() {
    let w = waveform(1, 16, 64);
    let frame = frame_of(w.shape(), 0, |_, _, n| (TAU * 9.0 * n as f64 / 64.0).cos() * 2047.0 / 2048.0);
    let mut processor = RdmProcessor::new(&RdmSpec::default(), &w).expect("spec fits");
    let mut map = processor.empty_map();
    processor.process(&frame, &mut map).expect("frame fits");
    assert_eq!(map.peak(), Some((0, 8, 9)));
    assert!(map.at(0, 8, 9).abs() < 0.02, "{}", map.at(0, 8, 9));
    // A constant of full scale reads 0 dBFS too: one-sided amplitudes count DC once.
    let frame = frame_of(w.shape(), 1, |_, _, _| -1.0);
    processor.process(&frame, &mut map).expect("frame fits");
    assert!(map.at(0, 8, 0).abs() < 1e-3);
}

/// The convention of the crate page: a receding target raises the delay, the beat's phase rises from chirp to chirp.
#[test]
fn receding_target_has_positive_velocity() {
    let w = waveform(1, 32, 64);
    let (range_m, velocity) = (9.0 * w.range_resolution_m(), 6.0 * w.velocity_step_m_per_s(32));
    let frame = frame_of(w.shape(), 0, |_, m, n| {
        let time_s = m as f64 * w.chirp_interval_s;
        let t = n as f64 / w.sample_rate_hz;
        let tau = 2.0 * (range_m + velocity * time_s) / crate::SPEED_OF_LIGHT_M_PER_S;
        0.5 * (TAU
            * (w.sampled_start_frequency_hz * tau + w.slope_hz_per_s * tau * t - 0.5 * w.slope_hz_per_s * tau * tau))
            .cos()
    });
    let mut processor = RdmProcessor::new(&RdmSpec::default(), &w).expect("spec fits");
    let mut map = processor.empty_map();
    processor.process(&frame, &mut map).expect("frame fits");
    let (_, doppler, range) = map.peak().expect("finite");
    assert!((map.velocity_m_per_s(doppler) - velocity).abs() < 0.6 * map.velocity_step_m_per_s, "{doppler}");
    assert!((map.range_m(range) - range_m).abs() < 0.6 * map.range_step_m, "{range}");
}

/// sbr.md section 5.1: noise of any radar has sigma 5.57 dB, and its dB mean lies 2.507 dB below its mean.
#[test]
fn noise_has_the_exponential_law_and_the_floor_estimate_finds_its_power() {
    let w = waveform(1, 128, 256);
    let mut random = Random(5);
    let sigma = 0.02;
    let mut samples: Vec<f32> = Vec::new();
    samples.resize_with(w.shape().codes(), || (sigma * random.normal()) as f32);
    let mut processor = RdmProcessor::new(&RdmSpec::default(), &w).expect("spec fits");
    let mut map = processor.empty_map();
    processor.process_samples(0, &samples, &mut map).expect("length fits");
    let cells: Vec<f64> =
        (0..128).flat_map(|d| (2..127).map(move |r| (d, r))).map(|(d, r)| f64::from(map.at(0, d, r))).collect();
    let mean = cells.iter().sum::<f64>() / cells.len() as f64;
    let deviation = (cells.iter().map(|c| (c - mean).powi(2)).sum::<f64>() / cells.len() as f64).sqrt();
    assert!((deviation - 5.57).abs() < 0.1, "{deviation}");
    // Mean power of a cell: sigma^2 sum w^2 (2 / sum w)^2 = 4 sigma^2 1.5^2 / (N M) for Hann on both axes.
    let expected = 10.0 * (4.0 * sigma * sigma * 2.25 / (128.0 * 256.0)).log10();
    assert!((mean + 2.507 - expected).abs() < 0.1, "{mean} against {expected}");
    let floor = noise_floor_db(&map, 0, 2);
    let floor_mean = floor[2..127].iter().map(|f| f64::from(*f)).sum::<f64>() / 125.0;
    assert!((floor_mean - expected).abs() < 0.3, "{floor_mean} against {expected}");
}

mod hard_cases {
    use super::*;

    fn default_map(frame: &Frame, w: &Waveform, spec: RdmSpec) -> Rdm {
        let mut processor = RdmProcessor::new(&spec, w).expect("spec fits");
        let mut map = processor.empty_map();
        processor.process(frame, &mut map).expect("frame fits");
        map
    }

    #[test]
    fn all_zero_samples_read_the_floor_everywhere() {
        let w = waveform(2, 8, 16);
        let mut processor = RdmProcessor::new(&RdmSpec::default(), &w).expect("spec fits");
        let mut map = processor.empty_map();
        processor.process_samples(0, &vec![0.0; w.shape().codes()], &mut map).expect("length fits");
        assert!(map.db.iter().all(|v| (v + 200.0).abs() < 1e-3));
        assert_eq!(map.flags, MapFlags::default());
    }

    #[test]
    fn a_frame_of_zero_codes_is_flagged_as_saturated_throughout() {
        let w = waveform(2, 8, 16);
        let map = default_map(&Frame::zeroed(w.shape()), &w, RdmSpec::default());
        assert_eq!(map.flags.saturated_samples, 2 * 8 * 16);
        assert!(map.db.iter().all(|v| v.is_finite()));
    }

    #[test]
    fn saturation_is_counted_in_the_used_channels_only() {
        let w = waveform(2, 8, 16);
        let frame = frame_of(w.shape(), 0, |rx, _, n| if rx == 1 && n < 3 { 2.0 } else { 0.0 });
        assert_eq!(default_map(&frame, &w, RdmSpec::default()).flags.saturated_samples, 24);
        let first = RdmSpec { channels: Channels::One(0), ..RdmSpec::default() };
        assert_eq!(default_map(&frame, &w, first).flags.saturated_samples, 0);
    }

    #[test]
    fn one_not_a_number_stays_visible_and_is_flagged_in_its_channel() {
        let w = waveform(2, 8, 16);
        let mut samples = vec![0.25; w.shape().codes()];
        samples[3] = f32::NAN;
        let mut processor = RdmProcessor::new(&RdmSpec::default(), &w).expect("spec fits");
        let mut map = processor.empty_map();
        processor.process_samples(0, &samples, &mut map).expect("length fits");
        assert_eq!(map.flags.non_finite_cells as usize, map.shape.cells() / 2);
        assert!(map.db[..map.shape.cells() / 2].iter().all(|v| v.is_nan()));
        // It does not outlive its frame.
        samples[3] = 0.25;
        processor.process_samples(1, &samples, &mut map).expect("length fits");
        assert_eq!(map.flags.non_finite_cells, 0);
    }

    /// dsp.md section 2: in f32 a target 90 dB below DC is right to a few thousandths of a dB.
    #[test]
    fn target_ninety_decibels_below_dc_leakage_is_exact() {
        let w = waveform(1, 128, 256);
        let amplitude = 10f64.powf(-90.0 / 20.0);
        let samples: Vec<f32> = (0..128)
            .flat_map(|m| {
                (0..256).map(move |n| {
                    (1.0 + amplitude * (TAU * (40.0 * n as f64 / 256.0 + 20.0 * m as f64 / 128.0)).cos()) as f32
                })
            })
            .collect();
        let mut processor = RdmProcessor::new(&RdmSpec::default(), &w).expect("spec fits");
        let mut map = processor.empty_map();
        processor.process_samples(0, &samples, &mut map).expect("length fits");
        assert!((map.at(0, 64 + 20, 40) + 90.0).abs() < 0.02, "{}", map.at(0, 84, 40));
    }

    #[test]
    fn frame_of_another_shape_is_refused_and_names_both() {
        let w = waveform(1, 8, 16);
        let mut processor = RdmProcessor::new(&RdmSpec::default(), &w).expect("spec fits");
        let mut map = processor.empty_map();
        let frame = Frame::zeroed(FrameShape { rx: 1, chirps: 8, samples: 32 });
        let message = processor.process(&frame, &mut map).expect_err("shape").to_string();
        assert!(message.contains("16 samples") && message.contains("32 samples"), "{message}");
        let mut frame = Frame::zeroed(w.shape());
        frame.codes.pop();
        assert!(processor.process(&frame, &mut map).is_err());
    }

    #[test]
    fn a_gap_empties_the_window_of_frames() {
        let w = waveform(1, 4, 16);
        let spec = RdmSpec { slow_time: SlowTime::Frames { frames: 3 }, ..RdmSpec::default() };
        let mut processor = RdmProcessor::new(&spec, &w).expect("spec fits");
        let mut map = processor.empty_map();
        let mut status = |s| processor.process(&busy_frame(w.shape(), s), &mut map).expect("fits");
        assert_eq!(status(0), MapStatus::WarmingUp { have: 1, need: 3 });
        assert_eq!(status(1), MapStatus::WarmingUp { have: 2, need: 3 });
        assert_eq!(status(2), MapStatus::Ready);
        assert_eq!(status(4), MapStatus::WarmingUp { have: 1, need: 3 });
    }

    #[test]
    fn specs_that_cannot_be_are_refused() {
        let w = waveform(1, 8, 16);
        let base = RdmSpec::default();
        for bad in [
            RdmSpec { channels: Channels::One(1), ..base },
            RdmSpec { range_fft_length: Some(15), ..base },
            RdmSpec { slow_time: SlowTime::Frames { frames: 1 }, ..base },
            RdmSpec { static_removal: StaticRemoval::RecursiveMti { alpha: 0.0 }, ..base },
            RdmSpec { floor_db: f64::NAN, ..base },
        ] {
            assert!(RdmProcessor::new(&bad, &w).is_err(), "{bad:?}");
        }
    }
}
