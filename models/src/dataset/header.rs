//! Header of a dataset: `dataset.json`.

use radome_dsp::rdm::SpecError;
use radome_dsp::{MapFlags, Occupancy, Rdm, RdmShape, RdmSpec, Waveform};
use serde::{Deserialize, Serialize};

/// Version of the format that is written; older ones are read.
pub const FORMAT_VERSION: u32 = 1;

/// Properties that all maps of a dataset share.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DatasetHeader {
    /// [`FORMAT_VERSION`] of the writer.
    pub format_version: u32,
    /// Waveform of the frames, as realised. With physical axes, the first of several waveforms.
    pub waveform: Waveform,
    /// Settings by which maps were computed from frames.
    pub rdm_spec: RdmSpec,
    /// Shape of each map.
    pub shape: RdmShape,
    /// Names of the axes of a map as stored, slowest first.
    pub dimensions: Vec<String>,
    /// Names of the classes by index.
    pub class_names: Vec<String>,
}

impl DatasetHeader {
    /// Makes the header for maps that `rdm_spec` makes of the frames of `waveform`.
    ///
    /// # Errors
    /// If the spec cannot be applied to the waveform.
    pub fn new(waveform: Waveform, rdm_spec: RdmSpec) -> Result<Self, SpecError> {
        Ok(DatasetHeader {
            format_version: FORMAT_VERSION,
            shape: rdm_spec.shape(&waveform)?,
            waveform,
            rdm_spec,
            dimensions: ["rx", "doppler", "range"].map(str::to_owned).to_vec(),
            class_names: Occupancy::ALL.map(|o| o.name().to_owned()).to_vec(),
        })
    }

    /// Makes a map of the dataset, without motion, from cells `[rx][doppler][range]`, dB.
    pub fn rdm(&self, db: Vec<f32>, sequence: u64) -> Rdm {
        let (range_step_m, velocity_step_m_per_s) = self.rdm_spec.steps(&self.waveform);
        let (shape, flags) = (self.shape, MapFlags::default());
        Rdm { shape, db, range_step_m, velocity_step_m_per_s, sequence, flags, motion: None }
    }
}
