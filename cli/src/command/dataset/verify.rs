//! `radome dataset verify`.

use std::path::PathBuf;

use anyhow::ensure;
use radome_models::dataset::{Dataset, SplitBy, SplitSpec, verify};

use crate::one_of::one_of;
use crate::output;

/// `radome dataset verify`
#[derive(clap::Args)]
pub struct Arguments {
    /// Dataset folder
    dataset: PathBuf,
    /// Property, besides the sequence, that no two splits may share. Sequences without a split of their own are divided by the default
    /// rule of trainings, by sequence
    #[arg(long, value_name = "PROPERTY", value_parser = one_of(PROPERTIES), default_value = "sequence")]
    by: SplitBy,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

const PROPERTIES: &[(&str, SplitBy)] = &[
    ("sequence", SplitBy::Sequence),
    ("subject", SplitBy::Subject),
    ("scene", SplitBy::Scene),
    ("seed", SplitBy::Seed),
];

/// Number of errors of a kind that are printed; the rest is only counted.
const SHOWN: usize = 5;

/// Reads all files and prints all errors found; fails if there are any.
///
/// # Errors
/// The dataset cannot be read, or something is wrong with it.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let dataset = Dataset::open(&arguments.dataset)?;
    let report = verify(&dataset, &SplitSpec { by: arguments.by, ..SplitSpec::default() })?;
    if arguments.json {
        output::json_line(&report)?;
    } else {
        let [train, validation, test] = report.split_maps;
        output::text_line(&format!(
            "{}: {} maps in {} sequences; {train} for training, {validation} for validation, {test} for test",
            arguments.dataset.display(),
            report.maps,
            report.sequences
        ))?;
        let name = |map: &usize| {
            let row = dataset.rows().get(*map);
            row.map_or_else(String::new, |row| format!("map {map} ({} frame {})", row.recording, row.frame))
        };
        show(report.damaged.iter().map(|damage| damage.what.clone()), "damaged maps")?;
        let duplicate = |d: &radome_models::dataset::Duplicate| {
            let maps: Vec<String> = d.maps.iter().take(SHOWN).map(name).collect();
            let splits: Vec<String> = d.splits.iter().map(ToString::to_string).collect();
            let count = d.maps.len();
            format!("{count} maps of the same {}, in {}: {}", d.what, splits.join(" and "), maps.join(", "))
        };
        show(report.duplicates.iter().map(duplicate), "groups of duplicates")?;
        let leak = |leak: &radome_models::dataset::Leak| {
            let splits: Vec<String> = leak.splits.iter().map(ToString::to_string).collect();
            format!("{} '{}' is in {}", leak.by, leak.name, splits.join(" and "))
        };
        show(report.leaks.iter().map(leak), "leaks between splits")?;
        let ungrouped = report.ungrouped.iter();
        let ungrouped =
            ungrouped.map(|sequence| format!("sequence '{sequence}' shows people and has no {}", arguments.by));
        show(ungrouped, "sequences without one")?;
        if report.pairs > 0 {
            output::text_line(&format!("{} pairs of a recording and its mirror", report.pairs))?;
        }
        show(report.unpaired.iter().map(|fault| format!("pair '{}' {}", fault.pair, fault.what)), "pairs")?;
    }
    let by = arguments.by;
    let is_left_to_training = dataset.rows().iter().any(|row| row.split.is_none());
    let hint = match report.leaks.iter().any(|leak| leak.by == by) && is_left_to_training && by != SplitBy::Sequence {
        true => format!(
            "\n\nhint: split = {{ by = \"{by}\" }} keeps each {by} in one split, in the settings of a training or, once and for all, in the \
             dataset's spec"
        ),
        false => String::new(),
    };
    ensure!(
        report.is_sound(),
        "{}: {} damaged maps, {} groups of duplicates, {} leaks between splits, {} pairs that are none{hint}",
        arguments.dataset.display(),
        report.damaged.len(),
        report.duplicates.len(),
        report.leaks.len(),
        report.unpaired.len()
    );
    Ok(())
}

fn show(lines: impl ExactSizeIterator<Item = String>, what: &str) -> anyhow::Result<()> {
    let count = lines.len();
    for line in lines.take(SHOWN) {
        output::text_line(&line)?;
    }
    if count > SHOWN {
        output::text_line(&format!("and {} more {what}", count - SHOWN))?;
    }
    Ok(())
}
