//! Reader thread that passes reference-counted frames from a pool to consumers, each with its own policy.

use std::error::Error;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crossbeam::channel::{Receiver, RecvTimeoutError, Sender, TrySendError, bounded};
use radome_driver::BoardError;
use radome_dsp::{Frame, FrameSource, Gap, GapReason, SourceError, SourceEvent};

use crate::output;
use crate::panics::{Panicked, catch_panic};

/// Item that a consumer receives.
pub enum Item {
    /// A frame, shared with the other consumers.
    Frame(Arc<Frame>),
    /// Frames are missing at this position.
    Gap(Gap),
    /// Last item, which every consumer receives.
    End(End),
}

/// Result of a stream of frames.
pub type End = Result<(), Failure>;

/// Error of a source, shared by the consumers.
#[derive(Debug, Clone, thiserror::Error)]
#[error(transparent)]
pub struct Failure(Arc<dyn Error + Send + Sync>);

impl From<SourceError> for Failure {
    fn from(error: SourceError) -> Self {
        Failure(error.into())
    }
}

impl Failure {
    /// Error of a source that ended without a result.
    pub fn without_result() -> Self {
        SourceError::from("the source ended without a result; its last frames may be missing").into()
    }

    /// Returns whether the source panicked. Its earlier frames may be wrong, so its recording stays marked unfinished.
    pub fn is_panic(&self) -> bool {
        self.0.is::<Panicked>()
    }

    /// Returns the gap at the end of a recording whose board was lost for good. Its number of frames is unknown.
    pub fn gap(&self, first_sequence: u64) -> Option<Gap> {
        let is_board = self.0.is::<BoardError>();
        is_board.then_some(Gap { first_sequence, frames: 0, reason: GapReason::Disconnected })
    }
}

/// Item with its arrival time at the host.
pub struct Delivery {
    pub item: Item,
    /// Arrival of the frame's last byte.
    pub arrived: Instant,
}

/// Policy for a consumer that is slower than the source.
#[derive(Debug, Clone, Copy)]
pub enum Policy {
    /// The reader waits. For sources that can wait (files, simulations), where every frame counts.
    Wait,
    /// The oldest waiting frame or gap is dropped and counted. For views and classifiers of a live board.
    DropOldest,
    /// No frame may be lost. If the consumer stalls for this long, the pipeline stops with an error.
    Lossless(Duration),
    /// No frame may be lost. A consumer that stalls for this long is abandoned ([`Queue::is_abandoned`]), and the others go
    /// on.
    LosslessOrAbandoned(Duration),
}

/// State of a consumer's queue, which both ends see.
#[derive(Default)]
pub struct Queue {
    /// Frames dropped because this consumer was too slow.
    pub missed: AtomicU64,
    /// Missing frames of the gaps that were dropped with them.
    pub missed_in_gaps: AtomicU64,
    /// Whether the pipeline has abandoned this consumer because it stalled. It receives no further items.
    pub is_abandoned: AtomicBool,
    /// Whether this consumer has taken nothing for the time that its policy allows.
    pub has_stalled: AtomicBool,
    /// Result of the stream. It is set before any consumer receives it.
    pub end: OnceLock<End>,
}

struct Outlet {
    name: &'static str,
    policy: Policy,
    sender: Sender<Delivery>,
    /// Receiver from which the oldest item is dropped. Only `DropOldest` holds it, so that the exit of other consumers
    /// is noticed.
    oldest: Option<Receiver<Delivery>>,
    queue: Arc<Queue>,
}

/// Consumer's end of a queue.
pub struct Inlet {
    pub receiver: Receiver<Delivery>,
    pub queue: Arc<Queue>,
}

impl Inlet {
    /// Result of the stream, once the queue is closed and empty. It is known even if the last item could not be delivered in
    /// time because the consumer took none.
    pub fn end_of_stream(&self) -> End {
        self.queue.end.get().cloned().unwrap_or_else(|| Err(Failure::without_result()))
    }
}

/// Consumers that are registered before the reader starts.
#[derive(Default)]
pub struct Pipeline {
    outlets: Vec<Outlet>,
}

/// Running reader thread.
pub struct Reader {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Pipeline {
    /// Adds a consumer with a queue of `capacity` items.
    pub fn consumer(&mut self, name: &'static str, capacity: usize, policy: Policy) -> Inlet {
        let (sender, receiver) = bounded(capacity);
        let oldest = matches!(policy, Policy::DropOldest).then(|| receiver.clone());
        let queue = Arc::<Queue>::default();
        self.outlets.push(Outlet { name, policy, sender, oldest, queue: queue.clone() });
        Inlet { receiver, queue }
    }

    /// Starts the reader. `limit` ends the stream after this number of frames.
    pub fn start(self, source: Box<dyn FrameSource>, limit: Option<u64>) -> Reader {
        let stop = Arc::new(AtomicBool::new(false));
        let stop_flag = stop.clone();
        let outlets = self.outlets;
        let thread = std::thread::spawn(move || {
            let end: End = match catch_panic(|| read(source, &outlets, limit, &stop_flag)) {
                Ok(end) => end.map_err(Failure::from),
                Err(panicked) => Err(SourceError::from(panicked).into()),
            };
            for outlet in &outlets {
                let _ = outlet.queue.end.set(end.clone());
            }
            outlets.iter().for_each(|outlet| outlet.finish(end.clone()));
        });
        Reader { stop, thread: Some(thread) }
    }
}

impl Reader {
    /// Requests an end after the frame that is being read.
    pub fn stop(&self) {
        self.stop.store(true, Ordering::SeqCst);
    }
}

impl Drop for Reader {
    fn drop(&mut self) {
        self.stop();
        // A source that waits for its board to reconnect must not delay the end of the program.
        let deadline = Instant::now() + Duration::from_secs(1);
        while self.thread.as_ref().is_some_and(|thread| !thread.is_finished() && Instant::now() < deadline) {
            std::thread::sleep(Duration::from_millis(5));
        }
        if let Some(thread) = self.thread.take().filter(JoinHandle::is_finished) {
            let _ = thread.join();
        }
    }
}

/// Frames of a source for a single consumer. A separate thread reads them and waits for the consumer, so that a signal ends the
/// wait for a board that is away.
pub struct Items {
    inlet: Inlet,
    /// Dropped after the inlet: once the inlet is gone, the reader does not wait to deliver an item.
    _reader: Reader,
}

impl Items {
    /// Starts to read a source, up to `limit` frames if that is given.
    pub fn of(source: Box<dyn FrameSource>, limit: Option<u64>) -> Self {
        let mut pipeline = Pipeline::default();
        let inlet = pipeline.consumer("command", 16, Policy::Wait);
        Items { inlet, _reader: pipeline.start(source, limit) }
    }

    /// Waits for the next frame, and calls `note_gap` at each gap before it. Returns `None` at the end, or if the user has
    /// stopped the program.
    ///
    /// # Errors
    /// Those of the source.
    pub fn next_frame(&self, mut note_gap: impl FnMut()) -> anyhow::Result<Option<Arc<Frame>>> {
        while !output::interrupted() {
            match self.inlet.receiver.recv_timeout(Duration::from_millis(100)).map(|delivery| delivery.item) {
                Ok(Item::Frame(frame)) => return Ok(Some(frame)),
                Ok(Item::Gap(_)) => note_gap(),
                Ok(Item::End(end)) => {
                    end?;
                    break;
                }
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => {
                    self.inlet.end_of_stream()?;
                    break;
                }
            }
        }
        Ok(None)
    }
}

fn read(
    mut source: Box<dyn FrameSource>,
    outlets: &[Outlet],
    limit: Option<u64>,
    stop: &AtomicBool,
) -> Result<(), SourceError> {
    let shape = source.waveform().shape();
    // One frame for every item of a queue, one held by each consumer, and one being read.
    let capacity: usize = outlets.iter().map(|o| o.sender.capacity().unwrap_or(1) + 1).sum();
    let mut pool: Vec<Arc<Frame>> = (0..capacity + 1).map(|_| Arc::new(Frame::zeroed(shape))).collect();
    let mut frames = 0;
    while !stop.load(Ordering::SeqCst) && limit.is_none_or(|limit| frames < limit) {
        let free = pool.iter().position(|frame| Arc::strong_count(frame) == 1);
        let mut slot = match free {
            Some(index) => pool.swap_remove(index),
            // A consumer holds frames longer than agreed, so another frame is allocated.
            None => Arc::new(Frame::zeroed(shape)),
        };
        let event = match Arc::get_mut(&mut slot) {
            Some(frame) => source.next_frame(frame)?,
            None => continue,
        };
        let arrived = Instant::now();
        match event {
            SourceEvent::Frame => {
                frames += 1;
                for outlet in outlets {
                    outlet.send(Delivery { item: Item::Frame(slot.clone()), arrived })?;
                }
            }
            SourceEvent::Gap(gap) => {
                for outlet in outlets {
                    outlet.send(Delivery { item: Item::Gap(gap), arrived })?;
                }
            }
            SourceEvent::End => return Ok(()),
        }
        pool.push(slot);
    }
    Ok(())
}

/// Message about a consumer that must not lose frames and has stalled.
pub fn stalled_message(name: &str, stall_limit: Duration) -> String {
    let limit_s = stall_limit.as_secs_f64();
    format!(
        "the {name} has not taken a frame for {limit_s:.1} s; stopped, because it must not lose any\n\nhint: write to a faster disk"
    )
}

impl Outlet {
    /// Sends the last item. Waits at most ten seconds for a consumer to take it.
    fn finish(&self, end: End) {
        let delivery = Delivery { item: Item::End(end), arrived: Instant::now() };
        if self.oldest.is_some() {
            let _ = self.send(delivery);
        } else if !self.queue.is_abandoned.load(Ordering::SeqCst) {
            let _ = self.sender.send_timeout(delivery, Duration::from_secs(10));
        }
    }

    fn send(&self, delivery: Delivery) -> Result<(), SourceError> {
        match self.policy {
            // The exit of a consumer does not stop the others.
            Policy::Wait => {
                let _ = self.sender.send(delivery);
            }
            Policy::Lossless(deadline) => {
                if let Err(error) = self.sender.send_timeout(delivery, deadline)
                    && error.is_timeout()
                {
                    self.queue.has_stalled.store(true, Ordering::SeqCst);
                    return Err(stalled_message(self.name, deadline).into());
                }
            }
            Policy::LosslessOrAbandoned(_) if self.queue.is_abandoned.load(Ordering::SeqCst) => {}
            Policy::LosslessOrAbandoned(deadline) => {
                let sent = self.sender.send_timeout(delivery, deadline);
                if sent.is_err_and(|error| error.is_timeout()) {
                    self.queue.has_stalled.store(true, Ordering::SeqCst);
                    self.queue.is_abandoned.store(true, Ordering::SeqCst);
                }
            }
            Policy::DropOldest => {
                let mut delivery = delivery;
                while let Err(TrySendError::Full(returned)) = self.sender.try_send(delivery) {
                    delivery = returned;
                    let oldest = self.oldest.as_ref().and_then(|oldest| oldest.try_recv().ok());
                    match oldest.map(|delivery| delivery.item) {
                        Some(Item::Frame(_)) => {
                            self.queue.missed.fetch_add(1, Ordering::Relaxed);
                        }
                        Some(Item::Gap(gap)) => {
                            self.queue.missed_in_gaps.fetch_add(gap.frames, Ordering::Relaxed);
                        }
                        Some(Item::End(_)) | None => {}
                    }
                }
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use radome_dsp::{Waveform, WaveformRequest, source_from_fn};

    /// Source of frames whose codes are their number, up to `end`; number 4 is lost.
    fn counter(end: u64) -> Box<dyn FrameSource> {
        let request = WaveformRequest { samples_per_chirp: 8, chirps_per_frame: 2, ..WaveformRequest::paper() };
        let mut next = 0;
        Box::new(source_from_fn(Waveform::realise(request).expect("valid"), move |frame| {
            if next == end {
                return Ok(SourceEvent::End);
            }
            frame.sequence = next;
            frame.codes.fill(next as u16);
            next += 1;
            Ok(match next {
                5 => SourceEvent::Gap(Gap { first_sequence: 4, frames: 1, reason: GapReason::PacketLost }),
                _ => SourceEvent::Frame,
            })
        }))
    }

    #[test]
    fn every_consumer_gets_every_frame_in_order_and_the_gap_in_its_place() {
        let mut pipeline = Pipeline::default();
        let inlets = [pipeline.consumer("a", 2, Policy::Wait), pipeline.consumer("b", 64, Policy::DropOldest)];
        let _reader = pipeline.start(counter(50), None);
        for inlet in inlets {
            let mut expected = 0;
            loop {
                match inlet.receiver.recv_timeout(Duration::from_secs(5)).expect("no stall").item {
                    Item::Frame(frame) => {
                        assert_eq!(frame.sequence, expected);
                        assert!(frame.codes.iter().all(|c| u64::from(*c) == expected));
                    }
                    Item::Gap(gap) => assert_eq!(gap.first_sequence, expected),
                    Item::End(end) => break end.expect("no error"),
                }
                expected += 1;
            }
            assert_eq!(expected, 50);
            assert_eq!(inlet.queue.missed.load(Ordering::Relaxed), 0);
        }
    }

    #[test]
    fn a_slow_view_misses_the_oldest_frames_and_counts_them() {
        let mut pipeline = Pipeline::default();
        let inlet = pipeline.consumer("view", 3, Policy::DropOldest);
        let mut reader = pipeline.start(counter(1000), Some(20));
        reader.thread.take().expect("runs").join().expect("reader ends by itself");
        let remaining: Vec<_> = inlet.receiver.try_iter().collect();
        let sequences: Vec<_> = remaining
            .iter()
            .filter_map(|delivery| match &delivery.item {
                Item::Frame(frame) => Some(frame.sequence),
                _ => None,
            })
            .collect();
        assert_eq!(sequences, [19, 20], "the newest stay");
        assert!(matches!(remaining.last(), Some(Delivery { item: Item::End(Ok(())), .. })));
        assert_eq!(inlet.queue.missed.load(Ordering::Relaxed), 18);
        // The frame of the gap was missing before.
        assert_eq!(inlet.queue.missed_in_gaps.load(Ordering::Relaxed), 1);
    }

    #[test]
    fn a_dropped_consumer_does_not_block_the_others() {
        let mut pipeline = Pipeline::default();
        drop(pipeline.consumer("gone", 1, Policy::Wait));
        let inlet = pipeline.consumer("stays", 64, Policy::Wait);
        let _reader = pipeline.start(counter(50), None);
        let mut frames = 0;
        while let Ok(delivery) = inlet.receiver.recv_timeout(Duration::from_secs(5)) {
            frames += usize::from(matches!(delivery.item, Item::Frame(_)));
        }
        assert_eq!(frames, 49);
    }

    #[test]
    fn a_stalled_recorder_stops_the_pipeline_with_an_error() {
        let mut pipeline = Pipeline::default();
        let inlet = pipeline.consumer("recorder", 2, Policy::Lossless(Duration::from_millis(50)));
        let reader = pipeline.start(counter(1000), None);
        std::thread::sleep(Duration::from_millis(200));
        let items: Vec<_> = inlet.receiver.iter().collect();
        drop(reader);
        let Some(Delivery { item: Item::End(Err(error)), .. }) = items.last() else { panic!("no error") };
        assert!(error.to_string().contains("recorder"), "{error}");
    }

    #[test]
    fn a_stalled_recorder_is_abandoned_and_the_others_go_on() {
        let mut pipeline = Pipeline::default();
        let stalled = pipeline.consumer("recorder", 2, Policy::LosslessOrAbandoned(Duration::from_millis(50)));
        let other = pipeline.consumer("classifier", 64, Policy::Wait);
        let _reader = pipeline.start(counter(50), None);
        let sent: Vec<_> = other.receiver.iter().collect();
        assert!(matches!(sent.last(), Some(Delivery { item: Item::End(Ok(())), .. })));
        assert_eq!(sent.len(), 51);
        assert!(stalled.queue.is_abandoned.load(Ordering::SeqCst));
        // Items that were sent before remain, without an end: the consumer must not take them for the whole stream.
        assert_eq!(stalled.receiver.iter().count(), 2);
    }

    #[test]
    fn frames_of_one_consumer_end_with_the_source_its_limit_or_its_error() {
        for (limit, frames, gaps) in [(None, 49, 1), (Some(3), 3, 0), (Some(0), 0, 0)] {
            let items = Items::of(counter(50), limit);
            let (mut seen, mut missing) = (0, 0);
            while items.next_frame(|| missing += 1).expect("no error").is_some() {
                seen += 1;
            }
            assert_eq!((seen, missing), (frames, gaps), "{limit:?}");
        }
        let items = Items::of(crate::panics::tests::failing_after(0, |_| "chunk 3 is damaged".into()), None);
        assert_eq!(items.next_frame(|| ()).err().map(|error| error.to_string()).as_deref(), Some("chunk 3 is damaged"));
    }

    mod hard_cases {
        use super::*;
        use crate::panics::tests::panicking_after;

        #[test]
        fn a_source_that_panics_is_an_error_with_its_place_for_every_consumer() {
            let mut pipeline = Pipeline::default();
            let inlets = [
                pipeline.consumer("first", 1, Policy::Wait),
                pipeline.consumer("second", 9, Policy::DropOldest),
                pipeline.consumer("third", 9, Policy::Lossless(Duration::from_secs(5))),
            ];
            let _reader = pipeline.start(panicking_after(3), None);
            for inlet in inlets {
                let mut frames = 0;
                let failure = loop {
                    match inlet.receiver.recv_timeout(Duration::from_secs(5)).expect("no stall").item {
                        Item::Frame(_) => frames += 1,
                        Item::Gap(gap) => panic!("{gap:?}"),
                        Item::End(end) => break end.expect_err("a panic"),
                    }
                };
                assert_eq!(frames, 3);
                assert!(failure.is_panic() && failure.gap(3).is_none());
                let said = failure.to_string();
                assert!(said.contains("panics.rs:") && said.contains("frame 3 cannot be made"), "{said}");
                assert!(inlet.queue.end.get().is_some_and(|end| end.as_ref().is_err_and(Failure::is_panic)));
                // The pipeline keeps no sender open after the end.
                assert!(inlet.receiver.recv().is_err());
            }
        }

        #[test]
        fn a_board_that_is_lost_leaves_a_gap_of_unknown_length() {
            let lost = SourceError::from(BoardError::Stopped);
            let failure = Failure::from(lost);
            let expected = Gap { first_sequence: 7, frames: 0, reason: GapReason::Disconnected };
            assert_eq!((failure.gap(7), failure.is_panic()), (Some(expected), false));
            assert_eq!(Failure::without_result().gap(7), None);
        }
    }
}
