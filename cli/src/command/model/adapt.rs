mod curve;
mod feature_reader;

use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use radome_driver::recording::Recording;
use radome_dsp::{FrameSource, Occupancy};
use radome_models::Dataset;
use radome_models::train::{AdaptRecording, Adaptation, Adapter, BeforeAfter};
use serde_json::json;

use self::feature_reader::FeatureReader;
use super::evaluate::LabelledRecording;
use crate::classifier::{CFAR, Model};
use crate::output_file::{MODEL_HINT, Overwrite, check_ending};
use crate::{files, output, source};

/// `radome model adapt`
#[derive(clap::Args)]
#[command(after_help = "Examples, with recordings that are labelled, and with recordings of one class each:\n  \
                  radome model adapt room-hqnn monday.mcap tuesday.mcap -o my-room.safetensors\n  \
                  radome model adapt room-hqnn a.mcap=empty b.mcap=empty c.mcap=one d.mcap=one -o mine.safetensors")]
pub struct Arguments {
    /// Model file, or room-hqnn, which is built in
    model: PathBuf,
    /// Recordings of the room: a recording with labels, RECORDING=LABELS.txt, .label or .json, or RECORDING=empty, RECORDING=one,
    /// RECORDING=two for a recording of one class. Each recording whose classes are also in other recordings is held out in turn,
    /// to measure the gain
    #[arg(value_name = "RECORDING[=LABEL]", value_hint = clap::ValueHint::AnyPath, required_unless_present_any = ["empty", "curve"])]
    recordings: Vec<String>,
    /// Recording of the empty room, the same as RECORDING=empty; may be given several times
    #[arg(long, value_name = "RECORDING")]
    empty: Vec<PathBuf>,
    /// Count only people up to this distance from the radar, m, as `live --max-range-m` will. The labels must be of these people
    #[arg(long, value_name = "METRES", value_parser = source::positive, conflicts_with = "curve")]
    max_range_m: Option<f64>,
    /// Dataset folder with simulated maps to mix in, so that the model keeps its accuracy in other rooms
    #[arg(long, value_name = "DATASET")]
    simulated: Option<PathBuf>,
    /// Measure accuracy against minutes of labels instead, on the simulated rooms of a file such as fixtures/strangers.toml. The
    /// model is adapted to each room and evaluated on other recordings of this room and of the other rooms
    #[arg(long, value_name = "FILE.toml", conflicts_with_all = ["recordings", "empty", "output"])]
    curve: Option<PathBuf>,
    /// Model file to write. Without it, only report the gain
    #[arg(short, long, value_name = "FILE.safetensors")]
    output: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Write the model even if it is worse than before on the held-out recordings
    #[arg(long)]
    force: bool,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// Adapts a model to a room and reports the change of its scores on held-out recordings.
///
/// # Errors
/// The model or a recording cannot be read, nothing is labelled, or the adapted model is worse and not forced.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    if let Some(path) = &arguments.output {
        // The model may be replaced by the adapted one.
        let mut inputs: Vec<&Path> = arguments.empty.iter().map(PathBuf::as_path).collect();
        for argument in &arguments.recordings {
            let (recording, labels) = argument.rsplit_once('=').unwrap_or_default();
            inputs.extend([argument.as_str(), recording, labels].map(Path::new));
        }
        arguments.overwrite.check(path, &inputs)?;
        check_ending(path, &["safetensors"], MODEL_HINT)?;
    }
    ensure!(
        !arguments.model.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("onnx")),
        "{}: an ONNX file cannot be adapted\n\nhint: adapt the .safetensors file that it was exported from, and export that",
        arguments.model.display()
    );
    let model = Model::open(&arguments.model)?;
    if matches!(model, Model::Cfar) {
        bail!("{CFAR} is not trained, so it cannot be adapted\n\nhint: name a model file");
    }
    let mut adapter = Adapter::new(crate::classifier::network(&arguments.model)?)?;
    if let Some(folder) = &arguments.simulated {
        adapter.mix(&Dataset::open(folder)?).with_context(|| folder.display().to_string())?;
    }
    if let Some(rooms) = &arguments.curve {
        return curve::run(model, &adapter, rooms, arguments.json);
    }
    let inputs = parse_inputs(arguments)?;
    let mut reader = FeatureReader::new(model, &adapter, arguments.max_range_m);
    let bar = output::progress(inputs.len() as u64, "reading");
    let mut recordings = Vec::with_capacity(inputs.len());
    for input in &inputs {
        recordings.push(read_recording(&mut reader, input)?);
        bar.inc(1);
    }
    bar.finish_and_clear();
    for input in &inputs {
        adapter.add_sequence(&source::name_of(&input.path).to_string_lossy());
        adapter.add_sequence(&input.sequence_name());
    }
    let adaptation = adapter.adapt(&recordings)?;
    let is_refused = adaptation.adapted.held_out.is_some_and(|scores| scores.is_worse()) && !arguments.force;
    let written = arguments.output.as_ref().filter(|_| !is_refused);
    if let Some(path) = written {
        files::write_bytes(path, arguments.overwrite.existing(), &adaptation.model.to_bytes(path)?)?;
    }
    print_report(arguments, &inputs, &recordings, &adaptation, written)?;
    if let Some(path) = arguments.output.as_ref().filter(|_| is_refused) {
        bail!(
            "{} is not written: the adapted model judges recordings that were held out worse than the model before\n\nhint: \
             label more recordings, or --force",
            path.display()
        );
    }
    Ok(())
}

/// Opens the recordings with their labels.
fn parse_inputs(arguments: &Arguments) -> anyhow::Result<Vec<LabelledRecording>> {
    let empty = arguments.empty.iter().map(|path| format!("{}=empty", path.display()));
    LabelledRecording::parse_all(arguments.recordings.iter().cloned().chain(empty))
}

fn read_recording(reader: &mut FeatureReader, recording: &LabelledRecording) -> anyhow::Result<AdaptRecording> {
    let name = || recording.path.display().to_string();
    let mut source = Recording::open(&recording.path)?;
    let waveform = source.waveform().clone();
    let features = reader.read(&mut source, |frame| recording.truth(frame, &waveform)).with_context(name)?;
    if features.frames.is_empty() {
        return Err(recording.without_frames());
    }
    ensure!(
        features.frames.iter().any(|frame| frame.label.is_some()),
        "{0}: no label\n\nhint: label it on the page of radome live {0} --view, or by radome recording label; or say what all of \
         it shows: {0}=empty",
        name()
    );
    Ok(features)
}

fn print_report(
    arguments: &Arguments,
    inputs: &[LabelledRecording],
    recordings: &[AdaptRecording],
    adaptation: &Adaptation,
    written: Option<&PathBuf>,
) -> anyhow::Result<()> {
    let Adaptation { adapted, held_out, recordings_by_class, is_measured, is_too_short, is_simulated, .. } = adaptation;
    let file = written.map(|path| path.display().to_string());
    for ((class, seconds), _) in
        Occupancy::ALL.into_iter().zip(adapted.seconds).zip(is_too_short).filter(|(_, short)| **short)
    {
        message!(
            "warning: {class} is labelled for {seconds} s only, too short to learn from: it counts as a class without labels"
        );
    }
    let mut not_measured = Vec::new();
    let counts = Occupancy::ALL.into_iter().zip(*recordings_by_class).zip(*is_measured);
    for ((class, count), _) in counts.filter(|(_, is_measured)| !is_measured) {
        let why = match count {
            0 if is_simulated[class.index()] => "no recording shows it; it is learnt from simulated maps only",
            0 => "no recording shows it; it is told from its neighbour about as before",
            1 => "only one recording shows it; held out, nothing would be left to adapt to",
            _ => "each recording that shows it also shows a class that the others show too briefly, or not at all",
        };
        message!("warning: {class} cannot be measured: {why}");
        not_measured.push(json!({ "class": class, "recordings": count, "why": why }));
    }
    let all = inputs.iter().zip(recordings).zip(held_out);
    if arguments.json {
        let recordings: Vec<_> = all
            .map(|((input, recording), held_out)| {
                json!({ "path": input.path.display().to_string(), "seconds": recording.seconds(), "held_out": held_out })
            })
            .collect();
        return output::json_line(&json!({
            "file": file, "adapted": adapted, "recordings": recordings, "not_measured": not_measured,
        }));
    }
    for ((input, recording), held_out) in all {
        let [empty, one, two] = recording.seconds();
        let scores = held_out.map_or("not measured".to_owned(), |scores| scores_text(&scores));
        let seconds = format!("{empty:.0} s empty, {one:.0} s one, {two:.0} s two");
        output::text_line(&format!("{}: {seconds}; held out: {scores}", input.path.display()))?;
    }
    match adapted.held_out {
        Some(scores) => output::text_line(&format!("all, each held out in turn: {}", scores_text(&scores)))?,
        None => output::text_line("nothing is measured: what a recording shows has to be in another one, too")?,
    }
    match file {
        Some(file) => {
            let strength_s = adapted.strength;
            output::text_line(&format!("{file} written; regularised towards the model before, strength {strength_s} s"))
        }
        None => Ok(()),
    }
}

/// Formats the scores for the terminal.
fn scores_text(scores: &BeforeAfter) -> String {
    let BeforeAfter { before, after } = scores;
    format!(
        "balanced accuracy by frame {:.3}, before {:.3}; filtered {:.3}, before {:.3}",
        after.by_frame, before.by_frame, after.filtered, before.filtered
    )
}
