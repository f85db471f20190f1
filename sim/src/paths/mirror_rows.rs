//! Fast test, without rays, of which points an image may light: vectorised over points.

// Loops use lane indices: several rows are accessed together, and the compiler vectorises these loops.
#![allow(clippy::needless_range_loop)]

use glam::DVec3;
use radome_dsp::KernelLevel;

use super::discovery::{ImagePaths, MAX_ORDER};
use super::flat::{Flat, SEAM_M};
use crate::lanes::vector::{Vector, add, dot, scale, subtract};
use crate::lanes::{WIDE, WideRow, WideRow3, compiled_for_levels, wide_lane};

/// Facet as a mirror of one antenna: its plane, the rectangle around it, and the antenna's image by it.
#[derive(Debug, Clone, Copy, Default)]
struct Mirror {
    normal: Vector,
    offset_m: f64,
    axes: [Vector; 2],
    /// Lowest and highest coordinates along the axes, m.
    extent_m: [[f64; 2]; 2],
    /// Position of the antenna's image, m.
    source: Vector,
    /// Distance of the antenna's image behind the plane, m.
    behind_m: f64,
}

impl Mirror {
    fn new(flat: &Flat, source: DVec3) -> Self {
        Mirror {
            normal: flat.normal.to_array(),
            offset_m: flat.offset_m,
            axes: flat.axes.map(|axis| axis.to_array()),
            extent_m: flat.extent_m.map(|corner| corner.to_array()),
            source: source.to_array(),
            behind_m: -flat.height(source),
        }
    }
}

compiled_for_levels! {
    /// Adds 1 in lanes whose points may be lit by these mirrors, in the order of the path.
    fn reflected_rows(mirrors: &[Mirror], points: &WideRow3, out: &mut WideRow) = reflected_rows_body;
}

#[inline(always)]
fn reflected_rows_body(mirrors: &[Mirror], points: &WideRow3, out: &mut WideRow) {
    let (mut targets, mut may_be_lit) = (*points, [1.0; WIDE]);
    for mirror in mirrors.iter().rev() {
        let (low, high) = (mirror.extent_m[0], mirror.extent_m[1]);
        for l in 0..WIDE {
            let target = wide_lane(&targets, l);
            let height_m = dot(mirror.normal, target) - mirror.offset_m;
            let to_source = subtract(mirror.source, target);
            let point = add(target, scale(to_source, height_m / (height_m + mirror.behind_m)));
            let (u, v) = (dot(mirror.axes[0], point), dot(mirror.axes[1], point));
            let is_missed = (height_m < -2.0 * SEAM_M) | (u < low[0]) | (u > high[0]) | (v < low[1]) | (v > high[1]);
            may_be_lit[l] = if is_missed { 0.0 } else { may_be_lit[l] };
            targets[0][l] = point[0];
            targets[1][l] = point[1];
            targets[2][l] = point[2];
        }
    }
    for l in 0..WIDE {
        out[l] += may_be_lit[l];
    }
}

impl ImagePaths {
    /// Adds 1 or more in lanes whose points an image may light. Facets are replaced by the rectangles around them, and
    /// nothing is hidden, so every point for which [`ImagePaths::is_lit`] holds is found.
    pub fn add_reached(
        &self,
        level: KernelLevel,
        image: usize,
        antenna: DVec3,
        points: &[WideRow3],
        out: &mut [WideRow],
    ) {
        let Some(image) = self.images.get(image) else { return };
        for sequence in &image.sequences {
            let Some(images) = self.images_along(sequence, antenna) else { continue };
            let mut mirrors = [Mirror::default(); MAX_ORDER];
            let flats = sequence.iter().filter_map(|&facet| self.environment.flat(facet));
            for ((mirror, flat), &source) in mirrors.iter_mut().zip(flats).zip(&images[1..]) {
                *mirror = Mirror::new(flat, source);
            }
            let Some(mirrors) = mirrors.get(..sequence.len()) else { continue };
            if mirrors.iter().any(|mirror| mirror.behind_m <= 0.0) {
                continue;
            }
            for (points, out) in points.iter().zip(out.iter_mut()) {
                reflected_rows(level, mirrors, points, out);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use glam::DVec2;
    use rand::{Rng, SeedableRng};
    use rand_xoshiro::Xoshiro256PlusPlus;

    use super::super::LaunchOptions;
    use super::super::environment::Environment;
    use super::super::rooms::{extruded, l_shape, sheet, slab};
    use super::*;
    use crate::lanes::tests::assert_same_at_every_level;
    use crate::lanes::vector::store;

    #[test]
    fn every_lit_point_is_found_and_few_others() {
        let options = LaunchOptions { max_order: 2, refinements: 2, max_rays: 20_000 };
        let (mut lit, mut reached, mut all) = (0, 0, 0);
        for seed in 0..6 {
            let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
            let outline = l_shape(&mut rng);
            let mut facets = extruded(&outline, 2.6);
            facets.extend(sheet(DVec2::new(0.35, -0.25), DVec2::new(0.35, -0.25).lerp(outline[0], 0.5), 2.0, slab(2)));
            let environment = Arc::new(Environment::new(facets, 1_257.507).expect("facets"));
            let antenna = DVec3::new(rng.random_range(-0.2..0.2), rng.random_range(-0.2..0.2), 1.3);
            let paths = ImagePaths::discover(environment, antenna, &options);
            let mut points = vec![[[0.0; WIDE]; 3]; 5];
            for point in &mut points {
                for l in 0..WIDE {
                    store(
                        point,
                        l,
                        [rng.random_range(-2.0..2.0), rng.random_range(-2.0..2.0), rng.random_range(0.1..2.5)],
                    );
                }
            }
            for image in 0..paths.images().len() {
                let counts = |level: KernelLevel| {
                    let mut counts = vec![[0.0; WIDE]; points.len()];
                    paths.add_reached(level, image, antenna, &points, &mut counts);
                    counts
                };
                assert_same_at_every_level(counts);
                for (points, counts) in points.iter().zip(counts(KernelLevel::Portable)) {
                    for (l, count) in counts.into_iter().enumerate() {
                        let is_lit = paths.is_lit(image, antenna, DVec3::from_array(wide_lane(points, l)));
                        assert!(!is_lit || count > 0.0, "{seed} {image} {l}");
                        lit += usize::from(is_lit);
                        reached += usize::from(count > 0.0);
                        all += 1;
                    }
                }
            }
        }
        assert!(lit > 300 && reached < 2 * lit && reached < all, "{lit} lit, {reached} reached, {all} in all");
    }
}
