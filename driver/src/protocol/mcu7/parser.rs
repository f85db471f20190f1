//! Parsers of messages in a stream of bytes that may hold garbage.

use super::{
    Framing, MAX_MESSAGE, Packet, Protocol, REQUEST_HEADER_LENGTH, Request, RequestKind, Response, SliceLayout, Status,
};
use crate::protocol::crc::crc16;

/// Message of a board.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BoardEvent<'a> {
    /// An answer.
    Response(Response<'a>),
    /// A piece of data.
    Packet(Packet<'a>),
    /// Skipped bytes that are not a message, or a message whose CRC is wrong.
    Damaged {
        /// Bytes skipped.
        bytes: usize,
    },
}

/// Message at the start of received bytes.
enum MessageStart {
    /// More bytes are needed to decide.
    Incomplete,
    /// No message begins here.
    No,
    /// A whole message of this length.
    Message(usize),
}

/// Longest answer while data run, bytes of payload: no request of a running stream asks for data.
const MAX_ANSWER: usize = 16;
/// Longest error code or text while data run, bytes.
const MAX_TEXT: usize = 256;

/// Finds out whether a message begins with these bytes. While slices of a layout are sent, only headers with a length
/// that a message can then have count.
fn message_start(bytes: &[u8], slice: Option<SliceLayout>) -> MessageStart {
    let Some(&first) = bytes.first() else { return MessageStart::Incomplete };
    let length = if first & 0xF0 == 0xD0 {
        let Some(header) = bytes.first_chunk() else {
            return if bytes.get(1).is_some_and(|channel| *channel != 0) {
                MessageStart::No
            } else {
                MessageStart::Incomplete
            };
        };
        match Packet::header(Framing::Serial, header) {
            Some((flags, length)) if is_expected(slice, flags.error, length) => Packet::HEADER_LENGTH + length + 2,
            _ => return MessageStart::No,
        }
    } else if RequestKind::from_code(first).is_some() {
        let Some(&[_, _, l0, l1]) = bytes.first_chunk() else { return MessageStart::Incomplete };
        let length = usize::from(u16::from_le_bytes([l0, l1]));
        if slice.is_some() && length > MAX_ANSWER {
            return MessageStart::No;
        }
        Response::HEADER_LENGTH + length + 2
    } else {
        return MessageStart::No;
    };
    match bytes.get(..length) {
        _ if length > MAX_MESSAGE => MessageStart::No,
        None => MessageStart::Incomplete,
        Some(message) if crc16(message) == 0 => MessageStart::Message(length),
        Some(_) => MessageStart::No,
    }
}

/// Returns whether the payload of a packet can have this length.
fn is_expected(slice: Option<SliceLayout>, is_error: bool, length: usize) -> bool {
    match slice {
        None => true,
        Some(_) if is_error => length <= MAX_TEXT,
        Some(slice) => (0..slice.packets()).any(|packet| slice.payload_length(packet) == length),
    }
}

/// Parser of the messages of a board. A message counts only if its CRC is right. After a wrong CRC the search continues
/// at the next byte, so that a message that was cut short does not hide its successor.
#[derive(Debug, Default)]
pub struct BoardParser {
    buffer: Vec<u8>,
    /// Bytes of `buffer` that have been handed out.
    used: usize,
    /// Length of the message after them, if its CRC has been checked and need not be computed again.
    checked_length: Option<usize>,
    /// Layout of the slices that the board sends.
    slice: Option<SliceLayout>,
}

impl BoardParser {
    /// Creates an empty parser that allocates nothing more while at most `bytes` bytes at a time are pushed and whole
    /// messages are taken out in between.
    pub fn with_capacity(bytes: usize) -> Self {
        BoardParser { buffer: Vec::with_capacity(bytes + MAX_MESSAGE), ..Self::default() }
    }

    /// Sets the layout of the slices that the board sends; `None` while it sends none. A header with a length that no
    /// message then has is garbage. Without the layout, it would hide messages until as many bytes have come.
    pub fn set_slice_layout(&mut self, slice: Option<SliceLayout>) {
        (self.slice, self.checked_length) = (slice, None);
    }

    /// Takes received bytes.
    pub fn push(&mut self, bytes: &[u8]) {
        if self.used > 0 {
            self.buffer.drain(..self.used);
            self.used = 0;
        }
        self.buffer.extend_from_slice(bytes);
    }

    /// Returns the next message or stretch of garbage; `None` until more bytes come.
    pub fn next_event(&mut self) -> Option<BoardEvent<'_>> {
        let start = self.used;
        if let Some(length) = self.checked_length.take() {
            self.used = start + length;
            return self.buffer.get(start..start + length).and_then(decode);
        }
        let mut at = start;
        loop {
            let rest = self.buffer.get(at..).unwrap_or(&[]);
            match message_start(rest, self.slice) {
                MessageStart::No => at += 1,
                _ if at > start => {
                    self.used = at;
                    return Some(BoardEvent::Damaged { bytes: at - start });
                }
                MessageStart::Incomplete => return None,
                MessageStart::Message(length) => {
                    self.used = at + length;
                    return self.buffer.get(at..at + length).and_then(decode);
                }
            }
        }
    }

    /// Returns whether the next event is an answer; `None` until more bytes come.
    pub fn peek_is_response(&mut self) -> Option<bool> {
        let rest = self.buffer.get(self.used..).unwrap_or(&[]);
        let start = match self.checked_length {
            Some(length) => MessageStart::Message(length),
            None => message_start(rest, self.slice),
        };
        match start {
            MessageStart::Incomplete => None,
            MessageStart::No => Some(false),
            MessageStart::Message(length) => {
                self.checked_length = Some(length);
                Some(rest.first().is_some_and(|first| first & 0xF0 != 0xD0))
            }
        }
    }

    /// Notes that the line has been silent. The rest of an incomplete message is then given up. Its header may have been
    /// garbage that hides a real message. Discards one byte; call [`Self::next_event`] again.
    pub fn on_silence(&mut self) {
        self.checked_length = None;
        self.used = (self.used + 1).min(self.buffer.len());
    }

    /// Returns whether the start of a message waits for the rest.
    pub fn is_waiting(&self) -> bool {
        self.used < self.buffer.len()
    }
}

/// Decodes a message whose length and CRC have been checked.
fn decode(message: &[u8]) -> Option<BoardEvent<'_>> {
    let (body, _) = message.split_last_chunk::<2>()?;
    if let Some((header, payload)) = body.split_first_chunk()
        && let Some((flags, _)) = Packet::header(Framing::Serial, header)
    {
        let counter = u16::from_le_bytes([header[2], header[3]]);
        return Some(BoardEvent::Packet(Packet { flags, channel: header[1], counter, payload }));
    }
    let (&[kind_code, status, _, _], payload) = body.split_first_chunk::<4>()?;
    Some(BoardEvent::Response(Response { kind_code, status: Status::from_code(status), payload }))
}

/// Message of a host, as the firmware parses it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum HostEvent {
    /// A request.
    Request(Request),
    /// Bytes that the firmware refuses with this status; its answer repeats the first byte.
    Refused {
        /// First byte of the refused bytes.
        kind_code: u8,
        /// Reason, as the firmware codes it.
        status: Status,
    },
}

/// Parser of requests to a board. It refuses the same bytes as the firmware.
#[derive(Debug, Default)]
pub struct HostParser {
    protocol: Protocol,
    buffer: Vec<u8>,
}

impl HostParser {
    /// Creates an empty parser of firmware that speaks this version.
    pub fn new(protocol: Protocol) -> Self {
        HostParser { protocol, buffer: Vec::new() }
    }

    /// Version of the protocol that the firmware speaks.
    pub fn protocol(&self) -> Protocol {
        self.protocol
    }

    /// Takes received bytes.
    pub fn push(&mut self, bytes: &[u8]) {
        self.buffer.extend_from_slice(bytes);
    }

    /// Returns the next request; `None` until more bytes come. Refused bytes empty the buffer, because the firmware
    /// then flushes its input.
    pub fn next_event(&mut self) -> Option<HostEvent> {
        let header: &[u8; REQUEST_HEADER_LENGTH] = self.buffer.first_chunk()?;
        let kind_code = header[0];
        let is_known = RequestKind::from_code(kind_code).is_some_and(|(_, protocol)| protocol == self.protocol);
        let Some(payload) = Request::payload_length(header).filter(|_| is_known) else {
            return self.refuse(kind_code, Status::RequestTypeInvalid);
        };
        let length = REQUEST_HEADER_LENGTH + payload + 2;
        if length > MAX_MESSAGE {
            return self.refuse(kind_code, Status::RequestPayloadTooLong);
        }
        let Some(request) = Request::decode(self.buffer.get(..length)?) else {
            return self.refuse(kind_code, Status::RequestCrc);
        };
        self.buffer.drain(..length);
        Some(HostEvent::Request(request))
    }

    fn refuse(&mut self, kind_code: u8, status: Status) -> Option<HostEvent> {
        self.buffer.clear();
        Some(HostEvent::Refused { kind_code, status })
    }
}
