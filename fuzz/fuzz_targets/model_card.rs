//! A model file whose container is right and whose card is anything.

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|input: &str| radome_fuzz::check_card(input));
