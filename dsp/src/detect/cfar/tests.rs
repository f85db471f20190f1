use super::*;
use crate::{MapFlags, RdmShape, split_mix_64};

/// Uniform numbers in (0, 1).
struct Draw(u64);

impl Draw {
    fn next(&mut self) -> f64 {
        let drawn = split_mix_64(self.0);
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        (drawn >> 11) as f64 / (1u64 << 53) as f64 + 1e-17
    }

    /// Power of complex Gaussian noise with mean one a look, summed over looks.
    fn power(&mut self, looks: usize) -> f64 {
        (0..looks).map(|_| -self.next().ln()).sum()
    }
}

fn spec(guard: (usize, usize), training: (usize, usize), false_alarm_rate: f64, looks: usize) -> CfarSpec {
    let reach = |(doppler, range)| CellReach { doppler, range };
    CfarSpec { rank: 0.75, guard: reach(guard), training: reach(training), false_alarm_rate, looks }
}

/// Threshold by the definition: collect the whole window, sort, take the ranked cell.
fn reference(spec: &CfarSpec, power: &[f64], (rows, columns): (usize, usize), doppler: usize, range: usize) -> f64 {
    let reach = |guard: usize, training: usize| (guard + training) as i64;
    let (doppler_reach, range_reach) =
        (reach(spec.guard.doppler, spec.training.doppler), reach(spec.guard.range, spec.training.range));
    let mut cells = Vec::new();
    for d in -doppler_reach..=doppler_reach {
        for r in -range_reach..=range_reach {
            let is_guard =
                d.unsigned_abs() as usize <= spec.guard.doppler && r.unsigned_abs() as usize <= spec.guard.range;
            let at = range as i64 + r;
            if !is_guard && (0..columns as i64).contains(&at) {
                let row = (doppler as i64 + d).rem_euclid(rows as i64) as usize;
                cells.push(power[row * columns + at as usize]);
            }
        }
    }
    cells.sort_unstable_by(f64::total_cmp);
    let order = (spec.rank * cells.len() as f64).ceil() as usize;
    ordered_factor(cells.len(), order, spec.looks, spec.false_alarm_rate) * cells[order - 1]
}

#[test]
fn thresholds_are_those_of_the_definition_everywhere() {
    let mut draw = Draw(1);
    let (rows, columns) = (12, 20);
    let mut power: Vec<f64> = (0..rows * columns).map(|_| draw.power(1)).collect();
    power[5 * columns + 3] = 1e12;
    for (guard, training) in [((1, 2), (2, 3)), ((0, 0), (0, 4)), ((0, 1), (5, 0)), ((2, 0), (0, 1)), ((0, 0), (1, 1))]
    {
        let spec = spec(guard, training, 1e-3, 1);
        let cfar = Cfar::new(spec, rows, columns).expect("fits");
        let fast = cfar.thresholds(&power).expect("as many");
        for (index, fast) in fast.iter().enumerate() {
            let slow = reference(&spec, &power, (rows, columns), index / columns, index % columns);
            assert!((fast / slow - 1.0).abs() < 1e-12, "{guard:?} {training:?} {index}: {fast} {slow}");
        }
    }
}

/// Closed forms against the rates that they are derived from.
#[test]
fn factors_give_their_rates() {
    let rate: f64 =
        (0..10).map(|i| f64::from(16 - i) / (f64::from(16 - i) + ordered_factor(16, 10, 1, 1e-4))).product();
    assert!((rate / 1e-4 - 1.0).abs() < 1e-9);
    for (cells, order, rate) in [(16, 12, 1e-2), (40, 30, 1e-4), (100, 75, 1e-6), (3, 1, 0.1)] {
        // For one look, the integral equals the product.
        let (product, integral) =
            (ordered_factor(cells, order, 1, rate), ordered_factor_by_integral(cells, order, 1, rate));
        assert!((integral / product - 1.0).abs() < 1e-5, "{cells} {order}: {integral} {product}");
        assert!(ordered_factor(cells, order, 2, rate) < product, "two looks spread less");
    }
}

/// Independent draws of one window, its middle or its edge as the cell under test.
fn measured_rate(spec: CfarSpec, cell: usize, columns: usize, trials: usize, seed: u64) -> f64 {
    let cfar = Cfar::new(spec, 1, columns).expect("fits");
    let mut draw = Draw(seed);
    let mut alarms = 0;
    for _ in 0..trials {
        // The level of the noise does not matter.
        let level = 10f64.powf(10.0 * draw.next() - 5.0);
        let power: Vec<f64> = (0..columns).map(|_| level * draw.power(spec.looks)).collect();
        alarms += usize::from(power[cell] > cfar.thresholds(&power).expect("as many")[cell]);
    }
    alarms as f64 / trials as f64
}

#[test]
fn noise_alone_alarms_at_the_stated_rate_in_the_middle_and_at_the_edge() {
    let trials = 100_000;
    // Seed of the draws, receivers, rate.
    for (seed, looks, rate) in [(1, 1, 1e-2), (3, 3, 1e-2), (5, 2, 1e-1)] {
        let spec = spec((0, 1), (0, 8), rate, looks);
        for cell in [9, 0, 3] {
            let measured = measured_rate(spec, cell, 19, trials, seed);
            let sigma = (rate * (1.0 - rate) / trials as f64).sqrt();
            assert!((measured - rate).abs() < 4.5 * sigma, "{looks} looks, cell {cell}: {measured}, asked {rate}");
        }
    }
}

fn map(rows: usize, columns: usize, power: &[f64]) -> Rdm {
    Rdm {
        shape: RdmShape { rx: 1, doppler: rows, range: columns },
        db: power.iter().map(|p| (10.0 * p.log10()) as f32).collect(),
        range_step_m: 0.2,
        velocity_step_m_per_s: 0.04,
        sequence: 0,
        flags: MapFlags::default(),
        motion: None,
    }
}

#[test]
fn targets_are_found_at_their_cells_also_at_the_ends_of_doppler() {
    let (rows, columns) = (64, 64);
    let mut draw = Draw(3);
    let mut power: Vec<f64> = (0..rows * columns).map(|_| draw.power(1)).collect();
    for (doppler, range) in [(20, 30), (0, 40), (63, 0)] {
        power[doppler * columns + range] = 200.0;
    }
    let cfar = Cfar::new(spec((1, 1), (4, 4), 1e-6, 1), rows, columns).expect("fits");
    let found: Vec<(usize, usize)> =
        cfar.detect(&map(rows, columns, &power), 0).iter().map(|d| (d.doppler, d.range)).collect();
    assert_eq!(found, [(0, 40), (20, 30), (63, 0)]);
}

/// The preselection of candidates loses no detection and adds none, at a rate at which many cells are detections.
#[test]
fn detections_are_the_cells_above_their_thresholds() {
    let (rows, columns) = (24, 40);
    let mut draw = Draw(17);
    let cfar = Cfar::new(spec((1, 2), (2, 3), 0.05, 2), rows, columns).expect("valid");
    let mut power: Vec<f64> = (0..rows * columns).map(|_| draw.power(2)).collect();
    power[5 * columns + 7] = 1e3;
    power[5 * columns + 8] = 900.0;
    // With the precision of a map.
    let map = map(rows, columns, &power);
    let power: Vec<f64> = map.db.iter().map(|&db| 10f64.powf(f64::from(db) / 10.0)).collect();
    let thresholds = cfar.thresholds(&power).expect("of this size");
    let expected: Vec<usize> = (0..power.len()).filter(|&i| power[i] > thresholds[i]).collect();
    let found = cfar.detect(&map, 0);
    assert!(expected.len() > 20);
    assert_eq!(found.iter().map(|d| d.doppler * columns + d.range).collect::<Vec<_>>(), expected);
    for d in found {
        let threshold = 10.0 * thresholds[d.doppler * columns + d.range].log10();
        assert!((f64::from(d.threshold_db) - threshold).abs() < 1e-5 * threshold.abs().max(1.0));
    }
}

#[test]
fn a_stronger_neighbour_does_not_mask_a_target() {
    let (rows, columns) = (32, 64);
    let mut draw = Draw(4);
    let mut power: Vec<f64> = (0..rows * columns).map(|_| draw.power(1)).collect();
    // 17 dB over noise, and 37 dB five bins further on: among its training cells.
    power[16 * columns + 30] = 50.0;
    power[16 * columns + 35] = 5000.0;
    let cfar = Cfar::new(spec((1, 2), (3, 6), 1e-5, 1), rows, columns).expect("fits");
    let found: Vec<usize> = cfar.detect(&map(rows, columns, &power), 0).iter().map(|d| d.range).collect();
    assert_eq!(found, [30, 35]);
}

/// Maps of white samples with Hann windows on both axes, whose cells are not independent.
#[test]
fn hann_windows_raise_the_rate_less_than_twofold() {
    use crate::{Frame, RdmProcessor, RdmSpec, Waveform, WaveformRequest};
    let request = WaveformRequest { samples_per_chirp: 128, chirps_per_frame: 64, ..WaveformRequest::paper() };
    let waveform = Waveform::realise(request).expect("waveform");
    let mut processor =
        RdmProcessor::new(&RdmSpec { floor_db: -300.0, ..RdmSpec::paper() }, &waveform).expect("processor");
    let (mut frame, mut out) = (Frame::zeroed(waveform.shape()), processor.empty_map());
    let mut draw = Draw(5);
    let cfar = Cfar::new(spec((2, 2), (4, 6), 1e-3, 1), 64, 64).expect("fits");
    let (mut alarms, mut cells) = (0, 0);
    for _ in 0..60 {
        frame.codes.iter_mut().for_each(|code| {
            let gauss: f64 = (0..12).map(|_| draw.next()).sum::<f64>() - 6.0;
            *code = (2048.0 + 30.0 * gauss).round() as u16;
        });
        processor.process(&frame, &mut out).expect("processes");
        // Zero Doppler is removed, and zero range is real.
        let free = |d: &CellDetection| d.doppler.abs_diff(32) > 8 && d.range > 8;
        alarms += cfar.detect(&out, 0).iter().filter(|d| free(d)).count();
        cells += (64 - 17) * (64 - 9);
    }
    let rate = alarms as f64 / cells as f64;
    assert!(rate > 0.8e-3 && rate < 2e-3, "{rate}");
}

mod hard_cases {
    use super::*;

    #[test]
    fn windows_that_do_not_fit_and_invalid_rates_are_refused() {
        let new = |spec| Cfar::new(spec, 16, 16).map(|_| ()).expect_err("refused");
        assert!(matches!(new(spec((1, 1), (7, 1), 1e-3, 1)), CfarError::TooWide { doppler: 17, .. }));
        assert!(matches!(new(spec((0, 16), (0, 1), 1e-3, 1)), CfarError::TooWide { .. }));
        assert!(matches!(new(spec((1, 1), (0, 0), 1e-3, 1)), CfarError::NoTraining { .. }));
        assert!(matches!(new(spec((usize::MAX, 1), (1, 1), 1e-3, 1)), CfarError::TooWide { .. }));
        for rate in [0.0, 1.0, f64::NAN, -1.0] {
            assert!(matches!(new(spec((1, 1), (1, 1), rate, 1)), CfarError::Rate { .. }));
        }
        assert!(matches!(new(spec((1, 1), (1, 1), 1e-3, 0)), CfarError::Looks { .. }));
        let zero = CfarSpec { rank: 0.0, ..spec((1, 1), (1, 1), 1e-3, 1) };
        assert!(matches!(new(zero), CfarError::Rank { .. }));
    }

    #[test]
    fn nan_silence_and_other_sizes_give_no_detection_and_no_panic() {
        let cfar = Cfar::new(spec((1, 1), (2, 2), 1e-3, 1), 16, 16).expect("fits");
        assert!(cfar.thresholds(&[1.0; 255]).is_none());
        let mut power = vec![1.0; 256];
        assert!(cfar.detect(&map(16, 16, &power), 0).is_empty(), "a flat map has no detections");
        power[40] = f64::NAN;
        assert!(cfar.detect(&map(16, 16, &power), 0).is_empty());
        assert!(cfar.detect(&map(16, 16, &vec![0.0; 256]), 0).is_empty());
        assert!(
            cfar.detect(&map(8, 16, &power[..128]), 0).is_empty() && cfar.detect(&map(16, 16, &power), 3).is_empty()
        );
    }
}
