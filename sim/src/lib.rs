//! Frames of chirps from physics: scenes, people, fields, receiver.
//!
//! [`Scene::load`] reads a room, a radar, a receiver and the people in it. A [`Simulator`] makes frames of it, as a
//! [`radome_dsp::FrameSource`] or one by one:
//!
//! ```
//! use std::path::Path;
//!
//! use radome_dsp::{Frame, FrameSource, SourceEvent};
//! use radome_sim::{Scene, SimulateOptions, Simulator};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
//! let scene = Scene::load(Path::new("../fixtures/scenes/corridor.toml"))?;
//! let options = SimulateOptions { seed: 7, frames: Some(2), ..SimulateOptions::default() };
//! let mut simulator = Simulator::new(&scene, options)?;
//!
//! let mut frame = Frame::zeroed(scene.waveform().shape());
//! let mut frames = 0;
//! while simulator.next_frame(&mut frame)? == SourceEvent::Frame {
//!     // The same frame by its index, whichever came before.
//!     assert_eq!(simulator.frame(frames).codes, frame.codes);
//!     frames += 1;
//! }
//! assert_eq!(frames, 2);
//! # Ok(())
//! # }
//! ```
//!
//! # Stages of a frame
//! Static paths are computed once for a scene and seed ([`prepared_scene`]). Then each frame has these stages:
//! 1. [`people`]: the bodies of the people at the sample times, as thirteen ellipsoids or a skin (a mesh).
//! 2. [`echo`]: the echo of each ellipsoid by every pair of image antennas by which it is not too far below the noise.
//!    [`echo::skin`]: the echo of a skin, to a requested error. [`diffuse`]: echoes that walls scatter in all directions.
//! 3. [`path_sampling`]: the sample times of each path. [`path_segment`]: interpolation to every chirp between them.
//!    [`tracks`]: paths to all receivers; weak ones become held echoes.
//! 4. [`synthesis`]: conversion of paths to ADC samples.
//! 5. [`receiver`]: leakage, noise and rounding to codes.
//!
//! [`validation`] applies the same integrators to canonical targets with known solutions.
//!
//! # Conventions
//! The conventions are those of [`radome_dsp`]. The room, or the box around it, is `0..size`, x and y horizontal, z up.
//! The radar's own axes are x boresight, y left, z up. Every random draw is a function of (seed, purpose, index).
//! Frames are therefore byte-identical in any order and on any number of threads.

pub mod chirp;
pub mod diffraction;
pub mod diffuse;
pub mod echo;
pub mod em;
pub mod file_error;
mod first_warning;
mod frame;
pub mod geometry;
pub(crate) mod lanes;
pub mod material;
mod math;
pub mod path_list;
pub mod path_sampling;
pub mod path_segment;
pub mod paths;
pub mod people;
pub mod people_list;
pub mod prepared_scene;
pub mod random;
pub mod rays;
pub mod receiver;
pub mod scenario;
pub mod scene;
pub mod scene_file;
pub mod simulator;
pub mod sway;
pub mod synthesis;
pub mod tracks;
pub mod validation;
mod weak_track;

pub use receiver::Receiver;
pub use scene::{Scene, SceneError, load_receiver};
pub use simulator::{FrameReport, PersonState, SimError, SimulateOptions, Simulator};
