//! Files of the rungs of a ladder: sets of simulated recordings that differ from training in one way each.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use radome_dsp::RdmSpec;
use radome_sim::scene_file::BodyFile;
use serde::Deserialize;

use super::spec::{BuildSpec, Simulated};
use crate::files;

const FORMAT: u32 = 1;
/// Largest number of frames of a rung: a day at ten per second.
pub const MOST_FRAMES: u64 = 864_000;

/// Content of a rung's file.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RungFile {
    format: u32,
    /// Short name: letters, digits, `-` and `_`.
    pub name: String,
    /// One sentence that describes the difference from training.
    pub about: String,
    pub scene: Vec<RungScene>,
}

/// Recordings of one scene.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RungScene {
    /// Scene file, relative to the rung's file.
    pub path: PathBuf,
    /// First and last seed; each seed gives one recording.
    pub seeds: (u64, u64),
    /// Maximum number of people; the scene's own number if absent.
    #[serde(default)]
    pub people: Option<usize>,
    /// Number of frames of a recording.
    pub frames: u64,
    /// Bodies of people, "ellipsoids" or "mesh"; those of the scene if absent.
    #[serde(default)]
    pub body: Option<BodyFile>,
}

impl RungFile {
    /// Reads and checks a file.
    ///
    /// # Errors
    /// The file cannot be read, or a value is not valid.
    pub fn load(path: &Path) -> anyhow::Result<Self> {
        let file: RungFile = files::read_toml(path, "rung of a ladder")?;
        file.check().with_context(|| path.display().to_string())?;
        Ok(file)
    }

    fn check(&self) -> anyhow::Result<()> {
        ensure!(self.format == FORMAT, "format is {}, this program knows {FORMAT}", self.format);
        let is_plain = |letter: char| letter.is_ascii_alphanumeric() || letter == '-' || letter == '_';
        if self.name.is_empty() || !self.name.chars().all(is_plain) {
            bail!("name is {:?}, expected letters, digits, - and _", self.name);
        }
        if self.scene.is_empty() {
            bail!("no [[scene]]");
        }
        let mut frames = 0u64;
        for scene in &self.scene {
            let (first, last) = scene.seeds;
            ensure!(first <= last, "seeds are [{first}, {last}], expected the first one first");
            ensure!(scene.frames > 0, "frames is 0, expected 1 or more");
            frames = frames.saturating_add((last - first).saturating_add(1).saturating_mul(scene.frames));
        }
        ensure!(frames <= MOST_FRAMES, "{frames} frames, expected {MOST_FRAMES} at most");
        Ok(())
    }

    /// Returns the rung as a dataset spec of all its frames. Paths stay relative to the rung's file.
    pub fn build_spec(self, map: RdmSpec) -> BuildSpec {
        let simulated = self.scene.into_iter().map(|of| Simulated {
            scene: of.path,
            seeds: of.seeds,
            people: of.people.into_iter().collect(),
            frames: of.frames,
            every: 1,
            waveform: toml::Table::new(),
            body: of.body,
            tolerance_db: None,
            split: None,
        });
        BuildSpec::of_runs(map, simulated.collect())
    }
}
