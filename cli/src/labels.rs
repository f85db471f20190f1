//! Files of labels, by the end of their name.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use radome_driver::LabelSpan;
use radome_driver::recording::label_text;

use crate::files;

#[derive(Clone, Copy)]
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

/// Reads a file of labels: `.txt` is an Audacity label track, `.label` a DEEPCRAFT file.
pub fn read(path: &Path) -> anyhow::Result<Vec<LabelSpan>> {
    let format = format(path)?;
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    let read = match format {
        Format::Audacity => label_text::from_audacity(&text),
        Format::Deepcraft => label_text::from_deepcraft(&text),
    };
    read.with_context(|| format!("{} cannot be understood", path.display()))
}

/// Writes such a file, whole or not at all.
pub fn write(path: &Path, spans: &[LabelSpan]) -> anyhow::Result<()> {
    let text = match format(path)? {
        Format::Audacity => label_text::to_audacity(spans),
        Format::Deepcraft => label_text::to_deepcraft(spans),
    };
    files::write_atomically(path, |file| {
        std::io::Write::write_all(file, text.as_bytes()).context("cannot write the labels")
    })
}

/// Where the labels of a recording lie that cannot hold any: `radome.label` in a folder, `NAME.label` beside a file.
pub fn name_beside(recording: &Path) -> PathBuf {
    if recording.is_dir() { recording.join("radome.label") } else { recording.with_extension("label") }
}

/// A file with the labels of such a recording, if there is one: where [`name_beside`] says; in a folder, `labels.label` and
/// `labels.txt` are taken too, and in a session's folder they are as good as in the radar's.
pub fn file_beside(recording: &Path) -> Option<PathBuf> {
    let mut places = vec![name_beside(recording)];
    if recording.is_dir() {
        let is_radar = recording.file_name().is_some_and(|n| n.to_string_lossy().starts_with("RadarIfxAvian_"));
        let session = recording.parent().filter(|_| is_radar);
        for folder in [Some(recording), session].into_iter().flatten() {
            places.extend(["radome.label", "labels.label", "labels.txt"].map(|name| folder.join(name)));
        }
    }
    places.into_iter().find(|path| path.is_file())
}
