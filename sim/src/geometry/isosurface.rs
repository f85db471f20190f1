//! Closed mesh of the zero set of a smooth function.
//!
//! The method is naive surface nets (Gibson, "Constrained elastic surface nets", MICCAI 1998). Every cell has one
//! vertex for each sheet of the surface in it, and every grid edge that the surface crosses has one quadrilateral.
//! Vertices are then relaxed along the surface, which makes triangles even, and projected onto it by Newton's step.

use std::collections::BTreeMap;

use glam::{DVec3, IVec3};

use super::Mesh;

/// Number of relaxation rounds: further rounds do not change the triangles' shapes visibly.
const ROUNDS: usize = 6;
/// Step of the gradient's finite differences, as a part of the cell.
const GRADIENT_STEP: f64 = 1e-3;

/// Meshes the zero set of a function, negative inside, within a box that the surface does not touch. Triangles face
/// outwards and their edges are about as long as a cell. Features finer than two cells are lost or pinched.
pub fn isosurface(least: DVec3, greatest: DVec3, cell_m: f64, function: impl Fn(DVec3) -> f64 + Sync) -> Mesh {
    let size = ((greatest - least) / cell_m).ceil().as_ivec3() + IVec3::ONE;
    let position = |p: IVec3| least + p.as_dvec3() * cell_m;
    let index = |p: IVec3| (p.x + size.x * (p.y + size.y * p.z)) as usize;
    let grid =
        || (0..size.z).flat_map(move |z| (0..size.y).flat_map(move |y| (0..size.x).map(move |x| IVec3::new(x, y, z))));
    let mut values = vec![0.0; (size.x * size.y * size.z) as usize];
    on_all_cores(&mut values, |i, value| {
        let i = i as i32;
        *value = function(position(IVec3::new(i % size.x, i / size.x % size.y, i / (size.x * size.y))));
    });
    let value = |p: IVec3| values.get(index(p)).copied().unwrap_or(f64::INFINITY);

    let mut mesh = Mesh::default();
    // Vertex of the sheet that crosses an edge, by the index of the cell and that of the edge in the cell.
    let mut vertex_of = BTreeMap::new();
    for p in grid().filter(|p| p.cmplt(size - IVec3::ONE).all()) {
        let corners = std::array::from_fn(|corner| value(p + offset(corner)));
        for sheet in sheets(&corners) {
            let crossing = |&edge: &usize| {
                let (from, to) = ends(edge);
                let (a, b) = (corners[from], corners[to]);
                offset(from).as_dvec3().lerp(offset(to).as_dvec3(), a / (a - b))
            };
            let middle = sheet.iter().map(crossing).sum::<DVec3>() / sheet.len() as f64;
            for edge in sheet {
                vertex_of.insert((index(p), edge), mesh.vertices.len() as u32);
            }
            mesh.vertices.push(position(p) + middle * cell_m);
        }
    }
    for p in grid() {
        for axis in 0..3 {
            let [step, u, v] = [0, 1, 2].map(|i| IVec3::AXES[(axis + i) % 3]);
            let q = p + step;
            if !q.cmplt(size).all() || (value(p) < 0.0) == (value(q) < 0.0) {
                continue;
            }
            // The four cells around the edge, counter-clockwise seen from its far end.
            let around = [(1, 1), (0, 1), (0, 0), (1, 0)].map(|(i, j)| {
                let cell = p - u * i - v * j;
                vertex_of.get(&(index(cell), 4 * axis + (i + 2 * j) as usize)).copied()
            });
            let [Some(a), Some(b), Some(c), Some(d)] = around else { continue };
            let [a, b, c, d] = if value(p) < 0.0 { [a, b, c, d] } else { [d, c, b, a] };
            let at = |i: u32| mesh.vertices[i as usize];
            // The quadrilateral is cut along its shorter diagonal.
            if at(a).distance_squared(at(c)) < at(b).distance_squared(at(d)) {
                mesh.triangles.extend([[a, b, c], [a, c, d]]);
            } else {
                mesh.triangles.extend([[a, b, d], [b, c, d]]);
            }
        }
    }
    relax(&mut mesh, cell_m, &function);
    mesh
}

/// Offset of a corner of a cell: bit 0 is x, 1 is y, 2 is z.
fn offset(corner: usize) -> IVec3 {
    IVec3::new((corner & 1) as i32, (corner >> 1 & 1) as i32, (corner >> 2 & 1) as i32)
}

/// Corners of an edge of a cell: four edges along each axis, ordered by their coordinates along the next axis and the
/// one after.
fn ends(edge: usize) -> (usize, usize) {
    let axis = edge / 4;
    let from = (edge & 1) << ((axis + 1) % 3) | (edge >> 1 & 1) << ((axis + 2) % 3);
    (from, from | 1 << axis)
}

/// Edges of a cell that the surface crosses, grouped by connected sheet. Two sheets in one cell get a vertex each;
/// otherwise the mesh would be pinched there (Nielson, "Dual marching cubes", IEEE Visualization 2004).
fn sheets(corners: &[f64; 8]) -> Vec<Vec<usize>> {
    let inside = corners.map(|v| v < 0.0);
    if inside.iter().all(|&i| i == inside[0]) {
        return Vec::new();
    }
    let mut sheet_of: [usize; 12] = std::array::from_fn(|edge| edge);
    let crossed: Vec<usize> = (0..12).filter(|&e| inside[ends(e).0] != inside[ends(e).1]).collect();
    for face in 0..6 {
        let (bit, side) = (1 << (face / 2), face % 2);
        let on_face = |corner: usize| usize::from(corner & bit != 0) == side;
        let edges: Vec<usize> = crossed.iter().copied().filter(|&e| on_face(ends(e).0) && on_face(ends(e).1)).collect();
        for (i, &e) in edges.iter().enumerate() {
            for &f in edges.iter().skip(i + 1) {
                // On a face with four crossings, those at the same corner inside belong to one sheet.
                let shared = |c: usize| inside[c] && (c == ends(f).0 || c == ends(f).1);
                if edges.len() == 2 || shared(ends(e).0) || shared(ends(e).1) {
                    let (from, to) = (sheet_of[e], sheet_of[f]);
                    sheet_of.iter_mut().filter(|s| **s == from).for_each(|s| *s = to);
                }
            }
        }
    }
    let mut sheets: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for edge in crossed {
        sheets.entry(sheet_of[edge]).or_default().push(edge);
    }
    sheets.into_values().collect()
}

/// Applies a function to every item and its index; the result does not depend on the number of threads.
///
/// It does not use the shared thread pool: a body is made while a thread holds a lock for it, and waiting in the pool
/// could block others.
fn on_all_cores<T: Send>(items: &mut [T], function: impl Fn(usize, &mut T) + Sync) {
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let share = items.len().div_ceil(threads).max(1);
    std::thread::scope(|scope| {
        for (number, items) in items.chunks_mut(share).enumerate() {
            let function = &function;
            scope.spawn(move || items.iter_mut().enumerate().for_each(|(i, item)| function(number * share + i, item)));
        }
    });
}

/// Moves every vertex to the middle of its neighbours along the surface, and projects it onto the surface.
fn relax(mesh: &mut Mesh, cell_m: f64, function: &(impl Fn(DVec3) -> f64 + Sync)) {
    let h = cell_m * GRADIENT_STEP;
    // Moves a vertex by Newton's step to the surface, and returns its normal there.
    let project = |vertex: &mut DVec3| {
        let value = function(*vertex);
        let slope = DVec3::AXES.map(|axis| (function(*vertex + axis * h) - value) / h);
        let slope = DVec3::from(slope);
        let newton = slope * (value / slope.length_squared().max(1e-12));
        *vertex -= newton.clamp_length_max(cell_m);
        slope.normalize_or_zero()
    };
    // Vertices with their normals.
    let mut all: Vec<(DVec3, DVec3)> = mesh.vertices.iter().map(|&vertex| (vertex, DVec3::ZERO)).collect();
    on_all_cores(&mut all, |_, (vertex, normal)| *normal = project(vertex));
    for _ in 0..ROUNDS {
        // An inner edge belongs to two triangles and is visited in both directions: each neighbour is counted once.
        let mut sums = vec![(DVec3::ZERO, 0.0); all.len()];
        for &[a, b, c] in &mesh.triangles {
            for (from, to) in [(a, b), (b, c), (c, a)] {
                let (sum, count) = &mut sums[from as usize];
                *sum += all[to as usize].0;
                *count += 1.0;
            }
        }
        on_all_cores(&mut all, |i, (vertex, normal)| {
            let (sum, count) = sums[i];
            let step = if count > 0.0 { sum / count - *vertex } else { DVec3::ZERO };
            *vertex += step - *normal * step.dot(*normal);
            *normal = project(vertex);
        });
    }
    on_all_cores(&mut all, |_, (vertex, _)| {
        project(vertex);
        project(vertex);
    });
    mesh.vertices = all.into_iter().map(|(vertex, _)| vertex).collect();
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sphere_is_closed_faces_outwards_and_has_its_volume() {
        let r = 0.2;
        let mesh = isosurface(DVec3::splat(-0.25), DVec3::splat(0.25), 0.02, |p| p.length() - r);
        let exact = 4.0 / 3.0 * std::f64::consts::PI * r.powi(3);
        assert!((mesh.volume_m3() / exact - 1.0).abs() < 0.01, "{}", mesh.volume_m3() / exact);
        assert!(mesh.vertices.iter().all(|v| (v.length() - r).abs() < 1e-6));
        // Euler's formula for a closed surface without holes: V - E + F = 2, and 2 E = 3 F.
        assert_eq!(2 * mesh.vertices.len(), mesh.triangles.len() + 4);
        let edges = mesh.triangles.iter().flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)]);
        let lengths: Vec<f64> =
            edges.map(|(a, b)| mesh.vertices[a as usize].distance(mesh.vertices[b as usize])).collect();
        assert!(lengths.iter().all(|l| (0.008..0.035).contains(l)));
    }
}
