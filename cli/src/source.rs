//! The SOURCE grammar: wherever frames are read, one string says where from.
//!
//! | SOURCE | frames from |
//! |---|---|
//! | a path | a recording: MCAP file or Infineon folder |
//! | `SCENE.toml` | the simulator |
//! | `serial:/dev/ttyACM0` | a board |
//! | `auto` | the one board attached |
//! | `emulated:SOURCE` | the same frames through a full emulated board on a pty |

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use anyhow::{Context, bail};
use radome_dsp::{Frame, FrameSource, SourceError, SourceEvent, Truth, Waveform};
use radome_driver::emulator::{EmulatedBoard, EmulatorOptions, Pace};
use radome_driver::{Board, replay::RealTime};
use radome_sim::{Scene, SimulateOptions, Simulator};

/// What to do with a source beyond its name.
#[derive(Debug, Clone, Default)]
pub struct SourceOptions {
    /// Waveform to program a board with; recordings and scenes bring their own.
    pub waveform: Option<Waveform>,
    /// Seed of a simulation.
    pub seed: u64,
    /// People that a simulation is forced to have.
    pub people: Option<usize>,
    /// Frames that a simulation ends after.
    pub frames: Option<u64>,
    /// Times real time; `None` is as fast as it goes. Boards have their own pace.
    pub speed: Option<f64>,
}

/// An opened source.
pub struct Source {
    /// The frames.
    pub frames: Box<dyn FrameSource>,
    /// Whether it cannot wait for slow consumers.
    pub is_live: bool,
    /// One line that says what it is.
    pub description: String,
}

/// Opens a SOURCE.
pub fn open(spec: &str, options: &SourceOptions) -> anyhow::Result<Source> {
    if let Some(inner) = spec.strip_prefix("emulated:") {
        return emulated(inner, options);
    }
    if let Some(port) = spec.strip_prefix("serial:") {
        return board(Path::new(port), options);
    }
    if spec == "auto" {
        return board(&the_one_board()?, options);
    }
    if spec.starts_with("usb:") {
        bail!("usb: (bulk transfers) is not spoken yet\n\nhint: boards with the vendor's firmware answer on serial:/dev/ttyACM0");
    }
    let path = Path::new(spec);
    let mut source = if path.extension().is_some_and(|e| e == "toml") {
        let scene = Scene::load(path)?;
        let simulate =
            SimulateOptions { seed: options.seed, people: options.people, frames: options.frames, ..Default::default() };
        let simulator = Simulator::new(&scene, simulate)?;
        Source {
            frames: Box::new(simulator),
            is_live: false,
            description: format!("simulation of {} with seed {}", path.display(), options.seed),
        }
    } else {
        let frames = radome_driver::recording::open(path)?;
        Source { frames, is_live: false, description: format!("recording {}", path.display()) }
    };
    if let Some(speed) = options.speed {
        source.frames = Box::new(RealTime::new(source.frames, speed));
    }
    Ok(source)
}

fn board(port: &Path, options: &SourceOptions) -> anyhow::Result<Source> {
    let Some(waveform) = &options.waveform else {
        bail!("a board must be told its waveform\n\nhint: name one with --waveform paper or --waveform FILE.toml");
    };
    let board = Board::open(port)?;
    let description = format!("{} on {}", board.identity(), port.display());
    Ok(Source { frames: Box::new(board.start(waveform)?), is_live: true, description })
}

/// The only board that discovery finds.
fn the_one_board() -> anyhow::Result<PathBuf> {
    let mut ports: Vec<PathBuf> =
        radome_driver::discover::candidates().into_iter().filter(|c| c.is_board()).filter_map(|c| c.port).collect();
    match (ports.pop(), ports.is_empty()) {
        (Some(port), true) => Ok(port),
        (Some(_), false) => bail!("more than one board is attached\n\nhint: name one with serial:PORT; radome devices lists them"),
        (None, _) => bail!("no board is attached\n\nhint: radome devices says what was found; emulated:SCENE.toml needs no board"),
    }
}

/// The same frames through an emulated board and the wire protocol. Truth cannot travel on the wire; it goes around it.
fn emulated(inner: &str, options: &SourceOptions) -> anyhow::Result<Source> {
    let inner_options = SourceOptions { speed: None, ..options.clone() };
    let source = open(inner, &inner_options)?;
    let waveform = source.frames.waveform().clone();
    let truths = Truths::default();
    let tap = TruthTap { inner: source.frames, truths: truths.clone() };
    let pace = options.speed.map_or(Pace::AsFastAsRead, Pace::RealTime);
    let emulator = EmulatedBoard::spawn(Box::new(tap), EmulatorOptions { pace, ..Default::default() })?;
    let board = Board::open(emulator.path()).context("the emulated board does not answer")?;
    let description = format!("{} emulated on {}, fed by {}", board.identity(), emulator.path().display(), source.description);
    let wanted = options.waveform.as_ref().unwrap_or(&waveform);
    let stream = board.start(wanted)?;
    let frames = Box::new(Emulated { stream: Box::new(stream), truths, _emulator: emulator });
    Ok(Source { frames, is_live: options.speed.is_some(), description })
}

type Truths = Arc<Mutex<VecDeque<(u64, Truth)>>>;

/// Notes the truth of each frame that goes into the emulated board.
struct TruthTap {
    inner: Box<dyn FrameSource>,
    truths: Truths,
}

impl FrameSource for TruthTap {
    fn waveform(&self) -> &Waveform {
        self.inner.waveform()
    }
    fn frame_count(&self) -> Option<u64> {
        self.inner.frame_count()
    }
    fn next_frame(&mut self, frame: &mut Frame) -> Result<SourceEvent, SourceError> {
        let event = self.inner.next_frame(frame)?;
        if let (SourceEvent::Frame, Some(truth)) = (event, frame.truth)
            && let Ok(mut truths) = self.truths.lock()
        {
            truths.push_back((frame.sequence, truth));
        }
        Ok(event)
    }
}

/// The board's stream, with truth put back by sequence number.
struct Emulated {
    stream: Box<dyn FrameSource>,
    truths: Truths,
    _emulator: EmulatedBoard,
}

impl FrameSource for Emulated {
    fn waveform(&self) -> &Waveform {
        self.stream.waveform()
    }
    fn next_frame(&mut self, frame: &mut Frame) -> Result<SourceEvent, SourceError> {
        let event = self.stream.next_frame(frame)?;
        if event == SourceEvent::Frame
            && let Ok(mut truths) = self.truths.lock()
        {
            while truths.front().is_some_and(|(sequence, _)| *sequence < frame.sequence) {
                truths.pop_front();
            }
            frame.truth = truths.front().filter(|(sequence, _)| *sequence == frame.sequence).map(|(_, truth)| *truth);
        }
        Ok(event)
    }
}

/// A waveform by name (`paper`) or from a TOML file of a [`radome_dsp::WaveformRequest`].
pub fn waveform(spec: &str) -> anyhow::Result<Waveform> {
    if spec == "paper" {
        return Ok(Waveform::realise(radome_dsp::WaveformRequest::paper())?);
    }
    let path = Path::new(spec);
    if path.extension().is_some_and(|e| e == "safetensors") {
        return Ok(radome_models::Classifier::load(path)?.waveform().clone());
    }
    let text = std::fs::read_to_string(path).with_context(|| {
        format!("cannot read waveform {spec}\n\nhint: it is \"paper\", a .toml file with the fields of a waveform, or a model file")
    })?;
    let request = toml::from_str(&text).with_context(|| format!("{spec} is no waveform"))?;
    Ok(Waveform::realise(request)?)
}
