//! Parts of an ONNX file that are read without a runtime.

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|input: &[u8]| radome_fuzz::check_onnx(input));
