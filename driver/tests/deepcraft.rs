//! Compares the DEEPCRAFT protocol with bytes written by hand and with protobuf, and tests it on a faulty link.

use proptest::prelude::*;
use prost::Message;
use radome_driver::protocol::deepcraft::*;

use crate::common::{captured_waveform, unhex};

const LAYOUT: ChunkLayout = ChunkLayout { device: 0, stream: 0, frame_codes: 40 };

/// Codes of a frame as a function of its number. The last code cannot be mistaken for a length (see
/// [`hard_cases::a_code_that_could_be_a_length_waits_for_more`]).
fn codes(layout: ChunkLayout, number: u32) -> Vec<u16> {
    let code = |i: u32| (i.wrapping_mul(2_654_435_761).wrapping_add(number.wrapping_mul(40_503)) >> 7) as u16 & 0xFFF;
    let last = layout.frame_codes as u32 - 1;
    (0..last).map(code).chain([code(last) & !0x80]).collect()
}

/// Encodes a chunk.
fn chunk(layout: ChunkLayout, number: u32, frames: u32) -> Vec<u8> {
    let codes: Vec<u16> = (0..frames).flat_map(|i| codes(layout, number.wrapping_add(i))).collect();
    let mut line = Vec::new();
    layout.encode(number, &codes, &mut line);
    line
}

/// Compares words of the captured blob with values written by hand.
#[test]
fn words_are_at_the_positions_of_the_firmware() {
    let blob = Custom::compile(&captured_waveform()).expect("fits").encode();
    let word = |i: usize| u32::from_le_bytes(blob[4 * i..4 * i + 4].try_into().expect("four bytes"));
    assert_eq!([word(0), word(1)], [38, 16]);
    assert_eq!(u64::from(word(3)) << 32 | u64::from(word(2)), 58_000_000_000);
    assert_eq!(u64::from(word(5)) << 32 | u64::from(word(4)), 63_000_000_000);
    assert_eq!([6, 7, 8, 9, 10].map(word), [64, 64, 3, 1, 2_000_000]);
    assert_eq!([11, 12].map(|i| f32::from_bits(word(i))), [591.125e-6, 0.0772688]);
    assert_eq!(blob.len(), 4 * (16 + 38));
    // ADC0 and PACR1 of the captured list as SPI write words.
    assert_eq!([word(16), word(17)], [0x030A_0210, 0x09E9_67FD]);
    // MAIN does not contain the start, which the firmware adds.
    assert_eq!(word(16 + 37), 0x011E_8270);
}

/// Events that a parser reported.
#[derive(Debug, Default, PartialEq)]
struct Received {
    frames: Vec<u32>,
    misnumbered: usize,
    errors: Vec<ErrorResponse>,
    damaged: bool,
}

/// Collects all events of a parser. Asserts that frames have the codes of their numbers.
fn collect_events(parser: &mut ChunkParser, layout: ChunkLayout, received: &mut Received) {
    while let Some(event) = parser.next_event() {
        match event {
            ChunkEvent::Frames { frame_number, frame_count, codes: payload } => {
                assert_eq!(payload.len(), frame_count * layout.frame_codes);
                for (i, frame) in (0..).zip(payload.chunks(layout.frame_codes)) {
                    let number = frame_number.wrapping_add(i);
                    let frame: Vec<u16> = frame.iter().map(|code| u16::from_le_bytes(*code)).collect();
                    assert_eq!(frame, codes(layout, number), "frame {number}");
                    received.frames.push(number);
                }
            }
            ChunkEvent::Misnumbered => received.misnumbered += 1,
            ChunkEvent::Error(error) => received.errors.push(error),
            ChunkEvent::Damaged => {
                received.damaged = true;
                return;
            }
        }
    }
}

/// Passes bytes to a parser in pieces. Reports silence of the line at the end, and after each piece if `silent` is
/// true.
fn receive(layout: ChunkLayout, first: u32, line: &[u8], pieces: &[usize], silent: bool) -> Received {
    let (mut parser, mut received) = (ChunkParser::new(layout, first), Received::default());
    let (mut rest, mut pieces) = (line, pieces.iter().cycle());
    while !rest.is_empty() && !received.damaged {
        let (piece, after) = rest.split_at((*pieces.next().expect("endless")).clamp(1, rest.len()));
        rest = after;
        parser.push(piece);
        collect_events(&mut parser, layout, &mut received);
        if silent && !received.damaged {
            parser.on_silence();
            collect_events(&mut parser, layout, &mut received);
        }
    }
    if !received.damaged {
        parser.on_silence();
        collect_events(&mut parser, layout, &mut received);
        parser.on_long_silence();
        collect_events(&mut parser, layout, &mut received);
    }
    received
}

/// Parses hexadecimal digits; text after a bar is a remark.
fn hex(text: &str) -> Vec<u8> {
    unhex(&text.lines().filter_map(|line| line.split('|').next()).flat_map(str::split_whitespace).collect::<String>())
}

/// Messages written by hand from the rules of protobuf and the fields of the captured messages. Rules: key = field << 3
/// | wire type; varints have seven bits at a time, lowest first; sint32 is zig-zag; negative int32 has 64 bits; zeros
/// are omitted.
mod by_hand {
    use super::*;

    fn request(command: Command) -> Vec<u8> {
        let mut line = Vec::new();
        Request::from(command).encode_to(&mut line);
        line
    }

    #[test]
    fn requests() {
        let capabilities = hex("09             | nine bytes follow
             0A 07          | 1: capabilities, seven bytes
             08 01          | 1: device -1
             10 81 80 80 08 | 2: tag 2^24 + 1");
        let device = ALL_DEVICES;
        assert_eq!(request(Command::Capabilities(CapabilitiesRequest { device, tag: (1 << 24) + 1 })), capabilities);
        assert_eq!(request(Command::Stop(StopRequest { device })), hex("04 22 02 08 01"));
        assert_eq!(request(Command::Start(StartRequest { device: 0 })), hex("02 1A 00"));
        assert_eq!(request(Command::Start(StartRequest { device: 3 })), hex("04 1A 02 08 03"));
        assert_eq!(request(Command::WatchdogReset(Empty {})), hex("02 2A 00"));
        let configure = hex("0D 12 0B          | 2: configuration
             08 02             | 1: device 2, not zig-zag
             12 04 08 01 28 03 | 2: option 1 is item 3
             18 E7 07          | 3: tag 999");
        let options = vec![OptionValue { option_id: USE_CASE, value: Some(Value::OneOf(3)) }];
        assert_eq!(request(Command::Configure(ConfigureRequest { device: 2, options, tag: 999 })), configure);
        let blob = hex("0F 12 0D 08 01 12 09 08 02 32 05 DE AD BE EF 00");
        let options = vec![OptionValue { option_id: CUSTOM_DATA, value: Some(Value::Blob(hex("DE AD BE EF 00"))) }];
        assert_eq!(request(Command::Configure(ConfigureRequest { device: 1, options, tag: 0 })), blob);
    }

    #[test]
    fn capabilities() {
        let line = hex("8B 01 0A 88 01 0A 80 01 | 139 bytes; 1: capabilities, 136 bytes; 1: board, 128 bytes
             0A 12 0A 10 00 01 02 03 04 05 06 07 08 09 0A 0B 0C 0D 0E 0F | 1: serial, 1: UUID
             12 03 4B 69 74 | 2: name Kit
             1A 04 08 01 10 02 | 3: firmware 1.2
             22 09 08 02 10 03 18 C2 B6 D3 09 | 4: protocol 2.3.20241218
             28 B8 17 | 5: watchdog 3000 ms
             32 51 | 6: a device, number 0
                12 05 52 61 64 61 72 20 01 | 2: name Radar, 4: a sensor
                2A 21 08 01 12 08 55 73 65 20 63 61 73 65 | 5: option 1, Use case
                  3A 13 10 01 1A 07 44 65 66 61 75 6C 74 1A 06 43 75 73 74 6F 6D | item 1 of Default, Custom
                32 23 0A 05 52 61 64 61 72 10 02 18 04 | 6: stream Radar, output, S16
                  22 0B 0A 07 41 6E 74 65 6E 6E 61 10 03 | 4: Antenna, 3
                  2D 00 00 04 42 30 01 40 07 48 05 | 5: 33 Hz, 6: 1 frame, 8: next is frame 7, 9: 5 dropped
             10 81 80 80 08 | 2: tag");
        let stream = StreamConfig {
            name: "Radar".into(),
            direction: direction::OUTPUT,
            data_type: data_type::S16,
            shape: vec![Dimension { name: "Antenna".into(), size: 3, labels: vec![] }],
            frequency: 33.0,
            max_frame_count: 1,
            current_frame: 7,
            frames_dropped: 5,
            ..StreamConfig::default()
        };
        let items = vec!["Default".into(), CUSTOM.into()];
        let use_case = OptionOneOf { default_index: 0, current_index: 1, items };
        let radar = Device {
            name: "Radar".into(),
            device_type: device_type::SENSOR,
            options: vec![DeviceOption {
                option_id: USE_CASE,
                name: "Use case".into(),
                description: String::new(),
                kind: Some(OptionKind::OneOf(use_case)),
            }],
            streams: vec![stream],
            ..Device::default()
        };
        let [major, minor, build, revision] = PROTOCOL_VERSION;
        let board = Board {
            serial: Some(BoardSerial { uuid: (0..16).collect() }),
            name: "Kit".into(),
            firmware_version: Some(Version { major: 1, minor: 2, build: 0, revision: 0 }),
            protocol_version: Some(Version { major, minor, build, revision }),
            watchdog_timeout: 3000,
            devices: vec![radar],
        };
        let response =
            Response::from(Answer::Capabilities(CapabilitiesResponse { board: Some(board), tag: (1 << 24) + 1 }));
        let mut parser = MessageParser::new(MAX_RESPONSE);
        parser.push(&line);
        let message = parser.next_message().expect("whole").expect("short enough");
        assert_eq!(Response::decode(message).expect("decodes"), response);
        let mut encoded = Vec::new();
        response.encode_to(&mut encoded);
        assert_eq!(encoded, line);
    }

    #[test]
    fn errors_and_data() {
        let line = hex("12 1A 10 0A 03 4E 6F 2E | 3: error, 1: No.
             10 F4 FF FF FF FF FF FF FF FF 01 | 2: code -12
             15 22 13 08 02 10 01 18 01 20 AC 02 | 4: data of device 2, stream 1: 1 frame, number 300
             2A 08 01 00 FF 0F 34 02 00 08 | 5: codes 1, 4095, 564, 2048");
        let layout = ChunkLayout { device: 2, stream: 1, frame_codes: 4 };
        let mut parser = ChunkParser::new(layout, 300);
        parser.push(&line);
        let error = ErrorResponse { message: "No.".into(), code: ErrorCode::NO_SUCH_DEVICE.0 };
        assert_eq!(parser.next_event(), Some(ChunkEvent::Error(error)));
        assert_eq!(parser.next_event(), None, "not confirmed yet");
        parser.on_silence();
        let codes: &[[u8; 2]] = &[[1, 0], [0xFF, 0xF], [0x34, 2], [0, 8]];
        let frames = ChunkEvent::Frames { frame_number: 300, frame_count: 1, codes };
        assert_eq!(parser.next_event(), Some(frames));
        let mut encoded = Vec::new();
        layout.encode(300, &[1, 4095, 564, 2048], &mut encoded);
        assert_eq!(encoded, line[19..]);
    }
}

fn layouts() -> impl Strategy<Value = ChunkLayout> {
    (0..300i32, 0..3i32, 4..700usize).prop_map(|(device, stream, half)| ChunkLayout {
        device,
        stream,
        frame_codes: 2 * half,
    })
}

proptest! {
    #[test]
    fn chunks_equal_those_of_protobuf(layout in layouts(), number: u32, frames in 1u32..4) {
        let line = chunk(layout, number, frames);
        let ChunkLayout { device, stream, .. } = layout;
        let codes = (0..frames).flat_map(|i| codes(layout, number.wrapping_add(i)));
        let payload: Vec<u8> = codes.flat_map(u16::to_le_bytes).collect();
        let (frame_number, frame_count) = (number as i32, frames as i32);
        let chunk = DataChunk { device, stream, frame_count, frame_number, payload, timestamps: vec![] };
        let mut expected = Vec::new();
        Response::from(Answer::Data(chunk.clone())).encode_to(&mut expected);
        prop_assert_eq!(&line, &expected);
        let Beginning::Chunk(header) = layout.beginning(&line) else { panic!("a chunk") };
        prop_assert_eq!((header.frame_number, header.frame_count, header.end), (number, frames as usize, line.len()));
        prop_assert_eq!(&line[header.payload_start..header.payload_end], &chunk.payload[..]);
        // Any incomplete part of the message is reported as incomplete.
        for length in 0..header.payload_start {
            prop_assert_eq!(layout.beginning(&line[..length]), Beginning::Incomplete);
        }
    }

    #[test]
    fn unknown_fields_are_skipped(layout in layouts(), number in 0u32..1_000_000, extra: u32, stamp: i64) {
        let mut data_chunk = DataChunk {
            device: layout.device,
            stream: layout.stream,
            frame_count: 1,
            frame_number: number as i32,
            payload: codes(layout, number).into_iter().flat_map(u16::to_le_bytes).collect(),
            timestamps: vec![Timestamp { timestamp: stamp, duration: 1 }],
        };
        // Adds an unknown field 9, a varint, before the others.
        let mut inner = vec![9 << 3];
        prost::encoding::encode_varint(u64::from(extra), &mut inner);
        data_chunk.encode(&mut inner).expect("room");
        let mut message = vec![4 << 3 | 2];
        prost::encoding::encode_varint(inner.len() as u64, &mut message);
        message.extend(inner);
        let mut line = Vec::new();
        prost::encoding::encode_varint(message.len() as u64, &mut line);
        line.extend(&message);
        let Response { answer: Some(Answer::Data(decoded)) } = Response::decode(&message[..]).expect("decodes") else {
            panic!("data");
        };
        prop_assert_eq!(&decoded, &data_chunk);
        data_chunk.timestamps.clear();
        line.extend(chunk(layout, number + 1, 1));
        let found = receive(layout, number, &line, &[line.len()], false);
        prop_assert_eq!(found.frames, vec![number, number + 1]);
        // Adds the same field to an answer.
        let tag = extra as i32;
        let mut message = Response::from(Answer::Capabilities(CapabilitiesResponse { board: None, tag })).encode_to_vec();
        message.extend([0x98, 0x06, 5]);
        let Response { answer: Some(Answer::Capabilities(decoded)) } = Response::decode(&message[..]).expect("decodes")
        else {
            panic!("capabilities");
        };
        prop_assert_eq!(decoded.tag, tag);
    }

    #[test]
    fn pieces_make_no_difference(
        layout in layouts(),
        first in 0u32..200,
        counts in prop::collection::vec(1u32..4, 1..8),
        pieces in prop::collection::vec(1usize..500, 1..20),
        silent: bool,
    ) {
        let mut number = first;
        let mut line = Vec::new();
        for count in counts {
            line.extend(chunk(layout, number, count));
            number += count;
        }
        let found = receive(layout, first, &line, &pieces, silent);
        prop_assert_eq!(found, Received { frames: (first..number).collect(), ..Received::default() });
    }

    #[test]
    fn any_bytes_are_parsed_without_panic(layout in layouts(), bytes in prop::collection::vec(any::<u8>(), 0..400)) {
        let mut parser = ChunkParser::new(layout, 0);
        parser.push(&bytes);
        parser.on_silence();
        for _ in 0..100 {
            if matches!(parser.next_event(), None | Some(ChunkEvent::Damaged)) {
                break;
            }
        }
    }
}

mod hard_cases {
    use super::*;

    /// Layouts with each length of header: messages below 128 bytes, below 2048, and longer.
    const LAYOUTS: [ChunkLayout; 4] = [
        ChunkLayout { device: 0, stream: 0, frame_codes: 8 },
        ChunkLayout { device: 0, stream: 0, frame_codes: 60 },
        ChunkLayout { device: 3, stream: 1, frame_codes: 128 },
        ChunkLayout { device: 0, stream: 0, frame_codes: 1536 },
    ];

    /// Asserts that an inner length of ten bytes that extends past its message is reported as damage (found by
    /// fuzzing).
    #[test]
    fn a_length_that_extends_past_its_message_is_damage() {
        for layout in LAYOUTS {
            let length = (2 * layout.frame_codes + 16) as u8 | 1;
            for inner in 0..=20usize {
                let bytes = [&[length & 0x7F, 0x22][..], &vec![0xFF; inner], &[0x01], &[0xFF; 40]].concat();
                assert!(!matches!(layout.beginning(&bytes), Beginning::Chunk(_)), "{layout:?} {inner}");
            }
        }
        let layout = ChunkLayout { device: 0, stream: 0, frame_codes: 2 };
        let bytes = [&[0x0A, 0x22][..], &[0xFF; 9], &[0x69], &[0xFF; 53]].concat();
        assert_eq!(layout.beginning(&bytes), Beginning::No);
    }

    #[test]
    fn a_message_cut_anywhere_changes_no_frame() {
        for layout in LAYOUTS {
            for (first, frames) in [(0, 1), (126, 1), (127, 2)] {
                let before = chunk(layout, first, frames);
                let cut = chunk(layout, first + frames, frames);
                let after: Vec<u8> = (2..5).flat_map(|i| chunk(layout, first + i * frames, frames)).collect();
                let step = if layout.frame_codes > 1000 { 7 } else { 1 };
                for length in (0..cut.len()).filter(|length| length % step == 0 || cut.len() - length < 80) {
                    let line = [&before, &cut[..length], &after].concat();
                    for (pieces, silent) in [(vec![line.len()], false), (vec![1], true)] {
                        let found = receive(layout, first, &line, &pieces, silent);
                        // A message that is lost completely leaves no damage.
                        let is_damaged = found.damaged || length == 0;
                        assert!(is_damaged, "{layout:?}, cut to {length}: {found:?}");
                        let later = found.frames.iter().filter(|number| **number >= first + 2 * frames).count();
                        assert!(length == 0 || later == 0, "cut to {length}: no frame is found behind damage");
                    }
                }
            }
        }
    }

    /// Asserts that the parser waits for more bytes if the last code of a chunk could be the length of the next one.
    /// When the line is silent after it, the parser cannot know whether the chunk is complete.
    #[test]
    fn a_code_that_could_be_a_length_waits_for_more() {
        let layout = ChunkLayout { device: 0, stream: 0, frame_codes: 128 };
        let mut codes = codes(layout, 0);
        let mut line = Vec::new();
        layout.encode(0, &codes, &mut line);
        let length = u16::from_le_bytes([line[0], line[1]]);
        assert!(length <= 4095, "it could be a code");
        codes[127] = length;
        line.clear();
        layout.encode(0, &codes, &mut line);
        let mut parser = ChunkParser::new(layout, 0);
        parser.push(&line);
        parser.on_silence();
        assert_eq!(parser.next_event(), None);
        parser.on_long_silence();
        assert_eq!(parser.next_event(), None, "long silence behind a whole chunk is no damage");
        parser.push(&chunk(layout, 1, 1));
        assert!(matches!(parser.next_event(), Some(ChunkEvent::Frames { frame_number: 0, .. })));
    }

    #[test]
    fn a_flipped_bit_before_the_samples_changes_no_frame() {
        for layout in LAYOUTS {
            let (first, frames) = (5, 2);
            let before = chunk(layout, first, frames);
            let hit = chunk(layout, first + frames, frames);
            let after: Vec<u8> = (2..5).flat_map(|i| chunk(layout, first + i * frames, frames)).collect();
            let Beginning::Chunk(header) = layout.beginning(&hit) else { panic!("a chunk") };
            for bit in 0..8 * header.payload_start {
                let mut hit = hit.clone();
                hit[bit / 8] ^= 1 << (bit % 8);
                let line = [&before[..], &hit, &after].concat();
                for (pieces, silent) in [(vec![line.len()], false), (vec![1], true)] {
                    let found = receive(layout, first, &line, &pieces, silent);
                    assert!(found.damaged || found.misnumbered == 1, "bit {bit}: {found:?}");
                    assert!(found.frames.is_sorted() && found.frames.iter().all(|n| !(7..9).contains(n)), "{found:?}");
                }
            }
        }
    }

    #[test]
    fn a_code_beyond_the_adc_is_damage() {
        for code in [4096, 0x8000, u16::MAX] {
            let mut codes = super::codes(LAYOUT, 0);
            codes[17] = code;
            let mut line = Vec::new();
            LAYOUT.encode(0, &codes, &mut line);
            line.extend(chunk(LAYOUT, 1, 1));
            let found = receive(LAYOUT, 0, &line, &[line.len()], false);
            assert_eq!(found, Received { damaged: true, ..Received::default() });
        }
    }

    #[test]
    fn doubled_late_and_missing_frames_keep_their_numbers() {
        let line = |numbers: &[u32]| -> Vec<u8> { numbers.iter().flat_map(|n| chunk(LAYOUT, *n, 1)).collect() };
        for (sent, expected, misnumbered) in [
            (&[0, 1, 1, 2, 3][..], &[0, 1, 1, 2, 3][..], 0),
            (&[0, 2, 3, 4], &[0, 2, 3, 4], 0),
            // The early frame is dropped, since its number may be wrong.
            (&[0, 2, 1, 3, 4], &[0, 1, 3, 4], 1),
            (&[9, 10, 11], &[9, 10, 11], 0),
        ] {
            let line = line(sent);
            let found = receive(LAYOUT, 0, &line, &[line.len()], false);
            assert_eq!(
                (&found.frames[..], found.misnumbered, found.damaged),
                (expected, misnumbered, false),
                "{sent:?}"
            );
        }
        // A jump in the numbers needs a second frame that confirms it.
        let found = receive(LAYOUT, 0, &line(&[0, 3]), &[1], true);
        assert_eq!(found, Received { frames: vec![0], ..Received::default() });
    }

    #[test]
    fn frame_numbers_wrap() {
        let first = u32::MAX - 1;
        let line: Vec<u8> = (0..5).flat_map(|i| chunk(LAYOUT, first.wrapping_add(i), 1)).collect();
        let found = receive(LAYOUT, first, &line, &[13], true);
        assert_eq!(found.frames, [u32::MAX - 1, u32::MAX, 0, 1, 2]);
    }

    #[test]
    fn an_error_between_chunks_is_reported() {
        let error = ErrorResponse { message: "Device already active.".into(), code: -20 };
        let mut line = chunk(LAYOUT, 0, 1);
        Response::from(Answer::Error(error.clone())).encode_to(&mut line);
        line.extend(chunk(LAYOUT, 1, 1));
        for pieces in [1, 1000] {
            let found = receive(LAYOUT, 0, &line, &[pieces], false);
            assert_eq!(found, Received { frames: vec![0, 1], errors: vec![error.clone()], ..Received::default() });
        }
    }

    #[test]
    fn huge_lengths_are_damage_and_not_waited_for() {
        for line in [&[0xFF, 0xFF, 0xFF, 0x7F][..], &[0xFF; 12], &[0x80, 0x80, 0x80, 0x80, 0x10]] {
            let mut parser = ChunkParser::new(LAYOUT, 0);
            parser.push(line);
            assert_eq!(parser.next_event(), Some(ChunkEvent::Damaged), "{line:x?}");
        }
    }
}
