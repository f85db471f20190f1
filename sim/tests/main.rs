//! Integration tests of the simulator, as one program, so that it is linked once.

mod actors;
mod any_geometry;
mod audible;
mod body_and_wall;
mod common;
mod hard_cases;
mod path_sampling;
mod people;
mod physics;
mod receiver;
mod references;
mod rooms;
mod scene_files;
mod side_by_side;
mod skins;
mod solver;
mod stream;
mod surfaces;
mod sway;
mod tracks;
mod transmission;
mod walls;
