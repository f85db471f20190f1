//! Command that adapts the model to the room with the labels of a recording, and the labels that it still lacks.

use std::borrow::Cow;
use std::path::Path;

use radome_driver::LabelSpan;
use radome_dsp::Occupancy;
use serde::Serialize;

use crate::classifier::CFAR;
use crate::shell;

/// File that the command writes. `radome model adapt` does not replace an existing file.
const OUTPUT: &str = "room-mine.safetensors";

/// Offer on the page to adapt the model with its labels: command and state.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Offer {
    /// Command line for a shell; absent where the model cannot be adapted or no recording holds the labels.
    pub command: Option<String>,
    /// Labelled time, and the labels that are missing.
    pub text: String,
}

impl Offer {
    /// Makes the offer for the labels of a recording, of people up to `max_range_m` if that is given. `None` while no label names a
    /// class.
    pub fn new(
        model: &Path,
        max_range_m: Option<f64>,
        recording: Option<&Path>,
        is_running: bool,
        labels: &[&LabelSpan],
    ) -> Option<Self> {
        let seconds = Occupancy::ALL.map(|class| {
            let of_class = labels.iter().filter(|label| label.occupancy() == Some(class));
            // An empty sum is -0.
            of_class.map(|label| label.end_s - label.start_s).sum::<f64>() + 0.0
        });
        if seconds.iter().sum::<f64>() <= 0.0 {
            return None;
        }
        let named = |(class, seconds): (Occupancy, f64)| format!("{seconds:.0} s {}", class.name());
        let labelled: Vec<String> = Occupancy::ALL.into_iter().zip(seconds).map(named).collect();
        let mut text = format!("Labelled: {}.", labelled.join(", "));
        let mut say = |sentence: &str| text = format!("{text} {sentence}");
        let is_onnx = model.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("onnx"));
        let command = match recording {
            _ if model == Path::new(CFAR) => {
                say("The classical detector cannot be adapted: start with --model room-hqnn.");
                None
            }
            _ if is_onnx => {
                say("An ONNX file cannot be adapted: start with the .safetensors file that it was exported from.");
                None
            }
            None => {
                say(
                    "These labels are kept in no recording: start with -o FILE.mcap to be able to adapt the model to this room.",
                );
                None
            }
            Some(recording) => {
                let missing: Vec<&str> = Occupancy::ALL
                    .into_iter()
                    .zip(seconds)
                    .filter(|(_, seconds)| *seconds <= 0.0)
                    .map(|(class, _)| class.name())
                    .collect();
                if seconds[1] + seconds[2] <= 0.0 {
                    say("Without people only the level at which the room counts as empty changes.");
                } else if !missing.is_empty() {
                    say(&format!("Not labelled yet: {}.", missing.join(", ")));
                }
                say("To measure the gain, name a second recording of the room with the same labels behind this one.");
                if is_running {
                    say("The recording is complete when this run has ended.");
                }
                let range = max_range_m.map(|range_m| format!(" --max-range-m {range_m}")).unwrap_or_default();
                Some(format!("radome model adapt {} {}{range} -o {OUTPUT}", quoted(model), quoted(recording)))
            }
        };
        Some(Offer { command, text })
    }
}

/// Quotes a path as one word of a POSIX shell.
fn quoted(path: &Path) -> String {
    let text = path.to_string_lossy();
    let text: Cow<str> = if text.starts_with('-') { format!("./{text}").into() } else { text };
    shell::word(&text)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn offer(model: &str, recording: Option<&str>, labels: &[LabelSpan]) -> Option<Offer> {
        Offer::new(Path::new(model), None, recording.map(Path::new), false, &labels.iter().collect::<Vec<_>>())
    }

    #[test]
    fn the_command_names_model_and_recording_and_the_text_what_is_missing() {
        let labels = [LabelSpan::new(0.0, 60.0, "empty"), LabelSpan::new(70.0, 130.0, "empty")];
        let found = offer("room-hqnn", Some("a room/it's.mcap"), &labels).expect("an offer");
        let command = "radome model adapt room-hqnn 'a room/it'\\''s.mcap' -o room-mine.safetensors";
        assert_eq!(found.command.as_deref(), Some(command));
        for expected in ["120 s empty, 0 s one, 0 s two", "Without people", "a second recording"] {
            assert!(found.text.contains(expected), "{}", found.text);
        }
        let with_one = [labels[0].clone(), LabelSpan::new(60.0, 70.0, "one")];
        let found = offer("-m.safetensors", Some("r.mcap"), &with_one).expect("an offer");
        assert!(found.text.contains("Not labelled yet: two."), "{}", found.text);
        assert!(
            found.command.is_some_and(|command| command.starts_with("radome model adapt ./-m.safetensors r.mcap "))
        );
    }

    /// Regression test: the command adapted the model to people of whom the answers and labels of this run know nothing.
    #[test]
    fn the_command_keeps_to_the_greatest_range() {
        let label = LabelSpan::new(0.0, 60.0, "one");
        let (model, recording) = (Path::new("room-hqnn"), Path::new("r.mcap"));
        let found = Offer::new(model, Some(1.5), Some(recording), false, &[&label]).expect("an offer");
        let command = "radome model adapt room-hqnn r.mcap --max-range-m 1.5 -o room-mine.safetensors";
        assert_eq!(found.command.as_deref(), Some(command));
    }

    #[test]
    fn nothing_is_offered_that_cannot_be_run() {
        let labels = [LabelSpan::new(0.0, 60.0, "one")];
        for (model, recording, expected) in [
            ("cfar", Some("r.mcap"), "cannot be adapted"),
            ("m.onnx", Some("r.mcap"), "cannot be adapted"),
            ("room-hqnn", None, "-o FILE.mcap"),
        ] {
            let found = offer(model, recording, &labels).expect("a text");
            assert!(found.command.is_none() && found.text.contains(expected), "{found:?}");
        }
        assert_eq!(offer("room-hqnn", Some("r.mcap"), &[LabelSpan::new(0.0, 60.0, "somebody coughs")]), None);
        assert_eq!(offer("room-hqnn", Some("r.mcap"), &[]), None);
    }
}
