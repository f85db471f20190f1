//! Any bytes as a native recording: reading, seeking and repair.

#![no_main]

use libfuzzer_sys::fuzz_target;
use radome_fuzz::{check_mcap, folder};

fuzz_target!(|input: &[u8]| {
    let folder = folder();
    check_mcap(folder.path(), input);
});
