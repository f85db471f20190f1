//! Round trips through the vendor's formats: supported content is preserved exactly, and unsupported content is
//! reported.

use std::path::Path;

use proptest::prelude::*;
use radome_driver::recording::infineon::{self, InfineonReader};
use radome_driver::recording::{Existing, Format, Recording, RecordingError, RecordingWriter, WriteReport, mcap};
use radome_driver::{LabelSpan, McapReader, Recorder, RecordingHeader};
use radome_dsp::{Frame, FrameSource, Gap, GapReason, Occupancy, SourceEvent, Truth, Waveform, WaveformRequest};

use crate::common::{self, cases, in_folder, make_pipe, waveform};

fn read(path: &Path) -> (Waveform, Vec<Frame>) {
    let mut source = Recording::open(path).expect("opens");
    let (frames, gaps, error) = common::read(&mut source);
    assert!(gaps.is_empty() && error.is_none(), "{gaps:?}, {error:?}");
    assert_eq!(source.frame_count(), Some(frames.len() as u64));
    (source.waveform().clone(), frames)
}

fn write(path: &Path, format: Format, waveform: &Waveform, frames: &[Frame]) -> WriteReport {
    let mut writer = RecordingWriter::create(path, format, &RecordingHeader::new(waveform.clone())).expect("creates");
    frames.iter().for_each(|frame| writer.frame(frame).expect("writes"));
    writer.finish().expect("finishes")
}

/// Frames at the nominal times of a simulation.
fn simulated(waveform: &Waveform, count: u64, seed: u64) -> Vec<Frame> {
    let frame = |sequence: u64| {
        let mut frame = Frame::zeroed(waveform.shape());
        for (i, code) in frame.codes.iter_mut().enumerate() {
            *code = ((i as u64 + 7 * sequence + seed).wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 52) as u16;
        }
        frame.sequence = sequence;
        frame.time_ns = waveform.frame_time_ns(sequence);
        frame
    };
    (0..count).map(frame).collect()
}

fn waveforms() -> impl Strategy<Value = Waveform> {
    let antennas = prop::sample::select(vec![vec![1], vec![2, 3], vec![1, 2, 3]]);
    (antennas, 1..9usize, 8..40usize, 0.05..0.3, 58e9..60e9, 1e9..3.5e9).prop_filter_map(
        "realisable",
        |(antennas, chirps, samples, frame_interval_s, start_frequency_hz, bandwidth_hz)| {
            let mut request = waveform(&antennas, chirps, samples, 0.1).request;
            request.frame_interval_s = frame_interval_s;
            request.start_frequency_hz = start_frequency_hz;
            request.end_frequency_hz = start_frequency_hz + bandwidth_hz;
            Waveform::realise(WaveformRequest { sample_rate_hz: 2e6, ..request }).ok()
        },
    )
}

proptest! {
    #![proptest_config(cases(48))]

    #[test]
    fn the_folder_preserves_all_content(
        waveform in waveforms(),
        seed in any::<u64>(),
        steps in prop::collection::vec((1..3_000_000_000u64, prop::option::of(-40_000..125_000i32)), 0..12),
        start_ns in 0..1_000_000_000u64,
    ) {
        let (folder, path) = in_folder("session");
        let mut frames = simulated(&waveform, steps.len() as u64, seed);
        let (mut now, mut known) = (start_ns, None);
        for (frame, (step, temperature)) in frames.iter_mut().zip(steps) {
            frame.time_ns = now;
            now += step;
            // A temperature holds until the next measurement.
            known = temperature.or(known);
            frame.temperature_millicelsius = known;
        }
        let report = write(&path, Format::Infineon, &waveform, &frames);
        prop_assert_eq!((report.frames, report.omitted), (frames.len() as u64, vec![]));
        prop_assert_eq!(read(&path), (waveform, frames));
        prop_assert_eq!(std::fs::read_dir(folder.path()).expect("lists").count(), 1);
    }

    #[test]
    fn the_native_file_preserves_all_content(
        waveform in waveforms(),
        seed in any::<u64>(),
        finish in any::<bool>(),
        items in prop::collection::vec((any::<[u64; 3]>(), any::<Option<i32>>(), 0..9usize, any::<bool>()), 0..30),
    ) {
        let (_folder, path) = in_folder("a.mcap");
        let mut recorder = Recorder::create(&path, &RecordingHeader::new(waveform.clone())).expect("creates");
        let (mut events, mut labels) = (Vec::new(), Vec::new());
        for (mut frame, ([sequence, time_ns, host_time_ns], temperature, kind, transition)) in
            simulated(&waveform, items.len() as u64, seed).into_iter().zip(items)
        {
            match kind {
                7 => {
                    let gap = Gap { first_sequence: sequence, frames: time_ns, reason: GapReason::PacketLost };
                    recorder.gap(&gap).expect("records");
                    events.push(Err(gap));
                }
                8 => {
                    let mut label = LabelSpan::new(time_ns as f64 * 1e-9, host_time_ns as f64 * 1e-9, "één");
                    (label.made_ns, label.note) = (Some(sequence), transition.then(|| "\u{0}\"".into()));
                    recorder.label(&label).expect("records");
                    labels.push(label);
                }
                _ => {
                    (frame.sequence, frame.time_ns, frame.host_time_ns) = (sequence, time_ns, host_time_ns);
                    frame.temperature_millicelsius = temperature;
                    frame.truth = Occupancy::from_index(kind).map(|occupancy| Truth { occupancy, transition });
                    recorder.frame(&frame).expect("records");
                    events.push(Ok(frame));
                }
            }
        }
        if finish {
            recorder.finish().expect("finishes");
        } else {
            drop(recorder);
        }
        let mut reader = McapReader::open(&path).expect("opens");
        prop_assert_eq!(reader.is_complete(), finish);
        prop_assert_eq!(reader.labels().expect("labels"), labels);
        prop_assert_eq!(reader.frame_count(), Some(events.iter().filter(|e| e.is_ok()).count() as u64));
        prop_assert_eq!(reader.waveform(), &waveform);
        for event in events {
            let mut frame = Frame::zeroed(waveform.shape());
            match (reader.next_frame(&mut frame).expect("reads"), event) {
                (SourceEvent::Frame, Ok(expected)) => prop_assert_eq!(frame, expected),
                (SourceEvent::Gap(gap), Err(expected)) => prop_assert_eq!(gap, expected),
                other => prop_assert!(false, "{:?}", other),
            }
        }
        let mut frame = Frame::zeroed(waveform.shape());
        prop_assert_eq!(reader.next_frame(&mut frame).expect("reads"), SourceEvent::End);
    }

    #[test]
    fn the_text_file_preserves_samples_and_waveform(waveform in waveforms(), seed in any::<u64>(), count in 0..6u64) {
        let (_folder, path) = in_folder("session.txt");
        let frames = simulated(&waveform, count, seed);
        let report = write(&path, Format::Text, &waveform, &frames);
        prop_assert_eq!((report.frames, report.omitted), (count, vec![]));
        let with_crlf = std::fs::read_to_string(&path).expect("text").replace('\n', "\r\n");
        prop_assert_eq!(read(&path), (waveform.clone(), frames.clone()));
        std::fs::write(&path, with_crlf).expect("writes");
        prop_assert_eq!(read(&path), (waveform, frames));
    }
}

#[test]
fn text_has_the_layout_of_the_vendor() {
    let (folder, path) = in_folder("session.txt");
    let waveform = waveform(&[1, 3], 2, 8, 0.1);
    let mut frame = Frame::zeroed(waveform.shape());
    frame.codes = (0..32).map(|i| i * 132).collect();
    write(&path, Format::Text, &waveform, &[frame]);
    let text = std::fs::read_to_string(&path).expect("text");
    let lines: Vec<_> = text.lines().collect();
    assert_eq!(lines.len(), 2 * 2 * (8 + 1));
    for (index, line) in lines.iter().enumerate() {
        let (chirp, sample) = (index / 9, index % 9);
        let code = 132.0 * (chirp * 8 + sample) as f64;
        assert_eq!(*line, if sample == 8 { String::new() } else { format!("{:.6}", code / 4095.0) });
    }
    assert!(folder.path().join("session.txt_config.json").exists());
}

#[test]
fn the_folder_has_the_vendors_files_and_keys() {
    let (_folder, path) = in_folder("session");
    let waveform = waveform(&[1, 2, 3], 4, 16, 0.1);
    write(&path, Format::Infineon, &waveform, &simulated(&waveform, 3, 1));
    let radar = path.join("RadarIfxAvian_00");
    let mut names: Vec<_> = std::fs::read_dir(&radar).expect("lists").flatten().map(|e| e.file_name()).collect();
    names.sort();
    assert_eq!(names, ["config.json", "format.version", "meta.json", "radar.npy"]);
    assert_eq!(std::fs::read_to_string(radar.join("format.version")).expect("reads"), "1.0.0\n");
    let config = std::fs::read_to_string(radar.join("config.json")).expect("reads");
    let keys: Vec<_> = config.lines().filter_map(|l| l.trim().strip_prefix('"')?.split('"').next()).collect();
    let expected = "device_config fmcw_single_shape aaf_cutoff_Hz chirp_repetition_time_s end_frequency_Hz \
        frame_repetition_time_s hp_cutoff_Hz if_gain_dB mimo_mode num_chirps_per_frame num_samples_per_chirp \
        rx_antennas sample_rate_Hz start_frequency_Hz tx_antennas tx_power_level";
    assert_eq!(keys.join(" "), expected.split_whitespace().collect::<Vec<_>>().join(" "));
    let npy = std::fs::read(radar.join("radar.npy")).expect("reads");
    assert_eq!(npy.len(), 1024 + 3 * 3 * 4 * 16 * 2);
    let header = npyz::NpyFile::new(npy.as_slice()).expect("an array");
    assert_eq!(header.shape(), [3, 3, 4, 16]);
    assert!(path.join("meta.json").exists());
}

/// Regression test: the host's intervals were written, so that 3 s of an emulated board that sends faster than in real time became
/// 0.1 s.
#[test]
fn the_host_dates_the_first_frame_and_the_board_gives_the_intervals() {
    let (_folder, path) = in_folder("session");
    let waveform = waveform(&[1], 2, 8, 0.1);
    let mut frames = simulated(&waveform, 4, 1);
    for frame in &mut frames {
        frame.host_time_ns = 1_767_683_775_123_456_789 + frame.time_ns / 26;
    }
    let report = write(&path, Format::Infineon, &waveform, &frames);
    assert_eq!(
        report.omitted,
        ["times by the host's clock, except that of the first frame (intervals are the board's)"]
    );
    let (_, back) = read(&path);
    for (a, b) in frames.iter().zip(&back) {
        assert_eq!((b.host_time_ns, b.time_ns), (1_767_683_775_123_456_789 + a.time_ns, a.time_ns));
    }
    let meta = std::fs::read_to_string(path.join("meta.json")).expect("reads");
    assert!(meta.contains("\"date_captured\": \"2026-01-06T07:16:15+0000\""), "{meta}");
}

/// Regression test: when the host's clock was set forwards, a recording of a second became one of a day.
#[test]
fn if_the_clock_of_the_host_was_set_the_times_are_the_boards() {
    let folder = tempfile::tempdir().expect("folder");
    let waveform = waveform(&[1], 2, 8, 0.1);
    let day_ns: i64 = 86_400_000_000_000;
    for (name, set_ns) in [("forwards", day_ns), ("backwards", -day_ns)] {
        let path = folder.path().join(name);
        let mut frames = simulated(&waveform, 4, 1);
        for frame in &mut frames {
            frame.time_ns += 7 * frame.sequence;
            let at_ns = 1_767_683_775_000_000_000 + frame.time_ns;
            frame.host_time_ns = if frame.sequence < 2 { at_ns } else { at_ns.saturating_add_signed(set_ns) };
        }
        let report = write(&path, Format::Infineon, &waveform, &frames);
        assert!(report.omitted.iter().any(|what| what.contains("the host's clock")), "{name}: {:?}", report.omitted);
        let (_, back) = read(&path);
        let times = |frames: &[Frame]| frames.iter().map(|frame| frame.time_ns).collect::<Vec<_>>();
        assert_eq!(times(&back), times(&frames), "{name}");
    }
}

/// Regression test: the first time of a recording became 0 without a report, for example after a repair without the first chunk.
#[test]
fn a_changed_time_of_the_first_frame_is_reported() {
    let (_folder, path) = in_folder("session");
    let waveform = waveform(&[1], 2, 8, 0.1);
    let mut frames = simulated(&waveform, 4, 1);
    for frame in &mut frames {
        frame.time_ns += 1_200_000_000;
        frame.host_time_ns = 1_767_683_775_000_000_000 + frame.time_ns;
    }
    let report = write(&path, Format::Infineon, &waveform, &frames);
    assert_eq!(report.omitted, ["the time of the first frame, 1.2 s (readers count from 0 s)"]);
    assert_eq!((report.time_shift_ns, read(&path).1[0].time_ns), (1_200_000_000, 0));
}

/// Asserts that the report has the largest change of a time. A text recording closes gaps, which moves all frames
/// behind them.
#[test]
fn the_report_has_the_largest_change_of_times() {
    let folder = tempfile::tempdir().expect("folder");
    let waveform = waveform(&[1], 2, 8, 0.1);
    let mut frames = simulated(&waveform, 4, 1);
    frames.remove(1);
    let shifts = [(Format::Infineon, "session", 0), (Format::Text, "session.txt", 100_000_000)];
    for (format, name, shift_ns) in shifts {
        let path = folder.path().join(name);
        let report = write(&path, format, &waveform, &frames);
        let moved = frames.iter().zip(read(&path).1).map(|(frame, back)| frame.time_ns.abs_diff(back.time_ns)).max();
        assert_eq!((report.time_shift_ns, moved), (shift_ns, Some(shift_ns)), "{name}");
        let is_reported = report.omitted.iter().any(|what| what == "the times of the frames");
        assert_eq!(is_reported, shift_ns > 0, "{:?}", report.omitted);
    }
}

/// Regression test: frames without a temperature got the last one before them without a report.
#[test]
fn frames_without_a_temperature_are_counted() {
    let (_folder, path) = in_folder("session");
    let waveform = waveform(&[1], 2, 8, 0.1);
    let mut frames = simulated(&waveform, 4, 1);
    frames[1].temperature_millicelsius = Some(25_000);
    let report = write(&path, Format::Infineon, &waveform, &frames);
    assert_eq!(report.omitted, ["frames without a temperature: 2 (readers take the last one before)"]);
    let temperatures: Vec<_> = read(&path).1.iter().map(|frame| frame.temperature_millicelsius).collect();
    assert_eq!(temperatures, [None, Some(25_000), Some(25_000), Some(25_000)]);
}

/// Regression test: the interval that a board's registers realise became the requested one without a report, which changes all
/// speeds.
#[test]
fn a_changed_chirp_interval_is_reported() {
    let folder = tempfile::tempdir().expect("folder");
    let mut waveform = waveform(&[1], 2, 8, 0.1);
    waveform.chirp_interval_s = 501e-6;
    for (name, format) in [("session", Format::Infineon), ("session.txt", Format::Text)] {
        let path = folder.path().join(name);
        let report = write(&path, format, &waveform, &simulated(&waveform, 2, 1));
        let omitted = ["the chirp interval of 501.0000 us (readers take 500.0000 us)"];
        assert_eq!(report.omitted, omitted, "{name}");
        assert!((read(&path).0.chirp_interval_s - 500e-6).abs() < 1e-12, "{name}");
    }
}

#[test]
fn unsupported_content_is_named() {
    let folder = tempfile::tempdir().expect("folder");
    let waveform = waveform(&[1], 2, 8, 0.1);
    let label = LabelSpan::new(0.0, 1.0, Occupancy::One.name());
    for (name, format) in [("session", Format::Infineon), ("session.txt", Format::Text)] {
        let path = folder.path().join(name);
        assert_eq!(Format::of_output(&path), Some(format));
        let header = RecordingHeader::new(waveform.clone());
        let mut writer = RecordingWriter::create(&path, format, &header).expect("creates");
        let mut frame = Frame::zeroed(waveform.shape());
        frame.truth = Some(Truth { occupancy: Occupancy::One, transition: false });
        writer.frame(&frame).expect("writes");
        writer.gap(&Gap { first_sequence: 1, frames: 4, reason: GapReason::Crc }).expect("counted");
        writer.label(&label).expect("counted");
        frame.sequence = 5;
        frame.time_ns = 500_000_000;
        writer.frame(&frame).expect("writes");
        let report = writer.finish().expect("finishes");
        assert_eq!((report.frames, report.gaps, report.frames_lost), (2, 1, 4));
        let omitted = report.omitted.join("; ");
        for part in ["1 gap, lost frames: 4", "numbers of the frames", "truth of 2 frames", "1 label"] {
            assert!(omitted.contains(part), "'{part}' is not in: {omitted}");
        }
    }
}

mod hard_cases {
    use super::*;

    /// Regression test: opening a recording that is a pipe waited without end. One that a shell substitutes was reported as no MCAP
    /// file, because its first bytes had been read before.
    #[test]
    fn a_pipe_is_refused_at_once() {
        let folder = tempfile::tempdir().expect("folder");
        let path = folder.path().join("pipe.mcap");
        make_pipe(&path);
        let repaired = mcap::repair(&path, &folder.path().join("out.mcap"), Existing::Refuse);
        for error in [Recording::open(&path).expect_err("a pipe"), repaired.expect_err("a pipe")] {
            assert!(matches!(error, RecordingError::NotRegular { .. }), "{error}");
            let message = error.to_string();
            assert!(message.contains("pipe.mcap: not a regular file") && message.contains("hint: "), "{message}");
        }
    }

    /// Regression test: reading waited without end if a file of a folder was a pipe, and a file of any length was read into
    /// memory.
    #[test]
    fn files_of_a_folder_that_are_pipes_or_too_long_are_refused_at_once() {
        let waveform = waveform(&[1], 2, 8, 0.1);
        let mut frames = simulated(&waveform, 3, 1);
        frames[1].temperature_millicelsius = Some(25_000);
        // meta.json is not read.
        for name in infineon::FILES.into_iter().filter(|name| *name != "meta.json") {
            for is_pipe in [true, false] {
                let (_folder, path) = in_folder("session");
                write(&path, Format::Infineon, &waveform, &frames);
                let file = path.join("RadarIfxAvian_00").join(name);
                std::fs::remove_file(&file).expect("was written");
                match is_pipe {
                    true => make_pipe(&file),
                    // The file has no data and takes no space on the disk.
                    false => {
                        std::fs::File::create(&file).and_then(|file| file.set_len((1 << 30) + 1)).expect("creates")
                    }
                }
                let message = Recording::open(&path).expect_err(name).to_string();
                assert!(message.contains(name), "{name}, {is_pipe}: {message}");
            }
        }
    }

    /// Regression test: reading waited without end if the labels beside a recording were a pipe.
    #[test]
    fn labels_beside_a_recording_that_are_a_pipe_are_refused_at_once() {
        let (folder, path) = in_folder("a.mcap");
        let waveform = waveform(&[1], 2, 8, 0.1);
        write(&path, Format::Mcap, &waveform, &simulated(&waveform, 3, 1));
        make_pipe(&folder.path().join(".a.mcap.labels"));
        assert_eq!(read(&path).1.len(), 3);
        let error = McapReader::open(&path).expect("opens").labels().expect_err("a pipe");
        assert!(matches!(error, RecordingError::NotRegular { .. }), "{error}");
    }

    /// Regression test: a recorder waited for the reader of a pipe and ignored signals meanwhile.
    #[test]
    fn a_pipe_without_a_reader_is_refused_at_once() {
        let folder = tempfile::tempdir().expect("folder");
        let (path, copy) = (folder.path().join("pipe.mcap"), folder.path().join("copy.mcap"));
        make_pipe(&path);
        let waveform = waveform(&[1], 2, 8, 0.1);
        let header = RecordingHeader::new(waveform.clone());
        let error = Recorder::create(&path, &header).err().expect("nobody reads");
        assert!(matches!(error, RecordingError::NoReader { .. }), "{error}");
        assert!(error.to_string().contains("hint: "), "{error}");
        let frames = simulated(&waveform, 3, 1);
        let reader = {
            let path = path.clone();
            std::thread::spawn(move || std::fs::read(path))
        };
        let mut recorder = loop {
            match Recorder::create(&path, &header) {
                // The reader has not opened the pipe yet.
                Err(RecordingError::NoReader { .. }) => std::thread::yield_now(),
                created => break created.expect("creates"),
            }
        };
        frames.iter().for_each(|frame| recorder.frame(frame).expect("writes"));
        recorder.finish().expect("finishes");
        std::fs::write(&copy, reader.join().expect("no panic").expect("reads")).expect("writes");
        assert_eq!(read(&copy).1.len(), 3);
    }

    #[test]
    fn an_interrupted_writer_leaves_no_complete_recording() {
        let folder = tempfile::tempdir().expect("folder");
        let waveform = waveform(&[1], 2, 8, 0.1);
        let header = RecordingHeader::new(waveform.clone());
        for (name, format) in [("a", Format::Infineon), ("a.txt", Format::Text), ("a.mcap", Format::Mcap)] {
            let path = folder.path().join(name);
            let mut writer = RecordingWriter::create(&path, format, &header).expect("creates");
            simulated(&waveform, 5, 1).iter().for_each(|frame| writer.frame(frame).expect("writes"));
            // State of the files after the program was killed.
            let partial = folder.path().join(format!(".{name}.partial"));
            assert!(!path.exists() && partial.exists());
            if format != Format::Mcap {
                assert!(Recording::open(&partial).is_err());
            }
            // State of the files after a failure.
            drop(writer);
            assert_eq!(std::fs::read_dir(folder.path()).expect("lists").count(), 0);
        }
    }

    #[test]
    fn a_folder_with_content_is_not_changed() {
        let (_folder, path) = in_folder("mine");
        std::fs::create_dir(&path).expect("creates");
        let header = RecordingHeader::new(waveform(&[1], 2, 8, 0.1));
        RecordingWriter::create(&path, Format::Infineon, &header).expect("an empty folder may be filled");
        std::fs::write(path.join("thesis.tex"), "x").expect("writes");
        let error = RecordingWriter::create(&path, Format::Infineon, &header).err().expect("refused").to_string();
        assert!(error.contains("mine") && error.contains("not empty"), "{error}");
        assert!(path.join("thesis.tex").exists());
    }

    /// Regression test: the error was "Not a directory", and came only after all frames had been converted.
    #[test]
    fn a_file_in_the_place_of_a_folder_is_refused_before_any_frame() {
        let folder = tempfile::tempdir().expect("folder");
        let path = folder.path().join("mine");
        std::fs::write(&path, "x").expect("writes");
        let header = RecordingHeader::new(waveform(&[1], 2, 8, 0.1));
        let error = RecordingWriter::create(&path, Format::Infineon, &header).err().expect("refused");
        assert!(matches!(error, RecordingError::Occupied { .. }), "{error}");
        assert_eq!(std::fs::read(&path).expect("reads"), b"x");
        assert_eq!(std::fs::read_dir(folder.path()).expect("lists").count(), 1);
    }

    #[test]
    fn the_error_of_a_cut_or_damaged_text_file_names_the_position() {
        let (folder, path) = in_folder("a.txt");
        let waveform = waveform(&[1], 2, 8, 0.1);
        write(&path, Format::Text, &waveform, &simulated(&waveform, 3, 1));
        let whole = std::fs::read(&path).expect("reads");
        let frame_bytes = whole.len() / 3;
        let message = |bytes: &[u8]| {
            std::fs::write(&path, bytes).expect("writes");
            match Recording::open(&path) {
                Ok(mut source) => {
                    let (frames, _, error) = common::read(&mut source);
                    (frames.len(), error.map_or("whole".into(), |error| error.to_string()))
                }
                Err(error) => (0, error.to_string()),
            }
        };
        let (count, said) = message(&whole[..whole.len() - 1]);
        assert!(count == 2 && said.contains("cut short") && said.contains("2 whole frames"), "{count}: {said}");
        for (at, byte) in [(3, b'x'), (8, b'0'), (frame_bytes - 1, b'0')] {
            let mut bytes = whole.clone();
            bytes[frame_bytes + at] = byte;
            let (count, said) = message(&bytes);
            let line = frame_bytes + if at == frame_bytes - 1 { at } else { 0 };
            assert!(count == 1 && said.contains(&format!("at byte {line}:")), "{count}: {said}");
        }
        assert!(message(b"hello\n").1.contains("first line"));
        assert_eq!(message(b""), (0, "whole".into()));
        std::fs::remove_file(folder.path().join("a.txt_config.json")).expect("removes");
        assert!(message(&whole).1.contains("not a recording"));
    }

    proptest! {
        #![proptest_config(cases(128))]

        #[test]
        fn any_bytes_are_refused_or_read(
            bytes in prop::collection::vec(any::<u8>(), 0..600),
            at in any::<prop::sample::Index>(),
            which in 0..6usize,
        ) {
            let folder = tempfile::tempdir().expect("folder");
            let waveform = waveform(&[1], 2, 8, 0.1);
            let mut frames = simulated(&waveform, 3, 1);
            frames[1].temperature_millicelsius = Some(25_000);
            let path = folder.path().join(["a", "a.txt"][which / 5]);
            write(&path, [Format::Infineon, Format::Text][which / 5], &waveform, &frames);
            let file = [
                "a/RadarIfxAvian_00/radar.npy",
                "a/RadarIfxAvian_00/config.json",
                "a/RadarIfxAvian_00/radar_timestamp.csv",
                "a/RadarIfxAvian_00/temperature.npy",
                "a/RadarIfxAvian_00/format.version",
                "a.txt",
            ][which];
            let file = folder.path().join(file);
            let whole = std::fs::read(&file).expect("reads");
            let start = at.index(whole.len());
            let changed = [&whole[..start], &bytes, &whole[(start + bytes.len()).min(whole.len())..]].concat();
            for content in [bytes, changed] {
                std::fs::write(&file, content).expect("writes");
                let Ok(mut source) = Recording::open(&path) else { continue };
                let mut frame = Frame::zeroed(source.waveform().shape());
                let _ = source.seek_time_s(0.1);
                while source.next_frame(&mut frame).is_ok_and(|event| event != SourceEvent::End) {}
            }
        }
    }

    #[test]
    fn time_stamps_may_have_exponents_and_malformed_ones_are_left_out() {
        let (_folder, path) = in_folder("a");
        let waveform = waveform(&[1], 2, 8, 0.1);
        let mut frames = simulated(&waveform, 2, 1);
        frames[0].time_ns = 5;
        write(&path, Format::Infineon, &waveform, &frames);
        let stamps = path.join("RadarIfxAvian_00/radar_timestamp.csv");
        assert_eq!(std::fs::read_to_string(&stamps).expect("reads"), "0.000000005\n0.100000000\n");
        std::fs::write(&stamps, "1e-1\n+2.5\n").expect("writes");
        assert_eq!(read(&path).1.iter().map(|f| f.time_ns).collect::<Vec<_>>(), [100_000_000, 2_500_000_000]);
        std::fs::write(&stamps, "1\n\nnoon\n").expect("writes");
        let reader = InfineonReader::open(&path).expect("opens");
        assert!(reader.left_out()[0].contains("line 3: 'noon'"), "{:?}", reader.left_out());
        for wrong in ["1\n0\n", "-1\n2\n", "nan\n2\n", "1\n", "1\n2\n3\n", "1\n99999999999999999999\n", "..\n2\n"] {
            std::fs::write(&stamps, wrong).expect("writes");
            let reader = InfineonReader::open(&path).expect("opens");
            let [reason] = reader.left_out() else { panic!("{wrong}: {:?}", reader.left_out()) };
            assert!(reason.contains("radar_timestamp.csv"), "{reason}");
            assert_eq!(read(&path).1.iter().map(|f| f.time_ns).collect::<Vec<_>>(), [0, 100_000_000], "{wrong}");
        }
    }

    /// Regression test: a damaged file of temperatures made all frames unreadable.
    #[test]
    fn unreadable_temperatures_are_left_out_and_frames_are_not() {
        let (_folder, path) = in_folder("a");
        let waveform = waveform(&[1], 2, 8, 0.1);
        let mut frames = simulated(&waveform, 3, 1);
        frames[1].temperature_millicelsius = Some(25_000);
        frames[2].temperature_millicelsius = Some(25_000);
        write(&path, Format::Infineon, &waveform, &frames);
        let file = path.join("RadarIfxAvian_00/temperature.npy");
        let whole = std::fs::read(&file).expect("reads");
        let kind = whole.windows(3).position(|bytes| bytes == b"<f8").expect("a type");
        let replace = |at: usize, bytes: &[u8]| [&whole[..at], bytes, &whole[at + bytes.len()..]].concat();
        for (damaged, expected_reason) in [
            (b"NUMPY".to_vec(), "shorter than an NPY header"),
            (replace(1, b"n"), "not an NPY file"),
            (replace(kind, b"<i8"), "temperatures are of type '<i8'"),
        ] {
            std::fs::write(&file, damaged).expect("writes");
            let reader = InfineonReader::open(&path).expect("opens");
            let [reason] = reader.left_out() else { panic!("{expected_reason}: {:?}", reader.left_out()) };
            assert!(reason.contains("temperature.npy") && reason.contains(expected_reason), "{reason}");
            for (back, frame) in read(&path).1.iter().zip(&frames) {
                assert_eq!((&back.codes, back.time_ns), (&frame.codes, frame.time_ns), "{expected_reason}");
                assert_eq!(back.temperature_millicelsius, None, "{expected_reason}");
            }
        }
    }

    /// Regression test: a wrong time stamp removed all temperatures without a report.
    #[test]
    fn temperatures_without_times_of_the_frames_are_reported_as_left_out() {
        let (_folder, path) = in_folder("a");
        let waveform = waveform(&[1], 2, 8, 0.1);
        let mut frames = simulated(&waveform, 2, 1);
        frames.iter_mut().for_each(|frame| frame.temperature_millicelsius = Some(25_000));
        write(&path, Format::Infineon, &waveform, &frames);
        let stamps = path.join("RadarIfxAvian_00/radar_timestamp.csv");
        std::fs::write(&stamps, "0\nnoon\n").expect("writes");
        let reader = InfineonReader::open(&path).expect("opens");
        let [times, temperatures] = reader.left_out() else { panic!("{:?}", reader.left_out()) };
        assert!(times.contains("radar_timestamp.csv") && temperatures.contains("temperature.npy"), "{temperatures}");
        std::fs::remove_file(&stamps).expect("removes");
        let reader = InfineonReader::open(&path).expect("opens");
        let [temperatures] = reader.left_out() else { panic!("{:?}", reader.left_out()) };
        assert!(temperatures.contains("temperature.npy"), "{temperatures}");
    }
}
