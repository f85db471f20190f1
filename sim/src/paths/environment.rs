//! Environment of propagation paths: plane polygons with a wall each, and a ray-tracing structure over their triangles.

use glam::DVec3;

use super::edge_index::EdgeIndex;
use super::edges::{DiffractingEdge, find_diffracting_edges};
pub use super::flat::{EnvironmentError, Facet, FacetId};
use super::flat::{Flat, PLANAR_M};
use super::groups::groups;
use crate::em::wall::WallTables;
use crate::geometry::Mesh;
use crate::rays::{Ray, RayTracer};

/// Facets whose planes are nearer to each other than this are coplanar, m.
const COPLANAR_M: f64 = 1e-7;
/// Sine of the angle up to which two planes are parallel.
const PARALLEL: f64 = 1e-6;
/// Normalised clearance beyond which an edge does not affect a path: three radii of the first Fresnel zone, where a
/// half-plane changes the field by 5 percent. The contribution fades out over the last third.
const MOST_REACH: f64 = 3.0 * std::f64::consts::SQRT_2;
/// Lower limit of the reach: edges within the first Fresnel zone always count.
const LEAST_REACH: f64 = std::f64::consts::SQRT_2;

/// Facets and obstacles on the straight segment between two points.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct SegmentObstacles {
    /// Whether an opaque object blocks the segment.
    pub is_blocked: bool,
    /// Facets that transmit waves, one per plane.
    pub crossed: Vec<FacetId>,
}

/// Plane polygons that waves meet.
#[derive(Debug, Clone)]
pub struct Environment {
    flats: Vec<Flat>,
    diffracting_edges: Vec<DiffractingEdge>,
    edge_index: EdgeIndex,
    /// Whether walls transmit waves.
    transmission: bool,
    /// Normalised clearance beyond which edges do not affect a path.
    edge_reach: f64,
    tracer: RayTracer,
    facet_of_triangle: Vec<FacetId>,
    /// Facets of each plane.
    planes: Vec<Vec<FacetId>>,
    wavenumber_per_m: f64,
}

impl Environment {
    /// Builds an environment of smooth facets, whose materials are evaluated at a wavenumber.
    ///
    /// # Errors
    /// If a facet is not a plane polygon, or rays cannot be traced among them.
    pub fn new(facets: Vec<Facet>, wavenumber_per_m: f64) -> Result<Self, EnvironmentError> {
        Self::with_obstacles(facets, &[], wavenumber_per_m, 0.0)
    }

    /// Builds an environment of facets, which scatter a share of the incident power in all directions, and of opaque
    /// triangles, m, that hide objects behind them and reflect nothing.
    ///
    /// # Errors
    /// If a facet is not a plane polygon, or rays cannot be traced among them.
    pub fn with_obstacles(
        facets: Vec<Facet>,
        obstacles: &[[DVec3; 3]],
        wavenumber_per_m: f64,
        diffuse_share: f64,
    ) -> Result<Self, EnvironmentError> {
        let mut tables = WallTables::new(wavenumber_per_m, false, diffuse_share);
        let prepared = facets.into_iter().enumerate().map(|(i, facet)| Flat::new(i, facet, &mut tables));
        let mut flats: Vec<Flat> = prepared.collect::<Result<_, _>>()?;
        let planes = number_planes(&mut flats);
        let (mut mesh, mut groups, mut facet_of_triangle) = (Mesh::default(), Vec::new(), Vec::new());
        for (number, flat) in flats.iter().enumerate().filter(|(_, flat)| flat.reflects()) {
            let why = "its outlines cross";
            let triangles = flat.triangles().ok_or(EnvironmentError::NoPolygon { facet: number, why })?;
            let first = mesh.vertices.len() as u32;
            mesh.vertices.extend(flat.facet.corners.iter().chain(flat.facet.holes.iter().flatten()));
            for corners in triangles {
                mesh.triangles.push(corners.map(|corner| first + corner));
                groups.push(flat.plane);
                facet_of_triangle.push(number as FacetId);
            }
        }
        for corners in obstacles {
            let first = mesh.vertices.len() as u32;
            mesh.vertices.extend(corners);
            mesh.triangles.push([first, first + 1, first + 2]);
            // Obstacles belong to no plane: rays that leave a facet or end on one meet all of them.
            groups.push(planes.len() as u32);
            facet_of_triangle.push(FacetId::MAX);
        }
        let tracer = RayTracer::new(mesh, &groups)?;
        let diffracting_edges = find_diffracting_edges(&flats);
        for (number, edge) in (0..).zip(&diffracting_edges) {
            for &facet in edge.facets() {
                if let Some(flat) = flats.get_mut(facet as usize).filter(|flat| !edge.is_inner_before(flat.normal)) {
                    flat.edges.push(number);
                }
            }
        }
        let edge_index = EdgeIndex::new(&diffracting_edges);
        Ok(Environment {
            flats,
            diffracting_edges,
            edge_index,
            transmission: false,
            edge_reach: MOST_REACH,
            tracer,
            facet_of_triangle,
            planes,
            wavenumber_per_m,
        })
    }

    /// Sets whether walls transmit waves: those that leave more than -40 dB at normal incidence.
    pub fn with_transmission(mut self, transmission: bool) -> Self {
        self.transmission = transmission;
        self
    }

    /// Leaves out edges that change a field by less than this part. At a normalised clearance `nu`, the edge of a
    /// half-plane changes a field by `1 / (pi sqrt(2) nu)` at most.
    pub fn with_least_part(mut self, part: f64) -> Self {
        let reach = std::f64::consts::FRAC_1_PI * std::f64::consts::FRAC_1_SQRT_2 / part.max(1e-9);
        self.edge_reach = reach.clamp(LEAST_REACH, MOST_REACH);
        self
    }

    /// Normalised clearance beyond which edges do not affect a path.
    pub(super) fn edge_reach(&self) -> f64 {
        self.edge_reach
    }

    /// Returns whether walls transmit waves.
    pub(super) fn has_transmission(&self) -> bool {
        self.transmission
    }

    /// Number of facets.
    pub fn len(&self) -> usize {
        self.flats.len()
    }

    /// Returns whether the environment has no facet.
    pub fn is_empty(&self) -> bool {
        self.flats.is_empty()
    }

    /// A facet.
    pub fn facet(&self, facet: FacetId) -> Option<&Facet> {
        self.flat(facet).map(|flat| &flat.facet)
    }

    /// Triangles that cover a facet, m; empty for a facet that does not reflect.
    pub fn triangles(&self, facet: FacetId) -> Vec<[DVec3; 3]> {
        let Some(flat) = self.flat(facet).filter(|flat| flat.reflects()) else { return Vec::new() };
        let corners: Vec<DVec3> = flat.facet.corners.iter().chain(flat.facet.holes.iter().flatten()).copied().collect();
        let corner = |number: u32| corners.get(number as usize).copied();
        let triangles = flat.triangles().unwrap_or_default().into_iter();
        triangles.filter_map(|[a, b, c]| Some([corner(a)?, corner(b)?, corner(c)?])).collect()
    }

    /// Unit normal of a facet.
    pub fn normal(&self, facet: FacetId) -> Option<DVec3> {
        self.flat(facet).map(|flat| flat.normal)
    }

    /// Edges that diffract.
    pub fn diffracting_edges(&self) -> &[DiffractingEdge] {
        &self.diffracting_edges
    }

    /// Finds the numbers of the diffracting edges near a straight segment ([`DiffractingEdge::is_near`]) and of a few more, ascending.
    pub(super) fn edges_near(&self, from: DVec3, to: DVec3, distance_m: f64, found: &mut Vec<u32>) {
        self.edge_index.near(from, to, distance_m, found);
    }

    /// Wavenumber at which materials are evaluated, 1/m.
    pub fn wavenumber_per_m(&self) -> f64 {
        self.wavenumber_per_m
    }

    /// Wavelength, m.
    pub fn wavelength_m(&self) -> f64 {
        std::f64::consts::TAU / self.wavenumber_per_m
    }

    /// A facet with the geometry of its plane.
    pub(super) fn flat(&self, facet: FacetId) -> Option<&Flat> {
        self.flats.get(facet as usize)
    }

    /// Facet on which a point lies, if any: an antenna may be mounted on a wall.
    pub fn facet_at(&self, point: DVec3) -> Option<FacetId> {
        self.facets_at(point).next()
    }

    /// All facets on which a point lies: several at an edge.
    pub fn facets_at(&self, point: DVec3) -> impl Iterator<Item = FacetId> + '_ {
        let contains =
            move |flat: &Flat| flat.reflects() && flat.height(point).abs() < PLANAR_M && flat.contains(point);
        (0..).zip(&self.flats).filter(move |(_, flat)| contains(flat)).map(|(facet, _)| facet)
    }

    /// Facet in whose plane a point lies; of several, the one whose outline is nearest.
    pub fn nearest_coplanar_facet(&self, point: DVec3) -> Option<FacetId> {
        let in_plane = |(_, flat): &(FacetId, &Flat)| flat.reflects() && flat.height(point).abs() < PLANAR_M;
        let all = (0..).zip(&self.flats).filter(in_plane).map(|(facet, flat)| (facet, flat.distance_to_sides_m(point)));
        all.min_by(|(_, distance_m), (_, other_m)| distance_m.total_cmp(other_m)).map(|(facet, _)| facet)
    }

    /// Returns a ray that excludes the plane of the facet on which it begins, if any.
    fn leaving(&self, ray: Ray, on: Option<FacetId>) -> Ray {
        match on.and_then(|facet| self.flat(facet)) {
            Some(flat) => ray.leaving(flat.plane, flat.normal),
            None => ray,
        }
    }

    /// First facet that a ray hits, and the point; `None` if there is none, or the ray hits it from behind. `on` is the
    /// facet on which the ray begins, if any.
    pub fn first_hit(&self, from: DVec3, direction: DVec3, on: Option<FacetId>) -> Option<(FacetId, DVec3)> {
        let hit = self.tracer.closest(&self.leaving(Ray::new(from, direction), on))?;
        let facet = *self.facet_of_triangle.get(hit.triangle as usize)?;
        let first = self.flat(facet)?;
        let along = -first.height(from) / first.normal.dot(direction);
        let point = from + direction * along;
        if !point.is_finite() {
            return None;
        }
        let faces = |flat: &Flat| flat.normal.dot(direction) < 0.0;
        if faces(first) {
            return Some((facet, point));
        }
        // The other side of a sheet is a facet in the same plane.
        let coplanar = self.planes.get(first.plane as usize)?;
        let is_hit = |facet: &FacetId| self.flat(*facet).is_some_and(|f| f.reflects() && faces(f) && f.contains(point));
        Some((coplanar.iter().copied().find(is_hit)?, point))
    }

    /// Distance from a point to the first surface in a direction, m.
    pub fn distance_m(&self, from: DVec3, direction: DVec3) -> Option<f64> {
        self.tracer.closest(&Ray::new(from, direction)).map(|hit| hit.distance_m)
    }

    /// Obstacles on the straight segment between two points. Each end may lie on a facet, whose plane is then ignored.
    pub(super) fn obstacles_between(&self, ends: [DVec3; 2], on: [Option<FacetId>; 2]) -> SegmentObstacles {
        let ray = self.ray_between(ends, on);
        let mut obstacles = SegmentObstacles { is_blocked: self.tracer.blocked(&ray), crossed: Vec::new() };
        if !(obstacles.is_blocked && self.transmission) {
            return obstacles;
        }
        let plane_of = |facet: FacetId| self.flat(facet).map(|flat| flat.plane);
        let on_planes = on.map(|facet| facet.and_then(plane_of));
        let mut is_opaque = false;
        for hit in self.tracer.all(&ray) {
            let facet = self.facet_of_triangle.get(hit.triangle as usize).copied().unwrap_or(FacetId::MAX);
            let Some(flat) = self.flat(facet) else {
                is_opaque = true;
                continue;
            };
            if on_planes.contains(&Some(flat.plane)) {
                continue;
            }
            is_opaque |= !flat.transmits;
            // Both sides of a sheet are one wall.
            if flat.transmits && !obstacles.crossed.iter().any(|&other| plane_of(other) == Some(flat.plane)) {
                obstacles.crossed.push(facet);
            }
        }
        // `blocked` also counts hits nearer to the origin than f32 resolves, which `all` leaves out. They lie in a
        // crease, which transmits nothing.
        obstacles.is_blocked = is_opaque || obstacles.crossed.is_empty();
        obstacles
    }

    /// Ray between two points that excludes the planes of the facets on which it begins and ends.
    fn ray_between(&self, [from, to]: [DVec3; 2], on: [Option<FacetId>; 2]) -> Ray {
        let ray = self.leaving(Ray::between(from, to), on[0]);
        match on[1].and_then(|facet| self.flat(facet)) {
            Some(flat) => ray.reaching(flat.plane),
            None => ray,
        }
    }
}

/// Numbers the planes of facets, and returns the facets of each.
fn number_planes(flats: &mut [Flat]) -> Vec<Vec<FacetId>> {
    let distances_m: Vec<f64> = flats.iter().map(|flat| flat.offset_m.abs()).collect();
    let is_same = |i: usize, j: usize| {
        let (a, b) = (&flats[i], &flats[j]);
        let side = a.normal.dot(b.normal).signum();
        let is_parallel = a.normal.cross(b.normal).length_squared() < PARALLEL * PARALLEL;
        is_parallel && (a.offset_m - side * b.offset_m).abs() <= COPLANAR_M
    };
    let mut planes = groups(&distances_m, COPLANAR_M, is_same);
    for (number, members) in (0..).zip(&mut planes) {
        members.sort_unstable();
        members.iter().for_each(|&facet| flats[facet].plane = number);
    }
    planes.into_iter().map(|members| members.into_iter().map(|facet| facet as FacetId).collect()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::em::image::Wall;

    const METAL: Wall = Wall::Conductor;

    fn square(z: f64, up: bool) -> Facet {
        let mut corners =
            vec![DVec3::new(0.0, 0.0, z), DVec3::new(1.0, 0.0, z), DVec3::new(1.0, 1.0, z), DVec3::new(0.0, 1.0, z)];
        if !up {
            corners.reverse();
        }
        Facet::new(corners, METAL)
    }

    #[test]
    fn rays_hit_the_side_of_a_sheet_that_faces_them() {
        let environment = Environment::new(vec![square(0.5, true), square(0.5, false)], 1257.0).expect("facets");
        let middle = DVec3::new(0.3, 0.4, 0.0);
        let up = environment.first_hit(middle, DVec3::Z, None).expect("a hit");
        let down = environment.first_hit(middle + DVec3::Z, -DVec3::Z, None).expect("a hit");
        assert_eq!((up.0, down.0), (1, 0));
        assert!((up.1 - DVec3::new(0.3, 0.4, 0.5)).length() < 1e-12);
        assert!(environment.obstacles_between([middle, middle + DVec3::Z], [None; 2]).is_blocked);
        assert!(!environment.obstacles_between([up.1, up.1 + DVec3::new(0.1, 0.0, 3.0)], [Some(0), None]).is_blocked);
        assert_eq!(environment.diffracting_edges().len(), 4);
    }

    #[test]
    fn a_hole_is_no_wall() {
        let ring = |s: f64| [[-s, -s], [s, -s], [s, s], [-s, s]].map(|[x, y]| DVec3::new(x, y, 1.0)).to_vec();
        let facet = Facet { holes: vec![ring(0.5)], ..Facet::new(ring(1.0), METAL) };
        let environment = Environment::new(vec![facet], 1257.0).expect("a facet");
        let ends = |x: f64| [DVec3::new(x, 0.1, 0.0), DVec3::new(x, 0.1, 2.0)];
        let is_blocked = |x: f64| environment.obstacles_between(ends(x), [None; 2]).is_blocked;
        assert!(!is_blocked(0.2) && is_blocked(0.7) && !is_blocked(1.2));
        assert_eq!(environment.diffracting_edges().len(), 8);
    }

    /// A pane of glass is crossed once, although both of its sides are hit; metal and obstacles block the path.
    #[test]
    fn glass_lets_waves_through_and_obstacles_do_not() {
        let glass = Wall::Slab { permittivity: num_complex::Complex64::new(6.31, -0.26), thickness_m: 0.01 };
        let sheet = |z: f64, wall: Wall| [true, false].map(|up| Facet { wall, ..square(z, up) });
        let small = [DVec3::new(0.0, 0.0, 0.8), DVec3::new(0.5, 0.0, 0.8), DVec3::new(0.0, 0.5, 0.8)];
        let facets = [sheet(0.5, glass), sheet(1.5, METAL)].concat();
        let environment = Environment::with_obstacles(facets, &[small], 1257.0, 0.0).expect("facets");
        let obstacles = |environment: &Environment, x: f64, high: f64| {
            let ends = [DVec3::new(x, 0.1, 0.0), DVec3::new(x, 0.1, high)];
            let found = environment.obstacles_between(ends, [None; 2]);
            (found.is_blocked, found.crossed.len())
        };
        assert_eq!(obstacles(&environment, 0.7, 1.0), (true, 0));
        let environment = environment.with_transmission(true);
        assert_eq!(obstacles(&environment, 0.7, 0.4), (false, 0));
        assert_eq!(obstacles(&environment, 0.7, 1.0), (false, 1));
        assert_eq!(obstacles(&environment, 0.7, 2.0), (true, 1));
        assert_eq!(obstacles(&environment, 0.1, 1.0), (true, 1));
    }

    #[test]
    fn facets_that_are_no_plane_polygons_are_refused() {
        let mut bent = square(0.0, true);
        bent.corners[2].z = 0.1;
        let line = Facet::new(vec![DVec3::ZERO, DVec3::X, DVec3::X * 2.0], METAL);
        let flags = Facet { diffracting_sides: vec![true], ..square(0.0, true) };
        for facet in [bent, line, flags] {
            assert!(Environment::new(vec![facet], 1257.0).is_err());
        }
    }
}
