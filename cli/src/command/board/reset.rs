//! `radome board reset`.

use std::path::Path;

use anyhow::bail;
use radome_driver::Candidate;
use radome_driver::discover;
use radome_driver::probe::{Probe, ResetMethod};
use serde_json::json;

use crate::output;

/// `radome board reset`
#[derive(clap::Args)]
pub struct Arguments {
    /// Debug probe: its path, its serial number, or the port of its kit
    probe: String,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// Resets the chip on a debug probe.
///
/// # Errors
/// Those of [`reset`].
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    reset(&arguments.probe, arguments.json)
}

/// Finds a debug probe by its own name, or by the port of its kit.
fn find_probe(name: &str) -> anyhow::Result<Candidate> {
    let candidates = discover::candidates();
    let is_named = |c: &&Candidate| {
        c.path == Path::new(name) || c.usb.as_ref().is_some_and(|usb| usb.serial_number.as_deref() == Some(name))
    };
    let matching: Vec<&Candidate> = candidates.iter().filter(is_named).collect();
    let neighbour = matching.iter().find_map(|c| c.debug_probe.as_ref());
    let found = candidates.iter().find(|c| c.is_probe() && (matching.contains(c) || Some(&c.path) == neighbour));
    match (found, matching.is_empty()) {
        (Some(probe), _) => Ok(probe.clone()),
        (None, false) => bail!("{name} has no debug probe\n\nhint: radome board list lists the probes"),
        (None, true) => bail!("{name} is no debug probe\n\nhint: radome board list lists the probes"),
    }
}

/// Resets the chip behind a debug probe and prints the method.
///
/// # Errors
/// There is no such probe, it cannot be opened, or it does not reset the chip.
pub fn reset(name: &str, as_json: bool) -> anyhow::Result<()> {
    let candidate = find_probe(name)?;
    let method = Probe::open(&candidate)?.reset_target()?;
    let path = candidate.path.display();
    if as_json {
        return output::json_line(&json!({ "probe": path.to_string(), "reset": method }));
    }
    let how = match method {
        ResetMethod::Sequence => "by the probe's own sequence",
        ResetMethod::Pin => "by its reset line",
    };
    output::text_line(&format!("{path}: the target was reset {how}"))
}
