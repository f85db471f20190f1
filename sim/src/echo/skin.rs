//! Echoes of somebody whose body is a mesh: physical optics near its highlights, patch by patch.
//!
//! Physical optics over the skin needs only where the path hardly changes: a smooth window over the angle between normal and
//! bisector keeps highlights with several Fresnel zones around them and lets go of the rest, which cancels. Inside the window
//! each triangle is integrated ([`crate::field::curved_triangle`]) at the key times, and is between them a point of the body
//! with an exact delay whose strength changes slowly. Triangles of one small patch are summed chirp by chirp
//! ([`super::chirp_sum`]) into one tone: nothing has to be found, followed or matched between key times, and highlights that
//! are born, merge and die do so in the sum.
//!
//! A patch has as many triangles as go side by side in lanes. It is taken through everything, by every way and at every key,
//! before the next: what is known of it stays at hand.
//!
//! A way and its reverse differ by the few millimetres between transmitter and receivers: they are integrated once.
//!
//! Strength at the vertices: what the image antenna's field makes of skin there (both polarisations, true incidence), cloth,
//! pattern, walls, and what people and the body's own limbs leave of it.

use glam::DVec3;
use num_complex::Complex64;

use super::chirp_sum::{ChirpSums, Direction};
use super::demand::{Demand, Fineness, Missed};
use super::key_rows::{StrengthRows, triangle_keys};
use super::patch::{FrameTimes, Patch, Place, TriangleKey, middle_antenna, missed_between_keys};
use super::posed_patch::{PosedPatch, vertex_rows};
use super::strength::{Between, FieldRows, any_shines, common_factor, light_rows, strengths};
use super::{EchoReport, Snapshot, past_people, self_shadow};
use crate::actor::body::SEGMENTS;
use crate::actor::skin::{PosedSkin, SkinPatch, WalkingMesh};
use crate::field::curved_triangle::{Integrator, moments, spans_rad};
use crate::field::image::{Element, ImageIndex};
use crate::field::quadrature::rule_for;
use crate::lanes::{LANES, Row};
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

/// Two images between which somebody is heard, whichever of them sends.
struct Pair {
    /// Places in the list of images.
    images: [usize; 2],
    fineness: Fineness,
}

/// What goes from patch to patch.
struct Work<'a> {
    stage: &'a Stage,
    integrator: &'a Integrator,
    times: &'a FrameTimes,
    /// Middle of the body: single precision counts from here.
    origin: DVec3,
    antenna: Element,
    indices: Vec<ImageIndex>,
    places: Vec<Place>,
    pairs: Vec<Pair>,
    posed: Vec<PosedSkin>,
    /// `[key][image][vertex]`: what people and limbs leave of light. Empty at every second key, which is half-way in between.
    weights: Vec<Vec<Vec<f64>>>,
}

/// What a patch is worked on with.
struct Bench {
    patches: Vec<PosedPatch>,
    fields: Vec<FieldRows>,
    /// `[key][image]`.
    weights: Vec<Vec<Row>>,
    strengths: Vec<StrengthRows>,
    keys: Vec<Vec<TriangleKey>>,
    coarse: Vec<TriangleKey>,
    sums: ChirpSums,
    /// Of the patch, in the middle pose.
    area_m2: f32,
    /// Field below which a patch is left out.
    least: f32,
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
        let posed: Vec<PosedSkin> = times.keys_s.iter().map(|&t| self.mesh.posed(t)).collect();
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
        let Some(middle) = posed.get(posed.len() / 2) else { return Missed::default() };
        let antenna = middle_antenna(stage);
        let pair = |&(way, loudness): &([ImageIndex; 2], f64)| Pair {
            images: way.map(|index| indices.binary_search(&index).unwrap_or(0)),
            fineness: demand.fineness(loudness),
        };
        let mut work = Work {
            stage,
            integrator,
            times,
            origin: middle.vertices.iter().sum::<DVec3>() / middle.vertices.len().max(1) as f64,
            places: indices.iter().map(|&index| Place::new(stage, &antenna, index)).collect(),
            pairs: ways.iter().map(pair).collect(),
            antenna,
            indices,
            posed,
            weights: Vec::new(),
        };
        let shining = self.shining(&work);
        work.weights = self.weights(&work, people, me, &shining);

        let loudest = stage.lsb.iter().copied().fold(0.0, f64::max);
        let mut bench = Bench {
            patches: work.posed.iter().map(|_| PosedPatch::new(work.indices.len(), integrator)).collect(),
            fields: vec![FieldRows::default(); work.indices.len()],
            weights: vec![vec![[0.0; LANES]; work.indices.len()]; work.posed.len()],
            strengths: vec![StrengthRows::default(); work.posed.len()],
            keys: vec![Vec::new(); work.posed.len()],
            coarse: Vec::new(),
            sums: ChirpSums::new(integrator.level),
            area_m2: 0.0,
            // Patches add up: one alone this far below what can be seen is not missed.
            least: (demand.least_patch_lsb() / loudest.max(1e-300)) as f32,
        };
        let coarse = Fineness::for_tolerance(2.0 * demand.tolerance_db);
        let mut missed = Tally::default();
        for (patch, shining) in self.mesh.skin().patches().iter().zip(&shining).filter(|(_, pairs)| !pairs.is_empty()) {
            report.clamped += self.pose(&work, patch, shining, &mut bench);
            for &number in shining {
                let Some(pair) = work.pairs.get(number) else { continue };
                if !bench.integrate(&work, patch, pair) {
                    continue;
                }
                report.paths += patch.triangles.len() * work.posed.len();
                if number == 0 {
                    bench.integrate_coarsely(&work, patch, pair, &coarse);
                    missed.add(&bench.keys, &bench.coarse, &times.keys_s, stage.wavelength_m);
                }
                bench.add_tone(&work, pair, grids, report);
            }
        }
        missed.missed()
    }

    /// By patch, the pairs of images between which it is near a highlight at the beginning or at the end.
    fn shining(&self, work: &Work) -> Vec<Vec<usize>> {
        let level = work.integrator.level;
        let patches = self.mesh.skin().patches();
        let mut all = vec![Vec::new(); patches.len()];
        let ends = [work.posed.first(), work.posed.last()];
        for (patch, shining) in patches.iter().zip(&mut all) {
            let seen: Vec<_> = ends
                .iter()
                .flatten()
                .map(|posed| {
                    let [places, normals] = vertex_rows(posed, patch, work.origin);
                    let light = |place: &Place| light_rows(level, from(work.origin, place.middle), &places);
                    (normals, work.places.iter().map(light).collect::<Vec<_>>())
                })
                .collect();
            let narrowing = patch.vertices.map(|v| self.mesh.skin().narrowing()[v as usize]);
            let shines = |pair: &Pair| {
                let [a, b] = pair.images;
                let outer = pair.fineness.window[1] as f32;
                let lit = |(normals, lights): &([Row; 3], Vec<_>)| {
                    any_shines(level, normals, &narrowing, [&lights[a], &lights[b]], outer)
                };
                seen.iter().any(lit)
            };
            shining.extend(work.pairs.iter().enumerate().filter(|(_, pair)| shines(pair)).map(|(number, _)| number));
        }
        all
    }

    /// What people and limbs leave of every image antenna's light at the vertices of patches that shine by it.
    fn weights(&self, work: &Work, people: &[Vec<Snapshot>], me: usize, shining: &[Vec<usize>]) -> Vec<Vec<Vec<f64>>> {
        let mut wanted = vec![vec![false; self.cloth.len()]; work.indices.len()];
        for (patch, pairs) in self.mesh.skin().patches().iter().zip(shining) {
            for image in pairs.iter().filter_map(|&number| work.pairs.get(number)).flat_map(|pair| pair.images) {
                patch.vertices.iter().for_each(|&v| wanted[image][v as usize] = true);
            }
        }
        let last = work.posed.len().saturating_sub(1);
        let at = |(key, (posed, people)): (usize, (&PosedSkin, &Vec<Snapshot>))| {
            if !key.is_multiple_of(2) && key != last {
                return Vec::new();
            }
            let each = work.indices.iter().zip(&work.places).zip(&wanted);
            each.map(|((&index, place), wanted)| {
                let skin = self.mesh.skin();
                let own = self_shadow::weights(skin, posed, place.middle, work.stage.wavelength_m, wanted);
                own.iter().zip(self.past_people(work.stage, people, me, index)).map(|(a, b)| a * b).collect()
            })
            .collect()
        };
        work.posed.iter().zip(people).enumerate().map(at).collect()
    }

    /// Puts a patch on the bench in every pose, as the images of the pairs by which it shines see it. Returns how many of their
    /// distances are less than amplitudes are made for.
    fn pose(&self, work: &Work, patch: &SkinPatch, shining: &[usize], bench: &mut Bench) -> usize {
        let level = work.integrator.level;
        let mut images: Vec<usize> =
            shining.iter().filter_map(|&number| work.pairs.get(number)).flat_map(|pair| pair.images).collect();
        images.sort_unstable();
        images.dedup();
        let mut clamped = 0;
        for (of_patch, posed) in bench.patches.iter_mut().zip(&work.posed) {
            of_patch.pose(work.stage, level, self.mesh.skin(), patch, posed, &self.cloth, work.origin);
            for &image in &images {
                of_patch.look(image, work.places[image].middle, work.origin, work.stage.wavelength_m, level);
                clamped += of_patch.lights[image].clamped();
            }
        }
        bench.area_m2 = bench.patches[work.posed.len() / 2].triangles.area_m2();
        // Patterns and walls change little over a patch and a frame: its middle will do.
        let middle = &work.posed[work.posed.len() / 2];
        let corners = &patch.vertices;
        let centre = corners.iter().map(|&v| middle.vertices[v as usize]).sum::<DVec3>() / corners.len() as f64;
        for &image in &images {
            let light = work.stage.room.illuminate(&work.antenna, work.indices[image], centre);
            bench.fields[image] = FieldRows::from(light.field);
        }
        let last = work.posed.len() - 1;
        for key in (0..=last).filter(|key| key.is_multiple_of(2) || *key == last) {
            for &image in &images {
                let of_image = &work.weights[key][image];
                bench.weights[key][image] = patch.vertices.map(|v| of_image[v as usize] as f32);
            }
        }
        for key in (0..last).filter(|key| !key.is_multiple_of(2)) {
            for &image in &images {
                let (before, after) = (bench.weights[key - 1][image], bench.weights[key + 1][image]);
                bench.weights[key][image] = std::array::from_fn(|l| 0.5 * (before[l] + after[l]));
            }
        }
        clamped
    }
}

impl Bench {
    fn strengths(&self, work: &Work, pair: &Pair, key: usize, fineness: &Fineness) -> (Row, Row) {
        let [out, back] = pair.images;
        let patch = &self.patches[key];
        let between = Between {
            vertices: &patch.vertices,
            lights: [&patch.lights[out], &patch.lights[back]],
            fields: [self.fields[out], self.fields[back]],
            weights: [&self.weights[key][out], &self.weights[key][back]],
            permittivity: SKIN_PERMITTIVITY,
            fineness,
            factor: common_factor(work.stage.wavelength_m),
        };
        strengths(work.integrator.level, &between)
    }

    /// Finds the patch's triangles at every key between two images. Whether there is anything.
    fn integrate(&mut self, work: &Work, patch: &SkinPatch, pair: &Pair) -> bool {
        let wavelength_m = work.stage.wavelength_m;
        for key in 0..self.patches.len() {
            self.strengths[key].now = self.strengths(work, pair, key, &pair.fineness);
        }
        let mut live = [false; LANES];
        for StrengthRows { now: (re, im), .. } in &self.strengths {
            for (l, live) in live.iter_mut().enumerate() {
                *live |= (re[l] != 0.0) | (im[l] != 0.0);
            }
        }
        // All of the patch in phase: what is not heard even then needs no integral.
        let strongest = self.strengths.iter().flat_map(|s| s.now.0.iter().zip(&s.now.1)).map(|(x, y)| x * x + y * y);
        let strongest = strongest.fold(0.0, f32::max).sqrt();
        if live == [false; LANES] || strongest * self.area_m2 < self.least {
            return false;
        }
        slopes(&mut self.strengths, &work.times.keys_s);
        let [out, back] = pair.images;
        let level = work.integrator.level;
        let middle = &self.patches[self.patches.len() / 2];
        let spans = spans_rad(level, [&middle.views[out], &middle.views[back]]);
        let corners_live = |l: usize| patch.corners[l].iter().any(|&v| live[v]);
        let span = (0..patch.triangles.len()).filter(|&l| corners_live(l)).map(|l| spans[l]).fold(0.0, f32::max);
        let rule = rule_for(span, pair.fineness.ease);
        for ((posed, strengths), keys) in self.patches.iter_mut().zip(&self.strengths).zip(&mut self.keys) {
            posed.nodes(rule, work.integrator);
            let moments = moments(level, posed.found(rule), [&posed.views[out], &posed.views[back]]);
            triangle_keys(level, patch, posed, work.origin, pair.images, &moments, strengths, wavelength_m, keys);
        }
        true
    }

    /// The same at the first key as it would be to a coarser demand.
    fn integrate_coarsely(&mut self, work: &Work, patch: &SkinPatch, pair: &Pair, fineness: &Fineness) {
        let strengths = StrengthRows { now: self.strengths(work, pair, 0, fineness), ..StrengthRows::default() };
        let [out, back] = pair.images;
        let level = work.integrator.level;
        let Some(posed) = self.patches.first_mut() else { return };
        let spans = spans_rad(level, [&posed.views[out], &posed.views[back]]);
        let span = spans.iter().take(patch.triangles.len()).copied().fold(0.0, f32::max);
        let rule = rule_for(span, fineness.ease);
        posed.nodes(rule, work.integrator);
        let moments = moments(level, posed.found(rule), [&posed.views[out], &posed.views[back]]);
        let (wavelength_m, coarse) = (work.stage.wavelength_m, &mut self.coarse);
        triangle_keys(level, patch, posed, work.origin, pair.images, &moments, &strengths, wavelength_m, coarse);
    }

    /// Adds what the patch sends back between two images in every chirp.
    fn add_tone(&mut self, work: &Work, pair: &Pair, grids: &mut ChirpGrids, report: &mut EchoReport) {
        let (stage, times) = (work.stage, work.times);
        let between = pair.images.map(|i| &work.places[i]);
        let both = [between, [between[1], between[0]]];
        let ways = if pair.images[0] == pair.images[1] { &both[..1] } else { &both[..] };
        let in_phase = |keys: &Vec<TriangleKey>| keys.iter().map(|key| key.field.norm()).sum::<f64>();
        if self.keys.iter().map(in_phase).fold(0.0, f64::max) < f64::from(self.least) {
            return;
        }
        let members = 0..self.keys.first().map_or(0, Vec::len);
        let keys = &self.keys;
        let Some(patch) = Patch::new(keys, members, between, times, stage.wavelength_m, &mut self.sums) else { return };
        if self.sums.loudest() < self.least {
            return;
        }
        report.synthesised += 1;
        let mut chirps = Vec::new();
        for (way, direction) in ways.iter().zip([Direction::There, Direction::Reverse]) {
            self.sums.chirps(direction, &mut chirps);
            let of_receiver = |rx| patch.way(stage, *way, rx, times.chirps_s.len());
            let of_receivers: Vec<EchoWay> = (0..stage.rx.len()).map(of_receiver).collect();
            grids.add(&stage.chirp, &of_receivers, &chirps);
        }
    }
}

/// An antenna from a place, in single precision.
fn from(origin: DVec3, antenna: DVec3) -> [f32; 3] {
    (antenna - origin).as_vec3().to_array()
}

/// Rates of strengths by differences over equal steps: central ones, and at the ends those of the parabola through three keys.
fn slopes(all: &mut [StrengthRows], times_s: &[f64]) {
    let last = all.len().saturating_sub(1);
    let step_s = match times_s {
        [first, second, ..] => second - first,
        _ => 1.0,
    };
    for i in 0..all.len() {
        let weights: &[(usize, f64)] = match (i, last) {
            (_, 0) => &[],
            (_, 1) => &[(0, -1.0), (1, 1.0)],
            (0, _) => &[(0, -1.5), (1, 2.0), (2, -0.5)],
            (i, last) if i == last => &[(last, 1.5), (last - 1, -2.0), (last - 2, 0.5)],
            (i, _) => &[(i + 1, 0.5), (i - 1, -0.5)],
        };
        let mut rates = ([0.0; LANES], [0.0; LANES]);
        for &(key, weight) in weights {
            let (weight, (re, im)) = ((weight / step_s) as f32, all[key].now);
            for l in 0..LANES {
                rates.0[l] += weight * re[l];
                rates.1[l] += weight * im[l];
            }
        }
        all[i].rates = rates;
    }
}

/// What is missed of a pair's field, patch by patch, in squares.
#[derive(Debug, Default)]
struct Tally {
    between_keys: [f64; 2],
    by_integration: [f64; 2],
}

impl Tally {
    fn add(&mut self, keys: &[Vec<TriangleKey>], coarse: &[TriangleKey], times_s: &[f64], wavelength_m: f64) {
        let (missed, power) = missed_between_keys(keys, times_s, wavelength_m);
        self.between_keys = [self.between_keys[0] + missed, self.between_keys[1] + power];
        let (mut sum, mut apart) = (Complex64::ZERO, Complex64::ZERO);
        for (a, b) in keys.first().into_iter().flatten().zip(coarse) {
            let turn = phasor(-a.length_m / wavelength_m);
            let turn = Complex64::new(turn.re.into(), turn.im.into());
            sum += a.field * turn;
            apart += (a.field - b.field) * turn;
        }
        self.by_integration = [self.by_integration[0] + apart.norm_sqr(), self.by_integration[1] + sum.norm_sqr()];
    }

    fn missed(&self) -> Missed {
        let part = |[missed, power]: [f64; 2]| if power > 0.0 { (missed / power).sqrt() } else { 0.0 };
        // Cubics err with the fourth power of the step.
        Missed { between_keys: part(self.between_keys) / 16.0, by_integration: part(self.by_integration) }
    }
}
