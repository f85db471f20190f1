//! Monostatic echo of a surface at rest, computed with the patches of skins.
//!
//! The computation is that of a person at one key time ([`super::skin`]) without motion: the same patches, triangles,
//! integrands and occlusion. Validation applies it to bodies with known cross-sections.

use std::f64::consts::TAU;

use glam::DVec3;
use num_complex::Complex64;

use super::error_budget::IntegrationSettings;
use super::patch_pose::{PatchPose, at_corners};
use super::patch_solver::rules_for;
use super::self_occlusion;
use super::surface_currents::{FieldAround, IntegrandInputs, field_rows, integrands};
use crate::em::Phasor3;
use crate::em::curved_triangle::{Integrator, moments, spans_rad};
use crate::geometry::Surface;
use crate::lanes::{LANES, Row};
use crate::people::skin::{PosedSkin, Skin, SkinPatch};

/// Largest distance of the antenna in the computation of occlusion, m. Farther antennas are moved to it, because
/// occlusion is computed in single precision.
const MAX_OCCLUSION_DISTANCE_M: f64 = 1e3;

/// Closed surface at rest.
#[derive(Debug, Clone)]
pub struct StillSkin {
    skin: Skin,
    posed: PosedSkin,
    /// Mean of the vertices: origin of single-precision coordinates.
    origin: DVec3,
}

/// Antenna that transmits and receives, and settings of the integration of its echo.
pub struct StillView<'a> {
    /// Position, m.
    pub antenna: DVec3,
    /// Field at a point, without spreading and phase.
    pub field: &'a dyn Fn(DVec3) -> Phasor3,
    /// Wavelength, m.
    pub wavelength_m: f64,
    /// Complex relative permittivity of the body, whose real part is no less than 1.
    pub permittivity: Complex64,
    /// Settings of the integration.
    pub settings: IntegrationSettings,
}

impl StillSkin {
    /// Builds the skin of a surface with normals, in which every edge belongs to one triangle or two.
    pub fn new(surface: &Surface) -> Self {
        let (skin, posed) = Skin::still(surface);
        let origin = posed.vertices.iter().sum::<DVec3>() / posed.vertices.len().max(1) as f64;
        StillSkin { skin, posed, origin }
    }

    /// Returns the number of triangles.
    pub fn triangles(&self) -> usize {
        self.skin.rest().triangles.len()
    }

    /// Integrates physical optics over the lit surface near specular points. The integrand is
    /// [`crate::em::current::received`] over the square of the distance, with the phase of the path relative to that by
    /// the middle of the surface.
    pub fn integral(&self, integrator: &Integrator, view: &StillView) -> Complex64 {
        let antenna = self.origin + (view.antenna - self.origin).clamp_length_max(MAX_OCCLUSION_DISTANCE_M);
        let is_queried = vec![true; self.posed.vertices.len()];
        let occlusion = self_occlusion::factors(&self.skin, &self.posed, antenna, view.wavelength_m, &is_queried);
        let mut pose = PatchPose::new(1, integrator);
        self.skin
            .patches()
            .iter()
            .map(|patch| self.patch_integral(integrator, view, patch, &occlusion, &mut pose))
            .sum()
    }

    /// Integrates over one patch. `occlusion` is the factor on the field at each vertex.
    fn patch_integral(
        &self,
        integrator: &Integrator,
        view: &StillView,
        patch: &SkinPatch,
        occlusion: &[f64],
        pose: &mut PatchPose,
    ) -> Complex64 {
        let level = integrator.level;
        pose.pose(level, patch, &self.posed, self.origin, [1.0; LANES], [1.0; LANES]);
        pose.view_from(0, view.antenna, self.origin, view.wavelength_m, level);
        let expansion = FieldAround::new(self.centre(patch), self.origin, view.field);
        let field = field_rows(level, &expansion, &pose.vertices.positions);
        let occlusion = patch.vertices.map(|v| occlusion.get(v as usize).map_or(1.0, |factor| *factor as f32));
        let (re, im) = integrands(
            level,
            &IntegrandInputs {
                vertices: &pose.vertices,
                directions: [&pose.directions[0]; 2],
                fields: [&field; 2],
                obstruction: [&occlusion; 2],
                permittivity: view.permittivity,
                settings: &view.settings,
                factor: 1.0,
            },
        );
        if re.iter().chain(&im).all(|part| *part == 0.0) {
            return Complex64::ZERO;
        }
        let spans = spans_rad(level, [&pose.views[0]; 2]);
        let rules = rules_for(&spans, 0..patch.triangles.len(), view.settings.ease);
        pose.compute_nodes(rules, integrator);
        let view_rows = &pose.views[0];
        let moments = moments(level, pose.nodes(rules), [view_rows; 2]);
        let (re, im) = (at_corners(&re, &patch.corners), at_corners(&im, &patch.corners));
        let middle_m = view.antenna.distance(self.origin);
        let of_triangle = |(l, distance_m): (usize, &f64)| {
            let number = |re: &Row, im: &Row| Complex64::new(re[l].into(), im[l].into());
            let products = (0..3).map(|i| number(&re[i], &im[i]) * number(&moments.re[i], &moments.im[i]));
            let longer_m = 2.0 * (distance_m - middle_m);
            products.sum::<Complex64>() * Complex64::from_polar(1.0, -TAU * longer_m / view.wavelength_m)
        };
        let triangles = view_rows.distances_m.iter().enumerate().take(patch.triangles.len());
        // Integrands contain a factor j, which is removed here.
        -Complex64::I * triangles.map(of_triangle).sum::<Complex64>()
    }

    fn centre(&self, patch: &SkinPatch) -> DVec3 {
        let positions = patch.vertices.iter().filter_map(|&v| self.posed.vertices.get(v as usize));
        positions.sum::<DVec3>() / LANES as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::shape;
    use crate::material::SKIN_PERMITTIVITY;

    #[test]
    fn a_ball_behind_a_larger_one_is_not_seen() {
        let integrator = Integrator::default();
        let towards = DVec3::new(0.8, 0.1, 0.3).normalize();
        let field = |_: DVec3| Phasor3::real(DVec3::Y.reject_from_normalized(towards).normalize());
        let view = |antenna: DVec3| StillView {
            antenna,
            field: &field,
            wavelength_m: 0.005,
            permittivity: SKIN_PERMITTIVITY,
            settings: IntegrationSettings::for_tolerance(0.5),
        };
        let front = shape::icosphere(DVec3::splat(0.2), 24);
        let mut both = front.clone();
        let small = shape::icosphere(DVec3::splat(0.05), 12);
        let first = both.vertices.len() as u32;
        both.vertices.extend(small.vertices.iter().map(|v| *v - towards));
        both.normals.extend(&small.normals);
        both.triangles.extend(small.triangles.iter().map(|t| t.map(|v| first + v)));
        let alone = StillSkin::new(&front);
        let pair = StillSkin::new(&both);
        assert_eq!(pair.triangles(), front.triangles.len() + small.triangles.len());
        for range_m in [4.0, 1e6] {
            let antenna = towards * range_m;
            let of = |skin: &StillSkin| skin.integral(&integrator, &view(antenna)).norm() * range_m * range_m;
            let (one, two) = (of(&alone), of(&pair));
            assert!(one > 1e-5 && (two / one - 1.0).abs() < 1e-3, "{range_m} m: {one} {two}");
        }
    }
}
