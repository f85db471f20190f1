use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use radome_dsp::Occupancy;
use radome_models::Classifier;
use serde_json::json;

use crate::live::classify::{Answer, Delays, Event, FrameClassifier, Summary, run as run_classifier};
use crate::live::pipeline::{Pipeline, Policy};
use crate::live::view;
use crate::output;
use crate::source::{self, SourceOptions};

/// `radome live`
#[derive(clap::Args)]
pub struct Arguments {
    /// Recording, SCENE.toml, serial:PORT, auto, or emulated:SOURCE
    source: String,
    /// Model file; a board is programmed with the waveform that it names
    #[arg(long)]
    model: PathBuf,
    /// Stop after so many frames
    #[arg(long)]
    frames: Option<u64>,
    /// Times real time for recordings and simulations; 0, the default, is as fast as it goes
    #[arg(long, default_value_t = 0.0)]
    speed: f64,
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
        speed: (arguments.speed > 0.0).then_some(arguments.speed),
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
    /// Times real time.
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
    let classifier = Classifier::load(watch.model)?;
    let options = SourceOptions {
        waveform: Some(classifier.waveform().clone()),
        seed: watch.seed,
        people: watch.people,
        frames: watch.frames,
        speed: watch.speed,
    };
    let source = source::open(watch.source, &options)?;
    eprintln!("{}", source.description);
    let waveform = source.frames.waveform().clone();
    let mut judge = FrameClassifier::new(classifier, &waveform, watch.delays, started)?;
    let page = view::Page::open(watch.view)?;

    let mut pipeline = Pipeline::new();
    let policy = if source.is_live { Policy::DropOldest } else { Policy::Wait };
    let inlet = pipeline.consumer("classifier", 16, policy);
    let reader = pipeline.start(source.frames, watch.frames);
    let mut screen = Screen::new(watch.json);
    let patience = Duration::from_secs_f64((2.0 * waveform.frame_interval_s()).clamp(0.1, 1.0));
    let summary = run_classifier(&inlet, &mut judge, patience, |judge, event| match event {
        Event::Answer(answer) => {
            if let Some(page) = &page {
                page.show(&answer, judge.map());
            }
            screen.answer(&answer)
        }
        Event::Gap(gap) if watch.json => output::json_line(&json!({ "gap": gap })),
        Event::Gap(gap) => {
            eprintln!("{} frames lost from {}: {}", gap.frames, gap.first_sequence, gap.reason.name());
            Ok(())
        }
    });
    reader.stop();
    screen.summary(&summary?)
}

/// Answers as JSON lines or as text for people: one line a change, and a line that lives on a terminal.
struct Screen {
    json: bool,
    is_terminal: bool,
    last: Option<(Option<Occupancy>, Option<Occupancy>)>,
}

impl Screen {
    fn new(json: bool) -> Self {
        let is_terminal = !json && std::io::stdout().is_terminal();
        if !json {
            println!("{:>8}  {:7} {:^23}  {:7} {:>10}", "time", "label", "empty   one     two", "truth", "latency");
        }
        Screen { json, is_terminal, last: None }
    }

    fn answer(&mut self, answer: &Answer) -> anyhow::Result<()> {
        if self.json {
            return output::json_line(answer);
        }
        let state = (answer.label, answer.truth);
        let is_change = self.last != Some(state);
        if !self.is_terminal && !is_change {
            return Ok(());
        }
        let label = answer.label.map_or("-", Occupancy::name);
        let values = match (&answer.probabilities, &answer.warming_up) {
            (Some(p), _) => p.to_string(),
            (None, Some(progress)) => format!("warming up {progress}"),
            (None, None) => String::new(),
        };
        let mut truth = answer.truth.map_or("", Occupancy::name).to_owned();
        if answer.transition == Some(true) {
            truth.push('~');
        }
        let line = format!("{:7.2}s  {label:7} {values:23}  {truth:7} {:7.1} ms", answer.time_s, answer.latency_ms);
        if self.is_terminal {
            use std::io::Write;
            let mut stdout = std::io::stdout().lock();
            // A change stays on the screen; what is unchanged is written over.
            let end = if is_change && self.last.is_some() { "\n" } else { "" };
            write!(stdout, "{end}\r{line}\x1b[K")?;
            stdout.flush()?;
        } else {
            output::text_line(&line)?;
        }
        self.last = Some(state);
        Ok(())
    }

    fn summary(&mut self, summary: &Summary) -> anyhow::Result<()> {
        if self.json {
            return output::json_line(&json!({ "summary": summary }));
        }
        if self.is_terminal {
            println!();
        }
        let mut line = format!("{} frames, {} dropped", summary.frames, summary.dropped);
        if let Some(accuracy) = summary.balanced_accuracy {
            line += &format!(", balanced accuracy {accuracy:.3}");
        }
        if let Some(settled) = &summary.metrics_without_transitions {
            line += &format!(
                " ({:.3} without the {} frames of entering and leaving)",
                settled.balanced_accuracy, summary.transition_frames
            );
        }
        line += &format!(", latency {:.1} ms median, {:.1} ms p99", summary.latency_ms.p50, summary.latency_ms.p99);
        output::text_line(&line)
    }
}
