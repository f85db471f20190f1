//! Points of many segments that face a source, vectorised over segments.

// Loops use lane indices: several rows are accessed together, and the compiler vectorises these loops.
#![allow(clippy::needless_range_loop)]

use crate::em::specular::Ellipsoid;
use crate::lanes::vector::{Vector, add, dot, normalized, scale, store, subtract, times};
use crate::lanes::{WIDE, WideRow3, compiled_for_levels, wide_lane};

/// Ellipsoids, one per lane. Unused lanes repeat the last one.
#[derive(Debug, Clone, Copy)]
pub(super) struct EllipsoidRows {
    centre: WideRow3,
    axes: [WideRow3; 3],
    semi_axes_m: WideRow3,
}

impl EllipsoidRows {
    /// Places ellipsoids in lanes, [`WIDE`] to a row.
    pub(super) fn of(all: &[Ellipsoid]) -> Vec<Self> {
        let rows = |some: &[Ellipsoid]| {
            let (mut centre, mut axes, mut semi_axes_m) = ([[0.0; WIDE]; 3], [[[0.0; WIDE]; 3]; 3], [[1.0; WIDE]; 3]);
            for l in 0..WIDE {
                let Some(ellipsoid) = some.get(l).or(some.last()) else { break };
                store(&mut centre, l, ellipsoid.centre.to_array());
                store(&mut semi_axes_m, l, ellipsoid.semi_axes_m.to_array());
                for (i, axis) in axes.iter_mut().enumerate() {
                    store(axis, l, ellipsoid.axes.col(i).to_array());
                }
            }
            EllipsoidRows { centre, axes, semi_axes_m }
        };
        all.chunks(WIDE).map(rows).collect()
    }
}

compiled_for_levels! {
    /// Computes the point of each ellipsoid that faces a source, as [`facing_point`](super::obstruction::facing_point)
    /// does.
    pub(super) fn facing_rows(of: &EllipsoidRows, source: Vector, out: &mut WideRow3) = facing_rows_body;
}

#[inline(always)]
fn facing_rows_body(of: &EllipsoidRows, source: Vector, out: &mut WideRow3) {
    for l in 0..WIDE {
        let (centre, semi_axes_m) = (wide_lane(&of.centre, l), wide_lane(&of.semi_axes_m, l));
        let [x, y, z] = [wide_lane(&of.axes[0], l), wide_lane(&of.axes[1], l), wide_lane(&of.axes[2], l)];
        let towards = subtract(source, centre);
        let unit = normalized(times([dot(x, towards), dot(y, towards), dot(z, towards)], semi_axes_m));
        let offset = times(unit, semi_axes_m);
        store(out, l, add(centre, add(add(scale(x, offset[0]), scale(y, offset[1])), scale(z, offset[2]))));
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::super::obstruction::facing_point;
    use super::*;
    use crate::lanes::tests::assert_same_at_every_level;
    use crate::people::motion::{MotionBuilder, Person};
    use radome_dsp::KernelLevel;

    #[test]
    fn lanes_face_the_source_as_single_segments_do() {
        let motion = MotionBuilder::new(Person::draw(3, [1, 0], 1.75), 0.0, [2.0, 1.0], 0.7).stay();
        let body = motion.body(0.4);
        let rows = EllipsoidRows::of(&body);
        for source in [DVec3::new(0.1, 0.2, 1.4), DVec3::new(-9.0, 4.0, 6.0), DVec3::new(2.5, 30.0, -1.0)] {
            let of_lanes = |level: KernelLevel| -> Vec<WideRow3> {
                let each = |row| {
                    let mut out = [[0.0; WIDE]; 3];
                    facing_rows(level, row, source.to_array(), &mut out);
                    out
                };
                rows.iter().map(each).collect()
            };
            assert_same_at_every_level(of_lanes);
            let found = of_lanes(KernelLevel::Portable);
            for (i, segment) in body.iter().enumerate() {
                let point = DVec3::from_array(wide_lane(&found[i / WIDE], i % WIDE));
                assert!(point.distance(facing_point(segment, source)) < 1e-12, "{i} {source}: {point}");
            }
        }
    }
}
