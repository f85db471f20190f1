//! Chirp frames from physics: scenes, people, fields, receiver.

pub mod receiver;
