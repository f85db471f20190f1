//! Labels that pages make by keys during playback, and edit and undo; and their storage.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use anyhow::{Context, bail, ensure};
use radome_driver::LabelSpan;
use radome_driver::recording::mcap::{self, LabelEditor};
use radome_driver::recording::span_check::check_spans;
use radome_driver::recording::{Recording, RecordingError};
use radome_dsp::Occupancy;
use serde::Serialize;

use super::adaptation::Offer;
use super::cut_labels::{Cut, SHORTEST_S, cut};
use crate::labels;
use crate::panics::lock;
use crate::source::Playback;

/// Largest number of labels, above any number made by hand.
const MOST_SPANS: usize = 5_000;
/// Number of changes that can be undone.
const MOST_UNDO: usize = 100;
/// Intervals at which a growing label is written to the disk, and to a recording that is being made. They limit the
/// loss if this program is killed.
const GROWING_SAVED: Duration = Duration::from_secs(10);
const GROWING_RECORDED: Duration = Duration::from_millis(500);
/// Time for which successive changes are collected into one write.
const IN_A_ROW: Duration = Duration::from_millis(300);
/// Most frames that a player may be ahead of the newest answer: those that wait for the classifier.
const MOST_WAITING: f64 = 20.0;
/// Message to pages once the recorder has failed.
const RECORDER_FAILED: &str = "the recording has failed and holds no frames from then on; export the labels";

/// Label with an identifier that stays while it is edited.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Span {
    pub id: u64,
    #[serde(flatten)]
    pub label: LabelSpan,
}

/// Label that has not ended yet.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Open {
    pub start_s: f64,
    pub label: Occupancy,
    #[serde(skip)]
    who: Option<String>,
    #[serde(skip)]
    made_ns: Option<u64>,
}

/// Set of spans with undo history, changed one step at a time.
#[derive(Debug, Default)]
pub struct Book {
    spans: Vec<Span>,
    open: Option<Open>,
    next_id: u64,
    past: Vec<(Vec<Span>, Option<Open>)>,
    future: Vec<(Vec<Span>, Option<Open>)>,
    extent_s: Option<(f64, f64)>,
    /// Number of changes.
    revision: u64,
}

impl Book {
    fn new(labels: Vec<LabelSpan>, extent_s: Option<(f64, f64)>) -> Self {
        let spans: Vec<Span> = (0u64..).zip(labels).map(|(id, label)| Span { id, label }).collect();
        Book { next_id: spans.len() as u64, spans, extent_s, ..Book::default() }
    }

    /// Stores the state before a change for undo.
    fn remember(&mut self) {
        self.past.push((self.spans.clone(), self.open.clone()));
        if self.past.len() > MOST_UNDO {
            self.past.remove(0);
        }
        self.future.clear();
        self.revision += 1;
    }

    /// Starts a label from the current time on. The same label once more ends it.
    pub(super) fn press(&mut self, label: Occupancy, now_s: f64, who: Option<String>) -> anyhow::Result<()> {
        self.check_room()?;
        self.remember();
        let was = self.open.as_ref().map(|open| open.label);
        self.end_open(now_s);
        if was != Some(label) {
            self.open = Some(Open { start_s: now_s, label, who, made_ns: now_ns() });
        }
        Ok(())
    }

    /// Ends the open label, if there is one.
    pub(super) fn stop(&mut self, end_s: f64) {
        if self.open.is_some() {
            self.remember();
            self.end_open(end_s);
        }
    }

    /// Ends the open label, and those of states that can come back by undo and redo, before the time jumps; `false` if none
    /// was open. This is no change of its own for undo: a label that was open before a jump is never open behind it.
    fn end_before_jump(&mut self, end_s: f64) -> bool {
        let is_open = self.open.is_some();
        let (mut past, mut future) = (std::mem::take(&mut self.past), std::mem::take(&mut self.future));
        for (spans, open) in past.iter_mut().chain(&mut future).filter(|(_, open)| open.is_some()) {
            std::mem::swap(&mut self.spans, spans);
            std::mem::swap(&mut self.open, open);
            self.end_open(end_s);
            std::mem::swap(&mut self.spans, spans);
            std::mem::swap(&mut self.open, open);
        }
        (self.past, self.future) = (past, future);
        self.end_open(end_s);
        self.revision += u64::from(is_open);
        is_open
    }

    fn check_room(&self) -> anyhow::Result<()> {
        let count = self.spans.len();
        ensure!(count < MOST_SPANS, "there are {count} labels already, more than can be made by hand");
        Ok(())
    }

    fn end_open(&mut self, end_s: f64) {
        let Some(Open { start_s, label, who, made_ns }) = self.open.take() else { return };
        self.paint(None, LabelSpan { who, made_ns, ..LabelSpan::new(start_s, end_s, label.name()) });
    }

    /// Adds a span; others that name a class are cut where they overlap.
    fn paint(&mut self, id: Option<u64>, span: LabelSpan) {
        let (start_s, end_s) = match self.extent_s {
            Some((first_s, last_s)) => (span.start_s.max(first_s), span.end_s.min(last_s)),
            None => (span.start_s, span.end_s),
        };
        let length_s = end_s - start_s;
        if length_s.is_nan() || length_s < SHORTEST_S {
            return;
        }
        if span.occupancy().is_some() {
            for other in std::mem::take(&mut self.spans).into_iter().filter(|other| Some(other.id) != id) {
                let is_class = |label: &LabelSpan| label.occupancy().is_some();
                let rests = labels::cut_out(vec![other.label.clone()], (start_s, end_s), is_class).into_iter();
                let rests = rests.filter(|rest| *rest == other.label || rest.end_s - rest.start_s >= SHORTEST_S);
                for (index, label) in rests.enumerate() {
                    // The remainders on both sides become two labels.
                    let id = if index == 0 { other.id } else { self.new_id() };
                    self.spans.push(Span { id, label });
                }
            }
        }
        let id = id.unwrap_or_else(|| self.new_id());
        self.spans.retain(|span| span.id != id);
        self.spans.push(Span { id, label: LabelSpan { start_s, end_s, ..span } });
        self.spans.sort_by(|a, b| a.label.start_s.total_cmp(&b.label.start_s));
    }

    fn new_id(&mut self) -> u64 {
        self.next_id += 1;
        self.next_id - 1
    }

    pub(super) fn change(&mut self, id: u64, change: impl FnOnce(&mut LabelSpan)) -> anyhow::Result<()> {
        let Some(span) = self.spans.iter().find(|span| span.id == id) else {
            bail!("that label is no longer there");
        };
        let mut label = span.label.clone();
        change(&mut label);
        self.check(&label)?;
        label.made_ns = now_ns();
        self.remember();
        self.paint(Some(id), label);
        Ok(())
    }

    /// Refuses a span that is none, or lies outside the recording. Of one that is being made, only the start is known.
    fn check(&self, label: &LabelSpan) -> anyhow::Result<()> {
        let LabelSpan { start_s, end_s, .. } = label;
        if !start_s.is_finite() || !end_s.is_finite() || end_s - start_s < SHORTEST_S {
            bail!("a label from {start_s} to {end_s} s: it must end after its start");
        }
        if self.extent_s.is_none() && *start_s < 0.0 {
            bail!("a label from {start_s} to {end_s} s: no frame comes before 0 s");
        }
        Ok(check_spans(std::slice::from_ref(label), self.extent_s)?)
    }

    /// Adds a span that is made now.
    pub(super) fn add(&mut self, label: LabelSpan) -> anyhow::Result<()> {
        self.check_room()?;
        self.check(&label)?;
        self.remember();
        self.paint(None, LabelSpan { made_ns: now_ns(), ..label });
        Ok(())
    }

    pub(super) fn delete(&mut self, id: u64) -> anyhow::Result<()> {
        ensure!(self.spans.iter().any(|span| span.id == id), "that label is no longer there");
        self.remember();
        self.spans.retain(|span| span.id != id);
        Ok(())
    }

    pub(super) fn undo(&mut self) -> anyhow::Result<()> {
        let before = self.past.pop().context("nothing to take back")?;
        self.future.push((std::mem::replace(&mut self.spans, before.0), std::mem::replace(&mut self.open, before.1)));
        self.revision += 1;
        Ok(())
    }

    pub(super) fn redo(&mut self) -> anyhow::Result<()> {
        let after = self.future.pop().context("nothing was taken back")?;
        self.past.push((std::mem::replace(&mut self.spans, after.0), std::mem::replace(&mut self.open, after.1)));
        self.revision += 1;
        Ok(())
    }

    /// Returns the labels as if the open label ended now.
    fn labels(&self, now_s: f64) -> Vec<LabelSpan> {
        let mut ended = Book {
            spans: self.spans.clone(),
            open: self.open.clone(),
            next_id: self.next_id,
            extent_s: self.extent_s,
            ..Book::default()
        };
        ended.end_open(now_s);
        ended.spans.into_iter().map(|span| span.label).collect()
    }
}

fn now_ns() -> Option<u64> {
    SystemTime::now().duration_since(UNIX_EPOCH).ok().and_then(|since| u64::try_from(since.as_nanos()).ok())
}

/// Message about labels to pages.
#[derive(Serialize)]
struct Told<'a> {
    spans: &'a [Span],
    open: &'a Option<Open>,
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

/// Storage of labels.
#[derive(Debug, Clone)]
enum Place {
    /// In a finished recording: beside it while they change, finally in its channel of labels.
    Mcap(PathBuf),
    /// In a file beside a recording that cannot hold labels.
    Beside { recording: PathBuf, file: PathBuf },
    /// In a recording that is being made: beside it until it is finished, then in its channel of labels. If its recorder fails, they
    /// stay beside it.
    Made { recording: PathBuf, has_failed: Arc<AtomicBool> },
}

impl Place {
    fn read(&self) -> anyhow::Result<Vec<LabelSpan>> {
        match self {
            Place::Mcap(recording) | Place::Beside { recording, .. } => labels::of(recording),
            Place::Made { .. } => Ok(Vec::new()),
        }
    }

    /// Writes the labels, unless another process has changed those in `known`; returns the stored labels. The cost is
    /// independent of the number of writes and of the length of the recording.
    fn write(&self, known: &[LabelSpan], spans: &[LabelSpan]) -> anyhow::Result<Vec<LabelSpan>> {
        let check = |found: &[LabelSpan]| match found == known {
            true => Ok(()),
            false => bail!(
                "another program has changed the labels in {}\n\nhint: export yours, end this program, and add them: radome recording \
                 label {} --from EXPORT",
                self.name(),
                self.recording().display()
            ),
        };
        match self {
            Place::Made { recording, .. } => {
                mcap::stage_labels(recording, spans)?;
                return Ok(spans.to_vec());
            }
            Place::Mcap(recording) => {
                let editor = LabelEditor::open(recording)?;
                check(&editor.labels()?)?;
                if known != spans {
                    editor.stage(spans)?;
                }
                return Ok(spans.to_vec());
            }
            Place::Beside { recording, file } => {
                check(&self.read()?)?;
                if known != spans {
                    labels::rewrite_beside(recording, file, |found| check(&found).map(|()| spans.to_vec()))?;
                }
            }
        }
        self.read()
    }

    /// Moves labels from beside a recording into it, once they no longer change. A recording that was not finished
    /// keeps them beside it.
    fn settle(&self) -> anyhow::Result<()> {
        let (Place::Mcap(recording) | Place::Made { recording, .. }) = self else { return Ok(()) };
        match LabelEditor::open(recording).and_then(|editor| editor.settle()) {
            Err(RecordingError::Unfinished { .. }) => Ok(()),
            settled => Ok(settled?),
        }
    }

    fn recording(&self) -> &Path {
        let (Place::Mcap(recording) | Place::Beside { recording, .. } | Place::Made { recording, .. }) = self;
        recording
    }

    /// Returns whether the recorder of the recording that is being made has failed.
    fn has_failed(&self) -> bool {
        matches!(self, Place::Made { has_failed, .. } if has_failed.load(Ordering::Relaxed))
    }

    fn name(&self) -> String {
        let (Place::Mcap(path) | Place::Beside { file: path, .. } | Place::Made { recording: path, .. }) = self;
        path.display().to_string()
    }
}

#[derive(Debug, Default)]
struct State {
    book: Book,
    /// Number of changes that are on the disk.
    saved: u64,
    /// Labels as they are on the disk.
    known: Vec<LabelSpan>,
    fault: Option<String>,
    closed: bool,
    /// Number of changes to report to pages.
    told: u64,
}

/// Storage of the labels of a run.
pub struct Keeper {
    state: Mutex<State>,
    changed: Condvar,
    place: Option<Place>,
    /// Model file, as it was named.
    model: PathBuf,
    /// Greatest distance of people who count, m.
    max_range_m: Option<f64>,
    interval_s: f64,
    /// Time of the newest frame, s, as the bits of an f64.
    now_s: AtomicU64,
}

impl Keeper {
    /// Reads the labels of a recording. If the source is not a recording, labels go to the one that is being made, which comes with
    /// the flag that tells whether its recorder has failed. `model` is the one that pages offer to adapt, to
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
        let made = recording.map(|(path, has_failed)| Place::Made { recording: path.to_owned(), has_failed });
        let place = playback.map(|playback| -> anyhow::Result<Place> {
            let recording = playback.path.clone();
            if Recording::open(&recording)?.format().holds_labels() {
                return Ok(Place::Mcap(recording));
            }
            let file = labels::file_beside(&recording).unwrap_or_else(|| labels::name_beside(&recording));
            Ok(Place::Beside { recording, file })
        });
        let place = place.transpose()?.or(made);
        let known = place.as_ref().map_or(Ok(Vec::new()), Place::read)?;
        let extent_s =
            playback.map(|playback| (playback.extent.first.time_s(), playback.extent.last.time_s() + interval_s));
        let state = State { book: Book::new(known.clone(), extent_s), known, ..State::default() };
        Ok(Keeper {
            state: Mutex::new(state),
            changed: Condvar::new(),
            place,
            model: model.to_owned(),
            max_range_m,
            interval_s,
            now_s: AtomicU64::new(0f64.to_bits()),
        })
    }

    /// Sets the time of the newest frame, s, without waiting.
    pub fn at(&self, time_s: f64) {
        self.now_s.store(time_s.to_bits(), Ordering::Relaxed);
    }

    fn now_s(&self) -> f64 {
        f64::from_bits(self.now_s.load(Ordering::Relaxed))
    }

    /// Returns whether the newest frame is the one of this time, s, or one that still waits for its answer may be.
    pub fn is_near(&self, time_s: f64) -> bool {
        (time_s - self.now_s()).abs() <= MOST_WAITING * self.interval_s
    }

    /// Applies a change of the labels, which is given the time of the newest frame, s.
    ///
    /// # Errors
    /// The change does not fit the labels.
    pub fn edit(&self, change: impl FnOnce(&mut Book, f64) -> anyhow::Result<()>) -> anyhow::Result<()> {
        let mut state = lock(&self.state);
        change(&mut state.book, self.now_s())?;
        state.told += 1;
        self.changed.notify_all();
        Ok(())
    }

    /// Ends the open label at the newest frame, before the time jumps.
    pub fn before_jump(&self) {
        let end_s = self.now_s() + self.interval_s;
        let mut state = lock(&self.state);
        if state.book.end_before_jump(end_s) {
            state.told += 1;
            self.changed.notify_all();
        }
    }

    pub fn labels(&self) -> Vec<LabelSpan> {
        lock(&self.state).book.labels(self.now_s() + self.interval_s)
    }

    /// Counter that changes whenever [`told`](Self::told) does.
    pub fn told_count(&self) -> u64 {
        lock(&self.state).told + u64::from(self.has_failed())
    }

    fn has_failed(&self) -> bool {
        self.place.as_ref().is_some_and(Place::has_failed)
    }

    pub fn told(&self) -> serde_json::Value {
        let state = lock(&self.state);
        let recording = self.place.as_ref().map(Place::recording);
        let is_running = matches!(self.place, Some(Place::Made { .. }));
        let has_failed = self.has_failed();
        let labels: Vec<&LabelSpan> = state.book.spans.iter().map(|span| &span.label).collect();
        let told = Told {
            spans: &state.book.spans,
            open: &state.book.open,
            can_undo: !state.book.past.is_empty(),
            can_redo: !state.book.future.is_empty(),
            place: self.place.as_ref().map(Place::name),
            saved: state.saved == state.book.revision && !has_failed,
            fault: if has_failed { Some(RECORDER_FAILED) } else { state.fault.as_deref() },
            adaptation: match has_failed {
                true => None,
                false => Offer::new(&self.model, self.max_range_m, recording, is_running, &labels),
            },
        };
        serde_json::json!({ "labels": told })
    }

    /// Writes changes to the disk until closed. Successive changes are written together.
    pub fn keep(&self) {
        let Some(place) = &self.place else { return };
        let growing = if matches!(place, Place::Made { .. }) { GROWING_RECORDED } else { GROWING_SAVED };
        loop {
            let mut state = lock(&self.state);
            let mut has_grown = false;
            while !state.closed && !has_grown && (state.saved == state.book.revision || state.fault.is_some()) {
                let waited = self.changed.wait_timeout(state, growing).unwrap_or_else(PoisonError::into_inner);
                state = waited.0;
                // After another change or a timeout, the write is tried again, since the error may be gone.
                state.fault = None;
                has_grown = waited.1.timed_out() && state.book.open.is_some();
            }
            let closed = state.closed;
            if !closed {
                drop(state);
                std::thread::sleep(IN_A_ROW);
                state = lock(&self.state);
            }
            let (revision, known) = (state.book.revision, state.known.clone());
            let is_due = state.saved != revision || has_grown;
            let labels = state.book.labels(self.now_s() + self.interval_s);
            drop(state);
            // The disk may be slow, so no lock is held.
            let written = if is_due { place.write(&known, &labels) } else { Ok(known) };
            let mut state = lock(&self.state);
            match written {
                Ok(known) => (state.saved, state.known, state.fault) = (revision, known, None),
                Err(error) => {
                    let said = crate::output::chain(&error);
                    tracing::error!("labels: {said}");
                    state.fault = Some(said);
                }
            }
            state.told += 1;
            if closed {
                return;
            }
        }
    }

    /// Ends the edits; the remaining changes go to the disk.
    pub fn close(&self) {
        self.before_jump();
        lock(&self.state).closed = true;
        self.changed.notify_all();
    }

    /// Writes the final labels to the recording; reports labels that could not be saved.
    ///
    /// # Errors
    /// The labels cannot be written.
    pub fn last_word(&self) -> anyhow::Result<()> {
        let state = lock(&self.state);
        let count = state.book.spans.len();
        if let Some(place) = self.place.as_ref().filter(|_| state.book.revision > 0) {
            if let Place::Made { recording, .. } = place {
                // Open labels have ended by now. Others may have been made for times to which the recording did not come.
                let Cut { labels, before, behind, without_frames } =
                    cut(state.book.labels(self.now_s()), recording, self.interval_s);
                if without_frames > 0 {
                    message!(
                        "{}: unfinished, and without frames for some labels ({without_frames}), which radome recording repair leaves out",
                        recording.display()
                    );
                }
                mcap::stage_labels(recording, &labels).with_context(|| format!("{count} labels were not saved"))?;
                for (left_out, place) in
                    [(before, "before the recording's start"), (behind, "behind the recording's end")]
                {
                    if left_out > 0 {
                        message!("{left_out} labels lie {place} and were left out");
                    }
                }
            } else if let Some(fault) = &state.fault {
                bail!("labels were not saved: {fault}");
            } else if state.saved != state.book.revision {
                bail!("{count} labels were not saved: the thread that saves them has ended");
            }
            place.settle().with_context(|| format!("{count} labels are in a file beside the recording"))?;
        }
        if self.place.is_none() && state.book.revision > 0 && !state.book.spans.is_empty() {
            message!(
                "no file holds the labels made on the page ({count}), unless they were exported\n\nhint: -o FILE.mcap keeps them"
            );
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spans(book: &Book) -> Vec<(f64, f64, &str)> {
        book.spans.iter().map(|s| (s.label.start_s, s.label.end_s, s.label.label.as_str())).collect()
    }

    #[test]
    fn keys_paint_spans_and_each_can_be_taken_back() {
        let mut book = Book::new(vec![LabelSpan::new(0.0, 10.0, "empty")], Some((0.0, 20.0)));
        book.press(Occupancy::One, 2.0, None).expect("room");
        book.press(Occupancy::Two, 4.0, None).expect("room");
        // The same label again ends it.
        book.press(Occupancy::Two, 6.0, None).expect("room");
        let painted = vec![(0.0, 2.0, "empty"), (2.0, 4.0, "one"), (4.0, 6.0, "two"), (6.0, 10.0, "empty")];
        assert_eq!(spans(&book), painted);
        let ids: std::collections::BTreeSet<u64> = book.spans.iter().map(|span| span.id).collect();
        assert_eq!(ids.len(), 4, "each its own name");
        for _ in 0..3 {
            book.undo().expect("a change");
        }
        assert_eq!(spans(&book), [(0.0, 10.0, "empty")]);
        assert!(book.open.is_none() && book.undo().is_err());
        for _ in 0..3 {
            book.redo().expect("taken back");
        }
        assert_eq!(spans(&book), painted);
    }

    /// Regression test: to take a label back behind a jump opened it again, and it grew over all that was skipped.
    #[test]
    fn what_was_open_before_a_jump_is_not_open_behind_it() {
        let mut book = Book::new(Vec::new(), Some((0.0, 20.0)));
        book.press(Occupancy::One, 1.0, None).expect("room");
        book.press(Occupancy::Two, 3.0, None).expect("room");
        assert!(book.end_before_jump(4.0) && !book.end_before_jump(14.0));
        assert_eq!(spans(&book), [(1.0, 3.0, "one"), (3.0, 4.0, "two")]);
        book.undo().expect("a change");
        assert_eq!((spans(&book), book.open.is_none()), (vec![(1.0, 4.0, "one")], true));
        book.undo().expect("a change");
        assert!(spans(&book).is_empty() && book.open.is_none() && book.undo().is_err());
        book.redo().expect("taken back");
        book.redo().expect("taken back");
        assert_eq!((spans(&book), book.open.is_none()), (vec![(1.0, 3.0, "one"), (3.0, 4.0, "two")], true));
    }

    #[test]
    fn an_edge_pushes_its_neighbour_and_stays_within_the_recording() {
        let labels = vec![LabelSpan::new(0.0, 4.0, "empty"), LabelSpan::new(4.0, 8.0, "one")];
        let mut book = Book::new(labels, Some((0.0, 10.0)));
        book.change(1, |label| label.start_s = 2.5).expect("an edit");
        assert_eq!(spans(&book), [(0.0, 2.5, "empty"), (2.5, 8.0, "one")]);
        assert!(book.change(1, |label| label.end_s = 11.0).is_err());
        assert!(book.change(1, |label| label.end_s = 2.5).is_err());
        assert!(book.change(1, |label| label.end_s = f64::NAN).is_err());
        book.delete(0).expect("there");
        assert!(book.delete(0).is_err());
        assert_eq!(spans(&book), [(2.5, 8.0, "one")]);
    }

    #[test]
    fn free_text_lies_over_anything() {
        let mut book = Book::new(vec![LabelSpan::new(0.0, 4.0, "door open")], None);
        book.press(Occupancy::One, 1.0, None).expect("room");
        let labels = book.labels(3.0);
        assert_eq!(labels.len(), 2);
        assert_eq!(spans(&book).len(), 1, "what goes on is not yet there");
        book.end_open(0.5);
        assert_eq!(spans(&book), [(0.0, 4.0, "door open")], "a label that ends before its start is none");
    }

    mod hard_cases {
        use super::super::super::cut_labels::tests::recorded;
        use super::*;

        /// Regression test: pages said of such labels that they are saved, and offered a command for a recording that was never
        /// complete.
        #[test]
        fn labels_are_not_said_to_be_saved_once_the_recorder_has_failed() {
            let folder = tempfile::tempdir().expect("a folder");
            let path = folder.path().join("night.mcap");
            let _recorder = recorded(&path);
            let has_failed = Arc::<AtomicBool>::default();
            let recording = Some((path.as_path(), has_failed.clone()));
            let keeper = Keeper::open(None, recording, Path::new("room-hqnn"), None, 0.1).expect("opens");
            keeper.edit(|book, _| book.add(LabelSpan::new(0.3, 0.5, "one"))).expect("fits");
            keeper.close();
            keeper.keep();
            let (told, count) = (keeper.told()["labels"].clone(), keeper.told_count());
            assert!(told["saved"] == true && told["fault"].is_null(), "{told}");
            assert!(told["adaptation"]["command"].is_string(), "{told}");
            has_failed.store(true, Ordering::Relaxed);
            let told = keeper.told()["labels"].clone();
            assert!(told["saved"] == false && told["adaptation"].is_null(), "{told}");
            assert!(told["fault"].as_str().is_some_and(|fault| fault.contains("recording has failed")), "{told}");
            assert_ne!(keeper.told_count(), count, "pages are told at once");
        }

        /// Regression test: labels that were saved were written once more at the end, and were said not to be saved if
        /// another program had changed them since.
        #[test]
        fn labels_that_are_saved_are_not_written_again_at_the_end() {
            let folder = tempfile::tempdir().expect("a folder");
            let path = folder.path().join("night.mcap");
            recorded(&path).finish().expect("finishes");
            let keeper = Keeper::open(None, None, Path::new("cfar"), None, 0.1).expect("opens");
            let keeper = Keeper { place: Some(Place::Mcap(path.clone())), ..keeper };
            keeper.edit(|book, _| book.add(LabelSpan::new(0.3, 0.5, "one"))).expect("fits");
            keeper.close();
            keeper.keep();
            assert_eq!(labels::of(&path).expect("labels").len(), 1);
            let theirs = [LabelSpan::new(0.3, 0.6, "two")];
            mcap::set_labels(&path, &theirs).expect("free");
            keeper.keep();
            keeper.last_word().expect("all were saved");
            assert_eq!(labels::of(&path).expect("labels"), theirs);
        }

        /// Regression test: labels of a recording that is being made could lie before its start and behind its end.
        #[test]
        fn labels_outside_a_recording_that_is_made_are_refused_or_cut() {
            let folder = tempfile::tempdir().expect("a folder");
            let path = folder.path().join("night.mcap");
            recorded(&path).finish().expect("finishes");

            let keeper = Keeper::open(None, Some((path.as_path(), Arc::default())), Path::new("cfar"), None, 0.1)
                .expect("opens");
            keeper.at(0.9);
            let refused =
                keeper.edit(|book, _| book.add(LabelSpan::new(-5.0, 1e6, "two"))).expect_err("before the start");
            assert!(refused.to_string().contains("no frame comes before 0 s"), "{refused}");
            for (start_s, end_s, label) in [(0.0, 0.4, "one"), (0.5, 1e6, "two"), (2.0, 3.0, "door open")] {
                keeper.edit(|book, _| book.add(LabelSpan::new(start_s, end_s, label))).expect("may come to be");
            }
            keeper.edit(|book, _| book.change(0, |label| label.start_s = -1.0)).expect_err("before the start");
            keeper.close();
            keeper.last_word().expect("saved");
            let kept: Vec<_> = labels::of(&path)
                .expect("labels")
                .into_iter()
                .map(|span| ((span.start_s * 1e3).round(), (span.end_s * 1e3).round(), span.label))
                .collect();
            assert_eq!(kept, [(300.0, 400.0, "one".to_owned()), (500.0, 1000.0, "two".to_owned())]);
        }
    }
}
