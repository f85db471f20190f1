use std::path::PathBuf;
use std::time::Duration;

use radome_driver::{EmulatedBoard, EmulatorOptions, Fault, Kind, Pace};
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
    /// PSoC 6 kit with DEEPCRAFT streaming firmware
    Deepcraft,
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
    /// What goes wrong: `drop 5, flip 12:345, unplug 70:2.5, slow 80:0.5, chip 0x606`; packets count from 0
    #[arg(long, value_delimiter = ',')]
    faults: Vec<Fault>,
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
    let kind = match arguments.protocol {
        Protocol::Mcu7V4 => Kind::Mcu7V4,
        Protocol::Mcu7V3 => Kind::Mcu7V3,
        Protocol::Deepcraft => Kind::Deepcraft,
        Protocol::Esp32 => Kind::Esp32,
    };
    let options = EmulatorOptions { pace, kind, faults: arguments.faults.clone(), link: arguments.link.clone() };
    let board = EmulatedBoard::spawn(source.frames, options)?;
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
