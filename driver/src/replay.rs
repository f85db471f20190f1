//! Playback of a source at the pace of its time stamps.

use std::thread;
use std::time::{Duration, Instant};

use radome_dsp::{Frame, FrameSource, SourceError, SourceEvent, Waveform};

/// Source that hands out the frames of another source when they are due.
pub struct RealTime<S> {
    source: S,
    speed: f64,
    /// Instant of the first frame, and its time, ns.
    start: Option<(Instant, u64)>,
}

impl<S: FrameSource> RealTime<S> {
    /// Paces a source by its time stamps, `speed` times as fast; a speed that is not a positive number leaves it
    /// unpaced.
    pub fn new(source: S, speed: f64) -> Self {
        RealTime { source, speed, start: None }
    }
}

impl<S: FrameSource> FrameSource for RealTime<S> {
    fn waveform(&self) -> &Waveform {
        self.source.waveform()
    }

    fn next_frame(&mut self, frame: &mut Frame) -> Result<SourceEvent, SourceError> {
        let event = self.source.next_frame(frame)?;
        if event == SourceEvent::Frame && self.speed > 0.0 && self.speed.is_finite() {
            let (start, first_ns) = *self.start.get_or_insert((Instant::now(), frame.time_ns));
            let due_s = frame.time_ns.saturating_sub(first_ns) as f64 * 1e-9 / self.speed;
            let due = Duration::try_from_secs_f64(due_s).unwrap_or(Duration::MAX);
            thread::sleep(due.saturating_sub(start.elapsed()));
        }
        Ok(event)
    }

    fn frame_count(&self) -> Option<u64> {
        self.source.frame_count()
    }
}
