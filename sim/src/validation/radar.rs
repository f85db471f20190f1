//! Radar: an antenna that transmits and receives, and the contribution of a surface element to its echo.

use glam::DVec3;
use num_complex::Complex64;

use super::endpoint::{Endpoint, Leg};
use super::facet::Sample;
use crate::em::Phasor3;
use crate::em::current::{Arrival, received};
use crate::em::image::Wall;

/// Antenna that transmits and receives, with a field of unit strength in every direction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Radar {
    /// Endpoint of its paths.
    pub end: Endpoint,
    /// Polarisation, unit vector.
    pub polarisation: DVec3,
}

/// Unit polarisation perpendicular to a direction of travel, as close as possible to the antenna's own.
pub fn transverse(polarisation: DVec3, direction: DVec3) -> DVec3 {
    (polarisation - direction * direction.dot(polarisation)).normalize_or(direction.any_orthonormal_vector())
}

impl Radar {
    /// Integrand of physical optics at a surface point. A two-sided sheet is turned towards the radar.
    #[inline]
    pub fn sample(
        &self,
        point: DVec3,
        normal: DVec3,
        two_sided: bool,
        boundary: &Wall,
        wavenumber_per_m: f64,
    ) -> Sample {
        let outward = self.end.leg(point);
        let cosine = normal.dot(outward.towards);
        if *boundary == Wall::Conductor {
            // Simplified form of the vector expression for a conductor and one antenna.
            let cosine = if two_sided { cosine.abs() } else { cosine };
            let amplitude = Complex64::from(cosine.max(0.0) * outward.spreading * outward.spreading);
            let (length_m, gradient) = (2.0 * outward.length_m, -2.0 * outward.towards);
            return Sample { length_m, gradient, amplitude, lit: cosine > 0.0 };
        }
        let normal = if two_sided && cosine < 0.0 { -normal } else { normal };
        let launched = |direction| Phasor3::real(transverse(self.polarisation, direction));
        self.scattered(point, normal, outward, launched, boundary, wavenumber_per_m)
    }

    /// Integrand at a surface point to which the wave of the radar, or of its image, travels by the leg `outward`.
    /// `arriving` is the field that arrives there in a direction. Currents also radiate behind the surface, where they
    /// extinguish the wave.
    pub fn scattered(
        &self,
        point: DVec3,
        normal: DVec3,
        outward: Leg,
        arriving: impl FnOnce(DVec3) -> Phasor3,
        boundary: &Wall,
        wavenumber_per_m: f64,
    ) -> Sample {
        let back = self.end.leg(point);
        let (length_m, gradient) = (outward.length_m + back.length_m, -(outward.towards + back.towards));
        let lit = normal.dot(outward.towards) > 0.0;
        if !lit {
            return Sample { length_m, gradient, amplitude: Complex64::ZERO, lit };
        }
        let direction = -outward.towards;
        let arrival = Arrival { field: arriving(direction), direction };
        let polarisation = Phasor3::real(transverse(self.polarisation, back.towards));
        let amplitude = received(&arrival, normal, boundary, wavenumber_per_m, back.towards, polarisation);
        Sample { length_m, gradient, amplitude: amplitude * (outward.spreading * back.spreading), lit }
    }
}
