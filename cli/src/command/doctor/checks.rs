//! Individual checks of the doctor.

use std::collections::BTreeSet;
use std::io::{ErrorKind, Write};
use std::net::{SocketAddr, TcpListener};
use std::path::Path;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use radome_driver::RecordingHeader;
use radome_driver::discover::{self, Identity, PERMISSION_REMEDY, State, UDEV_RULES};
use radome_driver::recording::utc;
use radome_dsp::{Frame, KernelLevel, SourceEvent, Waveform};

use super::check::Check;
use crate::classifier::{FrameClassifier, Model, Prediction};
use crate::live::integrations::broker::{Broker, BrokerArguments};
use crate::live::integrations::mqtt;
use crate::live::screen::unknown_loss_text;
use crate::source::{self, SourceOptions};

pub fn program() -> Check {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let found = format!(
        "radome {}, {}, kernels {}, {cores} cores",
        env!("CARGO_PKG_VERSION"),
        std::env::consts::ARCH,
        KernelLevel::detect().name()
    );
    Check::ok("program", found)
}

/// Checks the wall clock. Recordings store its time, and hubs refuse certificates from the future.
pub fn clock() -> Check {
    /// 1 November 2026.
    const RELEASE_S: u64 = 1_793_491_200;
    const TEN_YEARS_S: u64 = 315_360_000;
    let now_s = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |now| now.as_secs());
    let found = utc::iso_8601(now_s);
    if (RELEASE_S..RELEASE_S + TEN_YEARS_S).contains(&now_s) {
        Check::ok("clock", found)
    } else {
        Check::warn("clock", found, "set it (timedatectl set-ntp true): recordings and certificates go by it")
    }
}

/// Checks whether every user may open boards.
pub fn udev_rules() -> Check {
    let installed = ["/etc/udev/rules.d", "/run/udev/rules.d", "/usr/lib/udev/rules.d", "/lib/udev/rules.d"]
        .iter()
        .map(|folder| Path::new(folder).join("70-radome.rules"))
        .find(|path| path.exists());
    match installed.map(|path| (std::fs::read_to_string(&path), path)) {
        Some((Ok(text), path)) if text.trim() == UDEV_RULES.trim() => Check::ok("udev", path.display().to_string()),
        Some((_, path)) => Check::warn("udev", format!("{} is another version's", path.display()), PERMISSION_REMEDY),
        None => Check::warn("udev", "no rule lets users open boards", PERMISSION_REMEDY),
    }
}

/// Checks whether the live page could be served at its default port.
pub fn page_port() -> Check {
    let address = SocketAddr::from(([127, 0, 0, 1], 8060));
    match TcpListener::bind(address) {
        Ok(_) => Check::ok("page", format!("{address} is free")),
        Err(error) => Check::warn(
            "page",
            format!("{address}: {error}"),
            "another program serves there; --listen 127.0.0.1:PORT chooses another",
        ),
    }
}

/// Checks and opens the model file.
pub fn model(path: &Path) -> (Check, Option<Model>) {
    match Model::open(path) {
        Ok(model) => {
            let requirement = model
                .waveform()
                .map_or("any waveform of at least 20 samples and 2 chirps".to_owned(), |w| w.shape().to_string());
            (Check::ok("model", format!("{}: {requirement}", path.display())), Some(model))
        }
        Err(error) => (Check::error("model", &error), None),
    }
}

/// Checks for ONNX Runtime. Only ONNX files need it, and for those the model's own check has reported it.
pub fn onnxruntime(model: Option<&Path>) -> Check {
    let is_needed = model.and_then(Path::extension).is_some_and(|extension| extension.eq_ignore_ascii_case("onnx"));
    let found = match (is_needed, std::env::var_os("ORT_DYLIB_PATH")) {
        (true, _) => "used by the model".to_owned(),
        (false, Some(path)) => format!("not needed; ORT_DYLIB_PATH is {}", Path::new(&path).display()),
        (false, None) => "not needed: only .onnx models are run by it".to_owned(),
    };
    Check::ok("onnxruntime", found)
}

/// Checks whether the broker takes the login, in MQTT version 5; `None` where no broker is named.
pub fn broker(arguments: &BrokerArguments, broker: &anyhow::Result<Option<Broker>>) -> Option<Check> {
    let broker = match broker {
        Ok(broker) => broker.as_ref()?,
        Err(error) => return Some(Check::error("mqtt", error)),
    };
    let mut options = match arguments.options(broker) {
        Ok(options) => options,
        Err(error) => return Some(Check::error("mqtt", &error)),
    };
    // A name of its own, since a broker disconnects the older of two clients with one name.
    options.set_client_id(format!("radome-doctor-{}", std::process::id()));
    let log_in = || -> anyhow::Result<()> {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        runtime.block_on(mqtt::log_in(options)).map_err(|cause| anyhow::anyhow!("{broker}: {cause}"))
    };
    Some(match log_in() {
        Ok(()) => {
            let found = format!("{broker} takes the login, in MQTT version 5; what its user may publish is not tested");
            Check::ok("mqtt", found)
        }
        Err(error) => {
            let hint = "is the broker running, and are port and login right? With mqtts://, does --mqtt-ca name its certificates?";
            Check::fail("mqtt", format!("{error:#}"), hint)
        }
    })
}

/// Lists the attached boards and probes. The query stops a board that is measuring.
pub fn devices() -> Vec<Check> {
    let candidates = discover::candidates();
    if candidates.is_empty() {
        let hint = "plug one in; boards without USB ids are named serial:PORT; emulated:SCENE.toml needs none";
        return vec![Check::warn("devices", "no board is attached", hint)];
    }
    let check = |candidate: &radome_driver::Candidate| {
        let name = format!("{}: {}", candidate.path.display(), candidate.belief.description());
        match discover::ask(candidate, false) {
            State::Ready { identity: Identity::Board(board) } => {
                Check::ok("device", format!("{name}, firmware {}, {}", board.firmware_version, board.chip))
            }
            State::Ready { identity: Identity::Probe(_) } => Check::ok("device", format!("{name}, answers")),
            State::Prints => Check::ok("device", format!("{name}, prints lines")),
            State::NotAsked => Check::ok("device", format!("{name}, not asked")),
            State::Busy => Check::warn("device", format!("{name}, in use"), "another program has it: stop that first"),
            State::PermissionDenied { remedy } => Check::fail("device", format!("{name}, permission denied"), remedy),
            State::NotAnswering { why } => {
                Check::fail("device", format!("{name}, {why}"), "radome board list says more; unplug it and plug it in")
            }
            State::OtherChip { chip } => {
                Check::fail("device", format!("{name}, radar chip {chip}"), "this program drives the BGT60TR13C")
            }
            State::NoDriver => Check::fail("device", format!("{name}, no serial port"), "sudo modprobe cdc_acm"),
        }
    };
    candidates.iter().map(check).collect()
}

/// Frames and header of a source.
pub struct Examined {
    pub description: String,
    pub header: RecordingHeader,
    pub frames: Vec<Frame>,
}

/// Number of frames that are classified, and the time limit for them.
const FRAMES: usize = 20;
const TIME_LIMIT: Duration = Duration::from_secs(20);

/// Checks whether a source opens, delivers frames, and can be classified.
pub fn source(spec: &str, mut model: Option<Model>) -> (Vec<Check>, Option<Examined>) {
    let options = SourceOptions {
        model_waveform: model.as_ref().and_then(|model| model.waveform().cloned()),
        seed: source::DEFAULT_SEED,
        frames: Some(FRAMES as u64),
        ..SourceOptions::default()
    };
    let opened = match source::open(spec, &options) {
        Ok(opened) => opened,
        Err(error) => return (vec![Check::error("source", &error)], None),
    };
    let waveform = opened.frames.waveform().clone();
    let mut checks = vec![Check::ok("source", format!("{}, {}", opened.description, waveform.shape()))];
    let header = opened.header(None);
    let mut examined = Examined { description: opened.description, header, frames: Vec::new() };
    let mut classifier = match model.as_mut().map(|model| model.for_waveform(&waveform, None)) {
        Some(Ok(classifier)) => {
            checks.push(Check::ok("fit", "the model takes these frames"));
            Some(classifier)
        }
        Some(Err(error)) => {
            checks.push(Check::error("fit", &error));
            None
        }
        None => None,
    };
    checks.push(frames(opened.frames, opened.is_live, &mut classifier, &mut examined.frames));
    (checks, Some(examined))
}

/// Numbers of the first frames of a source.
#[derive(Default)]
struct FrameCounts {
    /// Frames known to be lost.
    lost: u64,
    /// Gaps of unknown length.
    unknown: u64,
    /// Samples at the lowest or highest code.
    saturated: u64,
    /// Receivers that gave no signal in some frame.
    dead: BTreeSet<usize>,
    /// Longest time to classify one of them; `None` where no model is checked.
    slowest: Option<Duration>,
}

/// Reads the first frames and reports how many arrive, how many are lost, and how long each takes to classify.
fn frames(
    mut source: Box<dyn radome_dsp::FrameSource>,
    is_live: bool,
    classifier: &mut Option<FrameClassifier>,
    frames: &mut Vec<Frame>,
) -> Check {
    let interval_s = source.waveform().frame_interval_s();
    let mut frame = Frame::zeroed(source.waveform().shape());
    let start = Instant::now();
    let mut counts = FrameCounts::default();
    while frames.len() < FRAMES && start.elapsed() < TIME_LIMIT {
        match source.next_frame(&mut frame) {
            Ok(SourceEvent::Frame) => {
                counts.saturated += u64::from(frame.saturated_samples());
                counts.dead.extend((0..frame.shape.rx).filter(|rx| frame.is_receiver_dead(*rx)));
                let classification_start = Instant::now();
                match classifier.as_mut().map(|classifier| classifier.classify(&frame)) {
                    Some(Err(error)) => return Check::error("frames", &error),
                    // The first frame is not timed: it includes the setup.
                    Some(Ok(Prediction::Probabilities(_))) if !frames.is_empty() => {
                        counts.slowest = counts.slowest.max(Some(classification_start.elapsed()))
                    }
                    _ => {}
                }
                frames.push(frame.clone());
            }
            Ok(SourceEvent::Gap(gap)) => {
                counts.lost = counts.lost.saturating_add(gap.frames);
                counts.unknown += u64::from(gap.frames == 0);
            }
            Ok(SourceEvent::End) => break,
            Err(error) => return Check::error("frames", &anyhow::Error::from_boxed(error)),
        }
    }
    counts.check(frames.len(), start.elapsed(), interval_s, is_live, frame.shape.rx)
}

impl FrameCounts {
    /// Reports the numbers for `count` frames that came in the time `elapsed`.
    fn check(&self, count: usize, elapsed: Duration, interval_s: f64, is_live: bool, receivers: usize) -> Check {
        let FrameCounts { lost, unknown, saturated, dead, slowest } = self;
        let unknown_loss = unknown_loss_text(*unknown);
        let found = format!(
            "{count} frames in {:.1} s, {lost} lost{unknown_loss}, {saturated} saturated samples{}",
            elapsed.as_secs_f64(),
            slowest.map_or_else(String::new, |slowest| {
                format!(", slowest answer {:.1} ms of {:.0} ms", slowest.as_secs_f64() * 1e3, interval_s * 1e3)
            }),
        );
        if count == 0 {
            let hint = match is_live {
                true => "the board is silent: radome board reset, or unplug it and plug it in",
                false => {
                    "no frame was recorded; of a recording that is damaged, radome recording repair saves what can be read"
                }
            };
            return Check::fail("frames", found, hint);
        }
        if let Some(first) = dead.first() {
            let found = match dead.len() == receivers {
                true => format!("{found}; no receiver gives a signal"),
                false => format!("{found}; receiver {} of {receivers} gives no signal", first + 1),
            };
            let hint = "see whether the board programs this receiver, and whether something covers or overdrives it";
            return if dead.len() == receivers {
                Check::fail("frames", found, hint)
            } else {
                Check::warn("frames", found, hint)
            };
        }
        if *lost > 0 || *unknown > 0 {
            let hint = match is_live {
                true => "another socket or a shorter cable; a hub that others do not share",
                false => {
                    "they were lost while it was recorded; radome doctor on the board tells whether it still loses any"
                }
            };
            return Check::warn("frames", found, hint);
        }
        if is_live && slowest.is_some_and(|slowest| slowest.as_secs_f64() > interval_s) {
            return Check::warn("frames", found, "this machine is too slow for the model: frames will be dropped");
        }
        if *saturated > 0 {
            return Check::warn("frames", found, "something stands close to the antenna, or if_gain_db is too high");
        }
        Check::ok("frames", found)
    }
}

/// Checks free space and write speed for recordings.
pub fn disk(folder: &Path, waveform: &Waveform) -> Vec<Check> {
    // Two bytes per code, before compression.
    let needed_bytes_per_s = 2.0 * waveform.shape().codes() as f64 / waveform.frame_interval_s();
    match rustix::fs::statvfs(folder) {
        Ok(fs) => {
            let free_bytes = fs.f_bavail as f64 * fs.f_frsize as f64;
            vec![free_space(folder, free_bytes, needed_bytes_per_s, waveform), write_speed(folder, needed_bytes_per_s)]
        }
        Err(error) => {
            vec![Check::fail("space", format!("{}: {error}", folder.display()), "name a folder that exists")]
        }
    }
}

/// Checks for how many hours of frames there is space.
fn free_space(folder: &Path, free_bytes: f64, needed_bytes_per_s: f64, waveform: &Waveform) -> Check {
    let hours = free_bytes / needed_bytes_per_s / 3600.0;
    let found = format!(
        "{}: {:.1} GiB free, {hours:.1} h of frames ({}, not compressed)",
        folder.display(),
        free_bytes / f64::from(1 << 30),
        waveform.shape()
    );
    match hours {
        h if h < 0.1 => Check::fail("space", found, "free some space, or --record-to another disk"),
        h if h < 10.0 => Check::warn("space", found, "not enough for a night: --record-to DIR on a larger disk"),
        _ => Check::ok("space", found),
    }
}

/// Checks whether frames can be written as fast as they come.
fn write_speed(folder: &Path, needed_bytes_per_s: f64) -> Check {
    let name = folder.display();
    let speed = match measure_write_speed(folder) {
        Ok(speed) => speed,
        Err(error) => return Check::fail("speed", format!("{name}: {error}"), remedy(error.kind())),
    };
    let found = format!("{name}: writes {:.0} MB/s, frames need {:.1}", speed / 1e6, needed_bytes_per_s / 1e6);
    match speed / needed_bytes_per_s {
        ratio if ratio < 1.0 => Check::fail("speed", found, "record to a faster disk: recordings would stop"),
        ratio if ratio < 3.0 => Check::warn("speed", found, "record to a faster disk: there is little to spare"),
        _ => Check::ok("speed", found),
    }
}

/// Measures how fast a file in the folder is written, bytes/s.
fn measure_write_speed(folder: &Path) -> std::io::Result<f64> {
    const PROBE_BYTES: usize = 32 << 20;
    // Incompressible data, in case the file system compresses.
    let mut word = 1u64;
    let mut block = vec![0u8; 1 << 20];
    block.chunks_mut(8).for_each(|bytes| {
        word = word.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        bytes.copy_from_slice(&word.to_le_bytes());
    });
    // The file has no name, or an unpredictable one, and is deleted when this function returns.
    let mut file = tempfile::tempfile_in(folder)?;
    let start = Instant::now();
    for _ in 0..PROBE_BYTES / block.len() {
        file.write_all(&block)?;
    }
    file.sync_all()?;
    Ok(PROBE_BYTES as f64 / start.elapsed().as_secs_f64())
}

/// Returns what helps against an error of writing to a folder.
fn remedy(kind: ErrorKind) -> &'static str {
    match kind {
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded => "make room, or --record-to another disk",
        ErrorKind::FileTooLarge => "raise the limit on the size of files (ulimit -f)",
        ErrorKind::PermissionDenied | ErrorKind::ReadOnlyFilesystem => "name a folder that this user may write",
        _ => "--record-to another disk, and see the system's log for errors of this one",
    }
}
