//! Hashes of the arrays and of the metadata of a model file (`.safetensors` or `.onnx`) or a checkpoint, which detect damage. They
//! are stored in the metadata. They do not cover the operators of an ONNX file.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

/// Metadata as written: their content and the hash of the arrays. The hash of this text follows as the last key.
#[derive(Serialize)]
struct WithHash<'a, T> {
    #[serde(flatten)]
    content: &'a T,
    arrays_sha256: String,
}

/// Hashes as read from metadata; files of earlier versions lack one or both.
#[derive(Deserialize)]
struct StoredHashes {
    arrays_sha256: Option<String>,
    text_sha256: Option<String>,
}

/// Difference between the arrays or the metadata and their hash.
pub(crate) struct Damaged {
    /// Hash in the metadata.
    pub expected: String,
    /// Hash of what the file holds.
    pub found: String,
}

/// Metadata as JSON, with the hash of the arrays, which are pairs of name and bytes, and the hash of the text before it.
pub(crate) fn to_json<'a, T: Serialize>(
    content: &T,
    arrays: impl IntoIterator<Item = (&'a str, &'a [u8])>,
) -> serde_json::Result<String> {
    let text = serde_json::to_string(&WithHash { content, arrays_sha256: hash(arrays) })?;
    let open = text.strip_suffix('}').unwrap_or(&text);
    Ok(format!("{open}{}", text_hash_entry(&text_hash(open))))
}

/// Last key of metadata, with the end of their object.
fn text_hash_entry(hash: &str) -> String {
    format!(r#","text_sha256":"{hash}"}}"#)
}

/// SHA-256 of a text, hex.
fn text_hash(text: &str) -> String {
    format!("{:x}", Sha256::digest(text))
}

/// Compares the text of metadata with its hash, their last key; `None` if they agree, or if there is no hash.
pub(crate) fn check_text(metadata: &str) -> serde_json::Result<Option<Damaged>> {
    let StoredHashes { text_sha256, .. } = serde_json::from_str(metadata)?;
    let Some(expected) = text_sha256 else { return Ok(None) };
    let entry = text_hash_entry(&expected);
    let found = text_hash(metadata.strip_suffix(entry.as_str()).unwrap_or(metadata));
    Ok((found != expected).then_some(Damaged { expected, found }))
}

/// Compares arrays with the hash in their metadata; `None` if they agree, or if there is no hash.
pub(crate) fn check<'a>(
    metadata: &str,
    arrays: impl IntoIterator<Item = (&'a str, &'a [u8])>,
) -> serde_json::Result<Option<Damaged>> {
    let StoredHashes { arrays_sha256, .. } = serde_json::from_str(metadata)?;
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
