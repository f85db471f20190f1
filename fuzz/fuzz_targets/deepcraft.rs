//! DEEPCRAFT messages, chunks and custom data: no panic, and bounded memory. Messages do not depend on the pieces and
//! mean the same when encoded again. A chunk holds only frames of the stream.

#![no_main]

use libfuzzer_sys::fuzz_target;
use prost::Message;
use radome_driver::protocol::deepcraft::{
    ChunkEvent, ChunkLayout, ChunkParser, Custom, MAX_REQUEST, MAX_RESPONSE, MessageParser, Request, Response,
};
use radome_fuzz::{pieces, with_memory_limit};

fn messages<'a>(input: impl Iterator<Item = &'a [u8]>) -> Vec<Option<Vec<u8>>> {
    let mut parser = MessageParser::new(MAX_REQUEST);
    let mut messages = Vec::new();
    for piece in input {
        parser.push(piece);
        while let Some(message) = parser.next_message() {
            match message {
                Ok(message) => messages.push(Some(message.to_vec())),
                // The start of the next message is unknown.
                Err(_) => {
                    messages.push(None);
                    return messages;
                }
            }
        }
    }
    messages
}

/// Checks numbers and codes of frames up to the first damage.
fn chunks<'a>(layout: ChunkLayout, input: impl Iterator<Item = &'a [u8]>) {
    let mut parser = ChunkParser::new(layout, 0);
    for piece in input {
        parser.push(piece);
        loop {
            match parser.next_event() {
                None => break,
                Some(ChunkEvent::Damaged) => return,
                Some(ChunkEvent::Frames { frame_count, codes, .. }) => {
                    assert_eq!(codes.len(), frame_count * layout.frame_codes);
                    assert!(codes.iter().all(|code| u16::from_le_bytes(*code) <= 4095));
                }
                Some(_) => {}
            }
        }
    }
    parser.on_silence();
    for _ in 0..1000 {
        match parser.next_event() {
            None | Some(ChunkEvent::Damaged) => return,
            Some(_) => {}
        }
    }
}

fuzz_target!(|input: &[u8]| {
    let allowed = (1 << 20) + 2 * MAX_RESPONSE + 1024 * input.len();
    let at_once = with_memory_limit(allowed, || messages(std::iter::once(input)));
    assert_eq!(at_once, messages(pieces(input, 40)));
    for message in at_once.iter().flatten().map(Vec::as_slice).chain([input]) {
        if let Ok(request) = with_memory_limit(allowed, || Request::decode(message)) {
            assert_eq!(Request::decode(request.encode_to_vec().as_slice()).map_err(|e| e.to_string()), Ok(request));
        }
        if let Ok(response) = with_memory_limit(allowed, || Response::decode(message)) {
            // NaN compares unequal to itself, so that bytes are compared.
            let bytes = response.encode_to_vec();
            let again = Response::decode(bytes.as_slice()).expect("what was encoded is decoded");
            assert_eq!(again.encode_to_vec(), bytes);
        }
        if let Ok(custom) = with_memory_limit(allowed, || Custom::decode(message)) {
            let again = Custom::decode(&custom.encode()).expect("what was encoded is decoded");
            assert_eq!(again.encode(), custom.encode());
        }
    }
    for frame_codes in [2, 16, 96] {
        let layout = ChunkLayout { device: 0, stream: 0, frame_codes };
        with_memory_limit(allowed, || chunks(layout, std::iter::once(input)));
        with_memory_limit(allowed, || chunks(layout, pieces(input, 60)));
    }
});
