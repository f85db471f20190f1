//! Antenna patterns: separable `cos^q` from the half-power beamwidths, with a floor for side and back lobes.

use glam::DVec3;

use crate::lanes;

/// One-way field pattern of one element, in the radar's frame: x boresight, y left, z up.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pattern {
    azimuth_exponent: f64,
    elevation_exponent: f64,
    floor_power: f64,
}

impl Pattern {
    /// Builds a pattern from one-way half-power beamwidths, rad, and a floor relative to boresight, dB.
    pub fn new(azimuth_beamwidth_rad: f64, elevation_beamwidth_rad: f64, floor_db: f64) -> Self {
        let exponent = |beamwidth: f64| 0.5f64.ln() / (0.5 * beamwidth).cos().ln();
        Pattern {
            azimuth_exponent: exponent(azimuth_beamwidth_rad),
            elevation_exponent: exponent(elevation_beamwidth_rad),
            floor_power: 10f64.powf(0.1 * floor_db),
        }
    }

    /// Returns the isotropic pattern.
    pub fn isotropic() -> Self {
        Pattern { azimuth_exponent: 0.0, elevation_exponent: 0.0, floor_power: 1.0 }
    }

    /// Returns the field relative to boresight for a unit direction away from the antenna.
    pub fn field(&self, direction_radar: DVec3) -> f64 {
        let DVec3 { x, y, .. } = direction_radar;
        let lobe = if x > 0.0 {
            // `(x / h)^azimuth h^elevation` with the horizontal part h, in one exponential.
            let horizontal = 0.5 * (x * x + y * y).max(f64::MIN_POSITIVE).ln();
            (self.azimuth_exponent * (x.ln() - horizontal) + self.elevation_exponent * horizontal).exp()
        } else {
            0.0
        };
        (self.floor_power + (1.0 - self.floor_power) * lobe).sqrt()
    }

    /// Returns the same field from the forward and left components of the direction, for loops over lanes.
    #[inline(always)]
    pub(crate) fn field_in_lane(&self, x: f64, y: f64) -> f64 {
        let horizontal = 0.5 * lanes::ln((x * x + y * y).max(f64::MIN_POSITIVE));
        let forward = lanes::ln(x.max(f64::MIN_POSITIVE));
        let lobe = lanes::exp(self.azimuth_exponent * (forward - horizontal) + self.elevation_exponent * horizontal);
        let lobe = if x > 0.0 { lobe } else { 0.0 };
        (self.floor_power + (1.0 - self.floor_power) * lobe).sqrt()
    }

    /// Returns an upper bound of the field over all directions within an angle of a unit direction.
    pub fn most_within(&self, direction_radar: DVec3, spread_rad: f64) -> f64 {
        let DVec3 { x, y, z } = direction_radar;
        let (sine, cosine) = spread_rad.sin_cos();
        let horizontal = (x * x + y * y).sqrt();
        // Azimuths in the cone differ from its own by at most asin(sine / horizontal). Where that does not exist, the
        // cone contains the pole.
        if cosine <= 0.0 || horizontal <= sine {
            return 1.0;
        }
        // Largest cosines of elevation and azimuth in the cone.
        let elevation_cosine = if z.abs() <= sine { 1.0 } else { (horizontal * cosine + z.abs() * sine).min(1.0) };
        let turn_sine = sine / horizontal;
        let [forward, aside] = [x, y.abs()].map(|component| component / horizontal);
        let turn_cosine = (1.0 - turn_sine * turn_sine).sqrt();
        let azimuth_cosine = if forward >= turn_cosine { 1.0 } else { forward * turn_cosine + aside * turn_sine };
        let [azimuth, elevation] =
            [azimuth_cosine, elevation_cosine].map(|cosine| lanes::ln(cosine.max(f64::MIN_POSITIVE)));
        let lobe = lanes::exp(self.azimuth_exponent * azimuth + self.elevation_exponent * elevation);
        (self.floor_power + (1.0 - self.floor_power) * lobe).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn half_power_at_half_the_beamwidth_in_both_planes() {
        let (azimuth, elevation) = (30.5f64.to_radians(), 60.5f64.to_radians());
        let pattern = Pattern::new(azimuth, elevation, -200.0);
        let (s, c) = (0.5 * azimuth).sin_cos();
        assert!((pattern.field(DVec3::new(c, s, 0.0)).powi(2) - 0.5).abs() < 1e-12);
        let (s, c) = (0.5 * elevation).sin_cos();
        assert!((pattern.field(DVec3::new(c, 0.0, s)).powi(2) - 0.5).abs() < 1e-12);
        assert!((pattern.field(DVec3::X) - 1.0).abs() < 1e-12);
        assert!(pattern.field(-DVec3::X) < 1e-9);
    }

    #[test]
    fn lanes_have_the_same_field() {
        for pattern in [Pattern::new(0.5, 1.1, -20.0), Pattern::new(1.9, 0.4, -200.0), Pattern::isotropic()] {
            for i in 0..500 {
                let (azimuth, elevation) = (0.0131 * f64::from(i) - 3.2, 0.0062 * f64::from(i) - 1.55);
                let z = elevation.sin();
                let (x, y) = (azimuth.cos() * elevation.cos(), azimuth.sin() * elevation.cos());
                let field = pattern.field(DVec3::new(x, y, z));
                assert!((pattern.field_in_lane(x, y) - field).abs() < 1e-12 * field.max(1e-3), "{x} {y}");
            }
        }
        let pattern = Pattern::new(0.5, 1.1, -20.0);
        for (x, y) in [(0.0, 0.0), (0.0, 1.0), (1e-310, 1.0), (-1.0, 0.0)] {
            let field = pattern.field(DVec3::new(x, y, 0.0));
            assert!((pattern.field_in_lane(x, y) - field).abs() < 1e-12, "{x} {y}");
        }
    }

    #[test]
    fn bounds_of_a_cone_hold_in_it() {
        let pattern = Pattern::new(0.5, 1.1, -20.0);
        let at = |azimuth: f64, elevation: f64| {
            DVec3::new(azimuth.cos() * elevation.cos(), azimuth.sin() * elevation.cos(), elevation.sin())
        };
        for i in 0..400 {
            let middle = at(0.016 * f64::from(i) - 3.1, 3.0 * f64::from(i % 37) / 37.0 - 1.5);
            assert!((pattern.most_within(middle, 0.0) - pattern.field(middle)).abs() < 1e-9);
            let (u, v) = middle.any_orthonormal_pair();
            for spread in [0.01f64, 0.1, 0.4, 1.3] {
                let most = pattern.most_within(middle, spread);
                for k in 0..64 {
                    let (sine, cosine) = (0.1 * f64::from(k)).sin_cos();
                    let (aside, along) = (spread * f64::from(k % 8) / 7.0).sin_cos();
                    let inside = middle * along + (u * cosine + v * sine) * aside;
                    assert!(pattern.field(inside) <= most + 1e-9, "{middle} {spread}: {inside}");
                }
            }
        }
    }
}
