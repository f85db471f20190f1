//! `radome bench solver`: error against time over targets, methods and tolerances.

use std::path::PathBuf;

use glam::DVec3;
use radome_sim::em::image::Wall;
use radome_sim::validation::{Method, Outline, Polarisation, Problem, Setup, Target, reference_value};
use serde::Serialize;

use super::point::least_ms;
use crate::output::{self, or_dash};
use crate::picture::plot;
use crate::picture::theme::Theme;

/// Tolerances that every method is run with, dB.
const TOLERANCES_DB: [f64; 4] = [1.0, 0.3, 0.1, 0.03];
/// Numbers of triangles of the skin meshes.
const TRIANGLES: [f64; 3] = [1280.0, 5120.0, 20480.0];

#[derive(clap::Args)]
pub struct Arguments {
    /// Print a JSON list of objects
    #[arg(long)]
    json: bool,
    /// Picture to write, of errors over times: PNG, or SVG if its name ends in .svg. An existing file is replaced
    #[arg(long, value_name = "FILE.png")]
    png: Option<PathBuf>,
    /// Rounds; the fastest counts
    #[arg(long, default_value_t = 5)]
    rounds: usize,
}

/// Result of one method on one target at one setting.
#[derive(Serialize)]
struct Row {
    target: &'static str,
    method: &'static str,
    tolerance_db: f64,
    triangles: usize,
    facets: usize,
    milliseconds: f64,
    error_db: f64,
    estimate_db: Option<f64>,
    /// Time of the plain sum over patches with no greater error, divided by this time; null if that sum never reaches
    /// the error.
    dense_over_this: Option<f64>,
}

/// Runs every method on every target at every tolerance, on one thread.
///
/// # Errors
/// A target cannot be solved, or the picture cannot be written.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let targets = targets();
    let bar = output::progress(targets.len() as u64, "targets");
    let mut rows = Vec::new();
    for (name, target, setup) in targets {
        let mut target_rows = Vec::new();
        for method in Method::ALL.into_iter().filter(|m| m.suits(&target)) {
            if method == Method::Skin {
                let Some(size_m) = size_m(&target) else { continue };
                for triangles in TRIANGLES {
                    let edge_m = size_m * (4.0 * std::f64::consts::PI / (0.433 * triangles)).sqrt();
                    target_rows.push(row(name, &target, &setup, method, (0.3, Some(edge_m)), arguments.rounds)?);
                }
                continue;
            }
            for tolerance_db in TOLERANCES_DB {
                target_rows.push(row(name, &target, &setup, method, (tolerance_db, None), arguments.rounds)?);
            }
        }
        let dense: Vec<(f64, f64)> =
            target_rows.iter().filter(|r| r.method == "dense").map(|r| (r.error_db.abs(), r.milliseconds)).collect();
        for row in &mut target_rows {
            let equally_accurate =
                dense.iter().filter(|(error, _)| *error <= row.error_db.abs().max(0.01)).map(|(_, ms)| *ms);
            row.dense_over_this = equally_accurate.reduce(f64::min).map(|ms| ms / row.milliseconds);
        }
        rows.extend(target_rows);
        bar.inc(1);
    }
    bar.finish_and_clear();
    if let Some(path) = &arguments.png {
        let series: Vec<(&str, Vec<(f64, f64)>)> = Method::ALL
            .iter()
            .map(|method| {
                let of_method = rows.iter().filter(|r| r.method == method.name());
                // An error of a ten-thousandth of a decibel counts as none.
                (method.name(), of_method.map(|r| (r.milliseconds, r.error_db.abs().max(1e-4))).collect())
            })
            .collect();
        plot::scatter(&Theme::LIGHT, ("time / ms", "error / dB"), &series).save(path)?;
    }
    if arguments.json {
        return output::json_line(&rows);
    }
    output::text_line(&format!(
        "{:22} {:15} {:>9} {:>9} {:>9} {:>10} {:>10} {:>10} {:>11}",
        "one thread, 60 GHz", "method", "tol dB", "triangles", "facets", "ms", "error dB", "estimate", "dense/this"
    ))?;
    for r in rows {
        let (estimate, ratio) = (or_dash(r.estimate_db, 4), or_dash(r.dense_over_this, 1));
        output::text_line(&format!(
            "{:22} {:15} {:9} {:9} {:9} {:10.4} {:10.4} {estimate:>10} {ratio:>11}",
            r.target, r.method, r.tolerance_db, r.triangles, r.facets, r.milliseconds, r.error_db
        ))?;
    }
    Ok(())
}

fn row(
    name: &'static str,
    target: &Target,
    setup: &Setup,
    method: Method,
    (tolerance_db, edge_m): (f64, Option<f64>),
    rounds: usize,
) -> anyhow::Result<Row> {
    let problem = Problem::new(target, setup, method, edge_m)?;
    let mut outcome = problem.solve(tolerance_db)?;
    let milliseconds = least_ms(rounds.clamp(1, 1000), || {
        outcome = problem.solve(tolerance_db)?;
        Ok(())
    })?;
    let exact = reference_value(target, setup).map_or(f64::NAN, |k| k.sigma_m2);
    Ok(Row {
        target: name,
        method: method.name(),
        tolerance_db,
        triangles: problem.triangles(),
        facets: outcome.facets,
        milliseconds,
        error_db: 10.0 * (outcome.sigma_m2 / exact).log10(),
        estimate_db: outcome.estimate_db,
        dense_over_this: None,
    })
}

/// Radius of a sphere with the area of a round body; `None` for other bodies.
fn size_m(target: &Target) -> Option<f64> {
    match target {
        Target::Sphere { radius_m } => Some(*radius_m),
        Target::Ellipsoid { semi_axes_m: s } => Some(((s.x * s.y + s.y * s.z + s.z * s.x) / 3.0).sqrt()),
        _ => None,
    }
}

fn targets() -> Vec<(&'static str, Target, Setup)> {
    let setup = |range_m: Option<f64>, azimuth_deg: f64, elevation_deg: f64| Setup {
        frequency_hz: 60e9,
        range_m,
        azimuth_rad: azimuth_deg.to_radians(),
        elevation_rad: elevation_deg.to_radians(),
        polarisation: Polarisation::Vertical,
        boundary: Wall::Conductor,
    };
    let plate = Target::Plate { width_m: 0.1, height_m: 0.1 };
    vec![
        ("plate 10 cm, 10 deg", plate.clone(), setup(None, 10.0, 0.0)),
        ("plate 10 cm at 1 m", plate, setup(Some(1.0), 0.0, 0.0)),
        ("dihedral 10 cm", Target::Dihedral { width_m: 0.1, height_m: 0.1 }, setup(None, 45.0, 0.0)),
        (
            "trihedral 10 cm",
            Target::Trihedral { edge_m: 0.1, outline: Outline::Square },
            setup(None, 45.0, 35.264_389_682_754_654),
        ),
        (
            "cavity 5 x 5 x 5 cm",
            Target::Cavity { width_m: 0.05, height_m: 0.05, depth_m: 0.05 },
            setup(None, 30.0, 0.0),
        ),
        ("sphere 5 cm", Target::Sphere { radius_m: 0.05 }, setup(None, 17.0, 31.0)),
        ("torso at 2 m", Target::Ellipsoid { semi_axes_m: DVec3::new(0.12, 0.17, 0.3) }, setup(Some(2.0), 30.0, 20.0)),
        ("cylinder 5 x 30 cm", Target::Cylinder { radius_m: 0.05, height_m: 0.3 }, setup(None, 20.0, 0.0)),
        ("mirror in focus", Target::Mirror { radius_m: 1.0, aperture_m: 0.2 }, setup(Some(1.0), 0.0, 0.0)),
    ]
}
