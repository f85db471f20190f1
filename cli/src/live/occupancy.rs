//! What a sequence of per-frame probabilities says about the room: a causal filter, then delays.

use radome_dsp::Occupancy;

/// Forward filter of a three-state hidden Markov model: people come and go one at a time and not from frame to frame.
///
/// With `q` the network's probabilities of one frame and `p` the filtered ones,
/// `p_k <- q_k^w sum_j T_jk p_j / norm`: Rabiner, Proc. IEEE 77(2), 1989, equation 19-20, with the network's
/// probabilities in place of scaled likelihoods. The weight `w < 1` says that neighbouring frames are not independent.
#[derive(Debug, Clone)]
pub struct OccupancyFilter {
    probabilities: [f64; 3],
    /// Mean time between changes of the number of people, s.
    dwell_s: f64,
    weight: f64,
    last_time_s: Option<f64>,
}

impl OccupancyFilter {
    /// A filter that knows nothing yet. `dwell_s`: mean time that a number of people stays what it is.
    pub fn new(dwell_s: f64, weight: f64) -> Self {
        OccupancyFilter { probabilities: [1.0 / 3.0; 3], dwell_s, weight, last_time_s: None }
    }

    /// Takes the network's probabilities of the frame at `time_s`; returns the filtered ones.
    pub fn update(&mut self, time_s: f64, frame: [f32; 3]) -> [f32; 3] {
        let elapsed_s = self.last_time_s.map_or(0.0, |last| (time_s - last).max(0.0));
        self.last_time_s = Some(time_s);
        let stay = (-elapsed_s / self.dwell_s).exp();
        let [empty, one, two] = self.probabilities;
        let go = 1.0 - stay;
        // One leaves from one or two, one comes to empty or one.
        let predicted =
            [stay * empty + 0.5 * go * one, stay * one + go * empty + go * two, stay * two + 0.5 * go * one];
        let mut posterior = [0.0; 3];
        for k in 0..3 {
            // No single frame may rule a class out for good.
            posterior[k] = predicted[k] * f64::from(frame[k]).max(1e-4).powf(self.weight);
        }
        let norm: f64 = posterior.iter().sum();
        self.probabilities = posterior.map(|p| p / norm);
        self.probabilities.map(|p| p as f32)
    }
}

/// Index of the largest probability as a class.
pub fn most_likely(probabilities: [f32; 3]) -> Occupancy {
    let mut best = Occupancy::Empty;
    for class in Occupancy::ALL {
        if probabilities[class.index()] > probabilities[best.index()] {
            best = class;
        }
    }
    best
}

/// Occupied or not, with delays against flicker: what leaves the house.
#[derive(Debug, Clone)]
pub struct Hysteresis {
    on_delay_s: f64,
    off_delay_s: f64,
    is_occupied: bool,
    /// Since when the frames have said otherwise.
    contrary_since_s: Option<f64>,
}

impl Hysteresis {
    /// Changes to occupied after `on_delay_s` of agreement, to empty after `off_delay_s`.
    pub fn new(on_delay_s: f64, off_delay_s: f64) -> Self {
        Hysteresis { on_delay_s, off_delay_s, is_occupied: false, contrary_since_s: None }
    }

    /// Takes the label of the frame at `time_s`; returns whether the room counts as occupied.
    pub fn update(&mut self, time_s: f64, label: Occupancy) -> bool {
        if (label != Occupancy::Empty) == self.is_occupied {
            self.contrary_since_s = None;
            return self.is_occupied;
        }
        let since_s = *self.contrary_since_s.get_or_insert(time_s);
        let delay_s = if self.is_occupied { self.off_delay_s } else { self.on_delay_s };
        if time_s - since_s >= delay_s {
            self.is_occupied = !self.is_occupied;
            self.contrary_since_s = None;
        }
        self.is_occupied
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_odd_frame_does_not_change_the_label_and_a_lasting_change_does() {
        let mut filter = OccupancyFilter::new(8.0, 0.5);
        let mut time_s = 0.0;
        let mut step = |q| {
            time_s += 0.1;
            most_likely(filter.update(time_s, q))
        };
        (0..20).for_each(|_| assert_eq!(step([0.9, 0.08, 0.02]), Occupancy::Empty));
        assert_eq!(step([0.1, 0.8, 0.1]), Occupancy::Empty);
        assert_eq!(step([0.9, 0.08, 0.02]), Occupancy::Empty);
        let changed = (0..30).position(|_| step([0.05, 0.9, 0.05]) == Occupancy::One).expect("follows");
        assert!(changed < 10, "{changed} frames");
    }

    #[test]
    fn certain_and_wrong_frames_do_not_lock_the_filter() {
        let mut filter = OccupancyFilter::new(8.0, 0.5);
        for i in 0..1000 {
            filter.update(f64::from(i) * 0.1, [1.0, 0.0, 0.0]);
        }
        let p = (0..20).map(|i| filter.update(100.0 + f64::from(i) * 0.1, [0.0, 0.0, 1.0])).last().expect("some");
        assert_eq!(most_likely(p), Occupancy::Two);
        assert!((p.iter().sum::<f32>() - 1.0).abs() < 1e-5);
    }

    #[test]
    fn hysteresis_waits_on_both_sides() {
        let mut state = Hysteresis::new(0.5, 2.0);
        let mut at = |time_s: f64, label| state.update(time_s, label);
        assert!(!at(0.0, Occupancy::One));
        assert!(!at(0.3, Occupancy::Empty));
        assert!(!at(0.4, Occupancy::Two));
        assert!(at(0.9, Occupancy::One));
        assert!(at(1.0, Occupancy::Empty));
        assert!(at(2.9, Occupancy::Empty));
        assert!(!at(3.0, Occupancy::Empty));
    }

    mod hard_cases {
        use super::*;

        /// A clock that stands still or goes back must not turn the filter; probabilities that are none must not stay in it.
        #[test]
        fn odd_times_and_odd_probabilities_leave_a_distribution() {
            let mut filter = OccupancyFilter::new(8.0, 1.0);
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
