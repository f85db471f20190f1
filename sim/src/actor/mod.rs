//! People: thirteen ellipsoids, a gait, small motions, and what they do.

pub mod body;
pub mod gait;
pub mod motion;
pub mod program;
pub mod track;
