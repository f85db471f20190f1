//! Maps of one unit, in the order of its frames, independent of parallel work.

use std::path::Path;

use anyhow::Context;
use radome_driver::LabelSpan;
use radome_driver::recording::Recording;
use radome_driver::recording::span_check::check_spans;
use radome_dsp::{Frame, FrameSource, MapStatus, Rdm, RdmProcessor, RdmSpec, Truth};
use radome_models::dataset::DatasetWriter;
use radome_sim::{Scene, SimulateOptions, Simulator};
use rayon::prelude::*;

use super::plan::{Plan, Unit, UnitSource};
use super::thermal::{NoisyProcessor, RawNoise};
use crate::output::Interrupted;
use crate::{labels, output, source};

/// Number of frames that are simulated before maps are computed from them.
const CHUNK: usize = 32;

/// Computes the maps of a unit and writes them as a dataset at `folder`. With `parallel`, its frames are simulated on
/// all threads; the bytes are the same either way.
///
/// # Errors
/// The source cannot be read or simulated, a map cannot be written, or the user interrupts.
pub fn make(plan: &Plan, unit: &Unit, folder: &Path, parallel: bool) -> anyhow::Result<()> {
    let mut sink = MapSink { writer: DatasetWriter::create(folder, &plan.header)?, unit, offered: 0 };
    let noise =
        |seed: u64| plan.card.spec.raw_snr_db.map(|snr_db| RawNoise { snr_db, seed, recording: &unit.recording });
    match &unit.source {
        UnitSource::Run { scene, seed, people, frames, tolerance_db } => {
            let mut options =
                SimulateOptions { seed: *seed, people: *people, frames: Some(*frames), ..Default::default() };
            options.tolerance_db = tolerance_db.unwrap_or(options.tolerance_db);
            // Receivers that no map uses are not simulated.
            let processor = RdmProcessor::with_kernel(&plan.header.rdm_spec, scene.waveform(), plan.kernel)?;
            let processor = NoisyProcessor::new(processor, noise(*seed));
            run(scene, options, &plan.header.rdm_spec, processor, parallel, &mut sink)?;
        }
        UnitSource::Recording { path, label, label_file } => {
            let mut recording = Recording::open(path)?;
            // A recording's axes may differ from the first recording's within the tolerance. With physical axes, its
            // waveform may differ too.
            let processor = RdmProcessor::with_kernel(&plan.header.rdm_spec, recording.waveform(), plan.kernel)?;
            let processor = NoisyProcessor::new(processor, noise(0));
            let spans = match (label, label_file) {
                (Some(_), _) => Vec::new(),
                (None, Some(file)) => labels::read_file(file)?,
                (None, None) => recording.labels()?,
            };
            let fixed_truth = label.map(|occupancy| Truth { occupancy, transition: false });
            self::recording(&mut recording, &spans, fixed_truth, processor, &mut sink)
                .with_context(|| format!("{} cannot be used", path.display()))?;
        }
    }
    Ok(sink.writer.finish()?)
}

/// Writer of every `unit.every`-th map.
struct MapSink<'a> {
    writer: DatasetWriter,
    unit: &'a Unit,
    offered: u64,
}

impl MapSink<'_> {
    /// Stores a map if its turn has come.
    fn push_every_nth(&mut self, map: &Rdm, truth: Truth) -> anyhow::Result<()> {
        self.offered += 1;
        if (self.offered - 1).is_multiple_of(self.unit.every) { self.push(map, truth) } else { Ok(()) }
    }

    fn push(&mut self, map: &Rdm, truth: Truth) -> anyhow::Result<()> {
        let mut row = self.unit.row(map.sequence, truth.occupancy);
        row.transition = truth.transition;
        Ok(self.writer.push(map, row)?)
    }
}

/// Stores the maps of a run of a scene.
fn run(
    scene: &Scene,
    options: SimulateOptions,
    spec: &RdmSpec,
    mut processor: NoisyProcessor,
    parallel: bool,
    sink: &mut MapSink,
) -> anyhow::Result<()> {
    let simulator = Simulator::new(scene, options)?;
    let is_single = spec.is_of_single_frames();
    // A map of one frame needs no other frames, so only the frames whose maps are stored are simulated.
    let step = if is_single { sink.unit.every as usize } else { 1 };
    let frame_numbers: Vec<u64> = (0..options.frames.unwrap_or(0)).step_by(step).collect();
    let mut map = processor.processor.empty_map();
    for chunk in frame_numbers.chunks(if parallel { CHUNK } else { 1 }) {
        if output::interrupted() {
            return Err(Interrupted.into());
        }
        let frames: Vec<Frame> = match parallel {
            true => chunk.par_iter().map(|index| simulator.frame(*index)).collect(),
            false => chunk.iter().map(|index| simulator.frame(*index)).collect(),
        };
        for frame in &frames {
            if processor.process(frame, &mut map)? == MapStatus::Ready {
                let truth = frame.truth.context("a simulated frame has truth")?;
                if is_single { sink.push(&map, truth)? } else { sink.push_every_nth(&map, truth)? }
            }
        }
    }
    Ok(())
}

/// Stores the maps of a recording.
fn recording(
    frames: &mut Recording,
    spans: &[LabelSpan],
    fixed_truth: Option<Truth>,
    mut processor: NoisyProcessor,
    sink: &mut MapSink,
) -> anyhow::Result<()> {
    check_spans(spans, None)?;
    // As in `model evaluate`, the truth that a simulator wrote counts only if there are no labels, not even free text.
    let has_labels = !spans.is_empty();
    let waveform = frames.waveform().clone();
    let mut map = processor.processor.empty_map();
    let mut frame = Frame::zeroed(waveform.shape());
    let (mut unlabelled, mut without_signal) = (0u64, 0u64);
    let mut extent_s: Option<(f64, f64)> = None;
    loop {
        if output::interrupted() {
            return Err(Interrupted.into());
        }
        if !source::next_frame_noting_gaps(frames, &mut frame, || processor.processor.reset_at_gap())? {
            break;
        }
        let end_s = frame.time_s() + waveform.frame_interval_s();
        extent_s = Some((extent_s.map_or(frame.time_s(), |(first, _)| first), end_s));
        if !processor.processor.spec().has_signal(&frame) {
            without_signal += 1;
            processor.processor.reset();
            continue;
        }
        if processor.process(&frame, &mut map)? != MapStatus::Ready {
            continue;
        }
        let labelled = || {
            let mut truth = labels::truth_of_frame(spans, &frame, &waveform)?;
            // A simulator also marks when somebody is partly in the room.
            truth.transition |= frame.truth.is_some_and(|own| own.transition && own.occupancy == truth.occupancy);
            Some(truth)
        };
        match fixed_truth.or_else(|| if has_labels { labelled() } else { frame.truth }) {
            Some(truth) => sink.push_every_nth(&map, truth)?,
            None => unlabelled += 1,
        }
    }
    labels::check_imported(spans, extent_s)?;
    if extent_s.is_none() {
        message!("{}: no frame, and so no map", sink.unit.recording);
    }
    if without_signal > 0 {
        message!("{}: {without_signal} frames in which a receiver gives no signal were left out", sink.unit.recording);
    }
    if unlabelled > 0 {
        message!("{}: {unlabelled} maps without a label were left out", sink.unit.recording);
    }
    Ok(())
}
