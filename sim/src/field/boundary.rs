//! What a surface does to the field that meets it.

use glam::DVec3;
use num_complex::Complex64;

use super::fresnel::{self, Reflection};
use super::{Phasor3, incidence_frame};

/// A surface's electrical nature, for reflection.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Boundary {
    /// Perfect conductor.
    Conductor,
    /// Lossy dielectric, thick enough that nothing returns from behind.
    HalfSpace {
        /// Complex relative permittivity, `eps' - j eps''`.
        permittivity: Complex64,
    },
    /// Lossy dielectric slab in air.
    Slab {
        /// Complex relative permittivity, `eps' - j eps''`.
        permittivity: Complex64,
        /// Thickness, m.
        thickness_m: f64,
    },
}

impl Boundary {
    /// Reflection coefficients at the cosine of the angle of incidence.
    pub fn reflection(&self, wavenumber_per_m: f64, cosine: f64) -> Reflection {
        match *self {
            Boundary::Conductor => Reflection { te: Complex64::from(-1.0), tm: Complex64::from(1.0) },
            Boundary::HalfSpace { permittivity } => fresnel::half_space(permittivity, cosine),
            Boundary::Slab { permittivity, thickness_m } => {
                fresnel::slab(permittivity, thickness_m, wavenumber_per_m, cosine).reflection
            }
        }
    }

    /// Field that leaves the surface and its direction, for a field that meets it along a direction.
    pub fn reflect(
        &self,
        incident: Phasor3,
        direction: DVec3,
        normal: DVec3,
        wavenumber_per_m: f64,
    ) -> (Phasor3, DVec3) {
        let descent = direction.dot(normal);
        let outgoing = direction - normal * (2.0 * descent);
        let coefficients = self.reflection(wavenumber_per_m, descent.abs().min(1.0));
        let (te, tm) = incidence_frame(direction, normal);
        let field = Phasor3::combine(
            coefficients.te * incident.along(te),
            te,
            coefficients.tm * incident.along(tm),
            te.cross(outgoing),
        );
        (field, outgoing)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A conductor's reflected field cancels the incident tangential one, at any angle and polarisation.
    #[test]
    fn no_tangential_field_on_a_conductor() {
        let normal = DVec3::new(0.3, -0.2, 0.9).normalize();
        for direction in [-normal, DVec3::NEG_Z, DVec3::new(0.8, 0.1, -0.5).normalize()] {
            let e = direction.any_orthonormal_vector();
            let incident = Phasor3::combine(Complex64::new(0.3, 0.4), e, Complex64::new(-0.2, 0.9), direction.cross(e));
            let (reflected, outgoing) = Boundary::Conductor.reflect(incident, direction, normal, 1257.0);
            for tangent in [normal.any_orthonormal_vector(), normal.cross(normal.any_orthonormal_vector())] {
                assert!((incident.along(tangent) + reflected.along(tangent)).norm() < 1e-12);
            }
            assert!(reflected.along(outgoing).norm() < 1e-12);
        }
    }
}
