//! Parser of SOURCE arguments. In all commands that read frames, one string names their source.
//!
//! | SOURCE | frames from |
//! |---|---|
//! | a path | a recording: MCAP file, Infineon folder or the vendor's text |
//! | `SCENE.toml` | the simulator |
//! | `serial:/dev/ttyACM0` | the board on that port, of any protocol |
//! | `deepcraft:/dev/ttyACM0` | a PSoC 6 kit with DEEPCRAFT firmware, without asking in other protocols first |
//! | `usb:`, `usb:1-4`, `usb:SERIAL` | a board with bulk firmware: the only one, by bus and address, by serial number |
//! | `auto` | the one board attached |
//! | `emulated:SOURCE` | the same frames through a full emulated board on a pty |

use std::ffi::{OsStr, OsString};
use std::os::unix::fs::FileTypeExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, bail, ensure};
use radome_driver::chip::RegisterList;
use radome_driver::recording::mcap::RecordingHeader;
use radome_driver::recording::{Extent, Recording, RecordingError};
use radome_driver::{
    BoardIdentity, EmulatedSource, EmulatorOptions, Feed, Judge, Outage, Pace, Player, RealTime, Reconnect,
    StartedBoard, Transport, start_board,
};
use radome_dsp::{Frame, FrameSource, SourceEvent, Waveform};
use radome_files::{TEXT_LIMIT_BYTES, parse_toml, read_text};
use radome_models::ModelCard;
use radome_models::model::{BUILT_IN, is_built_in};
use radome_sim::{Scene, SimulateOptions, Simulator};

use crate::exit::wrong_use;
use crate::panics::PanicGuard;

/// Default seed of a simulation.
pub const DEFAULT_SEED: u64 = 1;
/// Default number of frames of a simulation that a command reads to its end: a scene has no end.
const SIMULATED_FRAMES: u64 = 100;

/// Source of frames and its options, for every command that reads frames.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct SourceArgs {
    /// Recording, SCENE.toml, serial:PORT, usb:, deepcraft:PORT, auto, or emulated:SOURCE
    #[arg(value_name = "SOURCE", value_hint = clap::ValueHint::AnyPath)]
    pub source: String,
    /// Waveform to program a board with, or to simulate a scene in: paper, room-hqnn, a .toml file, a model file, or a recording
    #[arg(long, value_hint = clap::ValueHint::AnyPath)]
    pub waveform: Option<String>,
    /// Stop after this number of frames; a simulated scene has no end of its own
    #[arg(long)]
    pub frames: Option<u64>,
    /// Pace as a multiple of real time; 0, the default, is as fast as possible
    #[arg(long, value_parser = not_negative)]
    pub speed: Option<f64>,
    /// Seed of a simulation; 1 if absent
    #[arg(long)]
    pub seed: Option<u64>,
    /// Number of people, instead of the scene's own; a script has at most its own people
    #[arg(long)]
    pub people: Option<usize>,
    /// Seconds for which to search for a lost board
    #[arg(long, hide = true, value_parser = seconds)]
    pub give_up_after_s: Option<Duration>,
}

impl SourceArgs {
    /// Path of the recording or scene that is read, if the source is one.
    pub fn input(&self) -> &Path {
        Path::new(self.source.trim_start_matches("emulated:"))
    }

    /// Paths that no output may have: those of the source and of the waveform.
    pub fn inputs(&self) -> [&Path; 2] {
        [self.input(), Path::new(self.waveform.as_deref().unwrap_or(""))]
    }

    /// Refuses options without effect on this source. A source that does not exist is reported when it is opened.
    ///
    /// # Errors
    /// [`WrongUse`](crate::exit::WrongUse) for an option of another kind of source.
    pub fn check(&self) -> anyhow::Result<()> {
        let input = self.input();
        let schemes = ["serial:", "usb:", "deepcraft:"];
        let is_board = self.source == "auto" || schemes.iter().any(|scheme| self.source.starts_with(scheme));
        // A device is no recording. The error of opening it explains how to name the board.
        let is_recording = !is_board && !is_scene(input) && (input.is_file() || input.is_dir());
        let of_simulations = "it is for simulated scenes";
        for (option, is_given, is_unused, why) in [
            ("--waveform", self.waveform.is_some(), is_recording, "a recording has its own"),
            ("--seed", self.seed.is_some(), is_recording || is_board, of_simulations),
            ("--people", self.people.is_some(), is_recording || is_board, of_simulations),
            ("--speed", self.speed.is_some(), is_board, "a board has its own pace"),
        ] {
            if is_given && is_unused {
                wrong_use!("{option} has no effect on {}: {why}\n\nhint: leave it out", self.source);
            }
        }
        Ok(())
    }

    /// Returns the options with which the source is opened.
    ///
    /// # Errors
    /// Those of [`SourceArgs::check`] and of [`waveform`].
    pub fn options(&self) -> anyhow::Result<SourceOptions> {
        self.check()?;
        Ok(SourceOptions {
            waveform: self.waveform.as_deref().map(waveform).transpose()?,
            model_waveform: None,
            seed: self.seed.unwrap_or(DEFAULT_SEED),
            people: self.people,
            frames: self.frames,
            speed: self.speed,
            as_playback: false,
            give_up_after: self.give_up_after_s,
        })
    }

    /// Returns the options with which a command opens a source that it reads to its end. Without `--frames`, a simulation ends
    /// after 100.
    ///
    /// # Errors
    /// Those of [`SourceArgs::options`].
    pub fn finite_options(&self) -> anyhow::Result<SourceOptions> {
        let options = self.options()?;
        Ok(SourceOptions { frames: options.frames.or(Some(SIMULATED_FRAMES)), ..options })
    }
}

#[derive(Debug, Clone, Default)]
pub struct SourceOptions {
    /// Explicit waveform, with which a board is programmed, which a board without a request protocol uses, or in which a
    /// scene is simulated. Recordings have their own.
    pub waveform: Option<Waveform>,
    /// Default waveform to program a board with: that of the model which classifies its frames.
    pub model_waveform: Option<Waveform>,
    pub seed: u64,
    /// Number of people that a simulation is forced to have.
    pub people: Option<usize>,
    /// Number of frames after which a simulation ends.
    pub frames: Option<u64>,
    /// Speed as a multiple of real time; 0 is as fast as possible, and so is `None` except for a [`Playback`]. Boards
    /// have their own pace.
    pub speed: Option<f64>,
    /// Whether a recording is opened as a [`Playback`], by default at its original pace.
    pub as_playback: bool,
    /// Time for which a lost board is searched; the default if `None`.
    pub give_up_after: Option<Duration>,
}

/// Recording that a user plays, pauses and seeks.
#[derive(Clone)]
pub struct Playback {
    pub transport: Transport,
    pub extent: Extent,
    pub path: PathBuf,
}

pub struct Source {
    pub frames: Box<dyn FrameSource>,
    /// Whether the source cannot wait for slow consumers.
    pub is_live: bool,
    pub description: String,
    /// Board of the source, if there is one. For a recording, the board that made it.
    pub board: Option<BoardIdentity>,
    /// Whether the frames are those of a recording: the board is not at work now.
    pub is_recording: bool,
    pub registers: RegisterList,
    /// State that shows whether the board is away. If the source is stopped meanwhile, the lost frames are not in a gap of the
    /// source.
    pub outage: Outage,
    /// Playback, if the source is a recording that can be played, paused and sought.
    pub playback: Option<Playback>,
}

impl Source {
    /// Creates the source of a board, which cannot wait for slow consumers.
    fn of_board(board: StartedBoard) -> Self {
        let StartedBoard { frames, description, identity, registers, outage } = board;
        Source { is_live: true, board: identity, registers, outage, ..Source::without_board(frames, description) }
    }

    fn without_board(frames: Box<dyn FrameSource>, description: String) -> Self {
        Source {
            frames,
            is_live: false,
            description,
            board: None,
            is_recording: false,
            registers: RegisterList::new(),
            outage: Outage::default(),
            playback: None,
        }
    }

    /// Creates the source of a recording. Its board is the one that made the recording.
    fn of_recording(frames: Box<dyn FrameSource>, path: &Path, header: RecordingHeader) -> Self {
        let RecordingHeader { board, registers, .. } = header;
        let source = Source::without_board(frames, format!("recording {}", path.display()));
        Source { board, registers, is_recording: true, ..source }
    }

    /// Header for a recording of these frames, with the model that classifies them, if there is one.
    pub fn header(&self, judge: Option<Judge>) -> RecordingHeader {
        let (waveform, board) = (self.frames.waveform().clone(), self.board.clone());
        RecordingHeader { waveform, board, registers: self.registers.clone(), judge }
    }
}

/// Reads the next frame, skipping gaps; `false` at the end.
///
/// # Errors
/// Those of the source.
pub fn next_frame(source: &mut dyn FrameSource, frame: &mut Frame) -> anyhow::Result<bool> {
    next_frame_noting_gaps(source, frame, || ())
}

/// Reads the next frame, and calls `note_gap` at each gap before it; `false` at the end.
///
/// # Errors
/// Those of the source.
pub fn next_frame_noting_gaps(
    source: &mut dyn FrameSource,
    frame: &mut Frame,
    mut note_gap: impl FnMut(),
) -> anyhow::Result<bool> {
    loop {
        match source.next_frame(frame).map_err(anyhow::Error::from_boxed)? {
            SourceEvent::Frame => return Ok(true),
            SourceEvent::Gap(_) => note_gap(),
            SourceEvent::End => return Ok(false),
        }
    }
}

/// Opens a SOURCE. A panic of the source becomes an error of its frames.
///
/// # Errors
/// There is no such source, it cannot be read, or a board cannot be programmed.
pub fn open(spec: &str, options: &SourceOptions) -> anyhow::Result<Source> {
    let source = open_unguarded(spec, options)?;
    Ok(Source { frames: Box::new(PanicGuard::new(source.frames)), ..source })
}

fn open_unguarded(spec: &str, options: &SourceOptions) -> anyhow::Result<Source> {
    for (prefix, rest) in [("emulated:", "SOURCE"), ("serial:", "PORT"), ("deepcraft:", "PORT")] {
        if spec == prefix {
            wrong_use!("{spec} names nothing; expected {prefix}{rest}\n\nhint: radome board list lists the boards");
        }
    }
    if let Some(inner) = spec.strip_prefix("emulated:") {
        return emulated(inner, options);
    }
    // Boards may disconnect by accident; frames lost meanwhile are a gap.
    let default = Reconnect::default();
    let reconnect = Reconnect { give_up_after: options.give_up_after.unwrap_or(default.give_up_after), ..default };
    if let Some(board) = start_board(spec, options.waveform.as_ref(), options.model_waveform.as_ref(), reconnect)? {
        return Ok(Source::of_board(board));
    }
    let path = Path::new(spec);
    ensure!(
        path.exists(),
        "{spec}: there is no such file or folder\n\nhint: a SOURCE is a recording, SCENE.toml, serial:PORT, deepcraft:PORT, \
         usb:, auto, or emulated:SOURCE; radome board list lists the boards"
    );
    // Reading from a terminal would wait for keyboard input.
    if is_device(path) {
        bail!("{spec} is a device, and no recording or scene\n\nhint: name the board on it serial:{spec}");
    }
    if options.as_playback && !is_scene(path) {
        return playback(path, options.speed.unwrap_or(1.0));
    }
    let mut source = if is_scene(path) {
        let frames: Box<dyn FrameSource> = match &options.waveform {
            Some(waveform) => simulate_in_waveform(path, waveform, Duration::ZERO, options)?,
            None => Box::new(simulator(&Scene::load(path)?, options)?),
        };
        let description = format!("simulation of {} with seed {}", path.display(), options.seed);
        Source::without_board(frames, description)
    } else {
        let recording = Recording::open(path)?;
        let header = recording.header();
        Source::of_recording(Box::new(recording), path, header)
    };
    if let Some(speed) = options.speed.filter(|speed| *speed > 0.0) {
        source.frames = Box::new(RealTime::new(source.frames, speed));
    }
    Ok(source)
}

/// Returns whether a path leads to a character device, such as a serial port.
fn is_device(path: &Path) -> bool {
    std::fs::metadata(path).is_ok_and(|metadata| metadata.file_type().is_char_device())
}

/// Name of a recording or scene: that of the folder, or of the file without the ending of its format. Recordings of the
/// vendor's SDK have no ending, and names such as walk_0.5m and walk_0.7m differ behind their last dot.
pub fn name_of(path: &Path) -> OsString {
    // A path such as `.` has no name of its own.
    if path.file_name().is_none()
        && let Ok(whole) = path.canonicalize()
    {
        return whole.file_name().unwrap_or_default().to_owned();
    }
    let is_known = |ending: &OsStr| ["mcap", "txt", "toml"].iter().any(|known| ending.eq_ignore_ascii_case(known));
    let name = match !path.is_dir() && path.extension().is_some_and(is_known) {
        true => path.file_stem(),
        false => path.file_name(),
    };
    name.unwrap_or_default().to_owned()
}

fn is_scene(path: &Path) -> bool {
    path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("toml"))
}

fn simulator(scene: &Scene, options: &SourceOptions) -> anyhow::Result<Simulator> {
    let simulate =
        SimulateOptions { seed: options.seed, people: options.people, frames: options.frames, ..Default::default() };
    Ok(Simulator::new(scene, simulate)?.on_own_threads()?)
}

/// Returns the feed of an emulated board and a one-line description. A scene is simulated in any waveform that a client
/// programs; a recording can be restarted.
///
/// # Errors
/// Those of [`open`].
pub fn feed(spec: &str, options: &SourceOptions) -> anyhow::Result<(Feed, String)> {
    let Source { frames, description, .. } = open(spec, options)?;
    let (path, options) = (PathBuf::from(spec), options.clone());
    let feed = match (path.exists(), is_scene(&path)) {
        (false, _) => Feed::from(frames),
        (true, true) => Feed::of_any_waveform(frames, move |waveform, from| {
            Ok(simulate_in_waveform(&path, waveform, from, &options)?)
        }),
        (true, false) => Feed::reopenable(frames, move || Ok(Box::new(Recording::open(&path)?))),
    };
    Ok((feed, description))
}

/// Simulates a scene in another waveform than its own, from the first frame at or after this time.
fn simulate_in_waveform(
    path: &Path,
    waveform: &Waveform,
    from: Duration,
    options: &SourceOptions,
) -> anyhow::Result<Box<dyn FrameSource>> {
    let scene = Scene::load_with_waveform(path, &toml::Table::try_from(&waveform.request)?)?;
    let mut simulator = simulator(&scene, options)?;
    simulator.seek((from.as_secs_f64() / waveform.frame_interval_s()).ceil() as u64);
    Ok(Box::new(simulator))
}

fn playback(path: &Path, speed: f64) -> anyhow::Result<Source> {
    let recording = Recording::open(path)?;
    let header = recording.header();
    let Some(player) = Player::new(recording, speed)? else { bail!("{}: no frame", path.display()) };
    let playback = Playback { transport: player.transport(), extent: player.extent(), path: path.to_owned() };
    Ok(Source { playback: Some(playback), ..Source::of_recording(Box::new(player), path, header) })
}

/// Opens the same frames through an emulated board and the wire protocol.
fn emulated(inner: &str, options: &SourceOptions) -> anyhow::Result<Source> {
    let source = open_unguarded(inner, &SourceOptions { speed: None, as_playback: false, ..options.clone() })?;
    let speed = options.speed.filter(|speed| *speed > 0.0);
    let pace = speed.map_or(Pace::AsFastAsRead, Pace::RealTime);
    let frames = Box::new(PanicGuard::new(source.frames));
    let board = EmulatedSource::start(frames, EmulatorOptions { pace, ..Default::default() })?.into_board();
    let description = format!("{}, fed by a {}", board.description, source.description);
    Ok(Source { is_live: speed.is_some(), description, ..Source::of_board(board) })
}

/// Parses an argument that is a finite number of 0 or more.
///
/// # Errors
/// The text is no such number.
pub fn not_negative(text: &str) -> Result<f64, String> {
    let number = text.parse::<f64>().ok().filter(|number| number.is_finite() && *number >= 0.0);
    number.ok_or_else(|| "expected a finite number, 0 or more".to_owned())
}

/// Parses an argument that is a number above zero.
///
/// # Errors
/// The text is no such number.
pub fn positive(text: &str) -> Result<f64, String> {
    let number = text.parse::<f64>().ok().filter(|number| number.is_finite() && *number > 0.0);
    number.ok_or_else(|| "expected a finite number above 0".to_owned())
}

/// Parses an argument in seconds.
///
/// # Errors
/// The text is no number of seconds, or more than a [`Duration`] holds.
pub fn seconds(text: &str) -> Result<Duration, String> {
    Duration::try_from_secs_f64(not_negative(text)?).map_err(|error| error.to_string())
}

/// Returns a waveform by name (`paper`), or from a file or a built-in model. The file is a model, a recording, or TOML
/// of a [`radome_dsp::WaveformRequest`].
///
/// # Errors
/// The file cannot be read or holds no waveform, or the chip cannot produce the waveform.
pub fn waveform(spec: &str) -> anyhow::Result<Waveform> {
    if spec == "paper" {
        return Ok(Waveform::realise(radome_dsp::WaveformRequest::paper())?);
    }
    let path = Path::new(spec);
    if is_built_in(path) || path.extension().is_some_and(|e| e == "safetensors" || e == "onnx") {
        return Ok(ModelCard::load(path)?.waveform);
    }
    if path.is_dir() || path.is_file() {
        match Recording::open(path) {
            Ok(recording) => return Ok(recording.waveform().clone()),
            Err(RecordingError::Unknown { .. }) if path.is_file() => {}
            Err(error) => return Err(error.into()),
        }
    }
    let text = read_text(path, TEXT_LIMIT_BYTES).with_context(|| {
        format!(
            "cannot read waveform {spec}\n\nhint: it is \"paper\", a .toml file with the fields of a waveform, a model file, \
             {BUILT_IN} or a recording"
        )
    })?;
    let request = parse_toml(&text).with_context(|| format!("{spec} is no waveform"))?;
    Waveform::realise(request).with_context(|| format!("{spec} is no waveform of this chip"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_ends_with_the_format_and_not_at_any_dot() {
        let folder = tempfile::tempdir().expect("a folder");
        let session = folder.path().join("walk_0.5m");
        std::fs::create_dir(&session).expect("a folder");
        assert_eq!(name_of(&session), "walk_0.5m");
        for (path, name) in [
            ("a/night.mcap", "night"),
            ("walk_0.7m.TXT", "walk_0.7m"),
            ("walk_0.7m", "walk_0.7m"),
            ("hall.toml", "hall"),
        ] {
            assert_eq!(name_of(Path::new(path)), name, "{path}");
        }
    }
}
