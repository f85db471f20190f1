//! Native recording with valid records and check sums and arbitrary content: metadata, frames, gaps and labels.

#![no_main]

use std::collections::BTreeMap;
use std::io::Cursor;

use libfuzzer_sys::fuzz_target;
use mcap::records::{MessageHeader, Metadata};
use mcap::{Compression, WriteOptions};
use radome_fuzz::{check_mcap, folder, parts, waveform};

/// Builds a recording from the parts of an input: metadata, then messages.
fn build(input: &[u8]) -> Option<Vec<u8>> {
    let mut parts = parts(input, usize::MAX).into_iter();
    let valid_waveform = serde_json::to_string(&waveform()).ok()?;
    let mut text = |default: &str| {
        let part = parts.next().unwrap_or(&[]);
        if part.is_empty() { Some(default.to_owned()) } else { String::from_utf8(part.to_vec()).ok() }
    };
    let metadata = BTreeMap::from([
        ("format_version".to_owned(), text("1")?),
        ("waveform".to_owned(), text(&valid_waveform)?),
        ("board".to_owned(), text("null")?),
        ("registers".to_owned(), text("[]")?),
    ]);
    let mut writer = WriteOptions::new()
        .disable_seeking(true)
        .chunk_size(None)
        .compression(Some(Compression::Zstd))
        .compression_level(1)
        .compression_threads(0)
        .create(Cursor::new(Vec::new()))
        .ok()?;
    writer.write_metadata(&Metadata { name: "radome".into(), metadata }).ok()?;
    let schema = writer.add_schema("radome.frame", "", &[]).ok()?;
    let no_metadata = BTreeMap::new();
    let channels = [
        writer.add_channel(schema, "/radome/frames", "radome.frame", &no_metadata).ok()?,
        writer.add_channel(0, "/radome/gaps", "json", &no_metadata).ok()?,
        writer.add_channel(0, "/radome/labels", "json", &no_metadata).ok()?,
        writer.add_channel(0, "/other", "json", &no_metadata).ok()?,
    ];
    for (index, part) in parts.enumerate() {
        let Some((&kind, body)) = part.split_first() else { continue };
        if kind & 4 != 0 {
            writer.flush().ok()?;
        }
        let header = MessageHeader {
            channel_id: channels[usize::from(kind & 3)],
            sequence: index as u32,
            log_time: index as u64,
            publish_time: index as u64,
        };
        writer.write_to_known_channel(&header, body).ok()?;
    }
    writer.finish().ok()?;
    Some(writer.into_inner().into_inner())
}

fuzz_target!(|input: &[u8]| {
    let Some(bytes) = build(input) else { return };
    let folder = folder();
    check_mcap(folder.path(), &bytes);
});
