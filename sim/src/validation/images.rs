//! Multiple reflection between plane faces: images by every sequence of facets, and physical optics over the last
//! facet.
//!
//! The facets, the possible sequences, and the fields after reflections are computed as in scenes ([`crate::paths`]).
//! The part of the last facet that a sequence illuminates is a polygon: the facet clipped by the (mirrored) facets
//! before it, as seen from the last image. Currents are excited by each field of geometrical optics once. The sequences
//! 1-2 and 2-1 of a dihedral are two integrals, and fields scattered by physical optics are not reflected again.
//!
//! Currents radiate to both sides of a facet. Behind it they extinguish the wave that the facet intercepts, so that the
//! facet hides objects behind it from the receiver. It does not hide other facets from the transmitter. Only facets
//! that face away, or lie outside the view through the aperture if there is one, are not illuminated. The method
//! therefore suits corners and cavities, and not rooms with furniture. Every sequence is tried, because the rays that
//! find sequences in scenes are traced in single precision, from near antennas.

use glam::{DMat3, DVec3};

use super::endpoint::{Endpoint, Leg};
use super::facet::{Accuracy, Integral, integrate};
use super::radar::{Radar, transverse};
use crate::em::Phasor3;
use crate::em::image::Wall;
use crate::geometry::{Surface, polygon};
use crate::paths::exhaustive::all_sequences;
use crate::paths::{Environment, EnvironmentError, Facet, FacetId};

/// Distance of the source that represents a radar infinitely far in the tests of facet sequences, m.
const FAR_M: f64 = 1e6;

/// Plane facets of one material in front of a radar.
#[derive(Debug, Clone)]
pub struct Images {
    environment: Environment,
    boundary: Wall,
    radar: Radar,
    sequences: Vec<Sequence>,
}

/// Sequence of facets and the part of the last facet that it illuminates.
#[derive(Debug, Clone)]
pub struct Sequence {
    /// Facets in the order in which the wave meets them.
    pub facets: Vec<FacetId>,
    /// Image of the transmitter by all facets except the last.
    source: Endpoint,
    /// Mirror matrix of the transmitter's vectors.
    mirror: DMat3,
    /// Length that is missing in path lengths to a far source, m.
    missing_m: f64,
    /// The lit part of the last facet.
    lit: Surface,
}

impl Images {
    /// Makes facets from convex polygons of a material, counter-clockwise seen from the reflecting side, and every
    /// illuminated sequence of at most `max_bounces` facets. If there is an `aperture`, a convex polygon, the wave
    /// reaches facets only through it.
    ///
    /// # Errors
    /// If a face is not a plane polygon, or the environment of scenes refuses the faces.
    pub fn new(
        faces: Vec<Vec<DVec3>>,
        aperture: Option<Vec<DVec3>>,
        boundary: Wall,
        radar: Radar,
        wavenumber_per_m: f64,
        max_bounces: usize,
    ) -> Result<Self, EnvironmentError> {
        let facets = faces.into_iter().map(|corners| Facet::new(corners, boundary)).collect();
        let environment = Environment::new(facets, wavenumber_per_m)?;
        let origin = match radar.end {
            Endpoint::Near(antenna) => antenna,
            Endpoint::Far(towards) => towards * FAR_M,
        };
        let sequences = all_sequences(&environment, origin, max_bounces);
        let lit = |facets| Sequence::new(&environment, radar.end, aperture.clone(), facets);
        let sequences = sequences.into_iter().filter_map(lit).collect();
        Ok(Images { environment, boundary, radar, sequences })
    }

    /// The facets.
    pub fn environment(&self) -> &Environment {
        &self.environment
    }

    /// All sequences that illuminate a facet.
    pub fn sequences(&self) -> &[Sequence] {
        &self.sequences
    }

    /// Field scattered to the receiver from the last facet of a sequence.
    pub fn integrate(&self, sequence: &Sequence, accuracy: Accuracy) -> Integral {
        let before = sequence.facets.split_last().map(|(_, before)| before).unwrap_or_default();
        integrate(&sequence.lit, accuracy, |point, normal| {
            let outward = sequence.source.leg(point);
            let outward = Leg { length_m: outward.length_m + sequence.missing_m, ..outward };
            let reflected = |direction| {
                let launched = transverse(sequence.mirror * self.radar.polarisation, direction);
                self.environment.reflected(before, &[], direction, Phasor3::real(launched))
            };
            self.radar.scattered(point, normal, outward, reflected, &self.boundary, accuracy.wavenumber_per_m)
        })
    }
}

impl Sequence {
    /// Computes a sequence; `None` where the last facet is not illuminated, or the sequence is empty.
    fn new(
        environment: &Environment,
        end: Endpoint,
        aperture: Option<Vec<DVec3>>,
        facets: Vec<FacetId>,
    ) -> Option<Self> {
        let (last, before) = facets.split_last()?;
        let (mut source, mut mirror, mut missing_m) = (end, DMat3::IDENTITY, 0.0);
        // Aperture and facets that the wave has passed, in the same mirrored space.
        let mut windows: Vec<Vec<DVec3>> = aperture.into_iter().collect();
        for &facet in before {
            let (corners, normal) = (&environment.facet(facet)?.corners, environment.normal(facet)?);
            let on_plane = *corners.first()?;
            let image = |p: DVec3| p - normal * (2.0 * normal.dot(p - on_plane));
            windows.iter_mut().flatten().for_each(|corner| *corner = image(*corner));
            windows.push(corners.clone());
            if let Endpoint::Far(towards) = source {
                missing_m -= 2.0 * normal.dot(towards) * normal.dot(on_plane);
            }
            source = source.mirrored(on_plane, normal);
            let mirrored = |axis: DVec3| axis - normal * (2.0 * normal.dot(axis));
            mirror = DMat3::from_cols(mirrored(DVec3::X), mirrored(DVec3::Y), mirrored(DVec3::Z)) * mirror;
        }
        let corners = environment.facet(*last)?.corners.clone();
        let lit = windows.iter().fold(corners, |lit, window| through_window(lit, window, &source));
        let lit = fan(&lit, environment.normal(*last)?);
        (!lit.triangles.is_empty()).then_some(Sequence { source, mirror, missing_m, lit, facets })
    }
}

/// Surface of a convex polygon, as a fan of triangles.
fn fan(corners: &[DVec3], normal: DVec3) -> Surface {
    Surface {
        vertices: corners.to_vec(),
        normals: vec![normal; corners.len()],
        triangles: (2..corners.len() as u32).map(|i| [0, i - 1, i]).collect(),
        two_sided: false,
    }
}

/// Clips a convex polygon to the part that an endpoint sees through a convex window.
fn through_window(polygon: Vec<DVec3>, window: &[DVec3], endpoint: &Endpoint) -> Vec<DVec3> {
    let normal = polygon::normal(window);
    let middle = polygon::centroid(window);
    let away = if endpoint.side(middle, normal) > 0.0 { -normal } else { normal };
    let mut visible = polygon::clipped(&polygon, middle, away);
    for [a, b] in polygon::sides(window) {
        let side = (b - a).cross(endpoint.leg(a).towards);
        let inwards = if side.dot(middle - a) < 0.0 { -side } else { side };
        visible = polygon::clipped(&visible, a, inwards);
    }
    visible
}

/// The two square faces of a dihedral whose edge is on the z axis, opening towards +x and +y.
pub fn dihedral(width_m: f64, height_m: f64) -> Vec<Vec<DVec3>> {
    let (low, high) = (-0.5 * height_m, 0.5 * height_m);
    let face = |along: DVec3| {
        vec![DVec3::Z * low, along * width_m + DVec3::Z * low, along * width_m + DVec3::Z * high, DVec3::Z * high]
    };
    // Counter-clockwise from the front: the face along x faces +y, the one along y faces +x.
    let mut along_x = face(DVec3::X);
    along_x.reverse();
    vec![along_x, face(DVec3::Y)]
}

/// Faces of a trihedral with its corner at the origin and its edges on the positive axes: triangles or squares.
pub fn trihedral(edge_m: f64, is_square: bool) -> Vec<Vec<DVec3>> {
    let face = |u: DVec3, v: DVec3| {
        let mut corners = vec![DVec3::ZERO, u * edge_m];
        if is_square {
            corners.push((u + v) * edge_m);
        }
        corners.push(v * edge_m);
        corners
    };
    vec![face(DVec3::X, DVec3::Y), face(DVec3::Y, DVec3::Z), face(DVec3::Z, DVec3::X)]
}

/// Aperture of a rectangular cavity: in the plane x = 0, width along y, height along z.
pub fn aperture(width_m: f64, height_m: f64) -> Vec<DVec3> {
    let (w, h) = (0.5 * width_m, 0.5 * height_m);
    [(-w, -h), (w, -h), (w, h), (-w, h)].iter().map(|&(y, z)| DVec3::new(0.0, y, z)).collect()
}

/// The five inner faces of a rectangular cavity behind its [`aperture`].
pub fn cavity(width_m: f64, height_m: f64, depth_m: f64) -> Vec<Vec<DVec3>> {
    let rim = aperture(width_m, height_m);
    let end: Vec<DVec3> = rim.iter().map(|&corner| corner - DVec3::X * depth_m).collect();
    let side = |i: usize| vec![rim[i], rim[(i + 1) % 4], end[(i + 1) % 4], end[i]];
    (0..4).map(side).chain([end.clone()]).collect()
}

#[cfg(test)]
mod hard_cases {
    use std::sync::Arc;

    use num_complex::Complex64;

    use super::*;
    use crate::paths::{ImagePaths, LaunchOptions};

    const K: f64 = 1_257.507_013_171_009;
    const ACCURACY: Accuracy = Accuracy { wavenumber_per_m: K, tolerance_rad: 0.03 };

    fn images(faces: Vec<Vec<DVec3>>, end: Endpoint, max_bounces: usize) -> Images {
        let radar = Radar { end, polarisation: DVec3::Z };
        Images::new(faces, None, Wall::Conductor, radar, K, max_bounces).expect("plane faces")
    }

    /// Integrals of all sequences of `order` facets.
    fn of_order(images: &Images, order: usize) -> Vec<Complex64> {
        let sequences = images.sequences().iter().filter(|sequence| sequence.facets.len() == order);
        sequences.map(|of| images.integrate(of, ACCURACY)).filter(|i| i.facets > 0).map(|i| i.value).collect()
    }

    /// Both orders carry the same field, each illuminates all of its last face at 45 degrees, and no other sequence has
    /// two bounces.
    #[test]
    fn a_dihedral_has_two_orders_counted_once_each() {
        let far = Endpoint::Far(DVec3::new(1.0, 1.0, 0.0).normalize());
        let found = images(dihedral(0.1, 0.1), far, 4);
        let double = of_order(&found, 2);
        assert_eq!(double.len(), 2);
        for value in &double {
            // The value is area times cosine, without phase, because the corner is the origin.
            assert!((value.norm() - 0.01 * 0.5f64.sqrt()).abs() < 1e-12, "{value}");
        }
        assert!((double[0] - double[1]).norm() < 1e-12);
        assert!(of_order(&found, 3).is_empty() && of_order(&found, 4).is_empty());
    }

    /// A trihedral has six orders of three bounces, whose illuminated polygons together are the aperture of the closed
    /// form.
    #[test]
    fn a_trihedral_has_six_orders() {
        for (is_square, area) in [(false, 0.01 / 3f64.sqrt()), (true, 0.01 * 3f64.sqrt())] {
            let found = images(trihedral(0.1, is_square), Endpoint::Far(DVec3::ONE.normalize()), 6);
            let triple = of_order(&found, 3);
            assert_eq!(triple.len(), 6);
            let sum: Complex64 = triple.iter().sum();
            assert!((sum.norm() / area - 1.0).abs() < 1e-9, "{sum} {area}");
        }
    }

    /// For a radar infinitely far, the sum over all orders does not depend on the corner's position.
    #[test]
    fn a_corner_s_position_does_not_matter_for_a_far_radar() {
        let towards = DVec3::new(0.6, 0.7, 0.4).normalize();
        let sum = |shift: DVec3| -> Complex64 {
            let mut faces = trihedral(0.1, true);
            faces.iter_mut().flatten().for_each(|corner| *corner += shift);
            let found = images(faces, Endpoint::Far(towards), 3);
            found.sequences().iter().map(|sequence| found.integrate(sequence, ACCURACY).value).sum()
        };
        let (original, shifted) = (sum(DVec3::ZERO), sum(DVec3::new(0.31, -0.27, 0.53)));
        assert!((original.norm() / shifted.norm() - 1.0).abs() < 1e-9, "{original} {shifted}");
    }

    /// Rays as launched in scenes find every sequence by which a corner a metre away illuminates more than a twentieth
    /// of a face.
    #[test]
    fn rays_find_the_sequences_of_a_corner() {
        let radar = DVec3::new(0.5, 0.62, 0.55);
        let found = images(trihedral(1.0, true), Endpoint::Near(radar * 1.5), 3);
        let environment = Arc::new(found.environment().clone());
        let options = LaunchOptions { max_order: 3, ..LaunchOptions::default() };
        let by_rays = ImagePaths::discover(environment, radar * 1.5, &options);
        let known: Vec<&Vec<FacetId>> = by_rays.images().iter().flat_map(|image| &image.sequences).collect();
        let lit: Vec<&Sequence> = found.sequences().iter().filter(|of| of.lit.mesh().area_m2() > 0.05).collect();
        assert!(lit.iter().any(|sequence| sequence.facets.len() == 3), "a corner has paths of three reflections");
        for sequence in lit {
            assert!(known.contains(&&sequence.facets), "{:?}", sequence.facets);
        }
    }

    /// The visible part is twice as wide as the window at twice its distance from a near endpoint, and as wide as the
    /// window for a far endpoint.
    #[test]
    fn windows_clip_to_the_right_size() {
        let square = [DVec3::ZERO, DVec3::X, DVec3::new(1.0, 1.0, 0.0), DVec3::Y];
        let window = [0.4, 0.6, 0.6, 0.4].iter().zip([0.4, 0.4, 0.6, 0.6]).map(|(x, y)| DVec3::new(*x, y, 1.0));
        let window: Vec<DVec3> = window.collect();
        let near = through_window(square.to_vec(), &window, &Endpoint::Near(DVec3::new(0.5, 0.5, 2.0)));
        assert!((polygon::area_m2(&near) - 0.16).abs() < 1e-12, "{near:?}");
        let far = through_window(square.to_vec(), &window, &Endpoint::Far(DVec3::Z));
        assert!((polygon::area_m2(&far) - 0.04).abs() < 1e-12);
        // Polygons in front of the window are not seen through it.
        assert!(through_window(square.to_vec(), &window, &Endpoint::Far(-DVec3::Z)).is_empty());
    }
}
