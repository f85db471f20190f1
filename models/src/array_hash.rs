//! Hash of the arrays of a model file (`.safetensors` or `.onnx`) or a checkpoint, which detects damaged numbers. It is stored in
//! the file's metadata. It covers neither the metadata themselves nor the operators of an ONNX file.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

/// Metadata as written: their content and the hash.
#[derive(Serialize)]
struct WithHash<'a, T> {
    #[serde(flatten)]
    content: &'a T,
    arrays_sha256: String,
}

/// Hash as read from metadata; files of earlier versions have none.
#[derive(Deserialize)]
struct StoredHash {
    arrays_sha256: Option<String>,
}

/// Difference between the arrays and their hash.
pub(crate) struct Damaged {
    /// Hash in the metadata.
    pub expected: String,
    /// Hash of the arrays.
    pub found: String,
}

/// Metadata as JSON, with the hash of the arrays, which are pairs of name and bytes.
pub(crate) fn to_json<'a, T: Serialize>(
    content: &T,
    arrays: impl IntoIterator<Item = (&'a str, &'a [u8])>,
) -> serde_json::Result<String> {
    serde_json::to_string(&WithHash { content, arrays_sha256: hash(arrays) })
}

/// Compares arrays with the hash in their metadata; `None` if they agree, or if there is no hash.
pub(crate) fn check<'a>(
    metadata: &str,
    arrays: impl IntoIterator<Item = (&'a str, &'a [u8])>,
) -> serde_json::Result<Option<Damaged>> {
    let StoredHash { arrays_sha256 } = serde_json::from_str(metadata)?;
    let Some(expected) = arrays_sha256 else { return Ok(None) };
    let found = hash(arrays);
    Ok((found != expected).then_some(Damaged { expected, found }))
}

/// SHA-256 over names and bytes of all arrays, sorted by name, hex.
fn hash<'a>(arrays: impl IntoIterator<Item = (&'a str, &'a [u8])>) -> String {
    let by_name: BTreeMap<&str, &[u8]> = arrays.into_iter().collect();
    let mut hash = Sha256::new();
    for (name, bytes) in by_name {
        hash.update(name.as_bytes());
        hash.update(bytes);
    }
    format!("{:x}", hash.finalize())
}
