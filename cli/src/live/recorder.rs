//! Frames and what is said about them into one recording, on a thread of its own that loses nothing.

use std::collections::VecDeque;
use std::path::Path;
use std::thread::JoinHandle;
use std::time::Duration;

use anyhow::{anyhow, bail};
use crossbeam::channel::{Receiver, RecvTimeoutError, Sender, TrySendError, bounded};
use radome_driver::{FrameResult, Recorder, RecorderOptions, RecordingHeader, RecordingSummary};
use radome_dsp::Gap;

use super::classify::{Probabilities, Summary};
use super::health::Health;
use super::pipeline::{Delivery, Inlet, Item};
use super::sink::{Moment, Sink};

/// Answers that may wait for the recorder: more than there are frames on their way to it.
const WAITING_RESULTS: usize = 1024;
/// A source that is silent for this long may never come back: what it said is made safe.
const SILENCE: Duration = Duration::from_millis(500);

/// What is recorded of a moment.
pub fn frame_result(moment: &Moment) -> FrameResult {
    let Moment { answer, frame, .. } = moment;
    FrameResult {
        sequence: answer.sequence,
        time_ns: frame.time_ns,
        host_time_ns: frame.host_time_ns,
        label: answer.label,
        probabilities: answer.probabilities.map(Probabilities::values),
        frame_probabilities: answer.frame_probabilities.map(Probabilities::values),
        occupied: answer.occupied,
        people: answer.people as u8,
        latency_ns: (answer.latency_ms * 1e6) as u64,
    }
}

/// Hands answers to the recorder's thread, which has frames and gaps from the pipeline.
pub struct RecorderSink {
    results: Option<Sender<FrameResult>>,
    thread: Option<JoinHandle<anyhow::Result<RecordingSummary>>>,
    file: String,
}

impl RecorderSink {
    /// Creates the file and starts the thread. The header must name a judge.
    pub fn start(
        path: &Path,
        header: &RecordingHeader,
        options: &RecorderOptions,
        inlet: Inlet,
    ) -> anyhow::Result<Self> {
        let recorder = Recorder::with_options(path, header, options)?;
        let (results, receiver) = bounded(WAITING_RESULTS);
        let mut writer = Writer { recorder, ahead: VecDeque::new(), newest: None };
        let thread = std::thread::spawn(move || {
            let outcome = writer.run(&inlet.receiver, &receiver);
            // What has been captured is made whole whatever ended it.
            let summary = writer.recorder.finish()?;
            outcome.map(|()| summary)
        });
        Ok(RecorderSink { results: Some(results), thread: Some(thread), file: path.display().to_string() })
    }

    fn join(&mut self) -> anyhow::Result<RecordingSummary> {
        self.results.take();
        let Some(thread) = self.thread.take() else { bail!("the recorder of {} has ended", self.file) };
        thread.join().map_err(|_| anyhow!("the recorder of {} has panicked", self.file))?
    }
}

impl Sink for RecorderSink {
    fn answer(&mut self, moment: &Moment) -> anyhow::Result<()> {
        let Some(results) = &self.results else { return Ok(()) };
        match results.try_send(frame_result(moment)) {
            Ok(()) => Ok(()),
            // It has gone: its own error says why.
            Err(TrySendError::Disconnected(_)) => match self.join() {
                Err(error) => Err(error),
                Ok(_) => bail!("the recorder of {} has ended too early", self.file),
            },
            Err(TrySendError::Full(_)) => bail!(
                "the recorder of {} is {WAITING_RESULTS} answers behind; stopped, because it must not lose any\n\nhint: write to a \
                 faster disk",
                self.file
            ),
        }
    }

    fn gap(&mut self, _gap: &Gap, _health: &Health) -> anyhow::Result<()> {
        // The pipeline brings it the gaps that are the recording's; what only the classifier missed is there.
        Ok(())
    }

    fn end(&mut self, _summary: &Summary) -> anyhow::Result<()> {
        if self.thread.is_none() {
            return Ok(());
        }
        let summary = self.join()?;
        eprintln!(
            "{}: {} frames, {} judged, {} lost, {} MiB",
            self.file,
            summary.frames,
            summary.results,
            summary.frames_lost,
            summary.bytes >> 20
        );
        Ok(())
    }
}

struct Writer {
    recorder: Recorder,
    /// Answers to frames that are still in the queue.
    ahead: VecDeque<FrameResult>,
    newest: Option<u64>,
}

impl Writer {
    /// Until nobody answers any more, and all that had been taken from the source by then is written.
    fn run(&mut self, frames: &Receiver<Delivery>, results: &Receiver<FrameResult>) -> anyhow::Result<()> {
        let mut is_unflushed = false;
        let mut has_ended = false;
        loop {
            let delivery = if has_ended {
                match results.recv() {
                    Ok(result) => self.ahead.push_back(result),
                    Err(_) => break,
                }
                None
            } else {
                crossbeam::select! {
                    recv(results) -> result => match result {
                        Ok(result) => {
                            self.ahead.push_back(result);
                            None
                        }
                        Err(_) => break,
                    },
                    recv(frames) -> delivery => Some(delivery.map_err(|_| RecvTimeoutError::Disconnected)),
                    default(SILENCE) => Some(Err(RecvTimeoutError::Timeout)),
                }
            };
            match delivery {
                None => {}
                Some(Ok(delivery)) => {
                    has_ended = self.take(delivery)?;
                    is_unflushed = true;
                }
                Some(Err(RecvTimeoutError::Timeout)) if std::mem::take(&mut is_unflushed) => self.recorder.flush()?,
                Some(Err(RecvTimeoutError::Timeout)) => {}
                Some(Err(RecvTimeoutError::Disconnected)) => has_ended = true,
            }
            self.write_results()?;
        }
        for delivery in frames.try_iter() {
            self.take(delivery)?;
        }
        self.newest = Some(u64::MAX);
        self.write_results()
    }

    /// Writes an item; `true` if it is the last.
    fn take(&mut self, delivery: Delivery) -> anyhow::Result<bool> {
        match delivery.item {
            Item::Frame(frame) => {
                self.recorder.frame(&frame)?;
                self.newest = Some(frame.sequence);
            }
            Item::Gap(gap) => self.recorder.gap(&gap)?,
            // The classifier hears of it and ends the run.
            Item::End(_) => return Ok(true),
        }
        Ok(false)
    }

    /// Writes the answers to frames that are written.
    fn write_results(&mut self) -> anyhow::Result<()> {
        while let Some(result) = self.ahead.front()
            && self.newest.is_some_and(|newest| result.sequence <= newest)
        {
            self.recorder.result(result)?;
            self.ahead.pop_front();
        }
        Ok(())
    }
}
