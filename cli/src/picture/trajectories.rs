//! Trajectories of people in the picture of a scene.

use std::sync::Arc;

use glam::DVec3;
use radome_sim::Scene;
use radome_sim::people::body::PELVIS;
use radome_sim::people::motion::Motion;
use radome_sim::scenario::Scenario;

use super::canvas::{Canvas, Ink, Labels, Letters, Line, Pixel};
use super::palette::{circle, person_ink};
use super::view::View;

/// Sampling interval of trajectories, s.
const STEP_S: f64 = 0.05;
/// Least distance between times that are written along a trajectory, pixels and s, and distance between its arrows, pixels.
const LABEL_SPACING: f64 = 130.0;
const LABEL_SPACING_S: f64 = 1.2;
const ARROW_SPACING: f64 = 100.0;
/// Distance from the room up to which trajectories are drawn, m.
const OUTSIDE_M: f64 = 0.15;
/// Least distance between points of a line, pixels, and largest number of its sections. The time to draw a line grows with the
/// square of the number of its sections that cross or touch.
const LEAST_SECTION: f64 = 0.5;
const MOST_SECTIONS: usize = 300;
/// Number of later bodies that are drawn of each person.
const LATER_BODIES: usize = 3;

/// Trajectory of a person who is in the scene.
pub(super) struct Trajectory {
    /// Number of the person, as in lists of paths.
    pub slot: usize,
    pub motion: Arc<Motion>,
    pub ink: Ink,
    /// Times, s, and positions of the hips.
    positions: Vec<(f64, DVec3)>,
    /// Times at which the body is drawn, s.
    pub bodies: Vec<f64>,
}

/// Trajectories of all people who are in the scene up to a time, s, in the order of arrival.
pub(super) fn trajectories(scene: &Scene, seed: u64, people: Option<usize>, until_s: f64) -> Vec<Trajectory> {
    let mut all = Scenario::new(scene, seed, people).between(0.0, until_s);
    all.sort_by(|a, b| a.1.start_s.total_cmp(&b.1.start_s).then(a.0.cmp(&b.0)));
    let trajectory_of = |(slot, motion): (usize, Arc<Motion>)| {
        let (begin, end) = (motion.start_s.max(0.0), motion.end_s.min(until_s));
        let steps = ((end - begin) / STEP_S).ceil().max(1.0) as usize;
        let time_at = |i: usize| begin + (end - begin) * i as f64 / steps as f64;
        let positions: Vec<(f64, DVec3)> =
            (0..=steps).map(|i| (time_at(i), motion.body(time_at(i))[PELVIS].centre)).collect();
        let bodies = body_times(scene, &positions);
        Trajectory { slot, motion, ink: person_ink(slot), positions, bodies }
    };
    all.into_iter().map(trajectory_of).collect()
}

/// Time at which a person is first in the room, and a few later times with other positions or postures.
fn body_times(scene: &Scene, positions: &[(f64, DVec3)]) -> Vec<f64> {
    let size = scene.room().size_m;
    let in_room = |p: DVec3| p.x > 0.2 && p.y > 0.2 && p.x < size.x - 0.2 && p.y < size.y - 0.2;
    let inside: Vec<&(f64, DVec3)> = positions.iter().filter(|(_, p)| in_room(*p)).collect();
    let Some(&&(first_s, first)) = inside.first() else { return Vec::new() };
    // The times divide the travelled distance, including vertical motion, so that a person who sits is not drawn repeatedly.
    let mut travelled_m = 0.0;
    let mut last = first;
    let lengths: Vec<(f64, f64)> = inside
        .iter()
        .map(|(t, p)| {
            travelled_m += p.distance(last);
            last = *p;
            (*t, travelled_m)
        })
        .collect();
    let mut times = vec![first_s];
    for i in 1..=LATER_BODIES {
        let target_m = travelled_m * i as f64 / LATER_BODIES as f64;
        if travelled_m > 0.3
            && let Some((t, _)) = lengths.iter().find(|(_, length)| *length >= target_m - 1e-9)
        {
            times.push(*t);
        }
    }
    times
}

/// Returns whether a position is in the room, or up to [`OUTSIDE_M`] beyond its walls.
fn is_near_room(view: &View, p: DVec3) -> bool {
    p.min_element() > -OUTSIDE_M && p.x < view.size_m.x + OUTSIDE_M && p.y < view.size_m.y + OUTSIDE_M
}

/// Divides a trajectory into lines of at most [`MOST_SECTIONS`] sections. Each line begins with the last section of the one before,
/// so that the corner between them is round.
fn lines_along(positions: &[Pixel]) -> Vec<Vec<Pixel>> {
    let mut points: Vec<Pixel> = Vec::new();
    for &[x, y] in positions {
        if points.last().is_none_or(|[last_x, last_y]| (x - last_x).hypot(y - last_y) >= LEAST_SECTION) {
            points.push([x, y]);
        }
    }
    let begins = (0..points.len().saturating_sub(1)).step_by(MOST_SECTIONS);
    begins.map(|first| points[first.saturating_sub(1)..points.len().min(first + MOST_SECTIONS + 1)].to_vec()).collect()
}

/// Draws a trajectory with arrows.
pub(super) fn draw_trajectory(canvas: &mut Canvas, view: &View, trajectory: &Trajectory) {
    for piece in trajectory.positions.split(|(_, p)| !is_near_room(view, *p)).filter(|piece| piece.len() > 1) {
        let positions: Vec<Pixel> = piece.iter().map(|(_, p)| view.project(*p)).collect();
        let lines = lines_along(&positions);
        let halo = Line { ink: Ink::solid([255, 255, 255]).faint(0.8), width: 4.0, is_dashed: false };
        lines.iter().for_each(|line| canvas.line(line, &halo));
        lines.iter().for_each(|line| canvas.line(line, &Line { ink: trajectory.ink, width: 2.0, is_dashed: false }));
        let mut distance_since = 0.6 * ARROW_SPACING;
        for pair in positions.windows(2) {
            let &[a, b] = pair else { continue };
            let (dx, dy) = (b[0] - a[0], b[1] - a[1]);
            let length = dx.hypot(dy);
            distance_since += length;
            // A person who hardly moves has no direction.
            if distance_since < ARROW_SPACING || length < 0.2 * view.per_m * STEP_S {
                continue;
            }
            distance_since = 0.0;
            let (dx, dy) = (dx / length, dy / length);
            let place = |along: f64, across: f64| [b[0] + along * dx - across * dy, b[1] + along * dy + across * dx];
            canvas.fill(&[vec![place(7.0, 0.0), place(-4.0, 5.0), place(-4.0, -5.0)]], trajectory.ink);
        }
    }
}

/// Writes times along a trajectory: at bodies, and in the view from above also elsewhere.
pub(super) fn label_times(canvas: &mut Canvas, view: &View, trajectory: &Trajectory, labels: &mut Labels) {
    // Positions are in order of time: the nearest one is the last before a time or the next one.
    let position_at = |t: f64| {
        let before = trajectory.positions.partition_point(|(time_s, _)| *time_s < t).saturating_sub(1);
        let neighbours = trajectory.positions.iter().skip(before).take(2);
        neighbours.min_by(|a, b| (a.0 - t).abs().total_cmp(&(b.0 - t).abs())).map(|(_, p)| *p)
    };
    let (begin, end) =
        (trajectory.positions.first().map_or(0.0, |p| p.0), trajectory.positions.last().map_or(0.0, |p| p.0));
    let seconds = begin.ceil() as i64..=end.floor() as i64;
    let seconds = seconds.filter(|_| view.is_plan()).map(|t| (t as f64, false));
    let mut written: Vec<(f64, Pixel)> = Vec::new();
    for (time_s, is_body) in trajectory.bodies.iter().map(|&t| (t, true)).chain(seconds) {
        let Some(position) = position_at(time_s).filter(|p| is_near_room(view, *p)) else { continue };
        let [x, y] = view.project(position);
        let is_near = |&(other_s, [other_x, other_y]): &(f64, Pixel)| {
            let distance = (other_x - x).hypot(other_y - y);
            let is_other_pass = (other_s - time_s).abs() > 4.0 * LABEL_SPACING_S && distance > 0.3 * LABEL_SPACING;
            distance < LABEL_SPACING && !is_other_pass || (other_s - time_s).abs() < LABEL_SPACING_S
        };
        if !is_body && written.iter().any(is_near) {
            continue;
        }
        let text = if time_s.fract().abs() < 0.05 { format!("{time_s:.0} s") } else { format!("{time_s:.1} s") };
        let size = Letters::Small.size(&text);
        let candidates = [
            [x + 8.0, y - size[1] - 3.0],
            [x + 8.0, y + 4.0],
            [x - size[0] - 8.0, y - size[1] - 3.0],
            [x - size[0] - 8.0, y + 4.0],
        ];
        if let Some(found) = labels.find(size, &candidates, view.bounds()) {
            canvas.fill(&[circle([x, y], 3.4)], Ink::solid([255, 255, 255]));
            canvas.outline(&[circle([x, y], 3.4)], &Line { ink: trajectory.ink, width: 1.6, is_dashed: false });
            let [left, top] = found;
            let (right, bottom) = (left + size[0] + 2.0, top + size[1]);
            let background = vec![[left - 2.0, top], [right, top], [right, bottom], [left - 2.0, bottom]];
            canvas.fill(&[background], Ink::solid([255, 255, 255]).faint(0.65));
            canvas.text(found, &text, Letters::Small, trajectory.ink.darker(0.2));
            written.push((time_s, [x, y]));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Regression test: a trajectory of 40,000 frames was one line of 80,000 points, which took a minute to draw.
    #[test]
    fn long_trajectories_are_drawn_in_short_lines() {
        let stands = vec![[5.0, 5.0]; 10_000];
        let walks = (0..1000).map(|i| [5.0 + 7.0 * f64::from(i), 5.0]);
        let lines = lines_along(&stands.into_iter().chain(walks).collect::<Vec<_>>());
        assert_eq!(lines.iter().map(Vec::len).collect::<Vec<_>>(), [301, 302, 302, 101]);
        for pair in lines.windows(2) {
            assert!(pair[0].ends_with(&pair[1][..2]), "{:?}", pair[1]);
        }
        assert_eq!(lines.last().and_then(|line| line.last()), Some(&[5.0 + 7.0 * 999.0, 5.0]));
        assert!(lines_along(&[[1.0, 1.0]; 7]).is_empty());
    }
}
