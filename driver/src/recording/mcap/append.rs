//! Labels for a recording that is finished.

use std::path::Path;

use mcap::records::{Record, op};
use radome_dsp::{Frame, FrameSource, SourceEvent};

use super::index::summary_start;
use super::lengths::parse_record;
use super::records::{Next, Records, topic};
use super::{LabelSpan, McapReader, Recorder, RecordingSummary};
use crate::recording::RecordingError;
use crate::recording::partial::Partial;

/// Adds labels to a finished recording: a copy with the labels takes its place at once, or it stays as it was.
pub fn append_labels(path: &Path, labels: &[LabelSpan]) -> Result<RecordingSummary, RecordingError> {
    let mut source = McapReader::open(path)?.strict(true);
    if !source.is_complete() {
        let offset = Records::open(path)?.length;
        return Err(RecordingError::Unfinished { path: path.to_owned(), offset });
    }
    if let Some(what) = foreign(path)? {
        return Err(RecordingError::Foreign { path: path.to_owned(), what });
    }
    let partial = Partial::new(path)?;
    let mut recorder = Recorder::create(partial.path(), source.header())?;
    let mut frame = Frame::zeroed(source.waveform().shape());
    loop {
        match source.read_next(&mut frame)? {
            SourceEvent::Frame => recorder.frame(&frame)?,
            SourceEvent::Gap(gap) => recorder.gap(&gap)?,
            SourceEvent::End => break,
        }
    }
    for label in source.labels()?.iter().chain(labels) {
        recorder.label(label)?;
    }
    for result in source.results()? {
        recorder.result(&result?)?;
    }
    let summary = recorder.finish()?;
    partial.finish()?;
    Ok(summary)
}

/// What somebody else has put into the file, by its summary.
fn foreign(path: &Path) -> Result<Option<String>, RecordingError> {
    let mut records = Records::open(path)?;
    let Some(start) = summary_start(&mut records)?.filter(|start| *start > 0) else { return Ok(None) };
    records.go_to(start)?;
    let mut body = Vec::new();
    while let Next::Record(opcode, _) =
        records.next(&mut body, |opcode| matches!(opcode, op::CHANNEL | op::STATISTICS))?
    {
        if !matches!(opcode, op::CHANNEL | op::STATISTICS) {
            continue;
        }
        match parse_record(opcode, &body) {
            Ok(Record::Channel(channel)) if topic(&channel.topic).is_none() => {
                return Ok(Some(format!("the channel {}", channel.topic)));
            }
            Ok(Record::Statistics(statistics)) if statistics.attachment_count > 0 => {
                return Ok(Some(format!("{} attachments", statistics.attachment_count)));
            }
            _ => {}
        }
    }
    Ok(None)
}
