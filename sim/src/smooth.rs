//! Smooth steps and ramps, in closed form.

use std::f64::consts::{PI, TAU};

/// Raised-cosine step from 0 (below -1) to 1 (above 1).
pub fn smooth_step(x: f64) -> f64 {
    if x <= -1.0 {
        0.0
    } else if x >= 1.0 {
        1.0
    } else {
        0.5 * (x + 1.0) + (PI * x).sin() / TAU
    }
}

/// Integral of [`smooth_step`]: 0 below -1, x above 1.
pub fn smooth_ramp(x: f64) -> f64 {
    if x <= -1.0 {
        0.0
    } else if x >= 1.0 {
        x
    } else {
        0.25 * (x + 1.0) * (x + 1.0) - (1.0 + (PI * x).cos()) / (2.0 * PI * PI)
    }
}
