//! Chirp frames from bytes: boards, protocols, recordings, the emulated board.

pub mod board;
pub mod chip;
pub mod discover;
pub mod emulator;
pub mod protocol;
mod timing;

#[cfg(test)]
mod testing;

pub use board::{Board, BoardError, BoardIdentity, BoardStream};
pub use emulator::{EmulatedBoard, EmulatedSource, EmulatorError, EmulatorOptions, Fault, Pace};
