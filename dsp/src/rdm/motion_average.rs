//! Motion of echoes from frame to frame. It tells two people who walk from one person with multipath echoes.
//!
//! The echoes of one person approach and recede together: the distances between them hardly change, and the nearest one moves as its
//! Doppler says. Two people move independently. A single frame shows this only where they move in different directions. Therefore
//! each frame is compared with the one about 0.3 s before, and the differences are averaged over about a second.
//!
//! A person who sits hardly moves within a frame. Change from frame to frame shows this person. If it is nearer than the motion of another
//! person, it is held for a while, because this other person may stop or be hidden.
//!
//! The other quantities are computed from the range profile of a map: the strongest moving cell of each range bin, with its level over the
//! noise of the bin and its velocity. [`reference::motion`](super::reference::motion) is the slow version.

use std::collections::VecDeque;

use super::map::{Rdm, RdmShape};
use super::motion::Motion;
use super::nearer_change::nearer_change;
use super::physical::{QUARTILES, quantile};

/// Time between compared frames, s. The stored frame whose age is closest to it is taken.
pub(super) const LAG_S: f64 = 0.3;
/// Frames that are older are not compared, and a longer gap between two frames ends the averages, s.
pub(super) const MOST_AGE_S: f64 = 1.0;
/// Ranges below it show leakage between the antennas, m.
pub(super) const LEAKAGE_M: f64 = 0.4;
/// Velocities up to it are those of the room at rest, m/s.
pub(super) const SLOW_M_PER_S: f64 = 0.15;
/// Level of the strongest moving cell above which a frame shows motion, dB over noise.
pub(super) const MOTION_DB: f32 = 15.0;
/// Levels above which cells are part of the profile: that below the strongest cell, and that over noise, dB.
pub(super) const PROFILE_DB: [f32; 2] = [35.0, 10.0];
/// The same for the nearest echo. Sidelobes of windows and limbs nearer than a body are weaker.
pub(super) const NEAREST_DB: [f32; 2] = [10.0, 12.0];
/// Level above which there is a second echo, dB over noise.
pub(super) const SECOND_DB: f32 = 12.0;
/// The second echo is farther behind the nearest one than this, m. A body with its limbs and the range window extend over less.
pub(super) const BEHIND_M: f64 = 0.65;
/// Largest shift between profiles that is looked for, m.
pub(super) const MOST_SHIFT_M: f64 = 2.1;
/// Upper bound of distances, m. Where the nearest echo changes from one person to another, the distance says nothing more.
pub(super) const MOST_DISTANCE_M: f64 = 1.5;
/// Change is nearer than the motion if its distance to it is more than this, m. Limbs and, with at least 1 GHz of bandwidth, the range
/// window extend over less.
pub(super) const NEARER_M: f64 = 0.4;
/// Time in which held change falls by `1/e`, s.
pub(super) const HELD_S: f64 = 0.7;
/// Number of quantities that are averages.
pub(super) const AVERAGES: usize = Motion::QUANTITIES - 1;
/// Least time between stored frames, s. Of faster frames, some are not stored.
const STORED_INTERVAL_S: f64 = 0.02;

/// Averages over frames, and the frames that the next ones are compared with.
pub(super) struct MotionAverage {
    over_s: f64,
    frame_interval_s: f64,
    last_sequence: Option<u64>,
    /// Profiles of earlier frames, the newest first.
    earlier: VecDeque<Profile>,
    /// Profiles whose memory is used again.
    spare: Vec<Profile>,
    sums: [f64; AVERAGES],
    weight: f64,
    /// Change nearer than the motion: the largest of the frames, where earlier ones count less.
    nearer_change: f64,
    /// Whether cells of zero velocity hold the change from frame to frame.
    has_change: bool,
    /// Buffer for the levels of a range bin.
    column: Vec<f32>,
}

/// Range profile of a frame.
#[derive(Default)]
struct Profile {
    /// Time since the frame, s.
    age_s: f64,
    /// Change nearer than the motion, 0 to 1.
    nearer_change: f64,
    /// Level of the cell of zero velocity of each range bin, dB over noise.
    changes_db: Vec<f32>,
    /// Whether the frame shows motion. If not, the fields below do not count.
    is_moving: bool,
    /// Level of the strongest moving cell of each range bin, dB over noise, and its velocity, m/s.
    levels_db: Vec<f32>,
    velocities_m_per_s: Vec<f64>,
    /// Square root of the height of each level over the larger of the two [`PROFILE_DB`].
    weights: Vec<f32>,
    /// Autocorrelation of the weights by distance in bins, from 1 on, scaled to length 1; 0 if it is 0.
    spacings: Vec<f32>,
    /// Velocity of the strongest cell, m/s.
    velocity_m_per_s: f64,
    nearest: Echo,
    /// Strongest echo behind the nearest one.
    second: Option<Echo>,
}

#[derive(Clone, Copy, Default)]
struct Echo {
    range_m: f64,
    velocity_m_per_s: f64,
}

impl MotionAverage {
    /// Starts averages over maps of this shape, whose weights fall by `1/e` over `over_s`. `has_change` says whether the cells of zero
    /// velocity hold the change from frame to frame.
    pub(super) fn new(shape: RdmShape, over_s: f64, frame_interval_s: f64, has_change: bool) -> Self {
        let most_stored = (MOST_AGE_S / frame_interval_s.max(STORED_INTERVAL_S)) as usize + 2;
        MotionAverage {
            over_s,
            frame_interval_s,
            last_sequence: None,
            earlier: VecDeque::with_capacity(most_stored),
            spare: (0..most_stored).map(|_| Profile::with_capacity(shape.range)).collect(),
            sums: [0.0; AVERAGES],
            weight: 0.0,
            nearer_change: 0.0,
            has_change,
            column: Vec::with_capacity(shape.doppler),
        }
    }

    /// Forgets all frames.
    pub(super) fn reset(&mut self) {
        self.last_sequence = None;
        self.spare.extend(self.earlier.drain(..));
        (self.weight, self.sums, self.nearer_change) = (0.0, [0.0; AVERAGES], 0.0);
    }

    /// Takes the map of the next frame, of one channel, and returns the averages. Some frames may be missing. A map with cells that are
    /// not finite is left out.
    pub(super) fn push(&mut self, map: &Rdm) -> Motion {
        if map.flags.non_finite_cells > 0 {
            return self.average();
        }
        let frames = self.last_sequence.map(|last| map.sequence.checked_sub(last).unwrap_or(u64::MAX).max(1));
        let elapsed_s = frames.map_or(f64::INFINITY, |frames| frames as f64 * self.frame_interval_s);
        if elapsed_s > MOST_AGE_S {
            self.reset();
        }
        self.last_sequence = Some(map.sequence);
        for profile in &mut self.earlier {
            profile.age_s += elapsed_s;
        }
        while self.earlier.back().is_some_and(|profile| profile.age_s > MOST_AGE_S) {
            self.spare.extend(self.earlier.pop_back());
        }

        let mut newest = self.spare.pop().unwrap_or_default();
        newest.measure(map, &mut self.column);
        let distance_to_lag = |profile: &&Profile| (profile.age_s - LAG_S).abs();
        let closest = self.earlier.iter().min_by(|a, b| distance_to_lag(a).total_cmp(&distance_to_lag(b)));
        // The frame itself, of age 0, may be closer.
        let closest = closest.filter(|profile| distance_to_lag(profile) < LAG_S);
        let comparison = newest.compare(closest, map.range_step_m);
        let retention = (-elapsed_s / self.over_s).exp();
        self.weight = self.weight * retention + 1.0;
        for (sum, quantity) in self.sums.iter_mut().zip(comparison) {
            *sum = *sum * retention + quantity;
        }
        let nearer_change = if self.has_change { newest.nearer_change } else { 0.0 };
        self.nearer_change = nearer_change.max(self.nearer_change * (-elapsed_s / HELD_S).exp());
        let is_dense = self.earlier.front().is_some_and(|profile| profile.age_s < STORED_INTERVAL_S);
        if is_dense {
            self.spare.push(newest);
        } else {
            self.earlier.push_front(newest);
        }
        self.average()
    }

    fn average(&self) -> Motion {
        let mut quantities = [self.nearer_change as f32; Motion::QUANTITIES];
        for (quantity, sum) in quantities.iter_mut().zip(self.sums) {
            *quantity = if self.weight > 0.0 { (sum / self.weight) as f32 } else { 0.0 };
        }
        Motion::from_array(quantities)
    }
}

impl Profile {
    fn with_capacity(range: usize) -> Self {
        Profile {
            levels_db: Vec::with_capacity(range),
            velocities_m_per_s: Vec::with_capacity(range),
            changes_db: Vec::with_capacity(range),
            weights: Vec::with_capacity(range),
            spacings: Vec::with_capacity(range),
            ..Profile::default()
        }
    }

    /// Measures the profile of a map of one channel. `column` is a buffer.
    fn measure(&mut self, map: &Rdm, column: &mut Vec<f32>) {
        self.age_s = 0.0;
        self.levels_db.clear();
        self.velocities_m_per_s.clear();
        self.changes_db.clear();
        // Slow cells are no motion, but where the strongest cell is one, change may be that of the same person.
        let (mut slow_db, mut fast_db, mut fast_range) = (f32::MIN, f32::MIN, 0);
        for range in 0..map.shape.range {
            let (mut strongest_db, mut velocity_m_per_s, mut slowest_db) = (f32::MIN, 0.0, f32::MIN);
            column.clear();
            for doppler in 0..map.shape.doppler {
                let (level_db, velocity) = (map.at(0, doppler, range), map.velocity_m_per_s(doppler));
                column.push(level_db);
                if velocity.abs() > SLOW_M_PER_S && level_db > strongest_db {
                    (strongest_db, velocity_m_per_s) = (level_db, velocity);
                } else if velocity != 0.0 && velocity.abs() <= SLOW_M_PER_S {
                    slowest_db = slowest_db.max(level_db);
                }
            }
            let change_db = column[map.shape.doppler / 2];
            let noise_db = quantile(column, 4) - 10.0 * QUARTILES[0].log10();
            let is_leakage = map.range_m(range) < LEAKAGE_M;
            let over_noise_db = |level_db: f32| {
                if is_leakage { 0.0 } else { 10.0 * (1.0 + 10f32.powf(0.1 * (level_db - noise_db))).log10() }
            };
            let level_db = over_noise_db(strongest_db);
            self.levels_db.push(level_db);
            self.velocities_m_per_s.push(velocity_m_per_s);
            self.changes_db.push(over_noise_db(change_db));
            slow_db = slow_db.max(over_noise_db(slowest_db));
            if level_db > fast_db {
                (fast_db, fast_range) = (level_db, range);
            }
        }
        let is_nearer = |range: &usize| map.range_m(fast_range) - map.range_m(*range) > NEARER_M;
        let nearer_db = (0..map.shape.range).filter(is_nearer).map(|range| self.changes_db[range]).fold(0.0, f32::max);
        self.nearer_change = if fast_db > slow_db { nearer_change(nearer_db, fast_db) } else { 0.0 };

        let strongest = self.strongest(0);
        let most_db = strongest.map_or(0.0, |bin| self.levels_db[bin]);
        self.is_moving = most_db > MOTION_DB;
        let Some(strongest) = strongest.filter(|_| self.is_moving) else { return };
        self.velocity_m_per_s = self.velocities_m_per_s[strongest];
        let above = |[below_strongest_db, over_noise_db]: [f32; 2]| (most_db - below_strongest_db).max(over_noise_db);
        let profile_db = above(PROFILE_DB);
        self.weights.clear();
        self.weights.extend(self.levels_db.iter().map(|level_db| (level_db - profile_db).max(0.0).sqrt()));
        self.measure_spacings();
        let nearest_db = above(NEAREST_DB);
        let nearest = self.levels_db.iter().position(|level_db| *level_db > nearest_db).unwrap_or(strongest);
        self.nearest = self.echo(map, nearest);
        let behind = (nearest..self.levels_db.len())
            .find(|bin| map.range_m(*bin) - self.nearest.range_m > BEHIND_M)
            .and_then(|first| self.strongest(first));
        self.second = behind.filter(|bin| self.levels_db[*bin] > SECOND_DB).map(|bin| self.echo(map, bin));
    }

    /// Bin with the strongest moving cell from a bin on, the nearest one of equals.
    fn strongest(&self, first: usize) -> Option<usize> {
        let levels = self.levels_db.iter().copied().enumerate().skip(first);
        levels.reduce(|best, bin| if bin.1 > best.1 { bin } else { best }).map(|(bin, _)| bin)
    }

    fn echo(&self, map: &Rdm, bin: usize) -> Echo {
        Echo { range_m: map.range_m(bin), velocity_m_per_s: self.velocities_m_per_s[bin] }
    }

    fn measure_spacings(&mut self) {
        let Profile { weights, spacings, .. } = self;
        spacings.clear();
        spacings.extend((1..weights.len()).map(|distance| overlap(&weights[distance..], weights)));
        let length = overlap(spacings, spacings).sqrt();
        if length > 0.0 {
            spacings.iter_mut().for_each(|spacing| *spacing /= length);
        }
    }

    /// Compares the frame with an earlier one, and the echoes of the frame with each other: the averaged quantities of [`Motion`].
    fn compare(&self, earlier: Option<&Profile>, range_step_m: f64) -> [f64; AVERAGES] {
        let second = self.second.filter(|_| self.is_moving);
        let second_share = if second.is_some() { 1.0 } else { 0.0 };
        let difference = |second: Echo| (second.velocity_m_per_s - self.nearest.velocity_m_per_s).abs();
        let velocity_difference_m_per_s = second.map_or(0.0, difference);
        let Some(earlier) = earlier.filter(|earlier| self.is_moving && earlier.is_moving) else {
            return [0.0, 0.0, 0.0, 0.0, second_share, velocity_difference_m_per_s];
        };
        // A profile of one bin has no spacings.
        let has_spacings = |profile: &Profile| profile.spacings.iter().any(|spacing| *spacing > 0.0);
        let spacing_change_rad = if has_spacings(self) && has_spacings(earlier) {
            f64::from(overlap(&self.spacings, &earlier.spacings).min(1.0)).acos()
        } else {
            0.0
        };
        let error_m = |way_m: f64, velocities_m_per_s: [f64; 2]| {
            let expected_m = 0.5 * velocities_m_per_s.iter().sum::<f64>() * earlier.age_s;
            (way_m - expected_m).abs().min(MOST_DISTANCE_M)
        };
        let shift_m = self.shift_bins(earlier, range_step_m) as f64 * range_step_m;
        let (nearest, before) = (self.nearest, earlier.nearest);
        let separation_change_m = match (second, earlier.second) {
            (Some(second), Some(second_before)) => {
                let separation_m = second.range_m - nearest.range_m;
                (separation_m - (second_before.range_m - before.range_m)).abs().min(MOST_DISTANCE_M)
            }
            _ => 0.0,
        };
        [
            spacing_change_rad,
            error_m(shift_m, [self.velocity_m_per_s, earlier.velocity_m_per_s]),
            error_m(nearest.range_m - before.range_m, [nearest.velocity_m_per_s, before.velocity_m_per_s]),
            separation_change_m,
            second_share,
            velocity_difference_m_per_s,
        ]
    }

    /// Shift by which the earlier profile overlaps this one most, towards larger ranges.
    fn shift_bins(&self, earlier: &Profile, range_step_m: f64) -> i64 {
        let most = ((MOST_SHIFT_M / range_step_m).round() as i64).min(self.weights.len() as i64);
        let overlap_at = |shift: i64| {
            let by = shift.unsigned_abs() as usize;
            let (now, before) = if shift < 0 { (0, by) } else { (by, 0) };
            overlap(&self.weights[now..], &earlier.weights[before..])
        };
        let shifts = (-most..=most).map(|shift| (shift, overlap_at(shift)));
        shifts.reduce(|best, other| if other.1 > best.1 { other } else { best }).map_or(0, |(shift, _)| shift)
    }
}

/// Sum of products, up to the end of the shorter of the two.
fn overlap(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}
