//! Physical-optics integrands at sixteen vertices of a skin. The integrand is the received field per area of the skin,
//! from one image antenna to another, without the phase `exp(-j k L)` of the path. The formulation is that of
//! [`crate::em::current::received`]; a test compares both.

// Loops use lane indices: several rows are accessed together, and the compiler vectorises these loops.
#![allow(clippy::needless_range_loop)]

use glam::DVec3;
use num_complex::Complex64;

use super::LEAST_DISTANCE_M;
use super::error_budget::IntegrationSettings;
use crate::em::Phasor3;
use crate::lanes::{LANES, Row, Row3, compiled_for_levels, cos_sin_of_turns, lane};

/// Vertices of a posed skin, one per lane.
#[derive(Debug, Clone, Copy)]
pub(super) struct VertexRows {
    /// Positions relative to a common nearby origin, m.
    pub(super) positions: Row3,
    pub(super) normals: Row3,
    /// Factor of clothes and walls on the amplitude.
    pub(super) amplitude_factor: Row,
    /// Factor on the sine of the angle from the specular direction, applied before the window.
    pub(super) narrowing: Row,
}

/// Directions and distances from vertices to an image antenna.
#[derive(Debug, Clone, Copy)]
pub(super) struct DirectionRows {
    /// Unit vectors to the antenna.
    pub(super) towards: Row3,
    /// Inverse distance, 1/m, with the distance clamped to [`LEAST_DISTANCE_M`].
    pub(super) inverse_m: Row,
}

/// Field of an image antenna at vertices, without spreading.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct FieldRows {
    re: Row3,
    im: Row3,
}

/// First-order expansion of the field of an image antenna around a point: the field, and its slope along each axis,
/// 1/m.
#[derive(Debug, Clone, Copy)]
pub(super) struct FieldAround {
    pub(super) point: [f32; 3],
    pub(super) field: Phasor3,
    pub(super) slopes: [Phasor3; 3],
}

/// Step of the finite differences of fields, m.
const FIELD_STEP_M: f64 = 0.03;

impl FieldAround {
    /// Expands a field around `centre`. Positions are relative to `origin`.
    pub(super) fn new(centre: DVec3, origin: DVec3, field_at: impl Fn(DVec3) -> Phasor3) -> Self {
        let field = field_at(centre);
        let slope = |axis: DVec3| {
            let ahead = field_at(centre + axis * FIELD_STEP_M);
            Phasor3 { re: (ahead.re - field.re) / FIELD_STEP_M, im: (ahead.im - field.im) / FIELD_STEP_M }
        };
        FieldAround { point: (centre - origin).as_vec3().to_array(), field, slopes: DVec3::AXES.map(slope) }
    }
}

compiled_for_levels! {
    /// Evaluates the expanded field at vertices.
    pub(super) fn field_rows(expansion: &FieldAround, positions: &Row3) -> FieldRows = field_body;
}

#[inline(always)]
fn field_body(expansion: &FieldAround, positions: &Row3) -> FieldRows {
    let mut rows = FieldRows::default();
    let [x, y, z] = &expansion.slopes;
    for axis in 0..3 {
        let at = |v: DVec3| v.to_array()[axis] as f32;
        let (re, by_re) = (at(expansion.field.re), [at(x.re), at(y.re), at(z.re)]);
        let (im, by_im) = (at(expansion.field.im), [at(x.im), at(y.im), at(z.im)]);
        for l in 0..LANES {
            let [x, y, z] = lane(positions, l);
            let d = [x - expansion.point[0], y - expansion.point[1], z - expansion.point[2]];
            rows.re[axis][l] = re + dot(d, by_re);
            rows.im[axis][l] = im + dot(d, by_im);
        }
    }
    rows
}

/// Inputs of [`integrands`].
pub(super) struct IntegrandInputs<'a> {
    pub(super) vertices: &'a VertexRows,
    /// Directions to the transmitting and to the receiving image antenna.
    pub(super) directions: [&'a DirectionRows; 2],
    pub(super) fields: [&'a FieldRows; 2],
    /// Factors of obstruction by people and limbs on both fields.
    pub(super) obstruction: [&'a Row; 2],
    pub(super) permittivity: Complex64,
    pub(super) settings: &'a IntegrationSettings,
    /// Common factor of all integrands, to be multiplied by j.
    pub(super) factor: f32,
}

impl DirectionRows {
    #[inline(always)]
    fn new(antenna: [f32; 3], positions: &Row3) -> Self {
        let mut rows = DirectionRows { towards: Default::default(), inverse_m: [0.0; LANES] };
        for l in 0..LANES {
            let (x, y, z) = (antenna[0] - positions[0][l], antenna[1] - positions[1][l], antenna[2] - positions[2][l]);
            let distance = (x * x + y * y + z * z).sqrt();
            let inverse = 1.0 / distance.max(1e-6);
            (rows.towards[0][l], rows.towards[1][l], rows.towards[2][l]) = (x * inverse, y * inverse, z * inverse);
            rows.inverse_m[l] = 1.0 / distance.max(LEAST_DISTANCE_M as f32);
        }
        rows
    }

    /// Returns the number of clamped distances.
    pub(super) fn clamped(&self) -> usize {
        self.inverse_m.iter().filter(|&&inverse_m| inverse_m >= 1.0 / LEAST_DISTANCE_M as f32).count()
    }
}

compiled_for_levels! {
    /// Computes directions and inverse distances to an antenna. Its position has the same origin as those of the
    /// vertices.
    pub(super) fn direction_rows(antenna: [f32; 3], positions: &Row3) -> DirectionRows = DirectionRows::new;
}

compiled_for_levels! {
    /// Returns whether any vertex is near a specular point: within the window, and facing both antennas.
    pub(super) fn any_near_specular(
        normals: &Row3,
        narrowing: &Row,
        directions: [&DirectionRows; 2],
        outer: f32,
    ) -> bool = any_near_specular_body;
}

#[inline(always)]
fn any_near_specular_body(normals: &Row3, narrowing: &Row, [out, back]: [&DirectionRows; 2], outer: f32) -> bool {
    let mut any = 0u32;
    for l in 0..LANES {
        let (mut with_out, mut with_back, mut square) = (0.0, 0.0, 0.0);
        for axis in 0..3 {
            let (t, r, n) = (out.towards[axis][l], back.towards[axis][l], normals[axis][l]);
            with_out += n * t;
            with_back += n * r;
            square += (t + r) * (t + r);
        }
        let cosine = with_out + with_back;
        let is_near = (with_out > 0.0)
            & (with_back > 0.0)
            & ((square - cosine * cosine) * (narrowing[l] * narrowing[l]) < square * (outer * outer))
            & (square > 4.0 * GRAZING[0] * GRAZING[0]);
        any |= u32::from(is_near);
    }
    any != 0
}

/// Half the length of the sum of the unit vectors to both antennas, at which the weight of specular points is zero and
/// from which it is one. At smaller values forward scattering dominates, which this method does not model.
pub(super) const GRAZING: [f32; 2] = [0.1, 0.3];

/// [`crate::math::smooth_step`] from 0 at `from` to 1 at `to`.
#[inline(always)]
fn smooth_step(x: f32, from: f32, to: f32) -> f32 {
    let x = ((x - from) / (to - from)).clamp(0.0, 1.0);
    let (_, sine) = cos_sin_of_turns(x - 0.5);
    x + sine * (0.5 * std::f32::consts::FRAC_1_PI)
}

compiled_for_levels! {
    /// Computes integrands, real and imaginary parts.
    pub(super) fn integrands(between: &IntegrandInputs) -> (Row, Row) = integrands_body;
}

#[inline(always)]
fn cross(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

#[inline(always)]
fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline(always)]
fn sum(a: [f32; 3], b: [f32; 3], factor: f32) -> [f32; 3] {
    [a[0] + b[0] * factor, a[1] + b[1] * factor, a[2] + b[2] * factor]
}

#[inline(always)]
fn divide(a: (f32, f32), b: (f32, f32)) -> (f32, f32) {
    let inverse = 1.0 / (b.0 * b.0 + b.1 * b.1);
    ((a.0 * b.0 + a.1 * b.1) * inverse, (a.1 * b.0 - a.0 * b.1) * inverse)
}

#[inline(always)]
fn integrands_body(between: &IntegrandInputs) -> (Row, Row) {
    let IntegrandInputs {
        vertices,
        directions: [out, back],
        fields: [field, received],
        obstruction,
        permittivity,
        settings,
        factor,
    } = between;
    let (eps_re, eps_im) = (permittivity.re as f32, permittivity.im as f32);
    let (inner, outer) = (settings.window[0] as f32, settings.window[1] as f32);
    let (mut all_re, mut all_im) = ([0.0; LANES], [0.0; LANES]);
    for l in 0..LANES {
        let n = lane(&vertices.normals, l);
        let t = lane(&out.towards, l);
        let s = lane(&back.towards, l);
        let (field_re, field_im) = (lane(&field.re, l), lane(&field.im, l));
        let (receiver_re, receiver_im) = (lane(&received.re, l), lane(&received.im, l));
        let bisector = sum(t, s, 1.0);
        let length = dot(bisector, bisector).sqrt();
        let cosine = dot(n, bisector) / length.max(1e-6);
        let sine = (1.0 - cosine * cosine).max(0.0).sqrt() * vertices.narrowing[l];
        let (with_t, with_s) = (dot(n, t), dot(n, s));
        let window = smooth_step(sine, outer, inner) * smooth_step(0.5 * length, GRAZING[0], GRAZING[1]);
        let lit = (cosine > 0.0) & (with_t > 0.0) & (with_s > 0.0);
        let spreading = out.inverse_m[l] * back.inverse_m[l];
        let weight = window * vertices.amplitude_factor[l] * obstruction[0][l] * obstruction[1][l] * spreading;
        let weight = if lit { weight } else { 0.0 };

        // Directions of the incident and the reflected wave.
        let d = [-t[0], -t[1], -t[2]];
        let c = with_t.abs().min(1.0);
        let o = sum(d, n, 2.0 * with_t);
        // Normal component of the wave vector inside, by real roots. The real parts of the permittivities exceed one
        // here.
        let (a, b) = (eps_re - 1.0 + c * c, eps_im);
        let q_re = (0.5 * ((a * a + b * b).sqrt() + a)).sqrt();
        let q_im = 0.5 * b / q_re;
        let te = divide((c - q_re, -q_im), (c + q_re, q_im));
        let tm = divide((eps_re * c - q_re, eps_im * c - q_im), (eps_re * c + q_re, eps_im * c + q_im));
        // Unit vector perpendicular to the plane of incidence; at normal incidence any tangent serves.
        let across = cross(d, n);
        let any = if d[0].abs() < 0.7 { [0.0, d[2], -d[1]] } else { [-d[2], 0.0, d[0]] };
        let normal_incidence = dot(across, across) < 1e-8;
        let pick = |any: f32, across: f32| if normal_incidence { any } else { across };
        let u = [pick(any[0], across[0]), pick(any[1], across[1]), pick(any[2], across[2])];
        let inverse = 1.0 / dot(u, u).sqrt().max(1e-12);
        let u = [u[0] * inverse, u[1] * inverse, u[2] * inverse];
        let (v, w) = (cross(u, d), cross(u, o));
        let (along_u, along_v) = ((dot(field_re, u), dot(field_im, u)), (dot(field_re, v), dot(field_im, v)));
        let reflected_u = (te.0 * along_u.0 - te.1 * along_u.1, te.0 * along_u.1 + te.1 * along_u.0);
        let reflected_w = (tm.0 * along_v.0 - tm.1 * along_v.1, tm.0 * along_v.1 + tm.1 * along_v.0);
        let reflected_re = sum([u[0] * reflected_u.0, u[1] * reflected_u.0, u[2] * reflected_u.0], w, reflected_w.0);
        let reflected_im = sum([u[0] * reflected_u.1, u[1] * reflected_u.1, u[2] * reflected_u.1], w, reflected_w.1);
        // Electric and magnetic current, n x (H + H_r) and -n x (E + E_r).
        let (h_re, h_im) = (cross(d, field_re), cross(d, field_im));
        let j_re = cross(n, sum(h_re, cross(o, reflected_re), 1.0));
        let j_im = cross(n, sum(h_im, cross(o, reflected_im), 1.0));
        let m_re = cross(n, sum(field_re, reflected_re, 1.0));
        let m_im = cross(n, sum(field_im, reflected_im, 1.0));
        // Field of both currents at the receiving antenna.
        let (p_re, p_im) = (sum(receiver_re, s, -dot(s, receiver_re)), sum(receiver_im, s, -dot(s, receiver_im)));
        let (sp_re, sp_im) = (cross(s, p_re), cross(s, p_im));
        let re = dot(j_re, p_re) - dot(j_im, p_im) - (dot(m_re, sp_re) - dot(m_im, sp_im));
        let im = dot(j_re, p_im) + dot(j_im, p_re) - (dot(m_re, sp_im) + dot(m_im, sp_re));
        all_re[l] = -0.5 * factor * weight * im;
        all_im[l] = 0.5 * factor * weight * re;
    }
    (all_re, all_im)
}

/// Returns the common factor of all integrands, without `j`: `-j k / 2 pi` of physical optics, and the antennas'
/// aperture `lambda / 4 pi`.
pub(super) fn common_factor(wavelength_m: f64) -> f32 {
    let k = std::f64::consts::TAU / wavelength_m;
    let aperture = wavelength_m / (4.0 * std::f64::consts::PI);
    (-k * aperture / std::f64::consts::TAU) as f32
}

#[cfg(test)]
mod tests {
    use radome_dsp::KernelLevel;
    use rand::Rng;

    use super::*;
    use crate::em::current::{Arrival, received};
    use crate::em::image::Wall;
    use crate::material::SKIN_PERMITTIVITY;
    use crate::random::{Purpose, generator};

    /// Normals range from the line of sight to grazing. Fields are complex as behind lossy walls, and antennas are
    /// together or apart.
    #[test]
    fn integrands_are_those_of_physical_optics() {
        let mut rng = generator(3, Purpose::Noise, [0, 0]);
        let mut vector = move || {
            let mut number = || rng.random_range(-1.0..1.0);
            DVec3::new(number(), number(), number())
        };
        let settings = IntegrationSettings { window: [5.0, 9.0], ..IntegrationSettings::for_tolerance(0.5) };
        let level = KernelLevel::detect();
        let ones = [1.0; LANES];
        let mut compared = 0;
        for i in 0..4000 {
            let point = vector();
            let outbound_antenna = point + 3.0 * vector().normalize();
            let inbound_antenna =
                if i % 2 == 0 { outbound_antenna + 0.002 * vector() } else { point + 2.0 * vector().normalize() };
            let (t, s) = ((outbound_antenna - point).normalize(), (inbound_antenna - point).normalize());
            let normal = if i % 5 == 0 { t } else { (t + s + 0.9 * vector()).normalize() };
            // Fields are transverse to the direction of propagation.
            let mut phasor = |along: DVec3| {
                let across = |v: DVec3| v - along * along.dot(v);
                Phasor3 { re: across(vector()), im: across(vector()) }
            };
            let fields = [phasor(t), phasor(s)];
            if normal.dot(t) <= 1e-3 || normal.dot(s) <= 1e-3 || (t + s).length() < 0.61 {
                continue;
            }
            let row3 = |v: DVec3| v.as_vec3().to_array().map(|x| [x; LANES]);
            let vertices =
                VertexRows { positions: row3(point), normals: row3(normal), amplitude_factor: ones, narrowing: ones };
            let directions = [outbound_antenna, inbound_antenna]
                .map(|a| direction_rows(level, a.as_vec3().to_array(), &vertices.positions));
            let zero = Phasor3::real(DVec3::ZERO);
            let expansion = |field| FieldAround { point: [0.0; 3], field, slopes: [zero; 3] };
            let rows = fields.map(|field| field_rows(level, &expansion(field), &vertices.positions));
            let between = IntegrandInputs {
                vertices: &vertices,
                directions: [&directions[0], &directions[1]],
                fields: [&rows[0], &rows[1]],
                obstruction: [&ones, &ones],
                permittivity: SKIN_PERMITTIVITY,
                settings: &settings,
                factor: 1.0,
            };
            let (re, im) = integrands(level, &between);
            let skin = Wall::HalfSpace { permittivity: SKIN_PERMITTIVITY };
            let arrival = Arrival { field: fields[0], direction: -t };
            let exact = received(&arrival, normal, &skin, 1257.0, s, fields[1])
                / (outbound_antenna.distance(point) * inbound_antenna.distance(point));
            let miss = (Complex64::new(im[7].into(), (-re[7]).into()) - exact).norm();
            assert!(miss < 3e-6, "{miss:e} of {exact}");
            compared += 1;
        }
        assert!(compared > 1500, "{compared}");
    }
}
