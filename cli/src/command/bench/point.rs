//! Measurement of one implementation of a stage: its time and its error.

use std::time::Instant;

use serde::Serialize;

/// Time and error of one implementation of a stage.
#[derive(Debug, Clone, Serialize)]
pub struct Point {
    pub stage: &'static str,
    /// Name of the method.
    pub way: String,
    /// Minimum time of several runs, ms.
    pub milliseconds: f64,
    /// Error in `error_unit`; `None` for a reference, and where nothing is approximated.
    pub error: Option<f64>,
    pub error_unit: &'static str,
    /// Whether a third-party program or library was measured.
    pub is_peer: bool,
}

/// Measures the fastest of several runs, ms.
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
