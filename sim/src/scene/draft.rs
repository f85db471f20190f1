//! Faces before the sides with air are known.

use super::room::slab;
use crate::em::image::Wall;
use crate::geometry::PlanarPolygon;
use crate::scene_file::{SceneFile, SurfaceFile};

/// Group of the faces that enclose the room.
pub(super) const ROOM: usize = 0;

/// A face before the sides with air are known.
#[derive(Debug, Clone)]
pub(super) struct Draft {
    pub polygon: PlanarPolygon,
    pub wall: Wall,
    /// Name of the wall, the piece of furniture or the part of the file, for messages.
    pub name: String,
    /// Group of the face: faces of one group may enclose a volume together.
    pub group: usize,
}

/// Reflection and transmission of a surface; `None` for an open surface and for an unknown material.
pub(super) fn closed_wall(file: &SceneFile, surface: &SurfaceFile, frequency_hz: f64) -> Option<Wall> {
    slab(file, surface, frequency_hz).filter(|wall| *wall != Wall::Open)
}
