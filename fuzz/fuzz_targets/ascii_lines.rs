//! Lines of an ESP32: results do not depend on the pieces, memory is bounded, and a frame survives a round trip.

#![no_main]

use libfuzzer_sys::fuzz_target;
use radome_driver::protocol::ascii::{Line, LineError, LineParser, decode_waveform, encode, encode_waveform};
use radome_fuzz::{pieces, within};

#[derive(Debug, PartialEq)]
enum Found {
    Frame(u64, Vec<u16>),
    Log(Vec<u8>),
    Error(LineError),
}

fn parse<'a>(codes: usize, input: impl Iterator<Item = &'a [u8]>) -> Vec<Found> {
    let mut parser = LineParser::new(codes);
    let mut found = Vec::new();
    for piece in input {
        parser.push(piece);
        while let Some(line) = parser.next_line() {
            found.push(match line {
                Ok(Line::Frame { number, codes }) => Found::Frame(number, codes.to_vec()),
                Ok(Line::Log(text)) => Found::Log(text.to_vec()),
                Err(error) => Found::Error(error),
            });
        }
    }
    found
}

fuzz_target!(|input: &[u8]| {
    // Few codes, so that lines reach the length limit soon.
    let Some((&first, input)) = input.split_first() else { return };
    let codes = 1 + usize::from(first % 16);
    let found = parse(codes, std::iter::once(input));
    assert_eq!(found, parse(codes, pieces(input, 60)));
    for found in found {
        if let Found::Frame(number, codes) = found {
            assert!(codes.iter().all(|code| *code <= 4095));
            let mut line = Vec::new();
            encode(number, &codes, &mut line);
            assert_eq!(parse(codes.len(), line.chunks(7)), [Found::Frame(number, codes)]);
        }
    }
    for line in input.split(|b| *b == b'\n') {
        if let Some(Ok(request)) = decode_waveform(line) {
            let mut again = Vec::new();
            encode_waveform(&request, &mut again);
            let decoded = decode_waveform(again.strip_suffix(b"\n").expect("a line")).expect("says so");
            assert_eq!(decoded.expect("what was written is read"), request);
            let _ = radome_dsp::Waveform::realise(request);
        }
    }
    // The parser keeps nothing of what it has read.
    let mut parser = LineParser::new(codes);
    within(16 * 1024, || {
        for piece in pieces(input, 60) {
            parser.push(piece);
            while parser.next_line().is_some() {}
        }
    });
});
