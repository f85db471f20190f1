//! Surfaces as triangle meshes: merging of vertices ([`weld()`]), detection of defects ([`overlaps()`]), extraction of
//! planes and edges ([`planes()`], [`edges()`]), and import of files ([`mod@import`]).

mod creases;
mod edges;
pub mod import;
mod isosurface;
mod mesh;
mod normals;
mod orient;
mod overlaps;
mod planar_polygon;
mod planes;
pub mod polygon;
pub mod shape;
mod surface;
#[cfg(test)]
mod test_meshes;
mod weld;

pub use edges::{Edge, edges, neighbours};
pub use isosurface::isosurface;
pub use mesh::{MAX_COORDINATE_M, Mesh, MeshError};
pub(crate) use normals::one_ring_normals;
pub use orient::oriented;
pub use overlaps::overlaps;
pub use planar_polygon::{Clearance, PlanarPolygon};
pub use planes::{Plane, Planes, planes};
pub use surface::Surface;
pub(crate) use surface::{bulge, halfway, split};
pub use weld::{Welded, weld};
