//! Text recording of the vendor's SDK with its configuration: frames or an error. A recording that was read completely
//! survives a round trip.

#![no_main]

use libfuzzer_sys::fuzz_target;
use radome_driver::recording::{Format, Recording};
use radome_dsp::FrameSource;
use radome_fuzz::{folder, read, round_trip, sections, within};

fuzz_target!(|input: &[u8]| {
    let folder = folder();
    let path = folder.path().join("in.txt");
    let [config, text] = sections(input);
    std::fs::write(folder.path().join("in.txt_config.json"), config).expect("writes");
    std::fs::write(&path, text).expect("writes");
    let found = within((2 << 20) + 64 * input.len(), || {
        let mut source = Recording::open(&path).ok()?;
        let events = read(&mut source)?;
        source.seek_frame(1).expect("seeks");
        let rest = read(&mut source)?;
        // Damage before the target of the seek does not matter.
        if events.1 {
            assert_eq!(rest.0, events.0[events.0.len().min(1)..]);
        }
        Some((source.header(), events, source.frame_count()))
    });
    if let Some((header, (events, true), count)) = found {
        assert_eq!(count, Some(events.len() as u64));
        round_trip(folder.path(), &header, &events, &[], Format::Text);
    }
});
