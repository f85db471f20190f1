//! Radar Baseboard MCU7 on a serial port or on USB.

use radome_dsp::Waveform;

use super::handshake::{self, Handshake};
use super::link::Link;
use crate::board::{BoardError, BoardIdentity};
use crate::chip::ChipConfiguration;
use crate::transport::Address;

/// Radar Baseboard MCU7 that has been identified and does not measure.
///
/// ```no_run
/// use radome_driver::{Address, Mcu7Board, Reconnect};
/// use radome_dsp::{Frame, FrameSource, Waveform, WaveformRequest};
///
/// # fn main() -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
/// let board = Mcu7Board::open(&Address::Serial("/dev/ttyACM0".into()))?;
/// let waveform = Waveform::realise(WaveformRequest::paper())?;
/// let mut stream = board.start(&waveform)?.with_reconnect(Reconnect::default());
/// let mut frame = Frame::zeroed(waveform.shape());
/// stream.next_frame(&mut frame)?;
/// stream.stop()?;
/// # Ok(())
/// # }
/// ```
pub struct Mcu7Board {
    pub(super) link: Link,
    identity: BoardIdentity,
}

impl Mcu7Board {
    /// Reads the identity of a board and leaves the registers of its chip as they are, so that the next client still
    /// finds the programmed waveform. Only register SFCTL is written, and only if the chip cannot be read before its
    /// SPI is set up. A board that measures stops sending.
    ///
    /// # Errors
    /// [`BoardError`] if the port cannot be opened, if the board does not answer or answers with an error, or if its
    /// firmware or chip is not supported.
    pub fn identity_at(address: &Address) -> Result<BoardIdentity, BoardError> {
        let mut link = Link::open(address)?;
        Handshake::exchange(&mut link)?.identity(&mut link, handshake::read_chip_id)
    }

    /// Opens a board, reads its identity and resets the chip, as the vendor's client does.
    ///
    /// # Errors
    /// Those of [`Mcu7Board::identity_at`].
    pub fn open(address: &Address) -> Result<Mcu7Board, BoardError> {
        let mut link = Link::open(address)?;
        let handshake = Handshake::exchange(&mut link)?;
        Mcu7Board::reset(link, handshake)
    }

    /// Opens a board like [`Mcu7Board::open`], and reads the waveform that the chip was programmed with before;
    /// `None` if it has not been programmed since power-up.
    ///
    /// # Errors
    /// Those of [`Mcu7Board::identity_at`].
    pub fn open_with_waveform(address: &Address) -> Result<(Mcu7Board, Option<Waveform>), BoardError> {
        let mut link = Link::open(address)?;
        let handshake = Handshake::exchange(&mut link)?;
        let registers = handshake::read_every_register(&mut link)?;
        let waveform = ChipConfiguration::decode(&registers).ok().map(|configuration| configuration.waveform);
        Ok((Mcu7Board::reset(link, handshake)?, waveform))
    }

    fn reset(mut link: Link, handshake: Handshake) -> Result<Mcu7Board, BoardError> {
        handshake::set_up_spi(&mut link)?;
        let identity = handshake.identity(&mut link, handshake::reset_and_read_chip_id)?;
        Ok(Mcu7Board { link, identity })
    }

    /// Identity that the board reports.
    pub fn identity(&self) -> &BoardIdentity {
        &self.identity
    }
}
