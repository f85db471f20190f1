//! Answers on stdout, errors and progress on stderr.

use std::io::{IsTerminal, Write};
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::Context;
use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;

/// Writes one JSON object on a line of its own, at once.
pub fn json_line(value: &impl Serialize) -> anyhow::Result<()> {
    let line = serde_json::to_string(value).context("cannot write the answer as JSON")?;
    text_line(&line)
}

/// Writes a line of text, at once.
pub fn text_line(line: &str) -> anyhow::Result<()> {
    let mut stdout = std::io::stdout().lock();
    writeln!(stdout, "{line}")?;
    stdout.flush()?;
    Ok(())
}

/// Whether an error only says that nobody reads stdout any more.
pub fn is_closed_pipe(error: &anyhow::Error) -> bool {
    error
        .chain()
        .any(|cause| cause.downcast_ref::<std::io::Error>().is_some_and(|e| e.kind() == std::io::ErrorKind::BrokenPipe))
}

/// An error with its causes, each said once, and hints moved to the end.
pub fn chain(error: &anyhow::Error) -> String {
    let mut parts: Vec<String> = Vec::new();
    let mut hints: Vec<String> = Vec::new();
    for cause in error.chain() {
        let text = cause.to_string();
        let (message, hint) = text.split_once("\n\nhint: ").map_or((text.as_str(), None), |(m, h)| (m, Some(h)));
        if !parts.iter().any(|p| p.contains(message)) {
            parts.push(message.to_owned());
        }
        if let Some(hint) = hint.filter(|h| !hints.iter().any(|x| x == h)) {
            hints.push(hint.to_owned());
        }
    }
    let hints: String = hints.iter().map(|h| format!("\n\nhint: {h}")).collect();
    parts.join(": ") + &hints
}

/// A progress bar on stderr, hidden where nobody watches.
pub fn progress(length: u64, what: &'static str) -> ProgressBar {
    if !std::io::stderr().is_terminal() {
        return ProgressBar::hidden();
    }
    let style = ProgressStyle::with_template("{prefix} {bar:32} {pos}/{len} {msg} {eta}");
    let bar = ProgressBar::new(length).with_prefix(what);
    if let Ok(style) = style { bar.with_style(style) } else { bar }
}

static INTERRUPTED: AtomicBool = AtomicBool::new(false);

/// Makes Ctrl-C and SIGTERM ask for an orderly end; a second one ends at once.
pub fn catch_interrupts() -> anyhow::Result<()> {
    // A command may be made of others that ask for the same.
    static CAUGHT: AtomicBool = AtomicBool::new(false);
    if CAUGHT.swap(true, Ordering::SeqCst) {
        return Ok(());
    }
    ctrlc::set_handler(|| {
        if INTERRUPTED.swap(true, Ordering::SeqCst) {
            std::process::exit(130);
        }
    })
    .context("cannot catch Ctrl-C")
}

/// Whether an orderly end has been asked for.
pub fn interrupted() -> bool {
    INTERRUPTED.load(Ordering::SeqCst)
}
