//! Trace of requests to boards and their responses, for the bundle.

use std::fmt::{self, Write};
use std::sync::{Arc, Mutex};
use std::time::Instant;

use radome_driver::transport::trace::TARGET;
use tracing::field::{Field, Visit};
use tracing::{Event, Subscriber};
use tracing_subscriber::Layer;
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::layer::Context;
use tracing_subscriber::registry::LookupSpan;

use crate::panics::lock;

/// Number of lines kept at the beginning, with identification and programming, and at the end, where a failure may
/// show.
const FIRST_LINES: usize = 400;
const LAST_LINES: usize = 200;

/// Collects the driver's log events of requests and responses, and the identities of the boards in them.
#[derive(Debug, Clone)]
pub struct WireLog {
    started: Instant,
    lines: Arc<Mutex<Lines>>,
}

#[derive(Debug, Default)]
struct Lines {
    first: Vec<String>,
    last: std::collections::VecDeque<String>,
    left_out: usize,
    identities: Vec<String>,
}

impl Default for WireLog {
    fn default() -> Self {
        WireLog { started: Instant::now(), lines: Arc::default() }
    }
}

impl WireLog {
    pub fn layer<S: Subscriber + for<'a> LookupSpan<'a>>(&self) -> impl Layer<S> + use<S> {
        self.clone().with_filter(Targets::new().with_target(TARGET, LevelFilter::TRACE))
    }

    /// Returns lines of seconds, direction and bytes.
    pub fn text(&self) -> String {
        let lines = lock(&self.lines);
        let mut text = lines.first.concat();
        if lines.left_out > 0 {
            text += &format!("... {} lines left out\n", lines.left_out);
        }
        text.extend(lines.last.iter().map(String::as_str));
        text
    }

    /// Identities of the boards that were queried, in hexadecimal: their bytes occur in the lines.
    pub fn identities(&self) -> Vec<String> {
        lock(&self.lines).identities.clone()
    }
}

impl Lines {
    fn push(&mut self, line: String) {
        if self.first.len() < FIRST_LINES {
            return self.first.push(line);
        }
        if self.last.len() == LAST_LINES {
            self.last.pop_front();
            self.left_out += 1;
        }
        self.last.push_back(line);
    }
}

impl<S: Subscriber> Layer<S> for WireLog {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        let mut line = format!("{:10.4}", self.started.elapsed().as_secs_f64());
        let mut text = EventText { line: &mut line, identity: None };
        event.record(&mut text);
        let identity = text.identity;
        let mut lines = lock(&self.lines);
        if let Some(identity) = identity {
            lines.identities.push(identity);
            return;
        }
        line.push('\n');
        lines.push(line);
    }
}

/// Collects the single field of an event: a board's identity, or text after a mark of its direction.
struct EventText<'a> {
    line: &'a mut String,
    identity: Option<String>,
}

impl Visit for EventText<'_> {
    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        let mark = match field.name() {
            "identity" => {
                self.identity = Some(format!("{value:?}"));
                return;
            }
            "sent" => ">",
            "received" => "<",
            name => name,
        };
        // Writing to a string does not fail.
        let _ = write!(self.line, " {mark} {value:?}");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_trace_keeps_its_beginning_and_its_end() {
        let mut lines = Lines::default();
        (0..FIRST_LINES + LAST_LINES + 5).for_each(|i| lines.push(format!("{i}\n")));
        let log = WireLog { lines: Arc::new(Mutex::new(lines)), ..WireLog::default() };
        let text = log.text();
        assert!(text.starts_with("0\n1\n") && text.ends_with(&format!("{}\n", FIRST_LINES + LAST_LINES + 4)), "{text}");
        assert_eq!(text.lines().count(), FIRST_LINES + LAST_LINES + 1);
        assert!(text.contains(&format!("{}\n... 5 lines left out\n{}\n", FIRST_LINES - 1, FIRST_LINES + 5)), "{text}");
    }
}
