//! Wall coefficients in closed form, and tabulated over the cosine of incidence.
//!
//! [`fresnel::slab`] evaluates complex roots and exponentials, and an image path needs it at every wall. [`WallTable`]
//! divides the range of the cosine into cells, and each cell into as many equal pieces as accuracy requires. A piece is
//! a polynomial of degree five through Chebyshev points, within 1e-8 of the slab at all check points. Thin walls take
//! one piece a cell; walls many wavelengths thick take more. Cells that would take too many are not tabulated, and
//! coefficients there are computed in closed form. Examples are foils at grazing incidence and thick walls without
//! loss.

use std::f64::consts::PI;
use std::sync::Arc;

use glam::DVec3;
use num_complex::Complex64;

use super::fresnel::{self, Coefficients};
use super::{Phasor3, incidence_frame};

/// Type of a wall or another surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Wall {
    /// Lossy dielectric slab.
    Slab {
        /// Complex relative permittivity.
        permittivity: Complex64,
        /// Thickness, m.
        thickness_m: f64,
    },
    /// Lossy dielectric, thick enough that nothing returns from behind.
    HalfSpace {
        /// Complex relative permittivity, `eps' - j eps''`.
        permittivity: Complex64,
    },
    /// Perfect conductor.
    Conductor,
    /// No surface.
    Open,
}

/// Least depth over which a wall takes effect, m. Otherwise the field would step between two chirps when a person
/// passes.
const LEAST_DEPTH_M: f64 = 0.1;

impl Wall {
    /// Returns the reflection at the cosine of the angle of incidence, in closed form.
    pub fn reflection(&self, wavenumber_per_m: f64, cosine: f64) -> Coefficients {
        match *self {
            Wall::Slab { permittivity, thickness_m } => {
                fresnel::slab(permittivity, thickness_m, wavenumber_per_m, cosine).reflection
            }
            Wall::HalfSpace { permittivity } => fresnel::half_space(permittivity, cosine),
            Wall::Conductor => Coefficients { te: Complex64::from(-1.0), tm: Complex64::from(1.0) },
            Wall::Open => Coefficients { te: Complex64::ZERO, tm: Complex64::ZERO },
        }
    }

    /// Returns the factor of the wall on a field that passes straight through, relative to air.
    pub fn transmission(&self, wavenumber_per_m: f64, cosine: f64) -> Coefficients {
        match *self {
            Wall::Slab { permittivity, thickness_m } => {
                fresnel::straight_through(permittivity, thickness_m, wavenumber_per_m, cosine)
            }
            Wall::HalfSpace { .. } | Wall::Conductor => Coefficients { te: Complex64::ZERO, tm: Complex64::ZERO },
            Wall::Open => Coefficients { te: Complex64::ONE, tm: Complex64::ONE },
        }
    }

    /// Returns the reflected field and its direction, for a field incident along a direction.
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

    /// Returns the distance beyond the wall's inner face over which its effect increases from none to full, m. It is
    /// the wall's thickness, but at least a length that a body needs several chirps to pass.
    pub(super) fn depth_m(&self) -> f64 {
        match *self {
            Wall::Slab { thickness_m, .. } => thickness_m.max(LEAST_DEPTH_M),
            Wall::HalfSpace { .. } | Wall::Conductor | Wall::Open => LEAST_DEPTH_M,
        }
    }
}

/// Number of cells over the cosine's range from 0 to 1.
const CELLS: usize = 64;
/// Largest number of pieces of a cell.
const MOST_PIECES: usize = 64;
/// Number of polynomial coefficients.
const NODES: usize = 6;
/// Largest absolute error of a piece at its check points.
const TOLERANCE: f64 = 1e-8;
/// Check points of a piece, from -1 to 1: where the error of an interpolation by six points is largest.
const CHECKS: [f64; 7] = [-1.0, -0.866, -0.5, 0.0, 0.5, 0.866, 1.0];

/// Margin of a bound on magnitudes: the factor by which they may exceed those at the check points, or 1 by rounding.
const MARGIN: f64 = 1.01;

/// Real and imaginary parts of the coefficients of both polarisations: `[te.re, te.im, tm.re, tm.im]`.
type Parts = [f64; 4];

fn parts(Coefficients { te, tm }: Coefficients) -> Parts {
    [te.re, te.im, tm.re, tm.im]
}

/// Polynomial over -1..1, as coefficients by power.
type Piece = [Parts; NODES];

/// Cell of a curve.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Cell {
    /// Index of the first of its pieces.
    first: usize,
    /// Number of its pieces; 0 where the curve is not tabulated.
    count: usize,
    /// Upper bounds of the magnitudes, TE and TM.
    most: [f64; 2],
}

/// Coefficients of both polarisations over the cosine of incidence.
#[derive(Debug, Clone, PartialEq)]
struct Curve {
    cells: Vec<Cell>,
    pieces: Vec<Piece>,
}

impl Curve {
    /// Tabulates a function of the cosine.
    fn new(exact: impl Fn(f64) -> Parts) -> Self {
        let mut curve = Curve { cells: Vec::with_capacity(CELLS), pieces: Vec::with_capacity(CELLS) };
        for cell in 0..CELLS {
            let first = curve.pieces.len();
            let mut count = 1;
            let pieces = loop {
                let fitted = fit(&exact, cell, count);
                if fitted.is_some() || count == MOST_PIECES {
                    break fitted.unwrap_or_default();
                }
                count *= 2;
            };
            let most = if pieces.is_empty() { [MARGIN; 2] } else { max_magnitudes(&pieces) };
            curve.cells.push(Cell { first, count: pieces.len(), most });
            curve.pieces.extend(pieces);
        }
        curve
    }

    /// Returns the coefficients at a cosine; `None` where they are not tabulated.
    #[inline(always)]
    fn at(&self, cosine: f64) -> Option<Coefficients> {
        let in_cells = cosine * CELLS as f64;
        // NaN and values out of range map to the first or the last cell.
        let cell = (in_cells as usize).min(CELLS - 1);
        let &Cell { first, count, .. } = self.cells.get(cell)?;
        let in_pieces = (in_cells - cell as f64) * count as f64;
        let piece = (in_pieces as usize).min(count.checked_sub(1)?);
        let x = 2.0 * (in_pieces - piece as f64) - 1.0;
        let [te_re, te_im, tm_re, tm_im] = value(self.pieces.get(first + piece)?, x);
        Some(Coefficients { te: Complex64::new(te_re, te_im), tm: Complex64::new(tm_re, tm_im) })
    }
}

/// Fits a cell by `count` pieces; `None` if their error is too large.
fn fit(exact: &impl Fn(f64) -> Parts, cell: usize, count: usize) -> Option<Vec<Piece>> {
    let half = 0.5 / (CELLS * count) as f64;
    let mut pieces = Vec::with_capacity(count);
    for i in 0..count {
        let middle = cell as f64 / CELLS as f64 + (2 * i + 1) as f64 * half;
        let piece = interpolated(|x| exact(middle + half * x));
        let is_wrong = |&x: &f64| {
            let (fitted, exact) = (value(&piece, x), exact(middle + half * x));
            fitted.iter().zip(exact).any(|(fitted, exact)| (fitted - exact).abs() > TOLERANCE / 2.0)
        };
        if CHECKS.iter().any(is_wrong) {
            return None;
        }
        pieces.push(piece);
    }
    Some(pieces)
}

/// Returns the polynomial through a function's values at the Chebyshev points of -1..1.
fn interpolated(function: impl Fn(f64) -> Parts) -> Piece {
    /// Coefficients of the Chebyshev polynomials, in columns, by powers.
    const POWERS: [[f64; NODES]; NODES] = [
        [1.0, 0.0, -1.0, 0.0, 1.0, 0.0],
        [0.0, 1.0, 0.0, -3.0, 0.0, 5.0],
        [0.0, 0.0, 2.0, 0.0, -8.0, 0.0],
        [0.0, 0.0, 0.0, 4.0, 0.0, -20.0],
        [0.0, 0.0, 0.0, 0.0, 8.0, 0.0],
        [0.0, 0.0, 0.0, 0.0, 0.0, 16.0],
    ];
    let angles: [f64; NODES] = std::array::from_fn(|i| PI * (i as f64 + 0.5) / NODES as f64);
    let values = angles.map(|angle| function(angle.cos()));
    let mut by_degree = [[0.0; 4]; NODES];
    for (degree, sums) in by_degree.iter_mut().enumerate() {
        let scale = if degree == 0 { 1.0 } else { 2.0 };
        for (angle, value) in angles.iter().zip(&values) {
            let weight = scale / NODES as f64 * (degree as f64 * angle).cos();
            sums.iter_mut().zip(value).for_each(|(sum, value)| *sum += weight * value);
        }
    }
    POWERS.map(|row| {
        let mut power = [0.0; 4];
        for (weight, degree) in row.iter().zip(&by_degree) {
            power.iter_mut().zip(degree).for_each(|(power, degree)| *power += weight * degree);
        }
        power
    })
}

/// Value of a polynomial.
#[inline(always)]
fn value(piece: &Piece, x: f64) -> Parts {
    let mut sum = piece[NODES - 1];
    for power in piece.iter().rev().skip(1) {
        for (sum, power) in sum.iter_mut().zip(power) {
            *sum = *sum * x + power;
        }
    }
    sum
}

/// Returns the largest magnitudes of both polarisations over pieces, with a margin for values between the check points.
fn max_magnitudes(pieces: &[Piece]) -> [f64; 2] {
    let mut most = [0.0f64; 2];
    for [te_re, te_im, tm_re, tm_im] in pieces.iter().flat_map(|piece| CHECKS.map(|x| value(piece, x))) {
        most = [most[0].max(te_re.hypot(te_im)), most[1].max(tm_re.hypot(tm_im))];
    }
    most.map(|most| MARGIN * most)
}

/// Coefficients of a wall at one wave number, over the cosine of the angle of incidence.
#[derive(Debug, Clone, PartialEq)]
pub struct WallTable {
    wall: Wall,
    wavenumber_per_m: f64,
    /// Factor on the fields that the wall reflects specularly and transmits: the rest is scattered diffusely.
    specular_factor: f64,
    reflection: Option<Curve>,
    transmission: Option<Curve>,
}

impl WallTable {
    /// Tabulates a wall's reflection and, if `transmission` is set, its transmission. The wall scatters a share of the
    /// incident power in all directions; it reflects and transmits the rest as a smooth one. So no wall returns more
    /// power than it receives, and a metal one returns all.
    pub fn new(wall: Wall, wavenumber_per_m: f64, transmission: bool, diffuse_share: f64) -> Self {
        let is_slab = matches!(wall, Wall::Slab { .. });
        // An opening does not scatter.
        let specular_factor = if wall == Wall::Open { 1.0 } else { (1.0 - diffuse_share).max(0.0).sqrt() };
        let reflection = is_slab
            .then(|| Curve::new(|cosine| parts(wall.reflection(wavenumber_per_m, cosine).times(specular_factor))));
        let transmission = (is_slab && transmission)
            .then(|| Curve::new(|cosine| parts(wall.transmission(wavenumber_per_m, cosine).times(specular_factor))));
        WallTable { wall, wavenumber_per_m, specular_factor, reflection, transmission }
    }

    /// Returns the reflection at the cosine of the angle of incidence.
    #[inline(always)]
    pub fn reflection(&self, cosine: f64) -> Coefficients {
        let tabulated = self.reflection.as_ref().and_then(|curve| curve.at(cosine));
        tabulated.unwrap_or_else(|| self.wall.reflection(self.wavenumber_per_m, cosine).times(self.specular_factor))
    }

    /// Returns the factor of the wall on a field that passes straight through, relative to air.
    #[inline(always)]
    pub fn transmission(&self, cosine: f64) -> Coefficients {
        let tabulated = self.transmission.as_ref().and_then(|curve| curve.at(cosine));
        tabulated.unwrap_or_else(|| self.wall.transmission(self.wavenumber_per_m, cosine).times(self.specular_factor))
    }

    /// Returns upper bounds of the magnitudes of the reflection, TE and TM, over cosines from `low` to `high`.
    pub fn most_reflection(&self, low: f64, high: f64) -> [f64; 2] {
        let Some(curve) = &self.reflection else {
            return if self.wall == Wall::Open { [0.0; 2] } else { [self.specular_factor; 2] };
        };
        let cell = |cosine: f64| ((cosine.max(0.0) * CELLS as f64) as usize).min(CELLS - 1);
        let cells = curve.cells.get(cell(low)..=cell(high)).unwrap_or_default();
        cells.iter().fold([0.0; 2], |[te, tm], cell| [te.max(cell.most[0]), tm.max(cell.most[1])])
    }
}

/// Tables of walls at one wave number; equal walls share a table.
pub(crate) struct WallTables {
    pub(crate) wavenumber_per_m: f64,
    transmission: bool,
    diffuse_share: f64,
    tables: Vec<Arc<WallTable>>,
}

impl WallTables {
    /// Creates an empty set of tables, with transmissions if `transmission` is set, of walls that scatter a share of
    /// the incident power.
    pub(crate) fn new(wavenumber_per_m: f64, transmission: bool, diffuse_share: f64) -> Self {
        WallTables { wavenumber_per_m, transmission, diffuse_share, tables: Vec::new() }
    }

    /// Returns the table of a wall, which is made if there is none yet.
    pub(crate) fn of(&mut self, wall: Wall) -> Arc<WallTable> {
        if let Some(table) = self.tables.iter().find(|table| table.wall == wall) {
            return Arc::clone(table);
        }
        let table = Arc::new(WallTable::new(wall, self.wavenumber_per_m, self.transmission, self.diffuse_share));
        self.tables.push(Arc::clone(&table));
        table
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::material::Material;

    const K: f64 = 1_257.507_013_171_009;

    fn slabs() -> impl Iterator<Item = Wall> {
        let own = [Complex64::new(2.0, 0.0), Complex64::new(1.1, -1e-3), Complex64::new(9.0, -1e-4)];
        let known = Material::NAMES.iter().filter_map(|name| Material::named(name)?.permittivity(60e9));
        let all: Vec<Complex64> = known.chain(own).collect();
        all.into_iter().flat_map(|permittivity| {
            let thicknesses = [0.001, 0.003, 0.006, 0.0125, 0.02, 0.04, 0.1, 0.2, 0.3];
            thicknesses.map(|thickness_m| Wall::Slab { permittivity, thickness_m })
        })
    }

    fn difference(a: Coefficients, b: Coefficients) -> f64 {
        (a.te - b.te).norm().max((a.tm - b.tm).norm())
    }

    /// Covers all materials, 1 mm to 0.3 m, between all nodes and at both ends. The error is far below the 1e-4 that
    /// levels need.
    #[test]
    fn tables_are_the_slab() {
        for wall in slabs() {
            let table = WallTable::new(wall, K, true, 0.0);
            let mut worst = 0f64;
            for i in 0..=3001 {
                let cosine = f64::from(i) / 3001.0;
                worst = worst.max(difference(table.reflection(cosine), wall.reflection(K, cosine)));
                worst = worst.max(difference(table.transmission(cosine), wall.transmission(K, cosine)));
            }
            assert!(worst < 5e-8, "{wall:?}: {worst:e}");
        }
    }

    #[test]
    fn bounds_of_a_range_hold_in_it() {
        for wall in slabs() {
            let table = WallTable::new(wall, K, false, 0.0);
            for i in 0..=500 {
                let cosine = f64::from(i) / 500.0;
                let Coefficients { te, tm } = wall.reflection(K, cosine);
                for spread in [0.0, 0.003, 0.1, 2.0] {
                    let most = table.most_reflection(cosine - spread, cosine + spread);
                    assert!(te.norm() <= most[0] && tm.norm() <= most[1], "{wall:?} {cosine} {spread}");
                }
            }
        }
        let thin = Wall::Slab { permittivity: Complex64::new(2.73, -0.119), thickness_m: 0.001 };
        let most = WallTable::new(thin, K, false, 0.0).most_reflection(0.5, 0.5);
        assert!(most[0] < 1.1 * thin.reflection(K, 0.5).te.norm());
    }

    /// A scattering wall reflects and transmits the power that it does not scatter in the same proportions as a smooth
    /// wall, with a table or without one. A metal wall returns all power, and no wall returns more than it receives.
    #[test]
    fn walls_conserve_power() {
        const SHARE: f64 = 0.16;
        let untabulated = Wall::Slab { permittivity: Complex64::new(2.25, 0.0), thickness_m: 10.0 };
        for wall in slabs().chain([untabulated, Wall::Conductor, Wall::Open]) {
            let [smooth, rough] = [0.0, SHARE].map(|share| WallTable::new(wall, K, true, share));
            let share = if wall == Wall::Open { 0.0 } else { SHARE };
            for cosine in [0.01, 0.2, 0.5, 0.9, 1.0] {
                let coefficients = |table: &WallTable| [table.reflection(cosine), table.transmission(cosine)];
                let (of_smooth, of_rough) = (coefficients(&smooth), coefficients(&rough));
                for (smooth, rough) in of_smooth.iter().zip(&of_rough) {
                    assert!((rough.te.norm_sqr() - (1.0 - share) * smooth.te.norm_sqr()).abs() < 1e-6, "{wall:?}");
                    assert!((rough.tm.norm_sqr() - (1.0 - share) * smooth.tm.norm_sqr()).abs() < 1e-6, "{wall:?}");
                }
                let [te, tm] = [of_rough.map(|c| c.te.norm_sqr()), of_rough.map(|c| c.tm.norm_sqr())];
                for out in [te, tm].map(|powers| powers.iter().sum::<f64>() + share) {
                    assert!(out < 1.0 + 1e-6, "{wall:?} at {cosine}: {out}");
                    assert!(wall != Wall::Conductor || out > 1.0 - 1e-12, "{out}");
                }
                let most = rough.most_reflection(cosine, cosine);
                assert!(of_rough[0].te.norm() <= most[0] && of_rough[0].tm.norm() <= most[1], "{wall:?} {cosine}");
            }
        }
    }

    mod hard_cases {
        use super::*;

        /// Values outside the table are computed from the slab itself; no cosine, however wrong, causes a panic.
        #[test]
        fn foils_thick_glass_and_odd_cosines_are_those_of_the_slab() {
            let lossless = Complex64::new(2.25, 0.0);
            for thickness_m in [0.0, 1e-12, 1e-6, 3.0, 10.0] {
                let wall = Wall::Slab { permittivity: lossless, thickness_m };
                let table = WallTable::new(wall, K, true, 0.0);
                for cosine in [0.0, 1e-9, 1e-6, 1e-3, 0.1, 0.777, 1.0 - 1e-9, 1.0] {
                    assert!(
                        difference(table.reflection(cosine), wall.reflection(K, cosine)) < 1e-7,
                        "{wall:?} {cosine}"
                    );
                    let through = difference(table.transmission(cosine), wall.transmission(K, cosine));
                    assert!(through < 1e-7, "{wall:?} {cosine}");
                }
                for cosine in [1.0 + 1e-12, -1e-12, f64::NAN, f64::INFINITY, -3.0] {
                    table.reflection(cosine);
                    table.most_reflection(cosine, cosine + 0.1);
                }
            }
        }

        #[test]
        fn conductors_and_openings_need_no_table() {
            for wall in [Wall::Conductor, Wall::Open] {
                let table = WallTable::new(wall, K, true, 0.0);
                assert_eq!(table.reflection(0.3), wall.reflection(K, 0.3));
                assert_eq!(table.transmission(0.3), wall.transmission(K, 0.3));
                assert_eq!(table.most_reflection(0.0, 1.0), [wall.reflection(K, 1.0).te.norm(); 2]);
            }
        }
    }

    #[test]
    fn no_tangential_field_on_a_conductor() {
        let normal = DVec3::new(0.3, -0.2, 0.9).normalize();
        for direction in [-normal, DVec3::NEG_Z, DVec3::new(0.8, 0.1, -0.5).normalize()] {
            let e = direction.any_orthonormal_vector();
            let incident = Phasor3::combine(Complex64::new(0.3, 0.4), e, Complex64::new(-0.2, 0.9), direction.cross(e));
            let (reflected, outgoing) = Wall::Conductor.reflect(incident, direction, normal, 1257.0);
            for tangent in [normal.any_orthonormal_vector(), normal.cross(normal.any_orthonormal_vector())] {
                assert!((incident.along(tangent) + reflected.along(tangent)).norm() < 1e-12);
            }
            assert!(reflected.along(outgoing).norm() < 1e-12);
        }
    }
}
