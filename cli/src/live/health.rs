//! Counters of a run, of fixed size, for the page, the metrics and the summary at the end.

use std::collections::{BTreeMap, VecDeque};
use std::time::{Duration, Instant};

use radome_dsp::{Gap, GapReason, Occupancy};

/// Arrival times of the newest frames, which determine the frame rate.
#[derive(Debug, Clone, Default)]
pub struct Arrivals(VecDeque<Instant>);

impl Arrivals {
    /// Number of frames whose arrivals are kept.
    const FRAMES: usize = 32;

    pub fn add(&mut self, arrived: Instant) {
        if self.0.len() == Self::FRAMES {
            self.0.pop_front();
        }
        self.0.push_back(arrived);
    }

    /// Frame rate, 1/s; 0 until there are two frames.
    pub fn frames_per_s(&self) -> f64 {
        let (Some(first), Some(last)) = (self.0.front(), self.0.back()) else { return 0.0 };
        let span_s = last.duration_since(*first).as_secs_f64();
        if span_s > 0.0 { (self.0.len() - 1) as f64 / span_s } else { 0.0 }
    }

    /// Arrival of the newest frame; `None` until there is one.
    fn last(&self) -> Option<Instant> {
        self.0.back().copied()
    }
}

/// Counters of a run.
#[derive(Debug, Clone)]
pub struct Health {
    pub started: Instant,
    /// Number of classified frames.
    pub frames: u64,
    pub labels: [u64; Occupancy::ALL.len()],
    pub dropped: BTreeMap<GapReason, u64>,
    /// Gaps of unknown length, whose frames are not counted.
    pub unknown_gaps: u64,
    /// Number of codes at either end of the ADC range, over all frames.
    pub saturated_samples: u64,
    /// Latency from a frame's last byte to its label.
    pub latency: LatencyHistogram,
    /// Time from the start to the first label.
    pub first_label: Option<Duration>,
    /// Temperature of the chip in the newest frame, millidegrees Celsius.
    pub temperature_millicelsius: Option<i32>,
    arrivals: Arrivals,
}

impl Health {
    pub fn new(started: Instant) -> Self {
        Health {
            started,
            frames: 0,
            labels: [0; Occupancy::ALL.len()],
            dropped: BTreeMap::new(),
            unknown_gaps: 0,
            saturated_samples: 0,
            latency: LatencyHistogram::new(),
            first_label: None,
            temperature_millicelsius: None,
            arrivals: Arrivals::default(),
        }
    }

    /// Copies another value, without allocating in the steady state.
    pub fn copy_from(&mut self, other: &Health) {
        let Health { started, frames, labels, dropped, saturated_samples, latency, first_label, .. } = other;
        (self.started, self.frames, self.labels, self.saturated_samples) =
            (*started, *frames, *labels, *saturated_samples);
        (self.first_label, self.temperature_millicelsius) = (*first_label, other.temperature_millicelsius);
        self.unknown_gaps = other.unknown_gaps;
        if self.dropped != *dropped {
            self.dropped.clone_from(dropped);
        }
        self.latency.counts.copy_from_slice(&latency.counts);
        (self.latency.total, self.latency.sum_s) = (latency.total, latency.sum_s);
        self.arrivals.0.clone_from(&other.arrivals.0);
    }

    /// Counts a frame that has arrived and been classified.
    pub fn add_frame(&mut self, arrived: Instant, latency: Duration) {
        self.frames += 1;
        self.latency.add(latency);
        self.arrivals.add(arrived);
    }

    /// Counts a gap.
    pub fn add_gap(&mut self, gap: &Gap) {
        match gap.frames {
            0 => self.unknown_gaps += 1,
            frames => *self.dropped.entry(gap.reason).or_default() += frames,
        }
    }

    pub fn dropped_total(&self) -> u64 {
        self.dropped.values().sum()
    }

    /// Frame rate over the newest frames, 1/s; 0 until there are two.
    pub fn frames_per_s(&self) -> f64 {
        self.arrivals.frames_per_s()
    }

    /// Returns whether no frame has arrived for `silence`, or none at all.
    pub fn is_silent(&self, silence: Duration) -> bool {
        self.arrivals.last().is_none_or(|last| last.elapsed() >= silence)
    }
}

/// Histogram of latencies in bins that are 2 % wide, from a microsecond to over a hundred seconds.
#[derive(Debug, Clone)]
pub struct LatencyHistogram {
    counts: Vec<u64>,
    pub total: u64,
    pub sum_s: f64,
}

impl LatencyHistogram {
    const SHORTEST_S: f64 = 1e-6;
    const RATIO: f64 = 1.02;
    const BINS: usize = 936;

    fn new() -> Self {
        LatencyHistogram { counts: vec![0; Self::BINS], total: 0, sum_s: 0.0 }
    }

    fn add(&mut self, latency: Duration) {
        let latency_s = latency.as_secs_f64();
        let bin = (latency_s / Self::SHORTEST_S).max(1.0).ln() / Self::RATIO.ln();
        self.counts[(bin as usize).min(Self::BINS - 1)] += 1;
        self.total += 1;
        self.sum_s += latency_s;
    }

    /// Latency quantile within one percent: the latency that a fraction `q` of the frames did not exceed, s; 0 without
    /// frames.
    pub fn quantile_s(&self, q: f64) -> f64 {
        let rank = (q * self.total.saturating_sub(1) as f64).round() as u64;
        let mut cumulative = 0;
        for (bin, count) in self.counts.iter().enumerate() {
            cumulative += count;
            if cumulative > rank {
                return Self::SHORTEST_S * Self::RATIO.powf(bin as f64 + 0.5);
            }
        }
        0.0
    }

    /// Number of latencies up to `bound_s`, rounded to the nearest bin.
    pub fn count_up_to(&self, bound_s: f64) -> u64 {
        let bins = (bound_s / Self::SHORTEST_S).max(1.0).ln() / Self::RATIO.ln();
        self.counts.iter().take(bins.round() as usize).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_those_of_the_sorted_latencies_within_a_percent() {
        let mut histogram = LatencyHistogram::new();
        // 10 us to 10 s, uniform in the logarithm: quantile q is 10 us * 10^(6 q).
        for i in 0..10_001 {
            histogram.add(Duration::from_secs_f64(1e-5 * 10f64.powf(6.0 * f64::from(i) / 1e4)));
        }
        for q in [0.0, 0.01, 0.5, 0.95, 0.99, 1.0] {
            let ratio = histogram.quantile_s(q) / (1e-5 * 10f64.powf(6.0 * q));
            assert!((ratio - 1.0).abs() < 0.0105, "{q}: {ratio}");
        }
        assert_eq!(histogram.total, 10_001);
        assert!((histogram.count_up_to(1e-2) as f64 / 5_000.0 - 1.0).abs() < 0.01);
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn none_one_and_those_beyond_the_bins() {
            let mut histogram = LatencyHistogram::new();
            assert_eq!(histogram.quantile_s(0.5), 0.0);
            histogram.add(Duration::ZERO);
            assert!(histogram.quantile_s(0.5) < 1.1e-6);
            histogram.add(Duration::from_secs(100_000));
            assert!(histogram.quantile_s(1.0) > 100.0);
        }

        /// Regression test: such a gap added a reason with 0 frames.
        #[test]
        fn a_gap_of_unknown_length_counts_no_frames_of_its_reason() {
            let mut health = Health::new(Instant::now());
            health.add_gap(&Gap { first_sequence: 3, frames: 0, reason: GapReason::Disconnected });
            assert_eq!((health.dropped.len(), health.unknown_gaps), (0, 1));
            health.add_gap(&Gap { first_sequence: 3, frames: 2, reason: GapReason::Crc });
            assert_eq!((health.dropped_total(), health.unknown_gaps), (2, 1));
        }

        #[test]
        fn no_rate_before_two_frames() {
            let now = Instant::now();
            let mut health = Health::new(now);
            assert_eq!(health.frames_per_s(), 0.0);
            health.add_frame(now, Duration::ZERO);
            assert_eq!(health.frames_per_s(), 0.0);
            for i in 1..100 {
                health.add_frame(now + Duration::from_millis(100 * i), Duration::ZERO);
            }
            assert!((health.frames_per_s() - 10.0).abs() < 1e-9);
        }
    }
}
