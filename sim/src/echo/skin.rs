//! Echoes of a person modelled as a mesh: physical optics near specular points, patch by patch.
//!
//! Physical optics contributes only where the path length is nearly stationary. A smooth window over the angle between
//! normal and bisector keeps specular points with several Fresnel zones around them. The rest cancels and is left out.
//! Inside the window each triangle is integrated ([`crate::em::curved_triangle`]) at the key times. Between them it is
//! a point of the body with an exact delay and a slowly varying field. The triangles of one small patch are summed
//! chirp by chirp (`patch_sum.rs`) into one tone. No specular point is tracked between key times: their appearance,
//! merging and disappearance are part of the sum.
//!
//! A patch has as many triangles as there are lanes. It is processed for every path and every key time before the next,
//! so that its data stay in the cache.
//!
//! A path and its reverse differ by the few millimetres between transmitter and receivers, so they are integrated once.
//!
//! The integrand at a vertex contains the reflection of the image antenna's field by skin (both polarisations, true
//! incidence), cloth, pattern and walls. It also contains the obstruction by people and by the body's own limbs.

use glam::DVec3;

use super::error_budget::{ErrorBudget, ErrorEstimate};
use super::patch::{FrameTimes, ImagePositions, middle_antenna};
use super::patch_pose::vertex_rows;
use super::patch_solver::{ErrorSums, ImagePair, PatchSolver, SolverInputs};
use super::surface_currents::{any_near_specular, direction_rows};
use super::{EchoReport, Snapshot, distinct_images, people_factor, self_occlusion};
use crate::em::curved_triangle::Integrator;
use crate::em::image::ImageIndex;
use crate::em::specular::Ellipsoid;
use crate::lanes::Row;
use crate::people::body::{CHEST, SEGMENTS, THIGH, UPPER_ARM};
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
    pub fn people_factors(
        &self,
        prepared: &PreparedScene,
        people: &[Snapshot],
        target: usize,
        index: ImageIndex,
    ) -> Vec<f64> {
        let Some(snapshot) = people.get(target) else { return vec![1.0; self.cloth.len()] };
        let antenna = prepared.tx.position;
        let by_segment: [f64; SEGMENTS] =
            std::array::from_fn(|s| people_factor(prepared, people, target, index, antenna, snapshot.body[s].centre));
        if by_segment.iter().all(|&factor| factor == 1.0) {
            return vec![1.0; self.cloth.len()];
        }
        self.mesh.skin().blend(&by_segment)
    }

    /// Returns the moving mesh.
    pub fn mesh(&self) -> &WalkingMesh {
        &self.mesh
    }

    /// Adds a person's echoes in a frame to grids. `people` are snapshots of all people at the key times; this person
    /// is number `target`. `pairs` are the audible pairs with their loudness, LSB, the loudest first; a path and its
    /// reverse count as one. Returns the errors of the loudest pair's field, and the omitted power of all pairs.
    #[allow(clippy::too_many_arguments)]
    pub fn add_echoes(
        &self,
        prepared: &PreparedScene,
        integrator: &Integrator,
        budget: &ErrorBudget,
        times: &FrameTimes,
        people: &[Vec<Snapshot>],
        target: usize,
        pairs: &[((ImageIndex, ImageIndex), f64)],
        grids: &mut ChirpGrids,
        report: &mut EchoReport,
    ) -> ErrorEstimate {
        // Fast limbs need additional key times half-way between.
        let fine = times.with_midpoints();
        let posed: Vec<PosedSkin> = fine.keys_s.iter().map(|&t| self.mesh.posed(t)).collect();
        let (pairs, mut omitted_lsb2) = unordered_pairs(pairs, budget);
        let images = distinct_images(pairs.iter().flat_map(|(pair, _)| *pair));
        let Some(middle) = posed.get(posed.len() / 2) else { return ErrorEstimate::default() };
        let antenna = middle_antenna(prepared);
        let image_pair = |&(pair, loudness): &([ImageIndex; 2], f64)| ImagePair {
            images: pair.map(|index| images.binary_search(&index).unwrap_or(0)),
            loudness_lsb: loudness,
            settings: budget.settings(loudness),
        };
        let mut inputs = SolverInputs {
            prepared,
            integrator,
            skin: self.mesh.skin(),
            cloth: &self.cloth,
            times: [times, &fine],
            origin: middle.vertices.iter().sum::<DVec3>() / middle.vertices.len().max(1) as f64,
            positions: images.iter().map(|&index| ImagePositions::new(prepared, &antenna, index)).collect(),
            pairs: pairs.iter().map(image_pair).collect(),
            antenna,
            images,
            posed,
            obstruction: Vec::new(),
            interpolation_tolerance: budget.interpolation_tolerance(),
        };
        let near_specular = self.near_specular(&inputs);
        inputs.obstruction = self.obstruction_factors(&inputs, people, target, &near_specular, budget);

        let max_lsb = prepared.lsb.iter().copied().fold(0.0, f64::max);
        let min_field = (budget.min_patch_lsb() / max_lsb.max(1e-300)) as f32;
        let mut solver = PatchSolver::new(&inputs, min_field);
        let mut errors = ErrorSums::default();
        for (patch, near_specular) in
            inputs.skin.patches().iter().zip(&near_specular).filter(|(_, pairs)| !pairs.is_empty())
        {
            report.clamped += solver.pose(&inputs, patch, near_specular);
            for &number in near_specular {
                let Some(pair) = inputs.pairs.get(number) else { continue };
                if !solver.integrate(&inputs, patch, pair) {
                    continue;
                }
                if number == 0 {
                    solver.add_errors(&inputs, patch, pair, &mut errors);
                }
                report.synthesised += usize::from(solver.add_tone(&inputs, pair, grids));
            }
        }
        omitted_lsb2 += solver.omitted_power() * max_lsb * max_lsb;
        let ErrorEstimate { interpolation, integration, .. } = errors.estimate();
        let integration = integration * inputs.pairs.first().map_or(1.0, |pair| pair.settings.share_beyond_window());
        ErrorEstimate {
            interpolation,
            integration,
            omitted_power: omitted_lsb2 / (budget.noise_lsb * budget.noise_lsb),
        }
    }

    /// Returns, for each patch, the pairs of images for which it is near a specular point at the beginning or at the
    /// end.
    fn near_specular(&self, inputs: &SolverInputs) -> Vec<Vec<usize>> {
        let level = inputs.integrator.level;
        let patches = self.mesh.skin().patches();
        let mut all = vec![Vec::new(); patches.len()];
        let ends = [inputs.posed.first(), inputs.posed.last()];
        for (patch, near_specular) in patches.iter().zip(&mut all) {
            let at_ends: Vec<_> = ends
                .iter()
                .flatten()
                .map(|posed| {
                    let [places, normals] = vertex_rows(posed, patch, inputs.origin);
                    let directions = |position: &ImagePositions| {
                        direction_rows(level, relative_to(inputs.origin, position.middle), &places)
                    };
                    (normals, inputs.positions.iter().map(directions).collect::<Vec<_>>())
                })
                .collect();
            let narrowing = patch.vertices.map(|v| self.mesh.skin().narrowing()[v as usize]);
            let is_near = |pair: &ImagePair| {
                let [a, b] = pair.images;
                let outer = pair.settings.window[1] as f32;
                let is_near_at = |(normals, directions): &([Row; 3], Vec<_>)| {
                    any_near_specular(level, normals, &narrowing, [&directions[a], &directions[b]], outer)
                };
                at_ends.iter().any(is_near_at)
            };
            near_specular
                .extend(inputs.pairs.iter().enumerate().filter(|(_, pair)| is_near(pair)).map(|(number, _)| number));
        }
        all
    }

    /// Returns the factors of obstruction on every image antenna's field at the vertices of patches near its specular
    /// points. The number of key times depends on the loudness of the image.
    fn obstruction_factors(
        &self,
        inputs: &SolverInputs,
        people: &[Vec<Snapshot>],
        target: usize,
        near_specular: &[Vec<usize>],
        budget: &ErrorBudget,
    ) -> Vec<Vec<(f64, Vec<f64>)>> {
        let mut is_wanted = vec![vec![false; self.cloth.len()]; inputs.images.len()];
        for (patch, pairs) in inputs.skin.patches().iter().zip(near_specular) {
            for image in pairs.iter().filter_map(|&number| inputs.pairs.get(number)).flat_map(|pair| pair.images) {
                patch.vertices.iter().for_each(|&v| is_wanted[image][v as usize] = true);
            }
        }
        let last = people.len().saturating_sub(1);
        let arm_motion_m = arm_motion_m(people, target);
        let of_image = |image: usize| {
            let (index, antenna) = (inputs.images[image], inputs.positions[image].middle);
            let pairs = inputs.pairs.iter().filter(|pair| pair.images.contains(&image));
            let keys =
                budget.occlusion_keys(pairs.map(|pair| pair.loudness_lsb).fold(0.0, f64::max), arm_motion_m, last);
            let at = |key: usize| {
                // There is an additional pose between any two key times of people.
                let posed = inputs.posed.get(2 * key)?;
                let wavelength_m = inputs.prepared.wavelength_m;
                let by_limbs = self_occlusion::factors(inputs.skin, posed, antenna, wavelength_m, &is_wanted[image]);
                let by_people = self.people_factors(inputs.prepared, people.get(key)?, target, index);
                Some((2.0 * key as f64, by_limbs.iter().zip(by_people).map(|(a, b)| a * b).collect()))
            };
            keys.into_iter().filter_map(at).collect()
        };
        (0..inputs.images.len()).map(of_image).collect()
    }
}

/// Returns the longest way of an arm against the chest from the first key time to the last one, m. Legs shadow little of the
/// trunk.
fn arm_motion_m(people: &[Vec<Snapshot>], target: usize) -> f64 {
    let body = |people: &[Snapshot]| people.get(target).map(|snapshot| snapshot.body);
    let Some((first, last)) = people.first().and_then(|p| body(p)).zip(people.last().and_then(|p| body(p))) else {
        return 0.0;
    };
    let trunk = last[CHEST].centre - first[CHEST].centre;
    let motion = |(first, last): (&Ellipsoid, &Ellipsoid)| (last.centre - first.centre - trunk).length();
    let arms = UPPER_ARM..THIGH;
    first[arms.clone()].iter().zip(&last[arms]).map(motion).fold(0.0, f64::max)
}

/// Returns the pairs that are loud enough to count, each once for a path and its reverse, with the loudness, LSB, of
/// the first of both. Also returns the power of the pairs that are left out, LSB^2.
fn unordered_pairs(
    pairs: &[((ImageIndex, ImageIndex), f64)],
    budget: &ErrorBudget,
) -> (Vec<([ImageIndex; 2], f64)>, f64) {
    let mut kept: Vec<([ImageIndex; 2], f64)> = Vec::new();
    let mut omitted_lsb2 = 0.0;
    for &((p, q), loudness) in pairs {
        if loudness < budget.min_pair_lsb() {
            omitted_lsb2 += loudness * loudness;
            continue;
        }
        let pair = [p.min(q), p.max(q)];
        if !kept.iter().any(|(known, _)| *known == pair) {
            kept.push((pair, loudness));
        }
    }
    (kept, omitted_lsb2)
}

/// Returns an antenna's position relative to an origin, in single precision.
fn relative_to(origin: DVec3, antenna: DVec3) -> [f32; 3] {
    (antenna - origin).as_vec3().to_array()
}
