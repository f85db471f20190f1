//! What leaves the house: occupied or not, after delays.

use radome_dsp::Occupancy;

/// Occupied or not, with delays against flicker.
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
}
