//! A box room as a lattice of image antennas.
//!
//! The image with index n lies at `n_i L_i + x_i` for even `n_i` and at `n_i L_i + L_i - x_i` for odd ones. A ray from an image
//! to a point of the room crosses the mirror planes in the order of its bounces; in the unfolded room its direction never
//! changes, and each crossing multiplies the field by `G_te te te^T - G_tm tm tm^T` (mirroring turns `te x s'` into
//! `-(te x s)`, hence the sign; both terms agree at normal incidence).
//!
//! Where walls let waves through, a point beyond an upright wall has the antenna's own field times the slab's transmission, in
//! place of the air that the slab displaces; images carry nothing there.

use std::sync::Arc;

use glam::{DMat3, DVec3};
use num_complex::Complex64;

use super::fresnel::Reflection;
use super::pattern::Pattern;
pub use super::wall::Wall;
use super::wall::WallTable;
use super::{Phasor3, incidence_frame};
use crate::actor::track::smooth_step;

/// Index of an image in the lattice; `[0, 0, 0]` is the antenna itself.
pub type ImageIndex = [i32; 3];

/// Number of reflections on the way from an image.
pub fn order(index: ImageIndex) -> u32 {
    index.iter().map(|n| n.unsigned_abs()).sum()
}

/// All images up to an order, the antenna itself first, then by order.
pub fn images(max_order: u32) -> Vec<ImageIndex> {
    let m = max_order as i32;
    let mut all: Vec<ImageIndex> = (-m..=m)
        .flat_map(|x| (-m..=m).flat_map(move |y| (-m..=m).map(move |z| [x, y, z])))
        .filter(|&index| order(index) <= max_order)
        .collect();
    all.sort_by_key(|&index| (order(index), index));
    all
}

/// The box `0..size` with its six surfaces.
#[derive(Debug, Clone, PartialEq)]
pub struct BoxRoom {
    /// Inner size, m.
    pub size_m: DVec3,
    /// Surfaces at low and high x, low and high y, floor, ceiling. Fields come from what [`BoxRoom::new`] tabulated of them.
    pub walls: [Wall; 6],
    /// Wave number at which materials are evaluated, 1/m.
    pub wavenumber_per_m: f64,
    /// Whether points behind the upright walls are lit through them. If not, points outside are lit as if there were no wall.
    pub transmission: bool,
    /// The walls' coefficients. Equal walls share them.
    tables: [Arc<WallTable>; 6],
}

/// One antenna element in the room.
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

/// What an (image) antenna does at a point: its field there but for `e^{-jkR}/R`.
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

impl BoxRoom {
    /// A room of a size, m, with its surfaces at low and high x, low and high y, floor, ceiling. Tabulates these at the wave
    /// number.
    pub fn new(size_m: DVec3, walls: [Wall; 6], wavenumber_per_m: f64, transmission: bool) -> Self {
        let mut all: Vec<Arc<WallTable>> = Vec::with_capacity(walls.len());
        for (i, wall) in walls.iter().enumerate() {
            let equal = walls.iter().take(i).position(|other| other == wall);
            let shared = equal.and_then(|equal| all.get(equal)).map(Arc::clone);
            all.push(shared.unwrap_or_else(|| Arc::new(WallTable::new(*wall, wavenumber_per_m, transmission))));
        }
        let tables = std::array::from_fn(|wall| Arc::clone(&all[wall]));
        BoxRoom { size_m, walls, wavenumber_per_m, transmission, tables }
    }

    /// Position of an image.
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

    /// A vector of the antenna as its image has it.
    pub fn image_vector(index: ImageIndex, v: DVec3) -> DVec3 {
        let sign = |n: i32| if n % 2 == 0 { 1.0 } else { -1.0 };
        v * DVec3::new(sign(index[0]), sign(index[1]), sign(index[2]))
    }

    /// The mirror planes between an image and a point of the room: (fraction of the way, axis, wall), in order.
    fn crossings(&self, index: ImageIndex, source: DVec3, point: DVec3) -> Vec<(f64, usize, usize)> {
        let mut all = Vec::with_capacity(order(index) as usize);
        let (from, to, size) = (source.to_array(), point.to_array(), self.size_m.to_array());
        for (axis, ((&n, length), (from, to))) in index.iter().zip(size).zip(from.into_iter().zip(to)).enumerate() {
            let planes = if n > 0 { 1..=n } else { n + 1..=0 };
            for plane in planes {
                let fraction = (f64::from(plane) * length - from) / (to - from);
                all.push((fraction, axis, 2 * axis + usize::from(plane % 2 != 0)));
            }
        }
        all.sort_by(|a, b| a.0.total_cmp(&b.0));
        all
    }

    /// Field of an element's image at a point of the room.
    pub fn illuminate(&self, element: &Element, index: ImageIndex, point: DVec3) -> Illumination {
        let source = self.image_position(index, element.position);
        let offset = point - source;
        let distance_m = offset.length().max(1e-6);
        let direction = offset / distance_m;
        let departure = element.radar_from_world * Self::image_vector(index, direction);
        let polarisation = Self::image_vector(index, element.polarisation);
        let transverse = polarisation - direction * direction.dot(polarisation);
        let mut field = Phasor3::real(transverse).scaled(element.pattern.field(departure));
        if order(index) > 0 {
            for (_, axis, wall) in self.crossings(index, source, point) {
                let normal = DVec3::AXES[axis];
                let reflection = self.tables[wall].reflection(direction.dot(normal).abs());
                let (te, tm) = incidence_frame(direction, normal);
                field = Phasor3::combine(reflection.te * field.along(te), te, -reflection.tm * field.along(tm), tm);
            }
        }
        if self.transmission
            && let Some((axis, wall, weight)) = self.behind(element.position, point)
        {
            let rest = field.scaled(1.0 - weight);
            field = if order(index) > 0 {
                rest
            } else {
                let normal = DVec3::AXES[axis];
                let through = self.tables[wall].transmission(direction.dot(normal).abs());
                let (te, tm) = incidence_frame(direction, normal);
                let behind = Phasor3::combine(through.te * field.along(te), te, through.tm * field.along(tm), tm);
                Phasor3 { re: rest.re + behind.re * weight, im: rest.im + behind.im * weight }
            };
        }
        Illumination { source, distance_m, direction, field }
    }

    /// The upright wall through which the straight way from a point of the room to one outside leads: its axis, its number, and
    /// how much of it lies between, from 0 at its inner face to 1. `None` for a point in the room.
    fn behind(&self, from: DVec3, to: DVec3) -> Option<(usize, usize, f64)> {
        let (from, to, size) = (from.to_array(), to.to_array(), self.size_m.to_array());
        let crossed = [0, 1, 2, 3].map(|wall| {
            let axis = wall / 2;
            let plane = if wall % 2 == 0 { 0.0 } else { size[axis] };
            let beyond = if wall % 2 == 0 { -to[axis] } else { to[axis] - plane };
            (axis, wall, beyond, (plane - from[axis]) / (to[axis] - from[axis]))
        });
        // The room is convex: what leads out crosses the plane that it meets first within that wall itself.
        let out = crossed.into_iter().filter(|&(.., beyond, _)| beyond > 0.0);
        let (axis, wall, beyond, _) = out.min_by(|a, b| a.3.total_cmp(&b.3))?;
        let depth_m = self.walls[wall].depth_m();
        Some((axis, wall, smooth_step(2.0 * beyond / depth_m - 1.0)))
    }

    /// The way from an antenna to a point by an image, folded into the room: antenna, bounces, point.
    pub fn polyline(&self, index: ImageIndex, antenna: DVec3, point: DVec3) -> Vec<DVec3> {
        let source = self.image_position(index, antenna);
        let fold = |x: f64, length: f64| {
            let cell = (x / length).rem_euclid(2.0);
            length * if cell > 1.0 { 2.0 - cell } else { cell }
        };
        let mut points = vec![antenna];
        for (fraction, ..) in self.crossings(index, source, point) {
            let p = source.lerp(point, fraction);
            points.push(DVec3::new(fold(p.x, self.size_m.x), fold(p.y, self.size_m.y), fold(p.z, self.size_m.z)));
        }
        points.push(point);
        points
    }

    /// Amplitude of the way from a transmitter's image straight to a receiver, relative to the transmitted field and with
    /// isotropic antennas' aperture `lambda / 4 pi`, but for the propagation phase; and its length, m.
    pub fn direct(&self, tx: &Element, index: ImageIndex, rx: &Element) -> (Complex64, f64) {
        let arrival = self.illuminate(tx, index, rx.position);
        let towards_source = rx.radar_from_world * -arrival.direction;
        let gain = rx.pattern.field(towards_source);
        let aperture = 0.5 / (self.wavenumber_per_m * arrival.distance_m);
        (arrival.field.along(rx.polarisation) * (gain * aperture), arrival.distance_m)
    }
}
