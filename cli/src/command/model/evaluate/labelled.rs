//! Recording with the true classes of its frames.

use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use radome_driver::LabelSpan;
use radome_driver::recording::{Recording, infineon};
use radome_dsp::{Frame, Occupancy, Waveform};

use crate::exit::wrong_use;
use crate::{labels, shard, source};

pub struct LabelledRecording {
    pub path: PathBuf,
    labels: Labels,
}

enum Labels {
    /// One label for all frames.
    Constant(Occupancy),
    /// Spans; frames outside of them have no label.
    Spans(Vec<LabelSpan>),
    /// The truth that a simulator wrote with each frame.
    InFrames,
}

impl LabelledRecording {
    /// Parses recordings, each of which may be named once: frames that count twice, or that a model is
    /// adapted to and tested on, would give wrong scores.
    ///
    /// # Errors
    /// There is something else behind `=`, labels cannot be read, contradict each other or lie outside of the recording, or
    /// a recording is named twice.
    pub fn parse_all(inputs: impl IntoIterator<Item = String>) -> anyhow::Result<Vec<Self>> {
        let all = inputs.into_iter().map(|input| Self::parse(&input)).collect::<anyhow::Result<Vec<_>>>()?;
        labels::check_named_once(all.iter().map(|recording| &recording.path))?;
        Ok(all)
    }

    /// Parses `RECORDING=empty`, `=one` or `=two`, `RECORDING=LABELS.txt` or `.label`, or `RECORDING`. The latter uses
    /// the labels in the recording: spans, or, without any, not even free text, the truth that a simulator wrote with its frames.
    ///
    /// # Errors
    /// If there is something else behind `=`, or if labels cannot be read, contradict each other or lie outside of the
    /// recording.
    fn parse(input: &str) -> anyhow::Result<Self> {
        let after = input.rsplit_once('=');
        if let Some((path, label)) = after
            && let Some(occupancy) = Occupancy::from_name(label)
        {
            return Ok(LabelledRecording { path: path.into(), labels: Labels::Constant(occupancy) });
        }
        let (path, spans) = match after {
            Some((path, file)) if !Path::new(input).exists() => {
                if !Path::new(file).is_file() {
                    wrong_use!(
                        "{input}: {file} is not empty, one or two, and no file of labels\n\nhint: RECORDING=empty, RECORDING=one, \
                         RECORDING=two, RECORDING=LABELS.txt, or RECORDING alone if it holds labels"
                    );
                }
                (PathBuf::from(path), labels::read_file(Path::new(file))?)
            }
            _ => {
                let path = PathBuf::from(input);
                let spans = labels::of_recording(&path)?;
                if spans.is_empty() {
                    return Ok(LabelledRecording { path, labels: Labels::InFrames });
                }
                (path, spans)
            }
        };
        let extent_s = labels::extent_s(&mut Recording::open(&path)?)?;
        labels::check_imported(&spans, extent_s).with_context(|| format!("{input}: labels cannot be used"))?;
        Ok(LabelledRecording { path, labels: Labels::Spans(spans) })
    }

    /// Returns the name that the recording has as a sequence of a dataset: that of the session of a vendor's folder, and of the whole run
    /// of a shard.
    pub fn sequence_name(&self) -> String {
        let content = labels::content_of(&self.path);
        let name = source::name_of(infineon::session_of(&content).unwrap_or(&self.path));
        shard::name_of_whole(&name.to_string_lossy()).to_owned()
    }

    /// Returns the names that the recording may have had as a sequence of a dataset: a dataset of folders puts the folders between its
    /// own and the recording before [`Self::sequence_name`].
    pub fn possible_sequence_names(&self) -> Vec<String> {
        let content = labels::content_of(&self.path);
        let place = infineon::session_of(&content).unwrap_or(&content);
        let mut names = vec![self.sequence_name()];
        for folder in place.ancestors().skip(1).filter_map(Path::file_name) {
            let within = names.last().map_or("", String::as_str);
            names.push(format!("{}/{within}", folder.to_string_lossy()));
        }
        names
    }

    /// Creates the error for a recording of which a model can classify no frame.
    pub fn without_frames(&self) -> anyhow::Error {
        anyhow!(
            "{}: no frame of it can be judged\n\nhint: it is shorter than the slow time of the model's maps, or its receivers give no \
             signal",
            self.path.display()
        )
    }

    /// Returns the label of a frame; `None` where it has none, or where someone is entering or leaving.
    pub fn truth(&self, frame: &Frame, waveform: &Waveform) -> Option<Occupancy> {
        let truth = match &self.labels {
            Labels::Constant(occupancy) => return Some(*occupancy),
            Labels::Spans(spans) => labels::truth_of_frame(spans, frame, waveform),
            Labels::InFrames => frame.truth,
        };
        truth.filter(|truth| !truth.transition).map(|truth| truth.occupancy)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_recording_may_be_a_sequence_with_any_of_its_folders() {
        let recording = LabelledRecording { path: "data/anna/walk.mcap".into(), labels: Labels::InFrames };
        assert_eq!(recording.possible_sequence_names(), ["walk", "anna/walk", "data/anna/walk"]);
        // Shards of one run are one sequence.
        let shard = LabelledRecording { path: "anna/walk-shard-00001-of-00003.mcap".into(), labels: Labels::InFrames };
        assert_eq!(shard.possible_sequence_names(), ["walk", "anna/walk"]);
    }
}
