//! Checks for problems that could keep the program from working on this machine.

mod bundle;
mod check;
mod checks;
mod redact;
mod wire;

use std::path::{Path, PathBuf};

use anyhow::ensure;
use radome_models::ModelCard;
use radome_models::model::BUILT_IN;
use serde_json::json;

use self::check::{Check, Outcome};
use self::checks::Examined;
use self::redact::{Kind, Redactor};
use crate::classifier;
use crate::live::integrations::broker::{self, Broker, BrokerArguments, Secret};
use crate::output;
pub use wire::WireLog;

/// `radome doctor`
#[derive(clap::Args)]
pub struct Arguments {
    /// Also read frames of this source: serial:PORT, auto, a recording, ... With --model they are classified. Without a source,
    /// attached boards are only identified
    #[arg(value_hint = clap::ValueHint::AnyPath)]
    source: Option<String>,
    /// Model to check: whether it can be read, and whether it fits the source
    #[arg(long)]
    model: Option<PathBuf>,
    #[command(flatten)]
    broker: BrokerArguments,
    /// Folder for recordings, whose space, speed and permission are checked
    #[arg(long, value_name = "DIR", default_value = ".")]
    record_to: PathBuf,
    /// Pack the data for a bug report into this new archive: checks, board, registers, frames, bytes of the board's protocol.
    /// Tokens such as <path-1> replace paths, names of users and hosts, addresses, serial numbers and logins
    #[arg(long, value_name = "FILE.zip")]
    bundle: Option<PathBuf>,
    /// Print one JSON object per check
    #[arg(long)]
    json: bool,
    /// Trace of the board's protocol meanwhile.
    #[arg(skip)]
    wire: WireLog,
}

impl Arguments {
    /// Trace of the board protocol, if a bundle is to be written.
    pub fn wire_log(&self) -> Option<&WireLog> {
        self.bundle.as_ref().map(|_| &self.wire)
    }

    /// Replaces names in the archive: those of this machine, of its user, in the arguments and of the broker.
    fn redactor(&self, bundle: &Path, broker: &anyhow::Result<Option<Broker>>) -> Redactor {
        let mut redactor = Redactor::of_this_machine();
        let source = self.source.as_deref().map(|spec| {
            let prefixes = ["emulated:", "serial:", "usb:", "deepcraft:"];
            prefixes.iter().fold(spec, |spec, prefix| spec.strip_prefix(*prefix).unwrap_or(spec))
        });
        // Absolute paths are recognised anywhere. A path relative to the working folder is known only from the
        // arguments.
        let source = source.filter(|source| *source != "auto").map(Path::new);
        for path in [
            source,
            self.model.as_deref().filter(|name| !classifier::is_without_file(name)),
            Some(self.record_to.as_path()),
            self.broker.mqtt_password_file.as_deref(),
            self.broker.mqtt_ca.as_deref(),
            Some(bundle),
        ] {
            if let Some(path) = path.filter(|path| !path.starts_with("/dev")) {
                redactor.hide_path(path);
            }
        }
        for (variable, kind) in [(broker::USER_VARIABLE, Kind::User), (broker::PASSWORD_VARIABLE, Kind::Secret)] {
            redactor.hide(&std::env::var(variable).unwrap_or_default(), kind);
        }
        match (broker, self.broker.url.as_deref()) {
            (Ok(Some(broker)), _) => {
                redactor.hide(&broker.host, Kind::Host);
                redactor.hide(broker.user.as_deref().unwrap_or_default(), Kind::User);
                redactor.hide(broker.password.as_ref().map_or("", Secret::reveal), Kind::Secret);
            }
            (Err(_), Some(url)) => redactor.hide_url(url),
            _ => {}
        }
        redactor
    }
}

/// Runs all checks; fails if a check does.
///
/// # Errors
/// A check fails, or the bundle cannot be written.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    if let Some(path) = &arguments.bundle {
        bundle::check_absent(path)?;
    }
    let mut report = Report { as_json: arguments.json, checks: Vec::new() };
    report.add(checks::program())?;
    report.add(checks::clock())?;
    report.add(checks::udev_rules())?;
    report.add(checks::page_port())?;
    let model = match &arguments.model {
        Some(path) => {
            let (check, model) = checks::model(path);
            report.add(check)?;
            model
        }
        None => None,
    };
    report.add(checks::onnxruntime(arguments.model.as_deref()))?;
    // Read once: the file of the password may be a pipe.
    let broker = arguments.broker.broker();
    if let Some(check) = checks::broker(&arguments.broker, &broker) {
        report.add(check)?;
    }
    let mut waveform = model.as_ref().and_then(|model| model.waveform().cloned());
    let mut examined = None;
    match &arguments.source {
        Some(spec) => {
            let (found, source) = checks::source(spec, model);
            found.into_iter().try_for_each(|check| report.add(check))?;
            waveform = source.as_ref().map(|source| source.header.waveform.clone()).or(waveform);
            examined = source;
        }
        None => checks::devices().into_iter().try_for_each(|check| report.add(check))?,
    }
    // Without a model or a source, the waveform is that of the default model.
    let waveform = waveform.map_or_else(|| Ok(ModelCard::load(Path::new(BUILT_IN))?.waveform), anyhow::Ok)?;
    checks::disk(&arguments.record_to, &waveform).into_iter().try_for_each(|check| report.add(check))?;
    if let Some(path) = &arguments.bundle {
        pack(path, &report.checks, examined.as_ref(), arguments, &broker)?;
    }
    let count = |outcome: Outcome| report.checks.iter().filter(|check| check.outcome == outcome).count();
    let (warnings, failures) = (count(Outcome::Warn), count(Outcome::Fail));
    let checked = report.checks.len();
    if arguments.json {
        let summary = json!({ "summary": { "checks": checked, "warnings": warnings, "failures": failures } });
        output::json_line(&summary)?;
    } else {
        let plural = |n: usize, word: &str| format!("{n} {word}{}", if n == 1 { "" } else { "s" });
        let (warnings, failures) = (plural(warnings, "warning"), plural(failures, "failure"));
        output::text_line(&format!("{checked} checks, {warnings}, {failures}"))?;
    }
    ensure!(failures == 0, "{failures} of {checked} checks failed");
    Ok(())
}

/// Writes the archive, and prints a list of its content.
fn pack(
    path: &Path,
    checks: &[Check],
    examined: Option<&Examined>,
    arguments: &Arguments,
    broker: &anyhow::Result<Option<Broker>>,
) -> anyhow::Result<()> {
    let mut redactor = arguments.redactor(path, broker);
    let parts = bundle::parts(checks, examined, arguments.model.as_deref(), &arguments.wire, &mut redactor)?;
    bundle::write(path, &parts)?;
    message!("{} packs:", path.display());
    for (name, bytes) in &parts {
        message!("{:>10} bytes  {name}", bytes.len());
    }
    for (kind, count) in redactor.counts() {
        message!("{count} different texts were replaced by tokens <{}-N>", kind.word());
    }
    message!("{}: look at it before you send it anywhere", path.display());
    Ok(())
}

/// Prints each check when it is done, and stores it.
struct Report {
    as_json: bool,
    checks: Vec<Check>,
}

impl Report {
    fn add(&mut self, check: Check) -> anyhow::Result<()> {
        if self.as_json {
            output::json_line(&check)?;
        } else {
            let mark = match check.outcome {
                Outcome::Ok => "ok  ",
                Outcome::Warn => "WARN",
                Outcome::Fail => "FAIL",
            };
            let hint = check.hint.as_ref().map(|hint| format!("\n{:18}hint: {hint}", "")).unwrap_or_default();
            output::text_line(&format!("{mark}  {:11} {}{hint}", check.check, check.found))?;
        }
        self.checks.push(check);
        Ok(())
    }
}
