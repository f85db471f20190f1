//! Solver of a skin's patches, one after the other. It poses a patch at the key times, integrates its echo for each
//! pair of images, and adds the echo to the grids as tones.

use glam::DVec3;
use num_complex::Complex64;

use super::error_budget::{ErrorEstimate, IntegrationSettings};
use super::inside_room;
use super::patch::{FrameTimes, ImagePositions, Patch, interpolation_error};
use super::patch_field::{FieldInputs, IntegrandRows, PatchField, patch_field};
use super::patch_pose::{PatchPose, Rules};
use super::patch_sum::PatchSums;
use super::surface_currents::{FieldAround, FieldRows, IntegrandInputs, common_factor, field_rows, integrands};
use crate::em::curved_triangle::{HALVES, Integrator, MomentRows, moments, spans_rad};
use crate::em::image::{Element, ImageIndex};
use crate::em::quadrature::rule_for;
use crate::lanes::{LANES, Row};
use crate::material::SKIN_PERMITTIVITY;
use crate::people::skin::{PosedSkin, Skin, SkinPatch};
use crate::prepared_scene::PreparedScene;
use crate::synthesis::{ChirpGrids, Echo, EchoFactors, phasor};

/// Phase span across a triangle up to which all of a patch may be in phase, rad. At larger spans the bound on its field
/// falls in inverse proportion. The value was measured: the patches that it rejects are inaudible.
const IN_PHASE_RAD: f32 = 0.8;

/// Two images between which a person's echo is audible, in both directions.
pub(super) struct ImagePair {
    /// Indices in the list of images.
    pub(super) images: [usize; 2],
    pub(super) loudness_lsb: f64,
    pub(super) settings: IntegrationSettings,
}

/// Inputs shared by all patches.
pub(super) struct SolverInputs<'a> {
    pub(super) prepared: &'a PreparedScene,
    pub(super) integrator: &'a Integrator,
    pub(super) skin: &'a Skin,
    /// Factor of clothes on the amplitude at each vertex.
    pub(super) cloth: &'a [f64],
    /// Key times, and the same with additional key times half-way between.
    pub(super) times: [&'a FrameTimes; 2],
    /// Centre of the body: origin of single-precision coordinates.
    pub(super) origin: DVec3,
    /// Antenna half-way between transmitter and receivers, which stands for all antennas.
    pub(super) antenna: Element,
    /// Images of all pairs, ascending, and the positions of the antennas' images.
    pub(super) images: Vec<ImageIndex>,
    pub(super) positions: Vec<ImagePositions>,
    pub(super) pairs: Vec<ImagePair>,
    /// Poses at the finer key times.
    pub(super) posed: Vec<PosedSkin>,
    /// Factors of obstruction by people and limbs, `[image][key time][vertex]`. They are known at some of the finer key
    /// times, given by their indices.
    pub(super) obstruction: Vec<Vec<(f64, Vec<f64>)>>,
    /// Relative interpolation error that is allowed for a patch between key times.
    pub(super) interpolation_tolerance: f64,
}

/// Patch at one of the finer key times.
struct KeyPose {
    patch: PatchPose,
    /// Fields of the antenna's images, by image.
    fields: Vec<FieldRows>,
    /// Factors of obstruction, by image.
    obstruction: Vec<Row>,
    /// Whether fields and obstruction have been computed, by image.
    is_evaluated: Vec<bool>,
    /// Physical-optics integrands for the current pair of images.
    integrands: (Row, Row),
    moments: MomentRows,
}

/// Solver that holds the patch being processed.
pub(super) struct PatchSolver {
    poses: Vec<KeyPose>,
    /// Whether the patch has been posed half-way between key times.
    has_midpoints: bool,
    /// Images for which the patch is evaluated, as indices.
    images: Vec<usize>,
    /// Expansions of these images' fields around the patch.
    expansions: Vec<FieldAround>,
    /// Fields of the triangles at the key times.
    fields: Vec<PatchField>,
    /// 0 if these are the original key times, 1 if they are the finer ones.
    refinement: usize,
    sums: PatchSums,
    /// Echo factors for each receiver.
    factors: Vec<EchoFactors>,
    /// Area of the patch in the middle pose.
    area_m2: f32,
    /// Field below which a patch is left out.
    min_field: f32,
    /// Sum of the squares of the omitted fields.
    omitted_power: f64,
}

impl PatchSolver {
    /// Creates an empty solver that leaves out patches with fields below `min_field`.
    pub(super) fn new(inputs: &SolverInputs, min_field: f32) -> Self {
        let images = inputs.images.len();
        let pose = |_: &PosedSkin| KeyPose {
            patch: PatchPose::new(images, inputs.integrator),
            fields: vec![FieldRows::default(); images],
            obstruction: vec![[1.0; LANES]; images],
            is_evaluated: vec![false; images],
            integrands: ([0.0; LANES], [0.0; LANES]),
            moments: MomentRows::default(),
        };
        PatchSolver {
            poses: inputs.posed.iter().map(pose).collect(),
            has_midpoints: false,
            images: Vec::new(),
            expansions: Vec::new(),
            fields: Vec::new(),
            refinement: 0,
            sums: PatchSums::new(inputs.integrator.level),
            factors: Vec::new(),
            area_m2: 0.0,
            min_field,
            omitted_power: 0.0,
        }
    }

    /// Returns the sum of the squares of the omitted fields.
    pub(super) fn omitted_power(&self) -> f64 {
        self.omitted_power
    }

    /// Poses a patch at the key times and evaluates it for the images of the pairs `near_specular`, for which it is
    /// near a specular point. Returns the number of clamped distances.
    pub(super) fn pose(&mut self, inputs: &SolverInputs, patch: &SkinPatch, near_specular: &[usize]) -> usize {
        self.images.clear();
        self.images
            .extend(near_specular.iter().filter_map(|&number| inputs.pairs.get(number)).flat_map(|pair| pair.images));
        self.images.sort_unstable();
        self.images.dedup();
        self.has_midpoints = false;
        self.expansions = self.expand_fields(inputs, patch);
        let mut clamped = 0;
        for key in (0..self.poses.len()).step_by(2) {
            self.pose_at(inputs, patch, key);
            for number in 0..self.images.len() {
                clamped += self.evaluate_image(inputs, patch, key, self.images[number]);
            }
        }
        // The even key time that is next to the middle: the others are posed where they are needed.
        self.area_m2 = self.poses.get(inputs.posed.len() / 4 * 2).map_or(0.0, |pose| pose.patch.triangles.area_m2());
        clamped
    }

    /// Expands the fields of the images around a patch in the middle of the frame. A linear expansion suffices, because
    /// patterns and walls change little over a patch and a frame.
    fn expand_fields(&self, inputs: &SolverInputs, patch: &SkinPatch) -> Vec<FieldAround> {
        let Some(middle) = inputs.posed.get(inputs.posed.len() / 2) else { return Vec::new() };
        let centre = patch.vertices.iter().map(|&v| middle.vertices[v as usize]).sum::<DVec3>() / LANES as f64;
        let field =
            |image: usize, at: DVec3| inputs.prepared.room.illuminate(&inputs.antenna, inputs.images[image], at).field;
        self.images.iter().map(|&image| FieldAround::new(centre, inputs.origin, |at| field(image, at))).collect()
    }

    /// Poses a patch at one of the finer key times.
    fn pose_at(&mut self, inputs: &SolverInputs, patch: &SkinPatch, key: usize) {
        let Some((pose, posed)) = self.poses.get_mut(key).zip(inputs.posed.get(key)) else { return };
        let amplitude_factor = |v: usize| (inputs.cloth[v] * inside_room(inputs.prepared, posed.vertices[v])) as f32;
        let amplitude_factor = patch.vertices.map(|v| amplitude_factor(v as usize));
        let narrowing = patch.vertices.map(|v| inputs.skin.narrowing()[v as usize]);
        pose.patch.pose(inputs.integrator.level, patch, posed, inputs.origin, amplitude_factor, narrowing);
        pose.is_evaluated.fill(false);
    }

    /// Computes directions, fields and obstruction of a posed patch for one of the images, once per pose. Returns the
    /// number of clamped distances.
    fn evaluate_image(&mut self, inputs: &SolverInputs, patch: &SkinPatch, key: usize, image: usize) -> usize {
        let level = inputs.integrator.level;
        let expansion = self.images.binary_search(&image).ok().and_then(|number| self.expansions.get(number));
        let (Some(pose), Some(expansion)) = (self.poses.get_mut(key), expansion) else { return 0 };
        if std::mem::replace(&mut pose.is_evaluated[image], true) {
            return 0;
        }
        pose.patch.view_from(image, inputs.positions[image].middle, inputs.origin, inputs.prepared.wavelength_m, level);
        pose.fields[image] = field_rows(level, expansion, &pose.patch.vertices.positions);
        pose.obstruction[image] = obstruction_at(&inputs.obstruction[image], key as f64, patch);
        pose.patch.directions[image].clamped()
    }

    /// Integrates the patch between two images, with as many key times as accuracy requires. Returns whether the patch
    /// may be audible.
    pub(super) fn integrate(&mut self, inputs: &SolverInputs, patch: &SkinPatch, pair: &ImagePair) -> bool {
        let [out, back] = pair.images;
        let mut strongest = 0f32;
        let mut live = [false; LANES];
        for pose in self.poses.iter_mut().step_by(2) {
            pose.integrands = pose.integrands(inputs, pair, &pair.settings);
            let (re, im) = &pose.integrands;
            for (l, live) in live.iter_mut().enumerate() {
                let square = re[l] * re[l] + im[l] * im[l];
                *live |= square > 0.0;
                strongest = strongest.max(square);
            }
        }
        let Some(middle) = self.poses.get(self.poses.len() / 4 * 2) else { return false };
        let spans = spans_rad(inputs.integrator.level, [&middle.patch.views[out], &middle.patch.views[back]]);
        let corners_live = |l: usize| patch.corners[l].iter().any(|&v| live[v % LANES]);
        let lanes_live = (0..patch.triangles.len()).filter(|&l| corners_live(l));
        let min_span = lanes_live.clone().map(|l| spans[l]).fold(f32::INFINITY, f32::min);
        // The integral over a triangle with a large phase span is at most two over the span, and that over a patch is
        // smaller still. If even this bound is inaudible, skip the integral.
        if strongest == 0.0 || strongest.sqrt() * self.area_m2 * (IN_PHASE_RAD / min_span).min(1.0) < self.min_field {
            return false;
        }
        let rules = rules_for(&spans, lanes_live, pair.settings.ease);
        self.poses.iter_mut().step_by(2).for_each(|pose| pose.compute_moments(inputs, pair, rules));
        self.compute_fields(inputs, patch, pair, 0);
        let (error, power) = self.interpolation_error(inputs);
        // The error of cubic interpolation grows with the fourth power of the step.
        if error.sqrt() / 16.0 > f64::from(self.min_field).max(inputs.interpolation_tolerance * power.sqrt()) {
            if !self.has_midpoints {
                for key in (1..self.poses.len()).step_by(2) {
                    self.pose_at(inputs, patch, key);
                }
                self.has_midpoints = true;
            }
            for key in (1..self.poses.len()).step_by(2) {
                for image in pair.images {
                    self.evaluate_image(inputs, patch, key, image);
                }
            }
            for pose in self.poses.iter_mut().skip(1).step_by(2) {
                pose.integrands = pose.integrands(inputs, pair, &pair.settings);
                pose.compute_moments(inputs, pair, rules);
            }
            self.compute_fields(inputs, patch, pair, 1);
        }
        true
    }

    /// Computes the triangles' fields at the original key times (`refinement` 0) or the finer ones (1).
    fn compute_fields(&mut self, inputs: &SolverInputs, patch: &SkinPatch, pair: &ImagePair, refinement: usize) {
        self.refinement = refinement;
        let poses: Vec<&KeyPose> = self.poses.iter().step_by(2 - refinement).collect();
        self.fields.clear();
        self.fields.extend(poses.iter().enumerate().map(|(key, pose)| {
            let rates = rates(&poses, key, &inputs.times[refinement].keys_s);
            pose.patch_field(inputs, patch, pair, &IntegrandRows { now: pose.integrands, rates })
        }));
    }

    /// Returns the squared interpolation error between the patch's key times, and the squared fields.
    fn interpolation_error(&self, inputs: &SolverInputs) -> (f64, f64) {
        let step_s = inputs.times[self.refinement].step_s();
        interpolation_error(inputs.integrator.level, &self.fields, step_s, inputs.prepared.wavelength_m)
    }

    /// Adds the errors of a pair that has been integrated: between key times, and against a coarser field in the middle
    /// of the frame.
    pub(super) fn add_errors(
        &mut self,
        inputs: &SolverInputs,
        patch: &SkinPatch,
        pair: &ImagePair,
        errors: &mut ErrorSums,
    ) {
        let coarse = &pair.settings.coarser();
        let [out, back] = pair.images;
        errors.add_interpolation(self.interpolation_error(inputs));
        let middle = self.poses.len() / 4;
        let fine = self.fields.get(middle * (1 + self.refinement));
        let (Some(pose), Some(fine)) = (self.poses.get_mut(2 * middle), fine) else { return };
        let integrands = IntegrandRows { now: pose.integrands(inputs, pair, coarse), ..IntegrandRows::default() };
        let spans = spans_rad(inputs.integrator.level, [&pose.patch.views[out], &pose.patch.views[back]]);
        pose.compute_moments(inputs, pair, rules_for(&spans, 0..patch.triangles.len(), coarse.ease));
        errors.add_integration(fine, &pose.patch_field(inputs, patch, pair, &integrands), inputs.prepared.wavelength_m);
    }

    /// Adds the echo of the patch between two images in every chirp. Returns whether it was strong enough to be added.
    pub(super) fn add_tone(&mut self, inputs: &SolverInputs, pair: &ImagePair, grids: &mut ChirpGrids) -> bool {
        let (prepared, times) = (inputs.prepared, inputs.times[self.refinement]);
        let in_phase = |field: &PatchField| field.powers().into_iter().map(f32::sqrt).sum::<f32>();
        let is_both = pair.images[0] != pair.images[1];
        let directions = if is_both { 2.0 } else { 1.0 };
        if self.fields.iter().map(in_phase).fold(0.0, f32::max) < self.min_field {
            // The power is summed as for triangles with independent phases.
            let power = |field: &PatchField| field.powers().into_iter().sum::<f32>();
            self.omitted_power += directions * f64::from(self.fields.iter().map(power).fold(0.0, f32::max));
            return false;
        }
        let images = pair.images.map(|i| &inputs.positions[i]);
        let (fields, sums) = (&self.fields, &mut self.sums);
        let Some(patch) = Patch::new(fields, inputs.origin, images, times, prepared.wavelength_m, sums) else {
            return false;
        };
        let loudest = sums.loudest();
        if loudest < self.min_field {
            self.omitted_power += directions * f64::from(loudest * loudest);
            return false;
        }
        patch.echo_factors(prepared, images, is_both, times.chirps_s.len(), &mut self.factors);
        let (factors, chirps) = (self.factors.as_slice(), sums.chirps());
        grids.add(&Echo { chirp: &prepared.chirp, wavelength_m: prepared.wavelength_m, factors, chirps });
        true
    }
}

impl KeyPose {
    /// Computes the physical-optics integrands at the vertices for a pair of images.
    fn integrands(&self, inputs: &SolverInputs, pair: &ImagePair, settings: &IntegrationSettings) -> (Row, Row) {
        let [out, back] = pair.images;
        let integrand_inputs = IntegrandInputs {
            vertices: &self.patch.vertices,
            directions: [&self.patch.directions[out], &self.patch.directions[back]],
            fields: [&self.fields[out], &self.fields[back]],
            obstruction: [&self.obstruction[out], &self.obstruction[back]],
            permittivity: SKIN_PERMITTIVITY,
            settings,
            factor: common_factor(inputs.prepared.wavelength_m),
        };
        integrands(inputs.integrator.level, &integrand_inputs)
    }

    /// Computes the fields of the triangles for a pair of images.
    fn patch_field(
        &self,
        inputs: &SolverInputs,
        patch: &SkinPatch,
        pair: &ImagePair,
        integrands: &IntegrandRows,
    ) -> PatchField {
        let field_inputs = FieldInputs {
            posed: &self.patch,
            images: pair.images,
            moments: &self.moments,
            corners: &patch.corners,
            integrands,
            wavelength_m: inputs.prepared.wavelength_m,
        };
        patch_field(inputs.integrator.level, &field_inputs)
    }

    /// Integrates the moments of the triangles for a pair of images, by these quadrature rules.
    fn compute_moments(&mut self, inputs: &SolverInputs, pair: &ImagePair, rules: Rules) {
        let [out, back] = pair.images;
        self.patch.compute_nodes(rules, inputs.integrator);
        let views = [&self.patch.views[out], &self.patch.views[back]];
        self.moments = moments(inputs.integrator.level, self.patch.nodes(rules), views);
    }
}

/// Selects the quadrature rule for the widest phase span among these lanes, rad, for each half of all lanes.
pub(super) fn rules_for(spans: &Row, lanes: impl Iterator<Item = usize>, ease: f32) -> Rules {
    let mut widest: [Option<f32>; HALVES] = [None; HALVES];
    for l in lanes {
        if let Some(widest) = widest.get_mut(l * HALVES / LANES) {
            *widest = Some(widest.map_or(spans[l], |most| most.max(spans[l])));
        }
    }
    widest.map(|span| span.map(|span| rule_for(span, ease)))
}

/// Interpolates an image's factors of obstruction at a patch's vertices linearly between the key times at which they
/// are known.
fn obstruction_at(known: &[(f64, Vec<f64>)], key: f64, patch: &SkinPatch) -> Row {
    let next = known.iter().position(|(known_key, _)| *known_key >= key).unwrap_or(known.len().saturating_sub(1));
    let Some((end, after)) = known.get(next) else { return [1.0; LANES] };
    let (start, before) =
        known.get(next.saturating_sub(1)).map_or((*end, after), |(known_key, factors)| (*known_key, factors));
    let fraction = if end > &start { (key - start) / (end - start) } else { 0.0 };
    let mut factors = [1.0; LANES];
    for (factor, &v) in factors.iter_mut().zip(&patch.vertices) {
        if let Some((before, after)) = before.get(v as usize).zip(after.get(v as usize)) {
            *factor = (before * (1.0 - fraction) + after * fraction) as f32;
        }
    }
    factors
}

/// Computes rates of the integrands by differences over equal steps. They are central differences; at the ends they are
/// those of the parabola through three key times.
fn rates(poses: &[&KeyPose], key: usize, times_s: &[f64]) -> (Row, Row) {
    let last = poses.len().saturating_sub(1);
    let step_s = match times_s {
        [first, second, ..] => second - first,
        _ => 1.0,
    };
    let weights: &[(usize, f64)] = match (key, last) {
        (_, 0) => &[],
        (_, 1) => &[(0, -1.0), (1, 1.0)],
        (0, _) => &[(0, -1.5), (1, 2.0), (2, -0.5)],
        (key, last) if key == last => &[(last, 1.5), (last - 1, -2.0), (last - 2, 0.5)],
        (key, _) => &[(key + 1, 0.5), (key - 1, -0.5)],
    };
    let mut rates = ([0.0; LANES], [0.0; LANES]);
    for &(key, weight) in weights {
        let (weight, (re, im)) = ((weight / step_s) as f32, &poses[key].integrands);
        for l in 0..LANES {
            rates.0[l] += weight * re[l];
            rates.1[l] += weight * im[l];
        }
    }
    rates
}

/// Resolution in path length of the comparison with a coarser field, m: about a cell of the range axis.
const LENGTH_BIN_M: f64 = 0.15;

/// Largest index of path length in that comparison; longer paths have this index, too.
const MAX_LENGTH_BIN: usize = 4096;

/// Difference from a coarser field, and the field itself.
type Difference = [Complex64; 2];

/// Accumulated errors of a pair's field.
#[derive(Debug, Default)]
pub(super) struct ErrorSums {
    /// Sums of the squared interpolation errors and of the squared fields.
    interpolation: [f64; 2],
    /// Errors by path length. Far from specular points the fields of neighbours cancel, so errors are summed
    /// coherently.
    integration: Vec<Difference>,
}

impl ErrorSums {
    fn add_interpolation(&mut self, (error, power): (f64, f64)) {
        self.interpolation = [self.interpolation[0] + error, self.interpolation[1] + power];
    }

    fn add_integration(&mut self, fine: &PatchField, coarse: &PatchField, wavelength_m: f64) {
        let field = |of: &PatchField, l: usize| Complex64::new(of.field[0][l].into(), of.field[1][l].into());
        let by_length = &mut self.integration;
        for l in 0..LANES {
            let (fine_field, coarse_field) = (field(fine, l), field(coarse, l));
            if fine_field == Complex64::ZERO && coarse_field == Complex64::ZERO {
                continue;
            }
            let number = ((fine.length_m[l] / LENGTH_BIN_M) as usize).min(MAX_LENGTH_BIN);
            if by_length.len() <= number {
                by_length.resize(number + 1, Difference::default());
            }
            let Some([difference, sum]) = by_length.get_mut(number) else { continue };
            let phasor = phasor(-fine.length_m[l] / wavelength_m);
            let phasor = Complex64::new(phasor.re.into(), phasor.im.into());
            *difference += (fine_field - coarse_field) * phasor;
            *sum += fine_field * phasor;
        }
    }

    /// Returns the errors relative to the field.
    pub(super) fn estimate(&self) -> ErrorEstimate {
        let relative = |[error, power]: [f64; 2]| if power > 0.0 { (error / power).sqrt() } else { 0.0 };
        let add = |[a, b]: [f64; 2], [difference, sum]: &Difference| [a + difference.norm_sqr(), b + sum.norm_sqr()];
        let integration = self.integration.iter().fold([0.0; 2], add);
        // The error of cubic interpolation grows with the fourth power of the step.
        ErrorEstimate {
            interpolation: relative(self.interpolation) / 16.0,
            integration: relative(integration),
            omitted_power: 0.0,
        }
    }
}
