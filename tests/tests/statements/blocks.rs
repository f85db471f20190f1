//! Tables and plots for pages, made from the JSON files of studies.
//!
//! A mark names the study and the kind of table. Kinds with a group of conditions end with its heading in the report:
//! `conditions: GROUP` has a row for each network, `rungs: GROUP` a row for each condition with their mean, and `pairs: GROUP` the
//! differences between circuits and linear heads.

use std::fmt::Write;
use std::fs;

use radome_dsp::Occupancy;
use radome_models::dataset::{Domain, GroupStatistics};
use radome_models::interval::{Interval, t_interval};
use radome_models::study::{
    Cell, ConditionCell, ConditionReport, PAPER_CLEAN, PAPER_FRACTIONS, PAPER_NOISE, PAPER_SHARES, PAPER_SNR_DB,
    Report, Score, Times, mean_scores, paired_difference,
};
use radome_tests::root;

use super::{figure, report, report_file};

/// Pairs of networks with one recipe: with a circuit (or its effect on the inputs), and with a linear layer in its
/// place.
const PAIRS: [(&str, &str); 5] = [
    ("hqnn", "estimator_matched"),
    ("descriptor_hqnn", "descriptor_linear"),
    ("descriptor_hqnn", "two_linear"),
    ("descriptor_hqnn", "two_squashed_linear"),
    ("two_squashed_linear", "two_linear"),
];

/// Mean and sigma of the paper's training maps, dB, by scene and class: synthetic, then real.
const PAPER_CELLS: [(&str, Occupancy, [f64; 2], [f64; 2]); 6] = [
    ("corridor", Occupancy::Empty, [-198.02, 0.00], [-24.98, 5.48]),
    ("corridor", Occupancy::One, [-195.00, 4.43], [-24.55, 5.83]),
    ("corridor", Occupancy::Two, [-194.25, 5.29], [-24.36, 5.90]),
    ("room", Occupancy::Empty, [-196.26, 0.00], [-24.63, 5.52]),
    ("room", Occupancy::One, [-194.52, 3.43], [-24.40, 5.70]),
    ("room", Occupancy::Two, [-194.89, 2.72], [-24.19, 5.67]),
];

/// Mean with its half-width, both multiplied by a factor.
fn format_interval(of: Option<Interval>, factor: f64, digits: usize) -> String {
    let Some(Interval { mean, half_width, .. }) = of else { return "-".to_owned() };
    mean_with_half(factor * mean, half_width.map(|half| factor * half), digits)
}

fn mean_with_half(mean: f64, half_width: Option<f64>, digits: usize) -> String {
    let half = half_width.map_or(String::new(), |half| format!(" ± {half:.digits$}"));
    format!("{mean:.digits$}{half}")
}

/// Our figure and the paper's. Adds "agrees" if the paper's lies in our interval, otherwise the difference.
fn format_comparison(ours: Option<Interval>, paper: Option<f64>, factor: f64, digits: usize) -> String {
    let Some(paper) = paper else { return format_interval(ours, factor, digits) };
    let verdict = ours.map_or(String::new(), |of| {
        let more = of.mean - paper / factor;
        let agrees = of.half_width.is_some_and(|half| more.abs() <= half);
        if agrees { " (agrees)".to_owned() } else { format!(" ({:+.digits$})", factor * more) }
    });
    format!("{} / {paper:.digits$}{verdict}", format_interval(ours, factor, digits))
}

/// Markdown table with these column heads and rows.
fn table(heads: &[&str], rows: impl IntoIterator<Item = Vec<String>>) -> String {
    let mut table = format!("| {} |\n|{}", heads.join(" | "), "---|".repeat(heads.len()));
    for row in rows {
        let _ = write!(table, "\n| {} |", row.join(" | "));
    }
    table
}

fn not_run(study: &str) -> String {
    format!("Not run yet on this simulator: `fixtures/studies/remake {study}`.")
}

/// Markdown table or plot that a mark names.
pub fn block(study: &str, kind: &str, way: &str) -> String {
    match kind {
        "studies" => return studies(way),
        "gradients" => return gradients(study),
        "domains" => return domains(study),
        _ => {}
    }
    let Some(of) = report(study) else { return not_run(study) };
    if kind.ends_with(".svg") {
        let dark = kind.replace(".svg", "-dark.svg");
        return format!(
            "<picture><source media=\"(prefers-color-scheme: dark)\" srcset=\"{way}{study}/{dark}\">\
             <img alt=\"{}\" src=\"{way}{study}/{kind}\"></picture>",
            of.title
        );
    }
    let Some((kind, group)) = kind.split_once(": ") else { return clean_table(&of, kind) };
    let found: Vec<&ConditionReport> =
        of.conditions.iter().filter(|condition| condition.group.as_deref().unwrap_or("Other sets") == group).collect();
    if found.is_empty() {
        return format!("No scores of \"{group}\" in this report yet.");
    }
    match kind {
        "conditions" => conditions(&of, &found),
        "rungs" => rungs(&of, &found),
        "pairs" => pair_table(&of, &found),
        other => panic!("{other} is no kind of table"),
    }
}

/// Networks trained on all labels.
fn cells_of_all_labels(of: &Report) -> impl Iterator<Item = &Cell> {
    of.cells.iter().filter(|cell| cell.label_fraction == 1.0 && cell.done > 0)
}

/// Table of the scores on the test split, under noise on decibels and by share of the labels, with the paper's scores.
fn clean_table(of: &Report, kind: &str) -> String {
    let heads: &[&str] = match kind {
        "clean" => &["failed", "test", "training"],
        "accuracy" => &["test %", "training %"],
        "noise" => &["-20 dB", "-10 dB", "+10 dB", "+20 dB"],
        "labels" => &["10 %", "30 %", "50 %", "100 %"],
        "leak" => &["by scene and class %", "label-free %", "the leak is worth %"],
        other => panic!("{other} is no kind of table"),
    };
    let free = report("paper");
    let row = |cell: &Cell| {
        let cells = clean_row(of, free.as_ref(), cell, kind);
        [vec![cell.variant.clone(), cell.done.to_string()], cells].concat()
    };
    table(&[&["network", "seeds"][..], heads].concat(), cells_of_all_labels(of).map(row))
}

/// Cells of a network in the table of [`clean_table`]. `free` is the study without the leak.
fn clean_row(of: &Report, free: Option<&Report>, cell: &Cell, kind: &str) -> Vec<String> {
    let same = |of: &Report, share: f64| -> Option<Cell> {
        of.cells.iter().find(|other| other.variant == cell.variant && other.label_fraction == share).cloned()
    };
    // Joins our figures with the paper's.
    let beside = |ours: &[Option<Interval>], paper: Option<&[f64]>, factor: f64, digits: usize| -> Vec<String> {
        let paper = |index: usize| paper.and_then(|values| values.get(index).copied());
        ours.iter().enumerate().map(|(index, of)| format_comparison(*of, paper(index), factor, digits)).collect()
    };
    let accuracy = PAPER_CLEAN.iter().find(|(name, ..)| *name == cell.variant).map(|(_, a, b)| [*a, *b]);
    let noise = PAPER_NOISE.iter().find(|(name, _)| *name == cell.variant).map(|(_, values)| &values[..]);
    let labels = PAPER_FRACTIONS.iter().find(|(name, _)| *name == cell.variant).map(|(_, values)| &values[..]);
    match kind {
        "clean" => [vec![cell.failed.to_string()], beside(&[cell.test, cell.training], None, 1.0, 3)].concat(),
        "accuracy" => beside(&[cell.accuracy, cell.training], accuracy.as_ref().map(|of| &of[..]), 100.0, 1),
        "noise" => {
            let at = |snr_db: f64| cell.noisy.iter().find(|(ratio, _)| *ratio == snr_db).and_then(|(_, of)| *of);
            beside(&PAPER_SNR_DB.map(at), noise, 1.0, 3)
        }
        "labels" => {
            let [a, b, c] = PAPER_SHARES;
            let ours = [a, b, c, 1.0].map(|share| same(of, share).and_then(|cell| cell.test));
            beside(&ours, labels, 1.0, 3)
        }
        _ => {
            let without = free.and_then(|free| same(free, 1.0)).and_then(|cell| cell.accuracy);
            let paper = accuracy.map(|[test, _]| [test; 2]);
            let worth = cell.accuracy.zip(without).map(|(a, b)| format!("{:+.1}", 100.0 * (a.mean - b.mean)));
            let ours = beside(&[cell.accuracy, without], paper.as_ref().map(|of| &of[..]), 100.0, 1);
            [ours, vec![worth.unwrap_or("-".to_owned())]].concat()
        }
    }
}

fn cell_of_variant<'a>(condition: &'a ConditionReport, variant: &str) -> Option<&'a ConditionCell> {
    condition.cells.iter().find(|cell| cell.variant == variant)
}

/// Scores of a network's trainings, each the mean over conditions.
fn mean_over(found: &[&ConditionReport], variant: &str) -> Vec<Score> {
    let sets: Option<Vec<&[Score]>> =
        found.iter().map(|condition| Some(cell_of_variant(condition, variant)?.scores.as_slice())).collect();
    sets.map_or_else(Vec::new, |sets| mean_scores(&sets))
}

/// Table of networks by condition, beside the clean test split.
fn conditions(of: &Report, found: &[&ConditionReport]) -> String {
    let names = found.iter().map(|condition| condition.name.as_str());
    let heads: Vec<&str> = ["network", "seeds", "clean"].into_iter().chain(names).collect();
    let row = |cell: &Cell| -> Vec<String> {
        let score = |condition: &&ConditionReport| {
            format_interval(cell_of_variant(condition, &cell.variant).and_then(|of| of.balanced_accuracy), 1.0, 3)
        };
        let first = [cell.variant.clone(), cell.done.to_string(), format_interval(cell.test, 1.0, 3)];
        first.into_iter().chain(found.iter().map(score)).collect()
    };
    table(&heads, cells_of_all_labels(of).map(row))
}

/// Table of conditions by network, with the study's own maps in the first row and the mean in the last. The highest of
/// each row is bold.
fn rungs(of: &Report, found: &[&ConditionReport]) -> String {
    let cells: Vec<&Cell> = cells_of_all_labels(of).collect();
    let row = |name: &str, score: &dyn Fn(&Cell) -> Option<Interval>| -> Vec<String> {
        let scores: Vec<Option<Interval>> = cells.iter().map(|cell| score(cell)).collect();
        let most = scores.iter().flatten().map(|of| of.mean).fold(f64::NEG_INFINITY, f64::max);
        let texts = scores.iter().map(|of| {
            let text = format_interval(*of, 1.0, 3);
            if of.is_some_and(|of| of.mean == most) { format!("**{text}**") } else { text }
        });
        std::iter::once(name.to_owned()).chain(texts).collect()
    };
    let mean = |cell: &Cell| {
        let values: Vec<f64> = mean_over(found, &cell.variant).iter().map(|score| score.balanced_accuracy).collect();
        t_interval(&values)
    };
    let mut rows = vec![row("its training maps", &|cell| cell.training), row("test split", &|cell| cell.test)];
    for condition in found {
        rows.push(row(&condition.name, &|cell| cell_of_variant(condition, &cell.variant)?.balanced_accuracy));
    }
    rows.push(row("mean of these sets", &mean));
    let names = cells.iter().map(|cell| cell.variant.as_str());
    table(&["set"].into_iter().chain(names).collect::<Vec<_>>(), rows)
}

/// Table of paired differences between the networks of [`PAIRS`] that a study has, under the same seed. Columns are the
/// test split, each condition, the mean over conditions, and its excess over the test split.
fn pair_table(of: &Report, found: &[&ConditionReport]) -> String {
    let has = |variant: &str| cells_of_all_labels(of).any(|cell| cell.variant == variant);
    let pairs: Vec<(&str, &str)> = PAIRS.into_iter().filter(|&(circuit, linear)| has(circuit) && has(linear)).collect();
    let home = |variant: &str| {
        cells_of_all_labels(of).find(|cell| cell.variant == variant).map_or(Vec::new(), |cell| cell.scores.clone())
    };
    let change = |variant: &str| -> Vec<Score> {
        let home = home(variant);
        let less = |score: Score| {
            let same = home.iter().find(|other| (other.seed, &other.held_out) == (score.seed, &score.held_out))?;
            Some(Score { balanced_accuracy: score.balanced_accuracy - same.balanced_accuracy, ..score })
        };
        mean_over(found, variant).into_iter().filter_map(less).collect()
    };
    let row = |name: &str, scores: &dyn Fn(&str) -> Vec<Score>| -> Vec<String> {
        let differences = pairs.iter().map(|&(circuit, linear)| difference(&scores(circuit), &scores(linear)));
        std::iter::once(name.to_owned()).chain(differences).collect()
    };
    let mut rows = vec![row("test split", &home)];
    for condition in found {
        rows.push(row(&condition.name, &|variant| mean_over(&[*condition], variant)));
    }
    rows.push(row("mean of these sets", &|variant| mean_over(found, variant)));
    rows.push(row("that mean less the test split", &change));
    let names: Vec<String> = pairs.iter().map(|(circuit, linear)| format!("{circuit} less {linear}")).collect();
    table(&["set"].into_iter().chain(names.iter().map(String::as_str)).collect::<Vec<_>>(), rows)
}

/// Difference with its interval, its sign if the interval excludes zero, and the number of pairs.
fn difference(a: &[Score], b: &[Score]) -> String {
    let Some(Interval { count, mean, half_width, .. }) = paired_difference(a, b) else { return "-".to_owned() };
    let Some(half) = half_width else { return format!("{mean:+.3} (one pair)") };
    let verdict = if mean.abs() <= half {
        "open"
    } else if mean > 0.0 {
        "more"
    } else {
        "less"
    };
    format!("{mean:+.3} ± {half:.3} ({verdict}, {count} pairs)")
}

/// Table of all studies in the fixtures, their progress, and the cost of their trainings.
fn studies(way: &str) -> String {
    let entries = fs::read_dir(root().join("fixtures/studies")).expect("a folder").flatten();
    let mut names: Vec<String> =
        entries.filter_map(|entry| Some(entry.file_name().to_str()?.strip_suffix(".toml")?.to_owned())).collect();
    names.sort();
    let row = |name: &String| {
        let spec = fs::read_to_string(root().join(format!("fixtures/studies/{name}.toml"))).expect("a study");
        let title =
            spec.lines().find_map(|line| line.strip_prefix("title = \"")).expect("a title").trim_end_matches('"');
        let [done, failed, state] = if report_file(name, "report.md").exists() {
            let older = if report_file(name, "report.json").exists() { "" } else { ", by an older simulator" };
            let [done, planned, failed] = ["done", "planned", "failed"].map(|what| figure(name, "all", what));
            [format!("{done} of {planned}"), failed, format!("[{name}]({way}{name}/report.md){older}")]
        } else {
            ["-", "-", "not run yet"].map(str::to_owned)
        };
        let times = fs::read_to_string(report_file(name, "times.json")).ok();
        let times: Option<Times> = times.map(|text| serde_json::from_str(&text).expect("times"));
        let [hours, cpu_hours] = times
            .map_or([0.0; 2], |of| [of.seconds, of.cpu_seconds])
            .map(|seconds| if seconds > 0.0 { format!("{:.2}", seconds / 3600.0) } else { "-".to_owned() });
        vec![format!("`{name}`"), title.to_owned(), done, failed, hours, cpu_hours, state]
    };
    table(&["study", "title", "trainings", "failed", "hours", "CPU-hours", "report"], names.iter().map(row))
}

/// Table of the results of `radome bench trainability`, by qubits and depth.
fn gradients(study: &str) -> String {
    let Ok(text) = fs::read_to_string(report_file(study, "gradients.json")) else { return not_run(study) };
    let rows: Vec<serde_json::Value> = serde_json::from_str(&text).expect("a list");
    let row = |row: &serde_json::Value| -> Vec<String> {
        let square = |key: &str| format!("{:.2e}", row[key].as_f64().expect("a number"));
        let counts = ["depth", "qubits"].map(|key| row[key].to_string());
        counts.into_iter().chain(["angle_gradient_square", "input_gradient_square"].map(square)).collect()
    };
    table(&["depth", "qubits", "by angles", "by inputs"], rows.iter().map(row))
}

/// Table of mean and sigma of maps by source, scene and class, with the paper's beside those of simulated maps.
fn domains(study: &str) -> String {
    let Ok(text) = fs::read_to_string(report_file(study, "domains.json")) else { return not_run(study) };
    let sources: Vec<serde_json::Value> = serde_json::from_str(&text).expect("a list");
    let mut rows = Vec::new();
    for source in &sources {
        let name = source["name"].as_str().expect("a name");
        let cells: Vec<GroupStatistics> = serde_json::from_value(source["cells"].clone()).expect("cells");
        rows.extend(cells.iter().map(|cell| domain_row(name, cell)));
    }
    let heads = [
        "maps of",
        "scene",
        "people",
        "maps",
        "sequences",
        "mean dB",
        "sigma dB",
        "paper, synthetic dB",
        "paper, real dB",
    ];
    table(&heads, rows)
}

fn domain_row(name: &str, cell: &GroupStatistics) -> Vec<String> {
    let GroupStatistics { mean_db, sigma_db, mean_half_width_db, sigma_half_width_db, .. } = *cell;
    let of_paper = PAPER_CELLS
        .iter()
        .find(|(scene, class, ..)| cell.domain == Domain::Sim && *scene == cell.scene && *class == cell.class);
    let paper = of_paper.map_or(["-", "-"].map(str::to_owned), |(.., synthetic, real)| {
        [synthetic, real].map(|[mean, sigma]| format!("{mean:.2}, {sigma:.2}"))
    });
    let people = if cell.class == Occupancy::Empty { "none" } else { cell.class.name() };
    let ours = [
        name.to_owned(),
        cell.scene.clone(),
        people.to_owned(),
        cell.maps.to_string(),
        cell.sequences.to_string(),
        mean_with_half(mean_db, mean_half_width_db, 2),
        mean_with_half(sigma_db, sigma_half_width_db, 2),
    ];
    ours.into_iter().chain(paper).collect()
}

mod tests {
    use serde_json::{Value, json};

    use super::*;

    fn interval(values: [f64; 3]) -> Value {
        serde_json::to_value(t_interval(&values)).expect("JSON")
    }

    fn scores(values: [f64; 3]) -> Value {
        let score = |(seed, value): (u64, f64)| json!({ "seed": seed, "balanced_accuracy": value });
        (1..).zip(values).map(score).collect()
    }

    /// Report of a study of two networks, with scores on its own test split and on two other sets.
    fn study() -> Report {
        let networks =
            [("hqnn", [0.90, 0.80, 0.85], [0.5, 0.4, 0.6]), ("estimator_matched", [0.88, 0.78, 0.83], [0.5, 0.6, 0.4])];
        let none = json!([[0, 0, 0], [0, 0, 0], [0, 0, 0]]);
        let cells = networks.map(|(variant, home, _)| {
            json!({
                "variant": variant, "label_fraction": 1.0, "learning_rate": 1e-3, "done": 3, "failed": 0, "test": interval(home),
                "scores": scores(home), "confusion": none, "noisy": [], "reached_target": 0, "parameters": 1, "multiply_adds": 1,
            })
        });
        let condition = |name: &str, raised: f64| {
            let cells = networks.map(|(variant, _, other)| {
                let other = other.map(|score| score + raised);
                json!({
                    "variant": variant, "done": 3, "balanced_accuracy": interval(other), "scores": scores(other), "confusion": none,
                })
            });
            json!({
                "name": name, "group": "Ladder", "dataset_hash": "", "maps": 1, "done": 6, "planned": 6, "cells": cells,
            })
        };
        let report = json!({
            "title": "Study", "remarks": [], "dataset_hash": "", "maps": 1, "done": 6, "planned": 6, "target": 0.9, "cells": cells,
            "conditions": [condition("gait", 0.0), condition("still", 0.1)],
        });
        serde_json::from_value(report).expect("a report")
    }

    /// Asserts that paired seeds show a difference that means hide. On the study's own split, seeds differ by 0.05 and
    /// networks by 0.02; on the other sets the seeds are independent.
    #[test]
    fn pairs_of_seeds_show_a_difference_that_means_hide() {
        let of = study();
        let found: Vec<&ConditionReport> = of.conditions.iter().collect();
        let table = pair_table(&of, &found);
        let row = |name: &str| {
            table
                .lines()
                .find(|line| line.starts_with(&format!("| {name} |")))
                .unwrap_or_else(|| panic!("{name}: {table}"))
        };
        assert_eq!(row("test split"), "| test split | +0.020 ± 0.000 (more, 3 pairs) |");
        for name in ["gait", "still", "mean of these sets", "that mean less the test split"] {
            assert!(row(name).ends_with("(open, 3 pairs) |"), "{}", row(name));
        }
        assert!(row("that mean less the test split").contains("| -0.020 ± "), "{table}");
    }

    #[test]
    fn the_best_of_each_set_is_bold_and_their_mean_below() {
        let of = study();
        let found: Vec<&ConditionReport> = of.conditions.iter().collect();
        let table = rungs(&of, &found);
        assert!(table.starts_with("| set | hqnn | estimator_matched |\n"), "{table}");
        assert!(table.contains("| test split | **0.850 ± 0.124** | 0.830 ± 0.124 |"), "{table}");
        assert!(
            table
                .lines()
                .last()
                .is_some_and(|line| line.starts_with("| mean of these sets |") && line.contains("0.550"))
        );
        let table = conditions(&of, &found);
        assert!(table.starts_with("| network | seeds | clean | gait | still |\n"), "{table}");
        assert!(table.contains("| hqnn | 3 | 0.850 ± 0.124 | 0.500 ± 0.248 | 0.600 ± 0.248 |"), "{table}");
    }
}
