//! Native recording: an MCAP file.
//!
//! | what | where | encoding |
//! |---|---|---|
//! | waveform, board, registers, format version | metadata record `radome` | JSON in string fields |
//! | frames | channel `/radome/frames` | `radome.frame`, below |
//! | gaps | channel `/radome/gaps` | JSON [`Gap`](radome_dsp::Gap) |
//! | labels | channel `/radome/labels`; while they are edited `.NAME.labels` beside the file | JSON [`LabelSpan`], or a list of them that takes the place of all before it |
//! | results of a classifier, if one ran | channel `/radome/results`; [`Judge`] in the metadata | JSON [`FrameResult`] |
//!
//! A frame, little-endian: `version u8 = 1 | flags u8 (1 truth, 2 temperature) | class u8 | transition u8 | rx u16 |
//! chirps u16 | samples u16 | 0 u16 | sequence u64 | board time ns u64 | host time ns u64 | temperature i32
//! (thousandths of a degree Celsius) | codes u16[rx][chirp][sample]`: 40 bytes and the codes. The schema of the channel
//! says the same as text, so that a file can be read without this program. Recordings of earlier versions lack it.
//! Messages in JSON have no schema, as MCAP allows.
//!
//! Messages are logged at the host's time, or at the board's where the host's is unknown (0: simulations). Chunks are
//! written as a whole every second of board time or 4 MB, and every half second by a recorder that syncs
//! ([`SyncOptions`]). A recording can therefore be read up to its last chunk whenever its writer ends. Results stand in
//! chunks of their own, so that they can be read without the frames. Nothing depends on the wall clock: the same frames
//! give the same bytes.
//!
//! A recorder needs the same memory however long its recording is. The summary at the end of the file holds the index
//! of chunks. Until then the index is in a file without a name, in the folder of the recording: some 90 bytes for each
//! chunk.

mod chunk_indexes;
mod encode;
#[cfg(test)]
mod faults;
mod index;
mod label_list;
mod lengths;
mod reader;
mod recorder;
mod records;
mod repair;
mod results;
mod staged;
mod syncer;
mod writer;

pub use label_list::{LabelEditor, set_labels, stage_labels};
pub use reader::{McapReader, Results};
pub use recorder::{Recorder, RecorderOptions};
pub use repair::{Damage, RepairReport, repair, repair_unless};
pub use results::{FrameResult, Judge, RESULTS_VERSION};
pub use syncer::SyncOptions;
pub(super) use writer::McapWriter;

use radome_dsp::{Frame, FrameShape, Occupancy, Truth, Waveform};
use serde::{Deserialize, Serialize};

use crate::board::BoardIdentity;
use crate::chip::RegisterList;
use crate::recording::Position;

/// Version of the format that is written, and the newest that is read.
const FORMAT_VERSION: u32 = 1;
const METADATA_NAME: &str = "radome";
const FRAMES: &str = "/radome/frames";
const GAPS: &str = "/radome/gaps";
const LABELS: &str = "/radome/labels";
const RESULTS: &str = "/radome/results";
const FRAME_HEADER: usize = 40;

/// Layout of a frame, the schema of its channel: type, name and meaning of each field. The lengths of an array are
/// fields before it.
const FRAME_LAYOUT: &str = "\
little-endian, without padding
u8 version: 1
u8 flags: 1 truth is known, 2 temperature is known
u8 class: true class, 0 empty, 1 one person, 2 two people or more
u8 transition: 1 if a person enters or leaves
u16 rx: receive channels
u16 chirps
u16 samples: samples of a chirp
u16 reserved: 0
u64 sequence: frames since the acquisition started, lost ones counted too
u64 time: first chirp since the acquisition started, ns
u64 host_time: reception, ns since 1970, 0 if unknown
i32 temperature: 0.001 degrees Celsius
u16[rx][chirps][samples] codes: 0 to 4095
";

/// Header of a recording.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordingHeader {
    /// Waveform of every frame.
    pub waveform: Waveform,
    /// Board, if there was one.
    pub board: Option<BoardIdentity>,
    /// Registers of the board's chip; empty if there was none.
    pub registers: RegisterList,
    /// Classifier of the frames; with one, the recording has a channel for results.
    pub judge: Option<Judge>,
}

impl RecordingHeader {
    /// Creates the header of a recording without a board.
    pub fn new(waveform: Waveform) -> Self {
        RecordingHeader { waveform, board: None, registers: RegisterList::new(), judge: None }
    }
}

/// Label of a span of time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LabelSpan {
    /// Start on the frames' own clock (`Frame::time_ns`), s.
    pub start_s: f64,
    /// End, s.
    pub end_s: f64,
    /// Name of an [`Occupancy`], or free text.
    pub label: String,
    /// Author of the label.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub who: Option<String>,
    /// Confidence, 0 to 1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub confidence: Option<f64>,
    /// Time of labelling, ns since 1970.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub made_ns: Option<u64>,
    /// Free note.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub note: Option<String>,
}

impl LabelSpan {
    /// Creates a label without an author, confidence, time or note.
    pub fn new(start_s: f64, end_s: f64, label: impl Into<String>) -> Self {
        LabelSpan { start_s, end_s, label: label.into(), who: None, confidence: None, made_ns: None, note: None }
    }

    /// Returns the class that the label names; `None` if the label is free text.
    pub fn occupancy(&self) -> Option<Occupancy> {
        Occupancy::from_name(&self.label)
    }
}

/// Takes a message of the channel of labels, which adds one label or replaces all of them.
fn apply_label_message(message: &[u8], labels: &mut Vec<LabelSpan>) -> serde_json::Result<()> {
    if message.first() == Some(&b'[') {
        *labels = serde_json::from_slice(message)?;
    } else {
        labels.push(serde_json::from_slice(message)?);
    }
    Ok(())
}

fn encode_frame(frame: &Frame, out: &mut Vec<u8>) {
    out.clear();
    let flags = u8::from(frame.truth.is_some()) | u8::from(frame.temperature_millicelsius.is_some()) << 1;
    let class = frame.truth.map_or(0, |t| t.occupancy.index() as u8);
    out.extend([1, flags, class, u8::from(frame.truth.is_some_and(|t| t.transition))]);
    for length in [frame.shape.rx, frame.shape.chirps, frame.shape.samples, 0] {
        out.extend((length as u16).to_le_bytes());
    }
    for number in [frame.sequence, frame.time_ns, frame.host_time_ns] {
        out.extend(number.to_le_bytes());
    }
    out.extend(frame.temperature_millicelsius.unwrap_or(0).to_le_bytes());
    out.extend(frame.codes.iter().flat_map(|code| code.to_le_bytes()));
}

/// Fills a frame from a message; the error describes the defect.
fn decode_frame(bytes: &[u8], expected: FrameShape, frame: &mut Frame) -> Result<(), String> {
    let (header, codes) = bytes
        .split_first_chunk::<FRAME_HEADER>()
        .ok_or_else(|| format!("a frame of {} bytes, its header alone has {FRAME_HEADER}", bytes.len()))?;
    let [version, flags, class, transition, ..] = *header;
    if version != 1 {
        return Err(format!("frame format {version}, expected 1"));
    }
    let u16_at = |i: usize| usize::from(u16::from_le_bytes([header[i], header[i + 1]]));
    let shape = FrameShape { rx: u16_at(4), chirps: u16_at(6), samples: u16_at(8) };
    if shape != expected {
        return Err(format!("a frame is {shape}, the recording's waveform says {expected}"));
    }
    if codes.len() != 2 * shape.codes() {
        return Err(format!("a frame has {} bytes of codes, expected {}", codes.len(), 2 * shape.codes()));
    }
    let u64_at = |i: usize| header.get(i..).and_then(|b| b.first_chunk()).map_or(0, |b| u64::from_le_bytes(*b));
    let truth = match (flags & 1 != 0, Occupancy::from_index(usize::from(class))) {
        (false, _) => None,
        (true, Some(occupancy)) => Some(Truth { occupancy, transition: transition != 0 }),
        (true, None) => return Err(format!("class {class} of a frame's truth, known are 0 to 2")),
    };
    frame.codes.clear();
    frame.codes.extend(codes.as_chunks::<2>().0.iter().map(|b| u16::from_le_bytes(*b)));
    if let Some(code) = frame.codes.iter().find(|code| **code > radome_dsp::MAX_CODE) {
        return Err(format!("code {code} in frame {}, largest possible is 4095", u64_at(12)));
    }
    let temperature = i32::from_le_bytes([header[36], header[37], header[38], header[39]]);
    frame.shape = shape;
    (frame.sequence, frame.time_ns, frame.host_time_ns) = (u64_at(12), u64_at(20), u64_at(28));
    frame.truth = truth;
    frame.temperature_millicelsius = (flags & 2 != 0).then_some(temperature);
    Ok(())
}

/// Reads the position of a frame without decoding it; `None` if it is shorter than a header.
fn frame_position(bytes: &[u8]) -> Option<Position> {
    let header: &[u8; FRAME_HEADER] = bytes.first_chunk()?;
    let u64_at = |i: usize| header.get(i..).and_then(|b| b.first_chunk()).map(|b| u64::from_le_bytes(*b));
    Some(Position { sequence: u64_at(12)?, time_ns: u64_at(20)? })
}
