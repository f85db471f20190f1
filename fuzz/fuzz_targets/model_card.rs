//! Model file with a valid container and an arbitrary card.

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|input: &str| radome_fuzz::check_card(input));
