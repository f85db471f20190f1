//! Actors from files: a skinned mesh and a walking clip become a cycle of steps along a person's trajectory.
//!
//! A file is processed in this order. The requested clip is sampled, its displacement over the ground is removed, and
//! its ends are joined. The body is placed on the floor, scaled to its height and rotated to face the direction of
//! walking. The displacement in a cycle is computed from the feet on the floor, so that they do not slide. The mesh is
//! welded and refined (`refine`). The result is a table of the bones' maps over phase (`cycle`), and
//! phase advances with the ground covered. A standing actor takes the mean pose of the cycle.
//!
//! Limitations: an actor does not sit, breathe or fidget. Only faces that point outward reflect. Clothes that are
//! separate shells within 2 cm of the skin do not hide it.

use std::path::Path;
use std::sync::Arc;

use glam::{DMat3, DVec3};

use super::body::{Build, SEGMENTS};
use super::cycle::{CYCLE_HINT, Cycle, FootSliding, Stance, Walk, best_cycle, centred, rms_distance};
use super::refine::{BoundMesh, posed_position, refine};
use super::rig::{Clip, Rig, mean_transforms};
use super::skin::{BoneMap, Influence, Skin};
use super::{collada, gltf};
use crate::em::specular::Ellipsoid;
use crate::file_error::FileError;
use crate::geometry::Mesh;
use crate::geometry::import::{LengthUnit, UpAxis};

/// Least time between samples of a clip, s, and least and greatest number of samples of a cycle.
const SAMPLE_S: f64 = 1.0 / 60.0;
const CYCLE_SAMPLES: [f64; 2] = [24.0, 240.0];
/// Shortest and longest cycle that is searched for in a clip that is not one cycle, s.
const CYCLE_S: [f64; 2] = [0.6, 2.5];
/// Longest clip that is searched, s.
const LONGEST_S: f64 = 120.0;
/// Upper limit of joint positions that are compared to find a cycle. The time of the search grows with their number.
const MOST_POSITIONS: usize = 1_000_000;
/// Upper limit of vertices that are tracked over the floor. If there are more, evenly spaced ones are taken.
const MOST_FOOT_VERTICES: usize = 20_000;
/// Largest difference between the ends of a cycle, as a part of the body's height.
const LARGEST_END_DIFFERENCE: f64 = 0.03;
/// Least displacement in a cycle of a walking body, as a part of its height.
const LEAST_TRAVEL: f64 = 0.1;
/// Least and greatest plausible height of a body, m.
const HEIGHTS_M: [f64; 2] = [0.5, 2.5];
/// Lowest part of the body, as a part of its height. It contains the vertices that touch the floor.
const FOOT_ZONE: f64 = 0.15;

/// Options of an actor's file besides its name.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ActorOptions {
    /// Name of the animation. If absent, the file must have only one, or only one that is called a walk.
    pub animation: Option<String>,
    /// Height to which the actor is scaled, m. If absent, the file's own height is kept.
    pub height_m: Option<f64>,
    /// Length unit that replaces the file's unit.
    pub unit: Option<LengthUnit>,
    /// Axis that replaces the up axis of the file.
    pub up: Option<UpAxis>,
    /// Part of the animation that is one cycle, s. If absent, the cycle is searched for.
    pub cycle_s: Option<[f64; 2]>,
}

/// A walking body from a file.
#[derive(Debug, Clone, PartialEq)]
pub struct Actor {
    /// Skin of the actor.
    pub skin: Arc<Skin>,
    cycle: Cycle,
    standing: Vec<BoneMap>,
    /// Part of the actor for each segment of a body.
    parts: [ActorPart; SEGMENTS],
    /// Height of the standing actor, m.
    pub height_m: f64,
    /// Ground covered in a cycle of steps, m.
    pub cycle_m: f64,
    stance: Stance,
    /// Number of edges at which the skin ends: borders of sheets and holes.
    pub open_edges: usize,
}

/// Part of an actor that stands for a segment of a body.
#[derive(Debug, Clone, Copy, PartialEq)]
struct ActorPart {
    /// Index of the bone that moves the part.
    bone: usize,
    /// Ellipsoid around the part when standing.
    ellipsoid: Ellipsoid,
}

impl Actor {
    /// Parses a glTF (`.gltf`, `.glb`) or COLLADA (`.dae`) file. `path` gives the format, and the folder of its
    /// buffers.
    ///
    /// # Errors
    /// [`FileError`] if the file is malformed, has no skin, no walk or no cycle of steps, or exceeds the limits.
    pub fn parse(bytes: &[u8], path: &Path, options: &ActorOptions) -> Result<Self, FileError> {
        let rig = &read_rig(bytes, path, options)?;
        let clip = choose_clip(&rig.clips, options.animation.as_deref())?;
        let span = cycle_span(rig, clip, options.cycle_s)?;
        let (mut poses, mut standing) = sample_cycle(rig, clip, span);
        // The pose is rotated upright and scaled to metres.
        let up = |v: DVec3| rig.up.to_z_up(v) * rig.unit_m;
        let upright = DMat3::from_cols(up(DVec3::X), up(DVec3::Y), up(DVec3::Z));
        let file_height_m = posed_height(rig, &standing, upright)?;
        let height_m = options.height_m.unwrap_or(file_height_m);
        if !(HEIGHTS_M[0]..=HEIGHTS_M[1]).contains(&height_m) {
            let problem = format!("it is {file_height_m:.4} m tall, expected {} to {} m", HEIGHTS_M[0], HEIGHTS_M[1]);
            let hint = "say the file's unit (unit = \"mm\"), or what height the actor is to have (height_m = 1.75)";
            return Err(FileError::new("skin", problem, hint));
        }
        let scale = upright * (height_m / file_height_m);
        poses.iter_mut().for_each(|p| transform(p, scale, DVec3::ZERO));
        transform(&mut standing, scale, DVec3::ZERO);

        // Displacement and direction of walking, from the feet.
        let feet = foot_vertices(rig, &standing);
        let stance = stance_of(rig, &feet, &poses, height_m);
        let travel_m = stance.travel_m.length();
        if travel_m < LEAST_TRAVEL * height_m {
            let names: Vec<&str> = rig.clips.iter().map(|c| c.name.as_str()).collect();
            let problem = format!("feet on the floor move {travel_m:.3} m in a cycle, expected a walk");
            return Err(FileError::new(format!("clip {:?}", clip.name), problem, format!("the file has {names:?}")));
        }
        let heading = stance.travel_m.y.atan2(stance.travel_m.x);
        let ahead = DMat3::from_rotation_z(-heading);
        for (pose, surge_m) in poses.iter_mut().zip(stance.surge_m()) {
            transform(pose, ahead, ahead * surge_m - DVec3::Z * stance.floor_m);
        }
        let lowest = feet.iter().map(|&v| posed_position(rig.vertices[v], &rig.weights[v], &standing).z);
        let lowest = lowest.fold(f64::INFINITY, f64::min);
        transform(&mut standing, ahead, DVec3::Z * -lowest);

        let mesh = Mesh { vertices: rig.vertices.clone(), triangles: rig.triangles.clone() };
        let bound = refine(&mesh, &rig.weights, &standing)?;
        let parts = actor_parts(&bound, &standing, height_m);
        let rest = rest_mesh(&bound, &standing, &poses)?;
        let vertex_influences = |(weights, &vertex): (&Vec<(usize, f64)>, &DVec3)| -> Vec<Influence> {
            weights.iter().map(|&(bone, weight)| Influence { bone, weight, point: vertex }).collect()
        };
        let influences: Vec<_> = bound.weights.iter().zip(&bound.mesh.vertices).map(vertex_influences).collect();
        let mut actor = Actor {
            skin: Arc::new(Skin::bound(&rest, &influences, segments_of_bones(&bound, &standing, height_m))),
            cycle: Cycle::through(&poses),
            standing,
            parts,
            height_m,
            cycle_m: travel_m,
            stance: Stance::default(),
            open_edges: bound.open_edges,
        };
        // Contact of the feet on the interpolated curve between poses.
        let count = 4 * poses.len();
        let poses: Vec<Vec<BoneMap>> = (0..count).map(|k| actor.cycle.at(k as f64 / count as f64)).collect();
        actor.stance = stance_of(rig, &feet, &poses, height_m).with_travel(DVec3::X * travel_m);
        Ok(actor)
    }

    /// Returns how much the feet slide over the floor at a walking speed.
    pub fn foot_sliding(&self, speed_m_per_s: f64) -> FootSliding {
        self.stance.sliding(speed_m_per_s)
    }

    /// Returns the maps of the bones, in room coordinates.
    pub(super) fn maps(&self, walk: &Walk) -> Vec<BoneMap> {
        let rotation = DMat3::from_rotation_z(walk.heading_rad);
        let position = DVec3::new(walk.position_m[0], walk.position_m[1], 0.0);
        let mut maps = if walk.intensity > 0.0 { self.cycle.at(walk.phase) } else { self.standing.clone() };
        if walk.intensity < 1.0 {
            maps.iter_mut()
                .zip(&self.standing)
                .for_each(|(m, &s)| *m = *m * walk.intensity + s * (1.0 - walk.intensity));
        }
        transform(&mut maps, rotation, position);
        maps
    }

    /// Returns ellipsoids around the actor's parts, in room coordinates.
    pub(super) fn body(&self, walk: &Walk) -> [Ellipsoid; SEGMENTS] {
        let maps = self.maps(walk);
        self.parts.map(|ActorPart { bone, ellipsoid }| {
            let (Some(now), Some(standing)) = (maps.get(bone), self.standing.get(bone)) else { return ellipsoid };
            let from_standing = now.linear * standing.linear.inverse();
            let x = (from_standing * ellipsoid.axes.x_axis).normalize_or(DVec3::X);
            let y = (from_standing * ellipsoid.axes.y_axis)
                .reject_from_normalized(x)
                .normalize_or(x.any_orthonormal_vector());
            let axes = DMat3::from_cols(x, y, x.cross(y));
            Ellipsoid { centre: now.centre + from_standing * (ellipsoid.centre - standing.centre), axes, ..ellipsoid }
        })
    }
}

/// Reads and checks a file, with the options' unit and up axis.
fn read_rig(bytes: &[u8], path: &Path, options: &ActorOptions) -> Result<Rig, FileError> {
    let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
    let mut rig = match extension.as_str() {
        "gltf" | "glb" => gltf::parse_gltf(bytes, path.parent().unwrap_or(Path::new("")))?,
        "dae" => collada::parse_collada(bytes)?,
        _ => {
            let problem = format!("its name ends in {extension:?}, expected .glb, .gltf, .dae or .bvh");
            return Err(FileError::new("name", problem, "export the actor as glTF 2.0"));
        }
    };
    rig.check()?;
    if let Some(unit) = options.unit {
        rig.unit_m = unit.metres();
    }
    rig.up = options.up.unwrap_or(rig.up);
    Ok(rig)
}

/// Returns the requested clip, the only clip, or the only one that is called a walk.
fn choose_clip<'a>(clips: &'a [Clip], name: Option<&str>) -> Result<&'a Clip, FileError> {
    let names: Vec<&str> = clips.iter().map(|c| c.name.as_str()).collect();
    let hint = format!("the file has {names:?}: say one of them, animation = \"...\"");
    if clips.is_empty() {
        let hint = "export the actor with its animation, or let a BVH clip walk instead";
        return Err(FileError::new("animations", "the file has none, expected a walk", hint));
    }
    let is_requested = |c: &&Clip| name.map_or(c.name.to_lowercase().contains("walk"), |name| c.name == name);
    let found: Vec<&Clip> = clips.iter().filter(is_requested).collect();
    match (found.as_slice(), clips, name) {
        (&[one], ..) => Ok(one),
        ([], [one], None) => Ok(one),
        ([], _, Some(name)) => Err(FileError::new("animations", format!("none is called {name:?}"), hint)),
        _ => Err(FileError::new("animations", "which of them is the walk is not said", hint)),
    }
}

/// Returns the begin and end of one cycle in a clip, s.
fn cycle_span(rig: &Rig, clip: &Clip, requested: Option<[f64; 2]>) -> Result<[f64; 2], FileError> {
    let place = format!("clip {:?}", clip.name);
    let Some([begin, end]) = clip.span_s().filter(|[a, b]| b - a > 0.1 && b - a < LONGEST_S) else {
        let problem = format!("it lasts {:?} s, expected 0.1 to {LONGEST_S} s", clip.span_s().map(|[a, b]| b - a));
        return Err(FileError::new(place, problem, "export the frames of the walk, at the right frame rate"));
    };
    if let Some([a, b]) = requested {
        return if a >= begin - 1e-6 && b <= end + 1e-6 && b - a > 0.1 {
            Ok([a, b])
        } else {
            let problem = format!("cycle_s is {requested:?}, expected a part of {begin} to {end} s of at least 0.1 s");
            Err(FileError::new(place, problem, CYCLE_HINT))
        };
    }
    let step_s = clip.least_key_interval_s().clamp(SAMPLE_S, 0.05);
    let count = ((end - begin) / step_s).round().max(8.0) as usize;
    let time = |k: usize| begin + (end - begin) * k as f64 / count as f64;
    if count.saturating_mul(rig.joints.len()) > MOST_POSITIONS {
        let problem = format!("it has {} joints over {count} samples, too many to look for a cycle", rig.joints.len());
        return Err(FileError::new(place, problem, CYCLE_HINT));
    }
    let positions: Vec<Vec<DVec3>> = (0..=count).map(|k| rig.pose(&rig.local_transforms(clip, time(k))).0).collect();
    let (Some(first), Some(last)) = (positions.first(), positions.last()) else { return Ok([begin, end]) };
    let (first, last) = (centred(first), centred(last));
    let spread = rms_distance(&first, &vec![DVec3::ZERO; first.len()]);
    // The spread of the joints is about a quarter of the height.
    if rms_distance(&first, &last) < LARGEST_END_DIFFERENCE * 4.0 * spread {
        return Ok([begin, end]);
    }
    let samples = |s: f64| (s * count as f64 / (end - begin)).round() as usize;
    match best_cycle(&positions, samples(CYCLE_S[0]).max(4), samples(CYCLE_S[1])) {
        Some((a, b, cost)) if cost < 1.0 => Ok([time(a), time(b)]),
        _ => {
            let problem = "its end is not its beginning, and no cycle of steps was found in it";
            Err(FileError::new(place, problem, CYCLE_HINT))
        }
    }
}

/// Returns the maps at even phases of a cycle, without the clip's displacement over the ground, and those of the
/// standing actor, in the file's unit and axes.
fn sample_cycle(rig: &Rig, clip: &Clip, [begin, end]: [f64; 2]) -> (Vec<Vec<BoneMap>>, Vec<BoneMap>) {
    let [least, most] = CYCLE_SAMPLES;
    let count = ((end - begin) / clip.least_key_interval_s().max(SAMPLE_S)).round().clamp(least, most) as usize;
    let phase = |k: usize| k as f64 / count as f64;
    let locals: Vec<_> = (0..=count).map(|k| rig.local_transforms(clip, begin + (end - begin) * phase(k))).collect();
    let up = up_axis(rig);
    let horizontal = |v: DVec3| v - up * v.dot(up);
    let horizontal_centroid = |places: &[DVec3]| horizontal(places.iter().sum::<DVec3>() / places.len().max(1) as f64);
    let posed = locals.iter().map(|l| rig.pose(l));
    let mut samples: Vec<(DVec3, Vec<BoneMap>)> =
        posed.map(|(places, maps)| (horizontal_centroid(&places), maps)).collect();
    let (first, last) = (samples[0].0, samples[count].0);
    let centre =
        samples.iter().take(count).enumerate().map(|(k, (m, _))| *m - (last - first) * phase(k)).sum::<DVec3>()
            / count as f64;
    for (k, (_, maps)) in samples.iter_mut().enumerate() {
        maps.iter_mut().for_each(|m| m.centre -= centre + (last - first) * phase(k));
    }
    // The remaining difference between the ends is distributed over the cycle.
    let end_difference: Vec<BoneMap> = samples[count].1.iter().zip(&samples[0].1).map(|(&b, &a)| b - a).collect();
    samples.truncate(count);
    let closed = |(k, (_, maps)): (usize, (DVec3, Vec<BoneMap>))| -> Vec<BoneMap> {
        maps.iter().zip(&end_difference).map(|(&m, &s)| m - s * phase(k)).collect()
    };
    let poses = samples.into_iter().enumerate().map(closed).collect();
    let (places, mut standing) = rig.pose(&mean_transforms(&locals[..count]));
    let centroid = horizontal_centroid(&places);
    standing.iter_mut().for_each(|m| m.centre -= centroid);
    (poses, standing)
}

/// Axis of the file that points up.
fn up_axis(rig: &Rig) -> DVec3 {
    [DVec3::Y, DVec3::Z].into_iter().find(|&axis| rig.up.to_z_up(axis) == DVec3::Z).unwrap_or(DVec3::Z)
}

/// Applies a linear map about the origin to all maps, then moves them.
fn transform(maps: &mut [BoneMap], linear: DMat3, offset: DVec3) {
    for map in maps {
        *map = BoneMap { centre: linear * map.centre + offset, linear: linear * map.linear };
    }
}

/// Returns the mesh of the standing actor. It fails if the mesh is unusable or a pose is not finite.
fn rest_mesh(bound: &BoundMesh, standing: &[BoneMap], poses: &[Vec<BoneMap>]) -> Result<Mesh, FileError> {
    let rest = Mesh { vertices: bound.posed(standing), triangles: bound.mesh.triangles.clone() };
    let hint = "check the inverse bind matrices, the scale of the bones and the keys of the clip";
    rest.check().map_err(|error| FileError::new("skin", format!("where the actor stands, {error}"), hint))?;
    if rest.triangles.is_empty() {
        return Err(FileError::new("skin", "it has no triangle with an area, expected a closed surface", hint));
    }
    if let Some(bone) = poses.iter().find_map(|pose| pose.iter().position(|map| !map.is_finite())) {
        return Err(FileError::new("skin", format!("a key of its clip puts bone {bone} nowhere"), hint));
    }
    Ok(rest)
}

/// Height of the skin in a pose, from its lowest to its highest vertex.
fn posed_height(rig: &Rig, pose: &[BoneMap], upright: DMat3) -> Result<f64, FileError> {
    let heights = rig.vertices.iter().zip(&rig.weights).map(|(&p, w)| (upright * posed_position(p, w, pose)).z);
    let (low, high) = heights.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), z| (l.min(z), h.max(z)));
    if high - low > 0.0 && (high - low).is_finite() {
        return Ok(high - low);
    }
    let problem = format!("posed, it reaches from {low} to {high} m");
    Err(FileError::new("skin", problem, "check the scale of the skeleton and the inverse bind matrices"))
}

/// Returns the vertices that may touch the floor.
fn foot_vertices(rig: &Rig, standing: &[BoneMap]) -> Vec<usize> {
    let heights: Vec<f64> =
        rig.vertices.iter().zip(&rig.weights).map(|(&p, w)| posed_position(p, w, standing).z).collect();
    let (low, high) = heights.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), &z| (l.min(z), h.max(z)));
    let limit = low + FOOT_ZONE * (high - low);
    let low_vertices: Vec<usize> = (0..heights.len()).filter(|&v| heights[v] < limit).collect();
    let step = low_vertices.len().div_ceil(MOST_FOOT_VERTICES).max(1);
    low_vertices.into_iter().step_by(step).collect()
}

/// Finds the motion of the feet over a cycle.
fn stance_of(rig: &Rig, foot_vertices: &[usize], poses: &[Vec<BoneMap>], height_m: f64) -> Stance {
    let posed = |pose: &Vec<BoneMap>| {
        foot_vertices.iter().map(|&v| posed_position(rig.vertices[v], &rig.weights[v], pose)).collect()
    };
    let points: Vec<Vec<DVec3>> = poses.iter().map(posed).collect();
    Stance::of(&points, height_m)
}

/// For each bone, returns the mean position of its skin when standing.
fn mean_skin_positions(bound: &BoundMesh, standing: &[BoneMap]) -> Vec<DVec3> {
    let mut sums = vec![(DVec3::ZERO, 0.0); standing.len()];
    for (position, weights) in bound.posed(standing).into_iter().zip(&bound.weights) {
        for &(bone, weight) in weights {
            if let Some((sum, total)) = sums.get_mut(bone) {
                *sum += position * weight;
                *total += weight;
            }
        }
    }
    sums.into_iter().map(|(sum, total)| sum / f64::max(total, 1e-300)).collect()
}

/// Returns the segment of a standing body that is nearest to a point.
fn nearest_segment(body: &[Ellipsoid; SEGMENTS], point: DVec3) -> usize {
    let distance = |e: &Ellipsoid| ((e.axes.transpose() * (point - e.centre)) / e.semi_axes_m).length();
    (0..SEGMENTS).min_by(|&a, &b| distance(&body[a]).total_cmp(&distance(&body[b]))).unwrap_or(0)
}

/// Ellipsoids of a standing body of average girth.
fn standing_body(height_m: f64) -> [Ellipsoid; SEGMENTS] {
    let build = Build { height_m, girth: 1.0 };
    build.segments(&build.standing())
}

/// For each bone, returns the segment of a standing body that is nearest to its skin.
fn segments_of_bones(bound: &BoundMesh, standing: &[BoneMap], height_m: f64) -> Vec<usize> {
    let body = standing_body(height_m);
    mean_skin_positions(bound, standing).into_iter().map(|middle| nearest_segment(&body, middle)).collect()
}

/// For each segment of a body, returns the bone that moves most of the nearest skin, and an ellipsoid around that skin.
/// They serve for occlusion by other people, echo levels and ground truth. Skeletons may be coarse: a head without a
/// bone of its own is allowed.
fn actor_parts(bound: &BoundMesh, standing: &[BoneMap], height_m: f64) -> [ActorPart; SEGMENTS] {
    let body = standing_body(height_m);
    let posed = bound.posed(standing);
    let segment_of: Vec<usize> = posed.iter().map(|&place| nearest_segment(&body, place)).collect();
    let middle = posed.iter().sum::<DVec3>() / posed.len().max(1) as f64;
    std::array::from_fn(|segment| {
        let vertices = || (0..posed.len()).filter(|&v| segment_of[v] == segment);
        let mut bone_weights = vec![0.0; standing.len()];
        for &(bone, weight) in vertices().flat_map(|v| &bound.weights[v]) {
            bone_weights[bone] += weight;
        }
        let heaviest = (0..bone_weights.len()).max_by(|&a, &b| bone_weights[a].total_cmp(&bone_weights[b]));
        let bone = heaviest.unwrap_or(0);
        let count = vertices().count() as f64;
        if count == 0.0 {
            // The actor has no such part: a very small ellipsoid within the body replaces it.
            let semi_axes_m = DVec3::splat(0.02);
            return ActorPart { bone, ellipsoid: Ellipsoid { centre: middle, axes: DMat3::IDENTITY, semi_axes_m } };
        }
        let centre = vertices().map(|v| posed[v]).sum::<DVec3>() / count;
        let variances = vertices().map(|v| (posed[v] - centre) * (posed[v] - centre)).sum::<DVec3>() / count;
        // Over an ellipsoid's surface, the standard deviation of each coordinate is about its semi-axis over the square
        // root of three.
        let semi_axes_m = (3.0 * variances).map(f64::sqrt).max(DVec3::splat(0.02));
        ActorPart { bone, ellipsoid: Ellipsoid { centre, axes: DMat3::IDENTITY, semi_axes_m } }
    })
}
