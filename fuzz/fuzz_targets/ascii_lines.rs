//! Lines of an ESP32: results do not depend on the pieces, memory is bounded, and a frame survives a round trip.

#![no_main]

use libfuzzer_sys::fuzz_target;
use radome_driver::protocol::ascii::{Line, LineError, LineParser, decode_waveform, encode, encode_waveform};
use radome_fuzz::{pieces, with_memory_limit};

#[derive(Debug, PartialEq)]
enum ParsedLine {
    Frame(u64, Vec<u16>),
    Log(Vec<u8>),
    Error(LineError),
}

fn parse<'a>(codes: usize, input: impl Iterator<Item = &'a [u8]>) -> Vec<ParsedLine> {
    let mut parser = LineParser::new(codes);
    let mut lines = Vec::new();
    for piece in input {
        parser.push(piece);
        while let Some(line) = parser.next_line() {
            lines.push(match line {
                Ok(Line::Frame { number, codes }) => ParsedLine::Frame(number, codes.to_vec()),
                Ok(Line::Log(text)) => ParsedLine::Log(text.to_vec()),
                Err(error) => ParsedLine::Error(error),
            });
        }
    }
    lines
}

fuzz_target!(|input: &[u8]| {
    // Few codes, so that lines reach the length limit soon.
    let Some((&first, input)) = input.split_first() else { return };
    let codes = 1 + usize::from(first % 16);
    let lines = parse(codes, std::iter::once(input));
    assert_eq!(lines, parse(codes, pieces(input, 60)));
    for line in lines {
        if let ParsedLine::Frame(number, codes) = line {
            assert!(codes.iter().all(|code| *code <= 4095));
            let mut line = Vec::new();
            encode(number, &codes, &mut line);
            assert_eq!(parse(codes.len(), line.chunks(7)), [ParsedLine::Frame(number, codes)]);
        }
    }
    for line in input.split(|b| *b == b'\n') {
        if let Some(Ok(request)) = decode_waveform(line) {
            let mut again = Vec::new();
            encode_waveform(&request, &mut again);
            let decoded = decode_waveform(again.strip_suffix(b"\n").expect("a line")).expect("a waveform");
            assert_eq!(decoded.expect("what was written is read"), request);
            let _ = radome_dsp::Waveform::realise(request);
        }
    }
    // The parser does not keep the lines that it has read.
    let mut parser = LineParser::new(codes);
    with_memory_limit(16 * 1024, || {
        for piece in pieces(input, 60) {
            parser.push(piece);
            while parser.next_line().is_some() {}
        }
    });
});
