//! Model file: it survives a round trip, or gives an error.

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|input: &[u8]| radome_fuzz::check_model(input));
