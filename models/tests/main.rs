//! Tests of models through the public API, in one program, so that it is linked once.

mod filter_on_ladder;
mod hostile_files;
mod onnx;
mod study;
mod support;
mod training;
