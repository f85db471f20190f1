use std::f64::consts::TAU;

use super::*;
use crate::{Frame, FrameShape, KernelLevel, Window, noise_floor_db, split_mix_64};
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

/// Random numbers by SplitMix64, seeded.
struct Random(u64);
impl Random {
    fn next(&mut self) -> u64 {
        let drawn = split_mix_64(self.0);
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        drawn
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

/// Levels that this machine has.
fn levels() -> impl Iterator<Item = KernelLevel> {
    KernelLevel::ALL.into_iter().filter(|level| level.is_available())
}

/// A processor for each level that this machine has, and one that uses `realfft` for every size.
fn processors(spec: &RdmSpec, waveform: &Waveform) -> Vec<RdmProcessor> {
    let at = |level| RdmProcessor::with_kernel(spec, waveform, level).expect("spec fits");
    let mut realfft = at(KernelLevel::detect());
    realfft.use_realfft();
    levels().map(at).chain([realfft]).collect()
}

fn name(processor: &RdmProcessor) -> String {
    format!("{}, {} lanes", processor.kernel_level(), if processor.uses_lanes() { "with" } else { "without" })
}

fn last_map(processor: &mut RdmProcessor, frames: &[Frame]) -> Rdm {
    let mut map = processor.empty_map();
    let mut status = MapStatus::WarmingUp { have: 0, need: 1 };
    for frame in frames {
        status = processor.process(frame, &mut map).expect("frame fits");
    }
    assert_eq!(status, MapStatus::Ready);
    map
}

/// Map of one frame by a processor of its own.
fn map_of(spec: &RdmSpec, waveform: &Waveform, frame: &Frame) -> Rdm {
    last_map(&mut RdmProcessor::new(spec, waveform).expect("spec fits"), std::slice::from_ref(frame))
}

/// Map of samples in the spec's scale.
fn map_of_samples(processor: &mut RdmProcessor, samples: &[f32]) -> Rdm {
    let mut map = processor.empty_map();
    processor.process_samples(0, samples, &mut map).expect("length fits");
    map
}

fn to_f64(values: &[f32]) -> Vec<f64> {
    values.iter().map(|value| f64::from(*value)).collect()
}

/// Worst amplitude error of a cell against the strongest cell, dBc.
fn error_dbc(db: &[f32], expected: &[f64]) -> f64 {
    assert_eq!(db.len(), expected.len());
    let amplitude = |db: f64| 10f64.powf(db / 20.0);
    let peak = expected.iter().copied().map(amplitude).fold(0.0, f64::max);
    let errors = db.iter().zip(expected).map(|(got, e)| (amplitude(f64::from(*got)) - amplitude(*e)).abs());
    20.0 * (errors.fold(1e-12, f64::max) / peak).log10()
}

/// Worst error of all processors.
fn worst_error_dbc(spec: &RdmSpec, waveform: &Waveform, frames: &[Frame]) -> f64 {
    let expected = reference::map(spec, waveform, frames).expect("spec fits");
    let errors = processors(spec, waveform).into_iter().map(|mut p| error_dbc(&last_map(&mut p, frames).db, &expected));
    errors.fold(f64::NEG_INFINITY, f64::max)
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
        RdmSpec { range_fft_length: Some(128), doppler_fft_length: Some(64), ..base },
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

/// The vendor's examples double the whole range spectrum, also the mean of a chirp.
#[test]
fn a_constant_of_full_scale_reads_6_db_in_the_vendors_scale() {
    let w = waveform(1, 16, 32);
    let mut frame = Frame::zeroed(w.shape());
    frame.codes.fill(crate::MAX_CODE);
    for (amplitude, expected_db) in
        [(AmplitudeScale::Vendor, 20.0 * 2f64.log10()), (AmplitudeScale::FullScaleSine, 0.0)]
    {
        let spec = RdmSpec {
            scale: SampleScale::ZeroToOne,
            range_window: Window::Rectangular,
            doppler_window: Window::Rectangular,
            amplitude,
            ..RdmSpec::default()
        };
        let map = reference::map(&spec, &w, std::slice::from_ref(&frame)).expect("a map");
        let shape = spec.shape(&w).expect("valid");
        let at_dc = map[shape.doppler / 2 * shape.range];
        assert!((at_dc - expected_db).abs() < 1e-9, "{at_dc}");
    }
}

#[test]
fn a_dead_receiver_matters_where_the_map_needs_it() {
    let w = waveform(3, 16, 32);
    let spec = |channels| RdmSpec { channels, ..RdmSpec::default() };
    let axes = PhysicalAxes { range_step_m: 0.1, range_bins: 8, velocity_step_m_per_s: 0.1, velocity_bins: 8 };
    let axes = RdmSpec { physical_axes: Some(axes), ..spec(Channels::IncoherentSum) };
    let mut frame = busy_frame(w.shape(), 1);
    let have_signal = |frame: &Frame| {
        [spec(Channels::One(0)), spec(Channels::One(1)), spec(Channels::All), spec(Channels::IncoherentSum), axes]
            .map(|spec| spec.has_signal(frame))
    };
    assert_eq!(have_signal(&frame), [true; 5]);
    let length = frame.shape.chirps * frame.shape.samples;
    frame.codes[length..2 * length].fill(2048);
    assert_eq!(have_signal(&frame), [true, false, false, false, true]);
    frame.codes.fill(2048);
    assert_eq!(have_signal(&frame), [false; 5]);
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
    // More frames than the window, so that the ring buffer wraps.
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

    /// Sizes and padding of the lane transform, with and without removal.
    #[test]
    fn any_power_of_two_agrees_with_the_formula(
        log2_chirps in 4u32..7, log2_samples in 5u32..8, log2_padding in (0u32..3, 0u32..3), missing in 0usize..3,
        removes in proptest::prelude::any::<(bool, bool, bool)>(), seed in 0u64..1000,
    ) {
        let (fast_time, slow_time) = (1 << log2_samples, 1 << log2_chirps);
        // Frames need not be powers of two themselves if they are padded to one.
        let w = waveform(1 + seed as usize % 3, slow_time - 16 * (missing % (slow_time / 16)), fast_time);
        let spec = RdmSpec {
            range_fft_length: Some(fast_time << log2_padding.0),
            doppler_fft_length: Some(slow_time << log2_padding.1),
            chirp_mean_removal: removes.0,
            static_removal: if removes.1 { StaticRemoval::SlowTimeMean } else { StaticRemoval::None },
            channels: if removes.2 { Channels::IncoherentSum } else { Channels::All },
            ..RdmSpec::default()
        };
        for level in levels() {
            let processor = RdmProcessor::with_kernel(&spec, &w, level).expect("spec fits");
            proptest::prop_assert!(processor.uses_lanes(), "{level}");
        }
        let worst = worst_error_dbc(&spec, &w, &[busy_frame(w.shape(), seed)]);
        proptest::prop_assert!(worst < -105.0, "{worst} dBc");
    }
}

/// A frame of `WaveformRequest::paper` in the default spec: each level against the formula, and the levels against each other.
#[test]
fn every_level_is_within_minus_135_dbc_of_the_formula() {
    let w =
        Waveform::realise(WaveformRequest { rx_antennas: one_antenna(), ..WaveformRequest::paper() }).expect("valid");
    let frames = [busy_frame(w.shape(), 3)];
    let spec = RdmSpec::default();
    let expected = reference::map(&spec, &w, &frames).expect("spec fits");
    let mut maps: Vec<Vec<f32>> = Vec::new();
    for mut processor in processors(&spec, &w) {
        let map = last_map(&mut processor, &frames);
        let error = error_dbc(&map.db, &expected);
        assert!(error < -135.0, "{error} dBc {}", name(&processor));
        // A second run gives the same bits, whatever was processed before.
        processor.process(&busy_frame(w.shape(), 9), &mut processor.empty_map()).expect("frame fits");
        assert_eq!(last_map(&mut processor, &frames).db, map.db, "{}", name(&processor));
        maps.push(map.db);
    }
    for map in &maps[1..] {
        assert!(error_dbc(map, &to_f64(&maps[0])) < -132.0);
    }
}

fn one_antenna() -> RxMask {
    RxMask::from_antennas(&[1]).expect("exists")
}

/// Codes and their samples give the same map: the transform scales, removes means and pads in both.
#[test]
fn codes_and_samples_agree() {
    let w = waveform(2, 32, 64);
    let frame = busy_frame(w.shape(), 4);
    for scale in [SampleScale::FullScale, SampleScale::ZeroToOne, SampleScale::MinusOneToOne] {
        let spec = RdmSpec { scale, chirp_mean_removal: true, range_fft_length: Some(128), ..RdmSpec::default() };
        let (factor, offset) = scale.affine();
        let samples: Vec<f32> = frame.codes.iter().map(|c| (f64::from(*c) * factor + offset) as f32).collect();
        for mut processor in processors(&spec, &w) {
            let by_codes = last_map(&mut processor, std::slice::from_ref(&frame));
            let by_samples = map_of_samples(&mut processor, &samples);
            let error = error_dbc(&by_codes.db, &to_f64(&by_samples.db));
            assert!(error < -110.0, "{error} dBc {scale:?} {}", name(&processor));
        }
    }
}

#[test]
fn full_scale_sine_reads_zero_dbfs_and_its_bin_is_its_range() {
    let w = waveform(1, 16, 64);
    for mut processor in processors(&RdmSpec::default(), &w) {
        let frame = frame_of(w.shape(), 0, |_, _, n| (TAU * 9.0 * n as f64 / 64.0).cos() * 2047.0 / 2048.0);
        let map = last_map(&mut processor, &[frame]);
        assert_eq!(map.peak(), Some((0, 8, 9)), "{}", name(&processor));
        assert!(map.at(0, 8, 9).abs() < 0.02, "{} {}", map.at(0, 8, 9), name(&processor));
        // A constant of full scale reads 0 dBFS too: one-sided amplitudes count DC once.
        let frame = frame_of(w.shape(), 1, |_, _, _| -1.0);
        assert!(last_map(&mut processor, &[frame]).at(0, 8, 0).abs() < 1e-3, "{}", name(&processor));
    }
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
    for mut processor in processors(&RdmSpec::default(), &w) {
        let map = last_map(&mut processor, std::slice::from_ref(&frame));
        let (_, doppler, range) = map.peak().expect("finite");
        assert!((map.velocity_m_per_s(doppler) - velocity).abs() < 0.6 * map.velocity_step_m_per_s, "{doppler}");
        assert!((map.range_m(range) - range_m).abs() < 0.6 * map.range_step_m, "{range}");
    }
}

/// The level of exponentially distributed noise power has sigma 5.57 dB, and its mean lies 2.507 dB below the level of the mean.
#[test]
fn noise_has_the_exponential_law_and_the_floor_estimate_finds_its_power() {
    let w = waveform(1, 128, 256);
    let mut random = Random(5);
    let sigma = 0.02;
    let mut samples: Vec<f32> = Vec::new();
    samples.resize_with(w.shape().codes(), || (sigma * random.normal()) as f32);
    let map = map_of_samples(&mut RdmProcessor::new(&RdmSpec::default(), &w).expect("spec fits"), &samples);
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

mod change;
mod hard_cases;
mod motion;
mod physical;
