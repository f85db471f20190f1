use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use radome_driver::LabelSpan;
use radome_driver::recording::{Format, Recording, RecordingError, RecordingWriter, WriteReport};
use radome_dsp::{Frame, FrameSource, SourceEvent};
use serde_json::json;

use crate::exit::{Completion, wrong_use};
use crate::live::screen::unknown_loss_text;
use crate::output_file::Overwrite;
use crate::{files, labels, output, shell, viewers};

const REPAIR_HINT: &str = "\n\nhint: radome recording repair saves what can be read of it";
const INTERRUPTED: &str = "interrupted: nothing has been written";

/// `radome recording convert`
#[derive(clap::Args)]
#[command(
    after_help = "Exit status: 0 if the input is whole, 3 if the end of an MCAP input is cut and left out, 1 if nothing is written."
)]
pub struct Arguments {
    /// Recording: MCAP file, Infineon folder or text file
    input: PathBuf,
    /// Output: FILE.mcap, FILE.txt (with FILE.txt_config.json), or a FOLDER/
    output: PathBuf,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Format to write, if the name of the output does not determine it
    #[arg(long, value_name = "FORMAT", value_enum)]
    to: Option<To>,
    /// Print one JSON object at the end
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum To {
    /// Radar Fusion GUI and ifxdaq: RadarIfxAvian_00/radar.npy
    Infineon,
    /// The native format
    Mcap,
    /// The SDK application's text
    Text,
    /// Images, plots and a log for Foxglove, Rerun and PlotJuggler: an MCAP file that is not a recording
    Viewers,
}

impl To {
    /// Format of a recording; `None` for viewers.
    fn format(self) -> Option<Format> {
        match self {
            To::Infineon => Some(Format::Infineon),
            To::Mcap => Some(Format::Mcap),
            To::Text => Some(Format::Text),
            To::Viewers => None,
        }
    }
}

/// Writes a recording in another format. The output is written atomically. Content that its format cannot hold is
/// reported on stderr. An MCAP input that was cut while it was written is converted up to its last whole chunk, which counts as a
/// loss.
///
/// # Errors
/// The input cannot be read, or the output cannot be written.
pub fn run(arguments: &Arguments) -> anyhow::Result<Completion> {
    output::catch_interrupts()?;
    let Arguments { input, output: path, .. } = arguments;
    let format = match arguments.to {
        Some(to) => to.format(),
        None => match Format::of_output(path) {
            Some(format) => Some(format),
            None => wrong_use!(
                "the name {} does not say which format to write\n\nhint: --to infineon, --to mcap, --to text or --to viewers",
                path.display()
            ),
        },
    };
    arguments.overwrite.check_name(path, &[input])?;
    if format.is_some_and(Format::is_folder) {
        check_folder_is_empty(path)?;
    } else if format.is_some_and(|format| !format.holds_labels()) {
        check_no_labels_beside(path)?;
    }
    let mut source = open(input)?;
    let report = match format {
        Some(format) => convert(arguments, format, &mut source),
        None => write_for_viewers(arguments, &mut source),
    }?;
    for what in &report.omitted {
        message!("not held by this format: {what}");
    }
    let is_labelled = labels::of_recording(input).is_ok_and(|spans| !spans.is_empty());
    if is_labelled && format.is_some_and(|format| !format.holds_labels()) {
        explain_missing_labels(input, path, report.time_shift_ns as f64 * 1e-9, source.waveform().frame_interval_s());
    }
    if source.is_cut() {
        message!("frames may be lost at the end of {}, which cannot be read", input.display());
    }
    if arguments.json {
        output::ignore_closed_stdout(output::json_line(&json!({
            "file": path.display().to_string(),
            "frames": report.frames,
            "gaps": report.gaps,
            "gaps_of_unknown_length": report.unknown_gaps,
            "lost": report.frames_lost,
            "written": report.bytes,
            "not_held": report.omitted,
        })))?;
    } else {
        output::ignore_closed_stdout(output::text_line(&format!(
            "{}: {} frames, {} gaps with {} frames lost{}, {} bytes",
            path.display(),
            report.frames,
            report.gaps,
            report.frames_lost,
            unknown_loss_text(report.unknown_gaps),
            report.bytes
        )))?;
    }
    Ok(Completion::from_loss(source.is_cut()))
}

/// Prints how to write the labels beside a new recording that cannot hold them, if its frames have kept their times.
fn explain_missing_labels(input: &Path, output: &Path, shift_s: f64, frame_interval_s: f64) {
    let beside = labels::name_beside(output);
    let [from, new, to] = [input, output, beside.as_path()].map(|path| shell::word(&path.to_string_lossy()));
    // Frames that move by less keep their labels, except at the ends of these.
    if shift_s < 0.5 * frame_interval_s {
        message!("hint: radome recording label {from} -o {to} writes the labels beside it");
        return;
    }
    message!(
        "the labels of {from} do not fit {new}, where times of frames differ by up to {shift_s:.3} s\n\nhint: \
         radome recording label {new} --span START_S:END_S=LABEL labels it anew"
    );
}

/// Fails if the folder to write has something in it.
fn check_folder_is_empty(folder: &Path) -> anyhow::Result<()> {
    ensure!(
        !std::fs::read_dir(folder).is_ok_and(|mut entries| entries.next().is_some()),
        "{} exists already and is not empty\n\nhint: --overwrite replaces files, never folders; move it away, or name another",
        folder.display()
    );
    Ok(())
}

/// Fails if labels stand beside the file that is to be written: they would be taken for those of the new recording.
fn check_no_labels_beside(output: &Path) -> anyhow::Result<()> {
    match labels::file_beside(output) {
        Some(labels) => bail!(
            "{} holds the labels of {}, and would be taken for those of the new recording\n\nhint: move it away",
            labels.display(),
            output.display()
        ),
        None => Ok(()),
    }
}

/// Opens the input and reports known losses.
fn open(input: &Path) -> anyhow::Result<Recording> {
    let source = match Recording::open(input) {
        Err(error @ RecordingError::Corrupt { .. }) if matches!(Format::of_content(input), Ok(Some(Format::Mcap))) => {
            bail!("{error}{REPAIR_HINT}")
        }
        opened => opened?,
    };
    if source.format() == Format::Infineon {
        message!("not carried over: the descriptions in meta.json");
    }
    Ok(source)
}

/// Reads the labels of a recording, also those beside it, before the frames, which may take long. Warns of labels that do not fit the
/// recording; they are copied unchanged.
fn read_labels(input: &Path, source: &Recording) -> anyhow::Result<Vec<LabelSpan>> {
    let beside = labels::file_beside(input).filter(|_| !source.format().holds_labels());
    let spans = labels::of_recording(input).with_context(|| match beside {
        Some(file) => format!(
            "the labels of {} cannot be read\n\nhint: mend {}, or move it away to convert without labels",
            input.display(),
            file.display()
        ),
        None => format!("the labels of {} cannot be read", input.display()),
    })?;
    let extent = Recording::open(input).and_then(|mut recording| recording.extent()).ok().flatten();
    let interval_s = source.waveform().frame_interval_s();
    let extent_s = extent.map(|extent| (extent.first.time_s(), extent.last.time_s() + interval_s));
    if let Err(error) = labels::check_imported(&spans, extent_s) {
        message!("warning: {error}");
    }
    Ok(spans)
}

fn convert(arguments: &Arguments, format: Format, source: &mut Recording) -> anyhow::Result<WriteReport> {
    let spans = read_labels(&arguments.input, source)?;
    let existing = arguments.overwrite.existing();
    let mut writer = RecordingWriter::create_with(&arguments.output, format, &source.header(), existing)?;
    let bar = output::progress(source.frame_count().unwrap_or(0), "converting");
    let mut frame = Frame::zeroed(source.waveform().shape());
    loop {
        ensure!(!output::interrupted(), INTERRUPTED);
        match source.next_frame(&mut frame) {
            Ok(SourceEvent::Frame) => writer.frame(&frame)?,
            Ok(SourceEvent::Gap(gap)) => writer.gap(&gap)?,
            Ok(SourceEvent::End) => break,
            Err(error) => {
                let hint = match source.format() {
                    Format::Mcap => REPAIR_HINT,
                    _ => "\n\nhint: radome record RECORDING -o FILE.mcap keeps the frames before that place",
                };
                bail!("{}{hint}", output::chain(&anyhow::Error::from_boxed(error)));
            }
        }
        bar.inc(1);
    }
    spans.iter().try_for_each(|label| writer.label(label))?;
    for result in source.results()?.into_iter().flatten() {
        writer.result(&result?)?;
    }
    let report = writer.finish()?;
    bar.finish_and_clear();
    Ok(report)
}

fn write_for_viewers(arguments: &Arguments, source: &mut Recording) -> anyhow::Result<WriteReport> {
    let spans = read_labels(&arguments.input, source)?;
    let bar = output::progress(source.frame_count().unwrap_or(0), "for viewers");
    let after_event = || {
        ensure!(!output::interrupted(), INTERRUPTED);
        bar.inc(1);
        Ok(())
    };
    let mut report = WriteReport::default();
    files::write_output(&arguments.output, arguments.overwrite.existing(), |file| {
        report = viewers::export(source, spans, file, after_event)?;
        Ok(())
    })?;
    bar.finish_and_clear();
    Ok(report)
}
