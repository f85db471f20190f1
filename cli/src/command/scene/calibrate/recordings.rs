//! Recordings of one receiver. Frames are read one by one, in as many passes as needed, since recordings may exceed
//! memory.

use std::path::{Path, PathBuf};

use anyhow::bail;
use radome_driver::recording::Recording;
use radome_dsp::{Frame, FrameSource, Waveform};
use radome_sim::receiver::calibration::LEAST_FRAMES;

use crate::{labels, output, source};

/// Recordings of one waveform, each split in two.
pub struct Recordings {
    pub waveform: Waveform,
    pub all: Vec<SplitRecording>,
}

/// Recording whose first frames are used for the fit.
pub struct SplitRecording {
    path: PathBuf,
    frames: u64,
    fitted: u64,
}

/// Position of a frame in a recording.
pub struct FramePosition {
    /// Whether the receiver is fitted to it.
    pub is_fitted: bool,
    /// Relative position in its part, 0..1.
    pub in_part: f64,
}

impl Recordings {
    /// Opens recordings whose first part is used for the fit.
    ///
    /// # Errors
    /// A recording cannot be read, is too short or is named twice, or two have different waveforms.
    pub fn open(paths: &[PathBuf], part: f64) -> anyhow::Result<Self> {
        labels::check_named_once(paths)?;
        let (mut waveform, mut all) = (None::<(Waveform, &Path)>, Vec::new());
        for path in paths {
            let source = Recording::open(path)?;
            match &waveform {
                None => waveform = Some((source.waveform().clone(), path)),
                Some((first, of)) if first != source.waveform() => {
                    bail!(
                        "{} has another waveform than {}\n\nhint: a receiver is fitted at one waveform and gain; \
                         calibrate each by itself",
                        path.display(),
                        of.display()
                    );
                }
                Some(_) => {}
            }
            let frames = source.whole_frames();
            let recording =
                SplitRecording { path: path.clone(), frames, fitted: (frames as f64 * part).round() as u64 };
            if recording.fitted.min(recording.frames - recording.fitted.min(recording.frames)) < LEAST_FRAMES as u64 {
                let is_long = recording.frames >= 2 * LEAST_FRAMES as u64;
                let hint = if is_long { "choose a --part nearer to 0.5" } else { "record ten seconds or more" };
                bail!(
                    "{}: {} frames to fit and {} to judge by, {LEAST_FRAMES} of each are needed\n\nhint: {hint}",
                    path.display(),
                    recording.fitted,
                    recording.frames.saturating_sub(recording.fitted)
                );
            }
            all.push(recording);
        }
        match waveform {
            Some((waveform, _)) => Ok(Recordings { waveform, all }),
            None => bail!("no recording to calibrate by"),
        }
    }

    pub fn frames_fitted(&self) -> u64 {
        self.all.iter().map(|recording| recording.fitted).sum()
    }

    pub fn frames_held_out(&self) -> u64 {
        self.all.iter().map(|recording| recording.frames - recording.fitted).sum()
    }

    /// Returns the name of the first recording.
    pub fn name(&self) -> String {
        self.all.first().map(SplitRecording::name).unwrap_or_default()
    }

    /// Returns the names of the recordings that a receiver was fitted to.
    pub fn measured_from(&self) -> String {
        let of = |recording: &SplitRecording| {
            format!("{}: {} of {} frames", recording.name(), recording.fitted, recording.frames)
        };
        self.all.iter().map(of).collect::<Vec<_>>().join("; ")
    }
}

impl SplitRecording {
    pub fn name(&self) -> String {
        source::name_of(&self.path).to_string_lossy().into_owned()
    }

    /// Reads the recording once more, across its gaps.
    ///
    /// # Errors
    /// The recording cannot be read, or the callback fails.
    pub fn for_each_frame(
        &self,
        what: &'static str,
        mut visit: impl FnMut(FramePosition, &Frame) -> anyhow::Result<()>,
    ) -> anyhow::Result<()> {
        let mut source = Recording::open(&self.path)?;
        let bar = output::progress(self.frames, what);
        let mut frame = Frame::zeroed(source.waveform().shape());
        let mut index = 0;
        while source::next_frame(&mut source, &mut frame)? {
            let is_fitted = index < self.fitted;
            let (at, of) =
                if is_fitted { (index, self.fitted) } else { (index - self.fitted, self.frames - self.fitted) };
            visit(FramePosition { is_fitted, in_part: at as f64 / of.max(1) as f64 }, &frame)?;
            index += 1;
            bar.inc(1);
        }
        bar.finish_and_clear();
        Ok(())
    }
}
