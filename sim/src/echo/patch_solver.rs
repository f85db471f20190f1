//! Solver of a skin's patches, one after the other. It poses a patch at the key times, integrates it between pairs of
//! images, and adds it to the grids as tones.

use glam::DVec3;
use num_complex::Complex64;

use super::error_budget::{IntegrationSettings, Missed};
use super::inside_room;
use super::patch::{FrameTimes, ImagePositions, Patch, missed_between_keys};
use super::patch_field::{Parts, PatchField, StrengthRows, patch_field};
use super::patch_pose::{PatchPose, Rules};
use super::patch_sum::PatchSums;
use super::surface_currents::{Between, FieldAround, FieldRows, common_factor, field_rows, strengths};
use crate::em::curved_triangle::{HALVES, Integrator, MomentRows, moments, spans_rad};
use crate::em::image::{Element, ImageIndex};
use crate::em::quadrature::rule_for;
use crate::lanes::{LANES, Row};
use crate::material::SKIN_PERMITTIVITY;
use crate::people::skin::{PosedSkin, Skin, SkinPatch};
use crate::prepared_scene::PreparedScene;
use crate::synthesis::{ChirpGrids, Echo, EchoFactors, phasor};

/// Phase span across a triangle above which a patch is taken to be weaker than one in phase, in proportion, rad. The
/// value was measured: the patches it rejects are inaudible.
const RUN_RAD: f32 = 0.8;

/// Two images between which a person's echo is audible, in both directions.
pub(super) struct Pair {
    /// Indices in the list of images.
    pub(super) images: [usize; 2],
    pub(super) loudness_lsb: f64,
    pub(super) settings: IntegrationSettings,
}

/// Inputs shared by all patches.
pub(super) struct Work<'a> {
    pub(super) prepared: &'a PreparedScene,
    pub(super) integrator: &'a Integrator,
    pub(super) skin: &'a Skin,
    /// Factor of clothes on the amplitude at each vertex.
    pub(super) cloth: &'a [f64],
    /// Key times, and the same with additional key times half-way between.
    pub(super) times: [&'a FrameTimes; 2],
    /// Centre of the body: origin of single-precision coordinates.
    pub(super) origin: DVec3,
    pub(super) antenna: Element,
    pub(super) indices: Vec<ImageIndex>,
    pub(super) places: Vec<ImagePositions>,
    pub(super) pairs: Vec<Pair>,
    /// Poses at the finer key times.
    pub(super) posed: Vec<PosedSkin>,
    /// Factors of obstruction by people and limbs, `[image][key][vertex]`, at some of the finer key times, given by
    /// their indices.
    pub(super) weights: Vec<Vec<(f64, Vec<f64>)>>,
    /// Relative interpolation error of a patch that is allowed between key times.
    pub(super) missed_between_keys: f64,
}

/// Patch at one of the finer key times.
struct Pose {
    patch: PatchPose,
    /// Field rows by image.
    fields: Vec<FieldRows>,
    weights: Vec<Row>,
    /// Whether fields and weights have been computed, by image.
    is_evaluated: Vec<bool>,
    /// Strengths between the current pair of images.
    strengths: (Row, Row),
    moments: MomentRows,
}

/// Solver that holds the patch being processed.
pub(super) struct PatchSolver {
    poses: Vec<Pose>,
    /// Whether the patch has been posed half-way between key times.
    between: bool,
    images: Vec<usize>,
    /// Expansions of these images' fields around the patch.
    around: Vec<FieldAround>,
    /// Triangle fields at the key times of the current level.
    keys: Vec<PatchField>,
    level: usize,
    sums: PatchSums,
    /// Echo factors for each receiver.
    ways: Vec<EchoFactors>,
    /// Area of the patch in the middle pose.
    area_m2: f32,
    /// Field below which a patch is left out.
    least: f32,
    /// Sum of the squares of the omitted fields.
    left_out: f64,
}

impl PatchSolver {
    /// Creates an empty solver that leaves out patches with fields below `least`.
    pub(super) fn new(work: &Work, least: f32) -> Self {
        let images = work.indices.len();
        let pose = |_: &PosedSkin| Pose {
            patch: PatchPose::new(images, work.integrator),
            fields: vec![FieldRows::default(); images],
            weights: vec![[1.0; LANES]; images],
            is_evaluated: vec![false; images],
            strengths: ([0.0; LANES], [0.0; LANES]),
            moments: MomentRows::default(),
        };
        PatchSolver {
            poses: work.posed.iter().map(pose).collect(),
            between: false,
            images: Vec::new(),
            around: Vec::new(),
            keys: Vec::new(),
            level: 0,
            sums: PatchSums::new(work.integrator.level),
            ways: Vec::new(),
            area_m2: 0.0,
            least,
            left_out: 0.0,
        }
    }

    /// Returns the sum of the squares of the omitted fields.
    pub(super) fn left_out(&self) -> f64 {
        self.left_out
    }

    /// Poses a patch at the key times and evaluates it for the images of the pairs `near_specular`, for which it is near a
    /// specular point. Returns the number of clamped distances.
    pub(super) fn pose(&mut self, work: &Work, patch: &SkinPatch, near_specular: &[usize]) -> usize {
        self.images.clear();
        self.images
            .extend(near_specular.iter().filter_map(|&number| work.pairs.get(number)).flat_map(|pair| pair.images));
        self.images.sort_unstable();
        self.images.dedup();
        self.between = false;
        self.around = self.fields_around(work, patch);
        let mut clamped = 0;
        for key in (0..self.poses.len()).step_by(2) {
            self.pose_at(work, patch, key);
            for number in 0..self.images.len() {
                clamped += self.look(work, patch, key, self.images[number]);
            }
        }
        self.area_m2 = self.poses.get(work.posed.len() / 2).map_or(0.0, |pose| pose.patch.triangles.area_m2());
        clamped
    }

    /// Expands the fields of the images around a patch in the middle of the frame. A linear expansion suffices, because
    /// patterns and walls change little over a patch and a frame.
    fn fields_around(&self, work: &Work, patch: &SkinPatch) -> Vec<FieldAround> {
        let Some(middle) = work.posed.get(work.posed.len() / 2) else { return Vec::new() };
        let centre = patch.vertices.iter().map(|&v| middle.vertices[v as usize]).sum::<DVec3>() / LANES as f64;
        let field =
            |image: usize, at: DVec3| work.prepared.room.illuminate(&work.antenna, work.indices[image], at).field;
        self.images.iter().map(|&image| FieldAround::new(centre, work.origin, |at| field(image, at))).collect()
    }

    fn pose_at(&mut self, work: &Work, patch: &SkinPatch, key: usize) {
        let Some((pose, posed)) = self.poses.get_mut(key).zip(work.posed.get(key)) else { return };
        let left = |v: usize| (work.cloth[v] * inside_room(work.prepared, posed.vertices[v])) as f32;
        let left = patch.vertices.map(|v| left(v as usize));
        let narrowing = patch.vertices.map(|v| work.skin.narrowing()[v as usize]);
        pose.patch.pose(work.integrator.level, patch, posed, work.origin, left, narrowing);
        pose.is_evaluated.fill(false);
    }

    /// Computes directions, fields and weights of a posed patch for one of the images, once per pose. Returns the
    /// number of clamped distances.
    fn look(&mut self, work: &Work, patch: &SkinPatch, key: usize, image: usize) -> usize {
        let level = work.integrator.level;
        let around = self.images.binary_search(&image).ok().and_then(|number| self.around.get(number));
        let (Some(pose), Some(around)) = (self.poses.get_mut(key), around) else { return 0 };
        if std::mem::replace(&mut pose.is_evaluated[image], true) {
            return 0;
        }
        pose.patch.look(image, work.places[image].middle, work.origin, work.prepared.wavelength_m, level);
        pose.fields[image] = field_rows(level, around, &pose.patch.vertices.places);
        pose.weights[image] = weights_at(&work.weights[image], key as f64, patch);
        pose.patch.lights[image].clamped()
    }

    /// Integrates the patch between two images, with as many key times as accuracy requires. Returns whether the patch
    /// may be audible.
    pub(super) fn integrate(&mut self, work: &Work, patch: &SkinPatch, pair: &Pair) -> bool {
        let [out, back] = pair.images;
        let mut strongest = 0f32;
        let mut live = [false; LANES];
        for pose in self.poses.iter_mut().step_by(2) {
            pose.strengths = pose.strengths(work, pair, &pair.settings);
            let (re, im) = &pose.strengths;
            for (l, live) in live.iter_mut().enumerate() {
                let square = re[l] * re[l] + im[l] * im[l];
                *live |= square > 0.0;
                strongest = strongest.max(square);
            }
        }
        let Some(middle) = self.poses.get(self.poses.len() / 4 * 2) else { return false };
        let spans = spans_rad(work.integrator.level, [&middle.patch.views[out], &middle.patch.views[back]]);
        let corners_live = |l: usize| patch.corners[l].iter().any(|&v| live[v % LANES]);
        let lanes_live = (0..patch.triangles.len()).filter(|&l| corners_live(l));
        let least = lanes_live.clone().map(|l| spans[l]).fold(f32::INFINITY, f32::min);
        // The integral over a triangle with a large phase span is at most two over the span, and that over a patch is
        // smaller still. If even this bound is inaudible, skip the integral.
        if strongest == 0.0 || strongest.sqrt() * self.area_m2 * (RUN_RAD / least).min(1.0) < self.least {
            return false;
        }
        let rules = rules_for(&spans, lanes_live, pair.settings.ease);
        self.poses.iter_mut().step_by(2).for_each(|pose| pose.find_moments(work, pair, rules));
        self.find_keys(work, patch, pair, 0);
        let (missed, power) = self.missed_between_keys(work);
        // The error of cubic interpolation grows with the fourth power of the step.
        if missed.sqrt() / 16.0 > f64::from(self.least).max(work.missed_between_keys * power.sqrt()) {
            if !self.between {
                for key in (1..self.poses.len()).step_by(2) {
                    self.pose_at(work, patch, key);
                }
                self.between = true;
            }
            for key in (1..self.poses.len()).step_by(2) {
                for image in pair.images {
                    self.look(work, patch, key, image);
                }
            }
            for pose in self.poses.iter_mut().skip(1).step_by(2) {
                pose.strengths = pose.strengths(work, pair, &pair.settings);
                pose.find_moments(work, pair, rules);
            }
            self.find_keys(work, patch, pair, 1);
        }
        true
    }

    /// Computes the triangles' fields at the key times of a level.
    fn find_keys(&mut self, work: &Work, patch: &SkinPatch, pair: &Pair, level: usize) {
        self.level = level;
        let of_keys: Vec<&Pose> = self.poses.iter().step_by(2 - level).collect();
        self.keys.clear();
        self.keys.extend(of_keys.iter().enumerate().map(|(key, pose)| {
            let rates = rates(&of_keys, key, &work.times[level].keys_s);
            pose.keys(work, patch, pair, &StrengthRows { now: pose.strengths, rates })
        }));
    }

    /// Returns the squared interpolation error between the key times of the patch's level, and the squared fields.
    fn missed_between_keys(&self, work: &Work) -> (f64, f64) {
        let step_s = work.times[self.level].step_s();
        missed_between_keys(work.integrator.level, &self.keys, step_s, work.prepared.wavelength_m)
    }

    /// Adds the errors of a pair that has been integrated: between key times, and against a coarser field in the middle
    /// of the frame.
    pub(super) fn add_missed(&mut self, work: &Work, patch: &SkinPatch, pair: &Pair, missed: &mut Tally) {
        let coarse = &pair.settings.coarser();
        let [out, back] = pair.images;
        missed.add_between_keys(self.missed_between_keys(work));
        let middle = self.poses.len() / 4;
        let found = self.keys.get(middle * (1 + self.level));
        let (Some(pose), Some(fine)) = (self.poses.get_mut(2 * middle), found) else { return };
        let strengths = StrengthRows { now: pose.strengths(work, pair, coarse), ..StrengthRows::default() };
        let spans = spans_rad(work.integrator.level, [&pose.patch.views[out], &pose.patch.views[back]]);
        pose.find_moments(work, pair, rules_for(&spans, 0..patch.triangles.len(), coarse.ease));
        missed.add_integration(fine, &pose.keys(work, patch, pair, &strengths), work.prepared.wavelength_m);
    }

    /// Adds the echo of the patch between two images in every chirp. Returns whether it was strong enough to be added.
    pub(super) fn add_tone(&mut self, work: &Work, pair: &Pair, grids: &mut ChirpGrids) -> bool {
        let (prepared, times) = (work.prepared, work.times[self.level]);
        let in_phase = |keys: &PatchField| keys.powers().into_iter().map(f32::sqrt).sum::<f32>();
        let is_both = pair.images[0] != pair.images[1];
        let ways = if is_both { 2.0 } else { 1.0 };
        if self.keys.iter().map(in_phase).fold(0.0, f32::max) < self.least {
            // The power is summed as for triangles with independent phases.
            let power = |keys: &PatchField| keys.powers().into_iter().sum::<f32>();
            self.left_out += ways * f64::from(self.keys.iter().map(power).fold(0.0, f32::max));
            return false;
        }
        let between = pair.images.map(|i| &work.places[i]);
        let (keys, sums) = (&self.keys, &mut self.sums);
        let Some(patch) = Patch::new(keys, work.origin, between, times, prepared.wavelength_m, sums) else {
            return false;
        };
        let loudest = sums.loudest();
        if loudest < self.least {
            self.left_out += ways * f64::from(loudest * loudest);
            return false;
        }
        patch.ways(prepared, between, is_both, times.chirps_s.len(), &mut self.ways);
        let (ways, chirps) = (self.ways.as_slice(), sums.chirps());
        grids.add(&Echo { chirp: &prepared.chirp, wavelength_m: prepared.wavelength_m, ways, chirps });
        true
    }
}

impl Pose {
    fn strengths(&self, work: &Work, pair: &Pair, settings: &IntegrationSettings) -> (Row, Row) {
        let [out, back] = pair.images;
        let between = Between {
            vertices: &self.patch.vertices,
            lights: [&self.patch.lights[out], &self.patch.lights[back]],
            fields: [&self.fields[out], &self.fields[back]],
            weights: [&self.weights[out], &self.weights[back]],
            permittivity: SKIN_PERMITTIVITY,
            settings,
            factor: common_factor(work.prepared.wavelength_m),
        };
        strengths(work.integrator.level, &between)
    }

    fn keys(&self, work: &Work, patch: &SkinPatch, pair: &Pair, strengths: &StrengthRows) -> PatchField {
        let parts = Parts {
            posed: &self.patch,
            images: pair.images,
            moments: &self.moments,
            corners: &patch.corners,
            strengths,
            wavelength_m: work.prepared.wavelength_m,
        };
        patch_field(work.integrator.level, &parts)
    }

    fn find_moments(&mut self, work: &Work, pair: &Pair, rules: Rules) {
        let [out, back] = pair.images;
        self.patch.find_nodes(rules, work.integrator);
        let views = [&self.patch.views[out], &self.patch.views[back]];
        self.moments = moments(work.integrator.level, self.patch.nodes(rules), views);
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

/// Interpolates an image's weights at a patch's vertices linearly between the key times at which they are known.
fn weights_at(known: &[(f64, Vec<f64>)], key: f64, patch: &SkinPatch) -> Row {
    let next = known.iter().position(|(at, _)| *at >= key).unwrap_or(known.len().saturating_sub(1));
    let Some((end, after)) = known.get(next) else { return [1.0; LANES] };
    let (start, before) = known.get(next.saturating_sub(1)).map_or((*end, after), |(at, of)| (*at, of));
    let part = if end > &start { (key - start) / (end - start) } else { 0.0 };
    let mut weights = [1.0; LANES];
    for (weight, &v) in weights.iter_mut().zip(&patch.vertices) {
        if let Some((before, after)) = before.get(v as usize).zip(after.get(v as usize)) {
            *weight = (before * (1.0 - part) + after * part) as f32;
        }
    }
    weights
}

/// Computes rates of strengths by differences over equal steps. They are central differences; at the ends they are
/// those of the parabola through three key times.
fn rates(poses: &[&Pose], key: usize, times_s: &[f64]) -> (Row, Row) {
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
        let (weight, (re, im)) = ((weight / step_s) as f32, &poses[key].strengths);
        for l in 0..LANES {
            rates.0[l] += weight * re[l];
            rates.1[l] += weight * im[l];
        }
    }
    rates
}

/// Resolution in path length of the comparison with a coarser field, m: about a cell of the range axis.
const APART_M: f64 = 0.15;

/// Largest index of path length in that comparison; longer paths share it.
const MOST_APART: usize = 4096;

/// Difference from a coarser field, and the field itself.
type Difference = [Complex64; 2];

/// Accumulated errors of a pair's field.
#[derive(Debug, Default)]
pub(super) struct Tally {
    /// Sums of the squared interpolation errors and of the squared fields.
    between_keys: [f64; 2],
    /// Errors by path length. Far from specular points neighbours cancel, so their errors must be summed coherently.
    by_integration: Vec<Difference>,
}

impl Tally {
    fn add_between_keys(&mut self, (missed, power): (f64, f64)) {
        self.between_keys = [self.between_keys[0] + missed, self.between_keys[1] + power];
    }

    fn add_integration(&mut self, fine: &PatchField, coarse: &PatchField, wavelength_m: f64) {
        let field = |of: &PatchField, l: usize| Complex64::new(of.field[0][l].into(), of.field[1][l].into());
        let by_length = &mut self.by_integration;
        for l in 0..LANES {
            let (fine_field, coarse_field) = (field(fine, l), field(coarse, l));
            if fine_field == Complex64::ZERO && coarse_field == Complex64::ZERO {
                continue;
            }
            let number = ((fine.length_m[l] / APART_M) as usize).min(MOST_APART);
            if by_length.len() <= number {
                by_length.resize(number + 1, Difference::default());
            }
            let Some([apart, sum]) = by_length.get_mut(number) else { continue };
            let turn = phasor(-fine.length_m[l] / wavelength_m);
            let turn = Complex64::new(turn.re.into(), turn.im.into());
            *apart += (fine_field - coarse_field) * turn;
            *sum += fine_field * turn;
        }
    }

    /// Returns the errors relative to the field.
    pub(super) fn missed(&self) -> Missed {
        let part = |[missed, power]: [f64; 2]| if power > 0.0 { (missed / power).sqrt() } else { 0.0 };
        let add = |[a, b]: [f64; 2], [apart, sum]: &Difference| [a + apart.norm_sqr(), b + sum.norm_sqr()];
        let by_integration = self.by_integration.iter().fold([0.0; 2], add);
        // The error of cubic interpolation grows with the fourth power of the step.
        Missed { between_keys: part(self.between_keys) / 16.0, by_integration: part(by_integration), left_out: 0.0 }
    }
}
