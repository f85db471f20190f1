//! Radar Baseboard MCU7.

mod assembler;
mod board;
mod handshake;
mod link;
mod stream;

pub use board::Board;
pub use stream::BoardStream;
