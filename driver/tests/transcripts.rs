//! Compares the emulated board and the client with transcripts of unmodified vendor clients.

use std::io::{ErrorKind, Read, Write};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::Duration;

use radome_driver::chip::{ChipConfiguration, RegisterFile};
use radome_driver::protocol::crc::crc16;
use radome_driver::protocol::mcu7::{Command, Protocol, Request, SpiWord};
use radome_driver::{Address, EmulatedBoard, EmulatorOptions, Kind, Mcu7Board, Pace};
use radome_dsp::{Frame, FrameSource, SourceEvent, Waveform, source_from_fn};
use serialport::{SerialPort, TTYPort};

use crate::common::transcript;

/// Time limit for any answer, far above the need of any machine.
const TIMEOUT: Duration = Duration::from_secs(20);

/// Message of a transcript: whether the host sent it, and its bytes.
type Message = (bool, Vec<u8>);

/// Messages of the host.
fn sent_by_host(transcript: &[Message]) -> Vec<Vec<u8>> {
    transcript.iter().filter(|(host, _)| *host).map(|(_, bytes)| bytes.clone()).collect()
}

/// Words of the last long register list among requests.
fn register_list(requests: &[Vec<u8>]) -> Vec<SpiWord> {
    let mut lists = requests.iter().rev().filter_map(|bytes| {
        match Command::from_request(&Request::decode(bytes).expect("request")) {
            Ok(Command::Execute { words, .. }) if words.len() > 30 => Some(words),
            _ => None,
        }
    });
    lists.next().expect("a list")
}

/// Waveform that the client of a transcript programmed.
fn programmed(transcript: &[Message]) -> Waveform {
    let mut file = RegisterFile::default();
    register_list(&sent_by_host(transcript)).iter().for_each(|w| file.set(w.address, w.value));
    ChipConfiguration::decode(&file).expect("a waveform").waveform
}

/// Source whose codes count up in FIFO order, as in the transcripts.
fn ramp(waveform: Waveform) -> Box<dyn FrameSource> {
    let (shape, interval_s, mut next) = (waveform.shape(), waveform.frame_interval_s(), 0);
    Box::new(source_from_fn(waveform, move |frame| {
        let first = next * shape.codes() as u64;
        for (i, code) in frame.codes.iter_mut().enumerate() {
            let (rx, rest) = (i / (shape.chirps * shape.samples), i % (shape.chirps * shape.samples));
            *code = ((first + (rest * shape.rx + rx) as u64) % 4096) as u16;
        }
        (frame.sequence, frame.time_ns) = (next, (next as f64 * interval_s * 1e9) as u64);
        next += 1;
        Ok(SourceEvent::Frame)
    }))
}

/// Emulated board of this protocol.
fn emulated(waveform: Waveform, protocol: Protocol) -> EmulatedBoard {
    let kind = if protocol == Protocol::V3 { Kind::Mcu7V3 } else { Kind::Mcu7V4 };
    let options = EmulatorOptions { pace: Pace::AsFastAsRead, kind, ..EmulatorOptions::default() };
    EmulatedBoard::spawn(ramp(waveform), options).expect("spawns")
}

/// Reads one whole message of a board that sends no garbage.
fn message(port: &mut TTYPort) -> Vec<u8> {
    let mut bytes = vec![0; 4];
    port.read_exact(&mut bytes).expect("the board sends within twenty seconds");
    let is_packet = bytes[0] & 0xF0 == 0xD0;
    bytes.resize(if is_packet { 6 } else { 4 }, 0);
    port.read_exact(&mut bytes[4..]).expect("rest of the header");
    let header = bytes.len();
    let length = usize::from(u16::from_le_bytes([bytes[header - 2], bytes[header - 1]]));
    bytes.resize(header + length + 2, 0);
    port.read_exact(&mut bytes[header..]).expect("rest of the message");
    assert_eq!(crc16(&bytes), 0, "CRC");
    bytes
}

fn is_packet(bytes: &[u8]) -> bool {
    bytes[0] & 0xF0 == 0xD0
}

/// Packet without the board's clock and the CRC.
fn without_clock(bytes: &[u8]) -> &[u8] {
    &bytes[..bytes.len() - 2 - if bytes[0] & 4 != 0 { 8 } else { 0 }]
}

/// Sends the requests of the vendor's client. Answers must have the same bytes in the same order, and so must packets.
/// The order of packets relative to answers depends on timing.
fn replay(protocol: Protocol) {
    let Some(transcript) = transcript(protocol) else { return };
    let board = emulated(programmed(&transcript), protocol);
    let mut port =
        serialport::new(board.path().to_string_lossy(), 921_600).timeout(TIMEOUT).open_native().expect("opens");
    let (mut packets, mut compared) = (Vec::new(), 0);
    let mut expected_packets = transcript.iter().filter(|(host, bytes)| !host && is_packet(bytes)).map(|(_, b)| b);
    let mut answers = transcript.iter().filter(|(host, bytes)| !host && !is_packet(bytes)).map(|(_, b)| b);
    for (line, (host, bytes)) in transcript.iter().enumerate() {
        if *host {
            // Packets that the vendor's client received before the answer were sent before the request. Waits for them,
            // so that a stop does not overtake them.
            let until_answer = transcript.iter().skip(line + 1).take_while(|(host, bytes)| *host || is_packet(bytes));
            let so_far = transcript.iter().take(line).chain(until_answer);
            let due = so_far.filter(|(host, bytes)| !host && is_packet(bytes)).count();
            while packets.len() < due {
                packets.push(message(&mut port));
            }
            port.write_all(bytes).expect("writes");
            let answer = loop {
                match message(&mut port) {
                    packet if is_packet(&packet) => packets.push(packet),
                    answer => break answer,
                }
            };
            assert_eq!(Some(&answer), answers.next(), "answer to line {}", line + 1);
        }
        while compared < packets.len() {
            let Some(expected) = expected_packets.next() else { break };
            assert!(without_clock(&packets[compared]) == without_clock(expected), "packet {compared}");
            compared += 1;
        }
    }
    assert_eq!((answers.next(), expected_packets.next()), (None, None));
    assert!(compared >= 24);
}

#[test]
fn requests_of_protocol_4_are_answered_byte_for_byte() {
    replay(Protocol::V4);
}

#[test]
fn requests_of_protocol_3_are_answered_byte_for_byte() {
    replay(Protocol::V3);
}

/// Connection between client and board that records the client's bytes.
struct Tap {
    path: PathBuf,
    sent: Arc<Mutex<Vec<u8>>>,
    stop: Arc<AtomicBool>,
    threads: Vec<thread::JoinHandle<()>>,
    _terminal: std::fs::File,
}

impl Tap {
    fn on(board: &EmulatedBoard) -> Self {
        let (mut ours, mut theirs) = TTYPort::pair().expect("pseudo-terminal");
        theirs.set_exclusive(false).expect("the client may open it too");
        // The plain file keeps the terminal open without locking it; otherwise the line would hang up.
        let path = PathBuf::from(theirs.name().expect("has a name"));
        let terminal = std::fs::File::open(&path).expect("opens");
        drop(theirs);
        ours.set_timeout(Duration::from_millis(20)).expect("time-out");
        let port = serialport::new(board.path().to_string_lossy(), 921_600).timeout(Duration::from_millis(20));
        let mut board = port.open_native().expect("opens");
        let (sent, stop) = (Arc::new(Mutex::new(Vec::new())), Arc::new(AtomicBool::new(false)));
        let pump = |mut from: TTYPort, mut to: TTYPort, log: Option<Arc<Mutex<Vec<u8>>>>| {
            let stop = stop.clone();
            thread::spawn(move || {
                let mut buffer = [0; 4096];
                while !stop.load(Ordering::Acquire) {
                    let count = match from.read(&mut buffer) {
                        Ok(count) => count,
                        Err(e) if e.kind() == ErrorKind::TimedOut => continue,
                        Err(e) => panic!("tap: {e}"),
                    };
                    log.iter().for_each(|log| log.lock().expect("lock").extend(&buffer[..count]));
                    let mut rest = &buffer[..count];
                    while !rest.is_empty() && !stop.load(Ordering::Acquire) {
                        match to.write(rest) {
                            Ok(count) => rest = &rest[count..],
                            Err(e) if e.kind() == ErrorKind::TimedOut => {}
                            Err(e) => panic!("tap: {e}"),
                        }
                    }
                }
            })
        };
        let clone = |port: &mut TTYPort| port.try_clone_native().expect("clones");
        let down = pump(clone(&mut ours), clone(&mut board), Some(sent.clone()));
        let up = pump(board, ours, None);
        Tap { path, sent, stop, threads: vec![down, up], _terminal: terminal }
    }

    fn finish(self) -> Vec<u8> {
        self.stop.store(true, Ordering::Release);
        self.threads.into_iter().for_each(|t| t.join().expect("tap"));
        Arc::try_unwrap(self.sent).expect("threads have ended").into_inner().expect("lock")
    }
}

/// Requests of our client from opening to stopping, with the waveform of the transcript.
fn our_session(transcript: &[Message], protocol: Protocol) -> Vec<Vec<u8>> {
    let waveform = programmed(transcript);
    let board = emulated(waveform.clone(), protocol);
    let tap = Tap::on(&board);
    let client = Mcu7Board::open(&Address::Serial(tap.path.clone())).expect("opens");
    let mut stream = client.start(&waveform).expect("starts");
    let mut frame = Frame::zeroed(waveform.shape());
    for _ in 0..3 {
        assert_eq!(stream.next_frame(&mut frame).expect("frame"), SourceEvent::Frame);
    }
    drop(stream.stop().expect("stops"));
    let sent = tap.finish();
    let mut requests = Vec::new();
    let mut rest = sent.as_slice();
    while let Some(header) = rest.first_chunk() {
        let length = 8 + Request::payload_length(header).expect("a request") + 2;
        requests.push(rest[..length].to_vec());
        rest = &rest[length..];
    }
    requests
}

/// Text of a request. Of a long register list only the length is shown; its content is compared separately.
fn describe(bytes: &[u8]) -> String {
    let request = Request::decode(bytes).expect("request");
    match Command::from_request(&request).expect("command") {
        Command::Execute { words, .. } if words.len() > 30 => {
            format!("{:?} Execute {} words", request.protocol, words.len())
        }
        command => format!("{:?} {command:?}", request.protocol),
    }
}

/// Lines to remove from the vendor's sequence (`-`) and to insert (`+`) to get ours, around the longest common
/// subsequence.
fn differences(vendor: &[Vec<u8>], ours: &[Vec<u8>]) -> Vec<String> {
    let (n, m) = (vendor.len(), ours.len());
    let mut common = vec![vec![0; m + 1]; n + 1];
    for i in (0..n).rev() {
        for j in (0..m).rev() {
            common[i][j] =
                if vendor[i] == ours[j] { common[i + 1][j + 1] + 1 } else { common[i + 1][j].max(common[i][j + 1]) };
        }
    }
    let (mut i, mut j, mut out) = (0, 0, Vec::new());
    while i < n || j < m {
        if i < n && j < m && vendor[i] == ours[j] {
            (i, j) = (i + 1, j + 1);
        } else if i < n && (j == m || common[i + 1][j] >= common[i][j + 1]) {
            out.push(format!("-{}", describe(&vendor[i])));
            i += 1;
        } else {
            out.push(format!("+{}", describe(&ours[j])));
            j += 1;
        }
    }
    out
}

#[test]
fn our_client_differs_from_protocol_4_only_as_intended() {
    let Some(transcript) = transcript(Protocol::V4) else { return };
    let ours = our_session(&transcript, Protocol::V4);
    let expected = [
        // A killed program leaves a board that still measures, whose packets would delay every answer.
        "+V4 StopData",
        // Reads the same register once more by SPI, after the reset.
        "-V4 ReadRegisters { address: 2, count: 1 }",
        // A start may follow another start without reopening, so that registers are reset first.
        "+V4 StopData",
        "+V4 HardwareReset",
    ];
    assert_eq!(differences(&sent_by_host(&transcript), &ours), expected);
}

#[test]
fn our_client_differs_from_protocol_3_only_as_intended() {
    let Some(transcript) = transcript(Protocol::V3) else { return };
    let ours = our_session(&transcript, Protocol::V3);
    let expected = [
        // The vendor's client lists the boards before it opens one, so that everything up to the second board info
        // appears twice.
        "-V3 BoardInfoFixed { length: 32 }",
        "-V3 BoardInfo",
        "-V3 FirmwareVersion",
        "-V3 ComponentImplementation { component: 1 }",
        "-V3 WriteRegisters { address: 6, values: [1048576] }",
        "-V3 ReadRegisters { address: 2, count: 1 }",
        "-V3 Uuid",
        // Version 3 has two requests for the board info, of which one suffices.
        "-V3 BoardInfoFixed { length: 32 }",
        // Our client tries version 4 first.
        "+V4 BoardInfo",
        // Same difference as in version 4.
        "+V3 StopData",
        "-V3 ReadRegisters { address: 2, count: 1 }",
        // The vendor's client asks twice in one opening; the only data index is 0.
        "-V3 ComponentImplementation { component: 1 }",
        "-V3 DataIndex",
        // The hardware reset that follows also resets FIFO and state machine.
        "-V3 SetBits { address: 0, mask: 12 }",
        "-V3 Execute { words: [SpiWord { address: 0, write: true, value: 1999484 }], answer: false }",
        "-V3 HardwareReset",
        // The vendor's client writes the list once without and once with the start bit.
        "-V3 Execute 38 words",
        // The frame is not a multiple of a slice of 8192 samples, so that frames would arrive later than they are
        // complete.
        "-V3 ConfigureData { slice_samples: 8192 }",
        "+V3 HardwareReset",
        "+V3 ConfigureData { slice_samples: 6144 }",
        // The list differs in the FIFO level, which equals the slice.
        "-V3 Execute 38 words",
        "+V3 Execute 38 words",
    ];
    assert_eq!(differences(&sent_by_host(&transcript), &ours), expected);

    let (vendor, ours) = (register_list(&sent_by_host(&transcript)), register_list(&ours));
    let different: Vec<_> = vendor.iter().zip(&ours).filter(|(a, b)| a != b).collect();
    let level = |slice: u32| 0x10_2000 | (slice / 2 - 1);
    assert_eq!(different, [(&SpiWord::write(6, level(8192)), &SpiWord::write(6, level(6144)))]);
}
