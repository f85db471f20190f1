//! `radome model study`.

mod conditions;
mod plan;
mod plots;

use std::cell::RefCell;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, bail};
use radome_driver::recording::Existing;
use radome_files::with_suffix;
use radome_models::dataset::{Dataset, DatasetError};
use radome_models::study::{ConditionScores, Outcome, Progress, Report, Study, StudyError, StudySpec, Times};
use schemars::JsonSchema;
use serde::Deserialize;

use self::conditions::ConditionFile;
pub(super) use self::conditions::{GivenCondition, check_sources};
use crate::dataset::build::build_plan;
use crate::dataset::plan::{Plan, PlanCard};
use crate::shard::Shard;
use crate::{files, output};

/// `radome model study`
#[derive(clap::Args)]
pub struct Arguments {
    /// TOML file with the networks, seeds, shares of labels and noise to compare
    spec: PathBuf,
    /// Folder for results, report, times and plots. The study resumes with the results that it contains
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Dataset folder. Without it, the study builds one from the spec's `dataset`
    #[arg(long)]
    dataset: Option<PathBuf>,
    /// Dataset folder of a condition, in the spec or not. The trained models are evaluated on its maps
    #[arg(long, value_name = "NAME=DIR", value_hint = clap::ValueHint::DirPath)]
    condition: Vec<GivenCondition>,
    /// Do only part I of N of the trainings (from 0), in the same folder as the other parts; `auto/N` takes I from a
    /// Slurm, HyperQueue or Kubernetes array, `auto` takes I and N from a Slurm array. When all are done, --report-only writes the report
    #[arg(long, value_name = "I/N", default_value_t = Shard::WHOLE)]
    shard: Shard,
    /// Only write the report of the present results
    #[arg(long)]
    report_only: bool,
    /// Only report how many trainings there are, how many are done, the hours that the others take (from a few timed steps), and
    /// how many evaluations on conditions are left
    #[arg(long, conflicts_with_all = ["report_only", "shard"])]
    plan: bool,
    /// Print one JSON object per training, and the report; with --plan, print one object
    #[arg(long)]
    json: bool,
}

/// A study's file: what the library knows, and where the maps come from.
#[derive(Deserialize, JsonSchema)]
#[schemars(deny_unknown_fields)]
pub struct StudyFile {
    /// Spec of a dataset to build, relative to the file, where no folder is given.
    dataset: PathBuf,
    /// Other datasets, on which the models of trainings with all labels are evaluated.
    #[serde(default)]
    conditions: Vec<ConditionFile>,
    #[serde(flatten)]
    #[schemars(with = "StudySpec")]
    study: toml::Table,
}

/// Reads a study file. Returns the study, the name of its dataset's spec, and its conditions.
///
/// # Errors
/// The file or one that it names cannot be read, or it is no study.
pub(super) fn read_study(path: &Path) -> anyhow::Result<(StudySpec, PathBuf, Vec<ConditionFile>)> {
    let file: StudyFile = files::read_toml(path, "study")?;
    let mut spec: StudySpec = file.study.try_into().with_context(|| format!("{} is no study", path.display()))?;
    spec.train.weights = spec.train.weights.as_deref().map(|name| resolve(path, name)).transpose()?;
    spec.check()?;
    conditions::check(&file.conditions)?;
    if !file.conditions.is_empty() {
        spec.check_models()?;
    }
    Ok((spec, file.dataset, file.conditions))
}

/// Returns the path of a file that a study names.
///
/// # Errors
/// There is no such file, or it lies where a study's files may not be.
pub(super) fn resolve(study: &Path, name: &Path) -> anyhow::Result<PathBuf> {
    files::resolve_named(study.parent().unwrap_or(Path::new("")), name)
}

/// Trains and evaluates many networks, and writes one report.
///
/// # Errors
/// The spec or the dataset cannot be read, another process is at work in the folder, a training fails, or the report
/// cannot be written.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let (spec, source, conditions) = read_study(&arguments.spec)?;
    output::catch_interrupts()?;
    let folder = &arguments.output;
    std::fs::create_dir_all(folder).with_context(|| format!("cannot make {}", folder.display()))?;
    let maps = match &arguments.dataset {
        Some(maps) => maps.clone(),
        None if arguments.report_only && !folder.join("dataset/dataset.json").exists() => bail!(
            "{} holds no dataset\n\nhint: --dataset DIR names the one that the study was made with",
            folder.display()
        ),
        None => {
            let maps = folder.join("dataset");
            if !arguments.report_only {
                let hint = "undo the change, or give the study another folder by -o";
                make_dataset(&maps, &source, hint, || Plan::new(&resolve(&arguments.spec, &source)?, Shard::WHOLE))?;
            }
            maps
        }
    };
    let dataset = Dataset::open(&maps)?;
    let Shard { index, count } = arguments.shard;
    let study = Study::open(&spec, &dataset, folder, (index, count))?;
    let (conditions, unbuilt) = conditions::open(arguments, &conditions, dataset.header().rdm_spec)?;
    let study = study.with_conditions(&conditions)?;
    if arguments.plan {
        return plan::print(&study, conditions.len() + unbuilt, arguments.json);
    }
    let work_result = if arguments.report_only { Ok(()) } else { work(&study, arguments.json) };
    if work_result.as_ref().is_err_and(is_busy) {
        // The other process writes the report.
        return work_result;
    }
    // Finished trainings are reported, even if the work ended with an error.
    let is_shard = count > 1 && !arguments.report_only;
    let report_result = report(&study, folder, is_shard);
    if let Ok((report, _)) = &report_result {
        let next = match work_result {
            // The error names the remedy.
            Err(_) => "",
            Ok(()) if is_shard => "; when all shards are, --report-only reports",
            Ok(()) => "; the same command carries on",
        };
        if report.done < report.planned {
            message!("{} of {} trainings are done{next}", report.done, report.planned);
        }
        let (evaluated, planned) = conditions::count(report);
        if evaluated < planned {
            message!("{evaluated} of {planned} scores under conditions are done{next}");
        }
    }
    work_result?;
    let (report, times) = report_result?;
    if arguments.json {
        return output::json_line(&report);
    }
    output::text_line(&format!("{}\n{}", report.markdown(), times.markdown()))
}

/// Builds a dataset by the plan of the spec `source`, unless it exists. If another process, such as another shard, is
/// building it, waits for that process. The card of the plan is kept beside the dataset, and one that was built from another spec
/// or other sources is refused with the hint.
fn make_dataset(maps: &Path, source: &Path, hint: &str, plan: impl Fn() -> anyhow::Result<Plan>) -> anyhow::Result<()> {
    const WAIT: Duration = Duration::from_millis(500);
    let card = with_suffix(maps, ".plan.json");
    let mut is_announced = false;
    while !is_dataset(maps) {
        let plan = plan()?;
        if !std::mem::replace(&mut is_announced, true) {
            message!("building {} from {}", maps.display(), source.display());
        }
        match build_plan(&plan, maps, None) {
            Ok(_) => return plan.card.write_file(&card),
            // Another process has built it meanwhile.
            Err(_) if is_dataset(maps) => break,
            Err(error) if is_busy(&error) && !output::interrupted() => std::thread::sleep(WAIT),
            Err(error) => return Err(error),
        }
    }
    if card.exists() {
        let now = plan().with_context(|| format!("{} cannot be compared with its sources", maps.display()))?;
        if let Some(difference) = now.card.difference_of_sources(&PlanCard::read_file(&card)?) {
            bail!("{} was {difference}\n\nhint: {hint}", maps.display());
        }
    }
    Ok(())
}

fn is_dataset(folder: &Path) -> bool {
    folder.join("dataset.json").exists()
}

/// Returns whether an error means that another process is working in a folder.
fn is_busy(error: &anyhow::Error) -> bool {
    let is_busy = |error: &DatasetError| matches!(error, DatasetError::Busy { .. });
    let of_study = match error.downcast_ref::<StudyError>() {
        Some(StudyError::Dataset(error)) => is_busy(error),
        _ => false,
    };
    of_study || error.downcast_ref::<DatasetError>().is_some_and(is_busy)
}

/// Reads the report and times of the finished trainings. A shard does not write them: its report may be older than that
/// of a shard that has ended.
fn report(study: &Study, folder: &Path, is_shard: bool) -> anyhow::Result<(Report, Times)> {
    let (report, times) = (study.report()?, study.times()?);
    if !is_shard {
        write_reports(&report, &times, folder)?;
    }
    Ok((report, times))
}

fn work(study: &Study, json: bool) -> anyhow::Result<()> {
    let bar = output::progress(0, "study");
    // If the reader of the output has gone, the work stops.
    let output_error = RefCell::new(None);
    let continues = || !output::interrupted() && output_error.borrow().is_none();
    let outcome = study.run(&continues, &mut |progress| {
        let begin = |index: usize, count: usize, what: String| {
            bar.set_length(count as u64);
            bar.set_position(index as u64 - 1);
            bar.set_message(what);
        };
        let printed = match progress {
            Progress::Job(job, index, count) => {
                let labels = 100.0 * job.label_fraction;
                begin(index, count, format!("{} seed {} of {labels:.0} % ", job.variant, job.seed));
                return;
            }
            Progress::Evaluation(job, condition, index, count) => {
                begin(index, count, format!("{} seed {} on {condition} ", job.variant, job.seed));
                return;
            }
            Progress::Epoch(_) => return bar.tick(),
            Progress::Done(outcome) => {
                bar.suspend(|| if json { output::json_line(outcome) } else { print_outcome(outcome) })
            }
            Progress::Evaluated(of) => bar.suspend(|| if json { output::json_line(of) } else { print_judgement(of) }),
        };
        bar.inc(1);
        let mut output_error = output_error.borrow_mut();
        *output_error = output_error.take().or(printed.err());
    });
    bar.finish_and_clear();
    outcome?;
    if output::interrupted() {
        bail!("interrupted: trainings that have ended are kept\n\nhint: the same command goes on with the others");
    }
    output_error.into_inner().map_or(Ok(()), Err)
}

fn print_outcome(outcome: &Outcome) -> anyhow::Result<()> {
    let job = &outcome.job;
    let what = match (&outcome.error, &outcome.test) {
        (Some(error), _) => format!("failed: {}", error.lines().next().unwrap_or_default()),
        (None, Some(test)) => {
            // One recording may lack classes.
            let of_test = match &job.held_out {
                Some(recording) => format!("accuracy {:.3} on '{recording}'", test.accuracy),
                None => format!("balanced accuracy {:.3} test", test.balanced_accuracy),
            };
            format!("{of_test}, {:.3} training", outcome.training)
        }
        (None, None) => format!("{:.3} training, no test split", outcome.training),
    };
    message!(
        "{} rate {} labels {:.0} % seed {}: {what}, {:.0} s",
        job.variant,
        job.learning_rate,
        100.0 * job.label_fraction,
        job.seed,
        outcome.training_seconds
    );
    Ok(())
}

fn print_judgement(judgement: &ConditionScores) -> anyhow::Result<()> {
    let ConditionScores { job, condition, metrics, .. } = judgement;
    let what = match metrics {
        Some(metrics) => format!("balanced accuracy {:.3} of {} maps", metrics.balanced_accuracy, metrics.samples),
        None => "its training failed".to_owned(),
    };
    message!("{} rate {} seed {} on {condition}: {what}", job.variant, job.learning_rate, job.seed);
    Ok(())
}

fn write_reports(report: &Report, times: &Times, folder: &Path) -> anyhow::Result<()> {
    let save = |name: &str, text: &str| files::write_bytes(&folder.join(name), Existing::Replace, text.as_bytes());
    save("report.md", &report.markdown())?;
    save("report.json", &serde_json::to_string_pretty(report)?)?;
    save("times.md", &times.markdown())?;
    save("times.json", &serde_json::to_string_pretty(times)?)?;
    plots::write(report, folder)
}
