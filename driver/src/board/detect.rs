//! Detection of the kind of board on a serial port. Boards have no common way to report it: the port is listened to,
//! then asked in one protocol after the other.

use std::path::Path;
use std::time::{Duration, Instant};

use radome_dsp::Waveform;

use super::host::{lost, open_port};
use super::{BoardError, DeepcraftBoard, Esp32Stream, Mcu7Board};
use crate::transport::serial::read_more;
use crate::transport::{Address, trace};

/// Longest silence of a board that prints by itself.
const LISTEN: Duration = Duration::from_millis(300);
/// Number of bytes that suffices to decide whether they are text.
const ENOUGH: usize = 256;

/// Board found on a serial port.
///
/// ```no_run
/// use std::path::Path;
///
/// use radome_driver::Detected;
///
/// # fn main() -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
/// match Detected::open(Path::new("/dev/ttyACM0"), None)? {
///     Detected::Mcu7(board, _) => println!("{}", board.identity().name),
///     Detected::Deepcraft(board) => println!("{}", board.identity().name),
///     Detected::Esp32(_) => println!("a board that prints its frames"),
/// }
/// # Ok(())
/// # }
/// ```
pub enum Detected {
    /// Radar Baseboard MCU7, and the waveform that its chip was programmed with before.
    Mcu7(Box<Mcu7Board>, Option<Waveform>),
    /// PSoC 6 kit with DEEPCRAFT firmware, which reports its waveform.
    Deepcraft(Box<DeepcraftBoard>),
    /// Board that prints its frames.
    Esp32(Box<Esp32Stream>),
}

impl Detected {
    /// Opens a port and detects the board on it. A board that prints measures one waveform: the one given, or else the
    /// one that it states.
    ///
    /// # Errors
    /// [`BoardError`] if the port cannot be opened, nothing on it answers, or the board that answers is not supported.
    /// The requests sent do not harm a board of another protocol.
    pub fn open(path: &Path, waveform: Option<&Waveform>) -> Result<Detected, BoardError> {
        let mut port = open_port(path)?;
        let mut heard = Vec::new();
        let began = Instant::now();
        while began.elapsed() < LISTEN && heard.len() < ENOUGH {
            read_more(&mut port, &mut heard).map_err(lost(path))?;
        }
        if is_text(&heard) {
            trace::received(&heard);
            return Ok(Detected::Esp32(Box::new(Esp32Stream::listen(path, port, heard, waveform)?)));
        }
        trace::measured(heard.len());
        drop(port);
        // To a DEEPCRAFT board the MCU7 request is the head of a longer one, whose rest it waits for; the DEEPCRAFT
        // client completes it.
        match Mcu7Board::open_with_waveform(&Address::Serial(path.into())) {
            Ok((board, left)) => Ok(Detected::Mcu7(Box::new(board), left)),
            Err(silent @ BoardError::NoAnswer { .. }) => match DeepcraftBoard::open(path) {
                Ok(board) => Ok(Detected::Deepcraft(Box::new(board))),
                Err(BoardError::NoAnswer { .. }) => Err(silent),
                Err(error) => Err(error),
            },
            Err(error) => Err(error),
        }
    }
}

/// Returns whether bytes are text. Packets of samples hold bytes that text does not.
fn is_text(bytes: &[u8]) -> bool {
    let is_printable = |b: &u8| matches!(b, b' '..=b'~' | b'\t' | b'\r' | b'\n');
    bytes.len() >= 8 && bytes.iter().filter(|b| is_printable(b)).count() * 100 >= bytes.len() * 95
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn packets_are_no_text_and_lines_are_even_after_a_boot_loader() {
        let ramp: Vec<u8> = (0..=255).collect();
        assert!(!is_text(&ramp));
        assert!(!is_text(b""));
        assert!(is_text(b"I (312) main: radar started\r\nFrame 0: [1, 2, 3"));
        let boot = [&b"\xfe\x80ets Jun  8 2016 00:22:57\r\n"[..], &[b'x'; 100]].concat();
        assert!(is_text(&boot));
    }
}
