use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use radome_driver::recording::mcap::{self, LabelSpan};
use radome_driver::recording::{Recording, label_text};
use serde_json::json;

use crate::{files, output};

/// `radome labels`
#[derive(clap::Args)]
pub struct Arguments {
    /// MCAP recording
    file: PathBuf,
    /// Write its labels: .txt is an Audacity label track, .label a DEEPCRAFT file
    #[arg(long, conflicts_with = "import")]
    export: Option<PathBuf>,
    /// Add the labels of such a file
    #[arg(long)]
    import: Option<PathBuf>,
    /// Who says so, noted with what is imported
    #[arg(long, requires = "import")]
    who: Option<String>,
    /// A list of objects
    #[arg(long)]
    json: bool,
}

enum Format {
    Audacity,
    Deepcraft,
}

fn format(path: &Path) -> anyhow::Result<Format> {
    match path.extension().and_then(|e| e.to_str()) {
        Some("txt") => Ok(Format::Audacity),
        Some("label") => Ok(Format::Deepcraft),
        _ => bail!(
            "{}: which kind of labels?\n\nhint: end its name in .txt for an Audacity label track, in .label for DEEPCRAFT",
            path.display()
        ),
    }
}

/// Shows, writes or adds the labels of a recording.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    if let Some(path) = &arguments.import {
        let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
        let read = match format(path)? {
            Format::Audacity => label_text::from_audacity(&text),
            Format::Deepcraft => label_text::from_deepcraft(&text),
        };
        let mut spans = read.with_context(|| format!("{} cannot be understood", path.display()))?;
        spans.iter_mut().for_each(|span| span.who.clone_from(&arguments.who));
        mcap::append_labels(&arguments.file, &spans)?;
        eprintln!("{} labels added to {}", spans.len(), arguments.file.display());
    }
    let spans = Recording::open(&arguments.file)?.labels()?;
    if let Some(path) = &arguments.export {
        let text = match format(path)? {
            Format::Audacity => label_text::to_audacity(&spans),
            Format::Deepcraft => label_text::to_deepcraft(&spans),
        };
        files::write_atomically(path, |file| {
            std::io::Write::write_all(file, text.as_bytes()).context("cannot write the labels")
        })?;
    }
    if arguments.json {
        return output::json_line(&json!(spans));
    }
    for LabelSpan { start_s, end_s, label, who, .. } in &spans {
        output::text_line(&format!("{start_s:10.3} s  {end_s:10.3} s  {label}  {}", who.as_deref().unwrap_or("")))?;
    }
    Ok(())
}
