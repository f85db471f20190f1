//! Actor files that a scene refers to.

use std::path::Path;
use std::sync::Arc;

use radome_files::{MESH_LIMIT_BYTES, named_by_spec, read};

use super::{SceneError, file_error};
use crate::file_error::{FileError, utf8};
use crate::geometry::import::UpAxis;
use crate::people::clip::BodyClip;
use crate::people::imported::{Actor, ActorOptions};
use crate::people::motion::Steps;
use crate::scene_file::{ActorFile, SceneFile};

/// Walking speed for which foot sliding is reported, m/s.
const USUAL_SPEED_M_PER_S: f64 = 1.2;

/// Returns the source of the person's steps for each `[[people.actor]]`.
pub(super) fn load(scene: &SceneFile, path: &Path, text: &str) -> Result<Vec<Steps>, SceneError> {
    scene.people.actor.iter().map(|actor| load_one(actor, path, text)).collect()
}

fn load_one(actor: &ActorFile, path: &Path, text: &str) -> Result<Steps, SceneError> {
    let Some(name) = &actor.file else { return Ok(Steps::Gait) };
    let folder = path.parent().unwrap_or(Path::new(""));
    let file = folder.join(name);
    let scene_error = |source: FileError| file_error(path, text, name, source);
    let bytes = named_by_spec(folder, Path::new(name))
        .and_then(|file| read(&file, MESH_LIMIT_BYTES))
        .map_err(|e| scene_error(FileError::unreadable(&e)))?;
    if name.to_lowercase().ends_with(".bvh") {
        let text = utf8(&bytes, "BVH files are plain text: export the clip again").map_err(scene_error)?;
        let clip = BodyClip::parse(text, actor.up.unwrap_or(UpAxis::Y), actor.cycle_s).map_err(scene_error)?;
        tracing::info!(
            file = %file.display(),
            cycle_s = ?clip.span_s,
            foot_sliding = ?clip.foot_sliding(USUAL_SPEED_M_PER_S),
            "captured steps; sliding is at {USUAL_SPEED_M_PER_S} m/s and goes with the speed"
        );
        return Ok(Steps::Clip(Arc::new(clip)));
    }
    let options = ActorOptions {
        animation: actor.animation.clone(),
        height_m: actor.height_m,
        unit: actor.unit,
        up: actor.up,
        cycle_s: actor.cycle_s,
    };
    let loaded = Actor::parse(&bytes, &file, &options).map_err(scene_error)?;
    tracing::info!(
        file = %file.display(),
        triangles = loaded.skin.rest().triangles.len(),
        open_edges = loaded.open_edges,
        height_m = loaded.height_m,
        cycle_m = loaded.cycle_m,
        foot_sliding = ?loaded.foot_sliding(USUAL_SPEED_M_PER_S),
        "actor; sliding is at {USUAL_SPEED_M_PER_S} m/s and goes with the speed"
    );
    Ok(Steps::Actor(Arc::new(loaded)))
}
