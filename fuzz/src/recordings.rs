//! Checks of recordings.

use std::path::{Path, PathBuf};

use radome_driver::recording::mcap::repair;
use radome_driver::recording::{Existing, Format, Recording, RecordingWriter};
use radome_driver::{LabelSpan, McapReader, RecordingHeader};
use radome_dsp::{Frame, FrameShape, FrameSource, Gap, SourceEvent, Waveform, WaveformRequest};

use crate::with_memory_limit;

/// Files of a recording folder of the vendor, in the order of an input's sections.
pub const INFINEON_FILES: [&str; 6] = [
    "config.json",
    "radar.npy",
    "radar_timestamp.csv",
    "temperature.npy",
    "temperature_timestamp.csv",
    "format.version",
];

/// Waveform of small frames.
pub fn waveform() -> Waveform {
    let request = WaveformRequest {
        rx_antennas: radome_dsp::RxMask::from_antennas(&[1]).expect("an antenna"),
        chirps_per_frame: 2,
        samples_per_chirp: 8,
        ..WaveformRequest::paper()
    };
    Waveform::realise(request).expect("valid")
}

/// Event of a recording: a frame or a gap.
#[derive(Debug, Clone, PartialEq)]
enum Event {
    Frame(Frame),
    Gap(Gap),
}

/// Reads all remaining events, and whether the end was reached. Returns `None` if a frame would be too large for a
/// fuzzer.
fn read_all(source: &mut dyn FrameSource) -> Option<(Vec<Event>, bool)> {
    if source.waveform().shape().codes() > 1 << 16 {
        return None;
    }
    // The frame has no capacity, so that the reader must allocate it.
    let mut frame = Frame { codes: Vec::new(), ..Frame::zeroed(FrameShape { rx: 0, chirps: 0, samples: 0 }) };
    let mut events = Vec::new();
    loop {
        match source.next_frame(&mut frame) {
            Ok(SourceEvent::Frame) => {
                assert_eq!(frame.shape, source.waveform().shape());
                assert_eq!(frame.codes.len(), frame.shape.codes());
                assert!(frame.codes.iter().all(|code| *code <= radome_dsp::MAX_CODE));
                events.push(Event::Frame(frame.clone()));
            }
            Ok(SourceEvent::Gap(gap)) => events.push(Event::Gap(gap)),
            Ok(SourceEvent::End) => {
                assert!(matches!(source.next_frame(&mut frame), Ok(SourceEvent::End)), "an end is an end");
                return Some((events, true));
            }
            Err(error) => {
                assert!(!error.to_string().is_empty());
                return Some((events, false));
            }
        }
    }
}

/// Writes frames and gaps in a format, and labels if the format holds them.
fn write(path: &Path, format: Format, header: &RecordingHeader, events: &[Event], labels: &[LabelSpan]) -> bool {
    let mut writer = RecordingWriter::create(path, format, header).expect("creates");
    for event in events {
        match event {
            Event::Frame(frame) => writer.frame(frame).expect("a frame that was read can be written"),
            Event::Gap(gap) => writer.gap(gap).expect("a gap that was read can be written"),
        }
    }
    for label in labels {
        writer.label(label).expect("a label that was read can be written");
    }
    writer.finish().expect("finishes").omitted.is_empty()
}

/// Asserts that the native format preserves a recording that was read completely. Asserts the same of another format,
/// if that reports no loss.
fn round_trip(folder: &Path, header: &RecordingHeader, events: &[Event], labels: &[LabelSpan], other: Format) {
    let path = folder.join("again.mcap");
    write(&path, Format::Mcap, header, events, labels);
    let mut reader = McapReader::open(&path).expect("what was written opens");
    assert_eq!(reader.header(), header);
    assert_eq!(reader.labels().expect("labels"), labels);
    assert_eq!(read_all(&mut reader), Some((events.to_vec(), true)));
    let path = folder.join("again");
    if write(&path, other, header, events, labels) {
        let mut reader = Recording::open(&path).expect("what was written opens");
        assert_eq!(reader.waveform(), &header.waveform);
        assert_eq!(read_all(&mut reader), Some((events.to_vec(), true)));
    }
}

/// Asserts that a recording in a format of the vendor is read after a seek as from the start, and that one that was read
/// completely survives a round trip in `folder`.
pub fn check_vendors(folder: &Path, path: &Path, format: Format, input: &[u8]) {
    let result = with_memory_limit((2 << 20) + 64 * input.len(), || {
        let mut source = Recording::open(path).ok()?;
        let header = source.header();
        let events = read_all(&mut source)?;
        for time_s in [f64::NAN, -1.0, 0.05, 1e300] {
            let _ = source.seek_time_s(time_s);
        }
        source.seek_frame(u64::MAX).expect("seeks");
        source.seek_frame(1).expect("seeks");
        let rest = read_all(&mut source)?;
        // Damage before the target of the seek does not matter.
        if events.1 {
            assert_eq!(rest.0, events.0[events.0.len().min(1)..]);
        }
        Some((header, events, source.frame_count()))
    });
    if let Some((header, (events, true), count)) = result {
        assert_eq!(count, Some(events.len() as u64));
        round_trip(folder, &header, &events, &[], format);
    }
}

/// Asserts the properties of any file that may be a native recording.
pub fn check_mcap(folder: &Path, bytes: &[u8]) {
    let path: PathBuf = folder.join("a.mcap");
    std::fs::write(&path, bytes).expect("writes");
    // A chunk of a valid file unpacks to a few times its length; a claimed length alone must not allocate memory.
    let allowed = (8 << 20) + 256 * bytes.len();
    let result = with_memory_limit(allowed, || {
        let mut reader = McapReader::open(&path).ok()?;
        let events = read_all(&mut reader)?;
        Some((reader.header().clone(), reader.labels().ok(), events, reader.is_complete()))
    });
    if let Some((header, labels, (events, has_end), is_complete)) = &result {
        check_seek(&path, events, *has_end);
        if *has_end
            && *is_complete
            && let Some(labels) = labels
        {
            round_trip(folder, header, events, labels, Format::Infineon);
        }
    }
    let fixed = folder.join("fixed.mcap");
    let Ok(report) = with_memory_limit(allowed + (8 << 20), || repair(&path, &fixed, Existing::Replace)) else {
        return;
    };
    let mut reader = McapReader::open(&fixed).expect("a repaired file opens");
    assert!(reader.is_complete());
    let labels = reader.labels().expect("a repaired file's labels");
    assert_eq!(labels.len() as u64, report.labels);
    let Some((repaired, has_end)) = read_all(&mut reader) else { return };
    assert!(has_end, "a repaired file is whole");
    let frames = |events: &[Event]| -> Vec<Frame> {
        events.iter().filter_map(|e| if let Event::Frame(f) = e { Some(f.clone()) } else { None }).collect()
    };
    assert_eq!(frames(&repaired).len() as u64, report.frames);
    assert_eq!((repaired.len() - frames(&repaired).len()) as u64, report.gaps + report.lost.len() as u64);
    if let Some((header, _, (events, _), _)) = &result {
        assert_eq!(reader.header(), header);
        assert!(frames(&repaired).starts_with(&frames(events)), "repair saves what a reader reads");
    }
    // A second repair finds no damage.
    let again = folder.join("again-fixed.mcap");
    let second = repair(&fixed, &again, Existing::Replace).expect("repairs");
    assert!(second.damage.is_empty() && second.lost.is_empty(), "{second:?}");
    assert!(std::fs::read(&fixed).expect("reads") == std::fs::read(&again).expect("reads"));
}

/// Asserts that reading after a seek starts at the first frame that is not before the target, if the numbers of frames increase.
fn check_seek(path: &Path, events: &[Event], has_end: bool) {
    let numbers: Vec<u64> =
        events.iter().filter_map(|e| if let Event::Frame(f) = e { Some(f.sequence) } else { None }).collect();
    let is_increasing = numbers.is_sorted_by(|a, b| a < b);
    let mut source = Recording::open(path).expect("opens again");
    for target in [0, 1, numbers.len() as u64 / 2, numbers.last().copied().unwrap_or(9), u64::MAX] {
        if source.seek_frame(target).is_err() {
            continue;
        }
        let Some((rest, _)) = read_all(&mut source) else { return };
        if is_increasing && has_end {
            let first = rest.iter().find_map(|e| if let Event::Frame(f) = e { Some(f.sequence) } else { None });
            assert_eq!(first, numbers.iter().find(|n| **n >= target).copied(), "seeking frame {target}");
        }
    }
    for time_s in [f64::NAN, -1.0, 0.05, 1e300] {
        let _ = source.seek_time_s(time_s);
    }
}
