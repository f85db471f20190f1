//! The surfaces of a scene as paths meet them: plane polygons with a wall each, and a structure for rays over their triangles.

use std::sync::Arc;

use glam::{DMat3, DVec2, DVec3};
use thiserror::Error;

use super::edge_index::EdgeIndex;
use super::edges::{SoftEdge, soft_edges};
use super::triangulate::{doubled_area, triangulate};
use crate::field::image::{BoxRoom, Wall};
use crate::field::wall::WallTable;
use crate::geometry::{Mesh, polygon};
use crate::trace::{Body, BodyError, Build, Ray, Surface, World};

/// Corners may lie this far from their facet's plane, m: 1 um is 0.003 rad of phase at 60 GHz.
const PLANAR_M: f64 = 1e-6;
/// Points beyond a side by this much still lie on a facet, m: those on the seam of two facets lie on one of them at least.
const SEAM_M: f64 = 1e-9;
/// Facets whose planes are nearer to each other than this lie in one plane, m.
const COPLANAR_M: f64 = 1e-7;
/// Sine of the angle up to which two planes are parallel.
const PARALLEL: f64 = 1e-6;
/// The one body of the world.
const BODY: u32 = 0;
/// Walls let waves through that leave more than this part of a field at normal incidence: -40 dB.
const LEAST_TRANSMISSION: f64 = 0.01;

/// Index of a facet in its environment.
pub type FacetId = u32;

/// A plane polygon that reflects on the side of its normal.
#[derive(Debug, Clone, PartialEq)]
pub struct Facet {
    /// Outline, m: a simple polygon, counter-clockwise seen against the normal.
    pub corners: Vec<DVec3>,
    /// Outlines of holes, m, in any direction.
    pub holes: Vec<Vec<DVec3>>,
    /// What it is made of. Nothing is there where it is [`Wall::Open`].
    pub wall: Wall,
    /// For each side of the outline, from its corner to the next: whether it diffracts as a free edge or an outward corner does.
    /// Empty where that is to be found from the geometry, as it is for sides of holes.
    pub soft_edges: Vec<bool>,
}

/// Facets from which no environment can be made.
#[derive(Debug, Error, PartialEq)]
pub enum EnvironmentError {
    /// A facet is no plane polygon.
    #[error("facet {facet}: {why}\n\nhint: an outline has three corners or more, in one plane within {PLANAR_M} m")]
    NoPolygon {
        /// The facet.
        facet: usize,
        /// Why.
        why: &'static str,
    },
    /// The list of soft edges is not as long as the outline.
    #[error("facet {facet}: {given} soft edges for {sides} sides, expected one a side or none")]
    SoftEdges {
        /// The facet.
        facet: usize,
        /// Sides of the outline.
        sides: usize,
        /// Soft edges given.
        given: usize,
    },
    /// Rays cannot be traced among the facets.
    #[error(transparent)]
    Body(#[from] BodyError),
}

impl Facet {
    /// A facet without holes whose soft edges are found from the geometry.
    pub fn new(corners: Vec<DVec3>, wall: Wall) -> Self {
        Facet { corners, holes: Vec::new(), wall, soft_edges: Vec::new() }
    }

    /// The six surfaces of a box room, numbered as its walls are.
    pub fn of_box(room: &BoxRoom) -> Vec<Facet> {
        let s = room.size_m;
        let at = |x: u8, y: u8, z: u8| s * DVec3::new(f64::from(x), f64::from(y), f64::from(z));
        let corners = [
            [at(0, 0, 0), at(0, 1, 0), at(0, 1, 1), at(0, 0, 1)],
            [at(1, 0, 0), at(1, 0, 1), at(1, 1, 1), at(1, 1, 0)],
            [at(0, 0, 0), at(0, 0, 1), at(1, 0, 1), at(1, 0, 0)],
            [at(0, 1, 0), at(1, 1, 0), at(1, 1, 1), at(0, 1, 1)],
            [at(0, 0, 0), at(1, 0, 0), at(1, 1, 0), at(0, 1, 0)],
            [at(0, 0, 1), at(0, 1, 1), at(1, 1, 1), at(1, 0, 1)],
        ];
        corners.into_iter().zip(room.walls).map(|(corners, wall)| Facet::new(corners.to_vec(), wall)).collect()
    }
}

/// A facet with its plane.
#[derive(Debug, Clone)]
pub(super) struct Flat {
    pub facet: Facet,
    pub normal: DVec3,
    pub offset_m: f64,
    /// Facets in the same plane, of either side, have the same number.
    pub plane: u32,
    /// Indices of its soft edges.
    pub soft: Vec<u32>,
    /// Coefficients of its wall.
    pub table: Arc<WallTable>,
    /// Whether its wall leaves enough of a wave that goes through it to be followed.
    pub transmits: bool,
    /// Middle and radius of a ball around it, m.
    pub middle: DVec3,
    pub radius_m: f64,
    axes: [DVec3; 2],
    outline: Vec<DVec2>,
    holes: Vec<Vec<DVec2>>,
}

impl Flat {
    fn new(number: usize, facet: Facet, tables: &mut WallTables) -> Result<Self, EnvironmentError> {
        let refused = |why| EnvironmentError::NoPolygon { facet: number, why };
        let all = || facet.corners.iter().chain(facet.holes.iter().flatten());
        if facet.corners.len() < 3 || facet.holes.iter().any(|hole| hole.len() < 3) {
            return Err(refused("an outline has fewer than three corners"));
        }
        if !all().all(|c| c.is_finite()) {
            return Err(refused("a corner is not finite"));
        }
        if !facet.soft_edges.is_empty() && facet.soft_edges.len() != facet.corners.len() {
            let (sides, given) = (facet.corners.len(), facet.soft_edges.len());
            return Err(EnvironmentError::SoftEdges { facet: number, sides, given });
        }
        let normal = polygon::normal(&facet.corners);
        if normal == DVec3::ZERO {
            return Err(refused("the outline has no area"));
        }
        let offset_m = facet.corners.iter().map(|c| c.dot(normal)).sum::<f64>() / facet.corners.len() as f64;
        if all().any(|c| (c.dot(normal) - offset_m).abs() > PLANAR_M) {
            return Err(refused("a corner lies out of the plane of the others"));
        }
        let u = normal.any_orthonormal_vector();
        let axes = [u, normal.cross(u)];
        let flat = |corners: &[DVec3]| -> Vec<DVec2> {
            corners.iter().map(|c| DVec2::new(c.dot(axes[0]), c.dot(axes[1]))).collect()
        };
        let outline = flat(&facet.corners);
        let holes = facet.holes.iter().map(|hole| flat(hole)).collect();
        let middle = facet.corners.iter().sum::<DVec3>() / facet.corners.len() as f64;
        let radius_m = facet.corners.iter().map(|corner| corner.distance(middle)).fold(0.0, f64::max);
        let through = facet.wall.transmission(tables.wavenumber_per_m, 1.0).te.norm();
        Ok(Flat {
            normal,
            offset_m,
            plane: 0,
            soft: Vec::new(),
            table: tables.of(facet.wall),
            transmits: through > LEAST_TRANSMISSION,
            middle,
            radius_m,
            axes,
            outline,
            holes,
            facet,
        })
    }

    /// Height of a point over the plane, m.
    pub fn height(&self, point: DVec3) -> f64 {
        self.normal.dot(point) - self.offset_m
    }

    /// Mirror image of a point.
    pub fn mirrored(&self, point: DVec3) -> DVec3 {
        point - self.normal * (2.0 * self.height(point))
    }

    /// Mirror image of vectors.
    pub fn mirror(&self) -> DMat3 {
        let n = self.normal;
        DMat3::from_cols(DVec3::X - n * (2.0 * n.x), DVec3::Y - n * (2.0 * n.y), DVec3::Z - n * (2.0 * n.z))
    }

    /// Whether waves are reflected there at all.
    pub fn reflects(&self) -> bool {
        self.facet.wall != Wall::Open
    }

    /// Whether a point of the plane lies on the facet.
    pub fn contains(&self, point: DVec3) -> bool {
        let p = DVec2::new(point.dot(self.axes[0]), point.dot(self.axes[1]));
        let within = encloses(&self.outline, p) && !self.holes.iter().any(|hole| encloses(hole, p));
        within || std::iter::once(&self.outline).chain(&self.holes).any(|sides| distance_m(sides, p) < SEAM_M)
    }

    /// Whether a point of the plane lies farther than a distance, m, from the ball around the facet.
    pub fn is_far(&self, point: DVec3, distance_m: f64) -> bool {
        let reach_m = self.radius_m + distance_m;
        self.middle.distance_squared(point) > reach_m * reach_m
    }

    /// Whether a hole is counter-clockwise seen against the normal, as the outline is.
    pub fn is_positive(&self, hole: usize) -> bool {
        self.holes.get(hole).is_some_and(|hole| doubled_area(hole) > 0.0)
    }

    fn triangles(&self) -> Option<Vec<[u32; 3]>> {
        triangulate(&self.outline, &self.holes)
    }
}

/// Tables of walls, one for all that are equal.
struct WallTables {
    wavenumber_per_m: f64,
    known: Vec<(Wall, Arc<WallTable>)>,
}

impl WallTables {
    fn of(&mut self, wall: Wall) -> Arc<WallTable> {
        if let Some((_, table)) = self.known.iter().find(|(known, _)| *known == wall) {
            return Arc::clone(table);
        }
        let table = Arc::new(WallTable::new(wall, self.wavenumber_per_m, false));
        self.known.push((wall, Arc::clone(&table)));
        table
    }
}

/// Whether a point lies within a closed outline, by the number of sides that it has on one hand.
fn encloses(outline: &[DVec2], p: DVec2) -> bool {
    let mut inside = false;
    for (a, b) in outline.iter().zip(outline.iter().cycle().skip(1)) {
        if (a.y > p.y) != (b.y > p.y) && p.x < a.x + (p.y - a.y) / (b.y - a.y) * (b.x - a.x) {
            inside = !inside;
        }
    }
    inside
}

/// Distance of a point from the sides of a closed outline, m.
fn distance_m(outline: &[DVec2], p: DVec2) -> f64 {
    let to_side = |(a, b): (&DVec2, &DVec2)| {
        let side = *b - *a;
        let part = ((p - *a).dot(side) / side.length_squared().max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
        p.distance(*a + side * part)
    };
    outline.iter().zip(outline.iter().cycle().skip(1)).map(to_side).fold(f64::INFINITY, f64::min)
}

/// Facets and obstacles on the straight way between two points.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Passing {
    /// Whether something lies there that lets nothing through.
    pub is_blocked: bool,
    /// The facets that let waves through, one a plane.
    pub crossed: Vec<FacetId>,
}

/// Plane polygons that waves meet.
#[derive(Debug, Clone)]
pub struct Environment {
    flats: Vec<Flat>,
    soft_edges: Vec<SoftEdge>,
    edge_index: EdgeIndex,
    /// Whether waves go through walls.
    transmission: bool,
    world: World,
    facet_of_triangle: Vec<FacetId>,
    /// Facets of each plane.
    planes: Vec<Vec<FacetId>>,
    wavenumber_per_m: f64,
}

impl Environment {
    /// An environment of facets, whose materials are evaluated at a wave number.
    ///
    /// # Errors
    /// If a facet is no plane polygon, or rays cannot be traced among them.
    pub fn new(facets: Vec<Facet>, wavenumber_per_m: f64) -> Result<Self, EnvironmentError> {
        Self::with_obstacles(facets, &[], wavenumber_per_m)
    }

    /// An environment of facets and of triangles, m, that hide what is behind them and mirror nothing.
    ///
    /// # Errors
    /// If a facet is no plane polygon, or rays cannot be traced among them.
    pub fn with_obstacles(
        facets: Vec<Facet>,
        obstacles: &[[DVec3; 3]],
        wavenumber_per_m: f64,
    ) -> Result<Self, EnvironmentError> {
        let mut tables = WallTables { wavenumber_per_m, known: Vec::new() };
        let flats: Result<Vec<Flat>, _> =
            facets.into_iter().enumerate().map(|(i, f)| Flat::new(i, f, &mut tables)).collect();
        let mut flats = flats?;
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
            // Of no plane: rays that leave a facet or end on one meet all of them.
            groups.push(planes.len() as u32);
            facet_of_triangle.push(FacetId::MAX);
        }
        let bodies = if groups.is_empty() { Vec::new() } else { vec![Body::with_groups(mesh, groups, Build::Static)?] };
        let world = World::new(bodies)?;
        let soft_edges = soft_edges(&flats);
        for (number, edge) in (0..).zip(&soft_edges) {
            for &facet in edge.facets() {
                if let Some(flat) = flats.get_mut(facet as usize) {
                    flat.soft.push(number);
                }
            }
        }
        let edge_index = EdgeIndex::new(&soft_edges);
        Ok(Environment {
            flats,
            soft_edges,
            edge_index,
            transmission: false,
            world,
            facet_of_triangle,
            planes,
            wavenumber_per_m,
        })
    }

    /// The same environment whose walls let waves through: those that leave more than -40 dB at normal incidence.
    pub fn with_transmission(mut self, transmission: bool) -> Self {
        self.transmission = transmission;
        self
    }

    /// Whether waves go through walls.
    pub(super) fn lets_through(&self) -> bool {
        self.transmission
    }

    /// Number of facets.
    pub fn len(&self) -> usize {
        self.flats.len()
    }

    /// Whether there is no facet.
    pub fn is_empty(&self) -> bool {
        self.flats.is_empty()
    }

    /// A facet.
    pub fn facet(&self, facet: FacetId) -> Option<&Facet> {
        self.flat(facet).map(|flat| &flat.facet)
    }

    /// Triangles that cover a facet, m; none where it does not reflect.
    pub fn triangles(&self, facet: FacetId) -> Vec<[DVec3; 3]> {
        let Some(flat) = self.flat(facet).filter(|flat| flat.reflects()) else { return Vec::new() };
        let corners: Vec<DVec3> = flat.facet.corners.iter().chain(flat.facet.holes.iter().flatten()).copied().collect();
        let corner = |number: u32| corners.get(number as usize).copied();
        let triangles = flat.triangles().unwrap_or_default().into_iter();
        triangles.filter_map(|[a, b, c]| Some([corner(a)?, corner(b)?, corner(c)?])).collect()
    }

    /// The facet that a ray from a point of another one meets first, if it meets that from the front, and where.
    pub fn met_from(&self, on: FacetId, from: DVec3, direction: DVec3) -> Option<(FacetId, DVec3)> {
        self.first_hit(from, direction, Some(on))
    }

    /// Unit normal of a facet.
    pub fn normal(&self, facet: FacetId) -> Option<DVec3> {
        self.flat(facet).map(|flat| flat.normal)
    }

    /// Edges that diffract.
    pub fn soft_edges(&self) -> &[SoftEdge] {
        &self.soft_edges
    }

    /// Numbers of soft edges that may come within a distance, m, of a straight way, ascending.
    pub(super) fn edges_near(&self, from: DVec3, to: DVec3, distance_m: f64, found: &mut Vec<u32>) {
        self.edge_index.near(from, to, distance_m, found);
    }

    /// Wave number at which materials are evaluated, 1/m.
    pub fn wavenumber_per_m(&self) -> f64 {
        self.wavenumber_per_m
    }

    /// Wave length, m.
    pub fn wavelength_m(&self) -> f64 {
        std::f64::consts::TAU / self.wavenumber_per_m
    }

    pub(super) fn flat(&self, facet: FacetId) -> Option<&Flat> {
        self.flats.get(facet as usize)
    }

    /// The facet on which a point lies, if any: an antenna may be mounted on a wall.
    pub fn below(&self, point: DVec3) -> Option<FacetId> {
        let holds = |flat: &Flat| flat.reflects() && flat.height(point).abs() < PLANAR_M && flat.contains(point);
        self.flats.iter().position(holds).map(|facet| facet as FacetId)
    }

    /// A ray from a point, perhaps on a facet.
    fn ray(&self, ray: Ray, from: Option<FacetId>) -> Ray {
        match from.and_then(|facet| self.flat(facet)) {
            Some(flat) => ray.leaving(Surface { body: BODY, group: flat.plane }, flat.normal),
            None => ray,
        }
    }

    /// The facet that a ray meets first, if it meets that from the front, and where.
    pub(super) fn first_hit(&self, from: DVec3, direction: DVec3, on: Option<FacetId>) -> Option<(FacetId, DVec3)> {
        let hit = self.world.closest(&self.ray(Ray::new(from, direction), on))?;
        let met = *self.facet_of_triangle.get(hit.triangle as usize)?;
        let first = self.flat(met)?;
        let along = -first.height(from) / first.normal.dot(direction);
        let point = from + direction * along;
        if !point.is_finite() {
            return None;
        }
        let faces = |flat: &Flat| flat.normal.dot(direction) < 0.0;
        if faces(first) {
            return Some((met, point));
        }
        // The other side of a sheet lies in the same place.
        let others = self.planes.get(first.plane as usize)?;
        let holds = |facet: &FacetId| self.flat(*facet).is_some_and(|f| f.reflects() && faces(f) && f.contains(point));
        Some((others.iter().copied().find(holds)?, point))
    }

    /// Distance from a point to the first thing that a ray in a direction meets, m.
    pub fn distance_m(&self, from: DVec3, direction: DVec3) -> Option<f64> {
        self.world.closest(&Ray::new(from, direction)).map(|hit| hit.distance_m)
    }

    /// Whether anything lies on the straight way between two points, each perhaps on a facet, whose planes are passed over.
    pub(super) fn blocked(&self, ends: [DVec3; 2], on: [Option<FacetId>; 2]) -> bool {
        self.world.blocked(&self.ray_between(ends, on))
    }

    /// What lies on the straight way between two points, each perhaps on a facet, whose planes are passed over.
    pub(super) fn passing(&self, ends: [DVec3; 2], on: [Option<FacetId>; 2]) -> Passing {
        let ray = self.ray_between(ends, on);
        let mut passing = Passing { is_blocked: self.world.blocked(&ray), crossed: Vec::new() };
        if !(passing.is_blocked && self.transmission) {
            return passing;
        }
        let plane_of = |facet: FacetId| self.flat(facet).map(|flat| flat.plane);
        let on_planes = on.map(|facet| facet.and_then(plane_of));
        let mut is_opaque = false;
        for hit in self.world.all(BODY, &ray) {
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
            if flat.transmits && !passing.crossed.iter().any(|&other| plane_of(other) == Some(flat.plane)) {
                passing.crossed.push(facet);
            }
        }
        // What only the ray's own test of nearness finds lies in a crease, which lets nothing through.
        passing.is_blocked = is_opaque || passing.crossed.is_empty();
        passing
    }

    fn ray_between(&self, [from, to]: [DVec3; 2], on: [Option<FacetId>; 2]) -> Ray {
        let ray = self.ray(Ray::between(from, to), on[0]);
        match on[1].and_then(|facet| self.flat(facet)) {
            Some(flat) => ray.reaching(Surface { body: BODY, group: flat.plane }),
            None => ray,
        }
    }
}

/// Numbers the planes of facets, and returns the facets of each.
fn number_planes(flats: &mut [Flat]) -> Vec<Vec<FacetId>> {
    let mut order: Vec<usize> = (0..flats.len()).collect();
    let key = |i: usize| flats.get(i).map_or(0.0, |flat| flat.offset_m.abs());
    order.sort_by(|&a, &b| key(a).total_cmp(&key(b)).then(a.cmp(&b)));
    let mut planes: Vec<Vec<FacetId>> = Vec::new();
    let mut numbers = vec![0u32; flats.len()];
    // Planes at about the present distance from the origin: distance, number, a facet in it.
    let mut recent: Vec<(f64, u32, usize)> = Vec::new();
    for i in order {
        let distance = key(i);
        recent.retain(|(d, ..)| distance - d <= COPLANAR_M);
        let same = |j: usize| match (flats.get(i), flats.get(j)) {
            (Some(a), Some(b)) => {
                let side = a.normal.dot(b.normal).signum();
                let is_parallel = a.normal.cross(b.normal).length_squared() < PARALLEL * PARALLEL;
                is_parallel && (a.offset_m - side * b.offset_m).abs() <= COPLANAR_M
            }
            _ => false,
        };
        let number = match recent.iter().find(|(.., j)| same(*j)) {
            Some((_, number, _)) => *number,
            None => {
                recent.push((distance, planes.len() as u32, i));
                planes.push(Vec::new());
                planes.len() as u32 - 1
            }
        };
        if let (Some(members), Some(slot)) = (planes.get_mut(number as usize), numbers.get_mut(i)) {
            members.push(i as FacetId);
            *slot = number;
        }
    }
    planes.iter_mut().for_each(|members| members.sort_unstable());
    for (flat, number) in flats.iter_mut().zip(numbers) {
        flat.plane = number;
    }
    planes
}

#[cfg(test)]
mod tests {
    use super::*;

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
    fn rays_meet_the_side_of_a_sheet_that_faces_them() {
        let environment = Environment::new(vec![square(0.5, true), square(0.5, false)], 1257.0).expect("facets");
        let middle = DVec3::new(0.3, 0.4, 0.0);
        let up = environment.first_hit(middle, DVec3::Z, None).expect("a hit");
        let down = environment.first_hit(middle + DVec3::Z, -DVec3::Z, None).expect("a hit");
        assert_eq!((up.0, down.0), (1, 0));
        assert!((up.1 - DVec3::new(0.3, 0.4, 0.5)).length() < 1e-12);
        assert!(environment.blocked([middle, middle + DVec3::Z], [None; 2]));
        assert!(environment.passing([middle, middle + DVec3::Z], [None; 2]).is_blocked);
        assert!(!environment.blocked([up.1, up.1 + DVec3::new(0.1, 0.0, 3.0)], [Some(0), None]));
        assert_eq!(environment.soft_edges().len(), 4);
    }

    #[test]
    fn a_hole_is_no_wall() {
        let ring = |s: f64| [[-s, -s], [s, -s], [s, s], [-s, s]].map(|[x, y]| DVec3::new(x, y, 1.0)).to_vec();
        let facet = Facet { holes: vec![ring(0.5)], ..Facet::new(ring(1.0), METAL) };
        let environment = Environment::new(vec![facet], 1257.0).expect("a facet");
        let through = |x: f64| environment.blocked([DVec3::new(x, 0.1, 0.0), DVec3::new(x, 0.1, 2.0)], [None; 2]);
        assert!(!through(0.2) && through(0.7) && !through(1.2));
        assert_eq!(environment.soft_edges().len(), 8);
    }

    /// Glass is passed once where both of its sides are met; metal and what mirrors nothing hide it.
    #[test]
    fn glass_lets_waves_through_and_obstacles_do_not() {
        let glass = Wall::Slab { permittivity: num_complex::Complex64::new(6.31, -0.26), thickness_m: 0.01 };
        let sheet = |z: f64, wall: Wall| [true, false].map(|up| Facet { wall, ..square(z, up) });
        let small = [DVec3::new(0.0, 0.0, 0.8), DVec3::new(0.5, 0.0, 0.8), DVec3::new(0.0, 0.5, 0.8)];
        let facets = [sheet(0.5, glass), sheet(1.5, METAL)].concat();
        let environment = Environment::with_obstacles(facets, &[small], 1257.0).expect("facets");
        let passed = |environment: &Environment, x: f64, high: f64| {
            let passing = environment.passing([DVec3::new(x, 0.1, 0.0), DVec3::new(x, 0.1, high)], [None; 2]);
            (passing.is_blocked, passing.crossed.len())
        };
        assert_eq!(passed(&environment, 0.7, 1.0), (true, 0));
        let environment = environment.with_transmission(true);
        assert_eq!(passed(&environment, 0.7, 0.4), (false, 0));
        assert_eq!(passed(&environment, 0.7, 1.0), (false, 1));
        assert_eq!(passed(&environment, 0.7, 2.0), (true, 1));
        assert_eq!(passed(&environment, 0.1, 1.0), (true, 1));
    }

    #[test]
    fn what_is_no_polygon_is_refused() {
        let mut bent = square(0.0, true);
        bent.corners[2].z = 0.1;
        let line = Facet::new(vec![DVec3::ZERO, DVec3::X, DVec3::X * 2.0], METAL);
        let flags = Facet { soft_edges: vec![true], ..square(0.0, true) };
        for facet in [bent, line, flags] {
            assert!(Environment::new(vec![facet], 1257.0).is_err());
        }
    }
}
