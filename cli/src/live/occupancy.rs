//! Number of people in the room, after delays.

use radome_dsp::Occupancy;

/// On/off state with delays that suppress flicker.
#[derive(Debug, Clone)]
struct Hysteresis {
    on_delay_s: f64,
    off_delay_s: f64,
    is_on: bool,
    /// Time since which the labels have contradicted the state, s.
    contrary_since_s: Option<f64>,
}

impl Hysteresis {
    fn new(on_delay_s: f64, off_delay_s: f64) -> Self {
        Hysteresis { on_delay_s, off_delay_s, is_on: false, contrary_since_s: None }
    }

    fn update(&mut self, time_s: f64, is_on_label: bool) {
        if is_on_label == self.is_on {
            self.contrary_since_s = None;
            return;
        }
        let since_s = *self.contrary_since_s.get_or_insert(time_s);
        let delay_s = if self.is_on { self.off_delay_s } else { self.on_delay_s };
        if time_s - since_s >= delay_s {
            self.is_on = is_on_label;
            self.contrary_since_s = None;
        }
    }
}

/// Longest time after the first label for which a count of 0 is unsettled, s. A longer on delay takes its place.
const LONGEST_SETTLING_S: f64 = 5.0;

/// Number of people in a room. The same delays apply to each person, so neither the first nor the second one flickers.
#[derive(Debug, Clone)]
pub struct PeopleCount {
    at_least: [Hysteresis; 2],
    /// Time after the first label from which on a count of 0 is settled, s.
    settling_s: f64,
    /// Time of the first label, s.
    first_s: Option<f64>,
    is_settled: bool,
}

impl PeopleCount {
    /// Creates a count that rises after `on_delay_s` of agreement and falls after `off_delay_s`.
    pub fn new(on_delay_s: f64, off_delay_s: f64) -> Self {
        PeopleCount {
            at_least: [Hysteresis::new(on_delay_s, off_delay_s), Hysteresis::new(on_delay_s, off_delay_s)],
            settling_s: off_delay_s.min(LONGEST_SETTLING_S).max(on_delay_s),
            first_s: None,
            is_settled: false,
        }
    }

    /// Updates the count with the label of the frame at `time_s`; returns the number of people.
    pub fn update(&mut self, time_s: f64, label: Occupancy) -> usize {
        let [one, two] = &mut self.at_least;
        one.update(time_s, label >= Occupancy::One);
        two.update(time_s, label >= Occupancy::Two);
        let people = self.people();
        let first_s = *self.first_s.get_or_insert(time_s);
        self.is_settled |= people > 0 || time_s - first_s >= self.settling_s;
        people
    }

    /// Returns whether enough labels have come for the count. Before, it is 0, even if people are in the room.
    pub fn is_settled(&self) -> bool {
        self.is_settled
    }

    /// Number of people as of the last label.
    pub fn people(&self) -> usize {
        self.at_least.iter().filter(|state| state.is_on).count()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hysteresis_waits_on_both_sides() {
        let mut state = PeopleCount::new(0.5, 2.0);
        let mut at = |time_s: f64, label| state.update(time_s, label);
        assert_eq!(at(0.0, Occupancy::One), 0);
        assert_eq!(at(0.3, Occupancy::Empty), 0);
        assert_eq!(at(0.4, Occupancy::Two), 0);
        assert_eq!(at(0.9, Occupancy::One), 1);
        assert_eq!(at(1.0, Occupancy::Empty), 1);
        assert_eq!(at(2.9, Occupancy::Empty), 1);
        assert_eq!(at(3.0, Occupancy::Empty), 0);
    }

    /// Regression test: after each start, the room was reported as empty until the delay of the first person was over.
    #[test]
    fn a_count_of_nobody_is_settled_only_when_somebody_would_have_been_counted() {
        for (label, settled_s) in [(Occupancy::One, 0.5), (Occupancy::Empty, 2.0)] {
            let mut state = PeopleCount::new(0.5, 2.0);
            for tenths in 0..40 {
                let time_s = 7.0 + 0.1 * f64::from(tenths);
                state.update(time_s, label);
                assert_eq!(state.is_settled(), time_s - 7.0 >= settled_s - 1e-9, "{label:?} at {time_s} s");
            }
        }
        // A delay of minutes before a room counts as empty does not hold up the first answer for so long.
        let mut state = PeopleCount::new(0.5, 600.0);
        state.update(0.0, Occupancy::Empty);
        assert!(!state.is_settled());
        state.update(LONGEST_SETTLING_S, Occupancy::Empty);
        assert!(state.is_settled());
    }

    #[test]
    fn the_second_person_has_delays_of_their_own() {
        let mut state = PeopleCount::new(0.5, 2.0);
        let mut at = |time_s: f64, label| state.update(time_s, label);
        at(0.0, Occupancy::Two);
        assert_eq!(at(0.5, Occupancy::Two), 2);
        assert_eq!(at(1.0, Occupancy::One), 2);
        assert_eq!(at(2.0, Occupancy::Empty), 2);
        // No label has been two since 1.0, and none has been one since 2.0.
        assert_eq!(at(3.0, Occupancy::Empty), 1);
        assert_eq!(at(4.0, Occupancy::Empty), 0);
    }
}
