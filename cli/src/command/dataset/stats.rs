//! `radome dataset stats`.

use std::path::PathBuf;

use anyhow::ensure;
use radome_models::dataset::{Dataset, Split, SplitSpec, statistics};
use radome_models::standardise::LEAST_SIGMA_DB;

use super::features;
use crate::dataset::features::compare;
use crate::one_of::one_of;
use crate::output::{self, or_dash};

/// `radome dataset stats`
#[derive(clap::Args)]
pub struct Arguments {
    /// Dataset folder
    dataset: PathBuf,
    /// Use only the maps of this split; all maps if absent. Sequences without a split of their own are divided by the default rule of
    /// trainings
    #[arg(long, value_parser = one_of(SPLITS))]
    split: Option<Split>,
    /// Show features of people in the maps instead, each beside its measured value
    #[arg(long)]
    features: bool,
    /// With --features: recordings of an empty room, or scenes, to measure jitter and drift of static echoes
    #[arg(long, requires = "features", value_name = "SOURCE", value_hint = clap::ValueHint::AnyPath)]
    frames: Vec<String>,
    /// With --features: file of measured values; fixtures/features/walking.toml if absent
    #[arg(long, requires = "features", value_name = "FILE.toml")]
    measured: Option<PathBuf>,
    /// Print a JSON list of objects
    #[arg(long)]
    json: bool,
}

const SPLITS: &[(&str, Split)] = &[("train", Split::Train), ("validation", Split::Validation), ("test", Split::Test)];

/// Prints the table. A zero sigma is an error, reported after the table.
///
/// # Errors
/// The dataset or the measured features cannot be read, or a class has a sigma of zero.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let dataset = Dataset::open(&arguments.dataset)?;
    let indices: Vec<usize> = match arguments.split {
        Some(split) => of_split(&dataset, split)?,
        None => (0..dataset.len()).collect(),
    };
    if arguments.features {
        let rows = compare(&dataset, &indices, &arguments.frames, arguments.measured.as_deref())?;
        return features::print(&rows, !arguments.frames.is_empty(), arguments.json);
    }
    let table = statistics(&dataset, &indices)?;
    if arguments.json {
        output::json_line(&table)?;
    } else {
        let width = table.iter().map(|row| row.scene.chars().count()).max().unwrap_or(0).max(5);
        output::text_line(&format!(
            "{:<6} {:<width$} {:<6} {:>7} {:>9} {:>9} {:>6} {:>9} {:>6} {:>9} {:>9}",
            "domain", "scene", "class", "maps", "sequences", "mean dB", "±", "sigma dB", "±", "raised", "by dB"
        ))?;
        for row in &table {
            let raised = row.raised_fraction.map_or("-".to_owned(), |fraction| format!("{:.1} %", 100.0 * fraction));
            output::text_line(&format!(
                "{:<6} {:<width$} {:<6} {:>7} {:>9} {:>9.2} {:>6} {:>9.2} {:>6} {:>9} {:>9}",
                row.domain.to_string(),
                row.scene,
                row.class.name(),
                row.maps,
                row.sequences,
                row.mean_db,
                or_dash(row.mean_half_width_db, 2),
                row.sigma_db,
                or_dash(row.sigma_half_width_db, 2),
                raised,
                or_dash(row.raised_level_db, 1),
            ))?;
        }
    }
    let flat: Vec<String> = table
        .iter()
        .filter(|row| row.sigma_db < LEAST_SIGMA_DB)
        .map(|row| format!("{} {} {} (all cells at {:.2} dB)", row.domain, row.scene, row.class, row.mean_db))
        .collect();
    ensure!(
        flat.is_empty(),
        "sigma is zero in {}: such maps hold nothing to learn but that they are such\n\nhint: noise-free simulated maps sit \
         at the dB floor; add receiver noise to the simulation",
        flat.join(", ")
    );
    Ok(())
}

/// Returns the indices of a split's maps. Says by which rule sequences are divided that have no split of their own.
fn of_split(dataset: &Dataset, split: Split) -> anyhow::Result<Vec<usize>> {
    let rule = SplitSpec::default();
    let splits = dataset.splits(&rule)?;
    let undivided = dataset.rows().iter().filter(|row| row.split.is_none()).count();
    if undivided > 0 {
        let percent = |share: f64| 100.0 * share;
        message!(
            "{undivided} of {} maps have no split of their own: their sequences are divided by the default rule of trainings, {:.0} % \
             for validation and {:.0} % for test",
            dataset.len(),
            percent(rule.validation),
            percent(rule.test)
        );
    }
    Ok((0..dataset.len()).filter(|index| splits.get(*index) == Some(&split)).collect())
}
