//! Delimited messages: length as a varint, then the message.

use thiserror::Error;

/// Longest varint of 64 bits.
const MAX_VARINT: usize = 10;

/// Error of reading a part of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ReadError {
    /// The bytes end within the message.
    Incomplete,
    /// The bytes are not of the expected form.
    Malformed,
}

/// Reader of numbers from the front of bytes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Cursor<'a> {
    pub bytes: &'a [u8],
    pub position: usize,
}

impl Cursor<'_> {
    /// Reads a varint.
    pub fn varint(&mut self) -> Result<u64, ReadError> {
        let mut value = 0;
        for (i, byte) in self.bytes.iter().skip(self.position).take(MAX_VARINT).enumerate() {
            value |= u64::from(byte & 0x7F).checked_shl(7 * i as u32).unwrap_or(0);
            if byte & 0x80 == 0 {
                self.position += i + 1;
                return Ok(value);
            }
        }
        Err(if self.bytes.len() < self.position + MAX_VARINT { ReadError::Incomplete } else { ReadError::Malformed })
    }
}

/// Error of a length beyond the longest message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[error("a message of {length} bytes was announced, the longest has {longest}")]
pub struct TooLong {
    /// Length announced.
    pub length: u64,
    /// Longest message accepted.
    pub longest: usize,
}

/// Parser of delimited messages. A length beyond the longest is an error at once.
#[derive(Debug)]
pub struct MessageParser {
    longest: usize,
    buffer: Vec<u8>,
    /// Bytes of `buffer` that have been handed out.
    used: usize,
}

impl MessageParser {
    /// Creates an empty parser of messages up to this length.
    pub fn new(longest: usize) -> Self {
        MessageParser { longest, buffer: Vec::new(), used: 0 }
    }

    /// Takes received bytes.
    pub fn push(&mut self, bytes: &[u8]) {
        self.buffer.drain(..self.used);
        self.used = 0;
        self.buffer.extend_from_slice(bytes);
    }

    /// Returns the next message, without its length; `None` until more bytes come. After an error no message is
    /// found until [`Self::clear`], because the start of the next one is unknown.
    ///
    /// # Errors
    /// [`TooLong`] if the length announced is beyond the longest.
    pub fn next_message(&mut self) -> Option<Result<&[u8], TooLong>> {
        let longest = self.longest;
        let mut cursor = Cursor { bytes: &self.buffer, position: self.used };
        let length = match cursor.varint() {
            Ok(length) => length,
            Err(ReadError::Incomplete) => return None,
            Err(ReadError::Malformed) => u64::MAX,
        };
        if length > longest as u64 {
            return Some(Err(TooLong { length, longest }));
        }
        let (start, end) = (cursor.position, cursor.position + length as usize);
        if end > self.buffer.len() {
            return None;
        }
        self.used = end;
        self.buffer.get(start..end).map(Ok)
    }

    /// Discards everything received.
    pub fn clear(&mut self) {
        self.buffer.clear();
        self.used = 0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use prost::encoding::{encode_varint, encoded_len_varint};

    proptest! {
        #[test]
        fn numbers_round_trip(value: u64) {
            let mut bytes = Vec::new();
            encode_varint(value, &mut bytes);
            prop_assert_eq!(bytes.len(), encoded_len_varint(value));
            let mut cursor = Cursor { bytes: &bytes, position: 0 };
            prop_assert_eq!(cursor.varint(), Ok(value));
            prop_assert_eq!(cursor.position, bytes.len());
            for length in 0..bytes.len() {
                prop_assert_eq!(Cursor { bytes: &bytes[..length], position: 0 }.varint(), Err(ReadError::Incomplete));
            }
        }

        /// The same messages come out, however the bytes are split.
        #[test]
        fn messages_come_out_whole(
            messages in prop::collection::vec(prop::collection::vec(any::<u8>(), 0..300), 1..10),
            cuts in prop::collection::vec(1usize..50, 1..50),
        ) {
            let mut line = Vec::new();
            for message in &messages {
                encode_varint(message.len() as u64, &mut line);
                line.extend(message);
            }
            let mut parser = MessageParser::new(300);
            let (mut rest, mut cuts, mut found) = (line.as_slice(), cuts.iter().cycle(), Vec::new());
            while !rest.is_empty() {
                let (piece, after) = rest.split_at((*cuts.next().expect("endless")).min(rest.len()));
                rest = after;
                parser.push(piece);
                while let Some(message) = parser.next_message() {
                    found.push(message.expect("short enough").to_vec());
                }
            }
            prop_assert_eq!(found, messages);
        }

        #[test]
        fn any_bytes_are_taken_without_panic(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
            let mut parser = MessageParser::new(100);
            parser.push(&bytes);
            while let Some(Ok(_)) = parser.next_message() {}
        }
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn a_huge_length_is_an_error_and_no_allocation() {
            for line in [&[0xFF, 0xFF, 0xFF, 0xFF, 0x0F][..], &[0xFF; 10], &[0x81, 0x80, 0x40]] {
                let mut parser = MessageParser::new(1000);
                parser.push(line);
                let error = parser.next_message().expect("decided").expect_err("too long");
                assert!(error.length > 1000 && error.to_string().contains("longest has 1000"), "{error}");
                assert!(parser.buffer.capacity() < 100);
                parser.clear();
                parser.push(&[1, 7]);
                assert_eq!(parser.next_message(), Some(Ok(&[7][..])));
            }
        }
    }
}
