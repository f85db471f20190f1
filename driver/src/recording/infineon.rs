//! The vendor's folder: `RadarIfxAvian_00/{radar.npy,config.json,meta.json,format.version}`, as Radar Fusion GUI and
//! ifxdaq write it. Older recorders call the band `lower_frequency_Hz` and `upper_frequency_Hz`, leave the filters out,
//! write numbers as `60.5e9` and add time stamps and temperatures; all are read.

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use radome_dsp::{
    Frame, FrameShape, FrameSource, MAX_CODE, RxMask, SourceError, SourceEvent, Waveform, WaveformRequest,
};
use serde_json::Value;

use super::RecordingError;

/// Newest format that is known.
const SUPPORTED_VERSION: &str = "1.0.0";
/// Longest NPY header that makes sense.
const MAX_HEADER: u64 = 65_536;

/// Reads the vendor's folder frame by frame.
#[derive(Debug)]
pub struct InfineonReader {
    folder: PathBuf,
    data: PathBuf,
    file: BufReader<File>,
    data_offset: u64,
    waveform: Waveform,
    frames: u64,
    next: u64,
    /// Bytes of the file behind the header.
    available: u64,
    bytes: Vec<u8>,
    /// Unix time of each frame, s.
    timestamps_s: Option<Vec<f64>>,
    /// Unix time, s, and temperature, degrees Celsius.
    temperatures: Vec<(f64, f64)>,
}

impl InfineonReader {
    /// Opens a session's folder (its first radar is read) or a radar's own folder.
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        let folder = radar_folder(path)?;
        check_version(&folder.join("format.version"))?;
        let config = folder.join("config.json");
        let waveform = read_waveform(&config)?;

        let data = folder.join("radar.npy");
        let mut file = BufReader::new(File::open(&data).map_err(RecordingError::io(&data, "cannot be opened"))?);
        let length = file.get_ref().metadata().map_err(RecordingError::io(&data, "cannot be read"))?.len();
        let header = NpyHeader::read(&mut file, &data)?;
        if header.type_string != "<u2" {
            let reason = format!("samples are of type '{}', expected '<u2'", header.type_string);
            return Err(RecordingError::Corrupt { path: data, offset: 10, reason });
        }
        let &[frames, rx, chirps, samples] = header.shape.as_slice() else {
            let reason = format!("the array has shape {:?}, expected (frames, rx, chirps, samples)", header.shape);
            return Err(RecordingError::Corrupt { path: data, offset: 10, reason });
        };
        let shape = waveform.shape();
        if (rx, chirps, samples) != (shape.rx as u64, shape.chirps as u64, shape.samples as u64) {
            let got = format!("{rx} rx x {chirps} chirps x {samples} samples");
            return Err(RecordingError::Shape { data, got, config, expected: shape.to_string() });
        }
        Ok(InfineonReader {
            timestamps_s: read_timestamps(&folder.join("radar_timestamp.csv"), Some(frames))?,
            temperatures: read_temperatures(&folder)?,
            bytes: vec![0; shape.codes() * 2],
            available: length.saturating_sub(header.data_offset),
            data_offset: header.data_offset,
            folder,
            data,
            file,
            waveform,
            frames,
            next: 0,
        })
    }

    /// The radar's own folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Whole frames that are there; less than [`FrameSource::frame_count`] if the file was cut short.
    pub fn whole_frames(&self) -> u64 {
        (self.available / self.bytes.len().max(1) as u64).min(self.frames)
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
        self.file.read_exact(&mut self.bytes).map_err(RecordingError::io(&self.data, "cannot be read"))?;
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
        let stamps = self.timestamps_s.as_deref().unwrap_or(&[]);
        let stamp = usize::try_from(self.next).ok().and_then(|i| stamps.get(i));
        match (stamp, stamps.first()) {
            (Some(now), Some(first)) => {
                frame.time_ns = ((now - first).max(0.0) * 1e9).round() as u64;
                frame.host_time_ns = (now * 1e9).round() as u64;
            }
            _ => {
                frame.time_ns = (self.next as f64 * self.waveform.frame_interval_s() * 1e9).round() as u64;
                frame.host_time_ns = 0;
            }
        }
        // The last temperature known at the time of the frame.
        let known = stamp.and_then(|now| self.temperatures.iter().rev().find(|(at, _)| at <= now));
        frame.temperature_millicelsius = known.map(|(_, celsius)| (celsius * 1e3).round() as i32);
        self.next += 1;
        Ok(SourceEvent::Frame)
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

/// The folder that holds `radar.npy`: the given one, or the first `RadarIfxAvian_NN` in it.
fn radar_folder(path: &Path) -> Result<PathBuf, RecordingError> {
    if path.join("radar.npy").exists() || path.join("config.json").exists() {
        return Ok(path.to_owned());
    }
    let entries = std::fs::read_dir(path).map_err(RecordingError::io(path, "cannot be listed"))?;
    let is_radar = |name: &std::ffi::OsStr| name.to_string_lossy().starts_with("RadarIfxAvian_");
    let mut radars: Vec<_> = entries.flatten().filter(|e| is_radar(&e.file_name())).map(|e| e.path()).collect();
    radars.sort();
    radars.into_iter().next().ok_or_else(|| RecordingError::Unknown { path: path.to_owned() })
}

fn check_version(path: &Path) -> Result<(), RecordingError> {
    let text = std::fs::read_to_string(path).map_err(RecordingError::io(path, "cannot be read"))?;
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

/// Fields of a configuration under their new and old names.
struct Fields<'a> {
    path: &'a Path,
    object: &'a Value,
}

impl Fields<'_> {
    fn error(&self, field: &str, reason: impl Into<String>) -> RecordingError {
        RecordingError::Field { path: self.path.to_owned(), field: field.to_owned(), reason: reason.into() }
    }

    fn optional(&self, field: &str) -> Result<Option<f64>, RecordingError> {
        match self.object.get(field) {
            None | Some(Value::Null) => Ok(None),
            // Some recorders write numbers as text.
            Some(Value::String(text)) => match text.trim().parse() {
                Ok(number) => Ok(Some(number)),
                Err(_) => Err(self.error(field, format!("is \"{text}\", expected a number"))),
            },
            Some(value) => match value.as_f64() {
                Some(number) => Ok(Some(number)),
                None => Err(self.error(field, format!("is {value}, expected a number"))),
            },
        }
    }

    fn number(&self, field: &str, old: Option<&str>) -> Result<f64, RecordingError> {
        let value = match (self.optional(field)?, old) {
            (None, Some(old)) => self.optional(old)?,
            (value, _) => value,
        };
        value.ok_or_else(|| match old {
            Some(old) => self.error(field, format!("is absent, and so is its old name `{old}`")),
            None => self.error(field, "is absent"),
        })
    }

    fn count(&self, field: &str) -> Result<usize, RecordingError> {
        let number = self.number(field, None)?;
        if number < 0.0 || number > f64::from(u32::MAX) || number.fract() != 0.0 {
            return Err(self.error(field, format!("is {number}, expected a whole number")));
        }
        Ok(number as usize)
    }

    fn antennas(&self) -> Result<RxMask, RecordingError> {
        let field = "rx_antennas";
        let wrong = |this: &Self| this.error(field, "expected a list of antenna numbers such as [1, 2, 3]");
        let list = self.object.get(field).and_then(Value::as_array).ok_or_else(|| wrong(self))?;
        let antennas: Option<Vec<u8>> = list.iter().map(|v| v.as_f64().map(|a| a as u8)).collect();
        let antennas = antennas.ok_or_else(|| wrong(self))?;
        RxMask::from_antennas(&antennas).map_err(|e| self.error(field, e.to_string()))
    }
}

fn read_waveform(path: &Path) -> Result<Waveform, RecordingError> {
    let text = std::fs::read_to_string(path).map_err(RecordingError::io(path, "cannot be read"))?;
    let root: Value = serde_json::from_str(&text).map_err(|e| RecordingError::Corrupt {
        path: path.into(),
        offset: text.split_inclusive('\n').take(e.line().saturating_sub(1)).map(str::len).sum::<usize>() as u64
            + e.column() as u64,
        reason: format!("not JSON: {e}"),
    })?;
    let object = root.pointer("/device_config/fmcw_single_shape").ok_or_else(|| RecordingError::Field {
        path: path.into(),
        field: "device_config.fmcw_single_shape".into(),
        reason: "is absent; recordings configured otherwise cannot be read".into(),
    })?;
    let fields = Fields { path, object };
    let request = WaveformRequest {
        start_frequency_hz: fields.number("start_frequency_Hz", Some("lower_frequency_Hz"))?,
        end_frequency_hz: fields.number("end_frequency_Hz", Some("upper_frequency_Hz"))?,
        samples_per_chirp: fields.count("num_samples_per_chirp")?,
        chirps_per_frame: fields.count("num_chirps_per_frame")?,
        sample_rate_hz: fields.number("sample_rate_Hz", None)?,
        chirp_interval_s: fields.number("chirp_repetition_time_s", None)?,
        frame_interval_s: fields.number("frame_repetition_time_s", None)?,
        rx_antennas: fields.antennas()?,
        tx_power_level: fields.optional("tx_power_level")?.unwrap_or(31.0).clamp(0.0, 255.0) as u8,
        if_gain_db: fields.number("if_gain_dB", None)?,
        high_pass_cutoff_hz: fields.optional("hp_cutoff_Hz")?.unwrap_or(80e3),
        anti_alias_cutoff_hz: fields.optional("aaf_cutoff_Hz")?.unwrap_or(500e3),
    };
    Waveform::realise(request).map_err(|source| RecordingError::Waveform { path: path.into(), source })
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
        let length = match version {
            1 => u64::from(u16::from_le_bytes([a, b])),
            _ => u64::from(u32::from_le_bytes([a, b, c, d])),
        };
        if length > MAX_HEADER {
            return Err(corrupt(format!("the NPY header claims {length} bytes, expected at most {MAX_HEADER}")));
        }
        let io = |e: std::io::Error| corrupt(format!("the NPY header cannot be read: {e}"));
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
}

/// One Unix time in seconds a line.
fn read_timestamps(path: &Path, expected: Option<u64>) -> Result<Option<Vec<f64>>, RecordingError> {
    let text = match std::fs::read_to_string(path) {
        Ok(text) => text,
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(None),
        Err(e) => return Err(RecordingError::io(path, "cannot be read")(e)),
    };
    let mut stamps = Vec::new();
    let mut offset = 0;
    for line in text.split_inclusive('\n') {
        let corrupt = || RecordingError::Corrupt {
            path: path.to_owned(),
            offset,
            reason: format!("'{}' is no time, expected Unix seconds", line.trim().chars().take(20).collect::<String>()),
        };
        if !line.trim().is_empty() {
            let stamp: f64 = line.trim().parse().map_err(|_| corrupt())?;
            if !stamp.is_finite() || stamps.last().is_some_and(|last| *last > stamp) {
                return Err(corrupt());
            }
            stamps.push(stamp);
        }
        offset += line.len() as u64;
    }
    if let Some(expected) = expected
        && stamps.len() as u64 != expected
    {
        let reason = format!("{} time stamps for {expected} frames", stamps.len());
        return Err(RecordingError::Corrupt { path: path.into(), offset, reason });
    }
    Ok(Some(stamps))
}

fn read_temperatures(folder: &Path) -> Result<Vec<(f64, f64)>, RecordingError> {
    let path = folder.join("temperature.npy");
    let Some(times) = read_timestamps(&folder.join("temperature_timestamp.csv"), None)? else { return Ok(Vec::new()) };
    if !path.exists() {
        return Ok(Vec::new());
    }
    let mut file = BufReader::new(File::open(&path).map_err(RecordingError::io(&path, "cannot be opened"))?);
    let header = NpyHeader::read(&mut file, &path)?;
    let mut bytes = Vec::new();
    file.read_to_end(&mut bytes).map_err(RecordingError::io(&path, "cannot be read"))?;
    let values: Vec<f64> = match header.type_string.as_str() {
        "<f8" => bytes.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b)).collect(),
        "<f4" => bytes.as_chunks::<4>().0.iter().map(|b| f64::from(f32::from_le_bytes(*b))).collect(),
        other => {
            let reason = format!("temperatures are of type '{other}', expected '<f8' or '<f4'");
            return Err(RecordingError::Corrupt { path, offset: 10, reason });
        }
    };
    if values.len() != times.len() {
        let reason = format!("{} temperatures, but {} time stamps for them", values.len(), times.len());
        return Err(RecordingError::Corrupt { path, offset: header.data_offset, reason });
    }
    Ok(times.into_iter().zip(values).collect())
}
