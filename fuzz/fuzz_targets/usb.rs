//! Transfers over USB. Bulk reads of any length give each byte once, in a packet equal to its encoding or as damage.
//! Also checks control setups, and commands and answers of debug probes.

#![no_main]

use libfuzzer_sys::fuzz_target;
use radome_driver::protocol::cmsis_dap::{Answer, Command, Info};
use radome_driver::protocol::mcu7::bulk::{BulkParser, Control, LastError, MAX_BULK};
use radome_driver::protocol::mcu7::{BoardEvent, Framing};
use radome_fuzz::{pieces, with_memory_limit};

/// Asserts that no byte of these reads is lost or repeated.
fn check_bulk(input: &[u8]) {
    let mut parser = BulkParser::new();
    let (mut pushed, mut accounted) = (0, 0);
    for read in pieces(input, 2 * Framing::USB_PACKET) {
        parser.push(read);
        pushed += read.len();
        while let Some(event) = parser.next_event() {
            accounted += match event {
                BoardEvent::Packet(packet) => {
                    let mut bytes = Vec::new();
                    packet.encode_as(Framing::Bulk, &mut bytes);
                    assert!(bytes.len() <= MAX_BULK);
                    let at = accounted;
                    assert_eq!(input.get(at..at + bytes.len()), Some(bytes.as_slice()));
                    bytes.len()
                }
                BoardEvent::Damaged { bytes } => bytes,
                BoardEvent::Response(_) => panic!("answers do not come here"),
            };
        }
        assert_eq!(parser.is_waiting(), pushed > accounted);
    }
    accounted += parser.give_up();
    assert_eq!(accounted, pushed);
    assert!(!parser.is_waiting());
}

/// Checks commands and answers of debug probes.
fn check_probe(input: &[u8]) {
    if let Some(command) = Command::decode(input) {
        assert_eq!(Command::decode(&command.encode()), Some(command));
    }
    let pins = Command::Pins { output: 0, select: 0x80, wait_us: 1 };
    let others = [Command::Connect, Command::Disconnect, Command::ResetTarget, pins];
    for command in Info::ALL.into_iter().map(Command::Info).chain(others) {
        match command.answer(input) {
            // Status bytes that are neither good nor bad decode as bad.
            Ok(answer) => assert_eq!(command.answer(&answer.encode()), Ok(answer)),
            Err(error) => assert!(!error.to_string().is_empty()),
        }
    }
    let _ = Answer::Info(input).encode();
}

fuzz_target!(|input: &[u8]| {
    with_memory_limit(256 * 1024 + 8 * input.len(), || {
        check_bulk(input);
        check_probe(input);
        if let Some((setup, data)) = input.split_first_chunk() {
            let _ = Control::decode(setup, data);
        }
        if let Some(error) = LastError::decode(input) {
            assert_eq!(LastError::decode(&error.encode()), Some(error));
        }
    });
});
