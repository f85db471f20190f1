use std::path::PathBuf;

use radome_models::{Classifier, dataset::Dataset};

use crate::output;

/// `radome evaluate`
#[derive(clap::Args)]
pub struct Arguments {
    /// Model file
    model: PathBuf,
    /// Dataset folder
    dataset: PathBuf,
    /// Which split
    #[arg(long, value_enum, default_value_t = Split::Test)]
    split: Split,
    /// One object
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, PartialEq, clap::ValueEnum)]
enum Split {
    Train,
    Validation,
    Test,
    All,
}

/// Metrics of a model on one split of a dataset.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let mut classifier = Classifier::load(&arguments.model)?;
    let dataset = Dataset::open(&arguments.dataset)?;
    let split = match arguments.split {
        Split::Train => Some(radome_models::dataset::Split::Train),
        Split::Validation => Some(radome_models::dataset::Split::Validation),
        Split::Test => Some(radome_models::dataset::Split::Test),
        Split::All => None,
    };
    let report = radome_models::evaluate::evaluate(&mut classifier, &dataset, split)?;
    if arguments.json {
        return output::json_line(&report);
    }
    output::text_line(&report.to_string())
}
