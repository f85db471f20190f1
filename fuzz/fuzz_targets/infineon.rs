//! Vendor's recording folder with arbitrary files: frames or an error. A recording that was read completely survives a
//! round trip.

#![no_main]

use libfuzzer_sys::fuzz_target;
use radome_driver::recording::Format;
use radome_fuzz::{INFINEON_FILES, check_vendors, folder, sections};

fuzz_target!(|input: &[u8]| {
    let folder = folder();
    let radar = folder.path().join("in");
    std::fs::create_dir(&radar).expect("a folder");
    for (name, bytes) in INFINEON_FILES.iter().zip(sections::<6>(input)) {
        // The last files may be absent; the version is always present.
        let bytes = if *name == "format.version" && bytes.is_empty() { b"1.0.0" } else { bytes };
        if !bytes.is_empty() {
            std::fs::write(radar.join(name), bytes).expect("writes");
        }
    }
    check_vendors(folder.path(), &radar, Format::Infineon, input);
});
