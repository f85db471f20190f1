//! Chirp frames from physics: scenes, people, fields, receiver.
//!
//! [`Scene::load`] reads a room, a radar, a receiver and what people do in it; a [`Simulator`] makes frames of it, as a
//! [`radome_dsp::FrameSource`] or one by one. One frame goes: [`actor`] (where are the people's thirteen ellipsoids at the key
//! times) -> [`echo`] (what each of them reflects by every audible pair of image antennas) -> [`keys`] (how many key times each path
//! takes) -> [`slow_time`] (every chirp between them) and [`tracks`] (every receiver), beside them [`diffuse`] (what walls throw about)
//! -> [`synthesis`] (paths to samples) -> [`receiver`] (leakage, noise, rounding). People who are meshes go by [`echo::skin`]
//! instead, to an error that is asked for.
//!
//! Beside it, [`rcs`] puts canonical targets before the integrators of scenes, one by one, against what is known of them.
//!
//! Conventions are those of [`radome_dsp`]. The room is the box `0..size`, x and y horizontal, z up; the radar's own axes are
//! x boresight, y left, z up. Every random draw is a function of (seed, purpose, index): frames are the same bytes in whatever
//! order and on however many threads they are made.

pub mod actor;
pub mod bounded_file;
pub mod chirp;
pub mod diffuse;
pub mod echo;
pub mod fault;
pub mod field;
pub mod geometry;
pub mod keys;
pub(crate) mod lanes;
pub mod material;
mod math;
pub mod path_list;
pub mod paths;
pub mod program;
pub mod random;
pub mod rcs;
pub mod receiver;
mod render;
pub mod scene;
pub mod scene_file;
pub mod shadow;
pub mod simulator;
pub mod slow_time;
pub mod stage;
pub mod sway;
pub mod synthesis;
pub mod trace;
pub mod tracks;

pub use receiver::Receiver;
pub use scene::{Scene, SceneError, load_receiver};
pub use simulator::{FrameReport, PersonState, SimError, SimulateOptions, Simulator};
