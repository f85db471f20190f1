//! Draws jobs as a function of the seed, each for one board with one kind of fault.

use std::time::Duration;

use radome_driver::protocol::deepcraft::FIFO_LEVEL_CODES;
use radome_driver::protocol::mcu7::{Framing, SliceLayout};
use radome_driver::{Fault, Kind as Board};
use radome_dsp::{RxMask, Waveform, WaveformRequest};

/// Random number generator: splitmix64.
#[derive(Debug, Clone)]
pub struct Random(pub u64);

impl Random {
    pub fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ z >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ z >> 27).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ z >> 31
    }

    pub fn below(&mut self, end: u64) -> u64 {
        self.next() % end.max(1)
    }

    fn one_of<T: Copy>(&mut self, all: &[T]) -> T {
        all[self.below(all.len() as u64) as usize]
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Protocol {
    Mcu7V4,
    Mcu7V3,
    Mcu7Bulk,
    Esp32,
    Deepcraft,
}

impl Protocol {
    pub const ALL: [Protocol; 5] =
        [Protocol::Mcu7V4, Protocol::Mcu7V3, Protocol::Mcu7Bulk, Protocol::Esp32, Protocol::Deepcraft];

    pub fn name(self) -> &'static str {
        match self {
            Protocol::Mcu7V4 => "mcu7-4",
            Protocol::Mcu7V3 => "mcu7-3",
            Protocol::Mcu7Bulk => "mcu7-bulk",
            Protocol::Esp32 => "esp32",
            Protocol::Deepcraft => "deepcraft",
        }
    }

    pub fn board(self) -> Board {
        match self {
            Protocol::Mcu7V4 => Board::Mcu7V4,
            Protocol::Mcu7V3 => Board::Mcu7V3,
            Protocol::Mcu7Bulk => Board::Mcu7Bulk,
            Protocol::Esp32 => Board::Esp32,
            Protocol::Deepcraft => Board::Deepcraft,
        }
    }

    /// Whether the protocol's messages carry a check sum.
    pub fn has_checksum(self) -> bool {
        matches!(self, Protocol::Mcu7V4 | Protocol::Mcu7V3)
    }

    /// Whether the firmware sends frames of this shape, without joining hundreds of them into one message.
    fn takes(self, (antennas, chirps, samples): (&[u8], usize, usize)) -> bool {
        let codes = antennas.len() * chirps * samples;
        self != Protocol::Deepcraft || (codes.is_multiple_of(2) && codes >= 256)
    }

    fn slice(self, waveform: &Waveform) -> SliceLayout {
        let framing = if self == Protocol::Mcu7Bulk { Framing::Bulk } else { Framing::Serial };
        SliceLayout::for_frame_as(waveform.shape().codes(), framing)
    }

    /// Length of the protocol's shortest message, bytes.
    fn shortest_message(self, waveform: &Waveform) -> u64 {
        let slice = self.slice(waveform);
        match self {
            Protocol::Esp32 => 3 * waveform.shape().codes() as u64,
            Protocol::Deepcraft => 2 * waveform.shape().codes() as u64,
            _ => slice.payload_length(slice.packets() - 1) as u64 + 8,
        }
    }

    /// Number of messages for each frame, possibly a fraction.
    fn messages(self, waveform: &Waveform) -> f64 {
        let codes = waveform.shape().codes();
        let slice = self.slice(waveform);
        match self {
            Protocol::Esp32 => 1.0,
            // A chunk holds the frames that one read of the FIFO completes.
            Protocol::Deepcraft => (codes as f64 / FIFO_LEVEL_CODES as f64).min(1.0),
            _ => slice.packets() as f64 * codes as f64 / slice.samples as f64,
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
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
    /// Kinds, each with its number in ten thousand faults and the largest number for one board.
    pub const ALL: [(Kind, u64, u64); 13] = [
        (Kind::Drop, 1200, 40),
        (Kind::Double, 900, 40),
        (Kind::Reorder, 900, 40),
        (Kind::Truncate, 1400, 40),
        (Kind::Flip, 1800, 40),
        (Kind::Skip, 900, 20),
        (Kind::Overflow, 900, 20),
        (Kind::Stall, 150, 2),
        (Kind::Unplug, 450, 5),
        (Kind::SlowHost, 150, 2),
        (Kind::Version, 100, 1),
        (Kind::Chip, 100, 1),
        (Kind::Mixed, 1050, 25),
    ];

    pub fn name(self) -> &'static str {
        match self {
            Kind::Drop => "drop",
            Kind::Double => "double",
            Kind::Reorder => "reorder",
            Kind::Truncate => "truncate",
            Kind::Flip => "flip a bit",
            Kind::Skip => "skip counter",
            Kind::Overflow => "overflow",
            Kind::Stall => "stall",
            Kind::Unplug => "unplug",
            Kind::SlowHost => "slow host",
            Kind::Version => "wrong version",
            Kind::Chip => "foreign chip",
            Kind::Mixed => "all at once",
        }
    }

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
    pub protocol: Protocol,
    pub kind: Kind,
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

fn waveform(random: &mut Random, protocol: Protocol, kind: Kind) -> Waveform {
    let (antennas, chirps, samples) = match kind {
        // Frames large enough to fill the board's memory soon.
        Kind::SlowHost => (&[1u8, 2, 3][..], 64, 128),
        _ => {
            std::iter::repeat_with(|| random.one_of(&SHAPES)).find(|shape| protocol.takes(*shape)).expect("one of them")
        }
    };
    let request = WaveformRequest {
        rx_antennas: RxMask::from_antennas(antennas).expect("antennas"),
        chirps_per_frame: chirps,
        samples_per_chirp: samples,
        frame_interval_s: 500e-6 * chirps as f64 + 5e-3,
        ..WaveformRequest::paper()
    };
    Waveform::realise(request).expect("valid")
}

fn fault(random: &mut Random, kind: Kind, packet: u64, (messages, shortest): (f64, u64)) -> Fault {
    match kind {
        Kind::Drop => Fault::DropPacket(packet),
        Kind::Double => Fault::DoublePacket(packet),
        Kind::Reorder => Fault::ReorderPacket(packet),
        // Cuts in the header as often as after it; the message is never complete.
        Kind::Truncate => {
            let most = random.one_of(&[2, 12, 200, 5000]).min(shortest);
            Fault::TruncatePacket { packet, bytes: random.below(most) as usize }
        }
        // Headers are hit more often than their share of the length.
        Kind::Flip => {
            let most = random.one_of(&[8 * 12, 8 * 12, 400, 40_000]);
            Fault::FlipBit { packet, bit: random.below(most) as usize }
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
            let wire =
                [Kind::Drop, Kind::Double, Kind::Reorder, Kind::Truncate, Kind::Flip, Kind::Skip, Kind::Overflow];
            let kind = if random.below(25) == 0 { Kind::Unplug } else { random.one_of(&wire) };
            fault(random, kind, packet, (messages, shortest))
        }
    }
}

/// Job with this number of faults, drawn from the seed.
fn job(seed: u64, protocol: Protocol, kind: Kind, faults: u64) -> Job {
    let mut random = Random(seed);
    let waveform = waveform(&mut random, protocol, kind);
    let messages = protocol.messages(&waveform);
    // The data in a port's buffer are lost when its board is unplugged, so that some frames must pass first.
    let apart = match kind {
        Kind::Unplug => (40.0 + 6.0 * messages) as u64,
        Kind::Mixed => 2 + messages as u64,
        _ => (3.0 + 4.0 * messages) as u64,
    };
    let mut packet = (3.0 * messages).ceil() as u64;
    let mut all = Vec::new();
    for _ in 0..faults {
        packet += 1 + random.below(apart) + if kind == Kind::Mixed { 0 } else { apart / 2 };
        all.push(fault(&mut random, kind, packet, (messages, protocol.shortest_message(&waveform))));
    }
    let frames = (packet as f64 / messages) as u64 + 10;
    Job { seed, protocol, kind, waveform, faults: all, frames }
}

/// Jobs with this number of faults in total, divided evenly among the protocols.
pub fn jobs(seed: u64, faults: u64) -> Vec<Job> {
    let mut random = Random(seed);
    let mut jobs = Vec::new();
    for protocol in Protocol::ALL {
        for (kind, weight, at_most) in Kind::ALL {
            if protocol == Protocol::Esp32 && kind == Kind::Version {
                // An ESP32 does not report a protocol version.
                continue;
            }
            let mut left = (weight * faults).div_ceil(10_000 * Protocol::ALL.len() as u64);
            while left > 0 {
                let now = left.min(at_most);
                let job = job(random.next(), protocol, kind, now);
                left -= now;
                jobs.push(job);
            }
        }
    }
    // Shuffles the jobs, so that jobs that sleep alternate with jobs that compute.
    for i in (1..jobs.len()).rev() {
        jobs.swap(i, random.below(i as u64 + 1) as usize);
    }
    jobs
}
