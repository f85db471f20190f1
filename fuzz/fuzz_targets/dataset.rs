//! A dataset's folder, any of its files anything: maps or an error; what was read whole is written and read again.

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|input: &[u8]| radome_fuzz::check_dataset(input));
