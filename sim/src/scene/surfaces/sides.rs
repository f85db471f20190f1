//! Sides of faces that have air.

use glam::DVec3;

use super::touch::Touch;
use super::{Draft, Sides};

/// Direction of the rays that distinguish inside from outside. It is unlikely to be parallel to any edge.
const PROBE: DVec3 = DVec3::new(0.537_71, 0.318_83, 0.780_49);

/// Faces that enclose a volume.
struct Shell {
    /// Indices of the faces, and whether each must be reversed to match the first one.
    faces: Vec<(usize, bool)>,
    /// Volume, m^3; negative if the first face points inwards.
    volume_m3: f64,
}

/// Reverses faces that enclose a volume so that they point to the air: inwards if the volume contains the radar,
/// outwards otherwise. All other faces have air on both sides, and are turned towards the radar. Faces that others of
/// their group cover (`covered_by`) enclose no volume.
pub(super) fn resolve(
    drafts: &mut [Draft],
    touches: &[Touch],
    covered_by: &[Option<usize>],
    radar: DVec3,
) -> Vec<Sides> {
    let mut sides = vec![Sides::Two; drafts.len()];
    let is_covered = |face: usize| {
        let by = covered_by.get(face).copied().flatten();
        by.is_some_and(|by| drafts[by].group == drafts[face].group)
    };
    let is_covered: Vec<bool> = (0..drafts.len()).map(is_covered).collect();
    let shells = shells(drafts, touches, &is_covered);
    // Of nested volumes, such as the outer and inner faces of a building's walls, every second one has air inside.
    let mut enclosing: Vec<usize> = (0..shells.len()).filter(|&s| contains(drafts, &shells[s], radar)).collect();
    enclosing.sort_by(|&s, &t| shells[s].volume_m3.abs().total_cmp(&shells[t].volume_m3.abs()));
    for (number, shell) in shells.iter().enumerate() {
        let has_air = enclosing.iter().position(|&s| s == number).is_some_and(|depth| depth % 2 == 0);
        let is_inwards = shell.volume_m3 < 0.0;
        for &(face, is_reversed) in &shell.faces {
            sides[face] = Sides::One;
            if is_reversed ^ is_inwards ^ has_air {
                drafts[face].polygon = drafts[face].polygon.clone().flipped();
            }
        }
    }
    for (draft, _) in drafts.iter_mut().zip(&sides).filter(|(_, sides)| **sides == Sides::Two) {
        if draft.polygon.height_m(radar) < 0.0 {
            draft.polygon = draft.polygon.clone().flipped();
        }
    }
    sides
}

/// Returns the sets of faces of a group that are connected by edges of exactly two faces and have no open edge.
fn shells(drafts: &[Draft], touches: &[Touch], is_covered: &[bool]) -> Vec<Shell> {
    let mut neighbours: Vec<Vec<(usize, bool)>> = vec![Vec::new(); drafts.len()];
    let mut is_open = is_covered.to_vec();
    for touch in touches {
        let mut others = touch
            .sheets
            .iter()
            .filter_map(|sheet| Some((sheet.face?, sheet.ends_opposed?)))
            .filter(|&(other, _)| drafts[other].group == drafts[touch.face].group && !is_covered[other]);
        match (others.next(), others.next()) {
            (Some(other), None) => neighbours[touch.face].push(other),
            _ => is_open[touch.face] = true,
        }
    }
    let mut is_reversed_of_face: Vec<Option<bool>> = vec![None; drafts.len()];
    let mut shells = Vec::new();
    for first in 0..drafts.len() {
        if is_reversed_of_face[first].is_some() {
            continue;
        }
        is_reversed_of_face[first] = Some(false);
        let mut faces = vec![(first, false)];
        let (mut visited, mut is_closed) = (0, true);
        while let Some(&(face, is_reversed)) = faces.get(visited) {
            visited += 1;
            is_closed &= !is_open[face];
            for &(other, is_opposed) in &neighbours[face] {
                let is_reversed_too = is_reversed ^ !is_opposed;
                match is_reversed_of_face[other] {
                    Some(known) => is_closed &= known == is_reversed_too,
                    None => {
                        is_reversed_of_face[other] = Some(is_reversed_too);
                        faces.push((other, is_reversed_too));
                    }
                }
            }
        }
        if is_closed {
            let volume = |&(face, is_reversed): &(usize, bool)| {
                let polygon = &drafts[face].polygon;
                let cone = polygon.area_m2() * polygon.offset_m / 3.0;
                if is_reversed { -cone } else { cone }
            };
            let volume_m3 = faces.iter().map(volume).sum();
            shells.push(Shell { faces, volume_m3 });
        }
    }
    shells
}

/// Whether a point lies in the volume of a shell.
fn contains(drafts: &[Draft], shell: &Shell, point: DVec3) -> bool {
    let is_crossed = |&&(face, _): &&(usize, bool)| {
        let polygon = &drafts[face].polygon;
        let distance_m = -polygon.height_m(point) / polygon.normal.dot(PROBE);
        distance_m > 0.0 && distance_m.is_finite() && polygon.contains(point + PROBE * distance_m)
    };
    shell.faces.iter().filter(is_crossed).count() % 2 == 1
}
