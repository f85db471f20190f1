use std::path::PathBuf;

use anyhow::bail;
use radome_driver::FrameResult;
use radome_driver::recording::Recording;
use radome_dsp::Occupancy;

use crate::output_file::Overwrite;
use crate::{files, output};

/// `radome recording answers`
#[derive(clap::Args)]
pub struct Arguments {
    /// Recording of `radome live -o`
    recording: PathBuf,
    /// CSV file to write, instead of stdout
    #[arg(short, long, alias = "csv", value_name = "FILE.csv")]
    output: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Show only answers at which the number of people changes
    #[arg(long)]
    changes: bool,
    /// Print one JSON object per frame
    #[arg(long, conflicts_with = "output")]
    json: bool,
}

const HEADING: &str = "sequence,time_s,host_time_s,label,p_empty,p_one,p_two,occupied,people,latency_ms";

/// Prints the answers to the frames of a recording as CSV or JSON lines.
///
/// # Errors
/// The recording cannot be read or holds no answers, or the output cannot be written.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let name = arguments.recording.display();
    let recording = Recording::open(&arguments.recording)?;
    let classifier = recording.header().judge;
    let Some((results, classifier)) = recording.results()?.zip(classifier) else {
        bail!(
            "{name} holds no answers\n\nhint: radome live SOURCE --model M -o FILE.mcap records them with the frames"
        );
    };
    // Classifiers without a file have the program's version in place of a hash.
    let is_hash =
        classifier.model_hash.len() == 64 && classifier.model_hash.bytes().all(|byte| byte.is_ascii_hexdigit());
    message!(
        "judged by {} ({}{}), on after {} s, off after {} s{}",
        classifier.model,
        if is_hash { "SHA-256 " } else { "" },
        classifier.model_hash,
        classifier.on_delay_s,
        classifier.off_delay_s,
        classifier.max_range_m.map_or_else(String::new, |range_m| format!(", people up to {range_m} m"))
    );
    let mut people = None;
    let selected = results.filter(|result| {
        let Ok(result) = result else { return true };
        let is_change = people.replace(result.people) != Some(result.people);
        is_change || !arguments.changes
    });
    if let Some(path) = &arguments.output {
        arguments.overwrite.check(path, &[&arguments.recording])?;
    }
    let lines = selected.map(|result| match arguments.json {
        true => output::json_text(&result?),
        false => Ok(csv_line(&result?)),
    });
    let heading = (!arguments.json).then(|| Ok(HEADING.to_owned()));
    files::write_lines(arguments.output.as_deref(), arguments.overwrite.existing(), heading.into_iter().chain(lines))
}

fn csv_line(result: &FrameResult) -> String {
    let probabilities =
        result.probabilities.map_or(",,".to_owned(), |[empty, one, two]| format!("{empty},{one},{two}"));
    let host_time = match result.host_time_ns {
        0 => String::new(),
        ns => format!("{:.3}", ns as f64 * 1e-9),
    };
    format!(
        "{},{:.6},{host_time},{},{probabilities},{},{},{:.3}",
        result.sequence,
        result.time_s(),
        result.label.map_or("", Occupancy::name),
        result.occupied,
        result.people,
        result.latency_ns as f64 * 1e-6
    )
}
