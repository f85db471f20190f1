//! Frame source behind an emulated board: the same frames, sent through registers, packets and a serial port.

use std::cmp::Ordering;
use std::time::Duration;

use crossbeam::channel::{Receiver, Sender, unbounded};
use radome_dsp::{Frame, FrameSource, SourceError, SourceEvent, Truth, Waveform};

use super::{EmulatedBoard, EmulatorError, EmulatorOptions};
use crate::board::{BoardError, BoardIdentity, Mcu7Board, Mcu7Stream, Outage, StartedBoard};

/// Emulated board with a client attached. It ends with its source. The ground truth of the source's frames, which the
/// protocol cannot carry, bypasses the board and is put back by sequence number.
pub struct EmulatedSource {
    // Fields are dropped in this order: the client stops the board before the board is dropped.
    stream: Mcu7Stream,
    identity: BoardIdentity,
    board: EmulatedBoard,
    truths: Receiver<(u64, Truth)>,
    /// Ground truth received last, if it belongs to a later frame.
    pending_truth: Option<(u64, Truth)>,
}

/// Source that sends the ground truth of each frame to a channel.
struct TruthTap {
    source: Box<dyn FrameSource>,
    truths: Sender<(u64, Truth)>,
}

impl FrameSource for TruthTap {
    fn waveform(&self) -> &Waveform {
        self.source.waveform()
    }

    fn next_frame(&mut self, frame: &mut Frame) -> Result<SourceEvent, SourceError> {
        let event = self.source.next_frame(frame)?;
        if let (SourceEvent::Frame, Some(truth)) = (event, frame.truth) {
            // A closed channel is no error: the client has ended.
            let _ = self.truths.send((frame.sequence, truth));
        }
        Ok(event)
    }
}

/// Error of starting an emulated board and its client.
#[derive(Debug, thiserror::Error)]
pub enum EmulatedSourceError {
    /// Error of the emulated board.
    #[error(transparent)]
    Emulator(#[from] EmulatorError),
    /// Error of the client.
    #[error(transparent)]
    Board(#[from] BoardError),
}

impl EmulatedSource {
    /// Starts an emulated board on the source, and a client with the source's waveform.
    ///
    /// # Errors
    /// [`EmulatedSourceError`] if the board or the client cannot be started.
    pub fn start(source: Box<dyn FrameSource>, options: EmulatorOptions) -> Result<Self, EmulatedSourceError> {
        let waveform = source.waveform().clone();
        let (sender, truths) = unbounded();
        let board = EmulatedBoard::spawn(Box::new(TruthTap { source, truths: sender }), options)?;
        let client = Mcu7Board::open(board.address())?;
        let identity = client.identity().clone();
        Ok(EmulatedSource { stream: client.start(&waveform)?, identity, board, truths, pending_truth: None })
    }

    /// Ground truth of the frame with this number.
    fn truth(&mut self, sequence: u64) -> Option<Truth> {
        loop {
            let (truth_sequence, truth) = self.pending_truth.take().or_else(|| self.truths.try_recv().ok())?;
            match truth_sequence.cmp(&sequence) {
                Ordering::Less => {}
                Ordering::Equal => return Some(truth),
                Ordering::Greater => {
                    self.pending_truth = Some((truth_sequence, truth));
                    return None;
                }
            }
        }
    }

    /// Returns the frames as those of a board, with a description that names the terminal of the emulated board.
    pub fn into_board(self) -> StartedBoard {
        let (identity, registers) = (self.identity.clone(), self.stream.registers().clone());
        let description = format!("{} emulated on {}", identity.name, self.board.path().display());
        let outage = Outage::default();
        StartedBoard { frames: Box::new(self), description, identity: Some(identity), registers, outage }
    }

    /// Returns the emulated board.
    pub fn board(&self) -> &EmulatedBoard {
        &self.board
    }

    /// Returns the identity that the emulated board reports.
    pub fn identity(&self) -> &BoardIdentity {
        &self.identity
    }
}

impl FrameSource for EmulatedSource {
    fn waveform(&self) -> &Waveform {
        self.stream.waveform()
    }

    fn next_frame(&mut self, frame: &mut Frame) -> Result<SourceEvent, SourceError> {
        // The board is silent when its source has ended and when the source is slow. Only the former ends the stream.
        loop {
            let is_over = self.board.finished() || self.board.is_over();
            let result = self.stream.poll(frame, Duration::from_millis(50));
            if matches!(result, Ok(None)) && !is_over {
                continue;
            }
            // A board whose source or line has failed falls silent or disconnects. Its own failure is then the cause.
            if !matches!(result, Ok(Some(_)))
                && let Some(reason) = self.board.failure()
            {
                return Err(format!("the emulated board sends no more frames: {reason}").into());
            }
            let event = result?.unwrap_or(SourceEvent::End);
            if event == SourceEvent::Frame {
                frame.truth = self.truth(frame.sequence);
            }
            return Ok(event);
        }
    }
}
