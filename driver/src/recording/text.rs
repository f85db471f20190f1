//! Text recording of the vendor's SDK application (`-r NAME`): one code per line, divided by 4095 and with six
//! decimals, in the order receiver, chirp, sample. An empty line follows each chirp. `NAME_config.json` beside it holds
//! the waveform. The format holds no times, numbers, gaps, labels or truth.
//!
//! All values have the same width, so that frames are found by offset.

use std::ffi::OsString;
use std::fs::File;
use std::io::{BufReader, BufWriter, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use radome_dsp::{Frame, FrameSource, MAX_CODE, SourceError, SourceEvent, Waveform};

use super::input::open_file;
use super::mcap::RecordingHeader;
use super::partial::Partial;
use super::vendor_config::{read_waveform, write_waveform};
use super::{Existing, RecordingError, Tally, WriteReport, disk};

/// Characters of a value: `0.123456`.
const VALUE_BYTES: usize = 8;
/// Units of the last decimal in the value one.
const SCALE: u32 = 1_000_000;

/// `NAME_config.json`.
fn config_name(path: &Path) -> PathBuf {
    let mut name = OsString::from(path.file_name().unwrap_or_default());
    name.push("_config.json");
    path.with_file_name(name)
}

/// Finds the configuration of a text recording: `NAME_config.json`, or the same without NAME's extension.
pub fn config_path(path: &Path) -> Option<PathBuf> {
    [config_name(path), config_name(&path.with_extension(""))].into_iter().find(|path| path.is_file())
}

/// Returns whether a file that begins with `head` is a text recording. With `NAME_config.json` beside them, `NAME` and
/// `NAME.txt` are. `NAME` with another ending is one only if it begins with a value, because labels and pictures of a
/// recording have its name, too.
pub(super) fn is_recording(path: &Path, head: &[u8]) -> bool {
    let is_txt = path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("txt"));
    let begins_with_value = || line_end(head).is_some() && head.get(..VALUE_BYTES).and_then(parse_code).is_some();
    config_name(path).is_file() || (config_path(path).is_some() && (is_txt || begins_with_value()))
}

/// Number of characters that end a file's first line: 1, or 2 in a file from Windows. `None` if the line is not as long
/// as a value.
fn line_end(head: &[u8]) -> Option<usize> {
    match head.get(VALUE_BYTES..)? {
        [b'\r', b'\n', ..] => Some(2),
        [b'\n', ..] => Some(1),
        _ => None,
    }
}

/// Reader of the vendor's text recording, frame by frame.
#[derive(Debug)]
pub struct TextReader {
    path: PathBuf,
    file: BufReader<File>,
    length: u64,
    /// Characters of a line's end: 1, or 2 in a file from Windows.
    line_end: usize,
    waveform: Waveform,
    next: u64,
    bytes: Vec<u8>,
}

impl TextReader {
    /// Opens a text recording and the configuration beside it.
    ///
    /// # Errors
    /// [`RecordingError`] if a file is absent or cannot be read, if the configuration does not state a waveform, or if
    /// the text is not one of codes.
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        let config = config_path(path).ok_or_else(|| RecordingError::Missing { path: config_name(path) })?;
        let waveform = read_waveform(&config, None)?;
        let mut file = BufReader::new(open_file(path)?);
        let length = file.get_ref().metadata().map_err(RecordingError::cannot_read(path))?.len();
        let mut line = Vec::new();
        let prelude = VALUE_BYTES as u64 + 2;
        file.by_ref().take(prelude).read_to_end(&mut line).map_err(RecordingError::cannot_read(path))?;
        file.seek(SeekFrom::Start(0)).map_err(RecordingError::cannot_read(path))?;
        let line_end = match line_end(&line) {
            Some(characters) => characters,
            None if length == 0 => 1,
            None => {
                let reason = "the first line is no value with six decimals, such as 0.512332".into();
                return Err(RecordingError::Corrupt { path: path.to_owned(), offset: 0, reason });
            }
        };
        let path = path.to_owned();
        let mut reader = TextReader { path, file, length, line_end, waveform, next: 0, bytes: Vec::new() };
        reader.ignore_trailing_line_ends()?;
        Ok(reader)
    }

    /// Ignores line ends behind the last whole frame, which editors add. They cannot begin a frame, which begins with a value.
    fn ignore_trailing_line_ends(&mut self) -> Result<(), RecordingError> {
        let whole_bytes = self.whole_frames() * self.frame_bytes() as u64;
        self.file.seek(SeekFrom::Start(whole_bytes)).map_err(RecordingError::cannot_read(&self.path))?;
        let other = self.file.by_ref().bytes().find(|byte| !matches!(byte, Ok(b'\r' | b'\n'))).transpose();
        if other.map_err(RecordingError::cannot_read(&self.path))?.is_none() {
            self.length = whole_bytes;
        }
        self.file.seek(SeekFrom::Start(0)).map_err(RecordingError::cannot_read(&self.path))?;
        Ok(())
    }

    fn frame_bytes(&self) -> usize {
        let shape = self.waveform.shape();
        shape.codes() * (VALUE_BYTES + self.line_end) + shape.rx * shape.chirps * self.line_end
    }

    /// Returns whether the file ends behind a whole frame.
    pub fn is_complete(&self) -> bool {
        self.whole_frames() * self.frame_bytes() as u64 == self.length
    }

    /// Number of whole frames in the file.
    pub fn whole_frames(&self) -> u64 {
        self.length / self.frame_bytes().max(1) as u64
    }

    /// Seeks a frame by its number; the end for a number behind the last one.
    ///
    /// # Errors
    /// [`RecordingError::Io`].
    pub fn seek_frame(&mut self, sequence: u64) -> Result<(), RecordingError> {
        self.next = sequence.min(self.whole_frames());
        let offset = self.next * self.frame_bytes() as u64;
        self.file.seek(SeekFrom::Start(offset)).map_err(RecordingError::cannot_read(&self.path))?;
        Ok(())
    }

    fn read_next(&mut self, frame: &mut Frame) -> Result<SourceEvent, RecordingError> {
        let start = self.next * self.frame_bytes() as u64;
        if self.next >= self.whole_frames() {
            if self.length > start {
                return Err(RecordingError::Truncated {
                    path: self.path.clone(),
                    offset: self.length,
                    whole_frames: self.next,
                    expected_frames: self.next + 1,
                });
            }
            return Ok(SourceEvent::End);
        }
        // Allocated only after the file has confirmed the shape.
        self.bytes.resize(self.frame_bytes(), 0);
        self.file.read_exact(&mut self.bytes).map_err(RecordingError::cannot_read(&self.path))?;
        frame.shape = self.waveform.shape();
        self.parse_codes(start, &mut frame.codes)?;
        frame.sequence = self.next;
        frame.time_ns = self.waveform.frame_time_ns(self.next);
        frame.host_time_ns = 0;
        frame.truth = None;
        frame.temperature_millicelsius = None;
        self.next += 1;
        Ok(SourceEvent::Frame)
    }

    /// Parses the codes of the frame in `bytes`, which starts at this offset in the file.
    fn parse_codes(&self, start: u64, codes: &mut Vec<u16>) -> Result<(), RecordingError> {
        codes.clear();
        let expected_end: &[u8] = if self.line_end == 2 { b"\r\n" } else { b"\n" };
        let chirp_bytes = self.waveform.shape().samples * (VALUE_BYTES + self.line_end) + self.line_end;
        let corrupt = |offset: usize, reason: &str| RecordingError::Corrupt {
            path: self.path.clone(),
            offset: start + offset as u64,
            reason: reason.into(),
        };
        for (index, chirp) in self.bytes.chunks_exact(chirp_bytes.max(1)).enumerate() {
            let (values, blank) = chirp.split_at(chirp.len() - self.line_end);
            for (line, value) in values.chunks_exact(VALUE_BYTES + self.line_end).enumerate() {
                let (number, line_end) = value.split_at(VALUE_BYTES);
                let code = parse_code(number).filter(|_| line_end == expected_end).ok_or_else(|| {
                    let offset = index * chirp_bytes + line * value.len();
                    corrupt(offset, "expected a line such as 0.512332: a code of 0 to 4095, divided by 4095")
                })?;
                codes.push(code);
            }
            if blank != expected_end {
                return Err(corrupt(index * chirp_bytes + values.len(), "expected an empty line after each chirp"));
            }
        }
        Ok(())
    }
}

impl FrameSource for TextReader {
    fn waveform(&self) -> &Waveform {
        &self.waveform
    }

    fn next_frame(&mut self, frame: &mut Frame) -> Result<SourceEvent, SourceError> {
        Ok(self.read_next(frame)?)
    }

    fn frame_count(&self) -> Option<u64> {
        Some(self.whole_frames())
    }
}

/// Converts a code to millionths of full scale, rounded.
fn millionths(code: u16) -> u32 {
    (u32::from(code) * SCALE + u32::from(MAX_CODE) / 2) / u32::from(MAX_CODE)
}

/// Parses the code of a value. Single precision may have rounded the last decimal either way.
fn parse_code(text: &[u8]) -> Option<u16> {
    let [whole @ b'0'..=b'1', b'.', decimals @ ..] = text else { return None };
    if decimals.len() != 6 || !decimals.iter().all(u8::is_ascii_digit) {
        return None;
    }
    let value = decimals.iter().fold(u32::from(whole - b'0'), |n, d| 10 * n + u32::from(d - b'0'));
    let code = (u64::from(value) * u64::from(MAX_CODE) + u64::from(SCALE / 2)) / u64::from(SCALE);
    let code = u16::try_from(code).ok()?;
    (code <= MAX_CODE && millionths(code).abs_diff(value) <= 1).then_some(code)
}

/// Writer of the vendor's text recording. The file appears under its name when [`TextWriter::finish`] has completed it,
/// and not at all otherwise.
#[derive(Debug)]
pub(super) struct TextWriter {
    partial: Partial,
    partial_config: Partial,
    file: BufWriter<File>,
    path: PathBuf,
    header: RecordingHeader,
    /// Text line of every code, by code.
    lines: Vec<[u8; VALUE_BYTES + 1]>,
    /// Counts of the frames, and of the items that the format cannot hold.
    pub tally: Tally,
    has_times: bool,
    has_temperatures: bool,
}

impl TextWriter {
    /// Starts a text file and its configuration.
    ///
    /// # Errors
    /// [`RecordingError::Occupied`] if one of them exists and must not be replaced, [`RecordingError::Locked`] if one
    /// has another writer, and [`RecordingError::Io`].
    pub fn create(path: &Path, header: &RecordingHeader, existing: Existing) -> Result<Self, RecordingError> {
        let partial = Partial::file(path, existing)?;
        let partial_config = Partial::file(&config_name(path), existing)?;
        let file = partial.open()?;
        write_waveform(&header.waveform, partial_config.path())?;
        let line = |code| {
            let mut line = *b"0.000000\n";
            let mut rest = millionths(code);
            for digit in [7, 6, 5, 4, 3, 2, 0] {
                line[digit] = b'0' + (rest % 10) as u8;
                rest /= 10;
            }
            line
        };
        Ok(TextWriter {
            partial,
            partial_config,
            file: BufWriter::new(file),
            path: path.to_owned(),
            header: header.clone(),
            lines: (0..=MAX_CODE).map(line).collect(),
            tally: Tally::default(),
            has_times: false,
            has_temperatures: false,
        })
    }

    /// Adds a frame.
    ///
    /// # Errors
    /// [`RecordingError::FrameShape`] or [`RecordingError::Code`] for a frame that does not fit;
    /// [`RecordingError::Io`].
    pub fn frame(&mut self, frame: &Frame) -> Result<(), RecordingError> {
        let shift_ns = frame.time_ns.abs_diff(self.header.waveform.frame_time_ns(self.tally.report.frames));
        self.tally.count_frame(&self.path, self.header.waveform.shape(), frame)?;
        self.tally.report.time_shift_ns = self.tally.report.time_shift_ns.max(shift_ns);
        self.has_times |= frame.host_time_ns > 0 || shift_ns > 0;
        self.has_temperatures |= frame.temperature_millicelsius.is_some();
        for chirp in frame.codes.chunks(frame.shape.samples.max(1)) {
            for line in chirp.iter().filter_map(|code| self.lines.get(usize::from(*code))) {
                self.file.write_all(line).map_err(RecordingError::cannot_write(&self.path))?;
            }
            self.file.write_all(b"\n").map_err(RecordingError::cannot_write(&self.path))?;
        }
        Ok(())
    }

    /// Completes the file and its configuration and gives them their names.
    ///
    /// # Errors
    /// [`RecordingError::Io`], or [`RecordingError::Occupied`] if something has taken a name meanwhile.
    pub fn finish(mut self) -> Result<WriteReport, RecordingError> {
        let cannot = || RecordingError::cannot_write(&self.path);
        self.file.flush().and_then(|()| disk::sync(self.file.get_ref(), self.partial.path())).map_err(cannot())?;
        let bytes = self.file.get_ref().metadata().map_err(cannot())?.len();
        let mut omitted = self.tally.omitted(&self.header.waveform);
        if self.has_times {
            omitted.push("the times of the frames".into());
        }
        if self.has_temperatures {
            omitted.push("temperatures".into());
        }
        if !self.header.registers.is_empty() {
            omitted.push(format!("{} registers of the chip", self.header.registers.len()));
        }
        // The samples get their name last: without them there is no recording.
        self.partial_config.finish()?;
        self.partial.finish()?;
        Ok(WriteReport { bytes, omitted, ..self.tally.report })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Compares with the formula, in f64 and in the single precision of a C program.
    #[test]
    fn every_code_round_trips_in_six_decimals() {
        for code in 0..=MAX_CODE {
            for value in [f64::from(code) / 4095.0, f64::from(f32::from(code) / 4095.0)] {
                assert_eq!(parse_code(format!("{value:.6}").as_bytes()), Some(code));
            }
            assert_eq!(
                format!("{:.6}", f64::from(code) / 4095.0),
                format!("0.{:06}", millionths(code)).replace("0.1000000", "1.000000")
            );
        }
        for wrong in ["0.000100", "1.000244", "2.000000", "0.00000x", "-0.00000", "0,512345"] {
            assert_eq!(parse_code(wrong.as_bytes()), None, "{wrong}");
        }
    }

    mod hard_cases {
        use super::*;
        use crate::pattern::waveform;

        /// Regression test: a line end that an editor had added made a whole recording a cut one.
        #[test]
        fn line_ends_behind_the_last_frame_are_ignored() {
            let folder = tempfile::tempdir().expect("folder");
            let path = folder.path().join("a.txt");
            let header = RecordingHeader::new(waveform(&[1], 8, 64, 0.1));
            let mut writer = TextWriter::create(&path, &header, Existing::Refuse).expect("creates");
            let mut frame = Frame::zeroed(header.waveform.shape());
            writer.frame(&frame).expect("writes");
            writer.finish().expect("finishes");
            let whole = std::fs::read(&path).expect("reads");
            for (added, is_whole) in [("", true), ("\n", true), ("\r\n\n", true), ("0", false), ("\n0", false)] {
                std::fs::write(&path, [whole.as_slice(), added.as_bytes()].concat()).expect("writes");
                let mut reader = TextReader::open(&path).expect("opens");
                assert_eq!((reader.is_complete(), reader.frame_count()), (is_whole, Some(1)), "{added:?}");
                assert!(matches!(reader.read_next(&mut frame), Ok(SourceEvent::Frame)), "{added:?}");
                assert_eq!(reader.read_next(&mut frame).is_ok(), is_whole, "{added:?}");
            }
        }
    }
}
