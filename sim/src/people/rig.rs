//! A skeleton with a skin and clips, independent of the file format: a tree of nodes, of which some are joints,
//! vertices that follow joints by weights, and tracks of the nodes' local transforms over time.
//!
//! A vertex `p` is at `sum w_j G_j B_j p`, with `G_j` the joint's transform in the file's world and `B_j` its inverse
//! bind matrix (glTF 2.0, section 3.7.3). All quantities are in the file's own unit and axes.

use std::ops::{Add, Mul};

use glam::{DMat3, DMat4, DQuat, DVec3};

use super::skin::BoneMap;
use crate::file_error::FileError;
use crate::geometry::import::UpAxis;

/// Largest deviation of a vertex's sum of weights from one; beyond it the file is damaged. Exporters round weights to
/// bytes.
const WEIGHT_TOLERANCE: f64 = 0.05;
/// Hint for damaged files.
const EXPORT_HINT: &str = "export it again from the program it was made with, applying all transforms";

/// Upper limit of nodes, and of the joints of all skins. Actors have about a hundred.
pub(super) const MOST_NODES: usize = 4096;
/// Upper limit of a skin's triangles. The time of a frame grows with their number.
pub(super) const MOST_TRIANGLES: usize = 150_000;

/// A skeleton with a skin and clips.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Rig {
    pub nodes: Vec<Node>,
    pub joints: Vec<Joint>,
    /// Positions in the skin's own frame.
    pub vertices: Vec<DVec3>,
    /// For each vertex, joints and weights.
    pub weights: Vec<Vec<(usize, f64)>>,
    pub triangles: Vec<[u32; 3]>,
    pub clips: Vec<Clip>,
    /// Length of the file's unit in metres.
    pub unit_m: f64,
    pub up: UpAxis,
}

#[derive(Debug, Clone, PartialEq)]
pub(super) struct Node {
    pub name: String,
    pub parent: Option<usize>,
    pub local: LocalTransform,
}

/// Transform of a node within its parent: scale, rotation, translation, applied in this order.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct LocalTransform {
    pub translation: DVec3,
    pub rotation: DQuat,
    pub scale: DVec3,
}

/// A node that moves the skin.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Joint {
    pub node: usize,
    /// Transform from the skin's own frame into the joint's frame.
    pub inverse_bind: DMat4,
}

/// A named set of tracks over time.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Clip {
    pub name: String,
    pub tracks: Vec<KeyframeTrack>,
}

/// One component of one node's transform over time.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct KeyframeTrack {
    pub node: usize,
    pub interpolation: KeyInterpolation,
    /// Times of the keyframes, ascending, s.
    pub times_s: Vec<f64>,
    pub values: KeyframeValues,
}

/// Interpolation between keyframes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum KeyInterpolation {
    /// The value of the earlier keyframe.
    Step,
    /// Linear, or on the great arc for rotations.
    Linear,
    /// Hermite's cubic: three values for each keyframe, of which the first and last are tangents.
    Cubic,
}

#[derive(Debug, Clone, PartialEq)]
pub(super) enum KeyframeValues {
    Translation(Vec<DVec3>),
    Rotation(Vec<DQuat>),
    Scale(Vec<DVec3>),
}

impl LocalTransform {
    pub fn from_matrix(matrix: DMat4) -> Self {
        let (scale, rotation, translation) = matrix.to_scale_rotation_translation();
        LocalTransform { translation, rotation, scale }
    }

    pub fn matrix(&self) -> DMat4 {
        DMat4::from_scale_rotation_translation(self.scale, self.rotation, self.translation)
    }
}

impl Clip {
    /// Times of the first and last keyframe of all tracks, s; `None` without keyframes.
    pub fn span_s(&self) -> Option<[f64; 2]> {
        let ends = self.tracks.iter().filter_map(|t| Some([*t.times_s.first()?, *t.times_s.last()?]));
        ends.reduce(|[a, b], [c, d]| [a.min(c), b.max(d)])
    }

    /// Least mean interval between the keyframes of a track, s. The clip has no detail on shorter times.
    pub fn least_key_interval_s(&self) -> f64 {
        let mean_interval_s = |t: &KeyframeTrack| {
            let span_s = t.times_s.last()? - t.times_s.first()?;
            (t.times_s.len() > 2).then(|| span_s / (t.times_s.len() - 1) as f64)
        };
        self.tracks.iter().filter_map(mean_interval_s).fold(f64::INFINITY, f64::min)
    }
}

impl KeyframeTrack {
    /// Returns the keyframe before a time, and the fraction of the interval to the next one. Times outside the track
    /// give its ends.
    fn locate(&self, time_s: f64) -> (usize, f64) {
        let next = self.times_s.partition_point(|&t| t <= time_s);
        let last_key = self.times_s.len().saturating_sub(1);
        if next == 0 || last_key == 0 {
            return (0, 0.0);
        }
        let before = (next - 1).min(last_key - 1);
        let (a, b) = (self.times_s[before], self.times_s[before + 1]);
        (before, if b > a { ((time_s - a) / (b - a)).clamp(0.0, 1.0) } else { 0.0 })
    }

    /// Value at a time. `interpolate` goes from one keyframe's value to the next one's by a fraction.
    fn value<T>(&self, values: &[T], time_s: f64, interpolate: impl Fn(T, T, f64) -> T) -> Option<T>
    where
        T: Copy + Add<Output = T> + Mul<f64, Output = T>,
    {
        let (before, fraction) = self.locate(time_s);
        let at = |i: usize| values.get(i).copied();
        Some(match self.interpolation {
            KeyInterpolation::Step => at(if fraction >= 1.0 { before + 1 } else { before })?,
            KeyInterpolation::Linear if fraction == 0.0 => at(before)?,
            KeyInterpolation::Linear => interpolate(at(before)?, at(before + 1)?, fraction),
            KeyInterpolation::Cubic if self.times_s.len() < 2 => at(1)?,
            KeyInterpolation::Cubic => {
                let [a, tangent_out, tangent_in, b] =
                    [at(3 * before + 1)?, at(3 * before + 2)?, at(3 * before + 3)?, at(3 * before + 4)?];
                let [h00, h10, h01, h11] = self.hermite_weights(before, fraction);
                a * h00 + tangent_out * h10 + b * h01 + tangent_in * h11
            }
        })
    }

    /// Weights of the value and tangent at the keyframe, and at the next one.
    fn hermite_weights(&self, before: usize, fraction: f64) -> [f64; 4] {
        let step_s = self.times_s.get(before + 1).map_or(0.0, |b| b - self.times_s[before]);
        let u = fraction;
        let (u2, u3) = (u * u, u * u * u);
        [2.0 * u3 - 3.0 * u2 + 1.0, step_s * (u3 - 2.0 * u2 + u), 3.0 * u2 - 2.0 * u3, step_s * (u3 - u2)]
    }
}

impl Rig {
    /// Checks that the rig can be posed, and scales weights to a sum of one.
    ///
    /// # Errors
    /// [`FileError`] for the first part that is out of range or too large.
    pub fn check(&mut self) -> Result<(), FileError> {
        self.check_sizes()?;
        self.check_skin()?;
        self.check_skeleton()?;
        self.normalise_weights()?;
        self.check_clips()
    }

    /// Refuses files without a skin, and files with many more elements than a person needs.
    fn check_sizes(&self) -> Result<(), FileError> {
        if self.joints.is_empty() || self.vertices.is_empty() {
            let hint = "export a mesh that is bound to an armature, with the option for skinning";
            return Err(FileError::new("skin", "no mesh of the file has a skin, expected joints and weights", hint));
        }
        let (triangles, vertices) = (self.triangles.len(), self.vertices.len());
        if triangles == 0 {
            return Err(FileError::new("skin", "the skinned mesh has no triangle", EXPORT_HINT));
        }
        // Seams have a vertex for each side. A mesh has at least as many corners as used vertices.
        if triangles > MOST_TRIANGLES || vertices > 3 * MOST_TRIANGLES {
            let problem = format!(
                "it has {triangles} triangles and {vertices} vertices, expected {MOST_TRIANGLES} triangles at most"
            );
            return Err(FileError::new("skin", problem, "reduce the mesh: detail of 5 mm is below the wavelength"));
        }
        let (nodes, joints) = (self.nodes.len(), self.joints.len());
        if nodes > MOST_NODES || joints > MOST_NODES {
            let problem = format!("it has {nodes} nodes and {joints} joints, expected {MOST_NODES} of each at most");
            return Err(FileError::new("skeleton", problem, "export only the actor and its armature"));
        }
        Ok(())
    }

    /// Refuses vertices without a finite position and triangles with missing vertices.
    fn check_skin(&self) -> Result<(), FileError> {
        if let Some(i) = self.vertices.iter().position(|v| !v.is_finite()) {
            let problem = format!("vertex {i} is at {}, expected finite numbers", self.vertices[i]);
            return Err(FileError::new("skin", problem, EXPORT_HINT));
        }
        for (t, corners) in self.triangles.iter().enumerate() {
            if let Some(v) = corners.iter().find(|&&v| v as usize >= self.vertices.len()) {
                let problem = format!("triangle {t} names vertex {v} of {}", self.vertices.len());
                return Err(FileError::new("skin", problem, EXPORT_HINT));
            }
        }
        Ok(())
    }

    /// Refuses nodes that cannot be placed, and joints whose skin cannot be placed.
    fn check_skeleton(&self) -> Result<(), FileError> {
        for (i, node) in self.nodes.iter().enumerate() {
            let place = format!("node {:?}", node.name);
            if node.parent.is_some_and(|p| p >= i) {
                return Err(FileError::new(place, "its parent comes after it", EXPORT_HINT));
            }
            let LocalTransform { translation, rotation, scale } = node.local;
            if (0..3).any(|axis| scale[axis].abs() < 1e-9) {
                let problem = format!("its scale is {scale}, expected three numbers that are not zero");
                return Err(FileError::new(place, problem, "apply or reset the scale of this node and export again"));
            }
            if !(translation.is_finite() && rotation.is_finite() && scale.is_finite()) {
                return Err(FileError::new(place, "its transform has a number that is not finite", EXPORT_HINT));
            }
        }
        for (j, joint) in self.joints.iter().enumerate() {
            let place = format!("joint {j}");
            let Some(node) = self.nodes.get(joint.node) else {
                return Err(FileError::new(
                    place,
                    format!("it is node {}, of {}", joint.node, self.nodes.len()),
                    EXPORT_HINT,
                ));
            };
            let determinant = joint.inverse_bind.determinant();
            if !(determinant.is_finite() && determinant.abs() > 1e-30) {
                let problem = format!("the inverse bind matrix of {:?} cannot be inverted", node.name);
                return Err(FileError::new(place, problem, "bind the mesh to its skeleton anew"));
            }
        }
        Ok(())
    }

    /// Scales the weights of every vertex to a sum of one.
    fn normalise_weights(&mut self) -> Result<(), FileError> {
        for (v, weights) in self.weights.iter_mut().enumerate() {
            let place = || format!("weights of vertex {v}");
            if let Some((joint, _)) = weights.iter().find(|(joint, _)| *joint >= self.joints.len()) {
                let problem = format!("joint {joint} is named, but the skin has {}", self.joints.len());
                return Err(FileError::new(place(), problem, EXPORT_HINT));
            }
            weights.retain(|(_, weight)| *weight != 0.0);
            let sum = weights.iter().fold(0.0, |sum, (_, weight)| sum + weight);
            let is_valid = weights.iter().all(|(_, w)| *w > 0.0) && (sum - 1.0).abs() <= WEIGHT_TOLERANCE;
            if !is_valid {
                let problem = format!("they sum to {sum}, expected positive ones that sum to 1");
                let hint = "normalise all weights, and bind every vertex to a joint";
                return Err(FileError::new(place(), problem, hint));
            }
            weights.iter_mut().for_each(|(_, weight)| *weight /= sum);
        }
        Ok(())
    }

    fn check_clips(&self) -> Result<(), FileError> {
        for clip in &self.clips {
            for track in &clip.tracks {
                let name = self.nodes.get(track.node).map_or("", |n| n.name.as_str());
                let place = format!("clip {:?}, track of {name:?}", clip.name);
                let (values, is_finite) = match &track.values {
                    KeyframeValues::Translation(v) | KeyframeValues::Scale(v) => {
                        (v.len(), v.iter().all(|v| v.is_finite()))
                    }
                    KeyframeValues::Rotation(q) => (q.len(), q.iter().all(|q| q.is_finite())),
                };
                let keys = track.times_s.len();
                let expected = if track.interpolation == KeyInterpolation::Cubic { 3 * keys } else { keys };
                let hint = "bake the animation to key frames and export again";
                if keys == 0 || values != expected {
                    let problem = format!("{values} values for {keys} keys, expected {expected} and at least one key");
                    return Err(FileError::new(place, problem, hint));
                }
                let ascending = track.times_s.windows(2).all(|t| t[0] < t[1]);
                if !ascending || !track.times_s.iter().all(|t| t.is_finite()) {
                    return Err(FileError::new(place, "key times do not ascend", hint));
                }
                // A keyframe's rotation of length zero cannot be normalised. Tangents may have any value.
                let is_key = |i: usize| if track.interpolation == KeyInterpolation::Cubic { i % 3 == 1 } else { true };
                let is_invertible = match &track.values {
                    KeyframeValues::Rotation(q) => q.iter().enumerate().all(|(i, q)| !is_key(i) || q.length() > 1e-6),
                    KeyframeValues::Scale(s) => {
                        s.iter().enumerate().all(|(i, s)| !is_key(i) || s.abs().min_element() > 1e-9)
                    }
                    KeyframeValues::Translation(_) => true,
                };
                if !is_finite || !is_invertible {
                    let problem = "a key is not finite, or a rotation or scale of zero";
                    return Err(FileError::new(place, problem, hint));
                }
            }
        }
        Ok(())
    }

    /// Returns the nodes' transforms at a time of a clip.
    pub fn local_transforms(&self, clip: &Clip, time_s: f64) -> Vec<LocalTransform> {
        let mut local_transforms: Vec<LocalTransform> = self.nodes.iter().map(|n| n.local).collect();
        for track in &clip.tracks {
            let Some(local) = local_transforms.get_mut(track.node) else { continue };
            match &track.values {
                KeyframeValues::Translation(v) => {
                    local.translation = track.value(v, time_s, DVec3::lerp).unwrap_or(local.translation);
                }
                KeyframeValues::Rotation(q) => {
                    let rotation = track.value(q, time_s, DQuat::slerp);
                    local.rotation = rotation.map_or(local.rotation, DQuat::normalize);
                }
                KeyframeValues::Scale(v) => local.scale = track.value(v, time_s, DVec3::lerp).unwrap_or(local.scale),
            }
        }
        local_transforms
    }

    /// Returns the joints' positions in the file's world, and the maps from the skin's own frame.
    pub fn pose(&self, local_transforms: &[LocalTransform]) -> (Vec<DVec3>, Vec<BoneMap>) {
        let mut world: Vec<DMat4> = Vec::with_capacity(local_transforms.len());
        for (node, local) in self.nodes.iter().zip(local_transforms) {
            let parent = node.parent.and_then(|p| world.get(p)).copied().unwrap_or(DMat4::IDENTITY);
            world.push(parent * local.matrix());
        }
        let posed = |joint: &Joint| {
            let joint_world = world.get(joint.node).copied().unwrap_or(DMat4::IDENTITY);
            let map = joint_world * joint.inverse_bind;
            let map = BoneMap { centre: map.w_axis.truncate(), linear: DMat3::from_mat4(map) };
            (joint_world.w_axis.truncate(), map)
        };
        self.joints.iter().map(posed).unzip()
    }
}

/// Returns the mean transform of each node over several poses. Quaternions are averaged with consistent signs.
pub(super) fn mean_transforms(poses: &[Vec<LocalTransform>]) -> Vec<LocalTransform> {
    let Some(first) = poses.first() else { return Vec::new() };
    let share = 1.0 / poses.len() as f64;
    let mean_of = |i: usize| {
        let same_node = || poses.iter().filter_map(|p| p.get(i));
        let reference = first[i].rotation;
        let rotation = same_node().fold(DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0), |sum, local| {
            sum + if local.rotation.dot(reference) < 0.0 { -local.rotation } else { local.rotation }
        });
        LocalTransform {
            translation: same_node().map(|l| l.translation).sum::<DVec3>() * share,
            rotation: if rotation.length() > 1e-9 { rotation.normalize() } else { reference },
            scale: same_node().map(|l| l.scale).sum::<DVec3>() * share,
        }
    };
    (0..first.len()).map(mean_of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn track(interpolation: KeyInterpolation, values: KeyframeValues) -> KeyframeTrack {
        KeyframeTrack { node: 0, interpolation, times_s: vec![0.0, 2.0], values }
    }

    /// Interpolation follows glTF 2.0, appendix C.
    #[test]
    fn keyframes_are_interpolated_as_gltf_specifies() {
        let ends = || KeyframeValues::Translation(vec![DVec3::ZERO, DVec3::X]);
        let at = |track: &KeyframeTrack, t: f64| match &track.values {
            KeyframeValues::Translation(v) => track.value(v, t, DVec3::lerp).expect("keys").x,
            _ => f64::NAN,
        };
        let (step, linear) = (track(KeyInterpolation::Step, ends()), track(KeyInterpolation::Linear, ends()));
        assert_eq!([-1.0, 0.0, 1.9, 2.0, 3.0].map(|t| at(&step, t)), [0.0, 0.0, 0.0, 1.0, 1.0]);
        assert_eq!([-1.0, 0.5, 2.0, 3.0].map(|t| at(&linear, t)), [0.0, 0.25, 1.0, 1.0]);
        // x = t^3 from its values and slopes at 0 and 2.
        let slopes = [0.0, 0.0, 0.0, 12.0, 8.0, 0.0].map(|x| DVec3::X * x);
        let cubic = track(KeyInterpolation::Cubic, KeyframeValues::Translation(slopes.to_vec()));
        for t in [0.0, 0.3, 1.0, 1.7, 2.0] {
            assert!((at(&cubic, t) - t.powi(3)).abs() < 1e-12, "{t}");
        }
    }

    #[test]
    fn rotations_are_interpolated_along_the_shorter_arc() {
        let (a, b) = (DQuat::from_rotation_z(0.2), -DQuat::from_rotation_z(1.0));
        let turn = track(KeyInterpolation::Linear, KeyframeValues::Rotation(vec![a, b]));
        let KeyframeValues::Rotation(values) = &turn.values else { unreachable!() };
        let middle = turn.value(values, 1.0, DQuat::slerp).expect("keys");
        assert!(middle.dot(DQuat::from_rotation_z(0.6)).abs() > 1.0 - 1e-12);
    }
}
