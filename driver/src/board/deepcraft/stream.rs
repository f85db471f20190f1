//! Frame stream of a DEEPCRAFT board.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use radome_dsp::{Frame, FrameSource, GapReason, SourceError, SourceEvent, Waveform};

use super::board::{DeepcraftBoard, Setting};
use super::resequencer::Resequencer;
use crate::board::host::now_ns;
use crate::board::read_deadline::ReadDeadline;
use crate::board::reconnect::{Outage, Reconnect, Reconnectable, Recovery, check_same, next_event};
use crate::board::{BoardError, DeepcraftError};
use crate::chip::RegisterList;
use crate::protocol::deepcraft::{
    CapabilitiesRequest, ChunkEvent, ChunkLayout, ChunkParser, Command, ErrorCode, FIFO_LEVEL_CODES, StartRequest,
    holds_frames_of,
};
use crate::transport::trace;

/// Silence at the end of a chunk that confirms it: packets of a message follow each other within a millisecond.
const SILENCE: Duration = Duration::from_millis(5);
/// Silence after which the rest of a message is given up. Later bytes are the start of another message.
const LONG_SILENCE: Duration = Duration::from_millis(500);

/// Longest wait for the number of frames that the board has dropped.
const DROPPED_COUNT_TIMEOUT: Duration = Duration::from_millis(300);

/// A running acquisition. It ends with [`DeepcraftStream::stop`] or when dropped.
///
/// A board with a watchdog stops by itself unless it hears from the host. The stream resets the watchdog when it is
/// polled and a third of the watchdog's time has passed. If it is not polled for longer than the whole time, the stream
/// is started anew and reports a gap.
///
/// When frame numbers jump, the board is asked how many frames it has dropped itself, so that the gap has its reason.
pub struct DeepcraftStream {
    board: Option<DeepcraftBoard>,
    setting: Setting,
    /// Index of the stream among those of the radar.
    stream_index: usize,
    parser: ChunkParser,
    resequencer: Resequencer,
    /// Longest silence between two chunks.
    deadline: Duration,
    watchdog: Option<Duration>,
    watchdog_reset: Instant,
    restart: Option<GapReason>,
    /// Deadline for the board's answer about dropped frames, while one is awaited.
    dropped_count_deadline: Option<Instant>,
    path: PathBuf,
    uuid: String,
    recovery: Recovery,
    last_byte: Instant,
    /// Time at which the last chunk came, or the stream began.
    last_chunk: Instant,
}

impl DeepcraftBoard {
    /// Configures the radar and starts frames. A waveform that equals a preset of the firmware selects that preset. Any
    /// other waveform is sent as registers; the stream's waveform then has the chirp and frame intervals that they
    /// realise.
    ///
    /// # Errors
    /// [`DeepcraftError::Frame`] if the firmware cannot hold a frame, [`BoardError::Chip`] if the registers cannot hold
    /// the waveform; else an error of the connection or of the board.
    pub fn start(self, waveform: &Waveform) -> Result<DeepcraftStream, BoardError> {
        let codes = waveform.shape().codes();
        if !holds_frames_of(codes) {
            return Err(self.link.error(DeepcraftError::Frame { codes }));
        }
        let setting = self.setting_for(waveform)?;
        DeepcraftStream::start(self, setting)
    }
}

impl DeepcraftStream {
    fn start(mut board: DeepcraftBoard, setting: Setting) -> Result<Self, BoardError> {
        let shape = setting.waveform.shape();
        let stream = board.apply(&setting)?;
        let layout = ChunkLayout { device: board.device, stream: stream.index, frame_codes: shape.codes() };
        let parser = ChunkParser::new(layout, stream.next_number);
        // Small frames come together when they fill one read of the firmware.
        let frames = FIFO_LEVEL_CODES.div_ceil(shape.codes().max(1)).max(1) as f64;
        let now = Instant::now();
        let mut stream = DeepcraftStream {
            resequencer: Resequencer::new(&setting.realised, stream.next_number),
            stream_index: usize::try_from(stream.index).unwrap_or(0),
            parser,
            deadline: Duration::from_secs_f64(1.0 + 3.0 * frames * setting.realised.frame_interval_s()),
            setting,
            watchdog: board.watchdog,
            watchdog_reset: now,
            restart: None,
            dropped_count_deadline: None,
            path: board.link.path.clone(),
            uuid: board.identity.uuid.clone(),
            recovery: Recovery::default(),
            last_byte: now,
            last_chunk: now,
            board: Some(board),
        };
        stream.send_start()?;
        Ok(stream)
    }

    fn board(&mut self) -> Result<&mut DeepcraftBoard, BoardError> {
        self.board.as_mut().ok_or(BoardError::Stopped)
    }

    /// Sends the request that starts frames.
    fn send_start(&mut self) -> Result<(), BoardError> {
        let board = self.board()?;
        let device = board.device;
        board.link.reset_watchdog()?;
        board.link.send("start", Command::Start(StartRequest { device }))?;
        (self.last_byte, self.watchdog_reset) = (Instant::now(), Instant::now());
        Ok(())
    }

    /// Configures the radar again and starts frames.
    fn configure_and_start(&mut self) -> Result<(), BoardError> {
        let board = self.board.as_mut().ok_or(BoardError::Stopped)?;
        let stream = board.apply(&self.setting)?;
        self.parser.restart(stream.next_number);
        self.dropped_count_deadline = None;
        self.send_start()
    }

    /// Makes the stream reconnect after the board was unplugged or has stalled; [`FrameSource::next_frame`] then waits
    /// for it. The frames lost meanwhile become a gap, counted by the host's clock.
    pub fn with_reconnect(mut self, policy: Reconnect) -> Self {
        self.recovery.policy = Some(policy);
        self
    }

    /// Returns a handle that tells, from any thread, whether the board is away.
    pub fn outage(&self) -> Outage {
        self.recovery.outage.clone()
    }

    /// Register list that was sent to the board; empty for a preset of the firmware.
    pub fn registers(&self) -> &RegisterList {
        &self.setting.registers
    }

    /// Reads the next frame or gap; `None` if none is there within `timeout`.
    ///
    /// # Errors
    /// [`BoardError`] if the connection breaks, the board reports an error or refuses to start again, or the stream was
    /// stopped.
    pub fn poll(&mut self, frame: &mut Frame, timeout: Duration) -> Result<Option<SourceEvent>, BoardError> {
        let mut deadline = ReadDeadline::new(timeout);
        let mut is_renewed = false;
        loop {
            self.keep_alive()?;
            self.take_dropped_count();
            if let Some(event) = self.pop(frame) {
                if event == SourceEvent::Frame {
                    frame.host_time_ns = now_ns();
                }
                return Ok(Some(event));
            }
            if let Some(reason) = self.restart.take() {
                tracing::warn!(reason = reason.name(), "the board is started anew");
                self.resequencer.restart(reason);
                self.configure_and_start()?;
                // A board that is started anew again and again counts as stalled.
                if !std::mem::replace(&mut is_renewed, true) {
                    deadline.restart();
                }
            }
            if self.take_message()? {
                continue;
            }
            let Some(wait) = deadline.next_read() else { return Ok(None) };
            deadline.note_read(self.receive(wait)?);
        }
    }

    /// Takes the next message among the received bytes; returns whether there was one.
    fn take_message(&mut self) -> Result<bool, BoardError> {
        // Queued frames are handed out before the next chunk is parsed.
        if self.dropped_count_deadline.is_some() {
            return Ok(false);
        }
        match self.parser.next_event() {
            Some(ChunkEvent::Frames { frame_number, frame_count, codes }) => {
                self.resequencer.push_chunk(frame_number, frame_count, codes, self.last_chunk.elapsed());
                self.last_chunk = Instant::now();
                if self.resequencer.needs_reason() {
                    self.request_dropped_count()?;
                }
            }
            Some(ChunkEvent::Misnumbered) => self.resequencer.note_damage(),
            Some(ChunkEvent::Damaged) => self.restart = Some(GapReason::Crc),
            Some(ChunkEvent::Error(error)) => {
                let (code, message) = (ErrorCode(error.code), error.message);
                let source = DeepcraftError::Refused { command: "start", code, message };
                return Err(BoardError::Deepcraft { path: self.path.clone(), source });
            }
            None => return Ok(false),
        }
        Ok(true)
    }

    fn pop(&mut self, frame: &mut Frame) -> Option<SourceEvent> {
        if self.dropped_count_deadline.is_some() { None } else { self.resequencer.pop(frame) }
    }

    /// Asks the device for the number of frames that it has dropped.
    fn request_dropped_count(&mut self) -> Result<(), BoardError> {
        let board = self.board()?;
        let (device, tag) = (board.device, board.link.next_tag());
        board.link.send("capabilities", Command::Capabilities(CapabilitiesRequest { device, tag }))?;
        self.parser.await_answer(tag);
        self.dropped_count_deadline = Some(Instant::now() + DROPPED_COUNT_TIMEOUT);
        Ok(())
    }

    /// Takes the answer about dropped frames, or gives up after its deadline.
    fn take_dropped_count(&mut self) {
        let Some(until) = self.dropped_count_deadline else { return };
        if let Some(answer) = self.parser.take_answer() {
            let devices = answer.board.map_or(Vec::new(), |board| board.devices);
            let device = self.board.as_ref().map(|board| board.device);
            let radar = devices.iter().find(|d| Some(d.device_id) == device);
            let stream = radar.and_then(|d| d.streams.get(self.stream_index));
            self.resequencer.set_dropped(stream.and_then(|s| u64::try_from(s.frames_dropped).ok()).unwrap_or(0));
            self.dropped_count_deadline = None;
        } else if Instant::now() >= until {
            self.dropped_count_deadline = None;
        }
    }

    /// Reads bytes, waiting at most `timeout`, and notes silence. Returns whether any came.
    fn receive(&mut self, timeout: Duration) -> Result<bool, BoardError> {
        let longest = if self.parser.is_waiting() { SILENCE } else { Duration::from_millis(50) };
        let board = self.board.as_mut().ok_or(BoardError::Stopped)?;
        let bytes = board.link.receive(timeout.min(longest))?;
        if !bytes.is_empty() {
            trace::measured(bytes.len());
            self.last_byte = Instant::now();
            self.parser.push(bytes);
            return Ok(true);
        }
        if self.last_byte.elapsed() >= SILENCE {
            self.parser.on_silence();
        }
        if self.last_byte.elapsed() >= LONG_SILENCE {
            self.parser.on_long_silence();
        }
        Ok(false)
    }

    /// Resets the watchdog when a third of its time has passed; restarts the stream if all of its time has passed.
    fn keep_alive(&mut self) -> Result<(), BoardError> {
        let (Some(timeout), Some(board)) = (self.watchdog, &mut self.board) else { return Ok(()) };
        let elapsed = self.watchdog_reset.elapsed();
        if elapsed >= timeout {
            self.restart = Some(GapReason::Disconnected);
            self.watchdog_reset = Instant::now();
        } else if elapsed >= timeout / 3 {
            board.link.reset_watchdog()?;
            self.watchdog_reset = Instant::now();
        }
        Ok(())
    }

    /// Stops the acquisition and returns the board.
    ///
    /// # Errors
    /// An error of the connection, or [`BoardError::Stopped`] if it has been stopped before.
    pub fn stop(mut self) -> Result<DeepcraftBoard, BoardError> {
        let mut board = self.board.take().ok_or(BoardError::Stopped)?;
        board.link.stop()?;
        Ok(board)
    }
}

impl Drop for DeepcraftStream {
    fn drop(&mut self) {
        if let Some(mut board) = self.board.take()
            && let Err(error) = board.link.stop()
        {
            tracing::debug!(%error, "the board could not be stopped");
        }
    }
}

impl FrameSource for DeepcraftStream {
    fn waveform(&self) -> &Waveform {
        &self.setting.realised
    }

    fn next_frame(&mut self, frame: &mut Frame) -> Result<SourceEvent, SourceError> {
        Ok(next_event(self, frame)?)
    }
}

impl Reconnectable for DeepcraftStream {
    fn read_event(&mut self, frame: &mut Frame) -> Result<SourceEvent, BoardError> {
        let waited = self.deadline;
        self.poll(frame, waited)?.ok_or_else(|| BoardError::Stalled { path: self.path.clone(), waited })
    }

    fn close(&mut self) {
        self.board = None;
        self.restart = None;
    }

    fn reopen(&mut self) -> Result<(), BoardError> {
        let board = DeepcraftBoard::open(&self.path)?;
        check_same(&self.path, &self.uuid, &board.identity)?;
        self.board = Some(board);
        self.configure_and_start()?;
        self.resequencer.restart(GapReason::Disconnected);
        Ok(())
    }

    fn last_frame(&self) -> Instant {
        self.last_chunk
    }

    fn recovery(&mut self) -> &mut Recovery {
        &mut self.recovery
    }
}
