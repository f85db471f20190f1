//! Meshes from files: STL, OBJ and glTF.
//!
//! STL and OBJ state neither the unit of their numbers nor the axis that points up, so the caller specifies both. glTF
//! is in metres with y up. The result is in metres with z up and not yet welded ([`super::weld()`]): an STL file has
//! three vertices per triangle.

pub(crate) mod gltf;
mod lines;
mod obj;
mod stl;

use std::path::{Path, PathBuf};

use glam::DVec3;
use radome_files::{MESH_LIMIT_BYTES, read};
use schemars::JsonSchema;
use serde::Deserialize;
use thiserror::Error;

use super::{Mesh, MeshError};

pub use obj::parse_obj;
pub use stl::parse_stl;

/// Unit of a file's numbers.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize, JsonSchema)]
pub enum LengthUnit {
    /// 1 m.
    #[default]
    #[serde(rename = "m")]
    Metre,
    /// 0.01 m.
    #[serde(rename = "cm")]
    Centimetre,
    /// 0.001 m: most CAD programs.
    #[serde(rename = "mm")]
    Millimetre,
    /// 0.0254 m.
    #[serde(rename = "in")]
    Inch,
}

impl LengthUnit {
    /// Length of the unit in metres.
    pub fn metres(self) -> f64 {
        match self {
            LengthUnit::Metre => 1.0,
            LengthUnit::Centimetre => 0.01,
            LengthUnit::Millimetre => 0.001,
            LengthUnit::Inch => 0.0254,
        }
    }
}

/// Axis of a file that points up.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize, JsonSchema)]
pub enum UpAxis {
    /// z: CAD, and scenes of this program. Nothing is turned.
    #[default]
    #[serde(rename = "z")]
    Z,
    /// y, with z towards the viewer: games and animation. (x, y, z) becomes (x, -z, y).
    #[serde(rename = "y")]
    Y,
}

impl UpAxis {
    /// Converts a position or direction to z up.
    pub fn to_z_up(self, v: DVec3) -> DVec3 {
        match self {
            UpAxis::Z => v,
            UpAxis::Y => DVec3::new(v.x, -v.z, v.y),
        }
    }
}

/// Part of a file: an object, or the triangles of one material in it.
#[derive(Debug, Clone, PartialEq)]
pub struct Part {
    /// Name in the file; empty if there is none.
    pub name: String,
    /// Name of the material in the file.
    pub material: Option<String>,
    /// Surface.
    pub mesh: Mesh,
}

/// Damaged place in a file.
#[derive(Debug, Error, PartialEq)]
#[error("{place}: {problem}")]
pub struct Damage {
    /// Line from one, byte from zero, or part of the file.
    pub place: String,
    /// Content that was found, and the content that was expected.
    pub problem: String,
}

impl Damage {
    pub(crate) fn new(place: impl Into<String>, problem: impl Into<String>) -> Self {
        Damage { place: place.into(), problem: problem.into() }
    }
}

/// Error in a file's content.
#[derive(Debug, Error, PartialEq)]
pub enum ParseError {
    /// Some of the content is wrong.
    #[error(transparent)]
    Damage(#[from] Damage),
    /// The content is not a valid mesh.
    #[error(transparent)]
    Mesh(#[from] MeshError),
    /// The file contains no triangle.
    #[error("there is no triangle in it")]
    Empty,
}

impl ParseError {
    /// Remedy for this error.
    pub fn hint(&self) -> &'static str {
        match self {
            ParseError::Mesh(MeshError::InvalidPosition { .. }) => "check the unit of the file's numbers",
            _ => "export it again as binary STL, OBJ with triangles, or glTF",
        }
    }
}

/// Error in the import of a mesh file.
#[derive(Debug, Error)]
pub enum ImportError {
    /// The file cannot be read.
    #[error("cannot read the mesh {path}: {source}")]
    Read {
        /// Path of the file.
        path: PathBuf,
        /// Error of the system.
        source: std::io::Error,
    },
    /// The content is damaged.
    #[error("{path}: {source}\n\nhint: {}", .source.hint())]
    Content {
        /// Path of the file.
        path: PathBuf,
        /// Place and kind of the damage.
        source: ParseError,
    },
    /// The file format is not supported.
    #[error("{path}: the name ends in {extension:?}, expected .stl, .obj, .gltf or .glb")]
    Format {
        /// Path of the file.
        path: PathBuf,
        /// Extension of the name.
        extension: String,
    },
}

/// Reads a mesh file; the extension of its name determines the format.
///
/// # Errors
/// [`ImportError`] if the file cannot be read, its content is damaged or holds no triangle, or its name has another
/// extension.
pub fn import(path: &Path, unit: LengthUnit, up: UpAxis) -> Result<Vec<Part>, ImportError> {
    let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
    if !["stl", "obj", "gltf", "glb"].contains(&extension.as_str()) {
        return Err(ImportError::Format { path: path.to_owned(), extension });
    }
    let bytes = read(path, MESH_LIMIT_BYTES).map_err(|source| ImportError::Read { path: path.to_owned(), source })?;
    let content = |source| ImportError::Content { path: path.to_owned(), source };
    let mut parts = match extension.as_str() {
        "stl" => parse_stl(&bytes),
        "obj" => parse_obj(&bytes),
        _ => gltf::parse_gltf(&bytes, path.parent().unwrap_or(Path::new(""))),
    }
    .map_err(content)?;
    for part in &mut parts {
        for vertex in &mut part.mesh.vertices {
            *vertex = up.to_z_up(*vertex * unit.metres());
        }
        part.mesh.check().map_err(|e| content(e.into()))?;
    }
    Ok(parts)
}

#[cfg(test)]
mod hard_cases;
