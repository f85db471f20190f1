//! Features of maps and frames, compared with those measured on recordings.

use std::collections::BTreeMap;
use std::f64::consts::{PI, TAU};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use radome_dsp::spectrum::complex_fft;
use radome_dsp::{Frame, FrameSource, Occupancy, Window};
use radome_files::parse_toml;
use radome_models::dataset::{Dataset, Features, Spread, features};
use rustfft::num_complex::Complex64;
use serde::{Deserialize, Serialize};

use crate::files;
use crate::source::{self, SourceOptions};

/// Default file of measured features, for walking people.
const WALKING: &str = include_str!("../../../fixtures/features/walking.toml");
/// Ranges at which static clutter is searched for, m.
const CLUTTER_M: [f64; 2] = [1.8, 3.9];
/// Number of rooms that are examined if a scene draws its rooms, and number of frames of each.
const ROOMS: u64 = 24;
const FRAMES: u64 = 100;
/// Seed of the first room, far from the seeds of datasets.
const FIRST_SEED: u64 = 500_001;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct MeasuredFile {
    feature: Vec<Measured>,
}

/// Measured range of one feature.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Measured {
    key: String,
    /// Name of the feature, with its unit.
    pub name: String,
    /// Least and greatest value over recordings.
    pub measured: [f64; 2],
    /// Tolerance of the median beyond that range, in its unit.
    #[serde(default)]
    within: f64,
    /// Tolerance as a ratio of amplitudes, dB.
    #[serde(default)]
    within_db: f64,
}

/// Feature of a dataset with its measured range.
#[derive(Serialize)]
pub struct Row {
    #[serde(flatten)]
    pub measured: Measured,
    /// Median over maps; `None` where no map shows the feature.
    pub found: Option<f64>,
    /// Quantiles of 10 % and 90 % over maps, for features of maps.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub spread: Option<[f64; 2]>,
    /// Whether the median agrees with the measured range.
    pub holds: Option<bool>,
}

/// Compares the maps with these indices, and the frames of `sources`, with a file of measured features; `None` is the
/// built-in file of walking people.
///
/// # Errors
/// The file or a source cannot be read, or no range bin lies where clutter is looked for.
pub fn compare(
    dataset: &Dataset,
    indices: &[usize],
    sources: &[String],
    measured: Option<&Path>,
) -> anyhow::Result<Vec<Row>> {
    let (text, path) = match measured {
        Some(path) => (files::read_text_file(path)?, path.to_owned()),
        None => (WALKING.to_owned(), PathBuf::from("fixtures/features/walking.toml")),
    };
    let measured: MeasuredFile =
        parse_toml(&text).with_context(|| format!("{} is no file of measured features", path.display()))?;
    let mut found = map_features(&features(dataset, indices)?);
    found.extend(clutter_features(sources)?);
    let row = |measured: Measured| {
        let (found, spread) = found.get(&measured.key).copied().map_or((None, None), |(v, s)| (Some(v), s));
        let [least, most] = measured.measured;
        let ratio = 10f64.powf(0.05 * measured.within_db);
        let holds = found.map(|v| (least / ratio - measured.within..=most * ratio + measured.within).contains(&v));
        Row { measured, found, spread, holds }
    };
    Ok(measured.feature.into_iter().map(row).collect())
}

/// Median of each feature, and its spread where it has one.
type FeatureValues = BTreeMap<String, (f64, Option<[f64; 2]>)>;

fn map_features(features: &Features) -> FeatureValues {
    let noise = features.noise_lsb.iter().enumerate().map(|(bin, lsb)| (format!("noise_lsb.{bin}"), (*lsb, None)));
    let mut found: FeatureValues = noise.filter(|(_, (lsb, _))| lsb.is_finite()).collect();
    for of in &features.classes {
        let class = of.class.name();
        let spreads = [
            ("moving_energy_db", of.moving_energy_db),
            ("peak_db", of.peak_db),
            ("second_echo_db", of.second_echo_db),
            ("filled_bins", of.filled_bins),
            ("doppler_width_m_per_s", of.doppler_width_m_per_s),
            ("speed_m_per_s", of.speed_m_per_s),
        ];
        for (name, spread) in spreads {
            let Some(Spread { low, median, high }) = spread else { continue };
            found.insert(format!("{class}.{name}"), (median, Some([low, high])));
            found.insert(format!("{class}.{name}.high"), (high, None));
        }
        if let Some(share) = of.second_echo_share {
            found.insert(format!("{class}.second_echo_share"), (share, None));
        }
    }
    found
}

/// Features of static clutter, as medians over sources.
fn clutter_features(sources: &[String]) -> anyhow::Result<FeatureValues> {
    let mut values: BTreeMap<&str, Vec<f64>> = BTreeMap::new();
    for spec in sources {
        let seeds = if spec.ends_with(".toml") { ROOMS } else { 1 };
        for seed in FIRST_SEED..FIRST_SEED + seeds {
            let options = SourceOptions {
                seed,
                people: Some(Occupancy::Empty.index()),
                frames: Some(FRAMES),
                ..SourceOptions::default()
            };
            let mut source = source::open(spec, &options)?;
            let Some(clutter) = static_bin_features(source.frames.as_mut()).with_context(|| spec.clone())? else {
                continue;
            };
            for (name, value) in clutter {
                values.entry(name).or_default().push(value);
            }
        }
    }
    let spread = |values: Vec<f64>| Spread::of(values).map(|s| (s.median, Some([s.low, s.high])));
    Ok(values.into_iter().filter_map(|(name, values)| Some((format!("clutter.{name}"), spread(values)?))).collect())
}

/// Level, phase jitter and drift, and amplitude jitter of the strongest bin in [`CLUTTER_M`]; `None` for fewer than ten
/// frames.
fn static_bin_features(frames: &mut dyn FrameSource) -> anyhow::Result<Option<[(&'static str, f64); 4]>> {
    let waveform = frames.waveform().clone();
    let samples = waveform.request.samples_per_chirp;
    let step_m = waveform.range_step_m(samples);
    let bins: Vec<usize> =
        (0..samples / 2).filter(|bin| (CLUTTER_M[0]..=CLUTTER_M[1]).contains(&(*bin as f64 * step_m))).collect();
    if bins.is_empty() {
        bail!("no range bin lies at {} to {} m, where clutter is looked for", CLUTTER_M[0], CLUTTER_M[1]);
    }
    let window = Window::Hann.weights(samples);
    let gain = 2.0 / window.iter().sum::<f64>();
    let fft = complex_fft(samples);
    let mut frame = Frame::zeroed(waveform.shape());
    let (mut spectra, mut times_s) = (Vec::<Vec<Complex64>>::new(), Vec::new());
    while source::next_frame(frames, &mut frame)? {
        let mut mean = vec![Complex64::default(); samples];
        let chirps = waveform.request.chirps_per_frame;
        for chirp in 0..chirps {
            for (sum, code) in mean.iter_mut().zip(frame.chirp(0, chirp)) {
                *sum += f64::from(*code) / chirps as f64;
            }
        }
        let offset = mean.iter().sum::<Complex64>() / samples as f64;
        mean.iter_mut().zip(&window).for_each(|(x, w)| *x = (*x - offset) * *w * gain);
        fft.process(&mut mean);
        spectra.push(bins.iter().filter_map(|bin| mean.get(*bin).copied()).collect());
        times_s.push(frame.time_s());
    }
    if spectra.len() < 10 {
        return Ok(None);
    }
    let count = spectra.len() as f64;
    let level = |k: usize| spectra.iter().filter_map(|s| s.get(k)).map(|c| c.norm()).sum::<f64>() / count;
    let strongest = (0..bins.len()).max_by(|a, b| level(*a).total_cmp(&level(*b))).unwrap_or(0);
    let series: Vec<Complex64> = spectra.iter().filter_map(|s| s.get(strongest).copied()).collect();
    let mut phase = Vec::with_capacity(series.len());
    let mut last = 0.0;
    for c in &series {
        last += (c.arg() - last + PI).rem_euclid(TAU) - PI;
        phase.push(last);
    }
    let steps: Vec<f64> = phase.windows(2).map(|pair| pair[1] - pair[0]).collect();
    let level_lsb = level(strongest);
    let variance = series.iter().map(|c| (c.norm() - level_lsb).powi(2)).sum::<f64>() / count;
    Ok(Some([
        ("level_lsb", level_lsb),
        ("phase_jitter_rad", deviation(&steps)),
        ("drift_rad", 10.0 * slope(&times_s, &phase).abs()),
        ("amplitude_jitter", variance.sqrt() / level_lsb),
    ]))
}

fn deviation(values: &[f64]) -> f64 {
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / values.len() as f64).sqrt()
}

/// Slope of the least-squares line.
fn slope(x: &[f64], y: &[f64]) -> f64 {
    let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len() as f64;
    let (mx, my) = (mean(x), mean(y));
    let covariance: f64 = x.iter().zip(y).map(|(x, y)| (x - mx) * (y - my)).sum();
    let variance: f64 = x.iter().map(|x| (x - mx).powi(2)).sum();
    if variance > 0.0 { covariance / variance } else { 0.0 }
}
