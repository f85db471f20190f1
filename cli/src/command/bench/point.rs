//! Measurement of one way to do the job of a stage: its time and its error.

use std::time::Instant;

use serde::Serialize;

/// One way to do a stage's job.
#[derive(Debug, Clone, Serialize)]
pub struct Point {
    /// Name of the stage.
    pub stage: &'static str,
    /// Name of the method.
    pub way: String,
    /// The least of several runs.
    pub milliseconds: f64,
    /// Error in `error_unit`; `None` of a reference, and where nothing is approximated.
    pub error: Option<f64>,
    /// Unit of the error.
    pub error_unit: &'static str,
    /// Whether somebody else's program or library did it.
    pub is_peer: bool,
}

/// Milliseconds of the fastest of several runs.
///
/// # Errors
/// The job fails.
pub fn least_ms(rounds: usize, mut run: impl FnMut() -> anyhow::Result<()>) -> anyhow::Result<f64> {
    let mut least = f64::INFINITY;
    for _ in 0..rounds.max(1) {
        let started = Instant::now();
        run()?;
        least = least.min(started.elapsed().as_secs_f64() * 1e3);
    }
    Ok(least)
}
