//! The program's SOURCE grammar without the program: opens the frames that a string refers to.

use std::path::Path;
use std::time::Duration;

use pyo3::prelude::*;
use radome_driver::recording::Recording;
use radome_driver::{
    Address, BoardIdentity, EmulatedSource, EmulatorOptions, LabelSpan, Pace, RealTime, Reconnect, StartedBoard,
    candidates, start_board,
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
    fn of_file(frames: Box<dyn FrameSource>, description: String) -> Self {
        Opened { frames, is_live: false, description, board: None, labels: Vec::new() }
    }

    fn of_board(board: StartedBoard) -> Self {
        let StartedBoard { frames, description, identity, .. } = board;
        Opened { frames, is_live: true, description, board: identity, labels: Vec::new() }
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
    if let Some(board) = start_board(spec, options.waveform.as_ref(), None, options.reconnect()?)? {
        return Ok(Opened::of_board(board));
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
    let opened = Opened::of_file(Box::new(recording), format!("recording {}", path.display()));
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
    Ok(Opened::of_file(Box::new(simulator), description))
}

/// Opens a file and sends its frames through an emulated board and the wire protocol.
fn emulated(inner: &str, options: &Options) -> Outcome<Opened> {
    let opened = file(Path::new(inner), options)?;
    let pace = options.speed().map_or(Pace::AsFastAsRead, Pace::RealTime);
    let emulator = EmulatorOptions { pace, ..EmulatorOptions::default() };
    let board = EmulatedSource::start(opened.frames, emulator)?.into_board();
    let description = format!("{}, fed by a {}", board.description, opened.description);
    Ok(Opened { is_live: options.speed().is_some(), description, ..Opened::of_board(board) })
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
