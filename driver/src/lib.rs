//! Chirp frames from bytes: boards, protocols, recordings, the emulated board.

pub mod chip;
pub mod protocol;
#[cfg(test)]
mod testing;
