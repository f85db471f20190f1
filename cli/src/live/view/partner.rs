//! Simulated partner of a recording: the scene made by `scene pair`, at the time of the frame that is shown.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use radome_dsp::{Frame, FrameSource, Waveform};
use radome_files::read_text;
use radome_models::dataset::{Domain, MANIFEST_LIMIT_BYTES, ManifestRow};
use radome_sim::{Scene, SimulateOptions, Simulator};

use crate::exit::wrong_use;
use crate::source::{self, DEFAULT_SEED, Playback};

/// Simulation that mirrors a recording.
pub struct Partner {
    simulator: Simulator,
    /// Time of the recording's first frame, at which the mirror's time begins, s.
    first_s: f64,
    /// Number of the last frame that has a partner.
    last_sequence: u64,
}

impl Partner {
    /// Opens the partner in `folder`. Without `folder`, opens the one in the folder named after the recording beside
    /// it, if there is one.
    /// # Errors
    /// The folder is no pair of the recording or cannot be read.
    pub fn find(
        folder: Option<&Path>,
        playback: Option<&Playback>,
        waveform: &Waveform,
    ) -> anyhow::Result<Option<Self>> {
        let Some(playback) = playback else {
            if folder.is_some() {
                wrong_use!("--pair is of a recording, and the source is none");
            }
            return Ok(None);
        };
        let folder = match folder {
            Some(folder) => folder.to_owned(),
            None => match beside(&playback.path) {
                Some(folder) => folder,
                None => return Ok(None),
            },
        };
        let partner = Self::open(&folder, playback, waveform).with_context(|| {
            format!(
                "{} is no pair of {}\n\nhint: radome scene pair makes one",
                folder.display(),
                playback.path.display()
            )
        })?;
        message!("simulated partner: {}", folder.display());
        Ok(Some(partner))
    }

    fn open(folder: &Path, playback: &Playback, waveform: &Waveform) -> anyhow::Result<Self> {
        let manifest = folder.join("manifest.jsonl");
        let rows = read_text(&manifest, MANIFEST_LIMIT_BYTES)
            .with_context(|| format!("cannot read {}", manifest.display()))?;
        let (mut seed, mut last_sequence, mut first_ns) = (None, None, None);
        for line in rows.lines() {
            let row: ManifestRow = serde_json::from_str(line).context("a row of the manifest is malformed")?;
            if row.domain == Domain::Sim && row.pair.is_some() {
                seed = seed.or(row.seed);
                first_ns = first_ns.or(row.time_ns);
                last_sequence = last_sequence.max(Some(row.frame));
            }
        }
        let last_sequence = last_sequence.context("the dataset holds no mirror of a recording")?;
        let scene = Scene::load(&folder.join("mirror.toml"))?;
        let options = SimulateOptions { seed: seed.unwrap_or(DEFAULT_SEED), ..SimulateOptions::default() };
        let simulator = Simulator::new(&scene, options)?;
        waveform.check_compatible(simulator.waveform())?;
        if waveform.shape() != simulator.waveform().shape() {
            bail!("the mirror's frames are {}, the recording's {}", simulator.waveform().shape(), waveform.shape());
        }
        let first = playback.extent.first;
        if first_ns.is_some_and(|ns| ns < first.time_ns) || last_sequence > playback.extent.last.sequence {
            bail!("its frames are not the recording's");
        }
        Ok(Partner { simulator, first_s: first.time_s(), last_sequence })
    }

    /// Simulates the frame at the same time; `None` for frames after the end of the pair.
    pub fn frame(&self, frame: &Frame) -> Option<Frame> {
        let start_s = (frame.time_s() - self.first_s).max(0.0);
        (frame.sequence <= self.last_sequence).then(|| self.simulator.frame_at(frame.sequence, start_s))
    }
}

/// Returns `NAME-pair` beside `NAME.mcap` or the folder `NAME`.
fn beside(recording: &Path) -> Option<PathBuf> {
    let mut name = source::name_of(recording);
    name.push("-pair");
    let folder = recording.with_file_name(name);
    folder.join("mirror.toml").is_file().then_some(folder)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_pair_of_a_folder_has_its_whole_name() {
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name);
        for name in ["walk_0.5m", "walk_0-pair", "walk_0.5m-pair"] {
            std::fs::create_dir(at(name)).expect("a folder");
        }
        std::fs::write(at("walk_0-pair/mirror.toml"), "").expect("a file");
        assert_eq!(beside(&at("walk_0.5m")), None, "the pair of another recording");
        std::fs::write(at("walk_0.5m-pair/mirror.toml"), "").expect("a file");
        assert_eq!(beside(&at("walk_0.5m")), Some(at("walk_0.5m-pair")));
    }
}
