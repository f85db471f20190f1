//! Sources of frames: a thread reads ahead, and Python takes the frames from a queue.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use pyo3::exceptions::PyTimeoutError;
use pyo3::prelude::*;
use radome_driver::{BoardIdentity, LabelSpan};
use radome_dsp::{FrameSource, Gap, SourceEvent};

use crate::error::{Failure, Outcome, detached, from_python, lock, to_exception, to_python};
use crate::fork::CreatorProcess;
use crate::frame::Frame;
use crate::opened::{self, Opened, Options};
use crate::waveform::Waveform;

/// Longest wait between two checks of signals in Python.
const POLL_INTERVAL: Duration = Duration::from_millis(50);
/// Number of frames of a file that are read ahead of Python.
const FILE_QUEUE_FRAMES: usize = 4;
/// Number of frames of a board that are read ahead of Python. Boards do not wait.
const BOARD_QUEUE_FRAMES: usize = 64;
/// Longest time that closing or dropping a source waits for its thread.
const MAX_STOP_WAIT: Duration = Duration::from_secs(1);

/// Item that the reading thread sends.
enum Item {
    Frame(Box<radome_dsp::Frame>),
    Gap(Gap),
    End,
    Failed(Failure),
}

/// Result of waiting once for an item.
enum Polled {
    Item(Item),
    Nothing,
    Ended,
}

/// Properties of a source that are known once it is open.
struct Header {
    waveform: Arc<radome_dsp::Waveform>,
    description: String,
    is_live: bool,
    board: Option<BoardIdentity>,
    labels: Vec<LabelSpan>,
    frame_count: Option<u64>,
}

/// Header of an open source, and the receiving end of its items.
type Start = (Header, Receiver<Item>);

/// Reading thread and its items.
struct Reader {
    items: Option<Receiver<Item>>,
    thread: Option<JoinHandle<()>>,
    is_live: bool,
    has_ended: bool,
    creator: CreatorProcess,
}

impl Reader {
    fn poll(&mut self, timeout: Duration) -> Polled {
        let Some(items) = self.items.as_ref().filter(|_| !self.has_ended) else { return Polled::Ended };
        match items.recv_timeout(timeout) {
            Ok(item) => {
                self.has_ended = matches!(item, Item::End | Item::Failed(_));
                Polled::Item(item)
            }
            Err(RecvTimeoutError::Timeout) => Polled::Nothing,
            Err(RecvTimeoutError::Disconnected) => {
                self.has_ended = true;
                Polled::Item(Item::Failed("the thread that reads the source panicked".into()))
            }
        }
    }
}

impl Drop for Reader {
    fn drop(&mut self) {
        let (items, thread) = (self.items.take(), self.thread.take());
        if !self.creator.is_current() {
            // The thread is in another process, and so is the holder of the channel's locks.
            std::mem::forget((items, thread));
            return;
        }
        drop(items);
        let start_time = Instant::now();
        while self.is_live && thread.as_ref().is_some_and(|t| !t.is_finished()) && start_time.elapsed() < MAX_STOP_WAIT
        {
            thread::sleep(Duration::from_millis(5));
        }
    }
}

/// Reads a source until it ends or the receiver is dropped.
fn read(mut source: Box<dyn FrameSource>, items: &SyncSender<Item>) {
    let shape = source.waveform().shape();
    loop {
        let mut frame = radome_dsp::Frame::zeroed(shape);
        let event = catch_unwind(AssertUnwindSafe(|| source.next_frame(&mut frame)));
        let item = match event {
            Ok(Ok(SourceEvent::Frame)) => Item::Frame(Box::new(frame)),
            Ok(Ok(SourceEvent::Gap(gap))) => Item::Gap(gap),
            Ok(Ok(SourceEvent::End)) => Item::End,
            Ok(Err(failure)) => Item::Failed(failure),
            Err(_) => Item::Failed("the source panicked".into()),
        };
        let is_last = matches!(item, Item::End | Item::Failed(_));
        if items.send(item).is_err() || is_last {
            return;
        }
    }
}

/// Opens a source, sends its header, and reads it.
fn open_and_read(spec: &str, options: &Options, start: &SyncSender<Outcome<Start>>) {
    let Opened { frames, is_live, description, board, labels } = match opened::open(spec, options) {
        Ok(opened) => opened,
        Err(failure) => {
            // If the receiver has been dropped, the error is not needed.
            let _ = start.send(Err(failure));
            return;
        }
    };
    let (sender, items) = sync_channel(if is_live { BOARD_QUEUE_FRAMES } else { FILE_QUEUE_FRAMES });
    let (waveform, frame_count) = (Arc::new(frames.waveform().clone()), frames.frame_count());
    let header = Header { waveform, description, is_live, board, labels, frame_count };
    if start.send(Ok((header, items))).is_ok() {
        read(frames, &sender);
    }
}

/// Opened source of frames.
#[pyclass(frozen, module = "radome._radome")]
pub struct Source {
    reader: Mutex<Option<Reader>>,
    header: Header,
    creator: CreatorProcess,
}

impl Source {
    fn poll(&self, timeout: Duration) -> Outcome<Polled> {
        self.creator.check("the source")?;
        match lock(&self.reader).as_mut() {
            Some(reader) => Ok(reader.poll(timeout)),
            None => Err("the source is closed".into()),
        }
    }
}

/// Waits until the source is open or cannot be opened; Ctrl-C ends the wait.
fn wait_for_start(py: Python<'_>, start: &Mutex<Receiver<Outcome<Start>>>) -> PyResult<Start> {
    loop {
        let started = detached(py, || match lock(start).recv_timeout(POLL_INTERVAL) {
            Ok(started) => started.map(Some),
            Err(RecvTimeoutError::Timeout) => Ok(None),
            Err(RecvTimeoutError::Disconnected) => Err("opening the source panicked".into()),
        })?;
        match started {
            Some(start) => return Ok(start),
            None => py.check_signals()?,
        }
    }
}

#[pymethods]
impl Source {
    /// Opens a SOURCE. `options` is a dict with the keys of `radome.open`.
    #[staticmethod]
    #[pyo3(signature = (spec, waveform, options))]
    fn open(
        py: Python<'_>,
        spec: String,
        waveform: Option<&Bound<'_, Waveform>>,
        options: &Bound<'_, PyAny>,
    ) -> PyResult<Self> {
        let mut options: Options = from_python("open", options)?;
        options.waveform = waveform.map(|waveform| radome_dsp::Waveform::clone(&waveform.get().0));
        let (sender, receiver) = sync_channel(1);
        let thread = thread::Builder::new().name("radome-source".to_owned());
        let thread = thread.spawn(move || open_and_read(&spec, &options, &sender))?;
        let (header, items) = wait_for_start(py, &Mutex::new(receiver))?;
        let (creator, is_live) = (CreatorProcess::current(), header.is_live);
        let reader = Reader { items: Some(items), thread: Some(thread), is_live, has_ended: false, creator };
        Ok(Source { reader: Mutex::new(Some(reader)), header, creator })
    }

    /// The next frame, a dict for a gap, or `None` at the end. Waits, for `timeout_s` at most; Ctrl-C ends the wait.
    #[pyo3(signature = (timeout_s=None))]
    fn next_event<'py>(&self, py: Python<'py>, timeout_s: Option<f64>) -> PyResult<Option<Bound<'py, PyAny>>> {
        let limit = timeout_s.map(Duration::try_from_secs_f64).transpose()?;
        let start_time = Instant::now();
        loop {
            let wait =
                limit.map_or(POLL_INTERVAL, |limit| limit.saturating_sub(start_time.elapsed()).min(POLL_INTERVAL));
            match detached(py, || self.poll(wait))? {
                Polled::Nothing => {
                    py.check_signals()?;
                    if limit.is_some_and(|limit| start_time.elapsed() >= limit) {
                        return Err(PyTimeoutError::new_err("no frame came within the time"));
                    }
                }
                Polled::Ended | Polled::Item(Item::End) => return Ok(None),
                Polled::Item(Item::Frame(frame)) => {
                    let frame = Frame { inner: *frame, waveform: self.header.waveform.clone() };
                    return Ok(Some(Bound::new(py, frame)?.into_any()));
                }
                Polled::Item(Item::Gap(gap)) => return to_python(py, &gap).map(Some),
                Polled::Item(Item::Failed(failure)) => return Err(to_exception(py, &*failure)),
            }
        }
    }

    /// Stops the board or lets go of the file, and waits for that for a second at most.
    fn close(&self, py: Python<'_>) -> PyResult<()> {
        if !self.creator.is_current() {
            return Ok(());
        }
        let Some(mut reader) = py.detach(|| lock(&self.reader).take()) else { return Ok(()) };
        drop(reader.items.take());
        let thread = reader.thread.take();
        let start_time = Instant::now();
        while thread.as_ref().is_some_and(|thread| !thread.is_finished()) && start_time.elapsed() < MAX_STOP_WAIT {
            py.detach(|| thread::sleep(Duration::from_millis(1)));
            py.check_signals()?;
        }
        Ok(())
    }

    /// Waveform of all frames.
    #[getter]
    fn waveform(&self) -> Waveform {
        Waveform(self.header.waveform.clone())
    }

    /// One line that says what the source is.
    #[getter]
    fn description(&self) -> &str {
        &self.header.description
    }

    /// Whether the source is a board, which does not wait for slow readers.
    #[getter]
    fn is_live(&self) -> bool {
        self.header.is_live
    }

    /// Identity of the board, a dict; `None` without one.
    #[getter]
    fn board<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        to_python(py, &self.header.board)
    }

    /// Labels of the recording, a list of dicts.
    #[getter]
    fn labels<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        to_python(py, &self.header.labels)
    }

    /// Frames in total; `None` where the source does not know.
    #[getter]
    fn frame_count(&self) -> Option<u64> {
        self.header.frame_count
    }
}
