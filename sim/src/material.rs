//! Materials by ITU-R P.2040: `eps' = a f^b`, `sigma = c f^d` (f in GHz), `eps'' = 17.98 sigma / f`.

use num_complex::Complex64;
use schemars::JsonSchema;
use serde::Deserialize;

/// Name of the material of an absent surface.
pub(super) const OPEN: &str = "open";

/// Defines [`Material`] by the rows of a table. A row has the variant, the name in scene files, the frequency band in
/// which the constants hold (GHz), and coefficients `[a, b, c, d]` (`None` for a material that is not a dielectric).
macro_rules! materials {
    ($($variant:ident, $name:literal, $band_ghz:expr, $coefficients:expr;)*) => {
        /// Building material with constants of the recommendation's table 3, or a metal.
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        #[allow(missing_docs, reason = "the table below names each material")]
        pub enum Material {
            $($variant,)*
        }

        impl Material {
            /// Material names used in scene files.
            pub const NAMES: &[&str] = &[$($name,)*];

            /// Returns the material with a given name.
            pub fn named(name: &str) -> Option<Self> {
                match name {
                    $($name => Some(Material::$variant),)*
                    _ => None,
                }
            }

            /// Frequency band in GHz and coefficients.
            fn row(self) -> ([f64; 2], Option<[f64; 4]>) {
                match self {
                    $(Material::$variant => ($band_ghz, $coefficients),)*
                }
            }
        }
    };
}

materials! {
    Concrete, "concrete", [1.0, 100.0], Some([5.24, 0.0, 0.0462, 0.7822]);
    Brick, "brick", [1.0, 40.0], Some([3.91, 0.0, 0.0238, 0.16]);
    Plasterboard, "plasterboard", [1.0, 100.0], Some([2.73, 0.0, 0.0085, 0.9395]);
    Wood, "wood", [0.001, 100.0], Some([1.99, 0.0, 0.0047, 1.0718]);
    Glass, "glass", [0.1, 100.0], Some([6.31, 0.0, 0.0036, 1.3394]);
    CeilingBoard, "ceiling_board", [1.0, 100.0], Some([1.48, 0.0, 0.0011, 1.0750]);
    Chipboard, "chipboard", [1.0, 100.0], Some([2.58, 0.0, 0.0217, 0.78]);
    Plywood, "plywood", [1.0, 40.0], Some([2.71, 0.0, 0.33, 0.0]);
    Marble, "marble", [1.0, 60.0], Some([7.074, 0.0, 0.0055, 0.9262]);
    Floorboard, "floorboard", [50.0, 100.0], Some([3.66, 0.0, 0.0044, 1.3515]);
    // A perfect conductor.
    Metal, "metal", [1.0, 100.0], None;
    // An absent surface, which reflects nothing.
    Open, "open", [0.0, f64::INFINITY], None;
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

/// Permittivity `eps' - j eps''` by the recommendation's coefficients.
fn p2040([a, b, c, d]: [f64; 4], frequency_hz: f64) -> Complex64 {
    let ghz = frequency_hz * 1e-9;
    Complex64::new(a * ghz.powf(b), -17.98 * c * ghz.powf(d) / ghz)
}

impl Material {
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

    #[test]
    fn every_material_is_in_the_documentation() {
        let page = include_str!("../../docs/rooms.md");
        for name in Material::NAMES {
            assert!(page.contains(&format!("`{name}`")), "{name} is not in docs/rooms.md");
        }
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
