//! A patch's triangles at a key: from moments and strengths at their corners to fields, paths and the rates of both.

// Lanes are counted: several rows go together, and loops over their numbers are compiled to vectors.
#![allow(clippy::needless_range_loop)]

use num_complex::{Complex, Complex64};

use super::patch::TriangleKey;
use super::posed_patch::{PosedPatch, at_corners};
use crate::actor::skin::SkinPatch;
use crate::field::curved_triangle::{MomentRows, TriangleRows, ViewRows};
use crate::lanes::{LANES, Row, Row3, compiled_for_levels, dot};

/// Strengths at a patch's vertices, and their rates.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct StrengthRows {
    pub(super) now: (Row, Row),
    pub(super) rates: (Row, Row),
}

/// What a triangle's key holds, side by side.
#[derive(Debug, Clone, Copy)]
struct KeyRows {
    rate_m_per_s: Row,
    field: (Row, Row),
    field_rate: (Row, Row),
    moment: (Row, Row),
}

/// What goes into it.
struct Parts<'a> {
    triangles: &'a TriangleRows,
    velocity: &'a Row3,
    against: &'a [Row3; 3],
    views: [&'a ViewRows; 2],
    moments: &'a MomentRows,
    corners: &'a [[usize; 3]; LANES],
    strengths: &'a StrengthRows,
    wavenumber_per_m: f32,
}

compiled_for_levels! {
    fn key_rows(parts: &Parts) -> KeyRows = body;
}

#[inline(always)]
fn body(parts: &Parts) -> KeyRows {
    let Parts { triangles, velocity, against, views, moments, corners, strengths, wavenumber_per_m } = parts;
    let zero = [0.0; LANES];
    let (mut away_t, mut away_r, mut both): (Row3, Row3, Row3) = Default::default();
    for axis in 0..3 {
        for l in 0..LANES {
            away_t[axis][l] = views[0].offsets[axis][l] * views[0].inverse_m[l];
            away_r[axis][l] = views[1].offsets[axis][l] * views[1].inverse_m[l];
            both[axis][l] = away_t[axis][l] + away_r[axis][l];
        }
    }
    let speeds = [dot(&away_t, velocity), dot(&away_r, velocity)];
    let mut keys = KeyRows { rate_m_per_s: zero, field: (zero, zero), field_rate: (zero, zero), moment: (zero, zero) };
    for l in 0..LANES {
        keys.rate_m_per_s[l] = speeds[0][l] + speeds[1][l];
    }
    let (re, im) = (at_corners(&strengths.now.0, corners), at_corners(&strengths.now.1, corners));
    let (rate_re, rate_im) = (at_corners(&strengths.rates.0, corners), at_corners(&strengths.rates.1, corners));
    for corner in 0..3 {
        let d = &triangles.corners[corner];
        let (sideways, turning) = (dot(&both, &against[corner]), dot(d, velocity));
        let (along_t, along_r) = (dot(&away_t, d), dot(&away_r, d));
        for l in 0..LANES {
            // How fast the path by the corner grows against that by the middle.
            let rate = sideways[l]
                + (turning[l] - along_t[l] * speeds[0][l]) * views[0].inverse_m[l]
                + (turning[l] - along_r[l] * speeds[1][l]) * views[1].inverse_m[l];
            let turn = wavenumber_per_m * rate;
            let (x, y) = (re[corner][l], im[corner][l]);
            // The strength's own rate, and minus j k times the path's.
            let (u, v) = (rate_re[corner][l] + turn * y, rate_im[corner][l] - turn * x);
            let (a, b) = (moments.re[corner][l], moments.im[corner][l]);
            let (field_re, field_im) = (x * a - y * b, x * b + y * a);
            // About the path by the middle, which the corner's is longer than by this.
            let longer = along_t[l] + along_r[l];
            keys.field.0[l] += field_re;
            keys.field.1[l] += field_im;
            keys.moment.0[l] += longer * field_re;
            keys.moment.1[l] += longer * field_im;
            keys.field_rate.0[l] += u * a - v * b;
            keys.field_rate.1[l] += u * b + v * a;
        }
    }
    keys
}

/// Every triangle of a patch at a key.
#[allow(clippy::too_many_arguments)]
pub(super) fn triangle_keys(
    level: radome_dsp::KernelLevel,
    patch: &SkinPatch,
    posed: &PosedPatch,
    origin: glam::DVec3,
    [first, second]: [usize; 2],
    moments: &MomentRows,
    strengths: &StrengthRows,
    wavelength_m: f64,
    out: &mut Vec<TriangleKey>,
) {
    let views = [&posed.views[first], &posed.views[second]];
    let rows = key_rows(
        level,
        &Parts {
            triangles: &posed.triangles,
            velocity: &posed.velocity,
            against: &posed.against,
            views,
            moments,
            corners: &patch.corners,
            strengths,
            wavenumber_per_m: (std::f64::consts::TAU / wavelength_m) as f32,
        },
    );
    out.clear();
    let complex =
        |rows: &(Row, Row), l: usize| Complex64::from(Complex::new(f64::from(rows.0[l]), f64::from(rows.1[l])));
    out.extend((0..patch.triangles.len()).map(|l| {
        let middles = &posed.triangles.middles;
        let from_origin = glam::DVec3::new(middles[0][l].into(), middles[1][l].into(), middles[2][l].into());
        TriangleKey {
            middle: origin + from_origin,
            length_m: views[0].distances_m[l] + views[1].distances_m[l],
            rate_m_per_s: rows.rate_m_per_s[l].into(),
            field: complex(&rows.field, l),
            field_rate: complex(&rows.field_rate, l),
            moment: complex(&rows.moment, l),
        }
    }));
}
