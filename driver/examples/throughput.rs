//! Throughput of the client with the paper's waveform (3 x 128 x 256 samples every 100 ms).
//!
//! An emulated board sends through a pseudo-terminal, at TIMES the speed of a real board, or at full speed with 0:
//! `throughput [TIMES [SECONDS]]`. Prints the frames received and lost, and the client's share of one core. Fails if
//! anything was lost.

#![allow(clippy::print_stdout)]

use std::error::Error;
use std::time::{Duration, Instant};

use radome_driver::{EmulatedBoard, EmulatorOptions, Mcu7Board, Pace};
use radome_dsp::{Frame, FrameSource, SourceEvent, Waveform, WaveformRequest, source_from_fn};

/// Source of equal frames, without computing cost.
fn equal_frames(waveform: Waveform) -> impl FrameSource {
    let (interval_s, mut next) = (waveform.frame_interval_s(), 0);
    let codes: Vec<u16> = (0..waveform.shape().codes()).map(|i| ((i * 2_654_435_761) >> 7 & 0xFFF) as u16).collect();
    source_from_fn(waveform, move |frame| {
        frame.codes.clone_from(&codes);
        (frame.sequence, frame.time_ns) = (next, (next as f64 * interval_s * 1e9) as u64);
        next += 1;
        Ok(SourceEvent::Frame)
    })
}

/// Time that this thread has computed.
fn thread_time() -> Result<Duration, Box<dyn Error>> {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat")?;
    let nanoseconds = text.split_whitespace().next().ok_or("schedstat is empty")?.parse()?;
    Ok(Duration::from_nanos(nanoseconds))
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let times: f64 = arguments.next().map_or(Ok(20.0), |a| a.parse())?;
    let seconds: f64 = arguments.next().map_or(Ok(10.0), |a| a.parse())?;
    let waveform = Waveform::realise(WaveformRequest::paper())?;
    let frames = (seconds * if times > 0.0 { times } else { 20.0 } / waveform.frame_interval_s()) as u64;
    let pace = if times > 0.0 { Pace::RealTime(times) } else { Pace::AsFastAsRead };
    let options = EmulatorOptions { pace, ..EmulatorOptions::default() };
    let board = EmulatedBoard::spawn(Box::new(equal_frames(waveform.clone())), options)?;
    let mut stream = Mcu7Board::open(board.address())?.start(&waveform)?;
    let mut frame = Frame::zeroed(waveform.shape());
    let (mut received, mut lost) = (0, 0);
    let (start, start_thread) = (Instant::now(), thread_time()?);
    while received + lost < frames {
        match stream.next_frame(&mut frame).map_err(|e| e.to_string())? {
            SourceEvent::Frame => received += 1,
            SourceEvent::Gap(gap) => {
                println!("{} frames lost: {}", gap.frames, gap.reason.name());
                lost += gap.frames;
            }
            SourceEvent::End => break,
        }
    }
    let (wall, busy) = (start.elapsed(), thread_time()?.saturating_sub(start_thread));
    let megabytes = received as f64 * waveform.shape().codes() as f64 * 1.5e-6;
    println!(
        "{received} frames, {lost} lost, {} overflows in {:.2} s: {:.1} frames/s, {:.1} MB/s; client {:.2} % of a core",
        board.counts().overflows,
        wall.as_secs_f64(),
        received as f64 / wall.as_secs_f64(),
        megabytes / wall.as_secs_f64(),
        100.0 * busy.as_secs_f64() / wall.as_secs_f64()
    );
    if lost > 0 { Err("frames were lost".into()) } else { Ok(()) }
}
