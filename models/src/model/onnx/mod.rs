//! Networks as ONNX (opset 17), for runtimes and tools elsewhere.
//!
//! The input `map` is `[batch][1][range][doppler]`, standardised; the output `logits` is `[batch][3]`. The metadata
//! contain the model's card under `radome`, so that the file can replace the model file. Files of earlier versions have range and
//! Doppler exchanged where the network sees them so; `axes` in the card then has that order. Logits are divided by the card's
//! `temperature` before the softmax, and averaged over its `memory_s` ([`EvidenceMean`](crate::evidence_mean::EvidenceMean)).
//!
//! Operations that ONNX lacks are matrix products: adaptive pooling multiplies by matrices of means from both sides, and a circuit
//! consists of phases, a trained real matrix and squares (`circuit`).

mod circuit;
mod export;
pub mod proto;
mod read;
mod writer;

pub use super::onnx_runtime::{INPUT_NAME, OUTPUT_NAME};
pub use export::{export, export_network};
pub(crate) use read::read_card;
pub use writer::ExportError;
