//! What could keep the program from doing its work on this machine, found before it does.

mod bundle;
mod checks;
mod wire;

use std::path::PathBuf;

use anyhow::bail;
use serde::Serialize;
use serde_json::json;

use crate::output;
pub use wire::WireLog;

/// `radome doctor`
#[derive(clap::Args)]
pub struct Arguments {
    /// Also open this source and judge frames of it: serial:PORT, auto, a recording, ...; without it, boards that are attached
    /// are asked who they are
    source: Option<String>,
    /// Model that is to judge: whether it can be read, and whether it fits the source
    #[arg(long)]
    model: Option<PathBuf>,
    /// MQTT broker that is to be told: whether it answers
    #[arg(long, value_name = "URL")]
    mqtt: Option<String>,
    /// Folder that recordings are to go to: room, speed, permission
    #[arg(long, value_name = "FOLDER", default_value = ".")]
    record_to: PathBuf,
    /// Pack what a bug report needs into this archive: answers, board, registers, frames, what was said on the
    /// wire; no names, logins or networks
    #[arg(long, value_name = "FILE.zip")]
    bundle: Option<PathBuf>,
    /// One object a check
    #[arg(long)]
    json: bool,
    /// What is said on the wire meanwhile.
    #[arg(skip)]
    wire: WireLog,
}

impl Arguments {
    /// Where what is said on the wire is to go, if anybody will read it.
    pub fn wire_log(&self) -> Option<&WireLog> {
        self.bundle.as_ref().map(|_| &self.wire)
    }
}

/// How a check went.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
enum Verdict {
    Ok,
    /// Something will be missing or slow.
    Warn,
    /// It will not work.
    Fail,
}

/// What was looked at and what was found.
#[derive(Debug, Clone, Serialize)]
struct Check {
    check: &'static str,
    verdict: Verdict,
    found: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    hint: Option<String>,
}

impl Check {
    fn ok(check: &'static str, found: impl Into<String>) -> Self {
        Check { check, verdict: Verdict::Ok, found: found.into(), hint: None }
    }

    fn warn(check: &'static str, found: impl Into<String>, hint: impl Into<String>) -> Self {
        Check { check, verdict: Verdict::Warn, found: found.into(), hint: Some(hint.into()) }
    }

    fn fail(check: &'static str, found: impl Into<String>, hint: impl Into<String>) -> Self {
        Check { check, verdict: Verdict::Fail, found: found.into(), hint: Some(hint.into()) }
    }

    /// What an error says, and what it says to do.
    fn error(check: &'static str, error: &anyhow::Error) -> Self {
        let text = output::chain(error);
        let (found, hint) = match text.split_once("\n\nhint: ") {
            Some((found, hint)) => (found.to_owned(), Some(hint.to_owned())),
            None => (text, None),
        };
        Check { check, verdict: Verdict::Fail, found, hint }
    }
}

/// Looks at everything; fails if something does.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let mut report = Report { as_json: arguments.json, checks: Vec::new() };
    report.say(checks::program())?;
    report.say(checks::clock())?;
    report.say(checks::udev_rules())?;
    report.say(checks::page_port())?;
    let model = match &arguments.model {
        Some(path) => {
            let (check, model) = checks::model(path);
            report.say(check)?;
            model
        }
        None => None,
    };
    report.say(checks::onnxruntime(arguments.model.as_deref()))?;
    if let Some(url) = &arguments.mqtt {
        report.say(checks::broker(url))?;
    }
    let mut waveform = model.as_ref().and_then(|model| model.waveform().cloned());
    let mut examined = None;
    match &arguments.source {
        Some(spec) => {
            let (found, seen) = checks::source(spec, model);
            found.into_iter().try_for_each(|check| report.say(check))?;
            waveform = seen.as_ref().map(|seen| seen.header.waveform.clone()).or(waveform);
            examined = seen;
        }
        None => checks::devices().into_iter().try_for_each(|check| report.say(check))?,
    }
    checks::disk(&arguments.record_to, waveform.as_ref()).into_iter().try_for_each(|check| report.say(check))?;
    if let Some(path) = &arguments.bundle {
        bundle::write(path, &report.checks, examined.as_ref(), arguments.model.as_deref(), &arguments.wire)?;
        eprintln!("{}: look at it before it is sent anywhere", path.display());
    }
    let count = |verdict: Verdict| report.checks.iter().filter(|check| check.verdict == verdict).count();
    let (warnings, failures) = (count(Verdict::Warn), count(Verdict::Fail));
    let checked = report.checks.len();
    if arguments.json {
        let summary = json!({ "summary": { "checks": checked, "warnings": warnings, "failures": failures } });
        output::json_line(&summary)?;
    } else {
        output::text_line(&format!("{checked} checks, {warnings} warnings, {failures} failures"))?;
    }
    if failures > 0 {
        bail!("{failures} of {checked} checks failed");
    }
    Ok(())
}

/// Says what is found as it is found, and keeps it.
struct Report {
    as_json: bool,
    checks: Vec<Check>,
}

impl Report {
    fn say(&mut self, check: Check) -> anyhow::Result<()> {
        if self.as_json {
            output::json_line(&check)?;
        } else {
            let mark = match check.verdict {
                Verdict::Ok => "ok  ",
                Verdict::Warn => "WARN",
                Verdict::Fail => "FAIL",
            };
            let hint = check.hint.as_ref().map(|hint| format!("\n{:18}hint: {hint}", "")).unwrap_or_default();
            output::text_line(&format!("{mark}  {:11} {}{hint}", check.check, check.found))?;
        }
        self.checks.push(check);
        Ok(())
    }
}
