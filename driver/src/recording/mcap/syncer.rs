//! Brings a recording to the disk while it is made, on a thread of its own: frames do not wait for the disk.

use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use crossbeam::channel::{Receiver, RecvTimeoutError, SendTimeoutError, Sender, bounded};

use crate::recording::{RecordingError, disk};

/// A sync that takes longer is said in the log.
const SLOW: Duration = Duration::from_secs(1);

/// Limits on how far the disk lags behind a recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SyncOptions {
    /// Frames wait no longer than this for the chunk that they are written in, by their own clock.
    pub chunk: Duration,
    /// Two syncs begin at least so long after one another; a chunk waits no longer than this for the sync that it is part of.
    pub interval: Duration,
    /// A disk that needs longer for one sync ends the recording.
    pub patience: Duration,
}

impl Default for SyncOptions {
    /// Chunks of half a second, synced within a quarter: a disk that needs less than another quarter loses at most a second of
    /// frames to a power cut. One that needs ten seconds has failed.
    fn default() -> Self {
        SyncOptions {
            chunk: Duration::from_millis(500),
            interval: Duration::from_millis(250),
            patience: Duration::from_secs(10),
        }
    }
}

/// The first error of a recording: whoever asks again hears the same.
#[derive(Debug, Clone)]
pub(super) enum Failure {
    /// An input/output error.
    Io { what: &'static str, kind: io::ErrorKind, code: Option<i32>, text: String },
    /// The disk has not answered for so long.
    Stalled(Duration),
}

impl Failure {
    pub fn io(what: &'static str, source: &io::Error) -> Self {
        Failure::Io { what, kind: source.kind(), code: source.raw_os_error(), text: source.to_string() }
    }

    fn sync(source: &io::Error) -> Self {
        Failure::io("cannot be brought to the disk", source)
    }

    /// The failure as an error that names the recording.
    pub fn error(&self, path: &Path) -> RecordingError {
        let path = path.to_owned();
        match self {
            Failure::Io { what, kind, code, text } => {
                let source = match code {
                    Some(code) => io::Error::from_raw_os_error(*code),
                    None => io::Error::new(*kind, text.clone()),
                };
                RecordingError::Io { path, what, source }
            }
            Failure::Stalled(waited) => RecordingError::Stalled { path, waited_s: waited.as_secs_f64() },
        }
    }
}

/// Hands requests to the thread.
#[derive(Debug)]
pub(super) struct Syncer {
    /// Requests; one that carries a sender is answered when its sync is done.
    requests: Sender<Option<Sender<()>>>,
    /// The first error; success once nobody asks any more.
    outcome: Receiver<io::Result<()>>,
    /// When the sync in progress began.
    since: Arc<Mutex<Option<Instant>>>,
    patience: Duration,
}

impl Syncer {
    /// Starts the thread.
    pub fn start(file: File, path: PathBuf, options: SyncOptions) -> io::Result<Self> {
        let (requests, receiver) = bounded(1);
        let (sender, outcome) = bounded(1);
        let since = Arc::new(Mutex::new(None));
        let work = Work { file, path, requests: receiver, since: since.clone(), interval: options.interval };
        std::thread::Builder::new().name("sync".into()).spawn(move || {
            let _ = sender.send(work.run());
        })?;
        Ok(Syncer { requests, outcome, since, patience: options.patience })
    }

    /// Asks that all that is written by now be brought to the disk. Waits for nobody.
    pub fn request(&self) {
        // One that waits already will do.
        let _ = self.requests.try_send(None);
    }

    /// Checks whether a sync has failed or hangs.
    pub fn check(&self) -> Result<(), Failure> {
        if let Ok(Err(source)) = self.outcome.try_recv() {
            return Err(Failure::sync(&source));
        }
        let since = *self.since.lock().unwrap_or_else(PoisonError::into_inner);
        match since.map(|since| since.elapsed()).filter(|waited| *waited > self.patience) {
            Some(waited) => Err(Failure::Stalled(waited)),
            None => Ok(()),
        }
    }

    /// Brings all that is written to the disk and waits for it. A thread that the disk does not let go is left to itself.
    pub fn wait(&self) -> Result<(), Failure> {
        let (done, is_done) = bounded(1);
        match self.requests.send_timeout(Some(done), self.patience) {
            Ok(()) => {}
            Err(SendTimeoutError::Timeout(_)) => return Err(Failure::Stalled(self.patience)),
            Err(SendTimeoutError::Disconnected(_)) => return Err(self.ended()),
        }
        match is_done.recv_timeout(self.patience) {
            Ok(()) => Ok(()),
            Err(RecvTimeoutError::Timeout) => Err(Failure::Stalled(self.patience)),
            Err(RecvTimeoutError::Disconnected) => Err(self.ended()),
        }
    }

    /// Failure that ended the thread.
    fn ended(&self) -> Failure {
        match self.outcome.recv_timeout(self.patience) {
            Ok(Err(source)) => Failure::sync(&source),
            _ => Failure::sync(&io::Error::other("the thread that syncs has ended")),
        }
    }
}

struct Work {
    file: File,
    path: PathBuf,
    requests: Receiver<Option<Sender<()>>>,
    since: Arc<Mutex<Option<Instant>>>,
    interval: Duration,
}

impl Work {
    /// Serves requests until all senders have gone or a sync fails.
    fn run(&self) -> io::Result<()> {
        let mut earliest = Instant::now();
        while let Ok(first) = self.requests.recv() {
            let mut waiting: Vec<Sender<()>> = first.into_iter().collect();
            // What is asked for meanwhile is part of the same sync. Who waits does not wait for others.
            while waiting.is_empty() {
                let wait = earliest.saturating_duration_since(Instant::now());
                if wait.is_zero() {
                    break;
                }
                match self.requests.recv_timeout(wait) {
                    Ok(more) => waiting.extend(more),
                    Err(_) => break,
                }
            }
            earliest = Instant::now() + self.interval;
            self.sync()?;
            for done in waiting {
                let _ = done.send(());
            }
        }
        Ok(())
    }

    fn sync(&self) -> io::Result<()> {
        let set = |since| *self.since.lock().unwrap_or_else(PoisonError::into_inner) = since;
        let start = Instant::now();
        set(Some(start));
        let done = disk::sync(&self.file, &self.path);
        set(None);
        if start.elapsed() > SLOW {
            tracing::warn!("{}: the disk took {:.1} s to store it", self.path.display(), start.elapsed().as_secs_f64());
        }
        done
    }
}
