//! What a sequence of per-frame probabilities says about the room: a causal filter.

use serde::{Deserialize, Serialize};

/// Who is there and who of them is seen, `(present, seen)`: the states of [`OccupancyFilter`].
const STATES: [(usize, usize); 6] = [(0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2)];

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
    /// Weight of one frame's evidence in (0, 1]: neighbouring frames are not independent. 1 takes each at its word.
    pub weight: f64,
}

impl Default for Smoothing {
    /// Short visits by people who are always seen, frames taken at their word.
    fn default() -> Self {
        Smoothing { dwell_s: 8.0, unseen_share: 0.0, unseen_s: 1.0, weight: 1.0 }
    }
}

impl Smoothing {
    /// What is wrong with a setting: `(name, value, expected)`.
    pub(crate) fn fault(&self) -> Option<(&'static str, f64, &'static str)> {
        let positive = |v: f64| v.is_finite() && v > 0.0;
        if !positive(self.dwell_s) {
            return Some(("smoothing.dwell_s", self.dwell_s, "a time above 0"));
        }
        if !positive(self.unseen_s) {
            return Some(("smoothing.unseen_s", self.unseen_s, "a time above 0"));
        }
        if !(0.0..1.0).contains(&self.unseen_share) {
            return Some(("smoothing.unseen_share", self.unseen_share, "0 up to below 1"));
        }
        if !(self.weight > 0.0 && self.weight <= 1.0) {
            return Some(("smoothing.weight", self.weight, "above 0 and up to 1"));
        }
        None
    }
}

/// Forward filter of a hidden Markov model: people come and go one at a time, and each of them is seen and unseen on their own,
/// so that a room in which now two and now one are seen holds two, and one in which never more than one is seen holds one.
///
/// With `q` the network's probabilities of one frame, of as many people as are seen in it, and `p` those of the states,
/// `p_k <- q_seen(k)^w sum_j T_jk p_j / norm`: Rabiner, Proc. IEEE 77(2), 1989, equations 19-20, with the network's
/// probabilities in place of scaled likelihoods.
#[derive(Debug, Clone)]
pub struct OccupancyFilter {
    smoothing: Smoothing,
    probabilities: [f64; STATES.len()],
    last_time_s: Option<f64>,
}

impl OccupancyFilter {
    /// A filter that knows nothing yet.
    pub fn new(smoothing: Smoothing) -> Self {
        let probabilities = STATES.map(|(present, seen)| binomial(present, seen, 1.0 - smoothing.unseen_share) / 3.0);
        OccupancyFilter { smoothing, probabilities, last_time_s: None }
    }

    /// Takes the network's probabilities of the frame at `time_s`; returns those of empty, one and two.
    pub fn update(&mut self, time_s: f64, frame: [f32; 3]) -> [f32; 3] {
        let elapsed_s = self.last_time_s.map_or(0.0, |last| (time_s - last).max(0.0));
        self.last_time_s = Some(time_s);
        let weight = self.smoothing.weight;
        // No single frame may rule a class out for good.
        let evidence = frame.map(|q| f64::from(q).max(1e-4).powf(weight));
        let mut posterior = [0.0; STATES.len()];
        for (p, to) in posterior.iter_mut().zip(STATES) {
            let from = STATES.iter().zip(&self.probabilities);
            *p = evidence[to.1] * from.map(|(from, p)| p * self.transition(*from, to, elapsed_s)).sum::<f64>();
        }
        let norm: f64 = posterior.iter().sum();
        self.probabilities = posterior.map(|p| p / norm);
        let mut people = [0.0f32; 3];
        for ((present, _), p) in STATES.iter().zip(self.probabilities) {
            people[*present] += p as f32;
        }
        people
    }

    /// Probability of one state after another, `elapsed_s` later.
    fn transition(&self, from: (usize, usize), to: (usize, usize), elapsed_s: f64) -> f64 {
        let Smoothing { dwell_s, unseen_share, unseen_s, .. } = self.smoothing;
        let stay = (-elapsed_s / dwell_s).exp();
        // One leaves from one or two, one comes to empty or one.
        let present = match (from.0, to.0) {
            (a, b) if a == b => stay,
            (1, _) => 0.5 * (1.0 - stay),
            (_, 1) => 1.0 - stay,
            _ => 0.0,
        };
        if from.0 != to.0 {
            return present * binomial(to.0, to.1, 1.0 - unseen_share);
        }
        // Of those seen `kept` stay so, of the unseen the rest turn up.
        let forgets = -(-elapsed_s / unseen_s).exp_m1();
        let (stays_seen, turns_up) = (1.0 - unseen_share * forgets, (1.0 - unseen_share) * forgets);
        let seen = (0..=from.1.min(to.1))
            .map(|kept| binomial(from.1, kept, stays_seen) * binomial(from.0 - from.1, to.1 - kept, turns_up));
        present * seen.sum::<f64>()
    }
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

    use super::*;
    use crate::evaluate::most_probable;

    /// Frames taken at their word, everybody always seen.
    const PLAIN: Smoothing = Smoothing { dwell_s: 8.0, unseen_share: 0.0, unseen_s: 1.0, weight: 0.5 };

    /// Who stays for long, and is not always seen.
    const SLOW: Smoothing = Smoothing { dwell_s: 20.0, unseen_share: 0.3, unseen_s: 1.0, weight: 0.2 };

    /// Rows of a transition matrix are distributions, and what holds for two steps holds for one of twice the time.
    #[test]
    fn transitions_are_a_markov_chain() {
        let filter = OccupancyFilter::new(SLOW);
        for from in STATES {
            let sum: f64 = STATES.iter().map(|to| filter.transition(from, *to, 0.7)).sum();
            assert!((sum - 1.0).abs() < 1e-12, "{from:?}: {sum}");
            assert_eq!(filter.transition(from, from, 0.0), 1.0);
        }
        // Only within one number of people: coming and going is to first order in the time.
        let forever = OccupancyFilter::new(Smoothing { dwell_s: 1e12, ..SLOW });
        for from in STATES {
            for to in STATES {
                let steps =
                    STATES.iter().map(|via| forever.transition(from, *via, 0.4) * forever.transition(*via, to, 0.4));
                let (two, one) = (steps.sum::<f64>(), forever.transition(from, to, 0.8));
                assert!((two - one).abs() < 1e-9, "{from:?} to {to:?}: {two} {one}");
            }
        }
    }

    /// Two people of whom one is out of sight every other second are two, even while one is seen; one person is one.
    #[test]
    fn who_is_out_of_sight_for_a_moment_is_still_there() {
        let one = [0.05, 0.75, 0.2];
        let two = [0.05, 0.2, 0.75];
        let mut filter = OccupancyFilter::new(SLOW);
        let mut label = Occupancy::Empty;
        for i in 0..300 {
            label = most_probable(&filter.update(0.1 * f64::from(i), if i % 20 < 10 { two } else { one }));
            assert!(i < 100 || label == Occupancy::Two, "{i}: {label:?}");
        }
        assert_eq!(label, Occupancy::Two);
        let mut filter = OccupancyFilter::new(SLOW);
        let labels = (0..300).map(|i| most_probable(&filter.update(0.1 * f64::from(i), one)));
        assert!(labels.skip(50).all(|label| label == Occupancy::One));
    }

    #[test]
    fn one_odd_frame_does_not_change_the_label_and_a_lasting_change_does() {
        let mut filter = OccupancyFilter::new(PLAIN);
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
        let mut filter = OccupancyFilter::new(PLAIN);
        for i in 0..1000 {
            filter.update(f64::from(i) * 0.1, [1.0, 0.0, 0.0]);
        }
        let p = (0..20).map(|i| filter.update(100.0 + f64::from(i) * 0.1, [0.0, 0.0, 1.0])).last().expect("some");
        assert_eq!(most_probable(&p), Occupancy::Two);
        assert!((p.iter().sum::<f32>() - 1.0).abs() < 1e-5);
    }

    mod hard_cases {
        use super::*;

        /// A clock that stands still or goes back must not turn the filter; probabilities that are none must not stay in it.
        #[test]
        fn odd_times_and_odd_probabilities_leave_a_distribution() {
            let mut filter = OccupancyFilter::new(Smoothing { weight: 1.0, ..PLAIN });
            for (time_s, frame) in [
                (0.0, [0.2, 0.5, 0.3]),
                (0.0, [0.2, 0.5, 0.3]),
                (-5.0, [0.0, 1.0, 0.0]),
                (1e9, [f32::NAN, 0.5, 0.5]),
                (1e9 + 0.1, [0.0, 0.0, 0.0]),
            ] {
                let p = filter.update(time_s, frame);
                assert!(p.iter().all(|p| (0.0..=1.0).contains(p)), "{p:?} at {time_s}");
                assert!((p.iter().sum::<f32>() - 1.0).abs() < 1e-5, "{p:?} at {time_s}");
            }
        }
    }
}
