use std::path::Path;
use std::time::Instant;

use anyhow::bail;
use clap::ValueEnum;
use glam::DVec3;
use radome_sim::em::image::Wall;
use radome_sim::geometry::import::{LengthUnit, UpAxis, import};
use radome_sim::geometry::{Mesh, Surface, weld};
use radome_sim::material::{Material, SKIN_PERMITTIVITY};
use radome_sim::validation::{Method, Outline, Polarisation, Problem, RcsError, Setup, Target, reference_value};
use serde::Serialize;

use super::point::least_ms;
use crate::exit::{WrongUse, wrong_use};
use crate::one_of::one_of;
use crate::output;

/// Text below the options in the help.
const NOTES: &str = "\
Numbers in parentheses are defaults. Azimuth and elevation are those of the radar seen from the target: azimuth from the \
target's x axis towards y, elevation towards z. Plates, mirrors and cavities face x. A cylinder and a dihedral's edge stand \
along z. A trihedral's edges are the three axes. Without angles, the radar is on the target's axis of symmetry.";

/// `radome bench rcs`
#[derive(clap::Args)]
#[command(after_help = NOTES)]
pub struct Arguments {
    /// plate, dihedral, trihedral, cavity, sphere, cylinder, ellipsoid, mirror, or a mesh file in metres (.stl, .obj)
    target: String,
    /// Size along y (plate 0.1, cavity 0.05), across the edge (dihedral 0.1), or diameter of the aperture (mirror 0.2)
    #[arg(long, value_name = "METRES")]
    width_m: Option<f64>,
    /// Size along z (plate, dihedral, cylinder 0.1, cavity 0.05)
    #[arg(long, value_name = "METRES")]
    height_m: Option<f64>,
    /// Depth of a cavity (0.05)
    #[arg(long, value_name = "METRES")]
    depth_m: Option<f64>,
    /// Length of a trihedral's edges (0.1)
    #[arg(long, value_name = "METRES")]
    edge_m: Option<f64>,
    /// Radius of a sphere or cylinder (0.05), or radius of curvature of a mirror (1)
    #[arg(long, value_name = "METRES")]
    radius_m: Option<f64>,
    /// Semi-axes X,Y,Z of an ellipsoid (0.12,0.17,0.3)
    #[arg(long, value_name = "METRES,METRES,METRES", value_delimiter = ',', num_args = 1)]
    axes_m: Option<Vec<f64>>,
    /// Outline of a trihedral's faces (triangular)
    #[arg(long, value_parser = one_of(OUTLINES))]
    faces: Option<Outline>,
    /// Angle between a plate's normal and the direction of the radar
    #[arg(long, value_name = "DEGREES", allow_hyphen_values = true, conflicts_with = "azimuth_deg")]
    angle_deg: Option<f64>,
    /// Azimuth of the radar
    #[arg(long, value_name = "DEGREES", allow_hyphen_values = true)]
    azimuth_deg: Option<f64>,
    /// Elevation of the radar
    #[arg(long, value_name = "DEGREES", allow_hyphen_values = true)]
    elevation_deg: Option<f64>,
    /// Range to the target: middle of a plate or aperture, corner, pole of a mirror, surface of a round body; the far field if absent
    #[arg(long, value_name = "METRES")]
    range_m: Option<f64>,
    /// Frequency
    #[arg(long, value_name = "HZ", default_value_t = 60e9)]
    frequency_hz: f64,
    /// pec, skin, or a building material: concrete, plasterboard, glass, wood...
    #[arg(long, default_value = "pec")]
    material: String,
    /// Thickness of a slab of the material in air; a half-space if absent
    #[arg(long, value_name = "METRES")]
    thickness_m: Option<f64>,
    /// Direction of the radar's electric field
    #[arg(long, value_parser = one_of(POLARISATIONS), default_value = "vertical")]
    polarisation: Polarisation,
    /// Method of the solver
    #[arg(long, value_enum, default_value_t = MethodChoice::Auto)]
    method: MethodChoice,
    /// Use a mesh with edges of this length instead of the exact shape
    #[arg(long, value_name = "METRES")]
    mesh_edge_m: Option<f64>,
    /// Target of the numerical error, dB
    #[arg(long, value_name = "DB", default_value_t = 0.1)]
    tolerance_db: f64,
    /// Rounds; the fastest counts
    #[arg(long, default_value_t = 3)]
    rounds: usize,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

const OUTLINES: &[(&str, Outline)] = &[("triangular", Outline::Triangular), ("square", Outline::Square)];

const POLARISATIONS: &[(&str, Polarisation)] =
    &[("vertical", Polarisation::Vertical), ("horizontal", Polarisation::Horizontal)];

#[derive(Clone, Copy, PartialEq, ValueEnum)]
enum MethodChoice {
    /// Method that suits the target
    Auto,
    /// Stationary phase on the exact shape
    #[value(alias = "highlight")]
    Specular,
    /// Patches of curved triangles, as for people as skins; closed smooth meshes only
    Skin,
    /// Physical optics over adaptive facets
    Facets,
    /// Images by every sequence of plane faces, physical optics on the last
    Images,
    /// Physical optics over a grid of patches: the slow reference
    Dense,
}

#[derive(Serialize)]
struct Solution {
    target: String,
    method: &'static str,
    value_dbsm: Option<f64>,
    analytic_dbsm: Option<f64>,
    error_db: Option<f64>,
    milliseconds: f64,
    facets: usize,
    /// Origin of the analytic value.
    analytic_source: Option<&'static str>,
    /// The method's own estimate of its numerical error.
    estimate_db: Option<f64>,
    tolerance_db: f64,
    /// Time of meshing and computing normals, once per target, ms.
    prepare_milliseconds: f64,
    triangles: usize,
    azimuth_deg: f64,
    elevation_deg: f64,
    range_m: Option<f64>,
    frequency_hz: f64,
}

/// Computes one target with the solver.
///
/// # Errors
/// The target, its sizes or its material are not valid, or the solver refuses the setup.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let target = target(arguments)?;
    let setup = setup(arguments, &target)?;
    let method = match arguments.method {
        MethodChoice::Auto => Method::automatic(&target, arguments.mesh_edge_m.is_some()),
        MethodChoice::Specular => Method::Specular,
        MethodChoice::Skin => Method::Skin,
        MethodChoice::Facets => Method::Facets,
        MethodChoice::Images => Method::Images,
        MethodChoice::Dense => Method::Dense,
    };
    let started = Instant::now();
    let problem = Problem::new(&target, &setup, method, arguments.mesh_edge_m).map_err(solver_error)?;
    let prepare_milliseconds = started.elapsed().as_secs_f64() * 1e3;
    let mut outcome = None;
    let milliseconds = least_ms(arguments.rounds.clamp(1, 10_000), || {
        outcome = Some(problem.solve(arguments.tolerance_db).map_err(solver_error)?);
        Ok(())
    })?;
    let Some(outcome) = outcome else { bail!("nothing was solved") };
    let known = reference_value(&target, &setup);
    let decibels = |sigma: f64| Some(10.0 * sigma.log10()).filter(|db| db.is_finite());
    let value_dbsm = decibels(outcome.sigma_m2);
    let analytic_dbsm = known.and_then(|k| decibels(k.sigma_m2));
    let answer = Solution {
        target: arguments.target.clone(),
        method: method.name(),
        value_dbsm,
        analytic_dbsm,
        error_db: value_dbsm.zip(analytic_dbsm).map(|(value, analytic)| value - analytic),
        milliseconds,
        facets: outcome.facets,
        analytic_source: known.map(|k| k.source),
        estimate_db: outcome.estimate_db,
        tolerance_db: arguments.tolerance_db,
        prepare_milliseconds,
        triangles: problem.triangles(),
        azimuth_deg: setup.azimuth_rad.to_degrees(),
        elevation_deg: setup.elevation_rad.to_degrees(),
        range_m: setup.range_m,
        frequency_hz: setup.frequency_hz,
    };
    if arguments.json { output::json_line(&answer) } else { print(&answer) }
}

/// Converts an error of the solver. It is wrong use, unless it is about the content of a mesh file.
fn solver_error(error: RcsError) -> anyhow::Error {
    match error {
        RcsError::Faces(_) | RcsError::Empty => error.into(),
        other => WrongUse(other.into()).into(),
    }
}

fn print(answer: &Solution) -> anyhow::Result<()> {
    let decibels = |v: Option<f64>, unit: &str| v.map_or_else(|| "none".to_owned(), |v| format!("{v:.3} {unit}"));
    let range = answer.range_m.map_or_else(|| "far".to_owned(), |r| format!("at {r} m"));
    let (azimuth, elevation) = (answer.azimuth_deg, answer.elevation_deg);
    output::text_line(&format!("{} {range}, azimuth {azimuth:.2} deg, elevation {elevation:.2} deg", answer.target))?;
    output::text_line(&format!("value      {}   by {}", decibels(answer.value_dbsm, "dBsm"), answer.method))?;
    let source = answer.analytic_source.unwrap_or("no closed form for this direction");
    output::text_line(&format!("analytic   {}   {source}", decibels(answer.analytic_dbsm, "dBsm")))?;
    let estimate = decibels(answer.estimate_db, "dB");
    output::text_line(&format!("error      {}   own estimate {estimate}", decibels(answer.error_db, "dB")))?;
    output::text_line(&format!(
        "time       {:.3} ms   {} facets; prepared in {:.1} ms, {} triangles",
        answer.milliseconds, answer.facets, answer.prepare_milliseconds, answer.triangles
    ))
}

fn target(arguments: &Arguments) -> anyhow::Result<Target> {
    let a = arguments;
    let (width_m, height_m) = (a.width_m.unwrap_or(0.1), a.height_m.unwrap_or(0.1));
    let trihedral = |outline| Target::Trihedral { edge_m: a.edge_m.unwrap_or(0.1), outline };
    // Sizes that each kind of target takes. A size that the target does not have is an error.
    let (target, sizes): (Target, &[&str]) = match a.target.as_str() {
        "plate" => (Target::Plate { width_m, height_m }, &["width-m", "height-m", "angle-deg"]),
        "dihedral" => (Target::Dihedral { width_m, height_m }, &["width-m", "height-m"]),
        "trihedral" => (trihedral(a.faces.unwrap_or(Outline::Triangular)), &["edge-m", "faces"]),
        "trihedral-triangular" => (trihedral(Outline::Triangular), &["edge-m"]),
        "trihedral-square" => (trihedral(Outline::Square), &["edge-m"]),
        "cavity" => {
            let (width_m, height_m) = (a.width_m.unwrap_or(0.05), a.height_m.unwrap_or(0.05));
            let depth_m = a.depth_m.unwrap_or(0.05);
            (Target::Cavity { width_m, height_m, depth_m }, &["width-m", "height-m", "depth-m"])
        }
        "sphere" => (Target::Sphere { radius_m: a.radius_m.unwrap_or(0.05) }, &["radius-m"]),
        "cylinder" => (Target::Cylinder { radius_m: a.radius_m.unwrap_or(0.05), height_m }, &["radius-m", "height-m"]),
        "ellipsoid" => {
            let axes = a.axes_m.clone().unwrap_or_else(|| vec![0.12, 0.17, 0.3]);
            let Ok(axes) = <[f64; 3]>::try_from(axes) else {
                wrong_use!("--axes-m takes three numbers, as in --axes-m 0.12,0.17,0.3");
            };
            (Target::Ellipsoid { semi_axes_m: DVec3::from_array(axes) }, &["axes-m"])
        }
        "mirror" => {
            let (radius_m, aperture_m) = (a.radius_m.unwrap_or(1.0), a.width_m.unwrap_or(0.2));
            (Target::Mirror { radius_m, aperture_m }, &["radius-m", "width-m"])
        }
        path => (mesh_file(path)?, &[]),
    };
    let given = [
        ("width-m", a.width_m.is_some()),
        ("height-m", a.height_m.is_some()),
        ("depth-m", a.depth_m.is_some()),
        ("edge-m", a.edge_m.is_some()),
        ("radius-m", a.radius_m.is_some()),
        ("axes-m", a.axes_m.is_some()),
        ("faces", a.faces.is_some()),
        ("angle-deg", a.angle_deg.is_some()),
    ];
    if let Some((name, _)) = given.iter().find(|(name, given)| *given && !sizes.contains(name)) {
        let takes = if sizes.is_empty() { "no size".to_owned() } else { format!("--{}", sizes.join(", --")) };
        wrong_use!("--{name} does not belong to {}\n\nhint: it takes {takes}", a.target);
    }
    Ok(target)
}

/// Angle below which edges between triangles are smoothed, so that a triangulated ball is round and a box keeps its
/// edges.
const CREASE_DEG: f64 = 35.0;

/// Distance below which vertices are merged, m.
const WELD_TOLERANCE_M: f64 = 1e-6;

fn mesh_file(path: &str) -> anyhow::Result<Target> {
    let lower = path.to_ascii_lowercase();
    if !lower.ends_with(".stl") && !lower.ends_with(".obj") {
        wrong_use!(
            "there is no target {path}\n\nhint: plate, dihedral, trihedral, cavity, sphere, cylinder, ellipsoid, mirror, or a \
             file that ends in .stl or .obj"
        )
    }
    let mut mesh = Mesh::default();
    for part in import(Path::new(path), LengthUnit::Metre, UpAxis::Z)? {
        let first = mesh.vertices.len() as u32;
        mesh.vertices.extend(part.mesh.vertices);
        mesh.triangles.extend(part.mesh.triangles.iter().map(|corners| corners.map(|corner| first + corner)));
    }
    // Meshes in files without indices do not share vertices at their edges.
    let mesh = weld(&mesh, WELD_TOLERANCE_M)?.mesh;
    Ok(Target::Surface { surface: Surface::from_mesh(&mesh, CREASE_DEG.to_radians()) })
}

fn setup(arguments: &Arguments, target: &Target) -> anyhow::Result<Setup> {
    let (azimuth_rad, elevation_rad) = target.axis();
    let azimuth = arguments.angle_deg.or(arguments.azimuth_deg);
    Ok(Setup {
        frequency_hz: arguments.frequency_hz,
        range_m: arguments.range_m,
        azimuth_rad: azimuth.map_or(azimuth_rad, f64::to_radians),
        elevation_rad: arguments.elevation_deg.map_or(elevation_rad, f64::to_radians),
        polarisation: arguments.polarisation,
        boundary: boundary(arguments)?,
    })
}

fn boundary(arguments: &Arguments) -> anyhow::Result<Wall> {
    let name = arguments.material.as_str();
    let permittivity = match name {
        "pec" | "metal" => None,
        "skin" => Some(SKIN_PERMITTIVITY),
        _ => {
            let Some(material) = Material::named(name) else {
                wrong_use!("--material is {name:?}, expected one of pec, skin, {}", Material::NAMES.join(", "));
            };
            let Some(permittivity) = material.permittivity(arguments.frequency_hz) else {
                wrong_use!("{name} reflects nothing\n\nhint: choose pec, skin or a building material");
            };
            Some(permittivity)
        }
    };
    match (permittivity, arguments.thickness_m) {
        (None, None) => Ok(Wall::Conductor),
        (None, Some(_)) => wrong_use!("--thickness-m does not belong to {name}, which nothing passes"),
        (Some(permittivity), None) => Ok(Wall::HalfSpace { permittivity }),
        (Some(_), Some(t)) if !(t > 0.0 && t.is_finite()) => wrong_use!("--thickness-m {t} is no thickness"),
        (Some(permittivity), Some(thickness_m)) => Ok(Wall::Slab { permittivity, thickness_m }),
    }
}
