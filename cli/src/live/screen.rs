//! Output of answers on the terminal, or as JSON lines.

use std::io::IsTerminal;

use radome_dsp::{Gap, Occupancy};
use serde_json::json;

use super::answer::Summary;
use super::health::Health;
use super::sink::{Moment, Sink};
use crate::output;

/// Sink that prints answers as JSON lines or as text. The text has one line per change; on a terminal, the current line
/// is updated in place.
pub struct Screen {
    json: bool,
    is_terminal: bool,
    last: Option<(Option<Occupancy>, Option<Occupancy>)>,
}

impl Screen {
    /// Creates a screen and writes its heading, if it has one.
    ///
    /// # Errors
    /// Standard output cannot be written.
    pub fn new(json: bool) -> anyhow::Result<Self> {
        let is_terminal = !json && std::io::stdout().is_terminal();
        if !json {
            let head =
                format!("{:>8}  {:7} {:^23}  {:7} {:>10}", "time", "label", "empty   one     two", "truth", "latency");
            output::text_line(&head)?;
        }
        Ok(Screen { json, is_terminal, last: None })
    }
}

impl Sink for Screen {
    fn answer(&mut self, moment: &Moment) -> anyhow::Result<()> {
        let answer = moment.answer;
        if self.json {
            return output::json_line(answer);
        }
        let state = (answer.label, answer.truth);
        let is_change = self.last != Some(state);
        if !self.is_terminal && !is_change {
            return Ok(());
        }
        let label = answer.label.map_or("-", Occupancy::name);
        let values = match (&answer.probabilities, &answer.warming_up) {
            (Some(p), _) => p.to_string(),
            (None, Some(progress)) => format!("warming up {progress}"),
            (None, None) if answer.no_signal => "no signal".to_owned(),
            (None, None) => String::new(),
        };
        let mut truth = answer.truth.map_or("", Occupancy::name).to_owned();
        if answer.transition == Some(true) {
            truth.push('~');
        }
        let line = format!("{:7.2}s  {label:7} {values:23}  {truth:7} {:7.1} ms", answer.time_s, answer.latency_ms);
        if self.is_terminal {
            // A line with a change is kept; an unchanged line is overwritten.
            let end = if is_change && self.last.is_some() { "\n" } else { "" };
            output::text(&format!("{end}\r{line}\x1b[K"))?;
        } else {
            output::text_line(&line)?;
        }
        self.last = Some(state);
        Ok(())
    }

    fn gap(&mut self, gap: &Gap, _health: &Health) -> anyhow::Result<()> {
        if self.json {
            return output::json_line(&json!({ "gap": gap }));
        }
        eprintln!("{} frames lost from {}: {}", gap.frames, gap.first_sequence, gap.reason.name());
        Ok(())
    }

    fn end(&mut self, summary: &Summary) -> anyhow::Result<()> {
        if self.json {
            return output::json_line(&json!({ "summary": summary }));
        }
        if self.is_terminal {
            output::text_line("")?;
        }
        let mut line = format!("{} frames, {} dropped", summary.frames, summary.dropped);
        if let Some(accuracy) = summary.balanced_accuracy {
            line += &format!(", balanced accuracy {accuracy:.3}");
        }
        if let Some(settled) = &summary.metrics_without_transitions {
            line += &format!(
                " ({:.3} without the {} frames of entering and leaving)",
                settled.balanced_accuracy, summary.transition_frames
            );
        }
        line += &format!(", latency {:.1} ms median, {:.1} ms p99", summary.latency_ms.p50, summary.latency_ms.p99);
        output::text_line(&line)
    }
}
