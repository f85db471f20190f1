//! Legs of diffuse echoes between antennas or wall points and a segment, and vectorised echoes over them, one path per
//! lane.

// Loops use lane indices: several rows are accessed together, and the compiler vectorises these loops.
#![allow(clippy::needless_range_loop)]

use glam::DVec3;
use radome_dsp::SPEED_OF_LIGHT_M_PER_S;

use crate::diffuse::LEAST_LEG_M;
use crate::em::image::Element;
use crate::lanes::vector::{dot, scale, subtract};
use crate::lanes::{WIDE, WideRow, WideRow3, compiled_for_levels, wide_lane};
use crate::prepared_scene::PreparedScene;

/// Leg between an antenna or a point and the middle of a segment, at one time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Leg {
    /// Length, m, and its first and second time derivative.
    pub(super) length: [f64; 3],
    /// Field at the segment for a unit field at 1 m.
    pub(super) field: f64,
}

impl Leg {
    /// Computes a leg from a position that radiates a field, times m, in a direction.
    fn new(scatterer: &Scatterer, from: DVec3, radiated: impl Fn(DVec3) -> f64) -> Self {
        let offset = scatterer.centre - from;
        let distance_m = offset.length();
        let direction = offset / distance_m.max(1e-9);
        let clamped_m = distance_m.max(LEAST_LEG_M);
        let rate = direction.dot(scatterer.velocity);
        // Transverse motion increases the second derivative.
        let across = (scatterer.velocity.length_squared() - rate * rate) / clamped_m;
        let length = [distance_m, rate, direction.dot(scatterer.acceleration) + across];
        Leg { length, field: radiated(direction) / clamped_m }
    }

    /// Computes the leg from an antenna.
    pub(super) fn from_antenna(prepared: &PreparedScene, scatterer: &Scatterer, antenna: &Element) -> Self {
        let straight = prepared.room.field_on_segment(antenna.position, scatterer.centre);
        let radiated = |direction: DVec3| antenna.pattern.field(antenna.radar_from_world * direction) * straight;
        Leg::new(scatterer, antenna.position, radiated)
    }
}

/// Motion of a segment at one time.
pub(super) struct Scatterer {
    pub(super) centre: DVec3,
    pub(super) velocity: DVec3,
    pub(super) acceleration: DVec3,
}

/// Legs, one per lane ([`Leg`]).
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct LegRows {
    length: [WideRow; 3],
    field: WideRow,
}

impl LegRows {
    /// Repeats a leg in all lanes.
    pub(super) fn of_all(length: [f64; 3], field: f64) -> Self {
        LegRows { length: length.map(|value| [value; WIDE]), field: [field; WIDE] }
    }
}

compiled_for_levels! {
    /// Computes the legs from wall points, given by their positions and normals.
    pub(super) fn legs(scatterer: &Scatterer, points: &[WideRow3; 2], out: &mut LegRows) = legs_body;
}

#[inline(always)]
fn legs_body(scatterer: &Scatterer, [positions, normals]: &[WideRow3; 2], out: &mut LegRows) {
    let [centre, velocity, acceleration] =
        [scatterer.centre, scatterer.velocity, scatterer.acceleration].map(|of| of.to_array());
    let square = dot(velocity, velocity);
    for l in 0..WIDE {
        let offset = subtract(centre, wide_lane(positions, l));
        let distance_m = dot(offset, offset).sqrt();
        let clamped_m = if distance_m > LEAST_LEG_M { distance_m } else { LEAST_LEG_M };
        let direction = scale(offset, 1.0 / if distance_m > 1e-9 { distance_m } else { 1e-9 });
        let rate = dot(direction, velocity);
        let cosine = dot(direction, wide_lane(normals, l));
        out.length[0][l] = distance_m;
        out.length[1][l] = rate;
        out.length[2][l] = dot(direction, acceleration) + (square - rate * rate) / clamped_m;
        out.field[l] = if cosine > 0.0 { cosine.sqrt() / clamped_m } else { 0.0 };
    }
}

/// Echoes over two legs, one path per lane, for unit fields between legs and antennas.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct EchoRows {
    /// Delay, s, with its first and second time derivative.
    pub(super) delay: [WideRow; 3],
    /// Amplitude at the ADC, LSB: real and imaginary part.
    pub(super) amplitude: [WideRow; 2],
    /// Square of its magnitude.
    pub(super) power: WideRow,
}

compiled_for_levels! {
    /// Computes the echoes over two legs and a length between them, m. `lsb` is the amplitude at the ADC for unit legs
    /// before the filters.
    pub(super) fn two_leg_echoes(
        prepared: &PreparedScene,
        lsb: f64,
        legs: [&LegRows; 2],
        between_m: &WideRow,
        out: &mut EchoRows,
    ) = two_leg_echoes_body;
}

#[inline(always)]
fn two_leg_echoes_body(
    prepared: &PreparedScene,
    lsb: f64,
    [outbound, inbound]: [&LegRows; 2],
    between_m: &WideRow,
    out: &mut EchoRows,
) {
    let (chirp, filters) = (prepared.chirp, prepared.filters);
    let per_m = 1.0 / SPEED_OF_LIGHT_M_PER_S;
    for l in 0..WIDE {
        let delay_s = (outbound.length[0][l] + inbound.length[0][l] + between_m[l]) * per_m;
        let delay_rate = (outbound.length[1][l] + inbound.length[1][l]) * per_m;
        let response = filters.response_in_lane(chirp.beat_hz(delay_s, delay_rate));
        let amplitude = lsb * outbound.field[l] * inbound.field[l];
        let (re, im) = (amplitude * response[0], amplitude * response[1]);
        out.delay[0][l] = delay_s;
        out.delay[1][l] = delay_rate;
        out.delay[2][l] = (outbound.length[2][l] + inbound.length[2][l]) * per_m;
        out.amplitude[0][l] = re;
        out.amplitude[1][l] = im;
        out.power[l] = re * re + im * im;
    }
}

#[cfg(test)]
mod tests {
    use radome_dsp::KernelLevel;

    use super::*;
    use crate::lanes::vector::store;

    /// A leg's derivatives are those of its length.
    #[test]
    fn derivatives_of_legs_are_those_of_their_lengths() {
        let (velocity, acceleration) = (DVec3::new(1.0, -2.0, 0.5), DVec3::new(-4.0, 3.0, 9.0));
        let at = |time_s: f64| {
            let centre = DVec3::new(1.0, 0.4, 1.0) + velocity * time_s + 0.5 * acceleration * time_s * time_s;
            Leg::new(&Scatterer { centre, velocity, acceleration }, DVec3::new(3.0, 1.0, 0.0), |_| 1.0).length
        };
        let h = 1e-4;
        let [before, now, after] = [-h, 0.0, h].map(|time_s| at(time_s)[0]);
        let [length, rate, bend] = at(0.0);
        assert_eq!(length, now);
        assert!((rate - (after - before) / (2.0 * h)).abs() < 1e-6, "{rate}");
        assert!((bend - (after - 2.0 * now + before) / (h * h)).abs() < 1e-5, "{bend}");
    }

    /// Legs side by side are those of each point alone.
    #[test]
    fn legs_side_by_side_are_those_of_each() {
        let scatterer = Scatterer {
            centre: DVec3::new(1.0, 0.4, 1.0),
            velocity: DVec3::new(1.0, -2.0, 0.5),
            acceleration: DVec3::new(-4.0, 3.0, 9.0),
        };
        let normal = DVec3::X;
        let place = |l: usize| DVec3::new(-1.0 + 0.35 * l as f64, 0.2 * l as f64, 0.1);
        let mut points = [[[0.0; WIDE]; 3]; 2];
        for l in 0..WIDE {
            store(&mut points[0], l, place(l).to_array());
            store(&mut points[1], l, normal.to_array());
        }
        let mut rows = LegRows::default();
        legs(KernelLevel::detect(), &scatterer, &points, &mut rows);
        for l in 0..WIDE {
            let one = Leg::new(&scatterer, place(l), |direction| direction.dot(normal).max(0.0).sqrt());
            assert!((rows.field[l] - one.field).abs() < 1e-12, "{l}: {rows:?} {one:?}");
            for (row, one) in rows.length.iter().zip(one.length) {
                assert!((row[l] - one).abs() < 1e-12, "{l}: {rows:?} {one}");
            }
        }
        assert!(rows.field.contains(&0.0) && rows.field[0] > 0.0);
    }
}
