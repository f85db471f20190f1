//! An ESP32 on a pseudo-terminal that prints whatever frames a [`FrameSource`] provides ([`crate::protocol::ascii`]).

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use radome_dsp::{Frame, FrameSource, SourceEvent};

use super::pty::Pty;
use super::{EmulatorError, Pace};
use crate::protocol::{ascii, fifo};

/// The running firmware. It ends when dropped, or with its source.
pub struct EmulatedLines {
    path: PathBuf,
    link: Option<PathBuf>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl EmulatedLines {
    /// Starts printing. Frames that the source lacks are left out, and so are their numbers; at [`Pace::RealTime`] the source's
    /// time stamps set the pace. A line waits until the host has taken the one before: nothing is lost on this side.
    ///
    /// `link` is a symbolic link to the terminal, kept as long as the board.
    ///
    /// # Errors
    /// No pseudo-terminal, no link, no thread, or a speed that is no positive number.
    pub fn spawn(source: Box<dyn FrameSource>, pace: Pace, link: Option<PathBuf>) -> Result<Self, EmulatorError> {
        if let Pace::RealTime(speed) = pace
            && !(speed.is_finite() && speed > 0.0)
        {
            return Err(EmulatorError::Speed { speed });
        }
        let pty = Pty::open().map_err(EmulatorError::Pty)?;
        let path = pty.path.clone();
        if let Some(link) = &link {
            pty.link(link).map_err(|source| EmulatorError::Link { path: link.clone(), source })?;
        }
        let stop = Arc::new(AtomicBool::new(false));
        let told = stop.clone();
        let thread = thread::Builder::new()
            .name("emulated-lines".into())
            .spawn(move || print(source, pace, &pty, &told))
            .map_err(EmulatorError::Thread)?;
        Ok(EmulatedLines { path, link, stop, thread: Some(thread) })
    }

    /// The serial port; its link if there is one.
    pub fn path(&self) -> &Path {
        self.link.as_deref().unwrap_or(&self.path)
    }
}

impl Drop for EmulatedLines {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::SeqCst);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
        if let Some(link) = &self.link {
            let _ = std::fs::remove_file(link);
        }
    }
}

fn print(mut source: Box<dyn FrameSource>, pace: Pace, pty: &Pty, stop: &AtomicBool) {
    let stopped = || stop.load(Ordering::SeqCst);
    let shape = source.waveform().shape();
    let channels: Vec<usize> = (0..shape.rx).collect();
    let mut frame = Frame::zeroed(shape);
    let (mut order, mut line) = (Vec::new(), b"I (312) main: radar started\r\n".to_vec());
    let mut began: Option<(Instant, u64)> = None;
    while !stopped() {
        match source.next_frame(&mut frame) {
            Ok(SourceEvent::Frame) => {}
            Ok(SourceEvent::Gap(_)) => continue,
            Ok(SourceEvent::End) => break,
            Err(error) => {
                tracing::error!("emulated board: {error}");
                break;
            }
        }
        if let Pace::RealTime(speed) = pace {
            let (start, first_ns) = *began.get_or_insert_with(|| (Instant::now(), frame.time_ns));
            let due_s = frame.time_ns.saturating_sub(first_ns) as f64 * 1e-9 / speed;
            while !stopped() && start.elapsed().as_secs_f64() < due_s {
                let left_s = due_s - start.elapsed().as_secs_f64();
                thread::sleep(Duration::from_secs_f64(left_s.clamp(0.0, 0.05)));
            }
        }
        order.clear();
        fifo::interleave(&frame.codes, shape, &channels, &mut order);
        ascii::encode(frame.sequence, &order, &mut line);
        let mut sent = 0;
        while !stopped() && sent < line.len() {
            match pty.write(line.get(sent..).unwrap_or(&[])) {
                Ok(0) => {
                    let _ = pty.wait(true, Duration::from_millis(50));
                }
                Ok(count) => sent += count,
                Err(error) => {
                    tracing::error!("emulated board: {error}");
                    return;
                }
            }
        }
        line.clear();
    }
    // The board stays plugged in, and silent.
    while !stopped() {
        thread::sleep(Duration::from_millis(20));
    }
}
