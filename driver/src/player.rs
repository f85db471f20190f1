//! Playback of a recording that can be paused, sought, stepped and played at any speed through a [`Transport`].

use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use radome_dsp::{Frame, FrameSource, SourceError, SourceEvent, Waveform};

use crate::recording::{Extent, Position, Recording, RecordingError};

/// Source of the frames of a recording as its [`Transport`] asks for them. It has no end: behind the last frame it
/// waits for a seek until the transport is closed.
///
/// Frames come when they are due, as from [`RealTime`](crate::RealTime). After a seek the frame sought comes at once,
/// also while paused. If a preroll is set, the frames of that time before come first, for consumers that keep state
/// from frame to frame.
///
/// ```no_run
/// use std::path::Path;
///
/// use radome_driver::Player;
/// use radome_driver::recording::Recording;
/// use radome_dsp::{Frame, FrameSource};
///
/// # fn main() -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
/// let recording = Recording::open(Path::new("night.mcap"))?;
/// if let Some(mut player) = Player::new(recording, 2.0)? {
///     let transport = player.transport();
///     transport.seek_time_s(60.0);
///     let mut frame = Frame::zeroed(player.waveform().shape());
///     player.next_frame(&mut frame)?;
/// }
/// # Ok(())
/// # }
/// ```
pub struct Player {
    recording: Recording,
    extent: Extent,
    transport: Transport,
    /// Instant at which a frame of this time, ns, is due. Cleared when the transport changes something.
    clock: Option<(Instant, u64)>,
    /// Number of the frame that was sought, while the frames of its preroll come.
    preroll_until: Option<u64>,
}

/// Handle that controls a [`Player`]. Clones control the same player.
#[derive(Debug, Clone)]
pub struct Transport {
    shared: Arc<(Mutex<State>, Condvar)>,
}

/// State of a player.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Playback {
    /// Whether the player is playing and not paused.
    pub playing: bool,
    /// Speed as a multiple of real time; 0 is as fast as possible.
    pub speed: f64,
    /// Position of the frame that was handed out last.
    pub position: Option<Position>,
    /// Whether the frame that was handed out last is the last one of the recording.
    pub at_end: bool,
}

#[derive(Debug)]
struct State {
    playback: Playback,
    seek_target: Option<SeekTarget>,
    /// Frames to step forwards, or backwards if negative.
    steps: i64,
    closed: bool,
    /// Whether the transport has changed something, so that the clock has to be set again.
    changed: bool,
    preroll_s: f64,
    /// Numbers of the frames that came before the one that was sought last.
    preroll: std::ops::Range<u64>,
}

#[derive(Debug, Clone, Copy)]
enum SeekTarget {
    Time(f64),
    Frame(u64),
}

/// Next action of the player.
enum Task {
    Close,
    Seek(SeekTarget),
    Step,
    StepBack,
    Play,
    Preroll,
}

impl Transport {
    fn state(&self) -> MutexGuard<'_, State> {
        self.shared.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Changes the state and wakes the player.
    fn update(&self, change: impl FnOnce(&mut State)) {
        let mut state = self.state();
        change(&mut state);
        state.changed = true;
        self.shared.1.notify_all();
    }

    /// Returns the state of the player.
    pub fn playback(&self) -> Playback {
        self.state().playback
    }

    /// Plays; from the start if the player is at the end.
    pub fn play(&self) {
        self.update(|state| {
            if state.playback.at_end && state.seek_target.is_none() {
                state.seek_target = Some(SeekTarget::Frame(0));
            }
            state.playback.playing = true;
        });
    }

    /// Pauses at the current frame.
    pub fn pause(&self) {
        self.update(|state| state.playback.playing = false);
    }

    /// Sets the speed as a multiple of real time; any value that is not a number above 0 means as fast as possible.
    pub fn set_speed(&self, speed: f64) {
        self.update(|state| state.playback.speed = valid_speed(speed));
    }

    /// Goes to the first frame at or after this time on the frames' own clock, s, or to the last one.
    pub fn seek_time_s(&self, time_s: f64) {
        self.update(|state| (state.seek_target, state.steps) = (Some(SeekTarget::Time(time_s)), 0));
    }

    /// Goes to the first frame with this number or a later one, or to the last one.
    pub fn seek_frame(&self, sequence: u64) {
        self.update(|state| (state.seek_target, state.steps) = (Some(SeekTarget::Frame(sequence)), 0));
    }

    /// Steps `frames` frames forwards, or backwards if negative, and pauses there.
    pub fn step(&self, frames: i64) {
        self.update(|state| {
            state.playback.playing = false;
            // More than a thousand steps at once are not intended.
            state.steps = state.steps.saturating_add(frames).clamp(-1000, 1000);
        });
    }

    /// Sets the duration of the frames that come before a frame that is sought, s.
    pub fn set_preroll_s(&self, preroll_s: f64) {
        self.state().preroll_s = preroll_s;
    }

    /// Returns whether a seek is pending: the position is still that of an earlier frame.
    pub fn is_seeking(&self) -> bool {
        let state = self.state();
        state.seek_target.is_some() || state.steps < 0
    }

    /// Returns whether a frame is part of the preroll of the frame that was sought.
    pub fn is_preroll(&self, sequence: u64) -> bool {
        self.state().preroll.contains(&sequence)
    }

    /// Ends the stream of frames.
    pub fn close(&self) {
        self.update(|state| state.closed = true);
    }
}

/// Returns the speed, or 0 for a speed that is not a number above 0.
fn valid_speed(speed: f64) -> f64 {
    if speed.is_finite() && speed > 0.0 { speed } else { 0.0 }
}

impl Player {
    /// Creates a player that plays from the start of a recording; `None` if the recording has no frame.
    ///
    /// # Errors
    /// [`RecordingError`] if the extent of the recording cannot be read.
    pub fn new(mut recording: Recording, speed: f64) -> Result<Option<Self>, RecordingError> {
        let Some(extent) = recording.extent()? else { return Ok(None) };
        let playback = Playback { playing: true, speed: valid_speed(speed), position: None, at_end: false };
        let state = State {
            playback,
            seek_target: None,
            steps: 0,
            closed: false,
            changed: false,
            preroll_s: 0.0,
            preroll: 0..0,
        };
        let transport = Transport { shared: Arc::new((Mutex::new(state), Condvar::new())) };
        Ok(Some(Player { recording, extent, transport, clock: None, preroll_until: None }))
    }

    /// Returns the positions of the first and the last frame.
    pub fn extent(&self) -> Extent {
        self.extent
    }

    /// Returns a handle that controls the player.
    pub fn transport(&self) -> Transport {
        self.transport.clone()
    }

    /// Waits until there is something to do.
    fn next_task(&mut self) -> Task {
        let mut state = self.transport.state();
        loop {
            if std::mem::take(&mut state.changed) {
                self.clock = None;
            }
            if state.closed {
                return Task::Close;
            }
            if let Some(target) = state.seek_target.take() {
                return Task::Seek(target);
            }
            match state.steps {
                ..=-1 => {
                    state.steps += 1;
                    return Task::StepBack;
                }
                _ if self.preroll_until.is_some() => return Task::Preroll,
                1.. => {
                    state.steps -= 1;
                    return Task::Step;
                }
                0 if state.playback.playing && !state.playback.at_end => return Task::Play,
                0 => {}
            }
            state = self.transport.shared.1.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Reads the next frame or gap of the recording; pauses at its end.
    fn next_event(&mut self, frame: &mut Frame) -> Result<SourceEvent, SourceError> {
        let event = self.recording.next_frame(frame)?;
        if event == SourceEvent::End {
            let playback = &mut self.transport.state().playback;
            (playback.at_end, playback.playing) = (true, false);
        }
        Ok(event)
    }

    /// Reads the next frame and skips gaps before it; `None` behind the last one.
    fn next_frame_without_gaps(&mut self, frame: &mut Frame) -> Result<Option<Position>, SourceError> {
        loop {
            match self.next_event(frame)? {
                SourceEvent::Frame => return Ok(Some(position(frame))),
                SourceEvent::Gap(_) => {}
                SourceEvent::End => return Ok(None),
            }
        }
    }

    /// Reads the frame at a target.
    fn read_at(&mut self, target: SeekTarget, frame: &mut Frame) -> Result<Option<Position>, SourceError> {
        let Extent { first, last } = self.extent;
        match target {
            SeekTarget::Time(time_s) if time_s >= last.time_s() => self.recording.seek_frame(last.sequence)?,
            SeekTarget::Time(time_s) if time_s.is_nan() || time_s <= first.time_s() => {
                self.recording.seek_frame(first.sequence)?
            }
            SeekTarget::Time(time_s) => self.recording.seek_time_s(time_s)?,
            SeekTarget::Frame(sequence) => self.recording.seek_frame(sequence.min(last.sequence))?,
        }
        self.transport.state().playback.at_end = false;
        self.next_frame_without_gaps(frame)
    }

    /// Reads the frame at a target, or the first frame of its preroll.
    fn seek(&mut self, target: SeekTarget, frame: &mut Frame) -> Result<Option<Position>, SourceError> {
        let Some(found) = self.read_at(target, frame)? else { return Ok(None) };
        let preroll_s = self.transport.state().preroll_s;
        if preroll_s > 0.0 {
            self.read_at(SeekTarget::Time(found.time_s() - preroll_s), frame)?;
        }
        // If the recording's clock has restarted, the seek leads to another frame.
        if frame.sequence > found.sequence {
            self.read_at(SeekTarget::Frame(found.sequence), frame)?;
        }
        let mut state = self.transport.state();
        state.preroll = frame.sequence..found.sequence;
        state.playback.position = Some(found);
        self.preroll_until = (frame.sequence < found.sequence).then_some(found.sequence);
        Ok(Some(position(frame)))
    }

    /// Reads the last frame before the one that was handed out last; the first frame if there is none before it.
    fn step_back(&mut self, frame: &mut Frame) -> Result<Option<Position>, SourceError> {
        let current = self.transport.state().playback.position.map_or(0, |position| position.sequence);
        let mut distance = 1;
        loop {
            let from = current.saturating_sub(distance).max(self.extent.first.sequence);
            let Some(mut found) = self.read_at(SeekTarget::Frame(from), frame)? else { return Ok(None) };
            if found.sequence < current || from <= self.extent.first.sequence {
                // Numbers may be missing in between: the last frame before the current one is taken.
                while let Some(next) = self.next_frame_without_gaps(frame)?.filter(|next| next.sequence < current) {
                    found = next;
                }
                return self.seek(SeekTarget::Frame(found.sequence), frame);
            }
            distance *= 2;
        }
    }

    /// Waits until a frame is due. Returns `false` if the frame has to be discarded because of a seek, a step
    /// back or the end.
    fn wait_until_due(&mut self, frame: &Frame) -> bool {
        let mut state = self.transport.state();
        let last_ns = state.playback.position.map_or(frame.time_ns, |position| position.time_ns);
        loop {
            if std::mem::take(&mut state.changed) {
                self.clock = None;
            }
            if state.closed || state.seek_target.is_some() || state.steps < 0 {
                return false;
            }
            if state.steps > 0 {
                state.steps -= 1;
                return true;
            }
            let condition = &self.transport.shared.1;
            if !state.playback.playing {
                state = condition.wait(state).unwrap_or_else(PoisonError::into_inner);
                continue;
            }
            if state.playback.speed == 0.0 {
                return true;
            }
            let now = Instant::now();
            let (start, start_ns) = *self.clock.get_or_insert((now, last_ns.min(frame.time_ns)));
            let Some(elapsed_ns) = frame.time_ns.checked_sub(start_ns) else {
                // The clock of the recording has restarted.
                self.clock = Some((now, frame.time_ns));
                return true;
            };
            let due = Duration::try_from_secs_f64(elapsed_ns as f64 * 1e-9 / state.playback.speed);
            let due = due.unwrap_or(Duration::MAX);
            let remaining = due.saturating_sub(now - start);
            if remaining.is_zero() {
                // A player that has fallen behind by more than a second does not catch up.
                if (now - start).saturating_sub(due) > Duration::from_secs(1) {
                    self.clock = Some((now, frame.time_ns));
                }
                return true;
            }
            let result = condition.wait_timeout(state, remaining.min(Duration::from_secs(3600)));
            state = result.unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

fn position(frame: &Frame) -> Position {
    Position { sequence: frame.sequence, time_ns: frame.time_ns }
}

impl FrameSource for Player {
    fn waveform(&self) -> &Waveform {
        self.recording.waveform()
    }

    fn next_frame(&mut self, frame: &mut Frame) -> Result<SourceEvent, SourceError> {
        loop {
            let found = match self.next_task() {
                Task::Close => return Ok(SourceEvent::End),
                Task::Seek(target) => self.seek(target, frame)?,
                Task::Step => self
                    .next_frame_without_gaps(frame)?
                    .inspect(|found| self.transport.state().playback.position = Some(*found)),
                Task::StepBack => self.step_back(frame)?,
                Task::Preroll => {
                    let found = self.next_frame_without_gaps(frame)?;
                    self.preroll_until = self.preroll_until.filter(|until| found.is_some_and(|f| f.sequence < *until));
                    found
                }
                Task::Play => match self.next_event(frame)? {
                    SourceEvent::Frame => self.wait_until_due(frame).then(|| {
                        let found = position(frame);
                        self.transport.state().playback.position = Some(found);
                        found
                    }),
                    SourceEvent::Gap(gap) => return Ok(SourceEvent::Gap(gap)),
                    SourceEvent::End => None,
                },
            };
            if found.is_some() {
                return Ok(SourceEvent::Frame);
            }
        }
    }

    fn frame_count(&self) -> Option<u64> {
        self.recording.frame_count()
    }
}
