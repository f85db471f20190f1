//! Processor time per frame: to read it from a recording, to make its map, and to label it by a model.
//!
//! `RAYON_NUM_THREADS=1 cargo run --release -p radome-tests --example frame_cost RECORDING MODEL`
//!
//! Prints one JSON line: `frames`, `read_us`, `map_us` and `label_us`. Each time is the least of several rounds over
//! all frames, us a frame.
//! Reading includes the opening of the file. The map has the default spec; the label takes a model's map and its
//! network.
//! `python/bench/cost.py` runs the same rounds in Python beside it.
#![allow(clippy::print_stdout)]

use std::path::Path;

use radome_driver::recording::Recording;
use radome_dsp::{Frame, FrameSource, MapStatus, RdmProcessor, RdmSpec, SourceError, SourceEvent, Waveform};
use radome_models::Classifier;
use rustix::time::{ClockId, clock_gettime};

/// Allocator that the program uses.
#[global_allocator]
static ALLOCATOR: radome_models::LargeBlocks = radome_models::LargeBlocks::new();

const ROUNDS: usize = 9;

/// Processor time that all threads have used so far, us.
fn processor_us() -> f64 {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    time.tv_sec as f64 * 1e6 + time.tv_nsec as f64 * 1e-3
}

/// Least time of several rounds over this number of frames, us a frame.
fn least_us(frames: usize, mut round: impl FnMut() -> Result<(), SourceError>) -> Result<f64, SourceError> {
    let mut least_us = f64::INFINITY;
    for _ in 0..ROUNDS {
        let began_us = processor_us();
        round()?;
        least_us = least_us.min(processor_us() - began_us);
    }
    Ok(least_us / frames as f64)
}

/// Calls `take` with each frame of a recording, and returns their waveform.
fn read(path: &Path, mut take: impl FnMut(&Frame)) -> Result<Waveform, SourceError> {
    let mut source = Recording::open(path)?;
    let mut frame = Frame::zeroed(source.waveform().shape());
    loop {
        match source.next_frame(&mut frame)? {
            SourceEvent::Frame => take(&frame),
            SourceEvent::Gap(_) => {}
            SourceEvent::End => return Ok(source.waveform().clone()),
        }
    }
}

fn map_us(frames: &[Frame], waveform: &Waveform) -> Result<f64, SourceError> {
    let mut processor = RdmProcessor::new(&RdmSpec::default(), waveform)?;
    let mut map = processor.empty_map();
    least_us(frames.len(), || {
        for frame in frames {
            // Without a reset, a map could depend on earlier frames.
            processor.reset();
            processor.process(frame, &mut map)?;
        }
        Ok(())
    })
}

fn label_us(frames: &[Frame], waveform: &Waveform, model: &Path) -> Result<f64, SourceError> {
    let mut classifier = Classifier::load(model)?;
    classifier.rdm_spec().check_compatible(waveform, classifier.waveform())?;
    let mut processor = RdmProcessor::new(classifier.rdm_spec(), waveform)?;
    let mut map = processor.empty_map();
    least_us(frames.len(), || {
        for frame in frames {
            if processor.process(frame, &mut map)? == MapStatus::Ready {
                classifier.classify(&map)?;
            }
        }
        Ok(())
    })
}

fn main() -> Result<(), SourceError> {
    let arguments: Vec<_> = std::env::args_os().skip(1).collect();
    let [recording, model] = arguments.as_slice() else {
        return Err("frame_cost takes a recording and a model file".into());
    };
    let recording = Path::new(recording);
    let mut frames = Vec::new();
    let waveform = read(recording, |frame| frames.push(frame.clone()))?;
    if frames.is_empty() {
        return Err(format!("{}: the recording has no frames", recording.display()).into());
    }
    let costs = serde_json::json!({
        "frames": frames.len(),
        "read_us": least_us(frames.len(), || read(recording, |_| {}).map(drop))?,
        "map_us": map_us(&frames, &waveform)?,
        "label_us": label_us(&frames, &waveform, Path::new(model))?,
    });
    println!("{costs}");
    Ok(())
}
