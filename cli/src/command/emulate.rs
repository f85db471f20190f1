use std::path::Path;
use std::path::PathBuf;
use std::time::Duration;

use radome_driver::{EmulatedBoard, EmulatedLines, EmulatorOptions, Pace};
use radome_dsp::FrameSource;
use serde_json::json;

use crate::output;
use crate::source::{self, SourceOptions};

#[derive(Clone, Copy, Default, clap::ValueEnum)]
enum Protocol {
    /// Radar Baseboard MCU7, protocol 4
    #[default]
    #[value(name = "mcu7-4")]
    Mcu7V4,
    /// Radar Baseboard MCU7, protocol 3
    #[value(name = "mcu7-3")]
    Mcu7V3,
    /// ESP32 firmware that prints frames as lines
    Esp32,
}

/// `radome emulate`
#[derive(clap::Args)]
pub struct Arguments {
    /// Recording or SCENE.toml to serve
    #[arg(long)]
    from: String,
    /// What the board speaks
    #[arg(long, value_enum, default_value_t)]
    protocol: Protocol,
    /// Symbolic link to the pty, so that it has the same path each time
    #[arg(long)]
    link: Option<PathBuf>,
    /// Times real time; 0 is as fast as the host reads
    #[arg(long, default_value_t = 1.0)]
    speed: f64,
    /// Seed of a simulation
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// One object with the path
    #[arg(long)]
    json: bool,
}

/// Prints the path of a pty that behaves as a board, and serves until stopped.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    output::catch_interrupts()?;
    let source = source::open(&arguments.from, &SourceOptions { seed: arguments.seed, ..Default::default() })?;
    let pace = if arguments.speed > 0.0 { Pace::RealTime(arguments.speed) } else { Pace::AsFastAsRead };
    let description = source.description;
    let board = match arguments.protocol {
        Protocol::Mcu7V4 => Emulated::mcu7(source.frames, pace, 4)?,
        Protocol::Mcu7V3 => Emulated::mcu7(source.frames, pace, 3)?,
        Protocol::Esp32 => Emulated::Lines(EmulatedLines::spawn(source.frames, pace)?),
    };
    let path = board.path().display().to_string();
    if arguments.json {
        output::json_line(&json!({ "port": path }))?;
    } else {
        output::text_line(&path)?;
    }
    eprintln!("an emulated board with {description}; Ctrl-C stops it");
    while !output::interrupted() {
        std::thread::sleep(Duration::from_millis(100));
    }
    // Dropping it stops it.
    drop(board);
    Ok(())
}

/// A board of either kind, until it is dropped.
enum Emulated {
    Mcu7(EmulatedBoard),
    Lines(EmulatedLines),
}

impl Emulated {
    fn mcu7(source: Box<dyn FrameSource>, pace: Pace, protocol_version: u16) -> anyhow::Result<Self> {
        let options = EmulatorOptions { pace, protocol_version, ..Default::default() };
        Ok(Emulated::Mcu7(EmulatedBoard::spawn(source, options)?))
    }

    fn path(&self) -> &Path {
        match self {
            Emulated::Mcu7(board) => board.path(),
            Emulated::Lines(board) => board.path(),
        }
    }
}
