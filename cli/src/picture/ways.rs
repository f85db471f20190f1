//! Ways of people in the picture of a scene.

use std::sync::Arc;

use glam::DVec3;
use radome_sim::Scene;
use radome_sim::people::body::PELVIS;
use radome_sim::people::motion::Motion;
use radome_sim::scenario::Scenario;

use super::canvas::{Canvas, Ink, Labels, Letters, Line, Pixel};
use super::palette::{person_ink, ring};
use super::view::View;

/// Ways are looked at so often, s.
const STEP_S: f64 = 0.05;
/// Between times that are written on ways, pixels and s, and between arrows, pixels.
const BETWEEN_TIMES: f64 = 130.0;
const BETWEEN_TIMES_S: f64 = 1.2;
const BETWEEN_ARROWS: f64 = 100.0;
/// Ways are drawn this far out of the room, m.
const OUTSIDE_M: f64 = 0.15;
/// Least distance between points of a line along a way, pixels, and upper limit of its sections. The time to draw a line
/// grows with the square of the number of its sections that cross or touch.
const LEAST_SECTION: f64 = 0.5;
const MOST_SECTIONS: usize = 300;
/// Bodies drawn of everybody after the first.
const LATER: usize = 3;

/// Somebody's way while they are there.
pub(super) struct Way {
    /// Number of the person, as in lists of paths.
    pub slot: usize,
    pub motion: Arc<Motion>,
    pub ink: Ink,
    /// Times, s, and places of the hips.
    places: Vec<(f64, DVec3)>,
    /// Times at which the body is drawn, s.
    pub bodies: Vec<f64>,
}

/// Ways of all people who are there up to a time, s, in the order of their arrival.
pub(super) fn ways(scene: &Scene, seed: u64, people: Option<usize>, until_s: f64) -> Vec<Way> {
    let mut all = Scenario::new(scene, seed, people).between(0.0, until_s);
    all.sort_by(|a, b| a.1.start_s.total_cmp(&b.1.start_s).then(a.0.cmp(&b.0)));
    let one = |(slot, motion): (usize, Arc<Motion>)| {
        let (begin, end) = (motion.start_s.max(0.0), motion.end_s.min(until_s));
        let steps = ((end - begin) / STEP_S).ceil().max(1.0) as usize;
        let at = |i: usize| begin + (end - begin) * i as f64 / steps as f64;
        let places: Vec<(f64, DVec3)> = (0..=steps).map(|i| (at(i), motion.body(at(i))[PELVIS].centre)).collect();
        let bodies = body_times(scene, &places);
        Way { slot, motion, ink: person_ink(slot), places, bodies }
    };
    all.into_iter().map(one).collect()
}

/// Time at which somebody is first in the room, and a few later ones at which they are elsewhere or in another posture.
fn body_times(scene: &Scene, places: &[(f64, DVec3)]) -> Vec<f64> {
    let size = scene.room().size_m;
    let in_room = |p: DVec3| p.x > 0.2 && p.y > 0.2 && p.x < size.x - 0.2 && p.y < size.y - 0.2;
    let there: Vec<&(f64, DVec3)> = places.iter().filter(|(_, p)| in_room(*p)).collect();
    let Some(&&(first_s, first)) = there.first() else { return Vec::new() };
    // By how far they have moved, up and down too, so that who sits for long is not drawn again and again.
    let mut moved = 0.0;
    let mut last = first;
    let lengths: Vec<(f64, f64)> = there
        .iter()
        .map(|(t, p)| {
            moved += p.distance(last);
            last = *p;
            (*t, moved)
        })
        .collect();
    let mut times = vec![first_s];
    for i in 1..=LATER {
        let wanted = moved * i as f64 / LATER as f64;
        if moved > 0.3
            && let Some((t, _)) = lengths.iter().find(|(_, length)| *length >= wanted - 1e-9)
        {
            times.push(*t);
        }
    }
    times
}

/// Whether a place is in the room, or just out of it.
fn is_about(view: &View, p: DVec3) -> bool {
    p.min_element() > -OUTSIDE_M && p.x < view.size_m.x + OUTSIDE_M && p.y < view.size_m.y + OUTSIDE_M
}

/// Lines along a way, as few and as short as the picture needs. Each one begins with the last section of the one before, so
/// that the corner between them is round as well.
fn lines_along(places: &[Pixel]) -> Vec<Vec<Pixel>> {
    let mut kept: Vec<Pixel> = Vec::new();
    for &[x, y] in places {
        if kept.last().is_none_or(|[last_x, last_y]| (x - last_x).hypot(y - last_y) >= LEAST_SECTION) {
            kept.push([x, y]);
        }
    }
    let begins = (0..kept.len().saturating_sub(1)).step_by(MOST_SECTIONS);
    begins.map(|first| kept[first.saturating_sub(1)..kept.len().min(first + MOST_SECTIONS + 1)].to_vec()).collect()
}

/// Draws a way with arrows.
pub(super) fn draw_way(canvas: &mut Canvas, view: &View, way: &Way) {
    for piece in way.places.split(|(_, p)| !is_about(view, *p)).filter(|piece| piece.len() > 1) {
        let places: Vec<Pixel> = piece.iter().map(|(_, p)| view.at(*p)).collect();
        let lines = lines_along(&places);
        let halo = Line { ink: Ink::solid([255, 255, 255]).faint(0.8), width: 4.0, is_dashed: false };
        lines.iter().for_each(|line| canvas.line(line, &halo));
        lines.iter().for_each(|line| canvas.line(line, &Line { ink: way.ink, width: 2.0, is_dashed: false }));
        let mut since = 0.6 * BETWEEN_ARROWS;
        for pair in places.windows(2) {
            let &[a, b] = pair else { continue };
            let (dx, dy) = (b[0] - a[0], b[1] - a[1]);
            let length = dx.hypot(dy);
            since += length;
            // Who hardly moves has no direction.
            if since < BETWEEN_ARROWS || length < 0.2 * view.per_m * STEP_S {
                continue;
            }
            since = 0.0;
            let (dx, dy) = (dx / length, dy / length);
            let place = |along: f64, across: f64| [b[0] + along * dx - across * dy, b[1] + along * dy + across * dx];
            canvas.fill(&[vec![place(7.0, 0.0), place(-4.0, 5.0), place(-4.0, -5.0)]], way.ink);
        }
    }
}

/// Writes when somebody is where: at bodies, and from above also at other places.
pub(super) fn label_times(canvas: &mut Canvas, view: &View, way: &Way, labels: &mut Labels) {
    // Places are in order of time: the nearest one is the last before a time or the next one.
    let at = |t: f64| {
        let before = way.places.partition_point(|(time_s, _)| *time_s < t).saturating_sub(1);
        let around = way.places.iter().skip(before).take(2);
        around.min_by(|a, b| (a.0 - t).abs().total_cmp(&(b.0 - t).abs())).map(|(_, p)| *p)
    };
    let (begin, end) = (way.places.first().map_or(0.0, |p| p.0), way.places.last().map_or(0.0, |p| p.0));
    let seconds = begin.ceil() as i64..=end.floor() as i64;
    let seconds = seconds.filter(|_| view.is_plan()).map(|t| (t as f64, false));
    let mut written: Vec<(f64, Pixel)> = Vec::new();
    for (time_s, is_body) in way.bodies.iter().map(|&t| (t, true)).chain(seconds) {
        let Some(place) = at(time_s).filter(|p| is_about(view, *p)) else { continue };
        let [x, y] = view.at(place);
        let near = |of: &&(f64, Pixel)| {
            let apart = (of.1[0] - x).hypot(of.1[1] - y);
            let other_pass = (of.0 - time_s).abs() > 4.0 * BETWEEN_TIMES_S && apart > 0.3 * BETWEEN_TIMES;
            apart < BETWEEN_TIMES && !other_pass || (of.0 - time_s).abs() < BETWEEN_TIMES_S
        };
        if !is_body && written.iter().any(|of| near(&of)) {
            continue;
        }
        let text = if time_s.fract().abs() < 0.05 { format!("{time_s:.0} s") } else { format!("{time_s:.1} s") };
        let size = Letters::Small.size(&text);
        let places = [
            [x + 8.0, y - size[1] - 3.0],
            [x + 8.0, y + 4.0],
            [x - size[0] - 8.0, y - size[1] - 3.0],
            [x - size[0] - 8.0, y + 4.0],
        ];
        if let Some(found) = labels.find(size, &places, view.frame()) {
            canvas.fill(&[ring([x, y], 3.4)], Ink::solid([255, 255, 255]));
            canvas.around(&[ring([x, y], 3.4)], &Line { ink: way.ink, width: 1.6, is_dashed: false });
            let [left, top] = found;
            let (right, bottom) = (left + size[0] + 2.0, top + size[1]);
            let back = vec![[left - 2.0, top], [right, top], [right, bottom], [left - 2.0, bottom]];
            canvas.fill(&[back], Ink::solid([255, 255, 255]).faint(0.65));
            canvas.text(found, &text, Letters::Small, way.ink.darker(0.2));
            written.push((time_s, [x, y]));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A way of 40,000 frames was one line of 80,000 points, which took a minute to draw.
    #[test]
    fn long_ways_are_drawn_in_short_lines() {
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
