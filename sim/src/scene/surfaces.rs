//! Surfaces of a scene: one description for rooms from boxes, floor plans and files.
//!
//! Walls, floors and the sides of furniture are [`Face`]s: plane polygons of a slab of a material. Curved or small
//! parts remain meshes of triangles ([`SmallPart`]), which occlude objects behind them. Faces that enclose a volume
//! have air on one side, and their normals point to it: into the room if the volume contains the radar. All other faces
//! have air on both sides, and their normals point to the side of the radar.

mod sides;
pub(super) mod sources;
mod touch;

use std::f64::consts::{PI, TAU};

use glam::DVec3;

use super::draft::Draft;
use crate::em::image::Wall;
use crate::geometry::{Mesh, PlanarPolygon};
use crate::scene_file::FurnitureFile;
use touch::{PolygonIndex, TOUCH_M, Touch, touches};

/// Least area of a plane that becomes a face, m^2; smaller planes of a mesh remain triangles. For comparison, the first
/// Fresnel zone in the middle of a path of 2 m at 60 GHz is 0.008 m^2.
pub const LEAST_FACE_M2: f64 = 0.01;
/// Deviation from a straight angle within which a face continues another one, rad. The point of reflection at 5 m moves
/// by a tenth of a millimetre for this angle.
const STRAIGHT_RAD: f64 = 2e-5;
/// Angle between two faces at an edge up to which one lies on the other, rad.
const FOLDED_RAD: f64 = 0.01;

/// Sides of a face that have air.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sides {
    /// Only the side to which its normal points. The other side does not reflect.
    One,
    /// Both sides.
    Two,
}

/// A plane surface.
#[derive(Debug, Clone, PartialEq)]
pub struct Face {
    /// Outline of the face, m.
    pub polygon: PlanarPolygon,
    /// Reflection and transmission of its slab.
    pub wall: Wall,
    /// Name of the wall, the piece of furniture or the part of the file, for messages.
    pub name: String,
    /// Sides with air.
    pub sides: Sides,
}

/// Faces that meet a face at its edge.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum EdgeKind {
    /// Other faces, with at most 180 degrees of air between. The edge does not diffract.
    Inner,
    /// Another face in the same plane, on each side that has air.
    Flat,
    /// Another face in the same plane whose wall is a different one, as a pane in a wall. Reflection and transmission
    /// change there, so that the edge diffracts the difference; both faces list it.
    Seam {
        /// Index of the other face.
        other: usize,
    },
    /// Another face, with more than 180 degrees of air between. The edge is a wedge, which both faces list.
    Wedge {
        /// Index of the other face; `None` if it belongs to a [`SmallPart`].
        other: Option<usize>,
    },
    /// No other face: the free edge of a sheet.
    Free,
}

/// A part of a face's edge along which the same other faces meet it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FaceEdge {
    /// Index of the face.
    pub face: usize,
    /// Index of the edge, as in [`PlanarPolygon::edges`].
    pub edge: usize,
    /// Ends of the part, m, in the direction of the edge.
    pub ends: [DVec3; 2],
    /// Other faces at the edge.
    pub kind: EdgeKind,
}

impl FaceEdge {
    /// Whether the edge diffracts.
    pub fn diffracts(&self) -> bool {
        matches!(self.kind, EdgeKind::Free | EdgeKind::Wedge { .. } | EdgeKind::Seam { .. })
    }
}

/// Triangles of one material that do not form faces, because they are curved or too small.
#[derive(Debug, Clone, PartialEq)]
pub struct SmallPart {
    /// Triangles, m.
    pub mesh: Mesh,
}

/// All surfaces of a scene, in room coordinates.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Surfaces {
    /// Plane surfaces.
    pub faces: Vec<Face>,
    /// Edges of the faces, sorted by face.
    pub edges: Vec<FaceEdge>,
    /// Triangles that do not form faces.
    pub small: Vec<SmallPart>,
}

impl Surfaces {
    /// Determines the sides with air and the neighbours at edges, and leaves out faces that other faces cover.
    pub(super) fn assemble(mut drafts: Vec<Draft>, small: Vec<SmallPart>, radar: DVec3) -> Self {
        let polygons: Vec<PlanarPolygon> = drafts.iter().map(|draft| draft.polygon.clone()).collect();
        let triangles = small.iter().flat_map(|part| part.mesh.all_corners());
        let triangles: Vec<PlanarPolygon> =
            triangles.filter_map(|corners| PlanarPolygon::from_corners(&corners)).collect();
        let index = PolygonIndex::new(&polygons, &triangles);
        let touches = touches(&polygons, &index);
        let covered_by: Vec<Option<usize>> = (0..polygons.len()).map(|face| cover(&polygons, &index, face)).collect();
        let sides = sides::resolve(&mut drafts, &touches, &covered_by, radar);

        let mut surfaces = Surfaces { small, ..Surfaces::default() };
        let mut face_of_draft: Vec<Option<usize>> = Vec::with_capacity(drafts.len());
        for ((draft, by), sides) in drafts.into_iter().zip(&covered_by).zip(sides) {
            face_of_draft.push(by.is_none().then_some(surfaces.faces.len()));
            if by.is_none() {
                surfaces.faces.push(Face { polygon: draft.polygon, wall: draft.wall, name: draft.name, sides });
            }
        }
        surfaces.edges = touches.iter().filter_map(|touch| surfaces.edge(touch, &face_of_draft)).collect();
        surfaces
    }

    /// Converts a touch between drafts to an edge of the faces. `face_of_draft` maps drafts to faces.
    fn edge(&self, touch: &Touch, face_of_draft: &[Option<usize>]) -> Option<FaceEdge> {
        let index = face_of_draft.get(touch.face).copied().flatten()?;
        let face = self.faces.get(index)?;
        let edge = face.polygon.clearance(touch.ends[0].lerp(touch.ends[1], 0.5)).edge;
        let [from, to] = face.polygon.edges().nth(edge)?;
        let [first, last] = touch.ends;
        let ends = if (last - first).dot(to - from) >= 0.0 { [first, last] } else { [last, first] };
        let normal = face.polygon.normal;
        // Angles of the sheets about the edge, from the face towards its normal. Faces that were left out lie within
        // other faces.
        let mut sheets: Vec<(f64, Option<usize>)> = Vec::new();
        // A face in the same plane that ends here, too, and is another wall.
        let mut seam = None;
        for sheet in &touch.sheets {
            let other = match sheet.face {
                Some(draft) => match face_of_draft.get(draft).copied().flatten() {
                    Some(other) => Some(other),
                    None => continue,
                },
                None => None,
            };
            let angle = sheet.towards.dot(normal).atan2(sheet.towards.dot(touch.inwards)).rem_euclid(TAU);
            if angle > FOLDED_RAD && angle < TAU - FOLDED_RAD {
                sheets.push((angle, other));
            }
            if let Some(other) = other
                && sheet.ends_opposed.is_some()
                && (angle - PI).abs() <= STRAIGHT_RAD
                && self.faces.get(other).is_some_and(|other| other.wall != face.wall)
            {
                seam = Some(other);
            }
        }
        sheets.sort_by(|a, b| a.0.total_cmp(&b.0));
        let kind = match (kind(&sheets, face.sides), seam) {
            (EdgeKind::Flat, Some(other)) => EdgeKind::Seam { other },
            (kind, _) => kind,
        };
        Some(FaceEdge { face: index, edge, ends, kind })
    }

    /// Whether a piece of furniture of a material has sides among the faces.
    pub fn has_faces_of(&self, furniture: &FurnitureFile) -> bool {
        let low = DVec3::from_array(furniture.position_m) - TOUCH_M;
        let high = low + DVec3::from_array(furniture.size_m) + 2.0 * TOUCH_M;
        let is_within = |face: &Face| {
            let [face_low, face_high] = face.polygon.bounds();
            face_low.cmpge(low).all() && face_high.cmple(high).all()
        };
        furniture.material.is_some() && self.faces.iter().any(is_within)
    }

    /// All surfaces as triangles, m. Visibility is tested against them.
    pub fn triangles(&self) -> Mesh {
        let faces = self.faces.iter().flat_map(|face| face.polygon.triangulate());
        Mesh::soup(faces.chain(self.small.iter().flat_map(|part| part.mesh.all_corners())))
    }
}

/// Kind of an edge from the ascending angles of the other sheets at it.
fn kind(sheets: &[(f64, Option<usize>)], sides: Sides) -> EdgeKind {
    let (Some(&(first, front)), Some(&(last, back))) = (sheets.first(), sheets.last()) else {
        return EdgeKind::Free;
    };
    let air_angles = [(first, front), (TAU - last, back)];
    let angles_with_air = match sides {
        Sides::One => &air_angles[..1],
        Sides::Two => &air_angles[..],
    };
    match angles_with_air.iter().find(|air| air.0 > PI + STRAIGHT_RAD) {
        Some(&(_, other)) => EdgeKind::Wedge { other },
        None if angles_with_air.iter().all(|air| air.0 >= PI - STRAIGHT_RAD) => EdgeKind::Flat,
        None => EdgeKind::Inner,
    }
}

/// Returns the face that covers another one. If two faces cover each other, the first one counts as the cover.
fn cover(polygons: &[PlanarPolygon], index: &PolygonIndex, face: usize) -> Option<usize> {
    let polygon = polygons.get(face)?;
    let [low, high] = polygon.bounds();
    index
        .near(low, high)
        .filter_map(|near| Some((near.face?, near.polygon)))
        .filter(|&(other, larger)| {
            other != face && covers(larger, polygon) && (other < face || !covers(polygon, larger))
        })
        .map(|(other, _)| other)
        .min()
}

/// Whether one polygon lies within another one of the same plane, for either direction of the normals.
fn covers(larger: &PlanarPolygon, smaller: &PlanarPolygon) -> bool {
    let within = |point: DVec3| larger.clearance(point).distance_m >= -TOUCH_M;
    smaller.loops().flatten().all(|corner| larger.height_m(*corner).abs() <= TOUCH_M)
        && smaller.edges().all(|[a, b]| within(a) && within(a.lerp(b, 0.5)))
        && larger.loops().flatten().all(|corner| smaller.clearance(*corner).distance_m <= TOUCH_M)
        && larger.contains(smaller.inner_point())
}
