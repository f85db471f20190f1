//! Surroundings of the antennas of a scene: a box with a lattice of images, or plane faces whose images are found by
//! rays.

use std::sync::Arc;

use glam::DVec3;
use num_complex::Complex64;
use radome_dsp::KernelLevel;

use super::discovery::{DiscoveryReport, ImagePaths, LaunchOptions};
use super::environment::{Environment, EnvironmentError, FacetId};
use super::illuminate::{EdgesBeside, Obstruction};
use crate::em::image::{BoxRoom, Element, Illumination, ImageIndex, Wall, images, order};
use crate::lanes::{WideRow, WideRow3};
use crate::scene::Scene;
use crate::scene::surfaces::Surfaces;
use crate::scene_file::SolverFile;

/// Number of facets above which paths have at most two reflections: in such rooms paths of three are many and weak.
const MANY_FACETS: usize = 200;
const MOST_REFLECTIONS_OF_MANY: usize = 2;
/// Largest number of rays for path discovery, in rooms of few facets and of many.
const MOST_RAYS: [usize; 2] = [100_000, 45_000];
/// Tolerance within which faces lie in the sides of a box, m.
const IN_SIDE_M: f64 = 1e-4;
/// Names of a box room's walls in the order in which [`BoxRoom`] numbers them.
const WALL_NAMES: [&str; 6] = ["x_low", "x_high", "y_low", "y_high", "floor", "ceiling"];
/// Largest distance of a point from a surface on which it lies, m.
const ON_SURFACE_M: f64 = 1e-6;

/// Surroundings of the antennas. Images have an [`ImageIndex`]: the lattice index in a box, otherwise `[number, 0, 0]`.
/// The index `[0, 0, 0]` is the antenna itself.
// A prepared scene holds only one value, and a box is queried millions of times a frame.
#[allow(clippy::large_enum_variant)]
#[derive(Debug, Clone)]
pub enum Surroundings {
    /// Box room.
    Box(BoxRoom),
    /// Plane faces.
    Polygons(Arc<PolygonRoom>),
}

/// Plane faces around the antennas, with the paths that rays from the transmitter find.
#[derive(Debug, Clone)]
pub struct PolygonRoom {
    paths: ImagePaths,
    size_m: DVec3,
    max_body_reflections: usize,
    /// Name of each facet.
    names: Vec<String>,
    /// Facets that reflect paths, ascending.
    reached_facets: Vec<FacetId>,
    /// Whether each piece of furniture has faces.
    has_faces: Vec<bool>,
}

impl PolygonRoom {
    /// Finds the paths of a scene's surfaces.
    fn new(scene: &Scene, surfaces: &Surfaces, tx: &Element, least_part: f64) -> Result<Self, EnvironmentError> {
        let room = &scene.file().room;
        let (environment, names) = Environment::of_surfaces(surfaces, scene.wavenumber_per_m(), room.diffuse_share)?;
        let has_many_facets = environment.len() > MANY_FACETS;
        let environment = Arc::new(environment.with_transmission(room.transmission).with_least_part(least_part));
        let requested_order = room.max_reflections.max(room.max_body_reflections) as usize;
        let options = LaunchOptions {
            max_order: if has_many_facets { requested_order.min(MOST_REFLECTIONS_OF_MANY) } else { requested_order },
            max_rays: if has_many_facets { MOST_RAYS[1] } else { MOST_RAYS[0] },
            ..LaunchOptions::default()
        };
        let paths = ImagePaths::discover(environment, tx.position, &options);
        let mut reached_facets: Vec<FacetId> =
            paths.images().iter().flat_map(|image| image.sequences.concat()).collect();
        reached_facets.sort_unstable();
        reached_facets.dedup();
        let DiscoveryReport { rays, sequences, images, reached_limit } = paths.report();
        tracing::debug!(facets = names.len(), rays, sequences, images, reached_limit, "paths found by rays");
        Ok(PolygonRoom {
            paths,
            size_m: DVec3::from_array(room.size_m),
            max_body_reflections: room.max_body_reflections as usize,
            names,
            reached_facets,
            has_faces: scene.file().furniture.iter().map(|piece| surfaces.has_faces_of(piece)).collect(),
        })
    }

    /// The polygons of a box, for tests.
    #[cfg(test)]
    pub(crate) fn of_box(room: &BoxRoom, antenna: DVec3) -> Self {
        use super::environment::Facet;
        let environment = Environment::new(Facet::of_box(room), room.wavenumber_per_m).expect("facets");
        let paths = ImagePaths::discover(Arc::new(environment), antenna, &LaunchOptions::default());
        let reached_facets = (0..6).filter(|&facet| room.walls.get(facet as usize) != Some(&Wall::Open)).collect();
        let names = WALL_NAMES.map(str::to_owned).to_vec();
        PolygonRoom {
            paths,
            size_m: room.size_m,
            max_body_reflections: 2,
            names,
            reached_facets,
            has_faces: Vec::new(),
        }
    }

    /// The paths from the transmitter.
    pub fn paths(&self) -> &ImagePaths {
        &self.paths
    }

    /// Facets that reflect paths from the transmitter, ascending.
    pub fn reached_facets(&self) -> &[FacetId] {
        &self.reached_facets
    }

    /// Corners of the path from an antenna to a point by an image, whether obstacles block it or not; empty where there
    /// is none ([`ImagePaths::possible_polyline`]).
    pub fn possible_polyline(&self, index: ImageIndex, antenna: DVec3, point: DVec3) -> Vec<DVec3> {
        self.paths.possible_polyline(number(index), antenna, point)
    }

    /// Relative field of an antenna's image at a point past facets, edges and walls ([`ImagePaths::obstruction`]).
    pub fn obstruction(
        &self,
        index: ImageIndex,
        antenna: DVec3,
        point: DVec3,
        known: Option<&mut EdgesBeside>,
    ) -> Obstruction<'_> {
        self.paths.obstruction(number(index), antenna, point, known)
    }

    /// Returns whether an unobstructed ray leads from an antenna to a point by an image.
    pub fn is_lit(&self, index: ImageIndex, antenna: DVec3, point: DVec3) -> bool {
        self.paths.is_lit(number(index), antenna, point)
    }

    /// Returns whether an image counts where only diffraction by edges reaches: in rooms of many facets, after one
    /// reflection at most. Two reflections and an edge leave less than the neglected paths of three reflections.
    pub fn counts_in_shadow(&self, index: ImageIndex) -> bool {
        let order = self.paths.images().get(number(index)).map_or(0, |image| image.order);
        order < MOST_REFLECTIONS_OF_MANY || self.paths.environment().len() <= MANY_FACETS
    }

    /// Upper bound of the magnitude of an image's field within `reach_m` of `middle`, without obstructions; 0 where no
    /// facet reflects it there.
    pub fn most_free_field(&self, element: &Element, index: ImageIndex, middle: DVec3, reach_m: f64) -> f64 {
        let number = number(index);
        if !self.paths.may_light(number, element.position, middle, reach_m) {
            return 0.0;
        }
        let source = self.image_position(index, element.position);
        let distance_m = middle.distance(source).max(1e-9);
        let spread_rad = (reach_m / distance_m).min(1.0).asin();
        self.paths.most_free_field(element, number, (middle - source) / distance_m, spread_rad)
    }

    /// Antenna images that may light points within `reach_m` of `middle`, the antenna itself first, sorted by order.
    pub fn images_near(&self, antenna: DVec3, middle: DVec3, reach_m: f64) -> Vec<ImageIndex> {
        let near = self.paths.images_near(antenna, middle, reach_m, self.max_body_reflections);
        near.into_iter().map(|number| [number as i32, 0, 0]).collect()
    }

    /// Position of an image, m.
    pub fn image_position(&self, index: ImageIndex, antenna: DVec3) -> DVec3 {
        self.paths.images().get(number(index)).map_or(antenna, |image| image.of(antenna))
    }

    /// Pairs of such images, as indices into the list. The echo of a body by a pair has no more reflections than the
    /// scene allows.
    pub fn pairs_among(&self, images: &[ImageIndex]) -> Vec<[usize; 2]> {
        let order = |index: ImageIndex| self.paths.images().get(number(index)).map_or(0, |image| image.order);
        let mut pairs = Vec::with_capacity(2 * images.len());
        for (p, &outward) in images.iter().enumerate() {
            // Images are sorted by order.
            let fitting = images.iter().take_while(|&&back| order(outward) + order(back) <= self.max_body_reflections);
            pairs.extend((0..fitting.count()).map(|q| [p, q]));
        }
        pairs
    }

    /// Adds 1 or more in lanes whose points an image may light ([`ImagePaths::add_reached`]).
    pub fn add_reached(
        &self,
        level: KernelLevel,
        index: ImageIndex,
        antenna: DVec3,
        points: &[WideRow3],
        out: &mut [WideRow],
    ) {
        self.paths.add_reached(level, number(index), antenna, points, out);
    }
}

/// Number of an image of polygons.
fn number(index: ImageIndex) -> usize {
    usize::try_from(index[0]).unwrap_or(0)
}

/// Returns whether surfaces are `walls` sides of a box of this size and nothing else.
fn is_box(surfaces: &Surfaces, size_m: DVec3, walls: usize) -> bool {
    let is_side = |corners: &[DVec3]| {
        (0..3).any(|axis| [0.0, size_m[axis]].iter().any(|at| corners.iter().all(|c| (c[axis] - at).abs() < IN_SIDE_M)))
    };
    let is_corner = |c: &DVec3| (0..3).all(|i| c[i].abs() < IN_SIDE_M || (c[i] - size_m[i]).abs() < IN_SIDE_M);
    let is_whole = |outline: &[DVec3]| outline.len() == 4 && outline.iter().all(is_corner) && is_side(outline);
    surfaces.small.is_empty()
        && surfaces.faces.len() == walls
        && surfaces.faces.iter().all(|face| face.polygon.holes.is_empty() && is_whole(&face.polygon.outline))
}

impl Surroundings {
    /// Builds the surroundings of a scene's antennas. Floor plans are polygons, and so are rooms of meshes unless these
    /// make a box and nothing else. A box of six surfaces stays a box unless the scene requests rays. Edges that change
    /// a field by less than `least_part` are left out.
    pub fn of_scene(scene: &Scene, tx: &Element, least_part: f64) -> Self {
        let file = &scene.file().room;
        let may_be_box = match file.solver {
            Some(SolverFile::Rays) => false,
            Some(SolverFile::Images) => return Surroundings::Box(scene.room()),
            None => file.plan.is_none(),
        };
        if may_be_box && file.mesh.is_empty() {
            return Surroundings::Box(scene.room());
        }
        let (surfaces, room) = (scene.surfaces(), scene.room());
        let walls = room.walls.iter().filter(|wall| **wall != Wall::Open).count();
        if may_be_box && is_box(&surfaces, room.size_m, walls) {
            return Surroundings::Box(room);
        }
        match PolygonRoom::new(scene, &surfaces, tx, least_part) {
            Ok(polygons) => Surroundings::Polygons(Arc::new(polygons)),
            Err(error) => {
                tracing::error!(scene = scene.name(), %error, "rays cannot be traced: the box around the room is taken");
                Surroundings::Box(room)
            }
        }
    }

    /// Size of the box around the room, m; its low corner is the origin.
    pub fn size_m(&self) -> DVec3 {
        match self {
            Surroundings::Box(room) => room.size_m,
            Surroundings::Polygons(room) => room.size_m,
        }
    }

    /// Returns whether a piece of the scene's furniture has reflecting faces.
    pub fn has_faces_of(&self, furniture: usize) -> bool {
        match self {
            Surroundings::Box(_) => false,
            Surroundings::Polygons(room) => room.has_faces.get(furniture).copied().unwrap_or(false),
        }
    }

    /// Number of reflections of an image.
    pub fn order(&self, index: ImageIndex) -> u32 {
        match self {
            Surroundings::Box(_) => order(index),
            Surroundings::Polygons(room) => room.paths.images().get(number(index)).map_or(0, |i| i.order as u32),
        }
    }

    /// All images up to an order, the antenna itself first, sorted by order.
    pub fn images(&self, max_order: u32) -> Vec<ImageIndex> {
        match self {
            Surroundings::Box(_) => images(max_order),
            Surroundings::Polygons(room) => {
                let all = room.paths.images().iter().zip(0i32..);
                all.filter(|(image, _)| image.order as u32 <= max_order).map(|(_, number)| [number, 0, 0]).collect()
            }
        }
    }

    /// Position of an image, m.
    pub fn image_position(&self, index: ImageIndex, antenna: DVec3) -> DVec3 {
        match self {
            Surroundings::Box(room) => room.image_position(index, antenna),
            Surroundings::Polygons(room) => room.image_position(index, antenna),
        }
    }

    /// Field of an element's image at a point; zero where no path leads there.
    #[inline]
    pub fn illuminate(&self, element: &Element, index: ImageIndex, point: DVec3) -> Illumination {
        match self {
            Surroundings::Box(room) => room.illuminate(element, index, point),
            Surroundings::Polygons(room) => room.paths.illuminate(element, number(index), point),
        }
    }

    /// Corners of the path from an antenna to a point by an image: antenna, bounces, point. Empty where there is no
    /// such path.
    pub fn polyline(&self, index: ImageIndex, antenna: DVec3, point: DVec3) -> Vec<DVec3> {
        match self {
            Surroundings::Box(room) => room.polyline(index, antenna, point),
            Surroundings::Polygons(room) => room.paths.polyline(number(index), antenna, point),
        }
    }

    /// Amplitude of the path from a transmitter's image straight to a receiver, without the propagation phase, and its
    /// length, m. The amplitude is relative to the transmitted field, with the isotropic antennas' aperture `lambda / 4
    /// pi`.
    pub fn direct(&self, tx: &Element, index: ImageIndex, rx: &Element) -> (Complex64, f64) {
        let wavenumber_per_m = match self {
            Surroundings::Box(room) => room.wavenumber_per_m,
            Surroundings::Polygons(room) => room.paths.environment().wavenumber_per_m(),
        };
        let arrival = self.illuminate(tx, index, rx.position);
        (arrival.received(rx, wavenumber_per_m), arrival.distance_m)
    }

    /// Relative field past walls and furniture on the straight segment between two points. It is 1 in a box, whose
    /// walls hide nothing within.
    pub fn field_on_segment(&self, from: DVec3, to: DVec3) -> f64 {
        match self {
            Surroundings::Box(_) => 1.0,
            Surroundings::Polygons(room) => room.paths.field_on_segment([from, to], [None; 2]),
        }
    }

    /// Names of the walls or pieces of furniture on whose surface a point lies: several at an edge. For a point beside
    /// a face, in its plane, the name of that face: a path may be diffracted there.
    pub fn surface_names(&self, point: DVec3) -> Vec<&str> {
        match self {
            Surroundings::Box(room) => {
                let size_m = room.size_m;
                let distances_m =
                    [point.x, size_m.x - point.x, point.y, size_m.y - point.y, point.z, size_m.z - point.z];
                let all = distances_m.into_iter().zip(WALL_NAMES);
                all.filter(|(distance_m, _)| distance_m.abs() < ON_SURFACE_M).map(|(_, name)| name).collect()
            }
            Surroundings::Polygons(room) => {
                let environment = room.paths.environment();
                let mut facets: Vec<_> = environment.facets_at(point).collect();
                if facets.is_empty() {
                    facets.extend(environment.nearest_coplanar_facet(point));
                }
                facets.into_iter().filter_map(|facet| room.names.get(facet as usize)).map(String::as_str).collect()
            }
        }
    }
}
