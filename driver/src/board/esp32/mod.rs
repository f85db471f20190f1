//! Board with an ESP32 that prints its frames as lines ([`crate::protocol::ascii`]). It takes no requests and measures
//! the waveform that it was built for. The user has to name that waveform unless the firmware states it.

mod resequencer;
mod stream;

pub use stream::Esp32Stream;
