//! Model files, safetensors with a card in the metadata, and the built-in model.

use std::borrow::Cow;
use std::collections::{BTreeMap, HashMap};
use std::path::Path;

use radome_files::MODEL_LIMIT_BYTES;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};

use super::card::{CARD_KEY, ModelCard, ModelError};
use crate::array_hash::{self, Damaged};
use crate::atomic_file;
use crate::kernel::KernelLevel;
use crate::layer::{DESCRIPTORS, EARLIER_DESCRIPTORS};
use crate::network::Network;

/// Name of the built-in model. It accepts frames of nearly any waveform.
pub const BUILT_IN: &str = "room-hqnn";
static BUILT_IN_FILE: &[u8] = include_bytes!("../../../fixtures/models/room-hqnn.safetensors");

/// A network with its card.
pub struct Model {
    /// Card of the network.
    pub card: ModelCard,
    /// Network with its numbers.
    pub network: Network,
}

/// Returns whether a file is ONNX by its extension.
pub(crate) fn is_onnx(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("onnx"))
}

/// Returns whether a name is that of the built-in model, with no file of that name.
pub fn is_built_in(name: &Path) -> bool {
    name == Path::new(BUILT_IN) && !name.exists()
}

/// Reads the bytes of a model file, or of the built-in model by its name.
///
/// # Errors
/// [`ModelError::Io`] if the file cannot be read or has more than [`MODEL_LIMIT_BYTES`].
pub fn read(path: &Path) -> Result<Cow<'static, [u8]>, ModelError> {
    if is_built_in(path) {
        return Ok(Cow::Borrowed(BUILT_IN_FILE));
    }
    let data = radome_files::read(path, MODEL_LIMIT_BYTES);
    data.map(Cow::Owned).map_err(|source| ModelError::Io { path: path.to_owned(), action: "reading", source })
}

impl Model {
    /// Writes the model under a temporary name and renames it, so that the file is always complete. An existing file is replaced.
    ///
    /// # Errors
    /// Those of [`Model::to_bytes`], and [`ModelError::Io`] if the file cannot be written.
    pub fn save(&self, path: &Path) -> Result<(), ModelError> {
        let data = self.to_bytes(path)?;
        atomic_file::write(path, &data).map_err(|source| ModelError::Io {
            path: path.to_owned(),
            action: "writing",
            source,
        })
    }

    /// Returns the bytes of the file `path` (used in errors only).
    ///
    /// # Errors
    /// [`ModelError::Card`] if the card cannot be written as JSON, [`ModelError::Network`] if the numbers cannot be read, and
    /// [`ModelError::NotSafetensors`] if they are too many for the format.
    pub fn to_bytes(&self, path: &Path) -> Result<Vec<u8>, ModelError> {
        let values = self.network.values()?;
        let arrays = self.network.spec().layout().into_iter().map(|(name, shape)| {
            let numbers = values.get(&name).map(Vec::as_slice).unwrap_or_default();
            (name, shape, numbers.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>())
        });
        let arrays: Vec<_> = arrays.collect();
        let mut views = Vec::new();
        for (name, shape, bytes) in &arrays {
            let view = TensorView::new(Dtype::F32, shape.clone(), bytes).map_err(|e| not_safetensors(path, 0, e))?;
            views.push((name, view));
        }
        let named_bytes = arrays.iter().map(|(name, _, bytes)| (name.as_str(), bytes.as_slice()));
        let card = array_hash::to_json(&self.card, named_bytes);
        let card = card.map_err(|source| ModelError::Card { path: path.to_owned(), source })?;
        let metadata = HashMap::from([(CARD_KEY.to_owned(), card)]);
        safetensors::serialize(views, Some(metadata)).map_err(|e| not_safetensors(path, 0, e))
    }

    /// Reads a model file, or the built-in model by its name, and checks that it is complete and consistent.
    ///
    /// # Errors
    /// [`ModelError::Io`] if the file cannot be read or has more than [`MODEL_LIMIT_BYTES`], and those of [`Model::from_bytes`].
    pub fn load(path: &Path) -> Result<Self, ModelError> {
        Self::from_bytes(path, &read(path)?)
    }

    /// Reads a model from the bytes of the file `path` (used in errors only).
    ///
    /// # Errors
    /// [`ModelError`] if the bytes are no safetensors, have no card, or if card and arrays contradict each other or hold numbers
    /// that are not finite, and [`ModelError::Hash`] or [`ModelError::CardHash`] if numbers or card are not those that were written.
    pub fn from_bytes(path: &Path, data: &[u8]) -> Result<Self, ModelError> {
        let text = card_text(path, data)?;
        let card = ModelCard::parse(path, &text)?;
        let tensors = SafeTensors::deserialize(data).map_err(|e| not_safetensors(path, data.len(), e))?;
        let spec = card.network_spec();
        let (mut values, mut arrays) = (BTreeMap::new(), BTreeMap::new());
        for (name, shape) in spec.layout() {
            let inconsistent = |found: String| ModelError::Inconsistent {
                path: path.to_owned(),
                what: format!("tensor {name}"),
                expected: format!("F32 {shape:?}, finite"),
                found,
            };
            let view = tensors.tensor(&name).map_err(|e| inconsistent(e.to_string()))?;
            let earlier = match *shape {
                [rows, DESCRIPTORS] => EARLIER_DESCRIPTORS.into_iter().find(|&count| view.shape() == [rows, count]),
                _ => None,
            };
            if view.dtype() != Dtype::F32 || (view.shape() != shape && earlier.is_none()) {
                return Err(inconsistent(format!("{:?} {:?}", view.dtype(), view.shape())));
            }
            let mut numbers: Vec<f32> = view.data().as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
            if let Some(count) = earlier {
                // Descriptors that were added later have no weight.
                let row = |row: &[f32]| [row, &[0.0; DESCRIPTORS][count..]].concat();
                numbers = numbers.chunks(count).flat_map(row).collect();
            }
            let bad = numbers.iter().filter(|v| !v.is_finite()).count();
            if bad > 0 {
                return Err(inconsistent(format!("{bad} values that are NaN or infinite")));
            }
            arrays.insert(name.clone(), view.data());
            values.insert(name, numbers);
        }
        let named_bytes = arrays.iter().map(|(name, bytes)| (name.as_str(), *bytes));
        check_hash(path, &text, named_bytes)?;
        let mut network = Network::from_values(&spec, &values, KernelLevel::detect())?;
        network.set_latent_constants(card.latent.clone());
        Ok(Model { card, network })
    }
}

impl ModelCard {
    /// Card in the bytes of the safetensors file `path` (used in errors only).
    pub(super) fn of_safetensors(path: &Path, data: &[u8]) -> Result<Self, ModelError> {
        Self::parse(path, &card_text(path, data)?)
    }
}

/// Card as JSON in the bytes of the safetensors file `path` (used in errors only).
fn card_text(path: &Path, data: &[u8]) -> Result<String, ModelError> {
    let (_, header) = SafeTensors::read_metadata(data).map_err(|e| not_safetensors(path, data.len(), e))?;
    let text = header.metadata().as_ref().and_then(|metadata| metadata.get(CARD_KEY));
    text.cloned().ok_or_else(|| ModelError::NoCard { path: path.to_owned() })
}

/// Compares the arrays of the file `path` (used in errors only) with the hash in its card, which files of earlier versions lack.
pub(super) fn check_hash<'a>(
    path: &Path,
    card: &str,
    arrays: impl IntoIterator<Item = (&'a str, &'a [u8])>,
) -> Result<(), ModelError> {
    let damaged = array_hash::check(card, arrays);
    match damaged.map_err(|source| ModelError::Card { path: path.to_owned(), source })? {
        Some(Damaged { expected, found }) => Err(ModelError::Hash { path: path.to_owned(), expected, found }),
        None => Ok(()),
    }
}

fn not_safetensors(path: &Path, length: usize, error: impl std::fmt::Display) -> ModelError {
    ModelError::NotSafetensors { path: path.to_owned(), reason: error.to_string(), length }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// In the model of a file with fewer descriptors, later descriptors have weight zero.
    #[test]
    fn files_with_fewer_descriptors_are_read() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fixtures/models/room-linear.safetensors");
        let Model { card, network } = Model::load(&path).expect("a shipped model");
        let values = network.values().expect("numbers");
        let bytes = |numbers: Vec<f32>| -> Vec<u8> { numbers.iter().flat_map(|v| v.to_le_bytes()).collect() };
        let bias = bytes(values["head.bias"].clone());
        for count in EARLIER_DESCRIPTORS {
            let rows = || values["head.weight"].chunks(DESCRIPTORS).map(|row| &row[..count]);
            let weight = bytes(rows().flatten().copied().collect());
            let view = |shape: &[usize], data| TensorView::new(Dtype::F32, shape.to_vec(), data).expect("a tensor");
            let views = [("head.weight", view(&[3, count], &weight)), ("head.bias", view(&[3], &bias))];
            // Cards of these files have no hash of the arrays.
            let metadata = HashMap::from([(CARD_KEY.to_owned(), serde_json::to_string(&card).expect("a card"))]);
            let file = safetensors::serialize(views, Some(metadata)).expect("a file");
            let read = Model::from_bytes(Path::new("older.safetensors"), &file).expect("read");
            let expected: Vec<f32> = rows().flat_map(|row| [row, &[0.0; DESCRIPTORS][count..]].concat()).collect();
            let found = read.network.values().expect("numbers");
            assert_eq!((&found["head.weight"], &found["head.bias"]), (&expected, &values["head.bias"]));
        }
    }
}
