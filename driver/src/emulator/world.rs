//! What the emulated chip samples: codes of a frame source in FIFO order, and when.

use std::collections::VecDeque;
use std::thread;
use std::time::Instant;

use crossbeam::channel::{Receiver, Sender, TryRecvError, bounded};
use radome_dsp::{FIFO_SAMPLES, Frame, FrameShape, FrameSource, SourceEvent, Waveform};

use super::Pace;
use crate::chip::test_pattern;
use crate::protocol::fifo;
use crate::timing::SampleTiming;

/// Frames that the source may be ahead.
const FRAMES_AHEAD: usize = 2;

enum Message {
    Frame(Frame),
    Gap { frames: u64 },
    End,
}

/// What there is to send.
pub(super) enum Slice {
    /// So many codes, complete at this board time.
    Ready { time_us: u64 },
    /// Frames are missing in the source.
    Missing { frames: u64 },
    /// Not yet.
    Wait,
    /// Nothing will come any more.
    End,
}

pub(super) struct World {
    incoming: Receiver<Message>,
    spare: Sender<Frame>,
    shape: FrameShape,
    timing: SampleTiming,
    /// Indices of the source's receivers that the chip has switched on.
    channels: Vec<usize>,
    codes_per_frame: u64,
    /// Place of RX1 among the channels, and the next word of the test pattern, if the chip sends that.
    test_pattern: Option<(usize, u16)>,
    pace: Pace,
    /// A frame whose time has not come.
    upcoming: Option<Frame>,
    /// Codes of frames not yet sent, FIFO order; those before `sent` have been.
    codes: Vec<u16>,
    sent: usize,
    /// Codes taken out, and codes put in, since the frames started.
    taken: u64,
    put: u64,
    /// First code and time of the frames that `codes` holds.
    frames: VecDeque<(u64, u64)>,
    /// A gap that comes after the codes.
    missing: u64,
    has_begun: bool,
    ended: bool,
    /// Wall-clock time at which the source's time was this many nanoseconds.
    clock: Option<(Instant, u64)>,
    /// When the chip started again, ns: frames before that are passed over.
    started_ns: Option<u64>,
    /// When it was last reset, ns.
    stopped_ns: Option<u64>,
}

impl World {
    /// Takes frames from the source in a thread of their own: a slow source must not keep the firmware from answering.
    pub fn new(source: Box<dyn FrameSource>, pace: Pace) -> std::io::Result<Self> {
        let waveform = source.waveform().clone();
        let (to_world, incoming) = bounded(FRAMES_AHEAD);
        let (spare, from_world) = bounded(FRAMES_AHEAD + 2);
        // The thread ends with the source or with the world's end of the channel.
        thread::Builder::new().name("emulator source".into()).spawn(move || produce(source, &to_world, &from_world))?;
        Ok(World {
            incoming,
            spare,
            shape: waveform.shape(),
            timing: SampleTiming::new(&waveform),
            channels: (0..waveform.shape().rx).collect(),
            codes_per_frame: waveform.shape().codes() as u64,
            test_pattern: None,
            pace,
            upcoming: None,
            codes: Vec::new(),
            sent: 0,
            taken: 0,
            put: 0,
            frames: VecDeque::new(),
            missing: 0,
            has_begun: false,
            ended: false,
            clock: None,
            started_ns: None,
            stopped_ns: None,
        })
    }

    /// The chip starts frames with this waveform and these receivers of the source, and sends its test pattern instead
    /// of one of them.
    pub fn restart(&mut self, waveform: &Waveform, channels: Vec<usize>, test_pattern: Option<usize>) {
        self.test_pattern = test_pattern.map(|channel| (channel, test_pattern::FIRST));
        self.timing = SampleTiming::new(waveform);
        self.codes_per_frame = (channels.len() * self.shape.chirps * self.shape.samples) as u64;
        self.channels = channels;
        self.codes.clear();
        self.sent = 0;
        self.frames.clear();
        (self.taken, self.put, self.missing) = (0, 0, 0);
        // Who resets and starts at once loses no frame in between.
        let at_once = |now: u64, stopped: u64| (now - stopped) as f64 * 1e-9 < self.timing.frame_interval_s();
        let stopped = self.stopped_ns.take();
        self.started_ns = self.now_ns().map(|now| stopped.filter(|s| *s <= now && at_once(now, *s)).unwrap_or(now));
        self.has_begun = true;
    }

    /// The chip is about to be reset: nothing is sampled any more.
    pub fn stop(&mut self) {
        self.stopped_ns = self.stopped_ns.or(self.now_ns());
    }

    /// Source time by the wall clock, ns.
    fn now_ns(&self) -> Option<u64> {
        let Pace::RealTime(speed) = self.pace else { return None };
        let (instant, time_ns) = self.clock?;
        Some(time_ns + (instant.elapsed().as_nanos() as f64 * speed) as u64)
    }

    /// Lets the world go on while the host reads nothing: frames are sampled when their time has come.
    pub fn advance(&mut self) {
        let Some(now) = self.now_ns() else {
            // The first frame sets the clock.
            if self.has_begun && !self.waits() {
                self.pull();
            }
            return;
        };
        let ahead = 3 * self.fifo_limit();
        while self.frames.back().is_none_or(|(_, time_ns)| *time_ns <= now) && self.put < self.taken + ahead {
            let put = self.put;
            self.pull();
            if self.put == put {
                return;
            }
        }
    }

    /// How much faster than real this world goes, as far as it can be told.
    pub fn speed(&self) -> f64 {
        match self.pace {
            Pace::RealTime(speed) => speed.clamp(1.0, 100.0),
            Pace::AsFastAsRead => 1.0,
        }
    }

    /// Whether the world waits for whoever reads it: nothing overflows then.
    pub fn waits(&self) -> bool {
        self.pace == Pace::AsFastAsRead
    }

    fn pull(&mut self) {
        if self.ended || self.missing > 0 {
            return;
        }
        let frame = match self.upcoming.take().map_or_else(|| self.receive(), Some) {
            Some(frame) => frame,
            None => return,
        };
        if self.now_ns().is_some_and(|now| frame.time_ns > now) {
            self.upcoming = Some(frame);
            return;
        }
        // One that has a chirp is counted as measured; it ended with the start.
        let had_begun =
            |started: u64| self.timing.chirps_after(started.saturating_sub(frame.time_ns) as f64 * 1e-9) > 0;
        if self.started_ns.is_some_and(had_begun) {
            let _ = self.spare.try_send(frame);
            return;
        }
        self.started_ns = None;
        self.frames.push_back((self.put, frame.time_ns));
        let start = self.codes.len();
        fifo::interleave(&frame.codes, self.shape, &self.channels, &mut self.codes);
        if let Some((channel, word)) = &mut self.test_pattern {
            for code in self.codes.iter_mut().skip(start + *channel).step_by(self.channels.len().max(1)) {
                *code = *word;
                *word = test_pattern::next(*word);
            }
        }
        self.put += self.codes_per_frame;
        let _ = self.spare.try_send(frame);
    }

    /// The source's next frame, if it is there.
    fn receive(&mut self) -> Option<Frame> {
        let frame = match self.incoming.try_recv() {
            Ok(Message::Frame(frame)) => frame,
            Ok(Message::Gap { frames }) => {
                self.missing = frames;
                return None;
            }
            Ok(Message::End) | Err(TryRecvError::Disconnected) => {
                self.ended = true;
                return None;
            }
            Err(TryRecvError::Empty) => return None,
        };
        // A source that is late makes the world late; it does not make the host slow.
        let is_late = self.now_ns().is_none_or(|now| now > frame.time_ns) && self.started_ns.is_none();
        if is_late && matches!(self.pace, Pace::RealTime(_)) {
            self.clock = Some((Instant::now(), frame.time_ns));
        }
        Some(frame)
    }

    /// Board time at which this code has been sampled, ns.
    fn time_ns(&self, code: u64) -> u64 {
        let frame = self.frames.iter().rev().find(|(first, _)| *first <= code);
        let (first, time_ns) = frame.copied().unwrap_or((self.taken, 0));
        time_ns + (self.timing.in_frame_s(code - first) * 1e9) as u64
    }

    /// Whether a slice of this many codes is there.
    pub fn slice(&mut self, samples: u64) -> Slice {
        self.advance();
        if self.put < self.taken + samples {
            self.pull();
        }
        if self.put < self.taken + samples {
            return match (self.missing, self.ended) {
                (0, true) => Slice::End,
                (0, false) => Slice::Wait,
                (frames, _) => {
                    self.missing = 0;
                    Slice::Missing { frames }
                }
            };
        }
        let ready_ns = self.time_ns(self.taken + samples - 1);
        if self.now_ns().is_some_and(|now| ready_ns > now) {
            return Slice::Wait;
        }
        Slice::Ready { time_us: ready_ns / 1000 }
    }

    /// Whether more has been sampled than the FIFO holds.
    pub fn overflows(&self) -> bool {
        !self.waits() && self.in_fifo() > self.fifo_limit()
    }

    /// Codes that the FIFO holds before it overflows. A world that goes faster than real gives the chip as much more
    /// memory: the host, whose delays do not shrink, may be late by the same time.
    fn fifo_limit(&self) -> u64 {
        (FIFO_SAMPLES as f64 * self.speed()) as u64
    }

    /// Codes sampled since the frames started, those not yet taken from the source too. A world that waits has sampled what is
    /// there.
    pub fn sampled(&self) -> u64 {
        let Some(now) = self.stopped_ns.or(self.now_ns()) else { return self.put };
        let sampled = |(first, time_ns): &(u64, u64)| {
            first + self.timing.sampled_after(now.saturating_sub(*time_ns) as f64 * 1e-9)
        };
        let of_last = |(first, time_ns): &(u64, u64)| {
            first + self.timing.sampled_in_stream(now.saturating_sub(*time_ns) as f64 * 1e-9)
        };
        let last = self.frames.back().filter(|_| !self.ended).map(of_last);
        self.frames.iter().map(sampled).chain(last).max().unwrap_or(self.taken)
    }

    /// Codes sampled and not taken out.
    pub fn in_fifo(&self) -> u64 {
        self.sampled().saturating_sub(self.taken)
    }

    /// Codes taken out since the frames started.
    pub fn taken(&self) -> u64 {
        self.taken
    }

    /// Codes taken from the source and not taken out.
    pub fn at_hand(&self) -> usize {
        self.codes.len() - self.sent
    }

    /// Codes of the slice that is ready.
    pub fn codes(&self, samples: usize) -> &[u16] {
        self.codes.get(self.sent..self.sent + samples).unwrap_or(&[])
    }

    /// Removes codes, and the frames that were sent with them.
    pub fn take(&mut self, samples: usize) {
        self.sent = (self.sent + samples).min(self.codes.len());
        // Moved together now and then only: moving everything for each slice would cost more than sending it.
        if 2 * self.sent >= self.codes.len() {
            self.codes.drain(..self.sent);
            self.sent = 0;
        }
        self.taken += samples as u64;
        while self.frames.get(1).is_some_and(|(first, _)| *first <= self.taken) {
            self.frames.pop_front();
        }
    }

    /// Whether slices end where frames do: the codes taken so far are whole frames.
    pub fn at_frame_boundary(&self) -> bool {
        self.taken.is_multiple_of(self.codes_per_frame.max(1))
    }
}

fn produce(mut source: Box<dyn FrameSource>, to_world: &Sender<Message>, spare: &Receiver<Frame>) {
    let shape = source.waveform().shape();
    loop {
        let mut frame = spare.try_recv().unwrap_or_else(|_| Frame::zeroed(shape));
        let message = match source.next_frame(&mut frame) {
            Ok(SourceEvent::Frame) if frame.shape == shape && frame.codes.len() == shape.codes() => {
                Message::Frame(frame)
            }
            Ok(SourceEvent::Frame) => {
                tracing::error!(got = %frame.shape, expected = %shape, "the source changed the shape of its frames");
                Message::End
            }
            Ok(SourceEvent::Gap(gap)) => Message::Gap { frames: gap.frames },
            Ok(SourceEvent::End) => Message::End,
            Err(error) => {
                tracing::error!(error, "the source failed");
                Message::End
            }
        };
        let last = matches!(message, Message::End);
        if to_world.send(message).is_err() || last {
            return;
        }
    }
}
