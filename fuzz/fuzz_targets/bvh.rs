//! BVH: a clip and a cycle of steps, or errors.

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|input: &str| radome_fuzz::check_bvh(input));
