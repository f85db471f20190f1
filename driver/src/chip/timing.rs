//! Times at which the chip samples its codes.

use radome_dsp::{ADC_START_DELAY_S, Waveform};

/// Delay from the start of a chirp to the start of the transmitter: the PA delay of the captured configuration, s.
const TX_ON_S: f64 = 3e-6;

/// Times of codes in FIFO order, from the start of their acquisition.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SampleTiming {
    receivers: u64,
    codes_per_chirp: u64,
    codes_per_frame: u64,
    sample_interval_s: f64,
    chirp_interval_s: f64,
    frame_interval_s: f64,
}

impl SampleTiming {
    pub fn new(waveform: &Waveform) -> Self {
        let shape = waveform.shape();
        SampleTiming {
            receivers: shape.rx.max(1) as u64,
            codes_per_chirp: (shape.rx * shape.samples).max(1) as u64,
            codes_per_frame: shape.codes().max(1) as u64,
            sample_interval_s: 1.0 / waveform.sample_rate_hz,
            chirp_interval_s: waveform.chirp_interval_s,
            frame_interval_s: waveform.frame_interval_s(),
        }
    }

    /// Interval between the starts of frames, s.
    pub fn frame_interval_s(&self) -> f64 {
        self.frame_interval_s
    }

    /// Time of a code from the start of its own frame, s; `code` counts within the frame.
    pub fn in_frame_s(&self, code: u64) -> f64 {
        let (chirp, code) = (code / self.codes_per_chirp, code % self.codes_per_chirp);
        let sample = (code / self.receivers) as f64;
        TX_ON_S + ADC_START_DELAY_S + chirp as f64 * self.chirp_interval_s + sample * self.sample_interval_s
    }

    /// Time of a code from the start of the first frame at the nominal frame interval, s.
    pub fn in_stream_s(&self, code: u64) -> f64 {
        let frame = code / self.codes_per_frame;
        frame as f64 * self.frame_interval_s + self.in_frame_s(code % self.codes_per_frame)
    }

    /// Number of codes sampled this long after the start of the first frame, at the nominal frame interval.
    pub fn sampled_in_stream(&self, elapsed_s: f64) -> u64 {
        let frame = (elapsed_s / self.frame_interval_s).floor().max(0.0);
        frame as u64 * self.codes_per_frame + self.sampled_after(elapsed_s - frame * self.frame_interval_s)
    }

    /// Number of whole chirps of a frame sampled this long after its start.
    pub fn chirps_after(&self, elapsed_s: f64) -> u64 {
        self.sampled_after(elapsed_s) / self.codes_per_chirp
    }

    /// Number of codes of a frame sampled this long after its start.
    pub fn sampled_after(&self, elapsed_s: f64) -> u64 {
        let since_first = elapsed_s - TX_ON_S - ADC_START_DELAY_S;
        if since_first < 0.0 {
            return 0;
        }
        let chirp = (since_first / self.chirp_interval_s).floor();
        let samples = ((since_first - chirp * self.chirp_interval_s) / self.sample_interval_s).floor() as u64 + 1;
        let in_chirp = (samples * self.receivers).min(self.codes_per_chirp);
        (chirp as u64 * self.codes_per_chirp + in_chirp).min(self.codes_per_frame)
    }
}
