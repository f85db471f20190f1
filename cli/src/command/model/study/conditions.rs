//! Conditions of a study: their names in its file, and their datasets, which are built like the study's own or given.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use anyhow::{Context, bail};
use radome_dsp::RdmSpec;
use radome_models::dataset::{Dataset, Domain};
use radome_models::study::{Condition, Report, condition_file_name};
use schemars::JsonSchema;
use serde::Deserialize;

use super::{Arguments, is_dataset, make_dataset, resolve};
use crate::dataset::plan::Plan;
use crate::dataset::rung::RungFile;
use crate::dataset::spec::BuildSpec;
use crate::exit::wrong_use;
use crate::shard::Shard;
use crate::slurm::word_with;

/// Default heading of the table of folders whose maps all come from a sensor.
const REAL: &str = "Real recordings";

/// Another dataset on which the trained models are evaluated.
#[derive(Debug, Clone, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ConditionFile {
    /// Name in the report.
    name: String,
    /// Heading of its table in the report; conditions without one share a table.
    #[serde(default)]
    group: Option<String>,
    /// Spec of its dataset, relative to the study's file.
    #[serde(default)]
    dataset: Option<PathBuf>,
    /// Instead of a dataset: a rung of a ladder, relative to the study's file. Its maps are made as the study's are.
    #[serde(default)]
    ladder: Option<PathBuf>,
    /// Another `raw_snr_db` than the dataset's: thermal noise on the raw samples, dB.
    #[serde(default)]
    raw_snr_db: Option<f64>,
}

/// Name of a condition and the folder of its dataset: `NAME=DIR`.
#[derive(Debug, Clone)]
pub struct GivenCondition {
    name: String,
    folder: PathBuf,
}

impl FromStr for GivenCondition {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text.split_once('=') {
            Some((name, folder)) if !folder.is_empty() => {
                condition_file_name(name).map_err(|error| error.to_string())?;
                Ok(GivenCondition { name: name.to_owned(), folder: PathBuf::from(folder) })
            }
            _ => Err("expected NAME=DIR, such as office=out/office".to_owned()),
        }
    }
}

impl GivenCondition {
    /// Formats `NAME=DIR` with the full form of the folder, as one word of a shell.
    ///
    /// # Errors
    /// The folder has no full form or cannot stand in a script.
    pub fn word(&self) -> anyhow::Result<String> {
        word_with(&format!("{}=", self.name), &self.folder)
    }
}

/// Checks the conditions of a study's file.
///
/// # Errors
/// A name cannot be one of a file, occurs twice, or has no source or two.
pub(super) fn check(files: &[ConditionFile]) -> anyhow::Result<()> {
    let mut names = BTreeSet::new();
    for file in files {
        if !names.insert(condition_file_name(&file.name)?.to_ascii_lowercase()) {
            bail!("two conditions are called '{}', but for signs that file names cannot hold", file.name);
        }
        if file.dataset.is_some() == file.ladder.is_some() {
            bail!("condition '{}': expected one of `dataset` and `ladder`", file.name);
        }
    }
    Ok(())
}

impl ConditionFile {
    /// Returns the path of the spec or rung that the condition names.
    ///
    /// # Errors
    /// There is no such file, or it lies where a study's files may not be.
    pub fn source(&self, study: &Path) -> anyhow::Result<PathBuf> {
        resolve(study, self.named_source())
    }

    fn named_source(&self) -> &Path {
        self.dataset.as_ref().or(self.ladder.as_ref()).map_or(Path::new(""), PathBuf::as_path)
    }

    fn plan(&self, study: &Path, map: RdmSpec) -> anyhow::Result<Plan> {
        let path = self.source(study)?;
        let spec = match self.ladder {
            Some(_) => RungFile::load(&path)?.build_spec(map),
            None => BuildSpec::load(&path)?,
        };
        let spec = spec.with_raw_snr_db(self.raw_snr_db).with_context(|| path.display().to_string())?;
        Plan::of_spec(spec, &path, Shard::WHOLE)
    }

    /// Builds the condition's dataset in a folder of `conditions`, unless it exists.
    fn make(&self, study: &Path, conditions: &Path, map: RdmSpec) -> anyhow::Result<()> {
        let maps = conditions.join(condition_file_name(&self.name)?);
        let hint = "remove the folder to build it anew, or give the condition another name";
        make_dataset(&maps, self.named_source(), hint, || self.plan(study, map))
    }
}

/// Checks `--condition`, and that each condition of the study's file that it does not give has a source.
///
/// # Errors
/// `--condition` gives a name twice, or what the file names is not there or lies where a study's files may not be.
pub fn check_sources(study: &Path, files: &[ConditionFile], given: &[GivenCondition]) -> anyhow::Result<()> {
    check_given(given)?;
    let mut absent = files.iter().filter(|file| given_folder(given, &file.name).is_none());
    absent.try_for_each(|file| file.source(study).map(drop))
}

fn check_given(given: &[GivenCondition]) -> anyhow::Result<()> {
    let mut names = BTreeSet::new();
    if let Some(duplicate) = given.iter().find(|given| !names.insert(&given.name)) {
        wrong_use!("--condition '{}' is given twice", duplicate.name);
    }
    Ok(())
}

fn given_folder<'a>(given: &'a [GivenCondition], name: &str) -> Option<&'a Path> {
    given.iter().find(|given| given.name == name).map(|given| given.folder.as_path())
}

/// Opens the datasets of all conditions: those of the study's file in its order, and then those that only `--condition`
/// names. Builds absent datasets. For a report or a plan, leaves them out instead. Also returns the number of those
/// left out.
///
/// # Errors
/// A dataset cannot be built or read, or `--condition` gives a name twice.
pub(super) fn open(
    arguments: &Arguments,
    files: &[ConditionFile],
    map: RdmSpec,
) -> anyhow::Result<(Vec<Condition>, usize)> {
    let folder = arguments.output.join("conditions");
    check_given(&arguments.condition)?;
    let given = |name: &str| given_folder(&arguments.condition, name);
    let absent: Vec<&ConditionFile> = files.iter().filter(|file| given(&file.name).is_none()).collect();
    let may_build = !(arguments.report_only || arguments.plan);
    if may_build && !absent.is_empty() {
        std::fs::create_dir_all(&folder).with_context(|| format!("cannot make {}", folder.display()))?;
        // Each shard begins with a different dataset, so that shards do not wait for each other.
        for file in absent.iter().cycle().skip(arguments.shard.index % absent.len()).take(absent.len()) {
            file.make(&arguments.spec, &folder, map).with_context(|| format!("condition '{}'", file.name))?;
        }
    }
    let (mut conditions, mut unbuilt) = (Vec::new(), 0);
    for file in files {
        let maps = match given(&file.name) {
            Some(folder) => folder.to_owned(),
            None => folder.join(condition_file_name(&file.name)?),
        };
        if !may_build && given(&file.name).is_none() && !is_dataset(&maps) {
            unbuilt += 1;
            if arguments.report_only {
                message!("condition '{}' is left out: its dataset is not built yet", file.name);
            }
            continue;
        }
        conditions.push(Condition::new(&file.name, file.group.as_deref(), open_dataset(&file.name, &maps)?)?);
    }
    for GivenCondition { name, folder } in &arguments.condition {
        if !files.iter().any(|file| file.name == *name) {
            let dataset = open_dataset(name, folder)?;
            let is_real = dataset.rows().iter().all(|row| row.domain == Domain::Real);
            conditions.push(Condition::new(name, is_real.then_some(REAL), dataset)?);
        }
    }
    Ok((conditions, unbuilt))
}

fn open_dataset(name: &str, maps: &Path) -> anyhow::Result<Dataset> {
    Dataset::open(maps).with_context(|| format!("condition '{name}'"))
}

/// Number of models that were evaluated under conditions, and total number to evaluate.
pub(super) fn count(report: &Report) -> (usize, usize) {
    let conditions = || report.conditions.iter();
    (conditions().map(|of| of.done).sum(), conditions().map(|of| of.planned).sum())
}

#[cfg(test)]
mod tests {
    use super::super::read_study;
    use super::*;
    use crate::files;

    fn fixture(name: &str) -> PathBuf {
        files::fixture(name).expect("a fixture")
    }

    /// Every rung of the ladder gives maps for models of rooms, one for each frame of each recording.
    #[test]
    fn strangers_are_put_to_the_whole_ladder() {
        let study = fixture("studies/strangers.toml");
        let (_, _, conditions) = read_study(&study).expect("a study");
        let rungs =
            std::fs::read_dir(fixture("ladder")).expect("a folder").map(|entry| entry.expect("an entry").path());
        let rungs: BTreeSet<PathBuf> = rungs.filter(|path| path.extension().is_some_and(|e| e == "toml")).collect();
        let ladders: Vec<PathBuf> = conditions.iter().filter_map(|condition| condition.ladder.clone()).collect();
        let found: BTreeSet<PathBuf> =
            ladders.iter().filter_map(|path| path.file_name()).map(|n| fixture("ladder").join(n)).collect();
        assert_eq!(found, rungs);
        let map = BuildSpec::load(&fixture("datasets/rooms.toml")).expect("a dataset").map;
        for condition in conditions {
            let plan = condition.plan(&study, map).expect("a plan");
            assert_eq!(plan.header.rdm_spec, map, "{}", condition.name);
            assert!((3..=16).contains(&plan.units.len()), "{}: {} runs", condition.name, plan.units.len());
        }
    }

    /// The paper's study adds noise to its own frames: names and number of the runs are those without noise.
    #[test]
    fn thermal_noise_is_on_the_frames_of_the_study() {
        let study = fixture("studies/paper.toml");
        let (spec, dataset, conditions) = read_study(&study).expect("a study");
        let clean = Plan::new(&resolve(&study, &dataset).expect("a spec"), Shard::WHOLE).expect("a plan");
        let names = |plan: &Plan| plan.units.iter().map(|unit| unit.sequence.clone()).collect::<Vec<_>>();
        let mut ratios = Vec::new();
        for condition in conditions {
            let plan = condition.plan(&study, clean.header.rdm_spec).expect("a plan");
            assert_eq!(names(&plan), names(&clean));
            assert!(clean.card.difference(&plan.card).is_some_and(|what| what.contains("another spec")));
            ratios.extend(plan.card.spec.raw_snr_db);
        }
        assert_eq!(ratios, spec.snr_db);
    }

    mod hard_cases {
        use super::*;

        /// The datasets of a study and of its conditions were built before this was found.
        #[test]
        fn conditions_without_a_model_of_all_labels_are_refused_with_the_file() {
            let folder = tempfile::tempdir().expect("a folder");
            let path = folder.path().join("study.toml");
            let text = "title = \"a\"\ndataset = \"b.toml\"\nseeds = [1]\nlabel_fractions = [0.5]\n\
                        variants = [{ name = \"hqnn\" }]\nconditions = [{ name = \"c\", dataset = \"d.toml\" }]\n";
            std::fs::write(&path, text).expect("written");
            let error = read_study(&path).expect_err("no model").to_string();
            assert!(error.contains("label_fractions") && error.contains("models of all labels"), "{error}");
            std::fs::write(&path, text.replace("[0.5]", "[0.5, 1.0]")).expect("written");
            assert!(read_study(&path).is_ok());
        }

        #[test]
        fn conditions_that_cannot_be_made_are_refused() {
            let refused = |text: &str, expected: &str| {
                #[derive(Deserialize)]
                struct Files {
                    conditions: Vec<ConditionFile>,
                }
                let files = toml::from_str::<Files>(text).expect("conditions").conditions;
                let error = check(&files).expect_err(text).to_string();
                assert!(error.contains(expected), "{text}: {error}");
            };
            refused("conditions = [{ name = \"a\" }]", "one of `dataset` and `ladder`");
            refused(
                "conditions = [{ name = \"a\", dataset = \"b\", ladder = \"c\" }]",
                "one of `dataset` and `ladder`",
            );
            refused("conditions = [{ name = \"\", dataset = \"b\" }]", "name of a condition");
            refused(
                "conditions = [{ name = \"a 1\", dataset = \"b\" }, { name = \"A_1\", dataset = \"b\" }]",
                "two conditions are called 'A_1'",
            );
            for text in ["office", "=out", "office=", "|=out"] {
                assert!(GivenCondition::from_str(text).is_err(), "{text}");
            }
            assert_eq!(GivenCondition::from_str("a b=c=d").expect("a folder").folder, Path::new("c=d"));
        }
    }
}
