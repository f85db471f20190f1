//! Hash of the arrays of a model file (`.safetensors` or `.onnx`) or a checkpoint. It stands in the file's metadata, beside the other
//! content, so that a flipped bit in a number of an array is noticed. The metadata themselves are not in the hash, nor are the operators
//! of an ONNX file.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

/// Content of the metadata, with the hash.
#[derive(Serialize)]
struct Hashed<'a, T> {
    #[serde(flatten)]
    content: &'a T,
    arrays_sha256: String,
}

/// Hash in the metadata; files of earlier versions have none.
#[derive(Deserialize)]
struct Found {
    arrays_sha256: Option<String>,
}

/// Arrays whose bytes are not those that were written.
pub(crate) struct Damaged {
    /// Hash in the metadata.
    pub expected: String,
    /// Hash of the arrays.
    pub found: String,
}

/// Writes the metadata as JSON, with the hash of the arrays: names and bytes.
pub(crate) fn to_json<'a, T: Serialize>(
    content: &T,
    arrays: impl IntoIterator<Item = (&'a str, &'a [u8])>,
) -> serde_json::Result<String> {
    serde_json::to_string(&Hashed { content, arrays_sha256: hash(arrays) })
}

/// Compares arrays with the hash in their metadata; `None` if they agree, or if there is no hash.
pub(crate) fn check<'a>(
    metadata: &str,
    arrays: impl IntoIterator<Item = (&'a str, &'a [u8])>,
) -> serde_json::Result<Option<Damaged>> {
    let Found { arrays_sha256 } = serde_json::from_str(metadata)?;
    let Some(expected) = arrays_sha256 else { return Ok(None) };
    let found = hash(arrays);
    Ok((found != expected).then_some(Damaged { expected, found }))
}

/// SHA-256 over names and bytes in the order of the names, hex.
fn hash<'a>(arrays: impl IntoIterator<Item = (&'a str, &'a [u8])>) -> String {
    let by_name: BTreeMap<&str, &[u8]> = arrays.into_iter().collect();
    let mut hash = Sha256::new();
    for (name, bytes) in by_name {
        hash.update(name.as_bytes());
        hash.update(bytes);
    }
    format!("{:x}", hash.finalize())
}
