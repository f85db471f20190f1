//! Faces before their sides with air are known.

use super::room::slab;
use crate::em::image::Wall;
use crate::geometry::PlanarPolygon;
use crate::scene_file::{SceneFile, SurfaceFile};

/// Group of the faces that enclose the room.
pub(super) const ROOM: usize = 0;

#[derive(Debug, Clone)]
pub(super) struct Draft {
    pub polygon: PlanarPolygon,
    pub wall: Wall,
    pub name: String,
    /// Group of the face: faces of one group may enclose a volume together.
    pub group: usize,
}

/// Reflection and transmission of a surface; `None` for an open one.
pub(super) fn solid(file: &SceneFile, surface: &SurfaceFile, frequency_hz: f64) -> Option<Wall> {
    slab(file, surface, frequency_hz).filter(|wall| *wall != Wall::Open)
}
