//! Checks of the lengths of strings within a record. The library allocates memory for a string, up to 4 GB, before it
//! checks that the record is that long.

use mcap::records::{Record, op};
use mcap::{McapError, McapResult};

/// Parses a record of the data section or the summary. Only the strings of kinds that are read here are checked.
pub(super) fn parse_record(opcode: u8, body: &[u8]) -> McapResult<Record<'_>> {
    strings_fit(opcode, body).ok_or(McapError::UnexpectedEof)?;
    mcap::parse_record(opcode, body)
}

/// Checks that every string of a record ends within it; `None` if one does not.
pub(super) fn strings_fit(opcode: u8, body: &[u8]) -> Option<()> {
    let mut rest = Unparsed(body);
    match opcode {
        op::CHANNEL | op::METADATA => return content_length(opcode, body).map(|_| ()),
        // The body begins with two times, the length without compression and the CRC; the compression follows.
        op::CHUNK => rest.skip(28)?.strings(1),
        // The body begins with times, place and length of the chunk, a map of offsets and the length of the message
        // index.
        op::CHUNK_INDEX => rest.skip(32)?.offset_map()?.skip(8)?.strings(1),
        _ => Some(&mut rest),
    }
    .map(|_| ())
}

/// Compression of a chunk with its length, as it stands in the chunk's head.
pub(super) const CHUNK_MARK: &[u8] = b"\x04\0\0\0zstd";

/// Returns whether the content of a record that the recorder writes between its chunks ends within it. Bytes behind the
/// content, which later versions of MCAP may add, must not contain a chunk. Records of other kinds are not checked.
pub(super) fn has_valid_content(opcode: u8, body: &[u8]) -> bool {
    let is_checked = matches!(opcode, op::HEADER | op::SCHEMA | op::CHANNEL | op::METADATA | op::MESSAGE_INDEX);
    let has_no_chunk = |rest: &[u8]| !rest.windows(CHUNK_MARK.len()).any(|bytes| bytes == CHUNK_MARK);
    !is_checked || content_length(opcode, body).and_then(|length| body.get(length..)).is_some_and(has_no_chunk)
}

/// Length of the content of a record that the recorder writes between its chunks; `None` if the content does not end, and for
/// records of other kinds.
pub(super) fn content_length(opcode: u8, body: &[u8]) -> Option<usize> {
    let mut rest = Unparsed(body);
    let rest_after = match opcode {
        op::HEADER => rest.strings(2),
        // Number, name and encoding; the text of the schema has a length like a string.
        op::SCHEMA => rest.skip(2).and_then(|rest| rest.strings(3)),
        op::CHANNEL => rest.skip(4).and_then(|rest| rest.strings(2)).and_then(Unparsed::string_map),
        op::METADATA => rest.strings(1).and_then(Unparsed::string_map),
        // Number of the channel; the list of offsets has a length in bytes like a string.
        op::MESSAGE_INDEX => rest.skip(2).and_then(|rest| rest.strings(1)),
        _ => return None,
    };
    rest_after.map(|rest| body.len() - rest.0.len())
}

/// Copy of the body of metadata in which each byte of a text that is not ASCII is a question mark; `None` if a text does not end
/// within it.
pub(super) fn ascii_metadata(body: &[u8]) -> Option<Vec<u8>> {
    let number = |at: usize| Some(u32::from_le_bytes(*body.get(at..)?.first_chunk()?) as usize);
    let mut copy = body.to_vec();
    let mut replace_non_ascii = |at: usize| {
        let end = (at + 4).checked_add(number(at)?)?;
        copy.get_mut(at + 4..end)?.iter_mut().filter(|byte| !byte.is_ascii()).for_each(|byte| *byte = b'?');
        Some(end)
    };
    // The name; the length of the map, and its keys and values.
    let map = replace_non_ascii(0)?;
    let (mut at, end) = (map + 4, (map + 4).checked_add(number(map)?)?);
    while at < end {
        at = replace_non_ascii(at)?;
    }
    Some(copy)
}

/// Part of a record that has not been checked yet.
struct Unparsed<'a>(&'a [u8]);

impl Unparsed<'_> {
    /// Skips bytes.
    fn skip(&mut self, bytes: usize) -> Option<&mut Self> {
        self.0 = self.0.get(bytes..)?;
        Some(self)
    }

    /// Skips `count` strings, each a length and as many bytes.
    fn strings(&mut self, count: usize) -> Option<&mut Self> {
        for _ in 0..count {
            let length = u32::from_le_bytes(*self.0.first_chunk()?);
            self.skip(4)?.skip(usize::try_from(length).ok()?)?;
        }
        Some(self)
    }

    /// Skips a length in bytes, and as many pairs of a channel and a place as begin within it.
    fn offset_map(&mut self) -> Option<&mut Self> {
        let length = usize::try_from(u32::from_le_bytes(*self.0.first_chunk()?)).ok()?;
        self.skip(4)?.skip(length.checked_next_multiple_of(10)?)
    }

    /// Skips a length in bytes, and pairs of strings until that length is used up.
    fn string_map(&mut self) -> Option<&mut Self> {
        let length = usize::try_from(u32::from_le_bytes(*self.0.first_chunk()?)).ok()?;
        self.skip(4)?;
        let end = self.0.len().checked_sub(length)?;
        while self.0.len() > end {
            self.strings(2)?;
        }
        Some(self)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn string(text: &str) -> Vec<u8> {
        [&(text.len() as u32).to_le_bytes(), text.as_bytes()].concat()
    }

    mod hard_cases {
        use super::*;

        /// Found by fuzzing: a length of a gigabyte in a record of 30 bytes made the parser allocate a gigabyte.
        #[test]
        fn a_string_longer_than_its_record_is_refused_without_allocation() {
            let pair = [string("key"), string("value")].concat();
            let good = [string("radome"), (pair.len() as u32).to_le_bytes().to_vec(), pair].concat();
            assert!(parse_record(op::METADATA, &good).is_ok());
            // Each of the four lengths is damaged in turn.
            for at in [0, 10, 14, 21] {
                let mut bad = good.clone();
                bad[at + 3] = 0x40;
                assert!(parse_record(op::METADATA, &bad).is_err(), "length at byte {at}");
            }
            // The length of a map is no multiple of the length of its entries: the string behind it begins later.
            let mut index = [[0; 32].as_slice(), &1u32.to_le_bytes(), &[0; 18], &string("zstd"), &[0; 16]].concat();
            assert!(parse_record(op::CHUNK_INDEX, &index).is_ok());
            index[32 + 4 + 18 + 3] = 0x40;
            assert!(parse_record(op::CHUNK_INDEX, &index).is_err());
            for cut in 0..good.len() {
                assert!(parse_record(op::METADATA, &good[..cut]).is_err(), "cut at {cut}");
            }
        }
    }
}
