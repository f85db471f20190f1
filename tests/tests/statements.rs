//! Figures that pages quote against the reports of studies that they quote, and reports against the JSON files beside them.

use std::path::PathBuf;

use radome_models::study::Report;
use radome_tests::root;

/// Sentences of `docs/studies/README.md`. A quoted figure is `{report/network/figure}`.
const RESULTS: [&str; 10] = [
    "the HQNN reaches {controls/hqnn/test} balanced accuracy and the linear head {controls/estimator_matched/test} \
     (\"Estimator-matched\", {controls/estimator_matched/paper} % in the paper where the HQNN has {controls/hqnn/paper})",
    "the Dequantization head, {controls/dequantization/paper} % in the paper, {controls/dequantization/test}.",
    "Heads that see the same squash as the circuit have {controls/squashed_linear/mean} and \
     {controls/squashed_dequantization/mean}, the five trigonometric features of which the circuit is a sum \
     {controls/trigonometric/mean}, and a circuit whose angles stay as they were drawn {controls/frozen_angles/mean}:",
    "ResNet-18 {networks/resnet18/mean}, DopplerNet {networks/doppler_net/mean}, HQNN {networks/hqnn/mean}, its linear control \
     {networks/estimator_matched/mean}, EfficientNet-B0 {networks/efficientnet_b0/mean} (nothing pretrained)",
    "HQNN {paper/hqnn/mean} balanced accuracy on the test split, linear head {paper/estimator_matched/mean}, Dequantization \
     {paper/dequantization/mean}, DopplerNet {paper/doppler_net/mean}, where the paper has {paper/hqnn/paper}, \
     {paper/estimator_matched/paper}, {paper/dequantization/paper} and {paper/doppler_net/paper} %",
    "(DopplerNet {paper/doppler_net/training})",
    "begun: {paper/all/trainings} trainings",
    "whole: seven heads, a grid of three learning rates, five seeds:",
    "lowest {reliability/hqnn/least},",
    "highest {reliability/hqnn/most}, none failed",
];
/// Sentences of `docs/performance.md`.
const PERFORMANCE: [&str; 1] = ["balanced accuracy {reliability/hqnn/least} lowest,"];

fn studies() -> PathBuf {
    root().join("docs/studies")
}

/// A page with every run of blanks as one.
fn text(path: &str) -> String {
    let text = std::fs::read_to_string(root().join(path)).unwrap_or_else(|e| panic!("{path}: {e}"));
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Rows of the first table of a report, by the heads of its columns.
fn rows(report: &str) -> Vec<Vec<(String, String)>> {
    let cells =
        |line: &str| -> Vec<String> { line.trim_matches('|').split('|').map(|cell| cell.trim().to_owned()).collect() };
    let mut lines = report.lines().skip_while(|line| !line.starts_with('|')).take_while(|line| line.starts_with('|'));
    let heads = cells(lines.next().expect("a table"));
    lines.skip(1).map(|line| heads.iter().cloned().zip(cells(line)).collect()).collect()
}

/// A figure of a report, as it stands there.
fn figure(name: &str) -> String {
    let words: Vec<&str> = name.split('/').collect();
    let [report, network, figure] = words[..] else { panic!("{name} is not report/network/figure") };
    let path = studies().join(report).with_extension("md");
    let report = std::fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    if figure == "trainings" {
        let line = report.lines().find(|line| line.contains(" trainings")).expect("a line of numbers");
        return line.split(" trainings").next().unwrap_or_default().to_owned();
    }
    let rows = rows(&report);
    let is_of_network = |row: &&Vec<(String, String)>| row.first().is_some_and(|(_, found)| found == network);
    let row = rows.iter().find(is_of_network).unwrap_or_else(|| panic!("{}: no {network}", path.display()));
    let cell = |head: &str| {
        let found = row.iter().find(|(found, _)| found.starts_with(head));
        found.unwrap_or_else(|| panic!("{}: no column {head}", path.display())).1.as_str()
    };
    // 0.779 ± 0.006 [0.773, 0.783]
    let (interval, range) = cell("test").split_once(" [").unwrap_or((cell("test"), "]"));
    let (least, most) = range.trim_end_matches(']').split_once(", ").unwrap_or_default();
    let first = |text: &str| text.split(' ').next().unwrap_or_default().to_owned();
    match figure {
        "test" => interval.to_owned(),
        "mean" => first(interval),
        "least" => least.to_owned(),
        "most" => most.to_owned(),
        "training" => first(cell("training")),
        "paper" => first(cell("paper")),
        other => panic!("{other} is no figure"),
    }
}

/// A sentence with its figures.
fn filled(sentence: &str) -> String {
    let mut parts = sentence.split('{');
    let mut filled = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        let (name, rest) = part.split_once('}').expect("a closing brace");
        filled += &figure(name);
        filled += rest;
    }
    filled
}

#[test]
fn quoted_figures_are_those_of_the_reports() {
    let results = RESULTS.map(|sentence| ("docs/studies/README.md", sentence));
    let performance = PERFORMANCE.map(|sentence| ("docs/performance.md", sentence));
    for (path, sentence) in results.into_iter().chain(performance) {
        let expected = filled(sentence);
        assert!(text(path).contains(&expected), "{path} does not say, as the reports do: {expected}");
    }
}

/// "every control head, trained or not, has the same within 0.004", "No training failed", "to 0.89 and more".
#[test]
fn statements_about_all_networks_of_a_report_hold() {
    let names = |report: &str| -> Vec<String> {
        let path = studies().join(report).with_extension("md");
        let rows = rows(&std::fs::read_to_string(path).expect("a report"));
        rows.iter().filter_map(|row| Some(row.first()?.1.clone())).collect()
    };
    let number = |name: String| -> f64 { figure(&name).parse().unwrap_or_else(|e| panic!("{name}: {e}")) };
    let of = |report: &str, what: &str| -> Vec<f64> {
        names(report).iter().map(|network| number(format!("{report}/{network}/{what}"))).collect()
    };
    let means = of("controls", "mean");
    let (least, most) = means.iter().fold((1.0f64, 0.0f64), |(least, most), &mean| (least.min(mean), most.max(mean)));
    assert!(means.len() == 7 && most - least < 0.004 + 1e-9, "{means:?}");
    assert!(text("docs/performance.md").contains("has the same within 0.004"));
    let fitted = of("paper", "training");
    assert!(fitted.iter().all(|share| *share >= 0.885), "{fitted:?}");
    assert!(text("docs/studies/README.md").contains("All fit their own training maps to 0.89 and more"));
    for name in ["controls", "reliability"] {
        let report = std::fs::read_to_string(studies().join(name).with_extension("md")).expect("a report");
        let failed = rows(&report).iter().filter(|row| !row.contains(&("failed".to_owned(), "0".to_owned()))).count();
        assert_eq!(failed, 0, "{name}");
    }
}

/// Where a report's JSON file lies beside it, the program makes the page of it.
#[test]
fn reports_are_those_of_the_json_files_beside_them() {
    for entry in std::fs::read_dir(studies()).expect("a folder").flatten() {
        let path = entry.path();
        if path.extension().is_some_and(|extension| extension == "json") {
            let text = std::fs::read_to_string(&path).expect("a file");
            let report: Report = serde_json::from_str(&text).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
            let page = std::fs::read_to_string(path.with_extension("md")).expect("a page");
            assert_eq!(page, report.markdown(), "{}", path.display());
        }
    }
}
