//! `radome recording info`.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use radome_driver::recording::{Format, Recording};
use radome_dsp::Waveform;
use serde::Serialize;
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
    let info = Info::read(&arguments.recording)?;
    if arguments.json { output::json_line(&json!(info)) } else { info.print() }
}

/// Description of a recording, with the keys of `--json`.
#[derive(Serialize)]
struct Info {
    path: String,
    format: &'static str,
    finished: bool,
    frames: u64,
    /// Number of gaps; `None` where the format does not store them.
    gaps: Option<u64>,
    /// Number of frames that are missing by their sequence numbers.
    missing: u64,
    duration_s: f64,
    waveform: Waveform,
    board: Option<String>,
    /// Total time of each label, s.
    labelled_s: BTreeMap<String, f64>,
    model: Option<String>,
}

impl Info {
    /// Reads the description. Prints a message if the recording is cut short.
    fn read(path: &Path) -> anyhow::Result<Self> {
        let mut recording = Recording::open(path)?;
        let header = recording.header();
        let frames = recording.whole_frames();
        let extent = recording.extent()?;
        let interval_s = header.waveform.frame_interval_s();
        let duration_s = extent.map_or(0.0, |extent| extent.last.time_s() - extent.first.time_s() + interval_s);
        let numbers =
            extent.map_or(0, |extent| (extent.last.sequence.saturating_add(1)).saturating_sub(extent.first.sequence));
        let (format, finished) = (recording.format(), recording.is_complete());
        // An MCAP file may be one that is being recorded.
        if !finished && format != Format::Mcap {
            message!("{}: the recording is cut short", path.display());
        }
        let mut labelled_s: BTreeMap<String, f64> = BTreeMap::new();
        for span in labels::of_recording(path)? {
            *labelled_s.entry(span.label).or_default() += span.end_s - span.start_s;
        }
        Ok(Info {
            path: path.display().to_string(),
            format: format.name(),
            finished,
            frames,
            gaps: recording.gap_count(),
            missing: numbers.saturating_sub(frames),
            duration_s,
            board: header.board.map(|board| format!("{}, firmware {}", board.name, board.firmware_version)),
            labelled_s,
            model: header.judge.map(|judge| judge.model),
            waveform: header.waveform,
        })
    }

    /// Prints the description as a table.
    fn print(&self) -> anyhow::Result<()> {
        let Info { frames, missing, duration_s, waveform, .. } = self;
        let label = |(label, seconds): (&String, &f64)| format!("{} {seconds:.1} s", output::on_one_line(label));
        let labels: Vec<String> = self.labelled_s.iter().map(label).collect();
        let or_none = |text: Option<String>| text.unwrap_or_else(|| "none".to_owned());
        let gaps = self.gaps.map_or_else(|| "unknown".to_owned(), |count| count.to_string());
        for (name, value) in [
            ("format", self.format.to_owned()),
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
            ("board", or_none(self.board.clone())),
            ("labels", or_none((!labels.is_empty()).then(|| labels.join(", ")))),
            ("model", or_none(self.model.clone())),
        ] {
            output::text_line(&format!("{name:12} {value}"))?;
        }
        Ok(())
    }
}
