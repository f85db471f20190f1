//! Made-up maps of none, one or two moving targets: seeded, and difficult enough to need training.
#![allow(dead_code)]

use radome_dsp::{Occupancy, Rdm, RdmSpec, Waveform, WaveformRequest};
use radome_models::dataset::{DatasetHeader, Domain, ManifestRow, Split};
use radome_models::{Dataset, stream};
use rand::Rng;
use rand_distr::{Distribution, Exp1, Normal};

/// Settings of a set of maps.
#[derive(Clone, Copy)]
pub struct Maps {
    pub seed: u64,
    /// Number of range bins, and of Doppler bins.
    pub size: usize,
    /// Numbers of sequences of each class for training, validation and test.
    pub sequences: [usize; 3],
    /// Number of maps in a sequence.
    pub length: usize,
    /// Range of the targets' peak levels above the noise, dB.
    pub snr_db: (f64, f64),
}

impl Default for Maps {
    fn default() -> Self {
        Maps { seed: 1, size: 64, sequences: [80, 25, 40], length: 4, snr_db: (12.0, 26.0) }
    }
}

pub fn header(size: usize) -> DatasetHeader {
    let request = WaveformRequest { samples_per_chirp: 2 * size, chirps_per_frame: size, ..WaveformRequest::paper() };
    DatasetHeader::new(Waveform::realise(request).expect("waveform"), RdmSpec::paper()).expect("header")
}

struct Target {
    range: f64,
    doppler: f64,
    range_rate: f64,
    swing: f64,
    phase: f64,
    width: (f64, f64),
    snr_db: f64,
}

/// Map of complex noise with a ridge of static clutter. Its targets move in range, oscillate in Doppler, and speckle
/// between cells and maps.
fn map(header: &DatasetHeader, targets: &[Target], clutter: &[f64], frame: usize, rng: &mut impl Rng) -> Rdm {
    let shape = header.shape;
    let normal = Normal::new(0.0, 1.0).expect("normal");
    let mut db = Vec::with_capacity(shape.cells());
    let amplitude: Vec<f64> = targets.iter().map(|_| normal.sample(rng) * 2.0).collect();
    for doppler in 0..shape.doppler {
        let velocity = doppler as f64 - (shape.doppler / 2) as f64;
        for (range, clutter) in clutter.iter().enumerate() {
            let mut power = 1.0 + clutter * (-velocity * velocity / 1.5).exp();
            for (t, fading) in targets.iter().zip(&amplitude) {
                let r = range as f64 - t.range - t.range_rate * frame as f64;
                let v = velocity - t.doppler - t.swing * (0.7 * frame as f64 + t.phase).sin();
                let shape = (-(r / t.width.0).powi(2) - (v / t.width.1).powi(2)).exp();
                power += 10f64.powf((t.snr_db + fading) / 10.0) * shape;
            }
            let speckle: f64 = Exp1.sample(rng);
            db.push((-80.0 + 10.0 * (power * speckle.max(1e-9)).log10()) as f32);
        }
    }
    header.rdm(db, frame as u64)
}

pub fn dataset(maps: Maps) -> Dataset {
    let header = header(maps.size);
    let mut rows = Vec::new();
    let mut index = 0;
    for (split, sequences) in [Split::Train, Split::Validation, Split::Test].into_iter().zip(maps.sequences) {
        for class in Occupancy::ALL {
            for _ in 0..sequences {
                index += 1;
                let mut rng = stream(maps.seed, "sequence", index);
                let size = maps.size as f64;
                let targets: Vec<Target> = (0..class.index())
                    .map(|_| Target {
                        range: rng.random_range(0.1 * size..0.9 * size),
                        doppler: rng.random_range(-0.35 * size..0.35 * size),
                        range_rate: rng.random_range(-0.2..0.2),
                        swing: rng.random_range(0.0..0.06 * size),
                        phase: rng.random_range(0.0..6.3),
                        width: (rng.random_range(1.5..3.0), rng.random_range(0.03 * size..0.08 * size)),
                        snr_db: rng.random_range(maps.snr_db.0..maps.snr_db.1),
                    })
                    .collect();
                let clutter: Vec<f64> = (0..maps.size).map(|_| 10f64.powf(rng.random_range(-1.0..2.0))).collect();
                for frame in 0..maps.length {
                    let mut row =
                        ManifestRow::new(Domain::Sim, "made-up", "run", &format!("s{index}"), frame as u64, class);
                    row.split = Some(split);
                    rows.push((map(&header, &targets, &clutter, frame, &mut rng), row));
                }
            }
        }
    }
    Dataset::from_maps(header, rows).expect("dataset")
}
