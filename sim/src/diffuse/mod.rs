//! Diffuse echoes: power that walls scatter in all directions on the path to a person or back. The causes are roughness
//! and objects on and before the walls.
//!
//! A wall scatters a share of the incident power by Lambert's law. The rest is reflected specularly, transmitted and
//! absorbed, as by a smooth wall ([`crate::em::wall::WallTable`]). The model is that of
//! Degli-Esposti, Fuschini, Vitucci and Falciasecca, IEEE Transactions on Antennas and Propagation 55(1), 2007, section
//! II. The share is the square of their scattering coefficient S, for which they and others measured 0.2 to 0.4 and
//! more. Here fixed points with random phases represent the scattering. The paths antenna, point, segment of a body,
//! antenna, and their reverse, are treated like any others, so their delays and rates follow from the geometry. A
//! segment scatters in all directions, as a convex body does on average over its directions: `|Gamma|^2 S / 4` for the
//! surface S (Cauchy). For paths with a point both there and back, half as many pairs of points are used as there are
//! points, in both directions. The two directions of a path have nearly the same length, and add with their phases.
//!
//! More walls may lie between antenna and point. The power in a room decays exponentially with delay after many
//! reflections (room electromagnetics: Andersen, Nielsen, Pedersen, Bauch and Herdin, IEEE Antennas and Propagation
//! Magazine 49(2), 2007). Image antennas represent the paths with specular reflection at each of a few walls; the
//! points represent all other paths over as many walls. A point is the end of a random walk from wall to wall by
//! Lambert's law, and carries the power that the walls leave.
//!
//! `points.rs` generates the points of a room, with `facets.rs` for rooms of any shape; [`crate::echo::diffuse`] adds a
//! person's echoes over them. There are thousands of echoes. Each is weak, and together they are a field of random
//! phases, of which only the mean power at each delay and rate matters. If the tolerance permits, each segment of a
//! body takes a part of the points ([`crate::echo::diffuse::Thinning`]), and echoes are added for many chirps
//! at once ([`crate::synthesis::RateGrids`]).

mod facets;
mod points;

pub use points::{AntennaPaths, Diffuse, WallPoint};

use crate::em::image::Element;
use crate::paths::Surroundings;
use facets::FacetWalls;

/// Least length of a leg in amplitudes, m.
pub(crate) const LEAST_LEG_M: f64 = 0.3;
/// Distance between a point and its wall in visibility tests, m.
pub(crate) const BEFORE_M: f64 = 1e-4;
/// Fractional part of the golden ratio, whose multiples are evenly distributed between 0 and 1.
pub(crate) const GOLDEN: f64 = 0.618_033_988_749_894_9;

/// Generates the scattering points of a room.
pub fn wall_points(
    room: &Surroundings,
    diffuse: Diffuse,
    tx: &Element,
    rx: &[Element],
    wavelength_m: f64,
    seed: u64,
) -> Vec<WallPoint> {
    match room {
        Surroundings::Box(room) => points::points(room, diffuse, tx, rx, wavelength_m, seed),
        Surroundings::Polygons(room) => points::points(&FacetWalls::new(room), diffuse, tx, rx, wavelength_m, seed),
    }
}
