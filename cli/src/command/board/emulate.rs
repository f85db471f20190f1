use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;
use std::time::Duration;

use anyhow::{Context, bail};
use radome_driver::emulator::function_fs;
use radome_driver::emulator::probe::EmulatedProbe;
use radome_driver::{EmulatedBoard, EmulatorOptions, Fault, Kind, Pace};
use serde_json::json;

use crate::output;
use crate::source::{self, DEFAULT_SEED, SourceOptions};

#[derive(Clone, Copy, Default, clap::ValueEnum)]
enum Protocol {
    /// Radar Baseboard MCU7, protocol 4
    #[default]
    #[value(name = "mcu7-4")]
    Mcu7V4,
    /// Radar Baseboard MCU7, protocol 3
    #[value(name = "mcu7-3")]
    Mcu7V3,
    /// Radar Baseboard MCU7, bulk transfers; its endpoints are sockets in a folder
    #[value(name = "mcu7-bulk")]
    Mcu7Bulk,
    /// PSoC 6 kit with DEEPCRAFT streaming firmware
    Deepcraft,
    /// ESP32 firmware that prints frames as lines
    Esp32,
}

/// `radome board emulate`
#[derive(clap::Args)]
pub struct Arguments {
    /// Source of the frames: a recording, SCENE.toml, or any other SOURCE that `live` takes
    #[arg(long, value_name = "SOURCE", value_hint = clap::ValueHint::AnyPath, required_unless_present = "probe")]
    from: Option<String>,
    /// Emulate a CMSIS-DAP debug probe instead of a board: on a HID gadget's node such as /dev/hidg0, or on a mounted FunctionFS
    #[arg(long, value_name = "NODE", exclusive = true)]
    probe: Option<PathBuf>,
    /// Protocol of the board
    #[arg(long, value_enum, default_value_t)]
    protocol: Protocol,
    /// Symbolic link to the pseudo-terminal, so that clients have a fixed path; for mcu7-bulk, folder of the endpoints
    #[arg(long, value_name = "PATH")]
    link: Option<PathBuf>,
    /// Serve on this terminal instead, such as a USB gadget's /dev/ttyGS0; for mcu7-bulk, on a mounted FunctionFS
    #[arg(long, value_name = "PATH", conflicts_with = "link")]
    on: Option<PathBuf>,
    /// Repeat the recording without end; counters and time continue
    #[arg(long = "loop")]
    repeat: bool,
    /// Time that a request takes to reach the board, as over USB; frames are not delayed
    #[arg(long, value_name = "MS", default_value = "1.5", value_parser = milliseconds)]
    latency_ms: Duration,
    /// Faults at packets, which count from 0: `drop PACKET`, `flip PACKET:BIT`, `unplug PACKET:SECONDS`, `slow PACKET:SECONDS`;
    /// `chip ID` is another chip. Commas between several, such as `drop 5, flip 12:345, chip 0x606`
    #[arg(long, value_delimiter = ',')]
    faults: Vec<Fault>,
    /// Pace as a multiple of real time; 0 is as fast as the host reads
    #[arg(long, default_value_t = 1.0, value_parser = source::not_negative)]
    speed: f64,
    /// Seed of a simulation, and of the board's temperature
    #[arg(long, default_value_t = DEFAULT_SEED)]
    seed: u64,
    /// Print one JSON object with the path
    #[arg(long)]
    json: bool,
}

/// Prints the path of a pty that behaves like a board, and serves it until stopped.
///
/// # Errors
/// The source cannot be opened, or the pty or the endpoints cannot be made.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    if let Some(node) = &arguments.probe {
        return serve_probe(node);
    }
    output::catch_interrupts()?;
    let from = arguments.from.as_deref().unwrap_or_default();
    let gadget = arguments.on.as_deref().map(|on| Gadget::at(on, arguments.protocol)).transpose()?;
    let (feed, description) = source::feed(from, &SourceOptions { seed: arguments.seed, ..Default::default() })?;
    let pace = if arguments.speed > 0.0 { Pace::RealTime(arguments.speed) } else { Pace::AsFastAsRead };
    let kind = match arguments.protocol {
        Protocol::Mcu7V4 => Kind::Mcu7V4,
        Protocol::Mcu7V3 => Kind::Mcu7V3,
        Protocol::Deepcraft => Kind::Deepcraft,
        Protocol::Mcu7Bulk => Kind::Mcu7Bulk,
        Protocol::Esp32 => Kind::Esp32,
    };
    let terminal = match gadget {
        Some(Gadget::Terminal(path)) => Some(path.to_owned()),
        _ => None,
    };
    let options = EmulatorOptions {
        pace,
        kind,
        faults: arguments.faults.clone(),
        latency: arguments.latency_ms,
        repeat: arguments.repeat,
        seed: arguments.seed,
        link: arguments.link.clone(),
        terminal,
    };
    let board = EmulatedBoard::spawn(feed, options)?;
    let mut path = board.path().display().to_string();
    if kind == Kind::Mcu7Bulk && !path.contains('/') {
        // `usb:FOLDER` is distinguished from a serial number by its slash.
        path.insert_str(0, "./");
    }
    if let Some(Gadget::FunctionFs(mount)) = gadget {
        function_fs::serve(mount, board.path())
            .with_context(|| format!("{}: cannot serve this FunctionFS", mount.display()))?;
        path = mount.display().to_string();
    }
    if arguments.json {
        output::json_line(&json!({ "port": path }))?;
    } else {
        output::text_line(&path)?;
    }
    message!("an emulated board with {description}; Ctrl-C stops it");
    let cause = wait_for_end(&board, &description);
    let counts = board.counts();
    // Dropping the board stops it.
    drop(board);
    message!("{} frames and {} packets sent, {} FIFO overflows", counts.frames, counts.packets, counts.overflows);
    match cause {
        Some(reason) => bail!("an emulated board with {description}: {reason}"),
        None => Ok(()),
    }
}

/// Waits until the user interrupts or the board fails; returns the reason of a failure. Reports when the source has
/// ended.
fn wait_for_end(board: &EmulatedBoard, description: &str) -> Option<String> {
    let mut has_ended = false;
    while !output::interrupted() {
        std::thread::sleep(Duration::from_millis(100));
        if let Some(reason) = board.failure() {
            return Some(reason);
        }
        if board.finished() && !has_ended {
            has_ended = true;
            let frames = board.counts().frames;
            message!(
                "{description} has ended, {frames} frames were sent: the board is silent from here on; Ctrl-C stops it, --loop would \
                 begin again"
            );
        }
    }
    None
}

/// Parses milliseconds, at most one second.
fn milliseconds(text: &str) -> Result<Duration, String> {
    let number = text.parse::<f64>().ok().filter(|ms| (0.0..=1000.0).contains(ms));
    number.map(|ms| Duration::from_secs_f64(ms / 1e3)).ok_or_else(|| "expected milliseconds from 0 to 1000".to_owned())
}

/// Reports each reset of the probe's target, until the probe fails or the program is stopped.
fn serve_probe(node: &Path) -> anyhow::Result<()> {
    let mut probe = EmulatedProbe::default();
    let resets = probe.resets.clone();
    std::thread::spawn(move || {
        let mut reported = 0;
        loop {
            let resets = resets.load(Ordering::Relaxed);
            if resets > reported && output::text_line(&format!("target reset {resets}")).is_err() {
                return;
            }
            reported = resets;
            std::thread::sleep(Duration::from_millis(20));
        }
    });
    let ready = || message!("an emulated debug probe on {}; Ctrl-C stops it", node.display());
    let served = match node.is_dir() {
        true => function_fs::serve_probe(node, &mut probe, ready),
        false => probe.serve_hid(node, ready),
    };
    served.with_context(|| format!("{}: cannot serve this gadget", node.display()))
}

/// Device side of a USB gadget.
enum Gadget<'a> {
    Terminal(&'a Path),
    FunctionFs(&'a Path),
}

impl<'a> Gadget<'a> {
    fn at(path: &'a Path, protocol: Protocol) -> anyhow::Result<Self> {
        let is_bulk = matches!(protocol, Protocol::Mcu7Bulk);
        match (path.is_dir(), is_bulk) {
            (true, true) => Ok(Gadget::FunctionFs(path)),
            (false, false) => Ok(Gadget::Terminal(path)),
            (true, false) => bail!(
                "{} is a folder, and this board is on a terminal\n\nhint: --protocol mcu7-bulk is served on a FunctionFS",
                path.display()
            ),
            (false, true) => bail!(
                "{} is no folder in which a FunctionFS is mounted\n\nhint: mount -t functionfs NAME FOLDER",
                path.display()
            ),
        }
    }
}
