//! Echoes of somebody whose body is a mesh: physical optics near its specular points, patch by patch.
//!
//! Physical optics over the skin needs only where the path hardly changes: a smooth window over the angle between normal and
//! bisector keeps specular points with several Fresnel zones around them and lets go of the rest, which cancels. Inside the window
//! each triangle is integrated ([`crate::em::curved_triangle`]) at the key times, and is between them a point of the body
//! with an exact delay whose strength changes slowly. Triangles of one small patch are summed chirp by chirp
//! ([`super::patch_sum`]) into one tone: nothing has to be found, followed or matched between key times, and specular points that
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

use super::error_budget::{ErrorBudget, Missed};
use super::patch::{FrameTimes, Place, middle_antenna};
use super::patch_pose::vertex_rows;
use super::patch_solver::{Pair, PatchSolver, Tally, Work};
use super::surface_currents::{any_shines, light_rows};
use super::{EchoReport, Snapshot, past_people, self_occlusion};
use crate::em::curved_triangle::Integrator;
use crate::em::image::ImageIndex;
use crate::lanes::Row;
use crate::people::body::SEGMENTS;
use crate::people::skin::PosedSkin;
use crate::people::walking_mesh::WalkingMesh;
use crate::prepared_scene::PreparedScene;
use crate::synthesis::ChirpGrids;

/// Somebody with a skin.
#[derive(Debug, Clone)]
pub struct SkinnedPerson {
    mesh: WalkingMesh,
    /// Factor of clothes on amplitude at each vertex.
    cloth: Vec<f64>,
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

    /// Factors of other people, and of the body itself before the last wall, on an image antenna's field at each vertex: by
    /// segment, as vertices follow those.
    pub fn past_people(&self, prepared: &PreparedScene, people: &[Snapshot], me: usize, index: ImageIndex) -> Vec<f64> {
        let Some(own) = people.get(me) else { return vec![1.0; self.cloth.len()] };
        let of_segment: [f64; SEGMENTS] =
            std::array::from_fn(|s| past_people(prepared, people, me, index, prepared.tx.position, own.body[s].centre));
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
    /// is missed of the loudest pair's field, and what of the others is left out.
    #[allow(clippy::too_many_arguments)]
    pub fn add_echoes(
        &self,
        prepared: &PreparedScene,
        integrator: &Integrator,
        budget: &ErrorBudget,
        times: &FrameTimes,
        people: &[Vec<Snapshot>],
        me: usize,
        pairs: &[((ImageIndex, ImageIndex), f64)],
        grids: &mut ChirpGrids,
        report: &mut EchoReport,
    ) -> Missed {
        // Fast limbs need keys half-way between as well.
        let fine = times.halved();
        let posed: Vec<PosedSkin> = fine.keys_s.iter().map(|&t| self.mesh.posed(t)).collect();
        let mut ways: Vec<([ImageIndex; 2], f64)> = Vec::new();
        let mut left_out_lsb2 = 0.0;
        for &((p, q), loudness) in pairs {
            if loudness < budget.least_pair_lsb() {
                left_out_lsb2 += loudness * loudness;
                continue;
            }
            let way = [p.min(q), p.max(q)];
            if !ways.iter().any(|(known, _)| *known == way) {
                ways.push((way, loudness));
            }
        }
        let mut indices: Vec<ImageIndex> = ways.iter().flat_map(|(way, _)| *way).collect();
        indices.sort_unstable();
        indices.dedup();
        let Some(middle) = posed.get(posed.len() / 2) else { return Missed::default() };
        let antenna = middle_antenna(prepared);
        let pair = |&(way, loudness): &([ImageIndex; 2], f64)| Pair {
            images: way.map(|index| indices.binary_search(&index).unwrap_or(0)),
            loudness_lsb: loudness,
            settings: budget.settings(loudness),
        };
        let mut work = Work {
            prepared,
            integrator,
            skin: self.mesh.skin(),
            cloth: &self.cloth,
            times: [times, &fine],
            origin: middle.vertices.iter().sum::<DVec3>() / middle.vertices.len().max(1) as f64,
            places: indices.iter().map(|&index| Place::new(prepared, &antenna, index)).collect(),
            pairs: ways.iter().map(pair).collect(),
            antenna,
            indices,
            posed,
            weights: Vec::new(),
            missed_between_keys: budget.missed_between_keys(),
        };
        let shining = self.shining(&work);
        work.weights = self.weights(&work, people, me, &shining, budget);

        let loudest = prepared.lsb.iter().copied().fold(0.0, f64::max);
        // Patches add up: one alone this far below what can be seen is not missed.
        let least = (budget.least_patch_lsb() / loudest.max(1e-300)) as f32;
        let mut solver = PatchSolver::new(&work, least);
        let mut missed = Tally::default();
        for (patch, shining) in work.skin.patches().iter().zip(&shining).filter(|(_, pairs)| !pairs.is_empty()) {
            report.clamped += solver.pose(&work, patch, shining);
            for &number in shining {
                let Some(pair) = work.pairs.get(number) else { continue };
                if !solver.integrate(&work, patch, pair) {
                    continue;
                }
                report.paths += patch.triangles.len() * times.keys_s.len();
                if number == 0 {
                    solver.add_missed(&work, patch, pair, &mut missed);
                }
                report.synthesised += usize::from(solver.add_tone(&work, pair, grids));
            }
        }
        left_out_lsb2 += solver.left_out() * loudest * loudest;
        let Missed { between_keys, by_integration, .. } = missed.missed();
        let by_integration = by_integration * work.pairs.first().map_or(1.0, |pair| pair.settings.beyond());
        Missed { between_keys, by_integration, left_out: left_out_lsb2 / (budget.noise_lsb * budget.noise_lsb) }
    }

    /// By patch, the pairs of images between which it is near a specular point at the beginning or at the end.
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
                let outer = pair.settings.window[1] as f32;
                let lit = |(normals, lights): &([Row; 3], Vec<_>)| {
                    any_shines(level, normals, &narrowing, [&lights[a], &lights[b]], outer)
                };
                seen.iter().any(lit)
            };
            shining.extend(work.pairs.iter().enumerate().filter(|(_, pair)| shines(pair)).map(|(number, _)| number));
        }
        all
    }

    /// Factors of people and limbs on every image antenna's light at the vertices of patches that shine by it, at as many keys
    /// as its loudness asks for.
    fn weights(
        &self,
        work: &Work,
        people: &[Vec<Snapshot>],
        me: usize,
        shining: &[Vec<usize>],
        budget: &ErrorBudget,
    ) -> Vec<Vec<(f64, Vec<f64>)>> {
        let mut wanted = vec![vec![false; self.cloth.len()]; work.indices.len()];
        for (patch, pairs) in work.skin.patches().iter().zip(shining) {
            for image in pairs.iter().filter_map(|&number| work.pairs.get(number)).flat_map(|pair| pair.images) {
                patch.vertices.iter().for_each(|&v| wanted[image][v as usize] = true);
            }
        }
        let last = people.len().saturating_sub(1);
        let of_image = |image: usize| {
            let (index, place) = (work.indices[image], &work.places[image]);
            let of = work.pairs.iter().filter(|pair| pair.images.contains(&image));
            let keys = budget.shade_keys(of.map(|pair| pair.loudness_lsb).fold(0.0, f64::max), last);
            let at = |key: usize| {
                // Poses are twice as close as people's keys.
                let posed = work.posed.get(2 * key)?;
                let own =
                    self_occlusion::weights(work.skin, posed, place.middle, work.prepared.wavelength_m, &wanted[image]);
                let others = self.past_people(work.prepared, people.get(key)?, me, index);
                Some((2.0 * key as f64, own.iter().zip(others).map(|(a, b)| a * b).collect()))
            };
            keys.into_iter().filter_map(at).collect()
        };
        (0..work.indices.len()).map(of_image).collect()
    }
}

/// An antenna from a place, in single precision.
fn from(origin: DVec3, antenna: DVec3) -> [f32; 3] {
    (antenna - origin).as_vec3().to_array()
}
