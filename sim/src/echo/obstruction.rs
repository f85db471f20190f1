//! Obstruction of a path by people: by the limbs and trunk of the person that reflects it, and by other people near its
//! legs.

use std::cell::RefCell;

use glam::{DVec2, DVec3};

use super::{Seen, Snapshot};
use crate::diffraction::{self, Column, REACH_M};
use crate::em::image::{BoxRoom, Element, ImageIndex, order};
use crate::em::specular::Ellipsoid;
use crate::paths::{EdgesBeside, Obstruction, PolygonRoom, Surroundings};
use crate::people::body::SEGMENTS;
use crate::prepared_scene::PreparedScene;

/// Returns the segment that may hide a limb: the same limb of the other side.
pub(super) fn opposite(segment: usize) -> Option<usize> {
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
pub(super) struct Way {
    pub(super) image: ImageIndex,
    /// Position of the image.
    pub(super) source: DVec3,
    /// Position of the antenna itself.
    pub(super) antenna: DVec3,
}

/// Returns the factor of obstruction on the one-way path between a point on a person's segment and an antenna.
pub(super) fn visibility(
    prepared: &PreparedScene,
    people: &[Snapshot],
    me: usize,
    segment: usize,
    way: &Way,
    point: DVec3,
) -> f64 {
    let Some(own) = people.get(me) else { return 0.0 };
    past_own(prepared, own, segment, way.source, point)
        * past_people(prepared, people, me, way.image, way.antenna, point)
}

/// Returns the factor of obstruction by the person's own trunk and limbs on the one-way path between a point of a
/// segment and an image. It is evaluated along the unfolded path, which is valid because bodies are far smaller than
/// rooms.
pub(super) fn past_own(prepared: &PreparedScene, own: &Snapshot, segment: usize, source: DVec3, point: DVec3) -> f64 {
    if segment < 3 {
        return 1.0;
    }
    let other = opposite(segment).and_then(|i| own.body.get(i)).map(limb_column);
    [Some(own.trunk), other]
        .iter()
        .flatten()
        .map(|c| diffraction::past(point, source, c, prepared.wavelength_m))
        .product()
}

/// Returns the factor of obstruction by other people on the one-way path between a point of a person's body and an
/// image of an antenna. The own body counts on all legs but the last.
pub(super) fn past_people(
    prepared: &PreparedScene,
    people: &[Snapshot],
    me: usize,
    image: ImageIndex,
    antenna: DVec3,
    point: DVec3,
) -> f64 {
    match &prepared.room {
        Surroundings::Box(room) => {
            let (last, mut weight) = (order(image) as usize, 1.0);
            let others = Others { prepared, people, me };
            room.each_leg(image, antenna, point, |leg, from, to| weight *= others.past(leg == last, from, to));
            weight
        }
        Surroundings::Polygons(room) => {
            past_along(prepared, people, me, &room.possible_polyline(image, antenna, point))
        }
    }
}

/// Returns the same factor for a path with these corners, from an antenna to the point.
fn past_along(prepared: &PreparedScene, people: &[Snapshot], me: usize, way: &[DVec3]) -> f64 {
    let (last, others) = (way.len().saturating_sub(2), Others { prepared, people, me });
    way.windows(2).enumerate().map(|(leg, ends)| others.past(leg == last, ends[0], ends[1])).product()
}

/// People that may obstruct a leg.
struct Others<'a> {
    prepared: &'a PreparedScene,
    people: &'a [Snapshot],
    me: usize,
}

impl Others<'_> {
    /// Returns the factor of obstruction on a leg. The own body is excluded on the last leg, which ends at it.
    fn past(&self, is_last: bool, from: DVec3, to: DVec3) -> f64 {
        let others = self.people.iter().enumerate().filter(|(i, _)| *i != self.me || !is_last);
        others.map(|(_, other)| diffraction::past(from, to, &other.column, self.prepared.wavelength_m)).product()
    }
}

/// Returns the point of a segment that represents it in obstruction tests towards an image: the specular point for a
/// monostatic plane wave from there. The actual specular points lie within the segment's own radius of it, and first
/// Fresnel zones are as wide.
pub(super) fn facing(segment: &Ellipsoid, source: DVec3) -> DVec3 {
    let normal = segment.axes.transpose() * (source - segment.centre);
    segment.surface((normal * segment.semi_axes_m).normalize_or_zero())
}

/// Obstruction of the one-way path between an image and a segment.
pub(super) struct SharedWay<'a> {
    /// Obstruction by facets, edges and walls; `None` where every specular point has its own.
    pub(super) obstruction: Option<Obstruction<'a>>,
    /// Factor of obstruction by people.
    pub(super) past_people: f64,
}

/// Edges beside the one-way paths between an image and a segment in a frame.
#[derive(Debug, Clone, Default)]
pub(super) struct BesideWay {
    edges: EdgesBeside,
    /// Whether something arrived when the edges were searched. It may begin to arrive later, but seldom.
    arrives: bool,
}

/// Obstructions of the one-way paths between images and a person's segments at an instant, in a room of plane faces.
/// Away from edges, one result serves all specular points of a segment and all antennas, which are some millimetres
/// apart. Near edges the obstruction varies within a segment, so every specular point has its own.
pub(super) struct SharedWays<'a> {
    prepared: &'a PreparedScene,
    room: &'a PolygonRoom,
    people: &'a [Snapshot],
    me: usize,
    /// Edges near the paths at any instant: `[image][segment]`.
    beside: &'a RefCell<Vec<BesideWay>>,
    /// Obstructions computed so far: `[image][segment]`.
    known: Vec<Option<SharedWay<'a>>>,
}

impl<'a> SharedWays<'a> {
    /// Creates an empty store with an entry for each image and segment in `beside`.
    pub(super) fn new(
        prepared: &'a PreparedScene,
        room: &'a PolygonRoom,
        people: &'a [Snapshot],
        me: usize,
        beside: &'a RefCell<Vec<BesideWay>>,
    ) -> Self {
        let known = beside.borrow().iter().map(|_| None).collect();
        SharedWays { prepared, room, people, me, beside, known }
    }

    /// Returns the obstruction of the one-way path between a segment and an image with an index; `None` if it is
    /// complete.
    pub(super) fn of(&mut self, number: usize, image: ImageIndex, segment: usize) -> Option<&SharedWay<'a>> {
        let body = &self.people.get(self.me)?.body;
        let (ellipsoid, slot) = (body.get(segment)?, self.known.get_mut(number * SEGMENTS + segment)?);
        if slot.is_none() {
            let (room, antenna) = (self.room, self.prepared.tx.position);
            let point = facing(ellipsoid, self.prepared.room.image_position(image, antenna));
            let mut beside = self.beside.borrow_mut();
            let beside = beside.get_mut(number * SEGMENTS + segment)?;
            let (obstruction, way) = if beside.arrives && !beside.edges.is_empty() {
                (None, room.possible_polyline(image, antenna, point))
            } else {
                let obstruction = room.obstruction(image, antenna, point, Some(&mut beside.edges));
                beside.arrives = obstruction.bound() > 0.0;
                let way = room.paths().polyline_past(&obstruction, antenna, point);
                (Some(obstruction), way)
            };
            let past_people = past_along(self.prepared, self.people, self.me, &way);
            *slot = Some(SharedWay { obstruction, past_people });
        }
        slot.as_ref().filter(|way| way.obstruction.as_ref().is_none_or(|obstruction| obstruction.bound() > 0.0))
    }

    /// Returns the field of an element's image at a point of a segment.
    pub(super) fn field(
        &mut self,
        (number, image): (usize, ImageIndex),
        element: &Element,
        segment: usize,
        point: DVec3,
    ) -> Option<Seen> {
        let (room, beside) = (self.room, self.beside);
        let way = self.of(number, image, segment)?;
        let paths = room.paths();
        let mut beside = beside.borrow_mut();
        let edges = &mut beside.get_mut(number * SEGMENTS + segment)?.edges;
        let shared = way.obstruction.as_ref().filter(|_| edges.is_empty());
        let is_clear = shared.is_some() && way.past_people == 1.0;
        let field = match shared {
            Some(shared) => paths.illuminate_past(element, shared, point).field,
            None => {
                let own = room.obstruction(image, element.position, point, Some(edges));
                paths.illuminate_past(element, &own, point).field
            }
        };
        Some(Seen { field, left: way.past_people, is_clear })
    }
}

/// Margin for rounding on distances beyond which columns are ignored, m.
const ROUNDING_M: f64 = 1e-6;

/// Column on the ground plan of the unfolded room, with an image in every lattice cell that a path crosses.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Standing {
    axis: DVec2,
    /// Square of the distance from its axis beyond which a path is unaffected, m^2.
    reach_m2: f64,
    /// Whether the column obstructs only the part of the path before the last mirror plane above or below.
    is_own: bool,
}

impl Standing {
    /// Returns whether a straight path on the ground plan comes near.
    fn is_near(&self, from: DVec2, way: DVec2) -> bool {
        let offset = self.axis - from;
        let (along, square) = (offset.dot(way), way.length_squared());
        if along <= 0.0 {
            return offset.length_squared() <= self.reach_m2;
        }
        if along >= square {
            return (offset - way).length_squared() <= self.reach_m2;
        }
        let cross = offset.perp_dot(way);
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
    me: usize,
    /// Columns of each image; empty before first use, as the result is never empty.
    of_images: Vec<Vec<Standing>>,
}

impl<'a> Bystanders<'a> {
    /// Creates an empty store for a number of images of a box.
    pub(super) fn new(
        prepared: &'a PreparedScene,
        room: &'a BoxRoom,
        people: &'a [Snapshot],
        me: usize,
        images: usize,
    ) -> Self {
        Bystanders { prepared, room, people, me, of_images: vec![Vec::new(); images] }
    }

    fn standing(&self, [x, y, _]: ImageIndex) -> Vec<Standing> {
        let mut all = Vec::new();
        for i in x.min(0)..=x.max(0) {
            for j in y.min(0)..=y.max(0) {
                for (person, Snapshot { column, .. }) in self.people.iter().enumerate() {
                    let axis = self.room.image_position([i, j, 0], DVec3::new(column.x, column.y, 0.0));
                    let reach_m = column.radius_m + REACH_M + ROUNDING_M;
                    let is_own = person == self.me && (i, j) == (0, 0);
                    all.push(Standing { axis: axis.truncate(), reach_m2: reach_m * reach_m, is_own });
                }
            }
        }
        all
    }

    /// Returns the same factor as [`past_people`], which is evaluated only if a person is near the path. `number` is
    /// the index of the image.
    pub(super) fn past(&mut self, number: usize, way: &Way, point: DVec3) -> f64 {
        let (prepared, people, me) = (self.prepared, self.people, self.me);
        let exact = || past_people(prepared, people, me, way.image, way.antenna, point);
        let size_m = self.room.size_m;
        // Paths to points outside of the room may leave these cells before they are folded.
        if !(point.cmpge(DVec3::ZERO).all() && point.cmple(size_m).all()) {
            return exact();
        }
        if self.of_images.get(number).is_some_and(Vec::is_empty) {
            let standing = self.standing(way.image);
            self.of_images[number] = standing;
        }
        let Some(standing) = self.of_images.get(number) else { return exact() };
        let (from, all) = (way.source.truncate(), (point - way.source).truncate());
        // Part of the path before the last mirror plane above or below.
        let before = match way.image[2] {
            0 => None,
            planes => {
                let plane_m = if planes > 0 { size_m.z } else { 0.0 };
                Some(all * ((plane_m - way.source.z) / (point.z - way.source.z)))
            }
        };
        let is_near = |standing: &Standing| match (standing.is_own, before) {
            (false, _) => standing.is_near(from, all),
            (true, Some(before)) => standing.is_near(from, before),
            (true, None) => false,
        };
        if standing.iter().any(is_near) { exact() } else { 1.0 }
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
    fn bystanders_leave_what_all_people_leave() {
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
                    let way = Way { image, source: prepared.room.image_position(image, antenna), antenna };
                    for segment in people[0].body {
                        let unit = DVec3::new(rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0), 0.3);
                        let point = segment.surface(unit.normalize());
                        let exact = past_people(&prepared, &people, 0, image, antenna, point);
                        assert_eq!(bystanders.past(number, &way, point), exact, "{name} {i} {image:?} {point}");
                        shaded += usize::from(exact < 0.9);
                        all += 1;
                    }
                }
            }
        }
        assert!(shaded > all / 50, "{shaded} of {all}");
    }
}
