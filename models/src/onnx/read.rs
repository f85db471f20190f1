//! What of an ONNX file has to be understood before it is handed to a runtime: that it is whole, and its card.

use std::path::Path;

use prost::Message;

use super::{FLOAT, proto};
use crate::model_file::{CARD_KEY, ModelCard, ModelError};

/// The card in the bytes of the ONNX file `path` (used in errors only), whose numbers are checked to be finite.
pub(crate) fn read_card(path: &Path, data: &[u8]) -> Result<ModelCard, ModelError> {
    let damaged = |reason: String| ModelError::NotOnnx { path: path.to_owned(), reason, length: data.len() };
    let model = proto::Model::decode(data).map_err(|error| damaged(error.to_string()))?;
    let Some(graph) = &model.graph else { return Err(damaged("it holds no graph".to_owned())) };
    let Some(entry) = model.metadata.iter().find(|entry| entry.key == CARD_KEY) else {
        return Err(ModelError::NoCard { path: path.to_owned() });
    };
    for tensor in graph.initializer.iter().filter(|tensor| tensor.data_type == FLOAT) {
        let numbers = tensor.raw_data.as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes));
        let bad = numbers.filter(|v| !v.is_finite()).count();
        if bad > 0 {
            return Err(ModelError::Inconsistent {
                path: path.to_owned(),
                what: format!("tensor {}", tensor.name),
                expected: "finite numbers".to_owned(),
                found: format!("{bad} values that are NaN or infinite"),
            });
        }
    }
    ModelCard::parse(path, &entry.value)
}
