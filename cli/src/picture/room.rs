//! Floor, walls, openings and doors in the picture of a scene.

use std::collections::BTreeMap;

use glam::{DVec2, DVec3};
use radome_sim::Scene;
use radome_sim::scene_file::PlanFile;

use super::canvas::{Canvas, Ink, Line, Pixel};
use super::palette::{GREY, INK, material_ink};
use super::view::View;

/// Thickness of walls, pixels.
pub(super) const WALL: f64 = 9.0;

/// A side of the room's outline in a view.
struct Side<'a> {
    /// Corner at which it begins, pixels. It ends where the next one begins.
    from: DVec2,
    /// Unit vector across it, out of the room.
    outward: DVec2,
    /// Material of its wall.
    material: &'a str,
}

/// Sides of the room's outline: the walls of a floor plan seen from above, or else the four sides of the box around the room.
fn sides<'a>(view: &View, scene: &'a Scene) -> Vec<Side<'a>> {
    let room = &scene.file().room;
    let corners: Vec<(Pixel, &str)> = match &room.plan {
        Some(plan) if view.is_plan() => {
            let corners = plan.corners_m.iter().enumerate();
            corners.map(|(wall, [x, y])| (view.project(DVec3::new(*x, *y, 0.0)), plan.wall_surface(wall).0)).collect()
        }
        plan => {
            let ends = |axis: usize| match (axis, plan) {
                (2, _) => [&room.floor.material, &room.ceiling.material].map(String::as_str),
                (_, Some(plan)) => [0.0, view.size_m[axis]].map(|at_m| end_material(plan, axis, at_m)),
                (0, None) => [&room.x_low.material, &room.x_high.material].map(String::as_str),
                (_, None) => [&room.y_low.material, &room.y_high.material].map(String::as_str),
            };
            let ([left, right], [low, high]) = (ends(view.across), ends(view.up));
            let [[x0, y0], [x1, y1]] = view.bounds();
            vec![([x0, y1], low), ([x1, y1], right), ([x1, y0], high), ([x0, y0], left)]
        }
    };
    let next = |corner: usize| DVec2::from_array(corners[(corner + 1) % corners.len()].0);
    let edges = corners.iter().enumerate().map(|(corner, (from, _))| (DVec2::from_array(*from), next(corner)));
    let orientation = edges.clone().map(|(from, to)| from.perp_dot(to)).sum::<f64>().signum();
    let side = |((from, to), &(_, material)): ((DVec2, DVec2), &(Pixel, &'a str))| Side {
        from,
        outward: (to - from).normalize_or_zero().perp() * -orientation,
        material,
    };
    edges.zip(&corners).map(side).collect()
}

/// Material of a floor plan at one end of an axis: that of the longest wall that lies there, or else of one that leads there.
fn end_material(plan: &PlanFile, axis: usize, at_m: f64) -> &str {
    let corner = |number: usize| plan.corners_m[number % plan.corners_m.len()];
    let is_there = |number: usize| (corner(number)[axis] - at_m).abs() < 1e-6;
    let rank = |wall: &usize| match [*wall, wall + 1].map(is_there) {
        [true, true] => 1.0 + (corner(wall + 1)[1 - axis] - corner(*wall)[1 - axis]).abs(),
        [false, false] => 0.0,
        _ => 1.0,
    };
    let wall = (0..plan.corners_m.len()).max_by(|a, b| rank(a).total_cmp(&rank(b)));
    wall.map_or("", |wall| plan.wall_surface(wall).0)
}

/// Areas of the walls along the sides of an outline. Neighbours meet in a mitre, which is short at sharp corners.
fn bands(sides: &[Side]) -> Vec<Vec<Pixel>> {
    let corner = |number: usize| {
        let (side, before) = (&sides[number % sides.len()], &sides[(number + sides.len() - 1) % sides.len()]);
        let mitre = (before.outward + side.outward) / (1.0 + before.outward.dot(side.outward)).max(0.5);
        [side.from, side.from + mitre * WALL].map(|place| place.to_array())
    };
    let band = |number: usize| {
        let ([a, out_a], [b, out_b]) = (corner(number), corner(number + 1));
        vec![a, b, out_b, out_a]
    };
    (0..sides.len()).map(band).collect()
}

/// Draws floor, walls, openings and doors.
pub(super) fn draw_room(canvas: &mut Canvas, view: &View, scene: &Scene) {
    let sides = sides(view, scene);
    let floor_ink = if view.is_plan() {
        material_ink(scene, &scene.file().room.floor.material).faint(0.10)
    } else {
        GREY.faint(0.05)
    };
    canvas.fill(&[sides.iter().map(|side| side.from.to_array()).collect()], floor_ink);
    // Walls of a material are one area, without seams where they meet.
    let mut walls: BTreeMap<&str, Vec<Vec<Pixel>>> = BTreeMap::new();
    for (side, band) in sides.iter().zip(bands(&sides)) {
        walls.entry(side.material).or_default().push(band);
    }
    for (material, bands) in walls {
        if material == "open" {
            canvas.outline(&bands, &Line { ink: GREY.faint(0.7), width: 1.0, is_dashed: true });
        } else {
            canvas.fill(&bands, material_ink(scene, material));
        }
    }
    for outline in scene.outlines() {
        let line = Line { ink: material_ink(scene, &outline.material).darker(0.35), width: 1.4, is_dashed: false };
        for edge in &outline.edges {
            canvas.line(&edge.map(|p| view.project(p)), &line);
        }
    }
    if view.is_plan() {
        draw_openings(canvas, view, scene, floor_ink);
    }
    for door in &scene.file().door {
        draw_door(canvas, view, door.position_m, door.width_m);
    }
}

/// Draws openings of a plan from above: a gap in the wall, and in it the pane or the door leaf. `floor_ink` is the colour of
/// the floor.
fn draw_openings(canvas: &mut Canvas, view: &View, scene: &Scene, floor_ink: Ink) {
    /// Width of the strip in which a wall's line is erased, pixels.
    const STRIP: f64 = 4.0;
    let sides = sides(view, scene);
    let openings = scene.openings();
    for opening in &openings {
        let [a, b] = opening.ends.map(|end| view.project(end.extend(0.0)));
        // White erases the line; then the floor is drawn over it.
        for ink in [Ink::solid([255, 255, 255]), floor_ink] {
            canvas.line(&[a, b], &Line { ink, width: STRIP, is_dashed: false });
        }
        // Partitions are lines without a thickness.
        if let Some(side) = opening.file.wall.and_then(|wall| sides.get(wall)) {
            draw_gap(canvas, [a, b], side.outward.to_array());
        }
    }
    // Leaves and panes come after all gaps, since a leaf may cover another opening.
    for opening in &openings {
        let leaf = opening.leaf.zip(opening.file.door.as_ref()).map(|(ends, door)| (ends, &door.material));
        let pane = opening.file.material.as_ref().map(|material| (opening.ends, material));
        if let Some((ends, material)) = leaf.or(pane).filter(|(_, material)| *material != "open") {
            let ink = material_ink(scene, material).darker(0.35);
            let ends: [Pixel; 2] = ends.map(|end| view.project(end.extend(0.0)));
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

/// Draws a door: a gap in the plan, an outline from the side.
fn draw_door(canvas: &mut Canvas, view: &View, [x, y]: [f64; 2], width_m: f64) {
    /// Height of a door, m.
    const HEIGHT_M: f64 = 2.0;
    let in_x_wall = x < 1e-6 || x > view.size_m.x - 1e-6;
    let half = 0.5 * width_m;
    let along = if in_x_wall { DVec3::Y } else { DVec3::X } * half;
    let middle = DVec3::new(x, y, 0.0);
    if view.is_plan() {
        let outward =
            if in_x_wall { [if x < 1e-6 { -1.0 } else { 1.0 }, 0.0] } else { [0.0, if y < 1e-6 { 1.0 } else { -1.0 }] };
        draw_gap(canvas, [view.project(middle - along), view.project(middle + along)], outward);
    } else if in_x_wall == (view.across == 1) {
        let high = middle + along + DVec3::Z * HEIGHT_M.min(view.size_m.z);
        let door = view.rectangle(middle - along, high);
        canvas.outline(&[door], &Line { ink: GREY.faint(0.6), width: 1.2, is_dashed: true });
    }
}
