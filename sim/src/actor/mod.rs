//! People: thirteen ellipsoids or a skin around them, a gait, small motions, and what they do.

pub mod body;
pub mod gait;
pub mod motion;
pub mod program;
pub mod skin;
pub mod track;
