//! Tests in which every operation on the disk fails in turn, or is lost by a power cut, while a recording is made,
//! finished and labelled.

use std::collections::BTreeMap;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use radome_dsp::{Frame, FrameSource, SourceEvent};
use tempfile::TempDir;

use super::{
    LabelEditor, LabelSpan, McapReader, Recorder, RecorderOptions, RecordingHeader, SyncOptions, repair, set_labels,
    stage_labels,
};
use crate::pattern::{Pattern, Random, waveform};
use crate::recording::disk::trial::{Change, Plan, Trial, Watched};
use crate::recording::{Existing, RecordingError, WriteReport};

/// Number of frames, at 10 Hz.
const FRAMES: u64 = 33;
/// Number of frames in a second.
const SECOND: u64 = 10;
/// Frame before which labels are staged.
const LABELLED: u64 = 17;
/// Marks of the test, in addition to the numbers of frames.
const STAGED: u64 = 1_000;
const FINISHED: u64 = 1_001;

fn pattern() -> Pattern {
    Pattern::new(waveform(&[1], 4, 32, 0.1), FRAMES)
}

fn labels(count: u32) -> Vec<LabelSpan> {
    (0..count).map(|k| LabelSpan::new(f64::from(k) * 0.1, f64::from(k) * 0.1 + 0.05, "one")).collect()
}

/// Creates a folder, in memory if the system allows it: a test makes a thousand syncs.
fn folder() -> TempDir {
    let memory = Path::new("/dev/shm");
    if memory.is_dir() { tempfile::tempdir_in(memory) } else { tempfile::tempdir() }.expect("folder")
}

fn options() -> RecorderOptions {
    let sync = SyncOptions { interval: Duration::ZERO, ..SyncOptions::default() };
    RecorderOptions { existing: Existing::Refuse, sync: Some(sync) }
}

/// Waits until all that is written is synced, as at the pace of a board, for which a disk is fast.
fn wait_for_sync(watched: &Watched) {
    let start = Instant::now();
    loop {
        let changes = watched.changes();
        let last = |is: fn(&Change) -> bool| changes.iter().rposition(is);
        let (written, synced) =
            (last(|c| matches!(c, Change::Write { .. })), last(|c| matches!(c, Change::Sync { .. })));
        if synced >= written {
            return;
        }
        assert!(start.elapsed() < Duration::from_secs(60), "nothing is synced");
        std::thread::sleep(Duration::from_micros(100));
    }
}

/// Makes a recording; returns the number of frames that were taken, and the first error of frames, labels or end.
fn record(path: &Path, watched: &Watched, paced: bool) -> (u64, Result<WriteReport, RecordingError>) {
    let mut source = pattern();
    let mut recorder = match Recorder::with_options(path, &RecordingHeader::new(source.waveform.clone()), &options()) {
        Ok(recorder) => recorder,
        Err(error) => return (0, Err(error)),
    };
    let mut frame = Frame::zeroed(source.waveform.shape());
    let mut taken = 0;
    let mut label_error = None;
    while source.next_frame(&mut frame).expect("frame") == SourceEvent::Frame {
        if frame.sequence == LABELLED {
            label_error = stage_labels(path, &labels(3)).err();
            watched.mark(STAGED);
        }
        if let Err(error) = recorder.frame(&frame) {
            // A further call returns the same error.
            let again = recorder.flush().expect_err("it has failed");
            assert_eq!(again.to_string(), error.to_string());
            return (taken, Err(error));
        }
        taken += 1;
        watched.mark(taken);
        if paced {
            wait_for_sync(watched);
        }
    }
    let finished = recorder.finish();
    watched.mark(FINISHED);
    (taken, finished.and_then(|summary| label_error.map_or(Ok(summary), Err)))
}

/// Counts a recording's frames. Checks that they are complete from the first on and unchanged, and that the readable
/// part has no defect.
fn readable(path: &Path) -> u64 {
    let mut reader = McapReader::open(path).unwrap_or_else(|e| panic!("{e}"));
    let pattern = pattern();
    let (mut frame, mut expected) = (Frame::zeroed(pattern.waveform.shape()), Frame::zeroed(pattern.waveform.shape()));
    let mut count = 0;
    while reader.next_frame(&mut frame).unwrap_or_else(|e| panic!("{e}")) == SourceEvent::Frame {
        pattern.fill(count, &mut expected);
        assert_eq!(frame, expected);
        count += 1;
    }
    count
}

fn labels_of(path: &Path) -> Vec<LabelSpan> {
    McapReader::open(path).and_then(|reader| reader.labels()).unwrap_or_else(|e| panic!("{e}"))
}

/// Checks that an error names a file of the folder and its first cause.
fn assert_names(error: &RecordingError, folder: &Path, code: i32) {
    let RecordingError::Io { path, source, .. } = error else { panic!("{error}") };
    assert!(path.starts_with(folder), "{error}");
    assert_eq!(source.raw_os_error(), Some(code), "{error}: {source}");
}

#[test]
fn every_failure_is_an_error_with_its_path_and_loses_at_most_a_second() {
    for (plan, code) in [(Plan::Fail as fn(usize) -> Plan, 5), (Plan::Full as fn(usize) -> Plan, 28)] {
        let mut failures = 0;
        for at in 0.. {
            let folder = folder();
            let path = folder.path().join("a.mcap");
            let watched = Trial::start(folder.path(), plan(at));
            let (taken, outcome) = record(&path, &watched, false);
            drop(watched);
            let Err(error) = outcome else {
                assert_eq!((readable(&path), labels_of(&path)), (FRAMES, labels(3)));
                break;
            };
            failures += 1;
            assert_names(&error, folder.path(), code);
            if !path.exists() {
                assert_eq!(taken, 0, "operation {at}");
                continue;
            }
            let count = readable(&path);
            assert!(count + SECOND >= taken, "operation {at}: {count} of {taken} frames");
            let repaired = folder.path().join("b.mcap");
            assert_eq!(repair(&path, &repaired, Existing::Replace).expect("repairs").frames, count, "operation {at}");
            // The file's name is free for the next one.
            Recorder::create(&path, &RecordingHeader::new(pattern().waveform)).expect("no lock is left");
        }
        assert!(failures > 20, "{failures}");
    }
}

/// Number of frames of a recording whose index of chunks goes to the disk while it is made, and has several blocks when
/// it is finished.
const MANY: u64 = 1600;

/// Records each frame as a chunk; returns the number of frames that were taken, the outcome and all operations.
fn record_chunks(folder: &Path, plan: Plan) -> (u64, Result<WriteReport, RecordingError>, Vec<Change>) {
    let watched = Trial::start(folder, plan);
    let mut source = Pattern { frames: MANY, ..pattern() };
    let header = RecordingHeader::new(source.waveform.clone());
    let mut recorder = Recorder::create(&folder.join("a.mcap"), &header).expect("creates");
    let mut frame = Frame::zeroed(source.waveform.shape());
    let mut taken = 0;
    let outcome = loop {
        if source.next_frame(&mut frame).expect("frame") != SourceEvent::Frame {
            break recorder.finish();
        }
        if let Err(error) = recorder.frame(&frame).and_then(|()| recorder.flush()) {
            break Err(error);
        }
        taken += 1;
    };
    (taken, outcome, watched.changes())
}

#[test]
fn an_index_of_chunks_that_the_disk_refuses_is_an_error_and_loses_no_frame() {
    let made = folder();
    let (_, outcome, changes) = record_chunks(made.path(), Plan::Work);
    outcome.expect("records");
    assert_eq!(readable(&made.path().join("a.mcap")), MANY);
    let recording = std::fs::metadata(made.path().join("a.mcap")).expect("there").ino();
    let writes = |is_index: bool| {
        let changes = changes.iter().enumerate();
        changes.filter(move |(_, c)| matches!(c, Change::Write { inode, .. } if (*inode != recording) == is_index))
    };
    // The first entries that leave memory; then the blocks of the summary and the footer.
    let (first, _) = writes(true).next().expect("the index goes to the disk");
    let last: Vec<usize> = writes(false).map(|(number, _)| number).collect();
    let last = last.split_at(last.len() - 4).1;
    for number in [first].iter().chain(last) {
        for (plan, code) in [(Plan::Fail(*number), 5), (Plan::Full(*number), 28)] {
            let folder = folder();
            let path = folder.path().join("a.mcap");
            let (taken, outcome, _) = record_chunks(folder.path(), plan);
            assert_names(&outcome.expect_err("refused"), folder.path(), code);
            assert_eq!(readable(&path), (taken + 1).min(MANY), "operation {number}");
            assert!(!McapReader::open(&path).expect("opens").is_complete(), "operation {number}");
            let report = repair(&path, &folder.path().join("b.mcap"), Existing::Replace).expect("repairs");
            assert_eq!(report.frames, (taken + 1).min(MANY), "operation {number}");
        }
    }
}

#[test]
fn labels_of_a_finished_recording_survive_every_failure() {
    for (plan, code) in [(Plan::Fail as fn(usize) -> Plan, 5), (Plan::Full as fn(usize) -> Plan, 28)] {
        let mut failures = 0;
        for at in 0.. {
            let folder = folder();
            let path = folder.path().join("a.mcap");
            record(&path, &Trial::start(folder.path(), Plan::Work), false).1.expect("records");
            let watched = Trial::start(folder.path(), plan(at));
            let edit = || {
                let editor = LabelEditor::open(&path)?;
                editor.stage(&labels(5))?;
                editor.write(&labels(9))
            };
            let outcome = edit();
            drop(watched);
            let found = labels_of(&path);
            assert_eq!(readable(&path), FRAMES);
            assert!(McapReader::open(&path).expect("opens").is_complete(), "operation {at}");
            let Err(error) = outcome else {
                assert_eq!(found, labels(9));
                break;
            };
            failures += 1;
            assert_names(&error, folder.path(), code);
            assert!([3, 5, 9].iter().any(|count| found == labels(*count)), "operation {at}: {found:?}");
            // The interrupted change does not block the next one.
            set_labels(&path, &labels(2)).expect("sets");
            assert_eq!((labels_of(&path), readable(&path)), (labels(2), FRAMES));
            assert!(std::fs::read_dir(folder.path()).expect("lists").count() <= 2);
        }
        assert!(failures > 3, "{failures}");
    }
}

#[test]
fn a_disk_that_does_not_answer_ends_the_recording() {
    let folder = folder();
    let path = folder.path().join("a.mcap");
    let sync = SyncOptions { interval: Duration::ZERO, patience: Duration::from_millis(50), ..SyncOptions::default() };
    let options = RecorderOptions { sync: Some(sync), ..RecorderOptions::default() };
    let header = RecordingHeader::new(pattern().waveform);
    let mut recorder = Recorder::with_options(&path, &header, &options).expect("creates");
    let _watched = Trial::start(folder.path(), Plan::Slow(Duration::from_millis(500)));
    let mut source = Pattern { frames: u64::MAX, ..pattern() };
    let mut frame = Frame::zeroed(source.waveform.shape());
    let start = Instant::now();
    let error = loop {
        source.next_frame(&mut frame).expect("frame");
        if let Err(error) = recorder.frame(&frame) {
            break error;
        }
        assert!(start.elapsed() < Duration::from_secs(60), "it goes on");
        std::thread::sleep(Duration::from_millis(1));
    };
    assert!(matches!(error, RecordingError::Stalled { .. }), "{error}");
    assert!(matches!(recorder.finish(), Err(RecordingError::Stalled { .. })));
}

/// Regression test: a recording that was removed while it was made ended as a success.
#[test]
fn a_recording_that_is_removed_meanwhile_ends_with_an_error() {
    let folder = folder();
    let path = folder.path().join("a.mcap");
    let header = RecordingHeader::new(pattern().waveform);
    for sync in [None, options().sync] {
        let mut recorder =
            Recorder::with_options(&path, &header, &RecorderOptions { sync, ..options() }).expect("creates");
        let mut source = pattern();
        let mut frame = Frame::zeroed(source.waveform.shape());
        source.next_frame(&mut frame).expect("frame");
        recorder.frame(&frame).expect("records");
        std::fs::remove_file(&path).expect("removes");
        let Err(RecordingError::Io { path: error_path, source, .. }) = recorder.finish() else { panic!("no error") };
        assert!(error_path == path && source.to_string().contains("removed"), "{source}");
    }
}

/// Regression test: a recording that was cut while it was made ended as a success, and its beginning was a hole.
#[test]
fn a_recording_that_is_cut_meanwhile_ends_with_an_error() {
    let folder = folder();
    let path = folder.path().join("a.mcap");
    let header = RecordingHeader::new(pattern().waveform);
    let mut recorder = Recorder::with_options(&path, &header, &options()).expect("creates");
    let mut source = pattern();
    let mut frame = Frame::zeroed(source.waveform.shape());
    source.next_frame(&mut frame).expect("frame");
    recorder.frame(&frame).expect("records");
    recorder.flush().expect("writes");
    std::fs::File::options().write(true).open(&path).and_then(|file| file.set_len(0)).expect("cuts");
    source.next_frame(&mut frame).expect("frame");
    recorder.frame(&frame).expect("records");
    let Err(RecordingError::Io { path: error_path, source, .. }) = recorder.flush() else { panic!("no error") };
    assert!(error_path == path && source.to_string().contains("cut to 0 of"), "{source}");
    assert!(recorder.finish().is_err());
    assert_eq!(std::fs::metadata(&path).expect("the file").len(), 0, "no hole is written");
}

#[test]
fn a_hundred_changes_of_labels_leave_a_file_as_long_as_one() {
    let folder = folder();
    let path = folder.path().join("a.mcap");
    let watched = Trial::start(folder.path(), Plan::Work);
    record(&path, &watched, false).1.expect("records");
    set_labels(&path, &labels(4)).expect("sets");
    let once = std::fs::read(&path).expect("reads");
    for count in (0..100).map(|n| n % 7).chain([4]) {
        set_labels(&path, &labels(count)).expect("sets");
        assert_eq!(labels_of(&path), labels(count));
    }
    assert!(std::fs::read(&path).expect("reads") == once);
    let before = watched.changes().len();
    let editor = LabelEditor::open(&path).expect("opens");
    let mut written = Vec::new();
    for _ in 0..3 {
        editor.stage(&labels(6)).expect("stages");
        let bytes = |change: &Change| if let Change::Write { bytes, .. } = change { bytes.len() } else { 0 };
        written.push(watched.changes().iter().skip(before).map(bytes).sum::<usize>());
    }
    assert_eq!((2 * written[0], 3 * written[0]), (written[1], written[2]), "each as much as the first");
    assert!(std::fs::read(&path).expect("reads") == once, "they are beside it");
    assert_eq!(labels_of(&path), labels(6));
    editor.settle().expect("settles");
    drop(editor);
    assert_eq!((labels_of(&path), readable(&path)), (labels(6), FRAMES));
    assert_eq!(std::fs::read_dir(folder.path()).expect("lists").count(), 1);
}

#[test]
fn labels_beside_another_recording_of_the_same_name_are_left_out() {
    let folder = folder();
    let path = folder.path().join("a.mcap");
    let watched = Trial::start(folder.path(), Plan::Work);
    record(&path, &watched, false).1.expect("records");
    LabelEditor::open(&path).and_then(|editor| editor.stage(&labels(6))).expect("stages");
    assert_eq!(labels_of(&path), labels(6));
    // Another file takes the name.
    let other = RecordingHeader::new(waveform(&[1], 8, 32, 0.1));
    let made = folder.path().join("b.mcap");
    Recorder::create(&made, &other).and_then(Recorder::finish).expect("records");
    std::fs::rename(&made, &path).expect("renames");
    assert!(labels_of(&path).is_empty());
}

#[derive(Clone, Default)]
struct Disk {
    names: BTreeMap<PathBuf, u64>,
    files: BTreeMap<u64, Vec<u8>>,
}

impl Disk {
    fn of(folder: &Path) -> Disk {
        let mut disk = Disk::default();
        for entry in std::fs::read_dir(folder).expect("lists").map(|e| e.expect("an entry")) {
            let inode = entry.metadata().expect("metadata").ino();
            disk.names.insert(entry.path(), inode);
            disk.files.insert(inode, std::fs::read(entry.path()).expect("reads"));
        }
        disk
    }

    /// Writes all files to another folder.
    fn put(&self, folder: &Path) {
        for (path, inode) in &self.names {
            let content = self.files.get(inode).expect("a file");
            std::fs::write(folder.join(path.file_name().expect("a name")), content).expect("writes");
        }
    }

    /// Returns the content after a power cut before the operation `cut`. Synced changes are kept. Each write that was
    /// not synced is kept, lost, or kept in some sectors. Names that were not synced are kept up to one of them.
    fn after(&self, changes: &[Change], cut: usize, random: &mut Random) -> Disk {
        let mut disk = self.clone();
        let done = changes.get(..cut).expect("changes");
        let is_name = |c: &&Change| matches!(c, Change::Create { .. } | Change::Rename { .. } | Change::Remove { .. });
        let names_done = done.iter().filter(is_name).count();
        let synced = done.iter().rposition(|c| matches!(c, Change::SyncFolder)).unwrap_or(0);
        let names_synced = done.iter().take(synced).filter(is_name).count();
        let names_kept = names_synced + random.below((names_done - names_synced + 1) as u64) as usize;
        let mut names = 0;
        for (position, change) in done.iter().enumerate() {
            let is_synced =
                |file: u64| done.iter().skip(position).any(|c| matches!(c, Change::Sync { inode } if *inode == file));
            names += usize::from(is_name(&change));
            let keeps_name = names <= names_kept;
            match change {
                Change::Create { inode, path } => {
                    disk.files.insert(*inode, Vec::new());
                    if keeps_name {
                        disk.names.insert(path.clone(), *inode);
                    }
                }
                Change::Rename { from, to } if keeps_name => {
                    let inode = disk.names.remove(from).expect("a name");
                    disk.names.insert(to.clone(), inode);
                }
                Change::Remove { path } if keeps_name => drop(disk.names.remove(path)),
                Change::Write { inode, at, bytes } => {
                    let file = disk.files.entry(*inode).or_default();
                    let storage = if is_synced(*inode) { 0 } else { random.below(3) };
                    for (sector, bytes) in bytes.chunks(512).enumerate() {
                        if storage == 0 || (storage == 1 && random.below(2) == 0) {
                            let start = *at as usize + 512 * sector;
                            file.resize(file.len().max(start + bytes.len()), 0);
                            file[start..start + bytes.len()].copy_from_slice(bytes);
                        }
                    }
                }
                Change::SetLength { inode, length } if is_synced(*inode) || random.below(2) == 0 => {
                    disk.files.entry(*inode).or_default().resize(*length as usize, 0);
                }
                _ => {}
            }
        }
        disk
    }
}

/// Gives each file a number of its own, because the system uses the numbers of files again.
fn with_own_numbers(changes: Vec<Change>) -> Vec<Change> {
    let (mut numbers, mut next) = (BTreeMap::new(), 1u64 << 60);
    let mut changes = changes;
    for change in &mut changes {
        match change {
            Change::Create { inode, .. } => {
                next += 1;
                numbers.insert(*inode, next);
                *inode = next;
            }
            Change::Write { inode, .. } | Change::SetLength { inode, .. } | Change::Sync { inode } => {
                *inode = numbers.get(inode).copied().unwrap_or(*inode);
            }
            _ => {}
        }
    }
    changes
}

/// Simulates power cuts before every operation, in several ways each: fifty times as many where `RADOME_LONG` is set.
fn power_cuts(base: &Disk, changes: &[Change], mut check: impl FnMut(&Path, &[Change])) {
    let repetitions = if std::env::var_os("RADOME_LONG").is_some() { 400 } else { 8 };
    let mut random = Random(1);
    for cut in 0..=changes.len() {
        for _ in 0..repetitions {
            let folder = folder();
            base.after(changes, cut, &mut random).put(folder.path());
            check(folder.path(), &changes[..cut]);
        }
    }
}

#[test]
fn a_power_cut_while_recording_loses_at_most_a_second() {
    let made = folder();
    let watched = Trial::start(made.path(), Plan::Work);
    record(&made.path().join("a.mcap"), &watched, true).1.expect("records");
    let changes = with_own_numbers(watched.changes());
    drop(watched);
    let mut cases = 0;
    power_cuts(&Disk::default(), &changes, |folder, done| {
        let has = |mark: u64| done.iter().any(|c| matches!(c, Change::Mark(found) if *found == mark));
        let taken = (1..=FRAMES).rfind(|count| has(*count)).unwrap_or(0);
        let path = folder.join("a.mcap");
        cases += 1;
        if !path.exists() {
            assert_eq!(taken, 0);
            return;
        }
        let count = readable(&path);
        assert!(count + SECOND >= taken, "{count} of {taken} frames after {} operations", done.len());
        let found = labels_of(&path);
        assert!(found == labels(3) || (!has(STAGED) && found.is_empty()), "{found:?}");
        let report = repair(&path, &folder.join("b.mcap"), Existing::Replace).expect("repairs");
        assert!(report.frames >= count);
        if has(FINISHED) {
            assert!(count == FRAMES && McapReader::open(&path).expect("opens").is_complete());
        }
    });
    assert!(cases > 500, "{cases}");
}

#[test]
fn a_power_cut_while_labels_are_written_leaves_the_old_ones_or_the_new() {
    let made = folder();
    let path = made.path().join("a.mcap");
    let watched = Trial::start(made.path(), Plan::Work);
    record(&path, &watched, false).1.expect("records");
    drop(watched);
    let base = Disk::of(made.path());
    let watched = Trial::start(made.path(), Plan::Work);
    let editor = LabelEditor::open(&path).expect("opens");
    for (count, number) in (5..9).zip(1..) {
        let labels = labels(count);
        let written = if count % 2 == 0 { editor.write(&labels) } else { editor.stage(&labels) };
        written.expect("writes");
        watched.mark(number);
    }
    let changes = with_own_numbers(watched.changes());
    drop(watched);
    power_cuts(&base, &changes, |folder, done| {
        let path = folder.join("a.mcap");
        let last =
            done.iter().rev().find_map(|c| if let Change::Mark(number) = c { Some(*number as u32) } else { None });
        // The recording has three labels of its own, and each change has one more than the one before.
        let (old, new) = (last.map_or(3, |number| number + 4), last.map_or(5, |number| number + 5));
        let found = labels_of(&path);
        assert!(found == labels(old) || found == labels(new), "{old} to {new}: {}", found.len());
        assert_eq!(readable(&path), FRAMES);
        assert!(McapReader::open(&path).expect("opens").is_complete());
        // The next change succeeds.
        set_labels(&path, &labels(1)).expect("sets");
        assert_eq!((labels_of(&path), readable(&path)), (labels(1), FRAMES));
    });
}
