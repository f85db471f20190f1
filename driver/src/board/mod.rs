//! Boards: a Radar Baseboard MCU7 ([`Mcu7Board`]) on its serial port or its USB endpoints, a PSoC 6 kit with DEEPCRAFT
//! firmware ([`DeepcraftBoard`]), and an ESP32 that prints its frames ([`Esp32Stream`]).

mod deepcraft;
mod detect;
mod error;
mod esp32;
mod host;
mod identity;
mod mcu7;
mod read_deadline;
mod reconnect;

pub use deepcraft::{DeepcraftBoard, DeepcraftStream};
pub(crate) use detect::identity_on;
pub use detect::{Detected, StartedBoard};
pub use error::{BoardError, DeepcraftError};
pub use esp32::Esp32Stream;
pub use identity::BoardIdentity;
pub use mcu7::{Mcu7Board, Mcu7Stream};
pub use reconnect::{Outage, Reconnect};
