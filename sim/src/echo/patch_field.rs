//! Fields of a patch's triangles at a key time, with path lengths and their rates. They are computed from the moments
//! of the triangles and the physical-optics integrands at their corners.

// Loops use lane indices: several rows are accessed together, and the compiler vectorises these loops.
#![allow(clippy::needless_range_loop)]

use super::patch_pose::{PatchPose, at_corners};
use crate::em::curved_triangle::MomentRows;
use crate::lanes::{LANES, Row, Row3, compiled_for_levels, dot};

/// Physical-optics integrands at a patch's vertices, and their rates.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct IntegrandRows {
    pub(super) now: (Row, Row),
    pub(super) rates: (Row, Row),
}

/// Fields of a patch's triangles at a key time. Fields are zero in lanes without a triangle.
#[derive(Debug, Clone, Copy)]
pub(super) struct PatchField {
    /// Middles relative to the patch's origin, m.
    pub(super) middles: Row3,
    /// Length of the path by the antennas' midpoints, m, and its rate, m/s.
    pub(super) length_m: [f64; LANES],
    pub(super) rate_m_per_s: Row,
    /// Field of the triangle relative to the phase of the path by its middle, real and imaginary part, and its rate.
    pub(super) field: [Row; 2],
    pub(super) field_rate: [Row; 2],
    /// Moment of the field about that path: integral of the field times the excess length of its own path, m.
    pub(super) moment: [Row; 2],
}

impl Default for PatchField {
    fn default() -> Self {
        let (zero, both) = ([0.0; LANES], [[0.0; LANES]; 2]);
        PatchField {
            middles: [zero; 3],
            length_m: [0.0; LANES],
            rate_m_per_s: zero,
            field: both,
            field_rate: both,
            moment: both,
        }
    }
}

impl PatchField {
    /// Returns the squared magnitudes of the fields.
    #[inline(always)]
    pub(super) fn powers(&self) -> Row {
        let mut powers = [0.0; LANES];
        for l in 0..LANES {
            powers[l] = self.field[0][l] * self.field[0][l] + self.field[1][l] * self.field[1][l];
        }
        powers
    }
}

/// Inputs of [`patch_field`].
pub(super) struct FieldInputs<'a> {
    pub(super) posed: &'a PatchPose,
    /// Indices in the list of images.
    pub(super) images: [usize; 2],
    pub(super) moments: &'a MomentRows,
    pub(super) corners: &'a [[usize; 3]; LANES],
    pub(super) integrands: &'a IntegrandRows,
    pub(super) wavelength_m: f64,
}

compiled_for_levels! {
    /// Computes the fields of all triangles of a patch at a key time.
    pub(super) fn patch_field(parts: &FieldInputs) -> PatchField = patch_field_body;
}

#[inline(always)]
fn patch_field_body(parts: &FieldInputs) -> PatchField {
    let FieldInputs { posed, images: [first, second], moments, corners, integrands, wavelength_m } = parts;
    let PatchPose { triangles, velocity, corner_velocity, .. } = posed;
    let (views, wavenumber_per_m) =
        ([&posed.views[*first], &posed.views[*second]], (std::f64::consts::TAU / wavelength_m) as f32);
    let (mut away_t, mut away_r, mut both): (Row3, Row3, Row3) = Default::default();
    for axis in 0..3 {
        for l in 0..LANES {
            away_t[axis][l] = views[0].offsets[axis][l] * views[0].inverse_m[l];
            away_r[axis][l] = views[1].offsets[axis][l] * views[1].inverse_m[l];
            both[axis][l] = away_t[axis][l] + away_r[axis][l];
        }
    }
    let speeds = [dot(&away_t, velocity), dot(&away_r, velocity)];
    let mut out = PatchField { middles: triangles.middles, ..PatchField::default() };
    for l in 0..LANES {
        out.rate_m_per_s[l] = speeds[0][l] + speeds[1][l];
        out.length_m[l] = views[0].distances_m[l] + views[1].distances_m[l];
    }
    let (re, im) = (at_corners(&integrands.now.0, corners), at_corners(&integrands.now.1, corners));
    let (rate_re, rate_im) = (at_corners(&integrands.rates.0, corners), at_corners(&integrands.rates.1, corners));
    for corner in 0..3 {
        let d = &triangles.corners[corner];
        let (sideways, turning) = (dot(&both, &corner_velocity[corner]), dot(d, velocity));
        let (along_t, along_r) = (dot(&away_t, d), dot(&away_r, d));
        for l in 0..LANES {
            // Rate of the path length by the corner relative to that by the middle.
            let rate = sideways[l]
                + (turning[l] - along_t[l] * speeds[0][l]) * views[0].inverse_m[l]
                + (turning[l] - along_r[l] * speeds[1][l]) * views[1].inverse_m[l];
            let phase_rate = wavenumber_per_m * rate;
            let (x, y) = (re[corner][l], im[corner][l]);
            // Rate of the integrand with its phase: its own rate, minus j k times the rate of the path.
            let (u, v) = (rate_re[corner][l] + phase_rate * y, rate_im[corner][l] - phase_rate * x);
            let (a, b) = (moments.re[corner][l], moments.im[corner][l]);
            let (field_re, field_im) = (x * a - y * b, x * b + y * a);
            // Excess length of the path by the corner over that by the middle.
            let excess = along_t[l] + along_r[l];
            out.field[0][l] += field_re;
            out.field[1][l] += field_im;
            out.moment[0][l] += excess * field_re;
            out.moment[1][l] += excess * field_im;
            out.field_rate[0][l] += u * a - v * b;
            out.field_rate[1][l] += u * b + v * a;
        }
    }
    out
}
