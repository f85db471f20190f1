//! Vectorised echoes of paths by way of one segment: fields of the antennas, reflection by skin, and received signals.
//! Each lane gives the same result as [`super::Paths::trace`] for one path.

// Loops use lane indices: several rows are accessed together, and the compiler vectorises these loops.
#![allow(clippy::needless_range_loop)]

use num_complex::Complex64;
use radome_dsp::SPEED_OF_LIGHT_M_PER_S;

use super::LEAST_DISTANCE_M;
use crate::em::image::Element;
use crate::em::specular_rows::SpecularRows;
use crate::lanes::vector::{Vector, add, choose, cross, dot, normalized, scale, store, subtract, tangent, times};
use crate::lanes::{WIDE, WideRow, WideRow3, compiled_for_levels, wide_lane};
use crate::prepared_scene::PreparedScene;

/// Complex field vectors, one per lane.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct WideFields {
    pub(super) re: WideRow3,
    pub(super) im: WideRow3,
}

/// Echoes at one receiver, one path per lane.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct ReceivedRows {
    pub(super) delay_s: WideRow,
    pub(super) delay_rate: WideRow,
    /// Amplitude at the ADC, LSB: real and imaginary part.
    pub(super) amplitude: [WideRow; 2],
}

/// Distances from an end of each path to its specular point, one path per lane.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct LengthRows {
    pub(super) length_m: WideRow,
    /// Time derivative of the distance, m/s.
    pub(super) rate: WideRow,
}

/// Motion of the surface of a segment: velocity of its centre, m/s, and velocity per component of a point on the unit
/// sphere.
#[derive(Debug, Clone, Copy)]
pub(super) struct SurfaceMotion(pub(super) [Vector; 4]);

compiled_for_levels! {
    /// Computes the fields of an antenna's images at points in the given directions, before any wall. `signs` are the
    /// signs of the images' axes.
    pub(super) fn transmitted_fields(
        element: &Element,
        signs: &WideRow3,
        towards: &WideRow3,
        field: &mut WideRow3,
    ) = transmitted_body;
}

#[inline(always)]
fn transmitted_body(element: &Element, signs: &WideRow3, towards: &WideRow3, field: &mut WideRow3) {
    let rotation = &element.radar_from_world;
    let ahead = [rotation.x_axis.x, rotation.y_axis.x, rotation.z_axis.x];
    let left = [rotation.x_axis.y, rotation.y_axis.y, rotation.z_axis.y];
    let own_polarisation = [element.polarisation.x, element.polarisation.y, element.polarisation.z];
    for l in 0..WIDE {
        let (direction, sign) = (scale(wide_lane(towards, l), -1.0), wide_lane(signs, l));
        let departure = times(direction, sign);
        let gain = element.pattern.field_in_lane(dot(ahead, departure), dot(left, departure));
        let polarisation = times(own_polarisation, sign);
        let transverse = subtract(polarisation, scale(direction, dot(direction, polarisation)));
        store(field, l, scale(transverse, gain));
    }
}

compiled_for_levels! {
    /// Computes path amplitudes without phase, real and imaginary part. They combine the fields of both antennas at the
    /// specular points, the reflection by skin, spreading, and a factor of each path.
    pub(super) fn path_amplitudes(
        permittivity: Complex64,
        specular: &SpecularRows,
        fields: &[WideFields; 2],
        factors: &WideRow,
        amplitude: &mut [WideRow; 2],
    ) = path_amplitudes_body;
}

#[inline(always)]
fn path_amplitudes_body(
    permittivity: Complex64,
    specular: &SpecularRows,
    fields: &[WideFields; 2],
    factors: &WideRow,
    amplitude: &mut [WideRow; 2],
) {
    let [outbound, inbound] = fields;
    let (mut re, mut im) = ([0.0; WIDE], [0.0; WIDE]);
    for l in 0..WIDE {
        let (direction, normal) = (scale(wide_lane(&specular.towards[0], l), -1.0), wide_lane(&specular.normal, l));
        let cosine = -dot(direction, normal);
        let cosine = if cosine > 0.0 { cosine } else { 0.0 };
        let cosine = if cosine < 1.0 { cosine } else { 1.0 };
        // Perpendicular to the plane of incidence and in it; at normal incidence any tangent serves.
        let across = cross(direction, normal);
        let te = choose(dot(across, across) < 1e-12, tangent(direction), normalized(across));
        let tm = cross(te, direction);
        let tm_out = cross(te, add(direction, scale(normal, 2.0 * cosine)));
        let (r_te, r_tm) = skin_reflection([permittivity.re, permittivity.im], cosine);
        let (e_re, e_im) = (wide_lane(&outbound.re, l), wide_lane(&outbound.im, l));
        let (b_re, b_im) = (wide_lane(&inbound.re, l), wide_lane(&inbound.im, l));
        let by_te = multiply(multiply(r_te, [dot(e_re, te), dot(e_im, te)]), [dot(b_re, te), dot(b_im, te)]);
        let by_tm = multiply(multiply(r_tm, [dot(e_re, tm), dot(e_im, tm)]), [dot(b_re, tm_out), dot(b_im, tm_out)]);
        let (t_m, r_m) = (specular.distances_m[0][l], specular.distances_m[1][l]);
        let t_m = if t_m > LEAST_DISTANCE_M { t_m } else { LEAST_DISTANCE_M };
        let r_m = if r_m > LEAST_DISTANCE_M { r_m } else { LEAST_DISTANCE_M };
        let spreading = factors[l] * specular.cosine[l] / (specular.det_j[l].sqrt() * t_m * r_m);
        re[l] = spreading * (by_te[0] + by_tm[0]);
        im[l] = spreading * (by_te[1] + by_tm[1]);
    }
    *amplitude = [re, im];
}

#[inline(always)]
fn multiply(a: [f64; 2], b: [f64; 2]) -> [f64; 2] {
    [a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]]
}

#[inline(always)]
fn divide(a: [f64; 2], b: [f64; 2]) -> [f64; 2] {
    let per_square = 1.0 / (b[0] * b[0] + b[1] * b[1]);
    [(a[0] * b[0] + a[1] * b[1]) * per_square, (a[1] * b[0] - a[0] * b[1]) * per_square]
}

/// Reflection coefficients of a lossy half-space, TE and TM ([`crate::em::fresnel::half_space`]), for a permittivity
/// whose real part exceeds one.
#[inline(always)]
fn skin_reflection(permittivity: [f64; 2], cosine: f64) -> ([f64; 2], [f64; 2]) {
    let [eps_re, eps_im] = permittivity;
    let real = eps_re - (1.0 - cosine * cosine);
    let modulus = (real * real + eps_im * eps_im).sqrt();
    let q_re = (0.5 * (modulus + real)).sqrt();
    let q_im = 0.5 * eps_im / q_re;
    let (c_re, c_im) = (eps_re * cosine, eps_im * cosine);
    let te = divide([cosine - q_re, -q_im], [cosine + q_re, q_im]);
    let tm = divide([c_re - q_re, c_im - q_im], [c_re + q_re, c_im + q_im]);
    (te, tm)
}

compiled_for_levels! {
    /// Computes the echoes at a receiver whose images are at `sinks`.
    pub(super) fn receiver_echoes(
        prepared: &PreparedScene,
        lsb: f64,
        specular: &SpecularRows,
        motion: &SurfaceMotion,
        sinks: &WideRow3,
        amplitude: &[WideRow; 2],
        out: &mut ReceivedRows,
    ) = receiver_echoes_body;
}

#[inline(always)]
fn receiver_echoes_body(
    prepared: &PreparedScene,
    lsb: f64,
    specular: &SpecularRows,
    motion: &SurfaceMotion,
    sinks: &WideRow3,
    amplitude: &[WideRow; 2],
    out: &mut ReceivedRows,
) {
    let (chirp, filters) = (prepared.chirp, prepared.filters);
    let per_m = 1.0 / SPEED_OF_LIGHT_M_PER_S;
    for l in 0..WIDE {
        let velocity = velocity(motion, wide_lane(&specular.unit, l));
        let to_rx = subtract(wide_lane(sinks, l), wide_lane(&specular.point, l));
        let distance_m = dot(to_rx, to_rx).sqrt();
        let least_m = if distance_m > 1e-9 { distance_m } else { 1e-9 };
        let rate = dot(wide_lane(&specular.towards[0], l), velocity) + dot(to_rx, velocity) / least_m;
        let delay_s = (specular.distances_m[0][l] + distance_m) * per_m;
        let delay_rate = -rate * per_m;
        let response = filters.response_in_lane(chirp.beat_hz(delay_s, delay_rate));
        let at_adc = multiply([lsb * amplitude[0][l], -lsb * amplitude[1][l]], response);
        out.delay_s[l] = delay_s;
        out.delay_rate[l] = delay_rate;
        out.amplitude[0][l] = at_adc[0];
        out.amplitude[1][l] = at_adc[1];
    }
}

/// Velocity of a segment's material at a point of the unit sphere, m/s.
#[inline(always)]
fn velocity(motion: &SurfaceMotion, unit: Vector) -> Vector {
    let [centre, x, y, z] = motion.0;
    add(add(centre, scale(x, unit[0])), add(scale(y, unit[1]), scale(z, unit[2])))
}

compiled_for_levels! {
    /// Computes the distances of specular points from an end of each path.
    pub(super) fn path_lengths(
        specular: &SpecularRows,
        motion: &SurfaceMotion,
        ends: &WideRow3,
        out: &mut LengthRows,
    ) = path_lengths_body;
}

#[inline(always)]
fn path_lengths_body(specular: &SpecularRows, motion: &SurfaceMotion, ends: &WideRow3, out: &mut LengthRows) {
    for l in 0..WIDE {
        let velocity = velocity(motion, wide_lane(&specular.unit, l));
        let offset = subtract(wide_lane(&specular.point, l), wide_lane(ends, l));
        let length_m = dot(offset, offset).sqrt();
        out.length_m[l] = length_m;
        out.rate[l] = dot(offset, velocity) / if length_m > 1e-9 { length_m } else { 1e-9 };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::em::fresnel::half_space;
    use crate::material::SKIN_PERMITTIVITY;

    #[test]
    fn lanes_have_the_skin_of_the_half_space() {
        for i in 0..=1000 {
            let cosine = 1e-3 * f64::from(i);
            let expected = half_space(SKIN_PERMITTIVITY, cosine);
            let (te, tm) = skin_reflection([SKIN_PERMITTIVITY.re, SKIN_PERMITTIVITY.im], cosine);
            for (got, expected) in [(te, expected.te), (tm, expected.tm)] {
                assert!((Complex64::new(got[0], got[1]) - expected).norm() < 1e-14, "{cosine}: {got:?} {expected}");
            }
        }
    }
}
