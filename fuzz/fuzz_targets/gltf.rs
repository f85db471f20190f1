//! glTF with a separate buffer, or GLB: a mesh and an actor, or errors.

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|input: &[u8]| radome_fuzz::check_gltf(input));
