//! The program's SOURCE grammar without the program: opens the frames that a string refers to.

use std::fmt::Display;
use std::path::Path;
use std::time::Duration;

use pyo3::prelude::*;
use radome_driver::recording::Recording;
use radome_driver::{
    Address, BoardIdentity, Candidate, DeepcraftBoard, Detected, EmulatedSource, EmulatorOptions, LabelSpan, Pace,
    RealTime, Reconnect, StartedBoard, candidates,
};
use radome_dsp::{Frame, FrameSource, SourceError, SourceEvent, Waveform};
use radome_sim::{Scene, SimulateOptions, Simulator};
use serde::Deserialize;

use crate::error::{Outcome, detached, to_python};
use crate::fork;

/// Options of a source, as `radome.open` passes them.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Options {
    seed: u64,
    people: Option<usize>,
    frames: Option<u64>,
    tolerance_db: Option<f64>,
    speed: Option<f64>,
    give_up_after_s: Option<f64>,
    /// Waveform that programs a board, or replaces that of a simulated scene.
    #[serde(skip)]
    pub waveform: Option<Waveform>,
}

/// Opened source of frames.
pub struct Opened {
    /// Frames of the source.
    pub frames: Box<dyn FrameSource>,
    /// Whether the source cannot wait for slow consumers.
    pub is_live: bool,
    /// Description of the source in one line.
    pub description: String,
    /// Identity of the board, if the source is one.
    pub board: Option<BoardIdentity>,
    /// Labels, if the source is a recording.
    pub labels: Vec<LabelSpan>,
}

impl Opened {
    fn new(frames: Box<dyn FrameSource>, is_live: bool, description: String) -> Self {
        Opened { frames, is_live, description, board: None, labels: Vec::new() }
    }
}

/// Source that ends after a number of frames; gaps do not count.
struct Limited {
    source: Box<dyn FrameSource>,
    frame_limit: u64,
    delivered: u64,
}

impl FrameSource for Limited {
    fn waveform(&self) -> &Waveform {
        self.source.waveform()
    }

    fn next_frame(&mut self, frame: &mut Frame) -> Result<SourceEvent, SourceError> {
        if self.delivered >= self.frame_limit {
            return Ok(SourceEvent::End);
        }
        let event = self.source.next_frame(frame)?;
        if event == SourceEvent::Frame {
            self.delivered += 1;
        }
        Ok(event)
    }

    fn frame_count(&self) -> Option<u64> {
        self.source.frame_count().map(|count| count.min(self.frame_limit))
    }
}

impl Options {
    /// Positive speed, if one was given.
    fn speed(&self) -> Option<f64> {
        self.speed.filter(|speed| *speed > 0.0)
    }

    fn reconnect(&self) -> Outcome<Reconnect> {
        let default = Reconnect::default();
        let give_up_after = match self.give_up_after_s {
            Some(seconds) => Duration::try_from_secs_f64(seconds)?,
            None => default.give_up_after,
        };
        Ok(Reconnect { give_up_after, ..default })
    }

    fn simulate(&self) -> SimulateOptions {
        let default = SimulateOptions::default();
        SimulateOptions {
            seed: self.seed,
            people: self.people,
            frames: self.frames,
            tolerance_db: self.tolerance_db.unwrap_or(default.tolerance_db),
        }
    }
}

/// Opens a source.
///
/// # Errors
/// The source does not exist or cannot be read, or a board cannot be programmed.
pub fn open(spec: &str, options: &Options) -> Outcome<Opened> {
    let opened = open_unlimited(spec, options)?;
    let Some(frame_limit) = options.frames else { return Ok(opened) };
    Ok(Opened { frames: Box::new(Limited { source: opened.frames, frame_limit, delivered: 0 }), ..opened })
}

fn open_unlimited(spec: &str, options: &Options) -> Outcome<Opened> {
    if let Some(inner) = spec.strip_prefix("emulated:") {
        return emulated(inner, options);
    }
    if let Some(port) = spec.strip_prefix("serial:") {
        return board_at(&Address::Serial(port.into()), options);
    }
    if let Some(device) = spec.strip_prefix("usb:") {
        return board_at(&Address::Usb(device.parse()?), options);
    }
    if let Some(port) = spec.strip_prefix("deepcraft:") {
        return board(Detected::Deepcraft(Box::new(DeepcraftBoard::open(Path::new(port))?)), port, options);
    }
    if spec == "auto" {
        return board_at(&only_board()?, options);
    }
    let mut opened = file(Path::new(spec), options)?;
    if let Some(speed) = options.speed() {
        opened.frames = Box::new(RealTime::new(opened.frames, speed));
    }
    Ok(opened)
}

/// Opens a simulated scene or a recording, at full speed.
fn file(path: &Path, options: &Options) -> Outcome<Opened> {
    if path.extension().is_some_and(|extension| extension == "toml") {
        return simulation(path, options);
    }
    let recording = Recording::open(path)?;
    if let Some(waveform) = &options.waveform
        && waveform.shape() != recording.waveform().shape()
    {
        let (expected, actual) = (waveform.shape(), recording.waveform().shape());
        return Err(format!(
            "{}: frames of {expected} were asked for, the recording has {actual}\n\nhint: leave the waveform out: a recording has its own",
            path.display()
        )
        .into());
    }
    let (labels, board) = (recording.labels()?, recording.header().board);
    let opened = Opened::new(Box::new(recording), false, format!("recording {}", path.display()));
    Ok(Opened { labels, board, ..opened })
}

fn simulation(path: &Path, options: &Options) -> Outcome<Opened> {
    fork::check_pools("the simulator")?;
    let scene = match &options.waveform {
        None => Scene::load(path)?,
        Some(waveform) => Scene::load_with_waveform(path, &toml::Table::try_from(&waveform.request)?)?,
    };
    let simulator = Simulator::new(&scene, options.simulate())?.on_own_threads()?;
    let description = format!("simulation of {} with seed {}", path.display(), options.seed);
    Ok(Opened::new(Box::new(simulator), false, description))
}

/// Opens a file and sends its frames through an emulated board and the wire protocol.
fn emulated(inner: &str, options: &Options) -> Outcome<Opened> {
    let opened = file(Path::new(inner), options)?;
    let pace = options.speed().map_or(Pace::AsFastAsRead, Pace::RealTime);
    let source = EmulatedSource::start(opened.frames, EmulatorOptions { pace, ..EmulatorOptions::default() })?;
    let identity = source.identity().clone();
    let path = source.board().path().display().to_string();
    let description = format!("{} emulated on {path}, fed by a {}", identity.name, opened.description);
    let emulated = Opened::new(Box::new(source), options.speed().is_some(), description);
    Ok(Opened { board: Some(identity), ..emulated })
}

fn board_at(address: &Address, options: &Options) -> Outcome<Opened> {
    board(Detected::open(address, options.waveform.as_ref())?, address, options)
}

/// Starts a board with the waveform of the options, or else with its own.
fn board(detected: Detected, at: impl Display, options: &Options) -> Outcome<Opened> {
    let waveform = options.waveform.clone().or_else(|| detected.waveform()).ok_or_else(|| {
        let lack = detected.lack_of_waveform();
        format!("{lack}\n\nhint: give open() a waveform, such as radome.Waveform.load('paper')")
    })?;
    let StartedBoard { frames, name, identity, .. } = detected.start(&waveform, options.reconnect()?)?;
    let description = format!("{name} on {at}");
    Ok(Opened { board: identity, ..Opened::new(frames, true, description) })
}

/// Address of the only board that discovery finds.
fn only_board() -> Outcome<Address> {
    let mut found: Vec<Address> = candidates().iter().filter_map(Candidate::address).collect();
    match (found.pop(), found.is_empty()) {
        (Some(address), true) => Ok(address),
        (Some(_), false) => Err("more than one board is attached\n\nhint: name one of radome.boards()".into()),
        (None, _) => {
            Err("no board is attached\n\nhint: without one, open a recording, a scene or 'emulated:SCENE.toml'".into())
        }
    }
}

/// Boards that may be attached: pairs of a SOURCE to open and a dict of what the system says about the device.
#[pyfunction]
pub fn boards(py: Python<'_>) -> PyResult<Vec<(String, Bound<'_, PyAny>)>> {
    let found = detached(py, || Ok(candidates()))?;
    let mut boards = Vec::new();
    for candidate in &found {
        let source = match candidate.address() {
            Some(Address::Serial(port)) => format!("serial:{}", port.display()),
            Some(usb @ Address::Usb(_)) => usb.to_string(),
            None => continue,
        };
        boards.push((source, to_python(py, candidate)?));
    }
    Ok(boards)
}
