use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use radome_files::with_suffix;
use radome_models::dataset::{Dataset, DatasetError};
use radome_models::{
    CheckpointLock, EpochReport, Model, NetworkSpec, TrainError, TrainSpec, train_with_checkpoint, training_warnings,
};
use serde_json::json;

use crate::exit::WrongUse;
use crate::output_file::{MODEL_HINT, Overwrite, check_distinct, check_ending};
use crate::{files, output};

/// `radome model train`
#[derive(clap::Args)]
pub struct Arguments {
    /// Dataset folder
    dataset: PathBuf,
    /// Model file to write
    #[arg(short, long, value_name = "FILE.safetensors")]
    output: PathBuf,
    #[command(flatten)]
    overwrite: Overwrite,
    /// TOML file with the settings of the training; absent settings have defaults
    #[arg(long, value_name = "FILE.toml")]
    spec: Option<PathBuf>,
    /// Network, as `radome model list` names it; those whose names begin with descriptor_ need `reference.over_noise` in the spec
    #[arg(long)]
    network: Option<String>,
    /// torchvision's weights to start from, for resnet18, efficientnet_b0 and efficientnet_b0_rgb: its .pth as safetensors
    #[arg(long, value_name = "FILE.safetensors")]
    weights: Option<PathBuf>,
    /// Passes over the training split
    #[arg(long)]
    epochs: Option<usize>,
    /// Seed of initial weights, order and augmentation
    #[arg(long)]
    seed: Option<u64>,
    /// Recording (sequence) that alone is the test split. Where `split.by` of the spec is `subject`, `scene` or `seed`, the other
    /// recordings of its subject, scene or seed are in the test split, too
    #[arg(long, value_name = "SEQUENCE")]
    hold_out: Option<String>,
    /// File that stores the training after each epoch; if it exists, the training resumes from it. It is removed when the model is
    /// written. FILE.safetensors.checkpoint if absent
    #[arg(long, value_name = "FILE")]
    checkpoint: Option<PathBuf>,
    /// Print one JSON object per epoch and one at the end
    #[arg(long)]
    json: bool,
}

impl Arguments {
    fn checkpoint(&self) -> PathBuf {
        self.checkpoint.clone().unwrap_or_else(|| with_suffix(&self.output, ".checkpoint"))
    }

    /// Returns the settings of the file, with those that the options override.
    fn spec(&self) -> anyhow::Result<TrainSpec> {
        let mut spec = read_spec(self.spec.as_deref())?;
        if let Some(name) = &self.network {
            let Some(network) = NetworkSpec::named(name) else {
                let known: Vec<String> = radome_models::networks().into_iter().map(|network| network.name).collect();
                bail!("there is no network '{name}'\n\nhint: there are {}", known.join(", "));
            };
            spec.set_network(network).map_err(|error| WrongUse(error.into()))?;
        }
        if let Some(epochs) = self.epochs {
            spec.epochs = epochs;
            // The spec's `linear_epochs` fits its own number of epochs, so it is limited to the given one.
            spec.linear_epochs = spec.linear_epochs.map(|linear| linear.min(epochs));
        }
        spec.weights = self.weights.clone().or(spec.weights);
        spec.seed = self.seed.unwrap_or(spec.seed);
        spec.split.held_out = self.hold_out.clone().or(spec.split.held_out);
        if let Some(path) = &self.spec {
            // The options may replace settings of the file that do not fit each other.
            let of_file = || format!("{}, with the options of this command, is no training spec", path.display());
            spec.check().with_context(of_file)?;
        }
        Ok(spec)
    }
}

/// Trains a network and writes the weights of its best epoch.
///
/// # Errors
/// The dataset or the spec cannot be read, the output or the checkpoint is another file of the training, or the training fails.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let (spec, checkpoint) = (arguments.spec()?, arguments.checkpoint());
    let spec_file = arguments.spec.as_deref().unwrap_or(Path::new(""));
    let weights = spec.weights.as_deref().unwrap_or(Path::new(""));
    let inputs: [&Path; 3] = [&arguments.dataset, spec_file, weights];
    arguments.overwrite.check(&arguments.output, &inputs)?;
    check_ending(&arguments.output, &["safetensors"], MODEL_HINT)?;
    // Both are removed at the end.
    for removed in [&checkpoint, &CheckpointLock::path_of(&checkpoint)] {
        check_distinct(removed, &arguments.output)?;
        Overwrite::yes().check(removed, &inputs)?;
    }
    let _held = CheckpointLock::new(&checkpoint)?;
    train(arguments, &spec, &checkpoint)
}

/// Trains a network, from the checkpoint if it exists.
fn train(arguments: &Arguments, spec: &TrainSpec, checkpoint: &Path) -> anyhow::Result<()> {
    let dataset = Dataset::open(&arguments.dataset)?;
    let warnings = training_warnings(&dataset, spec)?;
    for warning in &warnings {
        message!("warning: {warning}");
    }
    // That the checkpoint is of this training is known when an epoch is done.
    let mut is_resuming = checkpoint.exists();
    let bar = output::progress(spec.all_epochs() as u64, "training");
    let mut output_error = None;
    let outcome = train_with_checkpoint(&dataset, spec, Some(checkpoint), &mut |report| {
        bar.inc(1);
        if std::mem::take(&mut is_resuming) {
            bar.suspend(|| message!("carrying on from {}", checkpoint.display()));
        }
        let printed = if arguments.json {
            output::json_line(&report)
        } else {
            bar.suspend(|| output::text_line(&epoch_text(&report)))
        };
        output_error = output_error.take().or(printed.err());
    });
    bar.finish_and_clear();
    let outcome = outcome.inspect_err(|error| {
        // After any other error the same command fails again.
        let may_pass =
            matches!(error, TrainError::CheckpointWrite { .. } | TrainError::Dataset(DatasetError::Io { .. }));
        if may_pass && checkpoint.exists() {
            message!("the epochs so far are in {}; the same command carries on", checkpoint.display());
        }
    })?;
    for warning in outcome.warnings.iter().filter(|warning| !warnings.contains(warning)) {
        message!("warning: {warning}");
    }
    // The model is saved even if progress could not be printed.
    save_model(arguments, &outcome.model, checkpoint)?;
    if let Some(error) = output_error {
        return Err(error);
    }
    let file = arguments.output.display().to_string();
    if arguments.json {
        return output::json_line(&json!({ "model": file, "training": outcome.model.card.training }));
    }
    output::text_line(&format!("{file} written"))
}

/// Formats the scores of an epoch for the terminal.
fn epoch_text(report: &EpochReport) -> String {
    format!(
        "start {} epoch {:2}/{}: loss {:.3}, balanced accuracy {:.3} training, {:.3} validation, {:.1} s",
        report.start + 1,
        report.epoch,
        report.epochs,
        report.training_loss,
        report.training_balanced_accuracy,
        report.validation_balanced_accuracy,
        report.seconds
    )
}

/// Writes the model, and then removes the checkpoint.
fn save_model(arguments: &Arguments, model: &Model, checkpoint: &Path) -> anyhow::Result<()> {
    let bytes = model.to_bytes(&arguments.output)?;
    files::write_bytes(&arguments.output, arguments.overwrite.existing(), &bytes).inspect_err(|_| {
        message!(
            "the training is kept in {}; the same command writes the model as soon as it can",
            checkpoint.display()
        );
    })?;
    // Not before: a kill would lose the training. A file that cannot be removed does no harm: a new training repeats the last step.
    let _ = std::fs::remove_file(checkpoint);
    Ok(())
}

/// Reads the settings of a training from a TOML file, without a check of their values; defaults without one.
fn read_spec(path: Option<&Path>) -> anyhow::Result<TrainSpec> {
    let Some(path) = path else { return Ok(TrainSpec::default()) };
    let mut spec: TrainSpec = files::read_toml(path, "training spec")?;
    if let Some(weights) = &spec.weights {
        spec.weights = Some(files::resolve_named(path.parent().unwrap_or(Path::new("")), weights)?);
    }
    Ok(spec)
}
