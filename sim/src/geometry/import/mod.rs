//! Meshes from files: STL and OBJ.
//!
//! Neither format says in which unit its numbers are, nor which way is up; whoever imports has to. What comes out is in metres
//! with z up, not yet welded ([`super::weld`]): an STL file has three vertices a triangle.

mod lines;
mod obj;
mod stl;

use std::path::{Path, PathBuf};

use glam::DVec3;
use thiserror::Error;

use super::{Mesh, MeshError};

pub use obj::parse_obj;
pub use stl::parse_stl;

/// What one of a file's numbers means.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LengthUnit {
    /// 1 m.
    Metre,
    /// 0.01 m.
    Centimetre,
    /// 0.001 m: most CAD programs.
    Millimetre,
    /// 0.0254 m.
    Inch,
}

impl LengthUnit {
    /// Metres in one of it.
    pub fn metres(self) -> f64 {
        match self {
            LengthUnit::Metre => 1.0,
            LengthUnit::Centimetre => 0.01,
            LengthUnit::Millimetre => 0.001,
            LengthUnit::Inch => 0.0254,
        }
    }
}

/// Which of a file's axes points up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UpAxis {
    /// z: CAD, and this house. Nothing is turned.
    Z,
    /// y, with z towards the viewer: games and animation. (x, y, z) becomes (x, -z, y).
    Y,
}

/// A part of a file.
#[derive(Debug, Clone, PartialEq)]
pub struct Part {
    /// Its name in the file; empty where there is none.
    pub name: String,
    /// The name of its material in the file.
    pub material: Option<String>,
    /// The surface.
    pub mesh: Mesh,
}

/// What is wrong with a file's content.
#[derive(Debug, Error, PartialEq)]
pub enum ParseError {
    /// At a line of a text.
    #[error("line {line}: {problem}")]
    Line {
        /// Counted from one.
        line: usize,
        /// What is wrong.
        problem: String,
    },
    /// At a byte of a binary file.
    #[error("byte {offset}: {problem}")]
    Byte {
        /// Counted from zero.
        offset: usize,
        /// What is wrong.
        problem: String,
    },
    /// Something that is no mesh.
    #[error(transparent)]
    Mesh(#[from] MeshError),
    /// No triangle in it.
    #[error("there is no triangle in it")]
    Empty,
}

/// A mesh file that cannot be had.
#[derive(Debug, Error)]
pub enum ImportError {
    /// It cannot be read.
    #[error("cannot read the mesh {path}")]
    Read {
        /// The file.
        path: PathBuf,
        /// Why not.
        #[source]
        source: std::io::Error,
    },
    /// Its content is damaged.
    #[error("{path}: {source}\n\nhint: export it again as binary STL or as OBJ with triangles")]
    Content {
        /// The file.
        path: PathBuf,
        /// Where and what.
        source: ParseError,
    },
    /// No format of ours.
    #[error("{path}: the name ends in {extension:?}, expected .stl or .obj")]
    Format {
        /// The file.
        path: PathBuf,
        /// What its name ends in.
        extension: String,
    },
}

/// Reads a mesh file; its name's ending tells the format.
pub fn import(path: &Path, unit: LengthUnit, up: UpAxis) -> Result<Vec<Part>, ImportError> {
    let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
    let parse = match extension.as_str() {
        "stl" => parse_stl,
        "obj" => parse_obj,
        _ => return Err(ImportError::Format { path: path.to_owned(), extension }),
    };
    let bytes = std::fs::read(path).map_err(|source| ImportError::Read { path: path.to_owned(), source })?;
    let content = |source| ImportError::Content { path: path.to_owned(), source };
    let mut parts = parse(&bytes).map_err(content)?;
    for part in &mut parts {
        for vertex in &mut part.mesh.vertices {
            *vertex *= unit.metres();
            if up == UpAxis::Y {
                *vertex = DVec3::new(vertex.x, -vertex.z, vertex.y);
            }
        }
        part.mesh.check().map_err(|e| content(e.into()))?;
    }
    Ok(parts)
}

#[cfg(test)]
mod hard_cases;
