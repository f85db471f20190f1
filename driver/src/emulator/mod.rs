//! Emulated board on a pseudo-terminal, or behind sockets that stand for USB endpoints. It measures the frames of a
//! [`FrameSource`](radome_dsp::FrameSource), or frames made for the waveform that a client programs ([`Feed`]).
//!
//! It answers and sends as the firmware does, so that any client of the board can open [`EmulatedBoard::path`]
//! ([`Board::open_at`](crate::Board::open_at) at [`EmulatedBoard::address`]). Differences: no frames come of a waveform
//! that the source does not have ([`EmulatedBoard::refusal`] holds the reason), and a slice that would trigger a known
//! firmware bug is refused. Frames that the source itself lacks appear as lost packets. The size of the board's buffer
//! beyond the chip's FIFO is assumed from its memory (192 KiB).
//!
//! On a pseudo-terminal the board detects that its last client has closed the port or was killed: it stops, and
//! discards half a request and unread data, so that the next client finds an idle board.

mod chip;
mod deepcraft;
mod esp32;
mod faults;
mod feed;
#[cfg(target_os = "linux")]
pub mod function_fs;
mod mcu7;
mod port;
pub mod probe;
mod source;
mod thermometer;
mod wire;
mod world;

use std::io::ErrorKind;
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use radome_dsp::Waveform;
use thiserror::Error;

use crate::chip::ChipError;
use crate::protocol::mcu7::{Framing, Protocol};
use crate::transport::Address;
use crate::transport::UsbAddress;
use deepcraft::Deepcraft;
use esp32::Esp32;
pub use faults::{Fault, FaultError};
pub use feed::Feed;
use mcu7::Mcu7;
use port::Place;
pub use source::{EmulatedSource, EmulatedSourceError};
use wire::{Firmware, Wire};

/// Round-trip time of a request to a board on USB.
const LATENCY: Duration = Duration::from_micros(1500);

/// Pace of the emulation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Pace {
    /// The source's time stamps, this many times as fast.
    RealTime(f64),
    /// As fast as the host reads: the back-pressure of the pseudo-terminal sets the pace, and nothing overflows.
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
    /// Frames are not held up. A board on USB needs about the default, 1.5 ms; the vendor's library loses answers that
    /// come within a fraction of that. Control transfers, whose answers their host waits for, do not take it.
    pub latency: Duration,
    /// Whether a source that ends is opened again, if it [can be](Feed::that_begins_again). Counters and time go on.
    pub repeat: bool,
    /// Seed of the random properties of the board: its temperature.
    pub seed: u64,
    /// Symbolic link to the pseudo-terminal, which is made anew each time the board is plugged in, since the terminal
    /// then has another name. For [`Kind::Mcu7Bulk`] the folder of its endpoints, which is created. Only one emulated
    /// board can have it.
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
            latency: LATENCY,
            repeat: false,
            seed: 1,
            link: None,
            terminal: None,
        }
    }
}

/// Error of starting an emulated board.
#[derive(Debug, Error)]
pub enum EmulatorError {
    /// The line to the host cannot be opened.
    #[error("emulator: cannot make {what}")]
    Line {
        /// Description of the line.
        what: String,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// Another emulated board has the link.
    #[error(
        "emulator: another emulated board has the link {link}\n\nhint: stop that board, or give this one another link",
        link = link.display()
    )]
    LinkTaken {
        /// The link.
        link: PathBuf,
    },
    /// The path of the link exists and is not the remains of an emulated board.
    #[error(
        "emulator: {link} exists and is no link that an emulated board has left behind\n\nhint: remove it, or give the board another link",
        link = link.display()
    )]
    LinkExists {
        /// The link.
        link: PathBuf,
    },
    /// A board with USB endpoints cannot use a terminal.
    #[error("emulator: a board with bulk transfers cannot be on the terminal {path}", path = path.display())]
    NoTerminal {
        /// Path of the terminal.
        path: PathBuf,
    },
    /// The thread cannot be started.
    #[error("emulator: cannot start a thread")]
    Thread(#[source] std::io::Error),
    /// The chip cannot hold the waveform of the source.
    #[error(transparent)]
    Chip(#[from] ChipError),
    /// The speed is not a positive number.
    #[error("emulator: speed is {speed}, it must be a positive number")]
    Speed {
        /// Speed that was given.
        speed: f64,
    },
}

/// Counts of an emulated board.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct EmulatorCounts {
    /// Slices sent.
    pub slices: u64,
    /// Data packets, faulty ones included.
    pub packets: u64,
    /// FIFO overflows.
    pub overflows: u64,
    /// Number of whole frames sent.
    pub frames: u64,
    /// Number of times the last client has closed the port or vanished.
    pub departures: u64,
}

#[derive(Default)]
struct Shared {
    stop: AtomicBool,
    dead: AtomicBool,
    finished: AtomicBool,
    slices: AtomicU64,
    packets: AtomicU64,
    overflows: AtomicU64,
    frames: AtomicU64,
    departures: AtomicU64,
    refusal: Mutex<Option<String>>,
    failure: Mutex<Option<String>>,
}

impl Shared {
    /// Sets the refusal: a client's request cannot be served.
    fn refuse(&self, reason: &str) {
        tracing::warn!("the emulated board sends no frames: {reason}");
        *self.refusal.lock().unwrap_or_else(PoisonError::into_inner) = Some(reason.to_owned());
    }

    /// Clears the refusal: the client's request can be served.
    fn accept(&self) {
        *self.refusal.lock().unwrap_or_else(PoisonError::into_inner) = None;
    }

    fn refusal(&self) -> Option<String> {
        self.refusal.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Sets the failure of the board itself; the first one counts.
    fn fail(&self, reason: String) {
        self.failure.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(reason);
    }
}

/// Running emulated board. It ends with [`EmulatedBoard::stop`] or when dropped.
pub struct EmulatedBoard {
    path: PathBuf,
    address: Address,
    waveform: Waveform,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
    /// Keeps other emulated boards from the link.
    claim: Option<OwnedFd>,
}

fn firmware(
    feed: Feed,
    options: &EmulatorOptions,
    shared: &Arc<Shared>,
) -> Result<Box<dyn Firmware + Send>, EmulatorError> {
    let shared = shared.clone();
    let mcu7 = |feed, protocol, framing, shared| {
        Mcu7::new(feed, protocol, framing, options, shared).map_err(EmulatorError::Thread)
    };
    Ok(match options.kind {
        Kind::Mcu7V4 => Box::new(mcu7(feed, Protocol::V4, Framing::Serial, shared)?),
        Kind::Mcu7V3 => Box::new(mcu7(feed, Protocol::V3, Framing::Serial, shared)?),
        Kind::Mcu7Bulk => Box::new(mcu7(feed, Protocol::V4, Framing::Bulk, shared)?),
        Kind::Deepcraft => Box::new(Deepcraft::new(feed, options, shared)?),
        Kind::Esp32 => Box::new(Esp32::new(feed, options, shared).map_err(EmulatorError::Thread)?),
    })
}

/// Path of a folder that nothing else in this process uses.
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
    ///
    /// # Errors
    /// [`EmulatorError`] if an option is invalid, another board has the link, the line cannot be opened, or the chip
    /// cannot hold the source's waveform.
    pub fn spawn(feed: impl Into<Feed>, options: EmulatorOptions) -> Result<EmulatedBoard, EmulatorError> {
        let feed = feed.into();
        if let Pace::RealTime(speed) = options.pace
            && !(speed > 0.0 && speed.is_finite())
        {
            return Err(EmulatorError::Speed { speed });
        }
        let waveform = feed.source.waveform().clone();
        let place = place(&options)?;
        let claim = options.link.as_deref().map(port::claim).transpose()?;
        let shared = Arc::new(Shared::default());
        let mut firmware = firmware(feed, &options, &shared)?;
        let what = place.description();
        let address = match &place {
            Place::Pseudoterminal { .. } | Place::Terminal(_) => None,
            Place::Endpoints(folder) => Some(Address::Usb(UsbAddress::Emulated(folder.clone()))),
        };
        let mut wire = Wire::new(place, &options, shared.clone()).map_err(|source| match &options.link {
            Some(link) if source.kind() == ErrorKind::AlreadyExists => EmulatorError::LinkExists { link: link.clone() },
            _ => EmulatorError::Line { what, source },
        })?;
        let path = wire.path().to_owned();
        let address = address.unwrap_or_else(|| Address::Serial(path.clone()));
        let thread = thread::Builder::new()
            .name("emulated board".into())
            .spawn(move || {
                if let Err(error) = wire.serve(firmware.as_mut()) {
                    wire.shared.fail(format!("its line failed: {error}"));
                }
                wire.shared.dead.store(true, Ordering::Release);
            })
            .map_err(EmulatorError::Thread)?;
        Ok(EmulatedBoard { path, address, waveform, shared, thread: Some(thread), claim })
    }

    /// Device node to open as a serial port, or folder of the endpoints.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Address for clients.
    pub fn address(&self) -> &Address {
        &self.address
    }

    /// Waveform of the source, with which the board is programmed at the start.
    pub fn waveform(&self) -> &Waveform {
        &self.waveform
    }

    /// Returns whether the source has ended and all of it has been handed to the port.
    pub fn finished(&self) -> bool {
        self.shared.finished.load(Ordering::Acquire)
    }

    /// Reason why the board sends no frames for its client's last request, if it sends none.
    pub fn refusal(&self) -> Option<String> {
        self.shared.refusal()
    }

    /// Failure of the source or of the line, if there was one. The board then sends nothing more.
    pub fn failure(&self) -> Option<String> {
        let failure = self.shared.failure.lock().unwrap_or_else(PoisonError::into_inner).clone();
        let has_panicked = self.is_over() && !self.shared.dead.load(Ordering::Acquire);
        failure.or_else(|| has_panicked.then(|| "the emulated board panicked".to_owned()))
    }

    /// Returns whether the board has stopped serving.
    fn is_over(&self) -> bool {
        self.thread.as_ref().is_some_and(JoinHandle::is_finished)
    }

    /// Returns the counts so far.
    pub fn counts(&self) -> EmulatorCounts {
        let load = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        let Shared { slices, packets, overflows, frames, departures, .. } = &*self.shared;
        EmulatorCounts {
            slices: load(slices),
            packets: load(packets),
            overflows: load(overflows),
            frames: load(frames),
            departures: load(departures),
        }
    }

    /// Waits until the source has been sent to its end, or the board has stopped. The board goes on answering.
    pub fn wait(&self) {
        while !self.finished() && !self.is_over() {
            thread::sleep(Duration::from_millis(10));
        }
    }

    /// Stops the board. A host that reads gets the rest of the current slice; the link is removed.
    pub fn stop(&mut self) {
        self.shared.stop.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::error!("the emulated board panicked");
        }
        drop(self.claim.take());
    }
}

impl Drop for EmulatedBoard {
    fn drop(&mut self) {
        self.stop();
    }
}
