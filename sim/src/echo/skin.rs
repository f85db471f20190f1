//! Echoes of a person modelled as a mesh: physical optics near specular points, patch by patch.
//!
//! Physical optics contributes only where the path length is nearly stationary. A smooth window over the angle between
//! normal and bisector keeps specular points with several Fresnel zones around them. The rest cancels and is dropped.
//! Inside the window each triangle is integrated ([`crate::em::curved_triangle`]) at the key times. Between them it is
//! a point of the body with an exact delay and a slowly varying strength. Triangles of one small patch are summed chirp
//! by chirp (`patch_sum.rs`) into one tone. No specular point is tracked between key times: their appearance,
//! merging and disappearance are part of the sum.
//!
//! A patch has as many triangles as there are lanes. It is processed for every path and every key time before the next,
//! so that its data stay in the cache.
//!
//! A path and its reverse differ by the few millimetres between transmitter and receivers, so they are integrated once.
//!
//! The strength at a vertex contains the reflection of the image antenna's field by skin (both polarisations, true
//! incidence), cloth, pattern and walls. It also contains the obstruction by people and by the body's own limbs.

use glam::DVec3;

use super::error_budget::{ErrorBudget, Missed};
use super::patch::{FrameTimes, ImagePositions, middle_antenna};
use super::patch_pose::vertex_rows;
use super::patch_solver::{Pair, PatchSolver, Tally, Work};
use super::surface_currents::{any_near_specular, direction_rows};
use super::{EchoReport, Snapshot, distinct_images, past_people, self_occlusion};
use crate::em::curved_triangle::Integrator;
use crate::em::image::ImageIndex;
use crate::lanes::Row;
use crate::people::body::SEGMENTS;
use crate::people::skin::PosedSkin;
use crate::people::walking_mesh::WalkingMesh;
use crate::prepared_scene::PreparedScene;
use crate::synthesis::ChirpGrids;

/// Person modelled as a skin mesh.
#[derive(Debug, Clone)]
pub struct SkinnedPerson {
    mesh: WalkingMesh,
    /// Factor of clothes on the amplitude at each vertex.
    cloth: Vec<f64>,
}

impl SkinnedPerson {
    /// Builds a person from a moving mesh.
    pub fn new(mesh: WalkingMesh) -> Self {
        let cloth = mesh.skin().blend(&mesh.motion().person.cloth);
        SkinnedPerson { mesh, cloth }
    }

    /// Returns the factor of clothes on the amplitude at each vertex.
    pub fn cloth(&self) -> &[f64] {
        &self.cloth
    }

    /// Returns the factors of obstruction by other people, and by the body itself before the last wall, on an image
    /// antenna's field at each vertex. They are computed by segment and blended over the vertices.
    pub fn past_people(&self, prepared: &PreparedScene, people: &[Snapshot], me: usize, index: ImageIndex) -> Vec<f64> {
        let Some(own) = people.get(me) else { return vec![1.0; self.cloth.len()] };
        let of_segment: [f64; SEGMENTS] =
            std::array::from_fn(|s| past_people(prepared, people, me, index, prepared.tx.position, own.body[s].centre));
        if of_segment.iter().all(|&w| w == 1.0) {
            return vec![1.0; self.cloth.len()];
        }
        self.mesh.skin().blend(&of_segment)
    }

    /// Returns the moving mesh.
    pub fn mesh(&self) -> &WalkingMesh {
        &self.mesh
    }

    /// Adds a person's echoes in a frame to grids. `people` are snapshots of all people at the key times, of whom this
    /// is number `me`. `pairs` are the audible pairs with their loudness, LSB, the loudest first; a path and its
    /// reverse count as one. Returns the error of the loudest pair's field, and the omitted power of the others.
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
        // Fast limbs need additional key times half-way between.
        let fine = times.halved();
        let posed: Vec<PosedSkin> = fine.keys_s.iter().map(|&t| self.mesh.posed(t)).collect();
        let (ways, mut left_out_lsb2) = loud_ways(pairs, budget);
        let indices = distinct_images(ways.iter().flat_map(|(way, _)| *way));
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
            places: indices.iter().map(|&index| ImagePositions::new(prepared, &antenna, index)).collect(),
            pairs: ways.iter().map(pair).collect(),
            antenna,
            indices,
            posed,
            weights: Vec::new(),
            missed_between_keys: budget.missed_between_keys(),
        };
        let near_specular = self.near_specular(&work);
        work.weights = self.weights(&work, people, me, &near_specular, budget);

        let loudest = prepared.lsb.iter().copied().fold(0.0, f64::max);
        // Patches add up, so the threshold of a single patch lies far below the visible level.
        let least = (budget.least_patch_lsb() / loudest.max(1e-300)) as f32;
        let mut solver = PatchSolver::new(&work, least);
        let mut missed = Tally::default();
        for (patch, near_specular) in
            work.skin.patches().iter().zip(&near_specular).filter(|(_, pairs)| !pairs.is_empty())
        {
            report.clamped += solver.pose(&work, patch, near_specular);
            for &number in near_specular {
                let Some(pair) = work.pairs.get(number) else { continue };
                if !solver.integrate(&work, patch, pair) {
                    continue;
                }
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

    /// Returns, for each patch, the pairs of images for which it is near a specular point at the beginning or at the
    /// end.
    fn near_specular(&self, work: &Work) -> Vec<Vec<usize>> {
        let level = work.integrator.level;
        let patches = self.mesh.skin().patches();
        let mut all = vec![Vec::new(); patches.len()];
        let ends = [work.posed.first(), work.posed.last()];
        for (patch, near_specular) in patches.iter().zip(&mut all) {
            let seen: Vec<_> = ends
                .iter()
                .flatten()
                .map(|posed| {
                    let [places, normals] = vertex_rows(posed, patch, work.origin);
                    let light =
                        |place: &ImagePositions| direction_rows(level, from(work.origin, place.middle), &places);
                    (normals, work.places.iter().map(light).collect::<Vec<_>>())
                })
                .collect();
            let narrowing = patch.vertices.map(|v| self.mesh.skin().narrowing()[v as usize]);
            let shines = |pair: &Pair| {
                let [a, b] = pair.images;
                let outer = pair.settings.window[1] as f32;
                let lit = |(normals, lights): &([Row; 3], Vec<_>)| {
                    any_near_specular(level, normals, &narrowing, [&lights[a], &lights[b]], outer)
                };
                seen.iter().any(lit)
            };
            near_specular
                .extend(work.pairs.iter().enumerate().filter(|(_, pair)| shines(pair)).map(|(number, _)| number));
        }
        all
    }

    /// Returns the factors of obstruction on every image antenna's field at the vertices of patches near its specular
    /// points. The number of key times depends on the loudness of the image.
    fn weights(
        &self,
        work: &Work,
        people: &[Vec<Snapshot>],
        me: usize,
        near_specular: &[Vec<usize>],
        budget: &ErrorBudget,
    ) -> Vec<Vec<(f64, Vec<f64>)>> {
        let mut wanted = vec![vec![false; self.cloth.len()]; work.indices.len()];
        for (patch, pairs) in work.skin.patches().iter().zip(near_specular) {
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
                // There is an additional pose between any two key times of people.
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

/// Returns the pairs that are loud enough to count, each once for a path and its reverse, with the loudness, LSB, of
/// the first of both. Also returns the power of the pairs that are left out, LSB^2.
fn loud_ways(pairs: &[((ImageIndex, ImageIndex), f64)], budget: &ErrorBudget) -> (Vec<([ImageIndex; 2], f64)>, f64) {
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
    (ways, left_out_lsb2)
}

/// Returns an antenna's position relative to an origin, in single precision.
fn from(origin: DVec3, antenna: DVec3) -> [f32; 3] {
    (antenna - origin).as_vec3().to_array()
}
