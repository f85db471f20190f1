//! `radome model slurm`.

use std::path::PathBuf;

use super::study;
use crate::output;
use crate::slurm::{Array, word};

/// `radome model slurm`
#[derive(clap::Args)]
pub struct Arguments {
    /// TOML file of a study
    spec: PathBuf,
    #[command(flatten)]
    array: Array,
    /// Dataset folder. Without it, the first task builds one from the study's `dataset`
    #[arg(long)]
    dataset: Option<PathBuf>,
    /// Dataset folder of a condition, in the spec or not; see `radome model study`
    #[arg(long, value_name = "NAME=DIR", value_hint = clap::ValueHint::DirPath)]
    condition: Vec<study::GivenCondition>,
}

/// Prints the script of an array job that runs a study; `sbatch` takes it.
///
/// # Errors
/// The study or the spec of a dataset cannot be read, a condition is given twice, a number is zero, or a path has no
/// full form or cannot stand in a script.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let Arguments { spec: path, array, dataset, condition: given } = arguments;
    array.check()?;
    // Errors in the study are reported here once rather than by every task.
    let (spec, source, conditions) = study::read_study(path)?;
    study::check_sources(path, &conditions, given)?;
    let trainings = spec.variants.len() * spec.seeds.len() * spec.label_fractions.len();
    if trainings < array.tasks && !spec.leave_one_recording_out {
        message!("there are {trainings} trainings for {} tasks: some will have nothing to do", array.tasks);
    }
    let mut command = format!("model study {} -o {}", word(path)?, word(&array.output)?);
    match dataset {
        Some(dataset) => command += &format!(" --dataset {}", word(dataset)?),
        None => drop(study::resolve(path, &source)?),
    }
    for given in given {
        command += &format!(" --condition {}", given.word()?);
    }
    let merge = format!("{command} --report-only");
    output::text_line(&array.script(path, &command, &merge)?)
}
