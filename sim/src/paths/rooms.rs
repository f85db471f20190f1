//! Rooms for tests.

use glam::{DVec2, DVec3};
use num_complex::Complex64;
use rand::Rng;

use super::environment::Facet;
use crate::em::image::Wall;
use crate::geometry::polygon::sides;

/// Slab of plasterboard, brick or concrete, by number.
pub(super) fn slab(number: usize) -> Wall {
    let (re, im, thickness_m) = [(2.73, -0.12, 0.0125), (3.91, -0.02, 0.11), (5.24, -0.34, 0.2)][number % 3];
    Wall::Slab { permittivity: Complex64::new(re, im), thickness_m }
}

/// Room over a counter-clockwise outline: its walls, then floor and ceiling.
pub(super) fn extruded(outline: &[DVec2], height_m: f64) -> Vec<Facet> {
    let mut facets: Vec<Facet> = sides(outline)
        .enumerate()
        .map(|(i, [a, b])| {
            let corners = [b.extend(0.0), a.extend(0.0), a.extend(height_m), b.extend(height_m)];
            Facet::new(corners.to_vec(), slab(i))
        })
        .collect();
    facets.push(Facet::new(outline.iter().map(|p| p.extend(0.0)).collect(), slab(0)));
    facets.push(Facet::new(outline.iter().rev().map(|p| p.extend(height_m)).collect(), slab(1)));
    facets
}

/// Both sides of a thin wall over a line on the floor plan.
pub(super) fn sheet(from: DVec2, to: DVec2, height_m: f64, wall: Wall) -> [Facet; 2] {
    let corners = vec![from.extend(0.0), to.extend(0.0), to.extend(height_m), from.extend(height_m)];
    let back: Vec<DVec3> = corners.iter().rev().copied().collect();
    [Facet::new(corners, wall), Facet::new(back, wall)]
}

/// Outline of 4 to 9 corners that all see the origin.
pub(super) fn star(rng: &mut impl Rng) -> Vec<DVec2> {
    let corners = rng.random_range(4..10usize);
    (0..corners)
        .map(|i| {
            let angle = std::f64::consts::TAU * (i as f64 + rng.random_range(-0.3..0.3)) / corners as f64;
            DVec2::from_angle(angle) * rng.random_range(2.0..5.0)
        })
        .collect()
}

/// L-shaped outline whose inner corner lies 0.3 to 1.5 m up and to the left of the origin.
pub(super) fn l_shape(rng: &mut impl Rng) -> Vec<DVec2> {
    let [left, right, low, high]: [f64; 4] = std::array::from_fn(|_| rng.random_range(2.0..5.0));
    let (x, y) = (rng.random_range(-1.5..-0.3), rng.random_range(0.3..1.5));
    [[-left, -low], [right, -low], [right, high], [x, high], [x, y], [-left, y]].map(DVec2::from_array).to_vec()
}
