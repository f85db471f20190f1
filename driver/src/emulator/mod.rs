//! A board on a pseudo-terminal, or behind sockets that stand for USB endpoints, measuring whatever a [`FrameSource`] provides.
//!
//! It answers what the firmware answers and sends what it sends, so that any client of the board can be pointed at
//! [`EmulatedBoard::path`] ([`Board::open_at`](crate::Board::open_at) at [`EmulatedBoard::address`]). Differences: a waveform other than the source's is refused, and so is a slice that would
//! trip a known firmware bug. Frames that the source itself lacks appear as packets lost. How much the board buffers
//! beyond the chip's FIFO is assumed from its memory (192 KiB).

mod chip;
mod deepcraft;
mod esp32;
mod faults;
mod mcu7;
mod port;
pub mod probe;
mod source;
mod watched;
mod wire;
mod world;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use radome_dsp::{FrameSource, SourceError, Waveform};
use thiserror::Error;

use crate::board::Address;
use crate::chip::ChipError;
use crate::protocol::strata::{Framing, Protocol};
use crate::usb::UsbAddress;
use deepcraft::Deepcraft;
use esp32::Esp32;
pub use faults::{Fault, FaultError};
use mcu7::Mcu7;
use port::Place;
pub use source::{EmulatedSource, EmulatedSourceError};
use watched::Watched;
use wire::{Firmware, Wire};

/// How fast the emulated world goes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Pace {
    /// By the source's time stamps, this many times as fast as they say.
    RealTime(f64),
    /// As fast as the host reads: the pseudo-terminal's back-pressure sets the pace, nothing overflows.
    AsFastAsRead,
}

/// What the emulated board is, and so what it speaks.
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

/// How the emulated board behaves.
#[derive(Debug, Clone)]
pub struct EmulatorOptions {
    /// How fast its world goes.
    pub pace: Pace,
    /// What it is.
    pub kind: Kind,
    /// What goes wrong.
    pub faults: Vec<Fault>,
    /// Symbolic link to the pseudo-terminal, to be made anew each time the board is plugged in: the terminal itself has
    /// another name then. For [`Kind::Mcu7Bulk`] the folder of its endpoints, which is made.
    pub link: Option<PathBuf>,
    /// Terminal to serve on instead of a pseudo-terminal: the board's end of a line that is there already, such as
    /// `/dev/ttyGS0` of a USB gadget. When it is hung up the board has been unplugged.
    pub terminal: Option<PathBuf>,
}

impl Default for EmulatorOptions {
    fn default() -> Self {
        EmulatorOptions {
            pace: Pace::RealTime(1.0),
            kind: Kind::default(),
            faults: Vec::new(),
            link: None,
            terminal: None,
        }
    }
}

/// The emulated board cannot be set up.
#[derive(Debug, Error)]
pub enum EmulatorError {
    /// No line to the host.
    #[error("emulator: cannot make {what}")]
    Line {
        /// What the line was to be.
        what: String,
        /// Why.
        source: std::io::Error,
    },
    /// A board with endpoints has no use for a terminal.
    #[error("emulator: a board with bulk transfers cannot be on the terminal {path}", path = path.display())]
    NoTerminal {
        /// Where it was to be.
        path: PathBuf,
    },
    /// No thread.
    #[error("emulator: cannot start a thread")]
    Thread(#[source] std::io::Error),
    /// The chip cannot be set to the waveform of the source.
    #[error(transparent)]
    Chip(#[from] ChipError),
    /// The speed makes no sense.
    #[error("emulator: speed is {speed}, it must be a positive number")]
    Speed {
        /// What was given.
        speed: f64,
    },
}

/// What the emulated board has done so far.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct EmulatorCounts {
    /// Slices sent.
    pub slices: u64,
    /// Data packets, faulty ones included.
    pub packets: u64,
    /// FIFO overflows.
    pub overflows: u64,
}

#[derive(Default)]
struct Shared {
    stop: AtomicBool,
    finished: AtomicBool,
    slices: AtomicU64,
    packets: AtomicU64,
    overflows: AtomicU64,
    refusal: Mutex<Option<String>>,
    failure: Mutex<Option<SourceError>>,
}

impl Shared {
    /// Keeps the first failure.
    fn fail(&self, error: SourceError) {
        self.failure.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
    }
}

/// A running emulated board. It ends with [`EmulatedBoard::stop`] or when dropped.
pub struct EmulatedBoard {
    path: PathBuf,
    address: Address,
    link: Option<PathBuf>,
    waveform: Waveform,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

fn firmware(
    source: Box<dyn FrameSource>,
    options: &EmulatorOptions,
    shared: &Arc<Shared>,
) -> Result<Box<dyn Firmware + Send>, EmulatorError> {
    let shared = shared.clone();
    let mcu7 = |source, protocol, framing, shared| {
        Mcu7::new(source, protocol, framing, options, shared).map_err(EmulatorError::Thread)
    };
    Ok(match options.kind {
        Kind::Mcu7V4 => Box::new(mcu7(source, Protocol::V4, Framing::Serial, shared)?),
        Kind::Mcu7V3 => Box::new(mcu7(source, Protocol::V3, Framing::Serial, shared)?),
        Kind::Mcu7Bulk => Box::new(mcu7(source, Protocol::V4, Framing::Bulk, shared)?),
        Kind::Deepcraft => Box::new(Deepcraft::new(source, options, shared)?),
        Kind::Esp32 => Box::new(Esp32::new(source, options, shared).map_err(EmulatorError::Thread)?),
    })
}

/// A folder that nothing else of this process has.
fn folder() -> PathBuf {
    static NEXT: AtomicU64 = AtomicU64::new(0);
    let next = NEXT.fetch_add(1, Ordering::Relaxed);
    std::env::temp_dir().join(format!("radome-board-{}-{next}", std::process::id()))
}

fn place(options: &EmulatorOptions) -> Result<Place, EmulatorError> {
    match (options.kind, &options.terminal) {
        (Kind::Mcu7Bulk, Some(path)) => Err(EmulatorError::NoTerminal { path: path.clone() }),
        (Kind::Mcu7Bulk, None) => Ok(Place::Endpoints(options.link.clone().unwrap_or_else(folder))),
        (_, Some(path)) => Ok(Place::Terminal(path.clone())),
        (_, None) => Ok(Place::Pseudoterminal { link: options.link.clone() }),
    }
}

impl EmulatedBoard {
    /// Opens the board's line to the host and serves it in a thread.
    pub fn spawn(source: Box<dyn FrameSource>, options: EmulatorOptions) -> Result<EmulatedBoard, EmulatorError> {
        if let Pace::RealTime(speed) = options.pace
            && !(speed > 0.0 && speed.is_finite())
        {
            return Err(EmulatorError::Speed { speed });
        }
        let waveform = source.waveform().clone();
        let place = place(&options)?;
        let shared = Arc::new(Shared::default());
        let mut firmware = firmware(Box::new(Watched::new(source, &shared)), &options, &shared)?;
        let what = place.description();
        let (link, address) = match &place {
            Place::Pseudoterminal { link } => (link.clone(), None),
            Place::Terminal(_) => (None, None),
            Place::Endpoints(folder) => (None, Some(Address::Usb(UsbAddress::Emulated(folder.clone())))),
        };
        let mut wire =
            Wire::new(place, options.faults, shared.clone()).map_err(|source| EmulatorError::Line { what, source })?;
        let path = wire.path().to_owned();
        let address = address.unwrap_or_else(|| Address::Serial(path.clone()));
        let thread = thread::Builder::new()
            .name("emulated board".into())
            .spawn(move || {
                if let Err(error) = wire.serve(firmware.as_mut()) {
                    tracing::error!(%error, "the emulated board failed");
                    wire.shared.fail(error.into());
                }
            })
            .map_err(EmulatorError::Thread)?;
        Ok(EmulatedBoard { path, address, link, waveform, shared, thread: Some(thread) })
    }

    /// Device node to open as a serial port, or folder of the endpoints.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Where a client finds it.
    pub fn address(&self) -> &Address {
        &self.address
    }

    /// Waveform of the source: the one that the board accepts.
    pub fn waveform(&self) -> &Waveform {
        &self.waveform
    }

    /// Whether the source has ended and all of it has been handed to the port.
    pub fn finished(&self) -> bool {
        self.shared.finished.load(Ordering::Acquire)
    }

    /// Whether the board is still served. It goes on after its source has ended; it does not after its line has failed.
    pub fn is_served(&self) -> bool {
        self.thread.as_ref().is_some_and(|thread| !thread.is_finished())
    }

    /// Why the source or the line of the board failed, if one did. It is given once.
    pub fn take_failure(&self) -> Option<SourceError> {
        self.shared.failure.lock().unwrap_or_else(PoisonError::into_inner).take()
    }

    /// Why the board last refused to start, if it did.
    pub fn refusal(&self) -> Option<String> {
        self.shared.refusal.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// What it has done so far.
    pub fn counts(&self) -> EmulatorCounts {
        let load = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        let Shared { slices, packets, overflows, .. } = &*self.shared;
        EmulatorCounts { slices: load(slices), packets: load(packets), overflows: load(overflows) }
    }

    /// Waits until the source has been sent to its end, or the board has stopped. It goes on answering.
    pub fn wait(&self) {
        while !self.finished() && self.is_served() {
            thread::sleep(Duration::from_millis(10));
        }
    }

    /// Ends it.
    pub fn stop(&mut self) {
        self.shared.stop.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::error!("the emulated board panicked");
        }
        // The terminal's name will be another's: nothing must lead there.
        if let Some(link) = self.link.take()
            && let Err(error) = std::fs::remove_file(&link)
        {
            tracing::warn!(%error, link = %link.display(), "the link could not be removed");
        }
    }
}

impl Drop for EmulatedBoard {
    fn drop(&mut self) {
        self.stop();
    }
}
