//! A picture of a scene before anything is simulated: from above and from the side, with what stands in it, what the radar
//! looks at, and who goes where.

use std::path::Path;
use std::sync::Arc;

use glam::DVec3;
use radome_sim::Scene;
use radome_sim::em::specular::Ellipsoid;
use radome_sim::people::body::PELVIS;
use radome_sim::people::motion::Motion;
use radome_sim::people::skin::EDGE_M;
use radome_sim::people::walking_mesh::WalkingMesh;
use radome_sim::scenario::Scenario;
use radome_sim::scene_file::{BodyFile, FurnitureFile, SurfaceFile};

use super::canvas::{Canvas, Ink, Labels, Letters, Line, Pixel};
use super::legend::{draw_sign, legend, legend_rows};
use super::palette::{BEAM, GREY, INK, LEFT, MOVING, STATIC, UNSAID, material_ink, person_ink, ring};
use super::theme::Theme;

/// Room below each view, above it, and to the right of it, pixels; below there are numbers and the axis's name.
const BELOW: f64 = 62.0;
const TOP: f64 = 64.0;
const RIGHT: f64 = 30.0;
/// Thickness of walls, pixels.
const WALL: f64 = 9.0;
/// Pixels of a metre: no more than this, and so many that views fill this width, or one of them this height.
const MOST_PER_M: f64 = 200.0;
const WIDTH: f64 = 1480.0;
const HEIGHT: f64 = 860.0;
/// Rooms this many times as long as wide have their views one above the other.
const LONG: f64 = 2.2;
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

/// Scene and options of its picture.
pub struct Preview<'a> {
    /// The scene as its seed drew it.
    pub scene: &'a Scene,
    pub seed: u64,
    /// Number of people; the scene's own number if `None`.
    pub people: Option<usize>,
    /// Ways are drawn up to here, s.
    pub until_s: f64,
    /// Ways of waves.
    pub paths: &'a [DrawnPath],
}

/// The way of a wave.
pub struct DrawnPath {
    /// Its corners, m.
    pub points: Vec<DVec3>,
    /// Whether it changes: it is drawn in another colour.
    pub is_moving: bool,
    /// From 0, as faint as lines get, to 1.
    pub strength: f64,
}

/// One of the views: which axes of the room are to the right and up, and where.
struct View {
    across: usize,
    up: usize,
    /// Upper left corner of the room, pixels.
    corner: Pixel,
    per_m: f64,
    size_m: DVec3,
}

impl View {
    fn at(&self, p: DVec3) -> Pixel {
        [
            self.corner[0] + p[self.across] * self.per_m,
            self.corner[1] + (self.size_m[self.up] - p[self.up]) * self.per_m,
        ]
    }

    fn width(&self) -> f64 {
        self.size_m[self.across] * self.per_m
    }

    fn height(&self) -> f64 {
        self.size_m[self.up] * self.per_m
    }

    fn is_plan(&self) -> bool {
        self.up == 1
    }

    fn frame(&self) -> [Pixel; 2] {
        [self.corner, [self.corner[0] + self.width(), self.corner[1] + self.height()]]
    }

    fn rectangle(&self, low: DVec3, high: DVec3) -> Vec<Pixel> {
        let ([x0, y1], [x1, y0]) = (self.at(low), self.at(high));
        vec![[x0, y0], [x1, y0], [x1, y1], [x0, y1]]
    }
}

/// Somebody's way while they are there.
struct Way {
    /// Number of the person, as in lists of paths.
    slot: usize,
    motion: Arc<Motion>,
    ink: Ink,
    /// Times, s, and places of the hips.
    places: Vec<(f64, DVec3)>,
    /// Times at which the body is drawn, s.
    bodies: Vec<f64>,
}

/// Draws a scene.
///
/// # Errors
/// The picture is too large, or the file cannot be written.
pub fn draw(preview: &Preview, path: &Path) -> anyhow::Result<()> {
    let scene = preview.scene;
    let views = views(scene);
    let ways = ways(preview);
    let people: Vec<(usize, f64)> = ways.iter().map(|way| (way.slot, way.motion.person.build.height_m)).collect();
    let legend = legend(scene, &people);
    let [right, below] = [0, 1].map(|axis| views.iter().map(|view| view.frame()[1][axis]).fold(0.0, f64::max));
    let width = (right + RIGHT).max(900.0);
    let rows = legend_rows(&legend, width);
    let below = below + BELOW;
    let mut canvas = Canvas::new(width, below + 22.0 * rows.len() as f64 + 12.0, Theme::LIGHT.paper);

    let (seed, note) = (format!(", seed {}", preview.seed), format!("0 to {:.0} s", preview.until_s));
    let (left, seed_width) = (LEFT - WALL, Letters::Title.size(&seed)[0] + 24.0);
    let name_width = width - RIGHT - left - seed_width - Letters::Small.size(&note)[0];
    let title = Letters::Title.shortened(scene.name(), name_width) + &seed;
    canvas.text([left, 10.0], &title, Letters::Title, INK);
    canvas.text([left + Letters::Title.size(&title)[0] + 24.0, 16.0], &note, Letters::Small, GREY);
    for view in &views {
        draw_view(&mut canvas, view, preview, &ways);
    }
    let mut y = below;
    for row in rows {
        let mut x = LEFT - WALL;
        for (sign, name) in row {
            draw_sign(&mut canvas, [x, y], sign);
            canvas.text([x + 30.0, y], name, Letters::Small, INK);
            x += 30.0 + Letters::Small.size(name)[0] + 26.0;
        }
        y += 22.0;
    }
    canvas.save(path)
}

/// The plan, and the view from the side.
fn views(scene: &Scene) -> [View; 2] {
    let size_m = scene.room().size_m;
    // Seen along the horizontal axis that is across the boresight.
    let ahead = scene.radar_from_world().transpose() * DVec3::X;
    let across = if ahead.x.abs() >= ahead.y.abs() { 0 } else { 1 };
    let is_long = size_m.x > LONG * size_m.y;
    let widths_m = if is_long { size_m.x.max(size_m[across]) } else { size_m.x + size_m[across] };
    let views = if is_long { 1.0 } else { 2.0 };
    let per_m = ((WIDTH - views * (LEFT + RIGHT)) / widths_m).min(HEIGHT / size_m.y.max(size_m.z)).min(MOST_PER_M);
    let view = |across, up, corner| View { across, up, corner, per_m, size_m };
    // Floors are level with the plan's lower edge.
    let top = |lower_m: f64| TOP + lower_m.max(0.0) * per_m;
    let plan = view(0, 1, [LEFT, if is_long { TOP } else { top(size_m.z - size_m.y) }]);
    let beside = match is_long {
        true => [LEFT, TOP + plan.height() + BELOW + 12.0],
        false => [LEFT + plan.width() + RIGHT + LEFT, top(size_m.y - size_m.z)],
    };
    [plan, view(across, 2, beside)]
}

/// Draws everything in a view, from back to front.
fn draw_view(canvas: &mut Canvas, view: &View, preview: &Preview, ways: &[Way]) {
    let scene = preview.scene;
    let mut labels = Labels::default();
    draw_room(canvas, view, scene);
    draw_beam(canvas, view, scene);
    draw_furniture(canvas, view, scene);
    ways.iter().for_each(|way| draw_bodies(canvas, view, scene, way));
    ways.iter().for_each(|way| draw_way(canvas, view, way));
    preview.paths.iter().for_each(|path| draw_path(canvas, view, path));
    draw_radar(canvas, view, scene, &mut labels);
    ways.iter().for_each(|way| label_times(canvas, view, way, &mut labels));
    // Names of furniture keep off bodies too.
    for (way, &time_s) in ways.iter().filter_map(|way| Some((way, way.bodies.first()?))) {
        for part in way.motion.body(time_s) {
            let (low, high) = bounds(&silhouette(view, &part));
            labels.take(low, high);
        }
    }
    label_furniture(canvas, view, scene, &mut labels);
    draw_axes(canvas, view);
}

/// Everybody who is there up to the end.
fn ways(preview: &Preview) -> Vec<Way> {
    let program = Scenario::new(preview.scene, preview.seed, preview.people);
    let mut all = program.between(0.0, preview.until_s);
    all.sort_by(|a, b| a.1.start_s.total_cmp(&b.1.start_s).then(a.0.cmp(&b.0)));
    let one = |(slot, motion): (usize, Arc<Motion>)| {
        let (begin, end) = (motion.start_s.max(0.0), motion.end_s.min(preview.until_s));
        let steps = ((end - begin) / STEP_S).ceil().max(1.0) as usize;
        let at = |i: usize| begin + (end - begin) * i as f64 / steps as f64;
        let places: Vec<(f64, DVec3)> = (0..=steps).map(|i| (at(i), motion.body(at(i))[PELVIS].centre)).collect();
        let bodies = body_times(preview.scene, &places);
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

/// The four surfaces around a view, in the order lower end across, higher end across, lower end up, higher end up.
fn surfaces<'a>(view: &View, scene: &'a Scene) -> [&'a SurfaceFile; 4] {
    let room = &scene.file().room;
    let ends = |axis: usize| match axis {
        0 => [&room.x_low, &room.x_high],
        1 => [&room.y_low, &room.y_high],
        _ => [&room.floor, &room.ceiling],
    };
    let ([a, b], [c, d]) = (ends(view.across), ends(view.up));
    [a, b, c, d]
}

fn draw_room(canvas: &mut Canvas, view: &View, scene: &Scene) {
    let [[x0, y0], [x1, y1]] = view.frame();
    let area = vec![[x0, y0], [x1, y0], [x1, y1], [x0, y1]];
    let back = if view.is_plan() {
        material_ink(scene, &scene.file().room.floor.material).faint(0.10)
    } else {
        GREY.faint(0.05)
    };
    canvas.fill(&[area], back);
    let w = WALL;
    let walls = [
        [[x0 - w, y0 - w], [x0, y1 + w]],
        [[x1, y0 - w], [x1 + w, y1 + w]],
        [[x0 - w, y1], [x1 + w, y1 + w]],
        [[x0 - w, y0 - w], [x1 + w, y0]],
    ];
    for (surface, [low, high]) in surfaces(view, scene).into_iter().zip(walls) {
        let wall = vec![low, [high[0], low[1]], high, [low[0], high[1]]];
        if surface.material == "open" {
            canvas.around(&[wall], &Line { ink: GREY.faint(0.7), width: 1.0, is_dashed: true });
        } else {
            canvas.fill(&[wall], material_ink(scene, &surface.material));
        }
    }
    for outline in scene.outlines() {
        let line = Line { ink: material_ink(scene, &outline.material).darker(0.35), width: 1.4, is_dashed: false };
        for edge in &outline.edges {
            canvas.line(&edge.map(|p| view.at(p)), &line);
        }
    }
    if view.is_plan() {
        draw_openings(canvas, view, scene, back);
    }
    for door in &scene.file().door {
        draw_door(canvas, view, door.position_m, door.width_m);
    }
}

/// Draws openings of a plan from above: a gap in the wall, and in it the pane or the door leaf. `back` is the colour of the floor.
fn draw_openings(canvas: &mut Canvas, view: &View, scene: &Scene, back: Ink) {
    /// Width of the strip in which a wall's line is taken away, pixels.
    const STRIP: f64 = 4.0;
    let size = view.size_m;
    let sides = [(0, 0.0, [-1.0, 0.0]), (0, size.x, [1.0, 0.0]), (1, 0.0, [0.0, 1.0]), (1, size.y, [0.0, -1.0])];
    let openings = scene.openings();
    for opening in &openings {
        let [a, b] = opening.ends.map(|end| view.at(end.extend(0.0)));
        // Paper takes the line away; the floor goes on over it.
        for ink in [Ink::solid([255, 255, 255]), back] {
            canvas.line(&[a, b], &Line { ink, width: STRIP, is_dashed: false });
        }
        let is_on = |axis: usize, at_m: f64| opening.ends.iter().all(|end| (end[axis] - at_m).abs() < 1e-6);
        if let Some((.., outward)) = sides.into_iter().find(|(axis, at_m, _)| is_on(*axis, *at_m)) {
            draw_gap(canvas, [a, b], outward);
        }
    }
    // After all gaps, for a leaf may stand before another opening.
    for opening in &openings {
        let leaf = opening.leaf.zip(opening.file.door.as_ref()).map(|(ends, door)| (ends, &door.material));
        let pane = opening.file.material.as_ref().map(|material| (opening.ends, material));
        if let Some((ends, material)) = leaf.or(pane).filter(|(_, material)| *material != "open") {
            let ink = material_ink(scene, material).darker(0.35);
            let ends: [Pixel; 2] = ends.map(|end| view.at(end.extend(0.0)));
            canvas.line(&ends, &Line { ink, width: 1.4, is_dashed: false });
        }
    }
}

/// Draws a gap in the thick wall around a room, beside a line along its inner side.
fn draw_gap(canvas: &mut Canvas, [a, b]: [Pixel; 2], outward: Pixel) {
    let out = |[x, y]: Pixel| [x + outward[0] * (WALL + 1.0), y + outward[1] * (WALL + 1.0)];
    canvas.fill(&[vec![a, b, out(b), out(a)]], Ink::solid([255, 255, 255]));
    for end in [a, b] {
        canvas.line(&[end, out(end)], &Line { ink: INK, width: 2.0, is_dashed: false });
    }
}

fn draw_door(canvas: &mut Canvas, view: &View, [x, y]: [f64; 2], width_m: f64) {
    /// Height of a door, m.
    const HEIGHT_M: f64 = 2.0;
    let in_x_wall = x < 1e-6 || x > view.size_m.x - 1e-6;
    let half = 0.5 * width_m;
    let along = if in_x_wall { DVec3::Y } else { DVec3::X } * half;
    let middle = DVec3::new(x, y, 0.0);
    if view.is_plan() {
        // A gap in the wall, with both leaves' ends.
        let outward =
            if in_x_wall { [if x < 1e-6 { -1.0 } else { 1.0 }, 0.0] } else { [0.0, if y < 1e-6 { 1.0 } else { -1.0 }] };
        draw_gap(canvas, [view.at(middle - along), view.at(middle + along)], outward);
    } else if in_x_wall == (view.across == 1) {
        let high = middle + along + DVec3::Z * HEIGHT_M.min(view.size_m.z);
        let door = view.rectangle(middle - along, high);
        canvas.around(&[door], &Line { ink: GREY.faint(0.6), width: 1.2, is_dashed: true });
    }
}

/// Directions of the beam's cut through the boresight in which the pattern is at least half as strong, in the room.
fn beam(view: &View, scene: &Scene) -> Vec<DVec3> {
    /// Steps of the angle, rad.
    const STEP_RAD: f64 = 0.005;
    let (transmitter, _) = scene.elements();
    let cut = |angle: f64| {
        let (sine, cosine) = angle.sin_cos();
        if view.is_plan() { DVec3::new(cosine, sine, 0.0) } else { DVec3::new(cosine, 0.0, sine) }
    };
    let is_strong = |angle: &f64| transmitter.pattern.field(cut(*angle)).powi(2) >= 0.5;
    let half = (0..).map(|i| f64::from(i) * STEP_RAD).take_while(|a| *a < 1.55 && is_strong(a)).last().unwrap_or(0.0);
    let world_from_radar = scene.radar_from_world().transpose();
    let steps = 400;
    (0..=steps).map(|i| world_from_radar * cut(half * (2.0 * f64::from(i) / f64::from(steps) - 1.0))).collect()
}

/// Point where a ray from a place in the room meets a wall.
fn to_wall(from: DVec3, direction: DVec3, size: DVec3) -> DVec3 {
    let length = (0..3)
        .filter(|&i| direction[i].abs() > 1e-9)
        .map(|i| (if direction[i] > 0.0 { size[i] - from[i] } else { -from[i] }) / direction[i])
        .fold(f64::INFINITY, f64::min);
    from + direction * length.clamp(0.0, 200.0)
}

fn draw_beam(canvas: &mut Canvas, view: &View, scene: &Scene) {
    let radar = scene.radar_position();
    let directions = beam(view, scene);
    let mut fan = vec![view.at(radar)];
    fan.extend(directions.iter().map(|&d| view.at(to_wall(radar, d, view.size_m))));
    let edge = Line { ink: BEAM.darker(0.15), width: 1.4, is_dashed: true };
    for end in [fan.get(1), fan.last()].into_iter().flatten() {
        canvas.line(&[fan[0], *end], &edge);
    }
    canvas.fill(&[fan], BEAM.faint(0.20));
}

fn draw_path(canvas: &mut Canvas, view: &View, path: &DrawnPath) {
    let ink = if path.is_moving { MOVING } else { STATIC };
    let line = Line { ink: ink.faint(0.15 + 0.75 * path.strength), width: 1.2, is_dashed: false };
    let places: Vec<Pixel> = path.points.iter().map(|p| view.at(*p)).collect();
    canvas.line(&places, &line);
}

fn draw_radar(canvas: &mut Canvas, view: &View, scene: &Scene, labels: &mut Labels) {
    /// Size of the sign, pixels.
    const SIZE: f64 = 11.0;
    let ahead = scene.radar_from_world().transpose() * DVec3::X;
    let at = view.at(scene.radar_position());
    let (dx, dy) = (ahead[view.across], -ahead[view.up]);
    let length = dx.hypot(dy);
    let (dx, dy) = if length > 0.05 { (dx / length, dy / length) } else { (0.0, 1.0) };
    let place = |along: f64, across: f64| [at[0] + along * dx - across * dy, at[1] + along * dy + across * dx];
    let arrow = vec![place(SIZE, 0.0), place(-0.6 * SIZE, 0.75 * SIZE), place(-0.6 * SIZE, -0.75 * SIZE)];
    canvas.fill(std::slice::from_ref(&arrow), BEAM);
    canvas.around(&[arrow], &Line { ink: INK, width: 1.6, is_dashed: false });
    labels.take([at[0] - SIZE, at[1] - SIZE], [at[0] + SIZE, at[1] + SIZE]);
}

/// Furniture without the walls of meshes, which are drawn by their outlines.
fn furniture(scene: &Scene) -> impl Iterator<Item = &FurnitureFile> {
    let all = scene.file().furniture.iter().enumerate();
    all.filter(move |(number, _)| !scene.is_wall_of_mesh(*number)).map(|(_, furniture)| furniture)
}

fn draw_furniture(canvas: &mut Canvas, view: &View, scene: &Scene) {
    // What is nearer to who looks hides the rest a little.
    let mut all: Vec<_> = furniture(scene).collect();
    let depth = if view.is_plan() { 2 } else { 1 - view.across };
    let sign = if view.is_plan() || view.across == 1 { 1.0 } else { -1.0 };
    all.sort_by(|a, b| {
        (sign * (a.position_m[depth] + a.size_m[depth])).total_cmp(&(sign * (b.position_m[depth] + b.size_m[depth])))
    });
    for furniture in all {
        let low = DVec3::from_array(furniture.position_m);
        let area = view.rectangle(low, low + DVec3::from_array(furniture.size_m));
        let ink = furniture.material.as_deref().map_or(UNSAID, |material| material_ink(scene, material));
        canvas.fill(std::slice::from_ref(&area), ink.faint(0.45));
        canvas.around(&[area], &Line { ink: ink.darker(0.35), width: 1.6, is_dashed: false });
    }
    let places = scene.file().seat.iter().map(|s| (s.position_m, s.heading_deg, s.height_m));
    let places = places.chain(scene.file().bed.iter().map(|b| (b.position_m, b.heading_deg, b.height_m)));
    for ([x, y], heading_deg, height_m) in places {
        // Where hips rest, and where one looks or feet point.
        let (sine, cosine) = heading_deg.to_radians().sin_cos();
        let hips = DVec3::new(x, y, height_m);
        let mark = Line { ink: INK.faint(0.75), width: 1.6, is_dashed: false };
        canvas.around(&[ring(view.at(hips), 4.0)], &mark);
        canvas.line(&[view.at(hips), view.at(hips + DVec3::new(cosine, sine, 0.0) * 0.22)], &mark);
    }
}

fn label_furniture(canvas: &mut Canvas, view: &View, scene: &Scene, labels: &mut Labels) {
    for furniture in furniture(scene) {
        let low = DVec3::from_array(furniture.position_m);
        let area = view.rectangle(low, low + DVec3::from_array(furniture.size_m));
        let ([x0, y0], [x1, y1]) = (area[0], area[2]);
        let [width, height] = Letters::Small.size(&furniture.name);
        let (x, y) = (0.5 * (x0 + x1 - width), 0.5 * (y0 + y1 - height));
        let mut places = vec![[x, y], [x, y0 + 2.0], [x, y1 - height - 2.0]];
        // Words that are wider than their thing go beside it.
        if width > x1 - x0 - 4.0 || height > y1 - y0 {
            places =
                vec![[x1 + 4.0, y], [x0 - width - 4.0, y], [x, y1 + 3.0], [x, y0 - height - 3.0], [x1 + 4.0, y0 + 3.0]];
        }
        if let Some(at) = labels.find([width, height], &places, view.frame()) {
            canvas.text(at, &furniture.name, Letters::Small, INK);
        }
    }
}

fn bounds(area: &[Pixel]) -> (Pixel, Pixel) {
    area.iter().fold(([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]), |(low, high), p| {
        ([low[0].min(p[0]), low[1].min(p[1])], [high[0].max(p[0]), high[1].max(p[1])])
    })
}

/// An ellipsoid seen from far away.
fn silhouette(view: &View, e: &Ellipsoid) -> Vec<Pixel> {
    let columns = [e.axes.x_axis * e.semi_axes_m.x, e.axes.y_axis * e.semi_axes_m.y, e.axes.z_axis * e.semi_axes_m.z];
    let covariance = |i: usize, j: usize| columns.iter().map(|c| c[i] * c[j]).sum::<f64>();
    // Its shadow is the ellipse of a square root of that.
    let a = covariance(view.across, view.across).sqrt();
    let b = covariance(view.across, view.up) / a.max(1e-12);
    let c = (covariance(view.up, view.up) - b * b).max(0.0).sqrt();
    let centre = view.at(e.centre);
    let place = |(sine, cosine): (f64, f64)| {
        [centre[0] + a * cosine * view.per_m, centre[1] - (b * cosine + c * sine) * view.per_m]
    };
    (0..40).map(|i| place((f64::from(i) * std::f64::consts::TAU / 40.0).sin_cos())).collect()
}

fn draw_bodies(canvas: &mut Canvas, view: &View, scene: &Scene, way: &Way) {
    let is_mesh = scene.file().people.body == BodyFile::Mesh;
    let mesh = is_mesh.then(|| WalkingMesh::new(Arc::clone(&way.motion), 1.5 * EDGE_M));
    for (i, &time_s) in way.bodies.iter().enumerate().rev() {
        let opacity = if i == 0 { 0.80 } else { 0.26 };
        if let Some(mesh) = &mesh {
            let mesh = mesh.mesh_at(time_s);
            let corners = |t: usize| mesh.corners(t).map(|c| c.map(|p| view.at(p)).to_vec());
            let triangles: Vec<Vec<Pixel>> = (0..mesh.triangles.len()).filter_map(corners).collect();
            canvas.fill(&triangles, way.ink.faint(opacity));
        } else {
            let parts: Vec<Vec<Pixel>> = way.motion.body(time_s).iter().map(|e| silhouette(view, e)).collect();
            canvas.fill(&parts, way.ink.faint(opacity));
            let line =
                Line { ink: way.ink.darker(0.4).faint(if i == 0 { 0.55 } else { 0.2 }), width: 1.0, is_dashed: false };
            canvas.around(&parts, &line);
        }
    }
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

fn draw_way(canvas: &mut Canvas, view: &View, way: &Way) {
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
fn label_times(canvas: &mut Canvas, view: &View, way: &Way, labels: &mut Labels) {
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

fn draw_axes(canvas: &mut Canvas, view: &View) {
    let [[x0, _], [_, y1]] = view.frame();
    let line = Line { ink: INK, width: 1.2, is_dashed: false };
    let step = [0.5, 1.0, 2.0, 5.0, 10.0, 20.0].into_iter().find(|step| step * view.per_m >= 48.0).unwrap_or(50.0);
    let digits = usize::from(step < 1.0);
    let ticks = |length: f64| (0..=(length / step + 1e-9) as usize).map(move |i| i as f64 * step);
    for tick in ticks(view.size_m[view.across]) {
        let x = x0 + tick * view.per_m;
        canvas.line(&[[x, y1 + WALL], [x, y1 + WALL + 5.0]], &line);
        let text = format!("{tick:.digits$}");
        canvas.text([x - 0.5 * Letters::Small.size(&text)[0], y1 + WALL + 7.0], &text, Letters::Small, INK);
    }
    for tick in ticks(view.size_m[view.up]) {
        let y = y1 - tick * view.per_m;
        canvas.line(&[[x0 - WALL - 5.0, y], [x0 - WALL, y]], &line);
        let text = format!("{tick:.digits$}");
        let [width, height] = Letters::Small.size(&text);
        canvas.text([x0 - WALL - 8.0 - width, y - 0.5 * height], &text, Letters::Small, INK);
    }
    let name = |axis: usize| ["x / m", "y / m", "z / m"][axis];
    let (across, up) = (name(view.across), name(view.up));
    let middle = x0 + 0.5 * (view.width() - Letters::Small.size(across)[0]);
    canvas.text([middle, y1 + WALL + 25.0], across, Letters::Small, INK);
    let what = if view.is_plan() { "from above" } else { "from the side" };
    let top = view.corner[1] - WALL - 20.0;
    canvas.text([x0 - WALL - 50.0, top], up, Letters::Small, INK);
    canvas.text([x0 + 12.0, top], what, Letters::Small, GREY);
}

#[cfg(test)]
mod tests {
    use glam::DMat3;

    use super::*;
    use crate::files;

    fn view() -> View {
        View { across: 0, up: 2, corner: [10.0, 20.0], per_m: 50.0, size_m: DVec3::new(4.0, 3.0, 2.5) }
    }

    fn scene(name: &str) -> Scene {
        Scene::load(&files::fixture(&format!("scenes/{name}.toml")).expect("a fixture")).expect("a scene")
    }

    /// A metre is as long across as up, and up is up.
    #[test]
    fn metres_are_as_long_either_way() {
        let view = view();
        let [x, y] = view.at(DVec3::ZERO);
        assert_eq!((x, y), (10.0, 20.0 + 125.0));
        assert_eq!(view.at(DVec3::new(1.0, 9.0, 1.0)), [x + 50.0, y - 50.0]);
    }

    /// An ellipsoid's outline reaches as far as it does, however it is turned.
    #[test]
    fn outlines_of_ellipsoids_are_their_shadows() {
        let axes = DMat3::from_rotation_y(0.7) * DMat3::from_rotation_z(0.4) * DMat3::from_rotation_x(1.1);
        let e = Ellipsoid { centre: DVec3::new(2.0, 1.0, 1.2), axes, semi_axes_m: DVec3::new(0.1, 0.2, 0.6) };
        let half = radome_sim::people::body::half_extent(&e) * 50.0;
        let (low, high) = bounds(&silhouette(&view(), &e));
        assert!((high[0] - low[0] - 2.0 * half.x).abs() < 0.02 * half.x, "{} {}", high[0] - low[0], half.x);
        assert!((high[1] - low[1] - 2.0 * half.z).abs() < 0.02 * half.z, "{} {}", high[1] - low[1], half.z);
    }

    /// Width and pixels of a PNG.
    fn rgb_of(file: &Path) -> (usize, Vec<[u8; 3]>) {
        let bytes = std::io::BufReader::new(std::fs::File::open(file).expect("a file"));
        let mut reader = png::Decoder::new(bytes).read_info().expect("a PNG");
        let mut pixels = vec![0; reader.output_buffer_size().expect("a size")];
        let image = reader.next_frame(&mut pixels).expect("an image");
        assert_eq!((image.color_type, image.bit_depth), (png::ColorType::Rgb, png::BitDepth::Eight));
        (image.width as usize, pixels.as_chunks().0.to_vec())
    }

    /// Every shipped scene has a picture, with something in it.
    #[test]
    fn every_shipped_scene_is_drawn() {
        let folder = files::fixture("scenes").expect("a fixture");
        let file = tempfile::NamedTempFile::new().expect("a file");
        let mut drawn = 0;
        for entry in std::fs::read_dir(folder).expect("folder") {
            let path = entry.expect("entry").path();
            if path.extension().is_none_or(|e| e != "toml") {
                continue;
            }
            let scene = Scene::load(&path).and_then(|scene| scene.drawn(3)).expect("a scene");
            let preview = Preview { scene: &scene, seed: 3, people: None, until_s: 20.0, paths: &[] };
            draw(&preview, file.path()).expect("a picture");
            let (_, pixels) = rgb_of(file.path());
            let inked = pixels.iter().filter(|pixel| **pixel != [255; 3]).count();
            assert!(inked as f64 > 0.1 * pixels.len() as f64, "{}", path.display());
            drawn += 1;
        }
        assert!(drawn >= 8);
    }

    /// A partition is drawn beside its doorway and not in it, where the leaf stands open.
    #[test]
    fn openings_are_gaps_in_the_plan() {
        let scene = scene("half-open-door");
        let file = tempfile::NamedTempFile::new().expect("a file");
        let preview = Preview { scene: &scene, seed: 3, people: None, until_s: 0.1, paths: &[] };
        draw(&preview, file.path()).expect("a picture");
        let (width, pixels) = rgb_of(file.path());
        let [plan, _] = views(&scene);
        let differ = |a: [f64; 2], b: [f64; 2]| {
            let [a, b] = [a, b].map(|[x, y]| plan.at(DVec3::new(x, y, 0.0)));
            let [a, b] = [a, b].map(|[x, y]| pixels[y as usize * width + x as usize]);
            (0..3).map(|i| a[i].abs_diff(b[i])).max() > Some(20)
        };
        assert!(differ([3.5, 3.6], [3.6, 3.6]));
        assert!(!differ([3.5, 2.2], [3.6, 2.2]));
        assert!(differ([3.182, 1.818], [3.6, 2.2]));
    }

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

    /// Returns whether the plans of two scenes differ at a place of the room, m.
    fn differ(scenes: [&Scene; 2], place_m: [f64; 2]) -> bool {
        let file = tempfile::NamedTempFile::new().expect("a file");
        let [a, b] = scenes.map(|scene| {
            let preview = Preview { scene, seed: 3, people: None, until_s: 0.1, paths: &[] };
            draw(&preview, file.path()).expect("a picture");
            let (width, pixels) = rgb_of(file.path());
            let [plan, _] = views(scene);
            let [x, y] = plan.at(DVec3::new(place_m[0], place_m[1], 0.0));
            pixels[y as usize * width + x as usize]
        });
        a != b
    }

    /// Two walls of a file, at a right angle, were drawn as furniture on the floor between them.
    #[test]
    fn inner_walls_of_meshes_leave_the_floor_free() {
        let folder = tempfile::tempdir().expect("a folder");
        let [text, mesh] = ["room-mesh.toml", "room-mesh.obj"]
            .map(|name| std::fs::read_to_string(files::fixture("scenes").expect("a folder").join(name)).expect("text"));
        // A scene may name files beside it.
        let receiver = files::fixture("receivers").expect("a folder").join("paper-mesh.toml");
        std::fs::copy(receiver, folder.path().join("paper-mesh.toml")).expect("a copy");
        let text = text.replace("../receivers/", "");
        let walls = "o inner\nusemtl plaster\nv -2 0 0\nv -2 0 2.6\nv 0 0 0\nv 0 0 2.6\nv 0 -2 0\nv 0 -2 2.6\n\
                     f -6 -5 -3 -4\nf -4 -3 -1 -2\n";
        let [without, with] = ["", walls].map(|walls| {
            std::fs::write(folder.path().join("room-mesh.obj"), format!("{mesh}{walls}")).expect("written");
            Scene::parse(&text, &folder.path().join("scene.toml")).expect("a scene")
        });
        assert!(differ([&without, &with], [3.0, 1.0]), "no wall");
        assert!(!differ([&without, &with], [1.5, 0.5]), "the floor between the walls");
    }

    /// The beam ends where the pattern has lost half its power.
    #[test]
    fn beams_are_as_wide_as_the_antenna_says() {
        let scene = scene("corridor");
        for (view, width_deg) in [
            (View { up: 1, ..view() }, scene.receiver().antenna.azimuth_beamwidth_deg),
            (view(), scene.receiver().antenna.elevation_beamwidth_deg),
        ] {
            let all = beam(&view, &scene);
            let (first, last) = (all[0], all[all.len() - 1]);
            assert!((first.angle_between(last).to_degrees() - width_deg).abs() < 1.0, "{width_deg} degrees");
        }
    }
}
