//! Electromagnetic fields: reflection at slabs, antennas and their images, specular points on ellipsoids, physical
//! optics over triangles.
//!
//! Convention `e^{+jwt}`, propagation `e^{-jkR}`, permittivity `eps' - j eps''`. Amplitudes hold every coefficient of a
//! path except the propagation phase.

pub mod current;
pub mod curved_triangle;
pub mod fresnel;
pub mod image;
pub mod pattern;
pub mod quadrature;
pub mod specular;
pub(crate) mod specular_rows;
pub mod triangle;
pub mod wall;

use glam::DVec3;
use num_complex::Complex64;

/// Phasor of a field: a complex 3-vector.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Phasor3 {
    /// Real part.
    pub re: DVec3,
    /// Imaginary part.
    pub im: DVec3,
}

impl Phasor3 {
    /// Creates a phasor with zero imaginary part.
    pub fn real(re: DVec3) -> Self {
        Phasor3 { re, im: DVec3::ZERO }
    }

    /// Returns the component along a real vector, without conjugation.
    pub fn along(self, v: DVec3) -> Complex64 {
        Complex64::new(self.re.dot(v), self.im.dot(v))
    }

    /// Returns the signal of this field in an antenna with a receive vector: their scalar product, without conjugation.
    pub fn received_by(self, antenna: Phasor3) -> Complex64 {
        Complex64::new(
            self.re.dot(antenna.re) - self.im.dot(antenna.im),
            self.re.dot(antenna.im) + self.im.dot(antenna.re),
        )
    }

    /// Returns the sum of two real directions with complex weights.
    pub fn combine(a: Complex64, u: DVec3, b: Complex64, v: DVec3) -> Self {
        Phasor3 { re: u * a.re + v * b.re, im: u * a.im + v * b.im }
    }

    /// Returns the phasor times a real factor.
    pub fn scaled(self, factor: f64) -> Self {
        Phasor3 { re: self.re * factor, im: self.im * factor }
    }

    /// Returns the phasor times a complex factor.
    pub fn times(self, factor: Complex64) -> Self {
        Phasor3 { re: self.re * factor.re - self.im * factor.im, im: self.re * factor.im + self.im * factor.re }
    }

    /// Returns the vector product of a real vector and this one, in this order.
    pub fn crossed_by(self, a: DVec3) -> Self {
        Phasor3 { re: a.cross(self.re), im: a.cross(self.im) }
    }

    /// Returns the Euclidean length of real and imaginary part together.
    pub fn magnitude(self) -> f64 {
        (self.re.length_squared() + self.im.length_squared()).sqrt()
    }
}

impl std::ops::Add for Phasor3 {
    type Output = Phasor3;

    fn add(self, other: Phasor3) -> Phasor3 {
        Phasor3 { re: self.re + other.re, im: self.im + other.im }
    }
}

/// Returns unit vectors TE (normal to the plane of incidence) and TM (`TE x direction`) of a wave incident on a surface
/// with this normal. At normal incidence, where the plane of incidence is undefined, they are any tangent pair.
pub fn incidence_frame(direction: DVec3, normal: DVec3) -> (DVec3, DVec3) {
    let cross = direction.cross(normal);
    let te = if cross.length_squared() < 1e-12 { direction.any_orthonormal_vector() } else { cross.normalize() };
    (te, te.cross(direction))
}
