//! Content of the golden files, and functions that make them.

use std::path::Path;

use radome_driver::board::BoardIdentity;
use radome_driver::chip::ChipConfiguration;
use radome_driver::protocol::mcu7::{
    BoardInfo, COMPONENT_AVIAN, COMPONENT_RADAR, Command, DataError, FirmwareVersion, Packet, PacketFlags, Protocol,
    Response, SpiWord, Status,
};
use radome_driver::protocol::{ascii, packed12};
use radome_driver::recording::label_text::{to_audacity, to_deepcraft};
use radome_driver::recording::mcap::RESULTS_VERSION;
use radome_driver::recording::{Format, RecordingWriter};
use radome_driver::{FrameResult, Judge, LabelSpan, RecordingHeader};
use radome_dsp::{Frame, Gap, GapReason, Occupancy, Truth, Waveform};

use crate::common;

/// Host time of the first frame: 6 January 2026, 07:16:15 UTC.
pub const HOST_NS: u64 = 1_767_683_775_000_000_000;

/// Waveform: RX1 and RX3, 2 chirps of 8 samples, 2.5 frames a second.
pub fn waveform() -> Waveform {
    common::waveform(&[1, 3], 2, 8, 0.4)
}

/// Code of a sample: the third frame's second chirp of RX3 begins with 3 * 37 + 1000 + 100.
pub fn code(number: u64, rx: usize, chirp: usize, sample: usize) -> u16 {
    (number * 37 + 1000 * rx as u64 + 100 * chirp as u64 + sample as u64) as u16
}

/// Frames 0 to 4 and 7 to 9. Every other one has a truth; from the third on there is a temperature.
pub fn frames() -> Vec<Frame> {
    let waveform = waveform();
    let frame = |number: u64| {
        let mut frame = Frame::zeroed(waveform.shape());
        let indices = (0..2).flat_map(|rx| (0..2).flat_map(move |chirp| (0..8).map(move |sample| (rx, chirp, sample))));
        frame.codes = indices.map(|(rx, chirp, sample)| code(number, rx, chirp, sample)).collect();
        frame.sequence = number;
        frame.time_ns = number * 400_000_000;
        frame.host_time_ns = HOST_NS + frame.time_ns;
        frame.truth = number.is_multiple_of(2).then_some(Truth { occupancy: Occupancy::Two, transition: number == 4 });
        frame.temperature_millicelsius = (number >= 2).then_some(31_500 + 250 * (number / 5) as i32);
        frame
    };
    (0..10).filter(|number| !(5..7).contains(number)).map(frame).collect()
}

pub const GAP: Gap = Gap { first_sequence: 5, frames: 2, reason: GapReason::Crc };

pub fn labels() -> Vec<LabelSpan> {
    let mut second = LabelSpan::new(1.6, 3.6, "two, or \"more\"");
    second.who = Some("golden".into());
    second.confidence = Some(0.75);
    second.made_ns = Some(HOST_NS + 5_000_000_001);
    second.note = Some("one of them behind the desk".into());
    vec![LabelSpan::new(0.0, 1.6, "one"), second]
}

pub fn header() -> RecordingHeader {
    let board = BoardIdentity {
        name: "Radar Baseboard MCU7 (MCU B)".into(),
        vendor_id: 0x058B,
        product_id: 0x0251,
        firmware_version: "2.9.0".into(),
        extended_version: "golden".into(),
        protocol_version: "4.0".into(),
        uuid: "000102030405060708090a0b0c0d0e0f".into(),
        chip: "BGT60TR13C".into(),
        chip_id: 0x303,
    };
    let configuration = ChipConfiguration { waveform: waveform(), slice_samples: 32 };
    let registers = configuration.compile().expect("compiles");
    RecordingHeader { waveform: waveform(), board: Some(board), registers, judge: None }
}

pub fn judge() -> Judge {
    let model_hash = "ab".repeat(32);
    Judge {
        version: RESULTS_VERSION,
        model: "paper.safetensors".into(),
        model_hash,
        on_delay_s: 0.5,
        off_delay_s: 3.0,
        max_range_m: None,
    }
}

/// Results of the frames: the first is within the warm-up, and the seventh was too late.
pub fn results() -> Vec<FrameResult> {
    let judged = frames().into_iter().filter(|frame| frame.sequence != 7);
    let result = |frame: Frame| {
        let probabilities = (frame.sequence > 0).then_some([0.125, 0.75, 0.125]);
        FrameResult {
            sequence: frame.sequence,
            time_ns: frame.time_ns,
            host_time_ns: frame.host_time_ns,
            label: probabilities.map(|_| Occupancy::One),
            probabilities,
            frame_probabilities: probabilities.map(|_| [0.25, 0.5, 0.25]),
            occupied: frame.sequence > 2,
            people: u8::from(frame.sequence > 2),
            latency_ns: 1_000_000 + frame.sequence,
        }
    };
    judged.map(result).collect()
}

fn recording(path: &Path, format: Format, judge: Option<Judge>) {
    let is_judged = judge.is_some();
    let mut writer = RecordingWriter::create(path, format, &RecordingHeader { judge, ..header() }).expect("creates");
    for frame in frames() {
        writer.frame(&frame).expect("writes");
        if frame.sequence + 1 == GAP.first_sequence {
            writer.gap(&GAP).expect("writes");
        }
    }
    labels().iter().for_each(|label| writer.label(label).expect("writes"));
    if is_judged {
        results().iter().for_each(|result| writer.result(result).expect("writes"));
    }
    writer.finish().expect("finishes");
}

/// Requests of a host, in the order of a session.
pub fn commands() -> Vec<Command> {
    vec![
        Command::BoardInfo,
        Command::BoardInfoFixed { length: 32 },
        Command::FirmwareVersion,
        Command::Uuid,
        Command::ExtendedVersion,
        Command::ComponentCount { component: COMPONENT_AVIAN },
        Command::ComponentImplementation { component: COMPONENT_RADAR },
        Command::DataIndex,
        Command::WriteRegisters { address: 6, values: vec![0x10_0000] },
        Command::ReadRegisters { address: 2, count: 1 },
        Command::SetBits { address: 0, mask: 0xC },
        Command::HardwareReset,
        Command::Execute { words: vec![SpiWord::write(6, 0x10_0000)], answer: false },
        Command::Execute { words: vec![SpiWord::read(2)], answer: true },
        Command::ConfigureData { slice_samples: 6144 },
        Command::DataStatus,
        Command::StartData,
        Command::StopData,
    ]
}

/// Line of a message: its sender and its hexadecimal digits.
fn hex(who: char, bytes: &[u8]) -> String {
    let digits: String = bytes.iter().map(|b| format!("{b:02x}")).collect();
    format!("{who} {digits}\n")
}

/// Requests (`H`), and answers and packets (`D`), as hexadecimal digits.
fn mcu7(protocol: Protocol) -> String {
    let mut text: String = commands().iter().map(|c| hex('H', &c.to_request(protocol).encode())).collect();
    let mut device = |encode: &dyn Fn(&mut Vec<u8>)| {
        let mut bytes = Vec::new();
        encode(&mut bytes);
        text += &hex('D', &bytes);
    };
    let info = BoardInfo { vendor_id: 0x058B, product_id: 0x0251, name: "Radar Baseboard MCU7 (MCU B)".into() };
    let version = FirmwareVersion { firmware: [2, 9, 0, 1], protocol: [protocol.major(), 0] };
    let kind_code = Command::BoardInfo.to_request(protocol).kind_code();
    for (status, payload) in
        [(Status::Ok, info.encode()), (Status::Ok, version.encode()), (Status::RequestTypeInvalid, Vec::new())]
    {
        device(&|out| Response { kind_code, status, payload: &payload }.encode(out));
    }
    let mut slice = Vec::new();
    packed12::pack(&[0xABC, 0xDEF, 0, 4095], &mut slice);
    slice.extend(1_234_567u64.to_le_bytes());
    let data = PacketFlags { first: true, last: true, timestamp: true, error: false };
    device(&|out| Packet { flags: data, channel: 0, counter: 513, payload: &slice }.encode(out));
    let error = PacketFlags { first: true, last: true, timestamp: false, error: true };
    let payload = DataError::FifoOverflow.code().to_le_bytes();
    device(&|out| Packet { flags: error, channel: 0, counter: 514, payload: &payload }.encode(out));
    text
}

fn esp32() -> Vec<u8> {
    let mut lines = b"I (312) main: radar started\r\n".to_vec();
    ascii::encode_waveform(&waveform().request, &mut lines);
    ascii::encode(41, &[0, 17, 4095], &mut lines);
    ascii::encode(43, &[1, 2, 3], &mut lines);
    lines
}

/// Makes all golden files.
pub fn make(folder: &Path) {
    recording(&folder.join("recording.mcap"), Format::Mcap, None);
    recording(&folder.join("judged.mcap"), Format::Mcap, Some(judge()));
    recording(&folder.join("infineon"), Format::Infineon, None);
    recording(&folder.join("sdk.txt"), Format::Text, None);
    let write = |name: &str, bytes: &[u8]| std::fs::write(folder.join(name), bytes).expect("writes");
    write("labels-audacity.txt", to_audacity(&labels()).as_bytes());
    write("labels-deepcraft.label", to_deepcraft(&labels()).as_bytes());
    write("wire-mcu7-4.txt", mcu7(Protocol::V4).as_bytes());
    write("wire-mcu7-3.txt", mcu7(Protocol::V3).as_bytes());
    write("wire-esp32.txt", &esp32());
}
