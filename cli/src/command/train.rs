use std::path::PathBuf;

use anyhow::Context;
use radome_models::dataset::Dataset;
use radome_models::{TrainSpec, train};
use serde_json::json;

use crate::{files, output};

/// `radome train`
#[derive(clap::Args)]
pub struct Arguments {
    /// Dataset folder
    dataset: PathBuf,
    /// Model file to write
    #[arg(short, long)]
    output: PathBuf,
    /// TOML file with the settings of the training; defaults for what it leaves out
    #[arg(long)]
    spec: Option<PathBuf>,
    /// Passes over the training split
    #[arg(long)]
    epochs: Option<usize>,
    /// Seed of initial weights and order
    #[arg(long)]
    seed: Option<u64>,
    /// One object an epoch and one at the end
    #[arg(long)]
    json: bool,
}

/// Trains the HQNN and writes the weights of its best epoch.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    files::check_parent(&arguments.output)?;
    let dataset = Dataset::open(&arguments.dataset)?;
    let mut spec = match &arguments.spec {
        None => TrainSpec::default(),
        Some(path) => {
            let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
            toml::from_str(&text).with_context(|| format!("{} is no training spec", path.display()))?
        }
    };
    if let Some(epochs) = arguments.epochs {
        spec.epochs = epochs;
    }
    if let Some(seed) = arguments.seed {
        spec.seed = seed;
    }
    let mut trouble = None;
    let outcome = train(&dataset, &spec, &mut |report| {
        let said = if arguments.json {
            output::json_line(&report)
        } else {
            output::text_line(&format!(
                "start {} epoch {:2}/{}: loss {:.3}, balanced accuracy {:.3} training, {:.3} validation, {:.1} s",
                report.start + 1,
                report.epoch,
                report.epochs,
                report.training_loss,
                report.training_balanced_accuracy,
                report.validation_balanced_accuracy,
                report.seconds
            ))
        };
        trouble = trouble.take().or(said.err());
    })?;
    if let Some(error) = trouble {
        return Err(error);
    }
    outcome.model.save(&arguments.output)?;
    let file = arguments.output.display().to_string();
    if arguments.json {
        return output::json_line(&json!({ "model": file, "training": outcome.model.card.training }));
    }
    output::text_line(&format!("{file} written"))
}
