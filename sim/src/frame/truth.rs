//! Ground truth of a frame: people in the room.

use std::sync::Arc;

use radome_dsp::{Occupancy, Truth};

use super::{FrameSimulator, PersonState};
use crate::em::specular::Ellipsoid;
use crate::people::body::{CHEST, SEGMENTS, half_extent};
use crate::people::motion::Motion;

/// Number of times in a frame at which truth is evaluated: its quarters.
const TRUTH_TIMES: usize = 5;

impl FrameSimulator {
    pub(crate) fn truth(&self, index: u64) -> Truth {
        self.truth_at(self.start_s(index))
    }

    pub(crate) fn truth_at(&self, start_s: f64) -> Truth {
        let motions = self.motions(start_s);
        self.truth_of(&motions, start_s, |person, time| {
            Some(motions.get(person)?.body(self.truth_time_s(start_s, time)))
        })
    }

    /// Returns the time at which truth is evaluated, s.
    fn truth_time_s(&self, start_s: f64, time: usize) -> f64 {
        start_s + self.active_s() * time as f64 / (TRUTH_TIMES - 1) as f64
    }

    /// Computes the ground truth of a frame, given the bodies of people by the index of the time.
    pub(super) fn truth_of(
        &self,
        motions: &[Arc<Motion>],
        start_s: f64,
        body: impl Fn(usize, usize) -> Option<[Ellipsoid; SEGMENTS]>,
    ) -> Truth {
        let (mut count, mut transition) = (0, false);
        for (person, motion) in motions.iter().enumerate() {
            let (mut in_room, mut outside) = (false, false);
            for time in 0..TRUTH_TIMES {
                if !motion.exists(self.truth_time_s(start_s, time)) {
                    outside = true;
                    continue;
                }
                for segment in body(person, time).iter().flatten() {
                    let [is_in, is_out] = self.floor.meets(segment.centre, half_extent(segment));
                    in_room |= is_in;
                    outside |= is_out;
                }
            }
            count += usize::from(in_room);
            transition |= in_room && outside;
        }
        let occupancy = Occupancy::from_index(count.min(2)).unwrap_or(Occupancy::Two);
        Truth { occupancy, transition }
    }

    pub(crate) fn people(&self, index: u64) -> Vec<PersonState> {
        let t = self.start_s(index) + 0.5 * self.active_s();
        let radar = self.scene.radar_position();
        let state = |(slot, motion): (usize, Arc<Motion>)| {
            let at = |t: f64| motion.body(t)[CHEST].centre;
            let h = 5e-4;
            let (position, velocity) = (at(t), (at(t + h) - at(t - h)) / (2.0 * h));
            let offset = position - radar;
            let in_room = motion.body(t).iter().any(|s| {
                let half = half_extent(s);
                s.centre.z + half.z > 0.0 && self.floor.meets(s.centre, half)[0]
            });
            PersonState {
                slot,
                position,
                velocity,
                range_m: offset.length(),
                radial_speed_m_per_s: velocity.dot(offset.normalize_or_zero()),
                in_room,
            }
        };
        self.scenario.between(t, t).into_iter().map(state).collect()
    }
}
