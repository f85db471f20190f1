//! Options of emulated boards.

use std::path::PathBuf;
use std::time::Duration;

use super::faults::Fault;

/// Pace of the emulation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Pace {
    /// Follows the source's time stamps, this many times as fast.
    RealTime(f64),
    /// Sends as fast as the host reads: the back-pressure of the pseudo-terminal sets the pace, and nothing overflows.
    AsFastAsRead,
}

/// Kind of the emulated board, which decides its protocol.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Kind {
    /// Radar Baseboard MCU7 with protocol 4.
    #[default]
    Mcu7V4,
    /// Radar Baseboard MCU7 with protocol 3.
    Mcu7V3,
    /// Radar Baseboard MCU7 with protocol 4 over control and bulk transfers.
    Mcu7Bulk,
    /// PSoC 6 kit with DEEPCRAFT firmware, set to the waveform of the source.
    Deepcraft,
    /// ESP32 that prints its frames.
    Esp32,
}

/// Options of the emulated board.
#[derive(Debug, Clone)]
pub struct EmulatorOptions {
    /// Pace of the frames.
    pub pace: Pace,
    /// Kind of the board.
    pub kind: Kind,
    /// Faults to inject.
    pub faults: Vec<Fault>,
    /// Delay of a request to the firmware over the serial port: no answer comes sooner after the request's last byte.
    /// Frames are not delayed. A board on USB needs about the default, 1.5 ms; the vendor's library loses answers that
    /// come within a fraction of that. Control transfers are not delayed, because their host waits for the answers.
    pub latency: Duration,
    /// Whether a source that ends is opened again, if it [can be](super::Feed::reopenable). Counters and time go on.
    pub repeat: bool,
    /// Seed of the random properties of the board: its temperature.
    pub seed: u64,
    /// Symbolic link to the pseudo-terminal. It is made anew each time the board is plugged in, since the terminal then
    /// has another name. For [`Kind::Mcu7Bulk`] the folder of the board's endpoints, which is created. Only one
    /// emulated board can have it.
    pub link: Option<PathBuf>,
    /// Terminal to serve on instead of a pseudo-terminal: the board's end of an existing line, such as `/dev/ttyGS0` of
    /// a USB gadget. A hang-up counts as unplugging.
    pub terminal: Option<PathBuf>,
}

impl Default for EmulatorOptions {
    fn default() -> Self {
        EmulatorOptions {
            pace: Pace::RealTime(1.0),
            kind: Kind::default(),
            faults: Vec::new(),
            latency: Duration::from_micros(1500),
            repeat: false,
            seed: 1,
            link: None,
            terminal: None,
        }
    }
}
