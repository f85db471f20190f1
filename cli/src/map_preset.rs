//! Presets of range-Doppler maps, as named in commands.

use radome_dsp::{RdmSpec, Waveform};

/// Kind of range-Doppler map.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum MapPreset {
    /// All receivers, (code - 2048) / 2048, Hann windows, dBFS, nothing removed
    #[default]
    #[value(alias = "house")]
    Default,
    /// As in the paper's statistics
    Paper,
    /// As in the vendor's examples
    Sdk,
}

impl MapPreset {
    /// Returns the specification of the map for frames of a waveform.
    pub fn spec(self, waveform: &Waveform) -> RdmSpec {
        match self {
            MapPreset::Default => RdmSpec::default(),
            MapPreset::Paper => RdmSpec::paper(),
            MapPreset::Sdk => RdmSpec::sdk(waveform),
        }
    }
}
