//! Bytes from a board: messages do not depend on the pieces, each byte is accounted for, and each message encodes to
//! its bytes.

#![no_main]

use libfuzzer_sys::fuzz_target;
use radome_driver::protocol::mcu7::{BoardEvent, BoardParser, MAX_MESSAGE};
use radome_fuzz::{pieces, with_memory_limit};

#[derive(Debug, PartialEq)]
enum Item {
    Message(Vec<u8>),
    Damaged(usize),
}

/// Adds an event to the items; damage joins damage before it.
fn note(event: BoardEvent<'_>, items: &mut Vec<Item>) {
    let mut bytes = Vec::new();
    match event {
        BoardEvent::Response(response) => response.encode(&mut bytes),
        BoardEvent::Packet(packet) => packet.encode(&mut bytes),
        BoardEvent::Damaged { bytes } => {
            assert!(bytes > 0);
            // The division of garbage depends on when it arrived; its total length does not.
            return match items.last_mut() {
                Some(Item::Damaged(before)) => *before += bytes,
                _ => items.push(Item::Damaged(bytes)),
            };
        }
    }
    items.push(Item::Message(bytes));
}

/// Messages in these pieces, and the number of bytes that still wait. With `peek`, each message is inspected before it
/// is taken.
fn parse<'a>(input: impl Iterator<Item = &'a [u8]>, peek: bool) -> (Vec<Item>, usize) {
    let mut parser = BoardParser::with_capacity(1024);
    let (mut items, mut pushed) = (Vec::new(), 0);
    for piece in input {
        pushed += piece.len();
        parser.push(piece);
        loop {
            let response = if peek { parser.peek_is_response() } else { Some(false) };
            let Some(event) = parser.next_event() else { break };
            if peek {
                assert_eq!(response, Some(matches!(event, BoardEvent::Response(_))));
            }
            note(event, &mut items);
        }
    }
    let taken: usize = items.iter().map(|f| if let Item::Message(bytes) = f { bytes.len() } else { 0 }).sum();
    let damaged: usize = items.iter().map(|f| if let Item::Damaged(bytes) = f { *bytes } else { 0 }).sum();
    let waiting = pushed - taken - damaged;
    assert!(waiting < MAX_MESSAGE, "{waiting} bytes wait");
    assert_eq!(parser.is_waiting(), waiting > 0);
    // After the line falls silent, the parser must finish.
    for _ in 0..=waiting {
        parser.on_silence();
        while parser.next_event().is_some() {}
    }
    assert!(!parser.is_waiting());
    (items, waiting)
}

fuzz_target!(|input: &[u8]| {
    let at_once = with_memory_limit(64 * 1024 + 8 * input.len(), || parse(std::iter::once(input), false));
    // Every byte keeps its position.
    let mut at = 0;
    for item in &at_once.0 {
        match item {
            Item::Message(bytes) => {
                assert_eq!(input.get(at..at + bytes.len()), Some(bytes.as_slice()));
                at += bytes.len();
            }
            Item::Damaged(bytes) => at += bytes,
        }
    }
    assert_eq!(at + at_once.1, input.len());
    let in_pieces = with_memory_limit(64 * 1024 + 8 * input.len(), || parse(pieces(input, 300), true));
    assert_eq!(at_once, in_pieces);
});
