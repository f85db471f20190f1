//! Images that may illuminate a sphere, and upper bounds of their fields, without rays.

use glam::{DMat3, DVec3};

use super::discovery::{Image, ImagePaths, MAX_ORDER};
use super::environment::FacetId;
use crate::em::image::Element;

/// Cone from an antenna, or its image, to a sphere.
struct Cone {
    antenna: DVec3,
    /// Centre of the sphere, m.
    middle: DVec3,
    /// Radius of the sphere, m.
    reach_m: f64,
}

impl ImagePaths {
    /// Numbers of the images of at most `max_order` reflections that may illuminate points within `reach_m` of
    /// `middle`, ascending. The antenna itself is always included. Facets are replaced by their bounding spheres and
    /// nothing is hidden, so that the result includes all images that illuminate such a point.
    pub fn images_near(&self, antenna: DVec3, middle: DVec3, reach_m: f64, max_order: usize) -> Vec<usize> {
        let cone = Cone { antenna, middle, reach_m };
        let images = self.images.iter().enumerate().take_while(|(_, image)| image.order <= max_order);
        images.filter(|(_, image)| self.image_may_light(image, &cone)).map(|(number, _)| number).collect()
    }

    /// Returns whether an image may illuminate points within `reach_m` of `middle`, as in [`ImagePaths::images_near`].
    pub fn may_light(&self, image: usize, antenna: DVec3, middle: DVec3, reach_m: f64) -> bool {
        let cone = Cone { antenna, middle, reach_m };
        self.images.get(image).is_some_and(|image| self.image_may_light(image, &cone))
    }

    fn image_may_light(&self, image: &Image, cone: &Cone) -> bool {
        image.order == 0 || image.sequences.iter().any(|sequence| self.sequence_may_light(sequence, cone))
    }

    /// Returns whether waves that a sequence of facets reflects may enter the sphere of a cone.
    fn sequence_may_light(&self, sequence: &[FacetId], cone: &Cone) -> bool {
        let &Cone { antenna, middle, reach_m } = cone;
        let Some(images) = self.images_along(sequence, antenna) else { return false };
        let length_m = middle.distance(images[sequence.len().min(MAX_ORDER)]);
        if length_m <= reach_m {
            return true;
        }
        // Diffraction beside a facet extends over the first Fresnel zones at most.
        let wavelength_m = self.environment.wavelength_m();
        let diffraction_m = self.environment.edge_reach() * 0.5 * (0.5 * wavelength_m * (length_m + reach_m)).sqrt();
        // A path beyond the edge of an inner corner goes by the edge.
        let corner_m = if self.runs.of(sequence).is_empty() { 0.0 } else { diffraction_m };
        let cone_sine = reach_m / length_m;
        let cone_cosine = (1.0 - cone_sine * cone_sine).sqrt();
        // Radius of the cone about the point of reflection, in the plane of the facet.
        let (mut target, mut radius_m) = (middle, reach_m + corner_m);
        for (&facet, &source) in sequence.iter().zip(images.iter().skip(1)).rev() {
            let Some(flat) = self.environment.flat(facet) else { return false };
            let (target_height, source_height) = (flat.height(target), flat.height(source));
            if source_height >= 0.0 || target_height <= -radius_m {
                return false;
            }
            if target_height <= radius_m {
                return true;
            }
            let offset = target - source;
            let cosine = (flat.normal.dot(offset) / offset.length()).abs().min(1.0);
            // Least cosine of incidence of any path in the cone.
            let least_cosine = cosine * cone_cosine - (1.0 - cosine * cosine).sqrt() * cone_sine;
            if least_cosine <= 0.02 {
                return true;
            }
            target = target.lerp(source, target_height / (target_height - source_height));
            radius_m = (target.distance(source) * cone_sine + corner_m) / least_cosine;
            if flat.is_far(target, radius_m + diffraction_m / least_cosine) {
                return false;
            }
        }
        true
    }

    /// Largest factor by which edges increase a field: those of a small mirror, of the size of a first Fresnel zone,
    /// double it.
    pub fn most_by_edges(&self) -> f64 {
        if self.environment.diffracting_edges().is_empty() { 1.0 } else { 2.0 }
    }

    /// Upper bound of the magnitude of an image's field at all points within an angle of a direction from it, for
    /// unobstructed paths and infinite facets.
    pub fn most_free_field(&self, element: &Element, image: usize, direction: DVec3, spread_rad: f64) -> f64 {
        let Some(image) = self.images.get(image) else { return 0.0 };
        let departure = element.radar_from_world * (image.mirror.transpose() * direction);
        let reflections = image.sequences.iter().map(|s| self.most_reflections(s, direction, spread_rad));
        element.pattern.most_within(departure, spread_rad) * reflections.fold(0.0, f64::max)
    }

    /// Upper bound of the product of a sequence's reflections.
    fn most_reflections(&self, sequence: &[FacetId], direction: DVec3, spread_rad: f64) -> f64 {
        let (mut most, mut later) = (1.0, DMat3::IDENTITY);
        for flat in sequence.iter().rev().filter_map(|&facet| self.environment.flat(facet)) {
            let cosine = direction.dot(later * flat.normal).abs();
            let [te, tm] = flat.table.most_reflection(cosine - spread_rad, cosine + spread_rad);
            most *= te.max(tm);
            later *= flat.mirror();
        }
        most
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
    use super::super::rooms::{extruded, l_shape, sheet, slab, star};
    use super::*;
    use crate::em::pattern::Pattern;

    #[test]
    fn images_that_are_left_out_light_nothing() {
        let options = LaunchOptions { max_order: 2, refinements: 2, max_rays: 20_000 };
        let (mut kept, mut all, mut lit) = (0, 0, 0);
        for seed in 0..20 {
            let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
            let outline = if seed < 12 { l_shape(&mut rng) } else { star(&mut rng) };
            let mut facets = extruded(&outline, 2.6);
            facets.extend(sheet(DVec2::new(0.35, -0.25), DVec2::new(0.35, -0.25).lerp(outline[0], 0.5), 2.0, slab(2)));
            let environment = Arc::new(Environment::new(facets, 1_257.507).expect("facets"));
            let antenna = Element {
                position: DVec3::new(rng.random_range(-0.2..0.2), rng.random_range(-0.2..0.2), 1.3),
                polarisation: DVec3::Z,
                radar_from_world: DMat3::from_rotation_z(0.4),
                pattern: Pattern::new(1.0, 1.2, -20.0),
            };
            let paths = ImagePaths::discover(environment, antenna.position, &options);
            for _ in 0..6 {
                let middle = DVec3::new(rng.random_range(-2.0..2.0), rng.random_range(-2.0..2.0), 1.0);
                let reach_m = rng.random_range(0.05..0.6);
                let near = paths.images_near(antenna.position, middle, reach_m, 2);
                all += paths.images().len();
                kept += near.len();
                for image in 0..paths.images().len() {
                    let offset = middle - paths.images()[image].of(antenna.position);
                    let spread_rad = (reach_m / offset.length()).min(1.0).asin();
                    let free = paths.most_free_field(&antenna, image, offset.normalize(), spread_rad);
                    for _ in 0..8 {
                        let aside = DVec3::from_array(std::array::from_fn(|_| rng.random_range(-1.0..1.0)));
                        let point = middle + aside.clamp_length_max(1.0) * reach_m;
                        let field = paths.illuminate(&antenna, image, point).field.magnitude();
                        assert!(field == 0.0 || near.contains(&image), "{seed} {image} {middle} {reach_m}: {field}");
                        let relative = paths.obstruction(image, antenna.position, point, None).bound();
                        let relative = relative.min(paths.most_by_edges());
                        assert!(field <= free * relative + 1e-9, "{seed} {image}: {field} {free} {relative}");
                        lit += usize::from(field > 0.0);
                    }
                }
            }
        }
        assert!(lit > 100 && kept < all, "{lit} lit, {kept} of {all} kept");
    }
}
