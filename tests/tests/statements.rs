//! Compares figures on pages with the reports of studies, and reports with the JSON files beside them.
//!
//! A page marks a figure, `<!-- = controls hqnn mean -->0.779`, and a table, `<!-- figures: controls clean -->` to `<!-- end -->`. Figures
//! are those of `docs/studies/STUDY/report.md`; tables are made of the JSON file beside it (`blocks.rs`). To rewrite
//! both:
//!
//!     RADOME_FIGURES=write cargo test --release -p radome-tests --test commands statements::

mod blocks;

use std::fmt::Write;
use std::fs;
use std::path::PathBuf;

use radome_models::study::Report;
use radome_tests::root;

use self::blocks::block;

/// Pages with marks, and the relative path from each to the folder of reports.
const PAGES: [(&str, &str); 3] =
    [("docs/paper.md", "studies/"), ("docs/performance.md", "studies/"), ("docs/studies/README.md", "")];

fn report_file(study: &str, name: &str) -> PathBuf {
    root().join("docs/studies").join(study).join(name)
}

/// Figure of a network in a report's first table, as printed there. The network `all` has the numbers of trainings
/// `done`, `planned` and `failed`, the `spread` of the means on the test split, and the least on the `training` maps.
fn figure(study: &str, network: &str, figure: &str) -> String {
    let report =
        fs::read_to_string(report_file(study, "report.md")).unwrap_or_else(|e| panic!("report of {study}: {e}"));
    let table = report.lines().skip_while(|line| !line.starts_with("| network")).skip(2);
    let rows: Vec<Vec<&str>> =
        table.take_while(|line| line.starts_with('|')).map(|line| line.split('|').map(str::trim).collect()).collect();
    let (failed, test, training, paper) = (4, 5, 6, 9);
    let first = |cell: &str| cell.split(' ').next().unwrap_or_default().to_owned();
    let column = |index: usize| -> Vec<f64> {
        rows.iter()
            .map(|row| first(row[index]).parse::<f64>().unwrap_or_else(|e| panic!("{study} {}: {e}", row[1])))
            .collect()
    };
    let least = |index: usize| column(index).into_iter().fold(f64::INFINITY, f64::min);
    let most = |index: usize| column(index).into_iter().fold(f64::NEG_INFINITY, f64::max);
    let (counts, _) = report.lines().find_map(|line| line.split_once(" trainings")).expect("a line of numbers");
    let (done, planned) = counts.split_once(" of ").expect("two numbers");
    // 0.779 ± 0.006 [0.773, 0.783]
    let row = rows.iter().find(|row| row[1] == network);
    assert!(row.is_some() || network == "all", "the report of {study} has no {network}");
    let (interval, range) =
        row.and_then(|row| row[test].split_once(" [")).unwrap_or((row.map_or("", |row| row[test]), "]"));
    let (low, high) = range.trim_end_matches(']').split_once(", ").unwrap_or_default();
    match (figure, row) {
        ("done", None) => done.to_owned(),
        ("planned", None) => planned.to_owned(),
        ("failed", None) => column(failed).iter().sum::<f64>().to_string(),
        ("spread", None) => format!("{:.3}", most(test) - least(test)),
        ("training", None) => format!("{:.3}", least(training)),
        ("test", Some(_)) => interval.to_owned(),
        ("mean", Some(_)) => first(interval),
        ("least", Some(_)) => low.to_owned(),
        ("most", Some(_)) => high.to_owned(),
        ("training", Some(row)) => first(row[training]),
        ("paper", Some(row)) => first(row[paper]),
        _ => panic!("the report of {study} has no {figure} of {network}"),
    }
}

/// Report of a study; `None` if the study has not been run.
fn report(study: &str) -> Option<Report> {
    let path = report_file(study, "report.json");
    let text = fs::read_to_string(&path).ok()?;
    Some(serde_json::from_str(&text).unwrap_or_else(|e| panic!("{}: {e}", path.display())))
}

/// Length of the figure at the beginning of a text: `0.779`, `0.779 ± 0.006`.
fn figure_length(text: &str) -> usize {
    let digits = |text: &str| {
        let length = text.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(text.len());
        text[..length].trim_end_matches('.').len()
    };
    let first = digits(text);
    text[first..].strip_prefix(" ± ").map_or(first, |rest| first + " ± ".len() + digits(rest))
}

/// Page with the figures of the reports filled in, and the errors found on it.
fn fill_page(page: &str, text: &str, way: &str) -> (String, Vec<String>) {
    let (mut out, mut rest, mut wrong) = (String::new(), text, Vec::new());
    while let Some((before, mark)) = rest.split_once("<!-- ") {
        let (name, tail) = mark.split_once(" -->").unwrap_or_else(|| panic!("{page}: a comment has no end"));
        let _ = write!(out, "{before}<!-- {name} -->");
        let place = format!("{page}:{}: {name}", 1 + out.matches('\n').count());
        // A figure without a mark is compared with no report.
        let is_loose = |(at, _): &(usize, &str)| before[at + 2..].bytes().take_while(u8::is_ascii_digit).count() == 3;
        if page == "docs/paper.md" && before.match_indices("0.").any(|found| is_loose(&found)) {
            wrong.push(format!("{place}: before it stands a figure without a mark"));
        }
        let (stands, expected) = match name.split_whitespace().collect::<Vec<_>>()[..] {
            ["=", study, network, what] => (&tail[..figure_length(tail)], figure(study, network, what)),
            ["figures:", study, ref kind @ ..] => {
                let length = tail.find("<!-- end -->").unwrap_or_else(|| panic!("{place} has no end"));
                (&tail[..length], format!("\n\n{}\n\n", block(study, &kind.join(" "), way)))
            }
            _ => ("", String::new()),
        };
        // GitHub parses a line that begins with a comment as HTML.
        if name.starts_with('=') && (before.is_empty() || before.ends_with('\n')) {
            wrong.push(format!("{place} begins a line"));
        }
        if stands != expected {
            wrong.push(format!("{place} is {stands} on the page and {expected} by the report"));
        }
        out += &expected;
        rest = &tail[stands.len()..];
    }
    (out + rest, wrong)
}

#[test]
fn figures_on_pages_are_those_of_the_reports() {
    let mut all = Vec::new();
    for (page, way) in PAGES {
        let path = root().join(page);
        let text = fs::read_to_string(&path).unwrap_or_else(|e| panic!("{page}: {e}"));
        let (out, wrong) = fill_page(page, &text, way);
        if std::env::var("RADOME_FIGURES").is_ok_and(|what| what == "write") && out != text {
            fs::write(&path, out).expect("writable");
        } else {
            all.extend(wrong);
        }
    }
    assert!(all.is_empty(), "{}\n\nhint: RADOME_FIGURES=write writes them anew", all.join("\n"));
}

#[test]
fn a_wrong_figure_is_reported_with_its_position_and_both_values() {
    let right = format!("\nit has <!-- = controls hqnn mean -->{}.", figure("controls", "hqnn", "mean"));
    assert_eq!(fill_page("page", &right, ""), (right.clone(), Vec::new()));
    let (out, wrong) = fill_page("page", "\nit has <!-- = controls hqnn mean -->0.1.", "");
    assert_eq!(out, right);
    assert!(wrong.len() == 1 && wrong[0].starts_with("page:2: = controls hqnn mean is 0.1 on the page"), "{wrong:?}");
}

/// Asserts that marks of tables accept names of groups with spaces.
#[test]
fn tables_of_conditions_are_named_by_their_group() {
    let text = "<!-- figures: none rungs: Real recordings --><!-- end -->";
    let (out, wrong) = fill_page("page", text, "");
    assert!(out.contains("Not run yet") && out.contains("remake none`") && out.ends_with("<!-- end -->"), "{out}");
    assert!(wrong.len() == 1 && wrong[0].starts_with("page:1: figures: none rungs: Real recordings is"), "{wrong:?}");
    assert_eq!(fill_page("page", &out, ""), (out.clone(), Vec::new()));
}

#[test]
fn reports_are_those_of_the_json_files_beside_them() {
    for entry in fs::read_dir(root().join("docs/studies")).expect("a folder").flatten() {
        let name = entry.file_name().into_string().expect("a name");
        if let Some(of) = report(&name) {
            let page = fs::read_to_string(report_file(&name, "report.md")).expect("a page");
            assert_eq!(page, of.markdown(), "{name}");
        }
    }
}
