use super::*;

#[test]
fn all_zero_samples_read_the_floor_everywhere() {
    let w = waveform(2, 16, 32);
    for mut processor in processors(&RdmSpec::default(), &w) {
        let map = map_of_samples(&mut processor, &vec![0.0; w.shape().codes()]);
        assert!(map.db.iter().all(|v| (v + 200.0).abs() < 1e-3), "{}", name(&processor));
        assert_eq!(map.flags, MapFlags::default());
    }
}

#[test]
fn a_frame_of_zero_codes_is_flagged_as_saturated_throughout() {
    let w = waveform(2, 16, 32);
    let map = map_of(&RdmSpec::default(), &w, &Frame::zeroed(w.shape()));
    assert_eq!(map.flags.saturated_samples, 2 * 16 * 32);
    assert!(map.db.iter().all(|v| v.is_finite()));
}

#[test]
fn saturation_is_counted_in_the_used_channels_only() {
    let w = waveform(2, 8, 16);
    let frame = frame_of(w.shape(), 0, |rx, _, n| if rx == 1 && n < 3 { 2.0 } else { 0.0 });
    assert_eq!(map_of(&RdmSpec::default(), &w, &frame).flags.saturated_samples, 24);
    let first = RdmSpec { channels: Channels::One(0), ..RdmSpec::default() };
    assert_eq!(map_of(&first, &w, &frame).flags.saturated_samples, 0);
}

#[test]
fn one_non_finite_sample_stays_visible_and_is_flagged_in_its_channel() {
    // Sizes of the lane transform, one of them padded, and other sizes.
    for (chirps, samples, padded) in [(16, 32, 32), (16, 32, 64), (8, 16, 16), (7, 30, 30)] {
        let w = waveform(2, chirps, samples);
        for channels in [Channels::All, Channels::IncoherentSum] {
            let spec = RdmSpec { range_fft_length: Some(padded), channels, ..RdmSpec::default() };
            for mut processor in processors(&spec, &w) {
                let mut map = processor.empty_map();
                // First, last and middle sample of the first channel; under a window's zero, too.
                for (at, bad) in [(0, f32::NAN), (chirps * samples - 1, f32::INFINITY), (3, -f32::INFINITY)] {
                    let mut x = vec![0.25; w.shape().codes()];
                    x[at] = bad;
                    processor.process_samples(0, &x, &mut map).expect("length fits");
                    let cells_of_channel = chirps * padded / 2;
                    assert_eq!(
                        map.flags.non_finite_cells as usize,
                        cells_of_channel,
                        "{bad} at {at}, {}",
                        name(&processor)
                    );
                    assert!(map.db[..cells_of_channel].iter().all(|v| !v.is_finite()));
                    // The value does not affect the next frame.
                    x[at] = 0.25;
                    processor.process_samples(1, &x, &mut map).expect("length fits");
                    assert_eq!(map.flags.non_finite_cells, 0, "{}", name(&processor));
                }
            }
        }
    }
}

/// Finite samples whose power is not: the cells that overflow are infinite and counted, the others stay.
#[test]
fn power_beyond_f32_is_infinite_and_counted() {
    let w = waveform(1, 16, 32);
    for mut processor in processors(&RdmSpec::default(), &w) {
        let map = map_of_samples(&mut processor, &vec![1e25; w.shape().codes()]);
        assert_eq!(map.at(0, 8, 0), f32::INFINITY);
        let infinite = map.db.iter().filter(|v| !v.is_finite()).count();
        assert_eq!(map.flags.non_finite_cells as usize, infinite, "{}", name(&processor));
        assert!(infinite < map.db.len());
    }
}

#[test]
fn codes_beyond_twelve_bits_are_counted_and_scaled() {
    let w = waveform(1, 16, 32);
    let frame = Frame { codes: vec![u16::MAX; w.shape().codes()], ..Frame::zeroed(w.shape()) };
    let expected = 20.0 * ((65535.0 - 2048.0) / 2048.0f64).log10();
    for mut processor in processors(&RdmSpec::default(), &w) {
        let map = last_map(&mut processor, std::slice::from_ref(&frame));
        assert_eq!(map.flags.saturated_samples as usize, w.shape().codes());
        assert!((f64::from(map.at(0, 8, 0)) - expected).abs() < 1e-3, "{}", name(&processor));
    }
}

#[test]
fn a_level_that_the_machine_lacks_is_refused_by_name() {
    let w = waveform(1, 8, 16);
    for level in KernelLevel::ALL.into_iter().filter(|level| !level.is_available()) {
        let error = RdmProcessor::with_kernel(&RdmSpec::default(), &w, level).err().expect("not here").to_string();
        assert!(error.contains(level.name()), "{error}");
    }
}

/// Sizes at and below the limits of the lane transform, on one axis or both.
#[test]
fn sizes_that_the_lane_transform_lacks_use_the_fourier_transform() {
    for (chirps, samples, lanes) in [(16, 32, true), (8, 32, false), (16, 16, false), (20, 32, false), (16, 48, false)]
    {
        let w = waveform(1, chirps, samples);
        let processor = RdmProcessor::new(&RdmSpec::default(), &w).expect("spec fits");
        assert_eq!(processor.uses_lanes(), lanes, "{chirps} x {samples}");
        assert!(worst_error_dbc(&RdmSpec::default(), &w, &[busy_frame(w.shape(), 1)]) < -120.0);
    }
}

/// In f32, a target 90 dB below DC is right to a few thousandths of a dB.
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
    for mut processor in processors(&RdmSpec::default(), &w) {
        let map = map_of_samples(&mut processor, &samples);
        assert!((map.at(0, 64 + 20, 40) + 90.0).abs() < 0.02, "{} {}", map.at(0, 84, 40), name(&processor));
    }
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
fn invalid_specs_are_refused() {
    let w = waveform(1, 8, 16);
    let base = RdmSpec::default();
    for bad in [
        RdmSpec { channels: Channels::One(1), ..base },
        RdmSpec { range_fft_length: Some(15), ..base },
        RdmSpec { slow_time: SlowTime::Frames { frames: 1 }, ..base },
        RdmSpec { static_removal: StaticRemoval::RecursiveMti { alpha: 0.0 }, ..base },
        RdmSpec { floor_db: f64::NAN, ..base },
        // Its power is infinite in f32.
        RdmSpec { floor_db: 400.0, ..base },
    ] {
        assert!(RdmProcessor::new(&bad, &w).is_err(), "{bad:?}");
    }
}
