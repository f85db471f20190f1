//! `config.json` as the vendor's tools write it, beside folders and text files alike.
//!
//! Most state a waveform (`fmcw_single_shape`); some state the metrics that it has to reach (`fmcw_scene`:
//! [`super::vendor_scene`]).

use std::path::Path;

use radome_dsp::{FrameShape, Waveform, WaveformRequest};
use radome_files::TEXT_LIMIT_BYTES;
use serde::Serialize;
use serde_json::{Value, json};

use super::input::read_text;
use super::vendor_fields::Fields;
use super::{RecordingError, disk, vendor_scene};

/// Reads a configuration; `data` is the shape of the frames beside it, if known.
pub(super) fn read_waveform(path: &Path, data: Option<FrameShape>) -> Result<Waveform, RecordingError> {
    let text = read_text(path, TEXT_LIMIT_BYTES)?;
    let root: Value = serde_json::from_str(&text).map_err(|e| RecordingError::Corrupt {
        path: path.into(),
        offset: text.split_inclusive('\n').take(e.line().saturating_sub(1)).map(str::len).sum::<usize>() as u64
            + e.column() as u64,
        reason: format!("not JSON: {e}"),
    })?;
    let realise = |request: WaveformRequest| {
        Waveform::realise(request).map_err(|source| RecordingError::Waveform { path: path.into(), source })
    };
    let Some(object) = root.pointer("/device_config/fmcw_single_shape") else {
        let object = root.pointer("/device_config/fmcw_scene").ok_or_else(|| RecordingError::Field {
            path: path.into(),
            field: "device_config.fmcw_single_shape".into(),
            reason: "is absent, and so is fmcw_scene; recordings configured otherwise cannot be read".into(),
        })?;
        return realise(vendor_scene::request(&Fields { path, object }, data)?);
    };
    let fields = Fields { path, object };
    realise(WaveformRequest {
        start_frequency_hz: fields.number("start_frequency_Hz", Some("lower_frequency_Hz"))?,
        end_frequency_hz: fields.number("end_frequency_Hz", Some("upper_frequency_Hz"))?,
        samples_per_chirp: fields.count("num_samples_per_chirp")?,
        chirps_per_frame: fields.count("num_chirps_per_frame")?,
        sample_rate_hz: fields.number("sample_rate_Hz", None)?,
        chirp_interval_s: fields.number("chirp_repetition_time_s", None)?,
        frame_interval_s: fields.number("frame_repetition_time_s", None)?,
        rx_antennas: fields.antennas()?,
        tx_power_level: fields.optional("tx_power_level")?.unwrap_or(31.0).clamp(0.0, 255.0) as u8,
        if_gain_db: fields.number("if_gain_dB", None)?,
        high_pass_cutoff_hz: fields.optional("hp_cutoff_Hz")?.unwrap_or(80e3),
        anti_alias_cutoff_hz: fields.optional("aaf_cutoff_Hz")?.unwrap_or(500e3),
    })
}

/// Formats a number as the vendor does: without a fraction if it is whole.
fn number(value: f64) -> Value {
    if value.fract() == 0.0 && value.abs() < 9e15 { json!(value as i64) } else { json!(value) }
}

/// Writes the configuration of a recording: the request of the waveform, from which reading restores the same waveform.
pub(super) fn write_waveform(waveform: &Waveform, path: &Path) -> Result<(), RecordingError> {
    let r = &waveform.request;
    write_json(
        path,
        &json!({ "device_config": { "fmcw_single_shape": {
            "aaf_cutoff_Hz": number(r.anti_alias_cutoff_hz),
            "chirp_repetition_time_s": number(r.chirp_interval_s),
            "end_frequency_Hz": number(r.end_frequency_hz),
            "frame_repetition_time_s": number(r.frame_interval_s),
            "hp_cutoff_Hz": number(r.high_pass_cutoff_hz),
            "if_gain_dB": number(r.if_gain_db),
            "mimo_mode": "off",
            "num_chirps_per_frame": r.chirps_per_frame,
            "num_samples_per_chirp": r.samples_per_chirp,
            "rx_antennas": r.rx_antennas.antennas(),
            "sample_rate_Hz": number(r.sample_rate_hz),
            "start_frequency_Hz": number(r.start_frequency_hz),
            "tx_antennas": [1],
            "tx_power_level": r.tx_power_level,
        } } }),
    )
}

/// Writes a JSON file with the vendor's indentation.
pub(super) fn write_json(path: &Path, value: &Value) -> Result<(), RecordingError> {
    let mut bytes = Vec::new();
    let formatter = serde_json::ser::PrettyFormatter::with_indent(b"    ");
    let mut serializer = serde_json::Serializer::with_formatter(&mut bytes, formatter);
    value.serialize(&mut serializer).map_err(|e| RecordingError::cannot_write(path)(e.into()))?;
    bytes.push(b'\n');
    disk::write_file(path, &bytes).map_err(RecordingError::cannot_write(path))
}
