//! Compares the bytes of each protocol with meanings that were written by hand, not computed.

use radome_driver::protocol::ascii::{Line, LineParser, decode_waveform};
use radome_driver::protocol::mcu7::{
    BoardEvent, BoardInfo, BoardParser, Command, DataError, FirmwareVersion, HostEvent, HostParser, Protocol, Status,
};

use crate::common::unhex;
use crate::golden_bytes;
use crate::make::{commands, waveform};

fn messages(name: &str, who: &str) -> Vec<Vec<u8>> {
    let text = String::from_utf8(golden_bytes(name)).expect("text");
    text.lines().filter_map(|line| line.split_once(' ')).filter(|(w, _)| *w == who).map(|(_, d)| unhex(d)).collect()
}

#[test]
fn requests_keep_their_meaning() {
    for (name, protocol) in [("wire-mcu7-4.txt", Protocol::V4), ("wire-mcu7-3.txt", Protocol::V3)] {
        let is_known = |command: &Command| match command {
            Command::BoardInfoFixed { .. } | Command::ComponentImplementation { .. } => protocol == Protocol::V3,
            Command::ComponentCount { .. } => protocol == Protocol::V4,
            _ => true,
        };
        let mut parser = HostParser::new(protocol);
        let requests = messages(name, "H");
        assert_eq!(requests.len(), commands().len());
        for (bytes, expected) in requests.iter().zip(commands()) {
            parser.push(bytes);
            let Some(HostEvent::Request(request)) = parser.next_event() else { panic!("{bytes:02x?}") };
            let command = Command::from_request(&request);
            if is_known(&expected) {
                assert_eq!(command.as_ref(), Ok(&expected));
            } else {
                assert_ne!(command.as_ref(), Ok(&expected));
            }
        }
    }
    // Bytes of the vendor's client.
    let requests = messages("wire-mcu7-4.txt", "H");
    assert_eq!(requests[0], [0x43, 0x80, 0, 0, 0, 0, 0, 0, 0xA4, 0x62]);
    assert_eq!(requests[2], [0xC0, 0x80, 1, 0, 0, 0, 0x10, 0, 0xD7, 0x45]);
    assert_eq!(requests[8], [0x40, 0x20, 3, 1, 0x10, 3, 5, 0, 0, 0, 0x10, 0, 6, 0xCA, 0x4A]);
}

#[test]
fn answers_and_packets_keep_their_meaning() {
    for (name, kind, major) in [("wire-mcu7-4.txt", 0x43, 4), ("wire-mcu7-3.txt", 0xE1, 3)] {
        let mut parser = BoardParser::default();
        parser.push(&messages(name, "D").concat());
        let mut answers = Vec::new();
        while let Some(BoardEvent::Response(response)) = parser.next_event() {
            assert_eq!(response.kind_code, kind);
            answers.push((response.status, response.payload.to_vec()));
            if answers.len() == 3 {
                break;
            }
        }
        let info = BoardInfo::decode(&answers[0].1).expect("decodes");
        assert_eq!((info.vendor_id, info.product_id, info.name.len()), (0x058B, 0x0251, 28));
        let version = FirmwareVersion::decode(&answers[1].1).expect("decodes");
        assert_eq!((version.firmware, version.protocol), ([2, 9, 0, 1], [major, 0]));
        assert_eq!(answers[2], (Status::RequestTypeInvalid, vec![]));

        let Some(BoardEvent::Packet(packet)) = parser.next_event() else { panic!("a packet") };
        let (data, stamp) = packet.split_timestamp();
        assert_eq!((packet.counter, data, stamp), (513, &[0xAB, 0xCD, 0xEF, 0, 0x0F, 0xFF][..], Some(1_234_567)));
        let Some(BoardEvent::Packet(packet)) = parser.next_event() else { panic!("a packet") };
        assert_eq!((packet.counter, packet.error()), (514, Some(DataError::FifoOverflow)));
        assert_eq!(parser.next_event(), None);
    }
}

#[test]
fn lines_keep_their_meaning() {
    let bytes = golden_bytes("wire-esp32.txt");
    let mut parser = LineParser::new(3);
    let mut frames = Vec::new();
    // A line that is not a frame may be longer than a frame.
    for line in bytes.split_inclusive(|b| *b == b'\n') {
        if let Some(request) = decode_waveform(line.trim_ascii_end()) {
            assert_eq!(request.expect("JSON"), waveform().request);
            continue;
        }
        parser.push(line);
        match parser.next_line() {
            Some(Ok(Line::Frame { number, codes })) => frames.push((number, codes.to_vec())),
            Some(Ok(Line::Log(text))) => assert_eq!(text, b"I (312) main: radar started"),
            other => panic!("{other:?}"),
        }
    }
    assert_eq!(frames, [(41, vec![0, 17, 4095]), (43, vec![1, 2, 3])]);
}
