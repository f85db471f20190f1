//! Echoes of every frame of a recording or a simulation, moving and still.

use std::collections::VecDeque;

use radome_dsp::detect::{Baseline, Detection, Detector, RangeProfile};
use radome_dsp::{Frame, Truth, Waveform};

use super::detections::Detections;

/// Half the time over which frames are compared to find still people, s.
const STILL_HALF_S: f64 = 1.0;
/// Distance within which a moving echo hides a still one, m.
const HIDDEN_WITHIN_M: f64 = 1.0;

/// Metadata of a frame of the recording, without its samples.
#[derive(Debug, Clone, Copy)]
pub struct FrameInfo {
    pub sequence: u64,
    /// Start of the frame on the recording's clock, ns.
    pub time_ns: u64,
    /// Whether frames were lost before it.
    pub after_gap: bool,
    /// Class by label or by simulation.
    pub truth: Option<Truth>,
}

/// Finds echoes frame by frame.
pub struct EchoFinder {
    detector: Detector,
    moving: Vec<Vec<Detection>>,
    profiles: VecDeque<RangeProfile>,
    still: Vec<Vec<Detection>>,
    /// Number of frames in a window.
    window: usize,
}

impl EchoFinder {
    pub fn new(waveform: &Waveform, baselines: &[Baseline]) -> Self {
        let half_window = (STILL_HALF_S / waveform.frame_interval_s()).round().clamp(2.0, 200.0) as usize;
        EchoFinder {
            detector: Detector::new(waveform, baselines),
            moving: Vec::new(),
            profiles: VecDeque::new(),
            still: Vec::new(),
            window: 2 * half_window + 1,
        }
    }

    /// Finds the echoes of the next frame.
    ///
    /// # Errors
    /// The frame does not have the shape of the waveform.
    pub fn add_frame(&mut self, frame: &Frame) -> anyhow::Result<()> {
        let (echoes, profile) = self.detector.detect_moving(frame)?;
        self.moving.push(echoes);
        self.profiles.push_back(profile);
        if self.profiles.len() > self.window {
            self.profiles.pop_front();
        }
        if self.profiles.len() == self.window {
            self.still.push(self.detector.detect_still(&self.profiles.iter().collect::<Vec<_>>()));
        }
        Ok(())
    }

    /// Returns the echoes of all frames, with the still echoes of the window that is centred on each. At either end,
    /// the first and the last complete window are used.
    pub fn finish(mut self, times_s: &[f64], frames: &[FrameInfo], waveform: &Waveform) -> Vec<Detections> {
        if self.still.is_empty() && !self.profiles.is_empty() {
            self.still.push(self.detector.detect_still(&self.profiles.iter().collect::<Vec<_>>()));
        }
        let middle_s = 0.5 * waveform.request.chirps_per_frame as f64 * waveform.chirp_interval_s;
        let half_window = self.window / 2;
        let moving = std::mem::take(&mut self.moving);
        let detections_of = |(k, mut echoes): (usize, Vec<Detection>)| {
            let still = self.still.get(k.saturating_sub(half_window).min(self.still.len().saturating_sub(1)));
            let near = |still: &Detection| echoes.iter().any(|e| (e.range_m - still.range_m).abs() < HIDDEN_WITHIN_M);
            let unhidden_still: Vec<_> = still.into_iter().flatten().filter(|s| !near(s)).cloned().collect();
            echoes.extend(unhidden_still);
            Detections {
                time_s: times_s.get(k).copied().unwrap_or(0.0) + middle_s,
                people: frames.get(k).and_then(|info| info.truth).map_or(2, |truth| truth.occupancy.index()),
                echoes,
            }
        };
        moving.into_iter().enumerate().map(detections_of).collect()
    }
}
