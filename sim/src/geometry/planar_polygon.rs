//! Plane polygons with holes: the surfaces of walls, floors and furniture.

use std::iter::once;

use earcut::Earcut;
use glam::DVec3;

use super::{Mesh, Plane, polygon};

/// Largest distance of a removed corner from the line through its neighbours, m. It is four times the rounding of an
/// f32 at 4 m, and far below the height of the arcs in outlines of round objects.
const STRAIGHT_M: f64 = 2e-6;

/// Polygon in a plane, with holes.
#[derive(Debug, Clone, PartialEq)]
pub struct PlanarPolygon {
    /// Corners, m: counter-clockwise when the normal points to the viewer. No three in a row lie on a line.
    pub outline: Vec<DVec3>,
    /// Corners of the holes, m: clockwise.
    pub holes: Vec<Vec<DVec3>>,
    /// Unit normal.
    pub normal: DVec3,
    /// Distance of the plane from the origin along the normal, m.
    pub offset_m: f64,
}

/// Position of a point relative to the edges of a polygon.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Clearance {
    /// Distance to the nearest edge, m: positive inside, negative outside.
    pub distance_m: f64,
    /// Index of the nearest edge, as in [`PlanarPolygon::edges`].
    pub edge: usize,
}

impl PlanarPolygon {
    /// Makes a polygon from corners that lie in a plane within rounding; the outline determines the direction of the
    /// normal. `None` where they enclose no area.
    pub fn from_corners(outline: &[DVec3]) -> Option<Self> {
        let normal = polygon::normal(outline);
        Self::in_plane(outline, normal, polygon::centroid(outline).dot(normal))
    }

    /// Makes polygons from a plane's outlines: one, unless the plane is not connected. The list is empty if the
    /// outlines do not enclose the area of the plane's triangles, since edges of a damaged mesh do not close.
    pub fn of_plane(mesh: &Mesh, plane: &Plane) -> Vec<Self> {
        let position = |v: &u32| mesh.vertices.get(*v as usize).copied();
        let corners = |outline: &Vec<u32>| outline.iter().map(position).collect::<Option<Vec<DVec3>>>();
        let loops: Vec<Vec<DVec3>> = plane.outlines.iter().filter_map(corners).collect();
        let (outer, inner): (Vec<_>, Vec<_>) =
            loops.into_iter().partition(|corners| polygon::normal(corners).dot(plane.normal) > 0.0);
        let mut found: Vec<Self> =
            outer.iter().filter_map(|corners| Self::in_plane(corners, plane.normal, plane.offset_m)).collect();
        for hole in &inner {
            let corners = simplified(hole, plane.normal, plane.offset_m);
            let Some(&first) = corners.first() else { continue };
            let encloses = |p: &&mut Self| p.clearance(first).distance_m >= -STRAIGHT_M;
            let owner = found.iter_mut().filter(encloses).min_by(|p, q| p.area_m2().total_cmp(&q.area_m2()));
            if let Some(owner) = owner {
                owner.holes.push(corners);
            }
        }
        let area_m2: f64 = found.iter().map(Self::area_m2).sum();
        let perimeter_m: f64 = found.iter().flat_map(Self::edges).map(|[a, b]| a.distance(b)).sum();
        if (area_m2 - plane.area_m2).abs() <= 1e-6 * plane.area_m2 + 4.0 * STRAIGHT_M * perimeter_m {
            found
        } else {
            Vec::new()
        }
    }

    /// Makes a polygon in a plane; `None` if the outline has no area.
    fn in_plane(outline: &[DVec3], normal: DVec3, offset_m: f64) -> Option<Self> {
        // This form of the test rejects NaN.
        if !(normal.length_squared() > 0.5 && offset_m.is_finite()) {
            return None;
        }
        let outline = simplified(outline, normal, offset_m);
        (!outline.is_empty()).then_some(PlanarPolygon { outline, holes: Vec::new(), normal, offset_m })
    }

    /// Returns the same polygon seen from its other side.
    pub fn flipped(mut self) -> Self {
        self.outline.reverse();
        self.holes.iter_mut().for_each(|hole| hole.reverse());
        PlanarPolygon { normal: -self.normal, offset_m: -self.offset_m, ..self }
    }

    /// Iterates over the outline and the holes.
    pub fn loops(&self) -> impl Iterator<Item = &[DVec3]> {
        once(self.outline.as_slice()).chain(self.holes.iter().map(Vec::as_slice))
    }

    /// Ends of the edges, m: those of the outline, then those of the holes. The polygon lies to the left of each.
    pub fn edges(&self) -> impl Iterator<Item = [DVec3; 2]> {
        self.loops().flat_map(polygon::sides)
    }

    /// Unit vector in the plane and across an edge, into the polygon; zero for an invalid index.
    pub fn inwards(&self, edge: usize) -> DVec3 {
        self.edges().nth(edge).map_or(DVec3::ZERO, |[a, b]| self.normal.cross((b - a).normalize_or_zero()))
    }

    /// Signed distance of a point from the plane, m; positive on the side of the normal.
    pub fn height_m(&self, point: DVec3) -> f64 {
        self.normal.dot(point) - self.offset_m
    }

    /// Returns whether a point of the plane is in the polygon. A point on an edge shared by two polygons of a plane is
    /// in exactly one of them.
    pub fn contains(&self, point: DVec3) -> bool {
        let [i, j] = self.projection_axes();
        let (x, y) = (point[i], point[j]);
        let mut inside = false;
        for [a, b] in self.edges() {
            // The result for an edge does not depend on its direction.
            let (low, high) = if a[j] < b[j] { (a, b) } else { (b, a) };
            if (low[j] > y) != (high[j] > y) {
                let side = (high[i] - low[i]) * (y - low[j]) - (x - low[i]) * (high[j] - low[j]);
                inside ^= side > 0.0;
            }
        }
        inside
    }

    /// Nearest edge to a point of the plane, and the distance.
    pub fn clearance(&self, point: DVec3) -> Clearance {
        let point = point - self.normal * self.height_m(point);
        let mut nearest = Clearance { distance_m: f64::INFINITY, edge: 0 };
        for (edge, [a, b]) in self.edges().enumerate() {
            let along = b - a;
            let fraction = ((point - a).dot(along) / along.length_squared()).clamp(0.0, 1.0);
            let distance_m = point.distance(a + along * fraction);
            if distance_m < nearest.distance_m {
                nearest = Clearance { distance_m, edge };
            }
        }
        if !self.contains(point) {
            nearest.distance_m = -nearest.distance_m;
        }
        nearest
    }

    /// Area, m^2.
    pub fn area_m2(&self) -> f64 {
        polygon::area_m2(&self.outline) - self.holes.iter().map(|hole| polygon::area_m2(hole)).sum::<f64>()
    }

    /// Low and high corner of the bounding box, m.
    pub fn bounds(&self) -> [DVec3; 2] {
        polygon::bounds(&self.outline)
    }

    /// Triangles that cover the polygon, counter-clockwise when the normal points to the viewer, m.
    pub fn triangulate(&self) -> Vec<[DVec3; 3]> {
        let [i, j] = self.projection_axes();
        let corners: Vec<DVec3> = self.loops().flatten().copied().collect();
        let mut starts: Vec<u32> = Vec::with_capacity(self.holes.len());
        let mut start = self.outline.len();
        for hole in &self.holes {
            starts.push(start as u32);
            start += hole.len();
        }
        let mut found: Vec<u32> = Vec::new();
        Earcut::<f64>::new().earcut(corners.iter().map(|c| [c[i], c[j]]), &starts, &mut found);
        let corner = |v: u32| corners.get(v as usize).copied();
        let triangle = |&[a, b, c]: &[u32; 3]| {
            let [a, b, c] = [corner(a)?, corner(b)?, corner(c)?];
            let is_left = (b - a).cross(c - a).dot(self.normal) >= 0.0;
            Some(if is_left { [a, b, c] } else { [a, c, b] })
        };
        found.as_chunks::<3>().0.iter().filter_map(triangle).collect()
    }

    /// Point inside the polygon: the middle of its largest triangle.
    pub fn inner_point(&self) -> DVec3 {
        let area = |t: &[DVec3; 3]| (t[1] - t[0]).cross(t[2] - t[0]).length_squared();
        let largest = self.triangulate().into_iter().max_by(|p, q| area(p).total_cmp(&area(q)));
        largest.map_or_else(|| polygon::centroid(&self.outline), |[a, b, c]| (a + b + c) / 3.0)
    }

    /// The two axes that remain when the plane is projected along the axis of the largest component of its normal.
    /// Their order keeps the winding.
    fn projection_axes(&self) -> [usize; 2] {
        let axis = self.normal.abs().max_position();
        let (i, j) = ((axis + 1) % 3, (axis + 2) % 3);
        if self.normal[axis] > 0.0 { [i, j] } else { [j, i] }
    }
}

/// Projects corners onto a plane and removes those at which the outline does not turn; empty if fewer than three
/// remain.
fn simplified(corners: &[DVec3], normal: DVec3, offset_m: f64) -> Vec<DVec3> {
    let mut corners: Vec<DVec3> = corners.iter().map(|&c| c - normal * (c.dot(normal) - offset_m)).collect();
    let mut count_before = usize::MAX;
    while corners.len() < count_before {
        count_before = corners.len();
        let mut index = 0;
        while corners.len() >= 3 && index < corners.len() {
            let count = corners.len();
            if is_straight(corners[(index + count - 1) % count], corners[index], corners[(index + 1) % count]) {
                corners.remove(index);
            } else {
                index += 1;
            }
        }
    }
    if corners.len() < 3 { Vec::new() } else { corners }
}

/// Returns whether a corner lies on the line through its neighbours. A corner at which the outline turns back on itself
/// does, too.
fn is_straight(before: DVec3, corner: DVec3, after: DVec3) -> bool {
    let across = after - before;
    let length_m = across.length();
    length_m <= STRAIGHT_M || across.cross(corner - before).length() <= STRAIGHT_M * length_m
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use glam::DMat3;
    use rand::{Rng, SeedableRng};
    use rand_xoshiro::Xoshiro256PlusPlus;

    use super::*;
    use crate::geometry::planes;

    /// Corners around a centre at increasing angles, at distances between two bounds.
    fn star(rng: &mut Xoshiro256PlusPlus, centre: DVec3, radii_m: [f64; 2], corners: usize) -> Vec<DVec3> {
        (0..corners)
            .map(|i| {
                let angle = TAU * (i as f64 + rng.random_range(-0.4..0.4)) / corners as f64;
                let radius_m = rng.random_range(radii_m[0]..radii_m[1]);
                centre + DVec3::new(angle.cos(), angle.sin(), 0.0) * radius_m
            })
            .collect()
    }

    /// Star in a random plane with up to three disjoint holes, and the map from the xy plane to that plane.
    fn random_polygon(seed: u64) -> (PlanarPolygon, impl Fn(DVec3) -> DVec3) {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
        let turn =
            DMat3::from_rotation_x(rng.random_range(0.0..TAU)) * DMat3::from_rotation_z(rng.random_range(0.0..TAU));
        let shift = DVec3::new(rng.random_range(-9.0..9.0), rng.random_range(-9.0..9.0), rng.random_range(-9.0..9.0));
        let map = move |p: DVec3| turn * p + shift;
        let count = rng.random_range(8..40);
        let outline: Vec<DVec3> = star(&mut rng, DVec3::ZERO, [0.5, 2.0], count).into_iter().map(map).collect();
        let mut polygon = PlanarPolygon::from_corners(&outline).expect("an area");
        polygon.holes = (0..rng.random_range(0..4u32))
            .map(|i| {
                let angle = TAU * f64::from(i) / 3.0;
                let count = rng.random_range(5..12);
                let centre = DVec3::new(angle.cos(), angle.sin(), 0.0) * 0.22;
                star(&mut rng, centre, [0.04, 0.12], count).into_iter().rev().map(map).collect()
            })
            .collect();
        (polygon, map)
    }

    fn is_in(point: DVec3, [a, b, c]: [DVec3; 3], normal: DVec3) -> bool {
        [(a, b), (b, c), (c, a)].iter().all(|&(from, to)| (to - from).cross(point - from).dot(normal) >= 0.0)
    }

    #[test]
    fn triangles_of_random_polygons_add_up_to_their_area() {
        for seed in 0..300 {
            let (polygon, _) = random_polygon(seed);
            let area = |[a, b, c]: [DVec3; 3]| 0.5 * (b - a).cross(c - a).dot(polygon.normal);
            let sum: f64 = polygon.triangulate().into_iter().map(area).sum();
            assert!((sum - polygon.area_m2()).abs() < 1e-9, "seed {seed}: {sum} of {}", polygon.area_m2());
        }
    }

    #[test]
    fn points_are_in_random_polygons_exactly_if_they_are_in_their_triangles() {
        for seed in 0..300 {
            let (polygon, map) = random_polygon(seed);
            let triangles = polygon.triangulate();
            let mut rng = Xoshiro256PlusPlus::seed_from_u64(1000 + seed);
            for _ in 0..200 {
                let point = map(DVec3::new(rng.random_range(-2.0..2.0), rng.random_range(-2.0..2.0), 0.0));
                let clearance = polygon.clearance(point);
                if clearance.distance_m.abs() < 1e-9 {
                    continue;
                }
                let expected = triangles.iter().any(|&t| is_in(point, t, polygon.normal));
                assert_eq!(polygon.contains(point), expected, "seed {seed}: {point}");
                assert_eq!(clearance.distance_m > 0.0, expected, "seed {seed}: {point}");
                // The result from the other side is the same.
                assert_eq!(polygon.clone().flipped().contains(point), expected, "seed {seed}: {point}");
            }
        }
    }

    #[test]
    fn clearances_are_distances_to_the_edge_that_they_name() {
        for seed in 0..50 {
            let (polygon, map) = random_polygon(seed);
            let point = map(DVec3::new(0.31, 0.02 * seed as f64 - 0.5, 0.0));
            let found = polygon.clearance(point);
            let [a, b] = polygon.edges().nth(found.edge).expect("an edge");
            // No sampled point of the edge is nearer than the distance found.
            let sampled = (0..=1000).map(|i| point.distance(a.lerp(b, f64::from(i) / 1000.0)));
            let nearest = sampled.fold(f64::INFINITY, f64::min);
            assert!((nearest - found.distance_m.abs()).abs() < 0.01, "seed {seed}: {nearest} {found:?}");
            // A step inwards from the middle of an edge leads inside.
            let inside = a.lerp(b, 0.5) + polygon.inwards(found.edge) * 1e-7;
            assert!(polygon.contains(inside), "seed {seed}");
        }
    }

    #[test]
    fn a_wall_with_a_window_keeps_its_corners_only() {
        // An upright wall of four by four squares without the one at (1, 1).
        let mut mesh = Mesh::sheet(4, &[5]);
        mesh.vertices.iter_mut().for_each(|v| *v = DVec3::new(v.x, 0.0, v.y) * 0.5);
        mesh.triangles.iter_mut().for_each(|t| t.swap(1, 2));
        let found = planes(&mesh, 1e-6);
        let [plane] = found.planes.as_slice() else { panic!("{:?}", found.planes) };
        let polygons = PlanarPolygon::of_plane(&mesh, plane);
        let [wall] = polygons.as_slice() else { panic!("{polygons:?}") };
        assert_eq!((wall.outline.len(), wall.holes.len(), wall.holes[0].len()), (4, 1, 4));
        assert!((wall.area_m2() - 3.75).abs() < 1e-12);
        assert_eq!(wall.normal, DVec3::Y);
        assert_eq!(wall.bounds(), [DVec3::ZERO, DVec3::new(2.0, 0.0, 2.0)]);
        assert!(!wall.contains(DVec3::new(0.75, 0.0, 0.75)) && wall.contains(DVec3::new(0.25, 0.0, 0.75)));
        assert!((wall.clearance(DVec3::new(0.75, 0.0, 0.7)).distance_m + 0.2).abs() < 1e-12);
        assert!(wall.contains(wall.inner_point()));
    }
}

#[cfg(test)]
mod hard_cases {
    use super::*;
    use crate::geometry::planes;

    #[test]
    fn corners_without_area_make_no_polygon() {
        let line = [DVec3::ZERO, DVec3::X, DVec3::X * 2.0, DVec3::X * 0.5];
        assert_eq!(PlanarPolygon::from_corners(&line), None);
        assert_eq!(PlanarPolygon::from_corners(&[]), None);
        assert_eq!(PlanarPolygon::from_corners(&[DVec3::ZERO, DVec3::X, DVec3::NAN]), None);
    }

    /// A sliver a tenth of a millimetre wide is a polygon; one of a micrometre is a line.
    #[test]
    fn slivers_are_polygons_down_to_rounding() {
        let sliver = |width_m: f64| {
            let corners = [DVec3::ZERO, DVec3::X * 3.0, DVec3::new(3.0, width_m, 0.0), DVec3::Y * width_m];
            PlanarPolygon::from_corners(&corners)
        };
        let thin = sliver(1e-4).expect("an area");
        assert!(thin.contains(DVec3::new(1.0, 5e-5, 0.0)) && !thin.contains(DVec3::new(1.0, 1.5e-4, 0.0)));
        assert!((thin.triangulate().len(), (thin.area_m2() - 3e-4).abs() < 1e-15) == (2, true));
        assert_eq!(sliver(1e-6), None);
    }

    /// Corners within straight lines, duplicate corners, and a needle out and back are removed.
    #[test]
    fn corners_without_a_turn_are_removed() {
        let corners = [
            DVec3::ZERO,
            DVec3::X,
            DVec3::X * 2.0,
            DVec3::X * 2.0,
            DVec3::new(2.0, 1.0, 0.0),
            DVec3::new(3.0, 1.0, 0.0),
            DVec3::new(2.0, 1.0, 0.0),
            DVec3::new(0.0, 1.0, 0.0),
        ];
        let square = PlanarPolygon::from_corners(&corners).expect("an area");
        assert_eq!(square.outline.len(), 4, "{:?}", square.outline);
        assert!((square.area_m2() - 2.0).abs() < 1e-15);
    }

    /// Two sheets that meet in one corner are two polygons. The area of a hole that touches the outline in a corner is
    /// subtracted.
    #[test]
    fn loops_that_touch_in_a_corner_enclose_the_squares_of_their_mesh() {
        for left_out in [vec![4], vec![0, 4], vec![1, 3], vec![1, 3, 5, 7]] {
            let mesh = Mesh::sheet(3, &left_out);
            let found = planes(&mesh, 1e-6);
            let polygons: Vec<PlanarPolygon> =
                found.planes.iter().flat_map(|plane| PlanarPolygon::of_plane(&mesh, plane)).collect();
            for i in 0..9u32 {
                let middle = DVec3::new(f64::from(i % 3) + 0.47, f64::from(i / 3) + 0.52, 0.0);
                let count = polygons.iter().filter(|p| p.contains(middle)).count();
                assert_eq!(count, usize::from(!left_out.contains(&i)), "{left_out:?}: {middle}");
            }
        }
    }
}
