//! Image antennas of a box room, in a lattice.
//!
//! The image with index n lies at `n_i L_i + x_i` for even `n_i` and at `n_i L_i + L_i - x_i` for odd ones. A ray from
//! an image to a point of the room crosses the mirror planes in the order of its bounces. In the unfolded room its
//! direction never changes. Each crossing multiplies the field by `G_te te te^T - G_tm tm tm^T`. The sign is negative
//! because mirroring turns `te x s'` into `-(te x s)`. Both terms agree at normal incidence.
//!
//! If walls transmit, the field at a point beyond an upright wall is the antenna's own field. It is multiplied by the
//! slab's transmission, relative to the air that the slab displaces. Images do not contribute there.

use std::sync::Arc;

use glam::{DMat3, DVec3};
use num_complex::Complex64;

use super::fresnel::Coefficients;
use super::pattern::Pattern;
pub use super::wall::Wall;
use super::wall::{WallTable, WallTables};
use super::{Phasor3, incidence_frame};
use crate::math::smooth_step;

/// Index of an image in the lattice; `[0, 0, 0]` is the antenna itself.
pub type ImageIndex = [i32; 3];

/// Returns the number of reflections on the path from an image.
pub fn order(index: ImageIndex) -> u32 {
    index.iter().map(|n| n.unsigned_abs()).sum()
}

/// Returns all images up to an order, the antenna itself first, then by order.
pub fn images(max_order: u32) -> Vec<ImageIndex> {
    let m = max_order as i32;
    let mut all: Vec<ImageIndex> = (-m..=m)
        .flat_map(|x| (-m..=m).flat_map(move |y| (-m..=m).map(move |z| [x, y, z])))
        .filter(|&index| order(index) <= max_order)
        .collect();
    all.sort_by_key(|&index| (order(index), index));
    all
}

/// Box room `0..size` with its six surfaces.
#[derive(Debug, Clone, PartialEq)]
pub struct BoxRoom {
    /// Inner size, m.
    pub size_m: DVec3,
    /// Surfaces at low and high x, low and high y, floor, ceiling. Fields use the tables that [`BoxRoom::new`] made of
    /// them.
    pub walls: [Wall; 6],
    /// Wave number at which materials are evaluated, 1/m.
    pub wavenumber_per_m: f64,
    /// Whether fields reach points behind the upright walls through them. If not, the field outside is computed as if
    /// there were no wall. Open walls pass it in any case.
    pub transmission: bool,
    /// Tabulated coefficients of the walls; equal walls share them.
    tables: [Arc<WallTable>; 6],
}

/// Antenna element in the room.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Element {
    /// Position in the room, m.
    pub position: DVec3,
    /// Polarisation, unit vector in the room.
    pub polarisation: DVec3,
    /// Rotation from room to radar axes.
    pub radar_from_world: DMat3,
    /// One-way field pattern.
    pub pattern: Pattern,
}

/// Field of an (image) antenna at a point, without `e^{-jkR}/R`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Illumination {
    /// Position of the image, m.
    pub source: DVec3,
    /// Distance from image to point, m.
    pub distance_m: f64,
    /// Unit vector from image to point, in the room.
    pub direction: DVec3,
    /// Polarisation times pattern times reflection coefficients.
    pub field: Phasor3,
}

impl Illumination {
    /// Returns the amplitude at a receiver at the point, relative to the transmitted field, without the propagation
    /// phase. It includes the aperture `lambda / 4 pi` of isotropic antennas.
    pub fn received(&self, rx: &Element, wavenumber_per_m: f64) -> Complex64 {
        let gain = rx.pattern.field(rx.radar_from_world * -self.direction);
        let aperture = 0.5 / (wavenumber_per_m * self.distance_m);
        self.field.along(rx.polarisation) * (gain * aperture)
    }
}

/// Converts a coordinate in a cell of the lattice to a coordinate in the room.
fn folded_coordinate(x: f64, length: f64, cell: i32) -> f64 {
    let in_cell = x - f64::from(cell) * length;
    if cell % 2 == 0 { in_cell } else { length - in_cell }
}

/// Mirror plane between an image and a point of the room.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Crossing {
    /// Fraction of the path from the image.
    fraction: f64,
    axis: usize,
    wall: usize,
}

/// Mirror planes across one axis that have not been crossed.
#[derive(Debug, Clone, Copy)]
struct PlanesAhead {
    /// Number of the next plane in the lattice.
    next: i32,
    /// Number of planes ahead.
    count: u32,
    /// Step from one plane to the next, 1 or -1.
    step: i32,
    /// Fraction of the path to the next plane.
    fraction: f64,
    /// Coordinate of the image along the axis, m.
    from_m: f64,
    /// Extent of the path along the axis, m.
    span_m: f64,
    /// Size of the room along the axis, m.
    room_m: f64,
}

/// Wall through which a path leaves the room.
struct Exit {
    /// Axis across which the wall lies.
    axis: usize,
    wall: usize,
    /// Part of the wall's effect, from 0 at its inner face to 1.
    weight: f64,
}

/// Mirror planes between an image and a point of the room, in the order in which the path crosses them. Those across
/// one axis are crossed one after another, so the next of all is the nearest of three.
struct Crossings([PlanesAhead; 3]);

impl Crossings {
    fn new(index: ImageIndex, source: DVec3, point: DVec3, size_m: DVec3) -> Self {
        Crossings(std::array::from_fn(|axis| {
            let n = index[axis];
            // Descending from above to plane 1, the high wall; ascending from below to plane 0, the low wall.
            let (next, step) = if n > 0 { (n, -1) } else { (n + 1, 1) };
            let (from_m, span_m, room_m) = (source[axis], point[axis] - source[axis], size_m[axis]);
            let mut planes = PlanesAhead { next, count: n.unsigned_abs(), step, fraction: 0.0, from_m, span_m, room_m };
            planes.update_fraction();
            planes
        }))
    }
}

impl PlanesAhead {
    /// Computes the fraction of the path to the next plane.
    fn update_fraction(&mut self) {
        if self.count > 0 {
            self.fraction = (f64::from(self.next) * self.room_m - self.from_m) / self.span_m;
        }
    }
}

impl Iterator for Crossings {
    type Item = Crossing;

    fn next(&mut self) -> Option<Crossing> {
        let ahead = self.0.iter_mut().enumerate().filter(|(_, planes)| planes.count > 0);
        let (axis, planes) = ahead.min_by(|(_, a), (_, b)| a.fraction.total_cmp(&b.fraction))?;
        let wall = 2 * axis + usize::from(planes.next % 2 != 0);
        let crossing = Crossing { fraction: planes.fraction, axis, wall };
        planes.next += planes.step;
        planes.count -= 1;
        planes.update_fraction();
        Some(crossing)
    }
}

/// Multiplies a field by the reflection at a mirror plane of the unfolded room: `G_te te te^T - G_tm tm tm^T`. The
/// field is transverse, so its part that is not TE is TM.
#[inline(always)]
fn reflected(field: Phasor3, direction: DVec3, axis: usize, reflection: Coefficients) -> Phasor3 {
    let across = direction.cross(DVec3::AXES[axis]);
    let square = across.length_squared();
    let all_as_tm = field.times(-reflection.tm);
    // TE and TM coincide at normal incidence.
    if square < 1e-12 {
        return all_as_tm;
    }
    let te_excess = (reflection.te + reflection.tm) * (field.along(across) / square);
    Phasor3 { re: all_as_tm.re + across * te_excess.re, im: all_as_tm.im + across * te_excess.im }
}

impl BoxRoom {
    /// Builds a room of a size, m, with its smooth surfaces at low and high x, low and high y, floor, ceiling.
    /// Tabulates their coefficients at the wave number.
    pub fn new(size_m: DVec3, walls: [Wall; 6], wavenumber_per_m: f64, transmission: bool) -> Self {
        Self::with_diffuse_share(size_m, walls, wavenumber_per_m, transmission, 0.0)
    }

    /// Builds a room whose surfaces scatter a share of the incident power in all directions.
    pub fn with_diffuse_share(
        size_m: DVec3,
        walls: [Wall; 6],
        wavenumber_per_m: f64,
        transmission: bool,
        diffuse_share: f64,
    ) -> Self {
        let mut tables = WallTables::new(wavenumber_per_m, transmission, diffuse_share);
        BoxRoom { size_m, walls, wavenumber_per_m, transmission, tables: walls.map(|wall| tables.of(wall)) }
    }

    /// Returns the position of an image.
    pub fn image_position(&self, index: ImageIndex, point: DVec3) -> DVec3 {
        let axis = |n: i32, length: f64, x: f64| {
            if n % 2 == 0 { f64::from(n) * length + x } else { f64::from(n) * length + length - x }
        };
        DVec3::new(
            axis(index[0], self.size_m.x, point.x),
            axis(index[1], self.size_m.y, point.y),
            axis(index[2], self.size_m.z, point.z),
        )
    }

    /// Returns a vector of the antenna, mirrored as in its image.
    pub fn image_vector(index: ImageIndex, v: DVec3) -> DVec3 {
        let sign = |n: i32| if n % 2 == 0 { 1.0 } else { -1.0 };
        v * DVec3::new(sign(index[0]), sign(index[1]), sign(index[2]))
    }

    /// Computes the field of an element's image at a point of the room.
    pub fn illuminate(&self, element: &Element, index: ImageIndex, point: DVec3) -> Illumination {
        let source = self.image_position(index, element.position);
        let offset = point - source;
        let distance_m = offset.length().max(1e-6);
        let direction = offset / distance_m;
        let departure = element.radar_from_world * Self::image_vector(index, direction);
        let polarisation = Self::image_vector(index, element.polarisation);
        let transverse = polarisation - direction * direction.dot(polarisation);
        let field = Phasor3::real(transverse * element.pattern.field(departure));
        let field = self.propagated(element.position, index, source, direction, point, field);
        Illumination { source, distance_m, direction, field }
    }

    /// Propagates a field from an image of `antenna` at `source` to a point: past all mirror planes on the path, and
    /// through the wall if the point lies outside.
    #[inline(always)]
    pub(crate) fn propagated(
        &self,
        antenna: DVec3,
        index: ImageIndex,
        source: DVec3,
        direction: DVec3,
        point: DVec3,
        field: Phasor3,
    ) -> Phasor3 {
        let field = self.past_planes(index, source, direction, point, field);
        let exit = self.exit(antenna, point).filter(|exit| self.is_passable(exit.wall));
        let Some(Exit { axis, wall, weight }) = exit else { return field };
        if order(index) > 0 {
            return field.scaled(1.0 - weight);
        }
        if self.walls[wall] == Wall::Open {
            return field;
        }
        let before = field.scaled(1.0 - weight);
        let normal = DVec3::AXES[axis];
        let through = self.tables[wall].transmission(direction.dot(normal).abs());
        let (te, tm) = incidence_frame(direction, normal);
        let behind = Phasor3::combine(through.te * field.along(te), te, through.tm * field.along(tm), tm);
        Phasor3 { re: before.re + behind.re * weight, im: before.im + behind.im * weight }
    }

    /// Returns whether fields reach points behind a wall.
    fn is_passable(&self, wall: usize) -> bool {
        self.transmission || self.walls[wall] == Wall::Open
    }

    /// Returns the depth of a point behind upright walls that hide it from an antenna in the room, m. It is negative
    /// behind such a wall. It is infinite in the room, and where the straight path leaves through an open wall or one
    /// that transmits. A person beside the box is then seen through that wall, even beyond the plane of a neighbouring
    /// one.
    pub(crate) fn depth_within_m(&self, antenna: DVec3, point: DVec3) -> f64 {
        let is_hidden = self.exit(antenna, point).is_some_and(|exit| !self.is_passable(exit.wall));
        if !is_hidden {
            return f64::INFINITY;
        }
        let depths_m = [point.x, self.size_m.x - point.x, point.y, self.size_m.y - point.y];
        (0..4).filter(|&wall| !self.is_passable(wall)).map(|wall| depths_m[wall]).fold(f64::INFINITY, f64::min)
    }

    /// Propagates a field past all mirror planes between an image and a point of the room.
    #[inline(always)]
    fn past_planes(
        &self,
        index: ImageIndex,
        source: DVec3,
        direction: DVec3,
        point: DVec3,
        mut field: Phasor3,
    ) -> Phasor3 {
        let [x, y, z] = index;
        // Planes across a single axis are crossed in a fixed order, wherever the point is.
        let only_axis: Option<usize> = match (x != 0, y != 0, z != 0) {
            (false, false, false) => return field,
            (true, false, false) => Some(0),
            (false, true, false) => Some(1),
            (false, false, true) => Some(2),
            _ => None,
        };
        if let Some(axis) = only_axis {
            let (n, cosine) = (index[axis], direction[axis].abs());
            let (first, step) = if n > 0 { (n, -1) } else { (n + 1, 1) };
            for crossed in 0..n.abs() {
                let wall = 2 * axis + usize::from((first + crossed * step) % 2 != 0);
                field = reflected(field, direction, axis, self.tables[wall].reflection(cosine));
            }
            return field;
        }
        for Crossing { axis, wall, .. } in Crossings::new(index, source, point, self.size_m) {
            field = reflected(field, direction, axis, self.tables[wall].reflection(direction[axis].abs()));
        }
        field
    }

    /// Returns an upper bound of the magnitude of an image's field at all points within an angle of a direction from
    /// it.
    pub fn most_field(&self, element: &Element, index: ImageIndex, direction: DVec3, spread_rad: f64) -> f64 {
        let departure = element.radar_from_world * Self::image_vector(index, direction);
        let mut most = element.pattern.most_within(departure, spread_rad);
        let is_across_one_axis = index.iter().filter(|&&n| n != 0).count() == 1;
        for (axis, &n) in index.iter().enumerate().filter(|(_, n)| **n != 0) {
            let [te, tm] = self.most_reflections(axis, n, direction[axis].abs(), spread_rad);
            let either = te.max(tm);
            if !is_across_one_axis {
                most *= either;
                continue;
            }
            // Least and largest part of the antenna's field that is TE; the rest is TM.
            let across = direction.cross(DVec3::AXES[axis]);
            let (along, sine) = (Self::image_vector(index, element.polarisation).dot(across).abs(), across.length());
            let least_te = ((along - spread_rad) / (sine + spread_rad).max(1e-9)).max(0.0);
            let most_te = if sine > spread_rad { ((along + spread_rad) / (sine - spread_rad)).min(1.0) } else { 1.0 };
            let power = (te * most_te).powi(2) + tm * tm * (1.0 - least_te * least_te).max(0.0);
            most *= power.sqrt().min(either);
        }
        most
    }

    /// Returns upper bounds of the product of reflections, TE and TM, at all planes across an axis. The cosine of
    /// incidence differs from the given one by at most `spread`.
    fn most_reflections(&self, axis: usize, n: i32, cosine: f64, spread: f64) -> [f64; 2] {
        let most = |wall: usize| self.tables[wall].most_reflection(cosine - spread, cosine + spread);
        let (low, high) = (most(2 * axis), most(2 * axis + 1));
        // Planes alternate; the first beyond the room is the wall on the image's side.
        let count = n.abs();
        let (more, fewer) = ((count + 1) / 2, count / 2);
        let (at_low, at_high) = if n > 0 { (fewer, more) } else { (more, fewer) };
        std::array::from_fn(|part| low[part].powi(at_low) * high[part].powi(at_high))
    }

    /// Returns whether no image but the antenna itself contributes to the field anywhere in a box with these
    /// half-widths, because it lies behind upright walls that transmit or are open.
    pub(crate) fn is_behind_walls(&self, centre: DVec3, half_widths_m: DVec3) -> bool {
        let beyond_m = |wall: usize| {
            let axis = wall / 2;
            if wall.is_multiple_of(2) { -centre[axis] } else { centre[axis] - self.size_m[axis] }
        };
        let is_wholly_behind = |wall: usize| beyond_m(wall) - half_widths_m[wall / 2] >= self.walls[wall].depth_m();
        let is_wholly_before = |wall: usize| beyond_m(wall) + half_widths_m[wall / 2] <= 0.0;
        (0..4).any(is_wholly_behind)
            && (0..4).all(|wall| is_wholly_before(wall) || is_wholly_behind(wall) && self.is_passable(wall))
    }

    /// Returns the upright wall by which the straight path from a point of the room to an outside point leaves the
    /// room; `None` for a point in the room.
    fn exit(&self, from: DVec3, to: DVec3) -> Option<Exit> {
        let (from, to, size) = (from.to_array(), to.to_array(), self.size_m.to_array());
        // Nearly all points lie in the room.
        let is_outside = to[0] < 0.0 || to[0] > size[0] || to[1] < 0.0 || to[1] > size[1];
        if !is_outside {
            return None;
        }
        let planes = [0, 1, 2, 3].map(|wall| {
            let axis = wall / 2;
            let plane = if wall % 2 == 0 { 0.0 } else { size[axis] };
            let beyond_m = if wall % 2 == 0 { -to[axis] } else { to[axis] - plane };
            let fraction = (plane - from[axis]) / (to[axis] - from[axis]);
            (axis, wall, beyond_m, fraction)
        });
        // The room is convex, so the path leaves it through the first plane that it crosses.
        let crossed = planes.into_iter().filter(|&(.., beyond_m, _)| beyond_m > 0.0);
        let (axis, wall, beyond_m, _) =
            crossed.min_by(|(.., fraction), (.., other_fraction)| fraction.total_cmp(other_fraction))?;
        let depth_m = self.walls[wall].depth_m();
        Some(Exit { axis, wall, weight: smooth_step(2.0 * beyond_m / depth_m - 1.0) })
    }

    /// Returns the corners of the path from an antenna to a point by an image, folded into the room: antenna, bounces,
    /// point.
    pub fn polyline(&self, index: ImageIndex, antenna: DVec3, point: DVec3) -> Vec<DVec3> {
        let mut corners = Vec::with_capacity(order(index) as usize + 2);
        corners.push(antenna);
        self.each_leg(index, antenna, point, |_, _, to| corners.push(to));
        corners
    }

    /// Visits the legs of the path from an antenna to a point by an image, folded into the room. The visitor takes the
    /// index, the start and the end of each.
    pub(crate) fn each_leg(
        &self,
        index: ImageIndex,
        antenna: DVec3,
        point: DVec3,
        mut visit: impl FnMut(usize, DVec3, DVec3),
    ) {
        let size_m = self.size_m;
        let (mut from, mut leg) = (antenna, 0);
        if index != ImageIndex::default() {
            let source = self.image_position(index, antenna);
            // Current cell of the lattice: each crossing moves one cell nearer to the room.
            let mut cell = index;
            for Crossing { fraction, axis, .. } in Crossings::new(index, source, point, size_m) {
                let unfolded = source.lerp(point, fraction);
                let corner = DVec3::new(
                    folded_coordinate(unfolded.x, size_m.x, cell[0]),
                    folded_coordinate(unfolded.y, size_m.y, cell[1]),
                    folded_coordinate(unfolded.z, size_m.z, cell[2]),
                );
                cell[axis] -= cell[axis].signum();
                visit(leg, from, corner);
                (from, leg) = (corner, leg + 1);
            }
        }
        visit(leg, from, point);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const K: f64 = 1257.507;

    fn room() -> BoxRoom {
        let slab = |thickness_m| Wall::Slab { permittivity: Complex64::new(2.73, -0.119), thickness_m };
        let walls = [slab(0.0125), slab(0.2), Wall::Conductor, slab(0.03), slab(0.0125), Wall::Open];
        BoxRoom::new(DVec3::new(5.0, 4.0, 2.7), walls, K, false)
    }

    /// In boxes that lie behind walls, images leave no field; there are such boxes behind every upright wall.
    #[test]
    fn images_leave_nothing_behind_walls() {
        let passable = BoxRoom { transmission: true, ..room() };
        let mut walls = [Wall::Open; 6];
        walls[4] = passable.walls[4];
        let open = BoxRoom::new(passable.size_m, walls, K, false);
        let position = DVec3::new(0.4, 1.9, 1.2);
        let element = Element {
            position,
            polarisation: DVec3::Z,
            radar_from_world: DMat3::IDENTITY,
            pattern: Pattern::isotropic(),
        };
        for room in [passable, open] {
            let (half_widths_m, mut behind) = (DVec3::new(0.25, 0.1, 0.25), [0; 4]);
            for i in 0..40 {
                for j in 0..40 {
                    let centre = DVec3::new(-2.0 + 0.23 * f64::from(i), -2.0 + 0.2 * f64::from(j), 1.1);
                    if !room.is_behind_walls(centre, half_widths_m) {
                        continue;
                    }
                    let beyond = [centre.x < 0.0, centre.x > 5.0, centre.y < 0.0, centre.y > 4.0];
                    behind.iter_mut().zip(beyond).for_each(|(count, is_beyond)| *count += i32::from(is_beyond));
                    for side in [DVec3::ZERO, DVec3::X, DVec3::Y, -DVec3::X, -DVec3::Y, DVec3::new(1.0, -1.0, 0.1)] {
                        for index in images(2).into_iter().filter(|&index| order(index) > 0) {
                            let field = room.illuminate(&element, index, centre + side * half_widths_m).field;
                            assert_eq!(field.magnitude(), 0.0, "{centre} {side} {index:?}");
                        }
                    }
                }
            }
            assert!(behind.iter().all(|&count| count > 50), "{behind:?}");
            assert!(!room.is_behind_walls(position, half_widths_m));
        }
    }

    /// Returns all planes, sorted by their fractions.
    fn sorted_crossings(room: &BoxRoom, index: ImageIndex, source: DVec3, point: DVec3) -> Vec<Crossing> {
        let mut all = Vec::new();
        for (axis, &n) in index.iter().enumerate() {
            let planes = if n > 0 { 1..=n } else { n + 1..=0 };
            for plane in planes {
                let along = f64::from(plane) * room.size_m[axis] - source[axis];
                let fraction = along / (point[axis] - source[axis]);
                all.push(Crossing { fraction, axis, wall: 2 * axis + usize::from(plane % 2 != 0) });
            }
        }
        all.sort_by(|a, b| a.fraction.total_cmp(&b.fraction));
        all
    }

    /// For up to six reflections, planes and their order agree with a sorted list. The field agrees with the incidence
    /// frames and the slab applied one by one.
    #[test]
    fn the_field_of_an_image_is_that_of_each_reflection_in_turn() {
        let room = room();
        let element = Element {
            position: DVec3::new(0.3, 1.1, 1.4),
            polarisation: DVec3::new(0.0, 0.6, 0.8),
            radar_from_world: DMat3::from_rotation_z(-0.3),
            pattern: Pattern::new(1.0, 1.2, -15.0),
        };
        for index in images(6) {
            for point in [DVec3::new(3.2, 0.4, 0.9), DVec3::new(0.3, 3.7, 2.5), DVec3::new(4.9, 1.1, 1.4)] {
                let source = room.image_position(index, element.position);
                let all = sorted_crossings(&room, index, source, point);
                let ours: Vec<Crossing> = Crossings::new(index, source, point, room.size_m).collect();
                assert_eq!(ours, all, "{index:?}");
                let direction = (point - source).normalize();
                let polarisation = BoxRoom::image_vector(index, element.polarisation);
                let departure = element.radar_from_world * BoxRoom::image_vector(index, direction);
                let transverse = polarisation - direction * direction.dot(polarisation);
                let mut field = Phasor3::real(transverse * element.pattern.field(departure));
                for Crossing { axis, wall, .. } in all {
                    let normal = DVec3::AXES[axis];
                    let Coefficients { te, tm } = room.walls[wall].reflection(K, direction[axis].abs());
                    let (across, within) = incidence_frame(direction, normal);
                    field = Phasor3::combine(te * field.along(across), across, -tm * field.along(within), within);
                }
                let got = room.illuminate(&element, index, point).field;
                let error = Phasor3 { re: got.re - field.re, im: got.im - field.im }.magnitude();
                assert!(error < 1e-7, "{index:?} {point}: {error:e}");
            }
        }
    }

    #[test]
    fn bounds_of_a_cone_hold_in_it() {
        let room = room();
        let element = Element {
            position: DVec3::new(0.3, 1.1, 1.4),
            polarisation: DVec3::Z,
            radar_from_world: DMat3::from_rotation_z(-0.3),
            pattern: Pattern::new(0.6, 1.2, -15.0),
        };
        let mut close = 0;
        for index in images(3) {
            for middle in [DVec3::new(3.2, 0.6, 0.9), DVec3::new(0.9, 3.2, 1.4), DVec3::new(4.4, 1.1, 0.5)] {
                let offset = middle - room.image_position(index, element.position);
                for radius_m in [0.01, 0.1, 0.3] {
                    let spread_rad = (radius_m / offset.length()).asin();
                    let most = room.most_field(&element, index, offset.normalize(), spread_rad);
                    for i in 0..60 {
                        let (x, y) = (0.7 * f64::from(i), 1.9 * f64::from(i));
                        let on_ball = DVec3::new(x.cos() * y.cos(), x.sin() * y.cos(), y.sin()) * radius_m;
                        let field = room.illuminate(&element, index, middle + on_ball).field.magnitude();
                        assert!(field <= most + 1e-9, "{index:?} {middle} {radius_m}: {field} {most}");
                        close += usize::from(radius_m == 0.01 && field > 0.7 * most);
                    }
                }
            }
        }
        assert!(close > 0);
    }

    /// Bounces lie on the crossed walls, within the room, and the folded path is as long as the unfolded one.
    #[test]
    fn corners_lie_on_the_walls_of_the_room() {
        let room = room();
        let (antenna, point) = (DVec3::new(0.3, 1.1, 1.4), DVec3::new(3.2, 0.4, 0.9));
        for index in images(6) {
            let corners = room.polyline(index, antenna, point);
            assert_eq!(corners.len(), order(index) as usize + 2);
            let source = room.image_position(index, antenna);
            let length_m: f64 = corners.windows(2).map(|leg| leg[0].distance(leg[1])).sum();
            assert!((length_m - source.distance(point)).abs() < 1e-9, "{index:?}");
            for (corner, Crossing { axis, wall, .. }) in
                corners[1..].iter().zip(Crossings::new(index, source, point, room.size_m))
            {
                let plane = if wall % 2 == 0 { 0.0 } else { room.size_m[axis] };
                assert!((corner[axis] - plane).abs() < 1e-9, "{index:?}");
                let within = corner.cmpge(DVec3::splat(-1e-9)).all() && corner.cmple(room.size_m + 1e-9).all();
                assert!(within, "{index:?}: {corner}");
            }
        }
    }
}
