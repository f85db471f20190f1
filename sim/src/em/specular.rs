//! Specular point of an ellipsoid for a pair of images of transmitter and receiver, in the near field.
//!
//! The method is the stationary phase of physical optics: `R_t + R_r` is least at the specular point. `J` is the
//! Hessian of `(R_t + R_r)/2` over the tangent plane. The echo's amplitude relative to the transmitted field is
//! `lambda/(4 pi) * cos/(2 sqrt(det J) R_t R_r)` times the reflection coefficient at the true incidence. In the
//! monostatic case `det J = (k1 + 1/R)(k2 + 1/R)`, `sigma = pi / det J`.
//!
//! The unknown of the search is the normal n. The point with that normal is `A n / h`, where A has the squares of the
//! semi-axes and `h^2 = n.A n`. The radii of curvature there are those of `S = (A - p p^T)/h`. Newton's step is `(c + B
//! S) dn = g`, with B the part of J due to the distances, c the cosine and g the gradient. It ends at once for far
//! sources (the normal is the bisector), and after two or three steps elsewhere.

use glam::{DMat3, DVec3};

/// Ellipsoid in the room.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ellipsoid {
    /// Centre, m.
    pub centre: DVec3,
    /// Directions of the semi-axes, in columns (a rotation).
    pub axes: DMat3,
    /// Semi-axes, m.
    pub semi_axes_m: DVec3,
}

/// Specular point of an ellipsoid for a pair of antennas.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SpecularPoint {
    /// Position, m.
    pub point: DVec3,
    /// Corresponding point of the unit sphere. A fixed point of the sphere follows a point of the moving body.
    pub unit: DVec3,
    /// Outward unit normal.
    pub normal: DVec3,
    /// Distances to transmitter and receiver, m.
    pub distances_m: (f64, f64),
    /// Unit vectors from the point to transmitter and receiver.
    pub towards: (DVec3, DVec3),
    /// Cosine of the angle of incidence.
    pub cosine: f64,
    /// Determinant of J, 1/m^2.
    pub det_j: f64,
    /// Whether transmitter and receiver lay inside the body and were moved to its surface.
    pub inside: (bool, bool),
}

/// Distance from the centre, in units of the ellipsoid's own radius, below which a source counts as touching it.
pub(super) const TOUCHING: f64 = 1.02;
/// Step length at which Newton's method ends, m. Where a limb has its largest curvature, the amplitude error is then a
/// millionth. The error of the path length is quadratic in the step.
pub(super) const LEAST_STEP_M: f64 = 5e-9;
/// Largest number of Newton steps.
const MOST_STEPS: usize = 25;
/// Least cosine of incidence of a specular point.
pub(crate) const LEAST_COSINE: f64 = 0.1;
/// Distance of a source, in lengths of the ellipsoid, beyond which the normal at the specular point is the bisector.
pub(super) const FAR: f64 = 7.0;

impl Ellipsoid {
    /// Returns its half-widths along the room's axes, m.
    pub fn half_widths_m(&self) -> DVec3 {
        let along = |axis: usize| (self.axes.row(axis) * self.semi_axes_m).length();
        DVec3::new(along(0), along(1), along(2))
    }

    /// Returns the point of the surface for a point of the unit sphere.
    pub fn surface(&self, unit: DVec3) -> DVec3 {
        self.centre + self.axes * (unit * self.semi_axes_m)
    }

    /// Converts a source to axes of the ellipsoid, and moves it to the surface if it lies inside. Also returns whether
    /// it does.
    fn moved_outside(&self, source: DVec3) -> (DVec3, bool) {
        let position = self.axes.transpose() * (source - self.centre);
        let unit = position / self.semi_axes_m;
        let square = unit.length_squared();
        if square >= TOUCHING * TOUCHING {
            return (position, false);
        }
        let radius = square.sqrt();
        let outward = if radius > 1e-9 { unit / radius } else { DVec3::X };
        (outward * TOUCHING * self.semi_axes_m, true)
    }

    /// Returns the initial normal of the search for the specular point of two sources; `None` where they lie on
    /// opposite sides.
    fn first_normal(&self, [tx, rx]: [DVec3; 2]) -> Option<DVec3> {
        let b = self.semi_axes_m;
        let bisector = tx.normalize_or_zero() + rx.normalize_or_zero();
        if bisector.length_squared() < 4.0 * LEAST_COSINE * LEAST_COSINE {
            return None;
        }
        let nearest_m = tx.length().min(rx.length());
        let longest_m = b.max_element();
        if nearest_m > FAR * longest_m {
            return Some(bisector.normalize());
        }
        // For far sources the normal is the bisector; for touching ones the point is below them. On the unit sphere,
        // the first point is between these two.
        let by_bisector = (b * bisector).normalize();
        let below = ((tx / b).normalize() + (rx / b).normalize()).normalize_or_zero();
        let weight = (longest_m / nearest_m).clamp(0.0, 1.0).powi(2);
        let unit = by_bisector.lerp(below, weight).normalize_or(by_bisector);
        Some((unit / b).normalize())
    }

    /// Finds the specular point for a pair of points; `None` where the pair lies on opposite sides (forward scattering,
    /// which has no specular point).
    ///
    /// `start` is a point of the unit sphere near the solution, if one is known. It is used only where directions from
    /// the centre do not determine on which side of the ellipsoid the pair lies.
    pub fn specular_point(&self, tx: DVec3, rx: DVec3, start: Option<DVec3>) -> Option<SpecularPoint> {
        let ((tx, tx_inside), (rx, rx_inside)) = (self.moved_outside(tx), self.moved_outside(rx));
        let b = self.semi_axes_m;
        let first = self.first_normal([tx, rx]).or_else(|| Some((start? / b).normalize()))?;
        let mut current = Reflector::new(b, first, [tx, rx])?;
        for _ in 0..MOST_STEPS {
            if current.step_m < LEAST_STEP_M {
                break;
            }
            current = current.next(b, [tx, rx])?;
        }
        (current.cosine > LEAST_COSINE).then(|| current.in_room(self, (tx_inside, rx_inside)))
    }
}

/// Bounds of the properties of a specular point, without its computation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SpecularPointBound {
    /// Largest `cos / (2 sqrt(det J))`, m.
    pub strength_m: f64,
    /// Least cosine of the angle of incidence.
    pub least_cosine: f64,
    /// Largest cosine of the angle of incidence.
    pub most_cosine: f64,
}

impl Ellipsoid {
    /// Bounds the specular point for any pair of points within `apart_m` of these, without a search; `None` where none
    /// exists.
    ///
    /// At a specular point both directions are at the same angle from the normal. The part of J due to distances is
    /// thus at least `cos (1/R_t + 1/R_r)/2` in each tangent direction on geometric mean. By Minkowski's inequality for
    /// determinants `sqrt(det J) >= cos (sqrt(K) + (1/R_t + 1/R_r)/2)`, with Gauss's curvature `K = (h^2/(abc))^2` at
    /// the normal's support h. The normal is the fixed point of a map: from a normal to the bisector at the point with
    /// that normal. Where the map is a contraction, two iterations bound the distance of the fixed point from the
    /// second, and that of the specular point from the point with the first normal. Elsewhere the flattest side gives
    /// the bound.
    pub fn bound(&self, tx: DVec3, rx: DVec3, apart_m: f64) -> Option<SpecularPointBound> {
        let (to_body, b) = (self.axes.transpose(), self.semi_axes_m);
        let sources = [tx, rx].map(|source| to_body * (source - self.centre));
        let (longest_m, shortest_m) = (b.max_element(), b.min_element());
        let reach_m = longest_m + apart_m;
        let distances_m = sources.map(|source| source.length());
        let by_distance: f64 = distances_m.iter().map(|distance| 0.5 / (distance + reach_m)).sum();
        let strength_m = |support_m: f64| 0.5 / (support_m * support_m / b.element_product() + by_distance);
        let near_m = distances_m.map(|distance| distance - reach_m);
        let loosest = SpecularPointBound { strength_m: strength_m(shortest_m), least_cosine: 0.0, most_cosine: 1.0 };
        if near_m[0] <= 0.0 || near_m[1] <= 0.0 {
            return Some(loosest);
        }
        let bisector =
            |point: DVec3| (sources[0] - point).normalize_or_zero() + (sources[1] - point).normalize_or_zero();
        // Sum of the largest angles by which the directions to both sources, from any point of the body, differ from
        // those at the centre.
        let direction_change: f64 = distances_m.iter().map(|distance| (reach_m / distance).min(1.0).asin()).sum();
        let middle = bisector(DVec3::ZERO);
        let twice_cosine = middle.length();
        let most_cosine = 0.5 * (twice_cosine + direction_change);
        if most_cosine < LEAST_COSINE {
            return None;
        }
        let least_twice_cosine = twice_cosine - direction_change;
        if least_twice_cosine <= 0.0 {
            return Some(SpecularPointBound { most_cosine, ..loosest });
        }
        let first = middle / twice_cosine;
        let scaled = b * b * first;
        let at_first = bisector(scaled / scaled.dot(first).sqrt());
        let second = at_first.normalize_or(first);
        let per_near_m = 1.0 / near_m[0] + 1.0 / near_m[1];
        let (per_m, radius_m) = (per_near_m / least_twice_cosine, longest_m * longest_m / shortest_m);
        let contraction = radius_m * per_m;
        let first_step = first.distance(second);
        if contraction >= 0.9 || first_step > 0.5 {
            return Some(SpecularPointBound { least_cosine: 0.5 * least_twice_cosine, most_cosine, ..loosest });
        }
        // An angle of half a radian is 1 % longer than its chord.
        let remaining = (apart_m * per_m + 1.02 * contraction * first_step) / (1.0 - contraction);
        let support_m = ((b * second).length() - longest_m * remaining).max(shortest_m);
        // The point moves by at most the largest radius of curvature times the angle.
        let apart_m = apart_m + 1.02 * radius_m * (first_step + remaining);
        let most_cosine = if first_step + remaining > 0.5 {
            most_cosine
        } else {
            most_cosine.min(0.5 * (at_first.length() + apart_m * per_near_m))
        };
        Some(SpecularPointBound {
            strength_m: strength_m(support_m),
            least_cosine: 0.5 * least_twice_cosine,
            most_cosine,
        })
    }
}

/// Point of an ellipsoid, in its own axes, that reflects between two sources.
#[derive(Debug, Clone, Copy)]
struct Reflector {
    normal: DVec3,
    point: DVec3,
    distances_m: [f64; 2],
    towards: [DVec3; 2],
    cosine: f64,
    det_j: f64,
    /// Newton's step of the normal.
    normal_step: DVec3,
    /// Resulting displacement of the point, m.
    step_m: f64,
}

impl Reflector {
    /// Evaluates the point with this normal; `None` where `det_j` is not finite and positive.
    fn new(b: DVec3, normal: DVec3, sources: [DVec3; 2]) -> Option<Self> {
        let square = b * b;
        let scaled = square * normal;
        let support_m = scaled.dot(normal).sqrt();
        let point = scaled / support_m;
        let offsets = sources.map(|source| source - point);
        let distances_m = offsets.map(|offset| offset.length().max(1e-9));
        let towards = [offsets[0] / distances_m[0], offsets[1] / distances_m[1]];
        let [t, r] = towards;
        let [per_t, per_r] = distances_m.map(|distance| 0.5 / distance);
        let cosine = 0.5 * (normal.dot(t) + normal.dot(r));
        let u = normal.any_orthonormal_vector();
        let v = normal.cross(u);
        // Radii of curvature over the tangent plane, and their product.
        let (p_u, p_v) = (point.dot(u), point.dot(v));
        let (scaled_u, scaled_v) = (square * u, square * v);
        let s_uu = (scaled_u.dot(u) - p_u * p_u) / support_m;
        let s_uv = (scaled_u.dot(v) - p_u * p_v) / support_m;
        let s_vv = (scaled_v.dot(v) - p_v * p_v) / support_m;
        let det_s = (b.element_product() / (support_m * support_m)).powi(2);
        // Part of J due to the distances.
        let (t_u, t_v, r_u, r_v) = (t.dot(u), t.dot(v), r.dot(u), r.dot(v));
        let b_uu = (1.0 - t_u * t_u) * per_t + (1.0 - r_u * r_u) * per_r;
        let b_uv = -t_u * t_v * per_t - r_u * r_v * per_r;
        let b_vv = (1.0 - t_v * t_v) * per_t + (1.0 - r_v * r_v) * per_r;
        let c = cosine.max(0.05);
        let m = [
            [c + b_uu * s_uu + b_uv * s_uv, b_uu * s_uv + b_uv * s_vv],
            [b_uv * s_uu + b_vv * s_uv, c + b_uv * s_uv + b_vv * s_vv],
        ];
        let det_m = m[0][0] * m[1][1] - m[0][1] * m[1][0];
        let det_j = det_m / det_s;
        if !(det_j.is_finite() && det_j > 0.0) {
            return None;
        }
        let (g_u, g_v) = (0.5 * (t_u + r_u), 0.5 * (t_v + r_v));
        let turn_u = (m[1][1] * g_u - m[0][1] * g_v) / det_m;
        let turn_v = (m[0][0] * g_v - m[1][0] * g_u) / det_m;
        let (step_u, step_v) = (s_uu * turn_u + s_uv * turn_v, s_uv * turn_u + s_vv * turn_v);
        let step_m = (step_u * step_u + step_v * step_v).sqrt();
        let normal_step = u * turn_u + v * turn_v;
        Some(Reflector { normal, point, distances_m, towards, cosine, det_j, normal_step, step_m })
    }

    /// Takes Newton's step, halved for as long as it lengthens the path.
    fn next(&self, b: DVec3, sources: [DVec3; 2]) -> Option<Self> {
        let length_m = |reflector: &Reflector| reflector.distances_m[0] + reflector.distances_m[1];
        let mut fraction = 1.0;
        loop {
            let next = Reflector::new(b, (self.normal + self.normal_step * fraction).normalize(), sources)?;
            if length_m(&next) <= length_m(self) + 1e-12 || fraction < 1e-3 {
                return Some(next);
            }
            fraction *= 0.5;
        }
    }

    /// Converts the point to room coordinates.
    fn in_room(&self, ellipsoid: &Ellipsoid, inside: (bool, bool)) -> SpecularPoint {
        SpecularPoint {
            point: ellipsoid.centre + ellipsoid.axes * self.point,
            unit: self.point / ellipsoid.semi_axes_m,
            normal: ellipsoid.axes * self.normal,
            distances_m: (self.distances_m[0], self.distances_m[1]),
            towards: (ellipsoid.axes * self.towards[0], ellipsoid.axes * self.towards[1]),
            cosine: self.cosine,
            det_j: self.det_j,
            inside,
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::Rng;

    use super::*;
    use crate::people::body::Build;
    use crate::random::{Purpose, generator};

    /// Draws a segment of a body and two sources on any side of it. They are as far apart as two antennas of a radar,
    /// or as image antennas.
    fn draw(rng: &mut impl Rng, near_m: f64) -> (Ellipsoid, DVec3, DVec3) {
        let build = Build { height_m: 1.75, girth: 1.0 };
        let body = build.segments(&build.standing());
        let segment = body[rng.random_range(0..body.len())];
        let mut direction = || {
            let sphere = DVec3::from_array([0; 3].map(|_| rng.random_range(-1.0..1.0)));
            sphere.try_normalize().unwrap_or(DVec3::Z)
        };
        let (axis, there, aside) = (direction(), direction(), direction());
        let axes = DMat3::from_axis_angle(axis, rng.random_range(0.0..3.0));
        let tx = segment.centre + there * rng.random_range(near_m..8.0);
        let rx = if rng.random::<bool>() {
            tx + aside * 0.005
        } else {
            segment.centre + (there + 0.5 * aside).normalize() * rng.random_range(near_m..8.0)
        };
        (Ellipsoid { axes, ..segment }, tx, rx)
    }

    /// Minimises a function over the unit sphere by descent from `start`. Steps are halved where none leads downhill,
    /// down to `least_step`.
    fn minimum(function: impl Fn(DVec3) -> f64, start: DVec3, mut step: f64, least_step: f64) -> DVec3 {
        let (mut unit, mut value) = (start, function(start));
        while step > least_step {
            let u = unit.any_orthonormal_vector();
            let v = unit.cross(u);
            let around = [u, -u, v, -v].map(|direction| (unit + direction * step).normalize());
            let best = around.into_iter().min_by(|a, b| function(*a).total_cmp(&function(*b))).unwrap_or(unit);
            if function(best) < value {
                (unit, value) = (best, function(best));
            } else {
                step *= 0.5;
            }
        }
        unit
    }

    /// Finds the specular point by search: the shortest path, then the point that best fulfils the law of reflection.
    /// The minimum of a length determines the point to only half of the digits.
    fn by_search(e: &Ellipsoid, tx: DVec3, rx: DVec3) -> DVec3 {
        let length = |unit: DVec3| e.surface(unit).distance(tx) + e.surface(unit).distance(rx);
        let mirror_error = |unit: DVec3| {
            let point = e.surface(unit);
            let normal = (e.axes * (unit / e.semi_axes_m)).normalize();
            ((tx - point).normalize() + (rx - point).normalize()).cross(normal).length_squared()
        };
        let candidates = (0..200).map(|i| {
            let z = 1.0 - (2.0 * f64::from(i) + 1.0) / 200.0;
            let (sine, cosine) = (2.399_963_229_728_653 * f64::from(i)).sin_cos();
            let ring = (1.0 - z * z).sqrt();
            DVec3::new(ring * cosine, ring * sine, z)
        });
        let first = candidates.min_by(|a, b| length(*a).total_cmp(&length(*b))).unwrap_or(DVec3::Z);
        minimum(mirror_error, minimum(length, first, 0.2, 1e-5), 1e-5, 1e-11)
    }

    /// Returns the amplitude without constants.
    fn amplitude(cosine: f64, det_j: f64, [r_t, r_r]: [f64; 2]) -> f64 {
        cosine / (det_j.sqrt() * r_t * r_r)
    }

    /// For random segments, poses and sources, the path agrees to 1e-7 m and the amplitude to 1e-6 with a search
    /// without gradients.
    #[test]
    fn specular_points_are_where_the_path_is_shortest() {
        let mut rng = generator(11, Purpose::Build, [0, 0]);
        let mut seen = 0;
        for _ in 0..300 {
            let (e, tx, rx) = draw(&mut rng, 0.45);
            let Some(h) = e.specular_point(tx, rx, None) else { continue };
            let unit = by_search(&e, tx, rx);
            let point = e.surface(unit);
            let length_m = point.distance(tx) + point.distance(rx);
            assert!((h.distances_m.0 + h.distances_m.1 - length_m).abs() < 1e-7, "{e:?} {tx} {rx}");
            let sources = [tx, rx].map(|source| e.moved_outside(source).0);
            let exact = Reflector::new(e.semi_axes_m, (unit / e.semi_axes_m).normalize(), sources).expect("numbers");
            let ours = amplitude(h.cosine, h.det_j, [h.distances_m.0, h.distances_m.1]);
            let ratio = ours / amplitude(exact.cosine, exact.det_j, exact.distances_m);
            assert!((ratio - 1.0).abs() < 1e-6, "{e:?} {tx} {rx}: {ratio}");
            assert!((h.unit.length() - 1.0).abs() < 1e-12 && (h.point - e.surface(h.unit)).length() < 1e-12);
            seen += 1;
        }
        assert!(seen > 200, "{seen}");
    }

    /// From two metres on, three points are evaluated: the first, and one after each of two steps. There are four where
    /// a limb is seen from its end.
    #[test]
    fn few_steps_are_taken() {
        let mut rng = generator(12, Purpose::Build, [0, 0]);
        let (mut evaluations, mut all) = (0, 0);
        for _ in 0..2000 {
            let (e, tx, rx) = draw(&mut rng, 2.0);
            let sources = [tx, rx].map(|source| e.moved_outside(source).0);
            let Some(first) = e.first_normal(sources) else { continue };
            let mut current = Reflector::new(e.semi_axes_m, first, sources).expect("numbers");
            (evaluations, all) = (evaluations + 1, all + 1);
            while current.step_m >= LEAST_STEP_M {
                current = current.next(e.semi_axes_m, sources).expect("numbers");
                evaluations += 1;
            }
        }
        assert!(f64::from(evaluations) < 3.2 * f64::from(all), "{evaluations} of {all}");
    }

    /// A start value from a neighbouring instant changes the result only where no other start value exists.
    #[test]
    fn a_start_does_not_change_a_specular_point() {
        let mut rng = generator(13, Purpose::Build, [0, 0]);
        for _ in 0..200 {
            let (e, tx, rx) = draw(&mut rng, 0.45);
            let Some(h) = e.specular_point(tx, rx, None) else { continue };
            let again = e.specular_point(tx, rx, Some(-h.unit)).expect("visible");
            assert_eq!(again, h);
        }
    }

    /// No specular point exceeds its bound, for sources anywhere near those given. From three metres on most are within
    /// a decibel and a half of it.
    #[test]
    fn bounds_hold_and_are_close() {
        let mut rng = generator(14, Purpose::Build, [0, 0]);
        let (mut close, mut far) = (0, 0);
        for i in 0..6000 {
            let near_m = [0.45, 1.0, 3.0][i % 3];
            let (e, tx, rx) = draw(&mut rng, near_m);
            let Some(h) = e.specular_point(tx, rx, None) else { continue };
            let strength_m = 0.5 * h.cosine / h.det_j.sqrt();
            let mut nearby = || DVec3::from_array([0; 3].map(|_| rng.random_range(-0.01..0.01)));
            let (tx, rx) = (tx + nearby(), rx + nearby());
            let bound = e.bound(tx, rx, 0.02).expect("it is seen");
            assert!(strength_m <= bound.strength_m * (1.0 + 1e-9), "{e:?} {tx} {rx}: {strength_m} {bound:?}");
            let range = bound.least_cosine..=bound.most_cosine;
            assert!(range.contains(&h.cosine), "{e:?} {tx} {rx}: {} {bound:?}", h.cosine);
            let exact = e.bound(tx, rx, 0.0).expect("it is seen");
            far += usize::from(near_m == 3.0);
            close += usize::from(near_m == 3.0 && exact.strength_m < 1.19 * strength_m);
        }
        assert!(close > far / 2, "{close} of {far}");
    }
}
