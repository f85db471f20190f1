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

/// Player of a recording, with its controls.
struct Playback {
    player: Player,
    controls: Transport,
    frame: Frame,
    _folder: tempfile::TempDir,
}

impl Playback {
    fn new(speed: f64) -> Playback {
        let (folder, path) = in_folder("a.mcap");
        record(&path);
        let player = Player::new(Recording::open(&path).expect("opens"), speed).expect("reads").expect("frames");
        let frame = Frame::zeroed(player.waveform().shape());
        Playback { controls: player.transport(), player, frame, _folder: folder }
    }

    fn next(&mut self) -> u64 {
        while let SourceEvent::Gap(_) = self.player.next_frame(&mut self.frame).expect("no fault") {}
        self.frame.sequence
    }
}

#[test]
fn controls_lead_to_the_requested_frame() {
    let mut playback = Playback::new(0.0);
    let extent = playback.player.extent();
    assert_eq!((extent.first.sequence, extent.last.sequence), (0, 39));
    assert!((extent.last.time_s() - 3.9).abs() < 1e-9);
    assert_eq!([playback.next(), playback.next()], [0, 1]);
    playback.controls.pause();
    playback.controls.seek_frame(30);
    assert_eq!(playback.next(), 30);
    playback.controls.step(2);
    assert_eq!([playback.next(), playback.next()], [31, 32]);
    playback.controls.step(-1);
    assert_eq!(playback.next(), 31);
    playback.controls.seek_time_s(2.01);
    assert_eq!(playback.next(), 21, "the first frame at or after it");
    // Steps back across the missing frames.
    playback.controls.step(-2);
    assert_eq!([playback.next(), playback.next()], [20, 9]);
    playback.controls.seek_frame(15);
    assert_eq!(playback.next(), 20);
    for beyond in [f64::MAX, f64::INFINITY] {
        playback.controls.seek_time_s(beyond);
        assert_eq!(playback.next(), 39);
    }
    for before in [-1.0, f64::NAN, f64::NEG_INFINITY] {
        playback.controls.seek_time_s(before);
        assert_eq!(playback.next(), 0);
    }
    playback.controls.step(-1);
    assert_eq!(playback.next(), 0, "before the first there is none");
    // Playback waits at the end and starts again when resumed.
    playback.controls.seek_frame(39);
    assert_eq!(playback.next(), 39);
    playback.controls.play();
    let controls = playback.controls.clone();
    let press = std::thread::spawn(move || {
        while !controls.playback().at_end {
            std::thread::yield_now();
        }
        controls.play();
    });
    assert_eq!(playback.next(), 0);
    press.join().expect("presses");
    playback.controls.close();
    assert_eq!(playback.player.next_frame(&mut playback.frame).expect("no fault"), SourceEvent::End);
}

#[test]
fn the_preroll_precedes_a_sought_frame() {
    let mut playback = Playback::new(0.0);
    playback.controls.set_preroll_s(0.35);
    assert_eq!(playback.next(), 0);
    playback.controls.pause();
    playback.controls.seek_frame(33);
    assert_eq!([playback.next(), playback.next(), playback.next(), playback.next()], [30, 31, 32, 33]);
    assert!(
        (30..33).all(|n| playback.controls.is_preroll(n))
            && !playback.controls.is_preroll(33)
            && !playback.controls.is_preroll(29)
    );
    assert_eq!(playback.controls.playback().position.map(|p| p.sequence), Some(33));
    playback.controls.step(1);
    assert_eq!(playback.next(), 34);
    // A second seek during the pre-roll of the first.
    playback.controls.seek_frame(33);
    assert_eq!(playback.next(), 30);
    playback.controls.seek_frame(2);
    assert_eq!([playback.next(), playback.next(), playback.next()], [0, 1, 2]);
}

#[test]
fn playback_follows_time_stamps_and_speed() {
    let mut playback = Playback::new(10.0);
    let start = std::time::Instant::now();
    for _ in 0..10 {
        playback.next();
    }
    assert!(start.elapsed().as_secs_f64() >= 0.09);
    playback.controls.set_speed(1e-6);
    let controls = playback.controls.clone();
    let press = std::thread::spawn(move || {
        std::thread::sleep(std::time::Duration::from_millis(50));
        controls.set_speed(f64::NAN);
    });
    // At this speed the frame is due in days; a change of speed releases it.
    playback.next();
    press.join().expect("presses");
    assert_eq!(playback.controls.playback().speed, 0.0);
}

#[test]
fn labels_set_in_place_change_nothing_else() {
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
    fn an_unfinished_recording_refuses_labels() {
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
    fn a_damaged_summary_is_an_error_and_nothing_is_written() {
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
    fn a_recording_without_frames_has_no_player() {
        let (_folder, path) = in_folder("a.mcap");
        let header = RecordingHeader::new(waveform(&[1], 8, 64, 0.1));
        Recorder::create(&path, &header).expect("creates").finish().expect("finishes");
        assert!(Player::new(Recording::open(&path).expect("opens"), 1.0).expect("reads").is_none());
    }
}
