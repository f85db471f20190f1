//! Plots of a study, for light and for dark pages, as SVG and as PNG.

use std::path::Path;

use radome_models::interval::Interval;
use radome_models::study::{Cell, CurvePoint, Report};

use crate::picture::plot;
use crate::picture::theme::Theme;

/// Series of a plot: name of a network, and points.
type Series<'a> = (&'a str, Vec<(f64, f64)>);

/// Page themes, each with the suffix of its plots' file names.
const PAGES: [(Theme, &str); 2] = [(Theme::LIGHT, ""), (Theme::DARK, "-dark")];

/// Writes the plots for which a report has data: `noise`, `labels`, `curves` and `cost`.
///
/// # Errors
/// A file cannot be written.
pub fn write(report: &Report, folder: &Path) -> anyhow::Result<()> {
    let with_all_labels: Vec<&Cell> =
        report.cells.iter().filter(|cell| cell.label_fraction == 1.0 && cell.done > 0).collect();
    let noise = with_points(series_of_cells(&with_all_labels, |cell| {
        cell.noisy.iter().filter_map(|(snr_db, of)| Some((*snr_db, of.as_ref()?.mean))).collect()
    }));
    let labels = label_series(report);
    let curve = |value: &dyn Fn(&CurvePoint) -> Option<Interval>| {
        series_of_cells(&with_all_labels, |cell| {
            cell.curve.iter().filter_map(|point| Some((point.epoch as f64, value(point)?.mean))).collect()
        })
    };
    let (validation, training) = (curve(&|point| point.validation), curve(&|point| point.training));
    let cost = with_points(series_of_cells(&with_all_labels, |cell| {
        // A logarithmic axis cannot show an error of zero.
        let error = cell.test.as_ref().map(|test| (1.0 - test.mean).max(1e-3));
        error.map(|error| (cell.multiply_adds as f64, error)).into_iter().collect()
    }));
    let share = "balanced accuracy";
    for (theme, suffix) in &PAGES {
        let plots = [
            ("noise", &noise, plot::lines(theme, ("SNR / dB", share), &noise, &[])),
            ("labels", &labels, plot::lines(theme, ("labels / %", share), &labels, &[])),
            (
                "curves",
                &validation,
                plot::lines(theme, ("epoch; validation solid, training dashed", share), &validation, &training),
            ),
            ("cost", &cost, plot::scatter(theme, ("multiply-adds", "1 - balanced accuracy"), &cost)),
        ];
        for (name, series, picture) in plots {
            if series.iter().all(|(_, points)| points.is_empty()) {
                continue;
            }
            for extension in ["svg", "png"] {
                picture.save(&folder.join(format!("{name}{suffix}.{extension}")))?;
            }
        }
    }
    Ok(())
}

fn series_of_cells<'a>(cells: &[&'a Cell], points: impl Fn(&Cell) -> Vec<(f64, f64)>) -> Vec<Series<'a>> {
    cells.iter().map(|cell| (cell.variant.as_str(), points(cell))).collect()
}

fn with_points(series: Vec<Series>) -> Vec<Series> {
    series.into_iter().filter(|(_, points)| !points.is_empty()).collect()
}

/// Balanced accuracy by the fraction of labels; empty for a study with a single fraction.
fn label_series(report: &Report) -> Vec<Series<'_>> {
    let mut series: Vec<Series> = Vec::new();
    if report.cells.iter().all(|cell| cell.label_fraction >= 1.0) {
        return series;
    }
    for cell in &report.cells {
        let index = series.iter().position(|(name, _)| *name == cell.variant).unwrap_or_else(|| {
            series.push((&cell.variant, Vec::new()));
            series.len() - 1
        });
        let point = cell.test.as_ref().map(|test| (100.0 * cell.label_fraction, test.mean));
        series[index].1.extend(point);
    }
    // A spec may list the fractions in any order.
    series.iter_mut().for_each(|(_, points)| points.sort_by(|a, b| a.0.total_cmp(&b.0)));
    series
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The paper's study lists all labels first. Lines must not run back to it.
    #[test]
    fn labels_are_drawn_from_few_to_many() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/studies/paper/report.json");
        let text = std::fs::read_to_string(path).expect("a report");
        let report: Report = serde_json::from_str(&text).expect("JSON");
        let series = label_series(&report);
        let (_, points) = series.iter().find(|(name, _)| *name == "hqnn").expect("the network");
        assert_eq!(points.iter().map(|(share, _)| *share).collect::<Vec<_>>(), [10.0, 30.0, 50.0, 100.0]);
    }
}
