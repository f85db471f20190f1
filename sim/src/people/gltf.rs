//! Skinned actors from glTF 2.0 files: metres, y up.

use std::path::Path;

use glam::{DMat4, DQuat, DVec3};
use gltf::animation::{Interpolation, Property};

use super::rig::{Between, Clip, Joint, Local, MOST_TRIANGLES, Node, Rig, Track, Values};
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
    let mut rig = Rig { metres: 1.0, up: UpAxis::Y, ..Rig::default() };
    // Index in the rig of each of the file's nodes.
    let mut number = vec![usize::MAX; file.document.nodes().count()];
    for (index, parent) in file.tree().map_err(damaged)? {
        let Some(node) = file.document.nodes().nth(index) else { continue };
        number[index] = rig.nodes.len();
        let (translation, rotation, scale) = node.transform().decomposed();
        let local = Local {
            translation: DVec3::from(translation.map(f64::from)),
            rotation: DQuat::from_array(rotation.map(f64::from)),
            scale: DVec3::from(scale.map(f64::from)),
        };
        let name = node.name().map_or_else(|| format!("node {index}"), str::to_owned);
        rig.nodes.push(Node { name, parent: parent.map(|p| number[p]), local });
    }
    for node in file.document.nodes() {
        match (node.mesh(), node.skin()) {
            (Some(mesh), Some(skin)) => add_skin(&mut rig, &file, &mesh, &skin, &number)?,
            (Some(_), None) => tracing::warn!(node = node.name(), "a mesh without a skin is left out of the actor"),
            (None, _) => {}
        }
    }
    for animation in file.document.animations() {
        rig.clips.push(clip(&file, &animation, &number)?);
    }
    Ok(rig)
}

/// Adds a skinned mesh. `number` maps the file's nodes to the rig's nodes.
fn add_skin(
    rig: &mut Rig,
    file: &GltfFile,
    mesh: &gltf::Mesh,
    skin: &gltf::Skin,
    number: &[usize],
) -> Result<(), FileError> {
    let first = rig.joints.len();
    let what = format!("skin {}", skin.index());
    let matrices = skin.inverse_bind_matrices();
    let rows =
        matrices.map(|m| file.rows(&m, &format!("inverse bind matrices of {what}"))).transpose().map_err(damaged)?;
    let inverse: Option<Vec<DMat4>> = rows.map(|rows| rows.of::<16>().map(|m| DMat4::from_cols_array(&m)).collect());
    for (i, joint) in skin.joints().enumerate() {
        let inverse_bind = match &inverse {
            Some(all) => *all.get(i).ok_or_else(|| {
                let problem = format!("{} inverse bind matrices for {} joints", all.len(), skin.joints().count());
                FileError::new(&what, problem, "bind the mesh to its skeleton anew and export again")
            })?,
            None => DMat4::IDENTITY,
        };
        rig.joints.push(Joint { node: number[joint.index()], inverse_bind });
    }
    for primitive in mesh.primitives() {
        let what = format!("primitive {} of mesh {:?}", primitive.index(), mesh.name().unwrap_or_default());
        let part = file.triangles(&primitive, &what).map_err(damaged)?;
        let count = part.vertices.len();
        // Seams have a vertex for each side. The check is before weights are read, which take the most memory.
        if rig.vertices.len().saturating_add(count) > 3 * MOST_TRIANGLES {
            let problem =
                format!("with it the skin has more vertices than expected, {} vertices at most", 3 * MOST_TRIANGLES);
            return Err(FileError::new(&what, problem, "reduce the mesh: detail of 5 mm is below the wavelength"));
        }
        let mut weights: Vec<Vec<(usize, f64)>> = vec![Vec::new(); count];
        for set in 0.. {
            let (Some(joints), Some(of)) =
                (primitive.get(&gltf::Semantic::Joints(set)), primitive.get(&gltf::Semantic::Weights(set)))
            else {
                break;
            };
            let joints = file.rows(&joints, &format!("joints of {what}")).map_err(damaged)?;
            let of = file.rows(&of, &format!("weights of {what}")).map_err(damaged)?;
            if joints.numbers.len() != 4 * count || of.numbers.len() != 4 * count {
                let problem = format!("{count} vertices, but joints or weights for another number");
                return Err(FileError::new(&what, problem, "bind the mesh to its skeleton anew and export again"));
            }
            for (weights, (joints, of)) in weights.iter_mut().zip(joints.of::<4>().zip(of.of::<4>())) {
                weights.extend(
                    joints.iter().zip(of).map(|(&joint, weight)| (first.saturating_add(joint as usize), weight)),
                );
            }
        }
        let start = rig.vertices.len() as u32;
        rig.vertices.extend(part.vertices);
        rig.weights.extend(weights);
        rig.triangles.extend(part.triangles.iter().map(|t| t.map(|v| v.saturating_add(start))));
    }
    Ok(())
}

/// Reads the clip of an animation. `number` maps the file's nodes to the rig's nodes.
fn clip(file: &GltfFile, animation: &gltf::Animation, number: &[usize]) -> Result<Clip, FileError> {
    let name = animation.name().map_or_else(|| format!("animation {}", animation.index()), str::to_owned);
    let mut clip = Clip { name, tracks: Vec::new() };
    for channel in animation.channels() {
        let (node, sampler) = (channel.target().node(), channel.sampler());
        let what = format!("{:?}", clip.name);
        let times_s = file.rows(&sampler.input(), &format!("key times of {what}")).map_err(damaged)?.numbers;
        let output = file.rows(&sampler.output(), &format!("keys of {what}")).map_err(damaged)?;
        let wide = |width: usize| {
            let hint = "bake the animation to key frames and export again";
            let problem = format!("{} numbers a key, expected {width}", output.width);
            if output.width == width { Ok(()) } else { Err(FileError::new(&what, problem, hint)) }
        };
        let values = match channel.target().property() {
            Property::Translation => wide(3).map(|()| Values::Translation(output.vectors()))?,
            Property::Scale => wide(3).map(|()| Values::Scale(output.vectors()))?,
            Property::Rotation => {
                wide(4).map(|()| Values::Rotation(output.of::<4>().map(DQuat::from_array).collect()))?
            }
            Property::MorphTargetWeights => continue,
        };
        let between = match sampler.interpolation() {
            Interpolation::Step => Between::Step,
            Interpolation::Linear => Between::Linear,
            Interpolation::CubicSpline => Between::Cubic,
        };
        clip.tracks.push(Track { node: number[node.index()], between, times_s, values });
    }
    Ok(clip)
}
