//! Output of answers on stdout, and of errors and progress on stderr.

use std::io::{IsTerminal, Read, StdoutLock, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM, SIGXFSZ};
use signal_hook::iterator::Signals;

/// Writes one JSON object on a line of its own, and flushes it.
///
/// # Errors
/// [`StdoutClosed`], or standard output cannot be written.
pub fn json_line(value: &impl Serialize) -> anyhow::Result<()> {
    text_line(&json_text(value)?)
}

/// Formats a value as JSON on one line.
///
/// # Errors
/// The value has no form in JSON.
pub fn json_text(value: &impl Serialize) -> anyhow::Result<String> {
    serde_json::to_string(value).context("cannot write the answer as JSON")
}

/// Writes a line of text, and flushes it.
///
/// # Errors
/// [`StdoutClosed`], or standard output cannot be written.
pub fn text_line(line: &str) -> anyhow::Result<()> {
    text(&format!("{line}\n"))
}

/// Escapes line ends and other control characters, so that a text fits on one line.
pub fn on_one_line(text: &str) -> String {
    text.chars().fold(String::new(), |mut line, character| {
        match character.is_control() {
            true => line.extend(character.escape_default()),
            false => line.push(character),
        }
        line
    })
}

/// Formats a number of a table; `-` for `None`.
pub fn or_dash(value: Option<f64>, decimals: usize) -> String {
    value.map_or("-".to_owned(), |value| format!("{value:.decimals$}"))
}

/// Writes text, and flushes it.
///
/// # Errors
/// [`StdoutClosed`], or standard output cannot be written.
pub fn text(text: &str) -> anyhow::Result<()> {
    to_stdout(|stdout| stdout.write_all(text.as_bytes()))
}

/// Writes all bytes of a reader.
///
/// # Errors
/// [`StdoutClosed`], the bytes cannot be read, or standard output cannot be written.
pub fn bytes(reader: &mut impl Read) -> anyhow::Result<()> {
    to_stdout(|stdout| std::io::copy(reader, stdout).map(drop))
}

/// Writes to stdout. All output there uses this function.
fn to_stdout(write: impl FnOnce(&mut StdoutLock) -> std::io::Result<()>) -> anyhow::Result<()> {
    let mut stdout = std::io::stdout().lock();
    match write(&mut stdout).and_then(|()| stdout.flush()) {
        Err(error) if error.kind() == std::io::ErrorKind::BrokenPipe => Err(StdoutClosed.into()),
        written => written.context("cannot write to stdout"),
    }
}

/// Refuses to write binary data to a terminal.
///
/// # Errors
/// Standard output is a terminal.
pub fn check_no_terminal() -> anyhow::Result<()> {
    if std::io::stdout().is_terminal() {
        bail!("binary data are not written to a terminal\n\nhint: pipe them to a program, or name a file");
    }
    Ok(())
}

/// Error of writing to a stdout that its reader has closed. It is the only error that ends a command without a message and with
/// status 0.
#[derive(Debug, thiserror::Error)]
#[error("stdout was closed")]
pub struct StdoutClosed;

/// Returns whether an error only means that the reader of stdout has closed it.
pub fn is_closed_stdout(error: &anyhow::Error) -> bool {
    error.is::<StdoutClosed>()
}

/// Treats a closed stdout as success, for output after the work is done.
///
/// # Errors
/// The given error, unless it is [`StdoutClosed`].
pub fn ignore_closed_stdout(written: anyhow::Result<()>) -> anyhow::Result<()> {
    written.or_else(|error| if is_closed_stdout(&error) { Ok(()) } else { Err(error) })
}

/// Formats an error with its causes, each once, and with hints moved to the end.
pub fn chain(error: &anyhow::Error) -> String {
    let mut parts: Vec<String> = Vec::new();
    let mut hints: Vec<String> = Vec::new();
    for cause in error.chain() {
        let text = cause.to_string();
        let (message, hint) = match text.split_once("\n\nhint: ") {
            Some((message, hint)) => (message, Some(hint)),
            None => (text.as_str(), None),
        };
        if !parts.iter().any(|part| part.contains(message)) {
            parts.push(message.to_owned());
        }
        if let Some(hint) = hint.filter(|hint| !hints.iter().any(|other| other == hint)) {
            hints.push(hint.to_owned());
        }
    }
    let hints: String = hints.iter().map(|h| format!("\n\nhint: {h}")).collect();
    parts.join(": ") + &hints
}

/// Creates a progress bar on stderr, hidden if stderr is not a terminal.
pub fn progress(length: u64, what: &'static str) -> ProgressBar {
    if !std::io::stderr().is_terminal() {
        return ProgressBar::hidden();
    }
    let style = ProgressStyle::with_template("{prefix} {bar:32} {pos}/{len} {msg} {eta}");
    let bar = ProgressBar::new(length).with_prefix(what);
    if let Ok(style) = style { bar.with_style(style) } else { bar }
}

/// Makes a write beyond the limit on the size of files (`ulimit -f`) fail with an error, where the system ends the program
/// by default.
pub fn catch_file_size_limit() {
    // The handler does nothing: the write fails because there is one. A system that refuses it keeps its default.
    let _ = signal_hook::flag::register(SIGXFSZ, Arc::default());
}

static INTERRUPTED: AtomicBool = AtomicBool::new(false);

/// Time after the first signal within which further signals are ignored: a terminal that closes sends several.
const SAME_SIGNAL: Duration = Duration::from_secs(1);

/// Makes Ctrl-C, SIGTERM and a closed terminal request an orderly end. Repeated after a second, a signal ends the program at
/// once. Under `nohup`, a closed terminal is ignored.
///
/// # Errors
/// The system refuses the handler.
pub fn catch_interrupts() -> anyhow::Result<()> {
    // A command may call other commands that install the handler too.
    static CAUGHT: AtomicBool = AtomicBool::new(false);
    if CAUGHT.swap(true, Ordering::SeqCst) {
        return Ok(());
    }
    let hangup = (!is_hangup_ignored()).then_some(SIGHUP);
    let mut signals = Signals::new([SIGINT, SIGTERM].into_iter().chain(hangup)).context("cannot catch Ctrl-C")?;
    let wait = move || {
        let mut first = None;
        for _ in signals.forever() {
            let first = *first.get_or_insert_with(Instant::now);
            if INTERRUPTED.swap(true, Ordering::SeqCst) && first.elapsed() > SAME_SIGNAL {
                std::process::exit(130);
            }
        }
    };
    std::thread::Builder::new().name("signals".into()).spawn(wait).context("cannot catch Ctrl-C")?;
    Ok(())
}

/// Returns whether the process was started with SIGHUP ignored, as `nohup` does. The mask of ignored signals has SIGHUP in
/// its lowest bit.
fn is_hangup_ignored() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).is_some_and(|mask| mask & 1 == 1)
}

/// Returns whether an orderly end has been requested.
pub fn interrupted() -> bool {
    INTERRUPTED.load(Ordering::SeqCst)
}

/// Error of work that ended because [`interrupted`] is true.
#[derive(Debug, thiserror::Error)]
#[error("interrupted")]
pub struct Interrupted;
