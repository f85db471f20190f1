//! Obstruction of a path by people: by the limbs and trunk of the person that reflects it, and by other people near its
//! legs.

use std::cell::RefCell;

use glam::{DVec2, DVec3};

use super::{IncidentField, Snapshot};
use crate::diffraction::{self, Column, REACH_M};
use crate::em::image::{BoxRoom, Element, ImageIndex, order};
use crate::em::specular::Ellipsoid;
use crate::paths::{EdgesBeside, Obstruction, PolygonRoom, Surroundings};
use crate::people::body::SEGMENTS;
use crate::prepared_scene::PreparedScene;

/// Returns the segment that may hide a limb: the same limb on the other side of the body; `None` for other segments.
pub(super) fn opposite_limb(segment: usize) -> Option<usize> {
    (segment >= 3).then_some(if segment % 2 == 1 { segment + 1 } else { segment - 1 })
}

/// Approximates a limb by an upright column.
pub(super) fn limb_column(limb: &Ellipsoid) -> Column {
    Column {
        x: limb.centre.x,
        y: limb.centre.y,
        radius_m: limb.semi_axes_m.x.min(limb.semi_axes_m.y),
        height_m: limb.centre.z + limb.semi_axes_m.z,
    }
}

/// One-way path between a specular point and an image of an antenna.
pub(super) struct OneWayPath {
    pub(super) image: ImageIndex,
    /// Position of the image.
    pub(super) source: DVec3,
    /// Position of the antenna itself.
    pub(super) antenna: DVec3,
}

/// Returns the factor of obstruction on the one-way path between a point on a segment of person number `target` and an
/// antenna: by the person's own body and by other people.
pub(super) fn obstruction_factor(
    prepared: &PreparedScene,
    people: &[Snapshot],
    target: usize,
    segment: usize,
    path: &OneWayPath,
    point: DVec3,
) -> f64 {
    let Some(snapshot) = people.get(target) else { return 0.0 };
    own_body_factor(prepared, snapshot, segment, path.source, point)
        * people_factor(prepared, people, target, path.image, path.antenna, point)
}

/// Returns the factor of obstruction by the person's own trunk and limbs on the one-way path between a point of a
/// segment and an image. The straight, unfolded path is evaluated. This is valid because bodies are far smaller than
/// rooms.
pub(super) fn own_body_factor(
    prepared: &PreparedScene,
    snapshot: &Snapshot,
    segment: usize,
    source: DVec3,
    point: DVec3,
) -> f64 {
    if segment < 3 {
        return 1.0;
    }
    let other = opposite_limb(segment).and_then(|i| snapshot.body.get(i)).map(limb_column);
    [Some(snapshot.trunk), other]
        .iter()
        .flatten()
        .map(|c| diffraction::past(point, source, c, prepared.wavelength_m))
        .product()
}

/// Returns the factor of obstruction by people on the one-way path between a point on the body of person number
/// `target` and an image of an antenna. That person's own body counts on all legs but the last.
pub(super) fn people_factor(
    prepared: &PreparedScene,
    people: &[Snapshot],
    target: usize,
    image: ImageIndex,
    antenna: DVec3,
    point: DVec3,
) -> f64 {
    match &prepared.room {
        Surroundings::Box(room) => {
            let (last, mut weight) = (order(image) as usize, 1.0);
            let others = ObstructingPeople { prepared, people, target };
            room.each_leg(image, antenna, point, |leg, from, to| weight *= others.leg_factor(leg == last, from, to));
            weight
        }
        Surroundings::Polygons(room) => {
            polyline_factor(prepared, people, target, &room.possible_polyline(image, antenna, point))
        }
    }
}

/// Returns the factor of [`people_factor`] for a path with these corners, from an antenna to the point.
fn polyline_factor(prepared: &PreparedScene, people: &[Snapshot], target: usize, polyline: &[DVec3]) -> f64 {
    let (last, others) = (polyline.len().saturating_sub(2), ObstructingPeople { prepared, people, target });
    polyline.windows(2).enumerate().map(|(leg, ends)| others.leg_factor(leg == last, ends[0], ends[1])).product()
}

/// People that may obstruct a leg.
struct ObstructingPeople<'a> {
    prepared: &'a PreparedScene,
    people: &'a [Snapshot],
    target: usize,
}

impl ObstructingPeople<'_> {
    /// Returns the factor of obstruction on a leg. The target's own body is excluded on the last leg, which ends at it.
    fn leg_factor(&self, is_last: bool, from: DVec3, to: DVec3) -> f64 {
        let others = self.people.iter().enumerate().filter(|(i, _)| *i != self.target || !is_last);
        others.map(|(_, other)| diffraction::past(from, to, &other.column, self.prepared.wavelength_m)).product()
    }
}

/// Returns the point that represents a segment in obstruction tests towards an image: the specular point for a
/// monostatic plane wave from there. The actual specular points are no farther from it than the segment's radius, and
/// first Fresnel zones are as wide.
pub(super) fn facing_point(segment: &Ellipsoid, source: DVec3) -> DVec3 {
    let normal = segment.axes.transpose() * (source - segment.centre);
    segment.surface((normal * segment.semi_axes_m).normalize_or_zero())
}

/// Obstruction of the one-way path between an image and a segment.
pub(super) struct SharedObstruction<'a> {
    /// Obstruction by facets, edges and walls; `None` where it is computed for every specular point.
    pub(super) obstruction: Option<Obstruction<'a>>,
    /// Factor of obstruction by people.
    pub(super) people_factor: f64,
}

/// Edges near the one-way paths between an image and a segment in a frame.
#[derive(Debug, Clone, Default)]
pub(super) struct PathEdges {
    edges: EdgesBeside,
    /// Whether any field passed the obstruction when the edges were last searched.
    is_lit: bool,
}

/// Obstructions of the one-way paths between images and a person's segments at an instant, in a room of plane faces.
/// Away from edges, one result serves all specular points of a segment and all antennas, which are some millimetres
/// apart. Near edges the obstruction varies within a segment, so every specular point has its own.
pub(super) struct SharedObstructions<'a> {
    prepared: &'a PreparedScene,
    room: &'a PolygonRoom,
    people: &'a [Snapshot],
    target: usize,
    /// Edges near the paths at any instant: `[image][segment]`.
    path_edges: &'a RefCell<Vec<PathEdges>>,
    /// Obstructions computed so far: `[image][segment]`.
    computed: Vec<Option<SharedObstruction<'a>>>,
}

impl<'a> SharedObstructions<'a> {
    /// Creates an empty store with an entry for each image and segment in `path_edges`.
    pub(super) fn new(
        prepared: &'a PreparedScene,
        room: &'a PolygonRoom,
        people: &'a [Snapshot],
        target: usize,
        path_edges: &'a RefCell<Vec<PathEdges>>,
    ) -> Self {
        let computed = path_edges.borrow().iter().map(|_| None).collect();
        SharedObstructions { prepared, room, people, target, path_edges, computed }
    }

    /// Returns the obstruction of the one-way path between a segment and an image with an index; `None` if it is
    /// complete.
    pub(super) fn of(&mut self, number: usize, image: ImageIndex, segment: usize) -> Option<&SharedObstruction<'a>> {
        let body = &self.people.get(self.target)?.body;
        let (ellipsoid, slot) = (body.get(segment)?, self.computed.get_mut(number * SEGMENTS + segment)?);
        if slot.is_none() {
            let (room, antenna) = (self.room, self.prepared.tx.position);
            let point = facing_point(ellipsoid, self.prepared.room.image_position(image, antenna));
            let mut path_edges = self.path_edges.borrow_mut();
            let path_edges = path_edges.get_mut(number * SEGMENTS + segment)?;
            let (obstruction, polyline) = if path_edges.is_lit && !path_edges.edges.is_empty() {
                (None, room.possible_polyline(image, antenna, point))
            } else {
                let obstruction = room.obstruction(image, antenna, point, Some(&mut path_edges.edges));
                path_edges.is_lit = obstruction.bound() > 0.0;
                let polyline = room.paths().polyline_past(&obstruction, antenna, point);
                (Some(obstruction), polyline)
            };
            let people_factor = polyline_factor(self.prepared, self.people, self.target, &polyline);
            *slot = Some(SharedObstruction { obstruction, people_factor });
        }
        slot.as_ref().filter(|shared| shared.obstruction.as_ref().is_none_or(|obstruction| obstruction.bound() > 0.0))
    }

    /// Returns the field of an element's image at a point of a segment.
    pub(super) fn field(
        &mut self,
        (number, image): (usize, ImageIndex),
        element: &Element,
        segment: usize,
        point: DVec3,
    ) -> Option<IncidentField> {
        let (room, path_edges) = (self.room, self.path_edges);
        let shared = self.of(number, image, segment)?;
        let paths = room.paths();
        let mut path_edges = path_edges.borrow_mut();
        let edges = &mut path_edges.get_mut(number * SEGMENTS + segment)?.edges;
        let shared_obstruction = shared.obstruction.as_ref().filter(|_| edges.is_empty());
        let is_clear = shared_obstruction.is_some() && shared.people_factor == 1.0;
        let field = match shared_obstruction {
            Some(obstruction) => paths.illuminate_past(element, obstruction, point).field,
            None => {
                let obstruction = room.obstruction(image, element.position, point, Some(edges));
                paths.illuminate_past(element, &obstruction, point).field
            }
        };
        Some(IncidentField { field, obstruction_factor: shared.people_factor, is_clear })
    }
}

/// Margin for rounding on distances beyond which columns are ignored, m.
const ROUNDING_M: f64 = 1e-6;

/// Column on the ground plan of the unfolded room, with an image in every lattice cell that a path crosses.
#[derive(Debug, Clone, Copy, PartialEq)]
struct PlanColumn {
    axis: DVec2,
    /// Square of the distance from its axis beyond which a path is unaffected, m^2.
    reach_m2: f64,
    /// Whether it is the body at which the path ends. It obstructs only the part of the path before the last reflection
    /// by floor or ceiling.
    is_target: bool,
}

impl PlanColumn {
    /// Returns whether a straight path on the ground plan comes near. It begins at `from` and extends by `vector`.
    fn is_near(&self, from: DVec2, vector: DVec2) -> bool {
        let offset = self.axis - from;
        let (along, square) = (offset.dot(vector), vector.length_squared());
        if along <= 0.0 {
            return offset.length_squared() <= self.reach_m2;
        }
        if along >= square {
            return (offset - vector).length_squared() <= self.reach_m2;
        }
        let cross = offset.perp_dot(vector);
        let is_far = cross * cross > self.reach_m2 * square;
        !is_far
    }
}

/// Columns that may obstruct the paths between images and a person's body at an instant, computed for each image on
/// first use.
pub(super) struct Bystanders<'a> {
    prepared: &'a PreparedScene,
    room: &'a BoxRoom,
    people: &'a [Snapshot],
    target: usize,
    /// Columns of each image; empty before first use, as the result is never empty.
    columns_by_image: Vec<Vec<PlanColumn>>,
}

impl<'a> Bystanders<'a> {
    /// Creates an empty store for a number of images of a box.
    pub(super) fn new(
        prepared: &'a PreparedScene,
        room: &'a BoxRoom,
        people: &'a [Snapshot],
        target: usize,
        images: usize,
    ) -> Self {
        Bystanders { prepared, room, people, target, columns_by_image: vec![Vec::new(); images] }
    }

    /// Returns the images of all people's columns in the lattice cells that paths from an image cross.
    fn plan_columns(&self, [x, y, _]: ImageIndex) -> Vec<PlanColumn> {
        let mut columns = Vec::new();
        for i in x.min(0)..=x.max(0) {
            for j in y.min(0)..=y.max(0) {
                for (person, Snapshot { column, .. }) in self.people.iter().enumerate() {
                    let axis = self.room.image_position([i, j, 0], DVec3::new(column.x, column.y, 0.0));
                    let reach_m = column.radius_m + REACH_M + ROUNDING_M;
                    let is_target = person == self.target && (i, j) == (0, 0);
                    columns.push(PlanColumn { axis: axis.truncate(), reach_m2: reach_m * reach_m, is_target });
                }
            }
        }
        columns
    }

    /// Returns the same factor as [`people_factor`], which is evaluated only if a person is near the path. `number` is
    /// the index of the image.
    pub(super) fn factor(&mut self, number: usize, path: &OneWayPath, point: DVec3) -> f64 {
        let (prepared, people, target) = (self.prepared, self.people, self.target);
        let exact = || people_factor(prepared, people, target, path.image, path.antenna, point);
        let size_m = self.room.size_m;
        // Paths to points outside of the room may leave these cells before they are folded.
        if !(point.cmpge(DVec3::ZERO).all() && point.cmple(size_m).all()) {
            return exact();
        }
        if self.columns_by_image.get(number).is_some_and(Vec::is_empty) {
            let columns = self.plan_columns(path.image);
            self.columns_by_image[number] = columns;
        }
        let Some(columns) = self.columns_by_image.get(number) else { return exact() };
        let (from, whole) = (path.source.truncate(), (point - path.source).truncate());
        // Part of the path before the last reflection by floor or ceiling.
        let before = match path.image[2] {
            0 => None,
            planes => {
                let plane_m = if planes > 0 { size_m.z } else { 0.0 };
                Some(whole * ((plane_m - path.source.z) / (point.z - path.source.z)))
            }
        };
        let is_near = |column: &PlanColumn| match (column.is_target, before) {
            (false, _) => column.is_near(from, whole),
            (true, Some(before)) => column.is_near(from, before),
            (true, None) => false,
        };
        if columns.iter().any(is_near) { exact() } else { 1.0 }
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use rand::Rng;

    use super::*;
    use crate::em::image::images;
    use crate::people::motion::{MotionBuilder, Person};
    use crate::random::{Purpose, generator};
    use crate::scene::Scene;

    /// For two people anywhere in rooms, the shortcut gives the same obstruction as the full computation.
    #[test]
    fn bystanders_obstruct_as_all_people_do() {
        let mut rng = generator(5, Purpose::Build, [0, 0]);
        let (mut shaded, mut all) = (0, 0);
        for name in ["corridor", "hall"] {
            let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("../fixtures/scenes/{name}.toml"));
            let scene = Scene::load(&path).expect("a fixture").drawn(1).expect("a scene");
            let prepared = PreparedScene::new(&scene, 1, 10.0);
            let room = scene.room();
            let size_m = room.size_m;
            for i in 0..40u64 {
                let mut somebody = |number: u64| {
                    let place = [rng.random_range(0.3..size_m.x - 0.3), rng.random_range(0.3..size_m.y - 0.3)];
                    let heading_rad = rng.random_range(-3.0..3.0);
                    MotionBuilder::new(Person::draw(i, [number, 0], 1.75), 0.0, place, heading_rad).stay()
                };
                let people = [somebody(0), somebody(1)].map(|motion| Snapshot::new(&motion, 1.0));
                let mut bystanders = Bystanders::new(&prepared, &room, &people, 0, images(2).len());
                for (number, image) in images(2).into_iter().enumerate() {
                    let antenna = prepared.tx.position;
                    let path = OneWayPath { image, source: prepared.room.image_position(image, antenna), antenna };
                    for segment in people[0].body {
                        let unit = DVec3::new(rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0), 0.3);
                        let point = segment.surface(unit.normalize());
                        let exact = people_factor(&prepared, &people, 0, image, antenna, point);
                        assert_eq!(bystanders.factor(number, &path, point), exact, "{name} {i} {image:?} {point}");
                        shaded += usize::from(exact < 0.9);
                        all += 1;
                    }
                }
            }
        }
        assert!(shaded > all / 50, "{shaded} of {all}");
    }
}
