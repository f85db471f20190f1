//! Reader of STL, binary and text.

use std::cell::Cell;
use std::io::Cursor;

use glam::DVec3;

use super::lines::Lines;
use super::{Damage, Mesh, ParseError, Part};

/// Length of the header and triangle count of a binary file.
const HEADER_BYTES: usize = 84;
/// Length of a triangle in a binary file.
const TRIANGLE_BYTES: usize = 50;

/// Parses an STL file. The file is text if it begins with `solid` and its length differs from that of a binary file
/// with its triangle count: some programs also begin binary files with `solid`. Normals in the file are not used; the
/// winding of the corners defines them.
///
/// # Errors
/// [`ParseError`] at the first line or byte that is malformed, and for a file without a triangle.
pub fn parse_stl(bytes: &[u8]) -> Result<Vec<Part>, ParseError> {
    let stated_bytes = bytes
        .get(80..HEADER_BYTES)
        .and_then(|c| c.try_into().ok())
        .map(|c: [u8; 4]| HEADER_BYTES + TRIANGLE_BYTES * u32::from_le_bytes(c) as usize);
    let text = bytes.trim_ascii_start();
    let part = if text.starts_with(b"solid") && stated_bytes != Some(bytes.len()) {
        parse_text(bytes)?
    } else {
        match stated_bytes {
            Some(stated) if bytes.len() >= stated => parse_binary(bytes)?,
            Some(stated) => {
                let problem = format!("the file ends here, but its triangles reach to byte {stated}");
                return Err(at_byte(bytes.len(), problem).into());
            }
            None => {
                let problem = format!("the file ends within the first {HEADER_BYTES} bytes and is no text");
                return Err(at_byte(bytes.len(), problem).into());
            }
        }
    };
    if part.mesh.triangles.is_empty() { Err(ParseError::Empty) } else { Ok(vec![part]) }
}

/// Damage at a byte of the file.
fn at_byte(offset: usize, problem: impl ToString) -> Damage {
    Damage::new(format!("byte {offset}"), problem.to_string())
}

fn parse_binary(bytes: &[u8]) -> Result<Part, Damage> {
    // A header that begins with `solid` would select the text format.
    let mut bytes = bytes.to_vec();
    if let Some(first) = bytes.first_mut() {
        *first = b' ';
    }
    let mut triangles = Vec::new();
    let offset = |triangle: usize| HEADER_BYTES + TRIANGLE_BYTES * triangle;
    let mut cursor = Cursor::new(bytes);
    let reader = stl_io::create_stl_reader(&mut cursor).map_err(|e| at_byte(0, e))?;
    for (index, triangle) in reader.enumerate() {
        let triangle = triangle.map_err(|e| at_byte(offset(index), e))?;
        if !triangle.vertices.iter().flat_map(|v| v.0).all(f32::is_finite) {
            return Err(at_byte(offset(index), format!("triangle {index} has a corner that is no place")));
        }
        triangles.push(corners(&triangle));
    }
    Ok(Part { name: String::new(), material: None, mesh: Mesh::soup(triangles) })
}

fn parse_text(bytes: &[u8]) -> Result<Part, Damage> {
    // The reader requires a name after `solid`, and nothing before it.
    let skipped = bytes.len() - bytes.trim_ascii_start().len();
    let lines_skipped = bytes.iter().take(skipped).filter(|&&b| b == b'\n').count();
    let first_end = bytes.iter().skip(skipped).position(|&b| b == b'\n').map_or(bytes.len(), |i| skipped + i);
    let first_line = bytes.get(skipped..first_end).unwrap_or(&[]);
    let name = String::from_utf8_lossy(first_line.get(5..).unwrap_or(&[])).trim().to_owned();
    let rest = bytes.get(first_end..).unwrap_or(&[]);
    let text = [b"solid x".as_slice(), rest].concat();

    let count = Cell::new(0);
    let mut lines = Lines::new(&text, &count);
    let problem = |e: std::io::Error| Damage::new(format!("line {}", lines_skipped + count.get()), e.to_string());
    let mut triangles = Vec::new();
    for triangle in stl_io::create_stl_reader(&mut lines).map_err(problem)? {
        triangles.push(corners(&triangle.map_err(problem)?));
    }
    Ok(Part { name, material: None, mesh: Mesh::soup(triangles) })
}

fn corners(triangle: &stl_io::Triangle) -> [DVec3; 3] {
    triangle.vertices.map(|v| DVec3::from(v.0.map(f64::from)))
}
