//! Dataset of a recording and its mirror.

use radome_dsp::{Rdm, Truth};
use radome_models::dataset::{DatasetWriter, Domain, ManifestRow};

use super::echo_finder::FrameInfo;

/// Writer of maps of both sides of a pair.
pub struct Store {
    pub writer: DatasetWriter,
    pub pair: String,
    pub scene: String,
    pub subject: Option<String>,
}

impl Store {
    /// Stores a map of one side with the class of the frame.
    ///
    /// # Errors
    /// The dataset cannot be written.
    pub fn push(
        &mut self,
        domain: Domain,
        map: &Rdm,
        info: &FrameInfo,
        truth: Truth,
        seed: Option<u64>,
    ) -> anyhow::Result<()> {
        let recording = match domain {
            Domain::Real => self.pair.clone(),
            Domain::Sim => format!("{}-mirror", self.pair),
        };
        let mut row = ManifestRow::new(domain, &self.scene, &recording, &self.pair, info.sequence, truth.occupancy);
        row.subject.clone_from(&self.subject);
        row.time_ns = Some(info.time_ns);
        row.pair = Some(self.pair.clone());
        row.transition = truth.transition;
        row.seed = seed;
        Ok(self.writer.push(map, row)?)
    }
}
