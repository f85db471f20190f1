//! Frames computed by dense physical optics. Each takes minutes, so they can be stored on disk.

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, bail, ensure};
use npyz::WriterBuilder;
use radome_driver::recording::Existing;
use radome_sim::Simulator;
use rayon::prelude::*;
use sha2::{Digest, Sha256};

use crate::{files, output};

/// Relative difference up to which a recomputed chirp counts as the same, since machines round differently.
const SAME_TOLERANCE: f64 = 1e-6;
/// Relative difference up to which a stored frame is still used, with a message. On a walker's map, -54 dB are about
/// 0.05 dB.
const USABLE_TOLERANCE: f64 = 2e-3;

/// Inputs of the computation of a frame.
pub struct DenseFrame<'a> {
    pub simulator: &'a Simulator,
    pub index: u64,
    /// Margin below the noise, dB: all wall paths louder than this are included.
    pub margin_db: f64,
    /// All other settings that affect the frame, as free text.
    pub settings: &'a str,
}

/// Samples of a frame, and the time that one thread takes to compute them.
pub struct DenseSamples {
    /// LSB, `[rx][chirp][sample]`.
    pub samples: Vec<f64>,
    pub milliseconds: f64,
}

impl DenseFrame<'_> {
    /// Reads the samples from `folder` if they are there and one recomputed chirp agrees with them. Otherwise computes
    /// them with a progress bar, and stores them there.
    ///
    /// # Errors
    /// The frame cannot be computed, or the file of stored samples cannot be read or written.
    pub fn samples(&self, folder: Option<&Path>) -> anyhow::Result<DenseSamples> {
        let Some(folder) = folder else { return self.compute() };
        let path = self.path(folder);
        if path.exists() {
            let samples = self.read(&path)?;
            let started = Instant::now();
            let difference = self.difference(&samples);
            let difference_db = 20.0 * difference.log10();
            if difference <= USABLE_TOLERANCE {
                if difference > SAME_TOLERANCE {
                    message!("{}: {difference_db:.1} dB off what the program makes now", path.display());
                }
                let milliseconds = started.elapsed().as_secs_f64() * 1e3 * self.shape()[1] as f64;
                return Ok(DenseSamples { samples, milliseconds });
            }
            message!("{}: {difference_db:.1} dB off what the program makes now; computed anew", path.display());
        }
        std::fs::create_dir_all(folder).with_context(|| format!("cannot create {}", folder.display()))?;
        let computed = self.compute()?;
        self.write(&path, &computed.samples)?;
        Ok(computed)
    }

    /// Shape of the samples: `[rx][chirp][sample]`.
    fn shape(&self) -> [usize; 3] {
        let shape = self.simulator.scene().waveform().shape();
        [shape.rx, shape.chirps, shape.samples]
    }

    /// Path of the stored frame, named by a hash of the settings. The content of the scene file is not part of the
    /// name: the recomputed chirp detects changes, and a scene file that gains a new key stays valid.
    fn path(&self, folder: &Path) -> PathBuf {
        let settings = format!("{} {}", self.margin_db, self.settings);
        let digest: String = Sha256::digest(settings).iter().take(4).map(|byte| format!("{byte:02x}")).collect();
        folder.join(format!("dense-{}-{digest}-{}.npy", self.simulator.scene().name(), self.index))
    }

    fn compute(&self) -> anyhow::Result<DenseSamples> {
        let [receivers, chirps, _] = self.shape();
        let bar = output::progress(chirps as u64, "chirps by dense physical optics");
        let started = Instant::now();
        let chirp = |chirp| {
            ensure!(!output::interrupted(), "interrupted: frame {} is not kept", self.index);
            let samples = self.simulator.dense_echo_chirp(self.index, chirp, self.margin_db);
            bar.inc(1);
            Ok(samples)
        };
        let all: Vec<Vec<Vec<f64>>> = (0..chirps).into_par_iter().map(chirp).collect::<anyhow::Result<_>>()?;
        // Time summed over all threads, as if one thread had done the work.
        let milliseconds = started.elapsed().as_secs_f64() * 1e3 * rayon::current_num_threads() as f64;
        bar.finish_and_clear();
        let of_receiver = |rx: usize| all.iter().filter_map(move |chirp| chirp.get(rx)).flatten().copied();
        Ok(DenseSamples { samples: (0..receivers).flat_map(of_receiver).collect(), milliseconds })
    }

    /// Difference of the frame's middle chirp from the one that the program computes now, relative to the latter.
    fn difference(&self, samples: &[f64]) -> f64 {
        let [_, chirps, length] = self.shape();
        let middle = chirps / 2;
        let now = self.simulator.dense_echo_chirp(self.index, middle, self.margin_db);
        let stored =
            samples.chunks(chirps * length).map(|channel| channel.chunks(length).nth(middle).unwrap_or_default());
        let (mut squared_difference, mut power) = (0.0, 0.0);
        for (now, stored) in now.iter().flatten().zip(stored.flatten()) {
            squared_difference += (now - stored).powi(2);
            power += now * now;
        }
        if squared_difference > 0.0 { (squared_difference / power).sqrt() } else { 0.0 }
    }

    fn read(&self, path: &Path) -> anyhow::Result<Vec<f64>> {
        let hint = || format!("{}: not a kept frame\n\nhint: remove it, and it is computed anew", path.display());
        let bytes = std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
        let array = npyz::NpyFile::new(bytes.as_slice()).with_context(hint)?;
        if array.shape() != self.shape().map(|n| n as u64) {
            bail!("{:?} instead of {:?}: {}", array.shape(), self.shape(), hint());
        }
        array.into_vec::<f64>().with_context(hint)
    }

    fn write(&self, path: &Path, samples: &[f64]) -> anyhow::Result<()> {
        let shape = self.shape().map(|n| n as u64);
        files::write_output(path, Existing::Replace, |file| {
            let mut writer = npyz::WriteOptions::new().default_dtype().shape(&shape).writer(file).begin_nd()?;
            writer.extend(samples.iter().copied())?;
            Ok(writer.finish()?)
        })
    }
}
