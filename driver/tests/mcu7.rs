//! Compares the codec with the transcript of an unmodified vendor client, and tests it with arbitrary bytes.

use proptest::prelude::*;
use radome_driver::chip::ChipConfiguration;
use radome_driver::protocol::mcu7::*;
use radome_driver::protocol::packed12;

use crate::common::{captured_waveform, transcript};

/// Requests of the session of the transcript, in its order.
fn session() -> Vec<Command> {
    let waveform = captured_waveform();
    let slice = SliceLayout::for_frame(waveform.shape().codes());
    let list = ChipConfiguration { waveform, slice_samples: slice.samples }.compile().expect("fits");
    let execute = |words, answer| Command::Execute { words, answer };
    vec![
        Command::BoardInfo,
        Command::FirmwareVersion,
        Command::ComponentCount { component: COMPONENT_AVIAN },
        Command::WriteRegisters { address: 6, values: vec![0x100000] },
        Command::ReadRegisters { address: 2, count: 1 },
        Command::Uuid,
        Command::ExtendedVersion,
        Command::HardwareReset,
        execute(vec![SpiWord::write(6, 0x100000)], false),
        execute(vec![SpiWord::read(2)], true),
        Command::ConfigureData { slice_samples: slice.samples as u16 },
        Command::StartData,
        execute(list.into_iter().map(SpiWord::from).collect(), false),
        Command::StopData,
        execute(vec![SpiWord::write(0, 0x1E827C)], false),
    ]
}

#[test]
fn requests_of_the_session_are_those_of_the_vendor_client() {
    let Some(transcript) = transcript(Protocol::V4) else { return };
    let sent: Vec<_> = transcript.into_iter().filter(|(host, _)| *host).map(|(_, bytes)| bytes).collect();
    assert_eq!(sent.len(), session().len());
    for (bytes, command) in sent.iter().zip(session()) {
        assert_eq!(&command.to_request(Protocol::V4).encode(), bytes, "{command:?}");
        let request = Request::decode(bytes).expect("decodes");
        assert_eq!(Command::from_request(&request), Ok(command));
    }
}

#[test]
fn commands_round_trip_in_both_versions() {
    let commands = session().into_iter().filter(|c| !matches!(c, Command::ComponentCount { .. }));
    let commands =
        commands.chain([Command::DataIndex, Command::DataStatus, Command::SetBits { address: 5, mask: 0xC0_0001 }]);
    for command in commands {
        for protocol in Protocol::ALL {
            let request = Request::decode(&command.to_request(protocol).encode()).expect("decodes");
            assert_eq!(request.protocol, protocol);
            assert_eq!(Command::from_request(&request).as_ref(), Ok(&command));
        }
    }
}

#[test]
fn requests_of_the_other_version_are_refused() {
    for (firmware, host) in [(Protocol::V4, Protocol::V3), (Protocol::V3, Protocol::V4)] {
        let mut parser = HostParser::new(firmware);
        let request = Command::BoardInfo.to_request(host);
        parser.push(&request.encode());
        let kind_code = request.kind_code();
        let refused = HostEvent::Refused { kind_code, status: Status::RequestTypeInvalid };
        assert_eq!(parser.next_event(), Some(refused));
        parser.push(&Command::BoardInfo.to_request(firmware).encode());
        assert!(matches!(parser.next_event(), Some(HostEvent::Request(_))));
    }
}

#[test]
fn answers_and_data_of_the_session_decode_to_an_unbroken_ramp() {
    let Some(transcript) = transcript(Protocol::V4) else { return };
    let mut parser = BoardParser::default();
    let (mut responses, mut packets, mut slice, mut codes) = (0, 0u16, Vec::new(), 0u64);
    for (host, bytes) in transcript {
        if host {
            continue;
        }
        // Three pieces, as a serial port may deliver them.
        let third = bytes.len() / 3;
        for piece in [&bytes[..third], &bytes[third..2 * third], &bytes[2 * third..]] {
            parser.push(piece);
            while let Some(event) = parser.next_event() {
                match event {
                    BoardEvent::Response(response) => {
                        assert_eq!(response.status, Status::Ok);
                        let mut encoded = Vec::new();
                        response.encode(&mut encoded);
                        assert_eq!(encoded, bytes);
                        responses += 1;
                    }
                    BoardEvent::Packet(packet) => {
                        let mut encoded = Vec::new();
                        packet.encode(&mut encoded);
                        assert_eq!(encoded, bytes);
                        assert_eq!(packet.counter, packets);
                        assert_eq!((packet.flags.first, packet.flags.last), (packets % 3 == 0, packets % 3 == 2));
                        packets += 1;
                        let (data, timestamp) = packet.split_timestamp();
                        assert_eq!(timestamp.is_some(), packet.flags.last);
                        slice.extend(data);
                        if packet.flags.last {
                            let mut unpacked = vec![0; 6144];
                            assert_eq!(packed12::unpack(&slice, &mut unpacked), 6144);
                            slice.clear();
                            for code in unpacked {
                                assert_eq!(u64::from(code), codes % 4096);
                                codes += 1;
                            }
                        }
                    }
                    BoardEvent::Damaged { .. } => panic!("damage in a clean transcript"),
                }
            }
        }
    }
    assert_eq!((responses, packets, codes), (15, 60, 20 * 6144));
}

/// Encodes a packet.
fn packet_bytes(counter: u16, payload: &[u8]) -> Vec<u8> {
    let flags = PacketFlags { first: true, last: true, ..PacketFlags::default() };
    let mut out = Vec::new();
    Packet { flags, channel: 0, counter, payload }.encode(&mut out);
    out
}

/// Counters of the packets in these bytes, which arrive in pieces.
fn counters(bytes: &[u8], piece: usize) -> Vec<u16> {
    let mut parser = BoardParser::default();
    let mut counters = Vec::new();
    let mut drain = |parser: &mut BoardParser| {
        while let Some(event) = parser.next_event() {
            if let BoardEvent::Packet(packet) = event {
                counters.push(packet.counter);
            }
        }
    };
    for piece in bytes.chunks(piece) {
        parser.push(piece);
        drain(&mut parser);
    }
    while parser.is_waiting() {
        parser.on_silence();
        drain(&mut parser);
    }
    counters
}

/// Regression test: a header with a wrong length hid the packets behind it until that many bytes had arrived. Small frames
/// arrived too slowly for that, and the board counted as stalled.
#[test]
fn a_wrong_length_does_not_hide_the_packets_behind_it() {
    let slice = SliceLayout::for_frame(32);
    let payload = vec![7; slice.payload_length(0)];
    let mut flipped = packet_bytes(1, &payload);
    // The length becomes 2048 bytes longer.
    flipped[5] ^= 0x08;
    let stray_answer = [0x40, 0, 0xF9, 0x0F].to_vec();
    let stray_packet = [0xD0, 0, 0, 0, 0xF0, 0x0F].to_vec();
    let stray_error = [0xD8, 0, 0, 0, 0xF0, 0x0F].to_vec();
    for garbage in [flipped, stray_answer, stray_packet, stray_error] {
        let mut parser = BoardParser::default();
        parser.set_slice_layout(Some(slice));
        parser.push(&garbage);
        parser.push(&packet_bytes(2, &payload));
        let mut found = Vec::new();
        while let Some(event) = parser.next_event() {
            if let BoardEvent::Packet(packet) = event {
                found.push(packet.counter);
            }
        }
        assert_eq!(found, [2], "{garbage:02x?}");
    }
    // Answers, error codes and texts still come between packets.
    let mut bytes = Vec::new();
    Response { kind_code: 0x40, status: Status::Ok, payload: &[] }.encode(&mut bytes);
    let flags = PacketFlags { first: true, last: true, error: true, ..PacketFlags::default() };
    Packet { flags, channel: 0, counter: 3, payload: b"a text" }.encode(&mut bytes);
    let mut parser = BoardParser::default();
    parser.set_slice_layout(Some(slice));
    parser.push(&bytes);
    assert!(matches!(parser.next_event(), Some(BoardEvent::Response(_))));
    assert!(matches!(parser.next_event(), Some(BoardEvent::Packet(packet)) if packet.error().is_none()));
}

proptest! {
    #[test]
    fn arbitrary_bytes_do_not_panic(bytes in prop::collection::vec(any::<u8>(), 0..2000), piece in 1usize..300) {
        counters(&bytes, piece);
        let mut host = HostParser::new(Protocol::V4);
        for piece in bytes.chunks(piece) {
            host.push(piece);
            while host.next_event().is_some() {}
        }
        let _ = Request::decode(&bytes);
        let _ = BoardInfo::decode(&bytes);
        let _ = FirmwareVersion::decode(&bytes);
    }

    #[test]
    fn arbitrary_commands_do_not_panic(
        (kind, request) in (0usize..3, prop::sample::select(vec![0x80u8, 0x20, 0x0D, 0x00])),
        (value, index) in (prop::sample::select(vec![0u16, 1, 2, 3, 4, 0x103]), any::<u16>()),
        payload in prop::collection::vec(any::<u8>(), 0..30),
    ) {
        let protocol = Protocol::ALL[usize::from(index % 2)];
        let kind = [RequestKind::Write, RequestKind::Read, RequestKind::Transfer][kind];
        let _ = Command::from_request(&Request { protocol, kind, request, value, index, length: 0, payload });
    }

    #[test]
    fn parser_finds_messages_after_garbage(
        garbage in prop::collection::vec(any::<u8>(), 0..200),
        payload in prop::collection::vec(any::<u8>(), 0..500),
        piece in 1usize..300,
    ) {
        let mut bytes = packet_bytes(1, &payload);
        bytes.extend(garbage);
        bytes.extend(packet_bytes(2, &payload));
        let found = counters(&bytes, piece);
        prop_assert_eq!((found.first(), found.last()), (Some(&1), Some(&2)));
    }

    #[test]
    fn one_flipped_bit_loses_one_packet(at in 0usize..3 * 108, bit in 0u32..8) {
        let payload: Vec<u8> = (0..100).collect();
        let mut bytes: Vec<u8> = (0..3).flat_map(|n| packet_bytes(n, &payload)).collect();
        bytes[at] ^= 1 << bit;
        let expected: Vec<u16> = (0..3).filter(|n| usize::from(*n) != at / 108).collect();
        prop_assert_eq!(counters(&bytes, 50), expected);
    }
}
