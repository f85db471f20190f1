use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use radome_dsp::rdm::{Motion, PhysicalAxes};
use radome_dsp::{Occupancy, Rdm, RdmSpec, Waveform, WaveformRequest};

use super::layout::MAPS_PER_SHARD;
use super::*;

fn header() -> DatasetHeader {
    let request = WaveformRequest { samples_per_chirp: 16, chirps_per_frame: 8, ..WaveformRequest::paper() };
    DatasetHeader::new(Waveform::realise(request).expect("waveform"), RdmSpec::paper()).expect("header")
}

fn map(header: &DatasetHeader, sequence: u64) -> Rdm {
    let db = (0..header.shape.cells()).map(|k| k as f32 - 1000.0 * sequence as f32).collect();
    header.rdm(db, sequence)
}

fn row(sequence: &str, frame: u64, label: Occupancy) -> ManifestRow {
    ManifestRow::new(Domain::Sim, "corridor", "run-1", sequence, frame, label)
}

/// Writes a dataset of these rows, each with the map of its frame.
fn write(path: &Path, rows: impl IntoIterator<Item = ManifestRow>) {
    let mut writer = DatasetWriter::create(path, &header()).expect("create");
    for row in rows {
        writer.push(&map(&header(), row.frame), row).expect("push");
    }
    writer.finish().expect("finish");
}

#[test]
fn written_maps_are_read_back_across_shards() {
    let dir = tempfile::tempdir().expect("folder");
    let path = dir.path().join("set");
    let header = header();
    let mut writer = DatasetWriter::create(&path, &header).expect("create");
    let maps = MAPS_PER_SHARD + 3;
    for index in 0..maps {
        let label = Occupancy::from_index(index % 3).expect("class");
        writer.push(&map(&header, index as u64), row("a", index as u64, label)).expect("push");
    }
    assert!(!path.exists(), "nothing has the final name before it is complete");
    writer.finish().expect("finish");
    assert_eq!(std::fs::read_dir(dir.path()).expect("list").count(), 1, "no temporary folder is left");
    let set = Dataset::open(&path).expect("open");
    assert_eq!((set.len(), set.header()), (maps, &header));
    for index in [0, 1, MAPS_PER_SHARD - 1, MAPS_PER_SHARD, maps - 1] {
        assert_eq!(set.map(index).expect("map"), map(&header, index as u64).db);
        assert_eq!(set.rows()[index].frame, index as u64);
    }
    set.verify().expect("hashes agree");
    assert_eq!(set.hash(), Dataset::open(&path).expect("open again").hash());
    write(&dir.path().join("copy"), set.rows().iter().cloned());
    assert_eq!(set.hash(), Dataset::open(&dir.path().join("copy")).expect("open").hash());
    assert!(matches!(set.map(maps), Err(DatasetError::NoSuchMap { .. })));
    assert!(matches!(DatasetWriter::create(&path, &header), Err(DatasetError::Exists { .. })));
}

/// Rows have the motion of their maps, also after a merge, and changed motion is damage.
#[test]
fn motion_travels_with_the_maps() {
    let dir = tempfile::tempdir().expect("folder");
    let path = dir.path().join("set");
    let motion = |k: u64| Some(Motion { second_share: 0.1 * k as f32, ..Motion::default() });
    let spec = RdmSpec { motion_over_s: Some(1.0), ..header().rdm_spec };
    let with_motion = DatasetHeader::new(header().waveform, spec).expect("header");
    let mut writer = DatasetWriter::create(&path, &with_motion).expect("create");
    for k in 0..3 {
        let map = Rdm { motion: motion(k), ..map(&with_motion, k) };
        writer.push(&map, row("a", k, Occupancy::One)).expect("push");
    }
    writer.finish().expect("finish");
    let set = Dataset::open(&path).expect("open");
    set.verify().expect("hashes agree");
    let merged = dir.path().join("merged");
    merge(&[(&path, &set)], &merged, None).expect("merge");
    for set in [&set, &Dataset::open(&merged).expect("open")] {
        for (k, row) in set.rows().iter().enumerate() {
            assert_eq!(row.motion, motion(k as u64));
        }
    }
    let manifest = path.join("manifest.jsonl");
    let text = std::fs::read_to_string(&manifest).expect("read");
    std::fs::write(&manifest, text.replace("\"second_share\":0.1", "\"second_share\":0.7")).expect("write");
    let set = Dataset::open(&path).expect("open");
    assert!(matches!(set.map(1), Err(DatasetError::Hash { index: 1, .. })));
    assert!(set.map(0).is_ok());
    // Motion that is missing, infinite or not asked for is refused.
    std::fs::write(&manifest, text.replace("\"second_share\":0.1", "\"second_share\":1e39")).expect("write");
    assert!(matches!(Dataset::open(&path), Err(DatasetError::Json { line: 2, .. })));
    for (header, motion) in [(&with_motion, None), (&header(), motion(1))] {
        let map = Rdm { motion, ..map(header, 4) };
        let mut writer = DatasetWriter::create(&dir.path().join("refused"), header).expect("create");
        assert!(matches!(writer.push(&map, row("a", 4, Occupancy::One)), Err(DatasetError::Motion { .. })));
        let of_maps = Dataset::from_maps(header.clone(), vec![(map, row("a", 4, Occupancy::One))]);
        assert!(matches!(of_maps, Err(DatasetError::Motion { .. })));
    }
}

#[test]
fn the_input_of_a_network_is_range_by_doppler() {
    let header = header();
    let map = map(&header, 0);
    let input = network_input(&map.db, map.shape, 0).expect("input");
    for range in 0..map.shape.range {
        for doppler in 0..map.shape.doppler {
            assert_eq!(input[range * map.shape.doppler + doppler], map.at(0, doppler, range));
        }
    }
    assert!(network_input(&map.db, map.shape, 1).is_none());
}

#[test]
fn sequences_stay_whole_and_every_split_sees_every_class() {
    let mut rows = Vec::new();
    for s in 0..30 {
        for frame in 0..5 {
            rows.push(row(&format!("s{s}"), frame, Occupancy::from_index(s % 3).expect("class")));
        }
    }
    let spec = SplitSpec::default();
    let splits = spec.assign(&rows).expect("splits");
    for (a, split_a) in rows.iter().zip(&splits) {
        for (b, split_b) in rows.iter().zip(&splits) {
            assert!(a.sequence != b.sequence || split_a == split_b);
        }
    }
    for split in [Split::Train, Split::Validation, Split::Test] {
        for class in Occupancy::ALL {
            assert!(rows.iter().zip(&splits).any(|(r, s)| *s == split && r.label == class), "{split} {class}");
        }
    }
    // The order of rows does not matter; the seed does.
    let backwards: Vec<ManifestRow> = rows.iter().rev().cloned().collect();
    let mut reversed = spec.assign(&backwards).expect("splits");
    reversed.reverse();
    assert_eq!(reversed, splits);
    assert_ne!(SplitSpec { seed: 1, ..spec }.assign(&rows).expect("splits"), splits);
}

#[test]
fn whole_subjects_and_whole_scenes_are_held_out() {
    let mut rows = Vec::new();
    for s in 0..24 {
        for frame in 0..3 {
            let mut row = row(&format!("s{s:02}"), frame, Occupancy::from_index(s % 2 + 1).expect("class"));
            row.subject = (s > 3).then(|| format!("subject{}", s % 5));
            row.scene = format!("scene{}", s % 4);
            row.seed = (s > 5).then_some(s as u64 % 3);
            rows.push(row);
        }
    }
    for by in [SplitBy::Subject, SplitBy::Scene, SplitBy::Seed] {
        let splits = SplitSpec { by, ..SplitSpec::default() }.assign(&rows).expect("splits");
        for (a, split_a) in rows.iter().zip(&splits) {
            for (b, split_b) in rows.iter().zip(&splits) {
                let same =
                    a.sequence == b.sequence || (by.group_name(a).is_some() && by.group_name(a) == by.group_name(b));
                assert!(!same || split_a == split_b, "{by}: {} and {}", a.sequence, b.sequence);
            }
        }
        assert!([Split::Train, Split::Test].iter().all(|split| splits.contains(split)), "{by}");
    }
    // By sequence, both splits contain the same subjects.
    let splits = SplitSpec::default().assign(&rows).expect("splits");
    let splits_of = |subject: String| {
        let rows = rows.iter().zip(&splits).filter(|(row, _)| row.subject.as_ref() == Some(&subject));
        rows.map(|(_, split)| *split).collect::<BTreeSet<_>>()
    };
    assert!((0..5).any(|i| splits_of(format!("subject{i}")).len() > 1));
}

#[test]
fn merged_parts_are_what_one_writer_would_have_written() {
    let dir = tempfile::tempdir().expect("folder");
    let header = header();
    let write = |name: &str, frames: std::ops::Range<u64>| {
        write(&dir.path().join(name), frames.map(|frame| row(&format!("s{}", frame / 4), frame, Occupancy::One)));
        Dataset::open(&dir.path().join(name)).expect("open")
    };
    let (whole, a, b, c) = (write("whole", 0..300), write("a", 0..7), write("b", 7..7), write("c", 7..300));
    let parts = [(dir.path(), &a), (dir.path(), &b), (dir.path(), &c)];
    assert_eq!(merge(&parts, &dir.path().join("merged"), None).expect("merges"), 300);
    let files = |name: &str| {
        let entries = std::fs::read_dir(dir.path().join(name)).expect("list").map(|entry| entry.expect("entry"));
        entries
            .map(|entry| (entry.file_name(), std::fs::read(entry.path()).expect("reads")))
            .collect::<BTreeMap<_, _>>()
    };
    assert_eq!(files("merged"), files("whole"));
    // A split that is fixed while merging stays fixed.
    merge(&parts, &dir.path().join("split"), Some(&SplitSpec::default())).expect("merges");
    let split = Dataset::open(&dir.path().join("split")).expect("open");
    assert!(split.rows().iter().all(|row| row.split.is_some()));
    let other = SplitSpec { seed: 9, ..SplitSpec::default() };
    assert_eq!(split.splits(&other).expect("splits"), whole.splits(&SplitSpec::default()).expect("splits"));

    let other = DatasetHeader { rdm_spec: RdmSpec { floor_db: -150.0, ..header.rdm_spec }, ..header.clone() };
    let other = Dataset::from_maps(other, Vec::new()).expect("in memory");
    let error = merge(&[(dir.path(), &a), (dir.path(), &other)], &dir.path().join("no"), None).expect_err("unlike");
    assert!(error.to_string().contains("the map spec is not that of"), "{error}");
    assert!(!dir.path().join("no").exists());
}

#[test]
fn parts_on_physical_axes_merge_whatever_their_nominal_waveforms() {
    let axes = PhysicalAxes { range_step_m: 0.2, range_bins: 4, velocity_step_m_per_s: 0.1, velocity_bins: 6 };
    let header = |axes: Option<PhysicalAxes>, chirps_per_frame: usize| {
        let request = WaveformRequest { samples_per_chirp: 32, chirps_per_frame, ..WaveformRequest::paper() };
        let spec = RdmSpec { physical_axes: axes, ..RdmSpec::paper() };
        DatasetHeader::new(Waveform::realise(request).expect("waveform"), spec).expect("header")
    };
    let dir = tempfile::tempdir().expect("folder");
    let path = dir.path().join("merged");
    let part = |header: &DatasetHeader, frame: u64| {
        let maps = vec![(map(header, frame), row("a", frame, Occupancy::One))];
        Dataset::from_maps(header.clone(), maps).expect("in memory")
    };
    let headers = [8, 16].map(|chirps| header(Some(axes), chirps));
    let parts = [part(&headers[0], 0), part(&headers[1], 1)];
    assert_eq!(merge(&[(dir.path(), &parts[0]), (dir.path(), &parts[1])], &path, None).expect("merges"), 2);
    assert_eq!(Dataset::open(&path).expect("open").header(), &headers[0]);

    let headers = [8, 16].map(|chirps| header(None, chirps));
    let parts = headers.map(|header| Dataset::from_maps(header, Vec::new()).expect("in memory"));
    let refused = merge(&[(dir.path(), &parts[0]), (dir.path(), &parts[1])], &dir.path().join("no"), None);
    let error = refused.expect_err("unlike").to_string();
    assert!(error.contains("the waveform is not that of"), "{error}");
}

mod hard_cases {
    use super::*;

    #[test]
    fn damage_duplicates_and_leaks_are_all_reported() {
        let header = header();
        let make = |frame: u64, like: u64, sequence: &str, split: Split| {
            let mut row = row(sequence, frame, Occupancy::One);
            (row.split, row.recording, row.subject) = (Some(split), sequence.to_owned(), Some("ann".into()));
            (map(&header, like), row)
        };
        let maps = vec![
            make(0, 0, "a", Split::Train),
            make(1, 1, "a", Split::Train),
            make(2, 0, "b", Split::Test),
            make(2, 7, "b", Split::Test),
            make(3, 3, "c", Split::Train),
            make(4, 4, "c", Split::Validation),
        ];
        let set = Dataset::from_maps(header.clone(), maps).expect("in memory");
        let report = verify(&set, &SplitSpec { by: SplitBy::Subject, ..SplitSpec::default() }).expect("a report");
        assert!(report.damaged.is_empty() && !report.is_sound());
        let duplicates: Vec<(&str, &[usize], usize)> =
            report.duplicates.iter().map(|d| (d.what, d.maps.as_slice(), d.splits.len())).collect();
        assert_eq!(duplicates, [("cells", &[0, 2][..], 2), ("frame", &[2, 3][..], 1)]);
        assert!(report.leaks.iter().any(|leak| leak.by == SplitBy::Sequence && leak.name == "c"), "{report:?}");
        assert!(report.leaks.iter().any(|leak| leak.by == SplitBy::Subject && leak.name == "ann"), "{report:?}");
        assert_eq!((report.maps, report.sequences, report.split_maps), (6, 3, [3, 1, 2]));
    }

    /// Regression test: sequences were divided by the property that was then checked, so that no leak of it was found.
    #[test]
    fn leaks_that_a_training_by_sequence_makes_are_found() {
        let header = header();
        let by_seed = SplitSpec { by: SplitBy::Seed, ..SplitSpec::default() };
        let leaks = |rule: Option<&SplitSpec>| {
            let of = |k: u64| ManifestRow { seed: Some(k % 4), ..row(&format!("s{k}"), k, Occupancy::One) };
            let mut rows: Vec<ManifestRow> = (0..12).map(of).collect();
            let splits = rule.map_or_else(Vec::new, |rule| rule.assign(&rows).expect("splits"));
            rows.iter_mut().zip(splits).for_each(|(row, split)| row.split = Some(split));
            let maps = rows.into_iter().map(|row| (map(&header, row.frame), row)).collect();
            let set = Dataset::from_maps(header.clone(), maps).expect("in memory");
            verify(&set, &by_seed).expect("a report").leaks.len()
        };
        assert!(leaks(None) > 0);
        assert_eq!(leaks(Some(&by_seed)), 0);
    }

    /// Regression test: each recording of people without a subject was a separate group, without a warning.
    #[test]
    fn sequences_with_people_that_lack_the_property_of_a_split_are_named() {
        let header = header();
        let make = |frame: u64, sequence: &str, label: Occupancy, subject: Option<&str>| {
            let row = ManifestRow { subject: subject.map(str::to_owned), ..row(sequence, frame, label) };
            (map(&header, frame), row)
        };
        let maps = vec![
            make(0, "a", Occupancy::One, Some("ann")),
            make(1, "nobody", Occupancy::Empty, None),
            make(2, "b", Occupancy::Two, None),
            make(3, "b", Occupancy::One, None),
        ];
        let set = Dataset::from_maps(header.clone(), maps).expect("in memory");
        let report = |by: SplitBy| verify(&set, &SplitSpec { by, ..SplitSpec::default() }).expect("a report");
        assert_eq!(report(SplitBy::Subject).ungrouped, ["b"]);
        assert_eq!(report(SplitBy::Seed).ungrouped, ["a", "b"]);
        assert!(report(SplitBy::Sequence).ungrouped.is_empty() && report(SplitBy::Scene).ungrouped.is_empty());
        let warning = SplitBy::Subject.warning(set.rows()).expect("a warning");
        assert!(warning.contains("1 sequences with people have no subject: 'b'"), "{warning}");
        assert_eq!(SplitBy::Scene.warning(set.rows()), None);
    }

    #[test]
    fn a_second_writer_of_a_folder_is_refused() {
        let dir = tempfile::tempdir().expect("folder");
        let path = dir.path().join("set");
        let first = DatasetWriter::create(&path, &header()).expect("create");
        assert!(matches!(DatasetWriter::create(&path, &header()), Err(DatasetError::Busy { .. })));
        drop(first);
        // Files of a killed writer do not block the next one.
        std::fs::create_dir(dir.path().join("set.partial")).expect("folder");
        std::fs::write(dir.path().join("set.partial/maps-00000.npy"), b"half").expect("write");
        write(&path, [row("a", 0, Occupancy::Empty)]);
        assert_eq!(Dataset::open(&path).expect("open").len(), 1);
        assert_eq!(std::fs::read_dir(dir.path()).expect("list").count(), 1);
    }

    /// Regression test: a user's folder called `NAME.partial` was emptied, and removed with the writer.
    #[test]
    fn files_of_users_in_the_folder_of_a_writer_stay() {
        let dir = tempfile::tempdir().expect("folder");
        let (path, partial) = (dir.path().join("set"), dir.path().join("set.partial"));
        let refused_for = |expected: &str| {
            let created = DatasetWriter::create(&path, &header());
            assert!(matches!(created, Err(DatasetError::ForeignFile { name, .. }) if name == expected), "{expected}");
        };
        let names = || {
            let entries = std::fs::read_dir(&partial).expect("list").map(|entry| entry.expect("entry").file_name());
            entries.map(|name| name.into_string().expect("text")).collect::<BTreeSet<_>>()
        };
        std::fs::create_dir(&partial).expect("folder");
        std::fs::write(partial.join("notes.txt"), b"mine").expect("write");
        refused_for("notes.txt");
        assert_eq!(names(), BTreeSet::from(["notes.txt".to_owned()]));
        std::fs::remove_dir_all(&partial).expect("removed");
        // A complete dataset of this name is not from a killed writer.
        write(&partial, [row("a", 0, Occupancy::Empty)]);
        let whole = names();
        refused_for("dataset.json");
        assert_eq!(names(), whole);
        Dataset::open(&partial).expect("opens").verify().expect("whole");
        std::fs::remove_dir_all(&partial).expect("removed");

        let mut writer = DatasetWriter::create(&path, &header()).expect("create");
        writer.push(&map(&header(), 0), row("a", 0, Occupancy::Empty)).expect("push");
        writer.add_file("mirror.toml", b"").expect("added");
        std::fs::write(partial.join("notes.txt"), b"mine").expect("write");
        drop(writer);
        assert_eq!(names(), BTreeSet::from(["notes.txt".to_owned()]));
    }

    #[test]
    fn a_sequence_in_two_splits_is_refused() {
        let mut rows = vec![row("a", 0, Occupancy::Empty), row("b", 0, Occupancy::One), row("a", 1, Occupancy::Empty)];
        rows[0].split = Some(Split::Train);
        rows[2].split = Some(Split::Test);
        let error = SplitSpec::default().assign(&rows).expect_err("leak").to_string();
        assert!(error.contains("sequence 'a' is in two splits, train and test"), "{error}");
        // The split of one row applies to its whole sequence.
        rows[2].split = None;
        assert_eq!(SplitSpec::default().assign(&rows).expect("splits")[2], Split::Train);
        for (validation, test) in [(0.5, 0.5), (-0.1, 0.2), (f64::NAN, 0.1)] {
            let spec = SplitSpec { validation, test, ..SplitSpec::default() };
            assert!(matches!(spec.assign(&rows), Err(DatasetError::Fractions { .. })));
        }
    }

    #[test]
    fn an_unfinished_writer_leaves_nothing_behind() {
        let dir = tempfile::tempdir().expect("folder");
        let path = dir.path().join("set");
        let mut writer = DatasetWriter::create(&path, &header()).expect("create");
        writer.push(&map(&header(), 0), row("a", 0, Occupancy::Empty)).expect("push");
        drop(writer);
        assert_eq!(std::fs::read_dir(dir.path()).expect("list").count(), 0);
    }

    #[test]
    fn maps_with_nan_or_another_shape_are_refused() {
        let dir = tempfile::tempdir().expect("folder");
        let header = header();
        let mut writer = DatasetWriter::create(&dir.path().join("set"), &header).expect("create");
        let mut bad = map(&header, 7);
        bad.db[3] = f32::NAN;
        let error = writer.push(&bad, row("a", 7, Occupancy::Empty)).expect_err("NaN").to_string();
        assert!(error.contains("frame 7") && error.contains("1 cells"), "{error}");
        let mut bad = map(&header, 7);
        bad.db.pop();
        assert!(matches!(writer.push(&bad, row("a", 7, Occupancy::Empty)), Err(DatasetError::Shape { .. })));
    }

    /// A small dataset, and the content of its files.
    fn small(path: &Path) -> [(&'static str, Vec<u8>); 3] {
        write(path, (0..3).map(|frame| row("a", frame, Occupancy::One)));
        ["dataset.json", "manifest.jsonl", "maps-00000.npy"]
            .map(|name| (name, std::fs::read(path.join(name)).expect("read")))
    }

    #[test]
    fn folders_cut_off_anywhere_are_refused_and_never_panic() {
        let dir = tempfile::tempdir().expect("folder");
        let path = dir.path().join("set");
        for (name, whole) in small(&path) {
            let file = path.join(name);
            for length in 0..whole.len() {
                std::fs::write(&file, &whole[..length]).expect("write");
                // The last line end may be missing, and a manifest may have no rows.
                let may_open =
                    name != "maps-00000.npy" && length + 1 == whole.len() || name == "manifest.jsonl" && length == 0;
                let error = Dataset::open(&path).err().map(|error| error.to_string());
                assert!(error.is_some() || may_open, "{name}: {length}");
                assert!(name != "maps-00000.npy" || error.is_some_and(|error| error.contains(name)), "{length}");
            }
            std::fs::write(&file, &whole).expect("write");
        }
        Dataset::open(&path).expect("opens").verify().expect("whole");
    }

    /// Regression test: a manifest cut at the border of a shard was opened with fewer maps.
    #[test]
    fn a_shard_that_the_manifest_does_not_list_is_refused() {
        let dir = tempfile::tempdir().expect("folder");
        let path = dir.path().join("set");
        write(&path, (0..MAPS_PER_SHARD as u64 + 1).map(|frame| row("a", frame, Occupancy::One)));
        let manifest = path.join("manifest.jsonl");
        let text = std::fs::read_to_string(&manifest).expect("read");
        let cut: String = text.split_inclusive('\n').take(MAPS_PER_SHARD).collect();
        std::fs::write(&manifest, cut).expect("write");
        let error = Dataset::open(&path).expect_err("cut").to_string();
        assert!(error.contains("maps-00001.npy") && error.contains("cut short"), "{error}");
    }

    #[test]
    fn numbers_beyond_the_files_are_refused() {
        let dir = tempfile::tempdir().expect("folder");
        let path = dir.path().join("set");
        let files = small(&path);
        let refused = |name: &str, from: &str, to: &str, expected: &str| {
            let (_, whole) = files.iter().find(|(file, _)| *file == name).expect("a file");
            let text: String = whole.iter().map(|byte| char::from(*byte)).collect();
            assert!(text.contains(from), "{from}");
            let bytes: Vec<u8> = text.replace(from, to).chars().map(|c| c as u8).collect();
            std::fs::write(path.join(name), bytes).expect("write");
            let error = Dataset::open(&path).expect_err(to).to_string();
            std::fs::write(path.join(name), whole).expect("write");
            assert!(error.contains(expected), "{to}: {error}");
        };
        let most = u64::MAX.to_string();
        let head = |from: &str, to: &str, expected: &str| refused("dataset.json", from, to, expected);
        head("\"samples_per_chirp\": 16", "\"samples_per_chirp\": 1", "at least 2");
        head("\"samples_per_chirp\": 16", &format!("\"samples_per_chirp\": {most}"), "at most 32768");
        head("\"chirps_per_frame\": 8", "\"chirps_per_frame\": 1000000000", "at most 32768");
        head("\"chirps_per_frame\": 8", "\"chirps_per_frame\": 32000", "maps of");
        head("\"doppler\": 8", &format!("\"doppler\": {most}"), "maps of");
        let realised = format!("\"slope_hz_per_s\": {}", serde_json::json!(header().waveform.slope_hz_per_s));
        head(&realised, "\"slope_hz_per_s\": -1.0", "as the request gives, found -1");
        head("\"request\"", &format!("\"deep\": {}, \"request\"", "[".repeat(100_000)), "dataset.json, line");
        let shape: String = files[2].1.iter().map(|byte| char::from(*byte)).skip_while(|c| *c != '(').collect();
        let shape = shape.split_inclusive(')').next().expect("a shape");
        // A shorter shape is padded with spaces, because the header states its own length.
        let width = shape.len();
        let shard = |to: &str, expected: &str| refused("maps-00000.npy", shape, &format!("{to:<width$}"), expected);
        shard("(4294967296, 4294967296, 1, 1)", "64-bit number");
        shard("(3, 1, 18446744073709551616)", "64-bit number");
        shard("(9, 1, 8, 8)", "shape [3, 1, 8, 8]");
        let long = format!("\"scene\":\"{}\"", "x".repeat(70_000));
        refused("manifest.jsonl", "\"scene\":\"corridor\"", &long, "rows of 65536 bytes at most");
        refused("manifest.jsonl", "\"scene\":\"corridor\"", "\"scene\":\"\u{ff}\"", "reading failed");
        refused("manifest.jsonl", "\"frame\":2", "\"frame\":1e400", "manifest.jsonl, line 3");
    }

    /// Links, devices and pipes with the names of a dataset's files are not read.
    #[cfg(unix)]
    #[test]
    fn links_devices_and_pipes_are_not_read() {
        let dir = tempfile::tempdir().expect("folder");
        let path = dir.path().join("set");
        for (name, whole) in small(&path) {
            let file = path.join(name);
            let outside = dir.path().join(name);
            std::fs::write(&outside, &whole).expect("write");
            for target in [outside.as_path(), Path::new("/dev/zero")] {
                std::fs::remove_file(&file).expect("removed");
                std::os::unix::fs::symlink(target, &file).expect("linked");
                let error = Dataset::open(&path).expect_err("a link").to_string();
                assert!(error.contains(name) && error.contains("leads out of its folder"), "{error}");
            }
            std::fs::remove_file(&file).expect("removed");
            let made = std::process::Command::new("mkfifo").arg(&file).status().expect("mkfifo");
            assert!(made.success());
            let error = Dataset::open(&path).expect_err("a pipe").to_string();
            assert!(error.contains(name) && error.contains("not a regular file"), "{error}");
            std::fs::remove_file(&file).expect("removed");
            std::fs::write(&file, &whole).expect("write");
        }
    }

    #[test]
    fn damage_is_named_with_its_file() {
        let dir = tempfile::tempdir().expect("folder");
        let path = dir.path().join("set");
        let [(_, head_json), (_, rows), (_, whole)] = small(&path);
        let shard = path.join("maps-00000.npy");
        let mut flipped = whole.clone();
        *flipped.last_mut().expect("byte") ^= 1;
        std::fs::write(&shard, &flipped).expect("write");
        let error = Dataset::open(&path).expect("lengths agree").verify().expect_err("changed").to_string();
        assert!(error.contains("maps-00000.npy") && error.contains("map 2"), "{error}");
        // Regression test: networks were trained and evaluated on damaged maps.
        let damaged = Dataset::open(&path).expect("lengths agree");
        assert!(matches!(damaged.input(2, 0), Err(DatasetError::Hash { index: 2, .. })));
        assert_eq!(damaged.map(1).expect("whole"), map(&header(), 1).db);

        std::fs::write(&shard, &whole).expect("write");

        let manifest = path.join("manifest.jsonl");
        let rows = String::from_utf8(rows).expect("text");
        std::fs::write(&manifest, rows.replacen("\"one\"", "\"seven\"", 1)).expect("write");
        let error = Dataset::open(&path).expect_err("no such class").to_string();
        assert!(error.contains("manifest.jsonl, line 1") && error.contains("seven"), "{error}");
        assert!(error.contains("build the dataset again"), "{error}");
        std::fs::write(&manifest, rows).expect("write");

        let head = path.join("dataset.json");
        let text = String::from_utf8(head_json).expect("text");
        std::fs::write(&head, text.replace("\"format_version\": 1", "\"format_version\": 99")).expect("write");
        let error = Dataset::open(&path).expect_err("newer").to_string();
        std::fs::write(&head, text.replace("\"two\"", "\"crowd\"")).expect("write");
        let other = Dataset::open(&path).expect_err("other classes").to_string();
        assert!(other.contains("crowd"), "{other}");
        assert!(error.contains("format 99 is newer than 1"), "{error}");
    }
}

/// Pairs whose sides differ are reported with the difference, and matching pairs are not.
#[test]
fn pairs_whose_sides_differ_are_named() {
    let header = header();
    let verified = |change: &dyn Fn(&mut Vec<ManifestRow>)| {
        let side = |domain, recording: &str| {
            let row = |frame| {
                let mut row = ManifestRow::new(domain, "corridor", recording, "walk", frame, Occupancy::One);
                (row.pair, row.time_ns) = (Some("walk".into()), Some(frame * 100_000_000));
                row
            };
            (0..4).map(row).collect::<Vec<_>>()
        };
        let mut rows = [side(Domain::Real, "walk"), side(Domain::Sim, "walk-mirror")].concat();
        change(&mut rows);
        let maps = rows.into_iter().enumerate().map(|(i, row)| (map(&header, i as u64), row)).collect();
        let dataset = Dataset::from_maps(header.clone(), maps).expect("a dataset");
        verify(&dataset, &SplitSpec::default()).expect("a report")
    };
    let sound = verified(&|_| {});
    assert!(sound.is_sound() && sound.pairs == 1, "{sound:?}");
    type Change = fn(&mut Vec<ManifestRow>);
    let cases: [(Change, &str); 5] = [
        (|rows| rows.truncate(4), "has no sim side"),
        (|rows| drop(rows.remove(6)), "4 real and 3 simulated frames; frame 2 is real and not sim"),
        (|rows| rows[5].label = Occupancy::Two, "frame 1 is one at 0.100000 s if real, two at 0.100000 s if simulated"),
        (|rows| rows[7].time_ns = Some(1), "frame 3 is one at 0.300000 s"),
        (|rows| rows[4..].iter_mut().for_each(|row| row.sequence = "other".into()), "2 sequences"),
    ];
    for (change, expected) in cases {
        let report = verified(&change);
        let found = report.unpaired.iter().map(|mismatch| mismatch.what.as_str()).collect::<Vec<_>>();
        assert!(!report.is_sound() && found.len() == 1 && found[0].contains(expected), "{expected}: {found:?}");
    }
}
