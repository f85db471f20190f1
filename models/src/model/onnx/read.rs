//! Checks of an ONNX file before a runtime loads it: it is complete, its numbers are finite, its card is valid, and both match their
//! hashes.

use std::path::Path;

use prost::Message;

use super::proto::{self, FLOAT};
use crate::model::card::{CARD_KEY, ModelCard, ModelError};
use crate::model::file::check_hash;

/// Reads the card in the bytes of the ONNX file `path` (used in errors only). Checks that numbers are finite, and that numbers and card
/// match the hashes in the card, if it has them.
pub(crate) fn read_card(path: &Path, data: &[u8]) -> Result<ModelCard, ModelError> {
    let damaged = |reason: String| ModelError::NotOnnx { path: path.to_owned(), reason, length: data.len() };
    // Decodes one message at a time: an empty message of two bytes takes a hundred bytes of memory, and a file may have any number.
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
    let parsed = ModelCard::parse(path, &card)?;
    check_hash(path, &card, arrays(data))?;
    Ok(parsed)
}

/// Field numbers of `ModelProto`, `GraphProto` and `TensorProto`, as in [`proto`].
const GRAPH: u64 = 7;
const METADATA: u64 = 14;
const INITIALIZER: u64 = 5;
const NAME: u64 = 8;
const RAW_DATA: u64 = 9;

/// Names and bytes of the arrays of a file.
fn arrays(data: &[u8]) -> impl Iterator<Item = (&str, &[u8])> {
    let tensors = contents(data, GRAPH).flat_map(|graph| contents(graph, INITIALIZER));
    tensors.map(|tensor| {
        let last = |number| contents(tensor, number).last().unwrap_or_default();
        (std::str::from_utf8(last(NAME)).unwrap_or_default(), last(RAW_DATA))
    })
}

/// Contents of the fields of a message that have this number.
fn contents(message: &[u8], number: u64) -> impl Iterator<Item = &[u8]> {
    Fields(message).filter_map(Result::ok).filter(move |(found, _)| *found == number).map(|(_, content)| content)
}

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
