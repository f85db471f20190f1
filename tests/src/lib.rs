//! Helpers of the end-to-end tests: the built program, its files, and its answers.

pub mod browser;
pub mod running;

use std::borrow::{Borrow, BorrowMut};
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use radome_driver::recording::{Format, Recording, RecordingWriter};
use radome_dsp::{Frame, FrameSource, Gap, MAX_CODE, SourceEvent, Waveform};
pub use radome_skip::{shared, skip};
use serde_json::Value;

/// Command of the built program. A literal stands for the words in it, any other argument is passed as it is, and `..list`
/// stands for all arguments of a list: `command!("recording convert --json", from, to, ..options)`.
#[macro_export]
macro_rules! command {
    (@add $command:ident) => {};
    (@add $command:ident, ..$list:expr $(, $($rest:tt)+)?) => {
        $command.args($list);
        $crate::command!(@add $command $(, $($rest)+)?);
    };
    (@add $command:ident, $words:literal $(, $($rest:tt)+)?) => {
        $command.args($words.split_whitespace());
        $crate::command!(@add $command $(, $($rest)+)?);
    };
    (@add $command:ident, $argument:expr $(, $($rest:tt)+)?) => {
        $command.arg($argument);
        $crate::command!(@add $command $(, $($rest)+)?);
    };
    ($words:literal $(, $($rest:tt)+)?) => {{
        let mut command = $crate::subcommand($words);
        $crate::command!(@add command $(, $($rest)+)?);
        command
    }};
}

/// Root of the source tree.
pub fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// Path of a file under `fixtures/`.
pub fn fixture(name: &str) -> PathBuf {
    root().join("fixtures").join(name)
}

/// Text of a fixture in which receivers and scenes have their full paths, so that a copy works in any folder.
///
/// # Panics
/// If the fixture does not exist.
pub fn fixture_text(name: &str) -> String {
    let text = std::fs::read_to_string(fixture(name)).unwrap_or_else(|e| panic!("{name}: {e}"));
    ["receivers", "scenes"].iter().fold(text, |text, folder| {
        let full = fixture(folder).canonicalize().expect("a folder of fixtures");
        text.replace(&format!("../{folder}"), &full.display().to_string())
    })
}

/// Writes a file into a folder; returns its path.
///
/// # Panics
/// If the file cannot be written.
pub fn write_file(folder: &Path, name: &str, content: impl AsRef<[u8]>) -> PathBuf {
    let path = folder.join(name);
    std::fs::write(&path, content).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    path
}

/// Writes a scene of a corridor in which one person walks between two ranges.
///
/// # Panics
/// If the scene cannot be written.
pub fn write_walking_scene(folder: &Path, from_m: f64, to_m: f64) -> PathBuf {
    let corridor = fixture_text("scenes/corridor.toml");
    let head = &corridor[..corridor.find("[people").expect("a people table")];
    let people = format!(
        "[people]\n[[people.actor]]\nstep = [{{ walk_to_m = [{from_m}, 1.0] }}, {{ walk_to_m = [{to_m}, 1.0], speed_m_per_s = 1.2 }}]\n"
    );
    let scene = folder.join("walk.toml");
    std::fs::write(&scene, format!("{head}{people}")).expect("a scene can be written");
    scene
}

/// Simulates a scene into a recording, with options such as `--frames 40 --seed 7`. Replaces an existing recording.
/// Returns the program's JSON answer.
///
/// # Panics
/// If the program fails.
pub fn simulate(scene: &Path, options: &str, to: &Path) -> Value {
    json_lines(command!("scene simulate --json --overwrite -o", to, scene, ..options.split_whitespace())).remove(0)
}

/// Converts a recording to the format that the name of the output stands for. Returns the program's JSON answer.
///
/// # Panics
/// If the program fails.
pub fn convert(from: &Path, to: &Path) -> Value {
    json_lines(command!("recording convert --json", from, to)).remove(0)
}

/// Labels of a recording, complete or not.
///
/// # Panics
/// If the program fails.
pub fn labels_of(recording: &Path) -> Vec<Value> {
    let list = json_lines(command!("recording label --json", recording)).remove(0);
    list.as_array().expect("a list").clone()
}

/// Range-Doppler maps of a recording, as an NPY file.
///
/// # Panics
/// If the program fails.
pub fn maps_of(recording: &Path) -> Vec<u8> {
    let Output { status, stdout, stderr } = run(command!("recording maps -o -", recording));
    assert!(status.success(), "{}", String::from_utf8_lossy(&stderr));
    stdout
}

/// Frames of a recording, and the gaps between them.
///
/// # Panics
/// If the recording cannot be read.
pub fn frames_and_gaps(recording: &Path) -> (Vec<Frame>, Vec<Gap>) {
    let mut source = Recording::open(recording).unwrap_or_else(|e| panic!("{e}"));
    let mut frame = Frame::zeroed(source.waveform().shape());
    let (mut frames, mut gaps) = (Vec::new(), Vec::new());
    loop {
        match source.next_frame(&mut frame).unwrap_or_else(|e| panic!("{e}")) {
            SourceEvent::Frame => frames.push(frame.clone()),
            SourceEvent::Gap(gap) => gaps.push(gap),
            SourceEvent::End => return (frames, gaps),
        }
    }
}

/// Copies a recording and adds a signal, in codes, to the samples of all receivers. `signal` is a function of the
/// waveform, the time of the chirp, s, and the time within the chirp, s.
///
/// # Panics
/// If a recording cannot be read or written.
pub fn add_signal(from: &Path, to: &Path, keep_truth: bool, signal: impl Fn(&Waveform, f64, f64) -> f64) {
    let mut source = Recording::open(from).expect("opens");
    let waveform = source.waveform().clone();
    let mut writer = RecordingWriter::create(to, Format::Mcap, &source.header()).expect("creates");
    let shape = waveform.shape();
    let mut frame = Frame::zeroed(shape);
    loop {
        match source.next_frame(&mut frame).expect("reads") {
            SourceEvent::End => break,
            SourceEvent::Gap(gap) => writer.gap(&gap).expect("writes"),
            SourceEvent::Frame => {
                for (i, code) in frame.codes.iter_mut().enumerate() {
                    let (chirp, sample) = (i / shape.samples % shape.chirps, i % shape.samples);
                    let time_s = frame.time_ns as f64 * 1e-9 + chirp as f64 * waveform.chirp_interval_s;
                    let value = f64::from(*code) + signal(&waveform, time_s, sample as f64 / waveform.sample_rate_hz);
                    *code = value.round().clamp(0.0, f64::from(MAX_CODE)) as u16;
                }
                if !keep_truth {
                    frame.truth = None;
                }
                writer.frame(&frame).expect("writes");
            }
        }
    }
    writer.finish().expect("finishes");
}

/// Command that runs the built program.
///
/// # Panics
/// If it has not been built.
pub fn radome() -> Command {
    let folder = std::env::current_exe().ok().and_then(|exe| Some(exe.parent()?.parent()?.to_owned()));
    let program = folder.unwrap_or_default().join("radome");
    assert!(program.exists(), "{} is absent: run tests/run, which builds it", program.display());
    let mut command = Command::new(program);
    command.current_dir(root());
    // Scenes and specs that tests write to other folders refer to fixtures and shared data.
    if let Ok(folders) = std::env::join_paths([root().join("fixtures"), radome_skip::shared_folder()]) {
        command.env("RADOME_PATH", folders);
    }
    command
}

/// Command of the built program by the name of its subcommand, such as `board list`.
///
/// # Panics
/// If the program has not been built.
pub fn subcommand(name: &str) -> Command {
    let mut command = radome();
    command.args(name.split_whitespace());
    command
}

/// Command `radome live` on a source, with the shipped model of the paper's waveform and options such as `--frames 40
/// --json`.
///
/// # Panics
/// If the program has not been built.
pub fn live_command(source: impl AsRef<OsStr>, options: &str) -> Command {
    command!("live --model", fixture("models/paper-hqnn.safetensors"), source, ..options.split_whitespace())
}

/// Command that may write this number of blocks to a file, which stands for a full disk. Blocks have 512 bytes or 1 KiB,
/// depending on the shell.
pub fn with_file_size_limit(blocks: u32, command: impl Borrow<Command>) -> Command {
    let command: &Command = command.borrow();
    let mut shell = Command::new("sh");
    shell.args(["-c", &format!("ulimit -f {blocks}; exec \"$@\""), "sh"]);
    shell.arg(command.get_program()).args(command.get_args());
    shell.current_dir(root());
    shell
}

/// SOURCE argument that replays the corridor scene through an emulated board.
pub fn emulated_corridor() -> String {
    format!("emulated:{}", fixture("scenes/corridor.toml").display())
}

/// Runs a command; returns the exit status, stdout and stderr.
///
/// # Panics
/// If the program cannot be run.
pub fn outcome(command: impl BorrowMut<Command>) -> (Option<i32>, String, String) {
    let Output { status, stdout, stderr } = run(command);
    (status.code(), String::from_utf8_lossy(&stdout).into_owned(), String::from_utf8_lossy(&stderr).into_owned())
}

/// Runs a command and returns the JSON lines of its stdout.
///
/// # Panics
/// If the program fails or prints anything but JSON lines.
pub fn json_lines(command: impl BorrowMut<Command>) -> Vec<Value> {
    json_lines_of(command, &[0])
}

/// Like [`json_lines`], for a program that may end with any of these exit statuses. Status 3 means done, but with
/// losses.
///
/// # Panics
/// If the program ends with another status or prints anything but JSON lines.
pub fn json_lines_of(mut command: impl BorrowMut<Command>, statuses: &[i32]) -> Vec<Value> {
    let command: &mut Command = command.borrow_mut();
    let output = run(&mut *command);
    let is_expected = output.status.code().is_some_and(|status| statuses.contains(&status));
    assert!(is_expected, "{command:?}: {}: {}", output.status, String::from_utf8_lossy(&output.stderr));
    String::from_utf8_lossy(&output.stdout)
        .lines()
        .map(|line| serde_json::from_str(line).unwrap_or_else(|e| panic!("{e} in {line}")))
        .collect()
}

/// Runs a command that must succeed; returns stdout and stderr.
///
/// # Panics
/// If the program fails.
pub fn success(mut command: impl BorrowMut<Command>) -> (String, String) {
    let command: &mut Command = command.borrow_mut();
    let (status, told, said) = outcome(&mut *command);
    assert_eq!(status, Some(0), "{command:?}: {said}");
    (told, said)
}

/// Runs commands at once, all of which must succeed.
///
/// # Panics
/// If one of them fails.
pub fn success_at_once(commands: impl IntoIterator<Item = Command>) {
    std::thread::scope(|scope| {
        for command in commands {
            scope.spawn(move || success(command));
        }
    });
}

/// Runs a command that must fail with exit status 1; returns its stderr.
///
/// # Panics
/// If the program succeeds or fails in another way.
pub fn failure(command: impl BorrowMut<Command>) -> String {
    assert_status(command, 1)
}

/// Runs a command that must fail with exit status 1 and say all of this on stderr.
///
/// # Panics
/// If the program succeeds, fails in another way, or does not say it.
pub fn fails_with(mut command: impl BorrowMut<Command>, parts: &[&str]) {
    let command: &mut Command = command.borrow_mut();
    let said = failure(&mut *command);
    assert_contains_all(command, &said, parts);
}

/// Runs a command that must be refused as wrong use, with exit status 2; returns its stderr.
///
/// # Panics
/// If the program succeeds or fails in another way.
pub fn wrong_use(command: impl BorrowMut<Command>) -> String {
    assert_status(command, 2)
}

/// Runs a command that must be refused as wrong use, with exit status 2, and say all of this on stderr.
///
/// # Panics
/// If the program succeeds, fails in another way, or does not say it.
pub fn wrong_use_with(mut command: impl BorrowMut<Command>, parts: &[&str]) {
    let command: &mut Command = command.borrow_mut();
    let said = wrong_use(&mut *command);
    assert_contains_all(command, &said, parts);
}

/// Runs a command that must end with this status; returns its stderr.
fn assert_status(mut command: impl BorrowMut<Command>, expected: i32) -> String {
    let command: &mut Command = command.borrow_mut();
    let (status, _, said) = outcome(&mut *command);
    assert_eq!(status, Some(expected), "{command:?}: {said}");
    said
}

fn assert_contains_all(command: &Command, said: &str, parts: &[&str]) {
    for part in parts {
        assert!(said.contains(part), "{command:?} does not say {part:?}: {said}");
    }
}

/// Copies the shipped room-cnn as a model of one waveform, the hall's; this copy refuses all other waveforms.
///
/// # Panics
/// If the model cannot be read or written.
pub fn model_of_one_waveform(folder: &Path) -> PathBuf {
    let mut model = radome_models::Model::load(&fixture("models/room-cnn.safetensors")).expect("a shipped model");
    (model.card.rdm_spec.physical_axes, model.card.rdm_spec.change_over_s) = (None, None);
    let path = folder.join("one-waveform.safetensors");
    model.save(&path).expect("a model can be written");
    path
}

/// Help text of a command such as `board list`, or of the program if `name` is empty.
///
/// # Panics
/// If the program has no such command.
pub fn help(name: &str) -> String {
    let (told, said) = success(subcommand(name).arg("--help"));
    assert!(said.is_empty(), "{name}: {said}");
    told
}

/// Long options that a help text lists.
pub fn long_options(help: &str) -> Vec<&str> {
    let listed = help.lines().filter(|line| line.trim_start().starts_with('-'));
    let named = listed.filter_map(|line| line.get(line.find("--")?..));
    named.map(|text| text.split(|c: char| !(c.is_ascii_lowercase() || c == '-')).next().unwrap_or_default()).collect()
}

/// Subcommands that a help text lists.
pub fn subcommands(help: &str) -> Vec<&str> {
    let listed = help.lines().skip_while(|line| *line != "Commands:").skip(1).take_while(|line| !line.is_empty());
    let named = listed.filter(|line| line.starts_with("  ") && !line.starts_with("   "));
    named.filter_map(|line| line.split_whitespace().next()).filter(|name| *name != "help").collect()
}

/// Path of a program that may be installed, such as a broker.
pub fn installed(name: &str) -> Option<PathBuf> {
    let path = std::env::var("PATH").unwrap_or_default();
    let mut folders = path.split(':').chain(["/usr/sbin", "/usr/local/sbin"]);
    folders.find_map(|folder| Some(Path::new(folder).join(name)).filter(|program| program.exists()))
}

/// NumPy file of codes.
pub fn npy_bytes(shape: [usize; 4], codes: &[u16]) -> Vec<u8> {
    let [f, r, c, s] = shape;
    let text = format!("{{'descr': '<u2', 'fortran_order': False, 'shape': ({f}, {r}, {c}, {s}), }}");
    let text = format!("{text:<117}\n");
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((text.len() as u16).to_le_bytes());
    bytes.extend(text.bytes().chain(codes.iter().flat_map(|code| code.to_le_bytes())));
    bytes
}

fn run(mut command: impl BorrowMut<Command>) -> Output {
    let command: &mut Command = command.borrow_mut();
    command.output().unwrap_or_else(|e| panic!("cannot run {command:?}: {e}"))
}
