//! Trajectory of a person from the echoes of a tracklet. A Kalman filter and a backward Rauch-Tung-Striebel smoother
//! are repeated until the result converges. Each pass is linearised about the previous result (the Gauss-Newton step of
//! the whole trajectory).
//!
//! The state is a position and a velocity on the floor plan. An echo measures the range of the trunk's near surface,
//! its radial speed, and a direction cosine. The body's axis lies behind that surface ([`REACH_M`]). Limbs and ghosts
//! off walls deviate by far more than noise, so the weight of an echo falls with its deviation, as with Student's
//! distribution.

use std::f64::consts::PI;

use glam::{DMat3, DMat4, DVec2, DVec3, DVec4};
use radome_dsp::Waveform;
use radome_dsp::detect::Baseline;
use radome_sim::Scene;
use radome_sim::em::image::{BoxRoom, Wall};
use radome_sim::em::pattern::Pattern;
use radome_sim::scene::ANTENNA_OFFSETS_M;

use super::detections::{Detections, EchoIndex};

/// Distance from the middle of the chest to its front or back surface, and to its side, m: its semi-axes in a body of
/// average girth (sim/src/people/body.rs).
const REACH_M: [f64; 2] = [0.115, 0.165];
/// Distance of the chest before the hips of a walking person, who leans forward, m.
const LEAN_M: f64 = 0.024;
/// Height of the chest's middle relative to that of the body.
pub const CHEST_HEIGHT: f64 = 0.72;
/// Standard errors of an echo's range (m) and speed (m/s), since the echo comes from any part of the trunk.
const RANGE_M: f64 = 0.06;
const SPEED_M_PER_S: f64 = 0.12;
/// Standard errors of its direction: from ghosts off walls, and across the body (m).
const COSINE: f64 = 0.03;
const ACROSS_M: f64 = 0.08;
/// Change of velocity of a walking person, m/s per root second. It is larger when a person turns or stops.
const ACCELERATION_NOISE: f64 = 0.2;
/// Time over which a turn is detected, s, and largest factor of a turn on the process noise.
const TURN_S: f64 = 0.5;
const MOST_TURN: f64 = 300.0;
/// Relative field of the merged ghosts below which a person counts as visible: -6 dB.
const VISIBLE_BELOW_FIELD: f64 = 0.5;
/// Fraction of the incident power that a wall scatters by Lambert's law, the largest measured one (sim/src/diffuse/), and area
/// of wall in a range cell, m^2.
const WALL_SCATTERING: f64 = 0.16;
const WALL_PIECE_M2: f64 = 3.0;
/// Least length of a path to a wall, m.
const LEAST_LEG_M: f64 = 0.3;
/// Degrees of freedom of Student's distribution of the errors.
const DEGREES_OF_FREEDOM: f64 = 4.0;
const ITERATIONS: usize = 8;

/// Geometry of the radar, as needed for detections.
#[derive(Debug, Clone)]
pub struct Sensor {
    pub position: DVec3,
    world_from_radar: DMat3,
    /// Unit vector, in the room, along the pair of receivers that measures azimuth; `None` with one receiver.
    azimuth: Option<DVec3>,
    /// Height of the trunk's middle, m.
    pub trunk_height_m: f64,
    /// Unambiguous span of speeds, m/s.
    pub span_m_per_s: f64,
    range_resolution_m: f64,
    pattern: Pattern,
    room: BoxRoom,
}

/// State of a person in a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PersonState {
    /// Index among the detections.
    pub frame: usize,
    pub time_s: f64,
    pub x: f64,
    pub y: f64,
    pub vx: f64,
    pub vy: f64,
    /// Standard deviation of the position, as estimated by the smoother, m.
    pub sigma_m: f64,
    /// Level of the echo over noise, dB; `None` where there was none.
    pub snr_db: Option<f64>,
    /// Whether there was an echo that is not merged with a ghost off a wall.
    pub is_visible: bool,
}

/// Expected echo of a person.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Expected {
    pub range_m: f64,
    pub velocity_m_per_s: f64,
    pub cosine: f64,
}

/// Piece of a wall, floor or ceiling.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WallPiece {
    pub center: DVec3,
    /// Unit normal into the room.
    pub normal: DVec3,
}

/// Ghosts that are merged with a person's own echo.
pub struct MergedGhosts {
    /// Total field relative to that of the echo.
    pub field: f64,
    /// Largest bias of the echo's direction cosine.
    pub cosine_bias: f64,
}

/// Average ghost of a person off a piece of wall, relative to the direct echo.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Multipath {
    /// Additional range of the ghost, m.
    pub farther_m: f64,
    /// Level relative to the direct echo, dB.
    pub louder_db: f64,
}

impl Sensor {
    /// Returns the radar of a scene, and the receivers to compare: RX1 with RX3, which are side by side, else RX1 with
    /// RX2, which are offset horizontally and vertically.
    pub fn new(scene: &Scene, waveform: &Waveform, height_m: f64) -> (Self, Vec<Baseline>) {
        let world_from_radar = scene.radar_from_world().transpose();
        let antennas = waveform.request.rx_antennas.antennas();
        let index = |antenna: u8| antennas.iter().position(|a| *a == antenna);
        let offset = |antenna: u8| ANTENNA_OFFSETS_M.rx.get(usize::from(antenna) - 1).copied().unwrap_or_default();
        let pair = [(1, 3), (1, 2)].into_iter().find_map(|(to, from)| {
            let way = offset(to) - offset(from);
            let baseline = Baseline { to: index(to)?, from: index(from)?, length_m: way.length(), phase_rad: 0.0 };
            Some((world_from_radar * way.normalize(), baseline))
        });
        let antenna = &scene.receiver().antenna;
        let sensor = Sensor {
            position: scene.radar_position(),
            world_from_radar,
            azimuth: pair.map(|(direction, _)| direction),
            trunk_height_m: CHEST_HEIGHT * height_m,
            span_m_per_s: 2.0 * waveform.max_velocity_m_per_s(),
            range_resolution_m: waveform.range_resolution_m(),
            pattern: Pattern::new(
                antenna.azimuth_beamwidth_deg.to_radians(),
                antenna.elevation_beamwidth_deg.to_radians(),
                antenna.side_lobe_floor_db,
            ),
            room: scene.room(),
        };
        (sensor, pair.map(|(_, baseline)| baseline).into_iter().collect())
    }

    /// Returns whether the receivers measure direction.
    pub fn measures_direction(&self) -> bool {
        self.azimuth.is_some()
    }

    /// Wraps a difference of speeds into the unambiguous span.
    pub fn wrap_speed(&self, speed: f64) -> f64 {
        speed - self.span_m_per_s * (speed / self.span_m_per_s).round()
    }

    /// Computes the ghost of a person off a piece of wall. The path leads from the radar via the wall to the person and back,
    /// or the other way round.
    pub fn multipath(&self, state: &PersonState, piece: &WallPiece) -> Multipath {
        let trunk = DVec3::new(state.x, state.y, self.trunk_height_m);
        let (to_wall, to_person, back) = (piece.center - self.position, trunk - piece.center, self.position - trunk);
        let [to_wall_m, to_person_m, back_m] = [to_wall, to_person, back].map(|leg| leg.length().max(LEAST_LEG_M));
        let field = |leg: DVec3| self.pattern.field(self.world_from_radar.transpose() * leg.normalize_or_zero());
        let cosines =
            (-to_wall.dot(piece.normal)).max(0.0) / to_wall_m * to_person.dot(piece.normal).max(0.0) / to_person_m;
        let by_pattern = (field(to_wall) / field(-back).max(1e-3)).powi(2);
        // Two paths in phase, of which a receiver takes one polarisation. The body is assumed to scatter equally in all
        // directions.
        let power = 4.0 * 0.5 * WALL_SCATTERING * WALL_PIECE_M2 * cosines / PI
            * by_pattern
            * (back_m / (to_wall_m * to_person_m)).powi(2);
        Multipath { farther_m: 0.5 * (to_wall_m + to_person_m - back_m), louder_db: 10.0 * power.max(1e-12).log10() }
    }

    /// Pieces of floor, ceiling and walls at this spacing.
    pub fn wall_pieces(&self, step_m: f64) -> impl Iterator<Item = WallPiece> + '_ {
        let size = self.room.size_m;
        let counts = (size / step_m).ceil().max(DVec3::ONE);
        let walls = self.room.walls.iter().enumerate().filter(|(_, wall)| !matches!(wall, Wall::Open));
        walls.flat_map(move |(i, _)| {
            let (axis, u, v) = (i / 2, (i / 2 + 1) % 3, (i / 2 + 2) % 3);
            let normal = DVec3::AXES[axis] * if i % 2 == 0 { 1.0 } else { -1.0 };
            let piece = move |a: f64, b: f64| {
                let mut center = DVec3::ZERO;
                center[axis] = if i % 2 == 0 { 0.0 } else { size[axis] };
                (center[u], center[v]) = ((a + 0.5) / counts[u] * size[u], (b + 0.5) / counts[v] * size[v]);
                WallPiece { center, normal }
            };
            (0..counts[u] as usize).flat_map(move |a| (0..counts[v] as usize).map(move |b| piece(a as f64, b as f64)))
        })
    }

    /// Computes the ghosts off upright walls that fall into the range cell of the echo of a person at this position.
    pub fn merged_ghosts(&self, x: f64, y: f64) -> MergedGhosts {
        let trunk = DVec3::new(x, y, self.trunk_height_m);
        let field = |from: DVec3| {
            let unit = (trunk - from).normalize_or_zero();
            (self.pattern.field(self.world_from_radar.transpose() * unit), unit)
        };
        let ((own_field, own_unit), path_m) = (field(self.position), trunk.distance(self.position));
        let mut ghosts = MergedGhosts { field: 0.0, cosine_bias: 0.0 };
        for (wall, image) in self.images().filter(|(wall, _)| wall / 2 < 2) {
            let farther_m = 0.5 * (trunk.distance(image) - path_m);
            if farther_m > self.range_resolution_m {
                continue;
            }
            // Seen from the antenna, the ghost comes from the person's own mirror image.
            let (axis, at) = (wall / 2, if wall % 2 == 0 { 0.0 } else { self.room.size_m[wall / 2] });
            let mut mirrored = trunk;
            mirrored[axis] = 2.0 * at - trunk[axis];
            let unit = (mirrored - self.position).normalize_or_zero();
            let reflection_of = |wall: &Wall| wall.reflection(self.room.wavenumber_per_m, unit[axis].abs()).te.norm();
            let reflection = self.room.walls.get(wall).map_or(0.0, reflection_of);
            let share = reflection * self.pattern.field(self.world_from_radar.transpose() * unit) / own_field.max(1e-3);
            ghosts.field += share;
            ghosts.cosine_bias += share * (self.azimuth_axis().dot(unit) - self.azimuth_axis().dot(own_unit)).abs();
        }
        ghosts
    }

    /// Images of the radar in each wall, with the wall's index.
    pub fn images(&self) -> impl Iterator<Item = (usize, DVec3)> {
        let (size, at) = (self.room.size_m, self.position);
        let walls = self.room.walls.iter().enumerate().filter(|(_, wall)| !matches!(wall, Wall::Open));
        walls.map(move |(i, _)| {
            let mut image = at;
            let axis = i / 2;
            image[axis] = if i % 2 == 0 { -at[axis] } else { 2.0 * size[axis] - at[axis] };
            (i, image)
        })
    }

    pub fn expected(&self, state: &PersonState) -> Expected {
        let [range, speed, cosine] = self.measures(DVec4::new(state.x, state.y, state.vx, state.vy));
        Expected { range_m: range.0, velocity_m_per_s: speed.0, cosine: cosine.0 }
    }

    /// Unit vector along which cosines are measured; perpendicular to the boresight if no receivers measure direction.
    fn azimuth_axis(&self) -> DVec3 {
        self.azimuth.unwrap_or(self.world_from_radar.y_axis)
    }

    /// Range, speed and cosine of a state, each with its gradient.
    fn measures(&self, state: DVec4) -> [(f64, DVec4); 3] {
        let velocity = DVec2::new(state.z, state.w);
        let lean = velocity.normalize_or_zero() * LEAN_M * velocity.length().min(1.0);
        let way = DVec3::new(state.x + lean.x, state.y + lean.y, self.trunk_height_m) - self.position;
        let r = way.length().max(0.05);
        let unit = way / r;
        let ground = unit.truncate();
        let speed = velocity.dot(ground);
        // Support function of the trunk's ellipse. People face their direction of motion; standing people may face
        // either way.
        let [front, side] = REACH_M;
        let facing = if velocity.length() > 0.2 { velocity.normalize().dot(ground.normalize_or_zero()) } else { 0.7 };
        let reach_squared = front * front * facing * facing + side * side * (1.0 - facing * facing);
        let reach = reach_squared.sqrt() * ground.length();
        let speed_gradient = (velocity - speed * ground) / r;
        let azimuth_axis = self.azimuth_axis();
        let cosine = azimuth_axis.dot(unit);
        let cosine_gradient = (azimuth_axis - cosine * unit) / r;
        [
            (r - reach, DVec4::new(ground.x, ground.y, 0.0, 0.0)),
            (speed, DVec4::new(speed_gradient.x, speed_gradient.y, ground.x, ground.y)),
            (cosine, DVec4::new(cosine_gradient.x, cosine_gradient.y, 0.0, 0.0)),
        ]
    }

    /// Approximate position of an echo.
    fn position_of(&self, range_m: f64, cosine: f64) -> DVec2 {
        let ground_m = (range_m.powi(2) - (self.trunk_height_m - self.position.z).powi(2)).max(0.01).sqrt();
        let sine = (cosine * range_m / ground_m).clamp(-0.95, 0.95);
        let ahead = self.world_from_radar.x_axis.truncate().normalize_or(DVec2::X);
        self.position.truncate() + ground_m * (ahead * (1.0 - sine * sine).sqrt() + ahead.perp() * sine)
    }
}

/// Measured value of an echo.
struct Measurement {
    /// Index of the quantity in [`Sensor::measures`].
    quantity: usize,
    value: f64,
    /// Standard error.
    sigma: f64,
    /// Factor on the variance, which grows with the deviation.
    variance_factor: f64,
}

/// Measurements from the echoes of a tracklet, by frame from its first to its last.
struct Measurements<'a> {
    frames: Vec<&'a Detections>,
    measures: Vec<Vec<Measurement>>,
    /// Levels of the echoes over noise, dB.
    snr_db: Vec<Option<f64>>,
    /// Times, s, and approximate positions of the echoes.
    positions: Vec<(f64, DVec2)>,
}

impl<'a> Measurements<'a> {
    fn new(detections: &'a [Detections], echoes: &[EchoIndex], sensor: &Sensor) -> Option<Self> {
        let (first, last) = (echoes.first()?.frame, echoes.last()?.frame);
        let frames: Vec<&Detections> = detections.iter().take(last + 1).skip(first).collect();
        let measures = frames.iter().map(|_| Vec::new()).collect();
        let snr_db = vec![None; frames.len()];
        let mut found = Measurements { frames, measures, snr_db, positions: Vec::new() };
        for &EchoIndex { frame, echo } in echoes {
            let index = frame - first;
            let Some(detected) = found.frames.get(index) else { continue };
            let Some(echo) = detected.echoes.get(echo) else { continue };
            let (Some(row), Some(level)) = (found.measures.get_mut(index), found.snr_db.get_mut(index)) else {
                continue;
            };
            *level = Some(echo.snr_db);
            let noise = 10f64.powf(-0.05 * echo.snr_db);
            let mut add =
                |quantity, value, sigma: f64| row.push(Measurement { quantity, value, sigma, variance_factor: 1.0 });
            add(0, echo.range_m, RANGE_M * if echo.is_still { 2.0 } else { 1.0 });
            add(1, echo.velocity_m_per_s, SPEED_M_PER_S);
            let cosine = echo.cosines.first().copied().unwrap_or(Some(0.0));
            if let Some(cosine) = cosine {
                let at = sensor.position_of(echo.range_m, cosine);
                let cosine_bias = sensor.merged_ghosts(at.x, at.y).cosine_bias;
                let across = ACROSS_M / echo.range_m.max(0.3);
                add(2, cosine, (COSINE.powi(2) + cosine_bias * cosine_bias + across.powi(2) + noise * noise).sqrt());
            }
            found.positions.push((detected.time_s, sensor.position_of(echo.range_m, cosine.unwrap_or(0.0))));
        }
        Some(found)
    }
}

/// Computes the trajectory of a tracklet: a state for each frame from its first to its last.
pub fn smooth(detections: &[Detections], echoes: &[EchoIndex], sensor: &Sensor) -> Vec<PersonState> {
    let Some(measurements) = Measurements::new(detections, echoes, sensor) else { return Vec::new() };
    let Measurements { frames, mut measures, snr_db, positions } = measurements;
    let first = echoes.first().map_or(0, |index| index.frame);
    let mut states = initial_states(&frames, &positions);
    let mut sigmas = vec![0.0; states.len()];
    let mut noise_factors = vec![4.0; states.len()];
    for _ in 0..ITERATIONS {
        (states, sigmas) = filter_and_smooth(&frames, &measures, &states, &noise_factors, sensor);
        noise_factors = process_noise_factors(&frames, &states);
        for (row, state) in measures.iter_mut().zip(&states) {
            let expected = sensor.measures(*state);
            for measure in row {
                let Some((value, _)) = expected.get(measure.quantity) else { continue };
                let standardised = deviation(measure, *value, sensor) / measure.sigma;
                measure.variance_factor = 1.0 + standardised * standardised / DEGREES_OF_FREEDOM;
            }
        }
    }
    let all = frames.iter().zip(states).zip(sigmas.into_iter().zip(snr_db)).enumerate();
    all.map(|(i, ((detected, s), (sigma_m, snr_db)))| PersonState {
        frame: first + i,
        time_s: detected.time_s,
        x: s.x,
        y: s.y,
        vx: s.z,
        vy: s.w,
        sigma_m,
        snr_db,
        is_visible: snr_db.is_some() && sensor.merged_ghosts(s.x, s.y).field < VISIBLE_BELOW_FIELD,
    })
    .collect()
}

/// Factor on the process noise at each time, from the change of velocity there. As with the measurement errors, an
/// unlikely change is attributed to another cause, such as a turn.
fn process_noise_factors(frames: &[&Detections], states: &[DVec4]) -> Vec<f64> {
    let velocity_at = |time_s: f64| {
        let later = frames.partition_point(|detected| detected.time_s < time_s).min(states.len().saturating_sub(1));
        states.get(later).map_or(DVec2::ZERO, |s| DVec2::new(s.z, s.w))
    };
    let factor = |detected: &&Detections| {
        let change = velocity_at(detected.time_s + 0.5 * TURN_S) - velocity_at(detected.time_s - 0.5 * TURN_S);
        let usual = 2.0 * ACCELERATION_NOISE * ACCELERATION_NOISE * TURN_S;
        1.0 + (change.length_squared() / usual).powi(2).min(MOST_TURN)
    };
    frames.iter().map(factor).collect()
}

/// Deviation of a measurement from its expected value.
fn deviation(measure: &Measurement, value: f64, sensor: &Sensor) -> f64 {
    let difference = measure.value - value;
    if measure.quantity == 1 { sensor.wrap_speed(difference) } else { difference }
}

/// Initial trajectory: average of the echoes' positions over half a second either way, with its slope as velocity.
fn initial_states(frames: &[&Detections], positions: &[(f64, DVec2)]) -> Vec<DVec4> {
    const HALF_S: f64 = 0.5;
    let average = |time_s: f64| {
        let near = positions.iter().filter(|(t, _)| (t - time_s).abs() <= HALF_S);
        let (sum, count) = near.fold((DVec2::ZERO, 0.0), |(sum, count), (_, position)| (sum + *position, count + 1.0));
        if count > 0.0 {
            return sum / count;
        }
        let nearest = positions.iter().min_by(|a, b| (a.0 - time_s).abs().total_cmp(&(b.0 - time_s).abs()));
        nearest.map_or(DVec2::ZERO, |(_, position)| *position)
    };
    let guess = |detected: &&Detections| {
        let position = average(detected.time_s);
        let change = average(detected.time_s + HALF_S) - average(detected.time_s - HALF_S);
        DVec4::new(position.x, position.y, change.x / (2.0 * HALF_S), change.y / (2.0 * HALF_S))
    };
    frames.iter().map(guess).collect()
}

/// State with its covariance.
#[derive(Clone, Copy)]
struct Estimate {
    state: DVec4,
    covariance: DMat4,
}

/// Filter results of a frame.
#[derive(Clone, Copy)]
struct Filtered {
    /// Transition from the state of the frame before.
    transition: DMat4,
    /// Estimate before the measurements of the frame.
    predicted: Estimate,
    /// Estimate after the measurements of the frame.
    updated: Estimate,
}

/// Runs the filter and the smoother once, with all measurements linearised about the states `linearised_at`. Returns states and
/// standard deviations of the positions.
fn filter_and_smooth(
    frames: &[&Detections],
    measures: &[Vec<Measurement>],
    linearised_at: &[DVec4],
    noise_factors: &[f64],
    sensor: &Sensor,
) -> (Vec<DVec4>, Vec<f64>) {
    let mut state = linearised_at.first().copied().unwrap_or_default();
    // Little is known about the initial state.
    let mut covariance = DMat4::from_diagonal(DVec4::new(25.0, 25.0, 4.0, 4.0));
    let mut before_s = frames.first().map_or(0.0, |detected| detected.time_s);
    let mut filtered: Vec<Filtered> = Vec::with_capacity(frames.len());
    for ((detected, row), (reference, noise_factor)) in
        frames.iter().zip(measures).zip(linearised_at.iter().zip(noise_factors))
    {
        let dt = detected.time_s - before_s;
        before_s = detected.time_s;
        let mut transition = DMat4::IDENTITY;
        (transition.z_axis.x, transition.w_axis.y) = (dt, dt);
        let q = ACCELERATION_NOISE * ACCELERATION_NOISE * noise_factor;
        let (a, b, c) = (q * dt.powi(3) / 3.0, q * dt.powi(2) / 2.0, q * dt);
        let process_noise = DMat4::from_cols(
            DVec4::new(a, 0.0, b, 0.0),
            DVec4::new(0.0, a, 0.0, b),
            DVec4::new(b, 0.0, c, 0.0),
            DVec4::new(0.0, b, 0.0, c),
        );
        state = transition * state;
        covariance = transition * covariance * transition.transpose() + process_noise;
        let predicted = Estimate { state, covariance };
        let expected = sensor.measures(*reference);
        for measure in row {
            let Some((value, gradient)) = expected.get(measure.quantity) else { continue };
            let innovation = deviation(measure, *value, sensor) - gradient.dot(state - *reference);
            let spread = covariance * *gradient;
            let variance = gradient.dot(spread) + measure.sigma * measure.sigma * measure.variance_factor;
            let gain = spread / variance;
            state += gain * innovation;
            let reduction = DMat4::from_cols(gain * spread.x, gain * spread.y, gain * spread.z, gain * spread.w);
            covariance -= reduction;
            covariance = (covariance + covariance.transpose()) * 0.5;
        }
        filtered.push(Filtered { transition, predicted, updated: Estimate { state, covariance } });
    }
    smooth_backwards(&filtered)
}

/// Smooths the filtered states backwards, so that later measurements count too.
fn smooth_backwards(filtered: &[Filtered]) -> (Vec<DVec4>, Vec<f64>) {
    let (mut states, mut sigmas) = (Vec::with_capacity(filtered.len()), Vec::with_capacity(filtered.len()));
    // Filter results and smoothed estimate of the frame after.
    let mut after: Option<(Filtered, Estimate)> = None;
    for frame in filtered.iter().rev() {
        let updated = frame.updated;
        let Estimate { mut state, mut covariance } = updated;
        if let Some((Filtered { transition, predicted, .. }, later)) = after {
            let gain = updated.covariance * transition.transpose() * predicted.covariance.inverse();
            state = updated.state + gain * (later.state - predicted.state);
            covariance = updated.covariance + gain * (later.covariance - predicted.covariance) * gain.transpose();
        }
        states.push(state);
        sigmas.push((covariance.x_axis.x + covariance.y_axis.y).max(0.0).sqrt());
        after = Some((*frame, Estimate { state, covariance }));
    }
    states.reverse();
    sigmas.reverse();
    (states, sigmas)
}

#[cfg(test)]
mod tests {
    use radome_dsp::WaveformRequest;
    use radome_dsp::detect::Detection;

    use super::*;

    fn sensor() -> Sensor {
        let waveform = Waveform::realise(WaveformRequest::paper()).expect("valid");
        Sensor::new(&Scene::empty_space(&waveform).expect("a scene"), &waveform, 1.75).0
    }

    fn first_echo(frame: usize) -> EchoIndex {
        EchoIndex { frame, echo: 0 }
    }

    /// Echoes of a person on a straight path, exactly as the sensor expects them, except for some from elsewhere.
    fn detections(sensor: &Sensor, wrong: impl Fn(usize) -> bool) -> (Vec<Detections>, Vec<PersonState>) {
        let truth = |i: usize| {
            let time_s = 0.1 * i as f64;
            PersonState {
                frame: i,
                time_s,
                x: sensor.position.x + 6.0 - 1.1 * time_s,
                y: sensor.position.y - 1.0 + 0.4 * time_s,
                vx: -1.1,
                vy: 0.4,
                sigma_m: 0.0,
                snr_db: Some(30.0),
                is_visible: true,
            }
        };
        let detected = |i: usize| {
            let expected = sensor.expected(&truth(i));
            let (range, cosine) = if wrong(i) { (0.5, -0.3) } else { (0.0, 0.0) };
            let echo = Detection {
                range_m: expected.range_m + range,
                velocity_m_per_s: expected.velocity_m_per_s,
                snr_db: 30.0,
                cosines: vec![Some(expected.cosine + cosine)],
                is_still: false,
            };
            Detections { time_s: truth(i).time_s, people: 1, echoes: vec![echo] }
        };
        ((0..40).map(detected).collect(), (0..40).map(truth).collect())
    }

    #[test]
    fn a_straight_path_is_recovered_from_its_echoes() {
        let sensor = sensor();
        let (detections, truth) = detections(&sensor, |_| false);
        let places: Vec<EchoIndex> = (0..40).filter(|i| !(15..20).contains(i)).map(first_echo).collect();
        let track = smooth(&detections, &places, &sensor);
        assert_eq!(track.len(), 40);
        for (estimate, truth) in track.iter().zip(&truth) {
            let (distance, speed) = (
                (estimate.x - truth.x).hypot(estimate.y - truth.y),
                (estimate.vx - truth.vx).hypot(estimate.vy - truth.vy),
            );
            assert!(distance < 0.01 && speed < 0.02, "{estimate:?} {truth:?}");
            assert_eq!(estimate.snr_db.is_none(), (15..20).contains(&estimate.frame));
        }
    }

    /// One echo in seven is 1.8 m to one side. An average over the echoes would be 0.26 m off; the smoother's error is
    /// less than half as much. (At the ends, where little else is known, wrong echoes weigh more.)
    #[test]
    fn outliers_change_a_trajectory_little() {
        let sensor = sensor();
        let (detections, truth) = detections(&sensor, |i| i % 7 == 3 && (7..33).contains(&i));
        let places: Vec<EchoIndex> = (0..40).map(first_echo).collect();
        for (estimate, truth) in smooth(&detections, &places, &sensor).iter().zip(&truth) {
            assert!((estimate.x - truth.x).hypot(estimate.y - truth.y) < 0.13, "{estimate:?} {truth:?}");
        }
    }

    /// Compares gradients with differences of the values.
    #[test]
    fn gradients_of_measurements_agree_with_differences() {
        let sensor = sensor();
        let state = DVec4::new(sensor.position.x + 3.0, sensor.position.y + 0.8, -0.9, 0.5);
        for axis in 0..4 {
            let mut step = DVec4::ZERO;
            step[axis] = 1e-4;
            let (after, before) = (sensor.measures(state + step), sensor.measures(state - step));
            for (quantity, (value, gradient)) in sensor.measures(state).into_iter().enumerate() {
                let slope = (after[quantity].0 - before[quantity].0) / 2e-4;
                // The gradient takes the reach and the lean of the trunk as constant.
                assert!(
                    (slope - gradient[axis]).abs() < 0.05,
                    "{quantity} {axis}: {slope} {} at {value}",
                    gradient[axis]
                );
            }
        }
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn nothing_to_track_is_no_trajectory() {
            assert!(smooth(&[], &[], &sensor()).is_empty());
            let lone = Detections { time_s: 0.0, people: 1, echoes: Vec::new() };
            assert!(smooth(&[lone], &[EchoIndex { frame: 0, echo: 3 }], &sensor()).len() <= 1);
        }
    }
}
