//! Helpers shared by several tests.
#![allow(dead_code)]

use std::f64::consts::TAU;
use std::path::{Path, PathBuf};

use glam::{DMat3, DVec3};
use num_complex::Complex64;
use radome_dsp::Frame;
use radome_sim::em::image::Element;
use radome_sim::em::pattern::Pattern;
use radome_sim::{Scene, SimulateOptions, Simulator};

/// Wavenumber at 60 GHz, 1/m.
pub const WAVENUMBER: f64 = TAU * 60e9 / 299_792_458.0;
/// Tables for a scene without people and without objects beside the radar.
pub const NOBODY: &str = "[people.desk]\nmax_people = 0\nobjects_probability = 0.0\n";

pub fn fixtures() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../fixtures")
}

pub fn scene(name: &str) -> Scene {
    Scene::load(&fixture(name).0).expect("fixture scene")
}

/// Path and text of a fixture scene.
pub fn fixture(name: &str) -> (PathBuf, String) {
    let path = fixtures().join(format!("scenes/{name}.toml"));
    let text = std::fs::read_to_string(&path).expect("fixture scene");
    (path, text)
}

pub fn simulator(scene: &Scene, seed: u64, people: Option<usize>) -> Simulator {
    Simulator::new(scene, SimulateOptions { seed, people, ..SimulateOptions::default() }).expect("valid options")
}

/// Reference values computed elsewhere (mpmath, scipy).
pub fn reference() -> serde_json::Value {
    let text = std::fs::read_to_string(fixtures().join("solver/reference.json"))
        .expect("fixtures/solver/reference.json is part of the sources");
    serde_json::from_str(&text).expect("reference values are JSON")
}

pub fn reference_rows(table: &str) -> Vec<serde_json::Value> {
    reference()[table]["rows"].as_array().expect("rows").clone()
}

pub fn number(value: &serde_json::Value) -> f64 {
    value.as_f64().expect("number")
}

pub fn vector(value: &serde_json::Value) -> DVec3 {
    DVec3::from_array([0, 1, 2].map(|i| number(&value[i])))
}

/// Result of a closure that runs on this number of threads.
pub fn on_threads<T: Send>(threads: usize, run: impl FnOnce() -> T + Send) -> T {
    rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("pool").install(run)
}

/// Power of the echoes of people in a frame, LSB^2.
pub fn echo_power(simulator: &Simulator, frame: u64) -> f64 {
    simulator.echo_samples(frame).iter().map(|&x| f64::from(x).powi(2)).sum()
}

/// An empty 20 m hall without walls, radar in a corner region looking along +x, paper waveform, flat quiet receiver.
pub fn hall(extra: &str) -> String {
    format!(
        r#"
format = 1
name = "hall"
[receiver]
format = 1
name = "flat"
noise_figure_db = 0.0
rx = [{{ dc_code = 2048.0 }}, {{ dc_code = 2048.0 }}, {{ dc_code = 2048.0 }}]
[receiver.noise]
adc_white_lsb = 2.0
baseband_white_lsb = 0.0
flicker_lsb2_at_100khz = 0.0
amplifier_flicker_corner_hz = 0.0
[receiver.clutter]
phase_jitter_rad = 0.0
phase_drift_rad_per_10s = 0.0
amplitude_jitter = 0.0
leakage_jitter = 0.0
leakage_drift_per_10s = 0.0
[receiver.drift]
dc_lsb_per_s = 0.0
dc_jitter_lsb = 0.0
[room]
size_m = [20.0, 20.0, 3.0]
x_low = {{ material = "open" }}
x_high = {{ material = "open" }}
y_low = {{ material = "open" }}
y_high = {{ material = "open" }}
floor = {{ material = "open" }}
ceiling = {{ material = "open" }}
[radar]
position_m = [1.0, 10.0, 1.2]
[waveform]
start_frequency_hz = 59.558825e9
end_frequency_hz = 60.441175e9
samples_per_chirp = 256
chirps_per_frame = 128
sample_rate_hz = 1e6
chirp_interval_s = 500e-6
frame_interval_s = 0.1
if_gain_db = 33.0
high_pass_cutoff_hz = 20e3
{extra}
"#
    )
}

/// The hall with other keys of `[room]` and further tables. The radar is at (0.5, 1, 1.2) and looks along x.
pub fn hall_with_room(room: &str, tables: &str) -> String {
    let hall = hall(tables);
    let (before, rest) = hall.split_once("size_m").expect("written");
    let (_, after) = rest.split_once("[radar]").expect("written");
    format!("{before}\n{room}\n[radar]{after}").replace("[1.0, 10.0, 1.2]", "[0.5, 1.0, 1.2]")
}

pub fn parse(text: &str) -> Scene {
    Scene::parse(text, Path::new("test.toml")).expect("valid scene")
}

/// Error message for the text of an invalid scene.
pub fn error_message(text: &str) -> String {
    Scene::parse(text, Path::new("a/b.toml")).map(|_| ()).expect_err(text).to_string()
}

/// Asserts that a result is an error whose message contains all words.
pub fn assert_refused<T>(result: Result<T, impl std::fmt::Display>, expected: &[&str]) {
    let Err(error) = result else { panic!("accepted, but expected {expected:?}") };
    let message = error.to_string();
    for word in expected {
        assert!(message.contains(word), "{word:?} is not in {message:?}");
    }
}

/// One scattering point at a range ahead of the radar of [`hall`].
pub fn post(range_m: f64, cross_section_dbsm: f64) -> String {
    let x = 1.0 + range_m;
    format!(
        "[[furniture]]\nname = \"post\"\nposition_m = [{x}, 10.0, 1.2]\nsize_m = [0.0, 0.0, 0.0]\npoints = 1\n\
         cross_section_dbsm = {cross_section_dbsm}\n"
    )
}

fn hann(i: usize, n: usize) -> f64 {
    0.5 - 0.5 * (TAU * i as f64 / n as f64).cos()
}

/// Range spectrum of every chirp of `count` samples, with a Hann window.
pub fn range_profiles(samples: &[f64], count: usize) -> Vec<Vec<Complex64>> {
    let fft = radome_dsp::spectrum::real_fft(count);
    let profile = |chirp: &[f64]| {
        let mut x: Vec<f64> = chirp.iter().enumerate().map(|(i, v)| v * hann(i, count)).collect();
        let mut spectrum = fft.make_output_vec();
        fft.process(&mut x, &mut spectrum).expect("lengths agree");
        spectrum
    };
    samples.chunks(count).map(profile).collect()
}

/// Power `[doppler][range]` of range profiles by plain sums over the chirps, with a Hann window. Zero Doppler is first.
pub fn doppler_power(profiles: &[Vec<Complex64>]) -> Vec<f64> {
    let (m, ranges) = (profiles.len(), profiles[0].len() - 1);
    let turns: Vec<Complex64> = (0..m).map(|i| Complex64::from_polar(1.0, -TAU * i as f64 / m as f64)).collect();
    let cell = |d: usize, k: usize| {
        let terms = profiles.iter().enumerate().map(|(i, p)| p[k] * (hann(i, m) * turns[d * i % m]));
        terms.sum::<Complex64>().norm_sqr()
    };
    (0..m).flat_map(|d| (0..ranges).map(move |k| (d, k))).map(|(d, k)| cell(d, k)).collect()
}

/// The paper's map of one channel by plain sums: scale 2 code/4095 - 1, Hann on both axes, slow-time mean removed. The
/// result is the power `[doppler][range]` in dB, with zero Doppler in the middle and receding targets above it.
pub fn map_db(frame: &Frame, rx: usize) -> Vec<f64> {
    let (m, n) = (frame.shape.chirps, frame.shape.samples);
    let codes = (0..m).flat_map(|chirp| frame.chirp(rx, chirp));
    let mut profiles = range_profiles(&codes.map(|&c| 2.0 * f64::from(c) / 4095.0 - 1.0).collect::<Vec<_>>(), n);
    for k in 0..n / 2 {
        let mean = profiles.iter().map(|p| p[k]).sum::<Complex64>() / m as f64;
        profiles.iter_mut().for_each(|p| p[k] -= mean);
    }
    let mut map: Vec<f64> = doppler_power(&profiles).iter().map(|power| 10.0 * power.max(1e-30).log10()).collect();
    map.rotate_right(m / 2 * (n / 2));
    map
}

/// Range bin of the first receiver in every chirp (Hann window over the samples).
pub fn range_bin(frame: &Frame, bin: f64) -> Vec<Complex64> {
    let n = frame.shape.samples;
    let sample = |(i, &code): (usize, &u16)| {
        Complex64::from_polar(f64::from(code) * hann(i, n), -bin * TAU * i as f64 / n as f64)
    };
    (0..frame.shape.chirps).map(|chirp| frame.chirp(0, chirp).iter().enumerate().map(sample).sum()).collect()
}

pub fn isotropic(position: DVec3, polarisation: DVec3) -> Element {
    Element { position, polarisation, radar_from_world: DMat3::IDENTITY, pattern: Pattern::isotropic() }
}

pub fn rms(values: &[f64]) -> f64 {
    (values.iter().map(|x| x * x).sum::<f64>() / values.len() as f64).sqrt()
}

/// Mean and standard deviation.
pub fn statistics(values: &[f64]) -> (f64, f64) {
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / values.len() as f64;
    (mean, variance.sqrt())
}

/// Index (doppler, range) of the strongest cell beyond the first range bins.
pub fn peak(map: &[f64], ranges: usize) -> (usize, usize) {
    let cells = map.iter().enumerate().filter(|(i, _)| i % ranges > 2);
    let (index, _) = cells.max_by(|a, b| a.1.total_cmp(b.1)).expect("cells");
    (index / ranges, index % ranges)
}
