//! Paths by sequences of facets, folded into the room: antenna, points of reflection, point.
//!
//! Unfolded, a path is a straight line from an image of the antenna to the point. A path that passes beyond the edge of
//! an inner corner is bent: it goes by the edge.

use glam::DVec3;
use num_complex::Complex64;

use super::corner_runs::CornerPassage;
use super::discovery::{ImagePaths, MAX_ORDER};
use super::flat::{FacetId, SEAM_M};
use super::leg::{Leg, RelativeField};

/// Least distance of a point before a facet for a reflection, m.
pub(super) const BEFORE_M: f64 = 1e-9;

/// Path folded into the room: antenna, points of reflection, point.
#[derive(Debug, Clone)]
pub(super) struct FoldedPath {
    points: [DVec3; MAX_ORDER + 2],
    count: usize,
    /// Relative field past the edges of inner corners in which the path is reflected to and fro.
    pub corner_field: RelativeField,
    /// Edges of inner corners beside single reflections, by the index of the reflection in the sequence.
    pub corners_beside: Vec<(usize, CornerPassage)>,
}

impl FoldedPath {
    /// Points of the path, from the antenna on.
    pub fn points(&self) -> &[DVec3] {
        self.points.get(..self.count).unwrap_or_default()
    }

    /// One of the points, 0 for the antenna.
    pub fn point(&self, i: usize) -> DVec3 {
        self.points.get(i).copied().unwrap_or(DVec3::ZERO)
    }

    /// Returns whether the edge of an inner corner is beside the path.
    pub fn is_at_corner(&self) -> bool {
        self.corner_field.field != Complex64::ONE || !self.corners_beside.is_empty()
    }

    /// Returns whether the path passes all inner corners on the side of their facets.
    pub fn is_within_corners(&self) -> bool {
        self.corner_field.is_geometric && !self.corners_beside.iter().any(|(_, passage)| passage.is_beyond)
    }
}

impl ImagePaths {
    /// Images of an antenna by the first facets of a sequence, 0 to [`MAX_ORDER`] of them; `None` if a facet does not
    /// exist.
    #[inline]
    pub(super) fn images_along(&self, sequence: &[FacetId], antenna: DVec3) -> Option<[DVec3; MAX_ORDER + 1]> {
        let mut images = [antenna; MAX_ORDER + 1];
        let mut image = antenna;
        for (slot, &facet) in images.iter_mut().skip(1).zip(sequence) {
            image = self.environment.flat(facet)?.mirrored(image);
            *slot = image;
        }
        Some(images)
    }

    /// The path by a sequence if it meets all planes from the front, at any point of them. Within reach of the edge of
    /// an inner corner it may also pass on the other side: it then meets the corner's facets at the edge.
    pub(super) fn folded(&self, sequence: &[FacetId], antenna: DVec3, point: DVec3) -> Option<FoldedPath> {
        let count = sequence.len();
        if count > MAX_ORDER {
            return None;
        }
        let images = self.images_along(sequence, antenna)?;
        let mut points = [point; MAX_ORDER + 2];
        let mut corner_field = RelativeField::FREE;
        let mut corners_beside: Vec<(usize, CornerPassage)> = Vec::new();
        let runs = self.runs.of(sequence);
        // Displacements of the path to inner corners, each with the index of the corner's first reflection.
        let mut shifts: Vec<(usize, DVec3)> = Vec::new();
        // Index of the last reflection at a corner by whose edge the path goes.
        let mut last_bend = None;
        let mut target = point;
        for (i, &facet) in sequence.iter().enumerate().rev() {
            let flat = self.environment.flat(facet)?;
            let source = images.get(i + 1).copied()?;
            for run in runs.iter().filter(|run| run.last == i) {
                let total_m = images.get(count)?.distance(point);
                let direction = (target - source).normalize_or_zero();
                let line = Leg { from: source, direction, length_m: total_m, before_m: 0.0, total_m };
                let Some(passage) = run.passage(&line, &self.environment) else { continue };
                if passage.other_side_part == Complex64::ZERO {
                    continue;
                }
                if run.count == 1 {
                    corners_beside.push((i, passage));
                } else {
                    let part = passage.other_side_part;
                    let field = if passage.is_behind { 1.0 - part } else { part };
                    corner_field = corner_field.and(RelativeField { field, is_geometric: passage.is_behind });
                }
                if passage.is_beyond {
                    shifts.push((run.first, passage.shift));
                    last_bend.get_or_insert(i);
                }
            }
            let shift: DVec3 = shifts.iter().map(|(_, shift)| *shift).sum();
            let (target_height, source_height) = (flat.height(target + shift), flat.height(source + shift));
            // A path into a corner and back meets both faces in their common edge: one face's point lies in the other's
            // plane.
            let least_m = if i + 1 == count { BEFORE_M } else { -SEAM_M };
            if target_height <= least_m || source_height >= -BEFORE_M {
                return None;
            }
            target = target.lerp(source, target_height / (target_height - source_height)) + shift;
            *points.get_mut(i + 1)? = target;
            if !shifts.is_empty() {
                // Within the run, the path is a parallel one. From its first facet, it goes straight to the antenna.
                let mirror = flat.mirror();
                shifts.retain_mut(|(first, shift)| {
                    *shift = mirror * *shift;
                    *first < i
                });
                target -= shifts.iter().map(|(_, shift)| *shift).sum::<DVec3>();
            }
        }
        if let Some(last) = last_bend.filter(|last| last + 1 < count) {
            // From the corner, the path goes straight to the point.
            let bend = *points.get(last + 1)?;
            self.fold_straight(sequence.get(last + 1..)?, bend, point, points.get_mut(last + 2..)?)?;
        }
        *points.first_mut()? = antenna;
        Some(FoldedPath { points, count: count + 2, corner_field, corners_beside })
    }

    /// Computes the points of reflection, one for each facet of a sequence, of a path from one point to another; `None`
    /// where it meets a plane from behind.
    fn fold_straight(&self, sequence: &[FacetId], from: DVec3, to: DVec3, points: &mut [DVec3]) -> Option<()> {
        let images = self.images_along(sequence, from)?;
        let mut target = to;
        for (i, (&facet, &source)) in sequence.iter().zip(images.iter().skip(1)).enumerate().rev() {
            let flat = self.environment.flat(facet)?;
            let (target_height, source_height) = (flat.height(target), flat.height(source));
            if target_height <= -SEAM_M || source_height >= -BEFORE_M {
                return None;
            }
            target = target.lerp(source, target_height / (target_height - source_height));
            *points.get_mut(i)? = target;
        }
        Some(())
    }
}
