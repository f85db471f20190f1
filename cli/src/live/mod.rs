//! Live pipeline: frames to labels as they arrive, `FrameSource -> Frame -> Rdm -> Occupancy`.

pub mod access;
pub mod answer;
pub mod background;
pub mod classify;
pub mod health;
pub mod http_server;
pub mod integrations;
pub mod occupancy;
pub mod pipeline;
pub mod recorder;
pub mod screen;
pub mod sink;
pub mod view;
