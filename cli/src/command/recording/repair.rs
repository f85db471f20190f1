use std::path::{Path, PathBuf};

use anyhow::bail;
use radome_driver::RecordingHeader;
use radome_driver::recording::{Format, Recording, RecordingError, mcap};
use radome_dsp::FrameSource;
use serde_json::json;

use crate::exit::Completion;
use crate::output;
use crate::output_file::Overwrite;

const HEAD_HINT: &str = "\n\nhint: if its beginning alone is damaged, --waveform-of RECORDING takes the waveform of another \
                         recording with the same settings";

/// `radome recording repair`
#[derive(clap::Args)]
#[command(
    after_help = "Exit status: 0 if all of the file could be read, 3 if chunks or frames of it are lost, 1 if there is no new file."
)]
pub struct Arguments {
    /// Cut or damaged MCAP recording; it is not changed
    file: PathBuf,
    /// MCAP file to write
    #[arg(short, long, value_name = "FILE.mcap")]
    output: PathBuf,
    /// Recording with the same settings whose waveform is taken where that of the file is damaged
    #[arg(long, value_name = "RECORDING")]
    waveform_of: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Print one JSON object at the end
    #[arg(long)]
    json: bool,
}

/// Writes the readable part of a recording to a new one and reports the losses.
///
/// An unfinished recording counts as lost only where some of its bytes cannot be read. Data that its recorder held in
/// memory when it was killed were never in the file.
///
/// # Errors
/// The file is no MCAP recording, nothing of it can be read, or the output cannot be written.
pub fn run(arguments: &Arguments) -> anyhow::Result<Completion> {
    output::catch_interrupts()?;
    let (file, output) = (&arguments.file, &arguments.output);
    let inputs: Vec<&Path> = std::iter::once(file).chain(&arguments.waveform_of).map(PathBuf::as_path).collect();
    arguments.overwrite.check(output, &inputs)?;
    let other = arguments.waveform_of.as_deref().map(Recording::open).transpose()?;
    let (is_given, header) = (other.is_some(), other.map(|other| RecordingHeader::new(other.waveform().clone())));
    let report = match mcap::repair_unless(file, output, header, arguments.overwrite.existing(), output::interrupted) {
        Err(error @ RecordingError::Corrupt { .. }) if !is_given && is_mcap(file) => bail!("{error}{HEAD_HINT}"),
        repaired => repaired?,
    };
    if !report.was_finished {
        message!("the recording was never finished; what came after its last chunk is lost");
    }
    for damage in &report.damage {
        let frames = damage.frames.map_or("frames unknown".into(), |frames| format!("{frames} frames"));
        message!("at byte {}: {} bytes lost, {frames}: {}", damage.offset, damage.bytes, damage.reason);
    }
    for gap in &report.lost {
        match gap.frames {
            0 => message!("an unknown number of frames lost from {} on", gap.first_sequence),
            frames => message!("{frames} frames lost from {} on", gap.first_sequence),
        }
    }
    if report.labels_left_out > 0 {
        message!("labels without saved frames, which are left out: {}", report.labels_left_out);
    }
    let file = arguments.output.display().to_string();
    if arguments.json {
        let lost = |gap: &radome_dsp::Gap| json!({ "first_sequence": gap.first_sequence, "frames": gap.frames });
        output::ignore_closed_stdout(output::json_line(&json!({
            "file": file,
            "frames": report.frames,
            "labels": report.labels,
            "labels_left_out": report.labels_left_out,
            "results": report.results,
            "gaps": report.gaps,
            "lost": report.frames_lost(),
            "lost_bytes": report.bytes_lost(),
            "lost_from": report.lost.iter().map(lost).collect::<Vec<_>>(),
            "was_finished": report.was_finished,
        })))?;
    } else {
        output::ignore_closed_stdout(output::text_line(&format!(
            "{file}: {} frames saved, {} known to be lost, {} bytes unreadable",
            report.frames,
            report.frames_lost(),
            report.bytes_lost()
        )))?;
    }
    Ok(Completion::from_loss(!report.damage.is_empty() || !report.lost.is_empty()))
}

fn is_mcap(file: &Path) -> bool {
    matches!(Format::of_content(file), Ok(Some(Format::Mcap)))
}
