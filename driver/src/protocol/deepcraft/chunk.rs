//! Messages that carry frames. The parser hands out a message only when the following bytes confirm it.

use prost::Message;
use prost::encoding::{encode_varint, encoded_len_varint};
use radome_dsp::MAX_CODE;

use super::delimited::{Cursor, ReadError};
use super::response::{Answer, CapabilitiesResponse, ErrorResponse, Response};

/// Longest message of a board: the firmware's ring of 64 Ki samples and the other fields.
pub const MAX_RESPONSE: usize = 2 * 65_536 + 1024;
/// Tag of the data in a response: field 4, length-delimited.
const DATA: u64 = 4 << 3 | LENGTH_DELIMITED;
/// Tags of capabilities and of an error in a response.
const CAPABILITIES: u64 = 1 << 3 | LENGTH_DELIMITED;
const ERROR: u64 = 3 << 3 | LENGTH_DELIMITED;
/// Wire types.
const VARINT: u64 = 0;
const FIXED_64: u64 = 1;
const LENGTH_DELIMITED: u64 = 2;
const FIXED_32: u64 = 5;
/// Fewest and most bytes of a chunk beside its payload: tags and numbers. Time stamps follow the payload.
const MIN_OVERHEAD: usize = 6;
const MAX_OVERHEAD: usize = 48;
const MAX_OVERHEAD_PER_FRAME: usize = 32;
/// Largest difference between the lengths of the headers of two chunks, whose numbers differ in length.
const MAX_HEADER_DIFFERENCE: usize = 6;
/// Lengths of an answer or error between chunks. Shorter ones could be mistaken for samples.
const INTERLEAVED_LENGTH: std::ops::RangeInclusive<u64> = 16..=16_384;
/// Largest distance between frame numbers of one stream.
const MOST_MISSING: u32 = 1 << 20;

/// Properties that all chunks of a stream share.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ChunkLayout {
    /// Device.
    pub device: i32,
    /// Stream of the device.
    pub stream: i32,
    /// Codes in a frame.
    pub frame_codes: usize,
}

/// Header of a chunk and the positions of its parts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ChunkHeader {
    /// Number of the chunk's first frame, modulo 2^32.
    pub frame_number: u32,
    /// Number of frames in the chunk.
    pub frame_count: usize,
    /// Start of the payload, counted from the length of the message.
    pub payload_start: usize,
    /// End of the payload.
    pub payload_end: usize,
    /// End of the chunk.
    pub end: usize,
}

impl ChunkHeader {
    /// Number of the frame after the chunk.
    fn next_number(&self) -> u32 {
        self.frame_number.wrapping_add(self.frame_count as u32)
    }
}

/// Classification of the first bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Beginning {
    /// A chunk of the stream, up to its payload at least.
    Chunk(ChunkHeader),
    /// The bytes are too few to decide.
    Incomplete,
    /// The bytes are no chunk of the stream.
    No,
}

impl ChunkLayout {
    fn frame_bytes(&self) -> usize {
        2 * self.frame_codes
    }

    /// Returns whether a message of this length can be a chunk of whole frames.
    fn is_possible(&self, length: usize) -> bool {
        let frames = length.saturating_sub(MIN_OVERHEAD).checked_div(self.frame_bytes()).unwrap_or(0);
        let overhead = length.saturating_sub(frames * self.frame_bytes());
        frames > 0 && length <= MAX_RESPONSE && overhead <= MAX_OVERHEAD + MAX_OVERHEAD_PER_FRAME * frames
    }

    /// Classifies the bytes, from the length of a message on.
    pub fn beginning(&self, bytes: &[u8]) -> Beginning {
        match self.header(bytes) {
            Ok(header) => Beginning::Chunk(header),
            Err(ReadError::Incomplete) => Beginning::Incomplete,
            Err(ReadError::Malformed) => Beginning::No,
        }
    }

    fn header(&self, bytes: &[u8]) -> Result<ChunkHeader, ReadError> {
        let require = |holds: bool| if holds { Ok(()) } else { Err(ReadError::Malformed) };
        let mut cursor = Cursor { bytes, position: 0 };
        let length = cursor.varint()?;
        require(length <= MAX_RESPONSE as u64 && self.is_possible(length as usize))?;
        let end = cursor.position + length as usize;
        require(cursor.varint()? == DATA)?;
        // The response holds nothing but the chunk.
        let inner = cursor.varint()?;
        require(end.checked_sub(cursor.position).is_some_and(|rest| inner == rest as u64))?;
        let [mut device, mut stream, mut count, mut number] = [0; 4];
        loop {
            let tag = cursor.varint()?;
            match (tag >> 3, tag & 7) {
                (1, VARINT) => device = cursor.varint()?,
                (2, VARINT) => stream = cursor.varint()?,
                (3, VARINT) => count = cursor.varint()?,
                (4, VARINT) => number = cursor.varint()?,
                (5, LENGTH_DELIMITED) => break,
                (0..=6, _) => return Err(ReadError::Malformed),
                (_, VARINT) => drop(cursor.varint()?),
                (_, FIXED_64) => cursor.position += 8,
                (_, FIXED_32) => cursor.position += 4,
                (_, LENGTH_DELIMITED) => cursor.position += cursor.varint()?.min(MAX_RESPONSE as u64) as usize,
                _ => return Err(ReadError::Malformed),
            }
            require(cursor.position < end)?;
        }
        let payload = cursor.varint()?;
        // Negative numbers are encoded as if they had 64 bits.
        require((device as i32, stream as i32) == (self.device, self.stream))?;
        require((1..=MAX_RESPONSE as u64).contains(&count) && payload == count * self.frame_bytes() as u64)?;
        let (payload_start, frame_count) = (cursor.position, count as usize);
        let payload_end = payload_start + payload as usize;
        require(payload_start <= MAX_OVERHEAD && payload_end <= end)?;
        Ok(ChunkHeader { frame_number: number as u32, frame_count, payload_start, payload_end, end })
    }

    /// Appends a chunk as the firmware writes it: fields that are zero are left out. Codes are in FIFO order.
    pub fn encode(&self, frame_number: u32, codes: &[u16], out: &mut Vec<u8>) {
        let frame_count = codes.len() / self.frame_codes.max(1);
        let mut fields = Vec::with_capacity(MAX_OVERHEAD);
        let numbers = [self.device, self.stream, frame_count as i32, frame_number as i32];
        for (field, number) in (1..).zip(numbers).filter(|(_, number)| *number != 0) {
            encode_varint(field << 3 | VARINT, &mut fields);
            encode_varint(i64::from(number) as u64, &mut fields);
        }
        encode_varint(5 << 3 | LENGTH_DELIMITED, &mut fields);
        encode_varint(2 * codes.len() as u64, &mut fields);
        let inner = (fields.len() + 2 * codes.len()) as u64;
        encode_varint(1 + encoded_len_varint(inner) as u64 + inner, out);
        encode_varint(DATA, out);
        encode_varint(inner, out);
        out.extend(fields);
        out.extend(codes.iter().flat_map(|code| code.to_le_bytes()));
    }
}

/// Event of a stream.
#[derive(Debug, PartialEq)]
pub enum ChunkEvent<'a> {
    /// Consecutive frames, each in FIFO order: 12-bit codes, little-endian.
    Frames {
        /// Number of the first frame, modulo 2^32.
        frame_number: u32,
        /// Number of frames.
        frame_count: usize,
        /// Codes of the frames.
        codes: &'a [[u8; 2]],
    },
    /// Chunk whose number agrees neither with the chunk before nor with the one after; it is discarded.
    Misnumbered,
    /// Error of the device.
    Error(ErrorResponse),
    /// Message boundaries are lost. Nothing is found until [`ChunkParser::restart`].
    Damaged,
}

/// Message of a board between chunks.
enum Interleaved {
    Error(ErrorResponse),
    /// Answer to a request that the host has sent meanwhile.
    Answer(CapabilitiesResponse),
}

/// Parses an error, or the answer with this tag, at the start of the bytes. Returns its length and the message.
fn parse_interleaved(bytes: &[u8], awaited_tag: Option<i32>) -> Result<(usize, Interleaved), ReadError> {
    let mut cursor = Cursor { bytes, position: 0 };
    let length = cursor.varint()?;
    if !INTERLEAVED_LENGTH.contains(&length) {
        return Err(ReadError::Malformed);
    }
    let (start, end) = (cursor.position, cursor.position + length as usize);
    let tag = cursor.varint()?;
    let is_possible = tag == ERROR || tag == CAPABILITIES && awaited_tag.is_some();
    let inner = cursor.varint()?;
    if !is_possible || end.checked_sub(cursor.position).is_none_or(|rest| inner != rest as u64) {
        return Err(ReadError::Malformed);
    }
    let message = bytes.get(start..end).ok_or(ReadError::Incomplete)?;
    match Response::decode(message).ok().and_then(|response| response.answer) {
        Some(Answer::Error(error)) if error.code < 0 => Ok((end, Interleaved::Error(error))),
        Some(Answer::Capabilities(answer)) if Some(answer.tag) == awaited_tag => Ok((end, Interleaved::Answer(answer))),
        _ => Err(ReadError::Malformed),
    }
}

/// Parser of the chunks of one stream.
///
/// A chunk is handed out when it is *confirmed*. It is confirmed when a chunk of the same stream (or an error, or an
/// answer) begins right behind it, or when the line is silent there ([`Self::on_silence`]). A chunk that was cut short
/// contains the header of its successor, so that no chunk begins behind it. More than two bytes of a header cannot be
/// codes: any four of them, taken as two codes, have one beyond 4095. Two bytes can be mistaken for a code. Silence
/// therefore does not confirm a chunk whose last code could be the length of another chunk.
#[derive(Debug)]
pub struct ChunkParser {
    layout: ChunkLayout,
    buffer: Vec<u8>,
    /// Bytes of `buffer` that have been handed out.
    used: usize,
    /// Number of the next frame.
    next_number: u32,
    silent: bool,
    damaged: bool,
    /// Tag of an answer that may come between chunks.
    awaited_tag: Option<i32>,
}

impl ChunkParser {
    /// Creates an empty parser of a stream whose next frame has this number. It allocates no more memory as long as at
    /// most 64 KiB at a time are pushed, and confirmed chunks are taken out between pushes.
    pub fn new(layout: ChunkLayout, next_number: u32) -> Self {
        ChunkParser {
            layout,
            buffer: Vec::with_capacity(MAX_RESPONSE + 65_536),
            used: 0,
            next_number,
            silent: false,
            damaged: false,
            awaited_tag: None,
        }
    }

    /// Takes received bytes.
    pub fn push(&mut self, bytes: &[u8]) {
        self.silent &= bytes.is_empty();
        self.buffer.drain(..self.used);
        self.used = 0;
        self.buffer.extend_from_slice(bytes);
    }

    /// Discards everything. The stream restarts with a frame of this number.
    pub fn restart(&mut self, next_number: u32) {
        self.buffer.clear();
        (self.used, self.next_number, self.silent, self.damaged) = (0, next_number, false, false);
        self.awaited_tag = None;
    }

    /// Notes that the host has requested capabilities with this tag: the answer may come between any two chunks.
    pub fn await_answer(&mut self, tag: i32) {
        self.awaited_tag = Some(tag);
    }

    /// Removes and returns the answer that is [awaited](Self::await_answer), anywhere among the queued chunks.
    pub fn take_answer(&mut self) -> Option<CapabilitiesResponse> {
        let mut position = self.used;
        loop {
            let bytes = self.buffer.get(position..)?;
            position += match (self.layout.beginning(bytes), parse_interleaved(bytes, self.awaited_tag)) {
                (Beginning::Chunk(header), _) => header.end,
                (Beginning::No, Ok((length, Interleaved::Error(_)))) => length,
                (Beginning::No, Ok((length, Interleaved::Answer(answer)))) => {
                    self.buffer.drain(position..position + length);
                    self.awaited_tag = None;
                    return Some(answer);
                }
                _ => return None,
            };
        }
    }

    /// Notes a silence longer than any between two packets of a message.
    pub fn on_silence(&mut self) {
        self.silent = true;
    }

    /// Notes a silence after which the rest of a message is given up.
    pub fn on_long_silence(&mut self) {
        if self.is_waiting() && !self.ends_with_whole_chunk() {
            self.damaged = true;
        }
    }

    /// Returns whether there are bytes that are incomplete or not confirmed yet.
    pub fn is_waiting(&self) -> bool {
        self.used < self.buffer.len()
    }

    fn rest(&self) -> &[u8] {
        self.buffer.get(self.used..).unwrap_or(&[])
    }

    /// Returns whether the bytes end where a chunk does.
    fn ends_with_whole_chunk(&self) -> bool {
        matches!(self.layout.beginning(self.rest()), Beginning::Chunk(header) if header.end == self.rest().len())
    }

    /// Returns the next event; `None` until more bytes or silence come.
    pub fn next_event(&mut self) -> Option<ChunkEvent<'_>> {
        if self.damaged {
            return Some(ChunkEvent::Damaged);
        }
        let header = loop {
            match self.layout.beginning(self.rest()) {
                Beginning::Chunk(header) => break header,
                Beginning::Incomplete => return None,
                Beginning::No => {}
            }
            match parse_interleaved(self.rest(), self.awaited_tag) {
                Ok((length, Interleaved::Error(error))) => {
                    self.used += length;
                    return Some(ChunkEvent::Error(error));
                }
                // The answer is no longer awaited.
                Ok((length, Interleaved::Answer(_))) => self.used += length,
                Err(ReadError::Incomplete) => return None,
                Err(ReadError::Malformed) => return self.report_damage(),
            }
        };
        let is_confirmed = match self.is_confirmed(&header) {
            Ok(is_confirmed) => is_confirmed,
            Err(ReadError::Incomplete) => return None,
            Err(ReadError::Malformed) => return self.report_damage(),
        };
        let start = self.used;
        self.used += header.end;
        let ahead = header.frame_number.wrapping_sub(self.next_number);
        if !is_confirmed || (MOST_MISSING..0u32.wrapping_sub(MOST_MISSING)).contains(&ahead) {
            return Some(ChunkEvent::Misnumbered);
        }
        // The caller discards chunks that come again or late.
        if ahead < MOST_MISSING {
            self.next_number = header.next_number();
        }
        let payload = self.buffer.get(start + header.payload_start..start + header.payload_end).unwrap_or(&[]);
        let (codes, _) = payload.as_chunks::<2>();
        if codes.iter().any(|code| u16::from_le_bytes(*code) > MAX_CODE) {
            self.damaged = true;
            return Some(ChunkEvent::Damaged);
        }
        Some(ChunkEvent::Frames { frame_number: header.frame_number, frame_count: header.frame_count, codes })
    }

    /// Returns whether the number of a chunk agrees with the chunk before or with the one after. Fails with
    /// [`ReadError::Malformed`] if no message begins right behind it, and with [`ReadError::Incomplete`] until the next bytes or
    /// silence come.
    fn is_confirmed(&self, header: &ChunkHeader) -> Result<bool, ReadError> {
        let message = self.rest().get(..header.end).ok_or(ReadError::Incomplete)?;
        let after = self.rest().get(header.end..).unwrap_or(&[]);
        let is_next = header.frame_number == self.next_number;
        if after.is_empty() {
            let is_whole = self.silent && is_next && !self.may_end_with_length(header, message);
            return if is_whole { Ok(true) } else { Err(ReadError::Incomplete) };
        }
        match self.layout.header(after) {
            // A jump of the number is accepted if the successor continues from there.
            Ok(next) => Ok(is_next || next.frame_number == header.next_number()),
            Err(ReadError::Incomplete) => Err(ReadError::Incomplete),
            Err(ReadError::Malformed) => parse_interleaved(after, self.awaited_tag).map(|_| is_next),
        }
    }

    /// Returns whether the last code of a chunk could be the length of its successor, in two bytes. Only the successor then
    /// confirms that the chunk is whole. Fields after the codes could hold any bytes.
    fn may_end_with_length(&self, header: &ChunkHeader, message: &[u8]) -> bool {
        let Some(&[low, high]) = message.last_chunk() else { return false };
        let length = usize::from(low & 0x7F) | usize::from(high) << 7;
        let overhead = header.end - (header.payload_end - header.payload_start) - encoded_len_varint(length as u64);
        // The successor may hold more frames or fewer, and its numbers may be longer or shorter.
        let is_similar =
            |frames: usize| (frames * self.layout.frame_bytes() + overhead).abs_diff(length) <= MAX_HEADER_DIFFERENCE;
        let frames = length / self.layout.frame_bytes().max(1);
        header.payload_end != header.end || low & 0x80 != 0 && (frames.saturating_sub(1)..=frames + 1).any(is_similar)
    }

    fn report_damage(&mut self) -> Option<ChunkEvent<'_>> {
        self.damaged = true;
        Some(ChunkEvent::Damaged)
    }
}
