//! From frames to labels while they happen: `FrameSource -> Frame -> Rdm -> Occupancy`.

pub mod classify;
pub mod occupancy;
pub mod pipeline;
pub mod view;
