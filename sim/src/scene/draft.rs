//! Faces before it is known where there is air.

use super::room::slab;
use crate::em::image::Wall;
use crate::geometry::PlanarPolygon;
use crate::scene_file::{SceneFile, SurfaceFile};

/// The group of faces that close the room.
pub(super) const ROOM: usize = 0;

#[derive(Debug, Clone)]
pub(super) struct Draft {
    pub polygon: PlanarPolygon,
    pub wall: Wall,
    pub name: String,
    /// Faces of one group may close a volume together.
    pub group: usize,
}

/// Reflection and transmission of a surface; `None` where there is none.
pub(super) fn solid(file: &SceneFile, surface: &SurfaceFile, frequency_hz: f64) -> Option<Wall> {
    slab(file, surface, frequency_hz).filter(|wall| *wall != Wall::Open)
}
