//! Recorder of frames and answers into one recording, on a thread of its own, without losses.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow, bail};
use crossbeam::channel::{Receiver, RecvTimeoutError, Sender, TrySendError, bounded};
use radome_driver::recording::WriteReport;
use radome_driver::{FrameResult, Outage, Recorder, RecorderOptions, RecordingHeader};
use radome_dsp::Gap;

use super::answer::{Probabilities, Summary};
use super::health::Health;
use super::pipeline::{Delivery, Failure, Inlet, Item, Queue, stalled_message};
use super::screen::unknown_loss_text;
use super::sink::{ClassifiedFrame, Sink};
use crate::output;
use crate::output_file::NewRecording;
use crate::panics::Panicked;

/// Capacity of the queue of answers to the recorder, larger than the number of frames in its frame queue.
const WAITING_RESULTS: usize = 1024;
/// Time for which the recorder may take no frame.
pub const STALL_LIMIT: Duration = Duration::from_secs(5);
/// Time for which the recorder may take no item at the end. A sync may take ten seconds, and another may be under way.
pub const FINAL_STALL_LIMIT: Duration = Duration::from_secs(30);
/// Silence of a source after which written data are flushed, since no further frame may come.
const SILENCE: Duration = Duration::from_millis(500);

/// Message about a recording that failed. The hint is left out if the output is no file or was removed.
pub fn failure_message(recorder: &Recorder) -> String {
    let frames = recorder.frames_written();
    if !recorder.path().is_file() {
        return format!("the recording ended after {frames} frames");
    }
    format!(
        "the recording ended after {frames} frames and is marked unfinished\n\nhint: radome recording repair makes a finished one of \
         what the file holds"
    )
}

/// Waits for the end of a recorder's thread, which counts the items that it takes in `taken`. A thread that takes nothing for
/// longer than `stall_limit` is abandoned: the disk blocks it.
///
/// # Errors
/// The disk has taken nothing for too long, or the thread has panicked.
pub fn join_unless_stalled<T>(
    thread: JoinHandle<T>,
    taken: &AtomicU64,
    stall_limit: impl Fn() -> Duration,
) -> anyhow::Result<T> {
    let (mut since, mut last) = (Instant::now(), 0);
    while !thread.is_finished() {
        let now = taken.load(Ordering::Relaxed);
        if std::mem::replace(&mut last, now) != now {
            since = Instant::now();
        }
        let stall_limit = stall_limit();
        if since.elapsed() > stall_limit {
            bail!(stalled_message("recorder", stall_limit.max(STALL_LIMIT)));
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    thread.join().map_err(|payload| Panicked::new(payload.as_ref()).into())
}

/// Converts an answer for the recording.
pub fn frame_result(classified: &ClassifiedFrame) -> FrameResult {
    let ClassifiedFrame { answer, frame, .. } = classified;
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

/// Sink that passes answers to the recorder's thread, which receives frames and gaps from the pipeline.
///
/// If the recorder fails, for example on a full disk or on one that hangs, the error is printed on stderr at once and
/// the file stays marked unfinished. The run continues without it, since occupancy needs no disk, and fails with that
/// error when it ends.
pub struct RecorderSink {
    results: Option<Sender<FrameResult>>,
    thread: Option<JoinHandle<anyhow::Result<Recorded>>>,
    /// Error of a recorder that ended before the run.
    failure: Option<anyhow::Error>,
    /// Number of items that the recorder has taken.
    taken_items: Arc<AtomicU64>,
    has_gaps: Arc<AtomicBool>,
    /// Set once the recorder has failed, for the page.
    has_failed: Arc<AtomicBool>,
    /// Queue from the pipeline, which may have abandoned the recorder.
    queue: Arc<Queue>,
    file: String,
}

/// Result of a recorder that ended without an error of its own.
enum Recorded {
    Finished(WriteReport),
    /// The source panicked after this number of frames.
    Unfinished(u64),
}

impl RecorderSink {
    /// Creates the file and starts the thread. The header must name a classifier. If the run is stopped in an outage of
    /// the board, the recording ends with a gap of unknown length. `has_failed` is set when the recorder fails.
    ///
    /// # Errors
    /// The file cannot be made, or the thread cannot be started.
    pub fn start(
        output: NewRecording,
        header: &RecordingHeader,
        options: &RecorderOptions,
        inlet: Inlet,
        outage: Outage,
        has_failed: Arc<AtomicBool>,
    ) -> anyhow::Result<Self> {
        let file = output.path().display().to_string();
        let recorder = output.create(header, options)?;
        let (results, receiver) = bounded(WAITING_RESULTS);
        let (has_gaps, taken_items) = (Arc::<AtomicBool>::default(), Arc::<AtomicU64>::default());
        let queue = inlet.queue.clone();
        let mut writer = Writer {
            recorder,
            waiting_results: VecDeque::new(),
            newest_written: None,
            next_sequence: 0,
            taken_items: taken_items.clone(),
            has_gaps: has_gaps.clone(),
            outage,
        };
        let thread = std::thread::spawn(move || -> anyhow::Result<Recorded> {
            // After an error the file stays marked unfinished. Finishing it would fail again and hide the cause.
            let written = writer.run(&inlet, &receiver);
            let is_abandoned = inlet.queue.is_abandoned.load(Ordering::SeqCst);
            // Only flushed frames are in the file, so the count below comes after the flush.
            let flushed = writer.recorder.flush().map_err(anyhow::Error::from);
            let frames = writer.recorder.frames_written();
            written
                .and_then(|()| if is_abandoned { bail!(stalled_message("recorder", STALL_LIMIT)) } else { flushed })
                .with_context(|| failure_message(&writer.recorder))?;
            Ok(match inlet.queue.end.get() {
                Some(Err(failure)) if failure.is_panic() => Recorded::Unfinished(frames),
                // A recording that its source or its user ended is complete.
                _ => Recorded::Finished(writer.recorder.finish()?),
            })
        });
        let (results, thread) = (Some(results), Some(thread));
        Ok(RecorderSink { results, thread, failure: None, taken_items, has_gaps, has_failed, queue, file })
    }

    /// Returns the flag that is set when frames are missing in the recording.
    pub fn has_gaps(&self) -> Arc<AtomicBool> {
        self.has_gaps.clone()
    }

    /// Waits for the end of the thread. One that the disk blocks is abandoned.
    fn join(&mut self) -> anyhow::Result<Recorded> {
        self.results.take();
        let Some(thread) = self.thread.take() else { bail!("the recorder has ended") };
        // An abandoned recorder has already taken nothing for the permitted time.
        let is_abandoned = || self.queue.is_abandoned.load(Ordering::SeqCst);
        join_unless_stalled(
            thread,
            &self.taken_items,
            || if is_abandoned() { Duration::ZERO } else { FINAL_STALL_LIMIT },
        )
        .and_then(|recorded| recorded)
        .with_context(|| format!("{} is not whole", self.file))
    }
}

impl Sink for RecorderSink {
    fn answer(&mut self, classified: &ClassifiedFrame) -> anyhow::Result<()> {
        let Some(results) = &self.results else { return Ok(()) };
        let sent = match self.queue.is_abandoned.load(Ordering::SeqCst) {
            false => results.try_send(frame_result(classified)),
            true => Err(TrySendError::Disconnected(frame_result(classified))),
        };
        match sent {
            Ok(()) => Ok(()),
            // The recorder has ended, and its own error gives the cause, or its disk hangs.
            Err(TrySendError::Disconnected(_)) => {
                self.has_failed.store(true, Ordering::Relaxed);
                let joined = self.join();
                let failure = joined.err().unwrap_or_else(|| anyhow!("the recorder of {} has ended", self.file));
                message!("error: {}", output::chain(&failure));
                message!("{} is marked unfinished; the run goes on without recording", self.file);
                self.failure = Some(failure);
                Ok(())
            }
            Err(TrySendError::Full(_)) => bail!(
                "the recorder of {} is {WAITING_RESULTS} answers behind; stopped, because it must not lose any\n\nhint: write to a \
                 faster disk",
                self.file
            ),
        }
    }

    fn gap(&mut self, _gap: &Gap, _health: &Health) -> anyhow::Result<()> {
        // The pipeline delivers the gaps of the recording. Frames that only the classifier missed are in the recording.
        Ok(())
    }

    fn end(&mut self, _summary: &Summary) -> anyhow::Result<()> {
        if let Some(failure) = self.failure.take() {
            return Err(failure);
        }
        if self.thread.is_none() {
            return Ok(());
        }
        match self.join()? {
            Recorded::Finished(report) => message!("{}: {}", self.file, report_text(&report)),
            Recorded::Unfinished(frames) => {
                message!("{}: {frames} frames, marked unfinished because the source failed", self.file);
            }
        }
        Ok(())
    }
}

/// Describes the content of a recording.
fn report_text(report: &WriteReport) -> String {
    let WriteReport { frames, results, frames_lost, unknown_gaps, bytes, .. } = report;
    let unknown_loss = unknown_loss_text(*unknown_gaps);
    format!("{frames} frames, {results} judged, {frames_lost} lost{unknown_loss}, {} MiB", bytes >> 20)
}

struct Writer {
    recorder: Recorder,
    /// Answers to frames that are still in the queue.
    waiting_results: VecDeque<FrameResult>,
    /// Number of the newest frame that is written.
    newest_written: Option<u64>,
    /// Number of the frame that should come next: behind the last frame or gap.
    next_sequence: u64,
    taken_items: Arc<AtomicU64>,
    has_gaps: Arc<AtomicBool>,
    outage: Outage,
}

impl Writer {
    /// Writes until no more answers can come; then writes the remaining frames.
    fn run(&mut self, inlet: &Inlet, results: &Receiver<FrameResult>) -> anyhow::Result<()> {
        let frames = &inlet.receiver;
        let mut is_unflushed = false;
        let mut has_ended = false;
        loop {
            let delivery = if has_ended {
                match results.recv() {
                    Ok(result) => self.waiting_results.push_back(result),
                    Err(_) => break,
                }
                None
            } else {
                crossbeam::select! {
                    recv(results) -> result => match result {
                        Ok(result) => {
                            self.waiting_results.push_back(result);
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
                    has_ended = self.write_item(delivery)?;
                    is_unflushed = true;
                }
                Some(Err(RecvTimeoutError::Timeout)) if std::mem::take(&mut is_unflushed) => self.recorder.flush()?,
                Some(Err(RecvTimeoutError::Timeout)) => {}
                // The result of the stream is known even if it could not be delivered in time.
                Some(Err(RecvTimeoutError::Disconnected)) => match inlet.queue.end.get() {
                    Some(_) => has_ended = true,
                    None => return Err(Failure::without_result().into()),
                },
            }
            self.write_results()?;
        }
        for delivery in frames.try_iter() {
            self.write_item(delivery)?;
        }
        let first_sequence = self.next_sequence;
        let missing = match inlet.queue.end.get() {
            Some(end) => end.as_ref().err().and_then(|failure| failure.gap(first_sequence)),
            None => self.outage.gap(first_sequence),
        };
        if let Some(gap) = missing {
            self.write_gap(&gap)?;
        }
        self.newest_written = Some(u64::MAX);
        self.write_results()
    }

    /// Writes an item; `true` if it is the last.
    fn write_item(&mut self, delivery: Delivery) -> anyhow::Result<bool> {
        self.taken_items.fetch_add(1, Ordering::Relaxed);
        match delivery.item {
            Item::Frame(frame) => {
                self.recorder.frame(&frame)?;
                self.newest_written = Some(frame.sequence);
                self.next_sequence = frame.sequence.saturating_add(1);
            }
            Item::Gap(gap) => self.write_gap(&gap)?,
            // The classifier receives the same item and ends the run.
            Item::End(_) => return Ok(true),
        }
        Ok(false)
    }

    fn write_gap(&mut self, gap: &Gap) -> anyhow::Result<()> {
        self.has_gaps.store(true, Ordering::Relaxed);
        self.next_sequence = gap.first_sequence.saturating_add(gap.frames);
        Ok(self.recorder.gap(gap)?)
    }

    /// Writes the answers to frames that are written. The number of waiting answers is limited, in case a source
    /// restarts its numbering. An answer may then precede its frame.
    fn write_results(&mut self) -> anyhow::Result<()> {
        while let Some(result) = self.waiting_results.front()
            && (self.waiting_results.len() > WAITING_RESULTS
                || self.newest_written.is_some_and(|newest| result.sequence <= newest))
        {
            self.recorder.result(result)?;
            self.waiting_results.pop_front();
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;
    use std::sync::mpsc::channel;

    use radome_driver::recording::mcap::RESULTS_VERSION;
    use radome_driver::{BoardError, Judge, McapReader};
    use radome_dsp::{Frame, FrameSource, GapReason, SourceEvent, Waveform, source_from_fn};

    use super::*;
    use crate::live::pipeline::{Pipeline, Policy};
    use crate::panics::tests::{failing_after, panicking_after};

    fn sink(path: &Path, waveform: &Waveform, inlet: Inlet) -> RecorderSink {
        let header = RecordingHeader::new(waveform.clone());
        let (output, options) = (NewRecording::named(path), RecorderOptions::default());
        RecorderSink::start(output, &header, &options, inlet, Outage::default(), Arc::default()).expect("a recorder")
    }

    /// Records a source until it ends.
    fn record(source: Box<dyn FrameSource>, path: &Path) -> (anyhow::Result<Recorded>, bool) {
        let mut pipeline = Pipeline::default();
        let classifier = pipeline.consumer("classifier", 64, Policy::Wait);
        let inlet = pipeline.consumer("recorder", 64, Policy::Wait);
        let mut sink = sink(path, source.waveform(), inlet);
        let _reader = pipeline.start(source, None);
        while !matches!(classifier.receiver.recv().expect("an end").item, Item::End(_)) {}
        let joined = sink.join();
        (joined, sink.has_gaps().load(Ordering::Relaxed))
    }

    /// Reads a recording: whether it is marked finished, its frames and its gaps.
    fn read(path: &Path) -> (bool, Vec<u64>, Vec<Gap>) {
        let mut reader = McapReader::open(path).expect("opens");
        let mut frame = Frame::zeroed(reader.waveform().shape());
        let (mut frames, mut gaps) = (Vec::new(), Vec::new());
        loop {
            match reader.next_frame(&mut frame).expect("readable") {
                SourceEvent::Frame => frames.push(frame.sequence),
                SourceEvent::Gap(gap) => gaps.push(gap),
                SourceEvent::End => return (reader.is_complete(), frames, gaps),
            }
        }
    }

    /// Regression test: `record` waited forever for an output that blocked.
    #[test]
    fn a_thread_that_takes_nothing_is_abandoned_and_a_slow_one_is_not() {
        let taken = Arc::<AtomicU64>::default();
        let (release, hang) = channel::<()>();
        let hanging = std::thread::spawn(move || hang.recv());
        let error = join_unless_stalled(hanging, &taken, || Duration::from_millis(20)).err().expect("it hangs");
        assert!(error.to_string().contains("has not taken a frame"), "{error}");
        drop(release);
        let counter = taken.clone();
        let slow = std::thread::spawn(move || {
            for _ in 0..10 {
                std::thread::sleep(Duration::from_millis(5));
                counter.fetch_add(1, Ordering::Relaxed);
            }
            7
        });
        assert_eq!(join_unless_stalled(slow, &taken, || Duration::from_secs(60)).expect("it ends"), 7);
    }

    #[test]
    fn answers_to_frames_that_never_come_do_not_pile_up() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("night.mcap");
        let judge = Judge {
            version: RESULTS_VERSION,
            model: "a".into(),
            model_hash: "b".into(),
            on_delay_s: 0.5,
            off_delay_s: 3.0,
            max_range_m: None,
        };
        let waveform = panicking_after(0).waveform().clone();
        let header = RecordingHeader { judge: Some(judge), ..RecordingHeader::new(waveform) };
        let recorder = Recorder::create(&path, &header).expect("creates");
        let (taken_items, has_gaps, outage) = Default::default();
        // The frames are numbered anew, so no frame has the number of an answer.
        let (waiting_results, newest_written, next_sequence) = (VecDeque::new(), Some(0), 1);
        let mut writer =
            Writer { recorder, waiting_results, newest_written, next_sequence, taken_items, has_gaps, outage };
        for sequence in 1..=2 * WAITING_RESULTS as u64 {
            writer.waiting_results.push_back(FrameResult { sequence, ..FrameResult::default() });
            writer.write_results().expect("writes");
            assert!(writer.waiting_results.len() <= WAITING_RESULTS);
        }
        writer.newest_written = Some(u64::MAX);
        writer.write_results().expect("writes");
        let summary = writer.recorder.finish().expect("finishes");
        assert_eq!(summary.results, 2 * WAITING_RESULTS as u64);
    }

    #[test]
    fn a_panicking_source_leaves_a_recording_that_opens_and_is_marked_unfinished() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("night.mcap");
        let (recorded, _) = record(panicking_after(3), &path);
        assert!(matches!(recorded.expect("no error of its own"), Recorded::Unfinished(3)));
        assert_eq!(read(&path), (false, vec![0, 1, 2], vec![]));
    }

    #[test]
    fn a_board_that_is_lost_leaves_a_finished_recording_that_says_so() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("night.mcap");
        let (recorded, has_gaps) = record(failing_after(3, |_| BoardError::Stopped.into()), &path);
        let Ok(Recorded::Finished(summary)) = &recorded else { panic!("no summary") };
        let lost = "3 frames, 0 judged, 0 lost, and an unknown number (gaps of unknown length: 1), ";
        assert!(report_text(summary).starts_with(lost), "{}", report_text(summary));
        let expected = Gap { first_sequence: 3, frames: 0, reason: GapReason::Disconnected };
        assert_eq!((read(&path), has_gaps), ((true, vec![0, 1, 2], vec![expected]), true));
    }

    /// Regression test: the gap at the end began behind the last frame, within the gap before it.
    #[test]
    fn a_gap_at_the_end_begins_behind_the_gap_before_it() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("night.mcap");
        let lost = Gap { first_sequence: 3, frames: 5, reason: GapReason::Crc };
        // Three frames and a gap; then the board is lost.
        let (mut board, mut has_gap) = (failing_after(3, |_| BoardError::Stopped.into()), false);
        let source = source_from_fn(board.waveform().clone(), move |frame| match board.next_frame(frame) {
            Err(_) if !std::mem::replace(&mut has_gap, true) => Ok(SourceEvent::Gap(lost)),
            event => event,
        });
        record(Box::new(source), &path).0.expect("no error of its own");
        let expected = Gap { first_sequence: 8, frames: 0, reason: GapReason::Disconnected };
        assert_eq!(read(&path), (true, vec![0, 1, 2], vec![lost, expected]));
    }

    #[test]
    fn a_source_that_ends_without_a_result_is_an_error_and_leaves_the_recording_unfinished() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("night.mcap");
        let mut pipeline = Pipeline::default();
        let inlet = pipeline.consumer("recorder", 64, Policy::Wait);
        drop(pipeline);
        let mut sink = sink(&path, panicking_after(0).waveform(), inlet);
        let start = Instant::now();
        while !sink.thread.as_ref().is_some_and(JoinHandle::is_finished) {
            assert!(start.elapsed() < Duration::from_secs(60), "the recorder waits for a source that has ended");
            std::thread::sleep(Duration::from_millis(5));
        }
        let error = sink.join().err().expect("an error");
        assert!(output::chain(&error).contains("without a result"), "{error:#}");
        assert!(!read(&path).0);
    }
}
