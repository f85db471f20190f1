//! Handover of frames from the classifier to the pages, and the pages that are open.
//!
//! The classifier hands over the newest frame and its answer, and continues. A thread of the pages keeps the history
//! ([`history`](super::history)) and makes pictures ([`picture`](super::picture)), only for pages that have received the
//! previous one.

use std::collections::BTreeMap;
use std::sync::{Condvar, Mutex};
use std::time::{Duration, Instant};

use anyhow::bail;
use axum::body::Bytes;
use radome_dsp::{Frame, Waveform};
use tokio::sync::mpsc;

use super::history::{History, Point};
use super::partner::Partner;
use super::picture::{Channel, MapProcessors, NewestFrame, Selection};
use crate::live::health::Arrivals;
use crate::live::sink::ClassifiedFrame;
use crate::panics::lock;

/// Shortest time between pictures, above the rate that viewers need.
const SHORTEST_INTERVAL: Duration = Duration::from_millis(33);
/// Largest number of pictures that a page has not acknowledged.
const MOST_UNACKNOWLEDGED: u32 = 2;
/// Time after which a page gets a picture even without an acknowledgement, in case it cannot send.
const PATIENCE: Duration = Duration::from_secs(2);

pub type PageId = u64;

struct PageState {
    selection: Selection,
    sender: mpsc::Sender<Bytes>,
    unacknowledged: u32,
    sent_at: Instant,
    /// Version that was sent last.
    version: u64,
    /// Number of answers that had entered the history at that time.
    sent_answers: u64,
}

/// Data that the classifier's thread hands to the pages' thread.
#[derive(Default)]
struct Handover {
    /// Newest frame, if it has not been taken.
    newest: Option<NewestFrame>,
    /// Answers that have not been taken.
    answers: History,
    after_gap: bool,
    /// Counter of frames and of changed selections of pages.
    version: u64,
    /// Counter of all changes that the pages' thread may be waiting for.
    events: u64,
    closed: bool,
}

#[derive(Default)]
struct Pages {
    open: BTreeMap<PageId, PageState>,
    next: PageId,
}

/// Newest frame, and the pages that show it.
///
/// The classifier's thread takes one lock, that of the [`Handover`]. All threads hold it for a few assignments only,
/// never while a message is written or a page is awaited. No thread holds it and the lock of the pages at once.
pub struct Feed {
    handover: Mutex<Handover>,
    wake: Condvar,
    pages: Mutex<Pages>,
    /// Arrival times of the shown frames of a recording; frames before a seek position are not shown. Used by the
    /// classifier's thread only.
    arrivals: Mutex<Arrivals>,
    waveform: Waveform,
    is_playback: bool,
    /// Lock with which a test stops the thread that writes messages.
    #[cfg(test)]
    message_lock: Mutex<()>,
}

impl Feed {
    pub fn new(waveform: &Waveform, is_playback: bool) -> Self {
        Feed {
            handover: Mutex::default(),
            wake: Condvar::new(),
            pages: Mutex::default(),
            arrivals: Mutex::default(),
            waveform: waveform.clone(),
            is_playback,
            #[cfg(test)]
            message_lock: Mutex::default(),
        }
    }

    /// Changes the handover and wakes the pages' thread.
    fn update<T>(&self, change: impl FnOnce(&mut Handover) -> T) -> T {
        let mut handover = lock(&self.handover);
        handover.events += 1;
        let result = change(&mut handover);
        drop(handover);
        self.wake.notify_all();
        result
    }

    /// Takes the newest frame without waiting for any page.
    pub fn publish(&self, classified: &ClassifiedFrame) {
        let newest = NewestFrame::of(classified, self.rate(classified));
        let mut point = Point::of(classified.answer);
        let old = self.update(|handover| {
            point.after_gap = std::mem::take(&mut handover.after_gap);
            handover.answers.push(point);
            handover.version += 1;
            handover.newest.replace(newest)
        });
        // The old frame is freed without the lock.
        drop(old);
    }

    /// Frame rate over the newest frames that are shown, 1/s.
    fn rate(&self, classified: &ClassifiedFrame) -> f64 {
        if !self.is_playback {
            return classified.health.frames_per_s();
        }
        let mut arrivals = lock(&self.arrivals);
        arrivals.add(Instant::now());
        arrivals.frames_per_s()
    }

    pub fn gap(&self) {
        lock(&self.handover).after_gap = true;
    }

    /// Ends the feed after the run.
    pub fn close(&self) {
        self.update(|handover| handover.closed = true);
    }

    /// Adds a page; its pictures arrive at the receiver.
    pub fn join(&self) -> (PageId, mpsc::Receiver<Bytes>) {
        let (sender, receiver) = mpsc::channel(MOST_UNACKNOWLEDGED as usize + 1);
        let mut pages = lock(&self.pages);
        let id = pages.next;
        pages.next += 1;
        let page = PageState {
            selection: Selection::default(),
            sender,
            unacknowledged: 0,
            sent_at: Instant::now(),
            version: 0,
            sent_answers: 0,
        };
        pages.open.insert(id, page);
        drop(pages);
        self.update(|_| ());
        (id, receiver)
    }

    pub fn leave(&self, page: PageId) {
        lock(&self.pages).open.remove(&page);
    }

    pub fn pages(&self) -> usize {
        lock(&self.pages).open.len()
    }

    /// Notes that a page has received a picture.
    pub fn acknowledge(&self, page: PageId) {
        if let Some(page) = lock(&self.pages).open.get_mut(&page) {
            page.unacknowledged = page.unacknowledged.saturating_sub(1);
        }
        self.update(|_| ());
    }

    /// Changes the selection of a page.
    ///
    /// # Errors
    /// The frames have no such channel or chirp.
    pub fn select(&self, page: PageId, selection: Selection) -> anyhow::Result<()> {
        let shape = self.waveform.shape();
        if let Channel::Rx(rx) = selection.channel
            && rx >= shape.rx
        {
            bail!("channel {rx}, expected 0 to {}", shape.rx.saturating_sub(1));
        }
        if selection.chirp.is_some_and(|chirp| chirp >= shape.chirps) {
            bail!("no such chirp, expected 0 to {}", shape.chirps.saturating_sub(1));
        }
        if let Some(page) = lock(&self.pages).open.get_mut(&page) {
            page.selection = selection;
        }
        self.update(|handover| handover.version += 1);
        Ok(())
    }

    /// Waits until there is a frame and a page needs a picture; `false` once closed.
    fn wait_for_pages(&self, mut has_frame: bool) -> bool {
        loop {
            let handover = lock(&self.handover);
            if handover.closed {
                return false;
            }
            has_frame |= handover.newest.is_some();
            let (version, events) = (handover.version, handover.events);
            drop(handover);
            if has_frame && lock(&self.pages).open.values().any(|page| page.is_due(version)) {
                return true;
            }
            let handover = lock(&self.handover);
            if handover.events == events {
                // Bounded wait, since a page may stay silent.
                drop(self.wake.wait_timeout(handover, PATIENCE));
            }
        }
    }

    /// Makes pictures until the feed is closed.
    pub fn serve(&self, partner: Option<Partner>) {
        let mut processors = MapProcessors::new(&self.waveform);
        let mut simulated: Option<(u64, Frame)> = None;
        let mut newest: Option<NewestFrame> = None;
        let mut history = History::default();
        let mut taken = History::default();
        // Number of answers that have entered the history.
        let mut answers = 0;
        let mut last = Instant::now();
        while self.wait_for_pages(newest.is_some()) {
            std::thread::sleep(SHORTEST_INTERVAL.saturating_sub(last.elapsed()));
            last = Instant::now();
            let mut handover = lock(&self.handover);
            let newer = handover.newest.take();
            std::mem::swap(&mut handover.answers, &mut taken);
            let version = handover.version;
            drop(handover);
            newest = newer.or(newest);
            answers += history.append(&mut taken);
            let Some(newest) = &newest else { continue };
            let pages = lock(&self.pages);
            let due = pages.open.iter().filter(|(_, page)| page.is_due(version));
            let selections: Vec<(PageId, Selection, u64)> =
                due.map(|(id, page)| (*id, page.selection, page.sent_answers)).collect();
            let shown: Vec<Selection> = pages.open.values().map(|page| page.selection).collect();
            drop(pages);

            // From here on, no lock is held: only pages wait for this work.
            processors.retain(&shown);
            if let Some(partner) =
                partner.as_ref().filter(|_| selections.iter().any(|(_, selection, _)| selection.partner))
                && simulated.as_ref().is_none_or(|(sequence, _)| *sequence != newest.frame.sequence)
            {
                simulated = partner.frame(&newest.frame).map(|frame| (newest.frame.sequence, frame));
            }
            let current = simulated.as_ref().filter(|(sequence, _)| *sequence == newest.frame.sequence);
            let partner_frame = current.map(|(_, frame)| frame);
            for (id, selection, sent_answers) in selections {
                let picture = processors.picture(newest, &selection, partner_frame);
                #[cfg(test)]
                drop(self.message_lock.lock());
                let Some(message) = picture.message(history.newest_rows(answers - sent_answers)) else { continue };
                let mut pages = lock(&self.pages);
                let Some(page) = pages.open.get_mut(&id) else { continue };
                // A page whose earlier pictures still wait gets this one later. One that takes none stays open until the
                // server drops it.
                if page.sender.try_send(message).is_ok() {
                    page.version = version;
                    page.sent_answers = answers;
                    page.unacknowledged += 1;
                }
                page.sent_at = Instant::now();
            }
        }
    }
}

impl PageState {
    fn is_due(&self, version: u64) -> bool {
        self.version < version && (self.unacknowledged < MOST_UNACKNOWLEDGED || self.sent_at.elapsed() > PATIENCE)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::thread;

    use radome_dsp::{RdmProcessor, RdmSpec, WaveformRequest};
    use serde_json::json;

    use super::*;
    use crate::live::answer::Answer;
    use crate::live::health::Health;
    use crate::live::view::history::HISTORY;

    /// Timeout far above the duration of any operation on any machine.
    const PATIENCE: Duration = Duration::from_secs(60);

    fn publish(feed: &Feed, sequences: std::ops::Range<u64>) {
        let processor = RdmProcessor::new(&RdmSpec::default(), &feed.waveform).expect("a processor");
        let (map, health) = (processor.empty_map(), Health::new(Instant::now()));
        let frame = Arc::new(Frame::zeroed(feed.waveform.shape()));
        for sequence in sequences {
            let answer = Answer { sequence, time_s: sequence as f64 * 0.1, ..Answer::default() };
            feed.publish(&ClassifiedFrame { answer: &answer, frame: &frame, map: &map, health: &health });
        }
    }

    /// Publishes on a separate thread; returns whether that finishes.
    fn can_publish(feed: &Arc<Feed>, sequences: std::ops::Range<u64>) -> bool {
        let (done, ended) = std::sync::mpsc::channel();
        let of = feed.clone();
        thread::spawn(move || {
            publish(&of, sequences);
            let _ = done.send(());
        });
        ended.recv_timeout(PATIENCE).is_ok()
    }

    fn header(message: &Bytes) -> serde_json::Value {
        let length = u32::from_le_bytes(message[..4].try_into().expect("four bytes")) as usize;
        serde_json::from_slice(&message[4..4 + length]).expect("JSON")
    }

    #[test]
    fn the_classifier_waits_for_no_page_and_each_gets_the_whole_history() {
        let waveform = Waveform::realise(WaveformRequest::paper()).expect("valid");
        let feed = Arc::new(Feed::new(&waveform, false));
        let answers = HISTORY as u64 + 100;

        // Holds the lock of the pages throughout, as a thread that changes them would.
        let held = lock(&feed.pages);
        assert!(can_publish(&feed, 0..answers), "waits for the pages' lock");
        drop(held);

        // The thread that writes messages is stopped within the message with the whole history.
        let (page, mut pictures) = feed.join();
        let held = feed.message_lock.lock().expect("a lock");
        let of = feed.clone();
        let serving = thread::spawn(move || of.serve(None));
        let start = Instant::now();
        while lock(&feed.handover).newest.is_some() {
            assert!(start.elapsed() < PATIENCE, "the frame is not taken");
            thread::sleep(Duration::from_millis(5));
        }
        assert!(can_publish(&feed, answers..answers + 50), "waits for a message to be written");
        drop(held);

        let first = header(&pictures.blocking_recv().expect("a picture"));
        let rows = first["history"].as_array().expect("rows");
        assert_eq!((rows.len(), &rows[0][0]), (HISTORY, &json!(100)));
        // Answers that were given meanwhile come with the next picture, once.
        feed.acknowledge(page);
        let second = header(&pictures.blocking_recv().expect("a picture"));
        let rows = second["history"].as_array().expect("rows");
        assert_eq!((rows.len(), &rows[49][0]), (50, &json!(answers + 49)));
        // A page that opens later gets the same history, and so does one that reconnects.
        for _ in 0..3 {
            let (page, mut pictures) = feed.join();
            let rows = header(&pictures.blocking_recv().expect("a picture"))["history"].clone();
            assert_eq!(rows.as_array().map(Vec::len), Some(HISTORY));
            feed.leave(page);
        }
        feed.close();
        serving.join().expect("an end");
    }

    /// Regression test: a page whose connection was stuck never got the newest picture if no frame came after it, as
    /// while a recording is paused.
    #[test]
    fn a_page_that_was_stuck_gets_the_newest_picture() {
        let waveform = Waveform::realise(WaveformRequest::paper()).expect("valid");
        let feed = Arc::new(Feed::new(&waveform, true));
        let (page, mut pictures) = feed.join();
        let of = feed.clone();
        let serving = thread::spawn(move || of.serve(None));
        // One picture more than can wait.
        let newest = MOST_UNACKNOWLEDGED as u64 + 1;
        for sequence in 0..=newest {
            let published = Instant::now();
            publish(&feed, sequence..sequence + 1);
            while lock(&feed.pages).open[&page].sent_at < published {
                assert!(published.elapsed() < PATIENCE, "picture {sequence} is not made");
                thread::sleep(Duration::from_millis(5));
            }
            feed.acknowledge(page);
        }
        let begun = Instant::now();
        let mut shown = None;
        while shown != Some(newest) {
            match pictures.try_recv() {
                Ok(picture) => shown = header(&picture)["answer"]["sequence"].as_u64(),
                Err(_) => thread::sleep(Duration::from_millis(5)),
            }
            assert!(begun.elapsed() < PATIENCE, "the page shows frame {shown:?}");
        }
        feed.close();
        serving.join().expect("an end");
    }
}
