//! A trained model at work: map in, probabilities out.

use std::path::Path;

use candle_core::{Device, Tensor};
use radome_dsp::{Occupancy, Rdm, RdmShape, RdmSpec, Waveform};
use thiserror::Error;

use crate::dataset::{DatasetError, ManifestRow, network_input};
use crate::layer::softmax;
use crate::model_file::{Model, ModelCard, ModelError};

/// A model ready to classify maps one by one.
pub struct Classifier {
    model: Model,
}

/// A map that cannot be classified.
#[derive(Debug, Error)]
pub enum ClassifyError {
    /// The map has another shape than the model was trained for.
    #[error(
        "map is {got} ({cells} cells), the model needs {expected}\n\nhint: make maps with the waveform and the map spec that the model names"
    )]
    Shape {
        /// Shape that is needed.
        expected: RdmShape,
        /// Shape of the map.
        got: RdmShape,
        /// Number of its cells.
        cells: usize,
    },
    /// The map holds NaN or infinity.
    #[error("map of frame {sequence}: {cells} cells are not finite, the first at index {first}; it is not classified")]
    NonFinite {
        /// Sequence number of its frame.
        sequence: u64,
        /// How many cells.
        cells: usize,
        /// Index of the first in `db`.
        first: usize,
    },
    /// The model was told the label of every map that it has seen.
    #[error(
        "the model standardises maps by scene and class, so it can only be asked about maps whose labels are known\n\nhint: evaluate it on a dataset, or train without label_leaking_cells"
    )]
    NeedsLabels,
    /// The network's answer is no number.
    #[error("the network's answer is not finite, cells of the map reach {largest_db} dB in magnitude")]
    Diverged {
        /// Largest magnitude of a cell.
        largest_db: f32,
    },
    /// A map could not be read.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// A tensor operation failed.
    #[error("network: {0}")]
    Network(#[from] candle_core::Error),
}

impl Classifier {
    /// Loads a model file.
    pub fn load(path: &Path) -> Result<Self, ModelError> {
        Ok(Self::new(Model::load(path)?))
    }

    /// Puts a model to work.
    pub fn new(model: Model) -> Self {
        Classifier { model }
    }

    /// Waveform that maps must come from.
    pub fn waveform(&self) -> &Waveform {
        &self.model.card.waveform
    }

    /// How maps must be made.
    pub fn rdm_spec(&self) -> &RdmSpec {
        &self.model.card.rdm_spec
    }

    /// Everything about the model but its numbers.
    pub fn card(&self) -> &ModelCard {
        &self.model.card
    }

    /// The model itself.
    pub fn model(&self) -> &Model {
        &self.model
    }

    /// Gives the model back.
    pub fn into_model(self) -> Model {
        self.model
    }

    /// Probabilities of empty, one, two; they sum to one.
    pub fn classify(&mut self, map: &Rdm) -> Result<[f32; 3], ClassifyError> {
        self.check_unlabelled()?;
        self.check_sequence(&map.db, map.shape, map.sequence)?;
        self.run(&map.db, map.shape, None)
    }

    /// The numbers that the HQNN reduces the map to before the circuit, before their standardisation; none for other networks.
    pub fn latent(&mut self, map: &Rdm) -> Result<Vec<f32>, ClassifyError> {
        self.check_unlabelled()?;
        self.check_sequence(&map.db, map.shape, map.sequence)?;
        let input = self.input(&map.db, map.shape, None)?;
        Ok(match self.model.network.latent(&input)? {
            Some(latent) => latent.flatten_all()?.to_vec1()?,
            None => Vec::new(),
        })
    }

    /// [`Classifier::classify`] for bare cells `[rx][doppler][range]` dB.
    pub fn classify_cells(&mut self, db: &[f32], shape: RdmShape) -> Result<[f32; 3], ClassifyError> {
        self.check_unlabelled()?;
        self.check_sequence(db, shape, 0)?;
        self.run(db, shape, None)
    }

    /// The same for a map of a dataset, whose row tells scene and label to models that cannot do without.
    pub fn classify_row(&mut self, db: &[f32], shape: RdmShape, row: &ManifestRow) -> Result<[f32; 3], ClassifyError> {
        self.check_sequence(db, shape, row.frame)?;
        self.run(db, shape, Some((&row.scene, row.label)))
    }

    fn check_unlabelled(&self) -> Result<(), ClassifyError> {
        if self.model.card.standardisation.needs_labels() { Err(ClassifyError::NeedsLabels) } else { Ok(()) }
    }

    fn expected_shape(&self) -> RdmShape {
        let card = &self.model.card;
        let [_, rows, columns] = card.input_shape;
        let (range, doppler) = if card.is_transposed() { (columns, rows) } else { (rows, columns) };
        RdmShape { rx: 1, doppler, range }
    }

    fn check_sequence(&self, db: &[f32], got: RdmShape, sequence: u64) -> Result<(), ClassifyError> {
        let expected = self.expected_shape();
        if got != expected || db.len() != expected.cells() {
            return Err(ClassifyError::Shape { expected, got, cells: db.len() });
        }
        match db.iter().position(|v| !v.is_finite()) {
            Some(first) => {
                let cells = db.iter().filter(|v| !v.is_finite()).count();
                Err(ClassifyError::NonFinite { sequence, cells, first })
            }
            None => Ok(()),
        }
    }

    /// Probabilities of a map that has been checked.
    fn run(&self, db: &[f32], shape: RdmShape, of: Option<(&str, Occupancy)>) -> Result<[f32; 3], ClassifyError> {
        let input = self.input(db, shape, of)?;
        let logits: Vec<f32> = self.model.network.logits(&input)?.flatten_all()?.to_vec1()?;
        let probabilities = softmax(&logits, self.model.card.temperature);
        match probabilities.as_slice() {
            &[p, q, r] if [p, q, r].iter().all(|v| v.is_finite()) => Ok([p as f32, q as f32, r as f32]),
            _ => Err(ClassifyError::Diverged { largest_db: db.iter().fold(0.0, |m, v| m.max(v.abs())) }),
        }
    }

    /// What the network sees of a map: standardised, `[1][range][doppler]`.
    fn input(&self, db: &[f32], shape: RdmShape, of: Option<(&str, Occupancy)>) -> Result<Tensor, ClassifyError> {
        let wrong_shape = || ClassifyError::Shape { expected: self.expected_shape(), got: shape, cells: db.len() };
        let mut input = network_input(db, shape, 0).ok_or_else(wrong_shape)?;
        self.model.card.standardisation.apply(&mut input, shape.doppler, of);
        let input = Tensor::from_vec(input, (1, shape.range, shape.doppler), &Device::Cpu)?;
        Ok(if self.model.card.is_transposed() { input.transpose(1, 2)?.contiguous()? } else { input })
    }
}
