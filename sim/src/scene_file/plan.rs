//! Keys of `[room.plan]`: a floor plan with openings and doors, drawn up to a height.

use schemars::JsonSchema;
use serde::Deserialize;

use super::SurfaceFile;

/// A room of upright walls over a polygon. Wall `i` leads from corner `i` to the next one.
///
/// ```toml
/// [room.plan]
/// corners_m = [[0.0, 0.0], [8.0, 0.0], [8.0, 2.0], [2.0, 2.0], [2.0, 6.0], [0.0, 6.0]]
/// height_m = 2.5
/// walls = { material = "plasterboard", thickness_m = 0.1 }
///
/// [[room.plan.opening]]
/// wall = 0
/// from_m = 3.0
/// to_m = 3.9
/// head_m = 2.0
/// door = { hinge = "from", open_deg = 40.0, material = "wood" }
/// ```
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PlanFile {
    /// Corners of the floor, `[x, y]`, m, in order and either way round: 3 to 200. The least x and the least y are 0.
    pub corners_m: Vec<[f64; 2]>,
    /// Height of the ceiling over the floor, m: 0.5 to 100.
    pub height_m: f64,
    /// Material of all walls but those of `wall`.
    pub walls: SurfaceFile,
    /// Walls that are made of something else.
    #[serde(default)]
    pub wall: Vec<PlanWallFile>,
    /// Openings in the walls.
    #[serde(default)]
    pub opening: Vec<OpeningFile>,
    /// Walls within the room.
    #[serde(default)]
    pub partition: Vec<PartitionFile>,
}

impl PlanFile {
    /// Material and thickness, m, of the wall with an index.
    pub fn wall_surface(&self, index: usize) -> (&str, f64) {
        match self.wall.iter().find(|wall| wall.index == index) {
            Some(wall) => (wall.material.as_str(), wall.thickness_m),
            None => (self.walls.material.as_str(), self.walls.thickness_m),
        }
    }

    /// Materials of the walls that differ, and of partitions, panes and doors.
    pub(crate) fn materials(&self) -> Vec<&str> {
        let walls = self.wall.iter().map(|wall| wall.material.as_str());
        let partitions = self.partition.iter().map(|partition| partition.material.as_str());
        let openings = || self.opening.iter().chain(self.partition.iter().flat_map(|partition| &partition.opening));
        let panes = openings().filter_map(|opening| opening.material.as_deref());
        let doors = openings().filter_map(|opening| opening.door.as_ref()).map(|door| door.material.as_str());
        walls.chain(partitions).chain(panes).chain(doors).collect()
    }
}

/// A wall that is made of something else than the others.
#[derive(Debug, Clone, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PlanWallFile {
    /// Index of the wall.
    pub index: usize,
    /// Material: one of the table's or of the scene's own; "open" for no wall.
    pub material: String,
    /// Thickness, m. Default 0.1.
    #[serde(default = "super::thickness")]
    pub thickness_m: f64,
}

/// A wall within the room: an upright sheet on a straight line.
#[derive(Debug, Clone, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PartitionFile {
    /// Place at which it begins, m.
    pub from_m: [f64; 2],
    /// Place at which it ends, m.
    pub to_m: [f64; 2],
    /// Height over the floor, m. Default that of the room.
    pub height_m: Option<f64>,
    /// Material: one of the table's or of the scene's own.
    pub material: String,
    /// Thickness, m. Default 0.1. It counts for what passes through; in the plan the partition is a line.
    #[serde(default = "super::thickness")]
    pub thickness_m: f64,
    /// Openings in it, without `wall`.
    #[serde(default)]
    pub opening: Vec<OpeningFile>,
}

/// A rectangular opening in a wall or a partition: free, with a pane, or with a door.
#[derive(Debug, Clone, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct OpeningFile {
    /// Index of its wall. Needed in `[[room.plan.opening]]`; none in a partition's own.
    pub wall: Option<usize>,
    /// Beginning along the wall, from the corner or place where that begins, m.
    pub from_m: f64,
    /// End along the wall, m.
    pub to_m: f64,
    /// Height of its lower edge over the floor, m. Default 0.
    #[serde(default)]
    pub sill_m: f64,
    /// Height of its upper edge over the floor, m.
    pub head_m: f64,
    /// Material of a pane that fills it. None if absent.
    pub material: Option<String>,
    /// Thickness of the pane, m. Default 0.006.
    pub thickness_m: Option<f64>,
    /// A door in it. None if absent.
    pub door: Option<DoorLeafFile>,
}

impl OpeningFile {
    /// Thickness of the pane, m.
    pub(crate) fn pane_thickness_m(&self) -> f64 {
        self.thickness_m.unwrap_or(0.006)
    }
}

/// A door leaf as wide and as high as its opening.
#[derive(Debug, Clone, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct DoorLeafFile {
    /// End of the opening at which it hangs: "from" or "to".
    pub hinge: HingeFile,
    /// Angle by which it is open, degrees: 0 for shut; positive into the room (of a partition: to the left of the way along
    /// it), negative the other way. -170 to 170.
    #[serde(default)]
    pub open_deg: f64,
    /// Material: one of the table's or of the scene's own.
    pub material: String,
    /// Thickness, m. Default 0.04.
    #[serde(default = "leaf_thickness")]
    pub thickness_m: f64,
}

/// Ends of an opening.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum HingeFile {
    /// Beginning of the opening.
    From,
    /// End of the opening.
    To,
}

fn leaf_thickness() -> f64 {
    0.04
}
