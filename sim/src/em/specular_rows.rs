//! Vectorised search for the specular points of one ellipsoid for several pairs of sources. Each lane takes the same
//! steps as [`Ellipsoid::specular_point`]. Special cases are left to that method: sources in the body or on opposite
//! sides of it, and steps that lengthen the path.

// Loops use lane indices: several rows are accessed together, and the compiler vectorises these loops.
#![allow(clippy::needless_range_loop)]

use super::specular::{Ellipsoid, FAR, LEAST_COSINE, LEAST_STEP_M, TOUCHING};
use crate::lanes::vector::{Vector, add, choose, cross, dot, normalized, over, scale, store, subtract, tangent, times};
use crate::lanes::{WIDE, WideRow, WideRow3, compiled_for_levels, wide_lane};

/// Number of points evaluated before a lane is left to the method for one pair.
const MOST_PLACES: usize = 6;

/// Specular points of an ellipsoid for pairs of sources, one per lane, with the fields of
/// [`super::specular::SpecularPoint`].
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct SpecularRows {
    /// 1 in lanes whose point was found. The other lanes are undefined and need [`Ellipsoid::specular_point`].
    pub(crate) found: WideRow,
    pub(crate) point: WideRow3,
    pub(crate) unit: WideRow3,
    pub(crate) normal: WideRow3,
    /// Unit vectors to the transmitter's and the receiver's image.
    pub(crate) towards: [WideRow3; 2],
    pub(crate) distances_m: [WideRow; 2],
    /// Cosine of the angle of incidence; there is no specular point where it is [`LEAST_COSINE`] or less.
    pub(crate) cosine: WideRow,
    pub(crate) det_j: WideRow,
}

compiled_for_levels! {
    /// Finds the specular points for pairs of positions of transmitter and receiver in the room.
    pub(crate) fn specular_points(of: &Ellipsoid, sources: &[WideRow3; 2], out: &mut SpecularRows) = specular_points_body;
}

/// Constants of an ellipsoid.
struct Body {
    centre: Vector,
    axes: [Vector; 3],
    semi_axes_m: Vector,
    longest_m: f64,
}

/// Pairs of sources in axes of the ellipsoid, and the initial normals of their search.
#[derive(Clone, Copy, Default)]
struct Begun {
    tx: WideRow3,
    rx: WideRow3,
    normal: WideRow3,
    /// 1 where an initial normal exists.
    sound: WideRow,
    /// 1 where a source is so near that the bisector is a poor initial normal.
    near: WideRow,
    nearest_m: WideRow,
}

/// Points of an ellipsoid, in its own axes, as mirrors between two sources.
#[derive(Clone, Copy)]
struct Mirrors {
    normal: WideRow3,
    point: WideRow3,
    towards: [WideRow3; 2],
    distances_m: [WideRow; 2],
    cosine: WideRow,
    det_j: WideRow,
    turn: WideRow3,
    step_m: WideRow,
    /// 1 where every step of the search was regular.
    sound: WideRow,
}

#[inline(always)]
fn specular_points_body(of: &Ellipsoid, sources: &[WideRow3; 2], out: &mut SpecularRows) {
    let body = Body {
        centre: [of.centre.x, of.centre.y, of.centre.z],
        axes: [
            [of.axes.x_axis.x, of.axes.x_axis.y, of.axes.x_axis.z],
            [of.axes.y_axis.x, of.axes.y_axis.y, of.axes.y_axis.z],
            [of.axes.z_axis.x, of.axes.z_axis.y, of.axes.z_axis.z],
        ],
        semi_axes_m: [of.semi_axes_m.x, of.semi_axes_m.y, of.semi_axes_m.z],
        longest_m: of.semi_axes_m.x.max(of.semi_axes_m.y).max(of.semi_axes_m.z),
    };
    let begun = begun(&body, sources);
    let mut here = Mirrors {
        normal: begun.normal,
        point: [[0.0; WIDE]; 3],
        towards: [[[0.0; WIDE]; 3]; 2],
        distances_m: [[f64::INFINITY; WIDE]; 2],
        cosine: [0.0; WIDE],
        det_j: [0.0; WIDE],
        turn: [[0.0; WIDE]; 3],
        step_m: [f64::INFINITY; WIDE],
        sound: begun.sound,
    };
    for _ in 0..MOST_PLACES {
        here = next(&body, &begun, &here);
        let mut open = 0.0;
        for l in 0..WIDE {
            open += if here.step_m[l] >= LEAST_STEP_M { here.sound[l] } else { 0.0 };
        }
        if open == 0.0 {
            break;
        }
    }
    in_the_room(&body, &here, out);
}

/// Transforms sources to axes of the ellipsoid and computes the initial normals.
#[inline(always)]
fn begun(body: &Body, sources: &[WideRow3; 2]) -> Begun {
    let (b, mut begun) = (body.semi_axes_m, Begun::default());
    for l in 0..WIDE {
        let t = subtract(wide_lane(&sources[0], l), body.centre);
        let r = subtract(wide_lane(&sources[1], l), body.centre);
        let t = [dot(body.axes[0], t), dot(body.axes[1], t), dot(body.axes[2], t)];
        let r = [dot(body.axes[0], r), dot(body.axes[1], r), dot(body.axes[2], r)];
        let (t_unit, r_unit) = (over(t, b), over(r, b));
        let (t_m, r_m) = (dot(t, t).sqrt(), dot(r, r).sqrt());
        let bisector = add(scale(t, 1.0 / t_m), scale(r, 1.0 / r_m));
        let square = dot(bisector, bisector);
        let is_sound = (dot(t_unit, t_unit) >= TOUCHING * TOUCHING)
            & (dot(r_unit, r_unit) >= TOUCHING * TOUCHING)
            & (square >= 4.0 * LEAST_COSINE * LEAST_COSINE);
        let nearest_m = if t_m < r_m { t_m } else { r_m };
        store(&mut begun.tx, l, t);
        store(&mut begun.rx, l, r);
        store(&mut begun.normal, l, scale(bisector, 1.0 / square.sqrt()));
        begun.sound[l] = if is_sound { 1.0 } else { 0.0 };
        begun.near[l] = if nearest_m > FAR * body.longest_m { 0.0 } else { 1.0 };
        begun.nearest_m[l] = nearest_m;
    }
    let mut near = 0.0;
    for l in 0..WIDE {
        near += begun.near[l];
    }
    if near == 0.0 {
        return begun;
    }
    // For far sources the normal is the bisector; for touching ones the point is below them.
    let mut normals = begun.normal;
    for l in 0..WIDE {
        let bisector = wide_lane(&begun.normal, l);
        let support = normalized(times(b, bisector));
        let (t, r) = (over(wide_lane(&begun.tx, l), b), over(wide_lane(&begun.rx, l), b));
        let below = normalized(add(normalized(t), normalized(r)));
        let part = body.longest_m / begun.nearest_m[l];
        let part = if part < 1.0 { part } else { 1.0 };
        let unit = add(scale(support, 1.0 - part * part), scale(below, part * part));
        let normal = normalized(over(unit, b));
        store(&mut normals, l, choose(begun.near[l] != 0.0, normal, bisector));
    }
    Begun { normal: normals, ..begun }
}

/// Takes Newton's step. Lanes in which the last step was short enough keep their point.
#[inline(always)]
fn next(body: &Body, begun: &Begun, here: &Mirrors) -> Mirrors {
    let mut next = *here;
    for l in 0..WIDE {
        let old = wide_lane(&here.normal, l);
        let moved = normalized(add(old, wide_lane(&here.turn, l)));
        let normal = choose(here.step_m[l] >= LEAST_STEP_M, moved, old);
        let m = mirror(body.semi_axes_m, normal, wide_lane(&begun.tx, l), wide_lane(&begun.rx, l));
        // Steps that lengthen the path need halving, which is left to the method for one pair.
        let longest_m = here.distances_m[0][l] + here.distances_m[1][l] + 1e-12;
        let is_sound = (m.distances_m[0] + m.distances_m[1] <= longest_m) & (m.det_j > 0.0) & (m.det_j < f64::INFINITY);
        store(&mut next.normal, l, normal);
        store(&mut next.point, l, m.point);
        store(&mut next.towards[0], l, m.towards[0]);
        store(&mut next.towards[1], l, m.towards[1]);
        store(&mut next.turn, l, m.turn);
        next.distances_m[0][l] = m.distances_m[0];
        next.distances_m[1][l] = m.distances_m[1];
        next.cosine[l] = m.cosine;
        next.det_j[l] = m.det_j;
        next.step_m[l] = m.step_m;
        next.sound[l] = if is_sound { here.sound[l] } else { 0.0 };
    }
    next
}

/// Point as a mirror, in one lane.
struct Mirror {
    point: Vector,
    towards: [Vector; 2],
    distances_m: [f64; 2],
    cosine: f64,
    det_j: f64,
    turn: Vector,
    step_m: f64,
}

/// Evaluates the point with this normal, like `Mirror::new` of [`super::specular`].
#[inline(always)]
fn mirror(b: Vector, normal: Vector, tx: Vector, rx: Vector) -> Mirror {
    let square = times(b, b);
    let scaled = times(square, normal);
    let support_m = dot(scaled, normal).sqrt();
    let per_support = 1.0 / support_m;
    let point = scale(scaled, per_support);
    let (to_tx, to_rx) = (subtract(tx, point), subtract(rx, point));
    let (t_m, r_m) = (dot(to_tx, to_tx).sqrt().max(1e-9), dot(to_rx, to_rx).sqrt().max(1e-9));
    let (inverse_t, inverse_r) = (1.0 / t_m, 1.0 / r_m);
    let (t, r) = (scale(to_tx, inverse_t), scale(to_rx, inverse_r));
    let (per_t, per_r) = (0.5 * inverse_t, 0.5 * inverse_r);
    let cosine = 0.5 * (dot(normal, t) + dot(normal, r));
    let u = tangent(normal);
    let v = cross(normal, u);
    // Radii of curvature over the tangent plane, and their product.
    let (p_u, p_v) = (dot(point, u), dot(point, v));
    let (scaled_u, scaled_v) = (times(square, u), times(square, v));
    let s_uu = (dot(scaled_u, u) - p_u * p_u) * per_support;
    let s_uv = (dot(scaled_u, v) - p_u * p_v) * per_support;
    let s_vv = (dot(scaled_v, v) - p_v * p_v) * per_support;
    let root_s = b[0] * b[1] * b[2] * per_support * per_support;
    // Part of J due to the distances.
    let (t_u, t_v, r_u, r_v) = (dot(t, u), dot(t, v), dot(r, u), dot(r, v));
    let b_uu = (1.0 - t_u * t_u) * per_t + (1.0 - r_u * r_u) * per_r;
    let b_uv = -t_u * t_v * per_t - r_u * r_v * per_r;
    let b_vv = (1.0 - t_v * t_v) * per_t + (1.0 - r_v * r_v) * per_r;
    let c = if cosine > 0.05 { cosine } else { 0.05 };
    let (m_uu, m_uv) = (c + b_uu * s_uu + b_uv * s_uv, b_uu * s_uv + b_uv * s_vv);
    let (m_vu, m_vv) = (b_uv * s_uu + b_vv * s_uv, c + b_uv * s_uv + b_vv * s_vv);
    let det_m = m_uu * m_vv - m_uv * m_vu;
    let (g_u, g_v) = (0.5 * (t_u + r_u), 0.5 * (t_v + r_v));
    let per_det = 1.0 / det_m;
    let turn_u = (m_vv * g_u - m_uv * g_v) * per_det;
    let turn_v = (m_uu * g_v - m_vu * g_u) * per_det;
    let (moved_u, moved_v) = (s_uu * turn_u + s_uv * turn_v, s_uv * turn_u + s_vv * turn_v);
    Mirror {
        point,
        towards: [t, r],
        distances_m: [t_m, r_m],
        cosine,
        det_j: det_m / (root_s * root_s),
        turn: add(scale(u, turn_u), scale(v, turn_v)),
        step_m: (moved_u * moved_u + moved_v * moved_v).sqrt(),
    }
}

/// Converts the points found to room axes.
#[inline(always)]
fn in_the_room(body: &Body, here: &Mirrors, out: &mut SpecularRows) {
    let [x, y, z] = body.axes;
    for l in 0..WIDE {
        let (p, n) = (wide_lane(&here.point, l), wide_lane(&here.normal, l));
        let (t, r) = (wide_lane(&here.towards[0], l), wide_lane(&here.towards[1], l));
        store(&mut out.unit, l, over(p, body.semi_axes_m));
        store(&mut out.point, l, add(body.centre, turned(x, y, z, p)));
        store(&mut out.normal, l, turned(x, y, z, n));
        store(&mut out.towards[0], l, turned(x, y, z, t));
        store(&mut out.towards[1], l, turned(x, y, z, r));
        out.distances_m[0][l] = here.distances_m[0][l];
        out.distances_m[1][l] = here.distances_m[1][l];
        out.cosine[l] = here.cosine[l];
        out.det_j[l] = here.det_j[l];
        out.found[l] = if here.step_m[l] < LEAST_STEP_M { here.sound[l] } else { 0.0 };
    }
}

/// Converts a vector from the ellipsoid's axes to the room's.
#[inline(always)]
fn turned(x: Vector, y: Vector, z: Vector, of: Vector) -> Vector {
    add(add(scale(x, of[0]), scale(y, of[1])), scale(z, of[2]))
}

#[cfg(test)]
mod tests {
    use glam::{DMat3, DVec3};
    use radome_dsp::KernelLevel;
    use rand::Rng;

    use super::*;
    use crate::lanes::tests::assert_same_at_every_level;
    use crate::people::body::Build;
    use crate::random::{Purpose, generator};

    /// Draws a segment of a body in any pose and pairs of sources on any side: near ones, far ones, some within the
    /// body.
    fn draw(rng: &mut impl Rng) -> (Ellipsoid, [WideRow3; 2]) {
        let build = Build { height_m: 1.75, girth: 1.0 };
        let body = build.segments(&build.standing());
        let segment = body[rng.random_range(0..body.len())];
        let mut direction = || {
            let sphere = DVec3::from_array([0; 3].map(|_| rng.random_range(-1.0..1.0)));
            sphere.try_normalize().unwrap_or(DVec3::Z)
        };
        let axis = direction();
        let ways: [[DVec3; 2]; WIDE] = std::array::from_fn(|_| [direction(), direction()]);
        let axes = DMat3::from_axis_angle(axis, rng.random_range(0.0..3.0));
        let mut sources = [[[0.0; WIDE]; 3]; 2];
        for (l, [there, aside]) in ways.into_iter().enumerate() {
            let least_m = [0.02, 0.45, 2.0][l % 3];
            let tx = segment.centre + there * rng.random_range(least_m..8.0);
            let rx = if rng.random::<bool>() {
                tx + aside * 0.005
            } else {
                segment.centre + (there + 0.9 * aside).normalize() * rng.random_range(least_m..8.0)
            };
            store(&mut sources[0], l, tx.to_array());
            store(&mut sources[1], l, rx.to_array());
        }
        (Ellipsoid { axes, ..segment }, sources)
    }

    fn vector(rows: &WideRow3, l: usize) -> DVec3 {
        DVec3::from_array(wide_lane(rows, l))
    }

    /// Each lane agrees with the method for one pair: the point to some nanometres, path length and amplitude to
    /// rounding.
    #[test]
    fn lanes_are_specular_points_of_one_pair() {
        let mut rng = generator(21, Purpose::Build, [0, 0]);
        let (mut found, mut all) = (0, 0);
        for _ in 0..600 {
            let (e, sources) = draw(&mut rng);
            let mut rows = SpecularRows::default();
            specular_points(KernelLevel::detect(), &e, &sources, &mut rows);
            for l in 0..WIDE {
                let one = e.specular_point(vector(&sources[0], l), vector(&sources[1], l), None);
                all += 1;
                if rows.found[l] == 0.0 {
                    continue;
                }
                found += 1;
                let Some(one) = one else {
                    assert!(rows.cosine[l] <= LEAST_COSINE, "{e:?}: lane {l} of {sources:?}");
                    continue;
                };
                assert!(rows.cosine[l] > LEAST_COSINE && !(one.inside.0 || one.inside.1));
                let length_m = rows.distances_m[0][l] + rows.distances_m[1][l];
                assert!((length_m - one.distances_m.0 - one.distances_m.1).abs() < 1e-12, "{e:?}: {l} of {sources:?}");
                for (row, vector_of_one) in [
                    (&rows.point, one.point),
                    (&rows.unit, one.unit),
                    (&rows.normal, one.normal),
                    (&rows.towards[0], one.towards.0),
                    (&rows.towards[1], one.towards.1),
                ] {
                    assert!((vector(row, l) - vector_of_one).length() < 1e-7, "{e:?}: {l} of {sources:?}");
                }
                assert!((rows.cosine[l] / one.cosine - 1.0).abs() < 1e-7);
                assert!((rows.det_j[l] / one.det_j - 1.0).abs() < 1e-6);
            }
        }
        assert!(found > all / 2, "{found} of {all}");
    }

    #[test]
    fn every_level_gives_the_same_bits() {
        let mut rng = generator(22, Purpose::Build, [0, 0]);
        for _ in 0..50 {
            let (e, sources) = draw(&mut rng);
            assert_same_at_every_level(|level| {
                let mut rows = SpecularRows::default();
                specular_points(level, &e, &sources, &mut rows);
                let all = [&rows.point, &rows.unit, &rows.normal, &rows.towards[0], &rows.towards[1]];
                let bits = |row: &WideRow| row.map(f64::to_bits);
                let sound: Vec<bool> = rows.found.iter().map(|found| *found != 0.0).collect();
                let vectors = all.into_iter().flatten().map(bits);
                let rest = [&rows.distances_m[0], &rows.distances_m[1], &rows.cosine, &rows.det_j, &rows.found];
                let mut all: Vec<[u64; WIDE]> = vectors.chain(rest.into_iter().map(bits)).collect();
                // Lanes without a point are ignored.
                all.iter_mut().for_each(|row| {
                    row.iter_mut().zip(&sound).filter(|(_, sound)| !**sound).for_each(|(bits, _)| *bits = 0);
                });
                all
            });
        }
    }
}
