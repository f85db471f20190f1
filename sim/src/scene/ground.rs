//! What of a floor plan is in people's way: all that lies outside of its walls, and its partitions but for their doorways.

use glam::DVec2;

use super::file::{OpeningFile, PartitionFile, PlanFile};

/// A box on the ground plan: low and high corner, m.
pub(crate) type GroundBox = [[f64; 2]; 2];

/// Size of the boxes into which walls askew are cut, m.
const STEP_M: f64 = 0.25;
/// People pass openings that begin below this and end above that, m.
const SILL_M: f64 = 0.05;
const HEAD_M: f64 = 1.9;
/// Doors that are open by so much let people through, degrees.
const OPEN_DEG: f64 = 45.0;
/// Lines nearer to each other than this are one, m.
const SAME_M: f64 = 1e-6;

/// What of a plan people walk around. Door leaves are not among it.
pub(crate) fn boxes(plan: &PlanFile) -> Vec<GroundBox> {
    let corners: Vec<DVec2> = plan.corners_m.iter().map(|&corner| DVec2::from_array(corner)).collect();
    let mut boxes = outside(&corners);
    for partition in &plan.partition {
        add_partition(partition, &mut boxes);
    }
    boxes
}

/// Boxes over what lies around a polygon within its bounds: exact where its sides run along the axes.
fn outside(corners: &[DVec2]) -> Vec<GroundBox> {
    let sides = || corners.iter().zip(corners.iter().cycle().skip(1));
    let is_askew = sides().any(|(a, b)| (a.x - b.x).abs() > SAME_M && (a.y - b.y).abs() > SAME_M);
    let lines = |axis: usize| {
        let mut lines: Vec<f64> = corners.iter().map(|corner| corner[axis]).collect();
        if is_askew {
            let most = lines.iter().copied().fold(0.0, f64::max);
            lines.extend((1..(most / STEP_M).ceil() as usize).map(|i| i as f64 * STEP_M));
        }
        lines.sort_by(f64::total_cmp);
        lines.dedup_by(|later, earlier| *later - *earlier <= SAME_M);
        lines
    };
    let (across, up) = (lines(0), lines(1));
    let mut boxes: Vec<GroundBox> = Vec::new();
    for row in up.windows(2) {
        let mut open: Option<GroundBox> = None;
        for column in across.windows(2) {
            let middle = DVec2::new(0.5 * (column[0] + column[1]), 0.5 * (row[0] + row[1]));
            if encloses(corners, middle) {
                boxes.extend(open.take());
            } else if let Some([_, high]) = &mut open {
                high[0] = column[1];
            } else {
                open = Some([[column[0], row[0]], [column[1], row[1]]]);
            }
        }
        boxes.extend(open);
    }
    boxes
}

/// Whether a point lies within a polygon.
fn encloses(corners: &[DVec2], p: DVec2) -> bool {
    let sides = corners.iter().zip(corners.iter().cycle().skip(1));
    let crossed =
        sides.filter(|(a, b)| (a.y > p.y) != (b.y > p.y) && p.x < a.x + (p.y - a.y) / (b.y - a.y) * (b.x - a.x));
    crossed.count() % 2 == 1
}

/// Whether people go through an opening.
fn lets_people_through(opening: &OpeningFile) -> bool {
    let is_open = opening.door.as_ref().is_none_or(|door| door.open_deg.abs() >= OPEN_DEG);
    opening.material.is_none() && is_open && opening.sill_m <= SILL_M && opening.head_m >= HEAD_M
}

/// Adds boxes around the parts of a partition between its doorways.
fn add_partition(partition: &PartitionFile, boxes: &mut Vec<GroundBox>) {
    let (from, to) = (DVec2::from_array(partition.from_m), DVec2::from_array(partition.to_m));
    let length_m = from.distance(to);
    let mut doorways: Vec<[f64; 2]> =
        partition.opening.iter().filter(|opening| lets_people_through(opening)).map(|o| [o.from_m, o.to_m]).collect();
    doorways.sort_by(|a, b| a[0].total_cmp(&b[0]));
    let mut begin = 0.0;
    for [first, last] in doorways.into_iter().chain([[length_m, length_m]]) {
        if first - begin > SAME_M {
            let at = |place_m: f64| from.lerp(to, place_m / length_m);
            add_line(at(begin), at(first), boxes);
        }
        begin = last;
    }
}

/// Adds boxes around a line: one where it runs along an axis.
fn add_line(from: DVec2, to: DVec2, boxes: &mut Vec<GroundBox>) {
    let offset = (to - from).abs();
    let parts = if offset.min_element() < SAME_M { 1 } else { (offset.length() / STEP_M).ceil().max(1.0) as usize };
    for part in 0..parts {
        let [a, b] = [part, part + 1].map(|end| from.lerp(to, end as f64 / parts as f64));
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
    fn the_corner_of_an_l_is_one_box() {
        let l = plan("corners_m = [[0.0, 0.0], [8.0, 0.0], [8.0, 2.0], [2.0, 2.0], [2.0, 6.0], [0.0, 6.0]]");
        assert_eq!(boxes(&l), [[[2.0, 2.0], [8.0, 6.0]]]);
        let rectangle = plan("corners_m = [[0.0, 0.0], [7.0, 0.0], [7.0, 4.0], [0.0, 4.0]]");
        assert!(boxes(&rectangle).is_empty());
    }

    /// Askew walls are followed within a step.
    #[test]
    fn askew_walls_are_taken_in_steps() {
        let triangle = plan("corners_m = [[0.0, 0.0], [4.0, 0.0], [0.0, 3.0]]");
        let all = boxes(&triangle);
        let area_m2: f64 = all.iter().map(|[low, high]| (high[0] - low[0]) * (high[1] - low[1])).sum();
        assert!((area_m2 - 6.0).abs() < 0.6, "{area_m2}");
        let holds =
            |x: f64, y: f64| all.iter().any(|[low, high]| x > low[0] && x < high[0] && y > low[1] && y < high[1]);
        assert!(holds(3.6, 2.6) && !holds(1.0, 1.0) && !holds(0.4, 2.2));
    }

    #[test]
    fn partitions_are_in_the_way_but_for_their_doorways() {
        let partition = "corners_m = [[0.0, 0.0], [7.0, 0.0], [7.0, 4.0], [0.0, 4.0]]\n[[partition]]\n\
                         from_m = [3.5, 0.0]\nto_m = [3.5, 4.0]\nmaterial = \"glass\"\n";
        assert_eq!(boxes(&plan(partition)), [[[3.5, 0.0], [3.5, 4.0]]]);
        let opening = "[[partition.opening]]\nfrom_m = 1.5\nto_m = 2.4\nhead_m = 2.0\n";
        let two = [[[3.5, 0.0], [3.5, 1.5]], [[3.5, 2.4], [3.5, 4.0]]];
        let near = |found: &[GroundBox]| {
            let pairs = found.iter().flatten().flatten().zip(two.iter().flatten().flatten());
            found.len() == 2 && pairs.map(|(a, b): (&f64, &f64)| (a - b).abs()).fold(0.0, f64::max) < 1e-12
        };
        assert!(near(&boxes(&plan(&format!("{partition}{opening}")))));
        let door = |open_deg: f64| {
            let door = format!("door = {{ hinge = \"from\", open_deg = {open_deg:?}, material = \"wood\" }}\n");
            boxes(&plan(&format!("{partition}{opening}{door}")))
        };
        assert!(near(&door(-80.0)) && door(10.0).len() == 1);
    }
}
