//! Campaign of faults against every kind of board. Thousands of packets are lost, doubled, cut, changed and out of
//! order. Boards stall, disconnect and overflow, and hosts sleep.
//!
//! Each received frame must have the samples of one source frame, later than the one before. The only exception is a
//! changed digit of a sample on links without a check sum. Sequence numbers of frames and gaps must follow each other
//! without hole or overlap. Their offset from the source's numbers must be constant, unless the board was absent and
//! only the host's clock could count. The stream must continue after every fault.
//!
//! `tests/long faults` runs the long campaign, with `RADOME_FAULTS` and `RADOME_SEED`.

#[path = "../common/mod.rs"]
mod common;
mod draw;
mod play;
mod report;

use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;

use report::Report;

/// Runs a campaign on this number of threads.
fn campaign(seed: u64, faults: u64, threads: usize) -> Report {
    let jobs = draw::jobs(seed, faults);
    let (next, report) = (AtomicUsize::new(0), Mutex::new(Report::default()));
    thread::scope(|scope| {
        for _ in 0..threads {
            scope.spawn(|| {
                while let Some(job) = jobs.get(next.fetch_add(1, Ordering::Relaxed)) {
                    let outcome = play::play(job);
                    report.lock().expect("no panic").add(job, outcome);
                }
            });
        }
    });
    report.into_inner().expect("no panic")
}

#[test]
fn a_small_campaign_has_no_failures() {
    let report = campaign(1, 300, 12);
    assert!(report.injected() >= 300);
    assert!(report.failures().is_empty(), "{}\n{:#?}", report.table(), report.failures());
}

/// Number from an environment variable.
fn setting(name: &str, default: u64) -> u64 {
    std::env::var(name).map_or(default, |text| text.parse().expect("a whole number"))
}

#[test]
#[ignore = "takes minutes: tests/long faults"]
#[allow(clippy::print_stdout)]
fn the_campaign() {
    let (seed, faults) = (setting("RADOME_SEED", 1), setting("RADOME_FAULTS", 12_000));
    // Sixteen threads, since jobs sleep more than they compute.
    let report = campaign(seed, faults, 16);
    println!("{}", report.table());
    if let Some(path) = std::env::var_os("RADOME_REPORT") {
        std::fs::write(&path, format!("{:#}\n", report.json(seed))).expect("writes");
    }
    assert!(report.failures().is_empty(), "{:#?}", report.failures());
}
