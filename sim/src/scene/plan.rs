//! Rooms from floor plans: checks of a plan, and its walls, panes and doors as faces.

use glam::{DVec2, DVec3};

use super::Outline;
use super::check::{InvalidValue, check_material, check_range, invalid};
use super::draft::{Draft, ROOM, closed_wall};
use crate::geometry::polygon::{self, distance_to_segment};
use crate::geometry::{Mesh, PlanarPolygon, planes};
use crate::scene_file::{DoorLeafFile, HingeFile, OpeningFile, PartitionFile, PlanFile, SceneFile, SurfaceFile};

/// Distance within which positions are the same, m.
const SAME_M: f64 = 1e-6;
/// Least length of walls and openings, m.
const LEAST_LENGTH_M: f64 = 0.05;
/// Least distance of the radar from walls, m.
const LEAST_RADAR_DISTANCE_M: f64 = 0.01;
/// Upper limit of corners, openings and partitions of a plan.
const MOST_PARTS: f64 = 200.0;

/// Checks the plan, if any, and fills in the size of the box around it and its walls.
pub(super) fn check_and_fill(file: &mut SceneFile) -> Result<(), InvalidValue> {
    let Some(plan) = &file.room.plan else { return Ok(()) };
    if file.room.size_m != [0.0; 3] {
        return invalid("size_m", file.room.size_m, "none beside [room.plan]: the size is that of the box around it");
    }
    check_outline(plan)?;
    check_walls(file, plan)?;
    for (number, partition) in plan.partition.iter().enumerate() {
        check_partition(file, plan, number, partition)?;
    }
    let high = corners(plan).into_iter().fold(DVec2::ZERO, DVec2::max);
    let (size_m, walls) = ([high.x, high.y, plan.height_m], plan.walls.clone());
    let room = &mut file.room;
    room.size_m = size_m;
    for wall in [&mut room.x_low, &mut room.x_high, &mut room.y_low, &mut room.y_high] {
        *wall = walls.clone();
    }
    Ok(())
}

/// Checks that radar, furniture, seats, beds and doors lie within the plan, if any.
pub(super) fn check_places(file: &SceneFile) -> Result<(), InvalidValue> {
    let Some(plan) = &file.room.plan else { return Ok(()) };
    let Some(floor) = floor(plan) else { return Ok(()) };
    let wall_clearance_m = |[x, y]: [f64; 2]| floor.clearance(DVec3::new(x, y, 0.0)).distance_m;
    let is_within = |position: [f64; 2]| wall_clearance_m(position) >= -SAME_M;
    let [x, y, _] = file.radar.position_m;
    let partition_distance_m = |partition: &PartitionFile| distance_to_segment(DVec2::new(x, y), ends(partition));
    let clearance_m = plan.partition.iter().map(partition_distance_m).fold(wall_clearance_m([x, y]), f64::min);
    if clearance_m < LEAST_RADAR_DISTANCE_M {
        let expected = "a place within [room.plan], 1 cm or more from its walls and partitions";
        return invalid("position_m", file.radar.position_m, expected);
    }
    for furniture in &file.furniture {
        let ([x, y, _], [dx, dy, _]) = (furniture.position_m, furniture.size_m);
        if ![[x, y], [x + dx, y], [x, y + dy], [x + dx, y + dy]].into_iter().all(is_within) {
            return invalid(
                "furniture",
                (&furniture.name, furniture.position_m, furniture.size_m),
                "a box within the walls of [room.plan]",
            );
        }
    }
    for (key, position) in
        file.seat.iter().map(|seat| ("seat", seat.position_m)).chain(file.bed.iter().map(|bed| ("bed", bed.position_m)))
    {
        if !is_within(position) {
            return invalid(key, position, "a place within the walls of [room.plan]");
        }
    }
    for door in &file.door {
        if wall_clearance_m(door.position_m).abs() > SAME_M {
            return invalid("door", door.position_m, "a place on a wall of [room.plan]");
        }
    }
    Ok(())
}

/// Returns the corners of the outline, m.
pub(super) fn corners(plan: &PlanFile) -> Vec<DVec2> {
    plan.corners_m.iter().map(|&corner| DVec2::from_array(corner)).collect()
}

/// Returns the ends of all walls, m.
pub(super) fn walls(plan: &PlanFile) -> Vec<[DVec2; 2]> {
    polygon::sides(&corners(plan)).collect()
}

/// Returns the ends of a partition, m.
pub(super) fn ends(partition: &PartitionFile) -> [DVec2; 2] {
    [DVec2::from_array(partition.from_m), DVec2::from_array(partition.to_m)]
}

/// An opening of a floor plan, seen from above.
#[derive(Debug, Clone, Copy)]
pub struct Opening<'a> {
    /// Begin and end of the opening on the line of its wall or partition, m.
    pub ends: [DVec2; 2],
    /// Hinge and end of its door leaf, m; `None` without a door.
    pub leaf: Option<[DVec2; 2]>,
    /// Its keys in the scene file.
    pub file: &'a OpeningFile,
}

impl<'a> Opening<'a> {
    /// Places an opening on a line, with its leaf as [`leaf`] turns it.
    fn new([from, to]: [DVec2; 2], file: &'a OpeningFile, left: f64) -> Self {
        let direction = (to - from).normalize_or_zero();
        let ends = [file.from_m, file.to_m].map(|distance_m| from + direction * distance_m);
        let leaf = file.door.as_ref().map(|door| leaf(door, ends, left));
        Opening { ends, leaf, file }
    }
}

/// Hinge and end of the leaf of a door between two places of a line, m. The leaf turns to the left of the line's
/// direction (1) or to the right (-1), at either hinge.
fn leaf(door: &DoorLeafFile, [from, to]: [DVec2; 2], left: f64) -> [DVec2; 2] {
    let (hinge, shut, turn) = match door.hinge {
        HingeFile::From => (from, to, left),
        HingeFile::To => (to, from, -left),
    };
    [hinge, hinge + DVec2::from_angle(turn * door.open_deg.to_radians()).rotate(shut - hinge)]
}

/// Returns the openings of all walls and partitions.
pub(super) fn openings(plan: &PlanFile) -> Vec<Opening<'_>> {
    let (walls, left) = (walls(plan), polygon::doubled_area(&corners(plan)).signum());
    let mut openings = Vec::new();
    for file in &plan.opening {
        if let Some(&line) = file.wall.and_then(|wall| walls.get(wall)) {
            openings.push(Opening::new(line, file, left));
        }
    }
    for partition in &plan.partition {
        let line = ends(partition);
        openings.extend(partition.opening.iter().map(|file| Opening::new(line, file, 1.0)));
    }
    openings
}

/// Returns the floor, which faces up.
fn floor(plan: &PlanFile) -> Option<PlanarPolygon> {
    let corners: Vec<DVec3> = corners(plan).into_iter().map(|corner| corner.extend(0.0)).collect();
    let floor = PlanarPolygon::from_corners(&corners)?;
    Some(if floor.normal.z > 0.0 { floor } else { floor.flipped() })
}

/// Whether two lines cross each other between their ends.
fn lines_cross([a, b]: [DVec2; 2], [c, d]: [DVec2; 2]) -> bool {
    let side = |p: DVec2, q: DVec2, r: DVec2| (q - p).normalize_or_zero().perp_dot(r - p);
    let are_on_both_sides = |p: f64, q: f64| p.min(q) < -SAME_M && p.max(q) > SAME_M;
    are_on_both_sides(side(a, b, c), side(a, b, d)) && are_on_both_sides(side(c, d, a), side(c, d, b))
}

fn check_outline(plan: &PlanFile) -> Result<(), InvalidValue> {
    check_range("corners_m", plan.corners_m.len() as f64, 3.0, MOST_PARTS, "corners")?;
    for coordinate_m in plan.corners_m.iter().flatten() {
        check_range("corners_m", *coordinate_m, 0.0, 100.0, "m")?;
    }
    if let (Some(first), Some(last), 4..) = (plan.corners_m.first(), plan.corners_m.last(), plan.corners_m.len())
        && first == last
    {
        return invalid("corners_m", *last, "a last corner other than the first: the line closes by itself");
    }
    let low = corners(plan).into_iter().fold(DVec2::INFINITY, DVec2::min);
    if low.abs().max_element() > 1e-9 {
        return invalid("corners_m", low.to_array(), "0 as the least x and as the least y");
    }
    check_range("height_m", plan.height_m, 0.5, 100.0, "m")?;
    let walls = walls(plan);
    for (i, &wall) in walls.iter().enumerate() {
        if wall[0].distance(wall[1]) < LEAST_LENGTH_M {
            return invalid("corners_m", wall.map(|end| end.to_array()), "corners 5 cm or more from the next");
        }
        for (j, &other) in walls.iter().enumerate().skip(i + 1) {
            let is_next = j == i + 1;
            let is_closing = i == 0 && j + 1 == walls.len();
            let do_meet = match (is_next, is_closing) {
                // The sides share a corner. They must not fold back onto each other.
                (true, _) => {
                    distance_to_segment(other[1], wall) < SAME_M || distance_to_segment(wall[0], other) < SAME_M
                }
                (_, true) => {
                    distance_to_segment(other[0], wall) < SAME_M || distance_to_segment(wall[1], other) < SAME_M
                }
                _ => {
                    lines_cross(wall, other)
                        || other.iter().any(|&end| distance_to_segment(end, wall) < SAME_M)
                        || wall.iter().any(|&end| distance_to_segment(end, other) < SAME_M)
                }
            };
            if do_meet {
                let expected = format!("a line around the room that does not meet itself, as walls {i} and {j} do");
                return invalid("corners_m", [wall, other].map(|ends| ends.map(|end| end.to_array())), expected);
            }
        }
    }
    Ok(())
}

fn check_walls(file: &SceneFile, plan: &PlanFile) -> Result<(), InvalidValue> {
    let count = plan.corners_m.len();
    check_material(file, "walls", &plan.walls.material)?;
    check_range("thickness_m", plan.walls.thickness_m, 0.0, 10.0, "m")?;
    for (index, wall) in plan.wall.iter().enumerate() {
        let is_repeated = plan.wall.iter().take(index).any(|other| other.index == wall.index);
        if wall.index >= count || is_repeated {
            return invalid("index", wall.index, format!("an index below the number of walls, {count}, once"));
        }
        check_material(file, "material", &wall.material)?;
        check_range("thickness_m", wall.thickness_m, 0.0, 10.0, "m")?;
    }
    check_range("opening", plan.opening.len() as f64, 0.0, MOST_PARTS, "tables")?;
    check_range("partition", plan.partition.len() as f64, 0.0, MOST_PARTS, "tables")?;
    let openings = || plan.opening.iter().enumerate();
    if let Some((index, opening)) = openings().find(|(_, opening)| opening.wall.is_none_or(|wall| wall >= count)) {
        let found = opening.wall.map_or_else(|| "without wall".to_owned(), |wall| format!("with wall = {wall}"));
        let expected = format!("wall = an index below the number of walls, {count} (opening {index})");
        return invalid("opening", format_args!("{found}"), expected);
    }
    for (index, [from, to]) in walls(plan).into_iter().enumerate() {
        let openings_of_wall: Vec<(usize, &OpeningFile)> =
            openings().filter(|(_, opening)| opening.wall == Some(index)).collect();
        check_openings(file, &openings_of_wall, &format!("wall {index}"), [from.distance(to), plan.height_m])?;
    }
    Ok(())
}

fn check_partition(
    file: &SceneFile,
    plan: &PlanFile,
    number: usize,
    partition: &PartitionFile,
) -> Result<(), InvalidValue> {
    let line = ends(partition);
    let line_in_file = (partition.from_m, partition.to_m);
    for coordinate_m in partition.from_m.iter().chain(&partition.to_m) {
        check_range("partition", *coordinate_m, 0.0, 100.0, "m")?;
    }
    let length_m = line[0].distance(line[1]);
    if length_m < LEAST_LENGTH_M {
        return invalid("partition", line_in_file, "from_m and to_m 5 cm or more from each other");
    }
    let floor = floor(plan);
    let is_within = |position: DVec2| {
        let clearance = floor.as_ref().map(|floor| floor.clearance(position.extend(0.0)));
        clearance.is_some_and(|clearance| clearance.distance_m >= -SAME_M)
    };
    let is_line_within = [line[0], line[0].lerp(line[1], 0.5), line[1]].into_iter().all(is_within);
    if !is_line_within || walls(plan).into_iter().any(|wall| lines_cross(wall, line)) {
        return invalid("partition", line_in_file, "a line within the walls of [room.plan]");
    }
    let height_m = partition.height_m.unwrap_or(plan.height_m);
    check_range("height_m", height_m, LEAST_LENGTH_M, plan.height_m, "m (the room's)")?;
    check_material(file, "material", &partition.material)?;
    check_range("thickness_m", partition.thickness_m, 0.0, 10.0, "m")?;
    check_range("opening", partition.opening.len() as f64, 0.0, MOST_PARTS, "tables")?;
    if let Some(wall) = partition.opening.iter().find_map(|opening| opening.wall) {
        return invalid("opening", format_args!("with wall = {wall}"), "no wall in a partition's own opening");
    }
    let openings: Vec<(usize, &OpeningFile)> = partition.opening.iter().enumerate().collect();
    check_openings(file, &openings, &format!("partition {number}"), [length_m, height_m])
}

/// Checks the openings of a wall with the given name, length and height. Each opening has its number in the file.
fn check_openings(
    file: &SceneFile,
    openings: &[(usize, &OpeningFile)],
    wall: &str,
    size_m: [f64; 2],
) -> Result<(), InvalidValue> {
    for (position, (number, opening)) in openings.iter().enumerate() {
        let previous = openings.iter().take(position).map(|(_, other)| *other);
        check_opening(file, opening, previous, size_m)
            .map_err(|invalid| invalid.in_part(&format!("opening {number}, {wall}")))?;
    }
    Ok(())
}

/// Checks an opening in a wall with the given length and height, and with the `previous` openings in it.
fn check_opening<'a>(
    file: &SceneFile,
    opening: &OpeningFile,
    mut previous: impl Iterator<Item = &'a OpeningFile>,
    [length_m, height_m]: [f64; 2],
) -> Result<(), InvalidValue> {
    let [from, to, sill, head] = rectangle(opening);
    let spans = [([from, to], length_m, "from_m and to_m"), ([sill, head], height_m, "sill_m and head_m")];
    for ([low, high], most_m, keys) in spans {
        if !(low >= 0.0 && high - low >= LEAST_LENGTH_M && high <= most_m + SAME_M) {
            let expected = format!("{keys}, 5 cm apart or more, within 0 to {most_m} m");
            return invalid("opening", [low, high], expected);
        }
    }
    let overlaps = |other: &&OpeningFile| {
        let [other_from, other_to, other_sill, other_head] = rectangle(other);
        from < other_to - SAME_M && other_from < to - SAME_M && sill < other_head - SAME_M && other_sill < head - SAME_M
    };
    if let Some(other) = previous.find(overlaps) {
        let expected = format!("an opening beside the one from {} to {} m", other.from_m, other.to_m);
        return invalid("opening", [from, to], expected);
    }
    if opening.material.is_some() && opening.door.is_some() {
        return invalid("opening", "a pane and a door", "material or door");
    }
    if opening.thickness_m.is_some() && opening.material.is_none() {
        return invalid("thickness_m", "given", "none without a pane's material: a door has its own");
    }
    check_range("thickness_m", opening.pane_thickness_m(), 0.0, 10.0, "m")?;
    opening.material.iter().try_for_each(|material| check_material(file, "material", material))?;
    if let Some(door) = &opening.door {
        check_range("open_deg", door.open_deg, -170.0, 170.0, "degrees")?;
        check_range("thickness_m", door.thickness_m, 0.0, 10.0, "m")?;
        check_material(file, "material", &door.material)?;
    }
    Ok(())
}

/// Returns the begin and end along the wall, and the sill and head above the floor, m.
fn rectangle(opening: &OpeningFile) -> [f64; 4] {
    [opening.from_m, opening.to_m, opening.sill_m, opening.head_m]
}

/// An upright rectangle on a line.
struct UprightRectangle {
    ends: [DVec3; 2],
    height_m: f64,
}

impl UprightRectangle {
    fn new([from, to]: [DVec2; 2], height_m: f64) -> Self {
        UprightRectangle { ends: [from.extend(0.0), to.extend(0.0)], height_m }
    }

    fn length_m(&self) -> f64 {
        self.ends[0].distance(self.ends[1])
    }

    fn at(&self, along_m: f64, up_m: f64) -> DVec3 {
        self.ends[0].lerp(self.ends[1], along_m / self.length_m()).with_z(up_m)
    }

    /// Returns a part of the rectangle, which faces to the left of its direction.
    fn cut_out(&self, [from, to, sill, head]: [f64; 4]) -> Option<PlanarPolygon> {
        let corners = [self.at(from, sill), self.at(from, head), self.at(to, head), self.at(to, sill)];
        PlanarPolygon::from_corners(&corners)
    }

    /// Returns the polygons that remain of the rectangle around openings. They face to the left.
    fn without_openings(&self, openings: &[&OpeningFile]) -> Vec<PlanarPolygon> {
        let grid_lines = |size_m: f64, edges: &dyn Fn(&[f64; 4]) -> [f64; 2]| {
            let cuts = openings.iter().flat_map(|opening| edges(&rectangle(opening)));
            let mut lines: Vec<f64> = [0.0, size_m].into_iter().chain(cuts.map(|cut| cut.clamp(0.0, size_m))).collect();
            lines.sort_by(f64::total_cmp);
            lines.dedup_by(|later, earlier| *later - *earlier <= SAME_M);
            lines
        };
        let columns = grid_lines(self.length_m(), &|[from, to, _, _]| [*from, *to]);
        let rows = grid_lines(self.height_m, &|[_, _, sill, head]| [*sill, *head]);
        let vertices =
            rows.iter().flat_map(|&up_m| columns.iter().map(move |&along_m| self.at(along_m, up_m))).collect();
        let mut mesh = Mesh { vertices, triangles: Vec::new() };
        for (row, height) in rows.windows(2).enumerate() {
            for (column, width) in columns.windows(2).enumerate() {
                let (along_m, up_m) = (0.5 * (width[0] + width[1]), 0.5 * (height[0] + height[1]));
                let is_open = openings.iter().any(|opening| {
                    let [from, to, sill, head] = rectangle(opening);
                    (from..to).contains(&along_m) && (sill..head).contains(&up_m)
                });
                if !is_open {
                    let low_left = (row * columns.len() + column) as u32;
                    let high_left = low_left + columns.len() as u32;
                    mesh.triangles
                        .extend([[low_left, high_left, high_left + 1], [low_left, high_left + 1, low_left + 1]]);
                }
            }
        }
        planes(&mesh, SAME_M).planes.iter().flat_map(|plane| PlanarPolygon::of_plane(&mesh, plane)).collect()
    }

    /// Returns a door leaf in an opening, and whether it is shut.
    fn leaf(&self, opening: &OpeningFile, door: &DoorLeafFile, left: f64) -> (Option<PlanarPolygon>, bool) {
        let [from, to, sill, head] = rectangle(opening);
        let ends = [from, to].map(|along_m| self.at(along_m, sill).truncate());
        let [hinge, end] = leaf(door, ends, left).map(|position| position.extend(sill));
        let corners = [hinge, hinge.with_z(head), end.with_z(head), end];
        (PlanarPolygon::from_corners(&corners), door.open_deg.abs() < 1e-6)
    }
}

/// A wall or partition in the making.
struct Wall<'a> {
    rectangle: UprightRectangle,
    openings: Vec<&'a OpeningFile>,
    /// Material and thickness in m.
    surface: (&'a str, f64),
    name: String,
    group: usize,
    /// Whether it faces to the left of its direction, else to the right.
    faces_left: bool,
}

/// Builder of faces with their groups, and of outlines.
struct Builder<'a> {
    file: &'a SceneFile,
    frequency_hz: f64,
    drafts: Vec<Draft>,
    outlines: Vec<Outline>,
    groups: usize,
}

impl Builder<'_> {
    fn new_group(&mut self) -> usize {
        self.groups += 1;
        self.groups
    }

    /// Adds faces of a material with its thickness in m, unless the material is open.
    fn add(
        &mut self,
        polygons: impl IntoIterator<Item = PlanarPolygon>,
        (material, thickness_m): (&str, f64),
        name: &str,
        group: usize,
    ) {
        let surface = SurfaceFile { material: material.to_owned(), thickness_m };
        let Some(wall) = closed_wall(self.file, &surface, self.frequency_hz) else { return };
        for polygon in polygons {
            self.outlines.push(Outline { material: surface.material.clone(), edges: polygon.edges().collect() });
            self.drafts.push(Draft { polygon, wall, name: name.to_owned(), group });
        }
    }

    /// Adds a wall or partition with its panes and doors.
    fn add_wall(&mut self, wall: &Wall) {
        let Wall { rectangle: wall_rectangle, openings, surface, name, group, faces_left } = wall;
        let facing = |polygon: PlanarPolygon| if *faces_left { polygon } else { polygon.flipped() };
        self.add(wall_rectangle.without_openings(openings).into_iter().map(facing), *surface, name, *group);
        for opening in openings {
            if let Some(material) = &opening.material {
                let pane = wall_rectangle.cut_out(rectangle(opening)).map(facing);
                self.add(pane, (material, opening.pane_thickness_m()), &format!("pane in {name}"), *group);
            }
            if let Some(door) = &opening.door {
                let (leaf, is_shut) = wall_rectangle.leaf(opening, door, if *faces_left { 1.0 } else { -1.0 });
                // An open leaf does not enclose a volume with the wall.
                let group = if is_shut { *group } else { self.new_group() };
                self.add(leaf, (&door.material, door.thickness_m), &format!("door in {name}"), group);
            }
        }
    }
}

/// Returns walls, floor, ceiling, partitions, panes and doors of a plan as faces, and their outlines.
pub(super) fn faces(file: &SceneFile, plan: &PlanFile, frequency_hz: f64) -> (Vec<Draft>, Vec<Outline>) {
    let mut builder = Builder { file, frequency_hz, drafts: Vec::new(), outlines: Vec::new(), groups: ROOM };
    let twice_area_m2 = polygon::doubled_area(&corners(plan));
    for (index, ends) in walls(plan).into_iter().enumerate() {
        builder.add_wall(&Wall {
            rectangle: UprightRectangle::new(ends, plan.height_m),
            openings: plan.opening.iter().filter(|opening| opening.wall == Some(index)).collect(),
            surface: plan.wall_surface(index),
            name: format!("wall {index}"),
            group: ROOM,
            faces_left: twice_area_m2 > 0.0,
        });
    }
    let (floor, room) = (floor(plan), &file.room);
    let ceiling = floor.as_ref().map(|floor| raised(floor, plan.height_m).flipped());
    builder.add(ceiling, (&room.ceiling.material, room.ceiling.thickness_m), "ceiling", ROOM);
    builder.add(floor, (&room.floor.material, room.floor.thickness_m), "floor", ROOM);
    for (number, partition) in plan.partition.iter().enumerate() {
        let group = builder.new_group();
        builder.add_wall(&Wall {
            rectangle: UprightRectangle::new(ends(partition), partition.height_m.unwrap_or(plan.height_m)),
            openings: partition.opening.iter().collect(),
            surface: (&partition.material, partition.thickness_m),
            name: format!("partition {number}"),
            group,
            faces_left: true,
        });
    }
    (builder.drafts, builder.outlines)
}

fn raised(floor: &PlanarPolygon, height_m: f64) -> PlanarPolygon {
    let outline = floor.outline.iter().map(|corner| corner.with_z(height_m)).collect();
    PlanarPolygon { outline, offset_m: height_m, ..floor.clone() }
}
