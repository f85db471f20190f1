//! Fields of antenna images: the path is unfolded, checked against polygons and obstacles, and its reflections are
//! multiplied.
//!
//! As in [`crate::em::image`] the field is followed in the image's frame, where the direction never changes. Each
//! reflection multiplies it by `G_te te te^T - G_tm tm tm^T`, with the facet's normal mirrored by the later facets.
//! Each wall that is crossed between two reflections multiplies it by `T_te te te^T + T_tm tm tm^T` in the same way.
//!
//! An edge divides a path's wave fronts. Let `D` be the part of the field that passes on the other side of the edge
//! (Kirchhoff's approximation, [`super::edge_field`]). The field is `(1 - D) T + D T'`: `T` is the transmission of the
//! walls that the path crosses, `T'` that of the walls on the other side of the edge. Beside a free edge there are none;
//! beyond a seam, a hinge or a corner there are others. `D` is one half where a path meets a long edge, so that the field
//! has no step there. Each list of walls `T'` is an arrival of its own.

use std::collections::HashMap;
use std::sync::Arc;

use glam::{DMat3, DVec3};
use num_complex::Complex64;

use super::aperture::Aperture;
use super::discovery::{Image, ImagePaths, MAX_ORDER};
use super::edges::SoftEdge;
use super::environment::{Environment, Passing};
use super::flat::FacetId;
use super::folded::{BEFORE_M, Folded};
use super::leg::{Kept, Leg, Passage, UNSURE_M};
use crate::em::fresnel::Coefficients;
use crate::em::image::{Element, Illumination};
use crate::em::{Phasor3, incidence_frame};

/// Distance beside an edge at which a free path past it is searched, m.
const BESIDE_M: f64 = 1e-4;
/// Smallest change of a relative field by an edge that counts: the accuracy of the Fresnel integrals.
const LEAST_PART: f64 = 0.003;
/// Initial capacity for edges near a leg.
const USUALLY_NEAR: usize = 64;
/// Additional search distance for edges beside a path that is followed, m: a trunk moves this far in most of a frame.
const MOVED_M: f64 = 0.05;

/// Relative field of an image past facets, edges and walls, about a point. It also gives the fields at nearby points
/// that are past the same objects.
#[derive(Debug, Clone)]
pub struct Obstruction<'a> {
    image: Option<&'a Image>,
    arrivals: Vec<Arrival<'a>>,
}

impl Obstruction<'_> {
    /// Upper bound of the magnitude of the relative field: sum over all sequences.
    pub fn left(&self) -> f64 {
        self.arrivals.iter().map(|arrival| arrival.part.norm()).sum()
    }
}

/// Edge beside a leg, and the walls that paths cross just behind it, where the widest of its facets is, and just beside
/// it; `None` where nothing passes.
#[derive(Debug, Clone)]
struct Beside {
    edge: u32,
    /// Unit vector from the edge into the facet that tells behind from beside.
    inwards: DVec3,
    behind: Option<Vec<FacetId>>,
    beside: Option<Vec<FacetId>>,
}

/// Edges beside the legs of paths to nearly the same place, as found for the first of them. The keys are the numbers of
/// the sequence and the leg. All edges that matter are known for places within 5 cm of the first. Farther away, as on
/// the other end of a trunk or where a foot swings, weak edges may be missing until the next search.
#[derive(Debug, Clone, Default)]
pub struct EdgesBeside {
    by_leg: HashMap<(u32, u32), Vec<Beside>>,
    /// Whether an inner corner is beside one of the paths.
    is_at_corner: bool,
}

impl EdgesBeside {
    /// Returns whether no edge is beside any leg, and no inner corner beside a path.
    pub fn is_empty(&self) -> bool {
        !self.is_at_corner && self.by_leg.values().all(Vec::is_empty)
    }
}

/// Known edges beside a leg, and the leg's number.
type KnownBeside<'a> = Option<(&'a mut EdgesBeside, (u32, u32))>;

/// Facets of a leg's path that do not diffract beside it.
#[derive(Debug, Clone, Copy)]
struct Ends<'a> {
    /// Facets on which the leg begins and ends.
    on: [Option<FacetId>; 2],
    /// Facets of the whole path: those that make a corner with one of these belong to its aperture.
    sequence: &'a [FacetId],
}

/// Relative field that passes a leg.
#[derive(Debug, Clone)]
struct OnLeg {
    /// Field by the walls that the leg crosses.
    kept: Kept,
    crossed: Vec<FacetId>,
    /// Parts of the field that pass edges by other walls, and those walls.
    others: Vec<(Complex64, Vec<FacetId>)>,
}

/// Walls that a path crosses, each with the number of the crossing leg.
type Crossed = Vec<(usize, FacetId)>;

/// Relative field that arrives by a sequence of facets, and by certain walls.
#[derive(Debug, Clone)]
struct Arrival<'a> {
    sequence: &'a [FacetId],
    /// Relative field past facets and edges.
    part: Complex64,
    is_whole: bool,
    crossed: Crossed,
}

/// Relative field on the first legs of a path.
struct Followed {
    /// Field by the walls that the path crosses.
    kept: Kept,
    crossed: Crossed,
    /// Parts of the field that pass edges by other walls, and those walls.
    others: Vec<(Complex64, Crossed)>,
}

impl Followed {
    /// Follows the path over the next leg, which has this number.
    fn over(&mut self, leg: usize, on_leg: OnLeg) {
        let with = |before: &[(usize, FacetId)], walls: &[FacetId]| -> Crossed {
            before.iter().copied().chain(walls.iter().map(|&facet| (leg, facet))).collect()
        };
        let mut next: Vec<(Complex64, Crossed)> = Vec::new();
        for (part, walls) in &on_leg.others {
            next.push((self.kept.field * *part, with(&self.crossed, walls)));
            // Two edges leave a product of two parts. Weak ones do not count, or there would be as many as there are
            // ways to choose an edge beside each leg.
            let both = self.others.iter().map(|(before, all)| (*before * *part, all));
            next.extend(both.filter(|(both, _)| counts(*both)).map(|(both, all)| (both, with(all, walls))));
        }
        let same = self.others.iter().map(|(before, all)| (*before * on_leg.kept.field, with(all, &on_leg.crossed)));
        next.extend(same);
        next.retain(|(part, _)| *part != Complex64::ZERO);
        self.others = next;
        self.kept = self.kept.and(on_leg.kept);
        self.crossed.extend(on_leg.crossed.into_iter().map(|facet| (leg, facet)));
    }
}

/// Returns whether a part of a field is strong enough to count.
fn counts(part: Complex64) -> bool {
    part.norm_sqr() >= LEAST_PART * LEAST_PART
}

impl ImagePaths {
    /// Field of an element's image at a point, as [`crate::em::image::BoxRoom::illuminate`] gives it; zero where no
    /// path connects the two.
    pub fn illuminate(&self, element: &Element, image: usize, point: DVec3) -> Illumination {
        self.illuminate_past(element, &self.obstruction(image, element.position, point, None), point)
    }

    /// Relative field of an antenna's image at a point past facets, edges and walls. For a path that is followed, edges
    /// beside it are searched only once, and `known` keeps them.
    pub fn obstruction(
        &self,
        image: usize,
        antenna: DVec3,
        point: DVec3,
        known: Option<&mut EdgesBeside>,
    ) -> Obstruction<'_> {
        let image = self.images.get(image);
        Obstruction { image, arrivals: image.map_or_else(Vec::new, |image| self.valid(image, antenna, point, known)) }
    }

    /// Returns whether an unobstructed ray leads from an antenna to a point by an image.
    pub fn is_lit(&self, image: usize, antenna: DVec3, point: DVec3) -> bool {
        let Some(image) = self.images.get(image) else { return false };
        image.sequences.iter().any(|sequence| self.is_free(sequence, antenna, point).unwrap_or(false))
    }

    /// Returns whether a ray is free along a sequence of facets; `None` where it meets planes from behind.
    fn is_free(&self, sequence: &[FacetId], antenna: DVec3, point: DVec3) -> Option<bool> {
        let folded = self.folded(sequence, antenna, point)?;
        if !folded.is_within_corners() {
            return Some(false);
        }
        let is_on = |(&facet, &met): (&FacetId, &DVec3)| self.environment.flat(facet).is_some_and(|f| f.contains(met));
        if !sequence.iter().zip(folded.points().iter().skip(1)).all(is_on) {
            return Some(false);
        }
        let is_clear = |leg: usize| {
            let on = self.ends_on(sequence, leg, antenna);
            !self.environment.passing([folded.point(leg), folded.point(leg + 1)], on).is_blocked
        };
        Some((0..=sequence.len()).all(is_clear))
    }

    /// Facets on which a leg of a sequence begins and ends.
    fn ends_on(&self, sequence: &[FacetId], leg: usize, antenna: DVec3) -> [Option<FacetId>; 2] {
        let holds = |facet: &FacetId| {
            let flat = self.environment.flat(*facet);
            flat.is_some_and(|flat| flat.height(antenna).abs() < super::edges::SAME_M)
        };
        let first = if leg == 0 { self.mount.filter(holds) } else { sequence.get(leg - 1).copied() };
        [first, sequence.get(leg).copied()]
    }

    /// Field of an element's image at a point ([`ImagePaths::illuminate`]) past known obstructions. Lengths, directions
    /// and reflections are those of the point.
    pub fn illuminate_past(&self, element: &Element, obstruction: &Obstruction, point: DVec3) -> Illumination {
        let position = obstruction.image.map_or(element.position, |image| image.of(element.position));
        let offset = point - position;
        let distance_m = offset.length().max(1e-6);
        let direction = offset / distance_m;
        let mut field = Phasor3::real(DVec3::ZERO);
        if let Some(image) = obstruction.image.filter(|_| !obstruction.arrivals.is_empty()) {
            let departure = element.radar_from_world * (image.mirror.transpose() * direction);
            let polarisation = image.mirror * element.polarisation;
            let transverse = polarisation - direction * direction.dot(polarisation);
            let launched = Phasor3::real(transverse).scaled(element.pattern.field(departure));
            for arrival in &obstruction.arrivals {
                let arrived = self.environment.reflected(arrival.sequence, &arrival.crossed, direction, launched);
                field = field + arrived.times(arrival.part);
            }
        }
        Illumination { source: position, distance_m, direction, field }
    }

    /// Corners of the strongest path from an antenna to a point by an image: antenna, points of reflection, point.
    /// Empty where there is no path.
    pub fn polyline(&self, image: usize, antenna: DVec3, point: DVec3) -> Vec<DVec3> {
        self.polyline_past(&self.obstruction(image, antenna, point, None), antenna, point)
    }

    /// Corners of the strongest path from an antenna to a point past known obstructions; empty where there is none.
    pub fn polyline_past(&self, obstruction: &Obstruction, antenna: DVec3, point: DVec3) -> Vec<DVec3> {
        let strongest = obstruction.arrivals.iter().max_by(|a, b| a.part.norm().total_cmp(&b.part.norm()));
        let folded = strongest.and_then(|arrival| self.folded(arrival.sequence, antenna, point));
        folded.map_or_else(Vec::new, |folded| folded.points().to_vec())
    }

    /// Corners of a path from an antenna to a point by an image, whether it is free or not. It is the first path whose
    /// points of reflection lie on their facets, otherwise one with points beside them; empty where there is none. No
    /// rays are traced.
    pub fn way(&self, image: usize, antenna: DVec3, point: DVec3) -> Vec<DVec3> {
        let Some(image) = self.images.get(image) else { return Vec::new() };
        let all = || image.sequences.iter().filter_map(|s| Some((s, self.folded(s, antenna, point)?)));
        let lies_on = |(sequence, folded): &(&Vec<FacetId>, Folded)| {
            let met = folded.points().iter().skip(1);
            sequence.iter().zip(met).all(|(&facet, met)| self.environment.flat(facet).is_some_and(|f| f.contains(*met)))
        };
        let found = all().find(lies_on).or_else(|| all().next());
        found.map_or_else(Vec::new, |(_, folded)| folded.points().to_vec())
    }

    /// Relative field on the straight segment between two points, each perhaps on a facet, past edges and through
    /// walls. It is the mean magnitude of both polarisations.
    pub fn straight(&self, [from, to]: [DVec3; 2], on: [Option<FacetId>; 2]) -> f64 {
        let length_m = from.distance(to);
        let direction = (to - from) / length_m.max(1e-12);
        let leg = Leg { from, direction, length_m, before_m: 0.0, total_m: length_m };
        let ends = Ends { on, sequence: &[] };
        let passing = self.passing(&leg, to, ends);
        let Some(OnLeg { kept, crossed, others }) = self.on_leg(&leg, to, ends, &passing, None) else {
            return 0.0;
        };
        let through = |&facet: &FacetId| {
            self.environment.flat(facet).map_or(Complex64::ONE, |flat| {
                let Coefficients { te, tm } = flat.table.transmission(direction.dot(flat.normal).abs().min(1.0));
                0.5 * (te + tm)
            })
        };
        let past = |(part, walls): (Complex64, &[FacetId])| part * walls.iter().map(through).product::<Complex64>();
        let all = others.iter().map(|(part, walls)| (*part, walls.as_slice()));
        let sum: Complex64 = std::iter::once((kept.field, crossed.as_slice())).chain(all).map(past).sum();
        sum.norm()
    }

    /// Sequences of an image by which a field arrives, with the relative field past facets and edges.
    fn valid<'a>(
        &self,
        image: &'a Image,
        antenna: DVec3,
        point: DVec3,
        mut known: Option<&mut EdgesBeside>,
    ) -> Vec<Arrival<'a>> {
        let mut all: Vec<Arrival> = Vec::new();
        let mut has_whole = false;
        for (number, sequence) in (0u32..).zip(&image.sequences) {
            let known = known.as_deref_mut().map(|known| (known, number));
            let Some((first, others)) = self.arrivals(sequence, antenna, point, known) else { continue };
            let is_whole = first.is_whole;
            // Backwards from the point only one facet is met first: a second free path is the same path on the seam of
            // two.
            if !(is_whole && has_whole) {
                all.extend(std::iter::once(first).chain(others).filter(|arrival| arrival.part != Complex64::ZERO));
            }
            has_whole |= is_whole;
        }
        all
    }

    /// Relative fields on the path by a sequence past facets, edges and walls: by the walls that the path crosses, and
    /// by others, where edges let the field pass by those. `None` where nothing is left.
    fn arrivals<'a>(
        &self,
        sequence: &'a [FacetId],
        antenna: DVec3,
        point: DVec3,
        mut known: Option<(&mut EdgesBeside, u32)>,
    ) -> Option<(Arrival<'a>, Vec<Arrival<'a>>)> {
        let folded = self.folded(sequence, antenna, point)?;
        if let Some((known, _)) = &mut known {
            known.is_at_corner |= folded.is_at_corner();
        }
        let points = folded.points();
        let total_m: f64 = points.windows(2).map(|w| w[0].distance(w[1])).sum();
        let leg = |i: usize, before_m: f64| {
            let (from, to) = (folded.point(i), folded.point(i + 1));
            let length_m = from.distance(to);
            Leg { from, direction: (to - from) / length_m.max(1e-12), length_m, before_m, total_m }
        };
        let mut weight = folded.past_corners;
        let mut aperture: Option<Aperture> = None;
        let (mut last, mut reflected): (Option<FacetId>, DVec3) = (None, DVec3::ZERO);
        let mut before_m = 0.0;
        // Facets are tested first, because paths that they reject need no rays.
        for (i, &facet) in sequence.iter().enumerate() {
            let mut leg = leg(i, before_m);
            before_m += leg.length_m;
            if leg.length_m < BEFORE_M && i > 0 {
                // From face to face in their common edge.
                leg.direction = reflected;
            }
            reflected = self.environment.flat(facet)?.mirror() * leg.direction;
            let corners = folded.beside_corners.iter().filter(|(place, _)| *place == i).map(|(_, past)| past);
            let own = self.on_facet(facet, &leg, folded.point(i + 1), corners)?;
            let corner = aperture.filter(|_| last.is_some_and(|last| self.corners.holds(last, facet)));
            let before = aperture.replace(corner.map_or(own, |corner| corner.beside(own)));
            if let (Some(before), None) = (before, corner) {
                weight = weight.and(before.kept);
            }
            last = Some(facet);
        }
        if let Some(aperture) = aperture {
            weight = weight.and(aperture.kept);
        }
        let (mut legs, mut before_m, mut is_from_edge) = (Vec::with_capacity(points.len()), 0.0, false);
        for i in 0..=sequence.len() {
            let leg = leg(i, before_m);
            before_m += leg.length_m;
            let leg = if is_from_edge { leg.off_edge() } else { leg };
            is_from_edge = leg.length_m < BEFORE_M;
            let ends = Ends { on: self.ends_on(sequence, i, antenna), sequence };
            legs.push((leg, ends, self.passing(&leg, folded.point(i + 1), ends)));
        }
        // Most paths in shadow end at a leg that is blocked and has no edge beside it. The edges of others are then not
        // searched.
        let mut on_legs: Vec<Option<OnLeg>> = legs.iter().map(|_| None).collect();
        let is_blocked = |(_, (_, _, passing)): &(usize, &(Leg, Ends, Passing))| passing.is_blocked;
        let (blocked, free) = (legs.iter().enumerate(), legs.iter().enumerate());
        for (i, (leg, ends, passing)) in blocked.filter(is_blocked).chain(free.filter(|leg| !is_blocked(leg))) {
            let known = known.as_mut().map(|(known, number)| (&mut **known, (*number, i as u32)));
            let on_leg = self.on_leg(leg, folded.point(i + 1), *ends, passing, known)?;
            on_legs.get_mut(i)?.replace(on_leg);
        }
        let mut followed = Followed { kept: weight, crossed: Vec::new(), others: Vec::new() };
        for (i, on_leg) in on_legs.into_iter().flatten().enumerate() {
            followed.over(i, on_leg);
        }
        let Followed { kept, crossed, others } = followed;
        let first = Arrival { sequence, part: kept.field, is_whole: kept.is_whole, crossed };
        let others = others.into_iter().map(|(part, crossed)| Arrival { sequence, part, is_whole: false, crossed });
        Some((first, others.collect()))
    }

    /// Facets and obstacles on a leg, except the facets on which it ends.
    fn passing(&self, leg: &Leg, to: DVec3, ends: Ends) -> Passing {
        if leg.length_m < BEFORE_M { Passing::default() } else { self.environment.passing([leg.from, to], ends.on) }
    }

    /// Relative field on a leg past all facets except those on which it ends, and the walls that it crosses.
    fn on_leg(&self, leg: &Leg, to: DVec3, ends: Ends, passing: &Passing, known: KnownBeside) -> Option<OnLeg> {
        let environment = &*self.environment;
        let mut others: Vec<(Complex64, Vec<FacetId>)> = Vec::new();
        if leg.length_m < BEFORE_M {
            let kept = Kept { field: Complex64::ONE, is_whole: true };
            return Some(OnLeg { kept, crossed: Vec::new(), others });
        }
        let mut field = if passing.is_blocked { Complex64::ZERO } else { Complex64::ONE };
        let mut is_left = !passing.is_blocked;
        let found;
        let edges: &[Beside] = match known {
            Some((known, number)) => {
                known.by_leg.entry(number).or_insert_with(|| self.edges_beside(leg, to, ends, MOVED_M))
            }
            None => {
                found = self.edges_beside(leg, to, ends, 0.0);
                &found
            }
        };
        for Beside { edge, inwards, behind, beside } in edges {
            let Some(edge) = environment.soft_edges().get(*edge as usize) else { continue };
            let passage = leg.past(edge, *inwards, environment.wavelength_m());
            let Some(passage) = passage else { continue };
            let part = passage.part(environment.edge_reach());
            if !counts(part) {
                continue;
            }
            let (behind, beside) = (behind.as_deref(), beside.as_deref());
            let is_as_found = |walls: Option<&[FacetId]>| match walls {
                Some(walls) => !passing.is_blocked && self.are_alike(walls, &passing.crossed),
                None => passing.is_blocked,
            };
            let by_ray = (passage.clearance_m < UNSURE_M && is_as_found(behind) != is_as_found(beside))
                .then(|| is_as_found(behind));
            let part = if by_ray.unwrap_or(passage.is_behind) { part } else { -part };
            for (walls, part) in [(beside, part), (behind, -part)] {
                match walls {
                    Some(walls) if self.are_alike(walls, &passing.crossed) => field += part,
                    Some(walls) => match others.iter_mut().find(|(_, other)| self.are_alike(walls, other)) {
                        Some((sum, _)) => *sum += part,
                        None => others.push((part, walls.to_vec())),
                    },
                    None => {}
                }
            }
            is_left = true;
        }
        let kept = Kept { field, is_whole: !passing.is_blocked };
        is_left.then(|| OnLeg { kept, crossed: passing.crossed.clone(), others })
    }

    /// Diffracting edges beside a leg: within reach (or up to `farther_m` beyond), seen from both ends, and with other
    /// walls on one side than on the other. Where no wall transmits, these are edges on the outline of their facets.
    fn edges_beside(&self, leg: &Leg, to: DVec3, ends: Ends, farther_m: f64) -> Vec<Beside> {
        let (environment, on) = (&*self.environment, ends.on);
        let of_corners = ends
            .sequence
            .iter()
            .copied()
            .filter(|&facet| on.into_iter().flatten().any(|end| end != facet && self.corners.holds(end, facet)));
        let facets = on.into_iter().flatten().chain(of_corners);
        let planes: Vec<u32> = facets.filter_map(|facet| Some(environment.flat(facet)?.plane)).collect();
        let wavelength_m = environment.wavelength_m();
        let reach_m = leg.own_reach_m(environment);
        // At the ends of a path, where zones are narrow, edges out of reach stay out of reach.
        let most_nu = environment.edge_reach() * (1.0 + farther_m / reach_m);
        let mut near = Vec::with_capacity(USUALLY_NEAR);
        environment.edges_near(leg.from, to, reach_m + farther_m, &mut near);
        let found = |number: u32| {
            let edge = environment.soft_edges().get(number as usize)?;
            let is_behind = |facet: FacetId| environment.flat(facet).is_some_and(|flat| edge.is_behind(flat));
            if !edge.is_near(leg.from, leg.direction, leg.length_m, reach_m + farther_m)
                || planes.iter().any(|&plane| edge.bounds_plane(plane))
                || on.into_iter().flatten().any(is_behind)
                || !(environment.lets_through() || edge.is_outline(leg.from, leg.direction))
            {
                return None;
            }
            let inwards = edge.widest(leg.direction);
            let passage = leg.past(edge, inwards, wavelength_m).filter(|passage| passage.nu < most_nu)?;
            let [behind, beside] = self.walls_beside(edge, leg, to, on, &passage);
            let is_step = match (&behind, &beside) {
                (None, None) => false,
                (Some(behind), Some(beside)) => !self.are_alike(behind, beside),
                _ => true,
            };
            is_step.then_some(Beside { edge: number, inwards, behind, beside })
        };
        near.into_iter().filter_map(found).collect()
    }

    /// Walls that a path crosses just behind an edge, where the widest of its facets is, and just beside it, in the order
    /// of the path; `None` where it is blocked. The edge's own facets are told by their sides, and all others by rays.
    fn walls_beside(
        &self,
        edge: &SoftEdge,
        leg: &Leg,
        to: DVec3,
        on: [Option<FacetId>; 2],
        passage: &Passage,
    ) -> [Option<Vec<FacetId>>; 2] {
        let environment = &*self.environment;
        let plane = |facet: FacetId| environment.flat(facet).map(|flat| flat.plane);
        let own = |is_beside: bool| {
            let mut walls: Vec<FacetId> = Vec::new();
            for (facet, _) in edge.sides_of(passage.outwards).filter(|(_, beside)| *beside == is_beside) {
                let transmits = environment.flat(facet).is_some_and(|flat| flat.transmits);
                if !(environment.lets_through() && transmits) {
                    return None;
                }
                // Both sides of a sheet are one wall.
                if walls.iter().all(|&other| plane(other) != plane(facet)) {
                    walls.push(facet);
                }
            }
            Some(walls)
        };
        let others = |place: DVec3| {
            let first = environment.passing([leg.from, place], [on[0], None]);
            if first.is_blocked {
                return None;
            }
            let second = environment.passing([place, to], [None, on[1]]);
            if second.is_blocked {
                return None;
            }
            let mut walls = first.crossed;
            for facet in second.crossed {
                if walls.iter().all(|&other| plane(other) != plane(facet)) {
                    walls.push(facet);
                }
            }
            walls.retain(|&facet| plane(facet).is_some_and(|plane| !edge.bounds_plane(plane)));
            Some(walls)
        };
        [(false, -BESIDE_M), (true, BESIDE_M)].map(|(is_beside, aside_m)| {
            let own = own(is_beside)?;
            let place = passage.nearest + passage.outwards * aside_m;
            let mut walls = others(place)?;
            walls.extend(own);
            // Polarisations mix at walls that are not parallel, so their order matters.
            let at_m = |facet: &FacetId| {
                environment.flat(*facet).map_or(0.0, |flat| -flat.height(place) / flat.normal.dot(leg.direction))
            };
            walls.sort_by(|a, b| at_m(a).total_cmp(&at_m(b)));
            Some(walls)
        })
    }

    /// Returns whether two lists hold the same walls: as many, each of the plane and the material of one in the other.
    fn are_alike(&self, some: &[FacetId], others: &[FacetId]) -> bool {
        let is_like = |a: FacetId, b: FacetId| match (self.environment.flat(a), self.environment.flat(b)) {
            (Some(a), Some(b)) => a.plane == b.plane && Arc::ptr_eq(&a.table, &b.table),
            _ => false,
        };
        some.len() == others.len() && some.iter().all(|&a| others.iter().any(|&b| is_like(a, b)))
    }
}

impl Environment {
    /// Field after the reflections of a sequence and the walls that it crosses, each with the number of the crossing
    /// leg. Fields and direction are in the image's frame.
    pub(crate) fn reflected(
        &self,
        sequence: &[FacetId],
        crossed: &[(usize, FacetId)],
        direction: DVec3,
        launched: Phasor3,
    ) -> Phasor3 {
        // Product of the later facets' mirrors at each leg.
        let mut frames = [DMat3::IDENTITY; MAX_ORDER + 1];
        let mut later = DMat3::IDENTITY;
        for (leg, &facet) in sequence.iter().enumerate().rev() {
            let (Some(flat), Some(slot)) = (self.flat(facet), frames.get_mut(leg)) else { continue };
            later *= flat.mirror();
            *slot = later;
        }
        let frame = |leg: usize| frames.get(leg).copied().unwrap_or(DMat3::IDENTITY);
        let mut field = launched;
        for leg in 0..=sequence.len() {
            let walls = crossed.iter().filter(|(of_leg, _)| *of_leg == leg);
            for flat in walls.filter_map(|(_, facet)| self.flat(*facet)) {
                let normal = frame(leg) * flat.normal;
                let through = flat.table.transmission(direction.dot(normal).abs().min(1.0));
                let (te, tm) = incidence_frame(direction, normal);
                field = Phasor3::combine(through.te * field.along(te), te, through.tm * field.along(tm), tm);
            }
            let Some(flat) = sequence.get(leg).and_then(|&facet| self.flat(facet)) else { continue };
            let normal = frame(leg + 1) * flat.normal;
            let reflection = flat.table.reflection(direction.dot(normal).abs().min(1.0));
            let (te, tm) = incidence_frame(direction, normal);
            field = Phasor3::combine(reflection.te * field.along(te), te, -reflection.tm * field.along(tm), tm);
        }
        field
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec2;

    use super::super::Facet;
    use super::super::rooms::{sheet, slab};
    use super::*;
    use crate::em::image::Wall;

    /// Wavenumber at 60 GHz, 1/m.
    const K: f64 = 1_257.507_013_171_009;

    /// Upright sheet along y at some x.
    fn across(x: f64, [from, to]: [f64; 2], wall: Wall) -> [Facet; 2] {
        sheet(DVec2::new(x, from), DVec2::new(x, to), 3.0, wall)
    }

    fn passable(facets: Vec<Facet>, antenna: DVec3, sequences: &[Vec<FacetId>]) -> ImagePaths {
        let environment = Environment::new(facets, K).expect("facets").with_transmission(true);
        ImagePaths::with_sequences(Arc::new(environment), antenna, sequences.to_vec())
    }

    /// Through a fence of slats beside both legs of a reflected path the field arrives through a slat or between two, on
    /// each leg. There was an arrival for every choice of an edge beside each leg.
    #[test]
    fn edges_of_one_wall_share_an_arrival() {
        let mirror = across(0.0, [-3.0, 3.0], Wall::Conductor);
        let slat = |i: i32| across(1.0, [0.08 * f64::from(i), 0.08 * f64::from(i) + 0.04], slab(0));
        let facets: Vec<Facet> = mirror.into_iter().chain((-12..12).flat_map(slat)).collect();
        let [antenna, point] = [-1.0, 1.0].map(|y| DVec3::new(2.0, y, 1.5));
        let paths = passable(facets, antenna, &[vec![0]]);
        let count = paths.obstruction(1, antenna, point, None).arrivals.len();
        assert!((2..=4).contains(&count), "{count}");
    }

    #[test]
    fn walls_beyond_an_edge_are_in_order() {
        let facets = [across(0.0, [-2.0, 0.0], slab(0)), across(0.5, [-2.0, 2.0], slab(1))].concat();
        let [from, to] = [-2.0, 2.0].map(|x| DVec3::new(x, 0.05, 1.5));
        let paths = passable(facets, from, &[]);
        let leg = Leg { from, direction: DVec3::X, length_m: 4.0, before_m: 0.0, total_m: 4.0 };
        let found = paths.edges_beside(&leg, to, Ends { on: [None; 2], sequence: &[] }, 0.0);
        let place = |facet: &FacetId| paths.environment().facet(*facet).map_or(f64::NAN, |facet| facet.corners[0].x);
        let places = |walls: &Option<Vec<FacetId>>| walls.iter().flatten().map(place).collect::<Vec<f64>>();
        let all: Vec<[Vec<f64>; 2]> = found.iter().map(|b| [places(&b.behind), places(&b.beside)]).collect();
        assert_eq!(all, [[vec![0.0, 0.5], vec![0.5]]]);
    }
}
