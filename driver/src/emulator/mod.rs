//! A board on a pseudo-terminal, or behind sockets that stand for USB endpoints, measuring whatever a
//! [`FrameSource`](radome_dsp::FrameSource) provides, or what is made for the waveform that a client programs ([`Feed`]).
//!
//! It answers what the firmware answers and sends what it sends, so that any client of the board can be pointed at
//! [`EmulatedBoard::path`] ([`Board::open_at`](crate::Board::open_at) at [`EmulatedBoard::address`]). Differences: of a waveform that the
//! source does not have no frame comes ([`EmulatedBoard::refusal`] says why), and a slice that would
//! trip a known firmware bug is refused. Frames that the source itself lacks appear as packets lost. How much the board buffers
//! beyond the chip's FIFO is assumed from its memory (192 KiB).
//!
//! On a pseudo-terminal the board learns when its last client has closed the port, or was killed: it stops, forgets half a
//! request, and throws away what nobody has read, so that the next client finds a board that waits for it.

mod chip;
mod deepcraft;
mod esp32;
mod faults;
mod feed;
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

use crate::board::Address;
use crate::chip::ChipError;
use crate::protocol::strata::{Framing, Protocol};
use crate::usb::UsbAddress;
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
    /// Delay of a request to the firmware over the serial port: no answer comes sooner after the request's last byte.
    /// Frames are not held up. A board on USB needs about the default, 1.5 ms; the vendor's library loses answers that come
    /// within a fraction of that. Control transfers, whose answers their host waits for, do not take it.
    pub latency: Duration,
    /// Whether a source that ends is begun again, where it [can be](Feed::that_begins_again). Counters and time go on.
    pub repeat: bool,
    /// Seed of what chance does to the board: its temperature.
    pub seed: u64,
    /// Symbolic link to the pseudo-terminal, to be made anew each time the board is plugged in: the terminal itself has
    /// another name then. For [`Kind::Mcu7Bulk`] the folder of its endpoints, which is made. One emulated board has it at a
    /// time.
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
            latency: LATENCY,
            repeat: false,
            seed: 1,
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
    /// The link is another board's.
    #[error(
        "emulator: another emulated board has the link {link}\n\nhint: stop that board, or give this one another link",
        link = link.display()
    )]
    LinkTaken {
        /// The link.
        link: PathBuf,
    },
    /// There is something at the link's place that no emulated board has left there.
    #[error(
        "emulator: {link} exists and is no link that an emulated board has left behind\n\nhint: remove it, or give the board another link",
        link = link.display()
    )]
    LinkExists {
        /// The link.
        link: PathBuf,
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
    /// Something that a client asks for cannot be.
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

    /// Something is wrong with the board itself; what was first counts.
    fn fail(&self, reason: String) {
        self.failure.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(reason);
    }
}

/// A running emulated board. It ends with [`EmulatedBoard::stop`] or when dropped.
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
    ///
    /// # Errors
    /// The options make no sense, the link is another's, the line cannot be had, or the chip cannot measure the source's
    /// waveform.
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

    /// Where a client finds it.
    pub fn address(&self) -> &Address {
        &self.address
    }

    /// Waveform of the source: the one that the board is left with.
    pub fn waveform(&self) -> &Waveform {
        &self.waveform
    }

    /// Whether the source has ended and all of it has been handed to the port.
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

    /// Whether it serves no longer.
    fn is_over(&self) -> bool {
        self.thread.as_ref().is_some_and(JoinHandle::is_finished)
    }

    /// What it has done so far.
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

    /// Waits until the source has been sent to its end, or the board has stopped. It goes on answering.
    pub fn wait(&self) {
        while !self.finished() && !self.is_over() {
            thread::sleep(Duration::from_millis(10));
        }
    }

    /// Ends it. A host that reads is given what is under way to the end of its slice; the link goes.
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
