//! Diffusely scattering walls of rooms of any shape: the facets that reflect paths from the antenna.

use glam::DVec3;
use rand::Rng;

use super::BEFORE_M;
use super::points::{WallPosition, Walls, mean_power};
use crate::paths::{FacetId, PolygonRoom};

/// Facets with the triangles that cover them.
pub(super) struct FacetWalls<'a> {
    room: &'a PolygonRoom,
    /// Cumulative area including each triangle, m^2, its facet, and its corners, m.
    triangles: Vec<(f64, FacetId, [DVec3; 3])>,
}

impl<'a> FacetWalls<'a> {
    /// Collects the facets of a room that reflect paths; the others contribute little.
    pub fn new(room: &'a PolygonRoom) -> Self {
        let mut triangles = Vec::new();
        let mut area_m2 = 0.0;
        for &facet in room.reached_facets() {
            for [a, b, c] in room.paths().environment().triangles(facet) {
                area_m2 += 0.5 * (b - a).cross(c - a).length();
                triangles.push((area_m2, facet, [a, b, c]));
            }
        }
        FacetWalls { room, triangles }
    }

    /// Makes a point on a facet.
    fn on(&self, facet: FacetId, position: DVec3) -> WallPosition {
        let normal = self.room.paths().environment().normal(facet).unwrap_or(DVec3::Z);
        WallPosition { wall: facet as usize, position, normal }
    }
}

impl Walls for FacetWalls<'_> {
    fn area_m2(&self) -> f64 {
        self.triangles.last().map_or(0.0, |(area_m2, ..)| *area_m2)
    }

    fn point_at(&self, at_m2: f64, rng: &mut impl Rng) -> WallPosition {
        let number = self.triangles.partition_point(|(area_m2, ..)| *area_m2 <= at_m2);
        let Some(&(_, facet, [a, b, c])) = self.triangles.get(number).or(self.triangles.last()) else {
            return self.on(0, DVec3::ZERO);
        };
        let (along, across) = (rng.random::<f64>().sqrt(), rng.random::<f64>());
        self.on(facet, a + (b - a) * (along * (1.0 - across)) + (c - a) * (along * across))
    }

    fn reflected_share(&self, wall: usize, cosine: f64) -> Option<f64> {
        let environment = self.room.paths().environment();
        let wall = environment.facet(wall as FacetId)?.wall;
        Some(mean_power(wall.reflection(environment.wavenumber_per_m(), cosine)))
    }

    fn next_hit(&self, from: &WallPosition, direction: DVec3) -> Option<WallPosition> {
        let environment = self.room.paths().environment();
        let (facet, position) = environment.first_hit(from.position, direction, Some(from.wall as FacetId))?;
        Some(self.on(facet, position))
    }

    fn visibility(&self, antenna: DVec3, point: &WallPosition) -> f64 {
        self.room.paths().field_on_segment([antenna, point.position + point.normal * BEFORE_M], [None; 2])
    }
}

#[cfg(test)]
mod tests {
    use super::super::points::tests::room;
    use super::super::points::{Diffuse, WallPoint, points};
    use super::*;

    /// Facets of a box scatter like the box: the power at a point by path length agrees over many seeds.
    #[test]
    fn facets_of_a_box_scatter_as_its_sides_do() {
        let (of_box, antenna) = room();
        let polygons = PolygonRoom::of_box(&of_box, antenna.position);
        let facets = FacetWalls::new(&polygons);
        let area_m2 = Walls::area_m2(&of_box);
        assert!((facets.area_m2() - area_m2).abs() < 1e-9 * area_m2);
        let diffuse = Diffuse { share: 0.1, points: 64, bounces: 4, mirrored: 2 };
        let receiver = DVec3::new(3.2, 2.1, 1.0);
        let by_length = |of_seed: &dyn Fn(u64) -> Vec<WallPoint>| {
            let mut power = [0.0; 5];
            for point in (0..400).flat_map(of_seed) {
                let leg = receiver - point.position;
                let bin = ((point.antennas.length_m + leg.length()) / 3.0) as usize;
                let cosine = leg.normalize().dot(point.normal).max(0.0);
                if let Some(slot) = power.get_mut(bin) {
                    *slot += point.antennas.tx.norm_sqr() * cosine / leg.length_squared().max(0.01);
                }
            }
            power
        };
        let expected = by_length(&|seed| points(&of_box, diffuse, &antenna, &[], 0.005, seed));
        let found = by_length(&|seed| points(&facets, diffuse, &antenna, &[], 0.005, 10_000 + seed));
        let whole: f64 = expected.iter().sum();
        for (bin, (expected, found)) in expected.iter().zip(&found).enumerate() {
            // Bins of low power have few points.
            if *expected > 0.05 * whole {
                assert!((found / expected - 1.0).abs() < 0.15, "{bin}: {found} {expected}");
            }
        }
        assert!((found.iter().sum::<f64>() / whole - 1.0).abs() < 0.08, "{found:?} {expected:?}");
    }
}
