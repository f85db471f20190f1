//! Vendor's recording folder with arbitrary files: frames or an error. A recording that was read completely survives a
//! round trip.

#![no_main]

use libfuzzer_sys::fuzz_target;
use radome_driver::RecordingHeader;
use radome_driver::recording::{Format, Recording};
use radome_dsp::FrameSource;
use radome_fuzz::{folder, read, round_trip, sections, within};

const FILES: [&str; 6] = [
    "config.json",
    "radar.npy",
    "radar_timestamp.csv",
    "temperature.npy",
    "temperature_timestamp.csv",
    "format.version",
];

fuzz_target!(|input: &[u8]| {
    let folder = folder();
    let radar = folder.path().join("in");
    std::fs::create_dir(&radar).expect("a folder");
    for (name, bytes) in FILES.iter().zip(sections::<6>(input)) {
        // The last files may be absent; the version is always present.
        let bytes = if *name == "format.version" && bytes.is_empty() { b"1.0.0" } else { bytes };
        if !bytes.is_empty() {
            std::fs::write(radar.join(name), bytes).expect("writes");
        }
    }
    let found = within((2 << 20) + 64 * input.len(), || {
        let mut source = Recording::open(&radar).ok()?;
        let header = source.header();
        let events = read(&mut source)?;
        for time_s in [f64::NAN, -1.0, 0.05, 1e300] {
            let _ = source.seek_time_s(time_s);
        }
        source.seek_frame(u64::MAX).expect("seeks");
        source.seek_frame(1).expect("seeks");
        let rest = read(&mut source)?;
        // Damage before the target of the seek does not matter.
        if events.1 {
            assert_eq!(rest.0, events.0[events.0.len().min(1)..]);
        }
        Some((header, events, source.frame_count()))
    });
    if let Some((header, (events, true), count)) = found {
        assert_eq!(count, Some(events.len() as u64));
        let header: RecordingHeader = header;
        round_trip(folder.path(), &header, &events, &[], Format::Infineon);
    }
});
