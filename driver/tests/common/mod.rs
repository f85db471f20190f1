//! Helpers for tests of boards and recordings. Each test binary uses a part of this module.

#![allow(dead_code, unused_imports)]

mod pattern;

use std::path::{Path, PathBuf};
use std::time::Duration;

use proptest::prelude::ProptestConfig;
use radome_driver::chip::ChipConfiguration;
use radome_driver::protocol::mcu7::{Protocol, SliceLayout};
use radome_driver::{
    BoardError, DeepcraftBoard, EmulatedBoard, EmulatorOptions, Esp32Stream, Fault, Kind, LabelSpan, Mcu7Board, Pace,
    Reconnect, Recorder, RecordingHeader,
};
use radome_dsp::{Frame, FrameSource, Gap, GapReason, SourceError, SourceEvent, Waveform};

pub use self::pattern::*;

/// Reconnection policy with a timeout for slow machines.
pub const POLICY: Reconnect = Reconnect {
    first_wait: Duration::from_millis(10),
    longest_wait: Duration::from_millis(50),
    give_up_after: Duration::from_secs(60),
};

/// Parses hexadecimal digits.
pub fn unhex(digits: &str) -> Vec<u8> {
    (0..digits.len()).step_by(2).map(|i| u8::from_str_radix(&digits[i..i + 2], 16).expect("hex")).collect()
}

/// Messages of a vendor client's transcript: whether the host sent each, and its bytes. `None` where the shared data
/// are absent.
pub fn transcript(protocol: Protocol) -> Option<Vec<(bool, Vec<u8>)>> {
    let path = radome_skip::shared(&format!("data/wire/protocol{}.txt", protocol.major()))?;
    let text = std::fs::read_to_string(path).expect("transcript is text");
    let line = |line: &str| {
        let words: Vec<&str> = line.split_whitespace().collect();
        (words[0] == "H", unhex(words[2]))
    };
    Some(text.lines().map(line).collect())
}

/// Configuration with this number of cases; fifty times as many where `RADOME_LONG` is set.
pub fn cases(count: u32) -> ProptestConfig {
    ProptestConfig::with_cases(if std::env::var_os("RADOME_LONG").is_some() { 50 * count } else { count })
}

/// Waveform with the intervals that the chip's registers realise. An emulated board measures when its source does, and
/// the client expects what the registers say.
pub fn realised(waveform: &Waveform) -> Waveform {
    let slice_samples = SliceLayout::for_frame(waveform.shape().codes()).samples;
    ChipConfiguration { waveform: waveform.clone(), slice_samples }.with_realised_intervals().expect("fits")
}

/// Options of an emulated board with these faults that sends as fast as it is read.
pub fn options(kind: Kind, faults: &[Fault]) -> EmulatorOptions {
    let default = EmulatorOptions::default();
    // Faults of DEEPCRAFT are counted in messages, whose number must not depend on the time of a request.
    let latency = if kind == Kind::Deepcraft { Duration::ZERO } else { default.latency };
    EmulatorOptions { pace: Pace::AsFastAsRead, kind, faults: faults.to_vec(), latency, ..default }
}

/// The same with the board's link in this folder, since the terminal number of a closed board is soon reused.
pub fn linked(kind: Kind, faults: &[Fault], folder: &Path) -> EmulatorOptions {
    EmulatorOptions { link: Some(folder.join("board")), ..options(kind, faults) }
}

/// Emulated board that measures this number of frames of a [`Pattern`].
pub fn spawn(waveform: &Waveform, frames: u64, options: EmulatorOptions) -> EmulatedBoard {
    EmulatedBoard::spawn(Box::new(Pattern::new(waveform.clone(), frames)), options).expect("spawns")
}

/// The same with [`options`] of this kind and these faults.
pub fn board(waveform: &Waveform, frames: u64, kind: Kind, faults: &[Fault]) -> EmulatedBoard {
    spawn(waveform, frames, options(kind, faults))
}

/// Client of an emulated board of this kind, which reconnects by this policy.
pub fn open(
    kind: Kind,
    board: &EmulatedBoard,
    waveform: &Waveform,
    policy: Reconnect,
) -> Result<Box<dyn FrameSource>, BoardError> {
    Ok(match kind {
        Kind::Esp32 => Box::new(Esp32Stream::open(board.path(), Some(waveform))?.with_reconnect(policy)),
        Kind::Deepcraft => Box::new(DeepcraftBoard::open(board.path())?.start(waveform)?.with_reconnect(policy)),
        Kind::Mcu7V4 | Kind::Mcu7V3 | Kind::Mcu7Bulk => {
            Box::new(Mcu7Board::open(board.address())?.start(waveform)?.with_reconnect(policy))
        }
    })
}

/// Frames and gaps until the source ends or fails, and the error if it failed.
pub fn read(source: &mut dyn FrameSource) -> (Vec<Frame>, Vec<Gap>, Option<SourceError>) {
    let mut frame = Frame::zeroed(source.waveform().shape());
    let (mut frames, mut gaps) = (Vec::new(), Vec::new());
    loop {
        match source.next_frame(&mut frame) {
            Ok(SourceEvent::Frame) => frames.push(frame.clone()),
            Ok(SourceEvent::Gap(gap)) => gaps.push(gap),
            Ok(SourceEvent::End) => return (frames, gaps, None),
            Err(error) => return (frames, gaps, Some(error)),
        }
    }
}

/// Reasons of gaps, in their order.
pub fn reasons(gaps: &[Gap]) -> Vec<GapReason> {
    gaps.iter().map(|gap| gap.reason).collect()
}

/// Creates a folder, which is removed when it is dropped, and returns the path of a file in it.
pub fn in_folder(name: &str) -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().expect("folder");
    let path = folder.path().join(name);
    (folder, path)
}

/// Byte range of each chunk of a finished recording.
pub fn chunks(bytes: &[u8]) -> Vec<(usize, usize)> {
    let summary = mcap::Summary::read(bytes).expect("reads").expect("a summary");
    let range = |start: u64, length: u64| (start as usize, (start + length) as usize);
    let mut chunks: Vec<_> =
        summary.chunk_indexes.iter().map(|chunk| range(chunk.chunk_start_offset, chunk.chunk_length)).collect();
    chunks.sort_unstable();
    chunks
}

/// Creates a named pipe.
pub fn make_pipe(path: &Path) {
    let status = std::process::Command::new("mkfifo").arg(path).status().expect("mkfifo");
    assert!(status.success());
}

/// Records all events of a source, then a label.
pub fn record(mut source: Pattern, label: &LabelSpan, path: &Path) {
    let mut recorder = Recorder::create(path, &RecordingHeader::new(source.waveform.clone())).expect("creates");
    let mut frame = Frame::zeroed(source.waveform.shape());
    loop {
        match source.next_frame(&mut frame).expect("frame") {
            SourceEvent::Frame => recorder.frame(&frame).expect("records"),
            SourceEvent::Gap(gap) => recorder.gap(&gap).expect("records"),
            SourceEvent::End => break,
        }
    }
    recorder.label(label).expect("records");
    recorder.finish().expect("finishes");
}
