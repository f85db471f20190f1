//! Fields by way of images: the path is unfolded, checked against polygons and obstacles, and its reflections multiplied.
//!
//! As in [`crate::field::image`] the field is followed in the image's frame, where the direction never changes: each reflection
//! multiplies it by `G_te te te^T - G_tm tm tm^T`, with the facet's normal as the later facets mirror it.

use glam::{DMat3, DVec3};
use num_complex::Complex64;

use super::discovery::{Image, ImagePaths, MAX_ORDER};
use super::edge_field::side_from_foot;
use super::edges::SoftEdge;
use super::environment::FacetId;
use crate::field::image::{Element, Illumination};
use crate::field::{Phasor3, incidence_frame};

/// Edges farther from a way than this have no part in it, in units of the normalised clearance: three radii of the first Fresnel
/// zone, where a half-plane changes the field by 5 percent. What they add fades out over the last third.
const REACH: f64 = 3.0 * std::f64::consts::SQRT_2;
/// Distances from an edge to the ends of a path count as at least this, m.
const LEAST_DISTANCE_M: f64 = 1e-3;
/// Ways that pass an edge nearer than this are free or blocked as rays say, not as f64 does, m: rays are traced in f32.
const UNSURE_M: f64 = 5e-5;
/// The same where a point lies on a facet or beside it, which f64 decides.
const UNSURE_ON_FACET_M: f64 = 1e-8;
/// Beside an edge by this much, m, it is looked for a free way past it.
const BESIDE_M: f64 = 1e-4;
/// Points must lie this far before a facet to be reflected, m.
const BEFORE_M: f64 = 1e-9;

/// A path folded into the room: antenna, points of reflection, point.
#[derive(Debug, Clone, Copy)]
struct Folded {
    points: [DVec3; MAX_ORDER + 2],
    count: usize,
}

impl Folded {
    fn points(&self) -> &[DVec3] {
        self.points.get(..self.count).unwrap_or_default()
    }

    fn point(&self, i: usize) -> DVec3 {
        self.points.get(i).copied().unwrap_or(DVec3::ZERO)
    }
}

/// A straight piece of a path.
#[derive(Debug, Clone, Copy)]
struct Leg {
    from: DVec3,
    direction: DVec3,
    length_m: f64,
    /// Length of the path before it, m.
    before_m: f64,
    /// Length of the whole path, m.
    total_m: f64,
}

/// What is left of a field.
#[derive(Debug, Clone, Copy)]
struct Kept {
    /// Part of the field.
    field: Complex64,
    /// Whether rays, too, go this way: edges take or add a little only.
    is_whole: bool,
}

impl Kept {
    /// What two of them in turn leave.
    fn and(self, other: Kept) -> Kept {
        Kept { field: self.field * other.field, is_whole: self.is_whole && other.is_whole }
    }
}

/// How a leg passes an edge.
struct Passage {
    /// The edge's part of the field, but for its sign.
    part: Complex64,
    /// Distance of the leg from the line of the edge, m.
    clearance_m: f64,
    /// Whether the leg passes on the side of what the edge bounds.
    is_behind: bool,
    /// The nearest point of the edge, m, and the direction across the leg out of what it bounds.
    nearest: DVec3,
    outwards: DVec3,
}

impl Leg {
    fn reach_m(&self, wavelength_m: f64) -> f64 {
        REACH * 0.5 * (0.5 * wavelength_m * self.total_m).sqrt()
    }

    /// `None` where an edge is out of reach.
    fn past(&self, edge: &SoftEdge, inwards: DVec3, wavelength_m: f64) -> Option<Passage> {
        let &Leg { from, direction, length_m, before_m, total_m } = self;
        let along = |p: DVec3| (p - from).dot(direction);
        let across = |v: DVec3| v - direction * v.dot(direction);
        let [(a, cut_a), (b, cut_b)] = clipped(edge.ends, edge.ends.map(along), length_m)?;
        let (foot_a, step) = (across(a - from), across(b - a));
        let length = step.length();
        if length < 1e-9 {
            return None;
        }
        let unit = step / length;
        // Coordinates of the ends along the edge, from the foot of the perpendicular from the leg.
        let (start, end) = (foot_a.dot(unit), foot_a.dot(unit) + length);
        let nearest = a.lerp(b, (-start / length).clamp(0.0, 1.0));
        let (d1, d2) = (before_m + along(nearest), total_m - before_m - along(nearest));
        let (d1, d2) = (d1.max(LEAST_DISTANCE_M), d2.max(LEAST_DISTANCE_M));
        let nu_per_m = (2.0 * (d1 + d2) / (wavelength_m * d1 * d2)).sqrt();
        let nu = across(nearest - from).length() * nu_per_m;
        if nu >= REACH {
            return None;
        }
        let perpendicular = foot_a - unit * start;
        let clearance_m = perpendicular.length();
        let into = across(inwards) - unit * across(inwards).dot(unit);
        let goes_on = |end: usize, cut: bool| cut || edge.goes_on.get(end).copied().unwrap_or(false);
        let low = if goes_on(0, cut_a) { f64::NEG_INFINITY } else { start * nu_per_m };
        let high = if goes_on(1, cut_b) { f64::INFINITY } else { end * nu_per_m };
        let p = clearance_m * nu_per_m;
        let fade = fade((REACH - nu) / (REACH / 3.0));
        Some(Passage {
            part: (side_from_foot(p, high) - side_from_foot(p, low)) * fade,
            clearance_m,
            is_behind: -perpendicular.dot(into) > 0.0,
            nearest,
            outwards: -into.normalize_or_zero(),
        })
    }
}

/// The part of an edge beside a leg, and whether each end was cut.
fn clipped([a, b]: [DVec3; 2], [at_a, at_b]: [f64; 2], length_m: f64) -> Option<[(DVec3, bool); 2]> {
    if at_a.max(at_b) <= 0.0 || at_a.min(at_b) >= length_m {
        return None;
    }
    let cut = |end: DVec3, at: f64| {
        let within = at.clamp(0.0, length_m);
        if within == at { (end, false) } else { (a.lerp(b, ((within - at_a) / (at_b - at_a)).clamp(0.0, 1.0)), true) }
    };
    Some([cut(a, at_a), cut(b, at_b)])
}

/// From 0 at 0 to 1 at 1, smoothly.
fn fade(x: f64) -> f64 {
    let x = x.clamp(0.0, 1.0);
    x * x * (3.0 - 2.0 * x)
}

impl ImagePaths {
    /// Field of an element's image at a point, as [`crate::field::image::BoxRoom::illuminate`] gives it: zero where no path leads
    /// from the one to the other.
    pub fn illuminate(&self, element: &Element, image: usize, point: DVec3) -> Illumination {
        let position = self.images.get(image).map_or(element.position, |image| image.of(element.position));
        let offset = point - position;
        let distance_m = offset.length().max(1e-6);
        let direction = offset / distance_m;
        let mut field = Phasor3::real(DVec3::ZERO);
        if let Some(image) = self.images.get(image) {
            let departure = element.radar_from_world * (image.mirror.transpose() * direction);
            let polarisation = image.mirror * element.polarisation;
            let transverse = polarisation - direction * direction.dot(polarisation);
            let launched = Phasor3::real(transverse).scaled(element.pattern.field(departure));
            for (sequence, weight) in self.valid(image, element.position, point) {
                let reflected = self.reflected(sequence, direction, launched);
                field = sum(field, times(reflected, weight));
            }
        }
        Illumination { source: position, distance_m, direction, field }
    }

    /// Amplitude of the way from a transmitter's image straight to a receiver, and its length, m, as
    /// [`crate::field::image::BoxRoom::direct`] gives them.
    pub fn direct(&self, tx: &Element, image: usize, rx: &Element) -> (Complex64, f64) {
        let arrival = self.illuminate(tx, image, rx.position);
        let towards_source = rx.radar_from_world * -arrival.direction;
        let gain = rx.pattern.field(towards_source);
        let aperture = 0.5 / (self.environment.wavenumber_per_m() * arrival.distance_m);
        (arrival.field.along(rx.polarisation) * (gain * aperture), arrival.distance_m)
    }

    /// The way from an antenna to a point by an image: antenna, points of reflection, point. Of several the strongest; empty
    /// where there is none.
    pub fn polyline(&self, image: usize, antenna: DVec3, point: DVec3) -> Vec<DVec3> {
        let strongest = self.strongest(image, antenna, point);
        strongest
            .and_then(|sequence| self.folded(sequence, antenna, point))
            .map_or_else(Vec::new, |folded| folded.points().to_vec())
    }

    /// The facets that the strongest way from an antenna to a point by an image meets.
    pub fn strongest(&self, image: usize, antenna: DVec3, point: DVec3) -> Option<&[FacetId]> {
        let all = self.valid(self.images.get(image)?, antenna, point);
        all.into_iter().max_by(|a, b| a.1.norm().total_cmp(&b.1.norm())).map(|(sequence, _)| sequence)
    }

    /// The sequences of an image by which something arrives, with the part of the field that facets and edges leave.
    fn valid<'a>(&self, image: &'a Image, antenna: DVec3, point: DVec3) -> Vec<(&'a [FacetId], Complex64)> {
        let mut all: Vec<(&[FacetId], Complex64)> = Vec::new();
        let mut has_whole = false;
        for sequence in &image.sequences {
            let Some(kept) = self.weight(sequence, antenna, point) else { continue };
            // Backwards from the point only one facet is met first: a second free path is the same path on the seam of two.
            if !(kept.is_whole && has_whole) {
                all.push((sequence.as_slice(), kept.field));
            }
            has_whole |= kept.is_whole;
        }
        all
    }

    /// Field after the reflections of a sequence, in the image's frame.
    fn reflected(&self, sequence: &[FacetId], direction: DVec3, launched: Phasor3) -> Phasor3 {
        let environment = &*self.environment;
        let mut normals = [DVec3::ZERO; MAX_ORDER];
        let mut later = DMat3::IDENTITY;
        for (slot, &facet) in normals.iter_mut().zip(sequence).rev() {
            let Some(flat) = environment.flat(facet) else { continue };
            *slot = later * flat.normal;
            later *= flat.mirror();
        }
        let mut field = launched;
        for (&facet, &normal) in sequence.iter().zip(&normals) {
            let Some(flat) = environment.flat(facet) else { continue };
            let cosine = direction.dot(normal).abs().min(1.0);
            let reflection = flat.facet.wall.reflection(environment.wavenumber_per_m(), cosine);
            let (te, tm) = incidence_frame(direction, normal);
            field = Phasor3::combine(reflection.te * field.along(te), te, -reflection.tm * field.along(tm), tm);
        }
        field
    }

    /// The path by a sequence if all its planes are met from the front, wherever on them.
    fn folded(&self, sequence: &[FacetId], antenna: DVec3, point: DVec3) -> Option<Folded> {
        let count = sequence.len();
        if count > MAX_ORDER {
            return None;
        }
        let mut images = [antenna; MAX_ORDER + 1];
        let mut image = antenna;
        for (slot, &facet) in images.iter_mut().skip(1).zip(sequence) {
            image = self.environment.flat(facet)?.mirrored(image);
            *slot = image;
        }
        let mut points = [point; MAX_ORDER + 2];
        let mut target = point;
        for (i, &facet) in sequence.iter().enumerate().rev() {
            let flat = self.environment.flat(facet)?;
            let source = images.get(i + 1).copied()?;
            let (over, under) = (flat.height(target), flat.height(source));
            if over <= BEFORE_M || under >= -BEFORE_M {
                return None;
            }
            target = target.lerp(source, over / (over - under));
            *points.get_mut(i + 1)? = target;
        }
        *points.first_mut()? = antenna;
        Some(Folded { points, count: count + 2 })
    }

    /// What facets and edges leave on the path by a sequence; `None` where nothing is left.
    fn weight(&self, sequence: &[FacetId], antenna: DVec3, point: DVec3) -> Option<Kept> {
        let folded = self.folded(sequence, antenna, point)?;
        let points = folded.points();
        let total_m: f64 = points.windows(2).map(|w| w[0].distance(w[1])).sum();
        let leg = |i: usize, before_m: f64| {
            let (from, to) = (folded.point(i), folded.point(i + 1));
            let length_m = from.distance(to);
            Leg { from, direction: (to - from) / length_m.max(1e-12), length_m, before_m, total_m }
        };
        let mut weight = Kept { field: Complex64::ONE, is_whole: true };
        let mut before_m = 0.0;
        // Facets first: what they refuse needs no rays.
        for (i, &facet) in sequence.iter().enumerate() {
            let leg = leg(i, before_m);
            before_m += leg.length_m;
            weight = weight.and(self.on_facet(facet, &leg, folded.point(i + 1))?);
        }
        let mut before_m = 0.0;
        let mount = self.mount.filter(|&facet| {
            self.environment.flat(facet).is_some_and(|flat| flat.height(antenna).abs() < super::edges::SAME_M)
        });
        for i in 0..=sequence.len() {
            let leg = leg(i, before_m);
            before_m += leg.length_m;
            let on = [if i == 0 { mount } else { sequence.get(i - 1).copied() }, sequence.get(i).copied()];
            weight = weight.and(self.on_leg(&leg, folded.point(i + 1), on)?);
        }
        Some(weight)
    }

    /// What a facet reflects of what it would if its plane had no end.
    fn on_facet(&self, facet: FacetId, leg: &Leg, met: DVec3) -> Option<Kept> {
        let flat = self.environment.flat(facet)?;
        let is_on = flat.contains(met);
        // The way goes on behind the mirror: edges may lie beyond the point of reflection.
        let unfolded = Leg { length_m: leg.total_m - leg.before_m, ..*leg };
        let wavelength_m = self.environment.wavelength_m();
        let mut field = if is_on { Complex64::ONE } else { Complex64::ZERO };
        let mut is_left = is_on;
        for &number in &flat.soft {
            let Some(edge) = self.environment.soft_edges().get(number as usize) else { continue };
            // What leaves a facet beyond an inner corner is met by the next facet, in a sequence of its own.
            if !is_on && edge.is_beyond(met) {
                continue;
            }
            let Some(passage) = unfolded.past(edge, edge.inwards(facet), wavelength_m) else { continue };
            let is_over = if passage.clearance_m < UNSURE_ON_FACET_M { is_on } else { passage.is_behind };
            field += if is_over { -passage.part } else { passage.part };
            is_left |= !is_over;
        }
        is_left.then_some(Kept { field, is_whole: is_on })
    }

    /// What is left on a leg past all facets but those on which it ends.
    fn on_leg(&self, leg: &Leg, to: DVec3, on: [Option<FacetId>; 2]) -> Option<Kept> {
        let environment = &*self.environment;
        if leg.length_m < BEFORE_M {
            return Some(Kept { field: Complex64::ONE, is_whole: true });
        }
        let is_blocked = environment.blocked([leg.from, to], on);
        let planes = on.map(|facet| facet.and_then(|facet| environment.flat(facet)).map(|flat| flat.plane));
        let wavelength_m = environment.wavelength_m();
        let reach_m = leg.reach_m(wavelength_m);
        let mut field = if is_blocked { Complex64::ZERO } else { Complex64::ONE };
        let mut is_left = !is_blocked;
        for edge in environment.soft_edges() {
            if !edge.is_near(leg.from, leg.direction, leg.length_m, reach_m)
                || planes.into_iter().flatten().any(|plane| edge.bounds_plane(plane))
                || !edge.is_outline(leg.direction)
            {
                continue;
            }
            let Some(passage) = leg.past(edge, edge.widest(leg.direction), wavelength_m) else { continue };
            let beside = passage.nearest + passage.outwards * BESIDE_M;
            if environment.blocked([leg.from, beside], [on[0], None])
                || environment.blocked([beside, to], [None, on[1]])
            {
                continue;
            }
            let is_behind = if passage.clearance_m < UNSURE_M { is_blocked } else { passage.is_behind };
            field += if is_behind { passage.part } else { -passage.part };
            is_left = true;
        }
        is_left.then_some(Kept { field, is_whole: !is_blocked })
    }
}

/// A field times a complex factor.
fn times(field: Phasor3, factor: Complex64) -> Phasor3 {
    Phasor3 { re: field.re * factor.re - field.im * factor.im, im: field.re * factor.im + field.im * factor.re }
}

fn sum(a: Phasor3, b: Phasor3) -> Phasor3 {
    Phasor3 { re: a.re + b.re, im: a.im + b.im }
}
