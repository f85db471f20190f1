//! A frame source behind an emulated board: the same frames, after a trip through registers, packets and a serial port.

use std::time::Duration;

use radome_dsp::{Frame, FrameSource, SourceError, SourceEvent, Waveform};

use super::{EmulatedBoard, EmulatorError, EmulatorOptions};
use crate::board::{Board, BoardError, BoardIdentity, BoardStream};

/// An emulated board with a client attached. Ends when its source does.
pub struct EmulatedSource {
    // Fields are dropped in this order: the client stops the board before the board goes.
    stream: BoardStream,
    identity: BoardIdentity,
    board: EmulatedBoard,
}

/// The emulated board or its client could not be started.
#[derive(Debug, thiserror::Error)]
pub enum EmulatedSourceError {
    /// The emulator.
    #[error(transparent)]
    Emulator(#[from] EmulatorError),
    /// The client.
    #[error(transparent)]
    Board(#[from] BoardError),
}

impl EmulatedSource {
    /// Starts an emulated board on the source and a client with the source's waveform.
    pub fn start(source: Box<dyn FrameSource>, options: EmulatorOptions) -> Result<Self, EmulatedSourceError> {
        let waveform = source.waveform().clone();
        let board = EmulatedBoard::spawn(source, options)?;
        let client = Board::open(board.path())?;
        let identity = client.identity().clone();
        Ok(EmulatedSource { stream: client.start(&waveform)?, identity, board })
    }

    /// The emulated board.
    pub fn board(&self) -> &EmulatedBoard {
        &self.board
    }

    /// The client's side.
    pub fn stream(&self) -> &BoardStream {
        &self.stream
    }

    /// Who the emulated board says it is.
    pub fn identity(&self) -> &BoardIdentity {
        &self.identity
    }
}

impl FrameSource for EmulatedSource {
    fn waveform(&self) -> &Waveform {
        self.stream.waveform()
    }

    fn next_frame(&mut self, frame: &mut Frame) -> Result<SourceEvent, SourceError> {
        // The board falls silent both when its source has ended and when the source is slow: only the former ends it.
        loop {
            let finished = self.board.finished();
            match self.stream.poll(frame, Duration::from_millis(50))? {
                Some(event) => return Ok(event),
                None if finished => return Ok(SourceEvent::End),
                None => {}
            }
        }
    }
}
