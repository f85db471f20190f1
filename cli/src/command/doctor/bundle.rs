//! Archive for a bug report. Tokens replace names of people, machines and networks.

use std::io::{Cursor, ErrorKind, Write};
use std::path::Path;

use anyhow::{Context, bail, ensure};
use radome_driver::Recorder;
use radome_models::ModelCard;
use serde::Serialize;
use serde_json::json;
use zip::write::SimpleFileOptions;

use super::check::Check;
use super::checks::Examined;
use super::redact::{Kind, Redactor};
use super::wire::WireLog;
use crate::files;

const EXISTS_HINT: &str = "hint: choose another name for --bundle, or remove that file";

/// Fails early if the archive's name is taken or its folder is missing.
///
/// # Errors
/// The file exists, or its folder does not.
pub fn check_absent(path: &Path) -> anyhow::Result<()> {
    files::check_parent(path)?;
    // This also rejects a link whose target is missing.
    ensure!(path.symlink_metadata().is_err(), "{} exists and is not written over\n\n{EXISTS_HINT}", path.display());
    Ok(())
}

/// Names and contents of the archive's files.
///
/// # Errors
/// A part cannot be written as JSON.
pub fn parts(
    checks: &[Check],
    examined: Option<&Examined>,
    model: Option<&Path>,
    wire: &WireLog,
    redactor: &mut Redactor,
) -> anyhow::Result<Vec<(&'static str, Vec<u8>)>> {
    let candidates = radome_driver::candidates();
    let serials = candidates.iter().filter_map(|candidate| candidate.usb.as_ref()?.serial_number.clone());
    let board = examined.and_then(|examined| examined.header.board.as_ref());
    for serial in serials.chain(wire.identities()).chain(board.map(|board| board.uuid.clone())) {
        // A board without an identity reports zeros.
        if serial.contains(|c| c != '0') {
            redactor.hide(&serial, Kind::Serial);
        }
    }
    let mut parts = vec![
        ("README.txt", README.as_bytes().to_vec()),
        ("checks.json", redacted(&checks, redactor)?),
        (
            "program.json",
            pretty(&json!({
                "version": env!("CARGO_PKG_VERSION"),
                "architecture": std::env::consts::ARCH,
                "system": std::env::consts::OS,
                "kernel_level": radome_dsp::KernelLevel::detect().name(),
            }))?,
        ),
        ("devices.json", redacted(&candidates, redactor)?),
        ("wire.txt", redactor.wire(&wire.text()).into_bytes()),
    ];
    if let Some(examined) = examined {
        let source = json!({ "description": examined.description, "waveform": examined.header.waveform, "board": examined.header.board });
        parts.push(("source.json", redacted(&source, redactor)?));
        let registers = examined.header.registers.iter().map(|r| format!("{:#04x} {:#08x}\n", r.address, r.value));
        parts.push(("registers.txt", registers.collect::<String>().into_bytes()));
        parts.push(("frames.mcap", recording(examined, redactor)?));
    }
    // The classical detector has no card, and neither has a file that cannot be read.
    if let Some(card) = model.and_then(|model| ModelCard::load(model).ok()) {
        parts.push(("model.json", redacted(&card, redactor)?));
    }
    Ok(parts)
}

/// Writes the archive atomically, and never over another file. Only its owner may read it.
///
/// # Errors
/// The file exists or cannot be written.
pub fn write(path: &Path, parts: &[(&'static str, Vec<u8>)]) -> anyhow::Result<()> {
    let mut archive = zip::ZipWriter::new(Cursor::new(Vec::new()));
    for (name, bytes) in parts {
        archive.start_file(*name, SimpleFileOptions::default()).context("cannot pack the archive")?;
        archive.write_all(bytes).context("cannot pack the archive")?;
    }
    let bytes = archive.finish().context("cannot pack the archive")?.into_inner();
    match files::create_private(path, &bytes) {
        Err(error) if error.kind() == ErrorKind::AlreadyExists => {
            bail!("{} exists and is not written over\n\n{EXISTS_HINT}", path.display())
        }
        created => created.with_context(|| format!("cannot write {}", path.display())),
    }
}

const README: &str = "What `radome doctor --bundle` found: checks.json what was checked, program.json which program, devices.json what is
attached, source.json the board and its waveform, registers.txt what its chip was told (address, value), frames.mcap its first frames
as raw codes, model.json the model's card without its numbers, wire.txt what was said to boards (>) and by them (<): seconds, then the
first bytes of each message in hexadecimal, of measurements the headers.

Paths, names of users and hosts, IP and MAC addresses, serial numbers and logins are replaced by tokens: <path-1>, <user-1>, <host-1>,
<address-1>, <serial-1>, <secret-1>, and xx for the bytes of serial numbers in wire.txt. The same text has the same token everywhere.
Device nodes such as /dev/ttyACM0 and addresses such as 127.0.0.1 stay. Names are recognised by their form, or because the command line
or this machine's settings hold them. Other names may remain: look at the files before you send them.

Frames show whether somebody moves before the radar, and when they were taken.
";

fn pretty(value: &impl Serialize) -> anyhow::Result<Vec<u8>> {
    serde_json::to_vec_pretty(value).context("cannot write JSON")
}

/// Formats a value as JSON in which tokens replace names.
fn redacted(value: &impl Serialize, redactor: &mut Redactor) -> anyhow::Result<Vec<u8>> {
    let mut value = serde_json::to_value(value).context("cannot write JSON")?;
    redactor.json(&mut value);
    pretty(&value)
}

/// Formats the frames as a recording in which a token replaces the board's identity.
fn recording(examined: &Examined, redactor: &mut Redactor) -> anyhow::Result<Vec<u8>> {
    let mut header = examined.header.clone();
    if let Some(board) = &mut header.board {
        for text in [&mut board.name, &mut board.extended_version, &mut board.uuid] {
            *text = redactor.text(text);
        }
    }
    let folder = tempfile::tempdir().context("cannot make a temporary folder")?;
    let path = folder.path().join("frames.mcap");
    let mut recorder = Recorder::create(&path, &header)?;
    examined.frames.iter().try_for_each(|frame| recorder.frame(frame))?;
    recorder.finish()?;
    std::fs::read(&path).with_context(|| format!("cannot read {}", path.display()))
}
