//! Fields of antenna images: the path is unfolded, checked against polygons and obstacles, and its reflections are
//! multiplied.
//!
//! As in [`crate::em::image`], the field is computed in the image's frame, where the direction never changes. Each
//! reflection multiplies it by `G_te te te^T - G_tm tm tm^T`, with the facet's normal mirrored by the later facets.
//! Each wall that is crossed between two reflections multiplies it by `T_te te te^T + T_tm tm tm^T` in the same way.
//!
//! An edge divides a path's wave fronts. Let `D` be the part of the field that passes on the other side of the edge
//! (Kirchhoff's approximation, [`super::edge_field`]). The field is `(1 - D) T + D T'`: `T` is the transmission of the
//! walls that the path crosses, `T'` that of the walls on the other side of the edge. Beside a free edge there are
//! none. Beyond a seam, a hinge or a corner there are other walls. `D` is one half where a path meets a long edge, so
//! that the field has no step there. Each list of walls `T'` is a [`SequenceField`] of its own.

use std::collections::HashMap;
use std::sync::Arc;

use glam::{DMat3, DVec3};
use num_complex::Complex64;

use super::aperture::Aperture;
use super::discovery::{Image, ImagePaths, MAX_ORDER};
use super::edges::DiffractingEdge;
use super::environment::{Environment, SegmentObstacles};
use super::flat::FacetId;
use super::folded::{BEFORE_M, FoldedPath};
use super::leg::{Leg, Passage, RelativeField, UNSURE_M};
use crate::em::fresnel::Coefficients;
use crate::em::image::{Element, Illumination};
use crate::em::{Phasor3, incidence_frame};

/// Distance from an edge at which paths on either side of it are tested, m.
const BESIDE_M: f64 = 1e-4;
/// Smallest change of a relative field by an edge that counts: the accuracy of the Fresnel integrals.
const LEAST_PART: f64 = 0.003;
/// Initial capacity for edges near a leg.
const USUALLY_NEAR: usize = 64;
/// Additional search distance for edges that are kept for paths to nearby points, m: a trunk moves this far in most of
/// a frame.
const MOVED_M: f64 = 0.05;

/// Relative field of an image past facets, edges and walls, about a point. It also gives the fields at nearby points
/// that are past the same objects.
#[derive(Debug, Clone)]
pub struct Obstruction<'a> {
    image: Option<&'a Image>,
    fields: Vec<SequenceField<'a>>,
}

impl Obstruction<'_> {
    /// Upper bound of the magnitude of the relative field: sum over all sequences.
    pub fn bound(&self) -> f64 {
        self.fields.iter().map(|of_sequence| of_sequence.field.norm()).sum()
    }
}

/// Edge beside a leg, and the walls that paths cross on both sides of it; `None` on a side where nothing passes.
#[derive(Debug, Clone)]
struct EdgeBeside {
    /// Number of the edge.
    edge: u32,
    /// Unit vector from the edge into the widest of its facets.
    inwards: DVec3,
    /// Walls just behind the edge, on the side of that facet.
    walls_behind: Option<Vec<FacetId>>,
    /// Walls just beside the edge, on the other side.
    walls_beside: Option<Vec<FacetId>>,
}

/// Edges beside the legs of paths to nearly the same point, as found for the first of them.
///
/// All edges that matter are known for points within 5 cm of the first. Farther away, as on the other end of a trunk or
/// where a foot swings, weak edges may be missing until the next search.
#[derive(Debug, Clone, Default)]
pub struct EdgesBeside {
    /// Edges by the numbers of sequence and leg.
    by_leg: HashMap<(u32, u32), Vec<EdgeBeside>>,
    /// Whether an inner corner is beside one of the paths.
    is_at_corner: bool,
}

impl EdgesBeside {
    /// Returns whether no edge is beside any leg, and no inner corner beside a path.
    pub fn is_empty(&self) -> bool {
        !self.is_at_corner && self.by_leg.values().all(Vec::is_empty)
    }
}

/// Known edges beside paths, and the numbers of sequence and leg.
type KnownEdges<'a> = Option<(&'a mut EdgesBeside, (u32, u32))>;

/// Facets at the ends of a leg. Their edges do not diffract beside the leg, because they belong to an aperture.
#[derive(Debug, Clone, Copy)]
struct LegEnds<'a> {
    /// Facets on which the leg begins and ends.
    on: [Option<FacetId>; 2],
    /// Facets of the whole path. Those that make a corner with a facet at an end belong to the same aperture.
    sequence: &'a [FacetId],
}

/// Relative field that passes a leg.
#[derive(Debug, Clone)]
struct LegField {
    /// Field by the walls that the leg crosses.
    main: RelativeField,
    /// Walls that the leg crosses.
    crossed: Vec<FacetId>,
    /// Parts of the field that pass edges by other walls, and those walls.
    others: Vec<(Complex64, Vec<FacetId>)>,
}

/// Walls that a path crosses, each with the number of the crossing leg.
type CrossedWalls = Vec<(usize, FacetId)>;

/// Relative field that arrives by a sequence of facets and by certain walls.
#[derive(Debug, Clone)]
struct SequenceField<'a> {
    sequence: &'a [FacetId],
    /// Relative field past facets and edges.
    field: Complex64,
    /// Whether the path is one of geometrical optics.
    is_geometric: bool,
    crossed: CrossedWalls,
}

/// Relative field on the first legs of a path.
struct PathField {
    /// Field by the walls that the path crosses.
    main: RelativeField,
    /// Walls that the path crosses.
    crossed: CrossedWalls,
    /// Parts of the field that pass edges by other walls, and those walls.
    others: Vec<(Complex64, CrossedWalls)>,
}

impl PathField {
    /// Multiplies by the field of the next leg, which has this number.
    fn append(&mut self, leg: usize, next_leg: LegField) {
        let with = |before: &[(usize, FacetId)], walls: &[FacetId]| -> CrossedWalls {
            before.iter().copied().chain(walls.iter().map(|&facet| (leg, facet))).collect()
        };
        let mut others: Vec<(Complex64, CrossedWalls)> = Vec::new();
        for (part, walls) in &next_leg.others {
            others.push((self.main.field * *part, with(&self.crossed, walls)));
            // Two edges leave a product of two parts. Weak products do not count. Otherwise there would be one for
            // every choice of an edge beside each leg.
            let products = self.others.iter().map(|(before, crossed)| (*before * *part, crossed));
            let strong = products.filter(|(product, _)| is_significant(*product));
            others.extend(strong.map(|(product, crossed)| (product, with(crossed, walls))));
        }
        let by_main = self
            .others
            .iter()
            .map(|(before, crossed)| (*before * next_leg.main.field, with(crossed, &next_leg.crossed)));
        others.extend(by_main);
        others.retain(|(part, _)| *part != Complex64::ZERO);
        self.others = others;
        self.main = self.main.and(next_leg.main);
        self.crossed.extend(next_leg.crossed.into_iter().map(|facet| (leg, facet)));
    }
}

/// Returns whether a part of a field is strong enough to count.
fn is_significant(part: Complex64) -> bool {
    part.norm_sqr() >= LEAST_PART * LEAST_PART
}

impl ImagePaths {
    /// Field of an element's image at a point, as [`crate::em::image::BoxRoom::illuminate`] gives it; zero where no
    /// path connects the two.
    pub fn illuminate(&self, element: &Element, image: usize, point: DVec3) -> Illumination {
        self.illuminate_past(element, &self.obstruction(image, element.position, point, None), point)
    }

    /// Relative field of an antenna's image at a point past facets, edges and walls. `known` keeps the edges beside
    /// paths to nearly the same point, so that they are searched only once.
    pub fn obstruction(
        &self,
        image: usize,
        antenna: DVec3,
        point: DVec3,
        known: Option<&mut EdgesBeside>,
    ) -> Obstruction<'_> {
        let image = self.images.get(image);
        let fields = image.map_or_else(Vec::new, |image| self.sequence_fields(image, antenna, point, known));
        Obstruction { image, fields }
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
        if !self.reflects_on_facets(sequence, &folded) {
            return Some(false);
        }
        let is_clear = |leg: usize| {
            let on = self.ends_on(sequence, leg, antenna);
            !self.environment.obstacles_between([folded.point(leg), folded.point(leg + 1)], on).is_blocked
        };
        Some((0..=sequence.len()).all(is_clear))
    }

    /// Returns whether all points of reflection of a path lie on their facets.
    fn reflects_on_facets(&self, sequence: &[FacetId], folded: &FoldedPath) -> bool {
        let reflection_points = folded.points().iter().skip(1);
        let is_on = |(&facet, &point): (&FacetId, &DVec3)| {
            self.environment.flat(facet).is_some_and(|flat| flat.contains(point))
        };
        sequence.iter().zip(reflection_points).all(is_on)
    }

    /// Facets on which a leg of a sequence begins and ends.
    fn ends_on(&self, sequence: &[FacetId], leg: usize, antenna: DVec3) -> [Option<FacetId>; 2] {
        let is_in_plane = |facet: &FacetId| {
            let flat = self.environment.flat(*facet);
            flat.is_some_and(|flat| flat.height(antenna).abs() < super::edges::SAME_M)
        };
        let first = if leg == 0 { self.mount.filter(is_in_plane) } else { sequence.get(leg - 1).copied() };
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
        if let Some(image) = obstruction.image.filter(|_| !obstruction.fields.is_empty()) {
            let departure = element.radar_from_world * (image.mirror.transpose() * direction);
            let polarisation = image.mirror * element.polarisation;
            let transverse = polarisation - direction * direction.dot(polarisation);
            let launched = Phasor3::real(transverse).scaled(element.pattern.field(departure));
            for of_sequence in &obstruction.fields {
                let SequenceField { sequence, crossed, .. } = of_sequence;
                let free = self.environment.reflected(sequence, crossed, direction, launched);
                field = field + free.times(of_sequence.field);
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
        let strongest = obstruction.fields.iter().max_by(|a, b| a.field.norm().total_cmp(&b.field.norm()));
        let folded = strongest.and_then(|strongest| self.folded(strongest.sequence, antenna, point));
        folded.map_or_else(Vec::new, |folded| folded.points().to_vec())
    }

    /// Corners of a path from an antenna to a point by an image, whether obstacles block it or not. It is the first
    /// path whose points of reflection lie on their facets, otherwise one with points beside them; empty where there is
    /// none. No rays are traced.
    pub fn possible_polyline(&self, image: usize, antenna: DVec3, point: DVec3) -> Vec<DVec3> {
        let Some(image) = self.images.get(image) else { return Vec::new() };
        let all = || image.sequences.iter().filter_map(|s| Some((s, self.folded(s, antenna, point)?)));
        let is_on = |(sequence, folded): &(&Vec<FacetId>, FoldedPath)| self.reflects_on_facets(sequence, folded);
        let found = all().find(is_on).or_else(|| all().next());
        found.map_or_else(Vec::new, |(_, folded)| folded.points().to_vec())
    }

    /// Relative field on the straight segment between two points, past edges and through walls. The points may lie on
    /// facets. It is the mean magnitude of both polarisations.
    pub fn field_on_segment(&self, [from, to]: [DVec3; 2], on: [Option<FacetId>; 2]) -> f64 {
        let length_m = from.distance(to);
        let direction = (to - from) / length_m.max(1e-12);
        let leg = Leg { from, direction, length_m, before_m: 0.0, total_m: length_m };
        let ends = LegEnds { on, sequence: &[] };
        let obstacles = self.obstacles_on(&leg, to, ends);
        let Some(LegField { main, crossed, others }) = self.leg_field(&leg, to, ends, &obstacles, None) else {
            return 0.0;
        };
        let transmission = |&facet: &FacetId| {
            self.environment.flat(facet).map_or(Complex64::ONE, |flat| {
                let Coefficients { te, tm } = flat.table.transmission(direction.dot(flat.normal).abs().min(1.0));
                0.5 * (te + tm)
            })
        };
        let transmitted =
            |(part, walls): (Complex64, &[FacetId])| part * walls.iter().map(transmission).product::<Complex64>();
        let others = others.iter().map(|(part, walls)| (*part, walls.as_slice()));
        let sum: Complex64 = std::iter::once((main.field, crossed.as_slice())).chain(others).map(transmitted).sum();
        sum.norm()
    }

    /// Relative fields past facets and edges by those sequences of an image by which a field arrives.
    fn sequence_fields<'a>(
        &self,
        image: &'a Image,
        antenna: DVec3,
        point: DVec3,
        mut known: Option<&mut EdgesBeside>,
    ) -> Vec<SequenceField<'a>> {
        let mut all: Vec<SequenceField> = Vec::new();
        let mut has_geometric = false;
        for (number, sequence) in (0u32..).zip(&image.sequences) {
            let known = known.as_deref_mut().map(|known| (known, number));
            let Some((main, others)) = self.fields_of(sequence, antenna, point, known) else { continue };
            let is_geometric = main.is_geometric;
            // Only one sequence can have a path of geometrical optics. A second one has the same path, on the seam of
            // two facets.
            if !(is_geometric && has_geometric) {
                all.extend(std::iter::once(main).chain(others).filter(|found| found.field != Complex64::ZERO));
            }
            has_geometric |= is_geometric;
        }
        all
    }

    /// Relative fields on the path by a sequence past facets, edges and walls. The first is by the walls that the path
    /// crosses, the others by other walls, on the other sides of edges. `None` where nothing is left.
    fn fields_of<'a>(
        &self,
        sequence: &'a [FacetId],
        antenna: DVec3,
        point: DVec3,
        mut known: Option<(&mut EdgesBeside, u32)>,
    ) -> Option<(SequenceField<'a>, Vec<SequenceField<'a>>)> {
        let folded = self.folded(sequence, antenna, point)?;
        if let Some((known, _)) = &mut known {
            known.is_at_corner |= folded.is_at_corner();
        }
        // Facets are tested first, because paths that they reject need no rays.
        let reflected = self.field_of_facets(sequence, &folded)?;
        let (mut tested, mut is_from_edge) = (Vec::with_capacity(folded.points().len()), false);
        for (i, leg) in path_legs(folded.points()).enumerate() {
            let leg = if is_from_edge { leg.off_edge() } else { leg };
            is_from_edge = leg.length_m < BEFORE_M;
            let ends = LegEnds { on: self.ends_on(sequence, i, antenna), sequence };
            tested.push((leg, ends, self.obstacles_on(&leg, folded.point(i + 1), ends)));
        }
        // Most paths in shadow end at a leg that is blocked and has no edge beside it. Blocked legs are first, so that
        // the edges beside the others are not searched in vain.
        let mut leg_fields: Vec<Option<LegField>> = tested.iter().map(|_| None).collect();
        let is_blocked = |(_, (_, _, obstacles)): &(usize, &(Leg, LegEnds, SegmentObstacles))| obstacles.is_blocked;
        let (blocked, free) = (tested.iter().enumerate(), tested.iter().enumerate());
        for (i, (leg, ends, obstacles)) in blocked.filter(is_blocked).chain(free.filter(|leg| !is_blocked(leg))) {
            let known = known.as_mut().map(|(known, number)| (&mut **known, (*number, i as u32)));
            let leg_field = self.leg_field(leg, folded.point(i + 1), *ends, obstacles, known)?;
            leg_fields.get_mut(i)?.replace(leg_field);
        }
        let mut path_field = PathField { main: reflected, crossed: Vec::new(), others: Vec::new() };
        for (i, leg_field) in leg_fields.into_iter().flatten().enumerate() {
            path_field.append(i, leg_field);
        }
        let PathField { main, crossed, others } = path_field;
        let main = SequenceField { sequence, field: main.field, is_geometric: main.is_geometric, crossed };
        let other = |(field, crossed)| SequenceField { sequence, field, is_geometric: false, crossed };
        Some((main, others.into_iter().map(other).collect()))
    }

    /// Relative field of the reflections of a path, by the apertures of its facets; `None` where nothing is left.
    fn field_of_facets(&self, sequence: &[FacetId], folded: &FoldedPath) -> Option<RelativeField> {
        let mut product = folded.corner_field;
        let mut aperture: Option<Aperture> = None;
        let (mut last, mut reflected): (Option<FacetId>, DVec3) = (None, DVec3::ZERO);
        for (i, (&facet, mut leg)) in sequence.iter().zip(path_legs(folded.points())).enumerate() {
            if leg.length_m < BEFORE_M && i > 0 {
                // The leg leads from face to face in their common edge, and has no direction of its own.
                leg.direction = reflected;
            }
            reflected = self.environment.flat(facet)?.mirror() * leg.direction;
            let corners = folded.corners_beside.iter().filter(|(index, _)| *index == i).map(|(_, passage)| passage);
            let own = self.facet_aperture(facet, &leg, folded.point(i + 1), corners)?;
            let in_corner = aperture.filter(|_| last.is_some_and(|last| self.corners.contains(last, facet)));
            let before = aperture.replace(in_corner.map_or(own, |before| before.joined(own)));
            if let (Some(before), None) = (before, in_corner) {
                product = product.and(before.relative);
            }
            last = Some(facet);
        }
        Some(aperture.map_or(product, |aperture| product.and(aperture.relative)))
    }

    /// Facets and obstacles on a leg, except the facets on which it ends.
    fn obstacles_on(&self, leg: &Leg, to: DVec3, ends: LegEnds) -> SegmentObstacles {
        if leg.length_m < BEFORE_M {
            return SegmentObstacles::default();
        }
        self.environment.obstacles_between([leg.from, to], ends.on)
    }

    /// Relative field on a leg past all facets except those on which it ends, and the walls that it crosses; `None`
    /// where nothing is left.
    fn leg_field(
        &self,
        leg: &Leg,
        to: DVec3,
        ends: LegEnds,
        obstacles: &SegmentObstacles,
        known: KnownEdges,
    ) -> Option<LegField> {
        let environment = &*self.environment;
        let mut others: Vec<(Complex64, Vec<FacetId>)> = Vec::new();
        if leg.length_m < BEFORE_M {
            return Some(LegField { main: RelativeField::FREE, crossed: Vec::new(), others });
        }
        let mut field = if obstacles.is_blocked { Complex64::ZERO } else { Complex64::ONE };
        let mut has_field = !obstacles.is_blocked;
        let found;
        let edges: &[EdgeBeside] = match known {
            Some((known, numbers)) => {
                known.by_leg.entry(numbers).or_insert_with(|| self.edges_beside(leg, to, ends, MOVED_M))
            }
            None => {
                found = self.edges_beside(leg, to, ends, 0.0);
                &found
            }
        };
        for EdgeBeside { edge, inwards, walls_behind, walls_beside } in edges {
            let Some(edge) = environment.diffracting_edges().get(*edge as usize) else { continue };
            let passage = leg.passage(edge, *inwards, environment.wavelength_m());
            let Some(passage) = passage else { continue };
            let part = passage.diffracted_part(environment.edge_reach());
            if !is_significant(part) {
                continue;
            }
            let (walls_behind, walls_beside) = (walls_behind.as_deref(), walls_beside.as_deref());
            // Whether the leg crosses the walls of a side, as its ray has found.
            let is_on_side = |walls: Option<&[FacetId]>| match walls {
                Some(walls) => !obstacles.is_blocked && self.are_same_walls(walls, &obstacles.crossed),
                None => obstacles.is_blocked,
            };
            let is_unsure = passage.clearance_m < UNSURE_M && is_on_side(walls_behind) != is_on_side(walls_beside);
            let is_behind = if is_unsure { is_on_side(walls_behind) } else { passage.is_behind };
            let part = if is_behind { part } else { -part };
            for (walls, part) in [(walls_beside, part), (walls_behind, -part)] {
                match walls {
                    Some(walls) if self.are_same_walls(walls, &obstacles.crossed) => field += part,
                    Some(walls) => match others.iter_mut().find(|(_, other)| self.are_same_walls(walls, other)) {
                        Some((sum, _)) => *sum += part,
                        None => others.push((part, walls.to_vec())),
                    },
                    None => {}
                }
            }
            has_field = true;
        }
        let main = RelativeField { field, is_geometric: !obstacles.is_blocked };
        has_field.then(|| LegField { main, crossed: obstacles.crossed.clone(), others })
    }

    /// Diffracting edges beside a leg: within reach (or up to `farther_m` beyond), seen from both ends, and with
    /// different walls on their two sides. Where no wall transmits, these are edges on the outline of their facets.
    fn edges_beside(&self, leg: &Leg, to: DVec3, ends: LegEnds, farther_m: f64) -> Vec<EdgeBeside> {
        let (environment, on) = (&*self.environment, ends.on);
        let of_corners = ends
            .sequence
            .iter()
            .copied()
            .filter(|&facet| on.into_iter().flatten().any(|end| end != facet && self.corners.contains(end, facet)));
        let facets = on.into_iter().flatten().chain(of_corners);
        let planes: Vec<u32> = facets.filter_map(|facet| Some(environment.flat(facet)?.plane)).collect();
        let wavelength_m = environment.wavelength_m();
        let reach_m = leg.leg_reach_m(environment);
        // At the ends of a path, where zones are narrow, edges out of reach stay out of reach.
        let most_nu = environment.edge_reach() * (1.0 + farther_m / reach_m);
        let mut near = Vec::with_capacity(USUALLY_NEAR);
        environment.edges_near(leg.from, to, reach_m + farther_m, &mut near);
        let found = |number: u32| {
            let edge = environment.diffracting_edges().get(number as usize)?;
            let is_behind = |facet: FacetId| environment.flat(facet).is_some_and(|flat| edge.is_behind(flat));
            if !edge.is_near(leg.from, leg.direction, leg.length_m, reach_m + farther_m)
                || planes.iter().any(|&plane| edge.bounds_plane(plane))
                || on.into_iter().flatten().any(is_behind)
                || !(environment.has_transmission() || edge.is_on_outline(leg.from, leg.direction))
            {
                return None;
            }
            let inwards = edge.widest_inwards(leg.direction);
            let passage = leg.passage(edge, inwards, wavelength_m).filter(|passage| passage.nu < most_nu)?;
            let [walls_behind, walls_beside] = self.walls_on_both_sides(edge, leg, to, on, &passage);
            let is_step = match (&walls_behind, &walls_beside) {
                (None, None) => false,
                (Some(behind), Some(beside)) => !self.are_same_walls(behind, beside),
                _ => true,
            };
            is_step.then_some(EdgeBeside { edge: number, inwards, walls_behind, walls_beside })
        };
        near.into_iter().filter_map(found).collect()
    }

    /// Walls that a path crosses just behind an edge, where the widest of its facets is, and just beside it, in the
    /// order of the path; `None` where it is blocked. Sides of the edge's own facets are known, and rays find all other
    /// walls.
    fn walls_on_both_sides(
        &self,
        edge: &DiffractingEdge,
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
                if !(environment.has_transmission() && transmits) {
                    return None;
                }
                // Both sides of a sheet are one wall.
                if walls.iter().all(|&other| plane(other) != plane(facet)) {
                    walls.push(facet);
                }
            }
            Some(walls)
        };
        let others = |by: DVec3| {
            let first = environment.obstacles_between([leg.from, by], [on[0], None]);
            if first.is_blocked {
                return None;
            }
            let second = environment.obstacles_between([by, to], [None, on[1]]);
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
            let by = passage.nearest + passage.outwards * aside_m;
            let mut walls = others(by)?;
            walls.extend(own);
            // Polarisations mix at walls that are not parallel, so their order matters.
            let along_m = |facet: &FacetId| {
                environment.flat(*facet).map_or(0.0, |flat| -flat.height(by) / flat.normal.dot(leg.direction))
            };
            walls.sort_by(|a, b| along_m(a).total_cmp(&along_m(b)));
            Some(walls)
        })
    }

    /// Returns whether two lists have the same walls: as many, and for each of one list one of the same plane and
    /// material in the other.
    fn are_same_walls(&self, some: &[FacetId], others: &[FacetId]) -> bool {
        let is_same = |a: FacetId, b: FacetId| match (self.environment.flat(a), self.environment.flat(b)) {
            (Some(a), Some(b)) => a.plane == b.plane && Arc::ptr_eq(&a.table, &b.table),
            _ => false,
        };
        some.len() == others.len() && some.iter().all(|&a| others.iter().any(|&b| is_same(a, b)))
    }
}

/// Legs of a path between its points.
fn path_legs(points: &[DVec3]) -> impl Iterator<Item = Leg> + '_ {
    let total_m: f64 = points.windows(2).map(|ends| ends[0].distance(ends[1])).sum();
    let mut before_m = 0.0;
    points.windows(2).map(move |ends| {
        let (from, to) = (ends[0], ends[1]);
        let length_m = from.distance(to);
        let leg = Leg { from, direction: (to - from) / length_m.max(1e-12), length_m, before_m, total_m };
        before_m += length_m;
        leg
    })
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
                let transmission = flat.table.transmission(direction.dot(normal).abs().min(1.0));
                let (te, tm) = incidence_frame(direction, normal);
                field = Phasor3::combine(transmission.te * field.along(te), te, transmission.tm * field.along(tm), tm);
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

    fn transmitting(facets: Vec<Facet>, antenna: DVec3, sequences: &[Vec<FacetId>]) -> ImagePaths {
        let environment = Environment::new(facets, K).expect("facets").with_transmission(true);
        ImagePaths::with_sequences(Arc::new(environment), antenna, sequences.to_vec())
    }

    /// A fence of slats is beside both legs of a reflected path. On each leg, the field passes through a slat or
    /// between two. Regression test: there was a field for every choice of an edge beside each leg.
    #[test]
    fn edges_of_the_same_walls_share_a_field() {
        let mirror = across(0.0, [-3.0, 3.0], Wall::Conductor);
        let slat = |i: i32| across(1.0, [0.08 * f64::from(i), 0.08 * f64::from(i) + 0.04], slab(0));
        let facets: Vec<Facet> = mirror.into_iter().chain((-12..12).flat_map(slat)).collect();
        let [antenna, point] = [-1.0, 1.0].map(|y| DVec3::new(2.0, y, 1.5));
        let paths = transmitting(facets, antenna, &[vec![0]]);
        let count = paths.obstruction(1, antenna, point, None).fields.len();
        assert!((2..=4).contains(&count), "{count}");
    }

    #[test]
    fn walls_beyond_an_edge_are_in_order() {
        let facets = [across(0.0, [-2.0, 0.0], slab(0)), across(0.5, [-2.0, 2.0], slab(1))].concat();
        let [from, to] = [-2.0, 2.0].map(|x| DVec3::new(x, 0.05, 1.5));
        let paths = transmitting(facets, from, &[]);
        let leg = Leg { from, direction: DVec3::X, length_m: 4.0, before_m: 0.0, total_m: 4.0 };
        let found = paths.edges_beside(&leg, to, LegEnds { on: [None; 2], sequence: &[] }, 0.0);
        let x = |facet: &FacetId| paths.environment().facet(*facet).map_or(f64::NAN, |facet| facet.corners[0].x);
        let xs = |walls: &Option<Vec<FacetId>>| walls.iter().flatten().map(x).collect::<Vec<f64>>();
        let all: Vec<[Vec<f64>; 2]> =
            found.iter().map(|edge| [xs(&edge.walls_behind), xs(&edge.walls_beside)]).collect();
        assert_eq!(all, [[vec![0.0, 0.5], vec![0.5]]]);
    }
}
