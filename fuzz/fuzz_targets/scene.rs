//! A scene file with everything that it names: loads, or says what is wrong.

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|input: &[u8]| radome_fuzz::check_scene(input));
