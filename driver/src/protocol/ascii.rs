//! Lines of ESP32 firmware (nichonaugle/esp32-bgt60tr13c-driver): `Frame N: [a, b, ...]`, one radar frame a line, codes
//! in decimal in FIFO order. Lines have no checksum: a digit that is changed into another is not detected. A code
//! beyond 12 bits, a line cut short and a wrong number of codes are detected. Other lines are the firmware's log.
//!
//! Firmware may state its waveform at its start and from time to time: `Waveform: {...}`, a [`WaveformRequest`] in
//! JSON. The driver named above does not send this line; its clients must be given the waveform.

use radome_dsp::{MAX_CODE, WaveformRequest};
use thiserror::Error;

/// Bytes of the longest code in decimal, a comma and a space.
const BYTES_PER_CODE: usize = 6;
const PREFIX: &[u8] = b"Frame ";
const WAVEFORM_PREFIX: &[u8] = b"Waveform: ";
/// Longest line that is not a frame.
const LONGEST_OTHER_LINE: usize = 1024;

/// Parsed line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Line<'a> {
    /// Frame with the firmware's number.
    Frame {
        /// Number of the frame since the firmware's start.
        number: u64,
        /// Codes in FIFO order, 0..=4095.
        codes: &'a [u16],
    },
    /// Log line of the firmware or of its boot loader.
    Log(&'a [u8]),
}

/// Error of a line that begins like a frame but is not one.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[allow(missing_docs, reason = "the message says what each field is")]
pub enum LineError {
    /// An unexpected character in place of the number, a bracket or a code.
    #[error("frame line: unexpected byte {byte:#04x} at column {column}")]
    Syntax {
        /// Column of the character, from 1.
        column: usize,
        /// The character; 0 at the end of the line.
        byte: u8,
    },
    /// Code of more than 12 bits.
    #[error("frame {number}: code {index} is beyond 4095")]
    Code {
        number: u64,
        /// Index of the code in the frame, from 0.
        index: usize,
    },
    /// Frame of another length than the waveform's.
    #[error(
        "frame {number}: {got} codes, expected {expected}\n\nhint: name the waveform that the firmware is built for"
    )]
    Length { number: u64, got: usize, expected: usize },
    /// Line longer than any frame.
    #[error(
        "a line of more than {limit} bytes, longer than any frame of the waveform\n\nhint: name the waveform that the firmware is built for"
    )]
    TooLong { limit: usize },
}

/// Appends a frame's line; `codes` in FIFO order.
pub fn encode(number: u64, codes: &[u16], line: &mut Vec<u8>) {
    line.extend_from_slice(PREFIX);
    line.extend_from_slice(number.to_string().as_bytes());
    line.extend_from_slice(b": [");
    for (i, code) in codes.iter().enumerate() {
        if i > 0 {
            line.extend_from_slice(b", ");
        }
        line.extend_from_slice(code.to_string().as_bytes());
    }
    line.extend_from_slice(b"]\n");
}

/// Appends the line that states the waveform; a request is always representable in JSON.
pub fn encode_waveform(request: &WaveformRequest, line: &mut Vec<u8>) {
    if let Ok(json) = serde_json::to_vec(request) {
        line.extend_from_slice(WAVEFORM_PREFIX);
        line.extend_from_slice(&json);
        line.push(b'\n');
    }
}

/// Decodes the waveform from a whole line without its end; `None` if the line does not state one.
///
/// # Errors
/// The JSON text is not a [`WaveformRequest`].
pub fn decode_waveform(line: &[u8]) -> Option<Result<WaveformRequest, serde_json::Error>> {
    Some(serde_json::from_slice(line.strip_prefix(WAVEFORM_PREFIX)?))
}

/// Parser of lines from a stream of bytes.
#[derive(Debug)]
pub struct LineParser {
    codes_per_frame: usize,
    /// Length beyond which a line is given up, bytes.
    limit: usize,
    buffer: Vec<u8>,
    /// Start of the next line in `buffer`.
    line_start: usize,
    /// Number of bytes from `line_start` on that hold no end of line.
    searched: usize,
    /// Whether the next bytes are the rest of a line that is being skipped.
    skipping: bool,
    codes: Vec<u16>,
}

impl LineParser {
    /// Creates a parser of frames of `codes_per_frame` codes.
    pub fn new(codes_per_frame: usize) -> Self {
        let limit = (codes_per_frame * BYTES_PER_CODE + 64).max(LONGEST_OTHER_LINE);
        LineParser {
            codes_per_frame,
            limit,
            buffer: Vec::new(),
            line_start: 0,
            searched: 0,
            skipping: false,
            codes: Vec::with_capacity(codes_per_frame),
        }
    }

    /// Adds received bytes.
    pub fn push(&mut self, bytes: &[u8]) {
        self.buffer.drain(..self.line_start);
        self.line_start = 0;
        self.buffer.extend_from_slice(bytes);
    }

    /// Returns the next whole line; `None` until more bytes come.
    ///
    /// # Errors
    /// [`LineError`] for a line that begins like a frame but is not one.
    pub fn next_line(&mut self) -> Option<Result<Line<'_>, LineError>> {
        loop {
            let rest = self.buffer.get(self.line_start + self.searched..).unwrap_or(&[]);
            let Some(end) = rest.iter().position(|&b| b == b'\n') else {
                self.searched += rest.len();
                if self.searched <= self.limit {
                    return None;
                }
                self.line_start += self.searched;
                self.searched = 0;
                if !std::mem::replace(&mut self.skipping, true) {
                    return Some(Err(LineError::TooLong { limit: self.limit }));
                }
                return None;
            };
            let (line_start, end) = (self.line_start, self.line_start + self.searched + end);
            self.line_start = end + 1;
            self.searched = 0;
            if std::mem::take(&mut self.skipping) {
                continue;
            }
            if end - line_start > self.limit {
                return Some(Err(LineError::TooLong { limit: self.limit }));
            }
            let line = self.buffer.get(line_start..end).unwrap_or(&[]);
            let line = line.strip_suffix(b"\r").unwrap_or(line);
            if !line.starts_with(PREFIX) {
                return Some(Ok(Line::Log(line)));
            }
            return Some(
                parse_frame(line, self.codes_per_frame, &mut self.codes)
                    .map(|number| Line::Frame { number, codes: &self.codes }),
            );
        }
    }
}

/// Parses the number and the codes of a line that begins with [`PREFIX`].
fn parse_frame(line: &[u8], expected: usize, codes: &mut Vec<u16>) -> Result<u64, LineError> {
    codes.clear();
    let mut position = PREFIX.len();
    let syntax =
        |position: usize| LineError::Syntax { column: position + 1, byte: line.get(position).copied().unwrap_or(0) };
    let number = decimal(line, &mut position).ok_or_else(|| syntax(position))?;
    position = literal(line, position, b": [").ok_or_else(|| syntax(position))?;
    let mut got = 0;
    if literal(line, position, b"]").is_none() {
        loop {
            let code = decimal(line, &mut position).ok_or_else(|| syntax(position))?;
            if code > u64::from(MAX_CODE) {
                return Err(LineError::Code { number, index: got });
            }
            got += 1;
            if got <= expected {
                codes.push(code as u16);
            }
            match literal(line, position, b",") {
                Some(next) => position = literal(line, next, b" ").unwrap_or(next),
                None => break,
            }
        }
    }
    match literal(line, position, b"]") {
        Some(end) if end == line.len() => {}
        Some(end) => return Err(syntax(end)),
        None => return Err(syntax(position)),
    }
    if got == expected { Ok(number) } else { Err(LineError::Length { number, got, expected }) }
}

/// Returns the position behind the literal `text` at `position`; `None` if it is not there.
fn literal(line: &[u8], position: usize, text: &[u8]) -> Option<usize> {
    line.get(position..)?.starts_with(text).then_some(position + text.len())
}

/// Parses a decimal number at `position` and moves `position` behind it; `None` if there is no number or it exceeds 64 bits.
fn decimal(line: &[u8], position: &mut usize) -> Option<u64> {
    let start = *position;
    let mut value = 0u64;
    while let Some(digit) = line.get(*position).filter(|b| b.is_ascii_digit()) {
        value = value.checked_mul(10)?.checked_add(u64::from(digit - b'0'))?;
        *position += 1;
    }
    (*position > start).then_some(value)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    type Owned = Result<(u64, Vec<u16>), LineError>;

    fn frames(codes_per_frame: usize, bytes: &[u8], piece: usize) -> Vec<Owned> {
        let mut parser = LineParser::new(codes_per_frame);
        let mut all = Vec::new();
        for piece in bytes.chunks(piece.max(1)) {
            parser.push(piece);
            while let Some(line) = parser.next_line() {
                match line {
                    Ok(Line::Frame { number, codes }) => all.push(Ok((number, codes.to_vec()))),
                    Ok(Line::Log(_)) => {}
                    Err(e) => all.push(Err(e)),
                }
            }
        }
        all
    }

    #[test]
    fn the_firmwares_line_is_read() {
        let bytes = b"I (312) main: start\r\nFrame 7: [0, 4095, 17]\r\nFrame 8: [1,2,3]\n";
        assert_eq!(frames(3, bytes, 100), [Ok((7, vec![0, 4095, 17])), Ok((8, vec![1, 2, 3]))]);
    }

    proptest! {
        #[test]
        fn lines_round_trip_in_any_pieces(
            codes in prop::collection::vec(0u16..=4095, 1..50),
            number: u64,
            piece in 1usize..40,
        ) {
            let mut line = b"half a line from before\n".to_vec();
            encode(number, &codes, &mut line);
            prop_assert_eq!(frames(codes.len(), &line, piece), [Ok((number, codes))]);
        }

        #[test]
        fn any_bytes_need_bounded_memory(bytes in prop::collection::vec(any::<u8>(), 0..4000), piece in 1usize..300) {
            let mut parser = LineParser::new(8);
            for piece in bytes.chunks(piece) {
                parser.push(piece);
                while parser.next_line().is_some() {}
                prop_assert!(parser.buffer.len() <= parser.limit + 2 * piece.len());
            }
        }
    }

    #[test]
    fn a_waveform_line_round_trips_and_is_a_log_line_among_frames() {
        let request = WaveformRequest::paper();
        let mut bytes = Vec::new();
        encode_waveform(&request, &mut bytes);
        encode(0, &[1, 2], &mut bytes);
        let line = bytes.split(|b| *b == b'\n').next().expect("a line");
        assert_eq!(decode_waveform(line).expect("a waveform line").expect("JSON"), request);
        assert!(decode_waveform(b"Waveform: {}").expect("a waveform line").is_err());
        assert!(decode_waveform(b"Frame 1: [1]").is_none());
        assert_eq!(frames(2, &bytes, 7), [Ok((0, vec![1, 2]))]);
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn a_damaged_line_is_named_and_alone_is_lost() {
            let good = b"Frame 9: [1, 2]\n";
            for (bad, error) in [
                (&b"Frame 1: [1, 4096]\n"[..], LineError::Code { number: 1, index: 1 }),
                (b"Frame 1: [1]\n", LineError::Length { number: 1, got: 1, expected: 2 }),
                (b"Frame 1: [1, 2, 3]\n", LineError::Length { number: 1, got: 3, expected: 2 }),
                (b"Frame 1: []\n", LineError::Length { number: 1, got: 0, expected: 2 }),
                (b"Frame 1: [1, 2\n", LineError::Syntax { column: 15, byte: 0 }),
                (b"Frame 1: [1, x]\n", LineError::Syntax { column: 14, byte: b'x' }),
                (b"Frame x: [1, 2]\n", LineError::Syntax { column: 7, byte: b'x' }),
                (b"Frame 1: [1, 2] \n", LineError::Syntax { column: 16, byte: b' ' }),
            ] {
                let bytes = [bad, good].concat();
                assert_eq!(frames(2, &bytes, 5), [Err(error), Ok((9, vec![1, 2]))]);
            }
        }

        /// Found by fuzzing: a line of any length was read if it came at once, but was given up if it came in pieces.
        #[test]
        fn a_line_is_too_long_in_any_pieces() {
            let line = |zeros: usize| [b"Frame 1: [1, ", &[b'0'; 1100][..zeros], b"2]\nFrame 9: [1, 2]\n"].concat();
            for piece in [1, 60, 1024, 1025, 4000] {
                // Lines of 1024 bytes and of 1025 bytes.
                assert_eq!(frames(2, &line(1009), piece), [Ok((1, vec![1, 2])), Ok((9, vec![1, 2]))]);
                assert_eq!(
                    frames(2, &line(1010), piece),
                    [Err(LineError::TooLong { limit: 1024 }), Ok((9, vec![1, 2]))],
                    "pieces of {piece}"
                );
            }
        }

        #[test]
        fn a_line_without_end_is_skipped_once() {
            let bytes = [&[b'7'; 3000][..], b"\nFrame 9: [1, 2]\n"].concat();
            assert_eq!(frames(2, &bytes, 50), [Err(LineError::TooLong { limit: 1024 }), Ok((9, vec![1, 2]))]);
        }
    }
}
