//! Tests of the throughput and memory of long runs: `tests/long home`. Ignored by default.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use radome_driver::{EmulatedBoard, EmulatorOptions, Pace, Recorder, RecorderOptions, RecordingHeader};
use radome_dsp::{Frame, FrameSource, SourceEvent, Waveform, WaveformRequest, source_from_fn};
use radome_models::Model;
use radome_tests::browser::{Served, page};
use radome_tests::running::{Running, emulated_board, send_request, wait_up_to};
use radome_tests::{command, fixture, json_lines, live_command, simulate};

fn number_from_environment(name: &str, default: u64) -> u64 {
    std::env::var(name).map_or(default, |value| value.parse().unwrap_or_else(|e| panic!("{name}={value}: {e}")))
}

fn small_waveform() -> Waveform {
    let request = WaveformRequest {
        samples_per_chirp: 64,
        chirps_per_frame: 8,
        frame_interval_s: 0.01,
        ..WaveformRequest::paper()
    };
    Waveform::realise(request).expect("possible")
}

/// Source that repeats small frames, a hundred for each second of its time, without computing cost, until `end` are sent.
fn small_frames(end: u64, sent: Arc<AtomicU64>) -> impl FrameSource {
    let waveform = small_waveform();
    let codes: Vec<u16> = (0..waveform.shape().codes()).map(|i| ((i * 2_654_435_761) >> 7 & 0xFFF) as u16).collect();
    source_from_fn(waveform, move |frame| {
        let next = sent.load(Ordering::Relaxed);
        if next == end {
            return Ok(SourceEvent::End);
        }
        frame.codes.clone_from(&codes);
        (frame.sequence, frame.time_ns) = (next, next * 10_000_000);
        sent.store(next + 1, Ordering::Relaxed);
        Ok(SourceEvent::Frame)
    })
}

/// Resident memory of a process, KiB.
fn resident_kib(process: u32) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).expect("a process");
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).expect("its memory");
    line.trim().trim_end_matches(" kB").parse().expect("a number")
}

/// Numbers of frames judged and lost, according to the metrics.
fn counts_of_metrics(port: u16) -> (u64, u64) {
    let request = format!("GET /metrics HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n");
    let page = send_request(("127.0.0.1", port), request);
    assert!(page.starts_with("HTTP/1.1 200"), "{page}");
    let value =
        |line: &str| line.rsplit_once(' ').and_then(|(_, value)| value.parse::<f64>().ok()).unwrap_or(0.0) as u64;
    let sum = |name: &str| page.lines().filter(|line| line.starts_with(name)).map(value).sum();
    (sum("radome_frames_total "), sum("radome_frames_dropped_total{"))
}

/// Asserts that memory stays constant over `RADOME_FRAMES` small frames (a million by default) at full speed. Frames
/// judged and frames counted as lost must add up to the frames sent.
#[test]
#[ignore = "takes minutes: tests/long home"]
#[allow(clippy::print_stderr)]
fn a_million_small_frames_need_constant_memory_and_every_loss_is_reported() {
    let end = number_from_environment("RADOME_FRAMES", 1_000_000);
    let folder = tempfile::tempdir().expect("a folder");
    // The paper's network, declared for small frames: its predictions are meaningless, but its cost is the same.
    let mut model = Model::load(&fixture("models/paper-hqnn.safetensors")).expect("loads");
    model.card.waveform = small_waveform();
    (model.card.rdm_spec.doppler_fft_length, model.card.rdm_spec.range_fft_length) = (Some(128), Some(256));
    let path = folder.path().join("small.safetensors");
    model.save(&path).expect("saves");

    let sent = Arc::new(AtomicU64::new(0));
    let source = small_frames(end, sent.clone());
    let options = EmulatorOptions { pace: Pace::AsFastAsRead, ..EmulatorOptions::default() };
    let board = EmulatedBoard::spawn(Box::new(source), options).expect("a board");
    let mut command = command!("live", format!("serial:{}", board.path().display()), "--model", &path);
    command.args(["--metrics", "127.0.0.1:0", "--keep-last-s", "30", "--keep-to"]).arg(folder.path().join("reports"));
    let start = Instant::now();
    let mut live = Running::start(command);
    let port = live.metrics_port();
    let mut memory = Vec::new();
    let mut last = (0, Instant::now());
    let (frames, lost) = loop {
        let (frames, lost) = counts_of_metrics(port);
        memory.push((frames + lost, resident_kib(live.id())));
        if frames + lost > last.0 {
            last = (frames + lost, Instant::now());
        }
        // Ends when all frames are counted, or when the counts have not changed for a minute.
        if frames + lost >= end || last.1.elapsed() > Duration::from_secs(60) {
            break (frames, lost);
        }
        std::thread::sleep(Duration::from_millis(500));
    };
    let took_s = start.elapsed().as_secs_f64();
    live.signal("TERM");
    assert!(live.wait().success(), "{:?}", live.stderr.all());
    // Pools, queues and the buffer of the last seconds are full after this many frames.
    let filled = (end / 10).max(75_000).min(end / 2);
    let settled: Vec<u64> = memory.iter().filter(|(frames, _)| *frames > filled).map(|(_, kib)| *kib).collect();
    let (first, most) = (settled.first().copied().unwrap_or(0), settled.iter().max().copied().unwrap_or(0));
    eprintln!(
        "{frames} judged, {lost} counted as lost, {} sent in {took_s:.1} s ({:.0}/s); memory {first} KiB, at most {most} KiB",
        sent.load(Ordering::Relaxed),
        end as f64 / took_s
    );
    assert_eq!(frames + lost, end, "frames and counted gaps are what was sent");
    assert!(most <= first + 4096, "memory grows: {settled:?}");
}

/// Records the same number of small frames at full speed, without and with syncing, and prints the cost of syncing.
/// Asserts that memory stays constant from a quarter of the run on.
#[test]
#[ignore = "takes minutes: tests/long home"]
#[allow(clippy::print_stderr)]
fn a_million_small_frames_are_recorded_with_and_without_syncing() {
    let end = number_from_environment("RADOME_FRAMES", 1_000_000);
    let folder = tempfile::tempdir().expect("a folder");
    for (name, sync) in [("left to the system", None), ("synced", RecorderOptions::default().sync)] {
        let path = folder.path().join("frames.mcap");
        let header = RecordingHeader::new(small_waveform());
        let options = RecorderOptions { sync, ..RecorderOptions::default() };
        let mut recorder = Recorder::with_options(&path, &header, &options).expect("creates");
        let mut source = small_frames(end, Arc::default());
        let mut frame = Frame::zeroed(source.waveform().shape());
        let mut memory = Vec::new();
        let start = Instant::now();
        while source.next_frame(&mut frame).expect("a frame") == SourceEvent::Frame {
            recorder.frame(&frame).expect("records");
            if frame.sequence.is_multiple_of((end / 20).max(1)) {
                memory.push(resident_kib(std::process::id()));
            }
        }
        memory.push(resident_kib(std::process::id()));
        let recorded_s = start.elapsed().as_secs_f64();
        let summary = recorder.finish().expect("finishes");
        eprintln!(
            "{name}: {} frames, {:.0} MB, {:.0} frames/s, {:.2} s to finish; memory {memory:?} KiB",
            summary.frames,
            summary.bytes as f64 * 1e-6,
            end as f64 / recorded_s,
            start.elapsed().as_secs_f64() - recorded_s
        );
        assert_eq!(summary.frames, end);
        // Memory at a quarter of the run, and at its end.
        let (quarter, last) = (memory.get(5).copied().unwrap_or(0), memory.last().copied().unwrap_or(u64::MAX));
        assert!(last < quarter + 1024, "memory grows: {memory:?}");
        std::fs::remove_file(&path).expect("removes");
    }
}

/// Measures latency over `RADOME_PACE_FRAMES` frames of the paper's waveform in real time (a minute by default). The
/// board is another process; the run is recorded, and two pages are open. The label follows the last sample after 2 ms,
/// 5 ms at most.
#[test]
#[ignore = "takes minutes, and means something on an idle machine only: tests/long home"]
#[allow(clippy::print_stderr)]
fn a_label_comes_within_two_milliseconds_of_the_last_sample_at_the_papers_pace() {
    let frames = number_from_environment("RADOME_PACE_FRAMES", 600);
    let folder = tempfile::tempdir().expect("a folder");
    let run = folder.path().join("run.mcap");
    simulate(&fixture("scenes/corridor.toml"), &format!("--frames {}", frames + 20), &run);
    let (_board, port) = emulated_board(&run, &["--speed", "1"]);
    let night = folder.path().join("night.mcap");
    let options = format!("--json --frames {frames} -o");
    let Served { program: mut live, address, .. } =
        Served::start(live_command(format!("serial:{port}"), &options).arg(&night));
    let pages = [(); 2].map(|()| {
        let mut socket = page(&address);
        // Acknowledges pictures as the page does, but no other messages.
        std::thread::spawn(move || {
            let mut pictures = 0;
            while let Ok(message) = socket.read() {
                if message.is_binary() {
                    pictures += 1;
                    let _ = socket.send(tungstenite::Message::text("{\"do\":\"seen\"}"));
                }
            }
            pictures
        })
    });
    // Waits for all frames, or until no more arrive: a board whose FIFO overflowed sends fewer.
    let mut last = (0, Instant::now());
    wait_up_to(Duration::from_secs(60 + frames / 5), "the last frame", || {
        let lines = live.stdout.all().len();
        if lines > last.0 {
            last = (lines, Instant::now());
        }
        (!live.is_running() || last.1.elapsed() > Duration::from_secs(20)).then_some(())
    });
    if live.is_running() {
        live.signal("TERM");
    }
    assert!(live.wait().success(), "{:?}", live.stderr.all());
    let seen = pages.map(|page| page.join().expect("a page"));
    let lines = live.stdout.all();
    let summary: serde_json::Value = serde_json::from_str(lines.last().expect("a summary")).expect("JSON");
    let summary = &summary["summary"];
    eprintln!("latency {}, pages saw {seen:?} pictures, {summary}", summary["latency_ms"]);
    assert_eq!((&summary["frames"], &summary["dropped"]), (&frames.into(), &0.into()));
    let kept = json_lines(command!("recording answers --json", &night));
    assert_eq!(kept.len() as u64, frames);
    assert!(seen.iter().all(|seen| *seen as u64 > frames / 2), "{seen:?}");
    let latency = |quantile: &str| summary["latency_ms"][quantile].as_f64().expect("a number");
    assert!(latency("p50") <= 2.0 && latency("p99") <= 5.0, "{}", summary["latency_ms"]);
}
