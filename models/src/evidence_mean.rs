//! Mean of a model's evidence over the last seconds.

use crate::metrics::CLASSES;

/// Least probability of a class in a frame, which keeps logarithms finite.
const LEAST_PROBABILITY: f64 = 1e-9;

/// Longest memory, s.
const LONGEST_S: f64 = 60.0;
/// Times that [`is_valid_memory`] accepts, for messages.
pub(crate) const MEMORY_RANGE: &str = "0 to 60 s";

/// Returns whether a model's memory may have this length.
pub(crate) fn is_valid_memory(memory_s: f64) -> bool {
    (0.0..=LONGEST_S).contains(&memory_s)
}

/// Mean of the logarithms of a network's probabilities over the last frames, weighted by `exp(-age / memory_s)`.
///
/// A single frame often does not show a second person who turns, stands still or is hidden. Up to a constant that softmax
/// ignores, the mean of the logarithms is the mean of the logits. The filter over answers
/// ([`OccupancyFilter`](crate::occupancy_filter::OccupancyFilter)) comes behind this mean. The filter accumulates evidence and
/// therefore becomes certain; the mean does not.
///
/// # Examples
/// ```
/// use radome_models::evidence_mean::EvidenceMean;
///
/// let mut mean = EvidenceMean::new(1.0);
/// mean.update(0.0, [0.1, 0.8, 0.1]);
/// let [_, one, two] = mean.update(0.1, [0.1, 0.4, 0.5]);
/// assert!(one > two);
/// ```
#[derive(Debug, Clone)]
pub struct EvidenceMean {
    memory_s: f64,
    last_time_s: f64,
    /// Weighted sums of the logarithms.
    sums: [f64; CLASSES],
    /// Sum of the weights.
    weight: f64,
}

impl EvidenceMean {
    /// Makes a mean without frames. With a memory of 0 s, only the newest frame counts.
    pub fn new(memory_s: f64) -> Self {
        EvidenceMean { memory_s, last_time_s: 0.0, sums: [0.0; CLASSES], weight: 0.0 }
    }

    /// Forgets all frames.
    pub fn reset(&mut self) {
        *self = EvidenceMean::new(self.memory_s);
    }

    /// Adds the network's probabilities of the frame at `time_s`, and returns the mean probabilities of empty, one and two. If
    /// `time_s` is before the last frame, the earlier frames are forgotten.
    pub fn update(&mut self, time_s: f64, frame: [f32; CLASSES]) -> [f32; CLASSES] {
        let retention = retention(self.memory_s, time_s - self.last_time_s);
        self.last_time_s = time_s;
        self.weight = self.weight * retention + 1.0;
        for (sum, p) in self.sums.iter_mut().zip(frame) {
            *sum = *sum * retention + f64::from(p).max(LEAST_PROBABILITY).ln();
        }
        if self.weight == 1.0 {
            return frame;
        }
        let mean = self.sums.map(|sum| sum / self.weight);
        let most = mean.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let powers = mean.map(|value| (value - most).exp());
        let total: f64 = powers.iter().sum();
        powers.map(|power| (power / total) as f32)
    }
}

/// Share of the weight of earlier frames that remains after `elapsed_s`, 0 to 1.
fn retention(memory_s: f64, elapsed_s: f64) -> f64 {
    // Negative times and NaN give 0.
    if memory_s > 0.0 && elapsed_s >= 0.0 { (-elapsed_s / memory_s).exp() } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frames() -> Vec<(f64, [f32; CLASSES])> {
        let frame = |k: usize| {
            let two = 0.05 + 0.9 * ((k * 37 % 101) as f32 / 101.0);
            (0.08 * k as f64, [0.02, 0.98 - two, two])
        };
        (0..60).map(frame).collect()
    }

    /// Compares the recursive sums with the weighted mean over all frames.
    #[test]
    fn it_is_the_weighted_mean_of_the_logarithms() {
        let mut mean = EvidenceMean::new(0.7);
        let frames = frames();
        for (k, (time_s, probabilities)) in frames.iter().enumerate() {
            let found = mean.update(*time_s, *probabilities);
            let (mut sums, mut weights) = ([0.0f64; CLASSES], 0.0);
            for (earlier_s, earlier) in &frames[..=k] {
                let weight = (-(time_s - earlier_s) / 0.7).exp();
                weights += weight;
                sums.iter_mut().zip(earlier).for_each(|(sum, p)| *sum += weight * f64::from(*p).ln());
            }
            let powers = sums.map(|sum| (sum / weights).exp());
            let total: f64 = powers.iter().sum();
            for (found, power) in found.iter().zip(powers) {
                assert!((f64::from(*found) - power / total).abs() < 1e-6, "{k}: {found} {power}");
            }
        }
    }

    #[test]
    fn the_frame_rate_hardly_matters() {
        let slow = frames();
        let (mut once, mut twice) = (EvidenceMean::new(1.0), EvidenceMean::new(1.0));
        for (time_s, frame) in slow {
            let expected = once.update(time_s, frame);
            twice.update(time_s, frame);
            let found = twice.update(time_s + 0.04, frame);
            assert!(found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 0.05), "{time_s}: {found:?} {expected:?}");
        }
    }

    #[test]
    fn nothing_is_remembered_without_a_memory_or_after_a_long_time() {
        let (mut none, mut short) = (EvidenceMean::new(0.0), EvidenceMean::new(0.5));
        for (time_s, frame) in frames() {
            assert_eq!(none.update(time_s, frame), frame);
            assert_eq!(short.update(1e4 * time_s, frame), frame);
        }
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn certain_frames_and_odd_times_give_finite_answers() {
            let mut mean = EvidenceMean::new(1.0);
            for time_s in [0.0, 0.1, 0.1, f64::NAN, 0.2, -5.0, f64::INFINITY, 0.0, 1e300] {
                for frame in [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [f32::NAN, 0.5, 0.5], [0.0; 3]] {
                    let found = mean.update(time_s, frame);
                    assert!(frame.iter().any(|p| p.is_nan()) || found.iter().all(|p| p.is_finite()), "{found:?}");
                }
            }
            mean.reset();
            assert_eq!(mean.update(0.0, [0.2, 0.5, 0.3]), [0.2, 0.5, 0.3]);
        }
    }
}
