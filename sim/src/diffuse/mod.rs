//! Diffuse echoes: power that walls scatter in all directions, by their roughness and by what hangs and stands on them, on the way
//! to a person or back.
//!
//! A wall returns a share of the power that falls on it by Lambert's law (Degli-Esposti, Fuschini, Vitucci and Falciasecca,
//! IEEE Transactions on Antennas and Propagation 55(1), 2007, section II: the square of their scattering coefficient S, for which
//! they and others measured 0.2 to 0.4 and more), besides what it mirrors. Here fixed points with random phases stand for it. The ways
//! antenna, point, segment of a body, antenna, and their reverse, are paths as any others, so that their delays and rates are those
//! of the geometry. A segment scatters in all directions, as a convex body does on average over its directions: `|Gamma|^2 S / 4`
//! for the surface S (Cauchy). Ways by a point both there and back are represented by as many pairs of points as there are points.
//!
//! More walls may lie between antenna and point: the power that a room returns after many of them decays exponentially with delay
//! (room electromagnetics: Andersen, Nielsen, Pedersen, Bauch and Herdin, IEEE Antennas and Propagation Magazine 49(2), 2007).
//! Image antennas represent the ways that are mirrored at each of a few walls; the points represent all other ways by as many walls.
//! A point is the end of a random walk from wall to wall by Lambert's law, and carries the power that the walls leave.
//!
//! `points.rs` makes the points of a room, of any shape with `facets.rs`; [`crate::echo::diffuse`] adds a person's echoes by way of
//! them. There are thousands: each is weak, and together they are a field of random phases, of which only the mean power at each
//! delay and rate matters. At a tolerance that allows it, each segment of a body takes a part of the points
//! ([`crate::echo::diffuse::points_a_segment`]), and echoes are laid down for many chirps at once
//! ([`crate::synthesis::RateGrids`]).

mod facets;
mod points;

pub use points::{Diffuse, WallPoint};

use crate::em::image::Element;
use crate::paths::Surroundings;
use facets::FacetWalls;

/// No leg counts as shorter than this, m.
pub(crate) const LEAST_LEG_M: f64 = 0.3;

/// The points of a room.
pub fn wall_points(room: &Surroundings, diffuse: Diffuse, tx: &Element, rx: &[Element], seed: u64) -> Vec<WallPoint> {
    match room {
        Surroundings::Box(room) => points::points(room, diffuse, tx, rx, seed),
        Surroundings::Polygons(room) => points::points(&FacetWalls::new(room), diffuse, tx, rx, seed),
    }
}
