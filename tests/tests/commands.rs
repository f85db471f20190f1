//! Commands that come to an end, in one program, so that it is linked once.

mod adapt;
mod calibrate;
mod circuit;
mod classical;
mod convert;
mod dataset;
mod documents;
mod features;
mod former_names;
mod hard_cases;
mod imports;
mod json;
mod labels;
mod ladder;
mod learning;
mod maps;
mod onnx;
mod pair;
mod paths;
mod people_hard_cases;
mod program;
mod schemas;
mod simulate;
mod slurm;
mod viewers;
