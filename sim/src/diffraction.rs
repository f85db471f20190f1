//! Diffraction by people. A person is modelled as an upright column. Knife-edge diffraction (approximation of ITU-R
//! P.526) attenuates each leg of a path near the column. The loss is smooth in the clearance, so a path never switches
//! off within a frame.
//!
//! Where a scene requests it, static paths are diffracted by both sides and the top of the column ([`past_strip`]), in
//! amplitude and phase. The field past an absorbing rectangle is 1 minus a product of two Fresnel integrals over it
//! (double knife edge).

use glam::{DVec2, DVec3};
use num_complex::Complex64;
use radome_dsp::KernelLevel;

use crate::lanes::vector::{dot, subtract};
use crate::lanes::{WIDE, WideRow, WideRow3, compiled_for_levels, wide_lane};
use crate::math::{smooth_ramp, smooth_step};

/// Upright obstacle standing on the floor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Column {
    /// x coordinate of the axis, m.
    pub x: f64,
    /// y coordinate of the axis, m.
    pub y: f64,
    /// Radius, m.
    pub radius_m: f64,
    /// Height, m.
    pub height_m: f64,
}

/// Largest distance on the floor plan from a leg to a column's side at which the column affects the leg, m.
pub const REACH_M: f64 = 0.5;
/// Half of the range of losses over which the knife edge's onset is rounded, dB.
const ONSET_DB: f64 = 3.0;

/// Clearance, as Fresnel's parameter, from which a leg suffers no loss.
const CLEAR_NU: f64 = 1.32;

/// Field behind a knife edge relative to free space: ITU-R P.526 `J(nu) = 6.9 + 20 log10(sqrt((nu - 0.1)^2 + 1) + nu -
/// 0.1)` dB. That formula begins at `nu = -0.78` with a corner. The corner is rounded here where `J` is within 3 dB of
/// zero: the loss is zero below `nu = -1.24` and half a decibel at the corner.
pub fn knife_edge(nu: f64) -> f64 {
    let x = nu - 0.1;
    // The factor is 10^(-6.9/20); the remaining term inverts the logarithm.
    let field = 0.451_855_944_374_922_4 / ((x * x + 1.0).sqrt() + x);
    // The rounding extends over 3 dB on either side.
    if field < 0.708 {
        return field;
    }
    if field > 1.413 {
        return 1.0;
    }
    let loss_db = -20.0 * field.log10();
    10f64.powf(-0.05 * ONSET_DB * smooth_ramp(loss_db / ONSET_DB))
}

/// Geometry of a column near a straight leg.
struct LegGeometry {
    /// Distance of the axis from the leg on the floor plan, m.
    axis_m: f64,
    /// Height of the leg at the point nearest to the axis, m.
    height_m: f64,
    /// Square of Fresnel's parameter for one metre of clearance at that point, 1/m^2.
    square_nu_per_m2: f64,
}

impl LegGeometry {
    /// Computes the geometry; `None` where the column is too far away to matter.
    fn new(a: DVec3, b: DVec3, column: &Column, wavelength_m: f64) -> Option<Self> {
        let (ax, ay) = (a.x - column.x, a.y - column.y);
        let (dx, dy) = (b.x - a.x, b.y - a.y);
        let plan_square_m2 = dx * dx + dy * dy;
        // Most columns are far from the whole line; this test avoids a division and a root for them.
        let (cross, reach_m) = (ax * dy - ay * dx, column.radius_m + REACH_M);
        if cross * cross > reach_m * reach_m * plan_square_m2 {
            return None;
        }
        let fraction =
            if plan_square_m2 > 1e-12 { (-(ax * dx + ay * dy) / plan_square_m2).clamp(0.0, 1.0) } else { 0.5 };
        let square = (ax + fraction * dx).powi(2) + (ay + fraction * dy).powi(2);
        if square > reach_m * reach_m {
            return None;
        }
        let (axis_m, length) = (square.sqrt(), (b - a).length());
        let (d1, d2) = ((fraction * length).max(0.05), ((1.0 - fraction) * length).max(0.05));
        Some(LegGeometry {
            axis_m,
            height_m: a.z + fraction * (b.z - a.z),
            square_nu_per_m2: 2.0 * (d1 + d2) / (wavelength_m * d1 * d2),
        })
    }
}

/// Relative field on the straight leg from `a` to `b` past a column.
pub fn past(a: DVec3, b: DVec3, column: &Column, wavelength_m: f64) -> f64 {
    let Some(beside) = LegGeometry::new(a, b, column, wavelength_m) else { return 1.0 };
    let clearance = (beside.axis_m - column.radius_m).max(beside.height_m - column.height_m);
    if clearance > 0.0 && clearance * clearance * beside.square_nu_per_m2 > CLEAR_NU * CLEAR_NU {
        return 1.0;
    }
    knife_edge(-clearance * beside.square_nu_per_m2.sqrt())
}

compiled_for_levels! {
    /// Computes Fresnel's diffraction parameter of a column for a row of straight legs; minus infinity where the column
    /// is too far away to matter.
    fn fresnel_parameter_rows(
        from: &WideRow3,
        to: &WideRow3,
        column: &Column,
        wavelength_m: f64,
        nu: &mut WideRow,
    ) = fresnel_parameter_body;
}

#[inline(always)]
fn fresnel_parameter_body(from: &WideRow3, to: &WideRow3, column: &Column, wavelength_m: f64, nu: &mut WideRow) {
    let reach_m = column.radius_m + REACH_M;
    for (l, nu) in nu.iter_mut().enumerate() {
        let (a, b) = (wide_lane(from, l), wide_lane(to, l));
        let (ax, ay) = (a[0] - column.x, a[1] - column.y);
        let leg = subtract(b, a);
        let plan_square_m2 = leg[0] * leg[0] + leg[1] * leg[1];
        let along = -(ax * leg[0] + ay * leg[1]) / plan_square_m2;
        let along = if along > 0.0 { along } else { 0.0 };
        let along = if along < 1.0 { along } else { 1.0 };
        let fraction = if plan_square_m2 > 1e-12 { along } else { 0.5 };
        let (x, y) = (ax + fraction * leg[0], ay + fraction * leg[1]);
        let (square, length_m) = (x * x + y * y, dot(leg, leg).sqrt());
        let (d1, d2) = (fraction * length_m, (1.0 - fraction) * length_m);
        let d1 = if d1 > 0.05 { d1 } else { 0.05 };
        let d2 = if d2 > 0.05 { d2 } else { 0.05 };
        let square_nu_per_m2 = 2.0 * (d1 + d2) / (wavelength_m * d1 * d2);
        let (aside_m, above_m) = (square.sqrt() - column.radius_m, a[2] + fraction * leg[2] - column.height_m);
        let clearance_m = if aside_m > above_m { aside_m } else { above_m };
        let is_near = square <= reach_m * reach_m;
        *nu = if is_near { -clearance_m * square_nu_per_m2.sqrt() } else { f64::NEG_INFINITY };
    }
}

/// Multiplies the fields of a row of straight legs by the relative field past a column ([`past`]).
pub(crate) fn attenuate_rows(
    level: KernelLevel,
    from: &WideRow3,
    to: &WideRow3,
    column: &Column,
    wavelength_m: f64,
    fields: &mut WideRow,
) {
    let mut nu = [0.0; WIDE];
    fresnel_parameter_rows(level, from, to, column, wavelength_m, &mut nu);
    for (field, nu) in fields.iter_mut().zip(nu).filter(|(_, nu)| *nu >= -CLEAR_NU) {
        *field *= knife_edge(nu);
    }
}

/// `exp(-j pi square/2)` to three millionths, for a number that is not negative: best polynomials for the half angle,
/// then angle doubling.
pub fn fresnel_phasor(square: f64) -> Complex64 {
    let turns = 0.25 * square;
    let y = turns - (turns + 0.5).floor();
    let z = y * y;
    let sine = y * (3.141_582 + z * (-5.167_143 + z * (2.541_899 - z * 0.554_636_2)));
    let cosine = 1.0 + z * (-4.934_793 + z * (4.058_412 + z * (-1.331_880_2 + z * 0.219_696_8)));
    Complex64::new(1.0 - 2.0 * sine * sine, -2.0 * sine * cosine)
}

/// Relative field past a half-plane whose edge lies `nu` beyond the leg: 1 far from the edge in the open, 0 far behind
/// it, 1/2 at the edge. It is `(1 + j)/2 int_{-inf}^nu exp(-j pi t^2/2) dt`, with the auxiliary functions of Abramowitz
/// and Stegun, Handbook of Mathematical Functions, 7.3.32 and 7.3.33, to 0.003.
pub fn half_plane(nu: f64) -> Complex64 {
    let x = nu.abs();
    let f = (1.0 + 0.926 * x) / (2.0 + x * (1.792 + 3.104 * x));
    let g = 1.0 / (2.0 + x * (4.142 + x * (3.492 + 6.670 * x)));
    let diffracted = Complex64::new(0.5, 0.5) * Complex64::new(g, -f) * fresnel_phasor(x * x);
    if nu > 0.0 { 1.0 - diffracted } else { diffracted }
}

/// Relative field (`e^{+jwt}`) on the straight leg from `a` to `b` past a column, modelled as an upright absorbing
/// strip on the floor. Both sides and the top diffract, beside the column as well as behind it. The diffraction by the
/// sides fades out towards [`REACH_M`] beside the column.
pub fn past_strip(a: DVec3, b: DVec3, column: &Column, wavelength_m: f64) -> Complex64 {
    let Some(LegGeometry { axis_m, height_m, square_nu_per_m2 }) = LegGeometry::new(a, b, column, wavelength_m) else {
        return Complex64::ONE;
    };
    let nu_per_m = square_nu_per_m2.sqrt();
    let covered = |low_m: f64, high_m: f64| half_plane(high_m * nu_per_m) - half_plane(low_m * nu_per_m);
    let across = covered(axis_m - column.radius_m, axis_m + column.radius_m);
    let upright = covered(-height_m, column.height_m - height_m);
    let fade = 1.0 - smooth_step(2.0 * (axis_m - column.radius_m) / REACH_M - 1.0);
    1.0 - across * upright * fade
}

/// Returns whether a column that moves by up to `moved_m` may come near a folded path. If false, the column has no
/// effect on the field of the path.
pub fn may_affect(polyline: &[DVec3], column: &Column, moved_m: f64) -> bool {
    let axis = DVec2::new(column.x, column.y);
    let reach_m = column.radius_m + REACH_M + moved_m;
    polyline.windows(2).any(|leg| {
        let (from, vector) = (leg[0].truncate(), (leg[1] - leg[0]).truncate());
        let square = vector.length_squared();
        let fraction = if square > 1e-12 { ((axis - from).dot(vector) / square).clamp(0.0, 1.0) } else { 0.5 };
        (from + fraction * vector).distance_squared(axis) <= reach_m * reach_m
    })
}

/// Iterates over all pairs of a leg of a folded path and a column.
fn leg_column_pairs<'a>(polyline: &[DVec3], columns: &'a [Column]) -> impl Iterator<Item = (DVec3, DVec3, &'a Column)> {
    polyline.array_windows::<2>().flat_map(move |&[a, b]| columns.iter().map(move |column| (a, b, column)))
}

/// Relative field on a folded path past columns: the product over all legs and columns ([`past`]).
pub fn past_columns(polyline: &[DVec3], columns: &[Column], wavelength_m: f64) -> f64 {
    leg_column_pairs(polyline, columns).map(|(a, b, column)| past(a, b, column, wavelength_m)).product()
}

/// Relative field on a folded path past columns that are modelled as strips ([`past_strip`]).
pub fn past_strips(polyline: &[DVec3], columns: &[Column], wavelength_m: f64) -> Complex64 {
    leg_column_pairs(polyline, columns).map(|(a, b, column)| past_strip(a, b, column, wavelength_m)).product()
}

#[cfg(test)]
mod tests {
    use rand::Rng;

    use super::*;
    use crate::lanes::vector::store;
    use crate::random::{Purpose, generator};

    /// `(1 + j)/2 int exp(-j pi t^2/2)` between two bounds, by the midpoint rule.
    fn integral(from: f64, to: f64) -> Complex64 {
        let steps = 20_000;
        let step = (to - from) / f64::from(steps);
        let at = |i: i32| {
            let t = from + (f64::from(i) + 0.5) * step;
            Complex64::from_polar(step, -0.5 * std::f64::consts::PI * t * t)
        };
        Complex64::new(0.5, 0.5) * (0..steps).map(at).sum::<Complex64>()
    }

    #[test]
    fn waves_turn_with_the_square_of_the_distance() {
        for i in 0..40_000 {
            let square = f64::from(i) * 0.0137;
            let exact = Complex64::from_polar(1.0, -0.5 * std::f64::consts::PI * square);
            assert!((fresnel_phasor(square) - exact).norm() < 4e-6, "{square}");
        }
    }

    #[test]
    fn half_planes_are_fresnels_integral() {
        assert!((half_plane(0.0) - 0.5).norm() < 1e-12);
        assert!((half_plane(40.0) - 1.0).norm() < 0.01 && half_plane(-40.0).norm() < 0.01);
        for nu in [-6.0, -2.3, -1.0, -0.2, 0.3, 0.9, 1.7, 3.3, 8.0] {
            let expected = 0.5 + integral(0.0, nu);
            assert!((half_plane(nu) - expected).norm() < 0.005, "{nu}: {} {expected}", half_plane(nu));
        }
        // Overshoot beside an edge: 1.17 of the free field at nu = 1.22.
        assert!((half_plane(1.217).norm() - 1.17).abs() < 0.01);
    }

    #[test]
    fn out_of_reach_nothing_is_lost() {
        let polyline = [DVec3::new(0.0, 0.0, 1.0), DVec3::new(4.0, 1.0, 1.5), DVec3::new(4.0, 1.0, 3.0)];
        let mut near = 0;
        for i in 0..2000 {
            let (x, y) = (f64::from(i % 50) * 0.1, f64::from(i / 50) * 0.1 - 1.5);
            let column = Column { x, y, radius_m: 0.18, height_m: 1.75 };
            let left = past_strips(&polyline, &[column], 0.005);
            near += usize::from(may_affect(&polyline, &column, 0.0));
            assert!(may_affect(&polyline, &column, 0.0) || left == Complex64::ONE, "{x} {y}: {left}");
            // The column is as near as it was before it moved.
            let moved = Column { x: x + 0.1, ..column };
            assert!(may_affect(&polyline, &column, 0.1) || !may_affect(&polyline, &moved, 0.0), "{x} {y}");
        }
        assert!((400..1600).contains(&near), "{near}");
    }

    #[test]
    fn a_strip_is_dark_behind_and_rings_beside() {
        let column = |y| Column { x: 2.0, y, radius_m: 0.18, height_m: 1.75 };
        let (a, b) = (DVec3::new(0.0, 0.0, 1.0), DVec3::new(4.0, 0.0, 1.0));
        assert!(past_strip(a, b, &column(0.0), 0.005).norm() < 0.25);
        assert_eq!(past_strip(a, b, &column(0.8), 0.005), Complex64::ONE);
        let beside: Vec<Complex64> =
            (0..200).map(|i| past_strip(a, b, &column(0.22 + 0.001 * f64::from(i)), 0.005)).collect();
        let most = beside.iter().map(|field| (field - 1.0).norm()).fold(0.0, f64::max);
        assert!(most > 0.05 && beside.iter().all(|field| field.norm() < 1.3), "{most}");
        let turned = beside.iter().map(|field| field.arg()).fold([0.0f64; 2], |[l, h], arg| [l.min(arg), h.max(arg)]);
        assert!(turned[0] < -0.02 && turned[1] > 0.02, "{turned:?}");
        // The field has no step where a person comes near, nor between two chirps anywhere.
        let mut last = past_strip(a, b, &column(0.7), 0.005);
        for i in 0..7000 {
            let now = past_strip(a, b, &column(0.7 - 1e-4 * f64::from(i)), 0.005);
            assert!((now - last).norm() < 0.02, "{i}: {now} {last}");
            last = now;
        }
        let high = DVec3::new(0.0, 0.0, 3.5);
        assert!((past_strip(high, DVec3::new(4.0, 0.0, 3.5), &column(0.0), 0.005) - 1.0).norm() < 0.05);
    }

    /// At grazing incidence half the field remains (-6 dB), far from the edge nothing is lost, and deep in the shadow
    /// the field is about `1/(2.2 nu)`.
    #[test]
    fn knife_edge_has_its_textbook_values() {
        assert!((20.0 * knife_edge(0.0).log10() + 6.02).abs() < 0.1);
        assert_eq!(knife_edge(-2.0), 1.0);
        assert_eq!(knife_edge(-CLEAR_NU), 1.0);
        assert!((20.0 * knife_edge(2.4).log10() + 20.5).abs() < 0.5);
        let [mut before, mut last] = [1.0; 2];
        for i in -200..300 {
            let now = knife_edge(f64::from(i) * 0.01);
            assert!(now <= last && last - now < 0.01, "falling");
            assert!((now - 2.0 * last + before).abs() < 2e-4, "no corner at {i}");
            (before, last) = (last, now);
        }
    }

    #[test]
    fn a_person_between_shades_and_one_beside_does_not() {
        let column = |y| Column { x: 2.0, y, radius_m: 0.18, height_m: 1.75 };
        let (a, b) = (DVec3::new(0.0, 0.0, 1.0), DVec3::new(4.0, 0.0, 1.0));
        assert!(past(a, b, &column(0.0), 0.005) < 0.1);
        assert_eq!(past(a, b, &column(0.8), 0.005), 1.0);
        let high = DVec3::new(0.0, 0.0, 2.5);
        assert_eq!(past(high, DVec3::new(4.0, 0.0, 2.5), &column(0.0), 0.005), 1.0);
    }

    /// Legs in random directions past columns at random positions: the row version gives the same loss as the scalar
    /// version.
    #[test]
    fn legs_side_by_side_lose_what_each_loses() {
        let mut rng = generator(3, Purpose::Build, [0, 0]);
        let mut shaded = 0;
        for _ in 0..500 {
            let mut place = |high_m: f64| {
                DVec3::new(rng.random_range(0.0..5.0), rng.random_range(0.0..4.0), rng.random_range(0.0..high_m))
            };
            let middle = place(1.0);
            let column = Column { x: middle.x, y: middle.y, radius_m: 0.18, height_m: 1.7 };
            let legs: [[DVec3; 2]; WIDE] = std::array::from_fn(|l| {
                let from = place(2.6);
                // Some legs are upright, some are aimed at the column, some are random.
                let to = [DVec3::new(from.x, from.y, 0.3), 2.0 * middle - from.with_z(-1.0), place(2.6)];
                [from, to[l % 3]]
            });
            let (mut from, mut to, mut fields) = ([[0.0; WIDE]; 3], [[0.0; WIDE]; 3], [1.0; WIDE]);
            for (l, leg) in legs.iter().enumerate() {
                store(&mut from, l, leg[0].to_array());
                store(&mut to, l, leg[1].to_array());
            }
            attenuate_rows(KernelLevel::detect(), &from, &to, &column, 0.005, &mut fields);
            for (leg, field) in legs.iter().zip(fields) {
                let one = past(leg[0], leg[1], &column, 0.005);
                assert!((field - one).abs() < 1e-12, "{leg:?} {column:?}: {field} {one}");
                shaded += usize::from(one < 0.9);
            }
        }
        assert!(shaded > 100, "{shaded}");
    }
}
