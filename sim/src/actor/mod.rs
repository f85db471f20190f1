//! People: thirteen ellipsoids or a skin around them, a gait, small motions, and what they do; or actors and captured steps from
//! files.

pub mod body;
pub mod bvh;
pub mod clip;
pub mod clothing;
mod collada;
mod cycle;
pub mod gait;
mod gltf;
pub mod imported;
pub mod low;
mod moment;
pub mod motion;
mod person;
pub mod program;
mod refine;
mod rig;
mod route;
pub mod skin;
pub mod track;
pub mod walking_mesh;
mod wander;

pub use cycle::FootSliding;
