//! Planes of a mesh: groups of connected triangles that lie in one plane.

use std::cmp::Reverse;

use glam::DVec3;

use super::{Mesh, neighbours};

/// Connected triangles that lie in one plane.
#[derive(Debug, Clone, PartialEq)]
pub struct Plane {
    /// Unit normal.
    pub normal: DVec3,
    /// Distance of the plane from the origin along the normal, m.
    pub offset_m: f64,
    /// Area, m^2.
    pub area_m2: f64,
    /// The triangles, ascending.
    pub triangles: Vec<u32>,
    /// Closed loops of vertices around the plane: counter-clockwise outside, clockwise around holes. All vertices are
    /// kept, including those within straight lines, so that the outlines of neighbours still fit.
    pub outlines: Vec<Vec<u32>>,
}

/// Planes of a mesh.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Planes {
    /// Index of the plane of every triangle. A triangle of a curved surface is a plane of its own.
    pub of_triangle: Vec<u32>,
    /// Planes, sorted by their lowest triangle.
    pub planes: Vec<Plane>,
}

/// Groups triangles that are connected by edges and have all corners within a tolerance of the plane of the largest of
/// them. 1 um is 0.003 rad of phase at 60 GHz and far above rounding; facets of a body differ by more.
pub fn planes(mesh: &Mesh, tolerance_m: f64) -> Planes {
    let neighbours = neighbours(mesh);
    let mut by_area: Vec<u32> = (0..mesh.triangles.len() as u32).collect();
    by_area.sort_by_key(|&t| (Reverse(mesh.area_vector(t as usize).length_squared().to_bits()), t));
    let mut group_of: Vec<Option<u32>> = vec![None; mesh.triangles.len()];
    let mut groups: Vec<Vec<u32>> = Vec::new();
    for seed in by_area {
        if group_of[seed as usize].is_some() {
            continue;
        }
        let normal = mesh.area_vector(seed as usize).normalize_or_zero();
        let Some([origin, ..]) = mesh.corners(seed as usize) else { continue };
        let lies_in = |t: u32| {
            mesh.corners(t as usize).is_some_and(|corners| {
                corners.iter().all(|c| (*c - origin).dot(normal).abs() <= tolerance_m)
                    && mesh.area_vector(t as usize).dot(normal) > 0.0
            })
        };
        let group = groups.len() as u32;
        let mut members = vec![seed];
        group_of[seed as usize] = Some(group);
        let mut visited = 0;
        while let Some(&triangle) = members.get(visited) {
            visited += 1;
            for n in neighbours[triangle as usize] {
                // The index is out of range where a side has no neighbour.
                if let Some(slot @ None) = group_of.get_mut(n as usize)
                    && lies_in(n)
                {
                    *slot = Some(group);
                    members.push(n);
                }
            }
        }
        members.sort_unstable();
        groups.push(members);
    }
    groups.sort_by_key(|members| members.first().copied());
    let mut result = Planes { of_triangle: vec![0; mesh.triangles.len()], planes: Vec::new() };
    for members in groups {
        for &t in &members {
            result.of_triangle[t as usize] = result.planes.len() as u32;
        }
        result.planes.push(plane(mesh, members));
    }
    result
}

/// Plane of triangles that lie in one.
fn plane(mesh: &Mesh, triangles: Vec<u32>) -> Plane {
    let sum: DVec3 = triangles.iter().map(|&t| mesh.area_vector(t as usize)).sum();
    let normal = sum.normalize_or_zero();
    let corners = triangles.iter().filter_map(|&t| mesh.corners(t as usize)).flatten();
    let (total, count) = corners.fold((0.0, 0.0), |(total, count), c| (total + c.dot(normal), count + 1.0));
    Plane {
        normal,
        offset_m: if count > 0.0 { total / count } else { 0.0 },
        area_m2: 0.5 * sum.length(),
        outlines: outlines(mesh, &triangles),
        triangles,
    }
}

/// Outlines of some triangles: closed loops of the edges that belong to only one of them.
fn outlines(mesh: &Mesh, triangles: &[u32]) -> Vec<Vec<u32>> {
    let mut sides: Vec<[u32; 2]> = triangles
        .iter()
        .filter_map(|&t| mesh.triangles.get(t as usize))
        .flat_map(|&[a, b, c]| [[a, b], [b, c], [c, a]])
        .collect();
    sides.sort_unstable();
    let inner = |&[a, b]: &[u32; 2]| sides.binary_search(&[b, a]).is_ok();
    let mut border: Vec<[u32; 2]> = sides.iter().filter(|s| !inner(s)).copied().collect();
    let mut loops = Vec::new();
    while let Some([first, mut vertex]) = border.pop() {
        let mut outline = vec![first];
        while vertex != first {
            outline.push(vertex);
            let Some(next) = border.iter().position(|&[from, _]| from == vertex) else { break };
            [_, vertex] = border.remove(next);
        }
        loops.push(outline);
    }
    loops
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::isosurface;

    /// Square of 1 m with a window, bent along the middle by `bend_m`.
    fn sheet(bend_m: f64) -> Mesh {
        let mut sheet = Mesh::sheet(8, &[9]);
        for vertex in &mut sheet.vertices {
            *vertex /= 8.0;
            vertex.z = bend_m * (vertex.x - 0.5).max(0.0);
        }
        sheet
    }

    #[test]
    fn a_finely_split_wall_with_a_window_is_one_plane_with_two_outlines() {
        let found = planes(&sheet(0.0), 1e-6);
        assert_eq!(found.planes.len(), 1);
        let wall = &found.planes[0];
        assert!((wall.area_m2 - 63.0 / 64.0).abs() < 1e-12);
        assert_eq!(wall.normal, DVec3::Z);
        let mut lengths: Vec<usize> = wall.outlines.iter().map(Vec::len).collect();
        lengths.sort_unstable();
        assert_eq!(lengths, [4, 32]);
    }

    #[test]
    fn a_bent_wall_is_two_planes_and_a_sphere_is_none() {
        assert_eq!(planes(&sheet(1e-3), 1e-6).planes.len(), 2);
        assert_eq!(planes(&sheet(1e-7), 1e-6).planes.len(), 1);
        let ball = isosurface(DVec3::splat(-0.15), DVec3::splat(0.15), 0.015, |p| p.length() - 0.1);
        let found = planes(&ball, 1e-6);
        assert!(found.planes.len() as f64 > 0.98 * ball.triangles.len() as f64, "{} planes", found.planes.len());
    }
}
