//! Thread that syncs a running recording to the disk, so that frames do not wait for the disk.

use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use crossbeam::channel::{Receiver, SendTimeoutError, Sender, bounded, select};

use crate::recording::{RecordingError, disk};

/// Duration of a sync beyond which a warning is logged.
const SLOW_SYNC: Duration = Duration::from_secs(1);

/// Interval at which a wait checks the sync in progress.
const CHECK_INTERVAL: Duration = Duration::from_millis(50);

/// Limits on how far the disk lags behind a recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SyncOptions {
    /// Longest time that frames wait for their chunk to be written, by their own clock.
    pub chunk: Duration,
    /// Interval between the starts of two syncs, and longest time that a chunk waits for its sync.
    pub interval: Duration,
    /// Longest duration of a sync; a slower disk ends the recording.
    pub patience: Duration,
}

impl Default for SyncOptions {
    /// Returns options for chunks of half a second that are synced within a quarter of a second. A disk that needs less
    /// than another quarter loses at most a second of frames to a power cut. A disk that needs ten seconds counts as
    /// failed.
    fn default() -> Self {
        SyncOptions {
            chunk: Duration::from_millis(500),
            interval: Duration::from_millis(250),
            patience: Duration::from_secs(10),
        }
    }
}

/// First error of a recording, which all later calls return.
#[derive(Debug, Clone)]
pub(super) enum Failure {
    /// An input/output error.
    Io { what: &'static str, kind: io::ErrorKind, code: Option<i32>, text: String },
    /// The disk has not answered for this long.
    Stalled(Duration),
}

impl Failure {
    pub fn io(what: &'static str, source: &io::Error) -> Self {
        Failure::Io { what, kind: source.kind(), code: source.raw_os_error(), text: source.to_string() }
    }

    fn sync(source: &io::Error) -> Self {
        Failure::io("cannot be brought to the disk", source)
    }

    /// Failure of a thread that has ended with this outcome.
    fn ended(outcome: Option<io::Result<()>>) -> Self {
        match outcome {
            Some(Err(source)) => Failure::sync(&source),
            _ => Failure::sync(&io::Error::other("the thread that syncs has ended")),
        }
    }

    /// Converts the failure to an error that names the recording.
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

/// Handle of the thread.
#[derive(Debug)]
pub(super) struct Syncer {
    /// Requests; one that carries a sender is answered when its sync is done.
    requests: Sender<Option<Sender<()>>>,
    /// Result of the thread: the first error, or success after the last request.
    outcome: Receiver<io::Result<()>>,
    /// Start of the sync in progress.
    sync_start: Arc<Mutex<Option<Instant>>>,
    patience: Duration,
}

impl Syncer {
    /// Starts the thread.
    pub fn start(file: File, path: PathBuf, options: SyncOptions) -> io::Result<Self> {
        let (requests, receiver) = bounded(1);
        let (sender, outcome) = bounded(1);
        let sync_start = Arc::new(Mutex::new(None));
        let work = Work { file, path, requests: receiver, sync_start: sync_start.clone(), interval: options.interval };
        std::thread::Builder::new().name("sync".into()).spawn(move || {
            let _ = sender.send(work.run());
        })?;
        Ok(Syncer { requests, outcome, sync_start, patience: options.patience })
    }

    /// Requests a sync of all data written so far. Does not wait.
    pub fn request(&self) {
        // One request in the queue suffices.
        let _ = self.requests.try_send(None);
    }

    /// Checks whether a sync has failed or hangs.
    pub fn check(&self) -> Result<(), Failure> {
        if let Ok(Err(source)) = self.outcome.try_recv() {
            return Err(Failure::sync(&source));
        }
        let sync_start = *self.sync_start.lock().unwrap_or_else(PoisonError::into_inner);
        match sync_start.map(|sync_start| sync_start.elapsed()).filter(|waited| *waited > self.patience) {
            Some(waited) => Err(Failure::Stalled(waited)),
            None => Ok(()),
        }
    }

    /// Syncs all data written so far and waits for it, as long as no single sync exceeds the patience. A thread that the
    /// disk blocks is abandoned.
    pub fn wait(&self) -> Result<(), Failure> {
        let (answer_sender, answer) = bounded(1);
        let mut request = Some(answer_sender);
        loop {
            match self.requests.send_timeout(request, CHECK_INTERVAL) {
                Ok(()) => break,
                Err(SendTimeoutError::Timeout(unsent)) => request = unsent,
                Err(SendTimeoutError::Disconnected(_)) => return Err(self.thread_failure()),
            }
            self.check()?;
        }
        loop {
            // A thread that fails at this moment leaves the request in the queue, so its outcome is awaited, too.
            select! {
                recv(answer) -> done => return done.map_err(|_| self.thread_failure()),
                recv(self.outcome) -> outcome => return Err(Failure::ended(outcome.ok())),
                default(CHECK_INTERVAL) => self.check()?,
            }
        }
    }

    /// Failure of the thread, which has ended.
    fn thread_failure(&self) -> Failure {
        Failure::ended(self.outcome.recv_timeout(self.patience).ok())
    }
}

struct Work {
    file: File,
    path: PathBuf,
    requests: Receiver<Option<Sender<()>>>,
    sync_start: Arc<Mutex<Option<Instant>>>,
    interval: Duration,
}

impl Work {
    /// Serves requests until all senders are dropped or a sync fails.
    fn run(&self) -> io::Result<()> {
        let mut earliest = Instant::now();
        while let Ok(first) = self.requests.recv() {
            let mut waiting: Vec<Sender<()>> = first.into_iter().collect();
            // Requests that come meanwhile are part of the same sync. A request that waits for its answer ends the
            // delay.
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
            // A request that has come by now is served by this sync, too.
            waiting.extend(self.requests.try_iter().flatten());
            self.sync()?;
            for done in waiting {
                let _ = done.send(());
            }
        }
        Ok(())
    }

    fn sync(&self) -> io::Result<()> {
        let set = |sync_start| *self.sync_start.lock().unwrap_or_else(PoisonError::into_inner) = sync_start;
        let start = Instant::now();
        set(Some(start));
        let result = disk::sync(&self.file, &self.path);
        set(None);
        if start.elapsed() > SLOW_SYNC {
            tracing::warn!("{}: the disk took {:.1} s to store it", self.path.display(), start.elapsed().as_secs_f64());
        }
        result
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The request is still in the queue of a thread that has just failed.
    #[test]
    fn a_failure_during_a_wait_is_returned_at_once() {
        let ((requests, _queue), (sender, outcome)) = (bounded(1), bounded(1));
        sender.send(Err(io::Error::from_raw_os_error(5))).expect("room for one");
        let syncer = Syncer { requests, outcome, sync_start: Arc::default(), patience: Duration::from_secs(600) };
        assert!(matches!(syncer.wait(), Err(Failure::Io { code: Some(5), .. })));
    }
}
