//! People: bodies of thirteen ellipsoids or with a skin, gait, small motions and scripts. Actors and captured steps can
//! come from files.

pub mod body;
pub mod bvh;
pub mod clip;
mod collada;
mod cycle;
pub mod gait;
mod gltf;
pub mod imported;
pub mod motion;
pub(crate) mod motion_state;
pub(crate) mod person;
pub mod postures;
mod refine;
mod rig;
pub(crate) mod route;
pub mod skin;
pub mod track;
pub mod walking_mesh;
pub(crate) mod wander;

pub use cycle::FootSliding;
