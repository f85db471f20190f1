//! Tests of recordings: a real one of the vendor's format, the native format, and damaged files.

use std::path::{Path, PathBuf};

use radome_driver::recording::{Recording, WriteReport};
use radome_driver::{
    EmulatedSource, EmulatorOptions, InfineonReader, LabelSpan, McapReader, Pace, RealTime, Recorder, RecordingError,
    RecordingHeader, recording,
};
use radome_dsp::{Frame, FrameSource, Gap, GapReason, SourceError, SourceEvent};

use crate::common::{Pattern, chunks, in_folder, read, waveform};

/// Path of the recording of a breathing person; `None` where the shared data are absent.
fn breathing() -> Option<PathBuf> {
    radome_skip::shared("data/recordings/breathing-person-20260106")
}

/// Frames of a source without gaps.
fn frames(source: &mut dyn FrameSource) -> Vec<Frame> {
    let (frames, gaps, error) = read(source);
    assert!(gaps.is_empty() && error.is_none(), "{gaps:?}, {error:?}");
    frames
}

/// Number of frames until the source ends or fails, and the error if it failed.
fn readable(source: &mut dyn FrameSource) -> (u64, Option<SourceError>) {
    let (frames, _, error) = read(source);
    (frames.len() as u64, error)
}

const CONFIG: &str = r#"{"device_config": {"fmcw_single_shape": {
    "chirp_repetition_time_s": 591.125e-6, "frame_repetition_time_s": 0.1, "if_gain_dB": 23,
    "lower_frequency_Hz": 60.5e9, "upper_frequency_Hz": 61.5e9, "num_chirps_per_frame": 4,
    "num_samples_per_chirp": 16, "rx_antennas": [1, 3], "sample_rate_Hz": 2e6, "tx_power_level": 31}}}"#;

const FRAME_BYTES: usize = 2 * 4 * 16 * 2;

/// Writes a small recording in the old format: 5 frames of 2 x 4 x 16; each code equals its index.
fn write_old_recording(folder: &Path) {
    std::fs::write(folder.join("config.json"), CONFIG).expect("writes");
    std::fs::write(folder.join("format.version"), "1.0.0\r\n").expect("writes");
    let codes = (0..5 * FRAME_BYTES as u16 / 2).flat_map(u16::to_le_bytes);
    std::fs::write(folder.join("radar.npy"), npy("<u2", "(5, 2, 4, 16)", codes)).expect("writes");
}

/// Encodes an NPY file.
fn npy(kind: &str, shape: &str, data: impl IntoIterator<Item = u8>) -> Vec<u8> {
    let mut header = format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}");
    while (header.len() + 11) % 64 != 0 {
        header.push(' ');
    }
    header.push('\n');
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((header.len() as u16).to_le_bytes());
    bytes.extend(header.as_bytes());
    bytes.extend(data);
    bytes
}

/// Configuration of the SDK's range-Doppler example; the writer's antenna mask is in `tx_antennas`.
const SCENE: &str = r#"{"device_config": {"fmcw_scene": {
    "rx_antennas": [1, 2, 3], "tx_antennas": [1, 2, 3], "tx_power_level": 31, "if_gain_dB": 33,
    "range_resolution_m": 0.15, "max_range_m": 4.8, "max_speed_m_s": 2.45, "speed_resolution_m_s": 0.2,
    "sample_rate_Hz": 1000000, "center_frequency_Hz": 60750000000, "frame_repetition_time_s": 0.2}}}"#;

/// Writes a recording of two frames that is configured by metrics.
fn write_scene_recording(folder: &Path, config: &str, chirps: usize, samples: usize) {
    std::fs::write(folder.join("config.json"), config).expect("writes");
    std::fs::write(folder.join("format.version"), "1.0.0\n").expect("writes");
    let codes = (0..2 * 3 * chirps * samples).flat_map(|i| (i as u16 % 4096).to_le_bytes());
    let shape = format!("(2, 3, {chirps}, {samples})");
    std::fs::write(folder.join("radar.npy"), npy("<u2", &shape, codes)).expect("writes");
}

/// Asserts that metrics in place of a waveform give the waveform, with the number of chirps of the data.
#[test]
fn a_folder_configured_by_metrics_is_read() {
    let folder = tempfile::tempdir().expect("a folder");
    // The metrics give 24.5 chirps, which the SDK rounds up, or up to a power of two.
    for chirps in [25, 32] {
        write_scene_recording(folder.path(), SCENE, chirps, 64);
        let mut reader = Recording::open(folder.path()).expect("opens");
        let waveform = reader.waveform().clone();
        let request = &waveform.request;
        assert_eq!((request.samples_per_chirp, request.chirps_per_frame, waveform.shape().rx), (64, chirps, 3));
        let bandwidth = request.end_frequency_hz - request.start_frequency_hz;
        assert!((299_792_458.0 / (2.0 * bandwidth) - 0.15).abs() < 1e-9, "{bandwidth}");
        assert!((0.5 * (request.start_frequency_hz + request.end_frequency_hz) - 60.75e9).abs() < 1.0);
        // A wavelength of 4.935 mm divided by four times 2.45 m/s.
        assert!((request.chirp_interval_s - 503.55e-6).abs() < 0.01e-6, "{}", request.chirp_interval_s);
        assert_eq!((request.frame_interval_s, request.sample_rate_hz, request.if_gain_db), (0.2, 1e6, 33.0));
        assert_eq!(frames(&mut reader).len(), 2);
    }
    // Optional keys, for which the SDK has defaults.
    let without_options = SCENE.replace("\"sample_rate_Hz\": 1000000, \"center_frequency_Hz\": 60750000000, ", "");
    write_scene_recording(folder.path(), &without_options, 32, 64);
    let same = Recording::open(folder.path()).expect("opens").waveform().clone();
    assert_eq!((same.request.sample_rate_hz, same.request.start_frequency_hz.round()), (1e6, 60_250_345_903.0));
    write_scene_recording(folder.path(), &SCENE.replace("60750000000", "0"), 32, 64);
    assert_eq!(Recording::open(folder.path()).expect("opens").waveform(), &same);
}

#[test]
fn metrics_and_data_that_contradict_each_other_are_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let refused = |config: &str, chirps: usize, samples: usize| {
        write_scene_recording(folder.path(), config, chirps, samples);
        Recording::open(folder.path()).expect_err("refused").to_string()
    };
    for (chirps, samples) in [(16, 64), (32, 128), (64, 64)] {
        let message = refused(SCENE, chirps, samples);
        assert!(message.contains(&format!("{chirps} chirps x {samples} samples")), "{message}");
        assert!(message.contains("config.json says"), "{message}");
    }
    let message = refused(&SCENE.replace("\"max_speed_m_s\": 2.45, ", ""), 32, 64);
    assert!(message.contains("max_speed_m_s") && message.contains("absent"), "{message}");
    for wrong in ["0", "-1", "1e999"] {
        let message = refused(
            &SCENE.replace("\"range_resolution_m\": 0.15", &format!("\"range_resolution_m\": {wrong}")),
            32,
            64,
        );
        assert!(message.contains("range_resolution_m") || message.contains("not JSON"), "{message}");
    }
    // This resolution needs more bandwidth than the chip has.
    let message = refused(&SCENE.replace("0.15", "0.01"), 32, 1024);
    assert!(message.contains("waveform is impossible"), "{message}");
    let message = refused(&SCENE.replace("fmcw_scene", "doppler_ltr11"), 32, 64);
    assert!(message.contains("fmcw_scene"), "{message}");
}

#[test]
fn the_real_recording_has_its_known_content() {
    let Some(path) = breathing() else { return };
    for path in [path.clone(), path.join("RadarIfxAvian_00")] {
        let mut source = Recording::open(&path).expect("opens");
        assert_eq!(source.frame_count(), Some(256));
        assert_eq!(source.waveform().shape().to_string(), "3 rx x 8 chirps x 64 samples");
        let frames = frames(&mut source);
        assert_eq!(frames.len(), 256);
        let codes = || frames.iter().flat_map(|f| &f.codes);
        assert!(codes().all(|code| (1000..2500).contains(code)));
        for (rx, range) in [(0, 1500.0..1700.0), (1, 1900.0..2000.0), (2, 2000.0..2100.0)] {
            let chirp = frames[100].chirp(rx, 3);
            let mean = chirp.iter().map(|c| f64::from(*c)).sum::<f64>() / 64.0;
            assert!(range.contains(&mean), "rx {rx}: {mean}");
        }
        assert!((frames[255].time_s() - 255.0 * 0.07726884633302689).abs() < 1e-6);
    }
}

#[test]
fn the_real_recording_passes_an_emulated_board_unchanged() {
    let Some(path) = breathing() else { return };
    let original = frames(&mut Recording::open(&path).expect("opens"));
    let options = EmulatorOptions { pace: Pace::AsFastAsRead, ..EmulatorOptions::default() };
    let mut source = EmulatedSource::start(Box::new(Recording::open(&path).expect("opens")), options).expect("starts");
    let received = frames(&mut source);
    assert_eq!(received.len(), 256);
    for (a, b) in original.iter().zip(&received) {
        assert_eq!((a.sequence, &a.codes), (b.sequence, &b.codes));
        assert!(a.time_ns.abs_diff(b.time_ns) < 3000);
    }
}

#[test]
fn old_keys_timestamps_and_temperatures_are_read() {
    let folder = tempfile::tempdir().expect("folder");
    write_old_recording(folder.path());
    let write = |name: &str, bytes: &[u8]| std::fs::write(folder.path().join(name), bytes).expect("writes");
    write("radar_timestamp.csv", b"1650000000.0\n1650000000.09\n1650000000.2\n1650000000.3\n1650000000.41\n");
    write("temperature_timestamp.csv", b"1650000000.05\n1650000000.25\n");
    write("temperature.npy", &npy("<f8", "(2,)", [31.5f64, 32.25].into_iter().flat_map(f64::to_le_bytes)));
    let mut reader = InfineonReader::open(folder.path()).expect("opens");
    let request = &reader.waveform().request;
    assert_eq!((request.start_frequency_hz, request.end_frequency_hz), (60.5e9, 61.5e9));
    assert_eq!(request.rx_antennas.antennas(), [1, 3]);
    let frames = frames(&mut reader);
    assert_eq!(frames.len(), 5);
    assert_eq!(frames[3].codes[0], 3 * FRAME_BYTES as u16 / 2);
    // A Unix time in f64 resolves a quarter of a microsecond.
    assert!(frames[1].time_ns.abs_diff(90_000_000) < 1000);
    let temperatures: Vec<_> = frames.iter().map(|f| f.temperature_millicelsius).collect();
    assert_eq!(temperatures, [None, Some(31_500), Some(31_500), Some(32_250), Some(32_250)]);
}

/// Source of this number of frames.
fn pattern(count: u64) -> Pattern {
    Pattern::new(waveform(&[1, 2, 3], 8, 64, 0.1), count)
}

/// Writes 25 frames at 10 Hz with a gap after the tenth and two labels.
fn record(path: &Path) -> WriteReport {
    let mut source = pattern(25);
    let mut recorder = Recorder::create(path, &RecordingHeader::new(source.waveform.clone())).expect("creates");
    let mut frame = Frame::zeroed(source.waveform.shape());
    while source.next_frame(&mut frame).expect("frame") == SourceEvent::Frame {
        recorder.frame(&frame).expect("records");
        if frame.sequence == 9 {
            recorder.gap(&Gap { first_sequence: 10, frames: 2, reason: GapReason::Crc }).expect("records");
            recorder.label(&label("one", 0.0)).expect("records");
        }
    }
    recorder.label(&label("two", 1.0)).expect("records");
    recorder.finish().expect("finishes")
}

/// Label of one second.
fn label(name: &str, start_s: f64) -> LabelSpan {
    LabelSpan {
        who: Some("test".into()),
        confidence: Some(0.1),
        made_ns: Some(1_767_683_775_123_456_789),
        note: Some("behind the desk".into()),
        ..LabelSpan::new(start_s, start_s + 1.0, name)
    }
}

#[test]
fn a_recorder_reports_what_it_has_written() {
    let (_folder, path) = in_folder("a.mcap");
    let report = record(&path);
    assert_eq!((report.frames, report.gaps, report.frames_lost, report.labels), (25, 1, 2, 2));
    assert_eq!(report.bytes, std::fs::metadata(&path).expect("there").len());
    let labels = McapReader::open(&path).expect("opens").labels().expect("labels");
    assert_eq!(labels, [label("one", 0.0), label("two", 1.0)]);
}

/// Asserts that readers find all labels as soon as they are set during a recording, whatever follows. The finished
/// recording has the last ones.
#[test]
fn labels_set_while_recording_are_found_when_the_call_returns() {
    let (folder, path) = in_folder("a.mcap");
    let mut source = pattern(7);
    let mut recorder = Recorder::create(&path, &RecordingHeader::new(source.waveform.clone())).expect("creates");
    let mut frame = Frame::zeroed(source.waveform.shape());
    let lists = [vec![label("one", 0.0)], vec![label("one", 0.0), label("two", 1.0)], vec![]];
    for list in lists.iter().cycle().take(5) {
        source.next_frame(&mut frame).expect("frame");
        recorder.frame(&frame).expect("records");
        recorder.flush().expect("records");
        recording::mcap::stage_labels(&path, list).expect("stages");
        let mut reader = McapReader::open(&path).expect("opens");
        assert_eq!(&reader.labels().expect("labels"), list);
        assert_eq!(readable(&mut reader).0, frame.sequence + 1);
    }
    let summary = recorder.finish().expect("finishes");
    assert_eq!((summary.frames, summary.labels), (5, 2));
    assert_eq!(McapReader::open(&path).expect("opens").labels().expect("labels"), lists[1]);
    assert_eq!(std::fs::read_dir(folder.path()).expect("lists").count(), 1, "nothing is left beside it");
}

#[test]
fn replay_follows_the_time_stamps() {
    let pattern = Pattern::new(waveform(&[1], 8, 64, 0.1), 5);
    let start = std::time::Instant::now();
    assert_eq!(frames(&mut RealTime::new(pattern, 8.0)).len(), 5);
    assert!(start.elapsed().as_secs_f64() >= 0.4 / 8.0);
}

mod hard_cases {
    use super::*;

    /// Number of readable frames and error of the old recording after an edit.
    fn edited(edit: impl FnOnce(&Path)) -> Result<(u64, Option<SourceError>), RecordingError> {
        let folder = tempfile::tempdir().expect("folder");
        write_old_recording(folder.path());
        edit(folder.path());
        Recording::open(folder.path()).map(|mut source| readable(&mut source))
    }

    /// The same after an edit of the samples' file.
    fn edited_samples(edit: impl FnOnce(&mut Vec<u8>)) -> Result<(u64, Option<SourceError>), RecordingError> {
        edited(|folder| {
            let path = folder.join("radar.npy");
            let mut bytes = std::fs::read(&path).expect("reads");
            edit(&mut bytes);
            std::fs::write(&path, bytes).expect("writes");
        })
    }

    /// Error of a recording.
    fn message(result: Result<(u64, Option<SourceError>), RecordingError>) -> String {
        match result {
            Err(error) => error.to_string(),
            Ok((_, Some(error))) => error.to_string(),
            Ok((count, None)) => panic!("no error after {count} frames"),
        }
    }

    fn assert_contains(text: &str, parts: &[&str]) {
        for part in parts {
            assert!(text.contains(part), "'{part}' is not in: {text}");
        }
    }

    #[test]
    fn a_recording_cut_short_gives_its_whole_frames_and_an_error() {
        let (count, error) = edited_samples(|bytes| bytes.truncate(bytes.len() - FRAME_BYTES - 1)).expect("opens");
        assert_eq!(count, 3);
        assert_contains(&error.expect("error").to_string(), &["radar.npy", "byte 1151", "3 whole frames", "5 were"]);
    }

    #[test]
    fn a_corrupt_header_is_named() {
        for (at, byte) in [(0, b'X'), (6, 9), (9, 0xFF), (10, b'!'), (40, 0xFF)] {
            let text = message(edited_samples(|bytes| bytes[at] = byte));
            assert_contains(&text, &["radar.npy", "at byte"]);
        }
        let text = message(edited_samples(|bytes| bytes.truncate(4)));
        assert_contains(&text, &["radar.npy", "shorter than"]);
    }

    /// Asserts that a header of nested brackets is refused at once. Each level doubles the parser's time (found by
    /// fuzzing).
    #[test]
    fn an_npy_header_of_brackets_is_refused_at_once() {
        for bracket in ["[", "(", "{"] {
            let shape = format!("({}", bracket.repeat(40));
            let text = message(edited_samples(|bytes| *bytes = npy("<u2", &shape, [])));
            assert_contains(&text, &["radar.npy", "brackets within brackets"]);
        }
    }

    #[test]
    fn configuration_and_data_that_disagree_are_both_named() {
        let replace = |from: &str, to: &str| {
            let text = CONFIG.replace(from, to);
            assert_ne!(text, CONFIG);
            message(edited(|folder| std::fs::write(folder.join("config.json"), text).expect("writes")))
        };
        let text = replace("\"num_chirps_per_frame\": 4", "\"num_chirps_per_frame\": 8");
        assert_contains(&text, &["radar.npy", "config.json", "2 rx x 4 chirps x 16", "2 rx x 8 chirps x 16"]);
        let text = replace("[1, 3]", "[1, 2, 3]");
        assert_contains(&text, &["2 rx", "3 rx"]);
        assert_contains(&replace("[1, 3]", "[1, 1]"), &["rx_antennas", "[1, 1]"]);
        assert_contains(&replace("[1, 3]", "[1, 2.5]"), &["rx_antennas", "list of antenna numbers"]);
        assert_contains(&replace("\"tx_power_level\": 31", "\"tx_power_level\": \"nan\""), &["tx_power_level", "nan"]);
        assert_contains(&replace("\"if_gain_dB\": 23", "\"gain\": 23"), &["`if_gain_dB`", "is absent"]);
        assert_contains(&replace("60.5e9", "\"many\""), &["lower_frequency_Hz", "many"]);
        assert_contains(&replace("61.5e9", "90e9"), &["config.json", "impossible"]);
        assert_contains(&replace("}}}", "}}"), &["config.json", "not JSON"]);
    }

    #[test]
    fn codes_beyond_twelve_bits_are_refused_with_their_position() {
        let text = message(edited_samples(|bytes| bytes[128 + FRAME_BYTES + 5] = 0x10));
        assert_contains(&text, &["at byte 388", "frame 1", "4095"]);
    }

    #[test]
    fn other_versions_and_missing_files_are_named() {
        let version = |text: &'static str| {
            message(edited(move |folder| std::fs::write(folder.join("format.version"), text).expect("writes")))
        };
        assert_contains(&version("2.0.0"), &["format.version", "2.0.0", "1.0.0", "update"]);
        assert_contains(&version("hello"), &["format.version", "hello"]);
        for file in ["config.json", "format.version", "radar.npy"] {
            let text = message(edited(|folder| std::fs::remove_file(folder.join(file)).expect("removes")));
            assert_contains(&text, &[file, "no such file"]);
        }
        let folder = tempfile::tempdir().expect("folder");
        assert!(matches!(Recording::open(folder.path()), Err(RecordingError::Unknown { .. })));
        assert!(matches!(Recording::open(&folder.path().join("x")), Err(RecordingError::Missing { .. })));
        let other = folder.path().join("a.wav");
        std::fs::write(&other, b"RIFF....WAVE").expect("writes");
        assert!(matches!(Recording::open(&other), Err(RecordingError::Unknown { .. })));
    }

    /// Asserts that a wrong length in the middle of a finished file is not taken for its end (found by fuzzing).
    #[test]
    fn a_wrong_length_is_no_end() {
        let (_folder, path) = in_folder("a.mcap");
        record(&path);
        let mut bytes = std::fs::read(&path).expect("reads");
        let (last, _) = *chunks(&bytes).last().expect("chunks");
        bytes[last + 7] = 0x40;
        std::fs::write(&path, bytes).expect("writes");
        let (count, error) = readable(&mut McapReader::open(&path).expect("opens"));
        assert!(count < 25);
        assert_contains(&error.expect("damaged").to_string(), &["a.mcap", &format!("at byte {last}"), "was finished"]);
    }

    #[test]
    fn a_damaged_chunk_is_an_error_with_its_position() {
        let (_folder, path) = in_folder("a.mcap");
        record(&path);
        let mut bytes = std::fs::read(&path).expect("reads");
        let middle = bytes.len() / 2;
        bytes[middle] ^= 0x10;
        std::fs::write(&path, bytes).expect("writes");
        let (_, error) = readable(&mut McapReader::open(&path).expect("opens"));
        assert_contains(&error.expect("damaged").to_string(), &["a.mcap", "at byte", "chunk is damaged"]);
    }

    #[test]
    fn a_frame_of_another_shape_is_not_recorded() {
        let folder = tempfile::tempdir().expect("folder");
        let source = pattern(1);
        let path = folder.path().join("a.mcap");
        let mut recorder = Recorder::create(&path, &RecordingHeader::new(source.waveform.clone())).expect("creates");
        let frame = Frame::zeroed(waveform(&[1], 8, 64, 0.1).shape());
        let text = recorder.frame(&frame).expect_err("refused").to_string();
        assert_contains(&text, &["1 rx x 8 chirps x 64", "3 rx x 8 chirps x 64"]);
    }
}
