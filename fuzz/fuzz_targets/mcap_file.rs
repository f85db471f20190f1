//! A file that may be a native recording, byte by byte: read, sought in, repaired.

#![no_main]

use libfuzzer_sys::fuzz_target;
use radome_fuzz::{check_mcap, folder};

fuzz_target!(|input: &[u8]| {
    let folder = folder();
    check_mcap(folder.path(), input);
});
