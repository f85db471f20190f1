//! Waveforms that are built into the firmware, and the item for a custom waveform of the host.

use radome_dsp::{RxMask, Waveform, WaveformError, WaveformRequest};

/// Items of the radar's option "Use case", by index.
pub const ITEMS: [&str; 5] = ["Default", "Gesture", "Macro Presence", "Micro Presence", CUSTOM];
/// Item for a custom waveform of the host.
pub const CUSTOM: &str = "Custom";

/// Waveform that is built into the firmware.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Preset {
    /// P0: one chirp on RX1, 200 Hz.
    Default,
    /// P1: 4 GHz, 32 chirps on all receivers, 33 Hz.
    Gesture,
    /// P2: 16 chirps on RX3, 10 Hz.
    MacroPresence,
    /// P3: 16 chirps on RX3, 100 Hz.
    MicroPresence,
}

impl Preset {
    /// All presets, in the firmware's order.
    pub const ALL: [Preset; 4] = [Preset::Default, Preset::Gesture, Preset::MacroPresence, Preset::MicroPresence];

    /// Name of the preset's item.
    pub fn name(self) -> &'static str {
        ITEMS.get(self as usize).copied().unwrap_or(CUSTOM)
    }

    /// Returns the preset with this item.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|preset| preset.name() == name)
    }

    /// Returns the preset that equals this waveform exactly.
    pub fn of(waveform: &Waveform) -> Option<Self> {
        Self::ALL.into_iter().find(|preset| preset.waveform().is_ok_and(|candidate| candidate == *waveform))
    }

    /// Returns the waveform of the preset. Its figures are those of the firmware's settings; receivers and gains are
    /// those of the registers that the firmware writes. P0 has one chirp a frame; its registers that determine the
    /// chirp interval are those of P3.
    ///
    /// # Errors
    /// [`WaveformError`] never in practice: the tests realise all presets.
    pub fn waveform(self) -> Result<Waveform, WaveformError> {
        let antennas: &[u8] = match self {
            Preset::Default => &[1],
            Preset::Gesture => &[1, 2, 3],
            Preset::MacroPresence | Preset::MicroPresence => &[3],
        };
        let narrow = WaveformRequest {
            start_frequency_hz: 61_020_099_000.0,
            end_frequency_hz: 61_479_903_000.0,
            samples_per_chirp: 128,
            chirps_per_frame: 16,
            sample_rate_hz: 2_352_941.0,
            chirp_interval_s: 69.9625e-6,
            frame_interval_s: 9.99593e-3,
            rx_antennas: RxMask::from_antennas(antennas)?,
            tx_power_level: 31,
            if_gain_db: 60.0,
            high_pass_cutoff_hz: 80e3,
            anti_alias_cutoff_hz: 500e3,
        };
        Waveform::realise(match self {
            Preset::Default => WaveformRequest { chirps_per_frame: 1, frame_interval_s: 5.00407e-3, ..narrow },
            Preset::Gesture => WaveformRequest {
                start_frequency_hz: 58.5e9,
                end_frequency_hz: 62.5e9,
                samples_per_chirp: 64,
                chirps_per_frame: 32,
                sample_rate_hz: 2e6,
                chirp_interval_s: 299.787e-6,
                frame_interval_s: 30.0446e-3,
                if_gain_db: 30.0,
                ..narrow
            },
            Preset::MacroPresence => WaveformRequest {
                start_frequency_hz: 61_020_100_000.0,
                end_frequency_hz: 61_479_904_000.0,
                chirp_interval_s: 69.45e-6,
                frame_interval_s: 0.100049,
                ..narrow
            },
            Preset::MicroPresence => narrow,
        })
    }
}

/// Returns the frequency that the firmware states for a stream: frames in a second, rounded.
pub fn stated_frequency_hz(waveform: &Waveform) -> f32 {
    (0.5 + 1.0 / waveform.frame_interval_s()).floor() as f32
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::chip::ChipConfiguration;
    use radome_dsp::SLOPE_STEP_HZ_PER_S;

    /// Compares with figures captured from the firmware.
    #[test]
    fn presets_have_the_figures_of_the_reference() {
        let expected = [
            (61.0201e9, 61.4799e9, 128, 1, 1, 2.352941e6, 200.0),
            (58.5e9, 62.5e9, 64, 32, 3, 2e6, 33.0),
            (61.02e9, 61.48e9, 128, 16, 1, 2.352941e6, 10.0),
            (61.02e9, 61.48e9, 128, 16, 1, 2.352941e6, 100.0),
        ];
        for (preset, (start, end, samples, chirps, rx, rate, frequency)) in Preset::ALL.into_iter().zip(expected) {
            let w = preset.waveform().expect("valid");
            assert!((w.request.start_frequency_hz - start).abs() < 0.2e6, "{preset:?}");
            assert!((w.request.end_frequency_hz - end).abs() < 0.2e6, "{preset:?}");
            assert_eq!((w.shape().samples, w.shape().chirps, w.shape().rx), (samples, chirps, rx), "{preset:?}");
            assert!((w.sample_rate_hz / rate - 1.0).abs() < 1e-6, "{preset:?}");
            assert_eq!(stated_frequency_hz(&w), frequency, "{preset:?}");
            assert_eq!((Preset::of(&w), Preset::from_name(preset.name())), (Some(preset), Some(preset)));
        }
    }

    /// Compares with the slopes that the firmware writes to RSU: 164 for 460 MHz, 2333 for 4 GHz.
    #[test]
    fn slopes_are_those_of_the_firmwares_registers() {
        for (preset, rsu) in Preset::ALL.into_iter().zip([164.0, 2333.0, 164.0, 164.0]) {
            let w = preset.waveform().expect("valid");
            assert_eq!((w.slope_hz_per_s / SLOPE_STEP_HZ_PER_S).round(), rsu, "{preset:?}");
            ChipConfiguration { waveform: w, slice_samples: 6144 }.compile().expect("the chip can do it");
        }
    }
}
