//! Vectorised search for the specular points of one ellipsoid for several pairs of sources. Each lane takes the same
//! steps as [`Ellipsoid::specular_point`]. Special cases are left to that method: sources in the body or on opposite
//! sides of it, and steps that lengthen the path.

// Loops use lane indices: several rows are accessed together, and the compiler vectorises these loops.
#![allow(clippy::needless_range_loop)]

use super::specular::{Ellipsoid, FAR, LEAST_COSINE, LEAST_STEP_M, TOUCHING};
use crate::lanes::vector::{Vector, add, choose, cross, dot, normalized, over, scale, store, subtract, tangent, times};
use crate::lanes::{WIDE, WideRow, WideRow3, compiled_for_levels, wide_lane};

/// Largest number of points that are evaluated. Lanes that need more are left to the method for one pair.
const MOST_EVALUATIONS: usize = 6;

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
    pub(crate) fn specular_points(
        ellipsoid: &Ellipsoid,
        sources: &[WideRow3; 2],
        out: &mut SpecularRows,
    ) = specular_points_body;
}

/// Constants of an ellipsoid.
struct Body {
    centre: Vector,
    axes: [Vector; 3],
    semi_axes_m: Vector,
    longest_m: f64,
}

/// Pairs of sources in axes of the ellipsoid, and the initial normals of the search.
#[derive(Clone, Copy, Default)]
struct Start {
    tx: WideRow3,
    rx: WideRow3,
    normal: WideRow3,
    /// 1 where an initial normal exists.
    regular: WideRow,
    /// 1 where a source is so near that the bisector is a poor initial normal.
    near: WideRow,
    /// Distance of the nearer source from the centre, m.
    nearest_m: WideRow,
}

/// Points of an ellipsoid, in its own axes, that reflect between two sources.
#[derive(Clone, Copy)]
struct Reflectors {
    normal: WideRow3,
    point: WideRow3,
    towards: [WideRow3; 2],
    distances_m: [WideRow; 2],
    cosine: WideRow,
    det_j: WideRow,
    /// Newton's step of the normal.
    normal_step: WideRow3,
    /// Resulting displacement of the point, m.
    step_m: WideRow,
    /// 1 where every step of the search was regular.
    regular: WideRow,
}

#[inline(always)]
fn specular_points_body(ellipsoid: &Ellipsoid, sources: &[WideRow3; 2], out: &mut SpecularRows) {
    let &Ellipsoid { centre, axes, semi_axes_m } = ellipsoid;
    let body = Body {
        centre: [centre.x, centre.y, centre.z],
        axes: [
            [axes.x_axis.x, axes.x_axis.y, axes.x_axis.z],
            [axes.y_axis.x, axes.y_axis.y, axes.y_axis.z],
            [axes.z_axis.x, axes.z_axis.y, axes.z_axis.z],
        ],
        semi_axes_m: [semi_axes_m.x, semi_axes_m.y, semi_axes_m.z],
        longest_m: semi_axes_m.x.max(semi_axes_m.y).max(semi_axes_m.z),
    };
    let start = start(&body, sources);
    let mut current = Reflectors {
        normal: start.normal,
        point: [[0.0; WIDE]; 3],
        towards: [[[0.0; WIDE]; 3]; 2],
        distances_m: [[f64::INFINITY; WIDE]; 2],
        cosine: [0.0; WIDE],
        det_j: [0.0; WIDE],
        normal_step: [[0.0; WIDE]; 3],
        step_m: [f64::INFINITY; WIDE],
        regular: start.regular,
    };
    for _ in 0..MOST_EVALUATIONS {
        current = next(&body, &start, &current);
        let mut unfinished = 0.0;
        for l in 0..WIDE {
            unfinished += if current.step_m[l] >= LEAST_STEP_M { current.regular[l] } else { 0.0 };
        }
        if unfinished == 0.0 {
            break;
        }
    }
    store_in_room(&body, &current, out);
}

/// Transforms sources to axes of the ellipsoid and computes the initial normals.
#[inline(always)]
fn start(body: &Body, sources: &[WideRow3; 2]) -> Start {
    let (b, mut start) = (body.semi_axes_m, Start::default());
    for l in 0..WIDE {
        let t = subtract(wide_lane(&sources[0], l), body.centre);
        let r = subtract(wide_lane(&sources[1], l), body.centre);
        let t = [dot(body.axes[0], t), dot(body.axes[1], t), dot(body.axes[2], t)];
        let r = [dot(body.axes[0], r), dot(body.axes[1], r), dot(body.axes[2], r)];
        let (t_unit, r_unit) = (over(t, b), over(r, b));
        let (t_m, r_m) = (dot(t, t).sqrt(), dot(r, r).sqrt());
        let bisector = add(scale(t, 1.0 / t_m), scale(r, 1.0 / r_m));
        let square = dot(bisector, bisector);
        let is_regular = (dot(t_unit, t_unit) >= TOUCHING * TOUCHING)
            & (dot(r_unit, r_unit) >= TOUCHING * TOUCHING)
            & (square >= 4.0 * LEAST_COSINE * LEAST_COSINE);
        let nearest_m = if t_m < r_m { t_m } else { r_m };
        store(&mut start.tx, l, t);
        store(&mut start.rx, l, r);
        store(&mut start.normal, l, scale(bisector, 1.0 / square.sqrt()));
        start.regular[l] = if is_regular { 1.0 } else { 0.0 };
        start.near[l] = if nearest_m > FAR * body.longest_m { 0.0 } else { 1.0 };
        start.nearest_m[l] = nearest_m;
    }
    let mut near = 0.0;
    for l in 0..WIDE {
        near += start.near[l];
    }
    if near == 0.0 {
        return start;
    }
    // For far sources the normal is the bisector; for touching ones the point is below them.
    let mut normals = start.normal;
    for l in 0..WIDE {
        let bisector = wide_lane(&start.normal, l);
        let by_bisector = normalized(times(b, bisector));
        let (t, r) = (over(wide_lane(&start.tx, l), b), over(wide_lane(&start.rx, l), b));
        let below = normalized(add(normalized(t), normalized(r)));
        let nearness = body.longest_m / start.nearest_m[l];
        let nearness = if nearness < 1.0 { nearness } else { 1.0 };
        let weight = nearness * nearness;
        let unit = add(scale(by_bisector, 1.0 - weight), scale(below, weight));
        let normal = normalized(over(unit, b));
        store(&mut normals, l, choose(start.near[l] != 0.0, normal, bisector));
    }
    Start { normal: normals, ..start }
}

/// Takes Newton's step. Lanes in which the last step was short enough keep their point.
#[inline(always)]
fn next(body: &Body, start: &Start, current: &Reflectors) -> Reflectors {
    let mut next = *current;
    for l in 0..WIDE {
        let old = wide_lane(&current.normal, l);
        let moved = normalized(add(old, wide_lane(&current.normal_step, l)));
        let normal = choose(current.step_m[l] >= LEAST_STEP_M, moved, old);
        let new = reflector(body.semi_axes_m, normal, wide_lane(&start.tx, l), wide_lane(&start.rx, l));
        // Steps that lengthen the path need halving, which is left to the method for one pair.
        let longest_m = current.distances_m[0][l] + current.distances_m[1][l] + 1e-12;
        let is_regular =
            (new.distances_m[0] + new.distances_m[1] <= longest_m) & (new.det_j > 0.0) & (new.det_j < f64::INFINITY);
        store(&mut next.normal, l, normal);
        store(&mut next.point, l, new.point);
        store(&mut next.towards[0], l, new.towards[0]);
        store(&mut next.towards[1], l, new.towards[1]);
        store(&mut next.normal_step, l, new.normal_step);
        next.distances_m[0][l] = new.distances_m[0];
        next.distances_m[1][l] = new.distances_m[1];
        next.cosine[l] = new.cosine;
        next.det_j[l] = new.det_j;
        next.step_m[l] = new.step_m;
        next.regular[l] = if is_regular { current.regular[l] } else { 0.0 };
    }
    next
}

/// Point that reflects, in one lane.
struct Reflector {
    point: Vector,
    towards: [Vector; 2],
    distances_m: [f64; 2],
    cosine: f64,
    det_j: f64,
    normal_step: Vector,
    step_m: f64,
}

/// Evaluates the point with this normal, like `Reflector::new` of [`super::specular`].
#[inline(always)]
fn reflector(b: Vector, normal: Vector, tx: Vector, rx: Vector) -> Reflector {
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
    let (step_u, step_v) = (s_uu * turn_u + s_uv * turn_v, s_uv * turn_u + s_vv * turn_v);
    Reflector {
        point,
        towards: [t, r],
        distances_m: [t_m, r_m],
        cosine,
        det_j: det_m / (root_s * root_s),
        normal_step: add(scale(u, turn_u), scale(v, turn_v)),
        step_m: (step_u * step_u + step_v * step_v).sqrt(),
    }
}

/// Converts the points found to room axes.
#[inline(always)]
fn store_in_room(body: &Body, found: &Reflectors, out: &mut SpecularRows) {
    let [x, y, z] = body.axes;
    for l in 0..WIDE {
        let (p, n) = (wide_lane(&found.point, l), wide_lane(&found.normal, l));
        let (t, r) = (wide_lane(&found.towards[0], l), wide_lane(&found.towards[1], l));
        store(&mut out.unit, l, over(p, body.semi_axes_m));
        store(&mut out.point, l, add(body.centre, room_vector(x, y, z, p)));
        store(&mut out.normal, l, room_vector(x, y, z, n));
        store(&mut out.towards[0], l, room_vector(x, y, z, t));
        store(&mut out.towards[1], l, room_vector(x, y, z, r));
        out.distances_m[0][l] = found.distances_m[0][l];
        out.distances_m[1][l] = found.distances_m[1][l];
        out.cosine[l] = found.cosine[l];
        out.det_j[l] = found.det_j[l];
        out.found[l] = if found.step_m[l] < LEAST_STEP_M { found.regular[l] } else { 0.0 };
    }
}

/// Converts a vector from the ellipsoid's axes to the room's.
#[inline(always)]
fn room_vector(x: Vector, y: Vector, z: Vector, vector: Vector) -> Vector {
    add(add(scale(x, vector[0]), scale(y, vector[1])), scale(z, vector[2]))
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
        let directions: [[DVec3; 2]; WIDE] = std::array::from_fn(|_| [direction(), direction()]);
        let axes = DMat3::from_axis_angle(axis, rng.random_range(0.0..3.0));
        let mut sources = [[[0.0; WIDE]; 3]; 2];
        for (l, [there, aside]) in directions.into_iter().enumerate() {
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
    fn lanes_agree_with_the_method_for_one_pair() {
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
                let is_found: Vec<bool> = rows.found.iter().map(|found| *found != 0.0).collect();
                let vectors = all.into_iter().flatten().map(bits);
                let rest = [&rows.distances_m[0], &rows.distances_m[1], &rows.cosine, &rows.det_j, &rows.found];
                let mut all: Vec<[u64; WIDE]> = vectors.chain(rest.into_iter().map(bits)).collect();
                // Lanes without a point are ignored.
                all.iter_mut().for_each(|row| {
                    row.iter_mut().zip(&is_found).filter(|(_, is_found)| !**is_found).for_each(|(bits, _)| *bits = 0);
                });
                all
            });
        }
    }
}
