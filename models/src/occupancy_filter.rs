//! What a sequence of per-frame probabilities says about the room: a causal filter.

use serde::{Deserialize, Serialize};

/// Who is there and who of them is seen, `(present, seen)`: the states of [`OccupancyFilter`].
const STATES: [(usize, usize); 6] = [(0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2)];

/// Least probability of a class in a frame: no single frame may rule a class out for good.
const LEAST_PROBABILITY: f64 = 1e-4;
/// Time after which no more is forgotten, s.
const LONGEST_S: f64 = 1e6;
/// Shortest time of a setting, s.
const SHORTEST_S: f64 = 1e-3;
/// [`Smoothing::independent_s`] where neither it nor a weight is given.
const INDEPENDENT_S: f64 = 1.0;

/// How the answers to frames are put together: what is known of the room's people, not of its maps, so it is given and not
/// trained. Travels in the model file.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Smoothing {
    /// Mean time that a number of people stays what it is, s.
    pub dwell_s: f64,
    /// Part of the time for which somebody who is there is not seen: standing still, turned away, behind another.
    pub unseen_share: f64,
    /// Time over which that is forgotten, s.
    pub unseen_s: f64,
    /// Weight of one frame's evidence in (0, 1], whatever the frame interval: of models from before `independent_s`, and absent
    /// where that is given. 1 takes each frame at its word.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub weight: Option<f64>,
    /// Time over which frames are one piece of evidence, s. A frame weighs as much of a piece as the time since the frame before
    /// it is of this, and one piece at most: the answer does not depend on the frame interval. 1 s if neither this nor `weight`
    /// is given.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub independent_s: Option<f64>,
}

impl Default for Smoothing {
    /// People who stay for a minute and are always seen; the frames of a second are one piece of evidence.
    fn default() -> Self {
        Smoothing { dwell_s: 60.0, unseen_share: 0.0, unseen_s: 1.0, weight: None, independent_s: Some(INDEPENDENT_S) }
    }
}

impl Smoothing {
    /// Settings of model files that name none: short visits by people who are always seen, frames taken at their word.
    pub(crate) fn of_old_models() -> Self {
        Smoothing { dwell_s: 8.0, unseen_share: 0.0, unseen_s: 1.0, weight: Some(1.0), independent_s: None }
    }

    /// What is wrong with a setting: `(name, value, expected)`.
    pub(crate) fn fault(&self) -> Option<(&'static str, f64, &'static str)> {
        let is_time = |v: f64| v.is_finite() && v >= SHORTEST_S;
        if !is_time(self.dwell_s) {
            return Some(("smoothing.dwell_s", self.dwell_s, "a millisecond or more"));
        }
        if !is_time(self.unseen_s) {
            return Some(("smoothing.unseen_s", self.unseen_s, "a millisecond or more"));
        }
        if !(0.0..1.0).contains(&self.unseen_share) {
            return Some(("smoothing.unseen_share", self.unseen_share, "0 up to below 1"));
        }
        match (self.weight, self.independent_s) {
            (Some(weight), Some(_)) => Some(("smoothing.weight", weight, "none beside independent_s")),
            (Some(weight), None) if !(weight > 0.0 && weight <= 1.0) => {
                Some(("smoothing.weight", weight, "above 0 and up to 1"))
            }
            (None, Some(independent_s)) if !is_time(independent_s) => {
                Some(("smoothing.independent_s", independent_s, "a millisecond or more"))
            }
            _ => None,
        }
    }

    /// Rates at which states follow each other, 1/s.
    fn rates(&self) -> Matrix {
        let Smoothing { dwell_s, unseen_share, unseen_s, .. } = *self;
        let mut rates = Matrix::default();
        for (j, (present, seen)) in STATES.into_iter().enumerate() {
            for (i, to) in STATES.into_iter().enumerate() {
                rates[i][j] = match to {
                    // One comes or goes: of one person as often as somebody comes. Who of those now there is seen is drawn anew.
                    (a, b) if a.abs_diff(present) == 1 => {
                        let ways = if present == 1 { 0.5 } else { 1.0 };
                        ways / dwell_s * binomial(a, b, 1.0 - unseen_share)
                    }
                    // One of the unseen turns up, or one of the seen goes out of sight.
                    (a, b) if a == present && b == seen + 1 => {
                        (present - seen) as f64 * (1.0 - unseen_share) / unseen_s
                    }
                    (a, b) if a == present && b + 1 == seen => seen as f64 * unseen_share / unseen_s,
                    _ => 0.0,
                };
            }
            let leaves: f64 = rates.iter().map(|row| row[j]).sum();
            rates[j][j] = -leaves;
        }
        rates
    }
}

/// Forward filter of a hidden Markov model in continuous time: people come and go one at a time, and each of them is seen and
/// unseen on their own, so that a room in which now two and now one are seen holds two, and one in which never more than one is
/// seen holds one.
///
/// With `q` the network's probabilities of one frame, of as many people as are seen in it, and `p` those of the states, over the
/// time since the frame before `dp/dt = (Q + diag(ln q_seen) / independent_s) p`, normalised: Rabiner, Proc. IEEE 77(2), 1989,
/// equations 19-20, with the network's probabilities in place of scaled likelihoods and evidence that comes evenly over time. Time
/// beyond `independent_s` brings no more of it. With a weight `w` a frame, `p_k <- q_seen(k)^w (exp(Q t) p)_k` instead.
#[derive(Debug, Clone)]
pub struct OccupancyFilter {
    smoothing: Smoothing,
    frame_interval_s: f64,
    rates: Matrix,
    probabilities: [f64; STATES.len()],
    last_time_s: Option<f64>,
}

impl OccupancyFilter {
    /// A filter that knows nothing yet. The first frame counts as one that comes `frame_interval_s` after another.
    pub fn new(smoothing: Smoothing, frame_interval_s: f64) -> Self {
        let mut filter = OccupancyFilter {
            smoothing,
            frame_interval_s,
            rates: smoothing.rates(),
            probabilities: Default::default(),
            last_time_s: None,
        };
        filter.reset();
        filter
    }

    /// Forgets all frames.
    pub fn reset(&mut self) {
        let seen_share = 1.0 - self.smoothing.unseen_share;
        self.probabilities = STATES.map(|(present, seen)| binomial(present, seen, seen_share) / 3.0);
        self.last_time_s = None;
    }

    /// Takes the network's probabilities of the frame at `time_s`; returns those of empty, one and two.
    pub fn update(&mut self, time_s: f64, frame: [f32; 3]) -> [f32; 3] {
        let elapsed_s = self.last_time_s.map_or(self.frame_interval_s, |last| time_s - last);
        // Neither a clock that goes back nor what is no number counts.
        let elapsed_s = if elapsed_s > 0.0 { elapsed_s.min(LONGEST_S) } else { 0.0 };
        self.last_time_s = Some(time_s);
        let evidence = frame.map(|q| {
            let q = f64::from(q);
            if q > LEAST_PROBABILITY { q.min(1.0).ln() } else { LEAST_PROBABILITY.ln() }
        });
        let mut posterior = self.probabilities;
        match (self.smoothing.independent_s, self.smoothing.weight) {
            (None, Some(weight)) => {
                posterior = propagate(&self.rates, elapsed_s, &posterior);
                for (p, (_, seen)) in posterior.iter_mut().zip(STATES) {
                    *p *= (weight * evidence[seen]).exp();
                }
            }
            (independent_s, _) => {
                let independent_s = independent_s.unwrap_or(INDEPENDENT_S);
                let counted_s = elapsed_s.min(independent_s);
                if elapsed_s > counted_s {
                    posterior = propagate(&self.rates, elapsed_s - counted_s, &posterior);
                }
                let mut rates = self.rates;
                for (k, (_, seen)) in STATES.into_iter().enumerate() {
                    rates[k][k] += evidence[seen] / independent_s;
                }
                posterior = propagate(&rates, counted_s, &posterior);
            }
        }
        let norm: f64 = posterior.iter().sum();
        self.probabilities = posterior.map(|p| p / norm);
        let mut people = [0.0; 3];
        for ((present, _), p) in STATES.iter().zip(self.probabilities) {
            people[*present] += p;
        }
        people.map(|p: f64| p as f32)
    }
}

/// Rates or probabilities `[to][from]`.
type Matrix = [[f64; STATES.len()]; STATES.len()];

/// `exp(rates time_s) p`.
fn propagate(rates: &Matrix, time_s: f64, p: &[f64; STATES.len()]) -> [f64; STATES.len()] {
    exponential(rates, time_s).map(|row| row.iter().zip(p).map(|(a, p)| a * p).sum())
}

/// Exponential of `rates time_s`, of rates whose columns sum to zero or less and of which only the diagonal is negative: with the
/// diagonal made positive, the series has no cancellation; halved as often as its norm needs and squared as often again.
fn exponential(rates: &Matrix, time_s: f64) -> Matrix {
    /// Terms of the series, for a norm up to 1: the next is below 1e-17.
    const TERMS: usize = 18;
    let fastest = rates.iter().enumerate().map(|(k, row)| -row[k]).fold(0.0, f64::max);
    let halvings = (fastest * time_s).log2().ceil().max(0.0) as i32;
    let step_s = time_s * 0.5f64.powi(halvings);
    let mut positive = rates.map(|row| row.map(|rate| rate * step_s));
    positive.iter_mut().enumerate().for_each(|(k, row)| row[k] += fastest * step_s);
    let mut term = diagonal((-fastest * step_s).exp());
    let mut sum = term;
    for k in 1..=TERMS {
        term = product(&term, &positive).map(|row| row.map(|v| v / k as f64));
        for (sum, term) in sum.iter_mut().flatten().zip(term.iter().flatten()) {
            *sum += term;
        }
    }
    for _ in 0..halvings {
        sum = product(&sum, &sum);
    }
    sum
}

/// A matrix of this number on its diagonal.
fn diagonal(value: f64) -> Matrix {
    let mut matrix = Matrix::default();
    matrix.iter_mut().enumerate().for_each(|(k, row)| row[k] = value);
    matrix
}

fn product(a: &Matrix, b: &Matrix) -> Matrix {
    a.map(|row| std::array::from_fn(|j| row.iter().zip(b).map(|(a, b)| a * b[j]).sum()))
}

/// Probability of `k` of `n`, each with probability `p`, n up to 2.
fn binomial(n: usize, k: usize, p: f64) -> f64 {
    let ways = match (n, k) {
        (2, 1) => 2.0,
        (n, k) if k <= n => 1.0,
        _ => return 0.0,
    };
    ways * p.powi(k as i32) * (1.0 - p).powi((n - k) as i32)
}

#[cfg(test)]
mod tests {
    use radome_dsp::Occupancy;
    use rand::Rng;

    use super::*;
    use crate::evaluate::{Metrics, most_probable};

    /// Everybody always seen, each frame half a piece of evidence, as models from before `independent_s` say it.
    const PLAIN: Smoothing =
        Smoothing { dwell_s: 8.0, unseen_share: 0.0, unseen_s: 1.0, weight: Some(0.5), independent_s: None };

    /// Who stays for long, and is not always seen.
    const SLOW: Smoothing =
        Smoothing { dwell_s: 20.0, unseen_share: 0.3, unseen_s: 1.0, weight: Some(0.2), independent_s: None };

    /// The same by time.
    const SLOW_BY_TIME: Smoothing = Smoothing { weight: None, independent_s: Some(0.5), ..SLOW };

    fn filter(smoothing: Smoothing) -> OccupancyFilter {
        OccupancyFilter::new(smoothing, 0.1)
    }

    fn largest_difference(a: &Matrix, b: &Matrix) -> f64 {
        a.iter().flatten().zip(b.iter().flatten()).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
    }

    /// Columns are distributions, what holds for two steps holds for one of twice the time, and of many short steps each is the
    /// first terms of its series.
    #[test]
    fn transitions_are_a_markov_chain() {
        let rates = SLOW.rates();
        let one = exponential(&rates, 0.7);
        for from in 0..STATES.len() {
            let sum: f64 = one.iter().map(|row| row[from]).sum();
            assert!((sum - 1.0).abs() < 1e-12, "{from}: {sum}");
        }
        let steps = product(&exponential(&rates, 0.4), &exponential(&rates, 0.3));
        assert!(largest_difference(&one, &steps) < 1e-12);
        let still = diagonal(1.0);
        assert!(largest_difference(&exponential(&rates, 0.0), &still) < 1e-15);
        // With evidence, and from a millisecond to a minute.
        let mut rates = rates;
        rates.iter_mut().enumerate().for_each(|(k, row)| row[k] -= k as f64);
        for time_s in [1e-3, 1.0, 60.0] {
            let pieces = 1 << 16;
            let h = time_s / f64::from(pieces);
            let square = product(&rates, &rates);
            let short: Matrix = std::array::from_fn(|i| {
                std::array::from_fn(|j| still[i][j] + h * rates[i][j] + 0.5 * h * h * square[i][j])
            });
            let mut slow = still;
            for _ in 0..pieces {
                slow = product(&slow, &short);
            }
            let difference = largest_difference(&exponential(&rates, time_s), &slow);
            assert!(difference < 1e-5, "{time_s} s: {difference}");
        }
    }

    /// How many frames a second there are does not matter: the same probabilities, shown at 10 and at 20 Hz, come to the same at
    /// the same times.
    #[test]
    fn evidence_is_by_time_and_not_by_frame() {
        for smoothing in [Smoothing::default(), SLOW_BY_TIME] {
            let mut rng = crate::stream(4, "probabilities", 0);
            let (mut slow, mut fast) = (OccupancyFilter::new(smoothing, 0.1), OccupancyFilter::new(smoothing, 0.05));
            for frame in 1..=400 {
                let raw: [f32; 3] = std::array::from_fn(|_| rng.random_range(0.001f32..1.0).powi(3));
                let probabilities = raw.map(|p| p / raw.iter().sum::<f32>());
                let time_s = 0.1 * f64::from(frame);
                let a = slow.update(time_s, probabilities);
                fast.update(time_s - 0.05, probabilities);
                let b = fast.update(time_s, probabilities);
                assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-6), "frame {frame}: {a:?} {b:?}");
            }
        }
    }

    /// Frames so far apart that they are independent count in full, and no more than that.
    #[test]
    fn a_frame_weighs_one_piece_of_evidence_at_most() {
        let still = Smoothing { dwell_s: 1e9, ..Smoothing::default() };
        for (interval_s, weight) in [(0.1, 0.1), (0.5, 0.5), (1.0, 1.0), (7.0, 1.0)] {
            let frame = [0.2f32, 0.5, 0.3];
            let p = OccupancyFilter::new(still, interval_s).update(0.0, frame);
            let expected = frame.map(|q| f64::from(q).powf(weight));
            let norm: f64 = expected.iter().sum();
            for (p, expected) in p.iter().zip(expected) {
                assert!((f64::from(*p) - expected / norm).abs() < 1e-6, "{interval_s} s: {p}");
            }
        }
    }

    /// Settings of model files from before `independent_s` mean what they meant and are written as they were read; where there is
    /// neither a weight nor that time, it is a second.
    #[test]
    fn old_settings_keep_their_meaning() {
        let old = r#"{"dwell_s":60.0,"unseen_share":0.3,"unseen_s":3.0,"weight":0.15}"#;
        let read: Smoothing = serde_json::from_str(old).expect("old settings");
        assert_eq!((read.weight, read.independent_s, read.fault()), (Some(0.15), None, None));
        assert_eq!(serde_json::to_string(&read).expect("JSON"), old);
        // A frame's evidence to the power of its weight, at any frame interval.
        for interval_s in [0.01, 0.1, 1.0] {
            let still = Smoothing { dwell_s: 1e9, unseen_share: 0.0, ..read };
            let frame = [0.2f32, 0.5, 0.3];
            let p = OccupancyFilter::new(still, interval_s).update(0.0, frame);
            let expected = frame.map(|q| f64::from(q).powf(0.15));
            let norm: f64 = expected.iter().sum();
            assert!(p.iter().zip(expected).all(|(p, e)| (f64::from(*p) - e / norm).abs() < 1e-6), "{p:?}");
        }
        let short: Smoothing = serde_json::from_str(r#"{"dwell_s":60.0}"#).expect("settings");
        assert_eq!((short.weight, short.independent_s), (None, None));
        let (mut a, mut b) = (filter(short), filter(Smoothing::default()));
        assert_eq!(a.update(0.0, [0.2, 0.5, 0.3]), b.update(0.0, [0.2, 0.5, 0.3]));
        let both = Smoothing { weight: Some(0.5), ..Smoothing::default() };
        assert_eq!(both.fault().map(|fault| fault.0), Some("smoothing.weight"));
        for bad in [0.0, -1.0, f64::NAN] {
            let bad = Smoothing { independent_s: Some(bad), ..Smoothing::default() };
            assert_eq!(bad.fault().map(|fault| fault.0), Some("smoothing.independent_s"));
        }
    }

    /// Frames with the recalls that real people gave (0.99, 0.86, 0.71), wrong for a second at a time, probabilities as calibrated
    /// as the confusion allows: the filter's balanced accuracy is above that of the frames, at every frame rate.
    #[test]
    fn the_filter_is_not_worse_than_its_frames() {
        let confusion = [[0.99, 0.007, 0.003], [0.06, 0.86, 0.08], [0.01, 0.28, 0.71]];
        let draw = |row: &[f64; 3], u: f64| match u {
            u if u < row[0] => 0,
            u if u < row[0] + row[1] => 1,
            _ => 2,
        };
        for (rate_hz, dwell_s) in [(5.0f64, 60.0f64), (10.0, 30.0), (10.0, 60.0), (20.0, 60.0)] {
            let (mut by_frame, mut filtered) = ([[0u64; 3]; 3], [[0u64; 3]; 3]);
            for sequence in 0..20 {
                let mut rng = crate::stream(31, "sequence", sequence);
                let interval_s = 1.0 / rate_hz;
                let happens = |mean_s: f64| 1.0 - (-interval_s / mean_s).exp();
                let mut filter = OccupancyFilter::new(Smoothing::default(), interval_s);
                let (mut truth, mut seen) = ((sequence % 3) as usize, None);
                for frame in 1..=(300.0 * rate_hz) as u32 {
                    if rng.random::<f64>() < happens(dwell_s) {
                        truth = if truth == 1 { 2 * rng.random_range(0..2) } else { 1 };
                        seen = None;
                    }
                    if rng.random::<f64>() < happens(1.0) {
                        seen = None;
                    }
                    let u = rng.random::<f64>();
                    let said = *seen.get_or_insert_with(|| draw(&confusion[truth], u));
                    let column = confusion.map(|row| row[said]);
                    let probabilities = column.map(|p| (p / column.iter().sum::<f64>()) as f32);
                    let answer = filter.update(f64::from(frame) * interval_s, probabilities);
                    by_frame[truth][said] += 1;
                    filtered[truth][most_probable(&answer).index()] += 1;
                }
            }
            let [by_frame, filtered] =
                [by_frame, filtered].map(|counts| Metrics::from_confusion(counts).balanced_accuracy);
            assert!((0.8..0.9).contains(&by_frame), "{by_frame}");
            assert!(filtered > by_frame + 0.02, "{rate_hz} Hz, {dwell_s} s: {by_frame} by frame, {filtered} filtered");
        }
    }

    /// Two people of whom one is out of sight every other second are two, even while one is seen; one person is one.
    #[test]
    fn who_is_out_of_sight_for_a_moment_is_still_there() {
        let one = [0.05, 0.75, 0.2];
        let two = [0.05, 0.2, 0.75];
        for smoothing in [SLOW, SLOW_BY_TIME] {
            let mut filter_two = filter(smoothing);
            let mut label = Occupancy::Empty;
            for i in 0..300 {
                label = most_probable(&filter_two.update(0.1 * f64::from(i), if i % 20 < 10 { two } else { one }));
                assert!(i < 100 || label == Occupancy::Two, "{i}: {label:?}");
            }
            assert_eq!(label, Occupancy::Two);
            let mut filter_one = filter(smoothing);
            let labels = (0..300).map(|i| most_probable(&filter_one.update(0.1 * f64::from(i), one)));
            assert!(labels.skip(50).all(|label| label == Occupancy::One));
        }
    }

    #[test]
    fn one_odd_frame_does_not_change_the_label_and_a_lasting_change_does() {
        let mut filter = filter(PLAIN);
        let mut time_s = 0.0;
        let mut step = |q| {
            time_s += 0.1;
            most_probable(&filter.update(time_s, q))
        };
        (0..20).for_each(|_| assert_eq!(step([0.9, 0.08, 0.02]), Occupancy::Empty));
        assert_eq!(step([0.1, 0.8, 0.1]), Occupancy::Empty);
        assert_eq!(step([0.9, 0.08, 0.02]), Occupancy::Empty);
        let changed = (0..30).position(|_| step([0.05, 0.9, 0.05]) == Occupancy::One).expect("follows");
        assert!(changed < 10, "{changed} frames");
    }

    #[test]
    fn certain_and_wrong_frames_do_not_lock_the_filter() {
        for smoothing in [PLAIN, Smoothing::default()] {
            let mut filter = filter(smoothing);
            for i in 0..1000 {
                filter.update(f64::from(i) * 0.1, [1.0, 0.0, 0.0]);
            }
            let p = (0..40).map(|i| filter.update(100.0 + f64::from(i) * 0.1, [0.0, 0.0, 1.0])).last().expect("some");
            assert_eq!(most_probable(&p), Occupancy::Two);
            assert!((p.iter().sum::<f32>() - 1.0).abs() < 1e-5);
        }
    }

    mod hard_cases {
        use super::*;

        /// A clock that stands still or goes back must not turn the filter; probabilities that are none must not stay in it.
        #[test]
        fn odd_times_and_odd_probabilities_leave_a_distribution() {
            let shortest = Smoothing { dwell_s: SHORTEST_S, unseen_share: 0.5, unseen_s: SHORTEST_S, ..PLAIN };
            for smoothing in [
                Smoothing { weight: Some(1.0), ..PLAIN },
                Smoothing::default(),
                SLOW_BY_TIME,
                shortest,
                Smoothing { weight: None, independent_s: Some(SHORTEST_S), ..shortest },
            ] {
                for interval_s in [0.1, 0.0, -1.0, f64::NAN, f64::INFINITY] {
                    let mut filter = OccupancyFilter::new(smoothing, interval_s);
                    for (time_s, frame) in [
                        (0.0, [0.2, 0.5, 0.3]),
                        (0.0, [0.2, 0.5, 0.3]),
                        (-5.0, [0.0, 1.0, 0.0]),
                        (1e9, [f32::NAN, 0.5, 0.5]),
                        (1e9 + 0.1, [0.0, 0.0, 0.0]),
                        (f64::NAN, [f32::INFINITY, -1.0, 2.0]),
                        (1e9 + 0.2, [0.1, 0.1, 0.8]),
                    ] {
                        let p = filter.update(time_s, frame);
                        assert!(p.iter().all(|p| (0.0..=1.0).contains(p)), "{p:?} at {time_s}");
                        assert!((p.iter().sum::<f32>() - 1.0).abs() < 1e-5, "{p:?} at {time_s}");
                    }
                }
            }
        }
    }
}
