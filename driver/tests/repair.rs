//! Tests of repairs, and of labels of damaged recordings: readable content is kept, and losses are reported.

use std::path::Path;

use proptest::prelude::*;
use radome_driver::recording::Existing;
use radome_driver::recording::mcap::{RESULTS_VERSION, RepairReport, repair, repair_unless, set_labels, stage_labels};
use radome_driver::{FrameResult, Judge, LabelSpan, McapReader, Recorder, RecordingError, RecordingHeader};
use radome_dsp::{Frame, FrameSource, Gap, GapReason, SourceEvent};

use crate::common::{Pattern, cases, chunks, in_folder, read, waveform};

const FRAMES: u64 = 50;
const RECORDED_GAP: Gap = Gap { first_sequence: 20, frames: 3, reason: GapReason::Crc };

fn pattern() -> Pattern {
    Pattern { gap: Some(RECORDED_GAP), ..Pattern::new(waveform(&[1], 4, 32, 0.1), FRAMES) }
}

/// Writes a recording of 50 numbers at 10 Hz: 20 to 22 lost, a chunk for each second, one label. Returns its bytes.
fn record(path: &Path) -> Vec<u8> {
    crate::common::record(pattern(), &LabelSpan::new(0.0, 2.0, "one"), path);
    std::fs::read(path).expect("reads")
}

/// Sequence numbers of the frames, which are compared with the pattern, and the gaps.
fn content(path: &Path) -> (Vec<u64>, Vec<Gap>) {
    let mut source = McapReader::open(path).expect("opens");
    assert!(source.is_complete());
    let (frames, gaps, error) = read(&mut source);
    assert!(error.is_none(), "{error:?}");
    for frame in &frames {
        let mut expected = Frame::zeroed(frame.shape);
        pattern().fill(frame.sequence, &mut expected);
        assert_eq!(*frame, expected);
    }
    (frames.iter().map(|frame| frame.sequence).collect(), gaps)
}

/// Repairs these bytes; asserts that the input file does not change. Also checks that a reader of the input does not panic.
fn repaired(bytes: &[u8]) -> Result<(RepairReport, Vec<u64>, Vec<Gap>), RecordingError> {
    let folder = tempfile::tempdir().expect("folder");
    let (broken, fixed) = (folder.path().join("broken.mcap"), folder.path().join("fixed.mcap"));
    std::fs::write(&broken, bytes).expect("writes");
    if let Ok(mut reader) = McapReader::open(&broken) {
        read(&mut reader);
    }
    let result = repair(&broken, &fixed, Existing::Replace);
    assert!(std::fs::read(&broken).expect("reads") == bytes);
    assert_eq!(fixed.exists(), result.is_ok());
    let report = result?;
    let (numbers, gaps) = content(&fixed);
    assert_eq!(numbers.len() as u64, report.frames);
    Ok((report, numbers, gaps))
}

/// Bytes of a whole recording.
fn whole() -> Vec<u8> {
    let folder = tempfile::tempdir().expect("folder");
    record(&folder.path().join("a.mcap"))
}

#[test]
fn a_whole_file_loses_nothing() {
    let (report, numbers, gaps) = repaired(&whole()).expect("repairs");
    assert!(report.was_finished && report.lost.is_empty() && report.damage.is_empty());
    assert_eq!((report.frames, report.labels, report.gaps), (47, 1, 1));
    assert!(numbers.into_iter().eq((0..20).chain(23..50)));
    assert_eq!(gaps, [RECORDED_GAP]);
}

#[test]
fn a_damaged_chunk_becomes_a_gap() {
    let bytes = whole();
    let chunks = chunks(&bytes);
    // The first chunk holds only channels; each other chunk holds a second.
    let (start, end) = chunks[2];
    for at in [start + 60, (start + end) / 2, end - 1] {
        let mut bytes = bytes.clone();
        bytes[at] ^= 0x40;
        let (report, numbers, gaps) = repaired(&bytes).expect("repairs");
        // The lost chunk contained the recorded gap; the sequence numbers still show it.
        let lost = Gap { first_sequence: 10, frames: 13, reason: GapReason::Recorded };
        assert_eq!(report.lost, [lost], "{:?}", report.damage);
        assert_eq!((report.damage.len(), report.damage[0].offset), (1, start as u64));
        assert_eq!(report.damage[0].frames, Some(10));
        assert!(report.bytes_lost() >= (end - start) as u64 && report.was_finished);
        assert!(numbers.into_iter().eq((0..10).chain(23..50)));
        assert_eq!(gaps, [lost]);
    }
}

#[test]
fn the_frames_of_the_last_chunk_are_counted_by_its_index() {
    let mut bytes = whole();
    let (start, end) = *chunks(&bytes).last().expect("chunks");
    bytes[(start + end) / 2] ^= 0x40;
    let (report, numbers, gaps) = repaired(&bytes).expect("repairs");
    let first = *numbers.last().expect("frames") + 1;
    let lost = Gap { first_sequence: first, frames: 50 - first, reason: GapReason::Recorded };
    assert_eq!((report.lost.as_slice(), gaps.last()), ([lost].as_slice(), Some(&lost)));
}

#[test]
fn a_wrong_length_loses_only_its_chunk() {
    let bytes = whole();
    let (start, end) = chunks(&bytes)[2];
    let opcodes = [0x81, 0x00, 0x07, 0x0a].map(|opcode| (start, opcode));
    for (at, byte) in opcodes.into_iter().chain([(start + 1, 0x03), (start + 3, 0x70), (start + 8, 0x70)]) {
        let mut bytes = bytes.clone();
        bytes[at] = byte;
        let (report, numbers, _) = repaired(&bytes).expect("repairs");
        // A slightly wrong outer length loses no frames, since the chunk inside has its own length and check sum.
        let lost = if numbers.len() == 47 { 20..20 } else { 10..23 };
        assert!(numbers.into_iter().eq((0..50).filter(|n| !lost.contains(n) && !(20..23).contains(n))), "{:?}", report);
        assert_eq!(report.frames_lost(), lost.end - lost.start);
        assert!(report.bytes_lost() < 2 * (end - start) as u64 + 400);
    }
}

/// Asserts that a record whose opcode marks the end of the data loses only itself, and is reported.
#[test]
fn one_wrong_byte_does_not_end_a_recording() {
    let bytes = whole();
    let is_chunk = |at: usize| chunks(&bytes).iter().any(|&(start, _)| start == at);
    let (last, _) = *chunks(&bytes).last().expect("chunks");
    let (mut at, mut records) = (8, 0);
    while bytes[at] != 0x0f {
        for opcode in [0x02, 0x0f] {
            let mut bytes = bytes.clone();
            bytes[at] = opcode;
            let repaired = repaired(&bytes);
            // The header has no copy.
            if let Ok((report, numbers, _)) = repaired {
                assert!(!report.damage.is_empty(), "{at}: {report:?}");
                let max_lost = if is_chunk(at) { 10 } else { 0 };
                assert!(numbers.len() + max_lost >= 47, "{at}: {report:?}");
                // The last chunk holds the label, and the repair does not search behind it.
                assert!(report.labels == 1 && report.was_finished || at >= last, "{at}: {report:?}");
                records += 1;
            }
        }
        let length = u64::from_le_bytes(*bytes[at + 1..].first_chunk().expect("a length"));
        at += 9 + length as usize;
    }
    assert!(records > 2 * chunks(&bytes).len(), "{records}");
}

#[test]
fn the_channels_are_known_without_their_chunk() {
    let mut bytes = whole();
    let (start, end) = chunks(&bytes)[0];
    bytes[(start + end) / 2] ^= 0x40;
    let (report, numbers, _) = repaired(&bytes).expect("repairs");
    assert_eq!((numbers.len(), report.frames_lost(), report.damage.len()), (47, 0, 1));
}

mod hard_cases {
    use super::*;

    const MESSAGE_INDEX: u8 = 0x07;

    /// Bytes of a recording of 20 frames at 10 Hz with an answer to each, as a live run makes it: chunks of answers follow those of
    /// frames.
    fn with_answers() -> Vec<u8> {
        let (_folder, path) = in_folder("a.mcap");
        let mut source = Pattern::new(waveform(&[1], 4, 32, 0.1), 20);
        let (model, model_hash) = ("a".to_owned(), "b".to_owned());
        let judge =
            Judge { version: RESULTS_VERSION, model, model_hash, on_delay_s: 0.5, off_delay_s: 3.0, max_range_m: None };
        let header = RecordingHeader { judge: Some(judge), ..RecordingHeader::new(source.waveform.clone()) };
        let mut recorder = Recorder::create(&path, &header).expect("creates");
        let mut frame = Frame::zeroed(source.waveform.shape());
        while source.next_frame(&mut frame).expect("frame") == SourceEvent::Frame {
            recorder.frame(&frame).expect("records");
            let result = FrameResult { sequence: frame.sequence, time_ns: frame.time_ns, ..FrameResult::default() };
            recorder.result(&result).expect("records");
        }
        recorder.flush().expect("records");
        recorder.finish().expect("finishes");
        std::fs::read(&path).expect("reads")
    }

    /// Regression test: damage between the last frames and their answers was reported as lost frames of unknown number.
    #[test]
    fn a_wrong_length_between_frames_and_answers_is_no_gap() {
        let whole = with_answers();
        let chunks = chunks(&whole);
        let at = chunks[chunks.len() - 2].1;
        assert_eq!(whole[at], MESSAGE_INDEX);
        let correct_length = u64::from_le_bytes(*whole[at + 1..].first_chunk().expect("a length"));
        // One more and one less than right, and beyond the end of the file.
        for length in [correct_length + 1, correct_length - 1, 1 << 40] {
            let mut bytes = whole.clone();
            bytes[at + 1..at + 9].copy_from_slice(&length.to_le_bytes());
            let (report, numbers, gaps) = repaired(&bytes).expect("repairs");
            assert!(numbers.into_iter().eq(0..20), "{report:?}");
            assert!(gaps.is_empty() && report.lost.is_empty(), "{report:?}");
            assert_eq!((report.results, report.damage.len(), report.damage[0].offset), (20, 1, at as u64));
            assert!(report.was_finished);
        }
    }

    /// Regression test: two bytes more in a record, which a later version of MCAP may add, counted as a damaged length.
    #[test]
    fn longer_records_are_valid() {
        const DATA_END: u8 = 0x0f;
        for whole in [with_answers(), whole()] {
            let (mut longer, mut rest) = (whole[..8].to_vec(), &whole[8..]);
            while rest[0] != DATA_END {
                let length = u64::from_le_bytes(*rest[1..].first_chunk().expect("a length"));
                let (record, next) = rest.split_at(9 + length as usize);
                let added: &[u8] = if record[0] == MESSAGE_INDEX { &[0x06, 0x01] } else { &[] };
                longer.push(record[0]);
                longer.extend((length + added.len() as u64).to_le_bytes());
                longer.extend([&record[9..], added].concat());
                rest = next;
            }
            longer.extend(rest);
            let (expected, numbers, gaps) = repaired(&whole).expect("repairs");
            assert_eq!(repaired(&longer).expect("repairs"), (expected, numbers, gaps));
        }
    }

    #[test]
    fn labels_can_be_set_in_a_damaged_recording() {
        let (folder, path) = in_folder("a.mcap");
        let bytes = record(&path);
        let both = [LabelSpan::new(0.0, 2.0, "one"), LabelSpan::new(0.0, 1.0, "one")];
        let mut damaged = bytes.clone();
        let (start, end) = chunks(&bytes)[2];
        damaged[(start + end) / 2] ^= 1;
        std::fs::write(&path, &damaged).expect("writes");
        set_labels(&path, &both).expect("sets");
        let after = std::fs::read(&path).expect("reads");
        let last = chunks(&bytes).last().expect("chunks").1;
        assert!(after[..last] == damaged[..last]);
        let labels = McapReader::open(&path).expect("opens").labels().expect("labels");
        assert_eq!(labels, both);
        assert_eq!(std::fs::read_dir(folder.path()).expect("lists").count(), 1);
    }

    /// Regression test: such a file was refused, although none of its frames is damaged.
    #[test]
    fn damaged_registers_lose_no_frame() {
        let whole = whole();
        let key = b"registers\x02\0\0\0[";
        let at = whole.windows(key.len()).position(|bytes| bytes == key).expect("the registers") + key.len() - 1;
        // The second byte makes the text no UTF-8, too.
        for (byte, reasons) in [(b'x', 1), (0xFF, 2)] {
            let mut bytes = whole.clone();
            bytes[at] = byte;
            let (report, numbers, _) = repaired(&bytes).expect("repairs");
            assert_eq!((numbers.len(), report.labels, report.damage.len()), (47, 1, reasons), "{report:?}");
            assert!(report.damage.iter().any(|damage| damage.reason.contains("`registers` is malformed")));
            assert_eq!(report.frames_lost(), 0);
        }
    }

    /// Regression test: the unfinished output stayed in the folder under its hidden name.
    #[test]
    fn a_repair_that_is_interrupted_leaves_no_file() {
        let (folder, path) = in_folder("a.mcap");
        record(&path);
        let repaired = repair_unless(&path, &folder.path().join("b.mcap"), None, Existing::Refuse, || true);
        assert!(matches!(repaired, Err(RecordingError::Interrupted { .. })), "{repaired:?}");
        assert_eq!(std::fs::read_dir(folder.path()).expect("lists").count(), 1);
    }

    #[test]
    fn a_file_is_not_repaired_onto_itself() {
        let (_folder, path) = in_folder("a.mcap");
        let bytes = record(&path);
        assert!(repair(&path, &path, Existing::Replace).is_err());
        assert!(std::fs::read(&path).expect("reads") == bytes);
    }

    /// Asserts that all complete chunks before a cut, as after `kill -9`, are read and saved.
    #[test]
    fn a_cut_loses_only_what_follows_the_last_whole_chunk() {
        let (folder, path) = in_folder("a.mcap");
        let bytes = record(&path);
        let cut_path = folder.path().join("cut.mcap");
        let chunks = chunks(&bytes);
        let header_end = chunks[0].0;
        for cut in (0..bytes.len()).step_by(61).chain(chunks.iter().flat_map(|c| [c.1 - 1, c.1, c.1 + 1])) {
            let result = repaired(&bytes[..cut]);
            if cut < header_end {
                assert!(result.is_err(), "cut at {cut}");
                continue;
            }
            let (report, numbers, _) = result.expect("repairs");
            let seconds = chunks[1..].iter().filter(|c| c.1 <= cut).count();
            let expected = [0, 10, 20, 30, 40, 47][seconds];
            assert_eq!(numbers.len(), expected, "cut at {cut}: {:?}", report.damage);
            std::fs::write(&cut_path, &bytes[..cut]).expect("writes");
            let Ok(mut reader) = McapReader::open(&cut_path) else {
                assert!(cut < chunks[0].1, "cannot be opened when cut at {cut}");
                continue;
            };
            assert!(!reader.is_complete());
            let (frames, gaps, error) = read(&mut reader);
            assert!(frames.len() == expected && error.is_none(), "cut at {cut}: {error:?}");
            // A part of a chunk is reported as a gap of unknown length behind the last frame.
            let behind_frames = frames.last().map_or(0, |frame| frame.sequence + 1);
            let first_sequence = gaps.iter().map(|gap| gap.first_sequence + gap.frames).fold(behind_frames, u64::max);
            let end = Gap { first_sequence, frames: 0, reason: GapReason::Recorded };
            assert_eq!(gaps.last() == Some(&end), reader.is_cut(), "cut at {cut}: {gaps:?}");
            let is_within_chunk = chunks[1..].iter().any(|c| c.0 < cut && cut < c.1);
            let is_whole = chunks.iter().any(|c| c.1 == cut);
            assert!(if is_within_chunk { reader.is_cut() } else { !is_whole || !reader.is_cut() }, "cut at {cut}");
        }
    }

    /// Regression test: of a file made by `cat a b > both` the first recording was read, and the second was not reported.
    #[test]
    fn data_behind_a_recording_are_reported() {
        let (_folder, path) = in_folder("both.mcap");
        let bytes = record(&path);
        for behind in [bytes.clone(), b"more".to_vec(), vec![0; 10_000]] {
            let both = [bytes.as_slice(), &behind].concat();
            let (report, numbers, _) = repaired(&both).expect("repairs");
            assert_eq!((numbers.len(), report.lost.len()), (47, 0));
            let [damage] = report.damage.as_slice() else { panic!("{:?}", report.damage) };
            assert_eq!((damage.offset, damage.bytes), (bytes.len() as u64, behind.len() as u64));
            std::fs::write(&path, &both).expect("writes");
            let (frames, _, error) = read(&mut McapReader::open(&path).expect("opens"));
            let error = error.expect("an error").to_string();
            assert!(frames.len() == 47 && error.contains("the file goes on"), "{error}");
            let labels = [LabelSpan::new(0.0, 1.0, "one")];
            assert!(set_labels(&path, &labels).is_err());
            assert!(std::fs::read(&path).expect("reads") == both);
        }
    }

    /// Regression test: one wrong byte in the waveform lost the whole recording.
    #[test]
    fn a_damaged_header_is_replaced_by_that_of_another_recording() {
        let (folder, path) = in_folder("a.mcap");
        let mut bytes = record(&path);
        let fixed = folder.path().join("fixed.mcap");
        let key = b"samples_per_chirp";
        let at = bytes.windows(key.len()).position(|part| part == key).expect("the waveform");
        bytes[at] = b'?';
        std::fs::write(&path, &bytes).expect("writes");
        assert!(matches!(repair(&path, &fixed, Existing::Refuse), Err(RecordingError::Corrupt { .. })));
        let repair_with = |waveform| {
            let header = Some(RecordingHeader::new(waveform));
            repair_unless(&path, &fixed, header, Existing::Replace, || false).expect("repairs")
        };
        let report = repair_with(pattern().waveform);
        assert_eq!((report.frames, report.labels, report.damage.len()), (47, 1, 1));
        assert!(content(&fixed).0.into_iter().eq((0..20).chain(23..50)));
        // Frames of another shape are not used for this waveform.
        let report = repair_with(waveform(&[1, 2], 4, 32, 0.1));
        assert_eq!((report.frames, report.frames_lost()), (0, 47));
    }

    proptest! {
        #![proptest_config(cases(100))]

        #[test]
        fn every_missing_frame_lies_in_a_gap(
            changes in prop::collection::vec((any::<prop::sample::Index>(), prop::collection::vec(any::<u8>(), 1..40)), 1..6),
            cut in prop::option::of(any::<prop::sample::Index>()),
        ) {
            let mut bytes = whole();
            let header_end = chunks(&bytes)[0].0;
            for (index, change) in &changes {
                let at = header_end + index.index(bytes.len() - header_end);
                let end = (at + change.len()).min(bytes.len());
                bytes[at..end].copy_from_slice(&change[..end - at]);
            }
            if let Some(cut) = cut {
                bytes.truncate(header_end + cut.index(bytes.len() - header_end));
            }
            let (report, numbers, gaps) = repaired(&bytes).expect("repairs");
            let end = numbers.last().map_or(0, |last| last + 1);
            let start = numbers.iter().chain(gaps.iter().map(|gap| &gap.first_sequence)).min().copied().unwrap_or(0);
            for number in start..end {
                let missing = !numbers.contains(&number);
                let in_gap = gaps.iter().any(|g| (g.first_sequence..g.first_sequence + g.frames).contains(&number));
                prop_assert_eq!(missing, in_gap, "frame {}, {:?}", number, report);
            }
        }

        #[test]
        fn arbitrary_bytes_are_refused_or_read(bytes in prop::collection::vec(any::<u8>(), 0..2000)) {
            let (folder, path) = in_folder("a.mcap");
            for content in [bytes.clone(), [mcap::MAGIC, &bytes].concat()] {
                std::fs::write(&path, content).expect("writes");
                let _ = McapReader::open(&path).map(|reader| reader.labels());
                prop_assert!(repair(&path, &folder.path().join("b.mcap"), Existing::Replace).is_err());
            }
        }
    }

    /// Regression test: a damaged length of a message index hid the chunks that it reached over, without a report.
    #[test]
    fn a_wrong_length_of_a_record_between_chunks_loses_no_chunk() {
        let whole = whole();
        let chunks = chunks(&whole);
        let at = chunks[1].1;
        assert_eq!(whole[at], MESSAGE_INDEX);
        // Beyond the end of two more chunks, and one byte more and less than right.
        let correct_length = u64::from_le_bytes(*whole[at + 1..].first_chunk().expect("a length"));
        for length in [(chunks[3].1 - at - 9) as u64, correct_length + 1, correct_length - 1] {
            let mut bytes = whole.clone();
            bytes[at + 1..at + 9].copy_from_slice(&length.to_le_bytes());
            let (report, numbers, _) = repaired(&bytes).expect("repairs");
            assert!(numbers.into_iter().eq((0..20).chain(23..50)), "{report:?}");
            assert_eq!((report.frames_lost(), report.damage.len()), (0, 1), "{report:?}");
            assert_eq!(report.damage[0].offset, at as u64);
        }
    }

    /// Asserts that a chunk of a hundred bytes with a stated length of exabytes is refused without allocating that memory.
    #[test]
    fn a_stated_length_is_checked_before_allocation() {
        let mut bytes = whole();
        let (start, _) = chunks(&bytes)[2];
        bytes[start + 9 + 16..start + 9 + 24].copy_from_slice(&(1u64 << 60).to_le_bytes());
        let (report, ..) = repaired(&bytes).expect("repairs");
        assert!(report.damage[0].reason.contains("claims"), "{:?}", report.damage);
    }

    /// Regression test: labels of frames that the repaired file lacks were kept, and other commands refused them.
    #[test]
    fn labels_are_cut_to_the_frames_that_are_saved() {
        let (folder, path) = in_folder("a.mcap");
        let bytes = record(&path);
        // Two seconds of frames; the rest was never written.
        std::fs::write(&path, &bytes[..chunks(&bytes)[2].1]).expect("writes");
        let spans = [(0.5, 1.5, "one"), (1.5, 4.0, "empty"), (1.0, 1.0, "a knock"), (3.0, 4.0, "two")];
        let labels = spans.map(|(start_s, end_s, label)| LabelSpan::new(start_s, end_s, label));
        stage_labels(&path, &labels).expect("stages");
        let fixed = folder.path().join("b.mcap");
        let report = repair(&path, &fixed, Existing::Refuse).expect("repairs");
        assert_eq!((report.frames, report.labels, report.labels_left_out), (20, 3, 1), "{report:?}");
        let kept = McapReader::open(&fixed).expect("opens").labels().expect("labels");
        let end_s = kept[1].end_s;
        assert!((end_s - 2.0).abs() < 0.01, "{end_s}");
        let [one, empty, knock, _] = labels;
        assert_eq!(kept, [one, LabelSpan { end_s, ..empty }, knock]);
    }
}
