//! Running emulated board.

use std::io::ErrorKind;
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use super::deepcraft::Deepcraft;
use super::error::EmulatorError;
use super::esp32::Esp32;
use super::feed::Feed;
use super::mcu7::Mcu7;
use super::options::{EmulatorOptions, Kind, Pace};
use super::port::{self, HostLine};
use super::shared::{EmulatorCounts, Shared};
use super::wire::{Firmware, Wire};
use crate::protocol::mcu7::{Framing, Protocol};
use crate::transport::{Address, UsbAddress};

/// Running emulated board. It ends with [`EmulatedBoard::stop`] or when dropped.
///
/// ```no_run
/// use std::path::Path;
///
/// use radome_driver::recording::Recording;
/// use radome_driver::{EmulatedBoard, EmulatorOptions, Mcu7Board};
/// use radome_dsp::{Frame, FrameSource};
///
/// # fn main() -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
/// let source = Box::new(Recording::open(Path::new("night.mcap"))?);
/// let waveform = source.waveform().clone();
/// let board = EmulatedBoard::spawn(source, EmulatorOptions::default())?;
/// let mut stream = Mcu7Board::open(board.address())?.start(&waveform)?;
/// let mut frame = Frame::zeroed(waveform.shape());
/// stream.next_frame(&mut frame)?;
/// # Ok(())
/// # }
/// ```
pub struct EmulatedBoard {
    path: PathBuf,
    address: Address,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
    /// Claim on the link, which excludes other emulated boards.
    claim: Option<OwnedFd>,
}

/// Creates the firmware of the emulated kind of board.
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

/// Path of a folder that no other board of this process uses.
fn unique_folder() -> PathBuf {
    static NEXT: AtomicU64 = AtomicU64::new(0);
    let next = NEXT.fetch_add(1, Ordering::Relaxed);
    std::env::temp_dir().join(format!("radome-board-{}-{next}", std::process::id()))
}

/// Line to the host that the options select.
fn host_line(options: &EmulatorOptions) -> Result<HostLine, EmulatorError> {
    match (options.kind, &options.terminal) {
        (Kind::Mcu7Bulk, Some(path)) => Err(EmulatorError::NoTerminal { path: path.clone() }),
        (Kind::Mcu7Bulk, None) => Ok(HostLine::Endpoints(options.link.clone().unwrap_or_else(unique_folder))),
        (_, Some(path)) => Ok(HostLine::Terminal(path.clone())),
        (_, None) => Ok(HostLine::Pseudoterminal { link: options.link.clone() }),
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
        let line = host_line(&options)?;
        let claim = options.link.as_deref().map(port::claim).transpose()?;
        let shared = Arc::new(Shared::default());
        let mut firmware = firmware(feed, &options, &shared)?;
        let description = line.description();
        let mut wire = Wire::new(line, &options, shared.clone()).map_err(|source| match &options.link {
            Some(link) if source.kind() == ErrorKind::AlreadyExists => EmulatorError::LinkExists { link: link.clone() },
            _ => EmulatorError::Line { what: description, source },
        })?;
        let path = wire.path().to_owned();
        let address = match options.kind {
            Kind::Mcu7Bulk => Address::Usb(UsbAddress::Emulated(path.clone())),
            _ => Address::Serial(path.clone()),
        };
        let thread = thread::Builder::new()
            .name("emulated board".into())
            .spawn(move || {
                if let Err(error) = wire.serve(firmware.as_mut()) {
                    wire.shared.fail(format!("its line failed: {error}"));
                }
                wire.shared.has_ended.store(true, Ordering::Release);
            })
            .map_err(EmulatorError::Thread)?;
        Ok(EmulatedBoard { path, address, shared, thread: Some(thread), claim })
    }

    /// Device node to open as a serial port, or folder of the endpoints.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Address for clients.
    pub fn address(&self) -> &Address {
        &self.address
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
        let has_panicked = self.is_over() && !self.shared.has_ended.load(Ordering::Acquire);
        failure.or_else(|| has_panicked.then(|| "the emulated board panicked".to_owned()))
    }

    /// Returns whether the board has stopped serving.
    pub(super) fn is_over(&self) -> bool {
        self.thread.as_ref().is_some_and(JoinHandle::is_finished)
    }

    /// Returns the counts so far.
    pub fn counts(&self) -> EmulatorCounts {
        let load = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        let Shared { packets, overflows, frames, departures, .. } = &*self.shared;
        EmulatorCounts {
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
