//! What people leave of a path: their own limbs and trunk, and everybody who stands beside one of its legs.

use glam::DVec3;

use super::Snapshot;
use crate::field::image::{ImageIndex, order};
use crate::paths::Surroundings;
use crate::shadow::{self, Column};
use crate::stage::Stage;

/// Which segment may hide a limb: the same limb of the other side.
fn opposite(segment: usize) -> Option<usize> {
    (segment >= 3).then_some(if segment % 2 == 1 { segment + 1 } else { segment - 1 })
}

/// One way of a path: between a highlight and an antenna by one of its images.
pub(super) struct Way {
    pub(super) image: ImageIndex,
    /// Position of the image.
    pub(super) source: DVec3,
    /// Position of the antenna itself.
    pub(super) antenna: DVec3,
}

/// Field left on the way between a point on somebody's segment and an antenna.
pub(super) fn visibility(
    stage: &Stage,
    people: &[Snapshot],
    me: usize,
    segment: usize,
    way: &Way,
    point: DVec3,
) -> f64 {
    let &Way { image, source, antenna } = way;
    let Some(own) = people.get(me) else { return 0.0 };
    let wavelength_m = stage.wavelength_m;
    let mut weight = 1.0;
    // The leg that touches the body, in the unfolded room (long enough: bodies are far smaller than rooms).
    if segment >= 3 {
        weight *= shadow::past(point, source, &own.trunk, wavelength_m);
        if let Some(other) = opposite(segment).and_then(|i| own.body.get(i)) {
            let radius_m = other.semi_axes_m.x.min(other.semi_axes_m.y);
            let column = Column {
                x: other.centre.x,
                y: other.centre.y,
                radius_m,
                height_m: other.centre.z + other.semi_axes_m.z,
            };
            weight *= shadow::past(point, source, &column, wavelength_m);
        }
    }
    weight * past_people(stage, people, me, image, antenna, point)
}

/// Field that other people leave on the way between a point of somebody's body and an antenna by one of its images, and the
/// own body before the last wall.
pub(super) fn past_people(
    stage: &Stage,
    people: &[Snapshot],
    me: usize,
    image: ImageIndex,
    antenna: DVec3,
    point: DVec3,
) -> f64 {
    match &stage.room {
        Surroundings::Box(room) => {
            past_legs(stage, people, me, order(image) as usize, room.corners(image, antenna, point))
        }
        Surroundings::Polygons(room) => {
            let way = room.way(image, antenna, point);
            past_legs(stage, people, me, way.len().saturating_sub(2), way.into_iter())
        }
    }
}

/// The same on a way whose leg of this number ends at the own body.
fn past_legs(
    stage: &Stage,
    people: &[Snapshot],
    me: usize,
    last: usize,
    mut corners: impl Iterator<Item = DVec3>,
) -> f64 {
    let Some(mut from) = corners.next() else { return 1.0 };
    let mut weight = 1.0;
    for (leg, to) in corners.enumerate() {
        for (i, other) in people.iter().enumerate() {
            if i != me || leg != last {
                weight *= shadow::past(from, to, &other.column, stage.wavelength_m);
            }
        }
        from = to;
    }
    weight
}
