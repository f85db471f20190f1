//! Reads files of `radome recording convert --to viewers` with the `mcap` crate: schemas, numbers, images and times.
//! Also checks the layout for Foxglove.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;

use prost::Message as _;
use prost_types::{FileDescriptorSet, Timestamp};
use radome_tests::{command, fails_with, fixture, json_lines, radome, root, simulate, skip, success, write_file};
use serde_json::Value;

/// Host time of the first frame of the golden recording, ns since 1970.
const HOST_NS: u64 = 1_767_683_775_000_000_000;
/// Sequence numbers of the frames of the golden recording, which are also their times in units of 0.4 s.
const FRAMES: [u64; 8] = [0, 1, 2, 3, 4, 7, 8, 9];

/// Image with three bytes a pixel.
struct Picture {
    columns: usize,
    rows: usize,
    rgb: Vec<u8>,
}

impl Picture {
    fn decode(data: &[u8]) -> Self {
        let mut reader = png::Decoder::new(std::io::Cursor::new(data)).read_info().expect("a PNG");
        let mut rgb = vec![0; reader.output_buffer_size().expect("a size")];
        let info = reader.next_frame(&mut rgb).expect("a picture");
        assert_eq!(info.color_type, png::ColorType::Rgb);
        Picture { columns: info.width as usize, rows: info.height as usize, rgb }
    }

    fn pixel(&self, column: usize, row: usize) -> [u8; 3] {
        let at = 3 * (row * self.columns + column);
        [self.rgb[at], self.rgb[at + 1], self.rgb[at + 2]]
    }
}

/// Fields of `foxglove.RawImage`.
#[derive(Clone, PartialEq, prost::Message)]
struct RawImage {
    #[prost(message, optional, tag = "1")]
    timestamp: Option<Timestamp>,
    #[prost(fixed32, tag = "2")]
    width: u32,
    #[prost(fixed32, tag = "3")]
    height: u32,
    #[prost(string, tag = "4")]
    encoding: String,
    #[prost(fixed32, tag = "5")]
    step: u32,
    #[prost(bytes = "vec", tag = "6")]
    data: Vec<u8>,
}

/// Fields of `foxglove.CompressedImage`.
#[derive(Clone, PartialEq, prost::Message)]
struct CompressedImage {
    #[prost(bytes = "vec", tag = "2")]
    data: Vec<u8>,
    #[prost(string, tag = "3")]
    format: String,
}

/// Fields of `foxglove.Log`.
#[derive(Clone, PartialEq, prost::Message)]
struct Log {
    #[prost(int32, tag = "2")]
    level: i32,
    #[prost(string, tag = "3")]
    message: String,
    #[prost(string, tag = "4")]
    name: String,
}

#[derive(Clone, PartialEq, prost::Message)]
struct State {
    #[prost(uint64, tag = "2")]
    sequence: u64,
    #[prost(double, tag = "3")]
    temperature_celsius: f64,
    #[prost(double, tag = "4")]
    frames_per_s: f64,
    #[prost(uint64, tag = "5")]
    frames_lost: u64,
    #[prost(double, tag = "7")]
    true_people: f64,
    #[prost(double, tag = "8")]
    labelled_people: f64,
}

#[derive(Clone, PartialEq, prost::Message)]
struct Answer {
    #[prost(uint64, tag = "2")]
    sequence: u64,
    #[prost(string, tag = "3")]
    label: String,
    #[prost(float, tag = "4")]
    p_empty: f32,
    #[prost(float, tag = "5")]
    p_one: f32,
    #[prost(uint32, tag = "7")]
    people: u32,
    #[prost(bool, tag = "8")]
    occupied: bool,
}

/// Message of a file: topic, type, time and content.
struct Found {
    topic: String,
    schema: String,
    time_ns: u64,
    data: Vec<u8>,
}

fn export(input: &Path, folder: &Path) -> PathBuf {
    let output = folder.join("viewers.mcap");
    let said = json_lines(command!("recording convert --to viewers --json", input, &output)).remove(0);
    assert_eq!(said["written"], std::fs::metadata(&output).expect("a file").len());
    output
}

/// Reads all messages; asserts that their schemas describe every type that they refer to.
fn read_messages(path: &Path) -> Vec<Found> {
    let bytes = std::fs::read(path).expect("reads");
    assert!(mcap::Summary::read(&bytes).expect("reads").is_some_and(|summary| summary.stats.is_some()));
    let found = mcap::MessageStream::new(&bytes).expect("an MCAP file").map(|message| {
        let message = message.expect("reads");
        let schema = message.channel.schema.as_ref().expect("a schema");
        assert_eq!((schema.encoding.as_str(), message.channel.message_encoding.as_str()), ("protobuf", "protobuf"));
        let descriptors = FileDescriptorSet::decode(&*schema.data).expect("descriptors");
        let [timestamp, file] = descriptors.file.as_slice() else { panic!("{} files", descriptors.file.len()) };
        assert_eq!(
            (timestamp.name(), file.dependency.as_slice()),
            (file.dependency[0].as_str(), &file.dependency[..1])
        );
        assert_eq!(schema.name, format!("{}.{}", file.package(), file.message_type[0].name()));
        Found {
            topic: message.channel.topic.clone(),
            schema: schema.name.clone(),
            time_ns: message.log_time,
            data: message.data.into_owned(),
        }
    });
    found.collect()
}

/// Messages of a topic, which must have this type.
fn messages_of_topic<M: prost::Message + Default>(found: &[Found], topic: &str, schema: &str) -> Vec<(u64, M)> {
    let of_topic = found.iter().filter(|message| message.topic == topic);
    let decoded = of_topic.map(|message| {
        assert_eq!(message.schema, schema);
        (message.time_ns, M::decode(&*message.data).expect("a message of its type"))
    });
    decoded.collect()
}

/// Whether both values are the same number, or both are unknown.
fn is_same(a: f64, b: Option<f64>) -> bool {
    b.map_or(a.is_nan(), |b| (a - b).abs() < 1e-6)
}

#[test]
fn chirps_and_maps_are_images_of_the_frames() {
    let folder = tempfile::tempdir().expect("a folder");
    let found = read_messages(&export(&fixture("formats/judged.mcap"), folder.path()));
    let times = FRAMES.map(|number| HOST_NS + number * 400_000_000);

    let chirps: Vec<(u64, RawImage)> = messages_of_topic(&found, "/radome/chirps", "foxglove.RawImage");
    assert_eq!(chirps.iter().map(|(time_ns, _)| *time_ns).collect::<Vec<_>>(), times);
    for ((time_ns, image), number) in chirps.iter().zip(FRAMES) {
        // 2 receivers with 2 chirps of 8 samples, 16 bits each.
        assert_eq!((image.width, image.height, image.step, image.encoding.as_str()), (8, 4, 16, "16UC1"));
        let codes: Vec<u64> = image.data.chunks(2).map(|b| u64::from(u16::from_le_bytes([b[0], b[1]]))).collect();
        assert_eq!(codes.len(), 32);
        // Rule of the golden recording: a code grows by 37 a frame, 1000 a receiver, 100 a chirp and 1 a sample.
        assert_eq!((codes[0], codes[10], codes[31]), (37 * number, 37 * number + 102, 37 * number + 1107));
        let timestamp = image.timestamp.as_ref().expect("a time");
        assert_eq!(timestamp.seconds as u64 * 1_000_000_000 + timestamp.nanos as u64, *time_ns);
    }

    let maps: Vec<(u64, CompressedImage)> = messages_of_topic(&found, "/radome/map", "foxglove.CompressedImage");
    assert_eq!(maps.iter().map(|(time_ns, _)| *time_ns).collect::<Vec<_>>(), times);
    for (_, map) in &maps {
        let image = Picture::decode(&map.data);
        // 8 samples and 2 chirps give 4 range bins and 2 velocity bins.
        assert_eq!((map.format.as_str(), image.columns, image.rows), ("png", 4, 2));
    }
}

#[test]
fn numbers_and_events_are_those_of_the_recording() {
    let folder = tempfile::tempdir().expect("a folder");
    let found = read_messages(&export(&fixture("formats/judged.mcap"), folder.path()));
    let mut times: Vec<u64> = found.iter().map(|message| message.time_ns).collect();
    assert!(times.is_sorted());
    times.dedup();
    assert_eq!(times, FRAMES.map(|number| HOST_NS + number * 400_000_000));

    let states: Vec<(u64, State)> = messages_of_topic(&found, "/radome/state", "radome.State");
    assert_eq!(states.iter().map(|(_, state)| state.sequence).collect::<Vec<_>>(), FRAMES);
    for (_, state) in &states {
        let number = state.sequence;
        let temperature = (number >= 2).then_some(if number < 5 { 31.5 } else { 31.75 });
        assert!(is_same(state.temperature_celsius, temperature), "{state:?}");
        // The frame rate is unknown after the start and after the gap.
        assert!(is_same(state.frames_per_s, (number != 0 && number != 7).then_some(2.5)), "{state:?}");
        assert_eq!(state.frames_lost, if number < 5 { 0 } else { 2 });
        assert!(is_same(state.true_people, number.is_multiple_of(2).then_some(2.0)), "{state:?}");
        assert!(is_same(state.labelled_people, (number < 4).then_some(1.0)), "{state:?}");
    }

    let answers: Vec<(u64, Answer)> = messages_of_topic(&found, "/radome/answer", "radome.Answer");
    assert_eq!(answers.iter().map(|(_, answer)| answer.sequence).collect::<Vec<_>>(), [0, 1, 2, 3, 4, 8, 9]);
    for (time_ns, answer) in &answers {
        assert_eq!(*time_ns, HOST_NS + answer.sequence * 400_000_000);
        let expected = if answer.sequence == 0 { ("", None) } else { ("one", Some(0.75)) };
        assert_eq!(answer.label, expected.0);
        assert!(is_same(f64::from(answer.p_one), expected.1), "{answer:?}");
        assert!(is_same(f64::from(answer.p_empty), expected.1.map(|_| 0.125)), "{answer:?}");
        assert_eq!((answer.people, answer.occupied), (u32::from(answer.sequence > 2), answer.sequence > 2));
    }

    let events: Vec<(u64, Log)> = messages_of_topic(&found, "/radome/events", "foxglove.Log");
    let said: Vec<_> = events.iter().map(|(_, log)| (log.level, log.name.as_str(), log.message.as_str())).collect();
    assert_eq!(
        said,
        [
            (2, "label", "one starts"),
            (2, "people", "people: 0 to 1"),
            (2, "label", "one ends"),
            (2, "label", "two, or \"more\" starts"),
            (3, "gap", "2 frames lost from frame 5 on: crc"),
            (2, "label", "two, or \"more\" ends"),
        ]
    );
}

/// Asserts that the pixels of a map are the cells of `recording maps`. A simulation has neither host times nor answers.
#[test]
fn a_pixel_of_a_map_is_a_cell() {
    let folder = tempfile::tempdir().expect("a folder");
    let input = folder.path().join("room.mcap");
    simulate(&fixture("scenes/corridor.toml"), "--frames 3 --seed 5", &input);
    let found = read_messages(&export(&input, folder.path()));
    assert!(messages_of_topic::<Answer>(&found, "/radome/answer", "radome.Answer").is_empty());
    let maps: Vec<(u64, CompressedImage)> = messages_of_topic(&found, "/radome/map", "foxglove.CompressedImage");
    assert_eq!(maps.iter().map(|(time_ns, _)| *time_ns).collect::<Vec<_>>(), [0, 100_000_000, 200_000_000]);

    let array = folder.path().join("maps.npy");
    let said = json_lines(command!("recording maps --incoherent --json -o", &array, &input)).remove(0);
    let shape: Vec<usize> = serde_json::from_value(said["shape"].clone()).expect("lengths");
    let (rows, columns) = (shape[2], shape[3]);
    let file = std::fs::File::open(&array).expect("reads");
    let db: Vec<f32> = npyz::NpyFile::new(std::io::BufReader::new(file)).expect("npy").into_vec().expect("f32");
    let image = Picture::decode(&maps[0].1.data);
    assert_eq!((image.columns, image.rows), (columns, rows));
    // The peak of the first map has the last colour. Rows are velocities, from the fastest receding one at the top
    // down.
    let first = &db[..rows * columns];
    let peak = (0..first.len()).max_by(|a, b| first[*a].total_cmp(&first[*b])).expect("cells");
    let (row, column) = (rows - 1 - peak / columns, peak % columns);
    assert_eq!(image.pixel(column, row), [253, 231, 37]);
    // Colours follow levels: the brighter of two cells has the larger green component.
    let green = |cell: usize| {
        let (column, row) = (cell % columns, rows - 1 - cell / columns);
        image.pixel(column, row)[1]
    };
    for cell in (1..first.len()).step_by(97) {
        let (darker, brighter) = if first[cell] < first[cell - 1] { (cell, cell - 1) } else { (cell - 1, cell) };
        assert!(green(darker) <= green(brighter), "cells {darker} and {brighter}");
    }
}

/// Needs the packages mcap, mcap-protobuf-support and, for Rerun's loader, rerun-sdk, in the Python that
/// `RADOME_VIEWERS_PYTHON` names, or in python3.
#[test]
#[allow(clippy::print_stderr)]
fn python_packages_read_the_file() {
    let python = std::env::var_os("RADOME_VIEWERS_PYTHON").unwrap_or_else(|| "python3".into());
    let has_packages = Command::new(&python).args(["-c", "import mcap_protobuf"]).output();
    if !has_packages.is_ok_and(|output| output.status.success()) {
        skip("mcap-protobuf", "RADOME_VIEWERS_PYTHON names a Python with the packages mcap and mcap-protobuf-support");
        return;
    }
    let script = root().join("tests/viewers/check.py");
    eprint!("{}", success(Command::new(&python).arg(script).arg(radome().get_program())).0);
}

/// Collects all strings of a JSON value.
fn strings<'a>(value: &'a Value, found: &mut Vec<&'a str>) {
    match value {
        Value::String(text) => found.push(text),
        Value::Array(list) => list.iter().for_each(|value| strings(value, found)),
        Value::Object(object) => object.values().for_each(|value| strings(value, found)),
        _ => {}
    }
}

#[test]
fn the_layout_for_foxglove_names_topics_and_fields_that_there_are() {
    let folder = tempfile::tempdir().expect("a folder");
    let bytes = std::fs::read(export(&fixture("formats/judged.mcap"), folder.path())).expect("reads");
    let summary = mcap::Summary::read(&bytes).expect("reads").expect("a summary");
    let mut fields: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for channel in summary.channels.values() {
        let schema = channel.schema.as_ref().expect("a schema");
        let descriptors = FileDescriptorSet::decode(&*schema.data).expect("descriptors");
        let message = &descriptors.file[1].message_type[0];
        fields.insert(channel.topic.clone(), message.field.iter().map(|field| field.name().to_owned()).collect());
    }

    let text = std::fs::read(root().join("docs/viewers/foxglove-layout.json")).expect("reads");
    let layout: Value = serde_json::from_slice(&text).expect("JSON");
    let mut named = Vec::new();
    strings(&layout["configById"], &mut named);
    let mut topics = BTreeSet::new();
    for name in named.into_iter().filter(|name| name.starts_with('/')) {
        let (topic, field) = name.split_once('.').map_or((name, None), |(topic, field)| (topic, Some(field)));
        let known = fields.get(topic).unwrap_or_else(|| panic!("there is no topic {topic}"));
        assert!(field.is_none_or(|field| known.contains(field)), "{topic} has no field in {name}");
        topics.insert(topic.to_owned());
    }
    assert_eq!(topics, fields.keys().cloned().collect::<BTreeSet<_>>());

    let mut panels = Vec::new();
    strings(&layout["layout"], &mut panels);
    panels.retain(|panel| panel.contains('!'));
    panels.sort_unstable();
    let mut configured: Vec<&str> =
        layout["configById"].as_object().expect("panels").keys().map(String::as_str).collect();
    configured.sort_unstable();
    assert_eq!(panels, configured);
    let page = std::fs::read_to_string(root().join("docs/viewers.md")).expect("reads");
    for topic in fields.keys() {
        assert!(page.contains(&format!("| `{topic}` |")), "docs/viewers.md lacks {topic}");
    }
}

mod hard_cases {
    use super::*;

    #[test]
    fn a_file_for_viewers_is_no_recording_and_replaces_nothing() {
        let folder = tempfile::tempdir().expect("a folder");
        let input = fixture("formats/judged.mcap");
        let output = export(&input, folder.path());
        fails_with(command!("recording info", &output), &["not one of our recordings"]);
        let before = std::fs::read(&output).expect("reads");
        fails_with(command!("recording convert --to viewers", &input, &output), &["--overwrite"]);
        assert!(std::fs::read(&output).expect("reads") == before);
    }

    #[test]
    fn the_vendors_formats_and_unfinished_recordings_are_exported() {
        let folder = tempfile::tempdir().expect("a folder");
        let found = read_messages(&export(&fixture("formats/infineon"), folder.path()));
        assert_eq!(messages_of_topic::<RawImage>(&found, "/radome/chirps", "foxglove.RawImage").len(), 8);
        std::fs::remove_file(folder.path().join("viewers.mcap")).expect("removes");
        let bytes = std::fs::read(fixture("formats/judged.mcap")).expect("reads");
        let cut = write_file(folder.path(), "cut.mcap", &bytes[..bytes.len() - 40]);
        let found = read_messages(&export(&cut, folder.path()));
        assert_eq!(messages_of_topic::<RawImage>(&found, "/radome/chirps", "foxglove.RawImage").len(), 8);
    }
}
