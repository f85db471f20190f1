//! Defects of a mesh before it is simulated.

use glam::{DVec2, DVec3};

use super::{Mesh, edges};

/// Coplanar triangles that cover each other by more than this are reported, m^2: two surfaces at one place are both lit.
pub const LEAST_OVERLAP_M2: f64 = 1e-6;
/// Triangles this near to each other's planes count as coplanar, m.
const SAME_PLANE_M: f64 = 1e-5;

/// The search for overlaps ends after so many of them, or so many pairs of triangles: a damaged mesh would have as many as the
/// square of its triangles.
const MOST_OVERLAPS: usize = 1000;
const MOST_PAIRS: usize = 50_000_000;

/// Triangles that hang together.
#[derive(Debug, Clone, PartialEq)]
pub struct Shell {
    /// Its lowest triangle.
    pub first_triangle: u32,
    /// Triangles.
    pub triangles: usize,
    /// True if the mesh has neither border nor tangle.
    pub closed: bool,
    /// Volume, m^3; negative when it faces inwards. Of an open shell, that of the cone over it from the origin.
    pub volume_m3: f64,
}

impl Shell {
    /// Closed and facing inwards: right for a room, wrong for a thing.
    pub fn is_inside_out(&self) -> bool {
        self.closed && self.volume_m3 < 0.0
    }
}

/// Two coplanar triangles that cover each other.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Overlap {
    /// The triangles, lower first.
    pub triangles: [u32; 2],
    /// Common area, m^2.
    pub area_m2: f64,
}

/// Findings.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Lint {
    /// Edges where the surface ends.
    pub boundary_edges: usize,
    /// Edges of three triangles or more, or of two that face different ways.
    pub tangled_edges: usize,
    /// Connected pieces, by their lowest triangle.
    pub shells: Vec<Shell>,
    /// Overlaps above [`LEAST_OVERLAP_M2`], by triangles; the first thousand that are found.
    pub overlaps: Vec<Overlap>,
}

impl Lint {
    /// Whether a solid thing could be made of it: closed, facing outwards, no surface twice.
    pub fn is_solid(&self) -> bool {
        let good = |s: &Shell| s.closed && !s.is_inside_out();
        self.tangled_edges == 0 && self.overlaps.is_empty() && !self.shells.is_empty() && self.shells.iter().all(good)
    }
}

/// Looks for open and tangled edges, shells that face inwards and faces that cover each other. Weld first: vertices apart by
/// rounding are borders.
pub fn lint(mesh: &Mesh) -> Lint {
    let edges = edges(mesh);
    let mut root: Vec<u32> = (0..mesh.triangles.len() as u32).collect();
    fn find(root: &mut [u32], mut of: u32) -> u32 {
        while let Some(&up) = root.get(of as usize)
            && up != of
        {
            let top = root.get(up as usize).copied().unwrap_or(up);
            if let Some(slot) = root.get_mut(of as usize) {
                *slot = top;
            }
            of = top;
        }
        of
    }
    for edge in &edges {
        if let Some(right) = edge.right {
            let (a, b) = (find(&mut root, edge.left), find(&mut root, right));
            if let Some(slot) = root.get_mut(a.max(b) as usize) {
                *slot = a.min(b);
            }
        }
    }
    let mut shells: Vec<Shell> = Vec::new();
    let mut shell_of = vec![usize::MAX; mesh.triangles.len()];
    for triangle in 0..mesh.triangles.len() {
        let top = find(&mut root, triangle as u32) as usize;
        // A root is the lowest of its shell, so it comes first.
        if top == triangle {
            let first_triangle = triangle as u32;
            shells.push(Shell { first_triangle, triangles: 0, closed: true, volume_m3: 0.0 });
        }
        let shell = if top == triangle { shells.len() - 1 } else { shell_of.get(top).copied().unwrap_or(usize::MAX) };
        if let (Some(slot), Some(shell_data)) = (shell_of.get_mut(triangle), shells.get_mut(shell)) {
            *slot = shell;
            shell_data.triangles += 1;
            if let Some([a, b, c]) = mesh.corners(triangle) {
                shell_data.volume_m3 += a.dot(b.cross(c)) / 6.0;
            }
        }
    }
    for edge in edges.iter().filter(|e| e.right.is_none()) {
        if let Some(shell) = shell_of.get(edge.left as usize).and_then(|&s| shells.get_mut(s)) {
            shell.closed = false;
        }
    }
    Lint {
        boundary_edges: edges.iter().filter(|e| e.is_boundary()).count(),
        tangled_edges: edges.iter().filter(|e| e.tangled).count(),
        shells,
        overlaps: overlaps(mesh),
    }
}

/// Pairs of coplanar triangles that cover each other: swept along x, compared where boxes touch.
fn overlaps(mesh: &Mesh) -> Vec<Overlap> {
    let mut boxes: Vec<(DVec3, DVec3, u32)> = (0..mesh.triangles.len())
        .filter_map(|t| mesh.corners(t).map(|[a, b, c]| (a.min(b).min(c), a.max(b).max(c), t as u32)))
        .collect();
    boxes.sort_by(|a, b| a.0.x.total_cmp(&b.0.x).then(a.2.cmp(&b.2)));
    let mut found = Vec::new();
    let mut pairs = 0;
    'search: for (i, (least, greatest, first)) in boxes.iter().enumerate() {
        let reach = greatest + SAME_PLANE_M;
        for (other_least, other_greatest, second) in boxes.iter().skip(i + 1).take_while(|b| b.0.x <= reach.x) {
            pairs += 1;
            if found.len() == MOST_OVERLAPS || pairs > MOST_PAIRS {
                break 'search;
            }
            if other_least.cmpgt(reach).any() || (*other_greatest + SAME_PLANE_M).cmplt(*least).any() {
                continue;
            }
            let area_m2 = common_area_m2(mesh, *first, *second);
            if area_m2 > LEAST_OVERLAP_M2 {
                found.push(Overlap { triangles: [*first.min(second), *first.max(second)], area_m2 });
            }
        }
    }
    found.sort_by_key(|o| o.triangles);
    found
}

/// Area that two triangles share in the plane of the first; zero unless they are coplanar.
fn common_area_m2(mesh: &Mesh, first: u32, second: u32) -> f64 {
    let (Some(p), Some(q)) = (mesh.corners(first as usize), mesh.corners(second as usize)) else { return 0.0 };
    let normal = (p[1] - p[0]).cross(p[2] - p[0]).normalize_or_zero();
    let other = (q[1] - q[0]).cross(q[2] - q[0]).normalize_or_zero();
    if normal.cross(other).length() > 1e-3 || q.iter().any(|c| (*c - p[0]).dot(normal).abs() > SAME_PLANE_M) {
        return 0.0;
    }
    let (u, v) = normal.any_orthonormal_pair();
    let flat = |c: DVec3| DVec2::new((c - p[0]).dot(u), (c - p[0]).dot(v));
    let mut shape: Vec<DVec2> = q.map(flat).to_vec();
    let window = p.map(flat);
    for (from, to) in [(window[0], window[1]), (window[1], window[2]), (window[2], window[0])] {
        let inside = |c: DVec2| (to - from).perp_dot(c - from) * normal.dot(u.cross(v));
        let mut kept = Vec::with_capacity(shape.len() + 1);
        for (a, b) in shape.iter().zip(shape.iter().cycle().skip(1)) {
            let (da, db) = (inside(*a), inside(*b));
            if da >= 0.0 {
                kept.push(*a);
            }
            if (da > 0.0 && db < 0.0) || (da < 0.0 && db > 0.0) {
                kept.push(a.lerp(*b, da / (da - db)));
            }
        }
        shape = kept;
    }
    0.5 * shape.iter().zip(shape.iter().cycle().skip(1)).map(|(a, b)| a.perp_dot(*b)).sum::<f64>().abs()
}

#[cfg(test)]
mod hard_cases {
    use super::*;

    fn cube(at: DVec3, size: f64) -> Mesh {
        let corner = |i: u32| at + size * DVec3::new(f64::from(i & 1), f64::from(i >> 1 & 1), f64::from(i >> 2));
        let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        let triangles = quads.into_iter().flat_map(|[a, b, c, d]| [[a, b, c], [a, c, d]]).collect();
        Mesh { vertices: (0..8).map(corner).collect(), triangles }
    }

    fn joined(mut first: Mesh, second: Mesh) -> Mesh {
        let start = first.vertices.len() as u32;
        first.vertices.extend(second.vertices);
        first.triangles.extend(second.triangles.into_iter().map(|t| t.map(|v| v + start)));
        first
    }

    #[test]
    fn a_cube_is_solid_and_turned_inside_out_it_is_not() {
        let mut mesh = cube(DVec3::new(3.0, -2.0, 1.0), 0.5);
        let good = lint(&mesh);
        assert!(good.is_solid(), "{good:?}");
        assert!((good.shells[0].volume_m3 - 0.125).abs() < 1e-12);
        mesh.triangles.iter_mut().for_each(|t| t.swap(0, 1));
        let bad = lint(&mesh);
        assert!(bad.shells[0].is_inside_out() && !bad.is_solid());
    }

    /// Two cubes side by side touch with a whole face; one cube a millimetre away does not.
    #[test]
    fn faces_that_cover_each_other_are_found_with_their_area() {
        let near = cube(DVec3::ZERO, 1.0);
        let touching = lint(&joined(near.clone(), cube(DVec3::new(1.0, 0.25, 0.0), 1.0)));
        let total: f64 = touching.overlaps.iter().map(|o| o.area_m2).sum();
        assert!((total - 0.75).abs() < 1e-9, "{total}");
        assert_eq!(touching.shells.len(), 2);
        let apart = lint(&joined(near.clone(), cube(DVec3::new(1.001, 0.25, 0.0), 1.0)));
        assert_eq!(apart.overlaps, []);
        // The same cube twice: every face twice over.
        let total: f64 = lint(&joined(near.clone(), near)).overlaps.iter().map(|o| o.area_m2).sum();
        assert!((total - 6.0).abs() < 1e-9, "{total}");
    }

    #[test]
    fn an_open_shell_is_no_solid() {
        let mut mesh = cube(DVec3::ZERO, 1.0);
        mesh.triangles.truncate(10);
        let found = lint(&mesh);
        assert_eq!(found.boundary_edges, 4);
        assert!(!found.shells[0].closed && !found.shells[0].is_inside_out() && !found.is_solid());
        assert_eq!(lint(&Mesh::default()), Lint::default());
    }
}
