//! Scene files: the TOML schema. Each field's doc states unit and default; an unknown key is an error.
//!
//! Frames of reference: the room is the box `0..size_m`, x and y horizontal, z up. Azimuth turns from +x towards +y. The radar's
//! own axes are x boresight, y left, z up (before tilt); `tilt_down_deg` lowers the boresight.

use std::collections::BTreeMap;

use radome_dsp::WaveformRequest;
use serde::Deserialize;
use toml::Spanned;

use super::draw::RandomFile;
use super::material::OwnMaterial;
use crate::geometry::import::{LengthUnit, UpAxis};

mod plan;

pub use plan::{DoorLeafFile, HingeFile, OpeningFile, PartitionFile, PlanFile, PlanWallFile};

/// Version of the schema that this crate reads.
pub const SCENE_FORMAT: u32 = 1;

/// A scene as its file states it.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SceneFile {
    /// Version of the schema: 1.
    pub format: u32,
    /// Short name, for messages and provenance.
    pub name: String,
    /// Path of a receiver file, relative to the scene file, or the receiver's own table. Datasheet typicals if absent.
    #[serde(default)]
    pub receiver: Option<Spanned<toml::Value>>,
    /// The room.
    pub room: RoomFile,
    /// Materials beside those of the table, by name.
    #[serde(default)]
    pub materials: BTreeMap<String, OwnMaterial>,
    /// Where the radar is.
    pub radar: RadarFile,
    /// What it transmits and samples.
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
    /// Who comes, and what they do.
    pub people: PeopleFile,
    /// Keys, by their dotted paths, whose values are drawn for each seed.
    #[serde(default)]
    pub random: BTreeMap<String, RandomFile>,
}

/// The room: a box with a slab for each surface (`size_m` and six surfaces), upright walls over a floor plan (`[room.plan]`, with
/// `floor` and `ceiling`), or what meshes say (`[[room.mesh]]`).
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RoomFile {
    /// Inner size along x, y, z, m. Not given beside `plan` or `mesh`: it is that of the box around them then.
    #[serde(default)]
    pub size_m: [f64; 3],
    /// Instead of size and upright walls: a floor plan.
    #[serde(default)]
    pub plan: Option<PlanFile>,
    /// Instead of size and surfaces: the room's walls and what stands in it, as meshes. The low corner of the box that the walls
    /// make becomes the origin of the scene. A surface that the meshes do not have is `{ material = "open" }`.
    #[serde(default)]
    pub mesh: Vec<RoomMeshFile>,
    /// Reflections at walls that a path may have in all. Default 3, at most 4.
    #[serde(default = "three")]
    pub max_reflections: u32,
    /// Reflections that a path by way of a person or of furniture may have in all. Default 2, at most 3.
    #[serde(default = "two")]
    pub max_body_reflections: u32,
    /// Whether people behind the upright walls are seen through them, on the straight way. Plasterboard takes some 11 dB of
    /// their echoes, both ways, concrete all of them. Default false: who is outside is not seen.
    #[serde(default)]
    pub transmission: bool,
    /// Share of the power that falls on the surfaces that they throw in all directions, by their roughness and by what hangs and
    /// stands on them ([`crate::diffuse`]): 0.04 to 0.16 in measurements. It makes moving echoes at many ranges of one person.
    /// Default 0.
    #[serde(default)]
    pub diffuse_share: f64,
    /// Points that stand for the surfaces there: one every few range bins and as many directions will do for echoes that are as
    /// noise is; in long rooms that takes more. Default 32, at most 1024.
    #[serde(default = "thirty_two")]
    pub diffuse_points: u32,
    /// Walls that a way by such a point meets at most between antenna and person. Each leaves what it mirrors and its diffuse
    /// share: a room returns the more, and the longer, the harder its walls. Default 1, at most 16.
    #[serde(default = "one")]
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

/// A slab.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SurfaceFile {
    /// Material: one of the table's ([`super::material::Material`]) or of the scene's own.
    pub material: String,
    /// Thickness, m. Default 0.1.
    #[serde(default = "tenth")]
    pub thickness_m: f64,
}

/// A group of small reflectors that move a little about where they are: cables, plants, curtains, fans, what stands on a desk
/// ([`crate::sway`]). They are no people: a room in which only they move is empty.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SwayFile {
    /// Reflectors. Default 4, at most 64; 0 for none.
    pub reflectors: usize,
    /// Probability that the group is there. Drawn for each seed. Default 1.
    pub probability: f64,
    /// Where each of them is drawn. Default "clutter".
    pub at: SwayPlaceFile,
    /// Where all of them are instead, m. Drawn by `at` if absent.
    pub position_m: Option<[f64; 3]>,
    /// Radar cross-section of each, dBsm: the middle of what is drawn. Default -45. At 3 m, -40 dBsm stands some 7 dB over noise
    /// in a map of 64 chirps of 128 samples at 48 dB of IF gain.
    pub cross_section_dbsm: f64,
    /// How far a reflector's cross-section is from that at most, dB either way. Drawn for each. Default 10.
    pub spread_db: f64,
    /// Displacement along the line of sight, rms, m. Drawn for each, evenly in its logarithm. Default [0.0005, 0.01].
    pub amplitude_m: [f64; 2],
    /// Frequency of the motion, Hz. Drawn for each, evenly in its logarithm. Default [0.2, 2].
    pub frequency_hz: [f64; 2],
    /// How far the motion's frequencies spread about that: standard deviation of their natural logarithm. Default 0.3; 0 for a
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
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
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
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RoomMeshFile {
    /// STL, OBJ or glTF file (`.stl`, `.obj`, `.gltf`, `.glb`), relative to the scene file.
    pub file: String,
    /// What one of its numbers is: "m", "cm", "mm" or "in". Needed of STL and OBJ, which do not say; glTF is in metres.
    #[serde(default)]
    pub unit: Option<LengthUnit>,
    /// Which of its axes points up: "z" or "y". Needed of STL and OBJ; glTF has y up.
    #[serde(default)]
    pub up: Option<UpAxis>,
    /// Material of its parts, but for those of `materials`.
    #[serde(default)]
    pub material: Option<String>,
    /// Materials by the names that the file gives to materials or parts.
    #[serde(default)]
    pub materials: BTreeMap<String, String>,
    /// Thickness of what it stands for, m. Default 0.1.
    #[serde(default = "tenth")]
    pub thickness_m: f64,
}

/// Where the radar is and where it looks.
#[derive(Debug, Clone, Deserialize)]
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
    #[serde(default)]
    pub vibration: Option<VibrationFile>,
}

/// Vibration of the radar along its boresight. All echoes share the phase of an echo on boresight; leakage has none.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct VibrationFile {
    /// Displacement, rms, m. Default 0; 5e-6 to 2e-4 is usual on desks and walls of light boards.
    pub amplitude_m: f64,
    /// Frequency, Hz. Default 10.
    pub frequency_hz: f64,
    /// How far the frequencies spread about that: standard deviation of their natural logarithm; 0 for a single sinusoid.
    /// Default 0.3.
    pub bandwidth: f64,
}

impl Default for VibrationFile {
    fn default() -> Self {
        VibrationFile { amplitude_m: 0.0, frequency_hz: 10.0, bandwidth: 0.3 }
    }
}

/// A static box, reduced to scattering points on the faces that the radar sees: their places and phases are drawn from the
/// seed, and together they have the stated radar cross-section.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FurnitureFile {
    /// Name, for messages.
    pub name: String,
    /// Corner with the least coordinates, m.
    pub position_m: [f64; 3],
    /// Size along x, y, z, m.
    pub size_m: [f64; 3],
    /// What it is made of: a material of the table or of the scene's own. It colours the box in pictures, and says how much
    /// it reflects where `cross_section_dbsm` does not. Neither, if absent.
    #[serde(default)]
    pub material: Option<String>,
    /// Thickness of its boards, m. Default 0.02.
    #[serde(default = "fiftieth")]
    pub thickness_m: f64,
    /// Radar cross-section of all points together, dBsm. Default what its material gives: the mean of a convex body turned at
    /// random, a quarter of its area times what it reflects; -10 without one.
    #[serde(default)]
    pub cross_section_dbsm: Option<f64>,
    /// Points. Default 6, at most 64.
    #[serde(default = "six")]
    pub points: usize,
}

impl FurnitureFile {
    /// Radar cross-section of all points together, dBsm.
    pub fn cross_section_dbsm(&self) -> f64 {
        self.cross_section_dbsm.unwrap_or(-10.0)
    }
}

/// A place to sit.
#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SeatFile {
    /// Where the hips come to rest, m.
    pub position_m: [f64; 2],
    /// Where one looks, from +x towards +y, degrees.
    pub heading_deg: f64,
    /// Height of the seat, m. Default 0.45.
    #[serde(default = "seat_height")]
    pub height_m: f64,
    /// How far before it one stands to sit down, m: hips go back by so much, feet stay. Default 0: hips sink where one stands,
    /// and feet slide ahead.
    #[serde(default)]
    pub back_m: f64,
}

/// A place to lie on the back.
#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BedFile {
    /// Where the hips come to rest, m.
    pub position_m: [f64; 2],
    /// Where feet point, from +x towards +y, degrees.
    pub heading_deg: f64,
    /// Height of the mattress, m. Default 0.5.
    #[serde(default = "half")]
    pub height_m: f64,
    /// From the hips' place to the edge at which one gets in and out, m: to the left of where feet point, to the right if
    /// negative. Default 0.45.
    #[serde(default = "seat_height")]
    pub edge_m: f64,
}

/// A door.
#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DoorFile {
    /// Middle of the door on a wall: x or y is 0 or the room's size, m.
    pub position_m: [f64; 2],
    /// Width, m. Default 0.9.
    #[serde(default = "door_width")]
    pub width_m: f64,
}

/// What people are made of.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum BodyFile {
    /// Thirteen ellipsoids, each with one highlight: the fastest.
    #[default]
    Ellipsoids,
    /// One skin of about 14000 triangles over the same bones, integrated to the tolerance asked for.
    Mesh,
}

/// Model of the shadows that people throw on static echoes.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ShadowFile {
    /// One edge weakens them, without phase, at a few times of a frame: [`crate::shadow::past`].
    #[default]
    Edge,
    /// Both sides and the top of the body diffract them, in amplitude and phase, at every chirp:
    /// [`crate::shadow::past_strip`]. Static echoes flicker at their own ranges, with the Doppler of the diffracted wave.
    Strip,
}

/// Who comes, and what they do: exactly one of the four programs.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PeopleFile {
    /// What people are made of: "ellipsoids" or "mesh" (not at a desk). Default "ellipsoids".
    #[serde(default)]
    pub body: BodyFile,
    /// People with written way-points.
    #[serde(default)]
    pub actor: Vec<ActorFile>,
    /// People who come and go by chance.
    #[serde(default)]
    pub visits: Option<VisitsFile>,
    /// People who wander about on smooth ways, alone or with each other.
    #[serde(default)]
    pub wander: Option<WanderFile>,
    /// People who sit before the radar.
    #[serde(default)]
    pub desk: Option<DeskFile>,
    /// Fastest that anybody turns, degrees/s: wide turns are made on the spot, with steps, others in a curve. If absent, a
    /// corner takes 0.7 s however sharp it is.
    #[serde(default)]
    pub turn_rate_deg_per_s: Option<f64>,
    /// How far hips keep from furniture and walls, m: ways lead around what stands in the room, and nobody paces to places nearer
    /// to it. If absent, ways are straight.
    #[serde(default)]
    pub keep_off_m: Option<f64>,
    /// Stride over the average one of such a body at such a speed. Drawn for each person. Default [1, 1].
    #[serde(default = "ones")]
    pub stride: [f64; 2],
    /// Swing of the arms over the average one. Drawn for each person. Default [1, 1].
    #[serde(default = "ones")]
    pub arm_swing: [f64; 2],
    /// What people wear, as fields over the body. If absent, each segment has one factor (-4 to 2 dB) and is smooth.
    #[serde(default)]
    pub clothing: Option<ClothingFile>,
    /// Model of the shadows on static echoes: "edge" or "strip". Default "edge".
    #[serde(default)]
    pub shadow: ShadowFile,
}

/// Cloth and folds ([`crate::actor::clothing`]), drawn for each person.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ClothingFile {
    /// Mean over the body of what cloth leaves of the skin's echo, dB. Default -1.
    pub level_db: f64,
    /// Standard deviation of that, dB; 0 for one factor for each segment. Default 1.7.
    pub spread_db: f64,
    /// Distance on the body at which that has a correlation of 1/e, m. Default 0.07; 0.05 to 0.10 is usual.
    pub correlation_m: f64,
    /// Height of folds, rms, m; 0 for smooth. Default 0; 0.0005 takes 6.9 dB of a highlight at 60 GHz, 0.001 all of it.
    pub roughness_m: f64,
    /// Slope of folds, rms, degrees: from how far around come the echoes that highlights lose. Default 20.
    pub fold_slope_deg: f64,
}

impl Default for ClothingFile {
    fn default() -> Self {
        ClothingFile { level_db: -1.0, spread_db: 1.7, correlation_m: 0.07, roughness_m: 0.0, fold_slope_deg: 20.0 }
    }
}

/// A person with a script.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ActorFile {
    /// When the script begins, s. Default 0. Before that the person waits at the first way-point.
    #[serde(default)]
    pub start_s: f64,
    /// Body height, m. Default 1.75; of an actor from a file, what the file says.
    #[serde(default)]
    pub height_m: Option<f64>,
    /// Whose steps these are: a skinned actor with an animation of it walking (`.glb`, `.gltf`, `.dae`; only with `body = "mesh"`),
    /// or captured steps for the house's own body (`.bvh`). A path relative to the scene file. The built-in gait if absent.
    #[serde(default)]
    pub file: Option<String>,
    /// Name of the actor's animation. Default the only one, or the only one with "walk" in its name.
    #[serde(default)]
    pub animation: Option<String>,
    /// The part of the animation or clip that is one cycle of two steps, s. Found if absent.
    #[serde(default)]
    pub cycle_s: Option<[f64; 2]>,
    /// Unit of the actor's file: "m", "cm", "mm" or "in". Default what the format says.
    #[serde(default)]
    pub unit: Option<LengthUnit>,
    /// Axis of the actor's file that points up: "y" or "z". Default what the format says; y for BVH.
    #[serde(default)]
    pub up: Option<UpAxis>,
    /// Stride over the average one of such a body at such a speed. Default what `[people]` says.
    #[serde(default)]
    pub stride: Option<f64>,
    /// Swing of the arms over the average one. Default what `[people]` says.
    #[serde(default)]
    pub arm_swing: Option<f64>,
    /// What they do, in order. The first one must be a place: `walk_to_m`, `enter_door` or `lie_s`.
    pub step: Vec<StepFile>,
}

/// One line of a script: `{ walk_to_m = [x, y], speed_m_per_s = 1.2 }`, `{ stand_s = 3 }`, `{ sit_s = 20, seat = 0 }`,
/// `{ squat_s = 4, depth_m = 0.4 }`, `{ lie_s = 30, bed = 0 }`, `{ face_deg = 90 }`, `{ enter_door = 0 }` or `{ leave_door = 0 }`.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StepFile {
    /// Walk there (the first step: be there), m.
    #[serde(default)]
    pub walk_to_m: Option<[f64; 2]>,
    /// Speed of the walk, m/s. Default 1.2.
    #[serde(default)]
    pub speed_m_per_s: Option<f64>,
    /// Stand so long, s.
    #[serde(default)]
    pub stand_s: Option<f64>,
    /// Sit so long, s.
    #[serde(default)]
    pub sit_s: Option<f64>,
    /// On this seat (index). Where one is, if absent.
    #[serde(default)]
    pub seat: Option<usize>,
    /// Squat so long, going down and getting up included, s.
    #[serde(default)]
    pub squat_s: Option<f64>,
    /// How much lower the head is then, m. Default 0.45; at most 0.36 of the body's height.
    #[serde(default)]
    pub depth_m: Option<f64>,
    /// Go to a bed and lie down so long, getting in and out included, s. As the first step: lie there from before the beginning.
    #[serde(default)]
    pub lie_s: Option<f64>,
    /// On this bed (index). Default 0.
    #[serde(default)]
    pub bed: Option<usize>,
    /// Turn on the spot to look there, from +x towards +y, degrees.
    #[serde(default)]
    pub face_deg: Option<f64>,
    /// Come in by this door (index): the first step. Before `start_s` the person is not there.
    #[serde(default)]
    pub enter_door: Option<usize>,
    /// Go out by this door (index) and be gone: the last step.
    #[serde(default)]
    pub leave_door: Option<usize>,
}

/// An endless stream of visits in each of a few slots. Pairs are the least and the largest value drawn.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct VisitsFile {
    /// Slots: the most people at a time. Default 2; of three or more labels say "two", which means two or more.
    pub max_people: usize,
    /// Before the first visit of a slot, s. Default [1.5, 5].
    pub first_absence_s: [f64; 2],
    /// Between two visits of a slot, s. Default [2.5, 6].
    pub absence_s: [f64; 2],
    /// Walking speed, m/s. Default [0.9, 1.7].
    pub speed_m_per_s: [f64; 2],
    /// Body height, m. Default [1.55, 1.92].
    pub height_m: [f64; 2],
    /// Distance of the path from the middle, m: slots keep to different sides. Default [0.2, 0.55].
    pub lateral_m: [f64; 2],
    /// Probability of turning round on the way and leaving by the same door. Default 0.25.
    pub turn_probability: f64,
    /// Probability of standing still on the way. Default 0.25.
    pub pause_probability: f64,
    /// Duration of that, s. Default [0.8, 2.5].
    pub pause_s: [f64; 2],
    /// Probability of going to a seat, where there is one. Default 0.
    pub sit_probability: f64,
    /// Time on the seat, s. Default [8, 25].
    pub sit_s: [f64; 2],
    /// Probability of pacing to and fro (for those who do not sit). Default 0.
    pub pace_probability: f64,
    /// Legs paced. Default [3, 8].
    pub pace_legs: [f64; 2],
    /// Where people pace: `[[x_low, y_low], [x_high, y_high]]`, m. The inner half of the room if absent.
    pub pace_area_m: Option<[[f64; 2]; 2]>,
    /// How far from the walls people keep where they pace, m: the rest of the room is the area, if that is absent.
    pub pace_margin_m: Option<f64>,
    /// How far off the radar's boresight people pace at most, on the ground plan, degrees. Anywhere if absent.
    pub pace_off_boresight_deg: Option<f64>,
    /// How far from the radar people pace, on the ground plan, m. Anywhere if absent.
    pub pace_range_m: Option<[f64; 2]>,
    /// Probability that somebody walks about beyond the wall at the far end of the room (x = size) all the time, who is seen
    /// faintly and does not count. Drawn for each seed. Default 0.
    pub passer_by_probability: f64,
    /// What that wall and the way around it leave of such a one's echoes, dB. Default [-25, -10].
    pub passer_by_level_db: [f64; 2],
}

/// Nobody, one or two people who wander about. Pairs are the least and the largest value drawn.
///
/// `turn_rate_deg_per_s` (120 if absent) and `keep_off_m` (0.35 if absent) of `[people]` hold for them, too.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WanderFile {
    /// Most people at a time; how many there are is drawn for each seed. Default 2.
    pub max_people: usize,
    /// Probability that people come in by a door and leave, `max_people` at a time at most, instead of being there all the time.
    /// Drawn for each seed; never where no door is clear of furniture. Only 0, the default, is taken: people can get stuck in doorways.
    pub come_and_go_probability: f64,
    /// Time that such people stay, s. Default [15, 90].
    pub stay_s: [f64; 2],
    /// Time between two of them, s. Default [3, 30].
    pub absence_s: [f64; 2],
    /// Mean speed while walking, m/s. Drawn for each person. Default [0.15, 1].
    pub speed_m_per_s: [f64; 2],
    /// Largest acceleration, m/s^2. Default 1.
    pub acceleration_m_per_s2: f64,
    /// Body height, m. Default [1.55, 1.92].
    pub height_m: [f64; 2],
    /// How far from the radar people go to, on the ground plan, m. They never come nearer than the least. Default [0.5, 5].
    pub range_m: [f64; 2],
    /// How far off the radar's boresight people go to at most, on the ground plan, degrees. Default 40.
    pub off_boresight_deg: f64,
    /// Weight of near places: ranges are drawn as the least plus the interval times a number of 0 to 1 to this power. Default 1.5;
    /// 1 draws all ranges alike.
    pub nearness: f64,
    /// Two people's hips never come nearer to each other than this, m. Default 0.55, at least 0.45.
    pub least_distance_m: f64,
    /// Probability of a pause at a goal. Default 0.3.
    pub pause_probability: f64,
    /// Duration of a pause, s: most are short. Default [0.5, 20].
    pub pause_s: [f64; 2],
    /// Share of people who stand all the time, where they do nothing together. Default 0.15.
    pub stand_probability: f64,
    /// Share of people who pace to and fro between two places, where they do nothing together. Default 0.2.
    pub pace_probability: f64,
    /// Probability of a seat as the next goal, where there are seats. Default 0.1.
    pub sit_probability: f64,
    /// Time on the seat, s. Default [4, 40].
    pub sit_s: [f64; 2],
    /// Excursion of postural sway at the shoulders, rms, m. Drawn for each person, evenly in its logarithm. Default [0.002, 0.02].
    pub sway_m: [f64; 2],
    /// Share of people who gesture with their arms. Default 0.6.
    pub gesture_probability: f64,
    /// Peak speed of a hand in a stroke of a gesture, m/s. Drawn for each stroke. Default [0.3, 1.5].
    pub gesture_m_per_s: [f64; 2],
    /// How long two people do one thing together, s; then another is drawn. Default [20, 90].
    pub mode_s: [f64; 2],
    /// What two people do together.
    pub modes: ModesFile,
    /// Probability that somebody wanders beyond the wall at the far end of the room (x = size) all the time, who is seen faintly
    /// and does not count. Drawn for each seed. Default 0.
    pub passer_by_probability: f64,
    /// What that wall and the way around it leave of such a one's echoes, dB. Default [-25, -10].
    pub passer_by_level_db: [f64; 2],
}

impl Default for WanderFile {
    fn default() -> Self {
        WanderFile {
            max_people: 2,
            come_and_go_probability: 0.0,
            stay_s: [15.0, 90.0],
            absence_s: [3.0, 30.0],
            speed_m_per_s: [0.15, 1.0],
            acceleration_m_per_s2: 1.0,
            height_m: [1.55, 1.92],
            range_m: [0.5, 5.0],
            off_boresight_deg: 40.0,
            nearness: 1.5,
            least_distance_m: 0.55,
            pause_probability: 0.3,
            pause_s: [0.5, 20.0],
            stand_probability: 0.15,
            pace_probability: 0.2,
            sit_probability: 0.1,
            sit_s: [4.0, 40.0],
            sway_m: [0.002, 0.02],
            gesture_probability: 0.6,
            gesture_m_per_s: [0.3, 1.5],
            mode_s: [20.0, 90.0],
            modes: ModesFile::default(),
            passer_by_probability: 0.0,
            passer_by_level_db: [-25.0, -10.0],
        }
    }
}

/// Weights of what two people do together.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ModesFile {
    /// Each goes about alone. Default 3.
    pub independent: f64,
    /// They walk side by side. Default 1.
    pub together: f64,
    /// One follows the other. Default 1.
    pub follow: f64,
    /// They meet, stand and talk, and part. Default 1.
    pub meet: f64,
    /// They pace between the same two places and pass each other on the way. Default 1.
    pub pass: f64,
    /// One stands while the other walks. Default 1.
    pub stand_and_walk: f64,
}

impl Default for ModesFile {
    fn default() -> Self {
        ModesFile { independent: 3.0, together: 1.0, follow: 1.0, meet: 1.0, pass: 1.0, stand_and_walk: 1.0 }
    }
}

/// Nobody, one or two people sitting before the radar, for good.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DeskFile {
    /// Most people. Default 2.
    pub max_people: usize,
    /// Distance of the chest from the radar, m. Default [0.25, 0.9].
    pub distance_m: [f64; 2],
    /// Most that they sit off the boresight, degrees. Default 20.
    pub off_boresight_deg: f64,
    /// Two people's chests differ at least so much in distance, m. Default 0.12.
    pub min_separation_m: f64,
    /// Two people's chests differ at most so much in distance, m: they sit side by side. Default 1.
    pub max_separation_m: f64,
    /// Level of a person's echoes over those of skin and cloth of the average body, dB: clothing, posture. Drawn for each
    /// seed. Default [0, 0].
    pub reflectivity_db: [f64; 2],
    /// How far a person's level is from that at most, dB either way. Drawn for each person. Default 0.
    pub reflectivity_scatter_db: f64,
    /// Level of the double bounce (person, radar board or desk, person) relative to the direct echo, dB. Drawn for each
    /// seed. None if absent.
    pub double_bounce_db: Option<[f64; 2]>,
    /// The double bounce comes so much later than at twice the delay, as a length of one way, m: where the board or desk stands
    /// that reflects. Drawn for each seed. Default [0, 0].
    pub double_bounce_offset_m: [f64; 2],
    /// Points of shoulders, arms and lap that scatter beside the highlights of the body's ellipsoids. Default 0, at most 32.
    pub body_points: usize,
    /// Radar cross-section of each such point level with the chest, dBsm. Drawn for each point. Default [-28, -14].
    pub body_point_dbsm: [f64; 2],
    /// Loss of such a point for each metre that it lies behind the chest's nearest place, dB. Drawn for each person.
    /// Default [70, 130].
    pub body_point_decay_db_per_m: [f64; 2],
    /// Detour of such a point's echo by several scatterings between body, clothes and seat, as a length of one way, m; its loss
    /// by `body_point_decay_db_per_m` counts from it too. Drawn for each point. Default [0, 0].
    pub body_point_detour_m: [f64; 2],
    /// Receiver noise over that of the receiver file, dB. Drawn for each seed. Default [0, 0].
    pub noise_db: [f64; 2],
    /// Factor on the receiver file's jitter of leakage. Drawn for each seed, evenly in its logarithm. Default [1, 1].
    pub leakage_jitter_factor: [f64; 2],
    /// Probability that a person moves a little rather than sits still. Default 0.5.
    pub fidget_probability: f64,
    /// Probability that static objects stand on the desk. Default 0.5.
    pub objects_probability: f64,
    /// Body height, m. Default [1.55, 1.92].
    pub height_m: [f64; 2],
}

impl Default for VisitsFile {
    fn default() -> Self {
        VisitsFile {
            max_people: 2,
            first_absence_s: [1.5, 5.0],
            absence_s: [2.5, 6.0],
            speed_m_per_s: [0.9, 1.7],
            height_m: [1.55, 1.92],
            lateral_m: [0.2, 0.55],
            turn_probability: 0.25,
            pause_probability: 0.25,
            pause_s: [0.8, 2.5],
            sit_probability: 0.0,
            sit_s: [8.0, 25.0],
            pace_probability: 0.0,
            pace_legs: [3.0, 8.0],
            pace_area_m: None,
            pace_margin_m: None,
            pace_off_boresight_deg: None,
            pace_range_m: None,
            passer_by_probability: 0.0,
            passer_by_level_db: [-25.0, -10.0],
        }
    }
}

impl Default for DeskFile {
    fn default() -> Self {
        DeskFile {
            max_people: 2,
            distance_m: [0.25, 0.9],
            off_boresight_deg: 20.0,
            min_separation_m: 0.12,
            max_separation_m: 1.0,
            reflectivity_db: [0.0, 0.0],
            reflectivity_scatter_db: 0.0,
            double_bounce_db: None,
            double_bounce_offset_m: [0.0, 0.0],
            body_points: 0,
            body_point_dbsm: [-28.0, -14.0],
            body_point_decay_db_per_m: [70.0, 130.0],
            body_point_detour_m: [0.0, 0.0],
            noise_db: [0.0, 0.0],
            leakage_jitter_factor: [1.0, 1.0],
            fidget_probability: 0.5,
            objects_probability: 0.5,
            height_m: [1.55, 1.92],
        }
    }
}

fn two() -> u32 {
    2
}
fn one() -> u32 {
    1
}
fn thirty_two() -> u32 {
    32
}

fn three() -> u32 {
    3
}
fn six() -> usize {
    6
}
fn tenth() -> f64 {
    0.1
}
fn fiftieth() -> f64 {
    0.02
}
fn half() -> f64 {
    0.5
}
fn ones() -> [f64; 2] {
    [1.0, 1.0]
}
fn seat_height() -> f64 {
    0.45
}
fn door_width() -> f64 {
    0.9
}
