//! Discovery of the facet sequences by which paths from an antenna are reflected, by launching rays, and of the antenna
//! images that these sequences make.
//!
//! Rays are launched in the directions of a subdivided icosahedron. Where the rays at the corners of one of its
//! triangles hit different facets, the triangle is divided into four, repeatedly. Rays thus concentrate at the edges of
//! facets. Further rays are aimed at every facet, for facets so small that all others miss them. The result depends on
//! geometry alone, never on threads.

use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use super::corner_runs::CornerRuns;
use super::corners::Corners;
use super::environment::Environment;
use super::flat::{FacetId, Flat};
use super::groups::groups;
use crate::geometry::shape::icosahedron;

/// Largest number of reflections of a path.
pub const MAX_ORDER: usize = 6;
/// Initial halvings of the icosahedron's edges: 2,562 rays, 4 degrees apart.
const FIRST_HALVINGS: u32 = 4;
/// Images nearer to each other than this are merged, m.
const MERGE_M: f64 = 1e-9;
/// Mirror matrices are merged if they differ less than this in all elements.
const MERGE_MIRROR: f64 = 1e-10;
/// Largest number of walls that a ray crosses on its path.
const MOST_CROSSED: u32 = 1;
/// Direction that is parallel to no typical edge of a building.
const ASKEW: DVec3 = DVec3::new(1.0, 0.754_877_666_2, 0.569_840_291_0);
/// Cosine up to which planes count as perpendicular.
const RIGHT_ANGLE: f64 = 1e-12;

/// Settings of the ray launch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LaunchOptions {
    /// Largest number of reflections of a path, at most [`MAX_ORDER`].
    pub max_order: usize,
    /// Number of divisions of the triangles of directions: four reduce the spacing from 4 degrees to 0.26.
    pub refinements: u32,
    /// Number of rays after which no more triangles are divided.
    pub max_rays: usize,
}

impl Default for LaunchOptions {
    fn default() -> Self {
        LaunchOptions { max_order: 3, refinements: 4, max_rays: 100_000 }
    }
}

/// Cost and results of a search.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct DiscoveryReport {
    /// Rays launched.
    pub rays: usize,
    /// Facet sequences, including the empty one.
    pub sequences: usize,
    /// Images of these sequences, including the antenna itself.
    pub images: usize,
    /// Whether the limit on rays left some triangles undivided.
    pub reached_limit: bool,
}

/// Facets that reflect one ray, in order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct RaySequence {
    facets: [FacetId; MAX_ORDER],
    length: usize,
}

/// Image of an antenna and the facet sequences that make it.
#[derive(Debug, Clone, PartialEq)]
pub struct Image {
    /// Number of reflections.
    pub order: usize,
    /// Position of the image of the antenna from which rays were launched, m.
    pub position: DVec3,
    /// Mirror matrix of the antenna's vectors: product of the facets' reflections.
    pub mirror: DMat3,
    /// Image of the origin, m: a point at `x` has its image at `mirror * x + shift`.
    pub shift: DVec3,
    /// The sequences, with facets in the order in which waves meet them.
    pub sequences: Vec<Vec<FacetId>>,
}

impl Image {
    /// Image of a point, m.
    pub fn of(&self, point: DVec3) -> DVec3 {
        self.mirror * point + self.shift
    }
}

/// Paths that leave an antenna, represented by its images.
#[derive(Debug, Clone)]
pub struct ImagePaths {
    pub(super) environment: Arc<Environment>,
    pub(super) images: Vec<Image>,
    /// The facet on which the antenna is mounted, if any.
    pub(super) mount: Option<FacetId>,
    pub(super) corners: Corners,
    pub(super) runs: CornerRuns,
    report: DiscoveryReport,
}

impl ImagePaths {
    /// Finds the paths that leave a point.
    pub fn discover(environment: Arc<Environment>, origin: DVec3, options: &LaunchOptions) -> Self {
        let mut launch = Launch::new(&environment, origin, environment.facet_at(origin), options);
        launch.refine(options);
        launch.aim_at_facets(options.max_rays);
        let (rays, reached_limit) = (launch.directions.len(), launch.reached_limit);
        let sequences = with_exchanged(&environment, origin, launch.sequences());
        let found = Self::with_sequences(environment, origin, sequences);
        ImagePaths { report: DiscoveryReport { rays, reached_limit, ..found.report }, ..found }
    }

    /// Builds the images of a point for given sequences; the point itself is the first.
    pub fn with_sequences(
        environment: Arc<Environment>,
        origin: DVec3,
        sequences: impl IntoIterator<Item = Vec<FacetId>>,
    ) -> Self {
        let mut all: BTreeSet<(usize, Vec<FacetId>)> = sequences.into_iter().map(|s| (s.len(), s)).collect();
        all.insert((0, Vec::new()));
        let count = all.len();
        let images = make_images(&environment, origin, all.into_iter().map(|(_, sequence)| sequence));
        let report = DiscoveryReport { sequences: count, images: images.len(), ..DiscoveryReport::default() };
        let sequences = images.iter().flat_map(|image| &image.sequences);
        let (mount, corners) = (environment.facet_at(origin), Corners::in_sequences(&environment, sequences));
        let runs = CornerRuns::in_images(&environment, &corners, images.iter().map(|image| image.sequences.as_slice()));
        ImagePaths { environment, images, mount, corners, runs, report }
    }

    /// The images, the antenna itself first, sorted by order.
    pub fn images(&self) -> &[Image] {
        &self.images
    }

    /// The facets.
    pub fn environment(&self) -> &Environment {
        &self.environment
    }

    /// Cost and results of the search.
    pub fn report(&self) -> DiscoveryReport {
        self.report
    }
}

/// Returns whether waves from a point may meet facets in this order, tested on planes only. Each facet must face the
/// image before it, and neighbours must have some part before each other.
pub(super) fn is_possible(environment: &Environment, origin: DVec3, sequence: &[FacetId]) -> bool {
    let mut image = origin;
    let mut last = None;
    for &facet in sequence {
        let Some(flat) = environment.flat(facet) else { return false };
        if !flat.reflects() || flat.height(image) < MERGE_M {
            return false;
        }
        if let Some(before) = last.and_then(|facet| environment.flat(facet))
            && !(has_part_before(before, flat) && has_part_before(flat, before))
        {
            return false;
        }
        image = flat.mirrored(image);
        last = Some(facet);
    }
    true
}

/// Returns whether some corner of another facet lies before the plane of a facet.
fn has_part_before(flat: &Flat, other: &Flat) -> bool {
    other.facet.corners.iter().any(|&corner| flat.height(corner) > MERGE_M)
}

/// Adds the sequences that follow from those found by exchange of neighbours. Successive reflections at perpendicular
/// planes may be exchanged without changing the image. Every prefix of a sequence is a sequence, too.
fn with_exchanged(environment: &Environment, origin: DVec3, found: BTreeSet<Vec<FacetId>>) -> BTreeSet<Vec<FacetId>> {
    let mut pending: Vec<Vec<FacetId>> = found.iter().cloned().collect();
    let mut all = found;
    while let Some(sequence) = pending.pop() {
        for i in 1..sequence.len() {
            let normal = |index: usize| sequence.get(index).and_then(|&facet| environment.normal(facet));
            let (Some(a), Some(b)) = (normal(i - 1), normal(i)) else { continue };
            if a.dot(b).abs() > RIGHT_ANGLE {
                continue;
            }
            let mut exchanged = sequence.clone();
            exchanged.swap(i - 1, i);
            for length in [i, exchanged.len()] {
                let prefix = exchanged.get(..length).unwrap_or_default().to_vec();
                if !all.contains(&prefix) && is_possible(environment, origin, &prefix) {
                    all.insert(prefix.clone());
                    pending.push(prefix);
                }
            }
        }
    }
    all
}

/// Makes the images of sequences, which are ordered by length; coincident images are merged.
fn make_images(environment: &Environment, origin: DVec3, sequences: impl Iterator<Item = Vec<FacetId>>) -> Vec<Image> {
    let mut all: Vec<Image> = sequences
        .map(|sequence| {
            let (mut position, mut shift, mut mirror) = (origin, DVec3::ZERO, DMat3::IDENTITY);
            for flat in sequence.iter().filter_map(|&facet| environment.flat(facet)) {
                (position, shift, mirror) = (flat.mirrored(position), flat.mirrored(shift), flat.mirror() * mirror);
            }
            Image { order: sequence.len(), position, mirror, shift, sequences: vec![sequence] }
        })
        .collect();
    // In axis-aligned rooms thousands of images share a coordinate; along this direction only coincident images do.
    let coordinates: Vec<f64> = all.iter().map(|image| image.position.dot(ASKEW)).collect();
    for group in groups(&coordinates, 3.0 * MERGE_M, |i, j| is_same(&all[i], &all[j])) {
        for &other in &group[1..] {
            let moved = std::mem::take(&mut all[other].sequences);
            all[group[0]].sequences.extend(moved);
        }
    }
    all.retain(|image| !image.sequences.is_empty());
    for image in &mut all {
        image.sequences.sort();
    }
    all.sort_by(|a, b| a.order.cmp(&b.order).then_with(|| a.sequences.cmp(&b.sequences)));
    all
}

/// Returns whether two images coincide within tolerances.
fn is_same(a: &Image, b: &Image) -> bool {
    let distance = |p: DVec3, q: DVec3| (p - q).abs().max_element();
    let columns = |m: &DMat3| [m.x_axis, m.y_axis, m.z_axis];
    a.order == b.order
        && distance(a.position, b.position) <= MERGE_M
        && columns(&a.mirror).into_iter().zip(columns(&b.mirror)).all(|(p, q)| distance(p, q) <= MERGE_MIRROR)
}

/// Launch of rays in all directions.
struct Launch<'a> {
    environment: &'a Environment,
    origin: DVec3,
    /// The facet on which the antenna is mounted, if any.
    mount: Option<FacetId>,
    max_order: usize,
    directions: Vec<DVec3>,
    /// Sequences by direction, as far as they are traced: of the ray that is reflected everywhere, and of rays that
    /// cross a wall.
    sequences: Vec<Vec<RaySequence>>,
    /// Triangles of directions that may be divided.
    triangles: Vec<[usize; 3]>,
    reached_limit: bool,
}

impl<'a> Launch<'a> {
    fn new(environment: &'a Environment, origin: DVec3, mount: Option<FacetId>, options: &LaunchOptions) -> Self {
        let (directions, triangles) = turned_icosahedron();
        let mut launch = Launch {
            environment,
            origin,
            mount,
            max_order: options.max_order.min(MAX_ORDER),
            directions,
            sequences: Vec::new(),
            triangles,
            reached_limit: false,
        };
        for _ in 0..FIRST_HALVINGS {
            let all = std::mem::take(&mut launch.triangles);
            launch.divide(&all);
        }
        launch.trace_new();
        launch
    }

    /// Divides triangles with different sequences at their corners.
    fn refine(&mut self, options: &LaunchOptions) {
        for _ in 0..options.refinements {
            let sequences = &self.sequences;
            let differ = |t: &[usize; 3]| {
                let [a, b, c] = t.map(|i| sequences.get(i));
                a != b || b != c
            };
            let to_divide: Vec<[usize; 3]> = self.triangles.iter().filter(|t| differ(t)).copied().collect();
            if to_divide.is_empty() {
                break;
            }
            // Each triangle has three new corners at most, and most of them are shared with a neighbour.
            if self.directions.len() + 3 * to_divide.len() / 2 > options.max_rays {
                self.reached_limit = true;
                break;
            }
            self.divide(&to_divide);
            self.trace_new();
        }
    }

    /// Aims rays at the middle of each facet that faces the antenna and halfway from there to its corners, until
    /// `max_rays` is reached.
    fn aim_at_facets(&mut self, max_rays: usize) {
        for facet in 0..self.environment.len() {
            let Some(flat) = self.environment.flat(facet as FacetId) else { continue };
            let corners = &flat.facet.corners;
            if corners.is_empty() || !flat.reflects() || flat.height(self.origin) < MERGE_M {
                continue;
            }
            if self.directions.len() + corners.len() >= max_rays {
                self.reached_limit = true;
                break;
            }
            let middle = corners.iter().sum::<DVec3>() / corners.len() as f64;
            let targets = std::iter::once(middle).chain(corners.iter().map(|&corner| middle.midpoint(corner)));
            let origin = self.origin;
            self.directions.extend(targets.map(|target| (target - origin).normalize_or(DVec3::X)));
        }
        self.trace_new();
    }

    /// Divides triangles into quarters, which replace all triangles of the launch. Adds directions for the new corners.
    fn divide(&mut self, triangles: &[[usize; 3]]) {
        let mut middles: HashMap<(usize, usize), usize> = HashMap::with_capacity(2 * triangles.len());
        let mut quarters = Vec::with_capacity(4 * triangles.len());
        for &[a, b, c] in triangles {
            let mut middle = |i: usize, j: usize| {
                let directions = &mut self.directions;
                *middles.entry((i.min(j), i.max(j))).or_insert_with(|| {
                    let corner = |k: usize| directions.get(k).copied().unwrap_or(DVec3::X);
                    let direction = (corner(i) + corner(j)).normalize_or(DVec3::X);
                    directions.push(direction);
                    directions.len() - 1
                })
            };
            let (ab, bc, ca) = (middle(a, b), middle(b, c), middle(c, a));
            quarters.extend([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]);
        }
        self.triangles = quarters;
    }

    /// Traces the directions that have not been traced yet.
    fn trace_new(&mut self) {
        let first = self.sequences.len();
        let new: Vec<Vec<RaySequence>> =
            self.directions.get(first..).unwrap_or_default().par_iter().map(|&d| self.trace(d)).collect();
        self.sequences.extend(new);
    }

    /// Traces a ray in a direction. If walls transmit waves, a further ray continues behind each wall that it meets.
    fn trace(&self, direction: DVec3) -> Vec<RaySequence> {
        let sequence = RaySequence { facets: [FacetId::MAX; MAX_ORDER], length: 0 };
        if let Some(flat) = self.mount.and_then(|facet| self.environment.flat(facet))
            && flat.normal.dot(direction) <= 0.0
        {
            return vec![sequence];
        }
        let mut found = Vec::with_capacity(1);
        let walls_left = if self.environment.has_transmission() { MOST_CROSSED } else { 0 };
        let mut pending = vec![RayState { from: self.origin, direction, on: self.mount, sequence, walls_left }];
        while let Some(mut ray) = pending.pop() {
            while ray.sequence.length < self.max_order {
                let Some((facet, point)) = self.environment.first_hit(ray.from, ray.direction, ray.on) else { break };
                let Some(flat) = self.environment.flat(facet) else { break };
                (ray.from, ray.on) = (point, Some(facet));
                if ray.walls_left > 0 && flat.transmits {
                    pending.push(RayState { walls_left: ray.walls_left - 1, ..ray });
                }
                if let Some(slot) = ray.sequence.facets.get_mut(ray.sequence.length) {
                    *slot = facet;
                }
                ray.sequence.length += 1;
                ray.direction -= flat.normal * (2.0 * flat.normal.dot(ray.direction));
            }
            found.push(ray.sequence);
        }
        found
    }

    /// Sequences of all rays, and all prefixes of these.
    fn sequences(&self) -> BTreeSet<Vec<FacetId>> {
        let mut sequences: Vec<RaySequence> = self.sequences.iter().flatten().copied().collect();
        sequences.sort_unstable();
        sequences.dedup();
        let prefixes = |sequence: &RaySequence| {
            let facets = sequence.facets;
            (0..=sequence.length).map(move |length| facets.iter().take(length).copied().collect::<Vec<_>>())
        };
        sequences.iter().flat_map(prefixes).collect()
    }
}

/// State of a ray during tracing.
#[derive(Debug, Clone, Copy)]
struct RayState {
    from: DVec3,
    direction: DVec3,
    /// Facet on which the ray begins, if any.
    on: Option<FacetId>,
    /// Facets that have reflected the ray.
    sequence: RaySequence,
    /// Number of walls that the ray may still cross.
    walls_left: u32,
}

/// Corners and triangles of an icosahedron, rotated so that it has no plane in common with rooms.
fn turned_icosahedron() -> (Vec<DVec3>, Vec<[usize; 3]>) {
    let turn = DMat3::from_rotation_z(0.377) * DMat3::from_rotation_x(0.611) * DMat3::from_rotation_y(0.213);
    let (corners, triangles) = icosahedron();
    (corners.into_iter().map(|corner| (turn * corner).normalize()).collect(), triangles)
}
