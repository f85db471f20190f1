//! Model of the mean chirp: an offset, two settling exponentials and a few slow tones.

use radome_dsp::Waveform;

use crate::receiver::{Leakage, Transient};

/// Frequencies of the tones, cycles a chirp.
const CYCLES: [f64; 4] = [0.5, 1.0, 1.5, 2.0];
/// Time constants that are tried, s: a fast and a slow one of each pair.
const FAST_S: [f64; 3] = [1e-6, 2e-6, 4e-6];
const SLOW_S: [f64; 4] = [6e-6, 8e-6, 12e-6, 20e-6];

/// Regularisation weight of every component's level: errors of a few LSB against levels of a few hundred.
const REGULARISATION: f64 = 0.0125;

/// A fitted mean chirp.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct ChirpModel {
    pub(super) constant_lsb: f64,
    pub(super) transient: Vec<Transient>,
    pub(super) leakage: Vec<Leakage>,
    /// Error of the fit, LSB rms.
    pub(super) residual_lsb: f64,
}

impl ChirpModel {
    /// Sum of the tones in every sample, LSB.
    pub(super) fn leakage_lsb(&self, samples: usize, waveform: &Waveform) -> Vec<f64> {
        let at = |i: usize| {
            let time_s = i as f64 / waveform.sample_rate_hz;
            self.leakage.iter().map(|l| l.amplitude_lsb * l.phase_at_rad(waveform, time_s).cos()).sum()
        };
        (0..samples).map(at).collect()
    }
}

/// Fits a chirp with the pair of time constants that has the least error.
pub(super) fn fit_chirp_model(chirp_lsb: &[f64], waveform: &Waveform) -> ChirpModel {
    let sample_count = chirp_lsb.len() as f64;
    let sample_s = 1.0 / waveform.sample_rate_hz;
    let mut best = ChirpModel { residual_lsb: f64::INFINITY, ..ChirpModel::default() };
    for (fast_s, slow_s) in FAST_S.iter().flat_map(|&fast| SLOW_S.iter().map(move |&slow| (fast, slow))) {
        let row = |i: usize| {
            let sample = i as f64;
            let mut row = vec![1.0, (-sample * sample_s / fast_s).exp(), (-sample * sample_s / slow_s).exp()];
            for cycles in CYCLES {
                let (sine, cosine) = (std::f64::consts::TAU * cycles * sample / sample_count).sin_cos();
                row.extend([cosine, -sine]);
            }
            row
        };
        let rows: Vec<Vec<f64>> = (0..chirp_lsb.len()).map(row).collect();
        // Slow tones and settling exponentials are nearly dependent. Regularisation selects a solution with moderate
        // components.
        let (mut regularised_rows, mut values) = (rows.clone(), chirp_lsb.to_vec());
        for k in 1..rows.first().map_or(0, Vec::len) {
            let mut row = vec![0.0; rows[0].len()];
            row[k] = REGULARISATION;
            regularised_rows.push(row);
            values.push(0.0);
        }
        let Some(coefficients) = least_squares(&regularised_rows, &values) else { continue };
        let squared_error =
            |(row, y): (&Vec<f64>, &f64)| (row.iter().zip(&coefficients).map(|(a, b)| a * b).sum::<f64>() - y).powi(2);
        let residual_lsb = (rows.iter().zip(chirp_lsb).map(squared_error).sum::<f64>() / sample_count).sqrt();
        if residual_lsb < best.residual_lsb {
            let tone = |(k, cycles): (usize, f64)| {
                let (re, im) = (coefficients[3 + 2 * k], coefficients[4 + 2 * k]);
                // `slope delay` cycles a second.
                let delay_s = cycles / (sample_count * sample_s * waveform.slope_hz_per_s);
                Leakage { delay_s, amplitude_lsb: re.hypot(im), phase_rad: im.atan2(re) }
            };
            let settling = |amplitude_lsb, time_constant_s| Transient { amplitude_lsb, time_constant_s };
            best = ChirpModel {
                constant_lsb: coefficients[0],
                transient: vec![settling(coefficients[1], fast_s), settling(coefficients[2], slow_s)],
                leakage: CYCLES.into_iter().enumerate().map(tone).collect(),
                residual_lsb,
            };
        }
    }
    best
}

/// Least squares by Householder reflections; `None` if columns are linearly dependent.
fn least_squares(rows: &[Vec<f64>], values: &[f64]) -> Option<Vec<f64>> {
    let columns = rows.first()?.len();
    if rows.len() < columns {
        return None;
    }
    let (mut a, mut b) = (rows.to_vec(), values.to_vec());
    for k in 0..columns {
        let norm = a[k..].iter().map(|row| row[k] * row[k]).sum::<f64>().sqrt();
        if norm < 1e-9 {
            return None;
        }
        let alpha = if a[k][k] > 0.0 { -norm } else { norm };
        let mut v: Vec<f64> = a[k..].iter().map(|row| row[k]).collect();
        v[0] -= alpha;
        let norm_squared = v.iter().map(|x| x * x).sum::<f64>();
        for column in k..columns {
            let projection = 2.0 * a[k..].iter().zip(&v).map(|(row, v)| row[column] * v).sum::<f64>() / norm_squared;
            a[k..].iter_mut().zip(&v).for_each(|(row, v)| row[column] -= projection * v);
        }
        let projection = 2.0 * b[k..].iter().zip(&v).map(|(b, v)| b * v).sum::<f64>() / norm_squared;
        b[k..].iter_mut().zip(&v).for_each(|(b, v)| *b -= projection * v);
    }
    let mut x = vec![0.0; columns];
    for k in (0..columns).rev() {
        let known: f64 = (k + 1..columns).map(|column| a[k][column] * x[column]).sum();
        x[k] = (b[k] - known) / a[k][k];
    }
    Some(x)
}
