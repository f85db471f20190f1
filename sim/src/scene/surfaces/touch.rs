//! Edges of faces, and the surfaces that meet them.

use glam::DVec3;

use crate::geometry::PlanarPolygon;

/// Distance within which faces touch, m: the distance within which vertices of meshes are welded.
pub(super) const TOUCH_M: f64 = 1e-4;
/// Largest width along x of polygons that are found by their position, m.
const NARROW_M: f64 = 1.0;

/// A part of a face's edge along which the same other surfaces meet it.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Touch {
    /// Index of the face.
    pub face: usize,
    /// Ends of the part, m.
    pub ends: [DVec3; 2],
    /// Unit vector from the edge into the face.
    pub inwards: DVec3,
    /// Other sheets at the edge.
    pub sheets: Vec<Sheet>,
}

/// A half-plane that begins at an edge.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Sheet {
    /// Index of the face to which it belongs; `None` for a small triangle.
    pub face: Option<usize>,
    /// Unit vector from the edge into the sheet.
    pub towards: DVec3,
    /// True if its polygon also ends at the edge, and its own edge runs in the opposite direction. `None` if it
    /// continues beyond the edge.
    pub ends_opposed: Option<bool>,
}

/// A polygon with its bounding box.
pub(super) struct BoundedPolygon<'a> {
    pub polygon: &'a PlanarPolygon,
    /// Index of the face; `None` for a small triangle.
    pub face: Option<usize>,
    low: DVec3,
    high: DVec3,
}

/// Polygons that are found by their position.
pub(super) struct PolygonIndex<'a> {
    wide: Vec<BoundedPolygon<'a>>,
    /// Polygons up to [`NARROW_M`] wide, sorted by their lowest x.
    narrow: Vec<BoundedPolygon<'a>>,
}

impl<'a> PolygonIndex<'a> {
    pub fn new(faces: &'a [PlanarPolygon], small: &'a [PlanarPolygon]) -> Self {
        let of_faces = faces.iter().enumerate().map(|(face, polygon)| (Some(face), polygon));
        let all = of_faces.chain(small.iter().map(|polygon| (None, polygon))).map(|(face, polygon)| {
            let [low, high] = polygon.bounds();
            BoundedPolygon { polygon, face, low, high }
        });
        let (mut narrow, wide): (Vec<_>, Vec<_>) = all.partition(|p| p.high.x - p.low.x <= NARROW_M);
        narrow.sort_by(|p, q| p.low.x.total_cmp(&q.low.x));
        PolygonIndex { wide, narrow }
    }

    /// Returns polygons whose bounding boxes touch a box.
    pub fn near(&self, low: DVec3, high: DVec3) -> impl Iterator<Item = &BoundedPolygon<'a>> {
        let (low, high) = (low - TOUCH_M, high + TOUCH_M);
        let first = self.narrow.partition_point(|p| p.low.x < low.x - NARROW_M);
        let narrow = self.narrow.iter().skip(first).take_while(move |p| p.low.x <= high.x);
        self.wide.iter().chain(narrow).filter(move |p| p.low.cmple(high).all() && p.high.cmpge(low).all())
    }
}

/// Returns all edges of all faces, cut where the set of touching surfaces changes.
pub(super) fn touches(faces: &[PlanarPolygon], index: &PolygonIndex) -> Vec<Touch> {
    let mut all = Vec::new();
    for (face, polygon) in faces.iter().enumerate() {
        for [a, b] in polygon.edges() {
            let (length_m, direction) = (a.distance(b), (b - a).normalize_or_zero());
            let near: Vec<&BoundedPolygon> = index
                .near(a.min(b), a.max(b))
                .filter(|p| p.face != Some(face))
                .filter(|p| [a, b].iter().all(|&end| p.polygon.height_m(end).abs() <= TOUCH_M))
                .collect();
            let mut cuts = vec![0.0, length_m];
            near.iter().for_each(|p| add_cuts(p.polygon, a, direction, length_m, &mut cuts));
            cuts.sort_by(f64::total_cmp);
            cuts.dedup_by(|later, earlier| *later - *earlier <= TOUCH_M);
            for part in cuts.windows(2) {
                let ends = [a + direction * part[0], a + direction * part[1]];
                let middle = ends[0].lerp(ends[1], 0.5);
                let sheets = near.iter().flat_map(|p| sheets(p, middle, direction)).collect();
                all.push(Touch { face, ends, inwards: polygon.normal.cross(direction), sheets });
            }
        }
    }
    all
}

/// Adds the positions along an edge at which a polygon begins, ends or has a corner, m. The polygon's plane contains
/// the edge.
fn add_cuts(polygon: &PlanarPolygon, from: DVec3, direction: DVec3, length_m: f64, cuts: &mut Vec<f64>) {
    let across = polygon.normal.cross(direction);
    let coordinates = |p: DVec3| ((p - from).dot(direction), (p - from).dot(across));
    for [p, q] in polygon.edges() {
        let ((along_m, across_m), (next_along_m, next_across_m)) = (coordinates(p), coordinates(q));
        let cut = if across_m.abs() <= TOUCH_M {
            along_m
        } else if next_across_m.abs() > TOUCH_M && (across_m > 0.0) != (next_across_m > 0.0) {
            along_m + (next_along_m - along_m) * across_m / (across_m - next_across_m)
        } else {
            continue;
        };
        if cut > TOUCH_M && cut < length_m - TOUCH_M {
            cuts.push(cut);
        }
    }
}

/// Returns the sheets of a polygon at a point of an edge. The polygon's plane contains the edge.
fn sheets(bounded: &BoundedPolygon, point: DVec3, direction: DVec3) -> Vec<Sheet> {
    let (polygon, face) = (bounded.polygon, bounded.face);
    let clearance = polygon.clearance(point);
    if clearance.distance_m > TOUCH_M {
        let across = polygon.normal.cross(direction).normalize_or_zero();
        return [across, -across].map(|towards| Sheet { face, towards, ends_opposed: None }).to_vec();
    }
    let own_direction = polygon.edges().nth(clearance.edge).map_or(DVec3::ZERO, |[a, b]| (b - a).normalize_or_zero());
    let parallel = own_direction.dot(direction);
    if clearance.distance_m < -TOUCH_M || parallel.abs() < 0.9 {
        return Vec::new();
    }
    vec![Sheet { face, towards: polygon.inwards(clearance.edge), ends_opposed: Some(parallel < 0.0) }]
}
