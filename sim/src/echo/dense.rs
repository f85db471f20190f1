//! Reference echoes of a skin: physical optics over its whole lit surface, recomputed in every chirp in double
//! precision.
//!
//! Surface, fields and occlusion are those of [`super::skin`], but none of its approximations is used: no window, no
//! key times, no choice of quadrature rules, no patches. Integrands are computed at every corner of the flat pieces,
//! and every piece has its own path and frequency. Only exact zeros are skipped, and quantities shared by several pairs
//! of images are computed once.

use std::f64::consts::TAU;

use glam::DVec3;
use num_complex::Complex64;
use radome_dsp::SPEED_OF_LIGHT_M_PER_S;

use super::skin::SkinnedPerson;
use super::{LEAST_DISTANCE_M, Snapshot, distinct_images, inside_room, self_occlusion};
use crate::em::current::{Arrival, received};
use crate::em::image::{Illumination, ImageIndex, Wall};
use crate::em::triangle;
use crate::geometry::bulge;
use crate::material::SKIN_PERMITTIVITY;
use crate::math::smooth_step;
use crate::people::skin::PosedSkin;
use crate::prepared_scene::PreparedScene;

/// Number of pieces per edge, each 2.5 mm long. Twice as many change a map by 0.02 dB (six of them: 0.07 dB).
const PIECES: usize = 8;
/// Tones of a chirp per cell of the range axis. A frequency between two tones is split between them by linear
/// interpolation.
const TONES_PER_CELL: f64 = 400.0;

/// Computes the samples of one chirp at every receiver, LSB: `[receiver][sample]`.
pub fn chirp(
    prepared: &PreparedScene,
    person: &SkinnedPerson,
    people: &[Snapshot],
    target: usize,
    pairs: &[(ImageIndex, ImageIndex)],
    time_s: f64,
    samples: usize,
) -> Vec<Vec<f64>> {
    let posed = person.mesh().posed(time_s);
    let indices = distinct_images(pairs.iter().flat_map(|&(p, q)| [p, q])).into_iter();
    let images: Vec<Image> = indices.map(|index| Image::new(prepared, person, people, target, index, &posed)).collect();
    let number = |index: ImageIndex| images.binary_search_by_key(&index, |image| image.index).ok();
    let pairs: Vec<[usize; 2]> = pairs.iter().filter_map(|&(p, q)| Some([number(p)?, number(q)?])).collect();
    let grid = Grid::new(PIECES);
    let mut tones = Tones::new(prepared, samples);
    let mut surface = Surface::default();
    let mut views: Vec<ImageView> = images.iter().map(|_| ImageView::default()).collect();
    for triangle in 0..person.mesh().skin().rest().triangles.len() {
        surface.pose(person, &posed, triangle, &grid);
        for (image, view) in images.iter().zip(&mut views) {
            view.illuminate_from(prepared, image, &surface, &grid);
        }
        for &[p, q] in &pairs {
            add_triangle(prepared, &surface, &grid, &views[p], &views[q], &mut tones);
        }
    }
    tones.samples()
}

/// Image of the antennas.
struct Image {
    index: ImageIndex,
    source: DVec3,
    sinks: Vec<DVec3>,
    /// Factors of obstruction by people and limbs on the field at each vertex.
    obstruction: Vec<f64>,
}

impl Image {
    fn new(
        prepared: &PreparedScene,
        person: &SkinnedPerson,
        people: &[Snapshot],
        target: usize,
        index: ImageIndex,
        posed: &PosedSkin,
    ) -> Self {
        let source = prepared.room.image_position(index, prepared.tx.position);
        let sinks: Vec<DVec3> = prepared.rx.iter().map(|rx| prepared.room.image_position(index, rx.position)).collect();
        let middle = 0.5 * (source + sinks.iter().sum::<DVec3>() / sinks.len().max(1) as f64);
        let all = vec![true; posed.vertices.len()];
        let by_limbs = self_occlusion::factors(person.mesh().skin(), posed, middle, prepared.wavelength_m, &all);
        let by_people = person.people_factors(prepared, people, target, index);
        let obstruction = by_limbs.iter().zip(by_people).map(|(a, b)| a * b).collect();
        Image { index, source, sinks, obstruction }
    }
}

/// Regular subdivision of a triangle into flat pieces.
struct Grid {
    /// Barycentric coordinates of the pieces' corners.
    nodes: Vec<[f64; 3]>,
    /// Barycentric coordinates of the middles of the pieces' edges.
    edge_middles: Vec<[f64; 3]>,
    /// Corners of each piece, then the middles of its edges, as indices.
    pieces: Vec<([usize; 3], [usize; 3])>,
}

impl Grid {
    fn new(cuts: usize) -> Self {
        let place = |i: usize, j: usize, n: usize| [(n - i - j) as f64, j as f64, i as f64].map(|w| w / n as f64);
        // Each row has one node fewer than the row before.
        let number = |[i, j]: [usize; 2], n: usize| i * (2 * n + 3 - i) / 2 + j;
        let all = |n: usize| (0..=n).flat_map(move |i| (0..=n - i).map(move |j| place(i, j, n))).collect();
        let mut pieces = Vec::new();
        let mut piece = |corners: [[usize; 2]; 3]| {
            let [a, b, c] = corners;
            let middle = |[i, j]: [usize; 2], [k, l]: [usize; 2]| number([i + k, j + l], 2 * cuts);
            pieces.push((corners.map(|corner| number(corner, cuts)), [middle(a, b), middle(b, c), middle(c, a)]));
        };
        for i in 0..cuts {
            for j in 0..cuts - i {
                piece([[i, j], [i, j + 1], [i + 1, j]]);
                if i + j + 2 <= cuts {
                    piece([[i + 1, j + 1], [i + 1, j], [i, j + 1]]);
                }
            }
        }
        Grid { nodes: all(cuts), edge_middles: all(2 * cuts), pieces }
    }
}

/// Triangle of the skin at all nodes.
#[derive(Default)]
struct Surface {
    corners: [u32; 3],
    cloth: [f64; 3],
    points: Vec<DVec3>,
    normals: Vec<DVec3>,
    /// Middles of the flat pieces' edges.
    edge_middles: Vec<DVec3>,
    /// Flat pieces: middle, velocity, twice the area.
    middles: Vec<DVec3>,
    velocities: Vec<DVec3>,
    twice_areas: Vec<f64>,
}

impl Surface {
    fn pose(&mut self, person: &SkinnedPerson, posed: &PosedSkin, triangle: usize, grid: &Grid) {
        let skin = person.mesh().skin();
        let at = |of: &[DVec3], i: u32| of.get(i as usize).copied().unwrap_or_default();
        self.corners = skin.rest().triangles.get(triangle).copied().unwrap_or_default();
        self.cloth = self.corners.map(|v| person.cloth().get(v as usize).copied().unwrap_or_default());
        let [points, normals, velocities] =
            [&posed.vertices, &posed.normals, &posed.velocities_m_per_s].map(|of| self.corners.map(|v| at(of, v)));
        let bulges = [(0, 1), (1, 2), (2, 0)].map(|(a, b)| bulge([points[a], points[b]], [normals[a], normals[b]]));
        let mean = |of: &[DVec3; 3], [a, b, c]: [f64; 3]| of[0] * a + of[1] * b + of[2] * c;
        let place = |w: &[f64; 3]| {
            let &[a, b, c] = w;
            mean(&points, *w) + 4.0 * (bulges[0] * (a * b) + bulges[1] * (b * c) + bulges[2] * (c * a))
        };
        refill(&mut self.points, grid.nodes.iter().map(place));
        refill(&mut self.edge_middles, grid.edge_middles.iter().map(place));
        refill(&mut self.normals, grid.nodes.iter().map(|w| mean(&normals, *w).normalize_or_zero()));
        let pieces = grid.pieces.iter().map(|(corners, _)| corners.map(|i| self.points[i]));
        refill(&mut self.middles, pieces.clone().map(|[a, b, c]| (a + b + c) / 3.0));
        refill(&mut self.twice_areas, pieces.map(|[a, b, c]| (b - a).cross(c - a).length()));
        let velocity = |(corners, _): &([usize; 3], [usize; 3])| {
            corners.iter().map(|&i| mean(&velocities, grid.nodes[i])).sum::<DVec3>() / 3.0
        };
        refill(&mut self.velocities, grid.pieces.iter().map(velocity));
    }
}

/// Refills a list and keeps its allocation.
fn refill<T>(list: &mut Vec<T>, items: impl Iterator<Item = T>) {
    list.clear();
    list.extend(items);
}

/// Triangle seen from the antennas of an image.
#[derive(Default)]
struct ImageView {
    /// Whether any part of the triangle faces an antenna and is not fully obstructed.
    is_lit: bool,
    /// Factors of obstruction by limbs and people at the corners.
    obstruction: [f64; 3],
    /// Fields of the transmitter and of the first receiver at the pieces' corners; `None` where they face away.
    from_tx: Vec<Option<Illumination>>,
    from_rx: Vec<Option<Illumination>>,
    tx: Legs,
    rx: Vec<Legs>,
}

/// Path lengths to an antenna.
#[derive(Default)]
struct Legs {
    /// Lengths from the middles of the flat pieces, m, and their rates, m/s.
    lengths_m: Vec<f64>,
    rates_m_per_s: Vec<f64>,
    /// Excess length at the corners of each piece, and its mean over the middles of the edges, m.
    corners_m: Vec<[f64; 3]>,
    edges_m: Vec<f64>,
}

impl Legs {
    fn measure(&mut self, antenna: DVec3, surface: &Surface, grid: &Grid) {
        refill(&mut self.lengths_m, surface.middles.iter().map(|p| p.distance(antenna)));
        let rate = |(p, v): (&DVec3, &DVec3)| (*p - antenna).normalize_or_zero().dot(*v);
        refill(&mut self.rates_m_per_s, surface.middles.iter().zip(&surface.velocities).map(rate));
        let at_nodes: Vec<f64> = surface.points.iter().map(|p| p.distance(antenna)).collect();
        let at_edge_middles: Vec<f64> = surface.edge_middles.iter().map(|p| p.distance(antenna)).collect();
        let pieces = || grid.pieces.iter().zip(&self.lengths_m);
        let corners = pieces().map(|((corners, _), length)| corners.map(|i| at_nodes[i] - length)).collect();
        let edges =
            pieces().map(|((_, edges), length)| edges.iter().map(|&i| at_edge_middles[i]).sum::<f64>() / 3.0 - length);
        self.edges_m = edges.collect();
        self.corners_m = corners;
    }
}

impl ImageView {
    /// Computes fields and path lengths of a triangle for an image.
    fn illuminate_from(&mut self, prepared: &PreparedScene, image: &Image, surface: &Surface, grid: &Grid) {
        let (Some(first), Some(sink)) = (prepared.rx.first(), image.sinks.first()) else { return };
        self.obstruction = surface.corners.map(|v| image.obstruction.get(v as usize).copied().unwrap_or_default());
        let is_unobstructed = self.obstruction.iter().any(|factor| *factor > 0.0);
        let faces =
            |antenna: DVec3| surface.points.iter().zip(&surface.normals).any(|(p, n)| n.dot(antenna - *p) > 0.0);
        self.is_lit = is_unobstructed && (faces(image.source) || faces(*sink));
        if !self.is_lit {
            return;
        }
        let fields = |element, antenna: DVec3| {
            let field = |(point, normal): (&DVec3, &DVec3)| {
                (normal.dot(antenna - *point) > 0.0).then(|| prepared.room.illuminate(element, image.index, *point))
            };
            surface.points.iter().zip(&surface.normals).map(field).collect()
        };
        (self.from_tx, self.from_rx) = (fields(&prepared.tx, image.source), fields(first, *sink));
        self.tx.measure(image.source, surface, grid);
        self.rx.resize_with(image.sinks.len(), Legs::default);
        for (legs, sink) in self.rx.iter_mut().zip(&image.sinks) {
            legs.measure(*sink, surface, grid);
        }
    }
}

/// Adds the echo of a triangle from one image to another.
fn add_triangle(
    prepared: &PreparedScene,
    surface: &Surface,
    grid: &Grid,
    outbound: &ImageView,
    inbound: &ImageView,
    tones: &mut Tones,
) {
    if !(outbound.is_lit && inbound.is_lit) {
        return;
    }
    let k = TAU / prepared.wavelength_m;
    let aperture = prepared.aperture_m();
    let factor = Complex64::new(0.0, -k * aperture / TAU);
    let skin = Wall::HalfSpace { permittivity: SKIN_PERMITTIVITY };
    let weights = [0, 1, 2].map(|i| outbound.obstruction[i] * inbound.obstruction[i] * surface.cloth[i]);
    let integrand = |i: usize| {
        let (Some(from_tx), Some(from_rx)) = (&outbound.from_tx[i], &inbound.from_rx[i]) else {
            return Complex64::ZERO;
        };
        let half_sum = 0.5 * (from_tx.direction + from_rx.direction).length();
        let [a, b, c] = grid.nodes[i];
        let weight = (weights[0] * a + weights[1] * b + weights[2] * c)
            * smooth_step((half_sum - 0.2) / 0.1)
            * inside_room(prepared, surface.points[i]);
        if weight == 0.0 {
            return Complex64::ZERO;
        }
        let arrival = Arrival { field: from_tx.field, direction: from_tx.direction };
        let received = received(&arrival, surface.normals[i], &skin, k, -from_rx.direction, from_rx.field);
        let spreading = 1.0 / (from_tx.distance_m.max(LEAST_DISTANCE_M) * from_rx.distance_m.max(LEAST_DISTANCE_M));
        factor * received * (spreading * weight)
    };
    let integrands: Vec<Complex64> = (0..grid.nodes.len()).map(integrand).collect();
    let Some(first) = inbound.rx.first() else { return };
    for (piece, (corners, _)) in grid.pieces.iter().enumerate() {
        let integrands = corners.map(|i| integrands[i]);
        if integrands == [Complex64::ZERO; 3] {
            continue;
        }
        // Over a piece the integrand is linear, and so is the path except for a mean offset. The offset is the same for
        // all receivers, which are millimetres apart.
        let excess = [0, 1, 2].map(|i| outbound.tx.corners_m[piece][i] + first.corners_m[piece][i]);
        let bend = outbound.tx.edges_m[piece] + first.edges_m[piece] - (excess[0] + excess[1] + excess[2]) / 3.0;
        let [a, b, c] = excess.map(|l| -k * (l + bend));
        let [x, y, z] = triangle::moments(a, b, c);
        let field = (x * integrands[0] + y * integrands[1] + z * integrands[2]) * surface.twice_areas[piece];
        for (rx, legs) in inbound.rx.iter().enumerate() {
            let length_m = outbound.tx.lengths_m[piece] + legs.lengths_m[piece];
            let rate_m_per_s = outbound.tx.rates_m_per_s[piece] + legs.rates_m_per_s[piece];
            tones.add(rx, field, length_m / SPEED_OF_LIGHT_M_PER_S, rate_m_per_s / SPEED_OF_LIGHT_M_PER_S);
        }
    }
}

/// Amplitudes of closely spaced tones of a chirp.
struct Tones<'a> {
    prepared: &'a PreparedScene,
    samples: usize,
    /// Distance between tones, Hz.
    step_hz: f64,
    /// Index of the first tone. A tone's frequency is its index times the step.
    first: i64,
    /// Amplitudes at the middle of the chirp, before gain and filters: `[receiver][tone]`.
    amplitudes: Vec<Vec<Complex64>>,
}

impl<'a> Tones<'a> {
    fn new(prepared: &'a PreparedScene, samples: usize) -> Self {
        let step_hz = prepared.chirp.sample_rate_hz / (samples as f64 * TONES_PER_CELL);
        Tones { prepared, samples, step_hz, first: 0, amplitudes: vec![Vec::new(); prepared.rx.len()] }
    }

    /// Adds a field given without the phase of its path.
    fn add(&mut self, rx: usize, field: Complex64, delay_s: f64, delay_rate: f64) {
        let chirp = &self.prepared.chirp;
        let cycles = chirp.phase_cycles(delay_s);
        let amplitude = field.conj() * Complex64::from_polar(1.0, TAU * (cycles - cycles.round()));
        let position = chirp.beat_hz(delay_s, delay_rate) / self.step_hz;
        let below = position.floor();
        let at = self.slot(below as i64);
        if let Some([one, other]) = self.amplitudes.get_mut(rx).and_then(|all| all.get_mut(at..at + 2)?.as_mut_array())
        {
            *one += amplitude * (below + 1.0 - position);
            *other += amplitude * (position - below);
        }
    }

    /// Returns the index of a tone in the lists of amplitudes, after making room for it and the next.
    fn slot(&mut self, number: i64) -> usize {
        let len = self.amplitudes.first().map_or(0, Vec::len);
        if len == 0 {
            self.first = number;
        }
        let before = (self.first - number).max(0) as usize;
        let after = (number + 2 - self.first).max(0) as usize;
        if before > 0 || after > len {
            self.first -= before as i64;
            for all in &mut self.amplitudes {
                all.splice(0..0, std::iter::repeat_n(Complex64::ZERO, before));
                all.resize((before + len).max(before + after), Complex64::ZERO);
            }
        }
        (number - self.first) as usize
    }

    /// Returns the sum of the tones at the ADC: `[receiver][sample]`.
    fn samples(&self) -> Vec<Vec<f64>> {
        let middle = (self.samples / 2) as f64;
        let of_receiver = |(rx, all): (usize, &Vec<Complex64>)| {
            let mut out = vec![0.0; self.samples];
            for (number, amplitude) in (self.first..).zip(all).filter(|(_, a)| **a != Complex64::ZERO) {
                let beat_hz = number as f64 * self.step_hz;
                let cycles = beat_hz / self.prepared.chirp.sample_rate_hz;
                let phasor = |samples: f64| Complex64::from_polar(1.0, TAU * cycles * samples);
                let amplitude = amplitude * self.prepared.at_adc(rx, Complex64::ONE, beat_hz);
                // Four samples are computed in parallel.
                let mut four: [Complex64; 4] = std::array::from_fn(|i| amplitude * phasor(i as f64 - middle));
                let step = phasor(4.0);
                for chunk in out.chunks_mut(4) {
                    for (x, value) in chunk.iter_mut().zip(&mut four) {
                        *x += value.re;
                        *value *= step;
                    }
                }
            }
            out
        };
        self.amplitudes.iter().enumerate().map(of_receiver).collect()
    }
}
