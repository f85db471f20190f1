//! Diffusely scattering points of walls, and the random walks from wall to wall that end at them.

use std::f64::consts::{PI, TAU};

use glam::DVec3;
use num_complex::Complex64;
use rand::Rng;
use rand::seq::SliceRandom;

use super::{GOLDEN, LEAST_LEG_M};
use crate::em::fresnel::Coefficients;
use crate::em::image::{BoxRoom, Element, Wall};
use crate::random::{Purpose, generator};
use crate::tracks::RECEIVERS;

/// Diffuse reflection of a room's walls.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Diffuse {
    /// Share of the incident power that a wall scatters.
    pub share: f64,
    /// Number of points.
    pub points: usize,
    /// Largest number of walls on a walk from an antenna to a point, including its own.
    pub bounces: u32,
    /// Number of walls up to which image antennas represent specular reflection at each wall.
    pub mirrored: u32,
}

/// Paths from a point to the transmitter and to each receiver.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AntennaPaths {
    /// Mean of the lengths to the transmitter and to the first receiver, m.
    pub(crate) length_m: f64,
    /// Field by the path to the transmitter, with the phase of its length beyond the mean, as it multiplies `exp(+j 2
    /// pi ...)` of the mean.
    pub(crate) tx: Complex64,
    /// Field by the path to each receiver.
    pub(crate) rx: [Complex64; RECEIVERS],
    /// Magnitudes of the fields by the paths to the transmitter and to the first receiver.
    pub(crate) magnitudes: [f64; 2],
}

impl AntennaPaths {
    /// Joins the paths to all antennas, each with its length, m, and its field.
    pub(crate) fn new(tx: (f64, f64), rx: &[(f64, f64)], wavelength_m: f64) -> Self {
        let length_m = rx.first().map_or(tx.0, |first| 0.5 * (tx.0 + first.0));
        let field = |path: (f64, f64)| Complex64::from_polar(path.1, TAU * (path.0 - length_m) / wavelength_m);
        let mut fields = [Complex64::ZERO; RECEIVERS];
        fields.iter_mut().zip(rx).for_each(|(own, path)| *own = field(*path));
        AntennaPaths {
            length_m,
            tx: field(tx),
            rx: fields,
            magnitudes: [tx.1, rx.first().map_or(0.0, |first| first.1)],
        }
    }

    /// Returns the field at each receiver by way of two points: from the transmitter over this one to the other, and in
    /// the opposite direction.
    pub(crate) fn both_ways(&self, other: &AntennaPaths) -> [Complex64; RECEIVERS] {
        std::array::from_fn(|receiver| self.tx * other.rx[receiver] + other.tx * self.rx[receiver])
    }

    /// Returns the field at the first receiver by way of two points, in the direction in which it is stronger.
    pub(crate) fn stronger_field(&self, other: &AntennaPaths) -> f64 {
        let ([tx, rx], [other_tx, other_rx]) = (self.magnitudes, other.magnitudes);
        (tx * other_rx).max(other_tx * rx)
    }
}

/// Scattering point of a wall.
#[derive(Debug, Clone, PartialEq)]
pub struct WallPoint {
    pub(crate) position: DVec3,
    /// Unit normal into the room.
    pub(crate) normal: DVec3,
    /// Paths to the antennas, over any walls. The fields are those scattered for a unit field, times m, without the
    /// cosine of departure, and with the point's random phase.
    pub(crate) antennas: AntennaPaths,
    /// Index of the other point of a path over two points. Only one point of each pair has it.
    pub(crate) partner: Option<usize>,
}

/// Point on a wall.
#[derive(Clone, Copy)]
pub(super) struct WallPosition {
    pub(super) wall: usize,
    pub(super) position: DVec3,
    pub(super) normal: DVec3,
}

/// Walls that scatter incident power in all directions.
pub(super) trait Walls {
    /// Returns the total area, m^2.
    fn area_m2(&self) -> f64;

    /// Returns a point on the wall that contains the cumulative area `at_m2`, m^2, drawn at random where the area
    /// leaves a choice.
    fn point_at(&self, at_m2: f64, rng: &mut impl Rng) -> WallPosition;

    /// Returns the share of the incident power that a wall would reflect if it were smooth; `None` where there is no
    /// wall.
    fn reflected_share(&self, wall: usize, cosine: f64) -> Option<f64>;

    /// Returns the point at which a ray from a wall meets another one; `None` where it leaves the room.
    fn next_hit(&self, from: &WallPosition, direction: DVec3) -> Option<WallPosition>;

    /// Returns the part of an antenna's field that reaches a position directly.
    fn visibility(&self, antenna: DVec3, point: &WallPosition) -> f64;
}

impl Walls for BoxRoom {
    fn area_m2(&self) -> f64 {
        (0..6).map(|wall| side_m2(self, wall)).sum()
    }

    fn point_at(&self, mut at_m2: f64, rng: &mut impl Rng) -> WallPosition {
        let wall = (0..5).find(|wall| {
            let contains_area = at_m2 < side_m2(self, *wall);
            at_m2 -= if contains_area { 0.0 } else { side_m2(self, *wall) };
            contains_area
        });
        let (wall, size) = (wall.unwrap_or(5), self.size_m.to_array());
        let mut position = [0, 1, 2].map(|axis| size[axis] * rng.random::<f64>());
        position[wall / 2] = if wall % 2 == 0 { 0.0 } else { size[wall / 2] };
        WallPosition::new(wall, DVec3::from_array(position))
    }

    fn reflected_share(&self, wall: usize, cosine: f64) -> Option<f64> {
        let wall = self.walls.get(wall).filter(|wall| **wall != Wall::Open)?;
        Some(mean_power(wall.reflection(self.wavenumber_per_m, cosine)))
    }

    fn next_hit(&self, from: &WallPosition, direction: DVec3) -> Option<WallPosition> {
        let (mut nearest_m, mut wall) = (f64::INFINITY, from.wall ^ 1);
        for axis in (0..3).filter(|&axis| direction[axis] != 0.0) {
            let is_high = direction[axis] > 0.0;
            let to = if is_high { self.size_m[axis] } else { 0.0 };
            let distance_m = (to - from.position[axis]) / direction[axis];
            let hit = 2 * axis + usize::from(is_high);
            if hit != from.wall && distance_m < nearest_m {
                (nearest_m, wall) = (distance_m, hit);
            }
        }
        Some(WallPosition::new(wall, (from.position + nearest_m * direction).clamp(DVec3::ZERO, self.size_m)))
    }

    fn visibility(&self, _: DVec3, _: &WallPosition) -> f64 {
        1.0
    }
}

/// Returns the area of a side of a box, m^2; zero where there is no wall.
fn side_m2(room: &BoxRoom, wall: usize) -> f64 {
    let size = room.size_m.to_array();
    match room.walls.get(wall) {
        Some(Wall::Open) | None => 0.0,
        Some(_) => (0..3).filter(|axis| *axis != wall / 2).map(|axis| size[axis]).product(),
    }
}

/// Returns the reflected power, averaged over both polarisations.
pub(super) fn mean_power(reflection: Coefficients) -> f64 {
    0.5 * (reflection.te.norm_sqr() + reflection.tm.norm_sqr())
}

impl WallPosition {
    fn new(wall: usize, position: DVec3) -> Self {
        let normal = DVec3::AXES[wall / 2] * if wall.is_multiple_of(2) { 1.0 } else { -1.0 };
        WallPosition { wall, position, normal }
    }

    /// Draws the next point of a ray that leaves this one by Lambert's law. Also returns the cosine of incidence there.
    fn scattered(&self, walls: &impl Walls, rng: &mut impl Rng) -> Option<(Self, f64)> {
        // A point of the unit sphere around the tip of the normal gives Lambert's law.
        let z: f64 = rng.random_range(-1.0..1.0);
        let (sin, cos) = rng.random_range(0.0..TAU).sin_cos();
        let ring = (1.0 - z * z).max(0.0).sqrt();
        let towards = self.normal + DVec3::new(ring * cos, ring * sin, z);
        let direction = towards.try_normalize().unwrap_or(self.normal);
        let hit = walls.next_hit(self, direction)?;
        Some((hit, -direction.dot(hit.normal)))
    }
}

/// Returns the number of walls of a walk, at most `max`, and its statistical weight: half of the walks meet one wall, a
/// quarter two, and so on. `draw` is 0 to 1.
fn bounces(draw: f64, max: u32) -> (u32, f64) {
    let count = (1..max).find(|&n| draw < 1.0 - 0.5f64.powi(n as i32)).unwrap_or(max.max(1));
    (count, 2f64.powi(count.min(max.saturating_sub(1)) as i32))
}

/// Generates the scattering points of walls.
pub(super) fn points(
    walls: &impl Walls,
    diffuse: Diffuse,
    tx: &Element,
    rx: &[Element],
    wavelength_m: f64,
    seed: u64,
) -> Vec<WallPoint> {
    let Diffuse { share, points: count, .. } = diffuse;
    let area_m2 = walls.area_m2();
    if !(share > 0.0 && area_m2 > 0.0) {
        return Vec::new();
    }
    let mut rng = generator(seed, Purpose::WallPoints, [0, 0]);
    let mut points = Vec::with_capacity(count);
    for index in 0..count {
        // One point in each of `count` equal parts of the walls.
        let at_m2 = (index as f64 + rng.random::<f64>()) / count as f64 * area_m2;
        let first = walls.point_at(at_m2, &mut rng);
        let phase = Complex64::from_polar(1.0, rng.random_range(0.0..TAU));
        let walk = Walk::from(first, walls, diffuse, tx.position, index, seed);
        // Lambert's law: a power density S on dA scatters `share S dA cos_in cos_out / (pi r^2)`.
        let leg = |element: &Element| {
            let offset = first.position - element.position;
            let distance_m = offset.length();
            let direction = offset / distance_m.max(1e-9);
            let cosine = (-direction.dot(first.normal)).max(0.0);
            let gain = element.pattern.field(element.radar_from_world * direction);
            let scattered = (walk.power * area_m2 / count as f64 * cosine / PI).sqrt() / distance_m.max(LEAST_LEG_M);
            (distance_m + walk.length_m, gain * scattered * walls.visibility(element.position, &first))
        };
        let WallPosition { position, normal, .. } = walk.end;
        let to_receivers: Vec<(f64, f64)> = rx.iter().map(leg).collect();
        let mut antennas = AntennaPaths::new(leg(tx), &to_receivers, wavelength_m);
        antennas.tx *= phase;
        antennas.rx.iter_mut().for_each(|field| *field *= phase);
        points.push(WallPoint { position, normal, antennas, partner: None });
    }
    // Random pairs; of an odd number, the last point is its own partner.
    let mut order: Vec<usize> = (0..count).collect();
    order.shuffle(&mut rng);
    for pair in order.chunks(2) {
        if let Some(point) = pair.first().and_then(|&first| points.get_mut(first)) {
            point.partner = pair.last().copied();
        }
    }
    points
}

/// Result of a walk from wall to wall.
struct Walk {
    end: WallPosition,
    /// Length from the first wall on, m.
    length_m: f64,
    /// Share of the power on the first wall that the last one scatters in all directions, times the statistical weight
    /// of the walk.
    power: f64,
}

impl Walk {
    fn from(first: WallPosition, walls: &impl Walls, diffuse: Diffuse, from: DVec3, index: usize, seed: u64) -> Self {
        let mut rng = generator(seed, Purpose::WallWalks, [index as u64, 0]);
        // Multiples of the golden ratio distribute the walks of each number of walls over the whole room.
        let draw = (index as f64 + 0.5) * GOLDEN;
        let (count, weight) = bounces(draw.fract(), diffuse.bounces);
        // Scattered power is not available for specular reflection.
        let mirrored_at = |point: &WallPosition, cosine: f64| {
            Some(walls.reflected_share(point.wall, cosine.clamp(1e-3, 1.0))? * (1.0 - diffuse.share))
        };
        let cosine = (from - first.position).normalize_or_zero().dot(first.normal);
        let (mut end, mut length_m) = (first, 0.0);
        // Shares of the power on the first wall: reflected specularly at every wall, and leaving it in any way.
        let mut mirrored = mirrored_at(&first, cosine).unwrap_or(0.0);
        let mut all = mirrored + diffuse.share;
        for _ in 1..count {
            let Some((next, cosine)) = end.scattered(walls, &mut rng) else {
                (mirrored, all) = (0.0, 0.0);
                break;
            };
            length_m += next.position.distance(end.position);
            end = next;
            // Power that reaches an opening is lost.
            let share = mirrored_at(&end, cosine);
            mirrored *= share.unwrap_or(0.0);
            all *= share.map_or(0.0, |share| share + diffuse.share);
        }
        let by_images = if count <= diffuse.mirrored { mirrored } else { 0.0 };
        Walk { end, length_m, power: weight * (all - by_images) }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::em::pattern::Pattern;

    /// Box of metal with an open side, and an antenna in it.
    pub(in crate::diffuse) fn room() -> (BoxRoom, Element) {
        let walls = [Wall::Conductor, Wall::Conductor, Wall::Conductor, Wall::Open, Wall::Conductor, Wall::Conductor];
        let antenna = Element {
            position: DVec3::new(1.0, 1.5, 1.2),
            polarisation: DVec3::Z,
            radar_from_world: glam::DMat3::IDENTITY,
            pattern: Pattern::new(1.1, 0.9, -15.0),
        };
        (BoxRoom::new(DVec3::new(5.0, 4.0, 2.6), walls, 1257.0, false), antenna)
    }

    /// The mean power at a point over the scattering points equals the integral over all pieces of the walls.
    #[test]
    fn points_scatter_as_walls_do() {
        let (room, antenna) = room();
        let (share, receiver) = (0.1, DVec3::new(3.2, 2.1, 1.0));
        let density = |position: DVec3, normal: DVec3, area_m2: f64| {
            let (first, second) = (position - antenna.position, receiver - position);
            let cosines = (-first.normalize().dot(normal)).max(0.0) * second.normalize().dot(normal).max(0.0);
            let gain = antenna.pattern.field(first.normalize()).powi(2);
            share * gain * area_m2 * cosines / (PI * first.length_squared() * second.length_squared())
        };
        let mut exact = 0.0;
        const CUTS: usize = 160;
        for wall in [0, 1, 2, 4, 5usize] {
            let (axis, size) = (wall / 2, room.size_m.to_array());
            let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
            let area_m2 = size[u] * size[v] / (CUTS * CUTS) as f64;
            for i in 0..CUTS * CUTS {
                let mut position = [0.0; 3];
                position[axis] = if wall % 2 == 0 { 0.0 } else { size[axis] };
                position[u] = size[u] * ((i % CUTS) as f64 + 0.5) / CUTS as f64;
                position[v] = size[v] * ((i / CUTS) as f64 + 0.5) / CUTS as f64;
                let normal = DVec3::AXES[axis] * if wall % 2 == 0 { 1.0 } else { -1.0 };
                exact += density(DVec3::from_array(position), normal, area_m2);
            }
        }
        const SEEDS: u64 = 3000;
        let drawn: f64 = (0..SEEDS)
            .flat_map(|seed| points(&room, one_wall(share), &antenna, &[], 0.005, seed))
            .map(|point| {
                let leg = receiver - point.position;
                point.antennas.tx.norm_sqr() * leg.normalize().dot(point.normal).max(0.0) / leg.length_squared()
            })
            .sum();
        let ratio = drawn / SEEDS as f64 / exact;
        assert!((ratio - 1.0).abs() < 0.03, "{ratio}");
        assert!(points(&room, one_wall(0.0), &antenna, &[antenna], 0.005, 1).is_empty());
    }

    fn one_wall(share: f64) -> Diffuse {
        Diffuse { share, points: 32, bounces: 1, mirrored: 2 }
    }

    fn walks(diffuse: Diffuse, walls: [Wall; 6]) -> (BoxRoom, Vec<Walk>) {
        let room = BoxRoom::new(DVec3::new(6.0, 3.5, 2.5), walls, 1257.0, false);
        let from = DVec3::new(0.3, 1.6, 1.5);
        // A Lambertian walk is uniform over the walls, so it may start anywhere.
        let mut rng = generator(7, Purpose::WallPoints, [0, 0]);
        let begin = |index: usize| {
            let on_floor = DVec3::new(rng.random_range(0.0..6.0), rng.random_range(0.0..3.5), 0.0);
            let mut point = WallPosition::new(4, on_floor);
            for _ in 0..8 {
                point = point.scattered(&room, &mut rng).expect("a wall").0;
            }
            Walk::from(point, &room, diffuse, from, index, 7)
        };
        let walks = (0..20_000).map(begin).collect();
        (room, walks)
    }

    /// The mean free path between two walls is 4 V / S, whatever the room's shape (Kosten, Acustica 10, 1960), for a
    /// diffuse field.
    #[test]
    fn walls_are_a_mean_free_path_apart() {
        let diffuse = Diffuse { share: 0.1, points: 1, bounces: 2, mirrored: 2 };
        let (room, walks) = walks(diffuse, [Wall::Conductor; 6]);
        let second: Vec<f64> = walks.iter().map(|walk| walk.length_m).filter(|length_m| *length_m > 0.0).collect();
        let mean = second.iter().sum::<f64>() / second.len() as f64;
        let DVec3 { x, y, z } = room.size_m;
        let exact = 4.0 * x * y * z / (2.0 * (x * y + y * z + z * x));
        assert!((second.len() as f64 / walks.len() as f64 - 0.5).abs() < 0.001);
        assert!((mean / exact - 1.0).abs() < 0.02, "{mean} {exact}");
    }

    /// Conductors are lossless: over any number of walls all power remains, minus the part of the images; openings
    /// leave no power.
    #[test]
    fn walks_carry_the_power_that_images_do_not() {
        let mean = |diffuse, walls| {
            let (_, walks) = walks(diffuse, walls);
            walks.iter().map(|walk| walk.power).sum::<f64>() / walks.len() as f64
        };
        let diffuse = Diffuse { share: 0.1, points: 1, bounces: 6, mirrored: 0 };
        let none = mean(diffuse, [Wall::Conductor; 6]);
        assert!((none / 6.0 - 1.0).abs() < 0.01, "{none}");
        let two = mean(Diffuse { mirrored: 2, ..diffuse }, [Wall::Conductor; 6]);
        assert!((two / (0.1 + (1.0 - 0.9 * 0.9) + 4.0) - 1.0).abs() < 0.01, "{two}");
        let open = mean(diffuse, [Wall::Open; 6]);
        assert!((open / 0.1 - 1.0).abs() < 0.01, "{open}");
        let one = mean(Diffuse { bounces: 1, mirrored: 2, ..diffuse }, [Wall::Conductor; 6]);
        assert!((one - 0.1).abs() < 1e-12, "{one}");
    }
}
