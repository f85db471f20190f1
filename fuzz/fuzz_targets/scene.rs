//! Scene file with all files that it refers to: it loads, or is refused with a reason.

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|input: &[u8]| radome_fuzz::check_scene(input));
