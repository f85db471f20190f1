use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use crossbeam::channel::RecvTimeoutError;
use radome_driver::Outage;
use radome_driver::recording::Recording;
use radome_driver::recording::mcap::{Recorder, RecorderOptions, SyncOptions};
use radome_dsp::Gap;
use serde_json::json;

use crate::exit::Completion;
use crate::live::pipeline::{End, Failure, Inlet, Item, Pipeline, Policy};
use crate::live::recorder::{FINAL_STALL_LIMIT, STALL_LIMIT, failure_message, join_unless_stalled};
use crate::live::screen;
use crate::output_file::{self, NewRecording, Overwrite};
use crate::source::{self, SourceArgs};
use crate::{labels, output};

/// `radome record`
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  \
                        radome record auto --waveform room-hqnn -o night.mcap\n  \
                        radome record serial:/dev/ttyACM0 --waveform room-hqnn --frames 600 -o recordings/\n\n\
                        Exit status: 0 if no frame is missing, 3 if frames are missing (0 with --allow-loss), 1 if the source, the disk \
                        or the program failed, or if --max-dropped is exceeded. In each case the file holds what was captured.")]
#[command(mut_arg("overwrite", |overwrite| overwrite.help("Replace the output file, at the start, if it exists")))]
pub struct Arguments {
    #[command(flatten)]
    source: SourceArgs,
    /// MCAP file to write. In a folder, the file is named by the time (UTC); {time} in a name is replaced by the time
    #[arg(short, long, value_name = "FILE.mcap")]
    output: PathBuf,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Let the operating system decide when to write frames to the disk
    #[arg(long, hide = true)]
    no_sync: bool,
    /// Fail with exit status 1 if more frames than this are lost, or an unknown number
    #[arg(long, value_name = "FRAMES")]
    max_dropped: Option<u64>,
    /// End with exit status 0 instead of 3 if frames are lost
    #[arg(long)]
    allow_loss: bool,
    /// Print one JSON object at the end
    #[arg(long)]
    json: bool,
}

/// Records every frame, or stops with an error.
///
/// # Errors
/// The source or the output cannot be opened, the recording fails, or more frames are lost than allowed.
pub fn run(arguments: &Arguments) -> anyhow::Result<Completion> {
    output::catch_interrupts()?;
    let output = NewRecording::named(&arguments.output);
    output_file::check_is_mcap(output.path())?;
    arguments.overwrite.check(output.path(), &arguments.source.inputs())?;
    let source = source::open(&arguments.source.source, &arguments.source.options()?)?;
    message!("{}", source.description);
    labels::warn_not_copied(arguments.source.input());
    warn_answers_not_copied(arguments.source.input());
    let header = source.header(None);
    let sync = (!arguments.no_sync).then(SyncOptions::default);
    let recorder_options = RecorderOptions { existing: arguments.overwrite.existing(), sync };
    let file = output.path().display().to_string();
    let recorder = output.create(&header, &recorder_options)?;
    let bar = output::progress(arguments.source.frames.or(source.frames.frame_count()).unwrap_or(0), "recording");
    let mut pipeline = Pipeline::default();
    let policy = if source.is_live { Policy::Lossless(STALL_LIMIT) } else { Policy::Wait };
    let inlet = pipeline.consumer("recorder", 64, policy);
    let reader = pipeline.start(source.frames, arguments.source.frames);
    let backlog = source.is_live.then(Backlog::default);
    let written_items = Arc::<AtomicU64>::default();
    let queue = inlet.queue.clone();
    let thread = {
        let (outage, bar, written_items) = (source.outage, bar.clone(), written_items.clone());
        std::thread::spawn(move || capture(&inlet, recorder, &outage, &bar, backlog, &written_items))
    };
    // The output may hang, so this thread watches it and checks for interrupts.
    while !(thread.is_finished() || queue.end.get().is_some() || output::interrupted()) {
        std::thread::sleep(Duration::from_millis(10));
    }
    // Items that wait when the output stalls may still be written, and the file finished.
    let has_stalled = || queue.has_stalled.load(Ordering::SeqCst);
    let capture_result =
        join_unless_stalled(thread, &written_items, || if has_stalled() { STALL_LIMIT } else { FINAL_STALL_LIMIT });
    reader.stop();
    bar.finish_and_clear();
    let (tally, end) = capture_result.with_context(|| format!("{file} is not whole"))?;
    let Tally { frames, dropped, gaps, unknown } = tally;
    let unknown_loss = screen::unknown_loss_text(unknown);
    let printed = match arguments.json {
        true => output::json_line(&json!({
            "file": file, "frames": frames, "dropped": dropped, "gaps": gaps, "gaps_of_unknown_length": unknown,
        })),
        false => output::text_line(&format!("{file}: {frames} frames, {dropped} dropped{unknown_loss}")),
    };
    end?;
    output::ignore_closed_stdout(printed)?;
    if let Some(limit) = arguments.max_dropped.filter(|limit| unknown > 0 || dropped > *limit) {
        bail!("{dropped} frames were lost{unknown_loss}, at most {limit} allowed");
    }
    if gaps > 0 && !arguments.allow_loss {
        message!("frames are missing (gaps: {gaps}); with --allow-loss this is no error");
    }
    Ok(Completion::from_loss(gaps > 0 && !arguments.allow_loss))
}

/// Names the model whose answers in a recording are not copied with its frames.
fn warn_answers_not_copied(source: &Path) {
    if let Some(judge) = Recording::open(source).ok().and_then(|recording| recording.header().judge) {
        message!(
            "the answers of {} in {} are not carried over; radome recording convert copies them",
            judge.model,
            source.display()
        );
    }
}

/// Numbers of recorded and lost frames.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct Tally {
    /// Number of frames that the recorder has taken; at the end, of those in the file.
    frames: u64,
    /// Number of frames that are known to be lost.
    dropped: u64,
    gaps: u64,
    /// Number of gaps of unknown length.
    unknown: u64,
}

/// Time for which the output has kept the reader of a board waiting. Meanwhile the chip's FIFO overflows, and the gap that follows
/// names the FIFO alone.
#[derive(Default)]
struct Backlog {
    waited: Duration,
    has_warned: bool,
}

impl Backlog {
    /// Longest wait that is not reported.
    const LONG: Duration = Duration::from_millis(500);

    /// Adds the time of a write. `is_full` is whether the queue is full behind it, so that the reader waits. Returns true once, when
    /// the wait exceeds [`Self::LONG`].
    fn is_long(&mut self, write_time: Duration, is_full: bool) -> bool {
        self.waited = if is_full { self.waited + write_time } else { Duration::ZERO };
        self.waited > Self::LONG && !std::mem::replace(&mut self.has_warned, true)
    }
}

/// Records until the source ends or fails, the disk fails, or the user stops it. `backlog` is given for a board, which does
/// not wait for the output. `written_items` counts the items that the file has taken.
///
/// The file is finished unless the disk has failed or the source has panicked: then it stays marked unfinished. A board
/// that is lost for good, or away when the user stops, leaves a gap of unknown length at the end.
fn capture(
    inlet: &Inlet,
    recorder: Recorder,
    outage: &Outage,
    bar: &indicatif::ProgressBar,
    backlog: Option<Backlog>,
    written_items: &AtomicU64,
) -> (Tally, anyhow::Result<()>) {
    let mut writer = Writer { recorder, tally: Tally::default(), next_sequence: 0, backlog };
    let outcome = writer.write_all(inlet, outage, bar, written_items);
    let Writer { mut recorder, mut tally, .. } = writer;
    // Frames that the disk has not taken are not in the file.
    let flushed = recorder.flush();
    tally.frames = recorder.frames_written();
    let end = match outcome {
        // The first error is reported; finishing the file would fail again.
        Err(error) => Err(error.context(failure_message(&recorder))),
        Ok(Some(failure)) if failure.is_panic() => Err(failure.into()),
        Ok(failure) => {
            let ended = failure_message(&recorder);
            let finished = flushed.and_then(|()| recorder.finish()).context(ended);
            match (failure, finished) {
                (None, finished) => finished.map(drop),
                (Some(failure), Ok(_)) => Err(failure.into()),
                (Some(failure), Err(error)) => {
                    message!("error: {}", output::chain(&error));
                    Err(failure.into())
                }
            }
        }
    };
    (tally, end)
}

/// Recording under way.
struct Writer {
    recorder: Recorder,
    tally: Tally,
    /// Number of the frame that should come next: behind the last frame or gap.
    next_sequence: u64,
    backlog: Option<Backlog>,
}

impl Writer {
    /// Writes all items, also those that wait when the user stops; returns the source's error, if it failed.
    fn write_all(
        &mut self,
        inlet: &Inlet,
        outage: &Outage,
        bar: &indicatif::ProgressBar,
        written_items: &AtomicU64,
    ) -> anyhow::Result<Option<Failure>> {
        let mut is_unflushed = false;
        while !output::interrupted() {
            match inlet.receiver.recv_timeout(Duration::from_millis(200)) {
                Ok(delivery) => {
                    let start = Instant::now();
                    if let Some(end) = self.write(delivery.item)? {
                        return Ok(end.err());
                    }
                    written_items.fetch_add(1, Ordering::Relaxed);
                    let backlog = self.backlog.as_mut();
                    if backlog.is_some_and(|it| it.is_long(start.elapsed(), inlet.receiver.is_full())) {
                        message!(
                            "warning: the output takes frames more slowly than they come; the board may lose some meanwhile \
                             (fifo_overflow)\n\nhint: write to a faster disk"
                        );
                    }
                    bar.set_position(self.tally.frames);
                    is_unflushed = true;
                }
                // A silent board may never come back, so its frames are flushed to the disk.
                Err(RecvTimeoutError::Timeout) if std::mem::take(&mut is_unflushed) => self.recorder.flush()?,
                Err(RecvTimeoutError::Timeout) => {}
                // The end is known even if it could not be delivered in time.
                Err(RecvTimeoutError::Disconnected) => {
                    let Some(end) = inlet.queue.end.get() else { return Err(Failure::without_result().into()) };
                    return Ok(self.write(Item::End(end.clone()))?.and_then(Result::err));
                }
            }
        }
        let waiting = inlet.receiver.len();
        for delivery in inlet.receiver.try_iter().take(waiting) {
            if let Some(end) = self.write(delivery.item)? {
                return Ok(end.err());
            }
            written_items.fetch_add(1, Ordering::Relaxed);
        }
        if let Some(missing) = outage.gap(self.next_sequence) {
            self.write_gap(&missing)?;
        }
        Ok(None)
    }

    /// Writes an item; returns the end of the stream if it is the last.
    fn write(&mut self, item: Item) -> anyhow::Result<Option<End>> {
        match item {
            Item::Frame(frame) => {
                self.recorder.frame(&frame)?;
                self.tally.frames += 1;
                self.next_sequence = frame.sequence.saturating_add(1);
            }
            Item::Gap(missing) => self.write_gap(&missing)?,
            Item::End(end) => {
                if let Some(missing) = end.as_ref().err().and_then(|failure| failure.gap(self.next_sequence)) {
                    self.write_gap(&missing)?;
                }
                return Ok(Some(end));
            }
        }
        Ok(None)
    }

    /// Writes a gap, counts it and reports it.
    fn write_gap(&mut self, gap: &Gap) -> anyhow::Result<()> {
        self.recorder.gap(gap)?;
        self.tally.gaps += 1;
        self.tally.unknown += u64::from(gap.frames == 0);
        self.tally.dropped = self.tally.dropped.saturating_add(gap.frames);
        self.next_sequence = gap.first_sequence.saturating_add(gap.frames);
        message!("{}", screen::gap_message(gap));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use radome_driver::{BoardError, McapReader, RecordingHeader};
    use radome_dsp::FrameSource;

    use super::*;
    use crate::panics::tests::{failing_after, panicking_after};

    /// Records a source; without a source, the pipeline ends at once. Returns the counts, the error, and whether the
    /// recording is marked finished.
    fn capture_source(source: Option<Box<dyn FrameSource>>) -> (Tally, Option<String>, bool) {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("run.mcap");
        let waveform = panicking_after(0).waveform().clone();
        let recorder = Recorder::create(&path, &RecordingHeader::new(waveform)).expect("a file");
        let mut pipeline = Pipeline::default();
        let inlet = pipeline.consumer("recorder", 4, Policy::Wait);
        let _reader = source.map(|source| pipeline.start(source, None));
        let (tally, end) =
            capture(&inlet, recorder, &Outage::default(), &indicatif::ProgressBar::hidden(), None, &AtomicU64::new(0));
        let is_finished = McapReader::open(&path).expect("a file that opens").is_complete();
        (tally, end.err().map(|error| output::chain(&error)), is_finished)
    }

    #[test]
    fn a_source_that_fails_leaves_a_finished_recording_and_its_error() {
        let damaged = failing_after(3, |_| "chunk 3 is damaged".into());
        let (tally, error, is_finished) = capture_source(Some(damaged));
        assert_eq!(tally, Tally { frames: 3, ..Tally::default() });
        assert_eq!((error.as_deref(), is_finished), (Some("chunk 3 is damaged"), true));
        // The number of frames that a lost board would have sent is unknown.
        let lost = failing_after(3, |_| BoardError::Stopped.into());
        let (tally, error, is_finished) = capture_source(Some(lost));
        assert_eq!(tally, Tally { frames: 3, dropped: 0, gaps: 1, unknown: 1 });
        assert!(error.is_some_and(|error| error.contains("stopped")) && is_finished);
    }

    #[test]
    fn a_source_that_panics_leaves_an_unfinished_recording_and_its_place() {
        let (tally, error, is_finished) = capture_source(Some(panicking_after(3)));
        let error = error.expect("an error");
        assert!(error.contains("panics.rs:") && error.contains("frame 3 cannot be made"), "{error}");
        assert_eq!((tally.frames, is_finished), (3, false));
    }

    /// Regression test: a disk that took no frame for ten seconds at the end left the recording unfinished.
    #[test]
    fn an_end_that_could_not_be_delivered_in_time_finishes_the_recording() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("run.mcap");
        let header = RecordingHeader::new(panicking_after(0).waveform().clone());
        let recorder = Recorder::create(&path, &header).expect("a file");
        let mut pipeline = Pipeline::default();
        let inlet = pipeline.consumer("recorder", 4, Policy::Wait);
        inlet.queue.end.set(Ok(())).expect("no end yet");
        drop(pipeline);
        let (_, end) =
            capture(&inlet, recorder, &Outage::default(), &indicatif::ProgressBar::hidden(), None, &AtomicU64::new(0));
        end.expect("an end");
        assert!(McapReader::open(&path).expect("a file that opens").is_complete());
    }

    /// A slow output made the chip's FIFO overflow, and only the FIFO was named.
    #[test]
    fn an_output_that_keeps_the_board_waiting_is_reported_once() {
        let mut backlog = Backlog::default();
        let seconds = Duration::from_secs_f64;
        assert!(!backlog.is_long(seconds(2.0), false), "nobody waits");
        assert!(!backlog.is_long(seconds(0.3), true));
        assert!(!backlog.is_long(seconds(0.0), false), "the queue was taken up");
        assert_eq!([true; 4].map(|is_full| backlog.is_long(seconds(0.3), is_full)), [false, true, false, false]);
    }

    #[test]
    fn a_source_that_ends_without_a_result_is_an_error() {
        let (_, error, is_finished) = capture_source(None);
        assert!(error.is_some_and(|error| error.contains("without a result")) && !is_finished);
    }
}
