//! Measurement of a receiver from recordings.

use radome_dsp::statistics::SlowTimeStatistics;
use radome_sim::receiver::Receiver;
use radome_sim::receiver::calibration::{Calibration, Fit};

use super::arguments::{Arguments, WINDOW_S};
use super::recordings::Recordings;

/// Measurements of a receiver from recordings.
pub struct Measured {
    /// Fit to the first parts of the recordings.
    pub fit: Fit,
    /// Fit to the other parts, which are held out for comparison.
    pub held_out: Fit,
    /// Slow-time statistics of the first parts.
    pub fitted_slow_time: SlowTimeStatistics,
    /// Slow-time statistics of whole recordings.
    pub slow_time: SlowTimeStatistics,
}

/// Measures noise, leakage and slow-time statistics.
///
/// # Errors
/// A recording cannot be read, or too little can be fitted.
pub fn measure(arguments: &Arguments, recordings: &Recordings, base: &Receiver) -> anyhow::Result<Measured> {
    let waveform = &recordings.waveform;
    let mut fitted = Calibration::new(waveform, recordings.frames_fitted() as usize)?;
    let mut held_out = Calibration::new(waveform, recordings.frames_held_out() as usize)?;
    let (mut fitted_slow_time, mut slow_time) =
        (SlowTimeStatistics::new(waveform, WINDOW_S), SlowTimeStatistics::new(waveform, WINDOW_S));
    for recording in &recordings.all {
        fitted.begin_recording();
        held_out.begin_recording();
        recording.for_each_frame("measuring", |position, frame| {
            if position.is_fitted {
                fitted.push(frame)?;
                fitted_slow_time.push(frame);
            } else {
                held_out.push(frame)?;
            }
            slow_time.push(frame);
            Ok(())
        })?;
        fitted_slow_time.end();
        slow_time.end();
    }
    let name = arguments.name.clone().unwrap_or_else(|| recordings.name());
    Ok(Measured {
        fit: fitted.fit(base, &name, &recordings.measured_from())?,
        held_out: held_out.fit(&Receiver::typical(), "", "")?,
        fitted_slow_time,
        slow_time,
    })
}
