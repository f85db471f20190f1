use std::path::PathBuf;

use radome_driver::recording::Recording;
use radome_driver::recording::mcap::LabelSpan;
use serde_json::json;

use crate::output_file::Overwrite;
use crate::{labels, output};

/// `radome recording labels`
#[derive(clap::Args)]
pub struct Arguments {
    /// MCAP recording
    file: PathBuf,
    /// Write its labels: .txt is an Audacity label track, .label a DEEPCRAFT file, .json a JSON array
    #[arg(long, conflicts_with = "import")]
    export: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Add the labels of a file of these formats
    #[arg(long)]
    import: Option<PathBuf>,
    /// Author of the imported labels, stored with them
    #[arg(long, value_name = "NAME", requires = "import")]
    who: Option<String>,
    /// Print a JSON list of objects
    #[arg(long)]
    json: bool,
}

/// Shows, writes or adds the labels of a recording.
///
/// # Errors
/// The recording or a file of labels cannot be read or written, or labels contradict each other.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    if let Some(path) = &arguments.import {
        let mut spans = labels::read_file(path)?;
        spans.iter_mut().for_each(|span| span.who.clone_from(&arguments.who));
        let found = labels::add(&arguments.file, &spans, |existing| existing)?.found;
        message!("{} labels added to {}", spans.len() - found, arguments.file.display());
    }
    let mut spans = Recording::open(&arguments.file)?.labels()?;
    labels::sort_by_time(&mut spans);
    if let Some(path) = &arguments.export {
        arguments.overwrite.check(path, &[&arguments.file])?;
        labels::write_file(path, arguments.overwrite.existing(), &spans)?;
    }
    if arguments.json {
        return output::json_line(&json!(spans));
    }
    for LabelSpan { start_s, end_s, label, who, .. } in &spans {
        let (label, who) = (output::on_one_line(label), output::on_one_line(who.as_deref().unwrap_or("")));
        output::text_line(&format!("{start_s:10.3} s  {end_s:10.3} s  {label}  {who}"))?;
    }
    Ok(())
}
