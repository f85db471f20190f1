//! Golden files of every format that the crate writes, in `fixtures/formats`. The present reader finds the written
//! content, and the present writer makes the same bytes. Copies that are cut, damaged or newer are distinguished from
//! valid ones.

#[path = "../common/mod.rs"]
mod common;
mod make;
mod wire;

use std::path::{Path, PathBuf};

use make::{GAP, HOST_NS, code, frames, header, judge, labels, results, waveform};
use radome_driver::recording::infineon::InfineonReader;
use radome_driver::recording::label_text::{from_audacity, from_deepcraft};
use radome_driver::recording::mcap::{repair, set_labels};
use radome_driver::recording::{Existing, Recording};
use radome_driver::{FrameResult, McapReader, RecordingHeader};
use radome_dsp::{Frame, FrameSource, Occupancy, SourceEvent, Truth};

/// Judged recording by an earlier version, whose channel of frames had no description of their layout.
const EARLIER_VERSION: &str = "judged-without-layout.mcap";

/// Path of a golden file.
fn golden(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../fixtures/formats").join(name)
}

fn golden_bytes(name: &str) -> Vec<u8> {
    std::fs::read(golden(name)).expect("a golden file")
}

/// All files below a folder, by their relative paths.
fn files(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(next) = folders.pop() {
        for entry in std::fs::read_dir(&next).expect("lists").map(|e| e.expect("an entry").path()) {
            if entry.is_dir() {
                folders.push(entry);
            } else {
                found.push(entry.strip_prefix(folder).expect("below").to_owned());
            }
        }
    }
    found.sort();
    found
}

/// Frames that can be read, the position of the gap if there was one, and the error at the end.
fn read(source: &mut dyn FrameSource) -> (Vec<Frame>, Option<usize>, Option<String>) {
    let mut frame = Frame::zeroed(source.waveform().shape());
    let (mut all, mut gap) = (Vec::new(), None);
    loop {
        match source.next_frame(&mut frame) {
            Ok(SourceEvent::Frame) => all.push(frame.clone()),
            Ok(SourceEvent::Gap(found)) => gap = (found == GAP).then_some(all.len()),
            Ok(SourceEvent::End) => return (all, gap, None),
            Err(error) => return (all, gap, Some(error.to_string())),
        }
    }
}

/// Writes the golden files again after an intended change of a format.
#[test]
#[ignore = "overwrites the golden files: cargo test -p radome-driver --test golden -- --ignored remake"]
fn remake() {
    let folder = golden("");
    // The writer refuses an existing folder.
    let _ = std::fs::remove_dir_all(folder.join("infineon"));
    make::make(&folder);
}

#[test]
fn writers_make_the_bytes_of_the_golden_files() {
    let folder = tempfile::tempdir().expect("folder");
    make::make(folder.path());
    let made = files(folder.path());
    let is_made = |name: &PathBuf| name != Path::new("README.md") && name != Path::new(EARLIER_VERSION);
    let kept: Vec<_> = files(&golden("")).into_iter().filter(is_made).collect();
    assert_eq!(made, kept);
    for name in made {
        let (new, old) = (std::fs::read(folder.path().join(&name)), std::fs::read(golden("").join(&name)));
        assert!(new.expect("reads") == old.expect("reads"), "{} has changed", name.display());
    }
}

#[test]
fn the_native_recording_has_its_content() {
    let mut reader = McapReader::open(&golden("recording.mcap")).expect("opens");
    assert!(reader.is_complete());
    assert_eq!(reader.frame_count(), Some(8));
    assert_eq!(reader.header(), &header());
    let request = reader.waveform().request.clone();
    assert_eq!((request.chirps_per_frame, request.samples_per_chirp), (2, 8));
    assert_eq!((request.rx_antennas.antennas(), request.frame_interval_s), (vec![1, 3], 0.4));
    let board = reader.header().board.clone().expect("a board");
    assert_eq!((board.firmware_version.as_str(), board.chip_id), ("2.9.0", 0x303));
    assert_eq!(reader.header().registers.last().map(|r| r.address), Some(0));
    let found = reader.labels().expect("labels");
    assert_eq!(found, labels());
    assert_eq!((found[1].start_s, found[1].end_s, found[1].confidence), (1.6, 3.6, Some(0.75)));
    assert_eq!(found[1].made_ns, Some(1_767_683_780_000_000_001));

    let (all, gap, error) = read(&mut reader);
    assert_eq!((all.as_slice(), gap, error), (frames().as_slice(), Some(5), None));
    assert_eq!(all.iter().map(|f| f.sequence).collect::<Vec<_>>(), [0, 1, 2, 3, 4, 7, 8, 9]);
    assert_eq!(all[3].codes[24], 3 * 37 + 1000 + 100);
    assert_eq!((all[5].time_ns, all[5].host_time_ns), (2_800_000_000, 1_767_683_777_800_000_000));
    assert_eq!(all[4].truth, Some(Truth { occupancy: Occupancy::Two, transition: true }));
    let temperatures: Vec<_> = all.iter().map(|f| f.temperature_millicelsius.unwrap_or(0)).collect();
    assert_eq!(temperatures, [0, 0, 31_500, 31_500, 31_500, 31_750, 31_750, 31_750]);
}

#[test]
fn the_judged_recording_has_its_content() {
    check_judged("judged.mcap");
    // A recording that was not judged has no results; the vendor's formats cannot hold any.
    let mut no_results =
        Recording::open(&golden("recording.mcap")).expect("opens").results().expect("none").expect("mcap");
    assert!(no_results.next().is_none());
    assert!(Recording::open(&golden("infineon")).expect("opens").results().expect("none").is_none());
}

#[test]
fn a_recording_of_an_earlier_version_has_its_content() {
    check_judged(EARLIER_VERSION);
}

#[test]
fn frames_can_be_read_by_the_schema_alone() {
    let bytes = golden_bytes("recording.mcap");
    let mut found = Vec::new();
    for message in mcap::MessageStream::new(&bytes).expect("opens") {
        let message = message.expect("reads");
        if message.channel.topic != "/radome/frames" {
            continue;
        }
        let schema = message.channel.schema.as_ref().expect("a schema");
        assert_eq!((schema.name.as_str(), schema.encoding.as_str()), ("radome.frame", "radome.layout"));
        let layout = std::str::from_utf8(&schema.data).expect("text");
        found.push(decode_by_layout(layout, &message.data));
    }
    let expected: Vec<_> = frames().into_iter().map(|f| (f.sequence, f.time_ns, f.host_time_ns, f.codes)).collect();
    assert_eq!(found, expected);
}

/// Decodes a message by the lines of a layout: sequence, time, host time and codes.
fn decode_by_layout(layout: &str, mut rest: &[u8]) -> (u64, u64, u64, Vec<u16>) {
    let mut fields: Vec<(&str, u64)> = Vec::new();
    let mut codes = Vec::new();
    for line in layout.lines().skip(1) {
        let (kind, name) = line.split(':').next().and_then(|text| text.split_once(' ')).expect("type and name");
        let value = |fields: &[(&str, u64)], name: &str| fields.iter().find(|(n, _)| *n == name).expect("a field").1;
        if let Some(lengths) = kind.strip_prefix("u16[") {
            let lengths = lengths.trim_end_matches(']').split("][").map(|name| value(&fields, name) as usize);
            assert_eq!(rest.len(), 2 * lengths.product::<usize>());
            codes = rest.chunks(2).map(|b| u16::from_le_bytes([b[0], b[1]])).collect();
            continue;
        }
        let bytes = kind[1..].parse::<usize>().expect("bits") / 8;
        let (field, after) = rest.split_at(bytes);
        fields.push((name, field.iter().rev().fold(0u64, |sum, byte| sum << 8 | u64::from(*byte))));
        rest = after;
    }
    let value = |name: &str| fields.iter().find(|(n, _)| *n == name).expect("a field").1;
    (value("sequence"), value("time"), value("host_time"), codes)
}

/// Checks the content of a judged recording.
fn check_judged(name: &str) {
    let mut reader = Recording::open(&golden(name)).expect("opens");
    assert_eq!(reader.header(), RecordingHeader { judge: Some(judge()), ..header() });
    let found: Vec<_> = reader.results().expect("results").expect("some").map(|r| r.expect("reads")).collect();
    assert_eq!(found, results());
    assert_eq!(found.iter().map(|r| r.sequence).collect::<Vec<_>>(), [0, 1, 2, 3, 4, 8, 9]);
    assert_eq!(
        (found[0].label, found[1].label, found[1].probabilities),
        (None, Some(Occupancy::One), Some([0.125, 0.75, 0.125]))
    );
    assert_eq!(
        (found[3].occupied, found[3].people, found[3].latency_ns, found[3].time_ns),
        (true, 1, 1_000_003, 1_200_000_000)
    );
    // Frames and labels equal those of a recording without results.
    assert_eq!(reader.labels().expect("labels"), labels());
    let (all, gap, error) = read(&mut reader);
    assert_eq!((all.as_slice(), gap, error), (frames().as_slice(), Some(5), None));
}

#[test]
fn results_of_an_unfinished_recording_are_found() {
    let folder = tempfile::tempdir().expect("folder");
    let (cut, fixed) = (folder.path().join("cut.mcap"), folder.path().join("fixed.mcap"));
    let bytes = golden_bytes("judged.mcap");
    let results_of = |path: &Path| -> Vec<FrameResult> {
        McapReader::open(path).expect("opens").results().expect("results").map_while(Result::ok).collect()
    };
    std::fs::write(&cut, &bytes[..bytes.len() - 40]).expect("writes");
    assert_eq!(results_of(&cut), results());
    let report = repair(&cut, &fixed, Existing::Replace).expect("repairs");
    assert_eq!((report.results, results_of(&fixed)), (7, results()));
    assert_eq!(McapReader::open(&fixed).expect("opens").header().judge, Some(judge()));
    // Labels of a judged recording can change without loss of results.
    set_labels(&fixed, &labels()[..1]).expect("sets");
    assert_eq!(results_of(&fixed), results());
}

/// Part of a frame that the vendor's formats hold: samples, a new number, and in the folder also time and temperature.
fn as_stored(mut frame: Frame, index: usize, keeps_times: bool) -> Frame {
    frame.sequence = index as u64;
    frame.truth = None;
    if !keeps_times {
        frame.time_ns = index as u64 * 400_000_000;
        frame.host_time_ns = 0;
        frame.temperature_millicelsius = None;
    }
    frame
}

#[test]
fn the_vendors_formats_have_their_content() {
    for (name, keeps_times) in [("infineon", true), ("sdk.txt", false)] {
        let mut reader = Recording::open(&golden(name)).expect("opens");
        assert_eq!(reader.waveform(), &waveform());
        let (all, gap, error) = read(&mut reader);
        let expected: Vec<_> = frames().into_iter().enumerate().map(|(i, f)| as_stored(f, i, keeps_times)).collect();
        assert_eq!((all.as_slice(), gap, error), (expected.as_slice(), None, None), "{name}");
        // The sixth frame has number 7; checks the last sample of RX3's second chirp.
        assert_eq!(all[5].codes[31], 7 * 37 + 1000 + 100 + 7);
        assert_eq!(code(7, 1, 1, 7), 1366);
        if keeps_times {
            assert_eq!(all[5].host_time_ns, HOST_NS + 2_800_000_000);
        }
    }
}

#[test]
fn label_files_have_their_content() {
    let text = String::from_utf8(golden_bytes("labels-audacity.txt")).expect("text");
    assert_eq!(text, "0.000000\t1.600000\tone\n1.600000\t3.600000\ttwo, or \"more\"\n");
    let spans = from_audacity(&text).expect("reads");
    assert_eq!((spans[1].start_s, spans[1].end_s, spans[1].label.as_str()), (1.6, 3.6, "two, or \"more\""));
    let text = String::from_utf8(golden_bytes("labels-deepcraft.label")).expect("text");
    assert_eq!(
        text.lines().nth(2),
        Some("1.600000,2.000000,\"two, or \"\"more\"\"\",0.75,one of them behind the desk")
    );
    let spans = from_deepcraft(&text).expect("reads");
    assert_eq!((spans[1].end_s, spans[1].confidence), (3.6, Some(0.75)));
    assert_eq!((spans[0].note.as_deref(), spans[1].note.as_deref()), (None, Some("one of them behind the desk")));
}

mod hard_cases {
    use super::*;

    /// Copies the golden recordings into a folder to damage. The folder is in memory where the system supports it,
    /// since many copies are written.
    fn copy() -> tempfile::TempDir {
        let memory = Path::new("/dev/shm");
        let parent = if memory.is_dir() { memory.to_owned() } else { std::env::temp_dir() };
        let folder = tempfile::tempdir_in(parent).expect("folder");
        for name in files(&golden("")) {
            let target = folder.path().join(&name);
            std::fs::create_dir_all(target.parent().expect("a folder")).expect("creates");
            std::fs::copy(golden("").join(&name), target).expect("copies");
        }
        folder
    }

    const RECORDINGS: [(&str, &[&str]); 4] = [
        ("recording.mcap", &["recording.mcap"]),
        ("judged.mcap", &["judged.mcap"]),
        (
            "infineon",
            &[
                "infineon/RadarIfxAvian_00/radar.npy",
                "infineon/RadarIfxAvian_00/config.json",
                "infineon/RadarIfxAvian_00/radar_timestamp.csv",
                "infineon/RadarIfxAvian_00/temperature.npy",
                "infineon/RadarIfxAvian_00/temperature_timestamp.csv",
                "infineon/RadarIfxAvian_00/format.version",
            ],
        ),
        ("sdk.txt", &["sdk.txt", "sdk.txt_config.json"]),
    ];

    /// Result of reading a recording: its frames, and the error if there is one. Asserts that an error names a file of
    /// the recording and a position in it: a byte, a field, or the two files that disagree.
    fn read_damaged(folder: &Path, recording: &str) -> (Vec<Frame>, Option<String>) {
        let path = folder.join(recording);
        let (frames, error) = match Recording::open(&path) {
            Ok(mut source) => {
                let (frames, _, error) = read(&mut source);
                (frames, error)
            }
            Err(error) => (Vec::new(), Some(error.to_string())),
        };
        if let Some(text) = &error {
            assert!(text.contains(&path.display().to_string()), "{text}");
            let positions = ["byte ", "field `", "config.json says", "impossible", "format version", "not a recording"];
            assert!(positions.iter().any(|position| text.contains(position)), "{text}");
        }
        (frames, error)
    }

    /// Frames of a golden recording.
    fn golden_frames(recording: &str) -> Vec<Frame> {
        read(&mut Recording::open(&golden(recording)).expect("opens")).0
    }

    #[test]
    fn a_recording_cut_anywhere_gives_its_beginning_and_says_so() {
        let folder = copy();
        for (recording, files) in RECORDINGS {
            let whole = golden_frames(recording);
            for file in files {
                let bytes = golden_bytes(file);
                for cut in 0..bytes.len() {
                    std::fs::write(folder.path().join(file), &bytes[..cut]).expect("writes");
                    let (frames, error) = read_damaged(folder.path(), recording);
                    // Times and temperatures that cannot be used are left out and reported.
                    let has_left_out = || {
                        let reader = InfineonReader::open(&folder.path().join(recording));
                        reader.is_ok_and(|reader| !reader.left_out().is_empty())
                    };
                    if recording == "infineon" && has_left_out() {
                        let codes = |frames: &[Frame]| frames.iter().map(|f| f.codes.clone()).collect::<Vec<_>>();
                        assert_eq!((codes(&frames), error), (codes(&whole), None), "{file} cut at {cut}");
                        continue;
                    }
                    assert!(whole.starts_with(&frames), "{file} cut at {cut}");
                    // Missing spaces at the end of a text are no loss. Missing decimals of the last time, or missing
                    // whole frames of a text, cannot be detected. An MCAP file states that it was not finished.
                    let is_complete = match recording {
                        "recording.mcap" | "judged.mcap" => {
                            McapReader::open(&folder.path().join(file)).is_ok_and(|r| r.is_complete())
                        }
                        _ if file.ends_with(".csv") && !bytes[cut..bytes.len() - 1].contains(&b'\n') => false,
                        _ if *file == "sdk.txt" && cut % (bytes.len() / whole.len()) == 0 => false,
                        _ => error.is_none() && !bytes[cut..].trim_ascii().is_empty(),
                    };
                    assert!(!is_complete, "{file} cut at {cut} counts as complete");
                }
                std::fs::write(folder.path().join(file), &bytes).expect("writes");
            }
        }
    }

    #[test]
    fn a_native_recording_cut_anywhere_is_repaired_to_its_last_whole_chunk() {
        let folder = copy();
        let (broken, fixed) = (folder.path().join("recording.mcap"), folder.path().join("fixed.mcap"));
        let bytes = golden_bytes("recording.mcap");
        let mut max_frames = 0;
        for cut in 0..bytes.len() {
            std::fs::write(&broken, &bytes[..cut]).expect("writes");
            let readable = Recording::open(&broken).map(|mut source| read(&mut source).0);
            match repair(&broken, &fixed, Existing::Replace) {
                Ok(report) => {
                    let mut fixed = McapReader::open(&fixed).expect("opens");
                    assert!(fixed.is_complete());
                    let (frames, _, error) = read(&mut fixed);
                    assert_eq!((frames.len() as u64, error), (report.frames, None));
                    assert!(readable.is_ok_and(|readable| readable == frames) || frames.is_empty());
                    max_frames = max_frames.max(frames.len());
                }
                Err(error) => {
                    assert!(error.to_string().contains("recording.mcap") && readable.is_err(), "{error}");
                }
            }
        }
        assert_eq!(max_frames, 8);
    }

    /// Selects bits to flip, identically in each run.
    fn sample(count: u64, bits: usize) -> impl Iterator<Item = usize> {
        (0..count).map(move |n| {
            let mixed = (n + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
            ((mixed ^ mixed >> 29).wrapping_mul(0xBF58_476D_1CE4_E5B9) >> 20) as usize % bits
        })
    }

    /// Asserts that no flipped bit changes a sample of the native file, which has check sums. The vendor's formats have
    /// none.
    #[test]
    fn a_flipped_bit_is_an_error_or_does_no_harm() {
        let folder = copy();
        for (recording, files) in RECORDINGS {
            let whole = golden_frames(recording);
            for file in files {
                let bytes = golden_bytes(file);
                for bit in sample(1500, 8 * bytes.len()) {
                    let mut bytes = bytes.clone();
                    bytes[bit / 8] ^= 1 << (bit % 8);
                    std::fs::write(folder.path().join(file), bytes).expect("writes");
                    let (frames, _) = read_damaged(folder.path(), recording);
                    if recording.ends_with(".mcap") {
                        assert!(whole.starts_with(&frames), "bit {bit}");
                    } else {
                        let codes =
                            |frames: &[Frame]| -> Vec<u16> { frames.iter().flat_map(|f| f.codes.clone()).collect() };
                        let (found, expected) = (codes(&frames), codes(&whole));
                        let wrong = found.iter().zip(&expected).filter(|(a, b)| a != b).count();
                        assert!(
                            wrong <= 1 || frames.len() != whole.len() || file.ends_with(".json"),
                            "{file} bit {bit}"
                        );
                    }
                }
                std::fs::write(folder.path().join(file), &bytes).expect("writes");
            }
        }
    }

    #[test]
    fn a_newer_copy_is_refused_with_both_versions() {
        let folder = copy();
        let mut bytes = golden_bytes("recording.mcap");
        let key = b"format_version\x01\0\0\0";
        let at = bytes.windows(key.len()).position(|w| w == key).expect("the version") + key.len();
        assert_eq!(bytes[at], b'1');
        bytes[at] = b'2';
        std::fs::write(folder.path().join("recording.mcap"), bytes).expect("writes");
        std::fs::write(folder.path().join("infineon/RadarIfxAvian_00/format.version"), "1.1.0\n").expect("writes");
        for (recording, version, known) in [("recording.mcap", "version 2,", "to 1;"), ("infineon", "1.1.0", "1.0.0")] {
            let (_, error) = read_damaged(folder.path(), recording);
            let error = error.expect("refused");
            assert!(error.contains(version) && error.contains(known), "{error}");
        }
        assert!(
            repair(&folder.path().join("recording.mcap"), &folder.path().join("fixed.mcap"), Existing::Replace)
                .is_err()
        );
        assert!(!folder.path().join("fixed.mcap").exists());
    }

    #[test]
    fn damaged_label_files_are_refused_with_the_line_or_read() {
        for name in ["labels-audacity.txt", "labels-deepcraft.label"] {
            let bytes = golden_bytes(name);
            let cuts = (0..bytes.len()).map(|cut| bytes[..cut].to_vec());
            let flips = (0..8 * bytes.len()).map(|bit| {
                let mut bytes = bytes.clone();
                bytes[bit / 8] ^= 1 << (bit % 8);
                bytes
            });
            for damaged in cuts.chain(flips) {
                let Ok(text) = String::from_utf8(damaged) else { continue };
                let result = if name.ends_with(".label") { from_deepcraft(&text) } else { from_audacity(&text) };
                match result {
                    Ok(spans) => assert!(spans.iter().all(|s| s.start_s.is_finite() && s.end_s >= s.start_s)),
                    Err(error) => assert!((1..=3).contains(&error.line), "{error}"),
                }
            }
        }
    }
}
