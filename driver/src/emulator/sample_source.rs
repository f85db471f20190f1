//! Sample source of the emulated chip: codes of a frame source in FIFO order, and their times.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use crossbeam::channel::{Receiver, RecvTimeoutError, Sender, bounded};
use radome_dsp::{FIFO_SAMPLES, Frame, FrameShape, FrameSource, SourceEvent, Waveform};

use super::feed::Maker;
use super::{Feed, Pace, Shared};
use crate::chip::{ChipConfiguration, SampleTiming};
use crate::error_text::with_causes;
use crate::protocol::fifo;

/// Most frames that the source may be ahead.
const FRAMES_AHEAD: usize = 2;
/// Largest number of frames that are sampled or discarded at once.
const MAX_FRAMES_AT_ONCE: usize = 100;
/// Wait for the source's next frame while frames are discarded.
const CATCH_UP_WAIT: Duration = Duration::from_millis(1);
/// Largest number of frames that a scene's simulation may be behind when the chip starts again. Beyond it, the simulation is
/// restarted at the current time.
const MOST_IDLE_FRAMES: f64 = 4.0;

enum Message {
    Frame(Frame),
    Gap {
        frames: u64,
    },
    End,
    /// The source has failed.
    Failed(String),
    /// Frames of this waveform are not available.
    Refused(String),
}

/// State of the next slice.
pub(super) enum Slice {
    /// The codes are complete, at this board time.
    Ready { time_us: u64 },
    /// Frames are missing in the source.
    Missing { frames: u64 },
    /// The codes are not sampled yet.
    Wait,
    /// The source has ended.
    End,
}

pub(super) struct SampleSource {
    incoming: Receiver<Message>,
    free_frames: Sender<Frame>,
    /// Thread that runs the source.
    producer: Option<JoinHandle<()>>,
    maker: Arc<Mutex<Maker>>,
    makes_any_waveform: bool,
    /// Whether a source that has ended is opened again.
    repeat: bool,
    /// Waveform of the source's frames.
    source: Waveform,
    /// Set if frames of that waveform cannot be made.
    is_refused: bool,
    /// Whether the chip was started with a waveform that the source does not have.
    is_silent: bool,
    shared: Arc<Shared>,
    shape: FrameShape,
    timing: SampleTiming,
    /// Indices of the source's receivers that the chip has switched on.
    channels: Vec<usize>,
    codes_per_frame: u64,
    pace: Pace,
    /// Frame that is not due yet.
    upcoming: Option<Frame>,
    /// Start of the source's next frame, ns.
    next_ns: u64,
    /// Codes of frames in FIFO order; those before `sent` have been sent.
    codes: Vec<u16>,
    sent: usize,
    /// Numbers of codes taken out of the FIFO and put into it since the frames started.
    pub codes_out: u64,
    codes_in: u64,
    /// First code and time of the frames that `codes` holds.
    frames: VecDeque<(u64, u64)>,
    /// A gap that comes after the codes.
    missing: u64,
    has_begun: bool,
    ended: bool,
    /// Wall-clock time that corresponds to this source time, ns.
    clock: Option<(Instant, u64)>,
    /// Time at which the chip started again, ns: earlier frames are discarded.
    started_ns: Option<u64>,
    /// Time of the last reset, ns.
    stopped_ns: Option<u64>,
}

impl SampleSource {
    /// Starts a thread that takes frames from the source, so that a slow source does not delay the firmware's answers.
    pub fn new(feed: Feed, pace: Pace, repeat: bool, shared: Arc<Shared>) -> std::io::Result<Self> {
        let Feed { source, maker } = feed;
        let waveform = source.waveform().clone();
        let makes_any_waveform = matches!(maker, Maker::Waveforms(_));
        let maker = Arc::new(Mutex::new(maker));
        let (incoming, free_frames, producer) =
            Producer::start(waveform.clone(), maker.clone(), repeat, FirstSource::Given(source))?;
        Ok(SampleSource {
            incoming,
            free_frames,
            producer: Some(producer),
            maker,
            makes_any_waveform,
            repeat,
            is_refused: false,
            is_silent: false,
            shared,
            shape: waveform.shape(),
            timing: SampleTiming::new(&waveform),
            channels: (0..waveform.shape().rx).collect(),
            codes_per_frame: waveform.shape().codes() as u64,
            source: waveform,
            pace,
            upcoming: None,
            next_ns: 0,
            codes: Vec::new(),
            sent: 0,
            codes_out: 0,
            codes_in: 0,
            frames: VecDeque::new(),
            missing: 0,
            has_begun: false,
            ended: false,
            clock: None,
            started_ns: None,
            stopped_ns: None,
        })
    }

    /// Checks that frames of this waveform are available; the error is the reason if not.
    pub fn check(&self, waveform: &Waveform) -> Result<(), String> {
        match self.makes_any_waveform {
            true => Ok(()),
            false => compare(&self.source, waveform),
        }
    }

    /// Returns whether the source's frames are those of this waveform. If others can be made, the registers have to be
    /// the same.
    fn has_waveform(&self, waveform: &Waveform) -> bool {
        !self.is_refused
            && compare(&self.source, waveform).is_ok()
            && (!self.makes_any_waveform || matches_except_receivers(&self.source, waveform))
    }

    /// Sets the refusal of a client's request; nothing is sampled then.
    pub fn refuse(&mut self, reason: &str) {
        self.is_silent = true;
        self.shared.refuse(reason);
    }

    /// Starts frames with this waveform. If the source has no such frames, sets the refusal and starts none.
    pub fn restart(&mut self, waveform: &Waveform) {
        self.is_silent = false;
        self.shared.accept();
        // A scene is not simulated for the time without a client.
        let idle_ns = self.now_ns().map_or(0, |now| now.saturating_sub(self.next_ns));
        let was_idle =
            self.makes_any_waveform && idle_ns as f64 * 1e-9 > MOST_IDLE_FRAMES * self.source.frame_interval_s();
        if !self.has_waveform(waveform) || was_idle {
            match self.check(waveform) {
                Ok(()) => self.change_waveform(waveform),
                Err(reason) => self.refuse(&reason),
            }
        }
        let source_antennas = self.source.request.rx_antennas.antennas();
        let antennas_on = waveform.request.rx_antennas.antennas();
        self.channels = antennas_on.iter().filter_map(|a| source_antennas.iter().position(|b| a == b)).collect();
        self.timing = SampleTiming::new(waveform);
        self.codes_per_frame = (self.channels.len() * self.shape.chirps * self.shape.samples) as u64;
        self.codes.clear();
        self.sent = 0;
        self.frames.clear();
        (self.codes_out, self.codes_in, self.missing) = (0, 0, 0);
        // A reset directly followed by a start loses no frame.
        let is_immediate = |now: u64, stopped: u64| (now - stopped) as f64 * 1e-9 < self.timing.frame_interval_s();
        let stopped = self.stopped_ns.take();
        self.started_ns =
            self.now_ns().map(|now| stopped.filter(|s| *s <= now && is_immediate(now, *s)).unwrap_or(now));
        self.has_begun = true;
    }

    /// Makes frames of another waveform, from the current time on. The clock stands still until the first frame is
    /// there.
    fn change_waveform(&mut self, waveform: &Waveform) {
        let from_ns = self.now_ns().unwrap_or(self.next_ns);
        let first_source = FirstSource::Made { from: Duration::from_nanos(from_ns) };
        match Producer::start(waveform.clone(), self.maker.clone(), self.repeat, first_source) {
            // The earlier producer ends when its channel is closed.
            Ok((incoming, free_frames, producer)) => {
                (self.incoming, self.free_frames, self.producer) = (incoming, free_frames, Some(producer));
                self.source = waveform.clone();
                self.shape = waveform.shape();
                (self.upcoming, self.clock, self.stopped_ns) = (None, None, None);
                (self.is_refused, self.ended) = (false, false);
            }
            Err(error) => self.refuse(&format!("no thread for frames of this waveform: {error}")),
        }
    }

    /// Stops sampling before a reset of the chip.
    pub fn stop(&mut self) {
        self.stopped_ns = self.stopped_ns.or(self.now_ns());
    }

    /// Source time by the wall clock, ns.
    fn now_ns(&self) -> Option<u64> {
        let Pace::RealTime(speed) = self.pace else { return None };
        let (instant, time_ns) = self.clock?;
        Some(time_ns.saturating_add((instant.elapsed().as_nanos() as f64 * speed) as u64))
    }

    /// Samples the frames that are due, while the host reads nothing.
    pub fn advance(&mut self) {
        let Some(now) = self.now_ns() else {
            // The first frame sets the clock.
            if self.has_begun && !self.waits_for_reader() {
                self.sample_frame();
            }
            return;
        };
        let ahead = 3 * self.fifo_limit();
        // The number is limited, because the firmware has to answer its host in between.
        for _ in 0..MAX_FRAMES_AT_ONCE {
            let is_due = self.frames.back().is_none_or(|(_, time_ns)| *time_ns <= now);
            if !(is_due && self.codes_in < self.codes_out + ahead && self.sample_frame()) {
                return;
            }
        }
    }

    /// Speed as a multiple of real time, as far as it is known.
    pub fn speed(&self) -> f64 {
        match self.pace {
            Pace::RealTime(speed) => speed.clamp(1.0, 100.0),
            Pace::AsFastAsRead => 1.0,
        }
    }

    /// Returns whether sampling waits for the reader: nothing overflows then.
    pub fn waits_for_reader(&self) -> bool {
        self.pace == Pace::AsFastAsRead
    }

    /// Samples the next frame, or discards one from before the start; returns false if there is none yet.
    fn sample_frame(&mut self) -> bool {
        if self.ended || self.is_silent || self.missing > 0 {
            return false;
        }
        let frame = match self.upcoming.take().map_or_else(|| self.receive(), Some) {
            Some(frame) => frame,
            None => return false,
        };
        if self.now_ns().is_some_and(|now| frame.time_ns > now) {
            self.upcoming = Some(frame);
            return false;
        }
        // A frame with at least one sampled chirp counts as measured; the start ended it.
        let is_before_start =
            |started: u64| self.timing.chirps_after(started.saturating_sub(frame.time_ns) as f64 * 1e-9) > 0;
        if self.started_ns.is_some_and(is_before_start) {
            let _ = self.free_frames.try_send(frame);
            return true;
        }
        self.started_ns = None;
        self.frames.push_back((self.codes_in, frame.time_ns));
        fifo::interleave(&frame.codes, self.shape, &self.channels, &mut self.codes);
        self.codes_in += self.codes_per_frame;
        let _ = self.free_frames.try_send(frame);
        true
    }

    /// Receives the source's next frame, if it is there.
    fn receive(&mut self) -> Option<Frame> {
        // Frames from before the start are discarded as fast as they come.
        let is_behind = self.clock.is_some() && self.started_ns.is_some_and(|started| self.next_ns < started);
        let timeout = if is_behind { CATCH_UP_WAIT } else { Duration::ZERO };
        let message = match self.incoming.recv_timeout(timeout) {
            Ok(message) => message,
            // The producer sends a message when it ends, unless it panics.
            Err(RecvTimeoutError::Disconnected) => {
                Message::Failed(self.producer.take().map_or_else(String::new, panic_message))
            }
            Err(RecvTimeoutError::Timeout) => return None,
        };
        match message {
            Message::Frame(frame) => {
                self.set_clock(&frame);
                return Some(frame);
            }
            Message::Gap { frames } => self.missing = frames,
            Message::End => self.ended = true,
            Message::Failed(reason) => {
                self.ended = true;
                self.shared.fail(reason);
            }
            Message::Refused(reason) => {
                self.is_refused = true;
                self.refuse(&reason);
            }
        }
        None
    }

    /// Notes when the next frame begins. A late source delays the clock; the host does not count as slow.
    fn set_clock(&mut self, frame: &Frame) {
        self.next_ns = frame.time_ns.saturating_add((self.source.frame_interval_s() * 1e9) as u64);
        let is_late = self.now_ns().is_none_or(|now| now > frame.time_ns) && self.started_ns.is_none();
        if is_late && matches!(self.pace, Pace::RealTime(_)) {
            self.clock = Some((Instant::now(), frame.time_ns));
        }
    }

    /// Board time at which this code has been sampled, ns.
    fn time_ns(&self, code: u64) -> u64 {
        let frame = self.frames.iter().rev().find(|(first, _)| *first <= code);
        let (first, time_ns) = frame.copied().unwrap_or((self.codes_out, 0));
        time_ns + (self.timing.in_frame_s(code - first) * 1e9) as u64
    }

    /// Returns the state of a slice of this many codes.
    pub fn slice(&mut self, samples: u64) -> Slice {
        self.advance();
        if self.codes_in < self.codes_out + samples {
            self.sample_frame();
        }
        if self.codes_in < self.codes_out + samples {
            return match (self.missing, self.ended) {
                (0, true) => Slice::End,
                (0, false) => Slice::Wait,
                (frames, _) => {
                    self.missing = 0;
                    Slice::Missing { frames }
                }
            };
        }
        let ready_ns = self.time_ns(self.codes_out + samples - 1);
        if self.now_ns().is_some_and(|now| ready_ns > now) {
            return Slice::Wait;
        }
        Slice::Ready { time_us: ready_ns / 1000 }
    }

    /// Returns whether more has been sampled than the FIFO holds.
    pub fn overflows(&self) -> bool {
        !self.waits_for_reader() && self.in_fifo() > self.fifo_limit()
    }

    /// Codes that the FIFO holds before it overflows. Above real time the FIFO is larger by the speed, since the delays
    /// of the host do not shrink.
    fn fifo_limit(&self) -> u64 {
        (FIFO_SAMPLES as f64 * self.speed()) as u64
    }

    /// Codes sampled since the frames started, including those not yet taken from the source. If sampling waits for the
    /// reader, all available codes count as sampled.
    pub fn sampled(&self) -> u64 {
        let Some(now) = self.stopped_ns.or(self.now_ns()) else { return self.codes_in };
        let sampled = |(first, time_ns): &(u64, u64)| {
            first + self.timing.sampled_after(now.saturating_sub(*time_ns) as f64 * 1e-9)
        };
        let sampled_with_last = |(first, time_ns): &(u64, u64)| {
            first + self.timing.sampled_in_stream(now.saturating_sub(*time_ns) as f64 * 1e-9)
        };
        let last = self.frames.back().filter(|_| !self.ended).map(sampled_with_last);
        self.frames.iter().map(sampled).chain(last).max().unwrap_or(self.codes_out)
    }

    /// Codes sampled and not yet taken out.
    pub fn in_fifo(&self) -> u64 {
        self.sampled().saturating_sub(self.codes_out)
    }

    /// Codes taken from the source and not yet taken out.
    pub fn available(&self) -> usize {
        self.codes.len() - self.sent
    }

    /// Codes of the slice that is ready.
    pub fn codes(&self, samples: usize) -> &[u16] {
        self.codes.get(self.sent..self.sent + samples).unwrap_or(&[])
    }

    /// Removes codes, and the frames that were sent with them.
    pub fn take(&mut self, samples: usize) {
        self.sent = (self.sent + samples).min(self.codes.len());
        // Compacted rarely: moving all codes for each slice would cost more than sending it.
        if 2 * self.sent >= self.codes.len() {
            self.codes.drain(..self.sent);
            self.sent = 0;
        }
        self.codes_out += samples as u64;
        while self.frames.get(1).is_some_and(|(first, _)| *first <= self.codes_out) {
            self.frames.pop_front();
        }
    }

    /// Returns whether the codes taken so far are whole frames, so that slices end where frames do.
    pub fn at_frame_boundary(&self) -> bool {
        self.codes_out.is_multiple_of(self.codes_per_frame.max(1))
    }
}

fn panic_message(thread: JoinHandle<()>) -> String {
    let Err(payload) = thread.join() else { return "the sample source ended without an error message".into() };
    let text = payload.downcast_ref::<&str>().copied().or_else(|| payload.downcast_ref::<String>().map(String::as_str));
    format!("the source panicked: {}", text.unwrap_or("without a word"))
}

/// Checks that frames of a source can replace those of a waveform; the error names the quantity that differs.
fn compare(source: &Waveform, wanted: &Waveform) -> Result<(), String> {
    source.check_compatible(wanted).map_err(|mismatch| {
        let (what, expected, got) = (mismatch.what, mismatch.expected, mismatch.got);
        format!("the client asks for another waveform than the source has: {what} {expected}, the source has {got}")
    })
}

/// Returns whether the registers of two waveforms are equal except for the receivers.
fn matches_except_receivers(source: &Waveform, wanted: &Waveform) -> bool {
    let is_wanted = |mut waveform: Waveform| {
        waveform.request.rx_antennas = wanted.request.rx_antennas;
        waveform == *wanted
    };
    let configuration = ChipConfiguration { waveform: source.clone(), slice_samples: FIFO_SAMPLES / 2 };
    is_wanted(source.clone()) || configuration.realised().is_ok_and(is_wanted)
}

/// Origin of a producer's first source.
enum FirstSource {
    Given(Box<dyn FrameSource>),
    /// The source has to be made; its first frame is at this time.
    Made {
        from: Duration,
    },
}

/// Thread that runs a source.
struct Producer {
    waveform: Waveform,
    maker: Arc<Mutex<Maker>>,
    repeat: bool,
    outgoing: Sender<Message>,
    free_frames: Receiver<Frame>,
}

/// End of a source: number of frames, and start of the frame that would follow, ns.
struct SourceEnd {
    frames: u64,
    next_ns: u64,
}

impl Producer {
    /// Starts a thread. It ends with its source or with the receiving end of the channel.
    fn start(
        waveform: Waveform,
        maker: Arc<Mutex<Maker>>,
        repeat: bool,
        first_source: FirstSource,
    ) -> std::io::Result<(Receiver<Message>, Sender<Frame>, JoinHandle<()>)> {
        let (outgoing, incoming) = bounded(FRAMES_AHEAD);
        let (to_producer, free_frames) = bounded(FRAMES_AHEAD + 2);
        let producer = Producer { waveform, maker, repeat, outgoing, free_frames };
        let thread = thread::Builder::new().name("emulator source".into()).spawn(move || producer.run(first_source))?;
        Ok((incoming, to_producer, thread))
    }

    fn run(self, first_source: FirstSource) {
        let mut source = match first_source {
            FirstSource::Given(source) => source,
            FirstSource::Made { from } => match self.make(from) {
                Ok(source) => source,
                Err(reason) => return self.send(Message::Refused(reason)),
            },
        };
        let mut start_ns = None;
        loop {
            // The channel is closed, or the reason of the end has been sent.
            let Some(end) = self.forward_frames(source.as_mut(), start_ns) else { return };
            // A source without a frame is not opened again, which would never end.
            if !self.repeat || end.frames == 0 {
                return self.send(Message::End);
            }
            source = match self.reopen() {
                Ok(Some(source)) => source,
                Ok(None) => return self.send(Message::End),
                Err(reason) => return self.send(Message::Failed(reason)),
            };
            start_ns = Some(end.next_ns);
        }
    }

    /// Sends the message, if the channel is open.
    fn send(&self, message: Message) {
        let _ = self.outgoing.send(message);
    }

    /// Forwards all frames of a source. If another source came before it, its first frame begins at `start_ns`.
    fn forward_frames(&self, source: &mut dyn FrameSource, start_ns: Option<u64>) -> Option<SourceEnd> {
        let shape = self.waveform.shape();
        let interval_ns = (self.waveform.frame_interval_s() * 1e9) as u64;
        let mut end = SourceEnd { frames: 0, next_ns: start_ns.unwrap_or(0) };
        let mut first_ns = None;
        loop {
            let mut frame = self.free_frames.try_recv().unwrap_or_else(|_| Frame::zeroed(shape));
            let message = match source.next_frame(&mut frame) {
                Ok(SourceEvent::Frame) if frame.shape == shape && frame.codes.len() == shape.codes() => {
                    let first_ns = *first_ns.get_or_insert(frame.time_ns);
                    if let Some(start_ns) = start_ns {
                        frame.time_ns = start_ns.saturating_add(frame.time_ns.saturating_sub(first_ns));
                    }
                    end.frames += 1;
                    end.next_ns = frame.time_ns.saturating_add(interval_ns);
                    Message::Frame(frame)
                }
                Ok(SourceEvent::Frame) => {
                    let got = frame.shape;
                    self.send(Message::Failed(format!("the source gave a frame of {got} instead of {shape}")));
                    return None;
                }
                Ok(SourceEvent::Gap(gap)) => Message::Gap { frames: gap.frames },
                Ok(SourceEvent::End) => return Some(end),
                Err(error) => {
                    self.send(Message::Failed(with_causes(&*error)));
                    return None;
                }
            };
            self.outgoing.send(message).ok()?;
        }
    }

    /// Makes frames of the waveform, from this time on.
    fn make(&self, from: Duration) -> Result<Box<dyn FrameSource>, String> {
        let mut maker = self.maker.lock().unwrap_or_else(PoisonError::into_inner);
        let Maker::Waveforms(make) = &mut *maker else { return Err("the source has frames of one waveform".into()) };
        let source = make(&self.waveform, from).map_err(|error| with_causes(&*error))?;
        compare(source.waveform(), &self.waveform)?;
        Ok(source)
    }

    /// Opens the source that has ended again; `None` if that is not possible.
    fn reopen(&self) -> Result<Option<Box<dyn FrameSource>>, String> {
        match &mut *self.maker.lock().unwrap_or_else(PoisonError::into_inner) {
            Maker::Reopen(open) => open().map(Some).map_err(|error| with_causes(&*error)),
            Maker::Waveforms(_) | Maker::None => Ok(None),
        }
    }
}
