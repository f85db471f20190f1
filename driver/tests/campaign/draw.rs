//! Draws jobs as a function of the seed, each for one board with one kind of fault.

use std::time::Duration;

use radome_driver::protocol::deepcraft::FIFO_LEVEL_CODES;
use radome_driver::protocol::mcu7::{Framing, SliceLayout};
use radome_driver::{Fault, Kind as Board};
use radome_dsp::Waveform;

use crate::common::{self, Random};

const BOARDS: [(Board, &str); 5] = [
    (Board::Mcu7V4, "mcu7-4"),
    (Board::Mcu7V3, "mcu7-3"),
    (Board::Mcu7Bulk, "mcu7-bulk"),
    (Board::Esp32, "esp32"),
    (Board::Deepcraft, "deepcraft"),
];

/// Whether the firmware sends frames of this shape, without joining hundreds of them into one message.
fn can_send(board: Board, (antennas, chirps, samples): (&[u8], usize, usize)) -> bool {
    let codes = antennas.len() * chirps * samples;
    board != Board::Deepcraft || (codes.is_multiple_of(2) && codes >= 256)
}

/// Length of the board's shortest message, bytes, and its number of messages for each frame, possibly a fraction.
fn messages(board: Board, waveform: &Waveform) -> (u64, f64) {
    let codes = waveform.shape().codes();
    let framing = if board == Board::Mcu7Bulk { Framing::Bulk } else { Framing::Serial };
    let slice = SliceLayout::for_frame_as(codes, framing);
    match board {
        Board::Esp32 => (3 * codes as u64, 1.0),
        // A chunk holds the frames that one read of the FIFO completes.
        Board::Deepcraft => (2 * codes as u64, (codes as f64 / FIFO_LEVEL_CODES as f64).min(1.0)),
        _ => {
            let shortest = slice.payload_length(slice.packets() - 1) as u64 + 8;
            (shortest, slice.packets() as f64 * codes as f64 / slice.samples as f64)
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    Drop,
    Double,
    Reorder,
    Truncate,
    Flip,
    Skip,
    Overflow,
    Stall,
    Unplug,
    SlowHost,
    Version,
    Chip,
    Mixed,
}

impl Kind {
    /// Kinds, each with its name, its number in ten thousand faults and the largest number for one board.
    const ALL: [(Kind, &str, u64, u64); 13] = [
        (Kind::Drop, "drop", 1200, 40),
        (Kind::Double, "double", 900, 40),
        (Kind::Reorder, "reorder", 900, 40),
        (Kind::Truncate, "truncate", 1400, 40),
        (Kind::Flip, "flip a bit", 1800, 40),
        (Kind::Skip, "skip counter", 900, 20),
        (Kind::Overflow, "overflow", 900, 20),
        (Kind::Stall, "stall", 150, 2),
        (Kind::Unplug, "unplug", 450, 5),
        (Kind::SlowHost, "slow host", 150, 2),
        (Kind::Version, "wrong version", 100, 1),
        (Kind::Chip, "foreign chip", 100, 1),
        (Kind::Mixed, "all at once", 1050, 25),
    ];

    /// Whether the board loses power or stops sending for a while, so that only the host's clock can count the lost
    /// frames.
    pub fn interrupts(self) -> bool {
        matches!(self, Kind::Stall | Kind::Unplug | Kind::Mixed)
    }
}

/// Board of the campaign, with its waveform and faults.
#[derive(Debug, Clone)]
pub struct Job {
    pub seed: u64,
    pub board: Board,
    pub kind: Kind,
    /// Names of the board and of the kind of fault.
    pub names: (&'static str, &'static str),
    pub waveform: Waveform,
    pub faults: Vec<Fault>,
    /// Number of source frames to reach.
    pub frames: u64,
}

/// Receivers, chirps and samples. A frame has one slice, several, or a part of one. Frames with an odd number of codes
/// share slices and bytes with their neighbours. The last shape's slices end anywhere in a frame.
const SHAPES: [(&[u8], usize, usize); 9] = [
    (&[1], 1, 16),
    (&[2, 3], 4, 32),
    (&[1, 2, 3], 8, 64),
    (&[1], 64, 128),
    (&[1, 2, 3], 32, 128),
    (&[1, 3], 64, 128),
    (&[3], 3, 33),
    (&[1, 2, 3], 5, 17),
    (&[1], 67, 67),
];

/// Draws a waveform that the board can send.
fn waveform(random: &mut Random, board: Board, kind: Kind) -> Waveform {
    let (antennas, chirps, samples) = match kind {
        // Frames large enough to fill the board's memory soon.
        Kind::SlowHost => (&[1u8, 2, 3][..], 64, 128),
        _ => std::iter::repeat_with(|| random.one_of(&SHAPES)).find(|s| can_send(board, *s)).expect("one of them"),
    };
    common::realised(&common::waveform(antennas, chirps, samples, 500e-6 * chirps as f64 + 5e-3))
}

/// Draws the details of a fault.
fn fault(random: &mut Random, kind: Kind, packet: u64, (messages, shortest): (f64, u64)) -> Fault {
    match kind {
        Kind::Drop => Fault::DropPacket(packet),
        Kind::Double => Fault::DoublePacket(packet),
        Kind::Reorder => Fault::ReorderPacket(packet),
        // Cuts in the header as often as after it; the message is never complete.
        Kind::Truncate => {
            let byte_limit = random.one_of(&[2, 12, 200, 5000]).min(shortest);
            Fault::TruncatePacket { packet, bytes: random.below(byte_limit) as usize }
        }
        // Headers are hit more often than their share of the length.
        Kind::Flip => {
            let bit_limit = random.one_of(&[8 * 12, 8 * 12, 400, 40_000]);
            Fault::FlipBit { packet, bit: random.below(bit_limit) as usize }
        }
        // Skips part of a slice, slices or frames, or counts backwards.
        Kind::Skip => {
            let frame = messages.round().max(1.0) as u64;
            let by = match random.below(6) {
                0 => 1 + random.below(3),
                1 => frame * (1 + random.below(4)),
                2 => 1 + random.below(60),
                3 => random.below(0x8000),
                4 => 0xFFFF - random.below(60),
                _ => random.below(0x1_0000),
            };
            Fault::SkipCounter { packet, by: by as u16 }
        }
        Kind::Overflow => Fault::Overflow(packet),
        Kind::Stall => Fault::Stall(packet),
        Kind::Unplug => Fault::Unplug { packet, duration: Duration::from_millis(1 + random.below(60)) },
        Kind::SlowHost => Fault::SlowHost { packet, duration: Duration::from_millis(300 + random.below(200)) },
        // Versions 2 to 4 are valid for some board.
        Kind::Version => Fault::WrongVersion(random.one_of(&[0, 1, 5, 0xFFFF])),
        Kind::Chip => Fault::ForeignChip(random.one_of(&[0, 0x504, 0x606, 0x60B, 0x707, 0x80C, 0x1234, 0xFF_FFFF])),
        Kind::Mixed => {
            let link_faults =
                [Kind::Drop, Kind::Double, Kind::Reorder, Kind::Truncate, Kind::Flip, Kind::Skip, Kind::Overflow];
            let kind = if random.below(25) == 0 { Kind::Unplug } else { random.one_of(&link_faults) };
            fault(random, kind, packet, (messages, shortest))
        }
    }
}

/// Faults of this kind and number, the waveform of their board, and the number of source frames to reach, drawn from
/// the seed.
fn draw(seed: u64, board: Board, kind: Kind, faults: u64) -> (Waveform, Vec<Fault>, u64) {
    let mut random = Random(seed);
    let waveform = waveform(&mut random, board, kind);
    let (shortest, messages) = messages(board, &waveform);
    // The data in a port's buffer are lost when its board is unplugged, so that some frames must pass first.
    let spacing = match kind {
        Kind::Unplug => (40.0 + 6.0 * messages) as u64,
        Kind::Mixed => 2 + messages as u64,
        _ => (3.0 + 4.0 * messages) as u64,
    };
    let mut packet = (3.0 * messages).ceil() as u64;
    let mut drawn = Vec::new();
    for _ in 0..faults {
        packet += 1 + random.below(spacing) + if kind == Kind::Mixed { 0 } else { spacing / 2 };
        drawn.push(fault(&mut random, kind, packet, (messages, shortest)));
    }
    let frames = (packet as f64 / messages) as u64 + 10;
    (waveform, drawn, frames)
}

/// Jobs with this number of faults in total, divided evenly among the boards.
pub fn jobs(seed: u64, faults: u64) -> Vec<Job> {
    let mut random = Random(seed);
    let mut jobs = Vec::new();
    for (board, board_name) in BOARDS {
        for (kind, kind_name, weight, max_faults) in Kind::ALL {
            if board == Board::Esp32 && kind == Kind::Version {
                // An ESP32 does not report a protocol version.
                continue;
            }
            let mut remaining = (weight * faults).div_ceil(10_000 * BOARDS.len() as u64);
            while remaining > 0 {
                let count = remaining.min(max_faults);
                let (seed, names) = (random.next(), (board_name, kind_name));
                let (waveform, faults, frames) = draw(seed, board, kind, count);
                remaining -= count;
                jobs.push(Job { seed, board, kind, names, waveform, faults, frames });
            }
        }
    }
    // Shuffles the jobs, so that jobs that sleep alternate with jobs that compute.
    for i in (1..jobs.len()).rev() {
        jobs.swap(i, random.below(i as u64 + 1) as usize);
    }
    jobs
}
