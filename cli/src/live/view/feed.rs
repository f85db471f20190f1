//! Content of pages: the newest frame, and the maps of it that they request.
//!
//! The classifier hands over the newest frame and its answer, and continues. A thread of the pages keeps the history
//! and computes the maps. Each kind is computed once for all pages that show it, and only for pages that have received
//! the previous picture.
//!
//! A picture is a message with the length of its header in four bytes, little-endian; the header in JSON; and the parts
//! that it lists. Maps have one byte per cell, `[doppler][range]`, `low_db + step_db * byte`, and 255 for values that
//! are not numbers. The noise floor is f32 by range bin. Chirps are u16: one chirp, and the least and largest code of
//! each sample over all chirps of the channel.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Condvar, Mutex};
use std::time::{Duration, Instant};

use anyhow::bail;
use axum::body::Bytes;
use radome_dsp::rdm::{Channels, StaticRemoval};
use radome_dsp::{Frame, MAX_CODE, MapStatus, Rdm, RdmProcessor, RdmSpec, Waveform, noise_floor_db};
use serde::{Deserialize, Serialize};
use serde_json::json;
use tokio::sync::mpsc;

use super::partner::Partner;
use crate::live::answer::{Answer, Probabilities};
use crate::live::health::Arrivals;
use crate::live::sink::Moment;
use crate::panics::lock;

/// Shortest time between pictures, above the rate that viewers need.
const SHORTEST_INTERVAL: Duration = Duration::from_millis(33);
/// Largest number of pictures that a page has not acknowledged.
const MOST_UNSEEN: u32 = 2;
/// Time after which a page gets a picture even without an acknowledgement, in case it cannot send.
const PATIENCE: Duration = Duration::from_secs(2);
/// Number of answers that a page gets when it opens: ten minutes of the paper's frames.
const HISTORY: usize = 6_000;
/// Step of a cell's byte, dB.
const STEP_DB: f32 = 0.5;
/// Number of Doppler bins around zero that do not count as noise.
const GUARD_BINS: usize = 3;
/// The vendor's weight of the newest frame in the MTI filter.
const MTI_ALPHA: f64 = 0.8;

/// Identifier of a page.
pub type PageId = u64;

/// Channel of a map.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Channel {
    /// Map that the network classifies.
    Network,
    /// Mean power of all receivers.
    #[default]
    Sum,
    /// One receiver, 0-based.
    Rx(usize),
}

/// Removal of static echoes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Removal {
    None,
    /// Subtracts the mean over a frame's chirps.
    #[default]
    Mean,
    /// The vendor's recursive filter over frames.
    Mti,
}

/// Selection of a page.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Look {
    #[serde(default)]
    channel: Channel,
    #[serde(default)]
    removal: Removal,
    /// Index of the chirp, if one is shown.
    #[serde(default)]
    chirp: Option<usize>,
    /// Whether the simulated partner is shown too.
    #[serde(default)]
    partner: bool,
}

type Kind = (Channel, Removal);

/// Newest frame with its answer.
struct Newest {
    answer: Answer,
    frame: Arc<Frame>,
    network_map: Rdm,
    health: serde_json::Value,
}

/// Answer to one frame, for the timeline.
#[derive(Debug, Clone, Copy)]
struct Point {
    sequence: u64,
    time_s: f64,
    probabilities: Option<Probabilities>,
    label: Option<usize>,
    occupied: bool,
    truth: Option<(usize, bool)>,
    /// Whether frames are missing before it.
    after_gap: bool,
}

impl Point {
    /// Returns the values in the order of the arguments of `History.add` in `timeline.js`.
    fn row(&self) -> serde_json::Value {
        let p = self.probabilities.map(|p| p.values().map(|v| (v * 1e3).round() / 1e3));
        json!([
            self.sequence,
            (self.time_s * 1e6).round() / 1e6,
            p,
            self.label,
            u8::from(self.occupied),
            self.truth.map(|(class, _)| class),
            u8::from(self.truth.is_some_and(|(_, transition)| transition)),
            u8::from(self.after_gap),
        ])
    }
}

struct PageState {
    look: Look,
    sender: mpsc::Sender<Bytes>,
    unseen: u32,
    sent_at: Instant,
    /// Version that was sent last.
    version: u64,
    /// Number of answers that had been given at that time.
    told: u64,
}

/// Data that the classifier's thread hands to the pages' thread.
#[derive(Default)]
struct Handover {
    /// Newest frame, if it has not been taken.
    newest: Option<Newest>,
    /// Answers that have not been taken, at most [`HISTORY`].
    points: VecDeque<Point>,
    after_gap: bool,
    /// Counter of frames and of changed selections of pages.
    version: u64,
    /// Counter of all events that the pages' thread may be waiting for.
    calls: u64,
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
    is_tape: bool,
    /// Lock with which a test stops the thread that writes messages.
    #[cfg(test)]
    hold_up: Mutex<()>,
}

impl Feed {
    pub fn new(waveform: &Waveform, is_tape: bool) -> Self {
        // Both swapped queues have their full capacity from the start: see `serve`.
        let handover = Handover { points: VecDeque::with_capacity(HISTORY), ..Handover::default() };
        Feed {
            handover: Mutex::new(handover),
            wake: Condvar::new(),
            pages: Mutex::default(),
            arrivals: Mutex::default(),
            waveform: waveform.clone(),
            is_tape,
            #[cfg(test)]
            hold_up: Mutex::default(),
        }
    }

    /// Changes the handover and wakes the pages' thread.
    fn call<T>(&self, change: impl FnOnce(&mut Handover) -> T) -> T {
        let mut handover = lock(&self.handover);
        handover.calls += 1;
        let result = change(&mut handover);
        drop(handover);
        self.wake.notify_all();
        result
    }

    /// Takes the newest frame without waiting for any page.
    pub fn publish(&self, moment: &Moment) {
        let answer = moment.answer;
        let newest = Newest {
            answer: answer.clone(),
            frame: moment.frame.clone(),
            network_map: moment.map.clone(),
            health: health(moment, self.rate(moment)),
        };
        let mut point = Point {
            sequence: answer.sequence,
            time_s: answer.time_s,
            probabilities: answer.probabilities,
            label: answer.label.map(|label| label.index()),
            occupied: answer.occupied,
            truth: answer.truth.map(|truth| (truth.index(), answer.transition == Some(true))),
            after_gap: false,
        };
        let old = self.call(|handover| {
            point.after_gap = std::mem::take(&mut handover.after_gap);
            if handover.points.len() == HISTORY {
                handover.points.pop_front();
            }
            handover.points.push_back(point);
            handover.version += 1;
            handover.newest.replace(newest)
        });
        // The old frame is freed without the lock.
        drop(old);
    }

    /// Frame rate over the newest frames that are shown, 1/s.
    fn rate(&self, moment: &Moment) -> f64 {
        if !self.is_tape {
            return moment.health.frames_per_s();
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
        self.call(|handover| handover.closed = true);
    }

    /// Adds a page; its pictures arrive at the receiver.
    pub fn join(&self) -> (PageId, mpsc::Receiver<Bytes>) {
        let (sender, receiver) = mpsc::channel(MOST_UNSEEN as usize + 1);
        let mut pages = lock(&self.pages);
        let id = pages.next;
        pages.next += 1;
        let page = PageState { look: Look::default(), sender, unseen: 0, sent_at: Instant::now(), version: 0, told: 0 };
        pages.open.insert(id, page);
        drop(pages);
        self.call(|_| ());
        (id, receiver)
    }

    pub fn leave(&self, page: PageId) {
        lock(&self.pages).open.remove(&page);
    }

    pub fn pages(&self) -> usize {
        lock(&self.pages).open.len()
    }

    /// Notes that a page has received a picture.
    pub fn seen(&self, page: PageId) {
        if let Some(page) = lock(&self.pages).open.get_mut(&page) {
            page.unseen = page.unseen.saturating_sub(1);
        }
        self.call(|_| ());
    }

    /// Changes the selection of a page.
    ///
    /// # Errors
    /// The frames have no such channel or chirp.
    pub fn look(&self, page: PageId, look: Look) -> anyhow::Result<()> {
        let shape = self.waveform.shape();
        if let Channel::Rx(rx) = look.channel
            && rx >= shape.rx
        {
            bail!("channel {rx}, expected 0 to {}", shape.rx.saturating_sub(1));
        }
        if look.chirp.is_some_and(|chirp| chirp >= shape.chirps) {
            bail!("no such chirp, expected 0 to {}", shape.chirps.saturating_sub(1));
        }
        if let Some(page) = lock(&self.pages).open.get_mut(&page) {
            page.look = look;
        }
        self.call(|handover| handover.version += 1);
        Ok(())
    }

    /// Waits until there is a frame and a page wants a picture; `false` once closed.
    fn wait_for_pages(&self, mut has_frame: bool) -> bool {
        loop {
            let handover = lock(&self.handover);
            if handover.closed {
                return false;
            }
            has_frame |= handover.newest.is_some();
            let (version, calls) = (handover.version, handover.calls);
            drop(handover);
            if has_frame && lock(&self.pages).open.values().any(|page| page.wants(version)) {
                return true;
            }
            let handover = lock(&self.handover);
            if handover.calls == calls {
                // Bounded wait, since a page may stay silent.
                drop(self.wake.wait_timeout(handover, PATIENCE));
            }
        }
    }

    /// Makes pictures until the feed is closed.
    pub fn serve(&self, partner: Option<Partner>) {
        let mut painters: BTreeMap<(bool, Kind), Painter> = BTreeMap::new();
        let mut mirrored: Option<(u64, Frame)> = None;
        let mut newest: Option<Newest> = None;
        let mut history: VecDeque<Point> = VecDeque::with_capacity(HISTORY);
        let mut taken: VecDeque<Point> = VecDeque::with_capacity(HISTORY);
        // Number of answers that have entered the history.
        let mut answers = 0;
        let mut last = Instant::now();
        while self.wait_for_pages(newest.is_some()) {
            std::thread::sleep(SHORTEST_INTERVAL.saturating_sub(last.elapsed()));
            last = Instant::now();
            let mut handover = lock(&self.handover);
            let newer = handover.newest.take();
            std::mem::swap(&mut handover.points, &mut taken);
            let version = handover.version;
            drop(handover);
            newest = newer.or(newest);
            answers += taken.len() as u64;
            for point in taken.drain(..) {
                if history.len() == HISTORY {
                    history.pop_front();
                }
                history.push_back(point);
            }
            let Some(newest) = &newest else { continue };
            let pages = lock(&self.pages);
            let wanting = pages.open.iter().filter(|(_, page)| page.wants(version));
            let looks: Vec<(PageId, Look, u64)> = wanting.map(|(id, page)| (*id, page.look, page.told)).collect();
            let kinds: Vec<Kind> = pages.open.values().map(|page| page.look.kind()).collect();
            drop(pages);

            // From here on, only pages wait for the work.
            painters.retain(|(_, kind), _| kinds.contains(kind));
            if let Some(partner) = partner.as_ref().filter(|_| looks.iter().any(|(_, look, _)| look.partner))
                && mirrored.as_ref().is_none_or(|(sequence, _)| *sequence != newest.frame.sequence)
            {
                mirrored = partner.frame(&newest.frame).map(|frame| (newest.frame.sequence, frame));
            }
            for (id, look, told) in looks {
                let picture = self.picture(newest, &look, mirrored.as_ref(), &mut painters);
                #[cfg(test)]
                drop(self.hold_up.lock());
                let missing = (answers - told).min(history.len() as u64) as usize;
                let points: Vec<_> = history.iter().skip(history.len() - missing).map(Point::row).collect();
                let Some(message) = picture.message(points) else { continue };
                let mut pages = lock(&self.pages);
                let Some(page) = pages.open.get_mut(&id) else { continue };
                // A page that takes no pictures stays open until the server drops it.
                if page.sender.try_send(message).is_ok() {
                    page.told = answers;
                    page.unseen += 1;
                }
                page.version = version;
                page.sent_at = Instant::now();
            }
        }
    }

    fn picture(
        &self,
        newest: &Newest,
        look: &Look,
        mirrored: Option<&(u64, Frame)>,
        painters: &mut BTreeMap<(bool, Kind), Painter>,
    ) -> Picture {
        let mut picture = Picture {
            header: json!({ "answer": newest.answer, "health": newest.health, "look": {
                "channel": look.channel, "removal": look.removal,
            } }),
            parts: Vec::new(),
        };
        if look.channel == Channel::Network {
            if newest.answer.warming_up.is_none() {
                picture.map("map", "floor", &newest.network_map);
            }
        } else {
            picture.painted("map", "floor", self.painter(false, look, painters), &newest.frame);
        }
        if let Some((_, frame)) = mirrored.filter(|(sequence, _)| look.partner && *sequence == newest.frame.sequence) {
            // The network's map may span several frames; the partner has only one.
            picture.painted("partner", "partner_floor", self.painter(true, look, painters), frame);
        }
        if let Some(chirp) = look.chirp {
            picture.chirps(&newest.frame, look.channel, chirp);
        }
        picture
    }

    fn painter<'a>(
        &self,
        is_partner: bool,
        look: &Look,
        painters: &'a mut BTreeMap<(bool, Kind), Painter>,
    ) -> Option<&'a mut Painter> {
        match painters.entry((is_partner, look.kind())) {
            std::collections::btree_map::Entry::Occupied(entry) => Some(entry.into_mut()),
            std::collections::btree_map::Entry::Vacant(entry) => {
                Painter::new(look.kind(), &self.waveform).map(|painter| entry.insert(painter))
            }
        }
    }
}

impl Look {
    fn kind(&self) -> Kind {
        (self.channel, self.removal)
    }
}

impl PageState {
    fn wants(&self, version: u64) -> bool {
        self.version < version && (self.unseen < MOST_UNSEEN || self.sent_at.elapsed() > PATIENCE)
    }
}

/// Counters of the run, for the line at the top of the page.
fn health(moment: &Moment, frames_per_s: f64) -> serde_json::Value {
    let health = moment.health;
    let dropped: BTreeMap<&str, u64> = health.dropped.iter().map(|(reason, frames)| (reason.name(), *frames)).collect();
    json!({
        "frames": health.frames,
        "frames_per_s": frames_per_s,
        "dropped": health.dropped_total(),
        "dropped_by_reason": dropped,
        "latency_p50_ms": health.latency.quantile_s(0.5) * 1e3,
        "latency_p95_ms": health.latency.quantile_s(0.95) * 1e3,
        "saturated_samples": health.saturated_samples,
        "temperature_c": health.temperature_millicelsius.map(|t| f64::from(t) * 1e-3),
        "running_s": health.started.elapsed().as_secs_f64(),
    })
}

/// Computes maps of one kind. The static-echo filter counts the frames that it receives, so frames that pages skip do
/// not reset it.
struct Painter {
    processor: RdmProcessor,
    map: Rdm,
    samples: Vec<f32>,
    count: u64,
    /// Frame that the map was computed from.
    made_of: Option<(u64, u64)>,
}

impl Painter {
    fn new((channel, removal): Kind, waveform: &Waveform) -> Option<Self> {
        let channels = match channel {
            Channel::Rx(rx) => Channels::One(rx),
            Channel::Sum | Channel::Network => Channels::IncoherentSum,
        };
        let static_removal = match removal {
            Removal::None => StaticRemoval::None,
            Removal::Mean => StaticRemoval::SlowTimeMean,
            Removal::Mti => StaticRemoval::RecursiveMti { alpha: MTI_ALPHA },
        };
        let spec = RdmSpec { channels, static_removal, ..RdmSpec::default() };
        let processor = RdmProcessor::new(&spec, waveform)
            .inspect_err(|error| tracing::warn!("the page has no map: {error}"))
            .ok()?;
        let map = processor.empty_map();
        Some(Painter { processor, map, samples: Vec::new(), count: 0, made_of: None })
    }

    fn paint(&mut self, frame: &Frame) -> Option<&Rdm> {
        let of = (frame.sequence, frame.time_ns);
        if self.made_of != Some(of) {
            if self.made_of.is_some_and(|(sequence, _)| frame.sequence < sequence) {
                self.processor.reset();
            }
            self.samples.clear();
            self.samples.extend(frame.codes.iter().map(|code| f32::from(*code) * (1.0 / 2048.0) - 1.0));
            self.count += 1;
            match self.processor.process_samples(self.count, &self.samples, &mut self.map) {
                Ok(MapStatus::Ready) => self.made_of = Some(of),
                Ok(MapStatus::WarmingUp { .. }) | Err(_) => return None,
            }
        }
        Some(&self.map)
    }
}

/// Message under construction.
struct Picture {
    header: serde_json::Value,
    parts: Vec<(&'static str, Vec<u8>)>,
}

impl Picture {
    fn painted(&mut self, name: &'static str, floor: &'static str, painter: Option<&mut Painter>, frame: &Frame) {
        if let Some(map) = painter.and_then(|painter| painter.paint(frame)) {
            self.map(name, floor, map);
        }
    }

    /// Adds the first channel of a map, and its noise floor.
    fn map(&mut self, name: &'static str, floor: &'static str, map: &Rdm) {
        let cells = map.db.get(..map.shape.doppler * map.shape.range).unwrap_or(&[]);
        let finite = || cells.iter().copied().filter(|v| v.is_finite());
        let (low, high) = finite().fold((f32::MAX, f32::MIN), |(low, high), v| (low.min(v), high.max(v)));
        // Range of a byte, from the top.
        let low_db = if low > high { 0.0 } else { low.floor().max((high - 254.0 * STEP_DB).ceil()) };
        self.header[name] = json!({
            "doppler": map.shape.doppler,
            "range": map.shape.range,
            "range_step_m": map.range_step_m,
            "velocity_step_m_per_s": map.velocity_step_m_per_s,
            "low_db": low_db,
            "step_db": STEP_DB,
        });
        let byte = |v: &f32| match v.is_finite() {
            true => ((v - low_db) / STEP_DB).round().clamp(0.0, 254.0) as u8,
            false => 255,
        };
        self.parts.push((name, cells.iter().map(byte).collect()));
        let floor_db = noise_floor_db(map, 0, GUARD_BINS);
        self.parts.push((floor, floor_db.iter().flat_map(|v| v.to_le_bytes()).collect()));
    }

    fn chirps(&mut self, frame: &Frame, channel: Channel, chirp: usize) {
        let rx = if let Channel::Rx(rx) = channel { rx } else { 0 };
        let samples = frame.shape.samples;
        let (mut least, mut most) = (vec![u16::MAX; samples], vec![0u16; samples]);
        for index in 0..frame.shape.chirps {
            for ((code, least), most) in frame.chirp(rx, index).iter().zip(&mut least).zip(&mut most) {
                *least = (*least).min(*code);
                *most = (*most).max(*code);
            }
        }
        let clipped = |rx: usize| {
            let of = (0..frame.shape.chirps).flat_map(|chirp| frame.chirp(rx, chirp));
            of.filter(|code| **code == 0 || **code >= MAX_CODE).count()
        };
        let clipped: Vec<usize> = (0..frame.shape.rx).map(clipped).collect();
        self.header["chirps"] = json!({ "rx": rx, "chirp": chirp, "samples": samples, "clipped_by_rx": clipped });
        let codes = frame.chirp(rx, chirp).iter().chain(&least).chain(&most);
        self.parts.push(("chirps", codes.flat_map(|code| code.to_le_bytes()).collect()));
    }

    fn message(mut self, history: Vec<serde_json::Value>) -> Option<Bytes> {
        self.header["history"] = history.into();
        let lengths: Vec<_> = self.parts.iter().map(|(name, bytes)| json!([name, bytes.len()])).collect();
        self.header["parts"] = lengths.into();
        let header = serde_json::to_vec(&self.header).ok()?;
        let mut message = Vec::with_capacity(4 + header.len() + self.parts.iter().map(|p| p.1.len()).sum::<usize>());
        message.extend_from_slice(&u32::try_from(header.len()).ok()?.to_le_bytes());
        message.extend_from_slice(&header);
        for (_, bytes) in &self.parts {
            message.extend_from_slice(bytes);
        }
        Some(message.into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::live::health::Health;
    use radome_dsp::WaveformRequest;
    use std::thread;

    /// Timeout far above the duration of any operation on any machine.
    const PATIENCE: Duration = Duration::from_secs(60);

    fn publish(feed: &Feed, sequences: std::ops::Range<u64>) {
        let processor = RdmProcessor::new(&RdmSpec::default(), &feed.waveform).expect("a processor");
        let (map, health) = (processor.empty_map(), Health::new(Instant::now()));
        let frame = Arc::new(Frame::zeroed(feed.waveform.shape()));
        for sequence in sequences {
            let answer = Answer { sequence, time_s: sequence as f64 * 0.1, ..Answer::default() };
            feed.publish(&Moment { answer: &answer, frame: &frame, map: &map, health: &health });
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
        let held = feed.hold_up.lock().expect("a lock");
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
        feed.seen(page);
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
}
