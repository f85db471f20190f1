//! Checks of scene files and of every kind of file that a scene refers to.

use radome_sim::Scene;
use radome_sim::geometry::import::{LengthUnit, Part, UpAxis, import, parse_obj, parse_stl};
use radome_sim::geometry::{overlaps, weld};
use radome_sim::people::bvh::parse_bvh;
use radome_sim::people::clip::BodyClip;
use radome_sim::people::imported::{Actor, ActorOptions};

use crate::{files, with_memory_limit};

/// Files of a scene's folder, in the order of an input's sections.
pub const SCENE_FILES: [&str; 8] =
    ["scene.toml", "receiver.toml", "room.obj", "room.stl", "room.gltf", "actor.gltf", "actor.dae", "clip.bvh"];

/// Memory that parsing a mesh may take for each of its bytes.
const BYTES_PER_MESH_BYTE: usize = 512;
/// Memory that parsing a mesh may take in addition.
const MESH_BYTES: usize = 16 << 20;
/// Memory that an actor may take: its skin is refined to 150,000 triangles at most.
const ACTOR_BYTES: usize = 768 << 20;
/// Memory that the samples of a clip's joints may take.
const CLIP_BYTES: usize = 256 << 20;

/// Asserts that a scene with its files loads or is refused with a reason. A loaded scene has a room, a radar and
/// receivers.
pub fn check_scene(input: &[u8]) {
    let folder = files(&SCENE_FILES, input);
    let path = folder.path().join("scene.toml");
    match with_memory_limit(2 * ACTOR_BYTES, || Scene::load(&path)) {
        Ok(scene) => {
            let room = scene.room();
            assert!(room.size_m.is_finite() && room.size_m.min_element() > 0.0, "{:?}", room.size_m);
            let (_, receivers) = scene.elements();
            assert_eq!(receivers.len(), scene.waveform().shape().rx);
            if let Ok(drawn) = scene.drawn(7) {
                assert_eq!(drawn.waveform(), scene.waveform());
            }
        }
        Err(error) => assert!(!error.to_string().is_empty()),
    }
}

/// Checks binary or text STL.
pub fn check_stl(input: &[u8]) {
    if let Ok(parts) = with_memory_limit(MESH_BYTES + BYTES_PER_MESH_BYTE * input.len(), || parse_stl(input)) {
        check_parts(&parts);
    }
}

/// Checks OBJ.
pub fn check_obj(input: &[u8]) {
    if let Ok(parts) = with_memory_limit(MESH_BYTES + BYTES_PER_MESH_BYTE * input.len(), || parse_obj(input)) {
        check_parts(&parts);
    }
}

/// Checks glTF with a separate buffer, or GLB, as a mesh of a room and as an actor.
pub fn check_gltf(input: &[u8]) {
    let folder = files(&["a.gltf", "buffer.bin"], input);
    let path = folder.path().join("a.gltf");
    // Many primitives may read the numbers of one accessor, so that their total is bounded.
    if let Ok(parts) = with_memory_limit(ACTOR_BYTES, || import(&path, LengthUnit::Metre, UpAxis::Y)) {
        check_parts(&parts);
    }
    let bytes = std::fs::read(&path).unwrap_or_default();
    let options = ActorOptions { height_m: Some(1.75), ..ActorOptions::default() };
    if let Ok(actor) = with_memory_limit(ACTOR_BYTES, || Actor::parse(&bytes, &path, &options)) {
        check_actor(&actor);
    }
}

/// Checks COLLADA.
pub fn check_collada(input: &[u8]) {
    let options = ActorOptions { height_m: Some(1.75), ..ActorOptions::default() };
    if let Ok(actor) = with_memory_limit(ACTOR_BYTES, || Actor::parse(input, std::path::Path::new("a.dae"), &options)) {
        check_actor(&actor);
    }
}

/// Checks a BVH clip and its cycle of steps.
pub fn check_bvh(text: &str) {
    let Ok(clip) = with_memory_limit((1 << 20) + 512 * text.len(), || parse_bvh(text)) else {
        assert!(BodyClip::parse(text, UpAxis::Y, None).is_err());
        return;
    };
    assert!(clip.joints.iter().enumerate().all(|(i, joint)| joint.parent.is_none_or(|parent| parent < i)));
    let channels: usize = clip.joints.iter().map(|joint| joint.channels.len()).sum();
    assert!(clip.frames.iter().all(|frame| frame.len() == channels && frame.iter().all(|number| number.is_finite())));
    for up in [UpAxis::Y, UpAxis::Z] {
        if let Ok(cycle) = with_memory_limit(CLIP_BYTES, || BodyClip::parse(text, up, None)) {
            let [start_s, end_s] = cycle.span_s;
            assert!(start_s >= 0.0 && end_s > start_s && cycle.cycle_m(0.9).is_finite());
        }
    }
}

/// Asserts that triangles refer to existing vertices, and that a mesh can be welded and checked.
fn check_parts(parts: &[Part]) {
    assert!(!parts.is_empty());
    for part in parts {
        let mesh = &part.mesh;
        assert!(!mesh.triangles.is_empty());
        assert!(mesh.triangles.iter().flatten().all(|&v| (v as usize) < mesh.vertices.len()));
        if let Ok(welded) = weld(mesh, 1e-4) {
            overlaps(&welded.mesh);
        }
    }
}

/// Asserts that an actor has a valid mesh, a height and a cycle.
fn check_actor(actor: &Actor) {
    let rest = actor.skin.rest();
    assert!(rest.check().is_ok() && !rest.triangles.is_empty());
    assert!(actor.height_m.is_finite() && actor.cycle_m.is_finite() && actor.cycle_m > 0.0);
}
