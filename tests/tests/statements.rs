//! Figures on pages against the reports of studies that they are of, and reports against the JSON files beside them.
//!
//! A page marks a figure, `<!-- = controls hqnn mean -->0.779`, and a table, `<!-- figures: controls clean -->` to `<!-- end -->`. Figures
//! are those of `docs/studies/STUDY/report.md`; tables are made of the JSON file beside it. This writes both anew:
//!
//!     RADOME_FIGURES=write cargo test --release -p radome-tests --test commands statements::

use std::fmt::Write;
use std::fs;
use std::path::PathBuf;

use radome_models::study::{
    Cell, Interval, PAPER_CLEAN, PAPER_FRACTIONS, PAPER_NOISE, PAPER_SHARES, PAPER_SNR_DB, Report,
};
use radome_tests::root;

/// Pages with marks, and the way from each to the folder of reports.
const PAGES: [(&str, &str); 3] =
    [("docs/paper.md", "studies/"), ("docs/performance.md", "studies/"), ("docs/studies/README.md", "")];

fn file(study: &str, name: &str) -> PathBuf {
    root().join("docs/studies").join(study).join(name)
}

/// A figure of a report's first table as it stands there; of `all` networks how many trainings are `done`, `planned` and `failed`, the
/// `spread` of the means on the test split, and the least on the `training` maps.
fn figure(study: &str, network: &str, figure: &str) -> String {
    let report = fs::read_to_string(file(study, "report.md")).unwrap_or_else(|e| panic!("report of {study}: {e}"));
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

/// The report of a study; `None` if it is not run yet.
fn report(study: &str) -> Option<Report> {
    let path = file(study, "report.json");
    let text = fs::read_to_string(&path).ok()?;
    Some(serde_json::from_str(&text).unwrap_or_else(|e| panic!("{}: {e}", path.display())))
}

/// A mean with its interval, times a factor.
fn told(of: Option<Interval>, factor: f64, digits: usize) -> String {
    let Some(Interval { mean, half_width, .. }) = of else { return "-".to_owned() };
    let half = half_width.map_or(String::new(), |half| format!(" ± {:.digits$}", factor * half));
    format!("{:.digits$}{half}", factor * mean)
}

/// Our figure, and the paper's beside it: whether the paper's is in our interval, or how much more ours is.
fn compared(ours: Option<Interval>, paper: Option<f64>, factor: f64, digits: usize) -> String {
    let Some(paper) = paper else { return told(ours, factor, digits) };
    let verdict = ours.map_or(String::new(), |of| {
        let more = of.mean - paper / factor;
        let agrees = of.half_width.is_some_and(|half| more.abs() <= half);
        if agrees { " (agrees)".to_owned() } else { format!(" ({:+.digits$})", factor * more) }
    });
    format!("{} / {paper:.digits$}{verdict}", told(ours, factor, digits))
}

/// A table of these heads and rows.
fn table(heads: &[&str], rows: impl IntoIterator<Item = Vec<String>>) -> String {
    let mut table = format!("| {} |\n|{}", heads.join(" | "), "---|".repeat(heads.len()));
    for row in rows {
        let _ = write!(table, "\n| {} |", row.join(" | "));
    }
    table
}

/// The table or plot that a mark names.
fn block(study: &str, kind: &str, way: &str) -> String {
    match kind {
        "studies" => return studies(way),
        "gradients" => return gradients(study),
        _ => {}
    }
    let Some(of) = report(study) else {
        return format!("Not run yet on this simulator: `fixtures/studies/remake {study}`.");
    };
    if kind.ends_with(".svg") {
        let dark = kind.replace(".svg", "-dark.svg");
        return format!(
            "<picture><source media=\"(prefers-color-scheme: dark)\" srcset=\"{way}{study}/{dark}\">\
             <img alt=\"{}\" src=\"{way}{study}/{kind}\"></picture>",
            of.title
        );
    }
    let free = report("paper");
    let same = |of: &Report, cell: &Cell, share: f64| -> Option<Cell> {
        of.cells.iter().find(|other| other.variant == cell.variant && other.label_fraction == share).cloned()
    };
    let heads: &[&str] = match kind {
        "clean" => &["failed", "test", "training"],
        "accuracy" => &["test %", "training %"],
        "noise" => &["-20 dB", "-10 dB", "+10 dB", "+20 dB"],
        "labels" => &["10 %", "30 %", "50 %", "100 %"],
        "leak" => &["by scene and class %", "label-free %", "the leak is worth %"],
        other => panic!("{other} is no kind of table"),
    };
    let cells = |cell: &Cell| -> Vec<String> {
        // Our figures with the paper's beside them.
        let beside = |ours: &[Option<Interval>], paper: Option<&[f64]>, factor: f64, digits: usize| -> Vec<String> {
            let paper = |index: usize| paper.and_then(|values| values.get(index).copied());
            ours.iter().enumerate().map(|(index, of)| compared(*of, paper(index), factor, digits)).collect()
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
                let ours = [a, b, c, 1.0].map(|share| same(&of, cell, share).and_then(|cell| cell.test));
                beside(&ours, labels, 1.0, 3)
            }
            _ => {
                let without = free.as_ref().and_then(|free| same(free, cell, 1.0)).and_then(|cell| cell.accuracy);
                let paper = accuracy.map(|[test, _]| [test; 2]);
                let worth = cell.accuracy.zip(without).map(|(a, b)| format!("{:+.1}", 100.0 * (a.mean - b.mean)));
                let ours = beside(&[cell.accuracy, without], paper.as_ref().map(|of| &of[..]), 100.0, 1);
                [ours, vec![worth.unwrap_or("-".to_owned())]].concat()
            }
        }
    };
    let whole = of.cells.iter().filter(|cell| cell.label_fraction == 1.0 && cell.done > 0);
    let row = |cell: &Cell| [vec![cell.variant.clone(), cell.done.to_string()], cells(cell)].concat();
    table(&[&["network", "seeds"][..], heads].concat(), whole.map(row))
}

/// All studies that there are files of, and how far each is run.
fn studies(way: &str) -> String {
    let entries = fs::read_dir(root().join("fixtures/studies")).expect("a folder").flatten();
    let mut names: Vec<String> =
        entries.filter_map(|entry| Some(entry.file_name().to_str()?.strip_suffix(".toml")?.to_owned())).collect();
    names.sort();
    let row = |name: &String| {
        let spec = fs::read_to_string(root().join(format!("fixtures/studies/{name}.toml"))).expect("a study");
        let title =
            spec.lines().find_map(|line| line.strip_prefix("title = \"")).expect("a title").trim_end_matches('"');
        let [done, failed, state] = if file(name, "report.md").exists() {
            let older = if file(name, "report.json").exists() { "" } else { ", by an older simulator" };
            let [done, planned, failed] = ["done", "planned", "failed"].map(|what| figure(name, "all", what));
            [format!("{done} of {planned}"), failed, format!("[{name}]({way}{name}/report.md){older}")]
        } else {
            ["-", "-", "not run yet"].map(str::to_owned)
        };
        vec![format!("`{name}`"), title.to_owned(), done, failed, state]
    };
    table(&["study", "title", "trainings", "failed", "report"], names.iter().map(row))
}

/// What `radome bench trainability` found, by qubits and depth.
fn gradients(study: &str) -> String {
    let Ok(text) = fs::read_to_string(file(study, "gradients.json")) else {
        return format!("Not run yet on this simulator: `fixtures/studies/remake {study}`.");
    };
    let rows: Vec<serde_json::Value> = serde_json::from_str(&text).expect("a list");
    let row = |row: &serde_json::Value| -> Vec<String> {
        let square = |key: &str| format!("{:.2e}", row[key].as_f64().expect("a number"));
        let counts = ["depth", "qubits"].map(|key| row[key].to_string());
        counts.into_iter().chain(["angle_gradient_square", "input_gradient_square"].map(square)).collect()
    };
    table(&["depth", "qubits", "by angles", "by inputs"], rows.iter().map(row))
}

/// Length of the figure that a text begins with: `0.779`, `0.779 ± 0.006`.
fn figure_length(text: &str) -> usize {
    let digits = |text: &str| {
        let length = text.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(text.len());
        text[..length].trim_end_matches('.').len()
    };
    let first = digits(text);
    text[first..].strip_prefix(" ± ").map_or(first, |rest| first + " ± ".len() + digits(rest))
}

/// A page with its figures as the reports have them, and what was wrong on it.
fn filled(page: &str, text: &str, way: &str) -> (String, Vec<String>) {
    let (mut out, mut rest, mut wrong) = (String::new(), text, Vec::new());
    while let Some((before, mark)) = rest.split_once("<!-- ") {
        let (name, tail) = mark.split_once(" -->").unwrap_or_else(|| panic!("{page}: a comment has no end"));
        let _ = write!(out, "{before}<!-- {name} -->");
        let place = format!("{page}:{}: {name}", 1 + out.matches('\n').count());
        // Figures that nothing holds to a report.
        let is_loose = |(at, _): &(usize, &str)| before[at + 2..].bytes().take_while(u8::is_ascii_digit).count() == 3;
        if page == "docs/paper.md" && before.match_indices("0.").any(|found| is_loose(&found)) {
            wrong.push(format!("{place}: before it stands a figure without a mark"));
        }
        let (stands, expected) = match name.split_whitespace().collect::<Vec<_>>()[..] {
            ["=", study, network, what] => (&tail[..figure_length(tail)], figure(study, network, what)),
            ["figures:", study, kind] => {
                let length = tail.find("<!-- end -->").unwrap_or_else(|| panic!("{place} has no end"));
                (&tail[..length], format!("\n\n{}\n\n", block(study, kind, way)))
            }
            _ => ("", String::new()),
        };
        // GitHub takes a line that begins with a comment for HTML.
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
        let (out, wrong) = filled(page, &text, way);
        if std::env::var("RADOME_FIGURES").is_ok_and(|what| what == "write") && out != text {
            fs::write(&path, out).expect("writable");
        } else {
            all.extend(wrong);
        }
    }
    assert!(all.is_empty(), "{}\n\nhint: RADOME_FIGURES=write writes them anew", all.join("\n"));
}

#[test]
fn a_wrong_figure_is_told_with_its_place_and_both_values() {
    let right = format!("\nit has <!-- = controls hqnn mean -->{}.", figure("controls", "hqnn", "mean"));
    assert_eq!(filled("page", &right, ""), (right.clone(), Vec::new()));
    let (out, wrong) = filled("page", "\nit has <!-- = controls hqnn mean -->0.1.", "");
    assert_eq!(out, right);
    assert!(wrong.len() == 1 && wrong[0].starts_with("page:2: = controls hqnn mean is 0.1 on the page"), "{wrong:?}");
}

/// Where a report's JSON file lies beside it, the program makes the page of it.
#[test]
fn reports_are_those_of_the_json_files_beside_them() {
    for entry in fs::read_dir(root().join("docs/studies")).expect("a folder").flatten() {
        let name = entry.file_name().into_string().expect("a name");
        if let Some(of) = report(&name) {
            let page = fs::read_to_string(file(&name, "report.md")).expect("a page");
            assert_eq!(page, of.markdown(), "{name}");
        }
    }
}
