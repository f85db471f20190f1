//! Text recording of the vendor's SDK with its configuration: frames or an error. A recording that was read completely
//! survives a round trip.

#![no_main]

use libfuzzer_sys::fuzz_target;
use radome_driver::recording::Format;
use radome_fuzz::{check_vendors, folder, sections};

fuzz_target!(|input: &[u8]| {
    let folder = folder();
    let path = folder.path().join("in.txt");
    let [config, text] = sections(input);
    std::fs::write(folder.path().join("in.txt_config.json"), config).expect("writes");
    std::fs::write(&path, text).expect("writes");
    check_vendors(folder.path(), &path, Format::Text, input);
});
