//! Detection of the kind of board on a serial port. Boards have no common request for it: the driver listens to the
//! port, then tries one protocol after the other.

use std::path::Path;
use std::time::{Duration, Instant};

use radome_dsp::{FrameSource, Waveform};

use super::host::{disconnected, open_port};
use super::{BoardError, BoardIdentity, DeepcraftBoard, Esp32Stream, Mcu7Board, Outage, Reconnect};
use crate::chip::RegisterList;
use crate::transport::serial::{OpenPort, read_more};
use crate::transport::{Address, trace};

/// Time for which the driver listens to a port before it sends requests.
const LISTEN_TIME: Duration = Duration::from_millis(300);
/// Time for which the driver listens again to a port that has not answered, in addition to three frame intervals.
const SECOND_LISTEN_TIME: Duration = Duration::from_secs(1);
/// Largest number of bytes that the driver listens to.
const MOST_RECEIVED: usize = 1 << 18;
/// Shortest line that is taken for text, bytes.
const SHORTEST_LINE: usize = 16;

/// Board found on a serial port.
///
/// ```no_run
/// use radome_driver::{Address, Detected};
///
/// # fn main() -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
/// match Detected::open(&Address::Serial("/dev/ttyACM0".into()), None)? {
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

/// Board whose frames have been started.
pub struct StartedBoard {
    /// Frames of the board, which is opened again if it is lost.
    pub frames: Box<dyn FrameSource>,
    /// Name that the board reports, or that of its kind; [`start_board`](crate::start_board) adds the address.
    pub description: String,
    /// Identity; `None` of a board that only prints.
    pub identity: Option<BoardIdentity>,
    /// Registers that the chip was programmed with; empty if the host does not program it.
    pub registers: RegisterList,
    /// Whether the board is away.
    pub outage: Outage,
}

impl StartedBoard {
    fn with_identity(
        frames: impl FrameSource + 'static,
        identity: BoardIdentity,
        registers: RegisterList,
        outage: Outage,
    ) -> Self {
        let description = identity.name.clone();
        StartedBoard { frames: Box::new(frames), description, identity: Some(identity), registers, outage }
    }
}

impl Detected {
    /// Opens the board at an address: on a serial port the kind that is detected, on USB the only supported kind. A
    /// board that prints its frames has one fixed waveform: `waveform` if given, else the one that the board states.
    ///
    /// # Errors
    /// [`BoardError`] if the port cannot be opened, nothing on it answers, or the board that answers is not supported.
    /// The requests sent do not harm a board of another protocol.
    pub fn open(address: &Address, waveform: Option<&Waveform>) -> Result<Detected, BoardError> {
        let Address::Serial(path) = address else { return Detected::mcu7(address) };
        let open_esp32 = |(port, received): (OpenPort, Vec<u8>)| {
            Esp32Stream::listen(path, port, received, waveform).map(|stream| Detected::Esp32(Box::new(stream)))
        };
        if let Some(received) = listen_for_text(path, LISTEN_TIME)? {
            return open_esp32(received);
        }
        match try_protocols(path, Detected::mcu7, |board| Detected::Deepcraft(Box::new(board))) {
            Err(no_answer @ BoardError::NoAnswer { .. }) => {
                listen_for_text(path, second_listen_time(waveform))?.map_or(Err(no_answer), open_esp32)
            }
            answer => answer,
        }
    }

    /// Returns the waveform that the board has already: the one that it was programmed with, is set to, or prints.
    pub fn waveform(&self) -> Option<Waveform> {
        match self {
            Detected::Mcu7(_, programmed) => programmed.clone(),
            Detected::Deepcraft(board) => board.configured_waveform(),
            Detected::Esp32(stream) => Some(stream.waveform().clone()),
        }
    }

    /// Error of a board whose [`Detected::waveform`] is `None`, where the user names none either.
    fn lack_of_waveform(&self) -> BoardError {
        let (lack, example) = match self {
            Detected::Deepcraft(_) => ("the board is set to no waveform that radome understands", "FILE.toml"),
            Detected::Mcu7(..) | Detected::Esp32(_) => {
                ("the board has not been told a waveform", "paper or --waveform FILE.toml")
            }
        };
        BoardError::NoWaveform { lack, example }
    }

    /// Programs the board with a waveform, or else with the one that it has already, and starts its frames. A board that prints its
    /// frames keeps its own waveform.
    ///
    /// # Errors
    /// [`BoardError::NoWaveform`] if there is no waveform, another [`BoardError`] if the chip cannot hold it, or the board does not take
    /// it or does not answer.
    pub fn start(self, waveform: Option<&Waveform>, reconnect: Reconnect) -> Result<StartedBoard, BoardError> {
        let own = self.waveform();
        let waveform = waveform.or(own.as_ref()).ok_or_else(|| self.lack_of_waveform())?;
        Ok(match self {
            Detected::Mcu7(board, _) => {
                let identity = board.identity().clone();
                let stream = board.start(waveform)?.with_reconnect(reconnect);
                let (registers, outage) = (stream.registers().clone(), stream.outage());
                StartedBoard::with_identity(stream, identity, registers, outage)
            }
            Detected::Deepcraft(board) => {
                let identity = board.identity().clone();
                let stream = board.start(waveform)?.with_reconnect(reconnect);
                let (registers, outage) = (stream.registers().clone(), stream.outage());
                StartedBoard::with_identity(stream, identity, registers, outage)
            }
            Detected::Esp32(stream) => {
                let stream = stream.with_reconnect(reconnect);
                let (description, outage) = ("ESP32".to_owned(), stream.outage());
                let registers = RegisterList::new();
                StartedBoard { frames: Box::new(stream), description, identity: None, registers, outage }
            }
        })
    }

    fn mcu7(address: &Address) -> Result<Detected, BoardError> {
        let (board, programmed) = Mcu7Board::open_with_waveform(address)?;
        Ok(Detected::Mcu7(Box::new(board), programmed))
    }
}

/// Reads the identity of the board on a serial port without reprogramming its chip; `None` if the board only prints.
///
/// # Errors
/// Those of [`Detected::open`].
pub(crate) fn identity_on(path: &Path) -> Result<Option<BoardIdentity>, BoardError> {
    if listen_for_text(path, LISTEN_TIME)?.is_some() {
        return Ok(None);
    }
    match try_protocols(path, Mcu7Board::identity_at, |board| board.identity().clone()) {
        Err(no_answer @ BoardError::NoAnswer { .. }) => match listen_for_text(path, second_listen_time(None))? {
            Some(_) => Ok(None),
            None => Err(no_answer),
        },
        answer => answer.map(Some),
    }
}

/// Returns the time for which the driver listens again to a port that has not answered. Its frames may be far apart.
fn second_listen_time(waveform: Option<&Waveform>) -> Duration {
    let interval_s = waveform.map_or(0.0, Waveform::frame_interval_s);
    SECOND_LISTEN_TIME + Duration::from_secs_f64(3.0 * interval_s)
}

/// Opens a port and listens until it has received text. Returns the port and the received bytes, or `None` after
/// `timeout` without text.
fn listen_for_text(path: &Path, timeout: Duration) -> Result<Option<(OpenPort, Vec<u8>)>, BoardError> {
    let mut port = open_port(path)?;
    let mut received = Vec::new();
    let start = Instant::now();
    while start.elapsed() < timeout && received.len() < MOST_RECEIVED {
        let previous_length = received.len();
        read_more(&mut port, &mut received).map_err(disconnected(path))?;
        if received.len() > previous_length && is_text(&received) {
            trace::received(&received);
            return Ok(Some((port, received)));
        }
    }
    trace::measured(received.len());
    Ok(None)
}

/// Tries one protocol after the other on a port. A DEEPCRAFT board takes the MCU7 request for the start of a longer request
/// and waits for the rest, which the DEEPCRAFT client sends.
fn try_protocols<T>(
    path: &Path,
    mcu7: impl FnOnce(&Address) -> Result<T, BoardError>,
    deepcraft: impl FnOnce(DeepcraftBoard) -> T,
) -> Result<T, BoardError> {
    match mcu7(&Address::Serial(path.into())) {
        Err(no_answer @ BoardError::NoAnswer { .. }) => match DeepcraftBoard::open(path) {
            Ok(board) => Ok(deepcraft(board)),
            Err(BoardError::NoAnswer { .. }) => Err(no_answer),
            Err(error) => Err(error),
        },
        answer => answer,
    }
}

/// Returns whether the last bytes are text: the newest whole line or the beginning of the next one. Packets of samples
/// hold bytes that text does not. A boot loader that prints at another rate sends such bytes before the first line.
fn is_text(bytes: &[u8]) -> bool {
    let is_printable = |b: &&u8| matches!(b, b' '..=b'~' | b'\t' | b'\r');
    let is_line =
        |line: &[u8]| line.len() >= SHORTEST_LINE && line.iter().filter(is_printable).count() * 100 >= line.len() * 95;
    bytes.rsplit(|b| *b == b'\n').take(2).any(is_line)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_text_even_after_a_boot_loader_and_packets_are_not() {
        let ramp: Vec<u8> = (0..=255).collect();
        assert!(!is_text(&ramp));
        assert!(!is_text(b""));
        assert!(is_text(b"I (312) main: radar started\r\nFrame 0: [1, 2, 3"));
        let boot = [&b"\xfe\x80ets Jun  8 2016 00:22:57\r\n"[..], &[b'x'; 100]].concat();
        assert!(is_text(&boot));
        // A boot loader at another rate.
        let garbage: Vec<u8> = ramp.iter().chain(&ramp).map(|byte| byte | 0x80).collect();
        assert!(!is_text(&garbage));
        assert!(is_text(&[&garbage[..], b"\nI (312) main: radar started\r\n"].concat()));
    }
}
