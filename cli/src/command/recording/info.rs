//! `radome recording info`.

use std::collections::BTreeMap;
use std::path::PathBuf;

use radome_driver::recording::{Format, Recording};
use serde_json::json;

use crate::{labels, output};

/// `radome recording info`
#[derive(clap::Args)]
pub struct Arguments {
    /// Recording: MCAP file, Infineon folder or text file
    recording: PathBuf,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// Prints format, length, waveform, board, labels and model of a recording.
///
/// # Errors
/// The recording or its labels cannot be read.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let path = &arguments.recording;
    let mut recording = Recording::open(path)?;
    let header = recording.header();
    let waveform = &header.waveform;
    let frames = recording.whole_frames();
    let gaps = recording.gap_count();
    let extent = recording.extent()?;
    let duration_s =
        extent.map_or(0.0, |extent| extent.last.time_s() - extent.first.time_s() + waveform.frame_interval_s());
    let numbers =
        extent.map_or(0, |extent| (extent.last.sequence.saturating_add(1)).saturating_sub(extent.first.sequence));
    let missing = numbers.saturating_sub(frames);
    let (format, is_finished) = (recording.format(), recording.is_complete());
    // An MCAP file may be one that is being recorded.
    if !is_finished && format != Format::Mcap {
        message!("{}: the recording is cut short", path.display());
    }
    let spans = labels::of_recording(path)?;
    let mut labelled_s: BTreeMap<&str, f64> = BTreeMap::new();
    for span in &spans {
        *labelled_s.entry(&span.label).or_default() += span.end_s - span.start_s;
    }
    let board = header.board.as_ref().map(|board| format!("{}, firmware {}", board.name, board.firmware_version));
    let model = header.judge.as_ref().map(|judge| judge.model.as_str());
    if arguments.json {
        return output::json_line(&json!({
            "path": path.display().to_string(),
            "format": format.name(),
            "finished": is_finished,
            "frames": frames,
            "gaps": gaps,
            "missing": missing,
            "duration_s": duration_s,
            "waveform": waveform,
            "board": board,
            "labelled_s": labelled_s,
            "model": model,
        }));
    }
    let labels: Vec<String> =
        labelled_s.iter().map(|(label, seconds)| format!("{} {seconds:.1} s", output::on_one_line(label))).collect();
    let or_none = |text: Option<String>| text.unwrap_or_else(|| "none".to_owned());
    let gaps = gaps.map_or_else(|| "unknown".to_owned(), |count| count.to_string());
    for (name, value) in [
        ("format", format.name().to_owned()),
        ("frames", frames.to_string()),
        ("missing", format!("{missing} frames by their numbers; gaps: {gaps}")),
        ("duration", format!("{duration_s:.3} s")),
        ("frame", waveform.shape().to_string()),
        (
            "band",
            format!(
                "{:.3} GHz, {:.1} MHz sampled",
                waveform.centre_frequency_hz() * 1e-9,
                waveform.sampled_bandwidth_hz() * 1e-6
            ),
        ),
        ("frame rate", format!("{:.3} Hz", 1.0 / waveform.frame_interval_s())),
        ("board", or_none(board)),
        ("labels", or_none((!labels.is_empty()).then(|| labels.join(", ")))),
        ("model", or_none(model.map(str::to_owned))),
    ] {
        output::text_line(&format!("{name:12} {value}"))?;
    }
    Ok(())
}
