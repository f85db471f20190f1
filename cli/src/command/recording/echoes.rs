use std::collections::VecDeque;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use radome_dsp::detect::{AngleCalibration, Detection, Detector, RangeProfile, Receivers};
use radome_dsp::{Frame, FrameSource, Waveform};
use radome_files::parse_toml;
use serde::{Deserialize, Serialize};
use serde_json::json;

use crate::exit::wrong_use;
use crate::live::pipeline::Items;
use crate::output_file::Overwrite;
use crate::source::{self, SourceArgs};
use crate::{files, output};

/// Time over which frames are compared to find people who sit or stand, s.
const STILL_WINDOW_S: f64 = 2.0;
/// Distance below which a still echo and a moving one belong to the same body, m.
const SAME_BODY_M: f64 = 0.5;
/// Half the range interval in which a reflector is searched for, m.
const REFLECTOR_HALF_WIDTH_M: f64 = 0.3;
/// Least level of a reflector over the median range, dB. Its phase is then within a few degrees.
const LEAST_REFLECTOR_DB: f64 = 20.0;
/// Number of frames over which a reflector is averaged.
const REFLECTOR_FRAMES: u64 = 50;

/// `radome recording echoes`
#[derive(clap::Args)]
#[command(mut_arg("frames", |frames| frames.help("Stop after this number of frames; a simulated scene ends after 100 if absent")))]
pub struct Arguments {
    #[command(flatten)]
    source: SourceArgs,
    /// File with the phase offsets between this board's receivers, which -o wrote with --reflector
    #[arg(long, value_name = "FILE")]
    angles: Option<PathBuf>,
    /// Measure the phase offsets between the receivers with a reflector at this place, in metres and degrees to the left and up.
    /// Nothing may move meanwhile
    #[arg(
        long,
        value_name = "RANGE_M,AZIMUTH_DEG,ELEVATION_DEG",
        value_delimiter = ',',
        allow_hyphen_values = true,
        num_args = 1
    )]
    reflector: Option<Vec<f64>>,
    /// File to write the phase offsets to
    #[arg(short, long, value_name = "FILE", requires = "reflector")]
    output: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Print one JSON object per frame
    #[arg(long)]
    json: bool,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct AngleFile {
    format: u32,
    #[serde(default)]
    measured_from: String,
    #[serde(flatten)]
    calibration: AngleCalibration,
}

/// Echo in the output format.
#[derive(Serialize)]
struct Echo {
    range_m: f64,
    velocity_m_per_s: f64,
    azimuth_deg: Option<f64>,
    elevation_deg: Option<f64>,
    snr_db: f64,
    is_still: bool,
}

/// Prints ranges, speeds and directions of moving echoes, frame by frame; or phase offsets between the receivers.
///
/// # Errors
/// The source or the angles cannot be read, no reflector is found, or something moves at its range.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    output::catch_interrupts()?;
    if let Some(path) = &arguments.output {
        let angles = arguments.angles.as_deref().unwrap_or(Path::new(""));
        let [source, waveform] = arguments.source.inputs();
        arguments.overwrite.check(path, &[source, waveform, angles])?;
    }
    let reflector = arguments.reflector.as_deref().map(parse_reflector).transpose()?;
    let calibration = arguments.angles.as_deref().map(read_angles).transpose()?.unwrap_or_default();
    let source = source::open(&arguments.source.source, &arguments.source.finite_options()?)?.frames;
    let waveform = source.waveform().clone();
    let receivers = Receivers::new(waveform.request.rx_antennas, calibration);
    if receivers.baselines().is_empty() {
        let why = "these receivers tell no angle: RX3 and RX1 are needed for azimuth, RX3 and RX2 for elevation";
        ensure!(reflector.is_none(), why);
        message!("{why}");
    }
    let detector = Detector::new(&waveform, &receivers.baselines());
    match reflector {
        None => print_all_echoes(arguments, &receivers, detector, source),
        Some(position) => {
            let echo = measure_reflector(arguments, position, detector, source)?;
            calibrate(arguments, position, &receivers, &waveform, &echo)
        }
    }
}

/// Prints the echoes of every frame: those that move within it, and those that change over [`STILL_WINDOW_S`].
fn print_all_echoes(
    arguments: &Arguments,
    receivers: &Receivers,
    mut detector: Detector,
    source: Box<dyn FrameSource>,
) -> anyhow::Result<()> {
    let window = (STILL_WINDOW_S / source.waveform().frame_interval_s()).round().clamp(4.0, 200.0) as usize;
    let mut profiles: VecDeque<RangeProfile> = VecDeque::with_capacity(window + 1);
    let items = Items::of(source, arguments.source.frames);
    let (mut frame_count, mut echo_count) = (0u64, 0);
    while let Some(frame) = items.next_frame(|| profiles.clear())? {
        let (mut echoes, profile) = detector.detect_moving(&frame)?;
        if profiles.len() == window {
            profiles.pop_front();
        }
        profiles.push_back(profile);
        if profiles.len() == window {
            let still = detector.detect_still(&profiles.iter().collect::<Vec<_>>());
            let is_new = |s: &Detection| echoes.iter().all(|e| (e.range_m - s.range_m).abs() > SAME_BODY_M);
            let new: Vec<Detection> = still.into_iter().filter(is_new).collect();
            echoes.extend(new);
        }
        frame_count += 1;
        echo_count += echoes.len();
        print_echoes(&frame, &echoes, receivers, arguments.json)?;
    }
    if echo_count == 0 && !arguments.json {
        message!("no echo stands out of the noise in {frame_count} frames");
    }
    Ok(())
}

/// Parses the position of the reflector: range, azimuth and elevation.
fn parse_reflector(numbers: &[f64]) -> anyhow::Result<[f64; 3]> {
    let &[range_m, azimuth_deg, elevation_deg] = numbers else {
        wrong_use!("--reflector takes three numbers: RANGE_M,AZIMUTH_DEG,ELEVATION_DEG, such as 2.0,0,0");
    };
    if !(range_m > 0.0 && azimuth_deg.abs() <= 60.0 && elevation_deg.abs() <= 60.0) {
        wrong_use!(
            "--reflector {range_m},{azimuth_deg},{elevation_deg}: expected a range above 0 and angles of at most 60 degrees"
        );
    }
    Ok([range_m, azimuth_deg, elevation_deg])
}

/// Measures the echo of a reflector over some frames. Refuses frames in which something moves at its range.
fn measure_reflector(
    arguments: &Arguments,
    [range_m, ..]: [f64; 3],
    mut detector: Detector,
    source: Box<dyn FrameSource>,
) -> anyhow::Result<Detection> {
    let max_range_m = source.waveform().max_range_m();
    let frame_limit = arguments.source.frames.unwrap_or(u64::MAX).min(REFLECTOR_FRAMES);
    let items = Items::of(source, Some(frame_limit));
    let (mut profiles, mut moving_count) = (Vec::<RangeProfile>::new(), 0u64);
    // A reflector that stands still needs no frames in a row.
    while let Some(frame) = items.next_frame(|| ())? {
        let (echoes, profile) = detector.detect_moving(&frame)?;
        profiles.push(profile);
        moving_count += u64::from(echoes.iter().any(|echo| (echo.range_m - range_m).abs() < REFLECTOR_HALF_WIDTH_M));
    }
    if output::interrupted() {
        return Err(output::Interrupted.into());
    }
    let frame_count = profiles.len();
    ensure!(frame_count > 0, "{}: no frame to measure a reflector in", arguments.source.source);
    ensure!(
        moving_count == 0,
        "something moves within {REFLECTOR_HALF_WIDTH_M} m of the reflector's range, {range_m} m, in {moving_count} of {frame_count} frames\n\nhint: leave the \
         room, and measure again"
    );
    let within_m = range_m - REFLECTOR_HALF_WIDTH_M..range_m + REFLECTOR_HALF_WIDTH_M;
    let echo = detector.find_reflector(&profiles.iter().collect::<Vec<_>>(), within_m).with_context(|| {
        format!(
            "no echo within {REFLECTOR_HALF_WIDTH_M} m of {range_m} m\n\nhint: check the reflector's range; the waveform reaches {max_range_m:.1} m"
        )
    })?;
    ensure!(
        echo.snr_db >= LEAST_REFLECTOR_DB,
        "no reflector stands out at {range_m} m: the strongest echo there is {:.0} dB over the median range, and {LEAST_REFLECTOR_DB} are \
         needed\n\nhint: use a larger reflector, such as a metal corner of 10 cm, or a range at which nothing else stands",
        echo.snr_db
    );
    Ok(echo)
}

/// Computes phase offsets between the receivers from the echo of a reflector at a known position. Writes and prints them.
fn calibrate(
    arguments: &Arguments,
    [range_m, azimuth_deg, elevation_deg]: [f64; 3],
    receivers: &Receivers,
    waveform: &Waveform,
    echo: &Detection,
) -> anyhow::Result<()> {
    let truth = (azimuth_deg.to_radians(), elevation_deg.to_radians());
    let calibration = receivers.calibrate(&echo.cosines, truth, waveform.wavelength_m());
    let measured_from = format!(
        "{}: a reflector at {range_m} m, {azimuth_deg} degrees left, {elevation_deg} up; seen at {:.3} m, {:.0} dB over the median range",
        arguments.source.source, echo.range_m, echo.snr_db
    );
    let file = AngleFile { format: 1, measured_from, calibration };
    if let Some(path) = &arguments.output {
        files::write_output(path, arguments.overwrite.existing(), |out| {
            std::io::Write::write_all(out, toml::to_string(&file)?.as_bytes()).context("cannot write the angles")
        })?;
    }
    if arguments.json {
        return output::json_line(&file);
    }
    output::text_line(&format!(
        "RX1 over RX3 {:+.1} degrees, RX2 over RX3 {:+.1}; {}",
        calibration.azimuth_phase_rad.to_degrees(),
        calibration.elevation_phase_rad.to_degrees(),
        file.measured_from
    ))
}

fn read_angles(path: &Path) -> anyhow::Result<AngleCalibration> {
    let file: AngleFile = parse_toml(&files::read_text_file(path)?).with_context(|| {
        format!(
            "{}: no file of angles\n\nhint: make one with radome recording echoes SOURCE --reflector 2.0,0,0 -o FILE",
            path.display()
        )
    })?;
    ensure!(file.format == 1, "{}: format {}, this program reads 1", path.display(), file.format);
    let AngleCalibration { azimuth_phase_rad, elevation_phase_rad } = file.calibration;
    if !(azimuth_phase_rad.is_finite() && elevation_phase_rad.is_finite()) {
        bail!("{}: a phase is no number", path.display());
    }
    Ok(file.calibration)
}

fn print_echoes(frame: &Frame, echoes: &[Detection], receivers: &Receivers, json: bool) -> anyhow::Result<()> {
    let rows = echoes.iter().map(|echo| {
        let direction = receivers.direction(&echo.cosines);
        Echo {
            range_m: echo.range_m,
            velocity_m_per_s: echo.velocity_m_per_s,
            azimuth_deg: direction.azimuth_rad.map(f64::to_degrees),
            elevation_deg: direction.elevation_rad.map(f64::to_degrees),
            snr_db: echo.snr_db,
            is_still: echo.is_still,
        }
    });
    let rows: Vec<Echo> = rows.collect();
    if json {
        return output::json_line(&json!({ "sequence": frame.sequence, "time_s": frame.time_s(), "echoes": rows }));
    }
    for row in &rows {
        let angle = |angle: Option<f64>| angle.map_or("     -".to_owned(), |degrees| format!("{degrees:+6.1}"));
        output::text_line(&format!(
            "{:8.2} s  {:6.3} m  {:+6.2} m/s  {} deg left  {} deg up  {:5.1} dB{}",
            frame.time_s(),
            row.range_m,
            row.velocity_m_per_s,
            angle(row.azimuth_deg),
            angle(row.elevation_deg),
            row.snr_db,
            if row.is_still { "  still" } else { "" }
        ))?;
    }
    Ok(())
}
