//! Skinned actors from glTF 2.0 files: metres, y up.

use std::path::Path;

use glam::{DMat4, DQuat, DVec3};
use gltf::animation::{Interpolation, Property};

use super::rig::{
    Clip, Joint, KeyInterpolation, KeyframeTrack, KeyframeValues, LocalTransform, MOST_TRIANGLES, Node, Rig,
};
use crate::file_error::FileError;
use crate::geometry::import::gltf::GltfFile;
use crate::geometry::import::{Damage, UpAxis};

/// Error of a damaged actor, with how to export it again.
fn damaged(damage: Damage) -> FileError {
    let hint = "export it again as glTF 2.0 (.glb), without compression and with all transforms applied";
    FileError::new(damage.place, damage.problem, hint)
}

/// Parses a glTF file. Buffers in other files are read from `folder`.
pub(super) fn parse_gltf(bytes: &[u8], folder: &Path) -> Result<Rig, FileError> {
    let file = GltfFile::parse(bytes, folder).map_err(damaged)?;
    let mut rig = Rig { unit_m: 1.0, up: UpAxis::Y, ..Rig::default() };
    // Index in the rig of each node of the file.
    let mut node_indices = vec![usize::MAX; file.document.nodes().count()];
    for (index, parent) in file.tree().map_err(damaged)? {
        let Some(node) = file.document.nodes().nth(index) else { continue };
        node_indices[index] = rig.nodes.len();
        let (translation, rotation, scale) = node.transform().decomposed();
        let local = LocalTransform {
            translation: DVec3::from(translation.map(f64::from)),
            rotation: DQuat::from_array(rotation.map(f64::from)),
            scale: DVec3::from(scale.map(f64::from)),
        };
        let name = node.name().map_or_else(|| format!("node {index}"), str::to_owned);
        rig.nodes.push(Node { name, parent: parent.map(|p| node_indices[p]), local });
    }
    for node in file.document.nodes() {
        match (node.mesh(), node.skin()) {
            (Some(mesh), Some(skin)) => add_skin(&mut rig, &file, &mesh, &skin, &node_indices)?,
            (Some(_), None) => tracing::warn!(node = node.name(), "a mesh without a skin is left out of the actor"),
            (None, _) => {}
        }
    }
    for animation in file.document.animations() {
        rig.clips.push(clip(&file, &animation, &node_indices)?);
    }
    Ok(rig)
}

/// Adds a skinned mesh. `node_indices` maps the file's nodes to the rig's nodes.
fn add_skin(
    rig: &mut Rig,
    file: &GltfFile,
    mesh: &gltf::Mesh,
    skin: &gltf::Skin,
    node_indices: &[usize],
) -> Result<(), FileError> {
    let first_joint = rig.joints.len();
    let place = format!("skin {}", skin.index());
    let matrices = skin.inverse_bind_matrices();
    let rows =
        matrices.map(|m| file.rows(&m, &format!("inverse bind matrices of {place}"))).transpose().map_err(damaged)?;
    let inverse: Option<Vec<DMat4>> = rows.map(|rows| rows.of::<16>().map(|m| DMat4::from_cols_array(&m)).collect());
    for (i, joint) in skin.joints().enumerate() {
        let inverse_bind = match &inverse {
            Some(all) => *all.get(i).ok_or_else(|| {
                let problem = format!("{} inverse bind matrices for {} joints", all.len(), skin.joints().count());
                FileError::new(&place, problem, "bind the mesh to its skeleton anew and export again")
            })?,
            None => DMat4::IDENTITY,
        };
        rig.joints.push(Joint { node: node_indices[joint.index()], inverse_bind });
    }
    for primitive in mesh.primitives() {
        let place = format!("primitive {} of mesh {:?}", primitive.index(), mesh.name().unwrap_or_default());
        let mesh_part = file.triangles(&primitive, &place).map_err(damaged)?;
        let count = mesh_part.vertices.len();
        // Seams have a vertex for each side. The check is before weights are read, which take the most memory.
        if rig.vertices.len().saturating_add(count) > 3 * MOST_TRIANGLES {
            let problem =
                format!("with it the skin has more vertices than expected, {} vertices at most", 3 * MOST_TRIANGLES);
            return Err(FileError::new(&place, problem, "reduce the mesh: detail of 5 mm is below the wavelength"));
        }
        let mut weights: Vec<Vec<(usize, f64)>> = vec![Vec::new(); count];
        for set in 0.. {
            let (Some(joints), Some(values)) =
                (primitive.get(&gltf::Semantic::Joints(set)), primitive.get(&gltf::Semantic::Weights(set)))
            else {
                break;
            };
            let joints = file.rows(&joints, &format!("joints of {place}")).map_err(damaged)?;
            let values = file.rows(&values, &format!("weights of {place}")).map_err(damaged)?;
            if joints.numbers.len() != 4 * count || values.numbers.len() != 4 * count {
                let problem = format!("{count} vertices, but joints or weights for another number");
                return Err(FileError::new(&place, problem, "bind the mesh to its skeleton anew and export again"));
            }
            for (weights, (joints, values)) in weights.iter_mut().zip(joints.of::<4>().zip(values.of::<4>())) {
                weights.extend(
                    joints
                        .iter()
                        .zip(values)
                        .map(|(&joint, weight)| (first_joint.saturating_add(joint as usize), weight)),
                );
            }
        }
        let first_vertex = rig.vertices.len() as u32;
        rig.vertices.extend(mesh_part.vertices);
        rig.weights.extend(weights);
        rig.triangles.extend(mesh_part.triangles.iter().map(|t| t.map(|v| v.saturating_add(first_vertex))));
    }
    Ok(())
}

/// Reads the clip of an animation. `node_indices` maps the file's nodes to the rig's nodes.
fn clip(file: &GltfFile, animation: &gltf::Animation, node_indices: &[usize]) -> Result<Clip, FileError> {
    let name = animation.name().map_or_else(|| format!("animation {}", animation.index()), str::to_owned);
    let mut clip = Clip { name, tracks: Vec::new() };
    for channel in animation.channels() {
        let (node, sampler) = (channel.target().node(), channel.sampler());
        let place = format!("{:?}", clip.name);
        let times_s = file.rows(&sampler.input(), &format!("key times of {place}")).map_err(damaged)?.numbers;
        let output = file.rows(&sampler.output(), &format!("keys of {place}")).map_err(damaged)?;
        let check_width = |width: usize| {
            let hint = "bake the animation to key frames and export again";
            let problem = format!("{} numbers a key, expected {width}", output.width);
            if output.width == width { Ok(()) } else { Err(FileError::new(&place, problem, hint)) }
        };
        let values = match channel.target().property() {
            Property::Translation => check_width(3).map(|()| KeyframeValues::Translation(output.vectors()))?,
            Property::Scale => check_width(3).map(|()| KeyframeValues::Scale(output.vectors()))?,
            Property::Rotation => {
                check_width(4).map(|()| KeyframeValues::Rotation(output.of::<4>().map(DQuat::from_array).collect()))?
            }
            Property::MorphTargetWeights => continue,
        };
        let interpolation = match sampler.interpolation() {
            Interpolation::Step => KeyInterpolation::Step,
            Interpolation::Linear => KeyInterpolation::Linear,
            Interpolation::CubicSpline => KeyInterpolation::Cubic,
        };
        clip.tracks.push(KeyframeTrack { node: node_indices[node.index()], interpolation, times_s, values });
    }
    Ok(clip)
}
