//! Work list of a build, the same on every machine. Its units are runs of a scene, and recordings.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, anyhow, bail, ensure};
use radome_driver::recording::{Existing, Recording};
use radome_dsp::rdm::{Channels, MapMismatch};
use radome_dsp::{FrameSource, KernelLevel, Occupancy, WaveformMismatch};
use radome_files::read_text;
use radome_models::dataset::{DatasetHeader, Domain, ManifestRow, Split};
use radome_sim::scene_file::BodyFile;
use radome_sim::{Scene, Simulator};
use serde::{Deserialize, Serialize};

use super::fingerprints::Fingerprints;
use super::folders::{self, FoundRecording, NamePatterns, ParsedName};
use super::spec::{BuildSpec, FolderLabel, Recorded, Simulated};
use crate::files::{self, resolve_named};
use crate::shard::{self, Shard};
use crate::source;

/// Format version of `plan.json`.
const FORMAT: u32 = 1;
/// Largest card that is read, bytes. It names every file that the build uses.
const CARD_LIMIT_BYTES: u64 = 256 << 20;
/// File name of the card in a folder of units.
pub const FILE: &str = "plan.json";

/// Run of a scene, or recording.
#[derive(Debug, Clone)]
pub struct Unit {
    pub scene: String,
    pub recording: String,
    pub sequence: String,
    pub subject: Option<String>,
    pub split: Option<Split>,
    /// Spacing of the maps that are taken: 1 takes every map.
    pub every: u64,
    pub source: UnitSource,
}

#[derive(Debug, Clone)]
pub enum UnitSource {
    Run { scene: Arc<Scene>, seed: u64, people: Option<usize>, frames: u64, tolerance_db: Option<f64> },
    Recording { path: PathBuf, label: Option<Occupancy>, label_file: Option<PathBuf> },
}

impl Unit {
    /// Row of the manifest for a map of this unit.
    pub fn row(&self, frame: u64, label: Occupancy) -> ManifestRow {
        let (domain, seed) = match &self.source {
            UnitSource::Run { seed, .. } => (Domain::Sim, Some(*seed)),
            UnitSource::Recording { .. } => (Domain::Real, None),
        };
        let mut row = ManifestRow::new(domain, &self.scene, &self.recording, &self.sequence, frame, label);
        row.subject.clone_from(&self.subject);
        row.split = self.split;
        row.seed = seed;
        row
    }
}

/// Units, and the properties that their maps share.
pub struct Plan {
    pub header: DatasetHeader,
    pub kernel: KernelLevel,
    pub units: Vec<Unit>,
    pub card: PlanCard,
}

/// Inputs that determine the bytes of a build, stored with its units. A later run or a merge compares them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlanCard {
    format: u32,
    program: String,
    /// Instruction set that computes the maps.
    kernel: KernelLevel,
    pub spec: BuildSpec,
    /// Fingerprints of the files that the spec names, keyed by their names in it.
    sources: BTreeMap<String, String>,
    /// Number of units of the whole build. Unit `k` belongs to shard `k mod N`.
    pub units: usize,
    pub shard: Shard,
}

impl Plan {
    /// Plans a spec file.
    ///
    /// # Errors
    /// The spec or a source cannot be read, a name occurs twice, or the machine lacks the kernel.
    pub fn new(path: &Path, shard: Shard) -> anyhow::Result<Self> {
        Self::of_spec(BuildSpec::load(path)?, path, shard)
    }

    /// Plans a spec whose paths are relative to the file `path`.
    ///
    /// # Errors
    /// A source cannot be read, a name occurs twice, or the machine lacks the kernel.
    pub fn of_spec(spec: BuildSpec, path: &Path, shard: Shard) -> anyhow::Result<Self> {
        let base = path.parent().unwrap_or(Path::new("."));
        let fingerprints = Fingerprints::new(base);
        let mut list =
            UnitList { units: Vec::new(), fingerprints, header: None, contents: BTreeMap::new(), spec: &spec };
        for source in &spec.simulated {
            list.add_simulated(&resolve_named(base, &source.scene)?, source)?;
        }
        for source in &spec.recorded {
            list.add_recorded(base, source)?;
        }
        let UnitList { units, fingerprints, header, .. } = list;
        let Some((_, header)) = header else { bail!("{} names no source", path.display()) };
        let mut by_name: BTreeMap<&str, &Unit> = BTreeMap::new();
        for unit in &units {
            let name = unit.recording.as_str();
            let Some(other) = by_name.insert(name, unit) else { continue };
            let is_run = |unit: &Unit| matches!(unit.source, UnitSource::Run { .. });
            let (what, hint) = match is_run(unit) && is_run(other) {
                true => (
                    "simulated runs",
                    "give each [[simulated]] of a scene its own seeds, or its own numbers of people; two scenes need two file names",
                ),
                false => (
                    "recordings",
                    "put both into one folder and name it by folders = ...: recordings are then called by their paths in it; or \
                     rename one of them",
                ),
            };
            bail!("{}: two {what} would be called '{name}'\n\nhint: {hint}", path.display());
        }
        // Contradictory splits would otherwise be found after all units are made, and correcting them changes the spec.
        let rows: Vec<ManifestRow> = units.iter().map(|unit| unit.row(0, Occupancy::Empty)).collect();
        let rule = spec.split.clone().unwrap_or_default();
        rule.assign(&rows).with_context(|| path.display().to_string())?;
        let kernel = spec.kernel.unwrap_or_else(KernelLevel::detect);
        ensure!(
            kernel.is_available(),
            "{}: kernel {kernel} asked for, the best that this machine has is {}",
            path.display(),
            KernelLevel::detect()
        );
        let card = PlanCard {
            format: FORMAT,
            program: env!("CARGO_PKG_VERSION").to_owned(),
            kernel,
            sources: fingerprints.into_map(),
            units: units.len(),
            spec,
            shard,
        };
        Ok(Plan { header, kernel, units, card })
    }
}

/// Units of a plan under construction.
struct UnitList<'a> {
    units: Vec<Unit>,
    fingerprints: Fingerprints,
    /// Header, which the first source sets, with the name of that source for messages.
    header: Option<(String, DatasetHeader)>,
    /// Names of the recordings, by the path of their content.
    contents: BTreeMap<PathBuf, String>,
    spec: &'a BuildSpec,
}

impl UnitList<'_> {
    /// Checks that a source agrees with the first one, or sets the header if it is the first.
    fn check_waveform(&mut self, name: &str, waveform: &radome_dsp::Waveform) -> anyhow::Result<()> {
        match &self.header {
            Some((first, header)) => {
                let context = || format!("{name} and {first}: sources of one dataset must agree");
                let checked = header.rdm_spec.check_compatible(waveform, &header.waveform);
                checked.map_err(|mismatch| match mismatch {
                    MapMismatch::Waveform(WaveformMismatch { what, expected, got }) => anyhow!(
                        "{}: waveforms differ in {what}: {got} and {expected}\n\nhint: leave one of them out, or make maps on axes that \
                         take both: physical_axes under [map]",
                        context()
                    ),
                    other => anyhow::Error::from(other).context(context()),
                })
            }
            None => {
                self.header = Some((name.to_owned(), DatasetHeader::new(waveform.clone(), self.spec.map)?));
                Ok(())
            }
        }
    }

    fn add_simulated(&mut self, path: &Path, source: &Simulated) -> anyhow::Result<()> {
        let mut scene = Scene::load_with_waveform(path, &source.waveform)?;
        if let Some(body) = source.body {
            if scene.file().people.desk.is_some() {
                bail!("{}: people at a desk are made of one thing only; leave `body` out of the spec", path.display());
            }
            scene = scene.with_body(body);
        }
        self.check_waveform(&path.display().to_string(), scene.waveform())?;
        source.people.iter().try_for_each(|people| Simulator::check_people(&scene, Some(*people)))?;
        source.tolerance_db.map_or(Ok(()), Simulator::check_tolerance).with_context(|| path.display().to_string())?;
        if let Channels::One(index) = self.spec.map.channels {
            // Receivers that no map uses need not be simulated.
            let receivers = scene.waveform().request.rx_antennas.up_to(index);
            scene = scene.with_receivers(receivers);
        }
        let scene = Arc::new(scene);
        self.fingerprints.add_scene(&source.scene)?;
        let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let waveform = match source.waveform.is_empty() {
            true => String::new(),
            false => {
                let request = &scene.waveform().request;
                let interval_us = (request.chirp_interval_s * 1e6).round();
                format!("-{}x{}x{interval_us}us", request.chirps_per_frame, request.samples_per_chirp)
            }
        };
        let people_counts: Vec<Option<usize>> =
            if source.people.is_empty() { vec![None] } else { source.people.iter().map(|p| Some(*p)).collect() };
        for seed in source.seeds.0..=source.seeds.1 {
            for &people in &people_counts {
                let suffix = people.map_or(String::new(), |p| format!("-people{p}"));
                let body = if source.body == Some(BodyFile::Mesh) { "-mesh" } else { "" };
                let recording = format!("{name}{waveform}-seed{seed}{suffix}{body}");
                self.units.push(Unit {
                    scene: name.clone(),
                    sequence: recording.clone(),
                    recording,
                    subject: None,
                    split: source.split,
                    every: source.every,
                    source: UnitSource::Run {
                        scene: Arc::clone(&scene),
                        seed,
                        people,
                        frames: source.frames,
                        tolerance_db: source.tolerance_db,
                    },
                });
            }
        }
        Ok(())
    }

    fn add_recorded(&mut self, base: &Path, source: &Recorded) -> anyhow::Result<()> {
        if let Some(recording) = &source.recording {
            let path = resolve_named(base, recording)?;
            let name = source::name_of(&path).to_string_lossy().into_owned();
            let found = FoundRecording { path, session: name.clone(), name };
            let label_file = source.label_file.as_ref().map(|file| resolve_named(base, file)).transpose()?;
            if let Some(file) = &source.label_file {
                self.fingerprints.add_file(file)?;
            }
            if let Some(file) = &label_file {
                // The unit reads the file again: this finds its faults before any unit is made.
                crate::labels::read_replacing(file)?;
            }
            return self.add_recording(source, found, &recording.display().to_string(), source.label, label_file, None);
        }
        let Some(folders) = &source.folders else { return Ok(()) };
        let patterns = NamePatterns::new(source)?;
        let folder = resolve_named(base, folders)?;
        for found in folders::find(&folder)? {
            let parsed = patterns.parse(&found.session).with_context(|| format!("in {}", folder.display()))?;
            let label = match parsed.label {
                FolderLabel::Skip => continue,
                FolderLabel::Spans => None,
                FolderLabel::Empty => Some(Occupancy::Empty),
                FolderLabel::One => Some(Occupancy::One),
                FolderLabel::Two => Some(Occupancy::Two),
            };
            let source_name = format!("{}/{}", folders.display(), found.name);
            self.add_recording(source, found, &source_name, label, None, Some(parsed))?;
        }
        Ok(())
    }

    /// Adds a recording as a unit; `source_name` is its name in the list of sources.
    fn add_recording(
        &mut self,
        source: &Recorded,
        found: FoundRecording,
        source_name: &str,
        label: Option<Occupancy>,
        label_file: Option<PathBuf>,
        parsed: Option<ParsedName>,
    ) -> anyhow::Result<()> {
        let opened = Recording::open(&found.path)?;
        self.check_waveform(&found.path.display().to_string(), opened.waveform())?;
        let content = crate::labels::content_of(&found.path);
        if let Some(other) = self.contents.insert(content, found.name.clone()) {
            bail!(
                "{}: the recordings '{other}' and '{}' are one\n\nhint: its frames would count twice; name each recording once",
                found.path.display(),
                found.name
            );
        }
        let label_file = match label_file {
            None if label.is_none() && !opened.format().holds_labels() => crate::labels::file_beside(&found.path),
            given => given,
        };
        let content = match &opened {
            Recording::Infineon(reader) => reader.folder(),
            Recording::Mcap(_) | Recording::Text(_) => &found.path,
        };
        self.fingerprints.add_recording(source_name, content, label_file.as_deref())?;
        let parsed =
            parsed.unwrap_or(ParsedName { label: FolderLabel::Spans, scene: None, subject: None, sequence: None });
        self.units.push(Unit {
            scene: parsed.scene.or_else(|| source.scene.clone()).unwrap_or_else(|| "unknown".into()),
            subject: parsed.subject.or_else(|| source.subject.clone()),
            // Shards of a simulated run are one sequence, which no two splits share.
            sequence: parsed
                .sequence
                .or_else(|| source.sequence.clone())
                .unwrap_or_else(|| shard::name_of_whole(&found.session).to_owned()),
            recording: found.name,
            split: source.split,
            every: source.every,
            source: UnitSource::Recording { path: found.path, label, label_file },
        });
        Ok(())
    }
}

impl PlanCard {
    /// Reads the card in a folder of units.
    ///
    /// # Errors
    /// The card cannot be read or is of another format.
    pub fn read(folder: &Path) -> anyhow::Result<Self> {
        Self::read_file(&folder.join(FILE))
    }

    /// Reads a card.
    ///
    /// # Errors
    /// Those of [`PlanCard::read`].
    pub fn read_file(path: &Path) -> anyhow::Result<Self> {
        let text = read_text(path, CARD_LIMIT_BYTES).with_context(|| format!("cannot read {}", path.display()))?;
        #[derive(Deserialize)]
        struct Version {
            format: u32,
        }
        let version: Version = serde_json::from_str(&text).with_context(|| format!("{} is no plan", path.display()))?;
        ensure!(
            version.format <= FORMAT,
            "{}: format {} is newer than {FORMAT}, the newest this program reads",
            path.display(),
            version.format
        );
        serde_json::from_str(&text).with_context(|| format!("{} is no plan", path.display()))
    }

    /// Writes the card.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn write_file(&self, path: &Path) -> anyhow::Result<()> {
        let text = serde_json::to_string_pretty(self).context("cannot write the plan")? + "\n";
        files::write_bytes(path, Existing::Replace, text.as_bytes())
    }

    /// Returns the difference that prevents a merge with the units of another plan; `None` if there is none.
    pub fn difference(&self, other: &PlanCard) -> Option<String> {
        if self.program != other.program {
            return Some(format!("made by version {} of this program, not {}", other.program, self.program));
        }
        if self.kernel != other.kernel {
            return Some(format!(
                "maps made with kernel {}, not {}; `kernel` in the spec makes unlike machines agree",
                other.kernel, self.kernel
            ));
        }
        self.difference_of_sources(other)
    }

    /// Returns the difference of the spec or of a source; `None` if there is none.
    pub fn difference_of_sources(&self, other: &PlanCard) -> Option<String> {
        if self.spec != other.spec {
            return Some("made from another spec".into());
        }
        let names: BTreeSet<&String> = self.sources.keys().chain(other.sources.keys()).collect();
        names.into_iter().find(|name| self.sources.get(*name) != other.sources.get(*name)).map(|name| {
            let what = match (self.sources.contains_key(name), other.sources.contains_key(name)) {
                (true, true) => "another content",
                (true, false) => "no such file",
                _ => "a file that is now absent",
            };
            format!("made from {what} of {name}")
        })
    }
}
