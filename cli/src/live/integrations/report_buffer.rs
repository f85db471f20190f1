//! Buffer of the last frames, which is saved as training data when a user reports a wrong answer.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use anyhow::{Context, ensure};
use crossbeam::channel::{Receiver, RecvTimeoutError, Sender, bounded};
use radome_driver::protocol::packed12;
use radome_driver::recording::{Format, RecordingWriter};
use radome_driver::{FrameResult, LabelSpan, RecordingHeader};
use radome_dsp::{Frame, Gap, Occupancy};

use super::latest::{Latest, count};
use crate::exit::wrong_use;
use crate::live::health::Health;
use crate::live::recorder::{FINAL_STALL_LIMIT, frame_result};
use crate::live::sink::{ClassifiedFrame, Sink};
use crate::panics::{Panicked, lock};

/// Options of the buffer.
#[derive(clap::Args, Default)]
pub struct Arguments {
    /// Keep the last frames, and save them in this folder when somebody reports a wrong answer: with a button in Home
    /// Assistant, with POST to /report/empty, one or two on the metrics' address, or with SIGUSR1 (empty)
    #[arg(long, value_name = "DIR")]
    keep_to: Option<PathBuf>,
    /// With --keep-to: seconds of the past to keep
    #[arg(long, value_name = "SECONDS", default_value_t = 60.0, requires = "keep_to", value_parser = parse_span_s)]
    keep_last_s: f64,
    /// With --keep-to: memory for these frames; older frames are dropped
    #[arg(long, value_name = "MIB", default_value_t = 256, requires = "keep_to", value_parser = clap::value_parser!(u64).range(1..))]
    keep_memory_mib: u64,
    /// With --keep-to: size of the folder above which reports are refused
    #[arg(long, value_name = "MIB", default_value_t = 4096, requires = "keep_to")]
    keep_disk_mib: u64,
}

/// Parses the seconds of the past to keep.
fn parse_span_s(text: &str) -> Result<f64, &'static str> {
    let span_s = text.parse::<f64>().ok().filter(|span_s| *span_s > 0.0 && *span_s <= 86_400.0);
    span_s.ok_or("expected seconds, above 0 and up to a day")
}

impl Arguments {
    pub fn is_wanted(&self) -> bool {
        self.keep_to.is_some()
    }
}

/// Report of the correct class by a user.
#[derive(Debug, Clone, Copy)]
pub struct Report {
    pub truth: Occupancy,
    /// Channel through which it came.
    pub channel: &'static str,
}

/// Least time between two reports that are both accepted.
const LEAST_INTERVAL: Duration = Duration::from_secs(5);

/// Sender of reports to the saving thread.
#[derive(Clone)]
pub struct ReportSender {
    sender: Sender<Report>,
    latest: Arc<Latest>,
}

impl ReportSender {
    /// Sends a report; `false` if earlier ones still wait. It is then counted as refused.
    pub fn send(&self, report: Report) -> bool {
        let is_sent = self.sender.try_send(report).is_ok();
        if !is_sent {
            count(&self.latest.counters.reports_refused);
        }
        is_sent
    }
}

/// Frame with its codes packed as the chip packs them: two codes in three bytes.
struct BufferedFrame {
    packed: Vec<u8>,
    /// Frame without the codes.
    head: Frame,
    result: FrameResult,
    /// Whether the number of people was known.
    is_settled: bool,
}

impl BufferedFrame {
    /// Packs a frame into `packed`, which may hold an older one.
    fn new(mut packed: Vec<u8>, classified: &ClassifiedFrame) -> Self {
        packed.clear();
        packed12::pack(&classified.frame.codes, &mut packed);
        BufferedFrame {
            packed,
            head: frame_head(classified.frame),
            result: frame_result(classified),
            is_settled: classified.answer.is_settled,
        }
    }

    fn bytes(&self) -> usize {
        self.packed.capacity() + size_of::<BufferedFrame>()
    }
}

/// Copies a frame without its codes.
fn frame_head(frame: &Frame) -> Frame {
    let Frame { sequence, time_ns, host_time_ns, shape, truth, temperature_millicelsius, .. } = *frame;
    Frame { sequence, time_ns, host_time_ns, shape, truth, temperature_millicelsius, codes: Vec::new() }
}

#[derive(Clone)]
enum Entry {
    Frame(Arc<BufferedFrame>),
    Gap(Gap),
}

/// Ring buffer of recent frames, limited by time and memory.
struct Ring {
    entries: VecDeque<Entry>,
    bytes: usize,
    span_ns: u64,
    most_bytes: usize,
    newest_ns: u64,
}

impl Ring {
    /// Removes entries beyond the limits; returns the memory of one frame for reuse.
    fn remove_old(&mut self) -> Option<Vec<u8>> {
        let mut spare = None;
        while let Some(first) = self.entries.front() {
            let is_old = match first {
                Entry::Gap(_) => self.entries.len() == 1,
                Entry::Frame(buffered) => {
                    self.newest_ns.saturating_sub(buffered.head.time_ns) > self.span_ns || self.bytes > self.most_bytes
                }
            };
            // A gap at the front precedes all kept frames.
            if !is_old && matches!(first, Entry::Frame(_)) {
                break;
            }
            if let Some(Entry::Frame(buffered)) = self.entries.pop_front() {
                self.bytes -= buffered.bytes();
                // The memory is not reused while the frame is being saved.
                spare = Arc::into_inner(buffered).map(|buffered| buffered.packed).or(spare);
            }
        }
        spare
    }
}

/// Sink that keeps frames as they are classified.
pub struct BufferSink {
    ring: Arc<Mutex<Ring>>,
    /// Memory for the next frame.
    spare: Vec<u8>,
}

/// Saving thread. Dropping it waits for the report that is being saved, unless the disk hangs.
pub struct SavingThread {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl BufferSink {
    /// Creates the sink, the sender of reports and the saving thread; `None` if nothing is to be kept.
    ///
    /// # Errors
    /// The folder cannot be written, or the memory holds no frame.
    pub fn open(
        arguments: &Arguments,
        header: &RecordingHeader,
        latest: Arc<Latest>,
    ) -> anyhow::Result<Option<(Self, ReportSender, SavingThread)>> {
        let Some(folder) = &arguments.keep_to else { return Ok(None) };
        let span_s = arguments.keep_last_s;
        let most_bytes = usize::try_from(arguments.keep_memory_mib.saturating_mul(1 << 20)).unwrap_or(usize::MAX);
        let frame_bytes = packed12::packed_length(header.waveform.shape().codes()) + size_of::<BufferedFrame>();
        if most_bytes < frame_bytes {
            wrong_use!(
                "--keep-memory-mib {}: one frame takes {} MiB, and nothing would be kept\n\nhint: name the memory for all of the last \
                 {span_s:.0} s",
                arguments.keep_memory_mib,
                frame_bytes.div_ceil(1 << 20)
            );
        }
        let hint = "hint: --keep-to a folder that this user may write";
        std::fs::create_dir_all(folder)
            .with_context(|| format!("cannot make the folder {}\n\n{hint}", folder.display()))?;
        // Reports may come after days. A folder that cannot be written is told of now.
        tempfile::tempfile_in(folder)
            .with_context(|| format!("cannot write in the folder {}\n\n{hint}", folder.display()))?;
        let fits_s = (most_bytes / frame_bytes) as f64 * header.waveform.frame_interval_s();
        if fits_s < span_s {
            message!("of the last {span_s:.0} s only {fits_s:.0} s are kept: --keep-memory-mib allows no more");
        }
        let ring =
            Ring { entries: VecDeque::new(), bytes: 0, span_ns: (span_s * 1e9) as u64, most_bytes, newest_ns: 0 };
        let ring = Arc::new(Mutex::new(ring));
        let (sender, receiver) = bounded(2);
        let saver = ReportSaver {
            ring: ring.clone(),
            folder: folder.clone(),
            most_disk_bytes: arguments.keep_disk_mib.saturating_mul(1 << 20),
            header: header.clone(),
            latest: latest.clone(),
        };
        let stop = Arc::new(AtomicBool::new(false));
        let stop_flag = stop.clone();
        let thread = std::thread::spawn(move || saver.run(&receiver, &stop_flag));
        let (sink, saving_thread) =
            (BufferSink { ring, spare: Vec::new() }, SavingThread { stop, thread: Some(thread) });
        Ok(Some((sink, ReportSender { sender, latest }, saving_thread)))
    }
}

impl Drop for SavingThread {
    fn drop(&mut self) {
        // The flag stops the thread even if a hanging task still holds a sender.
        self.stop.store(true, Ordering::Relaxed);
        let Some(thread) = self.thread.take() else { return };
        let since = Instant::now();
        while !thread.is_finished() {
            if since.elapsed() > FINAL_STALL_LIMIT {
                let waited_s = FINAL_STALL_LIMIT.as_secs();
                tracing::error!("a report may be lost: the disk has not stored it for {waited_s} s");
                return;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        if let Err(payload) = thread.join() {
            tracing::error!("reports are no longer saved: {}", Panicked::new(payload.as_ref()));
        }
    }
}

impl Sink for BufferSink {
    fn answer(&mut self, classified: &ClassifiedFrame) -> anyhow::Result<()> {
        let buffered = BufferedFrame::new(std::mem::take(&mut self.spare), classified);
        let mut ring = lock(&self.ring);
        // A restarted clock makes earlier entries unrelated.
        if classified.frame.time_ns < ring.newest_ns {
            ring.entries.clear();
            ring.bytes = 0;
        }
        ring.newest_ns = classified.frame.time_ns;
        ring.bytes += buffered.bytes();
        ring.entries.push_back(Entry::Frame(Arc::new(buffered)));
        self.spare = ring.remove_old().unwrap_or_default();
        Ok(())
    }

    fn gap(&mut self, gap: &Gap, _health: &Health) -> anyhow::Result<()> {
        let mut ring = lock(&self.ring);
        if !ring.entries.is_empty() {
            ring.entries.push_back(Entry::Gap(*gap));
        }
        Ok(())
    }
}

/// Inputs of the saving thread.
struct ReportSaver {
    ring: Arc<Mutex<Ring>>,
    folder: PathBuf,
    most_disk_bytes: u64,
    header: RecordingHeader,
    latest: Arc<Latest>,
}

impl ReportSaver {
    fn run(&self, reports: &Receiver<Report>, stop: &AtomicBool) {
        let mut last: Option<Instant> = None;
        loop {
            let report = match reports.recv_timeout(Duration::from_millis(100)) {
                Ok(report) => report,
                Err(RecvTimeoutError::Timeout) if !stop.load(Ordering::Relaxed) => continue,
                Err(_) => return,
            };
            if last.is_some_and(|last| last.elapsed() < LEAST_INTERVAL) {
                tracing::warn!("a report ({}) within five seconds of another is ignored", report.channel);
                count(&self.latest.counters.reports_refused);
                continue;
            }
            match self.save(report) {
                Ok(path) => {
                    last = Some(Instant::now());
                    count(&self.latest.counters.reports_kept);
                    message!(
                        "report by {}: it was {}; kept as {}",
                        report.channel,
                        report.truth.name(),
                        path.display()
                    );
                }
                Err(error) => {
                    count(&self.latest.counters.reports_refused);
                    tracing::error!("a report is lost: {}", crate::output::chain(&error));
                }
            }
        }
    }

    /// Writes the buffer as a recording, atomically.
    fn save(&self, report: Report) -> anyhow::Result<PathBuf> {
        // Cloning the list of references holds the lock only briefly, so the classifier's thread hardly waits.
        let entries = lock(&self.ring).entries.clone();
        let entries: Vec<Entry> = entries.into();
        let buffered = entries.iter().filter_map(|entry| match entry {
            Entry::Frame(buffered) => Some((buffered.result, buffered.is_settled)),
            Entry::Gap(_) => None,
        });
        let (results, is_settled): (Vec<FrameResult>, Vec<bool>) = buffered.unzip();
        ensure!(!results.is_empty(), "no frame has come yet");
        let used_bytes = folder_bytes(&self.folder)?;
        ensure!(
            used_bytes < self.most_disk_bytes,
            "{} holds {} MiB already\n\nhint: look at the reports and remove them, or raise --keep-disk-mib",
            self.folder.display(),
            used_bytes >> 20
        );
        let now_ns = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |now| now.as_nanos() as u64);
        let path = free_name(&self.folder, now_ns / 1_000_000_000, report.truth);
        let mut writer = RecordingWriter::create(&path, Format::Mcap, &self.header)?;
        let mut frame = Frame::zeroed(self.header.waveform.shape());
        for entry in &entries {
            match entry {
                Entry::Gap(gap) => writer.gap(gap)?,
                Entry::Frame(buffered) => {
                    let codes = std::mem::take(&mut frame.codes);
                    frame = Frame { codes, ..frame_head(&buffered.head) };
                    packed12::unpack(&buffered.packed, &mut frame.codes);
                    writer.frame(&frame)?;
                }
            }
        }
        results.iter().try_for_each(|result| writer.result(result))?;
        let (start_s, end_s) =
            disputed_interval_s(&results, &is_settled, report.truth, self.header.waveform.frame_interval_s());
        writer.label(&LabelSpan {
            who: Some(format!("report by {}", report.channel)),
            made_ns: Some(now_ns),
            note: Some("from when the answer became another until the report; look at it before training".into()),
            ..LabelSpan::new(start_s, end_s, report.truth.name())
        })?;
        writer.finish()?;
        Ok(path)
    }
}

/// Free file name `report-SECONDS-CLASS.mcap`, with a number from 2 on behind the class if it exists.
fn free_name(folder: &Path, now_s: u64, truth: Occupancy) -> PathBuf {
    let name = |number: &str| folder.join(format!("report-{now_s}-{}{number}.mcap", truth.name()));
    let numbered = (2..).map(|number: u64| name(&format!("-{number}")));
    std::iter::once(name("")).chain(numbered).find(|path| !path.exists()).unwrap_or_else(|| name(""))
}

/// Interval from the first of the last wrong answers until the end, s. If no answer before them was right, it starts at the last
/// change among them. Without a wrong answer or a change, it is the whole buffer. Answers up to the last one that was not
/// settled are ignored, since an outage may lie between.
fn disputed_interval_s(results: &[FrameResult], is_settled: &[bool], truth: Occupancy, interval_s: f64) -> (f64, f64) {
    let first_settled = is_settled.iter().rposition(|is_settled| !is_settled).map_or(0, |last| last + 1);
    let results = results.get(first_settled..).filter(|settled| !settled.is_empty()).unwrap_or(results);
    let is_wrong = |result: &&FrameResult| usize::from(result.people) != truth.index();
    let last_wrong = results.iter().rposition(|result| is_wrong(&result));
    let start = last_wrong.map_or(0, |last| {
        let last_right = results.iter().take(last).rposition(|result| !is_wrong(&result));
        let until_then = results.get(..=last).unwrap_or(results);
        let last_change = || until_then.windows(2).rposition(|pair| pair[0].people != pair[1].people);
        last_right.or_else(last_change).map_or(0, |before| before + 1)
    });
    let time_s = |result: Option<&FrameResult>| result.map_or(0.0, FrameResult::time_s);
    (time_s(results.get(start)), time_s(results.last()) + interval_s)
}

fn folder_bytes(folder: &Path) -> anyhow::Result<u64> {
    let files = std::fs::read_dir(folder).with_context(|| format!("cannot read {}", folder.display()))?;
    Ok(files.filter_map(|file| file.ok()?.metadata().ok()).map(|metadata| metadata.len()).sum())
}

#[cfg(test)]
mod tests {
    use radome_dsp::{Waveform, WaveformRequest};

    use super::*;
    use crate::exit::WrongUse;

    #[test]
    fn memory_that_holds_no_frame_is_wrong_use() {
        let waveform = Waveform::realise(WaveformRequest::paper()).expect("a valid waveform");
        let folder = tempfile::tempdir().expect("a folder");
        let keep_to = Some(folder.path().join("reports"));
        let arguments = Arguments { keep_to, keep_last_s: 60.0, keep_memory_mib: 0, ..Arguments::default() };
        let latest = Latest::new(Instant::now(), Duration::from_secs(1));
        let opened = BufferSink::open(&arguments, &RecordingHeader::new(waveform), latest);
        assert!(opened.is_err_and(|error| error.is::<WrongUse>()));
        assert!(!folder.path().join("reports").exists(), "refused before anything is made");
    }

    #[test]
    fn a_report_that_the_queue_cannot_take_is_counted() {
        let latest = Latest::new(Instant::now(), Duration::from_secs(1));
        let (sender, _receiver) = bounded(1);
        let reports = ReportSender { sender, latest: latest.clone() };
        let sent = [(); 2].map(|()| reports.send(Report { truth: Occupancy::Empty, channel: "signal" }));
        assert_eq!((sent, latest.counters.reports_refused.load(Ordering::Relaxed)), ([true, false], 1));
    }

    /// Regression test: where a name was taken, the seconds in the next name were those of a later time.
    #[test]
    fn a_name_that_is_taken_gets_a_number_and_keeps_its_time() {
        let folder = tempfile::tempdir().expect("a folder");
        for expected in ["report-1700-one.mcap", "report-1700-one-2.mcap", "report-1700-one-3.mcap"] {
            let path = free_name(folder.path(), 1700, Occupancy::One);
            assert_eq!(path, folder.path().join(expected));
            std::fs::write(path, "").expect("writes");
        }
    }

    fn results(people: &[u8]) -> Vec<FrameResult> {
        let result = |(i, people): (usize, &u8)| FrameResult {
            sequence: i as u64,
            time_ns: i as u64 * 100_000_000,
            occupied: *people > 0,
            people: *people,
            ..FrameResult::default()
        };
        people.iter().enumerate().map(result).collect()
    }

    #[test]
    fn the_disputed_interval_starts_where_the_answer_became_wrong() {
        let span = |people: &[u8], truth| disputed_interval_s(&results(people), &vec![true; people.len()], truth, 0.1);
        let close = |(a, b): (f64, f64), (c, d): (f64, f64)| (a - c).abs() < 1e-9 && (b - d).abs() < 1e-9;
        assert!(close(span(&[0, 0, 1, 1, 2], Occupancy::Empty), (0.2, 0.5)));
        // The answer became right again before the user reported.
        assert!(close(span(&[0, 1, 1, 0, 0], Occupancy::Empty), (0.1, 0.5)));
        // The earlier answer was rightly occupied.
        assert!(close(span(&[1, 0, 1, 1], Occupancy::Empty), (0.2, 0.4)));
        assert!(close(span(&[1, 1, 0, 0], Occupancy::One), (0.2, 0.4)));
        assert!(close(span(&[0, 0], Occupancy::Empty), (0.0, 0.2)));
        // Two people came into an empty room, and one was reported.
        assert!(close(span(&[0, 0, 1, 1], Occupancy::Two), (0.2, 0.4)));
        assert!(close(span(&[1, 1], Occupancy::Two), (0.0, 0.2)));
        // The answer became right in the end: what was wrong before is labelled, too.
        assert!(close(span(&[1, 1, 2, 2], Occupancy::Two), (0.0, 0.4)));
    }

    /// Regression test: the label of a report covered an outage and the time before the first answer.
    #[test]
    fn answers_that_were_not_settled_are_not_disputed() {
        let span =
            |people: &[u8], is_settled: &[bool]| disputed_interval_s(&results(people), is_settled, Occupancy::Two, 0.1);
        let (start_s, end_s) = span(&[1, 1, 0, 0, 1, 1], &[true, true, false, false, true, true]);
        assert!((start_s - 0.4).abs() < 1e-9 && (end_s - 0.6).abs() < 1e-9, "{start_s} {end_s}");
        let (start_s, end_s) = span(&[0, 0], &[false, false]);
        assert!(start_s == 0.0 && (end_s - 0.2).abs() < 1e-9, "{start_s} {end_s}");
    }
}
