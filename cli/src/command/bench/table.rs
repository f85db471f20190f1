//! `radome bench`: speed against error of every stage, in one table and one picture.

use std::path::PathBuf;

use super::point::Point;
use super::{circuit_time, networks, people, rdm, synthesis};
use crate::output;
use crate::picture::plot;
use crate::picture::theme::Theme;

#[derive(clap::Args)]
pub struct Arguments {
    /// Print a JSON list of objects
    #[arg(long)]
    json: bool,
    /// Picture to write, of errors over times with a colour for each stage: PNG, or SVG if its name ends in .svg. An existing file is
    /// replaced
    #[arg(long, value_name = "FILE.png")]
    png: Option<PathBuf>,
    /// Python whose scipy, torch and onnxruntime are measured too; `python3` if absent
    #[arg(long)]
    python: Option<PathBuf>,
}

/// Measures all stages from chirps to labels.
///
/// # Errors
/// A stage cannot be measured, or the picture cannot be written.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let python = arguments.python.as_deref();
    let bar = output::progress(5, "stages");
    let mut points = Vec::new();
    for stage in 0..5 {
        points.extend(match stage {
            0 => rdm::points(200, python)?,
            1 => synthesis::points()?,
            2 => people::points(5)?,
            3 => circuit_time::points(50)?,
            _ => networks::points(python)?,
        });
        bar.inc(1);
    }
    bar.finish_and_clear();
    if let Some(path) = &arguments.png {
        draw(path, &points)?;
    }
    if arguments.json {
        return output::json_line(&points);
    }
    print(&points)
}

/// Prints one table. The first row of a stage is this program's own; times are also given relative to it.
fn print(points: &[Point]) -> anyhow::Result<()> {
    let (mut stage, mut own_ms) = ("", f64::NAN);
    for point in points {
        if point.stage != stage {
            (stage, own_ms) = (point.stage, point.milliseconds);
            output::text_line(&format!("\n{:44} {:>14} {:>9}   error", stage, "time", "x ours"))?;
        }
        let error = point.error.map_or_else(|| "-".to_owned(), |e| format!("{} {}", significant(e), point.error_unit));
        let mark = if point.is_peer { '*' } else { ' ' };
        output::text_line(&format!(
            "{mark} {:42} {:>14} {:>9}   {error}",
            point.way,
            duration(point.milliseconds),
            significant(point.milliseconds / own_ms)
        ))?;
    }
    output::text_line("\n* another program or library")
}

fn duration(milliseconds: f64) -> String {
    match milliseconds {
        ms if ms >= 1e3 => format!("{:.2} s", ms * 1e-3),
        ms if ms >= 1.0 => format!("{ms:.2} ms"),
        ms if ms >= 1e-3 => format!("{:.1} us", ms * 1e3),
        ms => format!("{:.1} ns", ms * 1e6),
    }
}

fn significant(value: f64) -> String {
    match value.abs() {
        v if v >= 100.0 => format!("{value:.0}"),
        v if v >= 1.0 => format!("{value:.2}"),
        v if v >= 1e-3 => format!("{value:.3}"),
        _ => format!("{value:.1e}"),
    }
}

/// Draws errors as decibels of amplitude, whatever their own unit, so that one axis fits all.
fn draw(path: &std::path::Path, points: &[Point]) -> anyhow::Result<()> {
    let relative = |point: &Point| match (point.error, point.error_unit) {
        (Some(error), "dBc" | "dB of echoes") => Some(10f64.powf(error / 20.0)),
        (error, _) => error,
    };
    let mut series: Vec<(&str, Vec<(f64, f64)>)> = Vec::new();
    for point in points {
        let Some(error) = relative(point).filter(|error| *error > 0.0) else { continue };
        match series.iter_mut().find(|(stage, _)| *stage == point.stage) {
            Some((_, points)) => points.push((point.milliseconds, error)),
            None => series.push((point.stage, vec![(point.milliseconds, error)])),
        }
    }
    plot::scatter(&Theme::LIGHT, ("time / ms", "relative error"), &series).save(path)
}
