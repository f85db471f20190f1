//! Requests and packets over USB control and bulk transfers, as in firmware built with `COMMUNICATION_LIBUSB` and in
//! the vendor's host library. No shipped firmware is built this way: this module has not been tested with a board.
//!
//! A request's header is a control transfer's setup packet, bit for bit.
//!
//! - *write* (0x40): one OUT transfer. The device always acknowledges it; [`LastError`] holds its status.
//! - *read* (0xC0): one IN transfer. A failure stalls the endpoint; [`LastError`] holds the reason.
//! - *transfer* (0x43): an OUT transfer with the payload, which the firmware acts upon, then an IN transfer of kind
//!   [`ANSWER`] with the same request, value and index, which fetches the answer or stalls.
//!
//! Data packets come on bulk endpoint [`DATA_ENDPOINT`], each a transfer of its own: the six-byte header, then the
//! payload, no CRC. USB itself checks every packet on the cable and repeats it if necessary. A CRC would only add a
//! check of the software at both ends. Without it these errors are not detected: inverted bits in the memory of the
//! board or the host, and a payload replaced by another of its length. An inverted flag may turn a data packet into an
//! error packet; the board is then opened again. These errors are detected: an invalid header, a length that differs
//! from the transfer's, packets that are lost, doubled or out of order (by their counter), and packets of another
//! length than the slice's.

use super::{BoardEvent, Framing, Packet, Protocol, REQUEST_HEADER_LENGTH, Request, RequestKind, Status};

/// bmRequestType that fetches the answer to a *transfer*: vendor, IN, recipient "other".
pub const ANSWER: u8 = 0xC3;
/// Longest data stage of a control transfer: Linux allows 4096 bytes with the setup packet.
pub const MAX_CONTROL: usize = 4096 - REQUEST_HEADER_LENGTH;
/// Longest bulk transfer.
pub const MAX_BULK: usize = Packet::HEADER_LENGTH + Framing::Bulk.max_packet_payload();
/// Number of the bulk IN endpoint.
pub const DATA_ENDPOINT: u8 = 1;

/// Status of the last request, which a control transfer cannot report.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LastError {
    /// bmRequestType of that request.
    pub kind_code: u8,
    /// Status of that request.
    pub status: Status,
}

impl LastError {
    /// Bytes of the answer.
    pub const LENGTH: usize = 4;

    /// Returns the request for the status. The firmware answers it in any state, and the status stays as it is.
    pub fn request() -> Request {
        Request {
            protocol: Protocol::V4,
            kind: RequestKind::Read,
            request: 0x80,
            value: 0xFF,
            index: 1,
            length: Self::LENGTH as u16,
            payload: Vec::new(),
        }
    }

    /// Encodes the four bytes; the last two are a length that is not used.
    pub fn encode(self) -> [u8; Self::LENGTH] {
        [self.kind_code, self.status.code(), 0, 0]
    }

    /// Decodes the four bytes.
    pub fn decode(bytes: &[u8]) -> Option<Self> {
        let &[kind_code, status, _, _] = bytes else { return None };
        Some(LastError { kind_code, status: Status::from_code(status) })
    }
}

/// Decoded control transfer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Control {
    /// A request, with its payload.
    Request(Request),
    /// Fetch of the answer to the *transfer* before.
    Answer {
        /// Longest answer that the host takes, bytes.
        length: u16,
    },
    /// Kind that the firmware does not know.
    Unknown {
        /// Byte of the kind.
        kind_code: u8,
    },
}

impl Control {
    /// Decodes the setup packet and the data of an OUT transfer.
    pub fn decode(setup: &[u8; REQUEST_HEADER_LENGTH], data: &[u8]) -> Self {
        let &[kind_code, .., l0, l1] = setup;
        match RequestKind::from_code(kind_code) {
            Some((kind, Protocol::V4)) => Control::Request(Request::new(kind, Protocol::V4, setup, data)),
            _ if kind_code == ANSWER => Control::Answer { length: u16::from_le_bytes([l0, l1]) },
            _ => Control::Unknown { kind_code },
        }
    }
}

/// Returns the setup packet that fetches the answer to a *transfer*.
pub fn answer_setup(request: &Request) -> [u8; REQUEST_HEADER_LENGTH] {
    let [_, request, v0, v1, i0, i1, ..] = request.header();
    let [l0, l1] = (MAX_CONTROL as u16).to_le_bytes();
    [ANSWER, request, v0, v1, i0, i1, l0, l1]
}

/// Returns whether the data stage of a control transfer goes to the host.
pub fn is_in(setup: &[u8; REQUEST_HEADER_LENGTH]) -> bool {
    setup[0] & 0x80 != 0
}

/// Parser of data packets from the bulk endpoint. A transfer holds one packet and ends with a USB packet that is not
/// full. A read that timed out holds whole USB packets only; the next read gets the rest.
#[derive(Debug, Default)]
pub struct BulkParser {
    buffer: Vec<u8>,
    used: usize,
    /// Whether the buffer ends where a transfer does.
    ends_transfer: bool,
}

impl BulkParser {
    /// Creates an empty parser that allocates nothing as long as packets are taken out between pushes.
    pub fn new() -> Self {
        BulkParser { buffer: Vec::with_capacity(2 * MAX_BULK), used: 0, ends_transfer: false }
    }

    /// Takes the bytes of one read.
    pub fn push(&mut self, bytes: &[u8]) {
        self.buffer.drain(..self.used.min(self.buffer.len()));
        self.used = 0;
        self.buffer.extend_from_slice(bytes);
        self.ends_transfer = !bytes.len().is_multiple_of(Framing::USB_PACKET);
    }

    /// Returns the next packet; `None` until more bytes come. Everything received is discarded if the bytes do not
    /// begin with a header, or if the packet is longer than its transfer. The next transfer begins with a header again.
    pub fn next_event(&mut self) -> Option<BoardEvent<'_>> {
        let rest = self.buffer.get(self.used..).filter(|rest| !rest.is_empty())?;
        let header = rest.first_chunk::<{ Packet::HEADER_LENGTH }>();
        let packet = header.map(|header| Packet::header(Framing::Bulk, header));
        // A packet that fills whole USB packets does not end its transfer: further whole packets may follow.
        let is_whole = |length: usize| match rest.get(Packet::HEADER_LENGTH + length..) {
            Some([]) => true,
            Some(more) => {
                let fills_usb_packets = (Packet::HEADER_LENGTH + length).is_multiple_of(Framing::USB_PACKET);
                let next = more.first_chunk().and_then(|header| Packet::header(Framing::Bulk, header));
                fills_usb_packets || next.is_some_and(|(_, length)| more.len() == Packet::HEADER_LENGTH + length)
            }
            None => false,
        };
        let length = match packet {
            Some(Some((_, length))) if is_whole(length) => length,
            // Any other packet ends with its transfer. If bytes follow, the packet was cut short, and they belong to
            // another transfer.
            Some(Some((_, length))) if rest.len() > Packet::HEADER_LENGTH + length => {
                return Some(BoardEvent::Damaged { bytes: self.give_up() });
            }
            Some(Some(_)) | None if !self.ends_transfer => return None,
            _ => return Some(BoardEvent::Damaged { bytes: self.give_up() }),
        };
        let start = self.used;
        self.used += Packet::HEADER_LENGTH + length;
        let (header, payload) = self.buffer.get(start..self.used)?.split_first_chunk()?;
        let (flags, _) = Packet::header(Framing::Bulk, header)?;
        let counter = u16::from_le_bytes([header[2], header[3]]);
        Some(BoardEvent::Packet(Packet { flags, channel: header[1], counter, payload }))
    }

    /// Returns whether a packet waits for its rest.
    pub fn is_waiting(&self) -> bool {
        self.used < self.buffer.len()
    }

    /// Discards the packet whose rest has not come; returns the number of its bytes.
    pub fn give_up(&mut self) -> usize {
        let given_up = self.buffer.len() - self.used.min(self.buffer.len());
        self.used = self.buffer.len();
        given_up
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::protocol::mcu7::{Command, PacketFlags, SpiWord};

    fn all_but_error() -> PacketFlags {
        PacketFlags { first: true, last: true, timestamp: true, error: false }
    }

    fn encoded(counter: u16, payload: &[u8]) -> Vec<u8> {
        let mut out = Vec::new();
        Packet { flags: all_but_error(), channel: 0, counter, payload }.encode_as(Framing::Bulk, &mut out);
        out
    }

    /// Returns the counters and payloads of the packets, and the number of damaged parts.
    fn parse(reads: &[&[u8]]) -> (Vec<(u16, Vec<u8>)>, usize) {
        let (mut parser, mut packets, mut damaged) = (BulkParser::new(), Vec::new(), 0);
        for read in reads {
            parser.push(read);
            while let Some(event) = parser.next_event() {
                match event {
                    BoardEvent::Packet(packet) => packets.push((packet.counter, packet.payload.to_vec())),
                    _ => damaged += 1,
                }
            }
        }
        (packets, damaged)
    }

    #[test]
    fn a_packet_is_its_serial_form_without_the_crc() {
        let packet = Packet { flags: all_but_error(), channel: 0, counter: 7, payload: &[1, 2, 3, 4, 5, 6, 7, 8, 9] };
        let (mut serial, mut bulk) = (Vec::new(), Vec::new());
        packet.encode(&mut serial);
        packet.encode_as(Framing::Bulk, &mut bulk);
        assert_eq!(bulk, serial[..serial.len() - 2]);
    }

    #[test]
    fn a_request_is_a_setup_packet_and_its_payload() {
        let command = Command::Execute { words: vec![SpiWord::read(2)], answer: true };
        let request = command.to_request(Protocol::V4);
        assert_eq!(request.header(), [0x43, 0x20, 0x03, 0x01, 0x30, 0x01, 4, 0]);
        assert_eq!(answer_setup(&request), [0xC3, 0x20, 0x03, 0x01, 0x30, 0x01, 0xF8, 0x0F]);
        assert_eq!(Control::decode(&request.header(), &request.payload), Control::Request(request));
        assert_eq!(LastError::request().header(), [0xC0, 0x80, 0xFF, 0, 1, 0, 4, 0]);
    }

    proptest! {
        #[test]
        fn packets_round_trip_in_any_reads(
            payloads in prop::collection::vec(prop::collection::vec(any::<u8>(), 0..2000), 1..6),
            usb_packets in 1usize..4,
        ) {
            let transfers: Vec<Vec<u8>> = payloads.iter().enumerate().map(|(i, p)| encoded(i as u16, p)).collect();
            let reads: Vec<&[u8]> = transfers.iter().flat_map(|t| t.chunks(512 * usb_packets)).collect();
            let expected: Vec<_> = payloads.iter().enumerate().map(|(i, p)| (i as u16, p.clone())).collect();
            prop_assert_eq!(parse(&reads), (expected, 0));
        }

        #[test]
        fn last_errors_round_trip(kind_code: u8, code: u8) {
            let error = LastError { kind_code, status: Status::from_code(code) };
            prop_assert_eq!(LastError::decode(&error.encode()), Some(error));
        }
    }

    mod hard_cases {
        use super::*;

        proptest! {
            #[test]
            fn any_bytes_end_without_panic_and_leave_a_parser_that_works(
                reads in prop::collection::vec(prop::collection::vec(any::<u8>(), 0..300), 0..8),
            ) {
                let mut parser = BulkParser::new();
                for read in &reads {
                    parser.push(read);
                    while parser.next_event().is_some() {}
                }
                parser.give_up();
                parser.push(&encoded(5, &[9; 20]));
                let Some(BoardEvent::Packet(packet)) = parser.next_event() else { panic!("no packet") };
                prop_assert_eq!((packet.counter, packet.payload), (5, &[9u8; 20][..]));
            }

            #[test]
            fn any_setup_packet_is_decoded(setup: [u8; 8], data in prop::collection::vec(any::<u8>(), 0..50)) {
                match Control::decode(&setup, &data) {
                    Control::Request(request) => prop_assert_eq!(request.header(), setup),
                    Control::Answer { length } => prop_assert_eq!(length.to_le_bytes(), [setup[6], setup[7]]),
                    Control::Unknown { kind_code } => prop_assert_eq!(kind_code, setup[0]),
                }
            }
        }

        /// A packet without a checksum is accepted as it is.
        #[test]
        fn an_inverted_bit_is_detected_in_the_type_and_not_in_the_payload() {
            let mut bytes = encoded(0, &[0; 30]);
            bytes[20] ^= 1;
            let (packets, damaged) = parse(&[&bytes]);
            assert_eq!((packets[0].1[14], damaged), (1, 0));
            bytes[0] ^= 0x80;
            assert_eq!(parse(&[&bytes]), (vec![], 1));
        }

        #[test]
        fn a_packet_cut_short_is_lost_and_the_next_is_not() {
            let good = encoded(3, &[1; 40]);
            for length in 1..46 {
                assert_eq!(parse(&[&good[..length], &good]), (vec![(3, vec![1; 40])], 1), "{length}");
            }
            let long = encoded(4, &[2; 3000]);
            let mut parser = BulkParser::new();
            parser.push(&long[..1024]);
            assert!(parser.next_event().is_none() && parser.is_waiting());
            assert_eq!(parser.give_up(), 1024);
        }

        /// A packet that fills USB packets exactly does not end its transfer: its successor comes in the same transfer.
        #[test]
        fn packets_in_one_transfer_are_separated() {
            let both = [encoded(0, &[1; 506]), encoded(1, &[2; 30])].concat();
            assert_eq!(parse(&[&both]), (vec![(0, vec![1; 506]), (1, vec![2; 30])], 0));
        }

        #[test]
        fn garbage_loses_its_transfer_and_not_the_next() {
            let good = encoded(3, &[1; 40]);
            assert_eq!(parse(&[&[0xFF; 700][..], &good]), (vec![(3, vec![1; 40])], 1));
            let too_long = [0xD7, 0, 0, 0, 0xFF, 0xFF, 1, 2, 3];
            assert_eq!(parse(&[&too_long[..], &good]), (vec![(3, vec![1; 40])], 1));
        }
    }
}
