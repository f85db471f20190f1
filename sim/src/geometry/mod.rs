//! Surfaces as triangle meshes.

mod mesh;

pub use mesh::Mesh;
