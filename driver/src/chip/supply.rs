//! Supply current of the chip.

use super::field::{CCR1, CCR2, PLL1_7};
use super::{ChipConfiguration, ChipError};

/// Supply current in active mode with one transmitter, A (datasheet section 6, typical).
const ACTIVE_A: f64 = 0.201;
/// Supply current in idle mode, A.
const IDLE_A: f64 = 2.8e-3;
/// Supply current in deep sleep, A.
const DEEP_SLEEP_A: f64 = 0.12e-3;

impl ChipConfiguration {
    /// Mean supply current, A: the datasheet's typical currents weighted by the times that frames spend in each mode.
    ///
    /// Wake-up counts as idle. The registers choose the mode between chirps and between frames according to the time
    /// that is left there.
    ///
    /// # Errors
    /// Those of [`ChipConfiguration::compile`].
    pub fn supply_current_a(&self) -> Result<f64, ChipError> {
        let file = self.programmed()?;
        let waveform = ChipConfiguration::decode(&file)?.waveform;
        let chirps = f64::from(file.field(CCR2::FRAME_LEN)) + 1.0;
        let frame_s = waveform.frame_interval_s();
        let in_chirps_s = (chirps * waveform.chirp_interval_s).min(frame_s);
        let active_s = match file.field(PLL1_7::PD_MODE) {
            // The chip stays active between chirps.
            0 => in_chirps_s,
            _ => (chirps * self.active_chirp_s()).min(in_chirps_s),
        };
        let between_frames_a = if file.field(CCR1::PD_MODE) >= 2 { DEEP_SLEEP_A } else { IDLE_A };
        let charge =
            active_s * ACTIVE_A + (in_chirps_s - active_s) * IDLE_A + (frame_s - in_chirps_s) * between_frames_a;
        Ok(charge / frame_s)
    }
}

#[cfg(test)]
mod tests {
    use radome_dsp::{Waveform, WaveformRequest};

    use super::*;

    fn current_a(request: WaveformRequest) -> f64 {
        let waveform = Waveform::realise(request).expect("valid");
        ChipConfiguration { waveform, slice_samples: 4096 }.supply_current_a().expect("fits")
    }

    #[test]
    fn the_current_lies_between_its_modes_and_grows_with_the_duty() {
        let paper = WaveformRequest::paper();
        // 128 chirps are active for 265 us of their 500 us each: the chip is active for a third of the time.
        let full = current_a(paper.clone());
        assert!((0.06..0.08).contains(&full), "{full}");
        let sparse = current_a(WaveformRequest { chirps_per_frame: 8, ..paper.clone() });
        assert!(sparse < full / 8.0 && sparse > DEEP_SLEEP_A, "{sparse}");
        let slow = current_a(WaveformRequest { frame_interval_s: 10.0, ..paper });
        assert!((slow / (full / 100.0) - 1.0).abs() < 0.2, "{slow}");
    }
}
