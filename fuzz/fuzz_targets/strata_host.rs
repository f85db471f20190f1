//! Bytes from a host, and payloads of answers: requests encode to their bytes, and commands keep their meaning.

#![no_main]

use libfuzzer_sys::fuzz_target;
use radome_driver::chip::{ChipConfiguration, RegisterFile};
use radome_driver::protocol::mcu7::{
    BoardInfo, Command, FirmwareVersion, HostEvent, HostParser, MAX_MESSAGE, Protocol, Request,
};
use radome_fuzz::{pieces, with_memory_limit};

fn parse<'a>(protocol: Protocol, input: impl Iterator<Item = &'a [u8]>) -> Vec<HostEvent> {
    let mut parser = HostParser::new(protocol);
    let mut events = Vec::new();
    for piece in input {
        parser.push(piece);
        while let Some(event) = parser.next_event() {
            // A parser that refuses a request discards all its bytes, like the firmware. The result then depends on the
            // pieces.
            let is_refused = matches!(event, HostEvent::Refused { .. });
            events.push(event);
            if is_refused {
                return events;
            }
        }
    }
    events
}

/// Checks that a request keeps its meaning, and that its register values cause no panic.
fn check(request: &Request) {
    let bytes = request.encode();
    assert!(bytes.len() <= MAX_MESSAGE);
    assert_eq!(Request::decode(&bytes).as_ref(), Some(request));
    let Ok(command) = Command::from_request(request) else { return };
    let again = command.to_request(request.protocol);
    assert_eq!(Command::from_request(&again).as_ref(), Ok(&command), "{request:?}");
    // No register value of a host may cause a panic.
    if let Command::Execute { words, .. } = &command {
        let mut registers = RegisterFile::default();
        for word in words {
            registers.set(word.address, word.value);
        }
        if let Ok(configuration) = ChipConfiguration::decode(&registers)
            && let Ok(list) = configuration.compile()
        {
            let mut again = RegisterFile::default();
            list.iter().for_each(|r| again.set(r.address, r.value));
            let decoded = ChipConfiguration::decode(&again).expect("what was compiled can be decoded");
            assert_eq!(decoded.waveform.shape(), configuration.waveform.shape());
        }
    }
}

fuzz_target!(|input: &[u8]| {
    for protocol in Protocol::ALL {
        let at_once = with_memory_limit(64 * 1024 + 16 * input.len(), || parse(protocol, std::iter::once(input)));
        assert_eq!(at_once, parse(protocol, pieces(input, 40)));
        for event in &at_once {
            if let HostEvent::Request(request) = event {
                assert_eq!(request.protocol, protocol);
                check(request);
            }
        }
    }
    if let Some(request) = Request::decode(input) {
        assert_eq!(request.encode(), input);
        check(&request);
    }
    if let Ok(info) = BoardInfo::decode(input) {
        assert_eq!(BoardInfo::decode(&info.encode()).as_ref(), Ok(&info));
    }
    if let Ok(version) = FirmwareVersion::decode(input) {
        assert_eq!(version.encode()[..12], input[..12]);
        assert_eq!(FirmwareVersion::decode(&version.encode()), Ok(version));
    }
});
