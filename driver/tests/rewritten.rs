//! Recordings that another program has written again: valid MCAP files whose layout is not the recorder's.

use std::path::Path;

use mcap::WriteOptions;
use radome_driver::recording::Existing;
use radome_driver::recording::mcap::{repair, set_labels};
use radome_driver::{LabelSpan, McapReader, RecordingError};
use radome_dsp::{Frame, FrameSource, SourceEvent};

use crate::common::{Pattern, chunks, in_folder, read, record, rewritten, waveform};

const FRAMES: u64 = 25;

/// Source of the frames.
fn pattern() -> Pattern {
    Pattern::new(waveform(&[1], 4, 32, 0.1), FRAMES)
}

/// Label of the recording.
fn label() -> LabelSpan {
    LabelSpan::new(0.0, 2.0, "one")
}

/// Bytes of a recording of 25 frames and a label.
fn recorded() -> Vec<u8> {
    let (_folder, path) = in_folder("a.mcap");
    record(pattern(), &label(), &path);
    std::fs::read(&path).expect("reads")
}

/// Asserts that a file holds all frames and the label, for the reader, for a seek and for the repair.
fn assert_is_whole(bytes: &[u8], name: &str) {
    let (folder, path) = in_folder("a.mcap");
    std::fs::write(&path, bytes).expect("writes");
    let mut reader = McapReader::open(&path).unwrap_or_else(|error| panic!("{name}: {error}"));
    assert_eq!((reader.whole_frames(), reader.labels().expect("labels")), (FRAMES, vec![label()]), "{name}");
    let (frames, _, error) = read(&mut reader);
    assert!(error.is_none() && frames.iter().map(|frame| frame.sequence).eq(0..FRAMES), "{name}: {error:?}");
    reader.seek_frame(13).expect("seeks");
    let mut frame = Frame::zeroed(reader.waveform().shape());
    assert_eq!((reader.next_frame(&mut frame).expect("reads"), frame.sequence), (SourceEvent::Frame, 13), "{name}");
    let report = repair(&path, &folder.path().join("b.mcap"), Existing::Refuse).expect("repairs");
    assert_eq!((report.frames, report.labels, report.damage.len()), (FRAMES, 1, 0), "{name}: {report:?}");
}

/// Regression test: the labels of the first two files were not found, the others were read as recordings without frames or labels.
#[test]
fn files_of_another_layout_have_the_same_content() {
    let layouts = [
        ("channels named late", WriteOptions::new()),
        ("no channels in the summary", WriteOptions::new().repeat_channels(false)),
        ("no index of messages", WriteOptions::new().emit_message_indexes(false)),
        ("no chunks", WriteOptions::new().use_chunks(false)),
        ("no chunks and no summary", WriteOptions::new().use_chunks(false).emit_summary_records(false)),
    ];
    for (name, options) in layouts {
        let bytes = rewritten(&recorded(), options);
        assert_is_whole(&bytes, name);
        assert_is_whole(&bytes[..bytes.len() - 37], &format!("{name}, unfinished"));
    }
}

/// Regression test: a new label, which is a chunk, was the only chunk in the index, so that other programs found no frame.
#[test]
fn a_recording_without_chunks_refuses_labels_until_it_is_repaired() {
    let (folder, path) = in_folder("a.mcap");
    let bytes = rewritten(&recorded(), WriteOptions::new().use_chunks(false));
    std::fs::write(&path, &bytes).expect("writes");
    let error = set_labels(&path, &[label()]).expect_err("refused").to_string();
    assert!(error.contains("a.mcap") && error.contains("radome recording repair"), "{error}");
    assert!(std::fs::read(&path).expect("reads") == bytes);
    let repaired = folder.path().join("b.mcap");
    repair(&path, &repaired, Existing::Refuse).expect("repairs");
    set_labels(&repaired, &[label()]).expect("labels");
    assert_is_whole(&std::fs::read(&repaired).expect("reads"), "repaired");
}

/// Regression test: damage among messages without chunks lost all later frames without a gap.
#[test]
fn damage_among_messages_without_chunks_is_a_gap() {
    let mut bytes = rewritten(&recorded(), WriteOptions::new().use_chunks(false));
    let mut at = mcap::MAGIC.len();
    let mut messages = Vec::new();
    while at < bytes.len() - mcap::MAGIC.len() {
        if bytes[at] == mcap::records::op::MESSAGE {
            messages.push(at);
        }
        at += 9 + u64::from_le_bytes(*bytes[at + 1..].first_chunk().expect("a length")) as usize;
    }
    bytes[messages[12]] = 0x7F;
    let (folder, path) = in_folder("a.mcap");
    std::fs::write(&path, &bytes).expect("writes");
    let repaired = folder.path().join("b.mcap");
    let report = repair(&path, &repaired, Existing::Refuse).expect("repairs");
    assert!(report.frames < FRAMES && !report.damage.is_empty(), "{report:?}");
    let (frames, gaps, _) = read(&mut McapReader::open(&repaired).expect("opens"));
    assert_eq!((frames.len() as u64, gaps.len()), (report.frames, 1), "{gaps:?}");
}

/// Regression test: a wrong bit in the index of chunks hid labels and answers.
#[test]
fn damage_of_the_summary_hides_no_messages() {
    let whole = recorded();
    let (_folder, path) = in_folder("a.mcap");
    let content = |bytes: &[u8]| {
        std::fs::write(&path, bytes).expect("writes");
        let reader = McapReader::open(&path).expect("opens");
        (reader.whole_frames(), reader.labels().expect("labels"))
    };
    let summary_start = mcap::read::footer(&whole).expect("a footer").summary_start as usize;
    for at in summary_start..whole.len() {
        let mut bytes = whole.clone();
        bytes[at] ^= 1 << (at % 8);
        assert_eq!(content(&bytes), (FRAMES, vec![label()]), "byte {at}");
    }
    // Files by earlier versions state no CRC.
    let summary = mcap::Summary::read(&whole).expect("reads").expect("a summary");
    let index = summary.chunk_indexes.iter().max_by_key(|index| index.chunk_start_offset).expect("chunks");
    let entry = [&3u16.to_le_bytes()[..], &index.message_index_offsets[&3].to_le_bytes()].concat();
    let at = whole.windows(entry.len()).rposition(|bytes| bytes == entry).expect("the entry of the labels");
    for channel in [2, 5] {
        let mut bytes = whole.clone();
        bytes[at] = channel;
        let crc = bytes.len() - 12..bytes.len() - 8;
        bytes[crc].fill(0);
        assert_eq!(content(&bytes), (FRAMES, vec![label()]), "channel {channel}");
    }
}

/// Regression test: a file with LZ4 was called damaged, and the suggested repair saved nothing.
#[test]
fn another_compression_is_named_and_is_no_damage() {
    let whole = recorded();
    let (start, _) = chunks(&whole)[0];
    let body = start + 9;
    let length = u64::from_le_bytes(*whole[start + 1..].first_chunk().expect("a length")) - 1;
    let length = length.to_le_bytes();
    let lz4 = [&whole[..start + 1], &length, &whole[body..body + 28], b"\x03\0\0\0lz4", &whole[body + 36..]].concat();
    let (folder, path) = in_folder("a.mcap");
    std::fs::write(&path, lz4).expect("writes");
    let output: &Path = &folder.path().join("b.mcap");
    for error in [McapReader::open(&path).err(), repair(&path, output, Existing::Refuse).err()] {
        assert!(matches!(error, Some(RecordingError::Compression { .. })), "{error:?}");
    }
    assert!(!output.exists());
}
