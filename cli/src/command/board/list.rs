use std::time::Duration;

use radome_driver::Candidate;
use radome_driver::discover::{self, Change, Identity, Roots, State, Watch};
use serde::Serialize;

use super::reset;
use crate::output;

/// Polling interval of `--watch`.
const POLL_INTERVAL: Duration = Duration::from_millis(500);

/// `radome board list`
#[derive(clap::Args)]
pub struct Arguments {
    /// Also send requests to serial ports without a board's USB ids. Other devices on them may not know these requests
    #[arg(long, alias = "ask-all")]
    probe: bool,
    /// Report what is plugged in or unplugged, until stopped
    #[arg(long, conflicts_with_all = ["reset", "udev_rules"])]
    watch: bool,
    /// Reset the chip on a debug probe. Former option, replaced by `radome board reset`
    #[arg(long, hide = true, value_name = "PROBE", conflicts_with = "udev_rules")]
    reset: Option<String>,
    /// Print the udev rules that give all users access
    #[arg(long)]
    udev_rules: bool,
    /// Print one JSON object per candidate
    #[arg(long)]
    json: bool,
}

/// Candidate and its answer.
#[derive(Serialize)]
struct Report {
    #[serde(skip_serializing_if = "Option::is_none")]
    event: Option<&'static str>,
    #[serde(flatten)]
    candidate: Candidate,
    #[serde(flatten)]
    state: Option<State>,
}

/// Lists possible boards and debug probes, with remedies for those that cannot be used.
///
/// # Errors
/// A probe cannot be reset, or standard output cannot be written.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    if arguments.udev_rules {
        return output::text_line(discover::UDEV_RULES.trim_end());
    }
    if let Some(probe) = &arguments.reset {
        return reset::reset(probe, arguments.json);
    }
    if arguments.watch {
        return watch(arguments);
    }
    let candidates = discover::candidates();
    let is_empty = candidates.is_empty();
    for candidate in candidates {
        let state = Some(discover::ask(&candidate, arguments.probe));
        print_report(&Report { event: None, candidate, state }, arguments.json)?;
    }
    if is_empty && !arguments.json {
        message!("nothing found\n\nhint: radome demo needs no board; radome board emulate makes one");
    }
    Ok(())
}

fn print_report(report: &Report, as_json: bool) -> anyhow::Result<()> {
    if as_json { output::json_line(report) } else { output::text_line(&describe(report)) }
}

fn watch(arguments: &Arguments) -> anyhow::Result<()> {
    output::catch_interrupts()?;
    let mut watch = Watch::new(Roots::default());
    while !output::interrupted() {
        for change in watch.look() {
            let (event, candidate) = match change {
                Change::Added(candidate) => ("added", candidate),
                Change::Changed(candidate) => ("changed", candidate),
                Change::Removed(candidate) => ("removed", candidate),
            };
            let state = (event != "removed").then(|| discover::ask(&candidate, arguments.probe));
            print_report(&Report { event: Some(event), candidate, state }, arguments.json)?;
        }
        std::thread::sleep(POLL_INTERVAL);
    }
    Ok(())
}

fn describe(report: &Report) -> String {
    let Report { event, candidate, state } = report;
    let mut line = match event {
        Some(event) => format!("{event:8} "),
        None => String::new(),
    };
    line += &format!("{:20} {}", candidate.path.display(), candidate.belief.description());
    if let Some(product) = candidate.usb.as_ref().and_then(|usb| usb.product.as_deref()) {
        line += &format!(" \"{product}\"");
    }
    let reset =
        candidate.debug_probe.as_ref().map(|probe| format!("\n    hint: radome board reset {}", probe.display()));
    match state {
        None => {}
        Some(State::Ready { identity: Identity::Board(board) }) => {
            line += &format!(": ready: {}, firmware {}, {}", board.name, board.firmware_version, board.chip);
        }
        Some(State::Ready { identity: Identity::Probe(probe) }) => {
            line += &format!(
                ": ready: {}, firmware {}, serial number {}",
                probe.product, probe.firmware_version, probe.serial_number
            );
        }
        Some(State::Prints) => {
            line += &format!(
                ": prints lines\n    hint: if these are frames of an ESP32: radome live serial:{}",
                candidate.path.display()
            );
        }
        Some(State::NotAsked) => line += ": not asked",
        Some(State::Busy) => line += ": busy: another program has it",
        Some(State::PermissionDenied { remedy }) => line += &format!(": permission denied\n    hint: {remedy}"),
        Some(State::NotAnswering { why }) => line += &format!(": {why}{}", reset.unwrap_or_default()),
        Some(State::OtherChip { chip }) => line += &format!(": radar chip {chip}; this program drives the BGT60TR13C"),
        Some(State::NoDriver) => line += ": it has no serial port\n    hint: sudo modprobe cdc_acm",
    }
    line
}
