//! Labels of recordings. They are stored in the recording if it can hold them, otherwise in a file beside it.

use std::collections::{BTreeMap, HashSet};
use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use radome_driver::LabelSpan;
use radome_driver::recording::label_text::{self, LabelTextError};
use radome_driver::recording::mcap::LabelEditor;
use radome_driver::recording::span_check::{ROUNDING_S, SpanError, check_spans};
use radome_driver::recording::{Existing, Partial, Recording, infineon};
use radome_dsp::{Frame, FrameSource, Occupancy, Truth, Waveform};
use radome_files::read_text;

use crate::files;
use crate::output::on_one_line;

/// Length limit of files of labels, bytes: more than a label for each frame of a day.
const LIMIT_BYTES: u64 = 64 << 20;

/// Time by which imported labels may reach beyond their recording, s, in addition to a share of the recording's length.
const OVERHANG_S: f64 = 1.0;
const OVERHANG_SHARE: f64 = 0.01;

/// Largest number of texts that a message lists.
const MOST_LISTED: usize = 10;

/// Reader and writer of a kind of label file.
struct Codec {
    parse: fn(&str) -> Result<Vec<LabelSpan>, LabelTextError>,
    print: fn(&[LabelSpan]) -> String,
    /// Parts of labels that this kind of file does not hold.
    lost_parts: &'static [Part],
}

/// Name of a part of labels, and a function that returns whether a label has it.
type Part = (&'static str, fn(&LabelSpan) -> bool);

/// Parts that Audacity's label track does not hold.
const LOST_IN_AUDACITY: &[Part] = &[
    ("authors", |label| label.who.is_some()),
    ("times of labelling", |label| label.made_ns.is_some()),
    ("confidences", |label| label.confidence.is_some()),
    ("notes", |label| label.note.is_some()),
];

/// Parts that DEEPCRAFT's file does not hold.
const LOST_IN_DEEPCRAFT: &[Part] = &[
    ("authors", |label| label.who.is_some()),
    ("times of labelling", |label| label.made_ns.is_some()),
    ("the lack of a confidence (1 is written)", |label| label.confidence.is_none()),
];

fn codec(path: &Path) -> anyhow::Result<Codec> {
    match path.extension().and_then(|e| e.to_str()) {
        Some("txt") => {
            Ok(Codec { parse: label_text::from_audacity, print: label_text::to_audacity, lost_parts: LOST_IN_AUDACITY })
        }
        Some("label") => Ok(Codec {
            parse: label_text::from_deepcraft,
            print: label_text::to_deepcraft,
            lost_parts: LOST_IN_DEEPCRAFT,
        }),
        Some("json") => Ok(Codec { parse: label_text::from_json, print: label_text::to_json, lost_parts: &[] }),
        _ => bail!(
            "{}: which kind of labels?\n\nhint: end its name in .txt for an Audacity label track, in .label for DEEPCRAFT, in .json for JSON",
            path.display()
        ),
    }
}

/// Reads a file of labels: `.txt` is an Audacity label track, `.label` a DEEPCRAFT file, `.json` a JSON array.
///
/// # Errors
/// The name has an unknown ending, or the file cannot be read or understood.
pub fn read_file(path: &Path) -> anyhow::Result<Vec<LabelSpan>> {
    let parse = codec(path)?.parse;
    let text = read_text(path, LIMIT_BYTES).with_context(|| format!("cannot read {}", path.display()))?;
    parse(&text).with_context(|| format!("{} cannot be understood", path.display()))
}

/// Reads a file of labels that is named in place of a recording's own.
///
/// # Errors
/// Those of [`read_file`], or no label of the file is a class.
pub fn read_replacing(path: &Path) -> anyhow::Result<Vec<LabelSpan>> {
    let spans = read_file(path)?;
    ensure!(
        spans.iter().any(|span| span.occupancy().is_some()),
        "{}: no label in it is empty, one or two\n\nhint: name a file that labels the recording, or none to take the recording's own labels",
        path.display()
    );
    Ok(spans)
}

/// Writes a file of labels atomically. Says which parts of the labels it does not hold.
///
/// # Errors
/// The name has an unknown ending, the file exists and is not to be replaced, or it cannot be written.
pub fn write_file(path: &Path, existing: Existing, spans: &[LabelSpan]) -> anyhow::Result<()> {
    let Codec { print, lost_parts, .. } = codec(path)?;
    let text = print(spans);
    files::write_output(path, existing, |file| file.write_all(text.as_bytes()).context("cannot write the labels"))?;
    for (what, has_part) in lost_parts {
        if spans.iter().any(has_part) {
            message!("not held by this format: {what}");
        }
    }
    Ok(())
}

/// Replaces the labels in the file beside a recording that cannot hold any by the result of `change`. No other process
/// writes to it meanwhile.
///
/// # Errors
/// The labels cannot be read or written, or `change` fails.
pub fn rewrite_beside(
    recording: &Path,
    file: &Path,
    change: impl FnOnce(Vec<LabelSpan>) -> anyhow::Result<Vec<LabelSpan>>,
) -> anyhow::Result<()> {
    let partial = Partial::labels(file)?;
    let print = codec(file)?.print;
    let text = print(&change(of_recording(recording)?)?);
    files::write_partial(&partial, |out| out.write_all(text.as_bytes()).context("cannot write the labels"))?;
    Ok(partial.finish()?)
}

/// Prints how many labels of a source are not copied to the recording of its frames.
pub fn warn_not_copied(source: &Path) {
    let count = of_recording(source).map_or(0, |labels| labels.len());
    if count > 0 {
        message!("{count} labels of {} are not carried over; radome recording convert copies them", source.display());
    }
}

/// Names of the file of labels in a recording that is a folder. The first is the one that is written.
pub const NAMES_IN_FOLDER: [&str; 3] = ["radome.label", "labels.label", "labels.txt"];

/// Path of the labels of a recording that cannot hold any: `radome.label` in a folder, `NAME.label` beside `NAME` or `NAME.txt`.
pub fn name_beside(recording: &Path) -> PathBuf {
    if recording.is_dir() {
        return recording.join(NAMES_IN_FOLDER[0]);
    }
    // Recordings of the vendor's SDK have no ending, and names such as walk_0.5m and walk_0.7m differ behind their last dot.
    if recording.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("txt")) {
        return recording.with_extension("label");
    }
    let mut name = recording.as_os_str().to_owned();
    name.push(".label");
    name.into()
}

/// Returns the file with the labels of a recording that cannot hold any, if the file exists. Its name is that of
/// [`name_beside`]. For a folder, all of [`NAMES_IN_FOLDER`] are searched, in the radar's folder and in that of the session,
/// whichever of the two is given.
pub fn file_beside(recording: &Path) -> Option<PathBuf> {
    if !recording.is_dir() {
        return Some(name_beside(recording)).filter(|path| path.is_file());
    }
    let radar = infineon::only_radar_of(recording).unwrap_or_else(|| recording.to_owned());
    // A path such as `.` does not name the session that contains the folder.
    let radar = if radar.file_name().is_none() { content_of(recording) } else { radar };
    let folders = [Some(radar.as_path()), infineon::session_of(&radar), Some(recording)];
    let names = |folder: &Path| NAMES_IN_FOLDER.map(|name| folder.join(name));
    folders.into_iter().flatten().flat_map(names).find(|path| path.is_file())
}

/// Path of a recording's content: its file, or the folder of its only radar, with links resolved. It is the same for all names
/// of a recording.
pub fn content_of(recording: &Path) -> PathBuf {
    let content = infineon::only_radar_of(recording).unwrap_or_else(|| recording.to_owned());
    content.canonicalize().unwrap_or(content)
}

/// Refuses recordings of which two are one by [`content_of`]: its frames would count twice.
///
/// # Errors
/// A recording is named twice.
pub fn check_named_once<'a>(recordings: impl IntoIterator<Item = &'a PathBuf>) -> anyhow::Result<()> {
    let mut seen = HashSet::new();
    for recording in recordings {
        ensure!(
            seen.insert(content_of(recording)),
            "{} is named twice\n\nhint: name each recording once",
            recording.display()
        );
    }
    Ok(())
}

/// Sorts labels by their start, then by their end.
pub fn sort_by_time(spans: &mut [LabelSpan]) {
    spans.sort_by(|a, b| a.start_s.total_cmp(&b.start_s).then(a.end_s.total_cmp(&b.end_s)));
}

/// Reads all labels of a recording.
///
/// # Errors
/// The recording or the file beside it cannot be read.
pub fn of_recording(recording: &Path) -> anyhow::Result<Vec<LabelSpan>> {
    let opened = Recording::open(recording)?;
    if opened.format().holds_labels() {
        return Ok(opened.labels()?);
    }
    file_beside(recording).map_or(Ok(Vec::new()), |file| read_file(&file))
}

/// Returns the truth of a frame by its labels: the class at its first chirp, and whether the class at its last chirp
/// differs.
pub fn truth_of_frame(spans: &[LabelSpan], frame: &Frame, waveform: &Waveform) -> Option<Truth> {
    let at = |time_s: f64| {
        let contains = |span: &&LabelSpan| {
            span.occupancy().is_some() && span.start_s <= time_s + ROUNDING_S && time_s + ROUNDING_S < span.end_s
        };
        spans.iter().find(contains)?.occupancy()
    };
    let first_s = frame.time_s();
    let last_s = first_s + waveform.request.chirps_per_frame as f64 * waveform.request.chirp_interval_s;
    let occupancy = at(first_s)?;
    Some(Truth { occupancy, transition: at(last_s).is_some_and(|last| last != occupancy) })
}

/// Rounds a time in seconds to whole nanoseconds.
fn to_ns(time_s: f64) -> f64 {
    (time_s * 1e9).round() / 1e9
}

/// Builds spans from the classes of single frames. A frame lasts until the next one, and the last one for a frame interval.
pub fn spans_of(frames: &[(f64, Occupancy)], interval_s: f64) -> Vec<LabelSpan> {
    let mut spans: Vec<LabelSpan> = Vec::new();
    for (index, (time_s, class)) in frames.iter().enumerate() {
        let end_s = frames.get(index + 1).map_or_else(|| to_ns(time_s + interval_s), |(next_s, _)| *next_s);
        match spans.last_mut().filter(|span| span.label == class.name()) {
            Some(span) => span.end_s = end_s,
            None => spans.push(LabelSpan::new(*time_s, end_s, class.name())),
        }
    }
    spans
}

/// Checks labels against each other and their recording. Prints a message about labels that are free text.
///
/// # Errors
/// The recording cannot be read or has no frame, or labels are reversed, outside of the recording, or overlap each other.
pub fn check(recording: &Path, spans: &[LabelSpan]) -> anyhow::Result<()> {
    let mut source = Recording::open(recording)?;
    let context = || format!("{}: labels refused", recording.display());
    // Errors within the labels are checked first, since their messages are the most specific.
    check_spans(spans, None).with_context(context)?;
    let extent_s = extent_s(&mut source)?;
    if extent_s.is_none() && !spans.is_empty() {
        bail!("{}: the recording has no frame that they could be labels of", context());
    }
    check_spans(spans, extent_s).with_context(context)?;
    let mut free_texts: BTreeMap<&str, usize> = BTreeMap::new();
    for span in spans {
        let LabelSpan { start_s, end_s, label, .. } = span;
        if label.is_empty() {
            message!("the label from {start_s} to {end_s} s has no text: its frames count as not labelled");
        } else if span.occupancy().is_none() {
            *free_texts.entry(label).or_default() += 1;
        }
    }
    let mut listed = Vec::new();
    for (text, count) in free_texts {
        let mut classes = Occupancy::ALL.into_iter().map(Occupancy::name);
        match classes.find(|class| class.eq_ignore_ascii_case(text)) {
            Some(class) => message!("the label '{text}' is kept as free text; the class is written '{class}'"),
            None => listed.push(format!("'{}' ({count})", on_one_line(text))),
        }
    }
    if !listed.is_empty() {
        let others = listed.len().saturating_sub(MOST_LISTED);
        listed.truncate(MOST_LISTED);
        listed.extend((others > 0).then(|| format!("{others} others")));
        message!(
            "labels that are no class are kept as free text, and their frames count as not labelled: {}",
            listed.join(", ")
        );
    }
    Ok(())
}

/// Checks imported labels against each other and against the extent of their recording, s. They may reach a little beyond it:
/// label tracks end at full tenths or seconds, and their times follow the requested frame interval, from which boards deviate by
/// up to 0.4 %.
///
/// # Errors
/// Labels are reversed, reach far beyond the recording, or overlap each other.
pub fn check_imported(spans: &[LabelSpan], extent_s: Option<(f64, f64)>) -> Result<(), SpanError> {
    check_spans(spans, None)?;
    let Some((first_s, last_s)) = extent_s else { return Ok(()) };
    let margin_s = OVERHANG_S + OVERHANG_SHARE * (last_s - first_s);
    let clamped = |time_s: f64| match (first_s - margin_s..=last_s + margin_s).contains(&time_s) {
        true => time_s.clamp(first_s, last_s),
        false => time_s,
    };
    let cut =
        |span: &LabelSpan| LabelSpan { start_s: clamped(span.start_s), end_s: clamped(span.end_s), ..span.clone() };
    let spans: Vec<LabelSpan> = spans.iter().map(cut).filter(|span| span.end_s > span.start_s).collect();
    check_spans(&spans, extent_s)
}

/// Returns whether a label and an interval, s, have a time in common. A label without duration has its start in common
/// with an interval that begins there, and not with one that ends there.
pub fn overlaps(label: &LabelSpan, (start_s, end_s): (f64, f64)) -> bool {
    label.start_s < end_s && (label.end_s > start_s || label.start_s >= start_s)
}

/// Cuts an interval, s, out of the labels for which `is_affected` is true. The remainders on both sides stay.
pub fn cut_out(
    labels: Vec<LabelSpan>,
    (start_s, end_s): (f64, f64),
    is_affected: impl Fn(&LabelSpan) -> bool,
) -> Vec<LabelSpan> {
    let mut remaining = Vec::with_capacity(labels.len() + 1);
    for label in labels {
        if !is_affected(&label) || !overlaps(&label, (start_s, end_s)) {
            remaining.push(label);
            continue;
        }
        let rests = [(label.start_s, label.end_s.min(start_s)), (label.start_s.max(end_s), label.end_s)];
        // Rests within the rounding of times are dropped.
        let rest = |(start_s, end_s): (f64, f64)| {
            (end_s - start_s > ROUNDING_S).then(|| LabelSpan { start_s, end_s, ..label.clone() })
        };
        remaining.extend(rests.into_iter().filter_map(rest));
    }
    remaining
}

/// Interval in whole microseconds, as files have it at least, and text of a label.
fn interval_and_text(span: &LabelSpan) -> (i64, i64, &str) {
    let whole_us = |time_s: f64| (time_s * 1e6).round() as i64;
    (whole_us(span.start_s), whole_us(span.end_s), &span.label)
}

/// Result of [`add`].
pub struct Added {
    /// File that holds the labels.
    pub file: PathBuf,
    /// Number of labels that were there already.
    pub found: usize,
}

/// Adds labels to a recording, or to the file beside it. `make_room` first changes the existing labels. Labels with the interval and
/// the text of an existing one are not added. Nothing is written if [`check`] refuses the new labels, or if they overlap existing ones.
///
/// # Errors
/// The recording cannot be read or written, or the labels are refused.
pub fn add(
    recording: &Path,
    spans: &[LabelSpan],
    make_room: impl FnOnce(Vec<LabelSpan>) -> Vec<LabelSpan>,
) -> anyhow::Result<Added> {
    check(recording, spans)?;
    let source = Recording::open(recording)?;
    let context = || {
        let path = recording.display();
        format!(
            "{path}: labels refused\n\nhint: --replace cuts labels that are there already; --erase START_S:END_S cuts them out"
        )
    };
    let mut found = 0;
    let merged = |existing: Vec<LabelSpan>| -> anyhow::Result<Vec<LabelSpan>> {
        let mut all = make_room(existing);
        let new: Vec<LabelSpan> = {
            let known: HashSet<_> = all.iter().map(interval_and_text).collect();
            spans.iter().filter(|span| !known.contains(&interval_and_text(span))).cloned().collect()
        };
        found = spans.len() - new.len();
        all.extend(new);
        check_spans(&all, None).with_context(context)?;
        Ok(all)
    };
    if source.format().holds_labels() {
        let editor = LabelEditor::open(recording)?;
        editor.write(&merged(editor.labels()?)?)?;
        return Ok(Added { file: recording.to_owned(), found });
    }
    let file = file_beside(recording).unwrap_or_else(|| name_beside(recording));
    rewrite_beside(recording, &file, merged)?;
    Ok(Added { file, found })
}

/// Start of a recording's first frame and end of its last one by the frames' own clock, s; `None` for an empty
/// recording.
///
/// # Errors
/// The frames cannot be read.
pub fn extent_s(source: &mut Recording) -> anyhow::Result<Option<(f64, f64)>> {
    let interval_s = source.waveform().frame_interval_s();
    Ok(source.extent()?.map(|extent| (extent.first.time_s(), extent.last.time_s() + interval_s)))
}
