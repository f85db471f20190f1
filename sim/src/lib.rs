//! Chirp frames from physics: scenes, people, fields, receiver.

pub mod field;
pub mod random;
pub mod receiver;
pub mod scene;
