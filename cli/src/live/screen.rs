//! Output of answers on the terminal, or as JSON lines.

use std::io::IsTerminal;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use anyhow::bail;
use crossbeam::channel::{SendTimeoutError, Sender, bounded};
use radome_dsp::{Gap, Occupancy};
use serde::Serialize;
use serde_json::json;

use super::answer::Summary;
use super::health::Health;
use super::sink::{ClassifiedFrame, Sink};
use crate::output;
use crate::panics::Panicked;

/// Number of lines that may wait for a reader of stdout.
const WAITING_LINES: usize = 256;
/// Interval at which a wait for the reader of stdout checks for an interrupt.
const CHECK_INTERVAL: Duration = Duration::from_millis(100);
/// Longest wait for the reader after an interrupt.
const FINAL_WAIT: Duration = Duration::from_secs(1);

/// Sink that prints answers as JSON lines or as text. The text has one line per change; on a terminal, the current line
/// is updated in place.
///
/// A thread prints, so that a reader that stops reading stops neither the classifier nor other sinks of a live board.
/// Its answers are then lost, and counted. A recording or a simulation waits for the reader, and so does the summary.
pub struct Screen {
    json: bool,
    is_terminal: bool,
    is_live: bool,
    last: Option<(Option<Occupancy>, Option<Occupancy>)>,
    lines: Option<Sender<String>>,
    thread: Option<JoinHandle<anyhow::Result<()>>>,
    /// Number of lines that were lost.
    lost_lines: u64,
    /// Time at which the wait for the reader at the end of the run noticed an interrupt.
    interrupted: Option<Instant>,
}

impl Screen {
    /// Creates a screen and writes its heading, if it has one. Frames of a live source do not wait.
    ///
    /// # Errors
    /// Standard output cannot be written, or the thread cannot be started.
    pub fn new(json: bool, is_live: bool) -> anyhow::Result<Self> {
        let is_terminal = !json && std::io::stdout().is_terminal();
        if !json {
            let head =
                format!("{:>8}  {:7} {:^23}  {:7} {:>10}", "time", "label", "empty   one     two", "truth", "latency");
            output::text_line(&head)?;
        }
        let (lines, receiver) = bounded::<String>(WAITING_LINES);
        let print = move || receiver.iter().try_for_each(|line| output::text(&line));
        let thread = std::thread::Builder::new().name("stdout".into()).spawn(print)?;
        let (lines, thread) = (Some(lines), Some(thread));
        Ok(Screen { json, is_terminal, is_live, last: None, lines, thread, lost_lines: 0, interrupted: None })
    }

    /// Prints a JSON object on a line of its own.
    fn json_line(&mut self, value: &impl Serialize) -> anyhow::Result<()> {
        self.print(output::json_text(value)? + "\n")
    }

    /// Passes text to the thread, and waits for room unless the source is live.
    fn print(&mut self, mut text: String) -> anyhow::Result<()> {
        let Some(lines) = &self.lines else { return Ok(()) };
        loop {
            match lines.send_timeout(text, if self.is_live { Duration::ZERO } else { CHECK_INTERVAL }) {
                Ok(()) => return Ok(()),
                Err(SendTimeoutError::Disconnected(_)) => return self.join(),
                Err(SendTimeoutError::Timeout(_)) if self.is_live || output::interrupted() => {
                    self.lost_lines += 1;
                    return Ok(());
                }
                Err(SendTimeoutError::Timeout(returned)) => text = returned,
            }
        }
    }

    /// Passes the last text to the thread as soon as there is room, also for a live source, and waits until all is printed.
    fn print_last(&mut self, mut text: String) -> anyhow::Result<()> {
        while let Some(lines) = &self.lines {
            match lines.send_timeout(text, CHECK_INTERVAL) {
                Ok(()) | Err(SendTimeoutError::Disconnected(_)) => break,
                Err(SendTimeoutError::Timeout(returned)) => text = returned,
            }
            self.check_reader()?;
        }
        self.join()
    }

    /// Waits until all is printed.
    fn join(&mut self) -> anyhow::Result<()> {
        self.lines = None;
        let Some(thread) = self.thread.take() else { return Ok(()) };
        while !thread.is_finished() {
            self.check_reader()?;
            std::thread::sleep(Duration::from_millis(2));
        }
        thread.join().unwrap_or_else(|payload| Err(Panicked::new(payload.as_ref()).into()))
    }

    /// Fails if the reader has not read for [`FINAL_WAIT`] after an interrupt.
    fn check_reader(&mut self) -> anyhow::Result<()> {
        if output::interrupted() && self.interrupted.get_or_insert_with(Instant::now).elapsed() > FINAL_WAIT {
            bail!("stdout is not read: the last answers and the summary are lost");
        }
        Ok(())
    }
}

/// Message about lost frames. A gap of 0 frames is one of unknown length.
pub fn gap_message(gap: &Gap) -> String {
    let Gap { first_sequence, frames, reason } = gap;
    match frames {
        0 => format!("frames lost from {first_sequence} on: {}", reason.name()),
        1 => format!("frame {first_sequence} lost: {}", reason.name()),
        _ => format!("{frames} frames lost from {first_sequence}: {}", reason.name()),
    }
}

/// Text behind a number of lost frames about gaps of unknown length, which the number does not include.
pub fn unknown_loss_text(unknown_gaps: u64) -> String {
    match unknown_gaps {
        0 => String::new(),
        _ => format!(", and an unknown number (gaps of unknown length: {unknown_gaps})"),
    }
}

impl Sink for Screen {
    fn answer(&mut self, classified: &ClassifiedFrame) -> anyhow::Result<()> {
        let answer = classified.answer;
        if self.json {
            return self.json_line(answer);
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
            self.print(format!("{end}\r{line}\x1b[K"))?;
        } else {
            self.print(line + "\n")?;
        }
        self.last = Some(state);
        Ok(())
    }

    fn gap(&mut self, gap: &Gap, _health: &Health) -> anyhow::Result<()> {
        if self.json {
            return self.json_line(&json!({ "gap": gap }));
        }
        message!("{}", gap_message(gap));
        Ok(())
    }

    fn end(&mut self, summary: &Summary) -> anyhow::Result<()> {
        if self.lost_lines > 0 {
            message!("{} answers were not printed, because stdout was not read", self.lost_lines);
        }
        if self.json {
            return self.print_last(output::json_text(&json!({ "summary": summary }))? + "\n");
        }
        let unknown_loss = unknown_loss_text(summary.gaps_of_unknown_length);
        // On a terminal the line of the last answer has no end.
        let start = if self.is_terminal { "\n" } else { "" };
        let mut line = format!("{start}{} frames, {} dropped{unknown_loss}", summary.frames, summary.dropped);
        if let Some(accuracy) = summary.balanced_accuracy {
            line += &format!(", balanced accuracy {accuracy:.3}");
        }
        if let Some(metrics) = &summary.metrics_without_transitions {
            line += &format!(
                " ({:.3} without the {} frames of entering and leaving, marked ~)",
                metrics.balanced_accuracy, summary.transition_frames
            );
        }
        line += &format!(", latency {:.1} ms median, {:.1} ms p99", summary.latency_ms.p50, summary.latency_ms.p99);
        self.print_last(line + "\n")
    }
}

#[cfg(test)]
mod tests {
    use radome_dsp::GapReason;

    use super::*;

    /// Regression test: for a gap of unknown length, `live` printed that 0 frames were lost.
    #[test]
    fn the_message_about_a_gap_of_unknown_length_has_no_count() {
        let gap = Gap { first_sequence: 12, frames: 0, reason: GapReason::Disconnected };
        assert_eq!(gap_message(&gap), "frames lost from 12 on: disconnected");
        assert_eq!(gap_message(&Gap { frames: 1, ..gap }), "frame 12 lost: disconnected");
        assert_eq!(gap_message(&Gap { frames: 3, ..gap }), "3 frames lost from 12: disconnected");
    }
}
