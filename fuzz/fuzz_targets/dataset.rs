//! Dataset folder with arbitrary files: maps or an error. A dataset that was read completely survives a round trip.

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|input: &[u8]| radome_fuzz::check_dataset(input));
