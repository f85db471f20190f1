//! Frame stream of a Radar Baseboard MCU7.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use radome_dsp::{Frame, FrameSource, GapReason, SourceError, SourceEvent, Waveform};

use super::assembler::{Assembler, Outcome};
use super::board::Mcu7Board;
use super::link::Incoming;
use crate::board::BoardError;
use crate::board::host::now_ns;
use crate::board::read_deadline::ReadDeadline;
use crate::board::reconnect::{Outage, Reconnect, Reconnectable, Recovery, check_same, next_event};
use crate::chip::{ChipConfiguration, RegisterList, SpiWord};
use crate::protocol::mcu7::{Command, DataError, SliceLayout};
use crate::transport::Address;

/// Write of MAIN that resets FIFO and state machine, as the vendor's client stops the chip.
const STOP: SpiWord = SpiWord { address: 0, write: true, value: 0x1E_827C };

/// Largest number of restarts of the board without a frame in between.
const MOST_RESTARTS: u32 = 20;

/// A running acquisition. It ends with [`Mcu7Stream::stop`] or when dropped.
pub struct Mcu7Stream {
    board: Option<Mcu7Board>,
    waveform: Waveform,
    registers: RegisterList,
    slice: SliceLayout,
    assembler: Assembler,
    /// Longest silence between two packets, from the frame interval.
    deadline: Duration,
    restart: Option<GapReason>,
    /// Number of restarts since the last frame.
    restarts: u32,
    path: PathBuf,
    address: Address,
    uuid: String,
    recovery: Recovery,
    /// Time at which the last frame was handed out, or the stream began.
    last_frame: Instant,
}

impl Mcu7Board {
    /// Programs the chip and starts frames. The stream's waveform has the chirp and frame intervals that the registers
    /// realise.
    ///
    /// # Errors
    /// [`BoardError::Chip`] if the registers cannot hold the waveform; else an error of the connection or of the board.
    pub fn start(self, waveform: &Waveform) -> Result<Mcu7Stream, BoardError> {
        let slice = SliceLayout::for_frame_as(waveform.shape().codes(), self.link.framing());
        let configuration = ChipConfiguration { waveform: waveform.clone(), slice_samples: slice.samples };
        let registers = configuration.compile()?;
        // The registers hold intervals only approximately. Frames come at the interval that they realise.
        let realised = configuration.with_realised_intervals()?;
        let assembler = Assembler::new(&realised, slice);
        let deadline = Duration::from_secs_f64(1.0 + 3.0 * realised.frame_interval_s());
        let mut stream = Mcu7Stream {
            path: self.link.path.clone(),
            address: self.link.address.clone(),
            uuid: self.identity().uuid.clone(),
            recovery: Recovery::default(),
            last_frame: Instant::now(),
            board: Some(self),
            waveform: realised,
            registers,
            slice,
            assembler,
            deadline,
            restart: None,
            restarts: 0,
        };
        stream.program()?;
        Ok(stream)
    }
}

impl Mcu7Stream {
    fn board(&mut self) -> Result<&mut Mcu7Board, BoardError> {
        self.board.as_mut().ok_or(BoardError::Stopped)
    }

    /// Programs the chip and starts data.
    fn program(&mut self) -> Result<(), BoardError> {
        let words: Vec<SpiWord> = self.registers.iter().map(|r| (*r).into()).collect();
        let slice = self.slice;
        let slice_samples = slice.samples as u16;
        let link = &mut self.board()?.link;
        link.request_ok(&Command::StopData)?;
        link.request_ok(&Command::HardwareReset)?;
        link.request_ok(&Command::ConfigureData { slice_samples })?;
        link.set_slice_layout(Some(slice));
        link.request_ok(&Command::StartData)?;
        link.request_ok(&Command::Execute { words, answer: false })?;
        Ok(())
    }

    /// Makes the stream reconnect after the board was unplugged or has stalled; [`FrameSource::next_frame`] then waits
    /// for it. The frames lost meanwhile become a gap, counted by the board's clock if it has kept running, otherwise
    /// by the host's clock to about one frame.
    pub fn with_reconnect(mut self, policy: Reconnect) -> Self {
        self.recovery.policy = Some(policy);
        self
    }

    /// Returns a handle that tells, from any thread, whether the board is away.
    pub fn outage(&self) -> Outage {
        self.recovery.outage.clone()
    }

    /// Register list that was written to the chip.
    pub fn registers(&self) -> &RegisterList {
        &self.registers
    }

    /// Reads the next frame or gap; `None` if none is there within `timeout`.
    ///
    /// # Errors
    /// [`BoardError`] if the connection breaks, the board refuses to start again, stops by itself or sends no frame
    /// after many restarts, or the stream was stopped.
    pub fn poll(&mut self, frame: &mut Frame, timeout: Duration) -> Result<Option<SourceEvent>, BoardError> {
        let mut deadline = ReadDeadline::new(timeout);
        loop {
            if let Some(event) = self.assembler.pop(frame) {
                if event == SourceEvent::Frame {
                    frame.host_time_ns = now_ns();
                    self.last_frame = Instant::now();
                    self.restarts = 0;
                }
                return Ok(Some(event));
            }
            if let Some(reason) = self.restart.take() {
                self.start_anew(reason)?;
                deadline.restart();
            }
            self.take_packets()?;
            // Completed frames are handed out before later packets are parsed.
            if self.restart.is_some() || self.assembler.is_ready() {
                continue;
            }
            let Some(wait) = deadline.next_read() else { return Ok(None) };
            deadline.note_read(self.board()?.link.receive(wait.min(Duration::from_millis(50)))?);
        }
    }

    /// Starts the board again, unless that has often been in vain.
    fn start_anew(&mut self, reason: GapReason) -> Result<(), BoardError> {
        self.restarts += 1;
        let (restarts, reason_name) = (self.restarts, reason.name());
        match restarts {
            1 => tracing::warn!(reason = reason_name, "the board is started anew"),
            2..=MOST_RESTARTS => tracing::debug!(reason = reason_name, restarts, "the board is started anew"),
            _ => return Err(BoardError::NoFrame { path: self.path.clone(), restarts, reason: reason_name }),
        }
        self.assembler.restart(reason);
        self.program()
    }

    /// Takes received packets until a frame is complete, the board has to be started anew, or no packet is left.
    fn take_packets(&mut self) -> Result<(), BoardError> {
        let link = &mut self.board.as_mut().ok_or(BoardError::Stopped)?.link;
        while self.restart.is_none()
            && !self.assembler.is_ready()
            && let Some(incoming) = link.next_incoming()
        {
            let Incoming::Packet(packet) = incoming else {
                self.assembler.note_damage();
                continue;
            };
            self.assembler.set_host_elapsed(self.last_frame.elapsed());
            match self.assembler.push_packet(&packet) {
                Outcome::Accepted => {}
                Outcome::Stopped(DataError::FifoOverflow) => self.restart = Some(GapReason::FifoOverflow),
                Outcome::Stopped(DataError::Other(code)) => {
                    return Err(BoardError::Acquisition { path: link.path.clone(), code });
                }
                Outcome::Misaligned => self.restart = Some(GapReason::PacketLost),
            }
        }
        Ok(())
    }

    /// Stops the acquisition and returns the board.
    ///
    /// # Errors
    /// An error of the connection or of the board, or [`BoardError::Stopped`] if it has been stopped before.
    pub fn stop(mut self) -> Result<Mcu7Board, BoardError> {
        let mut board = self.board.take().ok_or(BoardError::Stopped)?;
        halt(&mut board)?;
        Ok(board)
    }
}

fn halt(board: &mut Mcu7Board) -> Result<(), BoardError> {
    board.link.request_ok(&Command::StopData)?;
    board.link.request_ok(&Command::Execute { words: vec![STOP], answer: false })?;
    board.link.set_slice_layout(None);
    Ok(())
}

impl Drop for Mcu7Stream {
    fn drop(&mut self) {
        if let Some(mut board) = self.board.take()
            && let Err(error) = halt(&mut board)
        {
            tracing::debug!(%error, "the board could not be stopped");
        }
    }
}

impl FrameSource for Mcu7Stream {
    fn waveform(&self) -> &Waveform {
        &self.waveform
    }

    fn next_frame(&mut self, frame: &mut Frame) -> Result<SourceEvent, SourceError> {
        Ok(next_event(self, frame)?)
    }
}

impl Reconnectable for Mcu7Stream {
    fn read_event(&mut self, frame: &mut Frame) -> Result<SourceEvent, BoardError> {
        let waited = self.deadline;
        self.poll(frame, waited)?.ok_or_else(|| BoardError::Stalled { path: self.path.clone(), waited })
    }

    fn close(&mut self) {
        self.board = None;
        self.restart = None;
    }

    fn reopen(&mut self) -> Result<(), BoardError> {
        let board = Mcu7Board::open(&self.address)?;
        check_same(&self.path, &self.uuid, board.identity())?;
        self.board = Some(board);
        self.program()?;
        self.assembler.note_reconnection();
        Ok(())
    }

    fn last_frame(&self) -> Instant {
        self.last_frame
    }

    fn recovery(&mut self) -> &mut Recovery {
        &mut self.recovery
    }
}
