//! Physical-optics currents that a field excites on a surface, and the field they produce at an antenna.

use glam::DVec3;
use num_complex::Complex64;

use super::Phasor3;
use super::wall::Wall;

/// Wave incident on a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Arrival {
    /// Electric field.
    pub field: Phasor3,
    /// Unit vector along which the wave travels.
    pub direction: DVec3,
}

/// Integrand of physical optics at a point: half of `p . [eta (J - s (s . J)) + M x s]` with `J = n x (H_i + H_r)` and
/// `M = -n x (E_i + E_r)`.
///
/// The received field is `-jk/(2 pi)` times the integral over the surface, with spreading and phase. For a conductor in
/// the monostatic case, the integrand is the cosine of the angle of incidence. `towards` is the unit vector from the
/// surface to the receiving antenna. The antenna's polarisation at the surface is complex behind a lossy wall.
pub fn received(
    arrival: &Arrival,
    normal: DVec3,
    boundary: &Wall,
    wavenumber_per_m: f64,
    towards: DVec3,
    polarisation: Phasor3,
) -> Complex64 {
    let s = towards;
    let p =
        Phasor3 { re: polarisation.re - s * s.dot(polarisation.re), im: polarisation.im - s * s.dot(polarisation.im) };
    let magnetic = arrival.field.crossed_by(arrival.direction);
    if *boundary == Wall::Conductor {
        return magnetic.crossed_by(normal).received_by(p);
    }
    let (reflected, outgoing) = boundary.reflect(arrival.field, arrival.direction, normal, wavenumber_per_m);
    let electric_current = (magnetic + reflected.crossed_by(outgoing)).crossed_by(normal);
    let magnetic_current = (arrival.field + reflected).crossed_by(normal);
    // p . (M x s) = M . (s x p), and M has a negative sign.
    0.5 * (electric_current.received_by(p) - magnetic_current.received_by(p.crossed_by(s)))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Monostatic case: the cosine for a conductor, and minus the reflection coefficient times the cosine for anything
    /// else at normal incidence.
    #[test]
    fn backscatter_is_the_cosine_times_reflection() {
        let towards = DVec3::new(0.5, 0.3, 0.8).normalize();
        let polarisation = Phasor3::real(towards.any_orthonormal_vector());
        let arrival = Arrival { field: polarisation, direction: -towards };
        let conductor = received(&arrival, DVec3::Z, &Wall::Conductor, 1257.0, towards, polarisation);
        assert!((conductor - towards.z).norm() < 1e-12);
        let permittivity = Complex64::new(7.98, -10.9);
        let skin = Wall::HalfSpace { permittivity };
        let back = received(&arrival, towards, &skin, 1257.0, towards, polarisation);
        let index = permittivity.sqrt();
        assert!((back + (1.0 - index) / (1.0 + index)).norm() < 1e-12);
    }

    #[test]
    fn a_conductor_is_the_limit_of_dielectrics() {
        let direction = DVec3::new(0.6, 0.1, -0.5).normalize();
        let field = Phasor3::combine(
            Complex64::new(0.2, 0.5),
            direction.any_orthonormal_vector(),
            Complex64::new(-0.7, 0.1),
            direction.cross(direction.any_orthonormal_vector()),
        );
        let arrival = Arrival { field, direction };
        let (towards, polarisation) = (DVec3::new(-0.2, 0.5, 0.7).normalize(), Phasor3::real(DVec3::Y));
        let of = |wall: Wall| received(&arrival, DVec3::Z, &wall, 1257.0, towards, polarisation);
        let almost = Wall::HalfSpace { permittivity: Complex64::new(1.0, -1e12) };
        assert!((of(almost) - of(Wall::Conductor)).norm() < 1e-5);
    }
}
