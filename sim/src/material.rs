//! Materials by ITU-R P.2040: `eps' = a f^b`, `sigma = c f^d` (f in GHz), `eps'' = 17.98 sigma / f`.

use num_complex::Complex64;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Name of the material of an absent surface.
pub(super) const OPEN: &str = "open";

/// Building material with constants of the recommendation's table 3, or a metal.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Material {
    /// Concrete.
    Concrete,
    /// Brick; 60 GHz lies outside the table's range (1..40 GHz).
    Brick,
    /// Plasterboard.
    Plasterboard,
    /// Wood.
    Wood,
    /// Glass.
    Glass,
    /// Ceiling board.
    CeilingBoard,
    /// Chipboard.
    Chipboard,
    /// Plywood; 60 GHz lies outside the table's range (1..40 GHz).
    Plywood,
    /// Marble.
    Marble,
    /// Floorboard.
    Floorboard,
    /// Metal, modelled as a perfect conductor.
    Metal,
    /// Absent surface, which reflects nothing.
    Open,
}

/// A material of a scene's own: `permittivity`, or coefficients as the table's.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct OwnMaterial {
    /// Relative permittivity `[real, loss]`: `real - j loss` at whatever frequency.
    pub permittivity: Option<[f64; 2]>,
    /// Coefficients `[a, b, c, d]` of the recommendation.
    pub p2040: Option<[f64; 4]>,
    /// Frequencies at which that holds, GHz. Everywhere if absent.
    pub band_ghz: Option<[f64; 2]>,
}

impl OwnMaterial {
    /// Complex relative permittivity `eps' - j eps''`.
    pub fn permittivity(&self, frequency_hz: f64) -> Complex64 {
        match (self.permittivity, self.p2040) {
            (Some([real, loss]), _) => Complex64::new(real, -loss),
            (None, coefficients) => p2040(coefficients.unwrap_or([1.0, 0.0, 0.0, 0.0]), frequency_hz),
        }
    }
}

fn p2040([a, b, c, d]: [f64; 4], frequency_hz: f64) -> Complex64 {
    let ghz = frequency_hz * 1e-9;
    Complex64::new(a * ghz.powf(b), -17.98 * c * ghz.powf(d) / ghz)
}

impl Material {
    /// Material names used in scene files.
    pub const NAMES: &[&str] = &[
        "concrete",
        "brick",
        "plasterboard",
        "wood",
        "glass",
        "ceiling_board",
        "chipboard",
        "plywood",
        "marble",
        "floorboard",
        "metal",
        "open",
    ];

    /// Returns the material with a given name.
    pub fn named(name: &str) -> Option<Self> {
        use serde::de::IntoDeserializer;
        let name: serde::de::value::StrDeserializer<serde::de::value::Error> = name.into_deserializer();
        Material::deserialize(name).ok()
    }

    /// Row of the table: the frequency band in which its constants hold, GHz, and the coefficients (a, b, c, d), `None`
    /// for a material that is not a dielectric.
    fn row(self) -> ([f64; 2], Option<[f64; 4]>) {
        match self {
            Material::Concrete => ([1.0, 100.0], Some([5.24, 0.0, 0.0462, 0.7822])),
            Material::Brick => ([1.0, 40.0], Some([3.91, 0.0, 0.0238, 0.16])),
            Material::Plasterboard => ([1.0, 100.0], Some([2.73, 0.0, 0.0085, 0.9395])),
            Material::Wood => ([0.001, 100.0], Some([1.99, 0.0, 0.0047, 1.0718])),
            Material::Glass => ([0.1, 100.0], Some([6.31, 0.0, 0.0036, 1.3394])),
            Material::CeilingBoard => ([1.0, 100.0], Some([1.48, 0.0, 0.0011, 1.0750])),
            Material::Chipboard => ([1.0, 100.0], Some([2.58, 0.0, 0.0217, 0.78])),
            Material::Plywood => ([1.0, 40.0], Some([2.71, 0.0, 0.33, 0.0])),
            Material::Marble => ([1.0, 60.0], Some([7.074, 0.0, 0.0055, 0.9262])),
            Material::Floorboard => ([50.0, 100.0], Some([3.66, 0.0, 0.0044, 1.3515])),
            Material::Metal => ([1.0, 100.0], None),
            Material::Open => ([0.0, f64::INFINITY], None),
        }
    }

    /// Frequency band in which the table's constants hold, GHz.
    pub fn band_ghz(self) -> [f64; 2] {
        self.row().0
    }

    /// Complex relative permittivity `eps' - j eps''`; `None` for a material that is not a dielectric.
    pub fn permittivity(self, frequency_hz: f64) -> Option<Complex64> {
        Some(p2040(self.row().1?, frequency_hz))
    }
}

/// Relative permittivity of skin at 60 GHz, `7.98 - j 10.9` (Gabriel's model, as quoted in the literature).
pub const SKIN_PERMITTIVITY: Complex64 = Complex64::new(7.98, -10.9);

#[cfg(test)]
mod tests {
    use super::*;

    /// The error for an unknown name lists the variants.
    #[test]
    fn every_material_is_among_the_names() {
        use serde::de::IntoDeserializer;
        let unknown: serde::de::value::StrDeserializer<serde::de::value::Error> = "?".into_deserializer();
        let said = Material::deserialize(unknown).expect_err("no material").to_string();
        let variants: Vec<&str> = said.split('`').skip(3).step_by(2).collect();
        assert_eq!(variants, Material::NAMES, "{said}");
    }

    /// Columns "eps' @60" and "eps'' @60" of the table as printed for 60 GHz.
    #[test]
    fn table_at_60_ghz() {
        let rows = [
            (Material::Concrete, 5.24, 0.341),
            (Material::Plasterboard, 2.73, 0.119),
            (Material::Wood, 1.99, 0.113),
            (Material::Glass, 6.31, 0.260),
            (Material::CeilingBoard, 1.48, 0.0269),
            (Material::Chipboard, 2.58, 0.159),
            (Material::Marble, 7.07, 0.0731),
            (Material::Floorboard, 3.66, 0.334),
        ];
        for (material, real, imaginary) in rows {
            let eps = material.permittivity(60e9).expect("dielectric");
            assert!((eps.re - real).abs() < 0.006, "{material:?} {eps}");
            assert!((-eps.im / imaginary - 1.0).abs() < 0.005, "{material:?} {eps}");
        }
    }
}
