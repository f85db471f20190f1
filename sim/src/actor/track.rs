//! Smooth functions of time made of corners: every change of slope or level is spread over a window with a raised cosine, in
//! closed form, so that position, velocity and acceleration are continuous and any time can be asked for directly.

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

/// `start + sum level_k step((t - t_k)/w) + sum slope_k w ramp((t - t_k)/w)`.
#[derive(Debug, Clone, PartialEq)]
pub struct Track {
    start: f64,
    window_s: f64,
    levels: Vec<(f64, f64)>,
    slopes: Vec<(f64, f64)>,
}

impl Track {
    /// A constant, whose later changes are spread over `window_s` either way.
    pub fn constant(start: f64, window_s: f64) -> Self {
        Track { start, window_s, levels: Vec::new(), slopes: Vec::new() }
    }

    /// Changes the level at a time.
    pub fn step(&mut self, time_s: f64, change: f64) {
        if change != 0.0 {
            self.levels.push((time_s, change));
        }
    }

    /// Changes the slope at a time.
    pub fn bend(&mut self, time_s: f64, change: f64) {
        if change != 0.0 {
            self.slopes.push((time_s, change));
        }
    }

    /// Value at a time.
    pub fn at(&self, time_s: f64) -> f64 {
        let w = self.window_s;
        let mut value = self.start;
        for &(t, change) in &self.levels {
            value += change * smooth_step((time_s - t) / w);
        }
        for &(t, change) in &self.slopes {
            value += change * w * smooth_ramp((time_s - t) / w);
        }
        value
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn velocity_and_acceleration_are_continuous_and_corners_end_exactly() {
        let mut track = Track::constant(2.0, 0.4);
        track.bend(1.0, 1.5);
        track.bend(3.0, -1.5);
        assert_eq!(track.at(0.5), 2.0);
        assert!((track.at(5.0) - 5.0).abs() < 1e-12);
        assert!((track.at(2.0) - 3.5).abs() < 1e-12);
        let h = 1e-4;
        let acceleration = |t: f64| (track.at(t + h) - 2.0 * track.at(t) + track.at(t - h)) / (h * h);
        let mut last = acceleration(0.0);
        for i in 1..5000 {
            let now = acceleration(i as f64 * 1e-3);
            assert!((now - last).abs() < 0.05, "jump at {i} ms");
            last = now;
        }
    }
}
