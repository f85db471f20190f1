//! Way-points: positions of people, given by the user for times at which they were not tracked, or not rightly.

use std::path::Path;

use anyhow::{Context, bail};
use glam::DVec2;
use radome_files::{TEXT_LIMIT_BYTES, parse_toml, read_text};
use radome_sim::scene_file::RoomFile;
use serde::Deserialize;
use thiserror::Error;

/// Distance beyond a door at which a body is out of the room, m.
pub const OUTSIDE_M: f64 = 0.75;
/// Largest coordinate of a script, m (sim/src/scene/check.rs).
const FARTHEST_M: f64 = 1000.0;
/// Rounding of times in messages, s.
const ROUNDING_S: f64 = 0.005;

/// File of way-points. For each person it has `[[person]]` with `point = [{ time_s = 1.5, position_m = [2.0, 1.0] },
/// ...]`. Times are by the recording's clock and in order.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WayPoints {
    #[serde(default)]
    pub person: Vec<WayPointPerson>,
}

#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WayPointPerson {
    pub point: Vec<WayPoint>,
}

#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WayPoint {
    pub time_s: f64,
    pub position_m: [f64; 2],
}

/// Error of a way-point. Persons and their points are numbered from 1, in the order of the file.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum WayPointError {
    /// A number is infinite or none.
    #[error("point {point} of person {person}: expected a finite time and position")]
    NotFinite { person: usize, point: usize },
    /// Way-points are out of order.
    #[error("way-points of person {person}: {time_s} s comes after {before_s} s, expected times that rise")]
    Order { person: usize, time_s: f64, before_s: f64 },
    /// Nobody can be there.
    #[error(
        "point {point} of person {person} is at {position_m:?} m, outside of the scene's room: expected {low_m:?} to {high_m:?} m"
    )]
    OutsideRoom { person: usize, point: usize, position_m: [f64; 2], low_m: [f64; 2], high_m: [f64; 2] },
    /// The recording does not show that time.
    #[error(
        "point {point} of person {person} is at {time_s} s, expected a time of the recording, {first_s:.2} to {last_s:.2} s"
    )]
    OutsideRecording { person: usize, point: usize, time_s: f64, first_s: f64, last_s: f64 },
}

impl WayPoints {
    /// Reads a file of way-points.
    ///
    /// # Errors
    /// The file cannot be read, holds something else or more than two people, or its points are not finite or out of order.
    pub fn read(path: &Path) -> anyhow::Result<Self> {
        let text = read_text(path, TEXT_LIMIT_BYTES).with_context(|| format!("{} cannot be read", path.display()))?;
        let points: WayPoints = parse_toml(&text).with_context(|| {
            format!(
                "{} holds no way-points\n\nhint: for each person [[person]] with point = [{{ time_s = 1.5, position_m = [2.0, 1.0] }}, ...]",
                path.display()
            )
        })?;
        if points.person.len() > 2 {
            bail!("{}: way-points of {} people, expected two at most", path.display(), points.person.len());
        }
        points.check_numbers().with_context(|| path.display().to_string())?;
        Ok(points)
    }

    /// All way-points with the numbers of their person and of themselves, from 1.
    fn numbered(&self) -> impl Iterator<Item = (usize, usize, &WayPoint)> {
        self.person.iter().enumerate().flat_map(|(person, of_person)| {
            of_person.point.iter().enumerate().map(move |(point, at)| (person + 1, point + 1, at))
        })
    }

    fn check_numbers(&self) -> Result<(), WayPointError> {
        for (person, point, WayPoint { time_s, position_m: [x, y] }) in self.numbered() {
            if ![time_s, x, y].into_iter().all(|number| number.is_finite()) {
                return Err(WayPointError::NotFinite { person, point });
            }
        }
        for (index, person) in self.person.iter().enumerate() {
            for pair in person.point.windows(2) {
                if let [before, after] = pair
                    && after.time_s <= before.time_s
                {
                    let (time_s, before_s) = (after.time_s, before.time_s);
                    return Err(WayPointError::Order { person: index + 1, time_s, before_s });
                }
            }
        }
        Ok(())
    }

    /// Checks that all positions are in a room, or not farther beyond a wall that hides people than the place behind a door.
    ///
    /// # Errors
    /// [`WayPointError::OutsideRoom`] for the first position that is not.
    pub fn check_positions(&self, room: &RoomFile) -> Result<(), WayPointError> {
        let [x_low, x_high, y_low, y_high] =
            room.hiding_walls().map(|hides| if hides { OUTSIDE_M } else { FARTHEST_M });
        let (low, size) = (-DVec2::new(x_low, y_low), DVec2::new(room.size_m[0], room.size_m[1]));
        let high = (size + DVec2::new(x_high, y_high)).min(DVec2::splat(FARTHEST_M));
        for (person, point, at) in self.numbered() {
            let (position_m, position) = (at.position_m, DVec2::from_array(at.position_m));
            if position.clamp(low, high) != position {
                let (low_m, high_m) = (low.to_array(), high.to_array());
                return Err(WayPointError::OutsideRoom { person, point, position_m, low_m, high_m });
            }
        }
        Ok(())
    }

    /// Checks that all times are within those of the recording, s.
    ///
    /// # Errors
    /// [`WayPointError::OutsideRecording`] for the first time that is not.
    pub fn check_times(&self, first_s: f64, last_s: f64) -> Result<(), WayPointError> {
        for (person, point, WayPoint { time_s, .. }) in self.numbered() {
            if !(first_s - ROUNDING_S..=last_s + ROUNDING_S).contains(time_s) {
                return Err(WayPointError::OutsideRecording { person, point, time_s: *time_s, first_s, last_s });
            }
        }
        Ok(())
    }

    /// Returns the way-points by another clock.
    pub fn shifted(mut self, by_s: f64) -> Self {
        self.person.iter_mut().flat_map(|p| &mut p.point).for_each(|point| point.time_s += by_s);
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn points(all: &[(f64, [f64; 2])]) -> WayPoints {
        let point = |&(time_s, position_m): &(f64, [f64; 2])| WayPoint { time_s, position_m };
        WayPoints { person: vec![WayPointPerson { point: all.iter().map(point).collect() }] }
    }

    /// The corridor is 12 m by 2 m. Behind its doors, people may be 0.75 m away.
    #[test]
    fn positions_end_behind_the_doors_of_a_room() {
        let file = crate::files::fixture("scenes/corridor.toml").expect("a fixture");
        let scene = radome_sim::Scene::load(&file).expect("a scene");
        let mut room = scene.file().room.clone();
        let check = |room: &RoomFile, x: f64| points(&[(0.0, [3.0, 1.0]), (1.0, [x, 1.0])]).check_positions(room);
        for (x, is_inside) in [(-0.75, true), (12.75, true), (-0.8, false), (12.8, false), (5e15, false)] {
            assert_eq!(check(&room, x).is_ok(), is_inside, "{x}");
        }
        let said = check(&room, 500.0).expect_err("outside").to_string();
        assert!(said.contains("point 2 of person 1 is at [500.0, 1.0] m"), "{said}");
        assert!(said.contains("expected [-0.75, -0.75] to [12.75, 2.75] m"), "{said}");
        // The radar sees people beyond walls that do not hide them.
        room.transmission = true;
        assert_eq!(check(&room, 500.0), Ok(()));
        assert!(check(&room, 1001.0).is_err());
    }

    mod hard_cases {
        use super::*;

        /// Regression test: such numbers were accepted, or the scene was said to hold them.
        #[test]
        fn numbers_that_are_no_times_and_positions_are_refused() {
            for (time_s, x) in [(f64::NAN, 1.0), (f64::INFINITY, 1.0), (0.0, f64::NAN), (0.0, f64::NEG_INFINITY)] {
                let error = points(&[(time_s, [x, 1.0])]).check_numbers();
                assert_eq!(error, Err(WayPointError::NotFinite { person: 1, point: 1 }), "{time_s} {x}");
            }
            assert!(points(&[(1.0, [1.0, 1.0]), (1.0, [2.0, 1.0])]).check_numbers().is_err());
            let times = points(&[(0.0, [1.0, 1.0]), (1.2, [1.0, 1.0])]);
            assert_eq!(times.check_times(0.0, 1.2), Ok(()));
            let said = times.check_times(0.0, 1.1).expect_err("later").to_string();
            assert!(said.contains("point 2 of person 1 is at 1.2 s") && said.contains("0.00 to 1.10 s"), "{said}");
        }
    }
}
