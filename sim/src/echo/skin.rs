//! Echoes of somebody whose body is a mesh: physical optics near its highlights, patch by patch.
//!
//! Physical optics over the skin needs only where the path hardly changes: a smooth window over the angle between normal and
//! bisector keeps highlights with several Fresnel zones around them and lets go of the rest, which cancels. Inside the window
//! each triangle is integrated in closed form ([`crate::field::curved_triangle`]) at the key times, and is between them a point
//! of the body with an exact delay whose strength changes slowly. Triangles of one small patch are summed chirp by chirp
//! ([`super::chirp_sum`]) into one tone: nothing has to be found, followed or matched between key times, and highlights that
//! are born, merge and die do so in the sum.
//!
//! A way and its reverse differ by the few millimetres between transmitter and receivers: they are integrated once.
//!
//! Strength at the vertices: what the image antenna's field makes of skin there (both polarisations, true incidence), cloth,
//! pattern, walls, and what people and the body's own limbs leave of it.

use glam::{DVec3, Vec3};
use num_complex::Complex64;

use super::chirp_sum::{ChirpSums, Direction};
use super::demand::{Demand, Fineness, Missed};
use super::patch::{FrameTimes, Patch, Place, TriangleKey, middle_antenna, missed_between_keys};
use super::{EchoReport, LEAST_DISTANCE_M, Snapshot, inside_room, past_people, self_shadow};
use crate::actor::body::SEGMENTS;
use crate::actor::skin::{PosedSkin, WalkingMesh};
use crate::actor::track::smooth_step;
use crate::field::Phasor3;
use crate::field::boundary::Boundary;
use crate::field::current::{Arrival, heard_by};
use crate::field::curved_triangle::{CurvedTriangle, Integrator, LANES, MOST_CUTS, View};
use crate::field::image::{Element, ImageIndex};
use crate::scene::material::SKIN_PERMITTIVITY;
use crate::stage::Stage;
use crate::synthesis::{ChirpGrids, EchoWay, phasor};

/// Somebody with a skin.
#[derive(Debug, Clone)]
pub struct SkinnedPerson {
    mesh: WalkingMesh,
    /// Factor of clothes on amplitude at each vertex.
    cloth: Vec<f64>,
}

/// What an image antenna throws on the vertices.
struct Light<'a> {
    fields: &'a [Phasor3],
    /// What people and limbs leave of them.
    weights: Vec<f64>,
    antenna: DVec3,
}

/// Triangles that shine between two images, with their cuts.
struct Pair {
    images: [usize; 2],
    fineness: Fineness,
    /// Patch by patch.
    triangles: Vec<PairTriangle>,
    /// Of the skin; what is said of vertices here is in their order.
    vertices: Vec<u32>,
}

/// A triangle that shines between two images.
#[derive(Debug, Clone, Copy)]
struct PairTriangle {
    number: u32,
    patch: u32,
    /// Places in the pair's list of vertices.
    corners: [u32; 3],
    cuts: usize,
}

/// A triangle in a pose, whoever looks at it.
#[derive(Debug, Clone, Copy)]
struct PosedTriangle {
    curved: CurvedTriangle,
    /// Of the middle, m/s, and of the corners against it.
    velocity: DVec3,
    against: [Vec3; 3],
}

/// Those triangles that somebody looks at: close together in memory, by number.
struct PosedTriangles {
    slots: Vec<u32>,
    triangles: Vec<PosedTriangle>,
}

impl PosedTriangles {
    fn get(&self, number: u32) -> Option<&PosedTriangle> {
        self.triangles.get(*self.slots.get(number as usize)? as usize)
    }
}

impl SkinnedPerson {
    /// Somebody who moves as a mesh.
    pub fn new(mesh: WalkingMesh) -> Self {
        let cloth = mesh.skin().blend(&mesh.motion().person.cloth);
        SkinnedPerson { mesh, cloth }
    }

    /// Factor of clothes on amplitude at each vertex.
    pub fn cloth(&self) -> &[f64] {
        &self.cloth
    }

    /// What other people, and the body itself before the last wall, leave of an image antenna's field at each vertex: by
    /// segment, as vertices follow those.
    pub fn past_people(&self, stage: &Stage, people: &[Snapshot], me: usize, index: ImageIndex) -> Vec<f64> {
        let Some(own) = people.get(me) else { return vec![1.0; self.cloth.len()] };
        let of_segment: [f64; SEGMENTS] =
            std::array::from_fn(|s| past_people(stage, people, me, index, stage.tx.position, own.body[s].centre));
        if of_segment.iter().all(|&w| w == 1.0) {
            return vec![1.0; self.cloth.len()];
        }
        self.mesh.skin().blend(&of_segment)
    }

    /// The mesh in motion.
    pub fn mesh(&self) -> &WalkingMesh {
        &self.mesh
    }

    /// Adds somebody's echoes in a frame to grids. `people` are everybody's snapshots at the keys, of whom this is number `me`.
    /// `pairs` are those that can be heard and how loud, the loudest first; each way and its reverse count as one. Returns what
    /// is missed of the loudest pair's field.
    #[allow(clippy::too_many_arguments)]
    pub fn add_echoes(
        &self,
        stage: &Stage,
        integrator: &Integrator,
        demand: &Demand,
        times: &FrameTimes,
        people: &[Vec<Snapshot>],
        me: usize,
        pairs: &[((ImageIndex, ImageIndex), f64)],
        grids: &mut ChirpGrids,
        report: &mut EchoReport,
    ) -> Missed {
        let times_s = &times.keys_s;
        let posed: Vec<PosedSkin> = times_s.iter().map(|&t| self.mesh.posed(t)).collect();
        let mut ways: Vec<([ImageIndex; 2], f64)> = Vec::new();
        for &((p, q), loudness) in pairs {
            let way = [p.min(q), p.max(q)];
            if !ways.iter().any(|(known, _)| *known == way) {
                ways.push((way, loudness));
            }
        }
        let mut indices: Vec<ImageIndex> = ways.iter().flat_map(|(way, _)| *way).collect();
        indices.sort_unstable();
        indices.dedup();
        let antenna = middle_antenna(stage);
        let places: Vec<Place> = indices.iter().map(|&index| Place::new(stage, &antenna, index)).collect();
        // What is near a highlight at the beginning or at the end.
        let middle = posed.len() / 2;
        let Some(last) = posed.len().checked_sub(1) else { return Missed::default() };
        let ends: Vec<(Vec<Vec3>, Vec<Vec<Vec3>>)> = [0, last]
            .map(|i| {
                let normals = posed[i].normals.iter().map(|n| n.as_vec3()).collect();
                (normals, places.iter().map(|place| towards(&posed[i], place.middle)).collect())
            })
            .to_vec();
        let pairs: Vec<Pair> = ways
            .iter()
            .map(|(way, loudness)| {
                let images = way.map(|index| indices.binary_search(&index).unwrap_or(0));
                let near = ends.iter().map(|(normals, d)| (normals.as_slice(), images.map(|i| d[i].as_slice())));
                let of = images.map(|i| places[i].middle);
                self.select(near, &posed[middle], of, images, demand.fineness(*loudness), stage)
            })
            .collect();
        let mut wanted = vec![vec![false; self.cloth.len()]; indices.len()];
        let mut used = vec![false; self.mesh.skin().rest().triangles.len()];
        for pair in &pairs {
            for &v in &pair.vertices {
                for image in pair.images {
                    wanted[image][v as usize] = true;
                }
            }
            for triangle in &pair.triangles {
                used[triangle.number as usize] = true;
            }
        }
        let triangles: Vec<PosedTriangles> = posed.iter().map(|posed| self.pose_triangles(posed, &used)).collect();
        // Strengths change less than phases: they are found at every second key, and are half-way in between.
        let exact = |i: usize| i.is_multiple_of(2) || i == last;
        // Patterns and walls change less still: the middle will do.
        let fields: Vec<Vec<Phasor3>> = indices
            .iter()
            .zip(&wanted)
            .map(|(&index, wanted)| {
                let field = |(v, wanted): (&DVec3, &bool)| {
                    if *wanted { stage.room.illuminate(&antenna, index, *v).field } else { Phasor3::real(DVec3::ZERO) }
                };
                posed[middle].vertices.iter().zip(wanted).map(field).collect()
            })
            .collect();
        let lights: Vec<Vec<Light>> = (0..posed.len())
            .map(|i| {
                let Some(people) = people.get(i).filter(|_| exact(i)) else { return Vec::new() };
                let each = indices.iter().zip(&wanted).zip(&fields);
                each.map(|((&index, wanted), fields)| Light {
                    fields,
                    weights: self.weights(stage, &antenna, &posed[i], people, me, index, wanted),
                    antenna: stage.room.image_position(index, antenna.position),
                })
                .collect()
            })
            .collect();

        let mut missed = None;
        let mut sums = ChirpSums::new(integrator.level());
        for pair in &pairs {
            report.paths += pair.triangles.len();
            let mut strengths: Vec<Vec<Complex64>> = posed
                .iter()
                .zip(&lights)
                .map(|(posed, lights)| self.strengths(stage, posed, lights, pair, report))
                .collect();
            for i in (0..posed.len()).filter(|&i| !exact(i)) {
                let (before, after) = (&strengths[i - 1], &strengths[i + 1]);
                strengths[i] = before.iter().zip(after).map(|(a, b)| 0.5 * (a + b)).collect();
            }
            let between = pair.images.map(|i| &places[i]);
            let keys: Vec<Vec<TriangleKey>> = triangles
                .iter()
                .enumerate()
                .map(|(i, posed)| {
                    let slopes = Slopes::new(&strengths, times_s, i);
                    self.integrate(stage, integrator, posed, between, pair, &slopes)
                })
                .collect();
            missed.get_or_insert_with(|| Missed {
                between_keys: missed_between_keys(&keys, times_s, stage.wavelength_m),
                by_integration: {
                    let coarse = Fineness::for_tolerance(2.0 * demand.tolerance_db);
                    let coarse =
                        Pair { fineness: coarse, ..self.select_again(pair, &posed[0], between, coarse, stage) };
                    let strengths = [self.strengths(stage, &posed[0], &lights[0], &coarse, report)];
                    let slopes = Slopes::new(&strengths, &times_s[..1], 0);
                    let of_coarse = self.integrate(stage, integrator, &triangles[0], between, &coarse, &slopes);
                    difference(pair, &keys[0], &of_coarse, stage.wavelength_m)
                },
            });
            self.add_pair(stage, pair, between, demand.least_patch_lsb(), &keys, times, &mut sums, grids, report);
        }
        missed.unwrap_or_default()
    }

    /// The same triangles with other cuts.
    fn select_again(
        &self,
        pair: &Pair,
        posed: &PosedSkin,
        between: [&Place; 2],
        fineness: Fineness,
        stage: &Stage,
    ) -> Pair {
        let k = std::f64::consts::TAU / stage.wavelength_m;
        let cut = |triangle: &PairTriangle| {
            let curved = self.curved(posed, triangle.number as usize);
            let [t, r] = between.map(|place| View::new(place.middle, curved.middle));
            PairTriangle { cuts: curved.cuts(&t, &r, k, fineness.bend_rad), ..*triangle }
        };
        Pair {
            images: pair.images,
            fineness,
            triangles: pair.triangles.iter().map(cut).collect(),
            vertices: pair.vertices.clone(),
        }
    }

    /// Triangles near a highlight, with the cuts that they need.
    fn select<'a>(
        &self,
        near: impl Iterator<Item = (&'a [Vec3], [&'a [Vec3]; 2])>,
        middle: &PosedSkin,
        antennas: [DVec3; 2],
        images: [usize; 2],
        fineness: Fineness,
        stage: &Stage,
    ) -> Pair {
        let mut shines = vec![false; self.cloth.len()];
        // As the window's weight, without its roots.
        let least = (1.0 - fineness.window[1] * fineness.window[1]) as f32;
        for (normals, [there, home]) in near {
            for (((shines, t), r), normal) in shines.iter_mut().zip(there).zip(home).zip(normals) {
                let bisector = *t + *r;
                let (square, cosine) = (bisector.length_squared(), normal.dot(bisector));
                *shines |= cosine > 0.0
                    && cosine * cosine > least * square
                    && normal.dot(*t) > 0.0
                    && normal.dot(*r) > 0.0
                    && square > 0.16;
            }
        }
        let mut pair = Pair { images, fineness, triangles: Vec::new(), vertices: Vec::new() };
        let mut places = vec![u32::MAX; self.cloth.len()];
        let k = std::f64::consts::TAU / stage.wavelength_m;
        let skin = self.mesh.skin();
        for (number, (corners, &patch)) in skin.rest().triangles.iter().zip(skin.patches()).enumerate() {
            if !corners.iter().any(|&v| shines.get(v as usize) == Some(&true)) {
                continue;
            }
            let corners = corners.map(|v| {
                let place = &mut places[v as usize];
                if *place == u32::MAX {
                    *place = pair.vertices.len() as u32;
                    pair.vertices.push(v);
                }
                *place
            });
            let curved = self.curved(middle, number);
            let [t, r] = antennas.map(|a| View::new(a, curved.middle));
            let cuts = curved.cuts(&t, &r, k, fineness.bend_rad);
            pair.triangles.push(PairTriangle { number: number as u32, patch, corners, cuts });
        }
        pair
    }

    fn curved(&self, posed: &PosedSkin, number: usize) -> CurvedTriangle {
        let skin = self.mesh.skin();
        let at = |of: &[DVec3], i: u32| of.get(i as usize).copied().unwrap_or_default();
        let corners = skin.rest().triangles.get(number).copied().unwrap_or_default();
        let sides = skin.sides().get(number).copied().unwrap_or_default();
        let [points, normals] = [&posed.vertices, &posed.normals].map(|of| corners.map(|v| at(of, v)));
        CurvedTriangle::new(points, normals, sides.map(|e| at(&posed.bulges, e)))
    }

    /// The triangles that are wanted, in a pose.
    fn pose_triangles(&self, posed: &PosedSkin, wanted: &[bool]) -> PosedTriangles {
        let mut all = PosedTriangles { slots: vec![u32::MAX; wanted.len()], triangles: Vec::new() };
        for (number, corners) in self.mesh.skin().rest().triangles.iter().enumerate().filter(|(i, _)| wanted[*i]) {
            let velocities = corners.map(|v| posed.velocities_m_per_s.get(v as usize).copied().unwrap_or_default());
            let velocity = (velocities[0] + velocities[1] + velocities[2]) / 3.0;
            let against = velocities.map(|v| (v - velocity).as_vec3());
            all.slots[number] = all.triangles.len() as u32;
            all.triangles.push(PosedTriangle { curved: self.curved(posed, number), velocity, against });
        }
        all
    }

    /// What people and limbs leave of an image antenna's field at every vertex that is wanted.
    #[allow(clippy::too_many_arguments)]
    fn weights(
        &self,
        stage: &Stage,
        antenna: &Element,
        posed: &PosedSkin,
        people: &[Snapshot],
        me: usize,
        index: ImageIndex,
        wanted: &[bool],
    ) -> Vec<f64> {
        let middle = stage.room.image_position(index, antenna.position);
        let own = self_shadow::weights(self.mesh.skin(), posed, middle, stage.wavelength_m, wanted);
        own.iter().zip(self.past_people(stage, people, me, index)).map(|(a, b)| a * b).collect()
    }

    /// Strength at every vertex of a pair, as it multiplies `exp(-j k L)` and an area: the integrand of physical optics with antennas'
    /// aperture and spreading.
    fn strengths(
        &self,
        stage: &Stage,
        posed: &PosedSkin,
        lights: &[Light],
        pair: &Pair,
        report: &mut EchoReport,
    ) -> Vec<Complex64> {
        let k = std::f64::consts::TAU / stage.wavelength_m;
        let aperture = stage.wavelength_m / (4.0 * std::f64::consts::PI);
        let factor = Complex64::new(0.0, -k * aperture / std::f64::consts::TAU);
        let skin = Boundary::HalfSpace { permittivity: SKIN_PERMITTIVITY };
        let mut all = vec![Complex64::ZERO; pair.vertices.len()];
        let [Some(out), Some(back)] = pair.images.map(|i| lights.get(i)) else { return all };
        for (strength, &v) in all.iter_mut().zip(&pair.vertices) {
            let i = v as usize;
            let (normal, point) = (posed.normals[i], posed.vertices[i]);
            let [there, home] = [out, back].map(|light| View::new(light.antenna, point));
            let [outwards, homewards] = [there, home].map(|view| view.offset / view.distance_m);
            let bisector = outwards + homewards;
            let length = bisector.length();
            let cosine = -normal.dot(bisector) / length.max(1e-12);
            if normal.dot(outwards) >= 0.0 || normal.dot(homewards) >= 0.0 {
                continue;
            }
            // Grazing highlights fade: forward scattering is not theirs to tell.
            let window = pair.fineness.weight(cosine) * smooth_step((0.5 * length - 0.2) / 0.1);
            let weight = window * out.weights[i] * back.weights[i] * self.cloth[i];
            if weight <= 0.0 {
                continue;
            }
            let clamped = there.distance_m < LEAST_DISTANCE_M || home.distance_m < LEAST_DISTANCE_M;
            report.clamped += usize::from(clamped);
            let spreading = 1.0 / (there.distance_m.max(LEAST_DISTANCE_M) * home.distance_m.max(LEAST_DISTANCE_M));
            let arrival = Arrival { field: out.fields[i], direction: outwards };
            let heard = heard_by(&arrival, normal, &skin, k, -homewards, back.fields[i]);
            *strength = factor * heard * (spreading * weight * inside_room(stage, point));
        }
        all
    }

    /// Every triangle of a pair at a key.
    fn integrate(
        &self,
        stage: &Stage,
        integrator: &Integrator,
        posed: &PosedTriangles,
        [first, second]: [&Place; 2],
        pair: &Pair,
        slopes: &Slopes,
    ) -> Vec<TriangleKey> {
        let k = std::f64::consts::TAU / stage.wavelength_m;
        let mut keys = vec![TriangleKey::default(); pair.triangles.len()];
        // Those that are cut alike go together.
        let mut alike: [Vec<u32>; MOST_CUTS] = Default::default();
        for (i, triangle) in pair.triangles.iter().enumerate() {
            alike[triangle.cuts.clamp(1, MOST_CUTS) - 1].push(i as u32);
        }
        let (mut views, mut moments) = (Vec::new(), Vec::new());
        let some = alike.iter().enumerate().flat_map(|(cuts, all)| all.chunks(LANES).map(move |some| (cuts, some)));
        for (cuts, members) in some {
            views.clear();
            moments.clear();
            for &i in members {
                let Some(triangle) = posed.get(pair.triangles[i as usize].number) else { continue };
                let [t, r] = [first, second].map(|image| View::new(image.middle, triangle.curved.middle));
                views.push((triangle.curved, t, r));
            }
            integrator.moments(&views, k, cuts + 1, &mut moments);
            for ((&i, (triangle, t, r)), moments) in members.iter().zip(&views).zip(&moments) {
                let PairTriangle { number, corners, .. } = pair.triangles[i as usize];
                let Some(PosedTriangle { velocity, against, .. }) = posed.get(number) else { continue };
                let velocity = *velocity;
                let [away_t, away_r] = [t, r].map(|view| view.offset / view.distance_m);
                let mut key = TriangleKey {
                    middle: triangle.middle,
                    length_m: t.distance_m + r.distance_m,
                    rate_m_per_s: (away_t + away_r).dot(velocity),
                    ..TriangleKey::default()
                };
                let (speeds, away) = ([away_t.dot(velocity), away_r.dot(velocity)], away_t + away_r);
                for ((v, moment), (d, against)) in corners.iter().zip(moments).zip(triangle.corners.iter().zip(against))
                {
                    let moment = Complex64::new(moment.re.into(), moment.im.into());
                    let (strength, slope) = slopes.at(*v);
                    // How fast the path by the corner grows against that by the middle.
                    let d = d.as_dvec3();
                    let (sideways, turning) = (away.dot(against.as_dvec3()), d.dot(velocity));
                    let rate = sideways
                        + (turning - away_t.dot(d) * speeds[0]) / t.distance_m
                        + (turning - away_r.dot(d) * speeds[1]) / r.distance_m;
                    key.field += strength * moment;
                    key.moment += strength * moment * away.dot(d);
                    key.field_rate += (slope - Complex64::new(0.0, k * rate) * strength) * moment;
                }
                keys[i as usize] = key;
            }
        }
        keys
    }

    /// Adds what a pair's patches send back in every chirp.
    #[allow(clippy::too_many_arguments)]
    fn add_pair(
        &self,
        stage: &Stage,
        pair: &Pair,
        between: [&Place; 2],
        least_lsb: f64,
        keys: &[Vec<TriangleKey>],
        times: &FrameTimes,
        sums: &mut ChirpSums,
        grids: &mut ChirpGrids,
        report: &mut EchoReport,
    ) {
        let both = [between, [between[1], between[0]]];
        let ways = if pair.images[0] == pair.images[1] { &both[..1] } else { &both[..] };
        let patch_of = |i: usize| pair.triangles.get(i).map(|t| t.patch);
        let loudest = stage.lsb.iter().copied().fold(0.0, f64::max);
        // Patches add up: one alone this far below what can be seen is not missed.
        let least = (least_lsb / loudest.max(1e-300)) as f32;
        let (mut begin, mut chirps) = (0, Vec::new());
        while begin < pair.triangles.len() {
            let end = (begin..pair.triangles.len()).find(|&i| patch_of(i) != patch_of(begin));
            let members = begin..end.unwrap_or(pair.triangles.len());
            begin = members.end;
            let Some(patch) = Patch::new(keys, members, between, times, stage.wavelength_m, sums) else { continue };
            if sums.loudest() < least {
                continue;
            }
            report.synthesised += 1;
            for (way, direction) in ways.iter().zip([Direction::There, Direction::Reverse]) {
                sums.chirps(direction, &mut chirps);
                let of_receiver = |rx| patch.way(stage, *way, rx, times.chirps_s.len());
                let of_receivers: Vec<EchoWay> = (0..stage.rx.len()).map(of_receiver).collect();
                grids.add(&stage.chirp, &of_receivers, &chirps);
            }
        }
    }
}

/// How far two integrations of the same triangles are apart, patch by patch, relative to the first.
fn difference(pair: &Pair, a: &[TriangleKey], b: &[TriangleKey], wavelength_m: f64) -> f64 {
    let patch_of = |i: usize| pair.triangles.get(i).map(|t| t.patch);
    let (mut apart, mut power) = (0.0, 0.0);
    let (mut sum, mut difference) = (Complex64::ZERO, Complex64::ZERO);
    for (i, (a, b)) in a.iter().zip(b).enumerate() {
        let turn = phasor(-a.length_m / wavelength_m);
        let turn = Complex64::new(turn.re.into(), turn.im.into());
        sum += a.field * turn;
        difference += (a.field - b.field) * turn;
        if patch_of(i) != patch_of(i + 1) {
            apart += difference.norm_sqr();
            power += sum.norm_sqr();
            (sum, difference) = (Complex64::ZERO, Complex64::ZERO);
        }
    }
    if power > 0.0 { (apart / power).sqrt() } else { 0.0 }
}

/// Unit vectors from the vertices to an antenna.
fn towards(posed: &PosedSkin, antenna: DVec3) -> Vec<Vec3> {
    posed.vertices.iter().map(|v| (antenna - *v).as_vec3().normalize_or_zero()).collect()
}

/// Strengths at one key, and their rates from the keys around it, by a pair's vertices.
struct Slopes<'a> {
    now: &'a [Complex64],
    rates: Vec<Complex64>,
}

impl<'a> Slopes<'a> {
    /// Differences over equal steps: central ones, and at the ends those of the parabola through three keys.
    fn new(all: &'a [Vec<Complex64>], times_s: &[f64], i: usize) -> Self {
        let last = all.len().saturating_sub(1);
        let step_s = match times_s {
            [first, second, ..] => second - first,
            _ => 1.0,
        };
        let weights: &[(usize, f64)] = match (i, last) {
            (_, 0) => &[],
            (_, 1) => &[(0, -1.0), (1, 1.0)],
            (0, _) => &[(0, -1.5), (1, 2.0), (2, -0.5)],
            (i, last) if i == last => &[(last, 1.5), (last - 1, -2.0), (last - 2, 0.5)],
            (i, _) => &[(i + 1, 0.5), (i - 1, -0.5)],
        };
        let now = all.get(i).map(Vec::as_slice).unwrap_or_default();
        let mut rates = vec![Complex64::ZERO; now.len()];
        for (key, weight) in weights.iter().filter_map(|&(key, w)| Some((all.get(key)?, w / step_s))) {
            for (rate, strength) in rates.iter_mut().zip(key) {
                *rate += strength * weight;
            }
        }
        Slopes { now, rates }
    }

    fn at(&self, vertex: u32) -> (Complex64, Complex64) {
        let of = |all: &[Complex64]| all.get(vertex as usize).copied().unwrap_or_default();
        (of(self.now), of(&self.rates))
    }
}
