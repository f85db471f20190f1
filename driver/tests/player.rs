//! Tests of playback of a recording, and of labels that are set in a finished recording.

use std::path::Path;

use radome_driver::recording::{Existing, Recording, mcap as native};
use radome_driver::{LabelSpan, McapReader, Player, Recorder, RecordingError, RecordingHeader, Transport};
use radome_dsp::{Frame, FrameSource, Gap, GapReason, SourceEvent};

use crate::common::{Pattern, in_folder, read, waveform};

/// Records 40 frames at 10 Hz, with numbers 10 to 19 missing.
fn record(path: &Path) {
    let mut source = Pattern::new(waveform(&[1, 2], 8, 64, 0.1), 40);
    source.gap = Some(Gap { first_sequence: 10, frames: 10, reason: GapReason::PacketLost });
    crate::common::record(source, &LabelSpan::new(0.0, 0.5, "empty"), path);
}

struct Tape {
    player: Player,
    keys: Transport,
    frame: Frame,
    _folder: tempfile::TempDir,
}

impl Tape {
    fn new(speed: f64) -> Tape {
        let (folder, path) = in_folder("a.mcap");
        record(&path);
        let player = Player::new(Recording::open(&path).expect("opens"), speed).expect("reads").expect("frames");
        let frame = Frame::zeroed(player.waveform().shape());
        Tape { keys: player.transport(), player, frame, _folder: folder }
    }

    fn next(&mut self) -> u64 {
        while let SourceEvent::Gap(_) = self.player.next_frame(&mut self.frame).expect("no fault") {}
        self.frame.sequence
    }
}

#[test]
fn keys_lead_to_the_frame_that_is_meant() {
    let mut tape = Tape::new(0.0);
    let extent = tape.player.extent();
    assert_eq!((extent.first.sequence, extent.last.sequence), (0, 39));
    assert!((extent.last.time_s() - 3.9).abs() < 1e-9);
    assert_eq!([tape.next(), tape.next()], [0, 1]);
    tape.keys.pause();
    tape.keys.seek_frame(30);
    assert_eq!(tape.next(), 30);
    tape.keys.step(2);
    assert_eq!([tape.next(), tape.next()], [31, 32]);
    tape.keys.step(-1);
    assert_eq!(tape.next(), 31);
    tape.keys.seek_time_s(2.01);
    assert_eq!(tape.next(), 21, "the first frame at or after it");
    // Steps back across the missing frames.
    tape.keys.step(-2);
    assert_eq!([tape.next(), tape.next()], [20, 9]);
    tape.keys.seek_frame(15);
    assert_eq!(tape.next(), 20);
    for beyond in [f64::MAX, f64::INFINITY] {
        tape.keys.seek_time_s(beyond);
        assert_eq!(tape.next(), 39);
    }
    for before in [-1.0, f64::NAN, f64::NEG_INFINITY] {
        tape.keys.seek_time_s(before);
        assert_eq!(tape.next(), 0);
    }
    tape.keys.step(-1);
    assert_eq!(tape.next(), 0, "before the first there is none");
    // Playback waits at the end and starts again when resumed.
    tape.keys.seek_frame(39);
    assert_eq!(tape.next(), 39);
    tape.keys.play();
    let keys = tape.keys.clone();
    let press = std::thread::spawn(move || {
        while !keys.playback().at_end {
            std::thread::yield_now();
        }
        keys.play();
    });
    assert_eq!(tape.next(), 0);
    press.join().expect("presses");
    tape.keys.close();
    assert_eq!(tape.player.next_frame(&mut tape.frame).expect("no fault"), SourceEvent::End);
}

#[test]
fn what_came_before_comes_before_a_frame_that_is_sought() {
    let mut tape = Tape::new(0.0);
    tape.keys.set_preroll_s(0.35);
    assert_eq!(tape.next(), 0);
    tape.keys.pause();
    tape.keys.seek_frame(33);
    assert_eq!([tape.next(), tape.next(), tape.next(), tape.next()], [30, 31, 32, 33]);
    assert!((30..33).all(|n| tape.keys.is_preroll(n)) && !tape.keys.is_preroll(33) && !tape.keys.is_preroll(29));
    assert_eq!(tape.keys.playback().position.map(|p| p.sequence), Some(33));
    tape.keys.step(1);
    assert_eq!(tape.next(), 34);
    // A second seek during the pre-roll of the first.
    tape.keys.seek_frame(33);
    assert_eq!(tape.next(), 30);
    tape.keys.seek_frame(2);
    assert_eq!([tape.next(), tape.next(), tape.next()], [0, 1, 2]);
}

#[test]
fn it_keeps_time_and_changes_speed() {
    let mut tape = Tape::new(10.0);
    let start = std::time::Instant::now();
    for _ in 0..10 {
        tape.next();
    }
    assert!(start.elapsed().as_secs_f64() >= 0.09);
    tape.keys.set_speed(1e-6);
    let keys = tape.keys.clone();
    let press = std::thread::spawn(move || {
        std::thread::sleep(std::time::Duration::from_millis(50));
        keys.set_speed(f64::NAN);
    });
    // At this speed the frame is due in days; a change of speed releases it.
    tape.next();
    press.join().expect("presses");
    assert_eq!(tape.keys.playback().speed, 0.0);
}

#[test]
fn labels_set_in_place_leave_all_else_alone_and_every_reader_finds_them() {
    let (folder, path) = in_folder("a.mcap");
    record(&path);
    let before = std::fs::read(&path).expect("reads");
    let mut playing = McapReader::open(&path).expect("opens");
    let mut frame = Frame::zeroed(playing.waveform().shape());
    playing.next_frame(&mut frame).expect("a frame");

    let labels = [LabelSpan::new(1.0, 2.0, "two")];
    native::set_labels(&path, &labels).expect("sets");

    // Frames keep their positions, and a reader that was open meanwhile reads to the end.
    let after = std::fs::read(&path).expect("reads");
    let data = before.len() - before.iter().rev().position(|b| *b == 0x0f).expect("an end") - 1;
    assert!(after.len() > before.len() && after[..data.min(30_000)] == before[..data.min(30_000)]);
    let (others, _, error) = read(&mut playing);
    assert!(others.len() == 29 && error.is_none(), "{} frames, {error:?}", others.len());
    // The format's own library reads the file too.
    let summary = mcap::Summary::read(&after).expect("reads").expect("a summary");
    let statistics = summary.stats.as_ref().expect("statistics");
    assert_eq!(statistics.chunk_count as usize, summary.chunk_indexes.len());
    let messages: Vec<_> = mcap::MessageStream::new(&after).expect("opens").map(|m| m.expect("a message")).collect();
    assert_eq!(messages.len() as u64, statistics.message_count);
    let of_labels = messages.iter().filter(|m| m.channel.topic == "/radome/labels").count() as u64;
    let channel = summary.channels.values().find(|c| c.topic == "/radome/labels").expect("the channel");
    assert_eq!(Some(&of_labels), statistics.channel_message_counts.get(&channel.id));
    for index in &summary.chunk_indexes {
        for message in summary.stream_chunk(&after, index).expect("a chunk") {
            message.expect("a message");
        }
    }

    // A repair keeps the labels.
    let repaired = folder.path().join("b.mcap");
    let report = native::repair(&path, &repaired, Existing::Replace).expect("repairs");
    assert_eq!((report.frames, report.labels), (30, 1));
    for path in [path, repaired] {
        assert_eq!(McapReader::open(&path).expect("opens").labels().expect("labels"), labels);
    }
}

mod hard_cases {
    use super::*;

    #[test]
    fn an_unfinished_recording_takes_no_labels_and_says_so() {
        let (_folder, path) = in_folder("a.mcap");
        record(&path);
        let whole = std::fs::read(&path).expect("reads");
        for cut in [1, 8, 37, 60, whole.len() / 2] {
            std::fs::write(&path, &whole[..whole.len() - cut]).expect("writes");
            let error = native::set_labels(&path, &[]).expect_err("cut");
            assert!(matches!(error, RecordingError::Unfinished { .. }), "{cut}: {error}");
            assert!(error.to_string().contains("radome recording repair"), "{error}");
            assert_eq!(std::fs::read(&path).expect("reads").len(), whole.len() - cut, "nothing was written");
        }
    }

    #[test]
    fn a_summary_that_lies_is_an_error_and_nothing_is_written() {
        let (_folder, path) = in_folder("a.mcap");
        record(&path);
        let whole = std::fs::read(&path).expect("reads");
        // Damages every byte of the footer's two positions, and of the first records of the summary.
        let footer = whole.len() - 8 - 20;
        for at in (footer..footer + 8).chain(whole.len() - 700..whole.len() - 600) {
            for (bit, states_crc) in [(0, true), (7, true), (0, false), (7, false)] {
                let mut bad = whole.clone();
                bad[at] ^= 1 << bit;
                if !states_crc {
                    let crc = bad.len() - 12..bad.len() - 8;
                    bad[crc].fill(0);
                }
                std::fs::write(&path, &bad).expect("writes");
                if native::set_labels(&path, &[LabelSpan::new(0.0, 1.0, "one")]).is_err() {
                    assert!(std::fs::read(&path).expect("reads") == bad, "byte {at}");
                }
            }
        }
    }

    #[test]
    fn a_recording_without_frames_is_no_tape() {
        let (_folder, path) = in_folder("a.mcap");
        let header = RecordingHeader::new(waveform(&[1], 8, 64, 0.1));
        Recorder::create(&path, &header).expect("creates").finish().expect("finishes");
        assert!(Player::new(Recording::open(&path).expect("opens"), 1.0).expect("reads").is_none());
    }
}
