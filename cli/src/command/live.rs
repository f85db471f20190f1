use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use radome_driver::{RecorderOptions, RecordingHeader};
use radome_dsp::Waveform;

use crate::exit::Ended;
use crate::judge::{BUILT_IN, Delays, Model};
use crate::live::background::Background;
use crate::live::classify::{FrameClassifier, run as run_classifier};
use crate::live::integrations::{self, Integrations};
use crate::live::pipeline::{Pipeline, Policy};
use crate::live::recorder::RecorderSink;
use crate::live::screen::Screen;
use crate::live::sink::Sink;
use crate::live::view;
use crate::output;
use crate::output_file::{self, Overwrite};
use crate::source::{self, SourceArgs, SourceOptions};

/// Seed of a simulation that no training of the shipped models has seen.
pub const UNSEEN_SEED: u64 = 100_001;

/// `radome live`
#[derive(clap::Args)]
#[command(
    after_help = "Exit status: 0 if all went well, 3 if frames are missing in the recording of -o (0 with --allow-loss), 1 if the \
                        source, the recording or the program failed. A recording that fails, as on a full disk, is said at once and \
                        marked unfinished; answers go on without it, and the status is 1 at the end."
)]
pub struct Arguments {
    #[command(flatten)]
    source: SourceArgs,
    /// Model file, which names the waveform that a board is programmed with; room-hqnn, which is built in and takes nearly any
    /// waveform; or cfar, the classical detector, for any waveform
    #[arg(long, default_value = BUILT_IN)]
    model: PathBuf,
    /// Record frames and answers to this MCAP file. In a folder it is a file with the time (UTC) as its name; {time} in a name stands
    /// for the time
    #[arg(short, long, value_name = "FILE.mcap")]
    output: Option<PathBuf>,
    /// End with exit status 0 although frames are missing in the recording of -o, instead of with 3
    #[arg(long)]
    allow_loss: bool,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Measurement of the empty room by `radome model background`: fans and curtains then count as nobody
    #[arg(long, value_name = "FILE.json")]
    background: Option<PathBuf>,
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
    #[command(flatten)]
    integrations: integrations::Arguments,
}

/// Online classification of any source.
///
/// # Errors
/// The model, the source or the output cannot be opened, or the run fails.
pub fn run(arguments: &Arguments) -> anyhow::Result<Ended> {
    let output = arguments.output.as_deref().map(output_file::dated);
    watch(&Watch {
        source: &arguments.source.source,
        model: &arguments.model,
        waveform: arguments.source.waveform.as_deref(),
        seed: arguments.source.seed.unwrap_or(UNSEEN_SEED),
        people: arguments.source.people,
        frames: arguments.source.frames,
        speed: arguments.source.speed,
        json: arguments.json,
        delays: Delays { on_s: arguments.on_delay_s, off_s: arguments.off_delay_s },
        view: &arguments.view,
        output: output.as_deref(),
        overwrite: arguments.overwrite,
        background: arguments.background.as_deref(),
        integrations: &arguments.integrations,
        allow_loss: arguments.allow_loss,
        give_up_after: arguments.source.give_up_after_s,
    })
}

/// Inputs and options of `live` and `demo`.
pub struct Watch<'a> {
    pub source: &'a str,
    pub model: &'a Path,
    /// Waveform to program a board with, if not the model's.
    pub waveform: Option<&'a str>,
    pub seed: u64,
    /// People that a simulation is forced to have.
    pub people: Option<usize>,
    /// Frames to stop after.
    pub frames: Option<u64>,
    /// Times real time; 0 is as fast as it goes. `None`: recordings at their own pace, all else as fast as it goes.
    pub speed: Option<f64>,
    pub json: bool,
    pub delays: Delays,
    pub view: &'a view::Arguments,
    /// Recording to write.
    pub output: Option<&'a Path>,
    pub overwrite: Overwrite,
    /// Capture of the empty room.
    pub background: Option<&'a Path>,
    pub integrations: &'a integrations::Arguments,
    /// Whether gaps in the recording count as success.
    pub allow_loss: bool,
    /// Time for which a lost board is looked for; the default if `None`.
    pub give_up_after: Option<Duration>,
}

/// Watches a source until it ends, is stopped, or has given enough frames. Frames that are missing are in the summary; only in a
/// recording do they count as lost.
///
/// # Errors
/// The model, the source or the output cannot be opened, or the run fails.
pub fn watch(watch: &Watch) -> anyhow::Result<Ended> {
    let started = Instant::now();
    output::catch_interrupts()?;
    watch.check_output()?;
    let model = Model::open(watch.model)?;
    let named = model.named(watch.model, watch.delays)?;
    let background = watch.background.map(|path| Background::load(path, &named)).transpose()?;
    let source = source::open(watch.source, &watch.source_options(&model)?)?;
    eprintln!("{}", source.description);
    eprintln!("judged by {}", watch.model.display());
    let waveform = source.frames.waveform().clone();
    let mut judge = FrameClassifier::new(model, &waveform, watch.delays, started)?.with_background(background);
    if let Some(playback) = &source.playback {
        playback.transport.set_preroll_s(judge.memory_s());
    }
    // Before anything is written: a page that cannot be served leaves files as they are.
    let page = view::Page::open(watch.view, &source, watch.model, watch.output)?;
    let header = RecordingHeader {
        waveform,
        board: source.board.clone(),
        registers: source.registers.clone(),
        judge: Some(named),
    };
    let mut integrations = Integrations::open(watch.integrations, watch.view.access(), &header, started)?;
    let screen = Screen::new(watch.json)?;

    let mut pipeline = Pipeline::new();
    let policy = if source.is_live { Policy::DropOldest } else { Policy::Wait };
    let inlet = pipeline.consumer("classifier", 16, policy);
    let recorder = watch.output.map(|path| watch.recorder(path, &header, &mut pipeline, source.is_live)).transpose()?;
    let reader = pipeline.start(source.frames, watch.frames);
    let patience = Duration::from_secs_f64((2.0 * header.waveform.frame_interval_s()).clamp(0.1, 1.0));
    let has_gaps = recorder.as_ref().map(RecorderSink::has_gaps);
    let mut sinks: Vec<Box<dyn Sink>> = integrations.take_sinks();
    sinks.extend(recorder.map(|recorder| Box::new(recorder) as Box<dyn Sink>));
    sinks.extend(page.map(|page| Box::new(page) as Box<dyn Sink>));
    sinks.push(Box::new(screen));
    let outcome = run_classifier(&inlet, &mut judge, patience, &mut sinks);
    reader.stop();
    drop(integrations);
    outcome?;
    let is_lost = has_gaps.is_some_and(|has_gaps| has_gaps.load(Ordering::Relaxed)) && !watch.allow_loss;
    if is_lost {
        eprintln!("frames are missing in the recording; --allow-loss takes that for success");
    }
    Ok(Ended::with_loss(is_lost))
}

impl Watch<'_> {
    /// Refuses an output that cannot be written, before anything is opened.
    fn check_output(&self) -> anyhow::Result<()> {
        let Some(path) = self.output else { return Ok(()) };
        if is_same(path, Path::new(self.source)) {
            bail!("{} is source and output at once\n\nhint: choose another name", path.display());
        }
        self.overwrite.check(path)
    }

    /// Options of the source; a board is programmed with a waveform that the model can judge.
    fn source_options(&self, model: &Model) -> anyhow::Result<SourceOptions> {
        Ok(SourceOptions {
            waveform: waveform(self, model)?,
            seed: self.seed,
            people: self.people,
            frames: self.frames,
            speed: self.speed,
            as_playback: self.view.is_wanted(),
            give_up_after: self.give_up_after,
        })
    }

    /// Starts to record frames and answers; of a board none may be lost meanwhile.
    fn recorder(
        &self,
        path: &Path,
        header: &RecordingHeader,
        pipeline: &mut Pipeline,
        is_live: bool,
    ) -> anyhow::Result<RecorderSink> {
        let policy = if is_live { Policy::Lossless(Duration::from_secs(5)) } else { Policy::Wait };
        let options = RecorderOptions { existing: self.overwrite.existing(), ..RecorderOptions::default() };
        RecorderSink::start(path, header, &options, pipeline.consumer("recorder", 64, policy))
    }
}

/// Waveform to program a board with: the named one if the model can judge it, else the model's own.
fn waveform(watch: &Watch, model: &Model) -> anyhow::Result<Option<Waveform>> {
    let Some(named) = watch.waveform else { return Ok(model.waveform().cloned()) };
    let waveform = source::waveform(named)?;
    model.check_waveform(&waveform).with_context(|| {
        format!(
            "--waveform {named} contradicts {}\n\nhint: leave --waveform away and the board is programmed with the model's own; --model \
             cfar takes any",
            watch.model.display()
        )
    })?;
    Ok(Some(waveform))
}

fn is_same(a: &Path, b: &Path) -> bool {
    a.canonicalize().is_ok_and(|a| b.canonicalize().is_ok_and(|b| a == b))
}
