//! The part of a scene file that says who is there: `[people]` and its programs.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::geometry::import::{LengthUnit, UpAxis};

/// Bodies of people.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum BodyFile {
    /// Thirteen ellipsoids, each with one specular point: the fastest.
    #[default]
    Ellipsoids,
    /// One skin of about 14000 triangles over the same bones, integrated to the tolerance asked for.
    Mesh,
}

/// Model of the shadows that people throw on static echoes.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ShadowFile {
    /// One edge weakens them, without phase, at a few times of a frame: [`crate::diffraction::past`].
    #[default]
    Edge,
    /// Both sides and the top of the body diffract them, in amplitude and phase, at every chirp:
    /// [`crate::diffraction::past_strip`]. Static echoes flicker at their own ranges, with the Doppler of the diffracted wave.
    Strip,
}

/// The people of a scene and what they do: exactly one of the four programs.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PeopleFile {
    /// Bodies of people: "ellipsoids" or "mesh" (not at a desk). Default "ellipsoids".
    #[serde(default)]
    pub body: BodyFile,
    /// People with written way-points.
    #[serde(default)]
    pub actor: Vec<ActorFile>,
    /// People who come and go by chance.
    pub visits: Option<VisitsFile>,
    /// People who wander about on smooth ways, alone or with each other.
    pub wander: Option<WanderFile>,
    /// People who sit before the radar.
    pub desk: Option<DeskFile>,
    /// Fastest that anybody turns, degrees/s: wide turns are made on the spot, with steps, others in a curve. If absent, a
    /// corner takes 0.7 s however sharp it is.
    pub turn_rate_deg_per_s: Option<f64>,
    /// Distance that hips keep from furniture and walls, m: ways lead around what stands in the room, and nobody paces to places nearer
    /// to it. If absent, ways are straight but around the walls and door leaves of floor plans and files.
    pub keep_off_m: Option<f64>,
    /// Stride over the average one of such a body at such a speed. Drawn for each person. Default [1, 1].
    #[serde(default = "factors_of_one")]
    pub stride: [f64; 2],
    /// Swing of the arms over the average one. Drawn for each person. Default [1, 1].
    #[serde(default = "factors_of_one")]
    pub arm_swing: [f64; 2],
    /// Model of the shadows on static echoes: "edge" or "strip". Default "edge".
    #[serde(default)]
    pub shadow: ShadowFile,
}

/// A person with a script.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ActorFile {
    /// Time at which the script begins, s. Default 0. Before that the person waits at the first way-point.
    #[serde(default)]
    pub start_s: f64,
    /// Body height, m. Default 1.75; of an actor from a file, what the file says.
    pub height_m: Option<f64>,
    /// Source of the steps: a skinned actor with an animation of it walking (`.glb`, `.gltf`, `.dae`; only with `body = "mesh"`),
    /// or captured steps for the built-in body (`.bvh`). A path relative to the scene file. The built-in gait if absent.
    pub file: Option<String>,
    /// Name of the actor's animation. Default the only one, or the only one with "walk" in its name.
    pub animation: Option<String>,
    /// The part of the animation or clip that is one cycle of two steps, s. Found if absent.
    pub cycle_s: Option<[f64; 2]>,
    /// Unit of the actor's file: "m", "cm", "mm" or "in". Default what the format says.
    pub unit: Option<LengthUnit>,
    /// Axis of the actor's file that points up: "y" or "z". Default what the format says; y for BVH.
    pub up: Option<UpAxis>,
    /// Stride over the average one of such a body at such a speed. Default what `[people]` says.
    pub stride: Option<f64>,
    /// Swing of the arms over the average one. Default what `[people]` says.
    pub arm_swing: Option<f64>,
    /// Steps of the script, in order. The first one must be a place: `walk_to_m`, `enter_door` or `lie_s`.
    pub step: Vec<StepFile>,
}

/// One line of a script: `{ walk_to_m = [x, y], speed_m_per_s = 1.2 }`, `{ stand_s = 3 }`, `{ sit_s = 20, seat = 0 }`,
/// `{ squat_s = 4, depth_m = 0.4 }`, `{ lie_s = 30, bed = 0 }`, `{ face_deg = 90 }`, `{ enter_door = 0 }` or `{ leave_door = 0 }`.
#[derive(Debug, Clone, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct StepFile {
    /// Walk there (the first step: be there), m.
    pub walk_to_m: Option<[f64; 2]>,
    /// Speed of the walk, m/s. Default 1.2.
    pub speed_m_per_s: Option<f64>,
    /// Stand so long, s.
    pub stand_s: Option<f64>,
    /// Sit so long, s.
    pub sit_s: Option<f64>,
    /// Index of the seat. If absent, the person sits down where they stand, in the direction in which they look.
    pub seat: Option<usize>,
    /// Squat so long, going down and getting up included, s.
    pub squat_s: Option<f64>,
    /// Height by which the head is lower then, m. Default 0.45; at most 0.36 of the body's height.
    pub depth_m: Option<f64>,
    /// Go to a bed and lie down so long, getting in and out included, s. As the first step: lie there from before the beginning.
    pub lie_s: Option<f64>,
    /// Index of the bed. Default 0.
    pub bed: Option<usize>,
    /// Turn on the spot to look there, from +x towards +y, degrees.
    pub face_deg: Option<f64>,
    /// Come in by this door (index): the first step. Before `start_s` the person is not there.
    pub enter_door: Option<usize>,
    /// Go out by this door (index) and be gone: the last step.
    pub leave_door: Option<usize>,
}

/// An endless stream of visits in each of a few slots. Pairs are the least and the largest value drawn.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
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
    /// Area in which people pace: `[[x_low, y_low], [x_high, y_high]]`, m. The inner half of the room if absent.
    pub pace_area_m: Option<[[f64; 2]; 2]>,
    /// Distance from the walls that people keep where they pace, m: the rest of the room is the area, if that is absent.
    pub pace_margin_m: Option<f64>,
    /// Largest angle off the radar's boresight at which people pace, on the ground plan, degrees. Anywhere if absent.
    pub pace_off_boresight_deg: Option<f64>,
    /// Range from the radar in which people pace, on the ground plan, m. Anywhere if absent.
    pub pace_range_m: Option<[f64; 2]>,
    /// Probability that somebody walks about beyond the wall at the far end of the room (x = size), who is seen faintly and does
    /// not count. This person stands after 400 walks, which take more than twenty minutes. Drawn for each seed. Default 0.
    pub passer_by_probability: f64,
    /// Level of that person's echoes behind that wall or around it, relative to those without a wall, dB. Default [-25, -10].
    pub passer_by_level_db: [f64; 2],
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

/// Nobody, one or two people who wander about, all the time. Pairs are the least and the largest value drawn.
///
/// `turn_rate_deg_per_s` (120 if absent) and `keep_off_m` (0.35 if absent) of `[people]` hold for them, too.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct WanderFile {
    /// Most people at a time; how many there are is drawn for each seed. Default 2.
    pub max_people: usize,
    /// Mean speed while walking, m/s. Drawn for each person. Default [0.15, 1].
    pub speed_m_per_s: [f64; 2],
    /// Largest acceleration, m/s^2. Default 1.
    pub acceleration_m_per_s2: f64,
    /// Body height, m. Default [1.55, 1.92].
    pub height_m: [f64; 2],
    /// Range from the radar in which people have goals, on the ground plan, m. They never come nearer than the least. Default [0.5, 5].
    pub range_m: [f64; 2],
    /// Largest angle off the radar's boresight at which people have goals, on the ground plan, degrees. Default 40.
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
    /// Time for which two people do one thing together, s; then another is drawn. Default [20, 90].
    pub mode_s: [f64; 2],
    /// Weights of what two people do together.
    pub modes: ModesFile,
    /// Probability that somebody wanders beyond the wall at the far end of the room (x = size) all the time, who is seen faintly
    /// and does not count. Drawn for each seed. Default 0.
    pub passer_by_probability: f64,
    /// Level of that person's echoes behind that wall or around it, relative to those without a wall, dB. Default [-25, -10].
    pub passer_by_level_db: [f64; 2],
}

impl Default for WanderFile {
    fn default() -> Self {
        WanderFile {
            max_people: 2,
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
#[derive(Debug, Clone, Copy, PartialEq, Deserialize, JsonSchema)]
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
#[derive(Debug, Clone, Deserialize, JsonSchema)]
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
    /// Largest deviation of a person's level from that, dB either way. Drawn for each person. Default 0.
    pub reflectivity_scatter_db: f64,
    /// Level of the double bounce (person, radar board or desk, person) relative to the direct echo, dB. Drawn for each
    /// seed. None if absent.
    pub double_bounce_db: Option<[f64; 2]>,
    /// The double bounce comes so much later than at twice the delay, as a length of one way, m: where the board or desk stands
    /// that reflects. Drawn for each seed. Default [0, 0].
    pub double_bounce_offset_m: [f64; 2],
    /// Points of shoulders, arms and lap that scatter beside the specular points of the body's ellipsoids. Default 0, at most 32.
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

fn factors_of_one() -> [f64; 2] {
    [1.0, 1.0]
}
