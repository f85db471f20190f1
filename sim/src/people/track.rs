//! Smooth functions of time: changes of level and slope, each spread over a window with a raised cosine. The form is
//! closed, so that position, velocity and acceleration are continuous and any time can be evaluated directly.

use crate::math::{smooth_ramp, smooth_step};

/// A smooth function of time: `start + sum level_k step((t - t_k)/w_k) + sum slope_k w_k ramp((t - t_k)/w_k)`.
#[derive(Debug, Clone, PartialEq)]
pub struct Track {
    start: f64,
    window_s: f64,
    levels: Vec<Change>,
    slopes: Vec<Change>,
}

/// A change at a time, spread over `window_s` before and after it.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Change {
    time_s: f64,
    by: f64,
    window_s: f64,
}

impl Track {
    /// Makes a constant. Later changes are spread over `window_s` before and after their time.
    pub fn constant(start: f64, window_s: f64) -> Self {
        Track { start, window_s, levels: Vec::new(), slopes: Vec::new() }
    }

    /// Changes the level at a time.
    pub fn change_level(&mut self, time_s: f64, change: f64) {
        self.change_level_over(time_s, change, self.window_s);
    }

    /// Changes the slope at a time.
    pub fn change_slope(&mut self, time_s: f64, change: f64) {
        self.change_slope_over(time_s, change, self.window_s);
    }

    /// Changes the level about a time, over its own window before and after. The rate never exceeds `change / window_s`
    /// a second.
    pub fn change_level_over(&mut self, time_s: f64, change: f64, window_s: f64) {
        if change != 0.0 {
            self.levels.push(Change { time_s, by: change, window_s });
        }
    }

    /// Changes the slope about a time, over its own window before and after.
    pub fn change_slope_over(&mut self, time_s: f64, change: f64, window_s: f64) {
        if change != 0.0 {
            self.slopes.push(Change { time_s, by: change, window_s });
        }
    }

    /// Widens the windows of the last changes of slope at exactly this time to at least `window_s`.
    pub fn widen_slopes(&mut self, time_s: f64, window_s: f64) {
        for change in self.slopes.iter_mut().rev().take_while(|c| c.time_s == time_s) {
            change.window_s = change.window_s.max(window_s);
        }
    }

    /// Value at a time.
    pub fn at(&self, time_s: f64) -> f64 {
        let mut value = self.start;
        // Most changes are complete or have not begun. These need neither a division nor a sine.
        for c in &self.levels {
            let since_s = time_s - c.time_s;
            if since_s >= c.window_s {
                value += c.by;
            } else if since_s > -c.window_s {
                value += c.by * smooth_step(since_s / c.window_s);
            }
        }
        for c in &self.slopes {
            let since_s = time_s - c.time_s;
            if since_s >= c.window_s {
                value += c.by * since_s;
            } else if since_s > -c.window_s {
                value += c.by * c.window_s * smooth_ramp(since_s / c.window_s);
            }
        }
        value
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn acceleration_is_continuous_and_values_outside_windows_are_exact() {
        let mut track = Track::constant(2.0, 0.4);
        track.change_slope(1.0, 1.5);
        track.change_slope(3.0, -1.5);
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
