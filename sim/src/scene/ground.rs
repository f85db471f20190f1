//! Floor of a room on the ground plan, and the obstacles on it: furniture, the area outside the walls, partitions
//! between their doorways, and door leaves. For rooms from files, the floor is the area that leads to the radar without
//! a wall between ([`cells`]).

mod cells;

use glam::{DVec2, DVec3};

use super::{Scene, plan};
use crate::geometry::polygon::{distance_to_segment, encloses, sides};
use crate::people::route::Block;
use crate::scene_file::{FurnitureFile, OpeningFile, PartitionFile, PlanFile};
use cells::{CellKind, Cells};

/// Size of the boxes that cover oblique walls, m.
const STEP_M: f64 = 0.25;
/// Openings that people can pass begin below the first height and end above the second one, m.
const SILL_M: f64 = 0.05;
const HEAD_M: f64 = 1.9;
/// Least opening angle of a door that people can pass, degrees.
const OPEN_DEG: f64 = 45.0;
/// Distance within which lines are the same, m.
const SAME_M: f64 = 1e-6;
/// Size on the ground plan above which a piece of a mesh counts as a wall if it is also higher than people, m. Such
/// pieces may surround the floor of the room.
const LARGE_M: f64 = 1.5;

/// Floor of a room on the ground plan.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Floor {
    /// The whole box around the room, of this size, m.
    Box([f64; 2]),
    /// Area enclosed by these corners, m.
    Plan(Vec<DVec2>),
    /// Cells of a grid.
    Cells(Cells),
}

impl Floor {
    /// The floor of a scene's room.
    pub fn of(scene: &Scene) -> Self {
        let room = &scene.file.room;
        let whole_box = || Floor::Box([room.size_m[0], room.size_m[1]]);
        match &room.plan {
            Some(plan) => Floor::Plan(plan::corners(plan)),
            None if room.mesh.is_empty() => whole_box(),
            None => Cells::of(scene).map_or_else(whole_box, Floor::Cells),
        }
    }

    /// Whether parts of a body lie in the room, and whether parts lie outside. The body extends by `half` along the
    /// axes from its centre, m.
    pub fn meets(&self, centre: DVec3, half: DVec3) -> [bool; 2] {
        let offsets = [DVec2::ZERO, DVec2::X * half.x, DVec2::Y * half.y];
        let points = || offsets.into_iter().flat_map(|offset| [centre.truncate() + offset, centre.truncate() - offset]);
        match self {
            Floor::Box([width_m, depth_m]) => {
                let (low, high) = (centre - half, centre + half);
                let is_in = high.x > 0.0 && high.y > 0.0 && low.x < *width_m && low.y < *depth_m;
                [is_in, low.x < 0.0 || low.y < 0.0 || high.x > *width_m || high.y > *depth_m]
            }
            Floor::Plan(walls) => [true, false].map(|is_in| points().any(|point| encloses(walls, point) == is_in)),
            Floor::Cells(cells) => {
                [CellKind::Inside, CellKind::Outside].map(|kind| points().any(|point| cells.kind(point) == kind))
            }
        }
    }
}

/// Whether a position lies outside the box around the room, outside the walls of its plan, or where the files of the
/// room have no floor that leads to the radar.
pub(crate) fn is_outside(scene: &Scene, position: [f64; 2]) -> bool {
    let room = &scene.file.room;
    let is_in_box = (0..2).all(|axis| (0.0..=room.size_m[axis]).contains(&position[axis]));
    let is_in_plan = |plan: &PlanFile| {
        let (corners, position) = (plan::corners(plan), DVec2::from_array(position));
        encloses(&corners, position) || sides(&corners).any(|side| distance_to_segment(position, side) <= SAME_M)
    };
    if !(is_in_box && room.plan.as_ref().is_none_or(is_in_plan)) {
        return true;
    }
    matches!(Floor::of(scene), Floor::Cells(cells) if cells.kind(DVec2::from_array(position)) == CellKind::Outside)
}

/// Whether a piece of furniture, by its index, is a piece of a mesh that counts as a wall.
pub(crate) fn is_wall(scene: &Scene, index: usize) -> bool {
    let is_piece_of_mesh = !scene.meshes.pieces.is_empty() && index >= scene.meshes.own_furniture;
    let is_large = |f: &FurnitureFile| f.position_m[2] + f.size_m[2] > HEAD_M && f.size_m[0].max(f.size_m[1]) > LARGE_M;
    is_piece_of_mesh && scene.file.furniture.get(index).is_some_and(is_large)
}

/// Obstacles that people walk around: furniture and walls.
pub(crate) fn blocks(scene: &Scene) -> Vec<Block> {
    /// Height below which objects are no obstacles, m.
    const CARPET_M: f64 = 0.05;
    let obstacles = scene.file.furniture.iter().enumerate().filter(|(index, furniture)| {
        let [bottom, top] = [furniture.position_m[2], furniture.position_m[2] + furniture.size_m[2]];
        bottom < HEAD_M && top > CARPET_M && !is_wall(scene, *index)
    });
    let footprint = |(_, furniture): (usize, &FurnitureFile)| {
        let ([x, y, _], [w, d, _]) = (furniture.position_m, furniture.size_m);
        [[x, y], [x + w, y + d]]
    };
    obstacles.map(footprint).chain(walls(scene)).collect()
}

/// Parts of the room itself that people walk around; none for a box.
pub(crate) fn walls(scene: &Scene) -> Vec<Block> {
    match (Floor::of(scene), &scene.file.room.plan) {
        (_, Some(plan)) => [wall_boxes(plan), door_leaf_boxes(plan)].concat(),
        (Floor::Cells(cells), None) => cells.boxes(),
        _ => Vec::new(),
    }
}

/// Boxes around the leaves of a plan's doors.
fn door_leaf_boxes(plan: &PlanFile) -> Vec<Block> {
    let mut boxes = Vec::new();
    for [hinge, end] in plan::openings(plan).into_iter().filter_map(|opening| opening.leaf) {
        add_line_boxes(hinge, end, &mut boxes);
    }
    boxes
}

/// Boxes around the parts of a plan that people walk around, except door leaves.
fn wall_boxes(plan: &PlanFile) -> Vec<Block> {
    let mut boxes = boxes_outside(&plan::corners(plan));
    for partition in &plan.partition {
        add_partition_boxes(partition, &mut boxes);
    }
    boxes
}

/// Boxes that cover the area outside a polygon, within its bounds. They are exact if the polygon's sides are parallel
/// to the axes.
fn boxes_outside(corners: &[DVec2]) -> Vec<Block> {
    let has_oblique_sides = sides(corners).any(|[a, b]| (a.x - b.x).abs() > SAME_M && (a.y - b.y).abs() > SAME_M);
    let lines = |axis: usize| {
        let mut lines: Vec<f64> = corners.iter().map(|corner| corner[axis]).collect();
        if has_oblique_sides {
            let largest = lines.iter().copied().fold(0.0, f64::max);
            lines.extend((1..(largest / STEP_M).ceil() as usize).map(|i| i as f64 * STEP_M));
        }
        lines.sort_by(f64::total_cmp);
        lines.dedup_by(|later, earlier| *later - *earlier <= SAME_M);
        lines
    };
    let (columns, rows) = (lines(0), lines(1));
    let mut boxes: Vec<Block> = Vec::new();
    for row in rows.windows(2) {
        let mut run: Option<Block> = None;
        for column in columns.windows(2) {
            let centre = DVec2::new(0.5 * (column[0] + column[1]), 0.5 * (row[0] + row[1]));
            if encloses(corners, centre) {
                boxes.extend(run.take());
            } else if let Some([_, high]) = &mut run {
                high[0] = column[1];
            } else {
                run = Some([[column[0], row[0]], [column[1], row[1]]]);
            }
        }
        boxes.extend(run);
    }
    boxes
}

/// Whether people can pass an opening.
fn lets_people_through(opening: &OpeningFile) -> bool {
    let has_open_door = opening.door.as_ref().is_none_or(|door| door.open_deg.abs() >= OPEN_DEG);
    opening.material.is_none() && has_open_door && opening.sill_m <= SILL_M && opening.head_m >= HEAD_M
}

/// Adds boxes around the parts of a partition between its doorways.
fn add_partition_boxes(partition: &PartitionFile, boxes: &mut Vec<Block>) {
    let [from, to] = plan::ends(partition);
    let length_m = from.distance(to);
    let mut doorways: Vec<[f64; 2]> =
        partition.opening.iter().filter(|opening| lets_people_through(opening)).map(|o| [o.from_m, o.to_m]).collect();
    doorways.sort_by(|a, b| a[0].total_cmp(&b[0]));
    let mut begin = 0.0;
    for [opening_begin, opening_end] in doorways.into_iter().chain([[length_m, length_m]]) {
        if opening_begin - begin > SAME_M {
            let at = |place_m: f64| from.lerp(to, place_m / length_m);
            add_line_boxes(at(begin), at(opening_begin), boxes);
        }
        begin = opening_end;
    }
}

/// Adds boxes that cover a line: a single one if it is parallel to an axis.
fn add_line_boxes(from: DVec2, to: DVec2, boxes: &mut Vec<Block>) {
    let extent = (to - from).abs();
    let count = if extent.min_element() < SAME_M { 1 } else { (extent.length() / STEP_M).ceil().max(1.0) as usize };
    for index in 0..count {
        let [a, b] = [index, index + 1].map(|end| from.lerp(to, end as f64 / count as f64));
        boxes.push([a.min(b).to_array(), a.max(b).to_array()]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plan(tables: &str) -> PlanFile {
        let text = format!("height_m = 2.5\nwalls = {{ material = \"concrete\" }}\n{tables}");
        toml::from_str(&text).expect("a plan")
    }

    #[test]
    fn the_area_outside_an_l_is_one_box_and_outside_a_rectangle_none() {
        let l = plan("corners_m = [[0.0, 0.0], [8.0, 0.0], [8.0, 2.0], [2.0, 2.0], [2.0, 6.0], [0.0, 6.0]]");
        assert_eq!(wall_boxes(&l), [[[2.0, 2.0], [8.0, 6.0]]]);
        let rectangle = plan("corners_m = [[0.0, 0.0], [7.0, 0.0], [7.0, 4.0], [0.0, 4.0]]");
        assert!(wall_boxes(&rectangle).is_empty());
    }

    /// Boxes follow oblique walls within one step.
    #[test]
    fn oblique_walls_are_covered_by_steps() {
        let triangle = plan("corners_m = [[0.0, 0.0], [4.0, 0.0], [0.0, 3.0]]");
        let all = wall_boxes(&triangle);
        let area_m2: f64 = all.iter().map(|[low, high]| (high[0] - low[0]) * (high[1] - low[1])).sum();
        assert!((area_m2 - 6.0).abs() < 0.6, "{area_m2}");
        let holds =
            |x: f64, y: f64| all.iter().any(|[low, high]| x > low[0] && x < high[0] && y > low[1] && y < high[1]);
        assert!(holds(3.6, 2.6) && !holds(1.0, 1.0) && !holds(0.4, 2.2));
    }

    /// A leaf of 0.9 m at 45 degrees is hung at the beginning of the opening and swings to the left of the partition's
    /// direction.
    #[test]
    fn open_door_leaves_are_obstacles() {
        let found = door_leaf_boxes(&plan(
            "corners_m = [[0.0, 0.0], [7.0, 0.0], [7.0, 4.0], [0.0, 4.0]]\n[[partition]]\nfrom_m = [3.5, 0.0]\n\
             to_m = [3.5, 4.0]\nmaterial = \"glass\"\n[[partition.opening]]\nfrom_m = 1.5\nto_m = 2.4\nhead_m = 2.0\n\
             door = { hinge = \"from\", open_deg = 45.0, material = \"wood\" }\n",
        ));
        let reach_m = 0.9 * 0.5f64.sqrt();
        let low = found.iter().map(|[low, _]| low[0]).fold(f64::INFINITY, f64::min);
        let high = found.iter().map(|[_, high]| high[1]).fold(0.0, f64::max);
        assert!((low - (3.5 - reach_m)).abs() < 1e-9 && (high - (1.5 + reach_m)).abs() < 1e-9, "{found:?}");
        // The leaf lies in the line x + y = 5, and each box covers a part of it.
        assert!(found.iter().all(|[low, high]| low[0] + low[1] <= 5.0 && high[0] + high[1] >= 5.0), "{found:?}");
    }

    #[test]
    fn partitions_are_obstacles_except_at_their_doorways() {
        let partition = "corners_m = [[0.0, 0.0], [7.0, 0.0], [7.0, 4.0], [0.0, 4.0]]\n[[partition]]\n\
                         from_m = [3.5, 0.0]\nto_m = [3.5, 4.0]\nmaterial = \"glass\"\n";
        assert_eq!(wall_boxes(&plan(partition)), [[[3.5, 0.0], [3.5, 4.0]]]);
        let opening = "[[partition.opening]]\nfrom_m = 1.5\nto_m = 2.4\nhead_m = 2.0\n";
        let two = [[[3.5, 0.0], [3.5, 1.5]], [[3.5, 2.4], [3.5, 4.0]]];
        let near = |found: &[Block]| {
            let pairs = found.iter().flatten().flatten().zip(two.iter().flatten().flatten());
            found.len() == 2 && pairs.map(|(a, b): (&f64, &f64)| (a - b).abs()).fold(0.0, f64::max) < 1e-12
        };
        assert!(near(&wall_boxes(&plan(&format!("{partition}{opening}")))));
        let door = |open_deg: f64| {
            let door = format!("door = {{ hinge = \"from\", open_deg = {open_deg:?}, material = \"wood\" }}\n");
            wall_boxes(&plan(&format!("{partition}{opening}{door}")))
        };
        assert!(near(&door(-80.0)) && door(10.0).len() == 1);
    }
}
