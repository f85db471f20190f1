//! Classification of maps by a trained model.

use std::collections::BTreeSet;
use std::path::Path;

use radome_dsp::rdm::Motion;
use radome_dsp::{Occupancy, Rdm, RdmShape, RdmSpec, Waveform};
use thiserror::Error;

use super::card::{ModelCard, ModelError};
use super::file::{Model, is_onnx, read};
use super::onnx::read_card;
use super::onnx_runtime::{OnnxError, OnnxSession};
use crate::dataset::{DatasetError, ManifestRow, network_input};
use crate::kernel::depthwise::transposed;
use crate::layer::softmax;
use crate::network::Inference;

/// Model that classifies maps one by one: a network of this crate, or an ONNX file in onnxruntime.
///
/// # Examples
/// ```no_run
/// use std::path::Path;
///
/// use radome_dsp::Rdm;
/// use radome_models::Classifier;
///
/// fn probability_of_people(map: &Rdm) -> Result<f32, Box<dyn std::error::Error>> {
///     let mut classifier = Classifier::load(Path::new("model.safetensors"))?;
///     let [_, one, two] = classifier.classify(map)?;
///     Ok(one + two)
/// }
/// ```
pub struct Classifier(Engine);

// A program has one classifier, so the size does not matter.
#[allow(clippy::large_enum_variant)]
enum Engine {
    Native {
        model: Model,
        /// Prepared network, made at the first map.
        inference: Option<Inference>,
    },
    Onnx {
        card: ModelCard,
        session: OnnxSession,
    },
}

impl Engine {
    /// Logits of the network's input for one map `[row][column]`.
    fn logits(&mut self, input: &[f32], rows: usize, columns: usize) -> Result<Vec<f32>, ClassifyError> {
        match self {
            Engine::Native { model, inference } => {
                let inference = match inference {
                    Some(inference) => inference,
                    None => inference.insert(Inference::new(&model.network)?),
                };
                let [rows, columns] = model.card.network.input_size([rows, columns]);
                Ok(inference.logits(input, [1, rows, columns])?.to_vec())
            }
            Engine::Onnx { session, .. } => Ok(session.logits(input)?),
        }
    }
}

/// Error of the classification of a map.
#[derive(Debug, Error)]
#[allow(missing_docs, reason = "the message says what each field is")]
pub enum ClassifyError {
    /// The map has another shape than the model was trained for.
    #[error(
        "map is {got} ({cells} cells), the model needs {expected}\n\nhint: make maps with the waveform and the map spec that the model names"
    )]
    Shape { expected: RdmShape, got: RdmShape, cells: usize },
    /// The maps were made by other settings, or of the frames of another waveform, than the model was trained on: the difference, and
    /// what was expected.
    #[error("{what}\n\nhint: make the maps with the waveform and the map spec that the model names")]
    OtherMaps { what: String },
    /// The map holds NaN or infinity, `first` at this index of `db`.
    #[error("map of frame {sequence}: {cells} cells are not finite, the first at index {first}; it is not classified")]
    NonFinite { sequence: u64, cells: usize, first: usize },
    /// The model standardises maps by scene and class, so it needs labels.
    #[error(
        "the model standardises maps by scene and class, so it classifies only maps with known labels\n\nhint: evaluate it on a dataset, or train without label_leaking_cells"
    )]
    NeedsLabels,
    /// The output of the network holds a number that is not finite.
    #[error("the network's output is not finite; cells of the map reach {largest_db} dB in magnitude")]
    Diverged { largest_db: f32 },
    /// A map could not be read.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// An ONNX network failed.
    #[error(transparent)]
    Onnx(#[from] OnnxError),
    /// A tensor operation failed.
    #[error("network: {0}")]
    Network(#[from] candle_core::Error),
}

/// Settings in which a map spec differs from the expected one, as text. Settings that are absent are null.
fn differences(got: &RdmSpec, expected: &RdmSpec) -> String {
    let settings = |spec: &RdmSpec| serde_json::to_value(spec).unwrap_or_default();
    let (got, expected) = (settings(got), settings(expected));
    // Absent settings are not serialised, so the keys of both count.
    let keys: BTreeSet<&String> =
        [&got, &expected].into_iter().flat_map(|spec| spec.as_object()).flat_map(|spec| spec.keys()).collect();
    let different = keys.into_iter().filter(|key| got.get(key) != expected.get(key));
    let value = |spec: &serde_json::Value, key: &str| spec.get(key).cloned().unwrap_or_default();
    let texts = different.map(|key| format!("{key} {} instead of {}", value(&got, key), value(&expected, key)));
    texts.collect::<Vec<_>>().join(", ")
}

impl Classifier {
    /// Loads a model file: safetensors, or ONNX if its name ends in `.onnx`, which needs onnxruntime. The name of the built-in model
    /// loads that.
    ///
    /// # Errors
    /// [`ModelError`] if the file cannot be read, is damaged, has no card or contradicts it, and [`ModelError::Onnx`] if
    /// onnxruntime is missing or refuses an ONNX file.
    pub fn load(path: &Path) -> Result<Self, ModelError> {
        if !is_onnx(path) {
            return Ok(Self::new(Model::load(path)?));
        }
        let data = read(path)?;
        let card = read_card(path, &data)?;
        let [_, rows, columns] = card.input_shape;
        let session = OnnxSession::new(path, &data, rows, columns)?;
        Ok(Classifier(Engine::Onnx { card, session }))
    }

    /// Makes a classifier of a model.
    pub fn new(model: Model) -> Self {
        Classifier(Engine::Native { model, inference: None })
    }

    /// Waveform that maps must come from, or with physical axes the nominal one ([`ModelCard::waveform`]).
    pub fn waveform(&self) -> &Waveform {
        &self.card().waveform
    }

    /// Settings by which maps must be made.
    pub fn rdm_spec(&self) -> &RdmSpec {
        &self.card().rdm_spec
    }

    /// Everything about the model but its numbers.
    pub fn card(&self) -> &ModelCard {
        match &self.0 {
            Engine::Native { model, .. } => &model.card,
            Engine::Onnx { card, .. } => card,
        }
    }

    /// The model; `None` for ONNX files.
    pub fn model(&self) -> Option<&Model> {
        match &self.0 {
            Engine::Native { model, .. } => Some(model),
            Engine::Onnx { .. } => None,
        }
    }

    /// Returns the model; `None` for ONNX files.
    pub fn into_model(self) -> Option<Model> {
        match self.0 {
            Engine::Native { model, .. } => Some(model),
            Engine::Onnx { .. } => None,
        }
    }

    /// Probabilities of empty, one, two; they sum to one.
    ///
    /// # Errors
    /// [`ClassifyError`] if the model needs labels, the map has another shape or a cell that is not finite, or the network fails or
    /// puts out a number that is not finite.
    pub fn classify(&mut self, map: &Rdm) -> Result<[f32; 3], ClassifyError> {
        let input = self.card().unlabelled_input(&map.db, map.shape, map.motion, map.sequence)?;
        self.run(&map.db, &input)
    }

    /// [`Classifier::classify`] for the cells `[rx][doppler][range]`, dB, of a map of a dataset. `row` has the scene and the label for
    /// models that need them.
    ///
    /// # Errors
    /// Those of [`Classifier::classify`], except [`ClassifyError::NeedsLabels`].
    pub fn classify_row(&mut self, db: &[f32], shape: RdmShape, row: &ManifestRow) -> Result<[f32; 3], ClassifyError> {
        let input = self.card().input(db, shape, row.motion, row.frame, Some((&row.scene, row.label)))?;
        self.run(db, &input)
    }

    /// Probabilities of a map from the network's input, `db` being its cells for the error.
    fn run(&mut self, db: &[f32], input: &[f32]) -> Result<[f32; 3], ClassifyError> {
        let [_, rows, columns] = self.card().input_shape;
        let logits = self.0.logits(input, rows, columns)?;
        let probabilities = softmax(&logits, self.card().temperature);
        match probabilities.as_slice() {
            &[p, q, r] if [p, q, r].iter().all(|v| v.is_finite()) => Ok([p as f32, q as f32, r as f32]),
            _ => Err(ClassifyError::Diverged { largest_db: db.iter().fold(0.0, |m, v| m.max(v.abs())) }),
        }
    }
}

impl ModelCard {
    /// The card of a model file, safetensors or ONNX, without its numbers, or of the built-in model by its name.
    ///
    /// # Errors
    /// [`ModelError`] if the file cannot be read, has more than [`MODEL_LIMIT_BYTES`](crate::MODEL_LIMIT_BYTES), is damaged, has no
    /// card, or the card makes no sense.
    pub fn load(path: &Path) -> Result<Self, ModelError> {
        let data = read(path)?;
        if is_onnx(path) { read_card(path, &data) } else { Self::of_safetensors(path, &data) }
    }

    /// Checks that `spec` makes the same kind of maps of the frames of `waveform` as the model was trained on. They may end at a nearer
    /// range ([`RdmSpec::max_range_m`]): people beyond it then do not count. Motion counts only for networks that read it.
    ///
    /// # Errors
    /// [`ClassifyError::OtherMaps`] if a setting differs, or the waveform does not fit.
    pub fn check_maps(&self, spec: &RdmSpec, waveform: &Waveform) -> Result<(), ClassifyError> {
        let mut expected = RdmSpec { max_range_m: spec.max_range_m, ..self.rdm_spec };
        if !self.network.reads_descriptors() {
            expected.motion_over_s = spec.motion_over_s;
        }
        if *spec != expected {
            let what = format!("the maps were made with {}", differences(spec, &expected));
            return Err(ClassifyError::OtherMaps { what });
        }
        let checked = spec.check_compatible(waveform, &self.waveform);
        checked.map_err(|mismatch| ClassifyError::OtherMaps { what: mismatch.to_string() })
    }

    /// Input of the network for a map without a label.
    pub(crate) fn unlabelled_input(
        &self,
        db: &[f32],
        shape: RdmShape,
        motion: Option<Motion>,
        sequence: u64,
    ) -> Result<Vec<f32>, ClassifyError> {
        if self.standardisation.needs_labels() {
            return Err(ClassifyError::NeedsLabels);
        }
        self.input(db, shape, motion, sequence, None)
    }

    /// Input of the network for a map: standardised, `[range][doppler]` or transposed by the card, or descriptors.
    fn input(
        &self,
        db: &[f32],
        got: RdmShape,
        motion: Option<Motion>,
        sequence: u64,
        scene_and_class: Option<(&str, Occupancy)>,
    ) -> Result<Vec<f32>, ClassifyError> {
        let [_, range, doppler] = self.map_shape();
        let expected = RdmShape { rx: 1, doppler, range };
        let raw_input = Some(got).filter(|got| *got == expected).and_then(|shape| network_input(db, shape, 0));
        let Some(mut input) = raw_input else {
            return Err(ClassifyError::Shape { expected, got, cells: db.len() });
        };
        if let Some(first) = db.iter().position(|v| !v.is_finite()) {
            let cells = db.iter().filter(|v| !v.is_finite()).count();
            return Err(ClassifyError::NonFinite { sequence, cells, first });
        }
        if self.network.reads_descriptors() && motion.is_some() != self.rdm_spec.motion_over_s.is_some() {
            let what = if motion.is_some() { "motion" } else { "no motion" };
            let what = format!("the map has {what} over frames (motion_over_s)");
            return Err(ClassifyError::OtherMaps { what });
        }
        self.standardisation.apply(&mut input, doppler, scene_and_class);
        if self.is_transposed() {
            input = transposed(&input, doppler);
        }
        Ok(self.network.input(input, motion, doppler))
    }
}
