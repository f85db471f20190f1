//! Checks of an ONNX file before a runtime gets it: that it is whole, that its numbers are finite, and its card.

use std::path::Path;

use prost::Message;

use super::proto::{self, FLOAT};
use crate::model::card::{CARD_KEY, ModelCard, ModelError};

/// The card in the bytes of the ONNX file `path` (used in errors only), whose numbers are checked to be finite.
pub(crate) fn read_card(path: &Path, data: &[u8]) -> Result<ModelCard, ModelError> {
    let damaged = |reason: String| ModelError::NotOnnx { path: path.to_owned(), reason, length: data.len() };
    // Decodes one message at a time: an empty one of two bytes takes a hundred bytes of memory, and there may be any number.
    let (mut is_graph, mut card) = (false, None);
    for field in Fields(data) {
        match field.map_err(&damaged)? {
            (GRAPH, _) => is_graph = true,
            (METADATA, content) if card.is_none() => {
                let entry = proto::Entry::decode(content).map_err(|error| damaged(error.to_string()))?;
                card = (entry.key == CARD_KEY).then_some(entry.value);
            }
            _ => {}
        }
    }
    if !is_graph {
        return Err(damaged("it holds no graph".to_owned()));
    }
    let Some(card) = card else { return Err(ModelError::NoCard { path: path.to_owned() }) };
    for field in Fields(data) {
        let (GRAPH, graph) = field.map_err(&damaged)? else { continue };
        for field in Fields(graph) {
            let (INITIALIZER, content) = field.map_err(&damaged)? else { continue };
            let tensor = proto::Tensor::decode(content).map_err(|error| damaged(error.to_string()))?;
            if tensor.data_type != FLOAT {
                continue;
            }
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
    }
    ModelCard::parse(path, &card)
}

/// Field numbers of `ModelProto` and `GraphProto`, as in [`proto`].
const GRAPH: u64 = 7;
const METADATA: u64 = 14;
const INITIALIZER: u64 = 5;

/// Iterator over the fields of a protobuf message: field number, and content of length-delimited fields (empty for others). It ends
/// at the first damaged field.
struct Fields<'a>(&'a [u8]);

impl<'a> Fields<'a> {
    fn bytes(&mut self, count: u64) -> Result<&'a [u8], String> {
        let split = usize::try_from(count).ok().and_then(|count| self.0.split_at_checked(count));
        let (bytes, rest) =
            split.ok_or_else(|| format!("a field has {count} bytes where {} are left", self.0.len()))?;
        self.0 = rest;
        Ok(bytes)
    }

    fn varint(&mut self) -> Result<u64, String> {
        let mut value = 0;
        for shift in (0..64).step_by(7) {
            let byte = self.bytes(1)?.first().copied().unwrap_or_default();
            value |= u64::from(byte & 0x7F) << shift;
            if byte < 0x80 {
                return Ok(value);
            }
        }
        Err("a number has more than ten bytes".to_owned())
    }

    fn field(&mut self) -> Result<(u64, &'a [u8]), String> {
        const NONE: &[u8] = &[];
        let key = self.varint()?;
        let number = key >> 3;
        match key & 7 {
            0 => self.varint().map(|_| (number, NONE)),
            1 => self.bytes(8).map(|_| (number, NONE)),
            2 => {
                let length = self.varint()?;
                self.bytes(length).map(|content| (number, content))
            }
            5 => self.bytes(4).map(|_| (number, NONE)),
            other => Err(format!("a field has the wire type {other}")),
        }
    }
}

impl<'a> Iterator for Fields<'a> {
    type Item = Result<(u64, &'a [u8]), String>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.0.is_empty() {
            return None;
        }
        let field = self.field();
        if field.is_err() {
            self.0 = &[];
        }
        Some(field)
    }
}
