//! Vectorised physical optics over curved triangles of a skin between two antennas. Each triangle contributes the
//! strength of one path.
//!
//! The normals at the corners determine the bulge of a triangle (a quadratic patch). Neighbours have the same curved
//! edge in common, so that the surface has no gaps. The path length over a triangle is the parabola through its values
//! at the corners and in the middles of the edges. The neglected part is of third order in the triangle's size over its
//! distance: micrometres. The integral is a sum over the nodes of a rule ([`super::quadrature`]). The phase span
//! selects the rule: a span of a few radians takes a few nodes, whatever the curvature.
//!
//! All path lengths are relative to the path by the triangle's middle, in a form without cancellation, so that single
//! precision suffices. A test compares `moments` with an integral in double precision.

// Loops use lane indices: several rows are accessed together, and the compiler vectorises these loops.
#![allow(clippy::needless_range_loop)]

use glam::DVec3;
use radome_dsp::KernelLevel;

use super::quadrature::{Rule, rules};
use crate::lanes::{LANES, Row, Row3, compiled_for_levels, cos_sin_of_turns, lane};

/// Quadratic patches, one triangle in every lane.
#[derive(Debug, Clone, Copy)]
pub struct TriangleRows {
    /// Mean of the corners relative to a common nearby origin, m.
    pub middles: Row3,
    /// Corners relative to the middle, m.
    pub corners: [Row3; 3],
    /// Offset of the surface from the middles of the edges (first to second corner, second to third, third to first),
    /// m.
    pub bulges: [Row3; 3],
    /// Half of the squared differences of unit normals along the edges. Interpolated normals are shorter than unit
    /// length. These values, times the weights of both ends, are the relative excess of the strength over linear
    /// interpolation.
    pub normal_changes: [Row; 3],
}

/// Antenna seen from the middles of triangles.
#[derive(Debug, Clone, Copy)]
pub struct ViewRows {
    /// Vectors from the antenna to the middles, m.
    pub offsets: Row3,
    /// Lengths of the offsets, m.
    pub distances_m: [f64; LANES],
    /// Inverse lengths, 1/m.
    pub inverse_m: Row,
    /// Excess length of the path to each of the [`SIX_POINTS`] over that to the middle, wavelengths.
    excess: [Row; 6],
}

/// Barycentric coordinates of the corners, then of the middles of the edges in the order of the bulges.
const SIX_POINTS: [[f32; 3]; 6] =
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.5, 0.5, 0.0], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5]];

/// Number of groups of lanes, each integrated by its own rule.
pub const HALVES: usize = 2;
/// Number of lanes in a group.
const HALF: usize = LANES / HALVES;

/// Nodes of a rule on the triangles of half of the lanes; empty where these need no integral.
#[derive(Debug, Clone, Default)]
pub struct Nodes {
    all: Vec<Node>,
}

/// Node of a rule on the triangles of half of the lanes.
#[derive(Debug, Clone, Copy)]
struct Node {
    /// Weights (barycentric coordinates) of the second and third corner.
    weights: [f32; 2],
    /// Area that the node represents, m^2.
    area: [f32; HALF],
}

/// Returns one half of the lanes.
#[inline(always)]
fn half_of(row: &Row, half: usize) -> [f32; HALF] {
    let (halves, _) = row.as_chunks::<HALF>();
    if half == 0 { halves[0] } else { halves[1] }
}

/// Quadrature rules, and the instruction set to use.
#[derive(Debug)]
pub struct Integrator {
    pub(crate) rules: [Rule; 7],
    pub(crate) level: KernelLevel,
}

impl Default for Integrator {
    fn default() -> Self {
        Integrator { rules: rules(), level: KernelLevel::detect() }
    }
}

/// Moments `int l_i exp(-j k (L - L_middle)) dS` over triangles for the barycentric coordinates `l_i` of their three
/// corners, m^2. The integral of a strength that is linear between the corners is the sum of its corner values times
/// the moments.
#[derive(Debug, Clone, Copy, Default)]
pub struct MomentRows {
    /// Real parts, by corner.
    pub re: [Row; 3],
    /// Imaginary parts, by corner.
    pub im: [Row; 3],
}

impl TriangleRows {
    /// Builds the rows from corners, unit normals there and bulges.
    #[inline(always)]
    pub fn new(corners: &[Row3; 3], normals: &[Row3; 3], bulges: &[Row3; 3]) -> Self {
        let mut rows = TriangleRows {
            middles: Default::default(),
            corners: *corners,
            bulges: *bulges,
            normal_changes: Default::default(),
        };
        for axis in 0..3 {
            for l in 0..LANES {
                let middle = (corners[0][axis][l] + corners[1][axis][l] + corners[2][axis][l]) * (1.0 / 3.0);
                rows.middles[axis][l] = middle;
                rows.corners[0][axis][l] -= middle;
                rows.corners[1][axis][l] -= middle;
                rows.corners[2][axis][l] -= middle;
            }
        }
        for (change, (a, b)) in rows.normal_changes.iter_mut().zip([(0, 1), (1, 2), (2, 0)]) {
            let (a, b) = (&normals[a], &normals[b]);
            for l in 0..LANES {
                let (x, y, z) = (a[0][l] - b[0][l], a[1][l] - b[1][l], a[2][l] - b[2][l]);
                change[l] = 0.5 * (x * x + y * y + z * z);
            }
        }
        rows
    }

    /// Returns the total area, m^2.
    pub fn area_m2(&self) -> f32 {
        (0..LANES).map(|l| 0.5 * self.twice_area([1.0 / 3.0; 3], l)).sum()
    }

    /// Returns a point by its barycentric coordinates, relative to the middle, m.
    #[inline(always)]
    fn point(&self, [a, b, c]: [f32; 3], l: usize) -> [f32; 3] {
        let (corners, bulges) = (&self.corners, &self.bulges);
        let mut point = [0.0; 3];
        for axis in 0..3 {
            let flat = a * corners[0][axis][l] + b * corners[1][axis][l] + c * corners[2][axis][l];
            let bulge = (a * b) * bulges[0][axis][l] + (b * c) * bulges[1][axis][l] + (c * a) * bulges[2][axis][l];
            point[axis] = flat + 4.0 * bulge;
        }
        point
    }

    /// Returns the derivatives of a point by the weights of the second and of the third corner. Each has its value at
    /// the first corner, and its slopes by both weights.
    #[inline(always)]
    fn tangents(&self) -> [[Row3; 3]; 2] {
        let (corners, bulges) = (&self.corners, &self.bulges);
        let mut tangents: [[Row3; 3]; 2] = Default::default();
        for axis in 0..3 {
            for l in 0..LANES {
                let (p, q, r) = (corners[0][axis][l], corners[1][axis][l], corners[2][axis][l]);
                let (pq, qr, rp) = (4.0 * bulges[0][axis][l], 4.0 * bulges[1][axis][l], 4.0 * bulges[2][axis][l]);
                let across = qr - rp - pq;
                tangents[0][0][axis][l] = (q - p) + pq;
                tangents[0][1][axis][l] = -2.0 * pq;
                tangents[0][2][axis][l] = across;
                tangents[1][0][axis][l] = (r - p) + rp;
                tangents[1][1][axis][l] = across;
                tangents[1][2][axis][l] = -2.0 * rp;
            }
        }
        tangents
    }

    /// Returns twice the area element at a point, relative to that of the barycentric coordinates, m^2.
    #[inline(always)]
    fn twice_area(&self, [a, b, c]: [f32; 3], l: usize) -> f32 {
        // Derivatives of the point as weight moves from the first corner to the second, and to the third.
        let (mut u, mut v) = ([0f32; 3], [0f32; 3]);
        for axis in 0..3 {
            let (corners, bulges) = (&self.corners, &self.bulges);
            let (p, q, r) = (corners[0][axis][l], corners[1][axis][l], corners[2][axis][l]);
            let (pq, qr, rp) = (4.0 * bulges[0][axis][l], 4.0 * bulges[1][axis][l], 4.0 * bulges[2][axis][l]);
            u[axis] = (q - p) + (a - b) * pq + c * qr - c * rp;
            v[axis] = (r - p) - b * pq + b * qr + (a - c) * rp;
        }
        let (x, y, z) = (u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]);
        (x * x + y * y + z * z).sqrt()
    }
}

impl ViewRows {
    /// Computes the view of triangles whose coordinates are relative to `origin`.
    #[inline(always)]
    pub fn new(antenna: DVec3, origin: DVec3, triangles: &TriangleRows, wavelength_m: f64) -> Self {
        let zero = [0.0; LANES];
        let start = (origin - antenna).to_array();
        let mut view = ViewRows { offsets: [zero; 3], distances_m: [0.0; LANES], inverse_m: zero, excess: [zero; 6] };
        let per_wavelength = 1.0 / wavelength_m;
        let mut wavelengths = zero;
        for l in 0..LANES {
            let [x, y, z] = lane(&triangles.middles, l);
            let (x, y, z) = (start[0] + f64::from(x), start[1] + f64::from(y), start[2] + f64::from(z));
            let distance = (x * x + y * y + z * z).sqrt().max(1e-6);
            (view.offsets[0][l], view.offsets[1][l], view.offsets[2][l]) = (x as f32, y as f32, z as f32);
            view.distances_m[l] = distance;
            view.inverse_m[l] = (1.0 / distance) as f32;
            wavelengths[l] = (distance * per_wavelength) as f32;
        }
        for (weights, excess) in SIX_POINTS.into_iter().zip(&mut view.excess) {
            for l in 0..LANES {
                let [x, y, z] = triangles.point(weights, l);
                let along = x * view.offsets[0][l] + y * view.offsets[1][l] + z * view.offsets[2][l];
                // `D (sqrt(1 + e) - 1)` with `e = (|d|^2 + 2 d.offset) / D^2`, without cancellation for small `e`.
                let inverse2 = view.inverse_m[l] * view.inverse_m[l];
                let e = ((x * x + y * y + z * z) + 2.0 * along) * inverse2;
                excess[l] = wavelengths[l] * e / (1.0 + (1.0 + e).max(0.0).sqrt());
            }
        }
        view
    }
}

compiled_for_levels! {
    /// Computes the offset of the surface from the middles of the edges, m, from corners and unit normals there. It is
    /// the cubic over an edge that is tangential to the surface at both ends.
    pub(crate) fn bulge_rows(corners: &[Row3; 3], normals: &[Row3; 3]) -> [Row3; 3] = bulges_body;
}

#[inline(always)]
fn bulges_body(corners: &[Row3; 3], normals: &[Row3; 3]) -> [Row3; 3] {
    let mut bulges: [Row3; 3] = Default::default();
    for (bulge, (a, b)) in bulges.iter_mut().zip([(0, 1), (1, 2), (2, 0)]) {
        let (p, q, m, n) = (&corners[a], &corners[b], &normals[a], &normals[b]);
        for l in 0..LANES {
            let (x, y, z) = (q[0][l] - p[0][l], q[1][l] - p[1][l], q[2][l] - p[2][l]);
            let along_m = 0.125 * (x * m[0][l] + y * m[1][l] + z * m[2][l]);
            let along_n = 0.125 * (x * n[0][l] + y * n[1][l] + z * n[2][l]);
            bulge[0][l] = n[0][l] * along_n - m[0][l] * along_m;
            bulge[1][l] = n[1][l] * along_n - m[1][l] * along_m;
            bulge[2][l] = n[2][l] * along_n - m[2][l] * along_m;
        }
    }
    bulges
}

compiled_for_levels! {
    /// Builds the rows of triangles ([`TriangleRows::new`]).
    pub(crate) fn triangle_rows(
        corners: &[Row3; 3],
        normals: &[Row3; 3],
        bulges: &[Row3; 3],
    ) -> TriangleRows = TriangleRows::new;
}

compiled_for_levels! {
    /// Computes the view of triangles from an antenna.
    pub(crate) fn view_rows(
        antenna: DVec3,
        origin: DVec3,
        triangles: &TriangleRows,
        wavelength_m: f64,
    ) -> ViewRows = ViewRows::new;
}

compiled_for_levels! {
    /// Places the nodes of a rule on the triangles of one half of the lanes.
    pub(crate) fn place_nodes(triangles: &TriangleRows, half: usize, rule: &Rule, out: &mut Nodes) = nodes_body;
}

#[inline(always)]
fn nodes_body(triangles: &TriangleRows, half: usize, rule: &Rule, out: &mut Nodes) {
    out.all.clear();
    let mut tangents = [[[[0f32; HALF]; 3]; 3]; 2];
    for (tangents, rows) in tangents.iter_mut().zip(&triangles.tangents()) {
        for (tangents, rows) in tangents.iter_mut().zip(rows) {
            for (tangents, row) in tangents.iter_mut().zip(rows) {
                *tangents = half_of(row, half);
            }
        }
    }
    let [second, third] = &tangents;
    let [ab, bc, ca] = &triangles.normal_changes;
    let changes = [half_of(ab, half), half_of(bc, half), half_of(ca, half)];
    for &([a, b, c], weight) in &rule.nodes {
        let mut node = Node { weights: [b, c], area: [0.0; HALF] };
        for l in 0..HALF {
            let (mut u, mut v) = ([0f32; 3], [0f32; 3]);
            for axis in 0..3 {
                u[axis] = second[0][axis][l] + b * second[1][axis][l] + c * second[2][axis][l];
                v[axis] = third[0][axis][l] + b * third[1][axis][l] + c * third[2][axis][l];
            }
            let (x, y, z) = (u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]);
            let strength = 1.0 + changes[0][l] * (a * b) + changes[1][l] * (b * c) + changes[2][l] * (c * a);
            node.area[l] = (0.5 * weight) * (x * x + y * y + z * z).sqrt() * strength;
        }
        out.all.push(node);
    }
}

compiled_for_levels! {
    /// Computes the phase span across each triangle between two antennas, rad.
    pub(crate) fn spans_rad(views: [&ViewRows; 2]) -> Row = spans_body;
}

#[inline(always)]
fn spans_body(views: [&ViewRows; 2]) -> Row {
    let mut spans = [0.0; LANES];
    for (l, span) in spans.iter_mut().enumerate() {
        let (mut least, mut most) = (f32::INFINITY, f32::NEG_INFINITY);
        for i in 0..6 {
            let excess = views[0].excess[i][l] + views[1].excess[i][l];
            (least, most) = (least.min(excess), most.max(excess));
        }
        *span = std::f32::consts::TAU * (most - least);
    }
    spans
}

compiled_for_levels! {
    /// Computes moments of triangles between two antennas, with the nodes of both halves of the lanes.
    pub(crate) fn moments(nodes: [&Nodes; HALVES], views: [&ViewRows; 2]) -> MomentRows = moments_body;
}

#[inline(always)]
fn moments_body(nodes: [&Nodes; HALVES], views: [&ViewRows; 2]) -> MomentRows {
    let mut rows = MomentRows::default();
    for (half, nodes) in nodes.into_iter().enumerate() {
        if nodes.all.is_empty() {
            continue;
        }
        let [a, b, c, d, e, f] = half_moments(nodes, half, views);
        for (row, found) in rows.re.iter_mut().chain(&mut rows.im).zip([a, b, c, d, e, f]) {
            let (halves, _) = row.as_chunks_mut::<HALF>();
            halves[half] = found;
        }
    }
    rows
}

/// Computes moments of one half of the lanes: real parts, then imaginary ones.
#[inline(always)]
fn half_moments(nodes: &Nodes, half: usize, views: [&ViewRows; 2]) -> [[f32; HALF]; 6] {
    // Phase parabola, turns, by powers of the weights of the second and third corner: 1, b, c, b b, b c, c c.
    let mut turns = [[0f32; HALF]; 6];
    let [p, q, r, pq, qr, rp] = &views[0].excess;
    let [p2, q2, r2, pq2, qr2, rp2] = &views[1].excess;
    let (p, q, r) = (half_of(p, half), half_of(q, half), half_of(r, half));
    let (p2, q2, r2) = (half_of(p2, half), half_of(q2, half), half_of(r2, half));
    let (pq, qr, rp) = (half_of(pq, half), half_of(qr, half), half_of(rp, half));
    let (pq2, qr2, rp2) = (half_of(pq2, half), half_of(qr2, half), half_of(rp2, half));
    for l in 0..HALF {
        let (p, q, r) = (p[l] + p2[l], q[l] + q2[l], r[l] + r2[l]);
        let (pq, qr, rp) = (pq[l] + pq2[l], qr[l] + qr2[l], rp[l] + rp2[l]);
        turns[0][l] = -p;
        turns[1][l] = 3.0 * p + q - 4.0 * pq;
        turns[2][l] = 3.0 * p + r - 4.0 * rp;
        turns[3][l] = 4.0 * pq - 2.0 * (p + q);
        turns[4][l] = 4.0 * ((pq + rp) - (p + qr));
        turns[5][l] = 4.0 * rp - 2.0 * (p + r);
    }
    // Sums of the field, and of the field times the weights of the second and third corner. The moment of the first
    // corner is the rest.
    let (mut re, mut im) = ([[0f32; HALF]; 3], [[0f32; HALF]; 3]);
    for node in &nodes.all {
        let [b, c] = node.weights;
        for l in 0..HALF {
            let along = turns[1][l] + (b * turns[3][l] + c * turns[4][l]);
            let turn = turns[0][l] + (b * along + c * (turns[2][l] + c * turns[5][l]));
            let (cosine, sine) = cos_sin_of_turns(turn);
            let (x, y) = (cosine * node.area[l], sine * node.area[l]);
            re[0][l] += x;
            re[1][l] += b * x;
            re[2][l] += c * x;
            im[0][l] += y;
            im[1][l] += b * y;
            im[2][l] += c * y;
        }
    }
    for l in 0..HALF {
        re[0][l] -= re[1][l] + re[2][l];
        im[0][l] -= im[1][l] + im[2][l];
    }
    [re[0], re[1], re[2], im[0], im[1], im[2]]
}

#[cfg(test)]
mod tests {
    use num_complex::{Complex, Complex64};
    use rand::Rng;

    use super::*;
    use crate::em::quadrature::rule_for;
    use crate::em::triangle;
    use crate::lanes::tests::assert_same_at_every_level;
    use crate::random::{Purpose, generator};

    const WAVELENGTH_M: f64 = 0.005;
    const K: f64 = std::f64::consts::TAU / WAVELENGTH_M;
    const ORIGIN: DVec3 = DVec3::new(3.0, 0.5, 1.0);

    /// A quadratic patch.
    #[derive(Debug, Clone, Copy, PartialEq)]
    struct CurvedTriangle {
        /// Corners, m.
        corners: [DVec3; 3],
        /// Unit normals there.
        normals: [DVec3; 3],
        /// Distance of the surface from the middles of the edges, m.
        bulges: [DVec3; 3],
    }

    /// Reference for [`moments`]: double precision, linear strength in each of `4 cuts^2` flat triangles, paths as
    /// plain distances.
    fn exact_moments(
        triangle: &CurvedTriangle,
        antennas: [DVec3; 2],
        wavenumber_per_m: f64,
        cuts: usize,
    ) -> [Complex64; 3] {
        let n = 2 * cuts;
        let CurvedTriangle { corners, normals, bulges } = triangle;
        let middle = (corners[0] + corners[1] + corners[2]) / 3.0;
        let length = |p: DVec3| antennas.iter().map(|a| a.distance(p)).sum::<f64>();
        let middle_length = length(middle);
        let changes = [0, 1, 2].map(|i| 0.5 * normals[i].distance_squared(normals[(i + 1) % 3]));
        let node = |i: usize, j: usize| {
            let [a, b, c] = [n - i - j, j, i].map(|w| w as f64 / n as f64);
            let point = corners[0] * a
                + corners[1] * b
                + corners[2] * c
                + 4.0 * (bulges[0] * (a * b) + bulges[1] * (b * c) + bulges[2] * (c * a));
            let strength = 1.0 + changes[0] * (a * b) + changes[1] * (b * c) + changes[2] * (c * a);
            (point, [a, b, c], strength)
        };
        let mut sums = [Complex64::ZERO; 3];
        let mut add = |nodes: [(DVec3, [f64; 3], f64); 3]| {
            let [p, q, r] = nodes.map(|(point, ..)| point);
            let twice_area = (q - p).cross(r - p).length();
            let phases = nodes.map(|(point, ..)| -wavenumber_per_m * (length(point) - middle_length));
            let moments = triangle::moments(phases[0], phases[1], phases[2]);
            for ((_, weights, strength), moment) in nodes.into_iter().zip(moments) {
                for (sum, w) in sums.iter_mut().zip(weights) {
                    *sum += moment * (twice_area * strength * w);
                }
            }
        };
        for i in 0..n {
            for j in 0..n - i {
                add([node(i, j), node(i, j + 1), node(i + 1, j)]);
                if i + j + 2 <= n {
                    add([node(i + 1, j + 1), node(i + 1, j), node(i, j + 1)]);
                }
            }
        }
        sums
    }

    /// Returns triangles of a limb or a trunk a few metres away, at any angle.
    fn triangles() -> Vec<(CurvedTriangle, [DVec3; 2])> {
        let mut rng = generator(11, Purpose::Noise, [0, 0]);
        let mut vector = |size: f64| {
            DVec3::new(rng.random_range(-size..size), rng.random_range(-size..size), rng.random_range(-size..size))
        };
        // Normals differ by some degrees.
        let turn = |i: u32| DVec3::new(1.0, 0.1 * f64::from(i), 0.15 - 0.1 * f64::from(i)).normalize();
        (0..400)
            .map(|_| {
                let middle = ORIGIN + vector(0.5);
                let corners = [0; 3].map(|_| middle + vector(0.012));
                let bulges = [0; 3].map(|_| vector(6e-4));
                let antenna = vector(0.5);
                (CurvedTriangle { corners, normals: [0, 1, 2].map(turn), bulges }, [antenna, antenna + vector(0.003)])
            })
            .collect()
    }

    fn row3(v: DVec3) -> Row3 {
        v.as_vec3().to_array().map(|x| [x; LANES])
    }

    fn rows(triangle: &CurvedTriangle, level: KernelLevel) -> TriangleRows {
        let corners = triangle.corners.map(|c| row3(c - ORIGIN));
        triangle_rows(level, &corners, &triangle.normals.map(row3), &triangle.bulges.map(row3))
    }

    /// Computes moments, and the span that selected their rule.
    fn moments_of(triangle: &CurvedTriangle, antennas: [DVec3; 2], level: KernelLevel) -> ([Complex<f32>; 3], f32) {
        let rows = rows(triangle, level);
        let [t, r] = antennas.map(|a| view_rows(level, a, ORIGIN, &rows, WAVELENGTH_M));
        let span = spans_rad(level, [&t, &r])[0];
        let mut nodes = [Nodes::default(), Nodes::default()];
        for (half, nodes) in nodes.iter_mut().enumerate() {
            place_nodes(level, &rows, half, &rules()[rule_for(span, 1.0)], nodes);
        }
        let found = moments(level, nodes.each_ref(), [&t, &r]);
        let at = |lane: usize| -> [Complex<f32>; 3] {
            std::array::from_fn(|i| Complex::new(found.re[i][lane], found.im[i][lane]))
        };
        assert_eq!(at(3), at(LANES - 1), "the same in both halves");
        (at(3), span)
    }

    /// Errors of moments, the area of the triangle, m^2, and the span that selected the rule, rad.
    fn errors(triangle: &CurvedTriangle, antennas: [DVec3; 2]) -> ([f64; 3], f64, f32) {
        let exact = exact_moments(triangle, antennas, K, 24);
        let [a, b, c] = triangle.corners;
        let (found, span) = moments_of(triangle, antennas, KernelLevel::detect());
        let error = |i: usize| (exact[i] - Complex64::new(found[i].re.into(), found[i].im.into())).norm();
        ([0, 1, 2].map(error), 0.5 * (b - a).cross(c - a).length(), span)
    }

    #[test]
    fn every_rule_is_the_integral_to_a_few_thousandths_of_the_area() {
        let (mut seen, mut squares) = ([0; 7], 0.0);
        for (triangle, antennas) in triangles() {
            let (errors, area, span) = errors(&triangle, antennas);
            seen[rule_for(span, 1.0)] += 1;
            for error in errors {
                // This bound holds in the worst direction.
                assert!(error < 3e-2 * area + 1e-8, "{} of {area} over {span} rad", error / area);
                squares += (error / area).powi(2) / 1200.0;
            }
        }
        assert!(squares.sqrt() < 3e-3, "{}", squares.sqrt());
        assert!(seen.iter().all(|&n| n > 0), "{seen:?}");
    }

    #[test]
    fn every_level_of_instructions_computes_the_same() {
        for (triangle, antennas) in triangles() {
            assert_same_at_every_level(|level| moments_of(&triangle, antennas, level));
        }
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn a_point_and_a_needle_have_no_moments() {
            let antennas = [DVec3::ZERO, DVec3::Y * 0.003];
            let corner = DVec3::new(2.0, 0.0, 0.0);
            for corners in [[corner; 3], [corner, corner + DVec3::Z * 0.02, corner + DVec3::Z * 0.01]] {
                let triangle = CurvedTriangle { corners, normals: [DVec3::X; 3], bulges: [DVec3::ZERO; 3] };
                for moment in moments_of(&triangle, antennas, KernelLevel::detect()).0 {
                    assert!(moment.norm() < 1e-9, "{moment}");
                }
            }
        }

        /// The antenna is a quarter of a metre away, where the error of the path's series is largest.
        #[test]
        fn moments_are_as_exact_near_an_antenna() {
            for (triangle, _) in triangles().into_iter().take(50) {
                let near = triangle.corners[0] + DVec3::new(-0.25, 0.02, 0.03);
                let (errors, area, span) = errors(&triangle, [near, near + DVec3::Y * 0.003]);
                for error in errors {
                    assert!(error < 1e-2 * area + 1e-8, "{} of {area} over {span} rad", error / area);
                }
            }
        }
    }
}
