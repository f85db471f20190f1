//! Paths by sequences of facets, folded into the room: antenna, points of reflection, point.
//!
//! Unfolded, a path is a straight line from an image of the antenna to the point. Past the edge of an inner corner it is
//! bent: it goes by the edge.

use glam::DVec3;
use num_complex::Complex64;

use super::corner_runs::PastCorner;
use super::discovery::{ImagePaths, MAX_ORDER};
use super::flat::{FacetId, SEAM_M};
use super::leg::{Kept, Leg};

/// Least distance of a point before a facet for a reflection, m.
pub(super) const BEFORE_M: f64 = 1e-9;

/// Path folded into the room: antenna, points of reflection, point.
#[derive(Debug, Clone)]
pub(super) struct Folded {
    points: [DVec3; MAX_ORDER + 2],
    count: usize,
    /// Relative field past the edges of inner corners in which the path is reflected to and fro.
    pub past_corners: Kept,
    /// Edges of inner corners beside single reflections, by the place of the reflection in the sequence.
    pub beside_corners: Vec<(usize, PastCorner)>,
}

impl Folded {
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
        self.past_corners.field != Complex64::ONE || !self.beside_corners.is_empty()
    }

    /// Returns whether the path passes all inner corners on the side of their facets.
    pub fn is_within_corners(&self) -> bool {
        self.past_corners.is_whole && !self.beside_corners.iter().any(|(_, past)| past.is_beyond)
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

    /// The path by a sequence if it meets all planes from the front, at any place on them. Within reach of the edge of an
    /// inner corner it may also pass on the other side: it then meets the corner's facets at the edge.
    pub(super) fn folded(&self, sequence: &[FacetId], antenna: DVec3, point: DVec3) -> Option<Folded> {
        let count = sequence.len();
        if count > MAX_ORDER {
            return None;
        }
        let images = self.images_along(sequence, antenna)?;
        let mut points = [point; MAX_ORDER + 2];
        let mut past_corners = Kept { field: Complex64::ONE, is_whole: true };
        let mut beside_corners: Vec<(usize, PastCorner)> = Vec::new();
        let runs = self.runs.of(sequence);
        // Displacements of the path to inner corners, each with the place of the corner's first reflection.
        let mut shifts: Vec<(usize, DVec3)> = Vec::new();
        let mut bent_at = None;
        let mut target = point;
        for (i, &facet) in sequence.iter().enumerate().rev() {
            let flat = self.environment.flat(facet)?;
            let source = images.get(i + 1).copied()?;
            for run in runs.iter().filter(|run| run.last == i) {
                let total_m = images.get(count)?.distance(point);
                let direction = (target - source).normalize_or_zero();
                let line = Leg { from: source, direction, length_m: total_m, before_m: 0.0, total_m };
                let Some(past) = run.past(&line, &self.environment) else { continue };
                if past.part == Complex64::ZERO {
                    continue;
                }
                if run.count == 1 {
                    beside_corners.push((i, past));
                } else {
                    let field = if past.is_behind { 1.0 - past.part } else { past.part };
                    past_corners = past_corners.and(Kept { field, is_whole: past.is_behind });
                }
                if past.is_beyond {
                    shifts.push((run.first, past.shift));
                    bent_at.get_or_insert(i);
                }
            }
            let shift: DVec3 = shifts.iter().map(|(_, shift)| *shift).sum();
            let (over, under) = (flat.height(target + shift), flat.height(source + shift));
            // A path into a corner and back meets both faces in their common edge: one face's point lies in the other's
            // plane.
            let least_m = if i + 1 == count { BEFORE_M } else { -SEAM_M };
            if over <= least_m || under >= -BEFORE_M {
                return None;
            }
            target = target.lerp(source, over / (over - under)) + shift;
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
        if let Some(last) = bent_at.filter(|last| last + 1 < count) {
            // From the corner, the path goes straight to the point.
            let later = sequence.get(last + 1..)?;
            let images = self.images_along(later, *points.get(last + 1)?)?;
            let mut target = point;
            for (i, (&facet, &source)) in later.iter().zip(images.iter().skip(1)).enumerate().rev() {
                let flat = self.environment.flat(facet)?;
                let (over, under) = (flat.height(target), flat.height(source));
                if over <= -SEAM_M || under >= -BEFORE_M {
                    return None;
                }
                target = target.lerp(source, over / (over - under));
                *points.get_mut(last + i + 2)? = target;
            }
        }
        *points.first_mut()? = antenna;
        Some(Folded { points, count: count + 2, past_corners, beside_corners })
    }
}
