//! Storage of the labels that pages edit: in the recording, or in a file beside it.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::Duration;

use anyhow::{Context, bail};
use radome_driver::LabelSpan;
use radome_driver::recording::mcap::{self, LabelEditor};
use radome_driver::recording::{Recording, RecordingError};
use serde::Serialize;

use super::adaptation::Offer;
use super::cut_labels::{Cut, cut};
use super::label_set::{LabelSet, OpenLabel, Span};
use crate::labels;
use crate::panics::lock;
use crate::source::Playback;

/// Intervals at which an open label is written: beside a finished recording, and beside one that is being made. They limit the
/// loss if this program is killed.
const OPEN_LABEL_INTERVAL: Duration = Duration::from_secs(10);
const OPEN_LABEL_INTERVAL_WHILE_RECORDING: Duration = Duration::from_millis(500);
/// Time for which successive changes are collected into one write.
const COLLECTING_TIME: Duration = Duration::from_millis(300);
/// Most frames that a player may be ahead of the newest answer: those that wait for the classifier.
const MOST_WAITING: f64 = 20.0;
/// Message to pages once the recorder has failed.
const RECORDER_FAILED: &str = "the recording has failed and holds no frames from then on; export the labels";

/// Message about labels to pages.
#[derive(Serialize)]
struct LabelsMessage<'a> {
    spans: &'a [Span],
    open: Option<&'a OpenLabel>,
    can_undo: bool,
    can_redo: bool,
    /// Path of the labels, if they are stored.
    place: Option<String>,
    /// Whether the shown labels are saved.
    saved: bool,
    /// Reason why the labels are not saved.
    #[serde(skip_serializing_if = "Option::is_none")]
    fault: Option<&'a str>,
    /// The offer to adapt the model with the labels. It is absent without labels, and after the recorder has failed.
    #[serde(skip_serializing_if = "Option::is_none")]
    adaptation: Option<Offer>,
}

/// Place where labels are stored.
#[derive(Debug, Clone)]
enum Storage {
    /// In a finished recording: beside it while they change, finally in its channel of labels.
    Finished(PathBuf),
    /// In a file beside a recording that cannot hold labels.
    Beside { recording: PathBuf, file: PathBuf },
    /// In a recording that is being made: beside it until it is finished, then in its channel of labels. If its recorder fails, they
    /// stay beside it.
    BeingMade { recording: PathBuf, has_failed: Arc<AtomicBool> },
}

impl Storage {
    fn read(&self) -> anyhow::Result<Vec<LabelSpan>> {
        match self {
            Storage::Finished(recording) | Storage::Beside { recording, .. } => labels::of_recording(recording),
            Storage::BeingMade { .. } => Ok(Vec::new()),
        }
    }

    /// Writes the labels, and returns those that are then stored. Fails if the stored labels are no longer `expected`, because
    /// another process has changed them. The cost is independent of the number of writes and of the length of the recording.
    fn write(&self, expected: &[LabelSpan], spans: &[LabelSpan]) -> anyhow::Result<Vec<LabelSpan>> {
        let check = |found: &[LabelSpan]| match found == expected {
            true => Ok(()),
            false => bail!(
                "another program has changed the labels in {}\n\nhint: export yours, end this program, and add them: radome recording \
                 label {} --from EXPORT",
                self.name(),
                self.recording().display()
            ),
        };
        match self {
            Storage::BeingMade { recording, .. } => {
                mcap::stage_labels(recording, spans)?;
                return Ok(spans.to_vec());
            }
            Storage::Finished(recording) => {
                let editor = LabelEditor::open(recording)?;
                check(&editor.labels()?)?;
                if expected != spans {
                    editor.stage(spans)?;
                }
                return Ok(spans.to_vec());
            }
            Storage::Beside { recording, file } => {
                check(&self.read()?)?;
                if expected != spans {
                    labels::rewrite_beside(recording, file, |found| check(&found).map(|()| spans.to_vec()))?;
                }
            }
        }
        self.read()
    }

    /// Moves labels from beside a recording into it, once they no longer change. A recording that was not finished
    /// keeps them beside it.
    fn move_into_recording(&self) -> anyhow::Result<()> {
        let (Storage::Finished(recording) | Storage::BeingMade { recording, .. }) = self else { return Ok(()) };
        match LabelEditor::open(recording).and_then(|editor| editor.settle()) {
            Err(RecordingError::Unfinished { .. }) => Ok(()),
            moved => Ok(moved?),
        }
    }

    fn recording(&self) -> &Path {
        let (Storage::Finished(recording) | Storage::Beside { recording, .. } | Storage::BeingMade { recording, .. }) =
            self;
        recording
    }

    /// Returns whether the recorder of the recording that is being made has failed.
    fn has_recorder_failed(&self) -> bool {
        matches!(self, Storage::BeingMade { has_failed, .. } if has_failed.load(Ordering::Relaxed))
    }

    fn name(&self) -> String {
        let (Storage::Finished(path) | Storage::Beside { file: path, .. } | Storage::BeingMade { recording: path, .. }) =
            self;
        path.display().to_string()
    }
}

#[derive(Debug, Default)]
struct State {
    labels: LabelSet,
    /// Revision of the labels that is on the disk.
    saved_revision: u64,
    /// Labels as they are on the disk.
    stored: Vec<LabelSpan>,
    /// Reason why the last write failed.
    error: Option<String>,
    closed: bool,
    /// Counter that changes with the message to pages.
    version: u64,
}

/// Labels of a run, and their storage.
pub struct LabelStore {
    state: Mutex<State>,
    changed: Condvar,
    storage: Option<Storage>,
    /// Model file, as it was named.
    model: PathBuf,
    /// Greatest distance of people who count, m.
    max_range_m: Option<f64>,
    interval_s: f64,
    /// Time of the newest frame, s, as the bits of an f64.
    newest_s: AtomicU64,
}

impl LabelStore {
    /// Reads the labels of a recording. If the source is not a recording, labels go to the one that is being made, which comes with
    /// the flag that is set when its recorder has failed. `model` is the one that pages offer to adapt, to
    /// people up to `max_range_m` if that is given.
    ///
    /// # Errors
    /// The recording or its labels cannot be read.
    pub fn open(
        playback: Option<&Playback>,
        recording: Option<(&Path, Arc<AtomicBool>)>,
        model: &Path,
        max_range_m: Option<f64>,
        interval_s: f64,
    ) -> anyhow::Result<Self> {
        let being_made =
            recording.map(|(path, has_failed)| Storage::BeingMade { recording: path.to_owned(), has_failed });
        let of_playback = playback.map(|playback| -> anyhow::Result<Storage> {
            let recording = playback.path.clone();
            if Recording::open(&recording)?.format().holds_labels() {
                return Ok(Storage::Finished(recording));
            }
            let file = labels::file_beside(&recording).unwrap_or_else(|| labels::name_beside(&recording));
            Ok(Storage::Beside { recording, file })
        });
        let storage = of_playback.transpose()?.or(being_made);
        let stored = storage.as_ref().map_or(Ok(Vec::new()), Storage::read)?;
        let extent_s =
            playback.map(|playback| (playback.extent.first.time_s(), playback.extent.last.time_s() + interval_s));
        let state = State { labels: LabelSet::new(stored.clone(), extent_s), stored, ..State::default() };
        Ok(LabelStore {
            state: Mutex::new(state),
            changed: Condvar::new(),
            storage,
            model: model.to_owned(),
            max_range_m,
            interval_s,
            newest_s: AtomicU64::new(0f64.to_bits()),
        })
    }

    /// Sets the time of the newest frame, s, without waiting.
    pub fn set_newest_s(&self, time_s: f64) {
        self.newest_s.store(time_s.to_bits(), Ordering::Relaxed);
    }

    fn newest_s(&self) -> f64 {
        f64::from_bits(self.newest_s.load(Ordering::Relaxed))
    }

    /// Returns whether the newest frame is the one of this time, s, or one that still waits for its answer may be.
    pub fn is_near(&self, time_s: f64) -> bool {
        (time_s - self.newest_s()).abs() <= MOST_WAITING * self.interval_s
    }

    /// Applies a change of the labels, which is given the time of the newest frame, s.
    ///
    /// # Errors
    /// The change does not fit the labels.
    pub fn edit(&self, change: impl FnOnce(&mut LabelSet, f64) -> anyhow::Result<()>) -> anyhow::Result<()> {
        let mut state = lock(&self.state);
        change(&mut state.labels, self.newest_s())?;
        state.version += 1;
        self.changed.notify_all();
        Ok(())
    }

    /// Ends the open label at the newest frame, before the time jumps.
    pub fn end_before_jump(&self) {
        let end_s = self.newest_s() + self.interval_s;
        let mut state = lock(&self.state);
        if state.labels.end_before_jump(end_s) {
            state.version += 1;
            self.changed.notify_all();
        }
    }

    /// Returns the labels as if an open one ended at the newest frame.
    pub fn labels(&self) -> Vec<LabelSpan> {
        lock(&self.state).labels.labels(self.newest_s() + self.interval_s)
    }

    /// Counter that changes whenever [`message`](Self::message) does.
    pub fn version(&self) -> u64 {
        lock(&self.state).version + u64::from(self.has_recorder_failed())
    }

    fn has_recorder_failed(&self) -> bool {
        self.storage.as_ref().is_some_and(Storage::has_recorder_failed)
    }

    /// Returns the message about the labels to pages.
    pub fn message(&self) -> serde_json::Value {
        let state = lock(&self.state);
        let recording = self.storage.as_ref().map(Storage::recording);
        let is_running = matches!(self.storage, Some(Storage::BeingMade { .. }));
        let has_failed = self.has_recorder_failed();
        let labels: Vec<&LabelSpan> = state.labels.spans().iter().map(|span| &span.label).collect();
        let message = LabelsMessage {
            spans: state.labels.spans(),
            open: state.labels.open_label(),
            can_undo: state.labels.can_undo(),
            can_redo: state.labels.can_redo(),
            place: self.storage.as_ref().map(Storage::name),
            saved: state.saved_revision == state.labels.revision() && !has_failed,
            fault: if has_failed { Some(RECORDER_FAILED) } else { state.error.as_deref() },
            adaptation: match has_failed {
                true => None,
                false => Offer::new(&self.model, self.max_range_m, recording, is_running, &labels),
            },
        };
        serde_json::json!({ "labels": message })
    }

    /// Writes changes to the disk until closed. Successive changes are written together.
    pub fn save_until_closed(&self) {
        let Some(storage) = &self.storage else { return };
        let open_label_interval = match storage {
            Storage::BeingMade { .. } => OPEN_LABEL_INTERVAL_WHILE_RECORDING,
            Storage::Finished(_) | Storage::Beside { .. } => OPEN_LABEL_INTERVAL,
        };
        loop {
            let mut state = lock(&self.state);
            let mut has_grown = false;
            while !state.closed
                && !has_grown
                && (state.saved_revision == state.labels.revision() || state.error.is_some())
            {
                let (next_state, wait) =
                    self.changed.wait_timeout(state, open_label_interval).unwrap_or_else(PoisonError::into_inner);
                state = next_state;
                // After another change or a timeout, the write is tried again, since the error may be gone.
                state.error = None;
                has_grown = wait.timed_out() && state.labels.open_label().is_some();
            }
            let closed = state.closed;
            if !closed {
                drop(state);
                std::thread::sleep(COLLECTING_TIME);
                state = lock(&self.state);
            }
            let (revision, stored) = (state.labels.revision(), state.stored.clone());
            let is_due = state.saved_revision != revision || has_grown;
            let labels = state.labels.labels(self.newest_s() + self.interval_s);
            drop(state);
            // The disk may be slow, so no lock is held.
            let written = if is_due { storage.write(&stored, &labels) } else { Ok(stored) };
            let mut state = lock(&self.state);
            match written {
                Ok(stored) => (state.saved_revision, state.stored, state.error) = (revision, stored, None),
                Err(error) => {
                    let text = crate::output::chain(&error);
                    tracing::error!("labels: {text}");
                    state.error = Some(text);
                }
            }
            state.version += 1;
            if closed {
                return;
            }
        }
    }

    /// Ends the edits; the remaining changes go to the disk.
    pub fn close(&self) {
        self.end_before_jump();
        lock(&self.state).closed = true;
        self.changed.notify_all();
    }

    /// Writes the final labels to the recording; reports labels that could not be saved.
    ///
    /// # Errors
    /// The labels cannot be written.
    pub fn finish(&self) -> anyhow::Result<()> {
        let state = lock(&self.state);
        let revision = state.labels.revision();
        if revision == 0 {
            return Ok(());
        }
        let count = state.labels.spans().len();
        let Some(storage) = &self.storage else {
            if count > 0 {
                message!(
                    "no file holds the labels made on the page ({count}), unless they were exported\n\nhint: -o FILE.mcap keeps them"
                );
            }
            return Ok(());
        };
        if let Storage::BeingMade { recording, .. } = storage {
            // Open labels have ended by now. Others may have been made for times to which the recording did not come.
            let cut = cut(state.labels.labels(self.newest_s()), recording, self.interval_s);
            stage_cut_labels(cut, recording).with_context(|| format!("{count} labels were not saved"))?;
        } else if let Some(error) = &state.error {
            bail!("labels were not saved: {error}");
        } else if state.saved_revision != revision {
            bail!("{count} labels were not saved: the thread that saves them has ended");
        }
        storage.move_into_recording().with_context(|| format!("{count} labels are in a file beside the recording"))
    }
}

/// Stores labels beside a recording, and reports those that it has no frames for.
fn stage_cut_labels(cut: Cut, recording: &Path) -> anyhow::Result<()> {
    let Cut { labels, before, behind, without_frames } = cut;
    if without_frames > 0 {
        message!(
            "{}: unfinished, and without frames for some labels ({without_frames}), which radome recording repair leaves out",
            recording.display()
        );
    }
    mcap::stage_labels(recording, &labels)?;
    for (left_out, position) in [(before, "before the recording's start"), (behind, "behind the recording's end")] {
        if left_out > 0 {
            message!("{left_out} labels lie {position} and were left out");
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    mod hard_cases {
        use super::super::super::cut_labels::tests::recorded;
        use super::*;

        /// Regression test: pages said of such labels that they are saved, and offered a command for a recording that was never
        /// complete.
        #[test]
        fn labels_are_not_reported_as_saved_after_the_recorder_has_failed() {
            let folder = tempfile::tempdir().expect("a folder");
            let path = folder.path().join("night.mcap");
            let _recorder = recorded(&path);
            let has_failed = Arc::<AtomicBool>::default();
            let recording = Some((path.as_path(), has_failed.clone()));
            let store = LabelStore::open(None, recording, Path::new("room-hqnn"), None, 0.1).expect("opens");
            store.edit(|set, _| set.add(LabelSpan::new(0.3, 0.5, "one"))).expect("fits");
            store.close();
            store.save_until_closed();
            let (message, version) = (store.message()["labels"].clone(), store.version());
            assert!(message["saved"] == true && message["fault"].is_null(), "{message}");
            assert!(message["adaptation"]["command"].is_string(), "{message}");
            has_failed.store(true, Ordering::Relaxed);
            let message = store.message()["labels"].clone();
            assert!(message["saved"] == false && message["adaptation"].is_null(), "{message}");
            assert!(message["fault"].as_str().is_some_and(|fault| fault.contains("recording has failed")), "{message}");
            assert_ne!(store.version(), version, "pages get the message at once");
        }

        /// Regression test: labels that were saved were written once more at the end, and were said not to be saved if
        /// another program had changed them since.
        #[test]
        fn labels_that_are_saved_are_not_written_again_at_the_end() {
            let folder = tempfile::tempdir().expect("a folder");
            let path = folder.path().join("night.mcap");
            recorded(&path).finish().expect("finishes");
            let store = LabelStore::open(None, None, Path::new("cfar"), None, 0.1).expect("opens");
            let store = LabelStore { storage: Some(Storage::Finished(path.clone())), ..store };
            store.edit(|set, _| set.add(LabelSpan::new(0.3, 0.5, "one"))).expect("fits");
            store.close();
            store.save_until_closed();
            assert_eq!(labels::of_recording(&path).expect("labels").len(), 1);
            let theirs = [LabelSpan::new(0.3, 0.6, "two")];
            mcap::set_labels(&path, &theirs).expect("free");
            store.save_until_closed();
            store.finish().expect("all were saved");
            assert_eq!(labels::of_recording(&path).expect("labels"), theirs);
        }

        /// Regression test: labels of a recording that is being made could lie before its start and behind its end.
        #[test]
        fn labels_outside_a_recording_that_is_made_are_refused_or_cut() {
            let folder = tempfile::tempdir().expect("a folder");
            let path = folder.path().join("night.mcap");
            recorded(&path).finish().expect("finishes");

            let store = LabelStore::open(None, Some((path.as_path(), Arc::default())), Path::new("cfar"), None, 0.1)
                .expect("opens");
            store.set_newest_s(0.9);
            let refused = store.edit(|set, _| set.add(LabelSpan::new(-5.0, 1e6, "two"))).expect_err("before the start");
            assert!(refused.to_string().contains("no frame comes before 0 s"), "{refused}");
            for (start_s, end_s, label) in [(0.0, 0.4, "one"), (0.5, 1e6, "two"), (2.0, 3.0, "door open")] {
                store.edit(|set, _| set.add(LabelSpan::new(start_s, end_s, label))).expect("may come to be");
            }
            store.edit(|set, _| set.change(0, |label| label.start_s = -1.0)).expect_err("before the start");
            store.close();
            store.finish().expect("saved");
            let kept: Vec<_> = labels::of_recording(&path)
                .expect("labels")
                .into_iter()
                .map(|span| ((span.start_s * 1e3).round(), (span.end_s * 1e3).round(), span.label))
                .collect();
            assert_eq!(kept, [(300.0, 400.0, "one".to_owned()), (500.0, 1000.0, "two".to_owned())]);
        }
    }
}
