//! Writer of the vendor's folder.

use std::fs::File;
use std::io::{BufWriter, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use radome_dsp::Frame;
use serde_json::json;

use super::{
    CONFIG, DATA, FIRST_UNIX_NS, META, RADAR, SUPPORTED_VERSION, TEMPERATURE_TIMES, TEMPERATURES, TIMES, VERSION,
    frame_time_ns,
};
use crate::recording::mcap::RecordingHeader;
use crate::recording::partial::Partial;
use crate::recording::vendor_config::{write_json, write_waveform};
use crate::recording::{RecordingError, Tally, WriteReport, disk, utc};

/// Length of the vendor's headers, bytes: any number of frames fits, so that the header can be filled in last.
const HEADER_BYTES: usize = 1024;

/// Difference between the steps of the board's and the host's clock above which the host's was set between two frames, ns.
/// Clocks drift apart by less, and frames are not held up for so long.
const CLOCK_SET_NS: u64 = 10_000_000_000;

/// Times of a frame.
#[derive(Debug, Clone, Copy)]
struct FrameTime {
    board_ns: u64,
    host_ns: u64,
}

/// Temperature of a frame.
#[derive(Debug, Clone, Copy)]
struct FrameTemperature {
    /// Index of the frame.
    frame: usize,
    /// Thousandths of a degree Celsius.
    millicelsius: i32,
}

/// Header of an NPY file, padded as the vendor pads it.
fn npy_header(descr: &str, shape: &str) -> Vec<u8> {
    let text = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}");
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((HEADER_BYTES as u16 - 10).to_le_bytes());
    bytes.extend(text.as_bytes());
    bytes.resize(HEADER_BYTES - 1, b' ');
    bytes.push(b'\n');
    bytes
}

/// Writer of a session's folder with one radar. The folder appears under its name when [`InfineonWriter::finish`] has
/// completed it, and not at all otherwise.
///
/// The format holds codes, times and temperatures. The times are the board's. They begin at the host's time of the first frame,
/// if all frames have the host's time and that clock was not set meanwhile.
/// The numbers of frames do not include gaps, and the format holds neither labels nor truth.
#[derive(Debug)]
pub(in crate::recording) struct InfineonWriter {
    partial: Partial,
    folder: PathBuf,
    data: PathBuf,
    file: BufWriter<File>,
    header: RecordingHeader,
    bytes: Vec<u8>,
    /// Times of each frame.
    times: Vec<FrameTime>,
    /// Temperatures, where they changed.
    temperatures: Vec<FrameTemperature>,
    /// Number of frames without a temperature behind the first one that has it.
    without_temperature: u64,
    /// Counts of the frames, and of the items that the format cannot hold.
    pub tally: Tally,
}

impl InfineonWriter {
    /// Starts a folder. One that exists must be empty.
    ///
    /// # Errors
    /// [`RecordingError::Occupied`] if a file or a folder with content has the name, [`RecordingError::Locked`] if another writer
    /// has it;
    /// [`RecordingError::Io`].
    pub fn create(path: &Path, header: &RecordingHeader) -> Result<Self, RecordingError> {
        if path.exists() && !std::fs::read_dir(path).is_ok_and(|mut entries| entries.next().is_none()) {
            return Err(RecordingError::Occupied { path: path.to_owned() });
        }
        let partial = Partial::folder(path)?;
        let folder = partial.path().join(format!("{RADAR}00"));
        std::fs::create_dir(&folder).map_err(RecordingError::cannot_write(path))?;
        let data = folder.join(DATA);
        let mut file = BufWriter::new(File::create(&data).map_err(RecordingError::cannot_write(&data))?);
        file.write_all(&[0; HEADER_BYTES]).map_err(RecordingError::cannot_write(&data))?;
        Ok(InfineonWriter {
            partial,
            folder,
            data,
            file,
            header: header.clone(),
            bytes: Vec::new(),
            times: Vec::new(),
            temperatures: Vec::new(),
            without_temperature: 0,
            tally: Tally::default(),
        })
    }

    /// Adds a frame.
    ///
    /// # Errors
    /// [`RecordingError::FrameShape`] or [`RecordingError::Code`] for a frame that does not fit;
    /// [`RecordingError::Io`].
    pub fn frame(&mut self, frame: &Frame) -> Result<(), RecordingError> {
        self.tally.count_frame(&self.data, self.header.waveform.shape(), frame)?;
        self.bytes.clear();
        self.bytes.extend(frame.codes.iter().flat_map(|code| code.to_le_bytes()));
        self.file.write_all(&self.bytes).map_err(RecordingError::cannot_write(&self.data))?;
        if let Some(now) = frame.temperature_millicelsius
            && self.temperatures.last().is_none_or(|last| last.millicelsius != now)
        {
            self.temperatures.push(FrameTemperature { frame: self.times.len(), millicelsius: now });
        }
        let has_none = frame.temperature_millicelsius.is_none();
        self.without_temperature += u64::from(has_none && !self.temperatures.is_empty());
        self.times.push(FrameTime { board_ns: frame.time_ns, host_ns: frame.host_time_ns });
        Ok(())
    }

    /// Completes the folder and gives it its name.
    ///
    /// # Errors
    /// [`RecordingError::Io`], or [`RecordingError::Occupied`] if something has taken the name meanwhile.
    pub fn finish(mut self) -> Result<WriteReport, RecordingError> {
        let frames = self.times.len();
        let shape = self.header.waveform.shape();
        let shape_text = format!("({frames}, {}, {}, {})", shape.rx, shape.chirps, shape.samples);
        let cannot = || RecordingError::cannot_write(&self.data);
        self.file.seek(SeekFrom::Start(0)).map_err(cannot())?;
        self.file.write_all(&npy_header("<u2", &shape_text)).map_err(cannot())?;
        self.file.flush().and_then(|()| disk::sync(self.file.get_ref(), &self.data)).map_err(cannot())?;
        let bytes = self.file.get_ref().metadata().map_err(cannot())?.len();

        let mut omitted = self.tally.omitted(&self.header.waveform);
        let stamps_ns = self.time_stamps(&mut omitted);
        self.tally.report.time_shift_ns = self.time_shift_ns(stamps_ns.as_deref());
        if let Some(stamps_ns) = &stamps_ns {
            self.write_file(TIMES, seconds(stamps_ns.iter().copied()).as_bytes())?;
            self.write_temperatures(stamps_ns)?;
            if self.without_temperature > 0 {
                let frames = self.without_temperature;
                omitted.push(format!("frames without a temperature: {frames} (readers take the last one before)"));
            }
        } else if !self.temperatures.is_empty() {
            omitted.push("temperatures, for want of times".into());
        }
        if !self.header.registers.is_empty() {
            omitted.push(format!("{} registers of the chip", self.header.registers.len()));
        }
        self.write_descriptions()?;
        disk::sync_folder(&self.data).map_err(cannot())?;
        self.partial.finish()?;
        Ok(WriteReport { bytes, omitted, ..self.tally.report })
    }

    /// Times to write; `None` if they equal those of the frame interval, or go backwards.
    fn time_stamps(&self, omitted: &mut Vec<String>) -> Option<Vec<u64>> {
        let board: Vec<u64> = self.times.iter().map(|time| time.board_ns).collect();
        let host: Vec<u64> = self.times.iter().map(|time| time.host_ns).collect();
        let has_host = host.iter().any(|t| *t > 0);
        if has_host && host.iter().all(|t| *t >= FIRST_UNIX_NS) && host.is_sorted() && !self.was_host_clock_set() {
            if !board.is_sorted() {
                omitted.push("times by the board's clock, which go backwards (the host's are kept)".into());
                return Some(host);
            }
            // The host's times give the date, but not the intervals: frames wait before the host takes them, and an emulated board
            // may send them faster than they were measured.
            let (first, start) = self.times.first().map_or((0, 0), |time| (time.host_ns, time.board_ns));
            if start > 0 {
                omitted.push(format!("the time of the first frame, {} s (readers count from 0 s)", start as f64 / 1e9));
            }
            let dated_times: Vec<u64> = board.iter().map(|time| first.saturating_add(time - start)).collect();
            if dated_times != host {
                omitted.push(
                    "times by the host's clock, except that of the first frame (intervals are the board's)".into(),
                );
            }
            return Some(dated_times);
        }
        if has_host {
            omitted.push("times by the host's clock, absent from some frames or set while they were taken".into());
        }
        if !board.is_sorted() || board.iter().any(|t| *t >= FIRST_UNIX_NS) {
            omitted.push("times by the board's clock, which go backwards".into());
            return None;
        }
        let nominal = |(index, time): (usize, &u64)| self.header.waveform.frame_time_ns(index as u64) == *time;
        (!self.temperatures.is_empty() || !board.iter().enumerate().all(nominal)).then_some(board)
    }

    /// Greatest difference between a frame's time by the board's clock and the one that readers find, ns.
    fn time_shift_ns(&self, stamps_ns: Option<&[u64]>) -> u64 {
        let read = |index| frame_time_ns(stamps_ns, &self.header.waveform, index);
        (0..).zip(&self.times).map(|(index, time)| time.board_ns.abs_diff(read(index))).max().unwrap_or(0)
    }

    /// Returns whether the host's clock has jumped against the board's, such as when a computer without a battery for its clock
    /// gets the time from the network.
    fn was_host_clock_set(&self) -> bool {
        self.times.windows(2).any(|pair| {
            let [time, next] = pair else { return false };
            next.host_ns.abs_diff(time.host_ns).abs_diff(next.board_ns.abs_diff(time.board_ns)) > CLOCK_SET_NS
        })
    }

    fn write_temperatures(&self, stamps_ns: &[u64]) -> Result<(), RecordingError> {
        if self.temperatures.is_empty() {
            return Ok(());
        }
        let mut bytes = npy_header("<f8", &format!("({},)", self.temperatures.len()));
        bytes.extend(self.temperatures.iter().flat_map(|entry| (f64::from(entry.millicelsius) / 1e3).to_le_bytes()));
        self.write_file(TEMPERATURES, &bytes)?;
        let times = self.temperatures.iter().filter_map(|entry| stamps_ns.get(entry.frame).copied());
        self.write_file(TEMPERATURE_TIMES, seconds(times).as_bytes())
    }

    fn write_descriptions(&self) -> Result<(), RecordingError> {
        let board = self.header.board.as_ref();
        write_waveform(&self.header.waveform, &self.folder.join(CONFIG))?;
        write_json(
            &self.folder.join(META),
            &json!({
                "adc_resolution": 12,
                "description": "BGT60TR13C FMCW Radar Sensor",
                "firmware_version": board.map_or("", |b| b.firmware_version.as_str()),
                "sdk_version": concat!("radome ", env!("CARGO_PKG_VERSION")),
                "uuid": board.map_or("0", |b| b.uuid.as_str()),
            }),
        )?;
        let capture_s = self.times.first().filter(|time| time.host_ns > 0).map(|time| time.host_ns / 1_000_000_000);
        // The folder does not depend on the machine: the same recording gives the same folder.
        write_json(
            &self.partial.path().join(META),
            &json!({
                "date_captured": capture_s.map(utc::iso_8601),
                "hostname": "unknown",
                "ifxdaq_version": "1.0.0",
                "machine": "",
                "os": "",
                "os_version": "",
                "username": "",
            }),
        )?;
        // Written last: without this file the folder is not read.
        self.write_file(VERSION, format!("{SUPPORTED_VERSION}\n").as_bytes())
    }

    /// Writes a small file of the radar's folder.
    fn write_file(&self, name: &str, bytes: &[u8]) -> Result<(), RecordingError> {
        let path = self.folder.join(name);
        disk::write_file(&path, bytes).map_err(RecordingError::cannot_write(&path))
    }
}

/// One time in seconds per line.
fn seconds(times_ns: impl Iterator<Item = u64>) -> String {
    times_ns.map(|time| format!("{}.{:09}\n", time / 1_000_000_000, time % 1_000_000_000)).collect()
}
