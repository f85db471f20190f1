//! Spec of a dataset: a TOML file. Paths in it are relative to it.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use radome_dsp::rdm::{Channels, StaticRemoval};
use radome_dsp::{KernelLevel, Occupancy, RdmSpec, WaveformRequest};
use radome_files::{TEXT_LIMIT_BYTES, parse_toml, read_text};
use radome_models::dataset::{Split, SplitSpec};
use radome_sim::scene_file::BodyFile;
use schemars::{JsonSchema, Schema, SchemaGenerator};
use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize};
use serde_json::Value;

// The fuzz targets compile this file by itself: it uses nothing of `crate`.

/// Newest format version of the file.
const FORMAT: u32 = 1;
/// Largest number of frames of one run: eleven days at ten per second.
const MOST_FRAMES: u64 = 10_000_000;
/// Largest total number of runs of all scenes. Each is a folder of its own while a dataset is built.
const MOST_RUNS: u64 = 1_000_000;
/// Largest magnitude of a signal-to-noise ratio, dB. Beyond it, the noise or the signal is not visible.
pub const MOST_SNR_DB: f64 = 100.0;

/// The whole file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct BuildSpec {
    /// Version of the schema: 1.
    format: u32,
    /// Kind of map: the mean power of all receivers, without the mean of each chirp and without echoes that are static within the frame,
    /// unless keys say otherwise.
    #[serde(default = "map_of_networks", deserialize_with = "over_map_of_networks")]
    #[schemars(schema_with = "any_keys::<RdmSpec>")]
    pub map: RdmSpec,
    /// White Gaussian noise on the raw samples, before maps are made of them, by its ratio, dB; none if absent. Its power in a
    /// receiver's samples of a frame is their mean square about the mean of each chirp, over 10^(raw_snr_db / 10): static echoes and
    /// leakage count as signal. Sequences, frames and labels are those of the dataset without noise. A receiver that gives no
    /// signal is not replaced by another.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub raw_snr_db: Option<f64>,
    /// Instructions that maps are made with; the fastest that the machine has if absent. Unlike machines agree to the
    /// bit if it is given.
    #[serde(default)]
    pub kernel: Option<KernelLevel>,
    /// Rule by which splits are made, once and for all; left to the training if absent.
    #[serde(default)]
    pub split: Option<SplitSpec>,
    /// Runs of scenes.
    #[serde(default)]
    pub simulated: Vec<Simulated>,
    /// Recordings.
    #[serde(default)]
    pub recorded: Vec<Recorded>,
}

/// Runs of a scene.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Simulated {
    /// Scene file.
    pub scene: PathBuf,
    /// First and last seed.
    pub seeds: (u64, u64),
    /// Numbers of people to force, one run each; the scene's own program if absent.
    #[serde(default)]
    pub people: Vec<usize>,
    /// Frames of a run.
    pub frames: u64,
    /// Take one map in so many.
    #[serde(default = "one")]
    pub every: u64,
    /// Other values of keys of the scene's `[waveform]`. Maps on physical axes may come of several waveforms.
    #[serde(default)]
    #[schemars(schema_with = "any_keys::<WaveformRequest>")]
    pub waveform: toml::Table,
    /// Kind of body; the scene's own if absent.
    #[serde(default)]
    pub body: Option<BodyFile>,
    /// Error of the echoes that is asked for, dB; the simulator's own if absent.
    #[serde(default)]
    pub tolerance_db: Option<f64>,
    /// Split of all runs; dealt out by sequence if absent.
    #[serde(default)]
    pub split: Option<Split>,
}

/// A recording, or all recordings in a folder.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Recorded {
    /// One recording.
    #[serde(default)]
    pub recording: Option<PathBuf>,
    /// All recordings in this folder and in those within it. Each is named by its path from here.
    #[serde(default)]
    pub folders: Option<PathBuf>,
    /// With `folders`: what a recording is, by its name. `*` stands for anything within a name, `{subject}`, `{scene}` and
    /// `{sequence}` for what is to be called so; a pattern without `/` is held against the last name of the path. Exactly
    /// one must fit.
    #[serde(default)]
    pub labels: BTreeMap<String, FolderLabel>,
    /// With `recording`: the class throughout; by its own labels and truth if absent.
    #[serde(default)]
    pub label: Option<Occupancy>,
    /// With `recording`: file with labels instead of its own.
    #[serde(default)]
    pub label_file: Option<PathBuf>,
    /// Scene or place.
    #[serde(default)]
    pub scene: Option<String>,
    /// Name of the person.
    #[serde(default)]
    pub subject: Option<String>,
    /// Sequence of the maps; the recording if absent.
    #[serde(default)]
    pub sequence: Option<String>,
    /// Take one map in so many.
    #[serde(default = "one")]
    pub every: u64,
    /// Split of all maps; dealt out by sequence if absent.
    #[serde(default)]
    pub split: Option<Split>,
}

/// Label of the recordings whose names fit a pattern.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum FolderLabel {
    /// Nobody, throughout.
    Empty,
    /// One person, throughout.
    One,
    /// Two people or more, throughout.
    Two,
    /// Labels of the recordings themselves.
    Spans,
    /// Not for the dataset.
    Skip,
}

/// Default map for the training of networks, independent of the board: the mean power of all receivers, without each
/// chirp's mean and without echoes that are static within the frame.
fn map_of_networks() -> RdmSpec {
    RdmSpec {
        channels: Channels::IncoherentSum,
        chirp_mean_removal: true,
        static_removal: StaticRemoval::SlowTimeMean,
        ..RdmSpec::default()
    }
}

fn over_map_of_networks<'de, D: Deserializer<'de>>(deserializer: D) -> Result<RdmSpec, D::Error> {
    // This is not a TOML table. The plan of a build stores its spec as JSON, and TOML tables cannot hold JSON's nulls.
    let given = serde_json::Map::deserialize(deserializer)?;
    let Value::Object(mut all) = serde_json::to_value(map_of_networks()).map_err(D::Error::custom)? else {
        return Err(D::Error::custom("a map is a table"));
    };
    // JSON has no number that is not finite: one of a TOML file has become a null, which a plan has only in the place of an absent key.
    let is_lost = |key: &str, value: &Value| holds_null(value) && all.get(key) != Some(value);
    if let Some((key, _)) = given.iter().find(|(key, value)| is_lost(key, value)) {
        return Err(D::Error::custom(format!("map.{key} holds a number that is not finite")));
    }
    all.extend(given);
    serde_json::from_value(Value::Object(all)).map_err(D::Error::custom)
}

fn holds_null(value: &Value) -> bool {
    match value {
        Value::Null => true,
        Value::Array(values) => values.iter().any(holds_null),
        Value::Object(table) => table.values().any(holds_null),
        _ => false,
    }
}

/// Schema of a table whose keys are all optional.
fn any_keys<T: JsonSchema>(generator: &mut SchemaGenerator) -> Schema {
    let mut schema = T::json_schema(generator);
    schema.remove("required");
    schema
}

fn one() -> u64 {
    1
}

impl BuildSpec {
    /// Reads and checks a file.
    ///
    /// # Errors
    /// The file cannot be read, or a value is not valid.
    pub fn load(path: &Path) -> anyhow::Result<Self> {
        let text = read_text(path, TEXT_LIMIT_BYTES).with_context(|| format!("cannot read {}", path.display()))?;
        Self::parse(&text).with_context(|| format!("{} is no dataset spec", path.display()))
    }

    /// Parses and checks a file's text.
    ///
    /// # Errors
    /// The text is no spec, or a value is not valid.
    pub fn parse(text: &str) -> anyhow::Result<Self> {
        let spec: BuildSpec = parse_toml(text)?;
        spec.check()?;
        Ok(spec)
    }

    /// Creates a spec of maps of runs, without splits.
    pub fn of_runs(map: RdmSpec, simulated: Vec<Simulated>) -> Self {
        BuildSpec { format: FORMAT, map, raw_snr_db: None, kernel: None, split: None, simulated, recorded: Vec::new() }
    }

    /// Returns the spec with noise of this ratio on the raw samples, or with its own ratio if `raw_snr_db` is `None`.
    ///
    /// # Errors
    /// The ratio is out of range.
    pub fn with_raw_snr_db(mut self, raw_snr_db: Option<f64>) -> anyhow::Result<Self> {
        self.raw_snr_db = raw_snr_db.or(self.raw_snr_db);
        self.check()?;
        Ok(self)
    }

    fn check(&self) -> anyhow::Result<()> {
        ensure!(self.format == FORMAT, "format is {}, this program knows {FORMAT}", self.format);
        if let Some(snr_db) = self.raw_snr_db.filter(|snr_db| !(-MOST_SNR_DB..=MOST_SNR_DB).contains(snr_db)) {
            bail!("raw_snr_db is {snr_db}, expected -{MOST_SNR_DB} to {MOST_SNR_DB}; leave it out for no noise");
        }
        let mut runs = 0u64;
        for (index, source) in self.simulated.iter().enumerate() {
            let (first, last) = source.seeds;
            if first > last {
                bail!("simulated source {}: seeds are [{first}, {last}], expected the first one first", index + 1);
            }
            if source.every == 0 || source.frames == 0 {
                bail!("simulated source {}: frames and every are counted from 1", index + 1);
            }
            if source.frames > MOST_FRAMES {
                bail!("simulated source {}: {} frames, expected {MOST_FRAMES} at most", index + 1, source.frames);
            }
            let of_source = (last - first).saturating_add(1).saturating_mul(source.people.len().max(1) as u64);
            runs = runs.saturating_add(of_source);
            ensure!(runs <= MOST_RUNS, "simulated source {}: more than {MOST_RUNS} runs up to here", index + 1);
        }
        for (index, source) in self.recorded.iter().enumerate() {
            let fault = match (&source.recording, &source.folders) {
                (Some(_), Some(_)) => "has both `recording` and `folders`, expected one of them",
                (None, None) => "has neither `recording` nor `folders`",
                (Some(_), None) if !source.labels.is_empty() => {
                    "`labels` goes with `folders`; for one recording: `label`"
                }
                (Some(_), None) if source.label.is_some() && source.label_file.is_some() => {
                    "has both `label` and `label_file`, expected one of them at most"
                }
                (None, Some(_)) if source.labels.is_empty() => {
                    "`folders` wants `labels`, such as { \"empty*\" = \"empty\", \"one_*\" = \"one\" }"
                }
                (None, Some(_)) if source.label.is_some() || source.label_file.is_some() => {
                    "`label` and `label_file` go with `recording`; for folders: `labels`"
                }
                _ if source.every == 0 => "`every` is counted from 1",
                _ => continue,
            };
            bail!("recorded source {}: {fault}", index + 1);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_default_map_suits_networks_and_given_keys_change_it() {
        let read = |text: &str| toml::from_str::<BuildSpec>(text);
        assert_eq!(read("format = 1").expect("valid").map, map_of_networks());
        let some = read("format = 1\n[map]\nchannels = { one = 0 }").expect("valid").map;
        assert_eq!(some, RdmSpec { channels: Channels::One(0), ..map_of_networks() });
        let spec = read("format = 1\n[map]\nchannels = { one = 2 }").expect("valid");
        let kept = serde_json::to_string(&spec).expect("JSON");
        assert_eq!(serde_json::from_str::<BuildSpec>(&kept).expect("a plan's spec"), spec);
        let error = read("format = 1\n[map]\nchannel = 1").expect_err("no such key").to_string();
        assert!(error.contains("channel"), "{error}");
    }

    /// A build continues only with its original spec, which its plan stores as JSON.
    #[test]
    fn another_ratio_is_another_spec_and_none_is_not_written() {
        let read = |text: &str| BuildSpec::parse(text).expect("valid");
        let (none, ten) = (read("format = 1"), read("format = 1\nraw_snr_db = 10.0"));
        let kept = |spec: &BuildSpec| serde_json::to_string(spec).expect("JSON");
        assert!(!kept(&none).contains("raw_snr_db"));
        assert_eq!(serde_json::from_str::<BuildSpec>(&kept(&ten)).expect("a plan's spec"), ten);
        assert_ne!(none, ten);
        assert_eq!(none.with_raw_snr_db(Some(10.0)).expect("in range"), ten);
        assert_eq!(ten.clone().with_raw_snr_db(None).expect("its own"), ten);
        assert!(ten.with_raw_snr_db(Some(f64::NAN)).is_err());
    }

    mod hard_cases {
        use super::*;

        /// A floor that is not finite was refused as "invalid type: null", and such a time of change was taken for none.
        #[test]
        fn a_number_of_a_map_that_is_not_finite_is_refused_with_its_key() {
            let axes = "physical_axes = { range_bins = 64, range_step_m = nan, velocity_bins = 64, velocity_step_m_per_s = 0.1 }";
            for (text, key) in
                [("floor_db = nan", "floor_db"), ("change_over_s = -inf", "change_over_s"), (axes, "physical_axes")]
            {
                let error = BuildSpec::parse(&format!("format = 1\n[map]\n{text}\n")).expect_err(text);
                let said = format!("{error:#}");
                assert!(said.contains(&format!("map.{key} holds a number that is not finite")), "{said}");
            }
        }

        #[test]
        fn numbers_that_would_fill_memory_are_refused() {
            let source = |rest: &str| {
                let text = format!("format = 1\n[[simulated]]\nscene = \"a.toml\"\n{rest}");
                BuildSpec::parse(&text).map(|_| ()).map_err(|error| format!("{error:#}"))
            };
            assert_eq!(source("seeds = [1, 2600]\nframes = 600\npeople = [0, 1, 2]\n"), Ok(()));
            let refused = |rest: &str, expected: &str| {
                let error = source(rest).expect_err(rest);
                assert!(error.contains(expected), "{rest}: {error}");
            };
            refused("seeds = [0, 9223372036854775807]\nframes = 1\n", "more than 1000000 runs");
            refused("seeds = [1, 500000]\nframes = 1\npeople = [0, 1, 2]\n", "more than 1000000 runs");
            refused("seeds = [1, 1]\nframes = 9223372036854775807\n", "10000000 at most");
            refused("seeds = [2, 1]\nframes = 1\n", "the first one first");
            refused("seeds = [1, 1]\nframes = -1\n", "frames");
            for ratio in ["inf", "nan", "-100.1", "1e300"] {
                let error =
                    BuildSpec::parse(&format!("format = 1\nraw_snr_db = {ratio}\n")).expect_err(ratio).to_string();
                assert!(error.contains("raw_snr_db") && error.contains("-100 to 100"), "{error}");
            }
            let deep = format!("format = 1\nmap = {}", "{ a = ".repeat(100_000));
            assert!(BuildSpec::parse(&deep).is_err());
        }

        #[test]
        fn a_spec_that_is_too_long_or_no_file_is_not_read() {
            let folder = tempfile::tempdir().expect("a folder");
            let path = folder.path().join("set.toml");
            std::fs::write(&path, vec![b'#'; (1 << 20) + 1]).expect("written");
            let long = format!("{:#}", BuildSpec::load(&path).expect_err("too long"));
            let none = format!("{:#}", BuildSpec::load(folder.path()).expect_err("a folder"));
            assert!(long.contains("set.toml") && long.contains("at most 1048576"), "{long}");
            assert!(none.contains("not a regular file"), "{none}");
        }
    }
}
