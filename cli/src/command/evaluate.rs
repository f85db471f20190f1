use std::path::PathBuf;

use radome_dsp::Occupancy;
use radome_models::dataset::{self, Dataset, SplitSpec};
use radome_models::{Classifier, evaluate::evaluate};

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
    let wanted = match arguments.split {
        Split::Train => Some(dataset::Split::Train),
        Split::Validation => Some(dataset::Split::Validation),
        Split::Test => Some(dataset::Split::Test),
        Split::All => None,
    };
    let splits = dataset.splits(&SplitSpec::default())?;
    let indices: Vec<usize> =
        (0..dataset.len()).filter(|i| wanted.is_none_or(|w| splits.get(*i) == Some(&w))).collect();
    let metrics = evaluate(&mut classifier, &dataset, &indices)?;
    if arguments.json {
        return output::json_line(&metrics);
    }
    output::text_line(&format!(
        "{} maps: balanced accuracy {:.4}, macro-F1 {:.4}, accuracy {:.4}, populated recall {}",
        metrics.samples,
        metrics.balanced_accuracy,
        metrics.macro_f1,
        metrics.accuracy,
        metrics.populated_recall.map_or("-".to_owned(), |r| format!("{r:.4}"))
    ))?;
    output::text_line(&format!("{:>14} {:>7} {:>7} {:>7}", "truth \\ label", "empty", "one", "two"))?;
    for (class, row) in Occupancy::ALL.iter().zip(&metrics.confusion) {
        output::text_line(&format!("{:>14} {:>7} {:>7} {:>7}", class.name(), row[0], row[1], row[2]))?;
    }
    for class in &metrics.absent {
        eprintln!("no map is labelled {class}: the balanced accuracy is over the other classes");
    }
    Ok(())
}
