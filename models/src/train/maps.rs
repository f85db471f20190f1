//! Maps that several trainings share.

use std::sync::{Arc, OnceLock};

use crate::dataset::{Dataset, DatasetError};
use crate::standardise::MapReference;

/// Maps of a dataset in one reference. Each map is read and measured once for all trainings.
pub(crate) struct Maps<'a> {
    dataset: &'a Dataset,
    reference: MapReference,
    loaded: Vec<OnceLock<Arc<[f32]>>>,
}

impl<'a> Maps<'a> {
    /// Maps for trainings with this reference. None is read yet.
    pub(crate) fn new(dataset: &'a Dataset, reference: MapReference) -> Self {
        Maps { dataset, reference, loaded: vec![OnceLock::new(); dataset.len()] }
    }

    /// The dataset that the maps are of.
    pub(crate) fn dataset(&self) -> &'a Dataset {
        self.dataset
    }

    /// Cells of a map, `[range][doppler]`, before bound and scaling.
    ///
    /// # Errors
    /// Those of [`Dataset::input`].
    pub(crate) fn get(&self, index: usize) -> Result<Arc<[f32]>, DatasetError> {
        let slot = self.loaded.get(index);
        if let Some(map) = slot.and_then(OnceLock::get) {
            return Ok(Arc::clone(map));
        }
        let mut cells = self.dataset.input(index, 0)?;
        self.reference.apply_unclipped(&mut cells, self.dataset.header().shape.doppler);
        let map: Arc<[f32]> = cells.into();
        if let Some(slot) = slot {
            // Another thread may have read the same cells meanwhile.
            let _ = slot.set(Arc::clone(&map));
        }
        Ok(map)
    }
}
