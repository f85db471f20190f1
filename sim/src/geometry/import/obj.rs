//! Reader of Wavefront OBJ: vertices, faces, names of objects and materials. Textures, normals and colours are ignored.

use std::cell::Cell;
use std::collections::HashMap;

use earcut::Earcut;
use glam::DVec3;
use tobj::{LoadError, LoadOptions, Material};

use super::lines::Lines;
use super::{Damage, Mesh, ParseError, Part};
use crate::geometry::polygon;

/// Largest accepted file, bytes: a face takes ten times as much memory while it is read.
const LARGEST_BYTES: usize = 64 << 20;
/// Largest number of corners of a concave face: the time to divide it grows with their square.
const MOST_CORNERS: usize = 1000;

/// Parses an OBJ file into a part for each object or group and each material in it; polygons become triangles.
///
/// # Errors
/// [`ParseError`] at the first line that is malformed, and for a file that is too long or has no triangle.
pub fn parse_obj(bytes: &[u8]) -> Result<Vec<Part>, ParseError> {
    if bytes.len() > LARGEST_BYTES {
        let problem =
            format!("the file has {} bytes, expected {LARGEST_BYTES} at most: use binary STL or glTF", bytes.len());
        return Err(Damage::new(format!("byte {LARGEST_BYTES}"), problem).into());
    }
    let (simplified, mut names) = simplified(&String::from_utf8_lossy(bytes))?;
    names.sort();
    names.dedup();

    let count = Cell::new(0);
    let options = LoadOptions { ignore_lines: true, ignore_points: true, ..LoadOptions::default() };
    let materials = |_: &std::path::Path| {
        let all = names.iter().map(|name| Material { name: name.clone(), ..Material::default() }).collect();
        let by_name: HashMap<String, usize> = names.iter().cloned().zip(0..).collect();
        Ok((all, by_name))
    };
    let loaded = tobj::load_obj_buf(&mut Lines::new(simplified.as_bytes(), &count), &options, materials);
    let (models, _) = loaded.map_err(|error| {
        let problem = match error {
            LoadError::FaceVertexOutOfBounds => {
                "a face of the object that ends on this line names a vertex that does not exist".to_owned()
            }
            LoadError::PositionParseError => "a vertex is not three numbers".to_owned(),
            LoadError::FaceParseError => "a face is not a list of vertex numbers".to_owned(),
            other => other.to_string(),
        };
        Damage::new(format!("line {}", count.get().saturating_sub(1)), problem)
    })?;
    let mut parts = Vec::new();
    for model in models {
        let vertices = model.mesh.positions.as_chunks::<3>().0.iter().map(|&p| DVec3::from(p)).collect();
        let mut mesh = Mesh { vertices, triangles: Vec::new() };
        mesh.check_unscaled()?;
        mesh.triangles = if model.mesh.face_arities.is_empty() {
            model.mesh.indices.as_chunks::<3>().0.to_vec()
        } else {
            triangles(&mesh.vertices, &model.mesh.indices, &model.mesh.face_arities)
                .map_err(|problem| Damage::new(format!("object {:?}", model.name), problem))?
        };
        if !mesh.triangles.is_empty() {
            let material = model.mesh.material_id.and_then(|id| names.get(id).cloned());
            // Default name in tobj of an object without a name.
            let name = if model.name == "unnamed_object" { String::new() } else { model.name };
            parts.push(Part { name, material, mesh });
        }
    }
    if parts.is_empty() { Err(ParseError::Empty) } else { Ok(parts) }
}

/// Triangles of faces, each of which takes its number of corners from `indices`.
///
/// A convex face becomes a fan. Others are divided by ear clipping, because a fan would also cover areas outside the
/// outline, such as a doorway.
///
/// # Errors
/// If a concave face has more than [`MOST_CORNERS`] corners.
fn triangles(vertices: &[DVec3], mut indices: &[u32], corner_counts: &[u32]) -> Result<Vec<[u32; 3]>, String> {
    let mut triangles = Vec::with_capacity(indices.len());
    let mut clipped: Vec<u32> = Vec::new();
    let mut earcut = Earcut::<f64>::new();
    for &count in corner_counts {
        let Some((face, rest)) = indices.split_at_checked(count as usize) else { break };
        indices = rest;
        let outline: Vec<DVec3> = face.iter().filter_map(|&i| vertices.get(i as usize).copied()).collect();
        if outline.len() != face.len() || outline.len() < 3 {
            continue;
        }
        let normal = polygon::normal(&outline);
        let sides: Vec<DVec3> = polygon::sides(&outline).map(|[a, b]| b - a).collect();
        // Corners on a straight side turn by rounding errors.
        let is_convex = polygon::sides(&sides)
            .all(|[before, after]| before.cross(after).dot(normal) >= -1e-9 * before.length() * after.length());
        if is_convex {
            triangles.extend(face.windows(2).skip(1).map(|pair| [face[0], pair[0], pair[1]]));
            continue;
        }
        if face.len() > MOST_CORNERS {
            return Err(format!("a concave face has {} corners, expected {MOST_CORNERS} at most", face.len()));
        }
        let axis = normal.abs().max_position();
        let flat = outline.iter().map(|corner| [corner[(axis + 1) % 3], corner[(axis + 2) % 3]]);
        earcut.earcut(flat, &[], &mut clipped);
        triangles.extend(clipped.as_chunks::<3>().0.iter().map(|&[a, b, c]| {
            let [p, q, r] = [a, b, c].map(|corner| outline[corner as usize]);
            let has_winding = (q - p).cross(r - p).dot(normal) >= 0.0;
            (if has_winding { [a, b, c] } else { [a, c, b] }).map(|corner| face[corner as usize])
        }));
    }
    Ok(triangles)
}

/// Reduces a text to the lines that matter. An inserted first line requests the materials, so that each line has its
/// number plus one. Also returns the names of materials, of which the scene defines the properties.
///
/// # Errors
/// If a face has fewer than three corners.
fn simplified(text: &str) -> Result<(String, Vec<String>), Damage> {
    let mut names: Vec<String> = Vec::new();
    let mut simplified = String::from("mtllib names\n");
    for line in text.lines() {
        let mut words = line.split_whitespace();
        match words.next() {
            Some("v") => {
                let numbers: Vec<&str> = words.take(4).collect();
                // A fourth number is a weight if it is the last, and otherwise the first component of a colour.
                let kept = if line.split_whitespace().count() == 5 { 4 } else { 3 };
                simplified.push_str(&format!("v {}", numbers.get(..kept.min(numbers.len())).unwrap_or(&[]).join(" ")));
            }
            Some("f") => {
                let corners: Vec<&str> = words.filter_map(|w| w.split('/').next()).collect();
                if corners.len() < 3 {
                    let place = format!("line {}", simplified.lines().count());
                    return Err(Damage::new(place, "a face of fewer than three corners"));
                }
                simplified.push_str(&format!("f {}", corners.join(" ")));
            }
            Some("usemtl") => {
                let name = words.collect::<Vec<_>>().join(" ");
                if !name.is_empty() {
                    simplified.push_str(&format!("usemtl {name}"));
                    names.push(name);
                }
            }
            Some(word @ ("o" | "g")) => {
                simplified.push_str(&format!("{word} {}", words.collect::<Vec<_>>().join(" ")));
            }
            _ => {}
        }
        simplified.push('\n');
    }
    Ok((simplified, names))
}
