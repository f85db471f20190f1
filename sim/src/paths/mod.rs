//! Paths between antennas and points, reflected by plane polygons. Rays find the surfaces that a path meets, and images
//! give the exact path.
//!
//! An [`Environment`] has the polygons, which are called facets. [`ImagePaths::discover`] launches rays from an antenna
//! and keeps every sequence of facets that reflects a ray. Sequences with the same image of the antenna share an
//! [`Image`]. [`ImagePaths::illuminate`] unfolds a sequence in f64. It checks that the points of reflection lie on the
//! facets and that the legs (the straight pieces between them) are free, and multiplies the reflection coefficients.
//! Free edges and outward corners diffract to first order ([`edge_field`]). A path therefore fades where its point of
//! reflection leaves a facet, or where a corner obstructs it. Walls may transmit waves.
//!
//! [`Surroundings`] are what surrounds a scene's antennas: polygons, or a box whose images are a lattice in closed
//! form.

mod aperture;
mod corner_runs;
mod corners;
pub mod discovery;
pub mod edge_field;
mod edge_index;
mod edges;
pub mod environment;
pub mod exhaustive;
mod facets;
mod flat;
mod folded;
mod groups;
mod illuminate;
mod leg;
mod mirror_rows;
mod reach;
#[cfg(test)]
mod rooms;
mod surroundings;
#[cfg(test)]
mod tests;
mod triangulate;

pub use discovery::{DiscoveryReport, Image, ImagePaths, LaunchOptions, MAX_ORDER};
pub use edges::DiffractingEdge;
pub use environment::{Environment, EnvironmentError, Facet, FacetId};
pub use illuminate::{EdgesBeside, Obstruction};
pub use surroundings::{PolygonRoom, Surroundings};
