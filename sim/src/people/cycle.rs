//! A cycle of steps: poses at evenly spaced phases, joined by a periodic cubic spline so that velocities are
//! continuous. The module also finds the motion of the feet on the floor.

use std::f64::consts::TAU;

use glam::DVec3;

use super::skin::BoneMap;
use crate::math::median;

/// Height above the lowest point within which points of a foot touch the floor, as a part of the body's height: 5 mm
/// for 1.75 m.
const CONTACT_HEIGHT: f64 = 0.003;
/// Height of a foot's lowest point above the floor beyond which it does not touch, as a part of the body's height: 2 cm
/// for 1.75 m.
const FLIGHT_HEIGHT: f64 = 0.0115;
/// Number of harmonics of a cycle in which the body's speed may follow its feet: up to about 5 Hz.
const SURGE_HARMONICS: usize = 6;
/// Hint where a clip's cycle cannot be found.
pub(super) const CYCLE_HINT: &str = "say which part of it is one cycle of two steps: cycle_s = [begin, end]";
/// Iterations for the spline's coefficients. Each iteration halves the remaining error.
const SPLINE_ITERATIONS: usize = 60;

/// Position on the ground plan and in the cycle of steps, at a time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Walk {
    /// Position, m.
    pub position_m: [f64; 2],
    /// Heading, from +x towards +y, rad.
    pub heading_rad: f64,
    /// Number of cycles (two steps each) completed.
    pub phase: f64,
    /// Intensity of walking: 0 standing, 1 walking.
    pub intensity: f64,
}

/// Poses of bones over one cycle.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Cycle {
    /// Coefficients of cubic B-splines: `[phase][bone]`.
    coefficients: Vec<Vec<BoneMap>>,
}

impl Cycle {
    /// Makes a periodic curve through poses at the phases `k / count`.
    pub fn through(poses: &[Vec<BoneMap>]) -> Self {
        let count = poses.len();
        let mut coefficients = poses.to_vec();
        // c[k-1] + 4 c[k] + c[k+1] = 6 p[k], solved by Gauss-Seidel iteration.
        for _ in 0..SPLINE_ITERATIONS {
            for k in 0..count {
                for bone in 0..coefficients[k].len() {
                    let neighbours = coefficients[(k + count - 1) % count][bone] + coefficients[(k + 1) % count][bone];
                    coefficients[k][bone] = poses[k][bone] * 1.5 - neighbours * 0.25;
                }
            }
        }
        Cycle { coefficients }
    }

    /// Pose at a phase, in cycles.
    pub fn at(&self, phase: f64) -> Vec<BoneMap> {
        let count = self.coefficients.len();
        let scaled_phase = phase.rem_euclid(1.0) * count as f64;
        let (k, fraction) = (scaled_phase.floor(), scaled_phase - scaled_phase.floor());
        let rest = 1.0 - fraction;
        let weights = [
            rest * rest * rest / 6.0,
            (4.0 - 6.0 * fraction * fraction + 3.0 * fraction * fraction * fraction) / 6.0,
            (4.0 - 6.0 * rest * rest + 3.0 * rest * rest * rest) / 6.0,
            fraction * fraction * fraction / 6.0,
        ];
        let control_poses: [&[BoneMap]; 4] = std::array::from_fn(|i| {
            let index = (k as usize + count + i).checked_sub(1).and_then(|i| i.checked_rem(count));
            index.and_then(|i| self.coefficients.get(i)).map(Vec::as_slice).unwrap_or_default()
        });
        let bones = control_poses.iter().map(|a| a.len()).min().unwrap_or(0);
        let blended = |bone: usize| {
            weights.iter().zip(control_poses).map(|(&w, a)| a[bone] * w).fold(BoneMap::ZERO, |s, m| s + m)
        };
        (0..bones).map(blended).collect()
    }
}

/// Motion of the feet in a cycle.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Stance {
    /// Displacement of the body in a cycle, m, for which feet on the floor do not slide.
    pub travel_m: DVec3,
    /// Height of the floor under the feet, m.
    pub floor_m: f64,
    /// Residual sliding velocity of the contact points, by phase, m a cycle; `None` in flight.
    slips_m_per_cycle: Vec<Option<DVec3>>,
    /// Height of the lowest point above the floor, by phase, m.
    heights_m: Vec<f64>,
}

/// Sliding of feet that touch the floor.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct FootSliding {
    /// Speed of all feet that touch the floor, rms over a cycle, m/s. It includes feet that are just landing or lifting
    /// off.
    pub rms_m_per_s: f64,
    /// Speed of standing feet, rms, m/s. A standing foot moves backward under the body, at no more than twice the
    /// body's speed.
    pub standing_rms_m_per_s: f64,
    /// Part of the cycle in which a foot stands.
    pub standing: f64,
}

impl Stance {
    /// Finds the motion of the feet from points at even phases of a cycle without displacement: `[phase][point]`. z is
    /// up; `height_m` is the body's height.
    pub fn of(points: &[Vec<DVec3>], height_m: f64) -> Self {
        let count = points.len();
        let lowest_m: Vec<f64> = points.iter().map(|p| p.iter().map(|p| p.z).fold(f64::INFINITY, f64::min)).collect();
        let floor_m = median(lowest_m.clone());
        // Velocity of the contact points, m a cycle; `None` in flight.
        let contact_velocities = |k: usize| {
            let (before, now, after) = (&points[(k + count - 1) % count], &points[k], &points[(k + 1) % count]);
            let velocities = now.iter().enumerate().filter(|(_, p)| p.z < lowest_m[k] + CONTACT_HEIGHT * height_m);
            let velocities: Vec<DVec3> =
                velocities.map(|(i, _)| (after[i] - before[i]) * (0.5 * count as f64)).collect();
            let is_on_floor = lowest_m[k] <= floor_m + FLIGHT_HEIGHT * height_m;
            is_on_floor.then(|| median_velocity(&velocities))
        };
        let contact_velocities: Vec<Option<DVec3>> = (0..count).map(contact_velocities).collect();
        let on_floor: Vec<DVec3> = contact_velocities.iter().flatten().copied().collect();
        let median_on_floor = median_velocity(&on_floor);
        // A foot that swings close to the floor does not stand.
        let standing: Vec<DVec3> =
            on_floor.into_iter().filter(|&velocity| is_standing(velocity, median_on_floor)).collect();
        let mean = standing.iter().sum::<DVec3>() / standing.len().max(1) as f64;
        let slips_m_per_cycle = contact_velocities.iter().map(|t| t.map(|velocity| velocity - mean)).collect();
        Stance {
            travel_m: -mean,
            floor_m,
            slips_m_per_cycle,
            heights_m: lowest_m.iter().map(|z| z - floor_m).collect(),
        }
    }

    /// Returns the stance of a body that covers a given displacement in a cycle.
    pub fn with_travel(mut self, travel_m: DVec3) -> Self {
        let difference = travel_m - self.travel_m;
        self.slips_m_per_cycle.iter_mut().flatten().for_each(|slip| *slip += difference);
        Stance { travel_m, ..self }
    }

    /// Whether a contact point with a sliding velocity stands on the floor.
    fn is_standing_slip(&self, slip_m_per_cycle: DVec3) -> bool {
        is_standing(slip_m_per_cycle - self.travel_m, -self.travel_m)
    }

    /// Returns the displacement, by phase, m, that makes standing feet rest on the floor. It is added to uniform
    /// motion, forward and upward. It is smooth: it contains only the first harmonics of the cycle.
    pub fn surge_m(&self) -> Vec<DVec3> {
        let count = self.slips_m_per_cycle.len();
        let slip = |k: usize| self.slips_m_per_cycle[k].filter(|&s| self.is_standing_slip(s)).unwrap_or_default();
        // Heights need no integration.
        let height = |k: usize| if self.slips_m_per_cycle[k].is_some() { self.heights_m[k] } else { 0.0 };
        let mut surge = vec![DVec3::NEG_Z * (0..count).map(height).sum::<f64>() / count.max(1) as f64; count];
        for harmonic in 1..=SURGE_HARMONICS.min(count / 4) {
            let angle = |k: usize| TAU * (harmonic * k) as f64 / count as f64;
            let slip_coefficient =
                |of: fn(f64) -> f64| (0..count).map(|k| slip(k) * of(angle(k))).sum::<DVec3>() * (2.0 / count as f64);
            let (cosine, sine) = (slip_coefficient(f64::cos), slip_coefficient(f64::sin));
            let height_coefficient =
                |of: fn(f64) -> f64| (0..count).map(|k| height(k) * of(angle(k))).sum::<f64>() * (2.0 / count as f64);
            let (up_cosine, up_sine) = (height_coefficient(f64::cos), height_coefficient(f64::sin));
            // Subtracts the integral of `cosine cos + sine sin` over phase.
            let integral_factor = 1.0 / (TAU * harmonic as f64);
            for (k, surge) in surge.iter_mut().enumerate() {
                *surge -= (cosine * angle(k).sin() - sine * angle(k).cos()) * integral_factor;
                surge.z -= up_cosine * angle(k).cos() + up_sine * angle(k).sin();
            }
        }
        surge
    }

    /// Returns how much the feet slide at a walking speed.
    pub fn sliding(&self, speed_m_per_s: f64) -> FootSliding {
        let factor = speed_m_per_s / self.travel_m.length().max(1e-9);
        let rms = |slips: &[DVec3]| {
            let squares: f64 = slips.iter().map(|s| s.length_squared()).sum();
            (squares / slips.len().max(1) as f64).sqrt() * factor
        };
        let slips: Vec<DVec3> = self.slips_m_per_cycle.iter().flatten().copied().collect();
        let standing: Vec<DVec3> = slips.iter().copied().filter(|&s| self.is_standing_slip(s)).collect();
        FootSliding {
            rms_m_per_s: rms(&slips),
            standing_rms_m_per_s: rms(&standing),
            standing: standing.len() as f64 / self.slips_m_per_cycle.len().max(1) as f64,
        }
    }
}

/// Whether a contact point stands on the floor, from its velocity under the body and the median velocity. A standing
/// point moves backward, at no more than twice the median speed; a swinging one moves forward.
fn is_standing(velocity: DVec3, median_velocity: DVec3) -> bool {
    velocity.dot(median_velocity) > 0.0 && velocity.length() < 2.0 * median_velocity.length()
}

/// Componentwise median of velocities on the ground plan.
fn median_velocity(velocities: &[DVec3]) -> DVec3 {
    let component = |axis: usize| median(velocities.iter().map(|velocity| velocity[axis]).collect());
    DVec3::new(component(0), component(1), 0.0)
}

/// Positions relative to their centroid.
pub(super) fn centred(positions: &[DVec3]) -> Vec<DVec3> {
    let centroid = positions.iter().sum::<DVec3>() / positions.len().max(1) as f64;
    positions.iter().map(|&position| position - centroid).collect()
}

/// Root mean square of the distances between two lists of positions.
pub(super) fn rms_distance(a: &[DVec3], b: &[DVec3]) -> f64 {
    let squares: f64 = a.iter().zip(b).map(|(p, q)| p.distance_squared(*q)).sum();
    (squares / a.len().max(1) as f64).sqrt()
}

/// Finds the best cycle in a sequence of poses: first and last index, and cost. `positions` are those of joints,
/// `[pose][joint]`, at even times; `shortest` and `longest` count poses. Two poses are similar if their joints,
/// relative to the centroid, have similar positions and velocities.
pub(super) fn best_cycle(positions: &[Vec<DVec3>], shortest: usize, longest: usize) -> Option<(usize, usize, f64)> {
    let centred: Vec<Vec<DVec3>> = positions.iter().map(|p| centred(p)).collect();
    let pose_distance = |a: usize, b: usize| rms_distance(&centred[a], &centred[b]);
    let last = positions.len().checked_sub(1)?;
    let mut best: Option<(usize, usize, f64)> = None;
    for a in 1..last {
        for b in a + shortest..=(a + longest).min(last - 1) {
            // The poses before and after are compared too, so that velocities count as positions do.
            let cost = pose_distance(a, b) + pose_distance(a - 1, b - 1) + pose_distance(a + 1, b + 1);
            // A motionless stretch is similar at all times, so the cost is relative to the motion within the cycle.
            let largest_motion = (a..b).step_by(2).map(|i| pose_distance(a, i)).fold(0.0, f64::max);
            let cost = cost / largest_motion.max(1e-12);
            if best.is_none_or(|(_, _, least)| cost < least) {
                best = Some((a, b, cost));
            }
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use glam::DMat3;

    use super::*;

    #[test]
    fn the_curve_interpolates_poses_smoothly() {
        let pose = |phase: f64| {
            let centre = DVec3::new((TAU * phase).cos(), (2.0 * TAU * phase).sin(), 1.0);
            vec![BoneMap { centre, linear: DMat3::from_rotation_y(0.6 * (TAU * phase).sin()) }]
        };
        let poses: Vec<_> = (0..48).map(|k| pose(f64::from(k) / 48.0)).collect();
        let cycle = Cycle::through(&poses);
        for i in -500..500 {
            let phase = f64::from(i) / 333.0;
            let (found, exact) = (cycle.at(phase)[0], pose(phase)[0]);
            assert!(found.centre.distance(exact.centre) < 2e-5, "{phase}");
            assert!((found.linear.determinant() - 1.0).abs() < 1e-5, "turned without stretching at {phase}");
        }
    }

    /// Two feet, each on the floor for one half of the cycle and swung forward during the other half.
    #[test]
    fn travel_in_a_cycle_is_the_distance_that_standing_feet_move_back() {
        let foot = |phase: f64| {
            let p = phase.rem_euclid(1.0);
            // 1.4 m a cycle: the foot moves back by 0.7 m in half a cycle.
            if p < 0.5 {
                DVec3::new(0.35 - 1.4 * p, 0.0, 0.0)
            } else {
                DVec3::new(-0.35 + 1.4 * (p - 0.5), 0.0, 0.1 * (TAU * (p - 0.5)).sin())
            }
        };
        let points: Vec<Vec<DVec3>> =
            (0..60).map(|k| f64::from(k) / 60.0).map(|p| vec![foot(p), foot(p + 0.5)]).collect();
        let stance = Stance::of(&points, 1.75);
        assert!((stance.travel_m.x - 1.4).abs() < 0.03 && stance.travel_m.y.abs() < 1e-9, "{stance:?}");
        assert!(stance.floor_m.abs() < 1e-9);
        let sliding = stance.sliding(1.2);
        assert!(sliding.standing > 0.9 && sliding.standing_rms_m_per_s < 0.1, "{sliding:?}");
    }

    /// Uniform forward motion of the body makes feet slide whose backward motion is not uniform. The surge removes the
    /// sliding.
    #[test]
    fn the_surge_removes_foot_sliding() {
        let at = |p: f64| -1.4 * p + 0.03 * (2.0 * TAU * p).sin();
        let foot = |p: f64, side: f64| {
            let p = (p + side).rem_euclid(1.0);
            let z = if p < 0.52 { 0.0 } else { 0.2 };
            DVec3::new(at(p.min(0.55)) + (p - 0.55).max(0.0) * 2.0, 0.0, z)
        };
        let points = |surge: &dyn Fn(usize) -> DVec3| -> Vec<Vec<DVec3>> {
            let index_and_phase = |k: usize| (k, k as f64 / 100.0);
            (0..100).map(index_and_phase).map(|(k, p)| vec![foot(p, 0.0) + surge(k), foot(p, 0.5) + surge(k)]).collect()
        };
        let uncorrected = Stance::of(&points(&|_| DVec3::ZERO), 1.75);
        let surge = uncorrected.surge_m();
        let surging = Stance::of(&points(&|k| surge[k]), 1.75);
        let [before, after] = [&uncorrected, &surging].map(|s| s.sliding(1.2).standing_rms_m_per_s);
        assert!(before > 0.1 && after < 0.5 * before, "{before} to {after} m/s");
    }
}
