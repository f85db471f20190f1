use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use radome_dsp::rdm::{SlowTime, StaticRemoval};
use radome_dsp::{Frame, FrameSource, MapStatus, Occupancy, Rdm, RdmProcessor, RdmSpec, SourceEvent, Truth, Waveform};
use radome_models::dataset::{DatasetHeader, DatasetWriter, Domain, ManifestRow, Split};
use radome_sim::{Scene, SimulateOptions, Simulator};
use rayon::prelude::*;
use serde::Deserialize;
use serde_json::json;

use crate::output;

/// `radome dataset`
#[derive(clap::Args)]
pub struct Arguments {
    #[command(subcommand)]
    action: Action,
}

#[derive(clap::Subcommand)]
enum Action {
    /// Maps, labels and manifest from simulated and recorded sources
    Build {
        /// TOML file: which map, which sources (fixtures/datasets has examples)
        spec: PathBuf,
        /// Folder to make
        #[arg(short, long)]
        output: PathBuf,
        /// One object at the end
        #[arg(long)]
        json: bool,
    },
}

/// What a dataset is made of. Paths are relative to the file.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct BuildSpec {
    format: u32,
    map: RdmSpec,
    #[serde(default)]
    simulated: Vec<Simulated>,
    #[serde(default)]
    recorded: Vec<Recorded>,
}

/// Runs of a scene.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Simulated {
    scene: PathBuf,
    /// First and last seed.
    seeds: (u64, u64),
    /// Numbers of people to force, one run each; the scene's own program if absent.
    #[serde(default)]
    people: Vec<usize>,
    /// Frames of a run.
    frames: u64,
    /// Take one map in so many.
    #[serde(default = "one")]
    every: u64,
    /// Split of all runs; dealt out by sequence if absent.
    #[serde(default)]
    split: Option<Split>,
}

/// A recording with one label throughout, or with labels of its own.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Recorded {
    recording: PathBuf,
    #[serde(default)]
    label: Option<Occupancy>,
    #[serde(default)]
    scene: Option<String>,
    #[serde(default)]
    subject: Option<String>,
    #[serde(default = "one")]
    every: u64,
    #[serde(default)]
    split: Option<Split>,
}

fn one() -> u64 {
    1
}

/// Builds datasets.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    match &arguments.action {
        Action::Build { spec, output, json } => build(spec, output, *json),
    }
}

fn build(path: &Path, folder: &Path, json: bool) -> anyhow::Result<()> {
    output::catch_interrupts()?;
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    let spec: BuildSpec = toml::from_str(&text).with_context(|| format!("{} is no dataset spec", path.display()))?;
    if spec.format != 1 {
        bail!("{}: format is {}, this program knows 1", path.display(), spec.format);
    }
    let base = path.parent().unwrap_or(Path::new("."));
    let mut builder = Builder { folder, spec: spec.map, writer: None, counts: [0; 3], transitions: 0 };
    for source in &spec.simulated {
        builder.simulated(&base.join(&source.scene), source)?;
    }
    for source in &spec.recorded {
        builder.recorded(&base.join(&source.recording), source)?;
    }
    let Some((writer, ..)) = builder.writer else {
        bail!("{} names no source that gave a map", path.display());
    };
    let maps = writer.maps();
    writer.finish()?;
    let [empty, one, two] = builder.counts;
    if json {
        return output::json_line(&json!({
            "dataset": folder.display().to_string(), "maps": maps, "empty": empty, "one": one, "two": two,
            "transitions": builder.transitions,
        }));
    }
    output::text_line(&format!(
        "{}: {maps} maps, {empty} empty, {one} one, {two} two, {} of them in transition",
        folder.display(),
        builder.transitions
    ))
}

struct Builder<'a> {
    folder: &'a Path,
    spec: RdmSpec,
    writer: Option<(DatasetWriter, Waveform)>,
    counts: [u64; 3],
    transitions: u64,
}

/// What all maps of one run have in common.
struct Origin<'a> {
    domain: Domain,
    scene: &'a str,
    recording: &'a str,
    subject: Option<&'a str>,
    split: Option<Split>,
    seed: Option<u64>,
}

impl Builder<'_> {
    /// All sources of a dataset have one waveform; the first sets it.
    fn check_waveform(&mut self, waveform: &Waveform) -> anyhow::Result<()> {
        match &self.writer {
            Some((_, first)) => waveform.check_compatible(first).context("sources of one dataset must agree"),
            None => {
                let header = DatasetHeader::new(waveform.clone(), self.spec)?;
                self.writer = Some((DatasetWriter::create(self.folder, &header)?, waveform.clone()));
                Ok(())
            }
        }
    }

    fn push(&mut self, map: &Rdm, truth: Truth, origin: &Origin) -> anyhow::Result<()> {
        let Some((writer, _)) = &mut self.writer else { return Ok(()) };
        let mut row = ManifestRow::new(
            origin.domain,
            origin.scene,
            origin.recording,
            origin.recording,
            map.sequence,
            truth.occupancy,
        );
        row.subject = origin.subject.map(str::to_owned);
        row.transition = truth.transition;
        row.split = origin.split;
        row.seed = origin.seed;
        writer.push(map, row)?;
        self.counts[truth.occupancy.index()] += 1;
        self.transitions += u64::from(truth.transition);
        Ok(())
    }

    fn simulated(&mut self, path: &Path, source: &Simulated) -> anyhow::Result<()> {
        let scene = Scene::load(path)?;
        self.check_waveform(scene.waveform())?;
        let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let seeds: RangeInclusive<u64> = source.seeds.0..=source.seeds.1;
        let forced: Vec<Option<usize>> =
            if source.people.is_empty() { vec![None] } else { source.people.iter().map(|p| Some(*p)).collect() };
        let runs = seeds.clone().count() * forced.len();
        let bar = output::progress(runs as u64, "runs");
        bar.set_message(name.clone());
        for seed in seeds {
            for people in &forced {
                if output::interrupted() {
                    bail!("interrupted; nothing is left behind");
                }
                let options =
                    SimulateOptions { seed, people: *people, frames: Some(source.frames), ..Default::default() };
                let simulator = Simulator::new(&scene, options)?;
                let people = people.map_or(String::new(), |p| format!("-people{p}"));
                let recording = format!("{name}-seed{seed}{people}");
                let (domain, split, seed) = (Domain::Sim, source.split, Some(seed));
                let origin = Origin { domain, scene: &name, recording: &recording, subject: None, split, seed };
                self.run(simulator, source, &origin)?;
                bar.inc(1);
            }
        }
        bar.finish_and_clear();
        Ok(())
    }

    fn run(&mut self, mut simulator: Simulator, source: &Simulated, origin: &Origin) -> anyhow::Result<()> {
        let mut processor = RdmProcessor::new(&self.spec, simulator.waveform())?;
        let mut map = processor.empty_map();
        let every = source.every.max(1);
        let is_single = self.spec.slow_time == SlowTime::Chirps
            && !matches!(self.spec.static_removal, StaticRemoval::RecursiveMti { .. });
        if is_single {
            // Maps of single frames need no others: render only those that are taken.
            let wanted: Vec<u64> = (0..source.frames).step_by(every as usize).collect();
            for chunk in wanted.chunks(32) {
                let frames: Vec<Frame> = chunk.par_iter().map(|index| simulator.render(*index)).collect();
                for frame in &frames {
                    processor.process(frame, &mut map)?;
                    self.push(&map, frame.truth.context("a simulated frame has truth")?, origin)?;
                }
            }
            return Ok(());
        }
        let mut frame = Frame::zeroed(simulator.waveform().shape());
        let mut made = 0u64;
        while simulator.next_frame(&mut frame).map_err(anyhow::Error::from_boxed)? == SourceEvent::Frame {
            if processor.process(&frame, &mut map)? == MapStatus::Ready {
                if made.is_multiple_of(every) {
                    self.push(&map, frame.truth.context("a simulated frame has truth")?, origin)?;
                }
                made += 1;
            }
        }
        Ok(())
    }

    fn recorded(&mut self, path: &Path, source: &Recorded) -> anyhow::Result<()> {
        let mut frames = radome_driver::recording::open(path)?;
        let waveform = frames.waveform().clone();
        self.check_waveform(&waveform)?;
        let mut processor = RdmProcessor::new(&self.spec, &waveform)?;
        let mut map = processor.empty_map();
        let mut frame = Frame::zeroed(waveform.shape());
        let recording = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let (mut made, mut unlabelled) = (0u64, 0u64);
        loop {
            match frames.next_frame(&mut frame).map_err(anyhow::Error::from_boxed)? {
                SourceEvent::End => break,
                SourceEvent::Gap(_) => processor.reset(),
                SourceEvent::Frame => {
                    if processor.process(&frame, &mut map)? != MapStatus::Ready {
                        continue;
                    }
                    let fixed = source.label.map(|occupancy| Truth { occupancy, transition: false });
                    let Some(truth) = fixed.or(frame.truth) else {
                        unlabelled += 1;
                        continue;
                    };
                    if made.is_multiple_of(source.every.max(1)) {
                        let origin = Origin {
                            domain: Domain::Real,
                            scene: source.scene.as_deref().unwrap_or("unknown"),
                            recording: &recording,
                            subject: source.subject.as_deref(),
                            split: source.split,
                            seed: None,
                        };
                        self.push(&map, truth, &origin)?;
                    }
                    made += 1;
                }
            }
        }
        if unlabelled > 0 {
            eprintln!("{}: {unlabelled} maps without a label were left out", path.display());
        }
        Ok(())
    }
}
