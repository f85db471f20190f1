//! Scene files: the TOML schema. Each field's doc states unit and default; an unknown key is an error.
//! Keys of `[people]` are in `people.rs`.
//!
//! Frames of reference: the room is the box `0..size_m`, x and y horizontal, z up. Azimuth turns from +x towards +y. The radar's
//! own axes are x boresight, y left, z up (before tilt); `tilt_down_deg` lowers the boresight.

pub(crate) mod draw;
mod people;

use std::collections::BTreeMap;

use radome_dsp::WaveformRequest;
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::Deserialize;

use crate::geometry::import::{LengthUnit, UpAxis};
use crate::material::{OPEN, OwnMaterial};
use crate::receiver::Receiver;
pub use draw::RandomFile;
pub use people::{ActorFile, BodyFile, DeskFile, ModesFile, PeopleFile, ShadowFile, StepFile, VisitsFile, WanderFile};

mod plan;

pub use plan::{DoorLeafFile, HingeFile, OpeningFile, PartitionFile, PlanFile, PlanWallFile};

/// Version of the schema that this crate reads.
pub const SCENE_FORMAT: u32 = 1;

/// A scene as its file states it.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SceneFile {
    /// Version of the schema: 1.
    pub format: u32,
    /// Short name, for messages and provenance.
    pub name: String,
    /// Path of a receiver file, relative to the scene file, or the receiver's own table. Datasheet typicals if absent.
    #[serde(default)]
    #[schemars(schema_with = "path_or_receiver")]
    pub receiver: Option<toml::Value>,
    /// The room.
    pub room: RoomFile,
    /// Materials beside those of the table, by name.
    #[serde(default)]
    pub materials: BTreeMap<String, OwnMaterial>,
    /// Place of the radar.
    pub radar: RadarFile,
    /// Waveform that it transmits and samples.
    pub waveform: WaveformRequest,
    /// Static reflectors.
    #[serde(default)]
    pub furniture: Vec<FurnitureFile>,
    /// Places to sit.
    #[serde(default)]
    pub seat: Vec<SeatFile>,
    /// Places to lie.
    #[serde(default)]
    pub bed: Vec<BedFile>,
    /// Doors, each in one of the four upright walls.
    #[serde(default)]
    pub door: Vec<DoorFile>,
    /// People who come, and what they do.
    pub people: PeopleFile,
    /// Keys, by their dotted paths, whose values are drawn for each seed.
    #[serde(default)]
    pub random: BTreeMap<String, RandomFile>,
}

/// The room: a box with a slab for each surface (`size_m` and six surfaces), upright walls over a floor plan (`[room.plan]`, with
/// `floor` and `ceiling`), or what meshes say (`[[room.mesh]]`).
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RoomFile {
    /// Inner size along x, y, z, m. Not given beside `plan` or `mesh`: it is that of the box around them then.
    #[serde(default)]
    pub size_m: [f64; 3],
    /// Instead of size and upright walls: a floor plan.
    pub plan: Option<PlanFile>,
    /// Instead of size and surfaces: the room's walls and what stands in it, as meshes. The low corner of the box that the walls
    /// make becomes the origin of the scene. A surface that the meshes do not have is `{ material = "open" }`.
    #[serde(default)]
    pub mesh: Vec<RoomMeshFile>,
    /// Way of finding paths: "images" takes the box around the room, whose images are a lattice, and furniture as points;
    /// "rays" takes all faces of walls and furniture, which mirror, hide and diffract. Default "rays" with `plan`, and with
    /// `mesh` unless that is a box and nothing else; "images" without.
    pub solver: Option<SolverFile>,
    /// Reflections at walls that a path may have in all. Default 3, at most 6. In rooms of more than 200 faces that rays are
    /// sent through, two are taken at most.
    #[serde(default = "count::<3>")]
    pub max_reflections: u32,
    /// Reflections that a path by way of a person or of furniture may have in all. Default 2, at most 3.
    #[serde(default = "count::<2>")]
    pub max_body_reflections: u32,
    /// Whether people behind walls are seen through them: the upright ones of a box, on the straight way; all faces that rays are
    /// sent through. Plasterboard takes some 11 dB of their echoes, both ways, concrete all of them. Default false: who is behind
    /// a wall is not seen, unless it is open.
    #[serde(default)]
    pub transmission: bool,
    /// Share of the incident power that surfaces scatter in all directions, by their roughness and by objects on and before them
    /// ([`crate::diffuse`]): 0.04 to 0.16 in measurements. They reflect and transmit only the rest as smooth ones. It makes moving
    /// echoes at many ranges of one person. Default 0.
    #[serde(default)]
    pub diffuse_share: f64,
    /// Number of points that represent the scattering surfaces. Some points per range bin and direction suffice for echoes that are
    /// like noise; long rooms need more. Default 32, at most 1024.
    #[serde(default = "count::<32>")]
    pub diffuse_points: u32,
    /// Largest number of walls on a path over such a point between antenna and person. Each wall leaves what it reflects and what
    /// it scatters: the better the walls reflect, the more a room returns, and the longer. Default 1, at most 16.
    #[serde(default = "count::<1>")]
    pub diffuse_bounces: u32,
    /// Groups of small reflectors that sway. None if absent.
    #[serde(default)]
    pub sway: Vec<SwayFile>,
    /// Surface at x = 0.
    #[serde(default)]
    pub x_low: SurfaceFile,
    /// Surface at x = size.
    #[serde(default)]
    pub x_high: SurfaceFile,
    /// Surface at y = 0.
    #[serde(default)]
    pub y_low: SurfaceFile,
    /// Surface at y = size.
    #[serde(default)]
    pub y_high: SurfaceFile,
    /// Floor.
    #[serde(default)]
    pub floor: SurfaceFile,
    /// Ceiling.
    #[serde(default)]
    pub ceiling: SurfaceFile,
}

impl RoomFile {
    /// Returns whether waves pass each upright wall of the box, at low and high x, low and high y: open walls, and all if
    /// walls transmit.
    pub fn passable_walls(&self) -> [bool; 4] {
        [&self.x_low, &self.x_high, &self.y_low, &self.y_high].map(|wall| self.transmission || wall.material == OPEN)
    }

    /// Returns whether each upright wall hides people behind it, at low and high x, low and high y. In rooms of polygons, rays
    /// decide that instead.
    pub fn hiding_walls(&self) -> [bool; 4] {
        let is_box = match self.solver {
            Some(solver) => solver == SolverFile::Images,
            None => self.plan.is_none() && self.mesh.is_empty(),
        };
        self.passable_walls().map(|is_passable| is_box && !is_passable)
    }
}

/// Ways to find paths.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum SolverFile {
    /// By the images of a box.
    Images,
    /// By rays over all faces.
    Rays,
}

/// A slab.
#[derive(Debug, Clone, Default, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SurfaceFile {
    /// Material: one of the table's ([`crate::material::Material`]) or of the scene's own.
    pub material: String,
    /// Thickness, m. Default 0.1.
    #[serde(default = "thickness")]
    pub thickness_m: f64,
}

/// A group of small reflectors that move a little about where they are: cables, plants, curtains, fans, what stands on a desk
/// ([`crate::sway`]). They are no people: a room in which only they move is empty.
#[derive(Debug, Clone, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SwayFile {
    /// Reflectors. Default 4, at most 64; 0 for none.
    pub reflectors: usize,
    /// Probability that the group is there. Drawn for each seed. Default 1.
    pub probability: f64,
    /// Rule by which each of them is placed. Default "clutter".
    pub at: SwayPlaceFile,
    /// Place of all of them instead, m. Drawn by `at` if absent.
    pub position_m: Option<[f64; 3]>,
    /// Radar cross-section of each, dBsm: the middle of what is drawn. Default -45. At 3 m, -40 dBsm stands some 7 dB over noise
    /// in a map of 64 chirps of 128 samples at 48 dB of IF gain.
    pub cross_section_dbsm: f64,
    /// Greatest difference of a reflector's cross-section from that, dB either way. Drawn for each. Default 10.
    pub spread_db: f64,
    /// Displacement along the line of sight, rms, m. Drawn for each, evenly in its logarithm. Default [0.0005, 0.01].
    pub amplitude_m: [f64; 2],
    /// Frequency of the motion, Hz. Drawn for each, evenly in its logarithm. Default [0.2, 2].
    pub frequency_hz: [f64; 2],
    /// Spread of the motion's frequencies about that: standard deviation of their natural logarithm. Default 0.3; 0 for a
    /// single sinusoid, as of what turns or is driven by the mains.
    pub bandwidth: f64,
}

impl Default for SwayFile {
    fn default() -> Self {
        SwayFile {
            reflectors: 4,
            probability: 1.0,
            at: SwayPlaceFile::Clutter,
            position_m: None,
            cross_section_dbsm: -45.0,
            spread_db: 10.0,
            amplitude_m: [0.0005, 0.01],
            frequency_hz: [0.2, 2.0],
            bandwidth: 0.3,
        }
    }
}

/// Places at which swaying reflectors are drawn.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum SwayPlaceFile {
    /// On furniture, before a wall or beside the radar, by chance.
    #[default]
    Clutter,
    /// On furniture; before a wall where there is none.
    Furniture,
    /// Up to 0.3 m before a wall, within 50 degrees of the boresight.
    Walls,
    /// Within 0.9 m of the radar: on the desk or shelf where it stands.
    Radar,
    /// Anywhere between the radar and the walls, within 50 degrees of the boresight.
    Anywhere,
}

/// A mesh of the room: walls, furniture, or both.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RoomMeshFile {
    /// STL, OBJ or glTF file (`.stl`, `.obj`, `.gltf`, `.glb`), relative to the scene file.
    pub file: String,
    /// Unit of its numbers: "m", "cm", "mm" or "in". Needed of STL and OBJ, which do not say; glTF is in metres.
    pub unit: Option<LengthUnit>,
    /// Axis that points up: "z" or "y". Needed of STL and OBJ; glTF has y up.
    pub up: Option<UpAxis>,
    /// Material of its parts, but for those of `materials`.
    pub material: Option<String>,
    /// Materials by the names that the file gives to materials or parts.
    #[serde(default)]
    pub materials: BTreeMap<String, String>,
    /// Thickness of what it stands for, m. Default 0.1.
    #[serde(default = "thickness")]
    pub thickness_m: f64,
}

/// Place of the radar and direction in which it looks.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RadarFile {
    /// Position in the room, m.
    pub position_m: [f64; 3],
    /// Boresight from +x towards +y, degrees. Default 0.
    #[serde(default)]
    pub azimuth_deg: f64,
    /// Boresight below the horizon, degrees. Default 0.
    #[serde(default)]
    pub tilt_down_deg: f64,
    /// Vibration of what the radar is mounted on. None if absent.
    pub vibration: Option<VibrationFile>,
}

/// Vibration of the radar along its boresight. All echoes share the phase of an echo on boresight; leakage has none.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct VibrationFile {
    /// Displacement, rms, m. Default 0; 5e-6 to 2e-4 is usual on desks and walls of light boards.
    pub amplitude_m: f64,
    /// Frequency, Hz. Default 10.
    pub frequency_hz: f64,
    /// Spread of the frequencies about that: standard deviation of their natural logarithm; 0 for a single sinusoid.
    /// Default 0.3.
    pub bandwidth: f64,
}

impl Default for VibrationFile {
    fn default() -> Self {
        VibrationFile { amplitude_m: 0.0, frequency_hz: 10.0, bandwidth: 0.3 }
    }
}

/// A static box, reduced to scattering points on the faces that the radar sees: their places and phases are drawn from the
/// seed, and together they have the stated radar cross-section. Where rays find the paths (`solver` of `[room]`), a box with a
/// material has its faces instead of points.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct FurnitureFile {
    /// Name, for messages.
    pub name: String,
    /// Corner with the least coordinates, m.
    pub position_m: [f64; 3],
    /// Size along x, y, z, m.
    pub size_m: [f64; 3],
    /// Material: one of the table or of the scene's own. It colours the box in pictures, and says how much
    /// it reflects where `cross_section_dbsm` does not. Neither, if absent.
    pub material: Option<String>,
    /// Thickness of its boards, m. Default 0.02.
    #[serde(default = "board_thickness")]
    pub thickness_m: f64,
    /// Radar cross-section of all points together, dBsm. Default what its material gives: the mean of a convex body turned at
    /// random, a quarter of its area times what it reflects; -10 without one.
    pub cross_section_dbsm: Option<f64>,
    /// Points. Default 6, at most 64.
    #[serde(default = "furniture_points")]
    pub points: usize,
}

impl FurnitureFile {
    /// Radar cross-section of all points together, dBsm.
    pub fn cross_section_dbsm(&self) -> f64 {
        self.cross_section_dbsm.unwrap_or(-10.0)
    }
}

/// A place to sit.
#[derive(Debug, Clone, Copy, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SeatFile {
    /// Place at which the hips come to rest, m.
    pub position_m: [f64; 2],
    /// Direction of the gaze, from +x towards +y, degrees.
    pub heading_deg: f64,
    /// Height of the seat, m. Default 0.45.
    #[serde(default = "seat_height")]
    pub height_m: f64,
    /// Distance before it at which one stands to sit down, m: hips go back by so much, feet stay. Default 0: hips sink where
    /// one stands, and feet slide ahead.
    #[serde(default)]
    pub back_m: f64,
}

/// A place to lie on the back.
#[derive(Debug, Clone, Copy, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct BedFile {
    /// Place at which the hips come to rest, m.
    pub position_m: [f64; 2],
    /// Direction of the feet, from +x towards +y, degrees.
    pub heading_deg: f64,
    /// Height of the mattress, m. Default 0.5.
    #[serde(default = "mattress_height")]
    pub height_m: f64,
    /// From the hips' place to the edge at which one gets in and out, m: to the left of where feet point, to the right if
    /// negative. Default 0.45.
    #[serde(default = "seat_height")]
    pub edge_m: f64,
}

/// A door by which people come and go. Beside a floor plan an opening belongs there, too: who goes through a wall of faces is hidden
/// by it from one chirp to the next.
#[derive(Debug, Clone, Copy, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct DoorFile {
    /// Middle of the door on a wall: x or y is 0 or the room's size, m.
    pub position_m: [f64; 2],
    /// Width, m. Default 0.9.
    #[serde(default = "door_width")]
    pub width_m: f64,
}

fn path_or_receiver(generator: &mut SchemaGenerator) -> Schema {
    let receiver = generator.subschema_for::<Receiver>();
    json_schema!({ "anyOf": [{ "type": "string" }, receiver] })
}

fn count<const N: u32>() -> u32 {
    N
}
fn furniture_points() -> usize {
    6
}
fn thickness() -> f64 {
    0.1
}
fn board_thickness() -> f64 {
    0.02
}
fn mattress_height() -> f64 {
    0.5
}
fn seat_height() -> f64 {
    0.45
}
pub(crate) fn door_width() -> f64 {
    0.9
}
