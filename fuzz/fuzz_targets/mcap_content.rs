//! Native recording with valid records and check sums and arbitrary content: metadata, frames, gaps and labels.

#![no_main]

use std::collections::BTreeMap;
use std::io::Cursor;

use libfuzzer_sys::fuzz_target;
use mcap::records::{MessageHeader, Metadata};
use mcap::{Compression, WriteOptions};
use radome_fuzz::{check_mcap, folder, parts, waveform};

fn build(input: &[u8]) -> Option<Vec<u8>> {
    let mut parts = parts(input, usize::MAX).into_iter();
    let good = serde_json::to_string(&waveform()).ok()?;
    let mut text = |good: &str| {
        let part = parts.next().unwrap_or(&[]);
        if part.is_empty() { Some(good.to_owned()) } else { String::from_utf8(part.to_vec()).ok() }
    };
    let metadata = BTreeMap::from([
        ("format_version".to_owned(), text("1")?),
        ("waveform".to_owned(), text(&good)?),
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
    let none = BTreeMap::new();
    let channels = [
        writer.add_channel(schema, "/radome/frames", "radome.frame", &none).ok()?,
        writer.add_channel(0, "/radome/gaps", "json", &none).ok()?,
        writer.add_channel(0, "/radome/labels", "json", &none).ok()?,
        writer.add_channel(0, "/other", "json", &none).ok()?,
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
