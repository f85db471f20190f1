use std::cell::RefCell;
use std::path::{Path, PathBuf};

use anyhow::Context;
use radome_models::bounded_file::{TEXT_LIMIT_BYTES, read_text};
use radome_models::dataset::Dataset;
use radome_models::study::{Outcome, Progress, Report, Study, StudySpec};
use radome_sim::bounded_file::named_by_spec;
use schemars::JsonSchema;
use serde::Deserialize;

use crate::picture::plot;
use crate::shard::Shard;
use crate::{files, output};

/// `radome model study`
#[derive(clap::Args)]
pub struct Arguments {
    /// TOML file: which networks, seeds, shares of labels and noise
    spec: PathBuf,
    /// Folder of the study: results as they come, report.md, report.json and plots. What is there is carried on with
    #[arg(short, long)]
    output: PathBuf,
    /// Dataset folder; made from the spec's `dataset` if not given
    #[arg(long)]
    dataset: Option<PathBuf>,
    /// Only this part of the trainings: I/N, auto/N, or auto in a Slurm array
    #[arg(long, default_value_t = Shard::WHOLE)]
    shard: Shard,
    /// The report of what is there, without training anything
    #[arg(long)]
    report_only: bool,
    /// One object a training, and the report
    #[arg(long)]
    json: bool,
}

/// A study's file: what the library knows, and where the maps come from.
#[derive(Deserialize, JsonSchema)]
#[schemars(deny_unknown_fields)]
pub struct StudyFile {
    /// Spec of a dataset to build, relative to the file, where no folder is given.
    dataset: PathBuf,
    #[serde(flatten)]
    #[schemars(with = "StudySpec")]
    study: toml::Table,
}

/// Trains and judges many networks, and writes one report.
///
/// # Errors
/// The spec or the dataset cannot be read, a training fails, or the report cannot be written.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let path = &arguments.spec;
    let text = read_text(path, TEXT_LIMIT_BYTES).with_context(|| format!("cannot read {}", path.display()))?;
    let file: StudyFile = toml::from_str(&text).with_context(|| format!("{} is no study", path.display()))?;
    let mut spec: StudySpec = file.study.try_into().with_context(|| format!("{} is no study", path.display()))?;
    let named = |name: &Path| {
        let base = path.parent().unwrap_or(Path::new(""));
        named_by_spec(base, name).with_context(|| format!("cannot read {}", base.join(name).display()))
    };
    spec.train.weights = spec.train.weights.as_deref().map(named).transpose()?;
    spec.check()?;
    let folder = &arguments.output;
    std::fs::create_dir_all(folder).with_context(|| format!("cannot make {}", folder.display()))?;
    let maps = match &arguments.dataset {
        Some(maps) => maps.clone(),
        None => {
            let maps = folder.join("dataset");
            if !maps.join("dataset.json").exists() {
                let source = named(&file.dataset)?;
                eprintln!("building {} from {}", maps.display(), source.display());
                crate::command::dataset::build(&source, &maps)?;
            }
            maps
        }
    };
    let dataset = Dataset::open(&maps)?;
    let Shard { index, count } = arguments.shard;
    let study = Study::open(&spec, &dataset, folder, (index, count))?;
    let worked = if arguments.report_only { Ok(()) } else { work(&study, arguments.json) };
    // What is done is reported, whatever ended the work.
    let reported = study.report().map_err(anyhow::Error::from);
    let reported = reported.and_then(|report| write(&report, folder).map(|()| report));
    if let Ok(report) = &reported
        && report.done < report.planned
    {
        eprintln!("{} of {} trainings are done; the same command carries on", report.done, report.planned);
    }
    worked?;
    let report = reported?;
    if arguments.json { output::json_line(&report) } else { output::text_line(&report.markdown()) }
}

fn work(study: &Study, json: bool) -> anyhow::Result<()> {
    output::catch_interrupts()?;
    let bar = output::progress(0, "study");
    // Who reads no more of it wants no more of it.
    let trouble = RefCell::new(None);
    let goes_on = || !output::interrupted() && trouble.borrow().is_none();
    let worked = study.run(&goes_on, &mut |progress| match progress {
        Progress::Job(job, index, count) => {
            bar.set_length(count as u64);
            bar.set_position(index as u64 - 1);
            bar.set_message(format!("{} seed {} of {:.0} % ", job.variant, job.seed, 100.0 * job.label_fraction));
        }
        Progress::Epoch(_) => bar.tick(),
        Progress::Done(outcome) => {
            bar.inc(1);
            let said = bar.suspend(|| if json { output::json_line(outcome) } else { told(outcome) });
            let mut trouble = trouble.borrow_mut();
            *trouble = trouble.take().or(said.err());
        }
    });
    bar.finish_and_clear();
    worked?;
    trouble.into_inner().map_or(Ok(()), Err)
}

fn told(outcome: &Outcome) -> anyhow::Result<()> {
    let job = &outcome.job;
    let what = match (&outcome.error, &outcome.test) {
        (Some(error), _) => format!("failed: {}", error.lines().next().unwrap_or_default()),
        (None, Some(test)) => {
            format!("balanced accuracy {:.3} test, {:.3} training", test.balanced_accuracy, outcome.training)
        }
        (None, None) => format!("{:.3} training, no test split", outcome.training),
    };
    eprintln!(
        "{} rate {} labels {:.0} % seed {}: {what}, {:.0} s",
        job.variant,
        job.learning_rate,
        100.0 * job.label_fraction,
        job.seed,
        outcome.training_seconds
    );
    Ok(())
}

fn write(report: &Report, folder: &Path) -> anyhow::Result<()> {
    let save = |name: &str, text: &str| {
        files::write_atomically(&folder.join(name), |file| Ok(std::io::Write::write_all(file, text.as_bytes())?))
    };
    save("report.md", &report.markdown())?;
    save("report.json", &serde_json::to_string_pretty(report)?)?;
    let whole = || report.cells.iter().filter(|cell| cell.label_fraction == 1.0 && cell.done > 0);
    let mut names: Vec<&str> = Vec::new();
    for cell in &report.cells {
        if !names.contains(&cell.variant.as_str()) {
            names.push(&cell.variant);
        }
    }
    let noise: Vec<(&str, Vec<(f64, f64)>)> = whole()
        .map(|cell| {
            let points = cell.noisy.iter().filter_map(|(snr_db, of)| Some((*snr_db, of.as_ref()?.mean)));
            (cell.variant.as_str(), points.collect())
        })
        .filter(|(_, points): &(_, Vec<_>)| !points.is_empty())
        .collect();
    if !noise.is_empty() {
        plot::lines(&folder.join("noise.png"), ("SNR / dB", "balanced accuracy"), &noise)?;
    }
    let labels: Vec<(&str, Vec<(f64, f64)>)> = names
        .iter()
        .map(|name| {
            let of = report.cells.iter().filter(|cell| cell.variant == *name);
            (*name, of.filter_map(|cell| Some((100.0 * cell.label_fraction, cell.test.as_ref()?.mean))).collect())
        })
        .collect();
    if report.cells.iter().any(|cell| cell.label_fraction < 1.0) {
        plot::lines(&folder.join("labels.png"), ("labels / %", "balanced accuracy"), &labels)?;
    }
    let cost: Vec<(&str, Vec<(f64, f64)>)> = whole()
        .filter_map(|cell| {
            // An error of nothing has no place on a logarithmic axis.
            let point = (cell.multiply_adds as f64, (1.0 - cell.test.as_ref()?.mean).max(1e-3));
            Some((cell.variant.as_str(), vec![point]))
        })
        .collect();
    if cost.is_empty() {
        return Ok(());
    }
    plot::scatter(&folder.join("cost.png"), ("multiply-adds", "1 - balanced accuracy"), &cost)
}
