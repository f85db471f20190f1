//! `radome recording label`.

use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use radome_driver::LabelSpan;
use radome_driver::recording::Recording;
use radome_driver::recording::span_check::{ROUNDING_S, check_spans};
use radome_dsp::{Frame, FrameSource};
use serde_json::json;

use crate::dataset::detector;
use crate::exit::wrong_use;
use crate::labels::Added;
use crate::output_file::Overwrite;
use crate::{labels, output, source};

/// `radome recording label`
#[derive(clap::Args)]
#[command(
    group = clap::ArgGroup::new("what").multiple(true),
    after_help = "Examples:\n  \
                  radome recording label night.mcap --span 0:60=empty --span 75:120=one\n  \
                  radome recording label night.mcap --span 20:60=one --replace\n  \
                  radome recording label night.mcap -o night.txt"
)]
pub struct Arguments {
    /// Recording of any kind; labels are stored in an MCAP file, or in a file beside another kind
    recording: PathBuf,
    /// Interval and its label, such as 0.5:12=empty; may be given several times
    #[arg(long, value_name = "START_S:END_S=LABEL", group = "what", value_parser = parse_span, allow_hyphen_values = true)]
    span: Vec<LabelSpan>,
    /// File with labels: .txt is an Audacity label track, .label a DEEPCRAFT file, .json a JSON array
    #[arg(long, value_name = "FILE", group = "what")]
    from: Option<PathBuf>,
    /// Add labels from the truth of the frames, which simulations have, or from a classical detector
    #[arg(long, value_name = "PROPOSER", value_enum, group = "what")]
    propose: Option<Proposer>,
    /// Cut existing labels of classes where new ones overlap them. Without it, overlaps are refused
    #[arg(long, requires = "what", conflicts_with = "output")]
    replace: bool,
    /// Interval in which all labels are removed; may be given several times
    #[arg(long, value_name = "START_S:END_S", value_parser = parse_interval, allow_hyphen_values = true, conflicts_with = "output")]
    erase: Vec<(f64, f64)>,
    /// Write the labels to this file, .txt, .label or .json, instead of adding them to the recording. Without --span, --from and --propose,
    /// write the labels of the recording
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Author of the labels of --span and --from, stored with them in an MCAP recording; those of --propose name the proposer
    #[arg(long, value_name = "NAME", requires = "what")]
    who: Option<String>,
    /// Print a JSON list of objects
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum Proposer {
    Truth,
    Detector,
}

fn parse_interval(text: &str) -> Result<(f64, f64), String> {
    parse_times(text)
        .filter(|(start_s, end_s)| start_s < end_s)
        .ok_or_else(|| format!("'{text}': expected START_S:END_S such as 0.5:12, the end after the start"))
}

fn parse_span(text: &str) -> Result<LabelSpan, String> {
    let span = text.split_once('=').and_then(|(interval, label)| {
        let (start_s, end_s) = parse_times(interval)?;
        Some(LabelSpan::new(start_s, end_s, label.trim()))
    });
    let span = span.ok_or_else(|| format!("'{text}': expected START_S:END_S=LABEL such as 0.5:12=empty"))?;
    check_spans(std::slice::from_ref(&span), None).map_err(|error| error.to_string())?;
    Ok(span)
}

fn parse_times(text: &str) -> Option<(f64, f64)> {
    let (start, end) = text.split_once(':')?;
    Some((start.trim().parse().ok()?, end.trim().parse().ok()?))
}

/// Adds labels to a recording, or shows its labels.
///
/// # Errors
/// The recording or a file of labels cannot be read or written, or the labels contradict each other or the recording.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    if let Some(file) = &arguments.output {
        let inputs = arguments.from.iter().chain([&arguments.recording]);
        arguments.overwrite.check(file, &inputs.map(PathBuf::as_path).collect::<Vec<_>>())?;
    }
    let is_given = !arguments.span.is_empty() || arguments.from.is_some() || arguments.propose.is_some();
    if !is_given && arguments.erase.is_empty() {
        return show_labels(arguments);
    }
    arguments.check_who()?;
    let spans = arguments.new_labels()?;
    if spans.is_empty() && arguments.erase.is_empty() && arguments.output.is_none() {
        Recording::open(&arguments.recording)?;
        message!("no label was given or found; nothing has been written");
        return print(&spans, arguments.json);
    }
    let (Added { file, found }, erased) = match &arguments.output {
        Some(file) => {
            labels::check(&arguments.recording, &spans)?;
            labels::write_file(file, arguments.overwrite.existing(), &spans)?;
            (Added { file: file.clone(), found: 0 }, 0)
        }
        None => edit_recording(arguments, &spans)?,
    };
    let target = file.display();
    let label_count = |count: usize| format!("{count} label{}", if count == 1 { "" } else { "s" });
    match (arguments.erase.is_empty(), erased) {
        (true, _) => {}
        (false, 0) => message!("no label is there to be erased in {target}"),
        (false, erased) => message!("{} cut or removed in {target}", label_count(erased)),
    }
    if found > 0 {
        message!("{} there already in {target}", label_count(found));
    }
    let written = spans.len() - found;
    if written > 0 || spans.is_empty() && arguments.erase.is_empty() {
        message!("{} written to {target}", label_count(written));
    }
    print(&spans, arguments.json)
}

impl Arguments {
    /// Refuses `--who` where no label would hold the author.
    fn check_who(&self) -> anyhow::Result<()> {
        if self.who.is_none() {
            return Ok(());
        }
        if self.span.is_empty() && self.from.is_none() {
            wrong_use!(
                "--who names the author of labels by --span and --from, and there are none\n\nhint: leave it out; labels of --propose name \
                 the proposer"
            );
        }
        if self.output.is_some() || !Recording::open(&self.recording)?.format().holds_labels() {
            wrong_use!(
                "--who has no effect: files of labels hold no authors\n\nhint: leave it out; labels in an MCAP recording hold them"
            );
        }
        Ok(())
    }

    /// Refuses a short `--span` with a class that covers no frame. Files of labels may hold such labels: the page makes them.
    fn check_spans_cover_frames(&self) -> anyhow::Result<()> {
        let mut recording = Recording::open(&self.recording)?;
        let interval_s = recording.waveform().frame_interval_s();
        let mut frame = Frame::zeroed(recording.waveform().shape());
        let is_class = |span: &&LabelSpan| span.occupancy().is_some();
        // Frames of boards may be a little farther apart than requested.
        let is_short = |span: &&LabelSpan| span.end_s - span.start_s < 2.0 * interval_s;
        // Labels outside of the recording are refused for that reason, with all others.
        let extent_s = labels::extent_s(&mut recording)?;
        let is_inside = |span: &&LabelSpan| check_spans(std::slice::from_ref(*span), extent_s).is_ok();
        let short = self.span.iter().filter(is_class).filter(is_short).filter(is_inside);
        for LabelSpan { start_s, end_s, label, .. } in short {
            recording.seek_time_s((start_s - ROUNDING_S).max(0.0))?;
            if !source::next_frame(&mut recording, &mut frame)? || frame.time_s() + ROUNDING_S >= *end_s {
                wrong_use!(
                    "the label '{label}' from {start_s} to {end_s} s covers no frame: frames are {interval_s:.3} s apart"
                );
            }
        }
        Ok(())
    }

    /// Returns the labels of `--span`, `--from` and `--propose`, in order of time.
    fn new_labels(&self) -> anyhow::Result<Vec<LabelSpan>> {
        if !self.span.is_empty() {
            self.check_spans_cover_frames()?;
        }
        let mut spans = self.span.clone();
        if let Some(file) = &self.from {
            spans.extend(labels::read_file(file)?);
        }
        if let Some(who) = &self.who {
            spans.iter_mut().for_each(|span| span.who = Some(who.clone()));
        }
        match self.propose {
            Some(Proposer::Truth) => spans.extend(truth_labels(&self.recording)?),
            Some(Proposer::Detector) => spans.extend(detector::propose(&self.recording)?),
            None => {}
        }
        labels::sort_by_time(&mut spans);
        Ok(spans)
    }
}

/// Cuts `--erase` out of the labels of the recording, and, with `--replace`, the new labels out of those of classes. Then adds the
/// new labels. Returns what was added, and the number of labels that `--erase` concerned.
fn edit_recording(arguments: &Arguments, spans: &[LabelSpan]) -> anyhow::Result<(Added, usize)> {
    let mut erased = 0;
    let added = labels::add(&arguments.recording, spans, |existing| {
        let is_erased = |label: &&LabelSpan| arguments.erase.iter().any(|interval| labels::overlaps(label, *interval));
        erased = existing.iter().filter(is_erased).count();
        let erase = arguments.erase.iter();
        let existing = erase.fold(existing, |existing, interval| labels::cut_out(existing, *interval, |_| true));
        let classes = spans.iter().filter(|span| arguments.replace && span.occupancy().is_some());
        classes.fold(existing, |existing, span| {
            labels::cut_out(existing, (span.start_s, span.end_s), |other| other.occupancy().is_some())
        })
    })?;
    Ok((added, erased))
}

/// Prints the labels of a recording in order of time, and writes them to the output file, if one is named.
fn show_labels(arguments: &Arguments) -> anyhow::Result<()> {
    let mut spans = labels::of_recording(&arguments.recording)?;
    labels::sort_by_time(&mut spans);
    if let Some(file) = &arguments.output {
        labels::write_file(file, arguments.overwrite.existing(), &spans)?;
    }
    print(&spans, arguments.json)
}

fn print(spans: &[LabelSpan], as_json: bool) -> anyhow::Result<()> {
    if as_json {
        return output::json_line(&json!(spans));
    }
    for LabelSpan { start_s, end_s, label, confidence, .. } in spans {
        let confidence = confidence.map_or_else(String::new, |c| format!("{c:.2}"));
        let label = output::on_one_line(label);
        output::text_line(&format!("{start_s:10.3} s  {end_s:10.3} s  {label}  {confidence}"))?;
    }
    Ok(())
}

/// Makes labels of the truth of the frames.
fn truth_labels(path: &Path) -> anyhow::Result<Vec<LabelSpan>> {
    let mut recording = Recording::open(path)?;
    let interval_s = recording.waveform().frame_interval_s();
    let mut frame = Frame::zeroed(recording.waveform().shape());
    let mut frames = Vec::new();
    while source::next_frame(&mut recording, &mut frame)? {
        let truth = frame.truth.with_context(|| {
            format!(
                "{}: frame {} has no truth\n\nhint: simulated recordings have it; for others: --propose detector",
                path.display(),
                frame.sequence
            )
        })?;
        frames.push((frame.time_s(), truth.occupancy));
    }
    ensure!(!frames.is_empty(), "{}: no frame", path.display());
    let mut spans = labels::spans_of(&frames, interval_s);
    for span in &mut spans {
        (span.who, span.confidence) = (Some("truth".into()), Some(1.0));
    }
    Ok(spans)
}
