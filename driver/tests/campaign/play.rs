//! Runs one board of the campaign. Its frames are a function of seed and number, so that every received sample can be
//! checked.

use std::time::{Duration, Instant};

use radome_driver::{BoardError, EmulatedBoard, EmulatorOptions, Fault, Kind as Board, Pace};
use radome_dsp::{Frame, FrameSource, GapReason, SourceEvent, Waveform, source_from_fn};

use crate::common::{POLICY, Random, open};
use crate::draw::{Job, Kind};

/// Makes the codes of a frame.
fn fill(seed: u64, sequence: u64, codes: &mut [u16]) {
    let mut random = Random(seed ^ sequence.wrapping_mul(0x2545_F491_4F6C_DD1D));
    for five in codes.chunks_mut(5) {
        let bits = random.next();
        five.iter_mut().enumerate().for_each(|(i, code)| *code = (bits >> (12 * i) & 0xFFF) as u16);
    }
    if let [low, high, ..] = codes {
        (*low, *high) = ((sequence & 0xFFF) as u16, (sequence >> 12 & 0xFFF) as u16);
    }
}

/// Endless source of frames. The first two codes of a frame are its number, the others resemble noise.
fn source(seed: u64, waveform: Waveform) -> impl FrameSource {
    let (frame_waveform, mut next) = (waveform.clone(), 0);
    source_from_fn(waveform, move |frame| {
        fill(seed, next, &mut frame.codes);
        (frame.sequence, frame.time_ns) = (next, frame_waveform.frame_time_ns(next));
        next += 1;
        Ok(SourceEvent::Frame)
    })
}

/// Counts of a job, or of several.
#[derive(Debug, Clone, Default)]
pub struct Outcome {
    pub injected: u64,
    pub delivered: u64,
    pub lost: u64,
    /// Samples that differ from the source's.
    pub wrong: u64,
    /// Wrong samples that no client could detect.
    pub undetectable: u64,
    /// Faults after which the stream did not continue.
    pub not_resumed: u64,
    /// Descriptions of violated requirements.
    pub failures: Vec<String>,
}

impl Outcome {
    pub fn add(&mut self, other: &Outcome) {
        self.injected += other.injected;
        self.delivered += other.delivered;
        self.lost += other.lost;
        self.wrong += other.wrong;
        self.undetectable += other.undetectable;
        self.not_resumed += other.not_resumed;
    }
}

/// Runs a job.
pub fn play(job: &Job) -> Outcome {
    let folder = tempfile::tempdir().expect("folder");
    let options = EmulatorOptions {
        pace: if job.kind == Kind::SlowHost { Pace::RealTime(1.0) } else { Pace::AsFastAsRead },
        kind: job.board,
        faults: job.faults.clone(),
        // A unique link, since the terminal number of a closed board is soon reused by another board.
        link: Some(folder.path().join("board")),
        ..EmulatorOptions::default()
    };
    let board = EmulatedBoard::spawn(Box::new(source(job.seed, job.waveform.clone())), options).expect("spawns");
    let mut outcome = Outcome { injected: job.faults.len() as u64, ..Outcome::default() };
    // On a busy machine even a healthy board may answer late, or close before its answer is read.
    let attempt = || {
        std::thread::sleep(Duration::from_millis(5));
        open(job.board, &board, &job.waveform, POLICY)
    };
    let mut attempts = std::iter::repeat_with(attempt).take(100);
    let is_transient = |client: &Result<Box<dyn FrameSource>, BoardError>| {
        use BoardError::{Absent, Disconnected, NoAnswer, Open};
        matches!(client, Err(NoAnswer { .. } | Disconnected { .. } | Open { .. } | Absent { .. }))
    };
    let client = attempts.find(|client| !is_transient(client)).unwrap_or_else(attempt);
    match (job.kind, client) {
        (Kind::Version, Err(BoardError::Protocol { .. })) => {}
        (Kind::Version | Kind::Chip, Err(BoardError::Deepcraft { .. })) => {}
        // Reads of an absent chip give all ones or all zeros.
        (Kind::Chip, Err(BoardError::OtherChip { .. } | BoardError::ChipSilent { .. }))
            if job.board != Board::Esp32 => {}
        (Kind::Version | Kind::Chip, Ok(_)) if job.board != Board::Esp32 => {
            outcome.failures.push("a board of another version or chip was driven".into());
        }
        (_, Ok(client)) => {
            // Reads until every fault has been injected.
            let last = job.faults.iter().map(packet).max().unwrap_or(0);
            Check::new(job, client, &mut outcome).run(|| board.counts().packets > last);
        }
        (_, Err(error)) => outcome.failures.push(format!("the board was not opened: {error}")),
    }
    outcome
}

/// Number of the packet that a fault changes.
fn packet(fault: &Fault) -> u64 {
    match *fault {
        Fault::DropPacket(packet)
        | Fault::DoublePacket(packet)
        | Fault::ReorderPacket(packet)
        | Fault::Overflow(packet)
        | Fault::Stall(packet)
        | Fault::FlipBit { packet, .. }
        | Fault::TruncatePacket { packet, .. }
        | Fault::SkipCounter { packet, .. }
        | Fault::Unplug { packet, .. }
        | Fault::SlowHost { packet, .. } => packet,
        Fault::ForeignChip(_) | Fault::WrongVersion(_) => 0,
    }
}

/// Checks the events of a client, frame by frame.
struct Check<'a> {
    job: &'a Job,
    client: Box<dyn FrameSource>,
    outcome: &'a mut Outcome,
    /// Number that the next frame or gap must have.
    next_sequence: u64,
    /// Smallest source number that the next frame may have.
    next_source: u64,
    /// Sequence number less the source's number, once known. It may change after a gap that only the host's clock could
    /// count.
    offset: Option<i128>,
    /// Numbers that faults make the firmware skip, not yet seen.
    skips: u64,
    last_event: Instant,
    /// Whether the board was opened again, so that a restart is still expected.
    is_restart_expected: bool,
    expected: Vec<u16>,
}

impl<'a> Check<'a> {
    fn new(job: &'a Job, client: Box<dyn FrameSource>, outcome: &'a mut Outcome) -> Self {
        // A printing board (ESP32) numbers its frames itself, so that a skipped counter skips frames. Packet counters
        // do not.
        let skips = job.faults.iter().map(|fault| match fault {
            Fault::SkipCounter { by, .. } if job.board == Board::Esp32 => u64::from(*by),
            _ => 0,
        });
        Check {
            job,
            client,
            outcome,
            next_sequence: 0,
            next_source: 0,
            offset: None,
            skips: skips.sum(),
            last_event: Instant::now(),
            is_restart_expected: false,
            expected: vec![0; job.waveform.shape().codes()],
        }
    }

    /// Notes a failure.
    fn fail(&mut self, what: String) {
        // The first few failures suffice.
        if self.outcome.failures.len() < 3 {
            self.outcome.failures.push(what);
        }
    }

    /// Reads until the source's last frame has come and the board `is_done`.
    fn run(&mut self, is_done: impl Fn() -> bool) {
        let mut frame = Frame::zeroed(self.job.waveform.shape());
        while self.next_source < self.job.frames || !is_done() {
            match self.client.next_frame(&mut frame) {
                Ok(SourceEvent::Frame) => self.check_frame(&frame),
                Ok(SourceEvent::Gap(gap)) => {
                    if gap.first_sequence != self.next_sequence {
                        self.fail(format!("{gap:?} where {} should follow", self.next_sequence));
                    }
                    // Losses before the first frame cannot be counted.
                    if gap.frames == 0 && self.offset.is_some() {
                        self.fail(format!("{gap:?} is empty"));
                    }
                    if gap.reason == GapReason::Disconnected {
                        // On a machine that is busy for a second, a healthy board looks stalled.
                        let was_silent = self.last_event.elapsed() > Duration::from_secs(1);
                        // One flipped flag turns a bulk packet into a report of the board's failure.
                        let may_report = self.job.board == Board::Mcu7Bulk && self.job.kind == Kind::Flip;
                        let is_explained = self.job.board == Board::Deepcraft
                            || may_report
                            || self.job.kind.interrupts()
                            || self.may_be_renumbered()
                            || was_silent;
                        if !is_explained && !std::mem::take(&mut self.is_restart_expected) {
                            self.fail(format!("{gap:?}, but the board was never away"));
                        }
                        // A printing board restarts when its port is opened, after the lines that it had printed
                        // before.
                        self.is_restart_expected |= was_silent && self.job.board == Board::Esp32;
                        self.offset = None;
                    }
                    // After damage a DEEPCRAFT board is restarted, and only the host's clock can count the lost frames.
                    if self.job.board == Board::Deepcraft {
                        self.offset = None;
                    }
                    self.next_sequence = gap.first_sequence + gap.frames;
                    self.outcome.lost += gap.frames;
                    self.last_event = Instant::now();
                }
                Ok(SourceEvent::End) => return self.fail("a board does not end".into()),
                Err(error) => {
                    self.outcome.not_resumed += 1;
                    self.fail(format!("after {} frames: {error}", self.outcome.delivered));
                    return;
                }
            }
        }
    }

    /// Whether a flipped digit of a line's number may look like a restart of the firmware.
    fn may_be_renumbered(&self) -> bool {
        self.job.board == Board::Esp32 && matches!(self.job.kind, Kind::Flip | Kind::Skip)
    }

    /// Checks numbers and samples of a frame.
    fn check_frame(&mut self, frame: &Frame) {
        self.outcome.delivered += 1;
        self.last_event = Instant::now();
        if frame.sequence != self.next_sequence {
            self.fail(format!("frame {} where {} should follow", frame.sequence, self.next_sequence));
        }
        self.next_sequence = frame.sequence + 1;
        let (source_number, wrong) = self.identify(frame);
        if wrong > 0 {
            self.outcome.wrong += wrong;
            // Without a check sum, one changed digit of one code cannot be detected.
            let has_checksum = matches!(self.job.board, Board::Mcu7V4 | Board::Mcu7V3);
            let is_undetectable = !has_checksum && matches!(self.job.kind, Kind::Flip | Kind::Mixed);
            if is_undetectable && wrong == 1 {
                self.outcome.undetectable += 1;
            } else {
                self.fail(format!(
                    "{wrong} samples of frame {} (the source's {source_number}) are wrong",
                    frame.sequence
                ));
            }
        }
        if source_number < self.next_source {
            self.fail(format!("the source's frame {source_number} after {}", self.next_source - 1));
        }
        self.next_source = source_number + 1;

        let offset = i128::from(frame.sequence) - i128::from(source_number);
        let previous = *self.offset.get_or_insert(offset);
        let skipped = offset - previous;
        if skipped != 0 {
            // Only numbers that the firmware skipped may be missing.
            if skipped > 0 && skipped <= i128::from(self.skips) {
                self.skips -= skipped as u64;
            } else {
                self.fail(format!(
                    "frame {} is the source's {source_number}: {skipped} counted too many",
                    frame.sequence
                ));
            }
            self.offset = Some(offset);
        }
    }

    /// Source number of a frame, and the number of its samples that differ from the source's.
    fn identify(&mut self, frame: &Frame) -> (u64, u64) {
        let mut wrong = |sequence: u64| {
            fill(self.job.seed, sequence, &mut self.expected);
            self.expected.iter().zip(&frame.codes).filter(|(a, b)| a != b).count() as u64
        };
        let stated = match frame.codes.as_slice() {
            [low, high, ..] => u64::from(*low) | u64::from(*high) << 12,
            _ => 0,
        };
        match wrong(stated) {
            0 => (stated, 0),
            // The number itself may be wrong.
            wrong_codes => {
                let near = (self.next_source..self.next_source + 200).map(|n| (n, wrong(n)));
                near.chain([(stated, wrong_codes)]).min_by_key(|(_, wrong)| *wrong).unwrap_or((stated, wrong_codes))
            }
        }
    }
}
