//! Surfaces as triangle meshes.

mod isosurface;
mod mesh;

pub use isosurface::isosurface;
pub use mesh::Mesh;
