use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use crate::judge::Model;
use crate::live::classify::{Delays, FrameClassifier, run as run_classifier};
use crate::live::pipeline::{Pipeline, Policy};
use crate::live::screen::Screen;
use crate::live::sink::Sink;
use crate::live::view;
use crate::output;
use crate::source::{self, SourceOptions};

/// `radome live`
#[derive(clap::Args)]
pub struct Arguments {
    /// Recording, SCENE.toml, serial:PORT, auto, or emulated:SOURCE
    source: String,
    /// Model file, which names the waveform that a board is programmed with; or cfar, the classical detector, for any waveform
    #[arg(long)]
    model: PathBuf,
    /// Stop after so many frames
    #[arg(long)]
    frames: Option<u64>,
    /// Times real time for recordings and simulations; 0, the default, is as fast as it goes. Recordings with --view: 1
    #[arg(long)]
    speed: Option<f64>,
    /// Seed of a simulation
    #[arg(long, default_value_t = 100_001)]
    seed: u64,
    /// People that a simulation is forced to have
    #[arg(long)]
    people: Option<usize>,
    /// Seconds of agreement before `occupied` is said
    #[arg(long, default_value_t = Delays::default().on_s)]
    on_delay_s: f64,
    /// Seconds of agreement before it is taken back
    #[arg(long, default_value_t = Delays::default().off_s)]
    off_delay_s: f64,
    /// One object a frame and one at the end
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    view: view::Arguments,
}

/// Online classification of any source.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    watch(&Watch {
        source: &arguments.source,
        model: &arguments.model,
        seed: arguments.seed,
        people: arguments.people,
        frames: arguments.frames,
        speed: arguments.speed,
        json: arguments.json,
        delays: Delays { on_s: arguments.on_delay_s, off_s: arguments.off_delay_s },
        view: &arguments.view,
    })
}

/// What `live` and `demo` have in common.
pub struct Watch<'a> {
    /// SOURCE.
    pub source: &'a str,
    /// Model file.
    pub model: &'a Path,
    /// Seed of a simulation.
    pub seed: u64,
    /// People that a simulation is forced to have.
    pub people: Option<usize>,
    /// Frames to stop after.
    pub frames: Option<u64>,
    /// Times real time; 0 is as fast as it goes. `None`: recordings at their own pace, all else as fast as it goes.
    pub speed: Option<f64>,
    /// JSON lines instead of a table.
    pub json: bool,
    /// Filter and delays.
    pub delays: Delays,
    /// The page.
    pub view: &'a view::Arguments,
}

/// Watches a source until it ends, is stopped, or has given enough frames.
pub fn watch(watch: &Watch) -> anyhow::Result<()> {
    let started = Instant::now();
    output::catch_interrupts()?;
    let model = Model::open(watch.model)?;
    let options = SourceOptions {
        waveform: model.waveform().cloned(),
        seed: watch.seed,
        people: watch.people,
        frames: watch.frames,
        speed: watch.speed,
        as_tape: watch.view.is_wanted(),
    };
    let source = source::open(watch.source, &options)?;
    eprintln!("{}", source.description);
    let waveform = source.frames.waveform().clone();
    let mut judge = FrameClassifier::new(model, &waveform, watch.delays, started)?;
    if let Some(tape) = &source.tape {
        tape.transport.set_preroll_s(judge.memory_s());
    }
    let page = view::Page::open(watch.view, &source, watch.model, None)?;

    let mut pipeline = Pipeline::new();
    let policy = if source.is_live { Policy::DropOldest } else { Policy::Wait };
    let inlet = pipeline.consumer("classifier", 16, policy);
    let reader = pipeline.start(source.frames, watch.frames);
    let patience = Duration::from_secs_f64((2.0 * waveform.frame_interval_s()).clamp(0.1, 1.0));
    let mut sinks: Vec<Box<dyn Sink>> = Vec::new();
    if let Some(page) = page {
        sinks.push(Box::new(page));
    }
    sinks.push(Box::new(Screen::new(watch.json)));
    let outcome = run_classifier(&inlet, &mut judge, patience, &mut sinks);
    reader.stop();
    outcome.map(drop)
}
