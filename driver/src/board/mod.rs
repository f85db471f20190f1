//! Boards: a Radar Baseboard MCU7 ([`Board`]) on its serial port or its USB endpoints, a PSoC 6 kit with DEEPCRAFT
//! firmware ([`DeepcraftBoard`]), and an ESP32 that prints its frames ([`LineStream`]).

mod deepcraft;
mod detect;
mod error;
mod esp32;
mod identity;
mod mcu7;
mod reconnect;

pub use deepcraft::{DeepcraftBoard, DeepcraftError, DeepcraftStream};
pub use detect::Detected;
pub use error::BoardError;
pub use esp32::LineStream;
pub use identity::BoardIdentity;
pub use mcu7::{Board, BoardStream};
pub use reconnect::Reconnect;
