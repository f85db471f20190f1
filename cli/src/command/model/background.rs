use std::path::PathBuf;

use anyhow::{Context, ensure};
use radome_models::model::BUILT_IN;
use serde_json::json;

use crate::classifier::{Model, Prediction};
use crate::exit::wrong_use;
use crate::live::background::{Background, Capture, LEAST_FRAMES};
use crate::live::pipeline::Items;
use crate::output;
use crate::output_file::{Overwrite, check_ending};
use crate::source::{self, SourceArgs, not_negative, positive};

/// `radome model background`
#[derive(clap::Args)]
#[command(mut_arg("people", |people| people.help("Number of people in a simulated scene; 0 if absent")))]
pub struct Arguments {
    #[command(flatten)]
    source: SourceArgs,
    /// Model that you will use in the room
    #[arg(long, default_value = BUILT_IN)]
    model: PathBuf,
    /// Greatest distance from the radar at which people will count, m: the same as of `live --max-range-m`
    #[arg(long, value_name = "METRES", value_parser = positive)]
    max_range_m: Option<f64>,
    /// File to write, for `live --background`
    #[arg(short, long, value_name = "FILE.json")]
    output: PathBuf,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Duration of the measurement by the frames' own clock, s; if absent 60, or more where that would be too few frames
    #[arg(long, value_parser = not_negative)]
    seconds: Option<f64>,
    /// Print one JSON object at the end
    #[arg(long)]
    json: bool,
}

/// Captures the background level of an empty room.
///
/// # Errors
/// The model or the source cannot be opened, too few frames come, or the file cannot be written.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    output::catch_interrupts()?;
    let [source, waveform] = arguments.source.inputs();
    arguments.overwrite.check(&arguments.output, &[source, waveform, &arguments.model])?;
    check_ending(&arguments.output, &["json"], "end its name in .json")?;
    let mut model = Model::open(&arguments.model)?;
    let description = model.description(&arguments.model, Default::default(), arguments.max_range_m)?;
    let mut options = arguments.source.options()?;
    options.model_waveform = model.waveform().cloned();
    options.people.get_or_insert(0);
    let source = source::open(&arguments.source.source, &options)?;
    message!("{}; nobody should be in the room", source.description);
    let (waveform, is_live) = (source.frames.waveform().clone(), source.is_live);
    let least_s = LEAST_FRAMES as f64 * waveform.frame_interval_s();
    let seconds = arguments.seconds.unwrap_or(f64::max(60.0, 1.1 * least_s));
    if seconds < least_s {
        wrong_use!(
            "--seconds {seconds} are {:.0} frames of the empty room, expected {LEAST_FRAMES} at least\n\nhint: --seconds {:.0}",
            seconds / waveform.frame_interval_s(),
            (1.1 * least_s).ceil()
        );
    }
    let mut classifier = model.for_waveform(&waveform, arguments.max_range_m)?;
    let mut capture = Capture::default();
    let (mut start_s, mut measured_s) = (None, 0.0);
    let items = Items::of(source.frames, arguments.source.frames);
    while let Some(frame) = items.next_frame(|| classifier.reset_at_gap())? {
        let elapsed_s = frame.time_s() - *start_s.get_or_insert(frame.time_s());
        measured_s = elapsed_s + waveform.frame_interval_s();
        if elapsed_s > seconds {
            break;
        }
        if let Prediction::Probabilities(_) = classifier.classify(&frame)? {
            capture.add(classifier.map());
        }
    }
    ensure!(is_live || !output::interrupted(), "interrupted: nothing is written");
    let background: Background = capture
        .finish(&description, &waveform)
        .with_context(|| format!("{} is not captured", arguments.source.source))?;
    background.save(&arguments.output, arguments.overwrite.existing())?;
    // A recording may be shorter than the time that nobody asked for.
    if arguments.seconds.is_some() && measured_s + 0.5 * waveform.frame_interval_s() < seconds {
        message!(
            "warning: the frames of {} end after {measured_s:.1} s: the measurement is shorter than --seconds {seconds}",
            arguments.source.source
        );
    }
    let file = arguments.output.display().to_string();
    if arguments.json {
        let (frames, threshold_db) = (background.frames, background.threshold_db);
        return output::json_line(&json!({ "file": file, "frames": frames, "threshold_db": threshold_db }));
    }
    output::text_line(&format!(
        "{file}: the empty room over {} frames; a person counts from {:.0} dB above it on, summed over a map",
        background.frames, background.threshold_db
    ))
}
