//! Models from outside: one program, so that it is linked once.

mod filter_on_ladder;
mod hostile_files;
mod onnx;
mod study;
mod support;
mod training;
