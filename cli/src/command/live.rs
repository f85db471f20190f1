use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context;
use radome_driver::{RecorderOptions, RecordingHeader};
use radome_models::model::BUILT_IN;

use crate::classifier::{Delays, Model};
use crate::exit::{Completion, wrong_use};
use crate::live::background::Background;
use crate::live::classify::{LiveClassifier, run as run_classifier};
use crate::live::integrations::{self, Integrations};
use crate::live::pipeline::{Pipeline, Policy};
use crate::live::recorder::{RecorderSink, STALL_LIMIT};
use crate::live::screen::Screen;
use crate::live::sink::Sink;
use crate::live::view;
use crate::output_file::{self, NewRecording, Overwrite};
use crate::source::{self, Source, SourceArgs, SourceOptions};
use crate::{labels, output};

/// Seed of a simulation that no training of the shipped models has seen.
pub const UNSEEN_SEED: u64 = 100_001;

/// `radome live`
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  \
                        radome live auto --view\n  \
                        radome live night.mcap --view\n  \
                        radome live auto --mqtt mqtt://radar@homeassistant.local --mqtt-password-file radar.password\n\n\
                        Exit status: 0 if all went well, 3 if frames are missing in the recording of -o (0 with --allow-loss), 1 if the \
                        source, the recording or the program failed. If the recording fails, as on a full disk, live reports it at \
                        once, marks the file unfinished, goes on classifying, and ends with 1.")]
#[command(mut_arg("speed", |speed| speed.help("Pace as a multiple of real time; 0 is as fast as possible. If absent, 1 for a \
                                               recording with --view and 0 otherwise")))]
#[command(mut_arg("seed", |seed| seed.help("Seed of a simulation; 100001 if absent, which no training of the shipped models has seen")))]
#[command(mut_arg("overwrite", |overwrite| overwrite.help("Replace the output file, at the start, if it exists")))]
pub struct Arguments {
    #[command(flatten)]
    pub source: SourceArgs,
    /// Model file; room-hqnn, which is built in and takes nearly any waveform; or cfar, the classical detector, for any waveform
    /// of at least 20 samples and 2 chirps. A board is programmed with the model's waveform, which cfar does not have
    #[arg(long, default_value = BUILT_IN)]
    pub model: PathBuf,
    /// Record frames and answers to this MCAP file. In a folder, the file is named by the time (UTC); {time} in a name is replaced
    /// by the time. Not for a recording that --view plays
    #[arg(short, long, value_name = "FILE.mcap")]
    pub output: Option<PathBuf>,
    /// End with exit status 0 instead of 3 if frames are missing in the recording of -o
    #[arg(long, requires = "output")]
    pub allow_loss: bool,
    #[command(flatten)]
    pub overwrite: Overwrite,
    /// Measurement of the empty room by `radome model background`, so that fans and curtains do not count as people
    #[arg(long, value_name = "FILE.json")]
    pub background: Option<PathBuf>,
    /// Count only people up to this distance from the radar, m: at a desk, in a bed, before a door. Somebody up to half a metre beyond
    /// may still count. For cfar and for models with maps on physical axes, such as the room models
    #[arg(long, value_name = "METRES", value_parser = source::positive)]
    pub max_range_m: Option<f64>,
    /// Seconds for which frames must agree before `occupied` or a greater number of people is reported
    #[arg(long, value_name = "SECONDS", default_value_t = Delays::default().on_s, value_parser = source::not_negative)]
    pub on_delay_s: f64,
    /// Seconds for which frames must agree before `empty` or a smaller number of people is reported
    #[arg(long, value_name = "SECONDS", default_value_t = Delays::default().off_s, value_parser = source::not_negative)]
    pub off_delay_s: f64,
    /// Print one JSON object per frame and one at the end
    #[arg(long)]
    pub json: bool,
    #[command(flatten)]
    pub view: view::Arguments,
    #[command(flatten)]
    pub integrations: integrations::Arguments,
}

/// Classifies the frames of a source until it ends, is stopped, or has delivered enough frames. The summary counts
/// missing frames; they count as lost only in a recording.
///
/// # Errors
/// The model, the source or the output cannot be opened, or the run fails.
pub fn run(arguments: &Arguments) -> anyhow::Result<Completion> {
    let started = Instant::now();
    output::catch_interrupts()?;
    arguments.check_access()?;
    let broker = arguments.integrations.broker()?;
    let output = arguments.new_recording()?;
    let mut model = Model::open(&arguments.model)?;
    let description = model.description(&arguments.model, arguments.delays(), arguments.max_range_m)?;
    let background = arguments.background.as_deref().map(|path| Background::load(path, &description)).transpose()?;
    let source = arguments.open_source(&model)?;
    let mut classifier = arguments.classifier(&mut model, background, &source, started)?;
    // Opened before anything is written, so that a page that cannot be served leaves files unchanged.
    let has_failed = Arc::<AtomicBool>::default();
    let recording = output.as_ref().map(|output| (output.path(), has_failed.clone()));
    let name = arguments.integrations.name();
    let page = view::Page::open(&arguments.view, &source, &arguments.model, arguments.max_range_m, recording, name)?;
    let header = source.header(Some(description));
    // A recording must not use the identity of the board that made it: the broker would drop that board's own connection.
    let board = source.board.as_ref().filter(|_| !source.is_recording);
    let mut integrations =
        Integrations::open(&arguments.integrations, broker, &arguments.view.access, &header, board, started)?;
    let screen = Screen::new(arguments.json, source.is_live)?;

    let mut pipeline = Pipeline::default();
    let policy = if source.is_live { Policy::DropOldest } else { Policy::Wait };
    // The recorder gets each frame first: a frame that has been classified is then in the recording.
    let recorder = output.map(|output| arguments.recorder(output, &header, &mut pipeline, &source, has_failed));
    let recorder = recorder.transpose()?;
    let inlet = pipeline.consumer("classifier", 16, policy);
    let reader = pipeline.start(source.frames, arguments.source.frames);
    let poll_interval = Duration::from_secs_f64((2.0 * header.waveform.frame_interval_s()).clamp(0.1, 1.0));
    let has_gaps = recorder.as_ref().map(RecorderSink::has_gaps);
    let mut sinks: Vec<Box<dyn Sink>> = integrations.take_sinks();
    sinks.extend(recorder.map(|recorder| Box::new(recorder) as Box<dyn Sink>));
    sinks.extend(page.map(|page| Box::new(page) as Box<dyn Sink>));
    sinks.push(Box::new(screen));
    let outcome = run_classifier(&inlet, &mut classifier, poll_interval, &mut sinks);
    reader.stop();
    drop(integrations);
    outcome?;
    let is_lost = has_gaps.is_some_and(|has_gaps| has_gaps.load(Ordering::Relaxed)) && !arguments.allow_loss;
    if is_lost {
        message!("frames are missing in the recording; with --allow-loss this is no error");
    }
    Ok(Completion::from_loss(is_lost))
}

impl Arguments {
    /// Refuses options of access without a page or metrics, and metrics that anyone in the network could read.
    fn check_access(&self) -> anyhow::Result<()> {
        if self.view.access.is_given() && !self.view.is_wanted() && !self.integrations.has_metrics() {
            wrong_use!(
                "--token-file and --allow-host are for a page or metrics\n\nhint: add --view or --metrics ADDRESS:PORT"
            );
        }
        self.integrations.check_metrics(&self.view.access)
    }

    /// Returns the recording that `-o` names, if its file can be written.
    fn new_recording(&self) -> anyhow::Result<Option<NewRecording>> {
        let Some(output) = self.output.as_deref().map(NewRecording::named) else { return Ok(None) };
        output_file::check_is_mcap(output.path())?;
        let background = self.background.as_deref().unwrap_or(Path::new(""));
        let [source, waveform] = self.source.inputs();
        self.overwrite.check(output.path(), &[source, waveform, &self.model, background])?;
        Ok(Some(output))
    }

    fn delays(&self) -> Delays {
        Delays { on_s: self.on_delay_s, off_s: self.off_delay_s }
    }

    /// Opens the source, and prints on stderr what it is and which model classifies its frames.
    fn open_source(&self, model: &Model) -> anyhow::Result<Source> {
        let source = source::open(&self.source.source, &self.source_options(model)?)?;
        // The page repeats and skips frames, which no recording may.
        if source.playback.is_some() && self.output.is_some() {
            wrong_use!(
                "-o cannot record a recording that the page plays: seeks and steps on the page would repeat frames and leave others out\n\n\
                 hint: leave out --view or -o; radome recording convert copies a recording"
            );
        }
        message!("{}", source.description);
        if self.output.is_some() {
            labels::warn_not_copied(self.source.input());
        }
        message!("model {}", self.model.display());
        Ok(source)
    }

    /// Builds the options of the source. A board is programmed with a waveform that the model accepts.
    fn source_options(&self, model: &Model) -> anyhow::Result<SourceOptions> {
        let options = self.source.options()?;
        if let (Some(name), Some(waveform)) = (&self.source.waveform, &options.waveform) {
            model.check_waveform(waveform).with_context(|| {
                format!(
                    "--waveform {name} contradicts {}\n\nhint: leave --waveform away and the board is programmed with the model's own; \
                     --model cfar takes nearly any",
                    self.model.display()
                )
            })?;
        }
        let seed = self.source.seed.unwrap_or(UNSEEN_SEED);
        let (model_waveform, as_playback) = (model.waveform().cloned(), self.view.is_wanted());
        Ok(SourceOptions { model_waveform, seed, as_playback, ..options })
    }

    /// Prepares the classifier for the frames of the source.
    fn classifier<'m>(
        &self,
        model: &'m mut Model,
        background: Option<Background>,
        source: &Source,
        started: Instant,
    ) -> anyhow::Result<LiveClassifier<'m>> {
        let waveform = source.frames.waveform();
        if let (Some(background), Some(path)) = (&background, &self.background) {
            background.check_waveform(path, waveform)?;
        }
        let classifier = LiveClassifier::new(model, waveform, self.delays(), self.max_range_m, started)?
            .with_background(background)
            .with_outage(source.outage.clone());
        let Some(playback) = &source.playback else { return Ok(classifier) };
        playback.transport.set_preroll_s(classifier.memory_s());
        Ok(classifier.with_transport(playback.transport.clone()))
    }

    /// Starts to record frames and answers. Frames of a board must not be lost meanwhile.
    fn recorder(
        &self,
        output: NewRecording,
        header: &RecordingHeader,
        pipeline: &mut Pipeline,
        source: &Source,
        has_failed: Arc<AtomicBool>,
    ) -> anyhow::Result<RecorderSink> {
        let policy = if source.is_live { Policy::LosslessOrAbandoned(STALL_LIMIT) } else { Policy::Wait };
        let options = RecorderOptions { existing: self.overwrite.existing(), ..RecorderOptions::default() };
        let inlet = pipeline.consumer("recorder", 64, policy);
        RecorderSink::start(output, header, &options, inlet, source.outage.clone(), has_failed)
    }
}
