//! Meshes from files: STL (binary and text) and OBJ, in metres.

use std::io::Cursor;

use glam::DVec3;
use thiserror::Error;

use super::Mesh;

/// Why bytes are no mesh.
#[derive(Debug, Error)]
pub enum ImportError {
    /// STL that cannot be read.
    #[error("not a readable STL file: {0}\n\nhint: it must be whole, text or binary, with triangles only")]
    Stl(std::io::Error),
    /// A binary STL whose length is not what its header says.
    #[error(
        "this binary STL file says {triangles} triangles, which take {expected} bytes; it has {found}\n\nhint: it was cut short or is none; export it again"
    )]
    StlLength {
        /// What the header says.
        triangles: u32,
        /// How long it should be.
        expected: u64,
        /// How long it is.
        found: u64,
    },
    /// OBJ that cannot be read.
    #[error("not a readable OBJ file: {0}\n\nhint: it must have vertices (v) and faces (f)")]
    Obj(tobj::LoadError),
    /// A coordinate that is no number.
    #[error("vertex {index} is no place: {position}\n\nhint: coordinates must be finite numbers, in metres")]
    NotFinite {
        /// Which vertex.
        index: usize,
        /// What it is.
        position: DVec3,
    },
    /// A file without triangles.
    #[error("no triangles in it\n\nhint: export the surface as triangles, not as points or curves")]
    Empty,
}

/// Length of a binary STL's header and of one of its triangles.
const STL_HEADER: usize = 84;
const STL_TRIANGLE: u64 = 50;

impl Mesh {
    /// From the bytes of an STL file.
    pub fn from_stl(bytes: &[u8]) -> Result<Mesh, ImportError> {
        let text = bytes.starts_with(b"solid") && bytes.windows(5).take(2000).any(|w| w == b"facet");
        if !text && let Some(&[a, b, c, d]) = bytes.get(STL_HEADER - 4..STL_HEADER) {
            // Checked before anything is set aside for what the header claims.
            let triangles = u32::from_le_bytes([a, b, c, d]);
            let expected = STL_HEADER as u64 + STL_TRIANGLE * u64::from(triangles);
            if expected > bytes.len() as u64 {
                return Err(ImportError::StlLength { triangles, expected, found: bytes.len() as u64 });
            }
        }
        let stl = stl_io::read_stl(&mut Cursor::new(bytes)).map_err(ImportError::Stl)?;
        let vertices = stl.vertices.iter().map(|v| DVec3::new(f64::from(v[0]), f64::from(v[1]), f64::from(v[2])));
        let triangles = stl.faces.iter().map(|face| face.vertices.map(|i| i as u32));
        checked(Mesh { vertices: vertices.collect(), triangles: triangles.collect() })
    }

    /// From the bytes of an OBJ file; all its objects together, materials left out.
    pub fn from_obj(bytes: &[u8]) -> Result<Mesh, ImportError> {
        let options =
            tobj::LoadOptions { triangulate: true, ignore_points: true, ignore_lines: true, ..Default::default() };
        let (models, _) = tobj::load_obj_buf(&mut Cursor::new(bytes), &options, |_| Ok(Default::default()))
            .map_err(ImportError::Obj)?;
        let mut mesh = Mesh::default();
        for model in models {
            let first = mesh.vertices.len() as u32;
            let positions = model.mesh.positions.chunks_exact(3);
            mesh.vertices.extend(positions.map(|p| DVec3::new(f64::from(p[0]), f64::from(p[1]), f64::from(p[2]))));
            let triangles = model.mesh.indices.chunks_exact(3);
            mesh.triangles.extend(triangles.map(|t| [first + t[0], first + t[1], first + t[2]]));
        }
        checked(mesh)
    }
}

fn checked(mesh: Mesh) -> Result<Mesh, ImportError> {
    if let Some((index, &position)) = mesh.vertices.iter().enumerate().find(|(_, v)| !v.is_finite()) {
        return Err(ImportError::NotFinite { index, position });
    }
    if mesh.triangles.is_empty() { Err(ImportError::Empty) } else { Ok(mesh) }
}

#[cfg(test)]
mod hard_cases {
    use super::*;

    fn binary_stl(triangles: &[[[f32; 3]; 3]]) -> Vec<u8> {
        let mut bytes = vec![0u8; 80];
        bytes.extend((triangles.len() as u32).to_le_bytes());
        for triangle in triangles {
            bytes.extend([0u8; 12]);
            bytes.extend(triangle.iter().flatten().flat_map(|v| v.to_le_bytes()));
            bytes.extend([0u8; 2]);
        }
        bytes
    }

    const TRIANGLE: [[f32; 3]; 3] = [[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, 0.25, 0.0]];

    #[test]
    fn files_give_their_triangles() {
        let stl = Mesh::from_stl(&binary_stl(&[TRIANGLE])).expect("whole");
        assert_eq!(stl.area_m2(), 0.0625);
        let text = "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 0.5 0 0\nvertex 0 0.25 0\nendloop\n\
                    endfacet\nendsolid a\n";
        assert_eq!(Mesh::from_stl(text.as_bytes()).expect("whole").area_m2(), 0.0625);
        // A quadrangle becomes two triangles, negative indices count backwards.
        let obj = "o a\nv 0 0 0\nv 0.5 0 0\nv 0.5 0.25 0\nv 0 0.25 0\nf -4 -3 -2 -1\n";
        let obj = Mesh::from_obj(obj.as_bytes()).expect("whole");
        assert_eq!((obj.triangles.len(), obj.area_m2()), (2, 0.125));
    }

    #[test]
    fn cut_empty_and_lying_files_are_refused() {
        let whole = binary_stl(&[TRIANGLE; 4]);
        for length in [0, 10, 83, 84, 100, whole.len() - 1] {
            assert!(Mesh::from_stl(&whole[..length]).is_err(), "{length}");
        }
        let mut lying = binary_stl(&[TRIANGLE]);
        lying[80..84].copy_from_slice(&u32::MAX.to_le_bytes());
        assert!(matches!(Mesh::from_stl(&lying), Err(ImportError::StlLength { .. })));
        let mut infinite = TRIANGLE;
        infinite[1][2] = f32::NAN;
        assert!(Mesh::from_stl(&binary_stl(&[infinite])).is_err());
        assert!(matches!(Mesh::from_stl(&binary_stl(&[])), Err(ImportError::Empty)));
        for text in ["", "v 0 0 0\n", "v 0 0 0\nf 1 2 3\n", "v 0 0 0\nf 0 0 0\n", "v a b c\nf 1 1 1\n", "f 1 2\n"] {
            assert!(Mesh::from_obj(text.as_bytes()).is_err(), "{text:?}");
        }
        assert!(Mesh::from_stl(b"solid\nfacet normal 0 0\n").is_err());
    }
}
