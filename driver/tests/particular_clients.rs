//! Clients as strict as the vendor's. One misses answers that come too early, and one reads the temperature
//! continuously. Some are killed at any time, and one has its board stopped.

use std::io::{ErrorKind, Read, Write};
use std::os::fd::{AsRawFd, BorrowedFd};
use std::process::{Command as Process, Stdio};
use std::time::{Duration, Instant};

use radome_driver::chip::{ChipConfiguration, address, field};
use radome_driver::protocol::mcu7::{
    BoardEvent, BoardParser, COMPONENT_AVIAN, Command, Protocol, SliceLayout, SpiWord, Status,
};
use radome_driver::{EmulatedBoard, EmulatorOptions, Kind};
use radome_dsp::Waveform;
use serialport::TTYPort;

use crate::common::{options, spawn, waveform};

/// Time limit for any answer, far above the need of any machine.
const TIMEOUT: Duration = Duration::from_secs(60);
/// Time in which answers are missed: the vendor's library marks a command as sent only after sending it, and drops an
/// earlier answer.
const TOO_SOON: Duration = Duration::from_micros(200);
/// MAIN register as the vendor's library writes it, without its triggers.
const MAIN: u32 = 0x1E_8270;
const CONTINUOUS_WAVE_START: u32 = MAIN | 1 << 16 | 1;
const STOP: u32 = MAIN | 0xC;

/// Client of protocol 4.
struct Client {
    port: TTYPort,
    parser: BoardParser,
    /// Time within which the client misses answers.
    deaf_for: Duration,
    /// Counters of the data packets since the last start, and whether each ends a slice.
    packets: Vec<(u16, bool)>,
    /// Number of bytes that belong to no message.
    damaged: usize,
}

impl Drop for Client {
    /// Unlocks the port as the driver does. Other tests start processes, which have copies of all open files until they
    /// run their programs, and a copy would hold the lock.
    fn drop(&mut self) {
        // SAFETY: the port is closed after this function.
        let descriptor = unsafe { BorrowedFd::borrow_raw(self.port.as_raw_fd()) };
        let _ = rustix::fs::flock(descriptor, rustix::fs::FlockOperation::Unlock);
    }
}

impl Client {
    fn open(board: &EmulatedBoard, deaf_for: Duration) -> Self {
        let path = board.path().display().to_string();
        let port = serialport::new(path, 921_600).timeout(Duration::from_millis(20)).open_native().expect("opens");
        Client { port, parser: BoardParser::default(), deaf_for, packets: Vec::new(), damaged: 0 }
    }

    /// Receives bytes for some milliseconds; returns whether the line is still open.
    fn receive(&mut self) -> bool {
        let mut buffer = [0; 4096];
        match self.port.read(&mut buffer) {
            Ok(0) => false,
            Ok(count) => {
                self.parser.push(&buffer[..count]);
                true
            }
            Err(e) if matches!(e.kind(), ErrorKind::TimedOut | ErrorKind::Interrupted) => true,
            Err(_) => false,
        }
    }

    /// Next answer in the received bytes; counts the packets before it.
    fn next_answer(&mut self) -> Option<(Status, Vec<u8>)> {
        loop {
            match self.parser.next_event()? {
                BoardEvent::Packet(packet) => self.packets.push((packet.counter, packet.flags.last)),
                BoardEvent::Response(response) => return Some((response.status, response.payload.to_vec())),
                BoardEvent::Damaged { bytes } => self.damaged += bytes,
            }
        }
    }

    /// Sends a request and returns its answer.
    fn request(&mut self, command: &Command) -> (Status, Vec<u8>) {
        // Measured from before the request is sent, so that a busy machine cannot make an answer seem too early.
        let sent = Instant::now();
        self.port.write_all(&command.to_request(Protocol::V4).encode()).expect("writes");
        loop {
            if let Some(answer) = self.next_answer() {
                let after = sent.elapsed();
                assert!(after >= self.deaf_for, "the answer to {command:?} came after {after:?} and was missed");
                return answer;
            }
            assert!(sent.elapsed() < TIMEOUT && self.receive(), "no answer to {command:?}");
        }
    }

    /// Sends a request, which must succeed; returns the payload of its answer.
    fn request_ok(&mut self, command: &Command) -> Vec<u8> {
        let (status, payload) = self.request(command);
        assert_eq!(status, Status::Ok, "{command:?}");
        payload
    }

    fn write(&mut self, registers: &[(u8, u32)]) {
        let words = registers.iter().map(|(address, value)| SpiWord::write(*address, *value)).collect();
        self.request_ok(&Command::Execute { words, answer: false });
    }

    fn read(&mut self, address: u8) -> u32 {
        let answer = self.request_ok(&Command::Execute { words: vec![SpiWord::read(address)], answer: true });
        u32::from_le_bytes(answer.try_into().expect("one word")) & 0xFF_FFFF
    }

    /// Requests of the vendor's library when it opens a board.
    fn identify(&mut self) {
        self.request_ok(&Command::BoardInfo);
        self.request_ok(&Command::FirmwareVersion);
        self.request_ok(&Command::ComponentCount { component: COMPONENT_AVIAN });
        self.request(&Command::WriteRegisters { address: address::SFCTL, values: vec![0x10_0000] });
        self.request_ok(&Command::ReadRegisters { address: address::CHIP_ID, count: 1 });
        self.request_ok(&Command::Uuid);
        self.request_ok(&Command::ExtendedVersion);
        self.request_ok(&Command::HardwareReset);
    }

    fn start(&mut self, waveform: &Waveform) {
        let [configure, start, list] = start_commands(waveform);
        self.request_ok(&configure);
        self.packets.clear();
        self.request_ok(&start);
        self.request_ok(&list);
    }

    fn stop(&mut self) {
        self.request_ok(&Command::StopData);
        self.write(&[(address::MAIN, STOP)]);
    }

    /// Waits for this number of further packets. Asserts that none has been missing since the start.
    fn stream(&mut self, more: usize) {
        let (start_time, target) = (Instant::now(), self.packets.len() + more);
        while self.packets.len() < target {
            assert_eq!(self.next_answer(), None, "nothing was asked");
            assert!(start_time.elapsed() < TIMEOUT && self.receive(), "packets do not come");
        }
        let missing = self.packets.iter().enumerate().find(|(index, (counter, _))| *counter != *index as u16);
        assert_eq!((missing, self.damaged), (None, 0));
    }

    /// Measures as the vendor's library does with a sleeping chip: wakes it in continuous-wave mode without
    /// transmission, and resets it at the end.
    fn measure_temperature(&mut self) -> f64 {
        self.write(&[
            (address::CSP_D_0, 0),
            (address::CSCDS, 0x0BE0),
            (address::CSP_I_0, 0),
            (address::CSP_I_1, 0x1000),
            (address::CSCI, 0x0F80),
            (address::PACR1, 0x80_0000),
            (address::MAIN, CONTINUOUS_WAVE_START),
            (address::SFCTL, 0x10_0000),
        ]);
        self.wait_for("the band gap", address::STAT0, |status| field::STAT0::MADC_BGUP.of(status) == 1);
        self.write(&[(address::CSCI, 0x0D80)]);
        self.wait_for("the ADC", address::STAT0, |status| field::STAT0::SADC_RDY.of(status) == 1);
        self.write(&[(address::SADC_CTRL, 0x01_0F10)]);
        let result = self
            .wait_for("the conversion", address::SADC_RESULT, |result| field::SADC_RESULT::SADC_BUSY.of(result) == 0);
        self.request_ok(&Command::HardwareReset);
        celsius(result)
    }

    /// Reads a register until it has the wanted value, at most as often as the vendor's library does.
    fn wait_for(&mut self, what: &str, address: u8, is_wanted: impl Fn(u32) -> bool) -> u32 {
        for _ in 0..1000 {
            let content = self.read(address);
            if is_wanted(content) {
                return content;
            }
        }
        panic!("{what} does not come");
    }
}

/// Data configuration, data start, and the register list whose last entry starts frames.
fn start_commands(waveform: &Waveform) -> [Command; 3] {
    let slice = SliceLayout::for_frame(waveform.shape().codes());
    let configuration = ChipConfiguration { waveform: waveform.clone(), slice_samples: slice.samples };
    let words = configuration.compile().expect("fits").into_iter().map(SpiWord::from).collect();
    [
        Command::ConfigureData { slice_samples: slice.samples as u16 },
        Command::StartData,
        Command::Execute { words, answer: false },
    ]
}

/// Converts the sensor's ADC result to degrees Celsius by the vendor's formula.
fn celsius(sadc_result: u32) -> f64 {
    let volts = f64::from(field::SADC_RESULT::SADC_RESULT.of(sadc_result)) * 1.21 / 1023.0;
    (volts - 0.789_84) / 0.002_86
}

/// Waveform with one packet a frame.
fn small() -> Waveform {
    waveform(&[1, 2, 3], 8, 64, 0.1)
}

fn board(waveform: &Waveform, latency: Duration) -> EmulatedBoard {
    spawn(waveform, u64::MAX, EmulatorOptions { latency, ..options(Kind::default(), &[]) })
}

/// Waits until the board has noticed more departures of clients than `before`.
fn wait_for_departure(board: &EmulatedBoard, before: u64) {
    let start_time = Instant::now();
    while board.counts().departures <= before {
        assert!(start_time.elapsed() < TIMEOUT, "the board does not notice");
        std::thread::sleep(Duration::from_millis(1));
    }
}

#[test]
fn no_answer_comes_too_soon_in_two_hundred_starts() {
    let w = small();
    let board = board(&w, EmulatorOptions::default().latency);
    for _ in 0..200 {
        let mut client = Client::open(&board, TOO_SOON);
        client.identify();
        client.start(&w);
        client.stream(3);
        client.stop();
    }
}

/// Asserts that the latency delays answers only: frames do not wait for it.
#[test]
fn a_long_latency_delays_answers_and_not_frames() {
    let w = small();
    let latency = Duration::from_millis(300);
    let board = board(&w, latency);
    let mut client = Client::open(&board, latency);
    client.start(&w);
    let packets_before = client.packets.len();
    // These packets arrive while the answer is delayed.
    client.request_ok(&Command::DataStatus);
    assert!(client.packets.len() > packets_before + 100, "{} packets in 300 ms", client.packets.len() - packets_before);
    client.stream(1);
}

#[test]
fn the_temperature_is_read_a_thousand_times_while_streaming_continues() {
    let w = small();
    let board = board(&w, Duration::ZERO);
    let mut client = Client::open(&board, Duration::ZERO);
    client.identify();
    let mut readings = Vec::new();
    readings.extend((0..300).map(|_| client.measure_temperature()));
    client.start(&w);
    for _ in 0..40 {
        client.stream(2);
        readings.extend((0..10).map(|_| celsius(client.read(address::SADC_RESULT))));
    }
    client.stream(10);
    client.stop();
    readings.extend((0..300).map(|_| client.measure_temperature()));
    assert_eq!(readings.len(), 1000);
    assert!(readings.iter().all(|reading| (30.0..45.0).contains(reading)), "{readings:?}");
    assert!(readings.iter().any(|reading| *reading != readings[0]), "it never changes");
    // One code is 0.41 C, and the board warms up meanwhile.
    let (low, high) = readings.iter().fold((f64::MAX, f64::MIN), |(low, high), r| (low.min(*r), high.max(*r)));
    assert!(high - low < 5.0, "from {low} to {high}");
    client.start(&w);
    client.stream(10);
    assert_eq!((board.refusal(), board.failure()), (None, None));
}

#[test]
fn frames_come_after_continuous_wave_mode_and_not_during_it() {
    let w = small();
    let board = board(&w, Duration::ZERO);
    let mut client = Client::open(&board, Duration::ZERO);
    let [configure, start, _] = start_commands(&w);
    client.request_ok(&configure);
    client.request_ok(&start);
    // The chip has the registers of the source, as an earlier client would have left them.
    client.wait_for("active mode", address::STAT0, |status| field::STAT0::PM.of(status) == 5);
    for mode in [3, 1, 1] {
        client.write(&[(address::MAIN, CONTINUOUS_WAVE_START)]);
        assert_eq!(field::STAT0::PM.of(client.read(address::STAT0)), mode);
    }
    std::thread::sleep(Duration::from_millis(100));
    client.request_ok(&Command::DataStatus);
    assert_eq!((client.packets.len(), board.refusal()), (0, None));
    client.request_ok(&Command::HardwareReset);
    client.start(&w);
    client.stream(10);
}

/// Asserts that a killed client leaves no trace. Each one is killed while it streams and half a request is sent. The
/// next one sends the first request of the vendor's client and gets the answer of an unused board.
#[test]
fn killed_clients_leave_a_usable_board() {
    let w = small();
    let board = board(&w, EmulatorOptions::default().latency);
    let mut requests = Vec::new();
    for command in start_commands(&w) {
        requests.extend(command.to_request(Protocol::V4).encode());
    }
    requests.extend(&Command::BoardInfo.to_request(Protocol::V4).encode()[..5]);
    for _ in 0..20 {
        let before = board.counts().departures;
        let script = "exec 3<>\"$0\"; cat >&3; exec cat <&3";
        let mut killed = Process::new("sh")
            .args(["-c", script])
            .arg(board.path())
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("there is a shell");
        killed.stdin.take().expect("piped").write_all(&requests).expect("writes");
        let mut buffer = vec![0; 20_000];
        killed.stdout.as_mut().expect("piped").read_exact(&mut buffer).expect("it streams");
        killed.kill().expect("kills");
        killed.wait().expect("is gone");
        wait_for_departure(&board, before);

        let before = board.counts().departures;
        let mut client = Client::open(&board, TOO_SOON);
        client.request_ok(&Command::BoardInfo);
        assert_eq!((client.packets.len(), client.damaged), (0, 0), "earlier data do not come");
        client.identify();
        client.start(&w);
        client.stream(5);
        // This client also leaves without stopping the board.
        drop(client);
        wait_for_departure(&board, before);
    }
}

/// Asserts that a stopped board ends with a whole slice, since the vendor's library takes an incomplete slice for a
/// dropped frame.
#[test]
fn a_board_that_is_stopped_ends_with_a_whole_slice() {
    let w = waveform(&[1, 2, 3], 128, 256, 0.1);
    let (mut complete, boards) = (0, 10);
    for _ in 0..boards {
        let mut board = board(&w, Duration::ZERO);
        let mut client = Client::open(&board, Duration::ZERO);
        client.start(&w);
        client.stream(50);
        let reader = std::thread::spawn(move || {
            while client.receive() {
                assert_eq!(client.next_answer(), None);
            }
            client
        });
        board.stop();
        let client = reader.join().expect("reads");
        let ends_slice = client.packets.last().is_some_and(|(_, last)| *last);
        complete += u32::from(ends_slice && client.damaged == 0 && !client.parser.is_waiting());
    }
    // A busy machine that stops the client for half a second may cut one slice short.
    assert!(complete + 1 >= boards, "{complete} of {boards}");
}
