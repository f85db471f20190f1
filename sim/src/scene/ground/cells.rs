//! Ground plan of a room from files, in cells: the floor that leads to the radar without a wall between.

use std::collections::VecDeque;

use glam::{DVec2, DVec3};

use super::{HEAD_M, SILL_M};
use crate::geometry::{Mesh, Plane, planes};
use crate::material::OPEN;
use crate::people::route::Block;
use crate::scene::Scene;
use crate::scene::room::WELD_M;

/// Largest side of a cell, m. Cells divide a room evenly.
const MOST_CELL_M: f64 = 0.1;
/// Height below which walls begin and floors lie, m. Walls also end above people's heads.
const FOOT_M: f64 = 0.3;
/// Largest vertical component of a wall's unit normal, and least one of a floor's.
const UPRIGHT: f64 = 0.05;
const LEVEL: f64 = 0.95;
/// Distance from the sides of the box around the room within which walls are these sides, m.
const ON_SIDE_M: f64 = 0.05;

/// A cell of the ground plan.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum CellKind {
    /// No floor, or none that leads to the radar.
    Outside,
    /// A wall.
    Wall,
    /// Floor of the room.
    Inside,
}

/// Grid over the box around a room.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Cells {
    size_m: DVec2,
    /// Size of a cell, m.
    cell_m: DVec2,
    /// Number of columns and rows.
    count: [usize; 2],
    /// Kinds of the cells; x is the fastest index.
    kinds: Vec<CellKind>,
}

impl Cells {
    /// Finds the cells of a scene's meshes; `None` if the whole box around the room is floor, or none of it.
    pub fn of(scene: &Scene) -> Option<Self> {
        let [width_m, depth_m, _] = scene.file.room.size_m;
        let size_m = DVec2::new(width_m, depth_m);
        let count = [width_m, depth_m].map(|length_m| ((length_m / MOST_CELL_M).ceil() as usize).max(1));
        let mut cells = Cells::new(size_m, count);
        let mut has_floor = vec![false; cells.kinds.len()];
        for piece in scene.meshes.pieces.iter().filter(|piece| piece.surface.material != OPEN) {
            let mut mesh = piece.mesh.clone();
            mesh.vertices.iter_mut().for_each(|vertex| *vertex -= scene.meshes.corner);
            for plane in planes(&mesh, WELD_M).planes {
                cells.add_plane(&mesh, &plane, &mut has_floor);
            }
        }
        if !has_floor.contains(&true) {
            has_floor.fill(true);
        }
        let azimuth_rad = scene.file.radar.azimuth_deg.to_radians();
        cells.flood(scene.radar_position().truncate(), DVec2::from_angle(azimuth_rad), &has_floor);
        let is_inside = |kind: &CellKind| *kind == CellKind::Inside;
        (cells.kinds.iter().any(is_inside) && !cells.kinds.iter().all(is_inside)).then_some(cells)
    }

    /// Makes cells that are all outside the room.
    fn new(size_m: DVec2, count: [usize; 2]) -> Self {
        let cell_m = size_m / DVec2::new(count[0] as f64, count[1] as f64);
        Cells { size_m, cell_m, count, kinds: vec![CellKind::Outside; count[0] * count[1]] }
    }

    /// Index of the cell at a position; `None` outside the grid.
    fn cell_index(&self, position: DVec2) -> Option<usize> {
        let [i, j] = (position / self.cell_m).floor().to_array();
        let is_within = i >= 0.0 && j >= 0.0 && i < self.count[0] as f64 && j < self.count[1] as f64;
        is_within.then(|| i as usize + self.count[0] * j as usize)
    }

    /// Kind of the cell at a position.
    pub fn kind(&self, position: DVec2) -> CellKind {
        self.cell_index(position).map_or(CellKind::Outside, |cell| self.kinds[cell])
    }

    /// Adds a plane of a mesh if it is a wall or a floor.
    fn add_plane(&mut self, mesh: &Mesh, plane: &Plane, has_floor: &mut [bool]) {
        let corners = || plane.triangles.iter().filter_map(|&triangle| mesh.corners(triangle as usize));
        let heights = || corners().flatten().map(|corner| corner.z);
        let low_m = heights().fold(f64::INFINITY, f64::min);
        let high_m = heights().fold(f64::NEG_INFINITY, f64::max);
        let upward = plane.normal.z.abs();
        if upward > LEVEL && high_m < FOOT_M {
            corners().for_each(|triangle| self.add_floor(triangle, has_floor));
        } else if upward < UPRIGHT && low_m < FOOT_M && high_m > HEAD_M {
            let along = DVec3::Z.cross(plane.normal).normalize_or_zero();
            for triangle in corners() {
                let span = if self.is_on_side(&triangle) { None } else { span_m(&triangle, along) };
                if let Some(span) = span {
                    self.add_wall(triangle[0], along, span);
                }
            }
        }
    }

    /// Whether a triangle is part of a side of the box around the room.
    fn is_on_side(&self, triangle: &[DVec3; 3]) -> bool {
        let lies_at =
            |axis: usize, side_m: f64| triangle.iter().all(|corner| (corner[axis] - side_m).abs() < ON_SIDE_M);
        (0..2).any(|axis| lies_at(axis, 0.0) || lies_at(axis, self.size_m[axis]))
    }

    /// Marks the cells whose centres lie in a triangle.
    fn add_floor(&self, triangle: [DVec3; 3], has_floor: &mut [bool]) {
        let [a, b, c] = triangle.map(DVec3::truncate);
        let clamped =
            |x: f64, axis: usize| ((x / self.cell_m[axis]).floor().max(0.0) as usize).min(self.count[axis] - 1);
        let (low, high) = (a.min(b).min(c), a.max(b).max(c));
        for j in clamped(low.y, 1)..=clamped(high.y, 1) {
            for i in clamped(low.x, 0)..=clamped(high.x, 0) {
                let centre = DVec2::new(i as f64 + 0.5, j as f64 + 0.5) * self.cell_m;
                let sides = [(a, b), (b, c), (c, a)].map(|(from, to)| (to - from).perp_dot(centre - from));
                let is_within = sides.iter().all(|side| *side >= 0.0) || sides.iter().all(|side| *side <= 0.0);
                has_floor[i + self.count[0] * j] |= is_within;
            }
        }
    }

    /// Marks the cells under a part of an upright plane, from one position along it to another.
    fn add_wall(&mut self, point_on_plane: DVec3, along: DVec3, [from, to]: [f64; 2]) {
        let steps = ((to - from) / (0.25 * self.cell_m.min_element())).ceil().max(1.0) as usize;
        for step in 0..=steps {
            let along_m = from + (to - from) * step as f64 / steps as f64;
            let position = (point_on_plane + along * (along_m - point_on_plane.dot(along))).truncate();
            if let Some(cell) = self.cell_index(position) {
                self.kinds[cell] = CellKind::Wall;
            }
        }
    }

    /// Marks the floor that leads to the radar. The search begins at the first floor cell ahead of the radar.
    fn flood(&mut self, radar: DVec2, ahead: DVec2, has_floor: &[bool]) {
        let is_free_floor = |kinds: &[CellKind], cell: usize| kinds[cell] == CellKind::Outside && has_floor[cell];
        let step_m = 0.5 * self.cell_m.min_element();
        let steps = (self.size_m.length() / step_m).ceil() as usize;
        let positions = (0..=steps).map(|step| radar + ahead * (step_m * step as f64));
        let first =
            positions.filter_map(|position| self.cell_index(position)).find(|&cell| is_free_floor(&self.kinds, cell));
        let mut queue: VecDeque<usize> = first.into_iter().collect();
        while let Some(cell) = queue.pop_front() {
            if !is_free_floor(&self.kinds, cell) {
                continue;
            }
            self.kinds[cell] = CellKind::Inside;
            let [columns, rows] = self.count;
            let (i, j) = (cell % columns, cell / columns);
            let neighbours = [
                (i > 0).then(|| cell - 1),
                (i + 1 < columns).then(|| cell + 1),
                (j > 0).then(|| cell - columns),
                (j + 1 < rows).then(|| cell + columns),
            ];
            queue.extend(neighbours.into_iter().flatten().filter(|&next| is_free_floor(&self.kinds, next)));
        }
    }

    /// Returns boxes that cover all cells outside the room's floor. Equal runs along x in consecutive rows share a box.
    pub fn boxes(&self) -> Vec<Block> {
        let mut boxes: Vec<Block> = Vec::new();
        // Runs of the previous row, with the row in which they began.
        let mut open_runs: Vec<([usize; 2], usize)> = Vec::new();
        for (j, row) in self.kinds.chunks(self.count[0]).enumerate() {
            let runs = runs(row);
            let (continued, ended): (Vec<_>, Vec<_>) = open_runs.into_iter().partition(|(run, _)| runs.contains(run));
            boxes.extend(ended.into_iter().map(|(run, first)| self.block(run, [first, j])));
            let new_runs =
                runs.iter().filter(|run| !continued.iter().any(|(other, _)| other == *run)).map(|&run| (run, j));
            let new_runs: Vec<_> = new_runs.collect();
            open_runs = continued;
            open_runs.extend(new_runs);
        }
        boxes.extend(open_runs.into_iter().map(|(run, first)| self.block(run, [first, self.count[1]])));
        boxes
    }

    /// Returns the box of a range of columns and rows. The second number of a range is one past its last index.
    fn block(&self, [left, right]: [usize; 2], [first, end]: [usize; 2]) -> Block {
        let corner = |i: usize, j: usize| (DVec2::new(i as f64, j as f64) * self.cell_m).to_array();
        [corner(left, first), corner(right, end)]
    }
}

/// Runs of columns without floor in a row: first column, and one past the last.
fn runs(row: &[CellKind]) -> Vec<[usize; 2]> {
    let mut runs: Vec<[usize; 2]> = Vec::new();
    for (column, _) in row.iter().enumerate().filter(|(_, kind)| **kind != CellKind::Inside) {
        match runs.last_mut() {
            Some([_, end]) if *end == column => *end = column + 1,
            _ => runs.push([column, column + 1]),
        }
    }
    runs
}

/// Part of a triangle at the heights at which people walk, as an interval along a direction, m.
fn span_m([a, b, c]: &[DVec3; 3], along: DVec3) -> Option<[f64; 2]> {
    let mut span = [f64::INFINITY, f64::NEG_INFINITY];
    for (from, to) in [(a, b), (b, c), (c, a)] {
        let rise_m = to.z - from.z;
        let (mut begin, mut end) = (0.0f64, 1.0f64);
        if rise_m.abs() > 1e-9 {
            let [first, second] = [SILL_M, HEAD_M].map(|height_m| (height_m - from.z) / rise_m);
            (begin, end) = (begin.max(first.min(second)), end.min(first.max(second)));
        } else if !(SILL_M..=HEAD_M).contains(&from.z) {
            continue;
        }
        if begin > end {
            continue;
        }
        for fraction in [begin, end] {
            let position = from.lerp(*to, fraction).dot(along);
            span = [span[0].min(position), span[1].max(position)];
        }
    }
    (span[0] <= span[1]).then_some(span)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A triangle of a wall counts at the height of people, not above their heads.
    #[test]
    fn a_wall_counts_only_at_the_height_of_people() {
        let position = |x: f64, z: f64| DVec3::new(x, 2.0, z);
        let span = |triangle: [DVec3; 3]| span_m(&triangle, DVec3::X);
        let [_, to] = span([position(1.0, 0.0), position(3.0, 0.0), position(3.0, 2.5)]).expect("a part");
        assert!((to - 3.0).abs() < 1e-12, "{to}");
        // Triangle above a door of 2 m.
        assert_eq!(span([position(1.0, 2.0), position(3.0, 2.0), position(3.0, 2.5)]), None);
        let [from, to] = span([position(0.0, 1.0), position(4.0, 5.0), position(0.0, 5.0)]).expect("a part");
        assert!(from.abs() < 1e-12 && (to - 0.9).abs() < 1e-12, "{from} {to}");
    }

    /// Equal runs in consecutive rows form one box.
    #[test]
    fn boxes_cover_all_cells_without_floor() {
        let mut cells = Cells::new(DVec2::new(0.6, 0.4), [6, 4]);
        cells.kinds.fill(CellKind::Inside);
        for (i, j) in [(3, 1), (4, 1), (3, 2), (4, 2), (0, 3), (5, 3)] {
            cells.kinds[i + 6 * j] = if i == 3 { CellKind::Wall } else { CellKind::Outside };
        }
        let mut boxes = cells.boxes();
        boxes.sort_by(|a, b| a[0][0].total_cmp(&b[0][0]));
        let expected = [[[0.0, 0.3], [0.1, 0.4]], [[0.3, 0.1], [0.5, 0.3]], [[0.5, 0.3], [0.6, 0.4]]];
        assert_eq!(boxes.len(), 3);
        for (found, expected) in boxes.iter().flatten().flatten().zip(expected.iter().flatten().flatten()) {
            assert!((found - expected).abs() < 1e-12, "{boxes:?}");
        }
        assert_eq!(cells.kind(DVec2::new(0.35, 0.15)), CellKind::Wall);
        assert_eq!(cells.kind(DVec2::new(-0.05, 0.15)), CellKind::Outside);
    }
}
