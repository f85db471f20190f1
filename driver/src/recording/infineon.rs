//! Vendor's folder: `RadarIfxAvian_00/{radar.npy,config.json,meta.json,format.version}`, as Radar Fusion GUI and
//! ifxdaq write it. Older recorders call the band `lower_frequency_Hz` and `upper_frequency_Hz`, leave the filters out,
//! write numbers as `60.5e9` and add time stamps and temperatures; all are read.
//!
//! `radar_timestamp.csv` holds the time of each frame in seconds, one per line: Unix time, or the board's own clock if
//! the stamp is before 1980.

mod writer;

use std::fs::File;
use std::io::{BufReader, Cursor, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use radome_dsp::{Frame, FrameShape, FrameSource, MAX_CODE, SourceError, SourceEvent, Waveform};
use radome_files::TEXT_LIMIT_BYTES;

use super::input::{self, open_file, read_text};
use super::vendor_config::read_waveform;
use super::{RecordingError, warn_once};

pub(super) use writer::InfineonWriter;

// Files in a radar's folder.
const DATA: &str = "radar.npy";
const TIMES: &str = "radar_timestamp.csv";
const TEMPERATURES: &str = "temperature.npy";
const TEMPERATURE_TIMES: &str = "temperature_timestamp.csv";
const CONFIG: &str = "config.json";
const META: &str = "meta.json";
const VERSION: &str = "format.version";
/// Names of all files in a radar's folder. A session's folder around it has one of the same names.
pub const FILES: [&str; 7] = [DATA, TIMES, TEMPERATURES, TEMPERATURE_TIMES, CONFIG, META, VERSION];
/// Beginning of the names of the radars' folders in a session.
const RADAR: &str = "RadarIfxAvian_";

/// Length limit of the files of times and temperatures, bytes: 50 million frames.
const SERIES_LIMIT_BYTES: u64 = 1 << 30;
/// Newest version of the format that is supported.
const SUPPORTED_VERSION: &str = "1.0.0";
/// Stamps from here on are Unix times: 1 January 1980, ns. A board's clock starts at zero.
const FIRST_UNIX_NS: u64 = 315_532_800_000_000_000;
/// Longest NPY header that is accepted, bytes.
const MAX_HEADER: u64 = 65_536;

/// Reader of the vendor's folder, frame by frame.
#[derive(Debug)]
pub struct InfineonReader {
    folder: PathBuf,
    data: PathBuf,
    file: BufReader<File>,
    data_offset: u64,
    waveform: Waveform,
    frames: u64,
    next: u64,
    /// Number of bytes behind the header.
    available: u64,
    bytes: Vec<u8>,
    series: Series,
}

impl InfineonReader {
    /// Opens a session's folder (its first radar is read) or a radar's own folder. Times and temperatures that cannot be used
    /// are left out with a warning: [`InfineonReader::left_out`].
    ///
    /// # Errors
    /// [`RecordingError`] if a file is absent or cannot be read, if the configuration does not state a waveform, or if
    /// it contradicts the data.
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        let folder = first_radar(path)?;
        check_version(&folder.join(VERSION))?;
        let (config, data) = (folder.join(CONFIG), folder.join(DATA));
        let mut file = BufReader::new(open_file(&data)?);
        let length = file.get_ref().metadata().map_err(RecordingError::cannot_read(&data))?.len();
        let header = NpyHeader::read(&mut file, &data)?;
        let (frames, data_shape) = header.frames_and_shape(&data)?;
        let waveform = read_waveform(&config, Some(data_shape))?;
        let shape = waveform.shape();
        if data_shape != shape {
            return Err(RecordingError::Shape {
                data,
                got: data_shape.to_string(),
                config,
                expected: shape.to_string(),
            });
        }
        let available = length.saturating_sub(header.data_offset);
        let surplus = available.saturating_sub(frames.saturating_mul(2 * shape.codes() as u64));
        if surplus > 0 {
            let data = data.display();
            warn_once(format!(
                "{data}: {surplus} bytes behind the {frames} frames that its header states; they are left out"
            ));
        }
        let series = Series::read(&folder, frames)?;
        Ok(InfineonReader {
            series,
            bytes: vec![0; shape.codes() * 2],
            available,
            data_offset: header.data_offset,
            folder,
            data,
            file,
            waveform,
            frames,
            next: 0,
        })
    }

    /// Returns the radar's own folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Reasons why times or temperatures of the folder are left out, with file and line. Without times, they follow from the frame
    /// interval.
    pub fn left_out(&self) -> &[String] {
        &self.series.left_out
    }

    /// Number of whole frames in the file; less than [`FrameSource::frame_count`] if the file was cut short.
    pub fn whole_frames(&self) -> u64 {
        (self.available / self.bytes.len().max(1) as u64).min(self.frames)
    }

    /// Returns whether the file has all frames that its header states.
    pub fn is_complete(&self) -> bool {
        self.whole_frames() == self.frames
    }

    /// Time of a frame from the start of the acquisition, ns.
    pub(super) fn time_ns(&self, index: u64) -> u64 {
        frame_time_ns(self.series.timestamps_ns.as_deref(), &self.waveform, index)
    }

    /// Seeks a frame by its number; the end for a number behind the last one.
    ///
    /// # Errors
    /// [`RecordingError::Io`].
    pub fn seek_frame(&mut self, sequence: u64) -> Result<(), RecordingError> {
        self.next = sequence.min(self.frames);
        let offset = self.data_offset + self.next.min(self.whole_frames()) * self.bytes.len() as u64;
        self.file.seek(SeekFrom::Start(offset)).map_err(RecordingError::cannot_read(&self.data))?;
        Ok(())
    }

    fn read_next(&mut self, frame: &mut Frame) -> Result<SourceEvent, RecordingError> {
        if self.next >= self.frames {
            return Ok(SourceEvent::End);
        }
        if self.next >= self.whole_frames() {
            return Err(RecordingError::Truncated {
                path: self.data.clone(),
                offset: self.data_offset + self.available,
                whole_frames: self.whole_frames(),
                expected_frames: self.frames,
            });
        }
        self.file.read_exact(&mut self.bytes).map_err(RecordingError::cannot_read(&self.data))?;
        let shape: FrameShape = self.waveform.shape();
        frame.shape = shape;
        frame.codes.clear();
        frame.codes.extend(self.bytes.as_chunks::<2>().0.iter().map(|b| u16::from_le_bytes(*b)));
        if let Some(index) = frame.codes.iter().position(|code| *code > MAX_CODE) {
            return Err(RecordingError::Code {
                path: self.data.clone(),
                offset: self.data_offset + self.next * self.bytes.len() as u64 + 2 * index as u64,
                frame: self.next,
                code: frame.codes.get(index).copied().unwrap_or(0),
            });
        }
        frame.sequence = self.next;
        frame.truth = None;
        frame.time_ns = self.time_ns(self.next);
        let stamp = usize::try_from(self.next).ok().and_then(|i| self.series.timestamps_ns.as_ref()?.get(i).copied());
        frame.host_time_ns = stamp.filter(|at| *at >= FIRST_UNIX_NS).unwrap_or(0);
        // The last temperature known at the time of the frame.
        let temperature = stamp.and_then(|now| {
            let after = self.series.temperatures.partition_point(|(at, _)| *at <= now);
            self.series.temperatures.get(after.checked_sub(1)?)
        });
        frame.temperature_millicelsius = temperature.map(|(_, celsius)| (celsius * 1e3).round() as i32);
        self.next += 1;
        Ok(SourceEvent::Frame)
    }
}

/// Time of a frame from the start of the acquisition, ns, by the folder's time stamps if it has them.
fn frame_time_ns(stamps_ns: Option<&[u64]>, waveform: &Waveform, index: u64) -> u64 {
    let stamps = stamps_ns.unwrap_or(&[]);
    match (usize::try_from(index).ok().and_then(|i| stamps.get(i)), stamps.first()) {
        (Some(now), Some(first)) if *first >= FIRST_UNIX_NS => now - first,
        (Some(now), _) => *now,
        _ => waveform.frame_time_ns(index),
    }
}

impl FrameSource for InfineonReader {
    fn waveform(&self) -> &Waveform {
        &self.waveform
    }

    fn next_frame(&mut self, frame: &mut Frame) -> Result<SourceEvent, SourceError> {
        Ok(self.read_next(frame)?)
    }

    fn frame_count(&self) -> Option<u64> {
        Some(self.frames)
    }
}

/// Finds the radars' own folders: the given one, or every `RadarIfxAvian_NN` in it, by name. A folder that has none is
/// no recording.
///
/// # Errors
/// [`RecordingError`] if the folder cannot be listed.
pub fn radar_folders(path: &Path) -> Result<Vec<PathBuf>, RecordingError> {
    // Either file is enough, because an error names the other one if it is absent. A config.json is not enough, because other
    // tools write one, too.
    if [DATA, VERSION].iter().any(|name| path.join(name).exists()) {
        return Ok(vec![path.to_owned()]);
    }
    let cannot = || RecordingError::io(path, "cannot be listed");
    let mut radars = Vec::new();
    for entry in std::fs::read_dir(path).map_err(cannot())? {
        let entry = entry.map_err(cannot())?.path();
        if is_radar(&entry) && entry.is_dir() {
            radars.push(entry);
        }
    }
    radars.sort();
    Ok(radars)
}

/// Returns the folder of the only radar of a session, or the radar's own folder, if that is given; `None` for anything else.
pub fn only_radar_of(path: &Path) -> Option<PathBuf> {
    let radars = if path.is_dir() { radar_folders(path).ok()? } else { return None };
    if let [radar] = radars.as_slice() { Some(radar.clone()) } else { None }
}

/// Returns the folder of the session that a radar's own folder is in; `None` if its name is no radar's.
pub fn session_of(radar: &Path) -> Option<&Path> {
    radar.parent().filter(|_| is_radar(radar))
}

fn is_radar(folder: &Path) -> bool {
    folder.file_name().is_some_and(|name| name.to_string_lossy().starts_with(RADAR))
}

/// Finds the folder of the first radar, and warns if there are others.
fn first_radar(path: &Path) -> Result<PathBuf, RecordingError> {
    let mut radars = radar_folders(path)?.into_iter();
    let folder = radars.next().ok_or_else(|| RecordingError::Unknown { path: path.to_owned() })?;
    if radars.len() > 0 {
        let (path, count) = (path.display(), radars.len() + 1);
        let first = folder.file_name().unwrap_or_default().to_string_lossy();
        warn_once(format!("{path}: {count} radars; only {first} is read; name the folder of another one to read that"));
    }
    Ok(folder)
}

fn check_version(path: &Path) -> Result<(), RecordingError> {
    let text = read_text(path, TEXT_LIMIT_BYTES)?;
    let text = text.trim();
    let numbers: Option<Vec<u32>> = text.split('.').map(|n| n.parse().ok()).collect();
    match numbers.as_deref() {
        Some([major, minor, _]) if (*major, *minor) <= (1, 0) => Ok(()),
        Some([_, _, _]) => {
            Err(RecordingError::Newer { path: path.into(), got: text.to_owned(), supported: SUPPORTED_VERSION })
        }
        _ => {
            let shown: String = text.chars().take(20).collect();
            let reason = format!("the version is '{shown}', expected three numbers such as {SUPPORTED_VERSION}");
            Err(RecordingError::Corrupt { path: path.into(), offset: 0, reason })
        }
    }
}

struct NpyHeader {
    type_string: String,
    shape: Vec<u64>,
    data_offset: u64,
}

impl NpyHeader {
    fn read<R: Read + Seek>(file: &mut R, path: &Path) -> Result<Self, RecordingError> {
        let corrupt = |reason: String| RecordingError::Corrupt { path: path.to_owned(), offset: 0, reason };
        // The header's own length is checked before anything is allocated for it.
        let mut prelude = [0; 12];
        file.read_exact(&mut prelude).map_err(|_| corrupt("shorter than an NPY header".into()))?;
        if prelude.get(..6) != Some(b"\x93NUMPY") {
            return Err(corrupt("not an NPY file: it does not begin with \\x93NUMPY".into()));
        }
        let [.., version, _, a, b, c, d] = prelude;
        // The text that follows; in version 1 its first two bytes have been read.
        let (length, already_read) = match version {
            1 => (u64::from(u16::from_le_bytes([a, b])), 2),
            _ => (u64::from(u32::from_le_bytes([a, b, c, d])), 0),
        };
        if length > MAX_HEADER {
            return Err(corrupt(format!("the NPY header claims {length} bytes, expected at most {MAX_HEADER}")));
        }
        let io = |e: std::io::Error| corrupt(format!("the NPY header cannot be read: {e}"));
        // The time of the parser doubles with each nested bracket. Plain numbers need only one dictionary and one tuple.
        let mut text = vec![c, d];
        file.by_ref().take(length.saturating_sub(already_read)).read_to_end(&mut text).map_err(io)?;
        let count = |bracket: u8| text.iter().filter(|b| **b == bracket).count();
        if count(b'[') > 0 || count(b'(') > 1 || count(b'{') > 1 {
            return Err(corrupt(
                "the NPY header has brackets within brackets, expected an array of plain numbers".into(),
            ));
        }
        file.seek(SeekFrom::Start(0)).map_err(io)?;
        let header = npyz::NpyHeader::from_reader(&mut *file).map_err(io)?;
        let npyz::DType::Plain(type_string) = header.dtype() else {
            return Err(corrupt("the array holds records, expected plain numbers".into()));
        };
        if header.order() != npyz::Order::C {
            return Err(corrupt("the array is in Fortran order, expected C order".into()));
        }
        let data_offset = file.stream_position().map_err(io)?;
        Ok(NpyHeader { type_string: type_string.to_string(), shape: header.shape().to_vec(), data_offset })
    }

    /// Number and shape of the frames of an array of samples, which is the content of `data`.
    fn frames_and_shape(&self, data: &Path) -> Result<(u64, FrameShape), RecordingError> {
        let corrupt = |reason: String| RecordingError::Corrupt { path: data.to_owned(), offset: 10, reason };
        if self.type_string != "<u2" {
            return Err(corrupt(format!("samples are of type '{}', expected '<u2'", self.type_string)));
        }
        let &[frames, rx, chirps, samples] = self.shape.as_slice() else {
            let shape = &self.shape;
            return Err(corrupt(format!("the array has shape {shape:?}, expected (frames, rx, chirps, samples)")));
        };
        // A count beyond any waveform's cannot match the configuration.
        let count = |n: u64| usize::try_from(n).unwrap_or(usize::MAX);
        Ok((frames, FrameShape { rx: count(rx), chirps: count(chirps), samples: count(samples) }))
    }
}

/// Times and temperatures of the frames of a folder.
#[derive(Debug)]
struct Series {
    /// Time of each frame, ns: since 1970, or by the board's clock.
    timestamps_ns: Option<Vec<u64>>,
    /// Time on the same clock, ns, and temperature, degrees Celsius.
    temperatures: Vec<(u64, f64)>,
    /// Reasons why times or temperatures are left out.
    left_out: Vec<String>,
}

impl Series {
    /// Reads times and temperatures of `frames` frames, and warns of those that cannot be used.
    fn read(folder: &Path, frames: u64) -> Result<Self, RecordingError> {
        let mut left_out = Vec::new();
        let timestamps_ns = read_timestamps(&folder.join(TIMES), Some(frames), &mut left_out)?;
        for reason in &left_out {
            warn_once(format!("{reason}; the times of all frames are made of the frame interval"));
        }
        let time_reasons = left_out.len();
        let temperatures = read_temperatures(folder, &mut left_out)?;
        if timestamps_ns.is_none() && !temperatures.is_empty() {
            let path = folder.join(TEMPERATURES);
            left_out.push(format!("{}: the frames have no times by the clock of the temperatures", path.display()));
        }
        for reason in left_out.iter().skip(time_reasons) {
            warn_once(format!("{reason}; the temperatures are left out"));
        }
        Ok(Series { timestamps_ns, temperatures, left_out })
    }
}

/// Reads one time in seconds per line; returns nanoseconds. If one time cannot be used, all are left out, and the reason is
/// added to `left_out`.
fn read_timestamps(
    path: &Path,
    expected: Option<u64>,
    left_out: &mut Vec<String>,
) -> Result<Option<Vec<u64>>, RecordingError> {
    let text = match read_text(path, SERIES_LIMIT_BYTES) {
        Ok(text) => text,
        Err(RecordingError::Missing { .. }) => return Ok(None),
        Err(error @ RecordingError::Corrupt { .. }) => {
            left_out.push(error.to_string());
            return Ok(None);
        }
        Err(error) => return Err(error),
    };
    let reason = match parse_timestamps(&text) {
        Ok(stamps) => match expected.filter(|expected| *expected != stamps.len() as u64) {
            None => return Ok(Some(stamps)),
            Some(expected) => format!("{} time stamps for {expected} frames", stamps.len()),
        },
        Err(reason) => reason,
    };
    left_out.push(format!("{}: {reason}", path.display()));
    Ok(None)
}

/// Parses one time in seconds per line to nanoseconds; the error names the line.
fn parse_timestamps(text: &str) -> Result<Vec<u64>, String> {
    let mut stamps: Vec<u64> = Vec::new();
    for (index, line) in text.lines().map(str::trim).enumerate().filter(|(_, line)| !line.is_empty()) {
        let stamp = parse_time_ns(line).filter(|stamp| stamps.last().is_none_or(|last| last <= stamp));
        let Some(stamp) = stamp else {
            let shown: String = line.chars().take(20).collect();
            return Err(format!("line {}: '{shown}' is no time, expected seconds that never decrease", index + 1));
        };
        stamps.push(stamp);
    }
    Ok(stamps)
}

/// Parses decimal seconds to nanoseconds, exactly. An f64 would resolve a Unix time to a quarter of a microsecond only.
fn parse_time_ns(text: &str) -> Option<u64> {
    let (whole, fraction) = text.split_once('.').unwrap_or((text, ""));
    let digits = |s: &str| s.bytes().all(|b| b.is_ascii_digit());
    if whole.is_empty() || !digits(whole) || !digits(fraction) {
        // The text has an exponent.
        let seconds: f64 = text.parse().ok()?;
        return (0.0..1e10).contains(&seconds).then_some((seconds * 1e9).round() as u64);
    }
    let nanoseconds =
        fraction.bytes().chain(std::iter::repeat(b'0')).take(9).fold(0, |n, b| 10 * n + u64::from(b - b'0'));
    whole.parse::<u64>().ok()?.checked_mul(1_000_000_000)?.checked_add(nanoseconds)
}

/// Reads times on the frames' clock, ns, and temperatures, degrees Celsius. If they cannot be used, all are left
/// out, and the reason is added to `left_out`.
fn read_temperatures(folder: &Path, left_out: &mut Vec<String>) -> Result<Vec<(u64, f64)>, RecordingError> {
    let path = folder.join(TEMPERATURES);
    let times = read_timestamps(&folder.join(TEMPERATURE_TIMES), None, left_out)?;
    let Some(times) = times else { return Ok(Vec::new()) };
    let content = match input::read(&path, SERIES_LIMIT_BYTES) {
        Err(RecordingError::Missing { .. }) => return Ok(Vec::new()),
        content => content?,
    };
    let values = match parse_temperatures(&content, &path) {
        Ok(values) => values,
        Err(error) => {
            left_out.push(error.to_string());
            return Ok(Vec::new());
        }
    };
    if values.len() != times.len() {
        let (path, values, times) = (path.display(), values.len(), times.len());
        left_out.push(format!("{path}: {values} temperatures, but {times} time stamps for them"));
        return Ok(Vec::new());
    }
    Ok(times.into_iter().zip(values).collect())
}

/// Parses the content of a file of temperatures, degrees Celsius; the error is [`RecordingError::Corrupt`].
fn parse_temperatures(content: &[u8], path: &Path) -> Result<Vec<f64>, RecordingError> {
    let header = NpyHeader::read(&mut Cursor::new(content), path)?;
    let bytes = content.get(header.data_offset as usize..).unwrap_or(&[]);
    match header.type_string.as_str() {
        "<f8" => Ok(bytes.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b)).collect()),
        "<f4" => Ok(bytes.as_chunks::<4>().0.iter().map(|b| f64::from(f32::from_le_bytes(*b))).collect()),
        other => {
            let reason = format!("temperatures are of type '{other}', expected '<f8' or '<f4'");
            Err(RecordingError::Corrupt { path: path.to_owned(), offset: 10, reason })
        }
    }
}
