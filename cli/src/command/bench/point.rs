//! What every stage is measured in: one way to do its job, what it takes, and how far off it is.

use std::time::Instant;

use serde::Serialize;

/// One way to do a stage's job.
#[derive(Debug, Clone, Serialize)]
pub struct Point {
    /// Which job.
    pub stage: &'static str,
    /// Which way.
    pub way: String,
    /// The least of several runs.
    pub milliseconds: f64,
    /// How far off, in `error_unit`; `None` of a reference, and where nothing is approximated.
    pub error: Option<f64>,
    /// Unit of the error.
    pub error_unit: &'static str,
    /// Whether somebody else's program or library did it.
    pub is_peer: bool,
}

/// Milliseconds of the fastest of several runs.
pub fn least_ms(rounds: usize, mut run: impl FnMut() -> anyhow::Result<()>) -> anyhow::Result<f64> {
    let mut least = f64::INFINITY;
    for _ in 0..rounds.max(1) {
        let started = Instant::now();
        run()?;
        least = least.min(started.elapsed().as_secs_f64() * 1e3);
    }
    Ok(least)
}
