//! Labels of a recording as pages edit them: class labels do not overlap, and each change can be undone.

use std::time::{SystemTime, UNIX_EPOCH};

use anyhow::{Context, bail, ensure};
use radome_driver::LabelSpan;
use radome_driver::recording::span_check::check_spans;
use radome_dsp::Occupancy;
use serde::Serialize;

use super::cut_labels::SHORTEST_S;
use crate::labels;

/// Largest number of labels, above any number made by hand.
const MOST_SPANS: usize = 5_000;
/// Number of changes that can be undone.
const MOST_UNDO: usize = 100;

/// Label with an identifier that stays while it is edited.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Span {
    pub id: u64,
    #[serde(flatten)]
    pub label: LabelSpan,
}

/// Label that has not ended yet.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct OpenLabel {
    pub start_s: f64,
    pub label: Occupancy,
    #[serde(skip)]
    who: Option<String>,
    #[serde(skip)]
    made_ns: Option<u64>,
}

/// State that undo and redo restore.
#[derive(Debug, Clone, Default)]
struct Snapshot {
    spans: Vec<Span>,
    open: Option<OpenLabel>,
}

/// Set of labels with undo history, changed one step at a time.
#[derive(Debug, Default)]
pub struct LabelSet {
    current: Snapshot,
    next_id: u64,
    undo_stack: Vec<Snapshot>,
    redo_stack: Vec<Snapshot>,
    /// Start of the recording's first frame and end of its last one, s; `None` while it is being made.
    extent_s: Option<(f64, f64)>,
    /// Number of changes.
    revision: u64,
}

impl LabelSet {
    pub(super) fn new(labels: Vec<LabelSpan>, extent_s: Option<(f64, f64)>) -> Self {
        let spans: Vec<Span> = (0u64..).zip(labels).map(|(id, label)| Span { id, label }).collect();
        let next_id = spans.len() as u64;
        LabelSet { current: Snapshot { spans, open: None }, next_id, extent_s, ..LabelSet::default() }
    }

    /// Labels that have ended, by start.
    pub(super) fn spans(&self) -> &[Span] {
        &self.current.spans
    }

    pub(super) fn open_label(&self) -> Option<&OpenLabel> {
        self.current.open.as_ref()
    }

    pub(super) fn can_undo(&self) -> bool {
        !self.undo_stack.is_empty()
    }

    pub(super) fn can_redo(&self) -> bool {
        !self.redo_stack.is_empty()
    }

    /// Number of changes so far.
    pub(super) fn revision(&self) -> u64 {
        self.revision
    }

    /// Starts a label at the current time. If a label of the same class is open, ends it instead.
    pub(super) fn toggle(&mut self, label: Occupancy, now_s: f64, who: Option<String>) -> anyhow::Result<()> {
        self.check_count()?;
        self.push_undo();
        let previous = self.current.open.as_ref().map(|open| open.label);
        self.end_open(now_s);
        if previous != Some(label) {
            self.current.open = Some(OpenLabel { start_s: now_s, label, who, made_ns: unix_time_ns() });
        }
        Ok(())
    }

    /// Ends the open label, if there is one.
    pub(super) fn stop(&mut self, end_s: f64) {
        if self.current.open.is_some() {
            self.push_undo();
            self.end_open(end_s);
        }
    }

    /// Ends the open label before the time jumps, also in the states that undo and redo restore. A label that was open before
    /// a jump is thus never open behind it. This is no change of its own for undo. Returns whether a label was open.
    pub(super) fn end_before_jump(&mut self, end_s: f64) -> bool {
        let is_open = self.current.open.is_some();
        let mut undo_stack = std::mem::take(&mut self.undo_stack);
        let mut redo_stack = std::mem::take(&mut self.redo_stack);
        let snapshots = undo_stack.iter_mut().chain(&mut redo_stack);
        for snapshot in snapshots.filter(|snapshot| snapshot.open.is_some()) {
            std::mem::swap(&mut self.current, snapshot);
            self.end_open(end_s);
            std::mem::swap(&mut self.current, snapshot);
        }
        (self.undo_stack, self.redo_stack) = (undo_stack, redo_stack);
        self.end_open(end_s);
        self.revision += u64::from(is_open);
        is_open
    }

    /// Adds a label that is made now.
    pub(super) fn add(&mut self, label: LabelSpan) -> anyhow::Result<()> {
        self.check_count()?;
        self.check(&label)?;
        self.push_undo();
        self.insert(None, LabelSpan { made_ns: unix_time_ns(), ..label });
        Ok(())
    }

    pub(super) fn change(&mut self, id: u64, change: impl FnOnce(&mut LabelSpan)) -> anyhow::Result<()> {
        let Some(span) = self.current.spans.iter().find(|span| span.id == id) else {
            bail!("that label is no longer there");
        };
        let mut label = span.label.clone();
        change(&mut label);
        self.check(&label)?;
        label.made_ns = unix_time_ns();
        self.push_undo();
        self.insert(Some(id), label);
        Ok(())
    }

    pub(super) fn delete(&mut self, id: u64) -> anyhow::Result<()> {
        ensure!(self.current.spans.iter().any(|span| span.id == id), "that label is no longer there");
        self.push_undo();
        self.current.spans.retain(|span| span.id != id);
        Ok(())
    }

    pub(super) fn undo(&mut self) -> anyhow::Result<()> {
        let before = self.undo_stack.pop().context("nothing to take back")?;
        self.redo_stack.push(std::mem::replace(&mut self.current, before));
        self.revision += 1;
        Ok(())
    }

    pub(super) fn redo(&mut self) -> anyhow::Result<()> {
        let after = self.redo_stack.pop().context("nothing was taken back")?;
        self.undo_stack.push(std::mem::replace(&mut self.current, after));
        self.revision += 1;
        Ok(())
    }

    /// Returns the labels as if the open label ended at `end_s`.
    pub(super) fn labels(&self, end_s: f64) -> Vec<LabelSpan> {
        let mut ended = LabelSet {
            current: self.current.clone(),
            next_id: self.next_id,
            extent_s: self.extent_s,
            ..LabelSet::default()
        };
        ended.end_open(end_s);
        ended.current.spans.into_iter().map(|span| span.label).collect()
    }

    /// Stores the state before a change for undo.
    fn push_undo(&mut self) {
        self.undo_stack.push(self.current.clone());
        if self.undo_stack.len() > MOST_UNDO {
            self.undo_stack.remove(0);
        }
        self.redo_stack.clear();
        self.revision += 1;
    }

    fn check_count(&self) -> anyhow::Result<()> {
        let count = self.current.spans.len();
        ensure!(count < MOST_SPANS, "there are {count} labels already, more than can be made by hand");
        Ok(())
    }

    /// Refuses a label that is too short or lies outside the recording. Of a recording that is being made, only the start is
    /// known.
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

    fn end_open(&mut self, end_s: f64) {
        let Some(OpenLabel { start_s, label, who, made_ns }) = self.current.open.take() else { return };
        self.insert(None, LabelSpan { who, made_ns, ..LabelSpan::new(start_s, end_s, label.name()) });
    }

    /// Adds a label, or replaces the one of this identifier. Other labels that name a class are cut where they overlap.
    fn insert(&mut self, id: Option<u64>, label: LabelSpan) {
        let (start_s, end_s) = match self.extent_s {
            Some((first_s, last_s)) => (label.start_s.max(first_s), label.end_s.min(last_s)),
            None => (label.start_s, label.end_s),
        };
        let length_s = end_s - start_s;
        if length_s.is_nan() || length_s < SHORTEST_S {
            return;
        }
        if label.occupancy().is_some() {
            for other in std::mem::take(&mut self.current.spans).into_iter().filter(|other| Some(other.id) != id) {
                let is_class = |label: &LabelSpan| label.occupancy().is_some();
                let rests = labels::cut_out(vec![other.label.clone()], (start_s, end_s), is_class).into_iter();
                let rests = rests.filter(|rest| *rest == other.label || rest.end_s - rest.start_s >= SHORTEST_S);
                for (index, label) in rests.enumerate() {
                    // The remainders on both sides become two labels.
                    let id = if index == 0 { other.id } else { self.new_id() };
                    self.current.spans.push(Span { id, label });
                }
            }
        }
        let id = id.unwrap_or_else(|| self.new_id());
        self.current.spans.retain(|span| span.id != id);
        self.current.spans.push(Span { id, label: LabelSpan { start_s, end_s, ..label } });
        self.current.spans.sort_by(|a, b| a.label.start_s.total_cmp(&b.label.start_s));
    }

    fn new_id(&mut self) -> u64 {
        self.next_id += 1;
        self.next_id - 1
    }
}

fn unix_time_ns() -> Option<u64> {
    SystemTime::now().duration_since(UNIX_EPOCH).ok().and_then(|since| u64::try_from(since.as_nanos()).ok())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spans(set: &LabelSet) -> Vec<(f64, f64, &str)> {
        set.spans().iter().map(|s| (s.label.start_s, s.label.end_s, s.label.label.as_str())).collect()
    }

    #[test]
    fn keys_make_labels_and_each_can_be_undone() {
        let mut set = LabelSet::new(vec![LabelSpan::new(0.0, 10.0, "empty")], Some((0.0, 20.0)));
        set.toggle(Occupancy::One, 2.0, None).expect("room");
        set.toggle(Occupancy::Two, 4.0, None).expect("room");
        // The same label again ends it.
        set.toggle(Occupancy::Two, 6.0, None).expect("room");
        let expected = vec![(0.0, 2.0, "empty"), (2.0, 4.0, "one"), (4.0, 6.0, "two"), (6.0, 10.0, "empty")];
        assert_eq!(spans(&set), expected);
        let ids: std::collections::BTreeSet<u64> = set.spans().iter().map(|span| span.id).collect();
        assert_eq!(ids.len(), 4, "each has its own identifier");
        for _ in 0..3 {
            set.undo().expect("a change");
        }
        assert_eq!(spans(&set), [(0.0, 10.0, "empty")]);
        assert!(set.open_label().is_none() && set.undo().is_err());
        for _ in 0..3 {
            set.redo().expect("an undone change");
        }
        assert_eq!(spans(&set), expected);
    }

    /// Regression test: undo behind a jump opened a label again, and it grew over all that was skipped.
    #[test]
    fn a_label_that_was_open_before_a_jump_is_not_open_behind_it() {
        let mut set = LabelSet::new(Vec::new(), Some((0.0, 20.0)));
        set.toggle(Occupancy::One, 1.0, None).expect("room");
        set.toggle(Occupancy::Two, 3.0, None).expect("room");
        assert!(set.end_before_jump(4.0) && !set.end_before_jump(14.0));
        assert_eq!(spans(&set), [(1.0, 3.0, "one"), (3.0, 4.0, "two")]);
        set.undo().expect("a change");
        assert_eq!((spans(&set), set.open_label().is_none()), (vec![(1.0, 4.0, "one")], true));
        set.undo().expect("a change");
        assert!(spans(&set).is_empty() && set.open_label().is_none() && set.undo().is_err());
        set.redo().expect("an undone change");
        set.redo().expect("an undone change");
        assert_eq!((spans(&set), set.open_label().is_none()), (vec![(1.0, 3.0, "one"), (3.0, 4.0, "two")], true));
    }

    #[test]
    fn a_moved_edge_cuts_its_neighbour_and_stays_within_the_recording() {
        let labels = vec![LabelSpan::new(0.0, 4.0, "empty"), LabelSpan::new(4.0, 8.0, "one")];
        let mut set = LabelSet::new(labels, Some((0.0, 10.0)));
        set.change(1, |label| label.start_s = 2.5).expect("an edit");
        assert_eq!(spans(&set), [(0.0, 2.5, "empty"), (2.5, 8.0, "one")]);
        assert!(set.change(1, |label| label.end_s = 11.0).is_err());
        assert!(set.change(1, |label| label.end_s = 2.5).is_err());
        assert!(set.change(1, |label| label.end_s = f64::NAN).is_err());
        set.delete(0).expect("there");
        assert!(set.delete(0).is_err());
        assert_eq!(spans(&set), [(2.5, 8.0, "one")]);
    }

    #[test]
    fn free_text_may_overlap_classes() {
        let mut set = LabelSet::new(vec![LabelSpan::new(0.0, 4.0, "door open")], None);
        set.toggle(Occupancy::One, 1.0, None).expect("room");
        let labels = set.labels(3.0);
        assert_eq!(labels.len(), 2);
        assert_eq!(spans(&set).len(), 1, "an open label is not in the list");
        set.end_open(0.5);
        assert_eq!(spans(&set), [(0.0, 4.0, "door open")], "a label that ends before its start is none");
    }
}
