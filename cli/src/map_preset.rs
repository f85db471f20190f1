//! Presets of range-Doppler maps, as named in commands.

use radome_dsp::{RdmSpec, Waveform};

/// Kind of range-Doppler map.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum MapPreset {
    /// All receivers, codes minus 2048 over 2048, Hann x Hann, dBFS, nothing removed
    #[default]
    #[value(alias = "house")]
    Default,
    /// Normalised as the paper's statistics
    Paper,
    /// Normalised as the vendor's examples
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
