//! Radar Baseboard MCU7.

mod assembler;
mod board;
mod handshake;
mod link;
mod stream;

pub use board::Mcu7Board;
pub use stream::Mcu7Stream;
