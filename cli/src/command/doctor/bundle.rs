//! What a bug report needs, in one archive.

use std::io::{Cursor, Write};
use std::path::Path;

use anyhow::Context;
use radome_driver::Recorder;
use radome_models::ModelCard;
use serde::Serialize;
use serde_json::json;
use zip::write::SimpleFileOptions;

use super::checks::Examined;
use super::{Check, WireLog};
use crate::files;

/// Writes the archive, whole or not at all. Nothing is packed that names the user, the machine or a network: what is there is
/// what this program found out about radar, disk and clock.
pub fn write(
    path: &Path,
    checks: &[Check],
    examined: Option<&Examined>,
    model: Option<&Path>,
    wire: &WireLog,
) -> anyhow::Result<()> {
    files::check_parent(path)?;
    let mut parts: Vec<(&str, Vec<u8>)> = vec![
        ("README.txt", README.as_bytes().to_vec()),
        ("checks.json", pretty(&checks)?),
        (
            "program.json",
            pretty(&json!({
                "version": env!("CARGO_PKG_VERSION"),
                "architecture": std::env::consts::ARCH,
                "system": std::env::consts::OS,
                "kernel_level": radome_dsp::KernelLevel::detect().name(),
            }))?,
        ),
        ("devices.json", pretty(&radome_driver::candidates())?),
        ("wire.txt", wire.text().into_bytes()),
    ];
    if let Some(seen) = examined {
        parts.push((
            "source.json",
            pretty(&json!({ "description": seen.description, "waveform": seen.header.waveform, "board": seen.header.board }))?,
        ));
        let registers = seen.header.registers.iter().map(|r| format!("{:#04x} {:#08x}\n", r.address, r.value));
        parts.push(("registers.txt", registers.collect::<String>().into_bytes()));
        parts.push(("frames.mcap", recording(seen)?));
    }
    if let Some(card) = model.and_then(|path| ModelCard::load(path).ok()) {
        parts.push(("model.json", pretty(&card)?));
    }
    files::write_atomically(path, |file| {
        let mut archive = zip::ZipWriter::new(Cursor::new(Vec::new()));
        for (name, bytes) in &parts {
            archive.start_file(*name, SimpleFileOptions::default()).context("cannot pack the archive")?;
            archive.write_all(bytes).context("cannot pack the archive")?;
        }
        let bytes = archive.finish().context("cannot pack the archive")?.into_inner();
        file.write_all(&bytes).with_context(|| format!("cannot write {}", path.display()))
    })
}

const README: &str = "What `radome doctor --bundle` found: checks.json what was checked, program.json which program, devices.json what is
attached, source.json the board and its waveform, registers.txt what its chip was told (address, value), frames.mcap its first frames
as raw codes, model.json the model's card without its numbers, wire.txt what was said to boards (>) and by them (<): seconds, then the
first bytes of each message in hexadecimal, of measurements the headers. Frames show whether somebody moves before the radar.
";

fn pretty(value: &impl Serialize) -> anyhow::Result<Vec<u8>> {
    serde_json::to_vec_pretty(value).context("cannot write JSON")
}

/// The frames as a recording.
fn recording(seen: &Examined) -> anyhow::Result<Vec<u8>> {
    let path = std::env::temp_dir().join(format!("radome-doctor-{}.mcap", std::process::id()));
    let write = || -> anyhow::Result<Vec<u8>> {
        let mut recorder = Recorder::create(&path, &seen.header)?;
        seen.frames.iter().try_for_each(|frame| recorder.frame(frame))?;
        recorder.finish()?;
        std::fs::read(&path).with_context(|| format!("cannot read {}", path.display()))
    };
    let bytes = write();
    let _ = std::fs::remove_file(&path);
    bytes
}
