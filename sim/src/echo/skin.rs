//! Echoes of somebody whose body is a mesh: every triangle near a highlight is a path.
//!
//! Physical optics over the skin needs only where the path hardly changes: a smooth window over the angle between normal and
//! bisector keeps highlights with several Fresnel zones around them and lets go of the rest, which cancels. Inside the window
//! each triangle is integrated in closed form ([`crate::field::curved_triangle`]) relative to its middle, and is from then on
//! a path: a point of the body with an exact delay, whose strength changes slowly. Nothing has to be found, followed or
//! matched between key times; highlights that are born, merge and die do so in the sum.
//!
//! Strength at the vertices: what the image antenna's field makes of skin there (both polarisations, true incidence), cloth,
//! pattern, walls, and what people and the body's own limbs leave of it.

use glam::DVec3;
use num_complex::Complex64;
use radome_dsp::SPEED_OF_LIGHT_M_PER_S;

use super::{EchoReport, LEAST_DISTANCE_M, Snapshot, inside_room, past_people, self_shadow};
use crate::actor::body::SEGMENTS;
use crate::actor::skin::{PosedSkin, WalkingMesh};
use crate::actor::track::smooth_step;
use crate::field::Phasor3;
use crate::field::boundary::Boundary;
use crate::field::current::{Arrival, heard_by};
use crate::field::curved_triangle::{CurvedTriangle, Integrator, View};
use crate::field::image::{Element, ImageIndex};
use crate::scene::material::SKIN_PERMITTIVITY;
use crate::slow_time::Key;
use crate::stage::Stage;
use crate::trace::World;

/// How finely a skin is integrated.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fineness {
    /// Sine of the angle between normal and bisector up to which everything counts, and from which nothing does.
    pub window: [f64; 2],
    /// Phase, rad, by which the middle of an edge may miss the mean of its ends before it is cut.
    pub bend_rad: f64,
}

impl Fineness {
    /// For an error of this many decibels.
    pub fn for_tolerance(tolerance_db: f64) -> Self {
        let part = (tolerance_db / 0.5).clamp(0.02, 8.0);
        let inner = (0.3 * part.powf(-0.3)).clamp(0.12, 0.7);
        Fineness { window: [inner, (inner + 0.2 + 0.05 * part.powf(-0.5)).min(0.95)], bend_rad: (0.8 * part).min(2.5) }
    }

    /// Weight of a place by the cosine between normal and bisector.
    fn weight(&self, cosine: f64) -> f64 {
        let [inner, outer] = self.window;
        let sine = (1.0 - cosine * cosine).max(0.0).sqrt();
        smooth_step((outer - sine) / (outer - inner))
    }
}

/// Somebody with a skin.
#[derive(Debug, Clone)]
pub struct SkinnedPerson {
    mesh: WalkingMesh,
    /// Factor of clothes on amplitude at each vertex.
    cloth: Vec<f64>,
    /// The mesh alone, to be refitted.
    world: World,
}

/// Paths of somebody at key times.
#[derive(Debug, Clone, Default)]
pub struct SkinPaths {
    /// `[key][path * receivers + receiver]`.
    pub keys: Vec<Vec<Key>>,
    /// Rates of the amplitudes, LSB/s, likewise.
    pub rates: Vec<Vec<Complex64>>,
}

/// What an image antenna does at a vertex.
#[derive(Debug, Clone, Copy)]
struct Lit {
    field: Phasor3,
    /// From the antenna to the vertex.
    direction: DVec3,
    distance_m: f64,
}

/// One of an antenna's images at a key time.
struct Image {
    index: ImageIndex,
    tx: DVec3,
    /// Middle of the receivers' images.
    rx: DVec3,
    /// By vertex; only where wanted.
    out: Vec<Option<Lit>>,
    back: Vec<Option<Lit>>,
    /// What people and limbs leave of a field from there.
    weights: Vec<f64>,
}

/// Triangles of a pair of images.
struct Pair {
    out: usize,
    back: usize,
    triangles: Vec<(u32, usize)>,
    wanted: Vec<bool>,
}

impl SkinnedPerson {
    /// Makes room for refitting.
    pub fn new(mesh: WalkingMesh) -> Option<Self> {
        let body = crate::trace::Body::new(mesh.skin().rest().clone(), crate::trace::Build::Moving).ok()?;
        let world = World::new(vec![body]).ok()?;
        let cloth = mesh.skin().blend(&mesh.motion().person.cloth);
        Some(SkinnedPerson { mesh, cloth, world })
    }

    /// Factor of clothes on amplitude at each vertex.
    pub fn cloth(&self) -> &[f64] {
        &self.cloth
    }

    /// The mesh alone, as rays meet it in a pose.
    pub fn refitted(&self, posed: &PosedSkin) -> Option<World> {
        let mut world = self.world.clone();
        world.refit(0, &posed.vertices).ok()?;
        Some(world)
    }

    /// What other people, and the body itself before the last wall, leave of an image antenna's field at each vertex: by
    /// segment, as vertices follow those.
    pub fn past_people(&self, stage: &Stage, people: &[Snapshot], me: usize, index: ImageIndex) -> Vec<f64> {
        let Some(own) = people.get(me) else { return vec![1.0; self.cloth.len()] };
        let of_segment: [f64; SEGMENTS] =
            std::array::from_fn(|s| past_people(stage, people, me, index, stage.tx.position, own.body[s].centre));
        if of_segment.iter().all(|&w| w == 1.0) {
            return vec![1.0; self.cloth.len()];
        }
        self.mesh.skin().blend(&of_segment)
    }

    /// The mesh in motion.
    pub fn mesh(&self) -> &WalkingMesh {
        &self.mesh
    }

    /// All paths at key times. `people` are everybody's snapshots then, of whom this is number `me`.
    pub fn paths(
        &self,
        stage: &Stage,
        integrator: &Integrator,
        fineness: &Fineness,
        times_s: &[f64],
        people: &[&[Snapshot]],
        me: usize,
        pairs: &[(ImageIndex, ImageIndex)],
        report: &mut EchoReport,
    ) -> SkinPaths {
        let posed: Vec<PosedSkin> = times_s.iter().map(|&t| self.mesh.posed(t)).collect();
        let mut indices: Vec<ImageIndex> = pairs.iter().flat_map(|&(p, q)| [p, q]).collect();
        indices.sort_unstable();
        indices.dedup();
        let number = |index: ImageIndex| indices.binary_search(&index).unwrap_or(0);
        let places = |index: ImageIndex| {
            let rx: DVec3 = stage.rx.iter().map(|rx| rx.position).sum::<DVec3>() / stage.rx.len().max(1) as f64;
            (stage.room.image_position(index, stage.tx.position), stage.room.image_position(index, rx))
        };
        // What is near a highlight at the beginning, in the middle or at the end.
        let middle = posed.len() / 2;
        let ends = [0, middle, posed.len().saturating_sub(1)];
        let pairs: Vec<Pair> = pairs
            .iter()
            .map(|&(p, q)| {
                let (tx, rx) = (places(p).0, places(q).1);
                let near = ends.iter().filter_map(|&i| posed.get(i));
                self.select(near, posed.get(middle), tx, rx, fineness, stage, (number(p), number(q)))
            })
            .collect();
        let mut wanted = vec![vec![false; self.cloth.len()]; indices.len()];
        for pair in &pairs {
            for image in [pair.out, pair.back] {
                for (all, of) in wanted[image].iter_mut().zip(&pair.wanted) {
                    *all |= of;
                }
            }
        }
        let mut world = self.world.clone();
        let images: Vec<Vec<Image>> = posed
            .iter()
            .zip(people)
            .map(|(posed, people)| {
                let refitted = world.refit(0, &posed.vertices).is_ok();
                let of_image = |(&index, wanted): (&ImageIndex, &Vec<bool>)| {
                    let (tx, rx) = places(index);
                    let shadow = refitted.then_some(&world);
                    self.image(stage, posed, shadow, people, me, (index, tx, rx), wanted)
                };
                indices.iter().zip(&wanted).map(of_image).collect()
            })
            .collect();

        let mut paths = SkinPaths::default();
        paths.keys.resize(times_s.len(), Vec::new());
        paths.rates.resize(times_s.len(), Vec::new());
        for pair in &pairs {
            report.paths += pair.triangles.len() * times_s.len();
            let strengths: Vec<Vec<Complex64>> = posed
                .iter()
                .zip(&images)
                .map(|(posed, images)| self.strengths(stage, posed, images, pair, fineness, report))
                .collect();
            for (i, (posed, images)) in posed.iter().zip(&images).enumerate() {
                let slopes = Slopes::new(&strengths, times_s, i);
                let (keys, rates) = (&mut paths.keys[i], &mut paths.rates[i]);
                let (Some(out), Some(back)) = (images.get(pair.out), images.get(pair.back)) else { continue };
                self.integrate(stage, integrator, posed, (out, back), &pair.triangles, &slopes, keys, rates);
            }
        }
        paths
    }

    /// Triangles near a highlight, with the cuts that they need.
    fn select<'a>(
        &self,
        near: impl Iterator<Item = &'a PosedSkin>,
        middle: Option<&PosedSkin>,
        tx: DVec3,
        rx: DVec3,
        fineness: &Fineness,
        stage: &Stage,
        (out, back): (usize, usize),
    ) -> Pair {
        let mut shines = vec![false; self.cloth.len()];
        for posed in near {
            for ((shines, v), normal) in shines.iter_mut().zip(&posed.vertices).zip(&posed.normals) {
                if !*shines {
                    let (t, r) = ((tx - *v).normalize_or_zero(), (rx - *v).normalize_or_zero());
                    let bisector = t + r;
                    let cosine = normal.dot(bisector);
                    // As the window's weight, without its roots.
                    let least = 1.0 - fineness.window[1] * fineness.window[1];
                    *shines = cosine > 0.0
                        && cosine * cosine > least * bisector.length_squared()
                        && normal.dot(t) > 0.0
                        && normal.dot(r) > 0.0
                        && bisector.length_squared() > 0.16;
                }
            }
        }
        let mut pair = Pair { out, back, triangles: Vec::new(), wanted: vec![false; self.cloth.len()] };
        let Some(middle) = middle else { return pair };
        let k = std::f64::consts::TAU / stage.wavelength_m;
        for (number, corners) in self.mesh.skin().rest().triangles.iter().enumerate() {
            if !corners.iter().any(|&v| shines.get(v as usize) == Some(&true)) {
                continue;
            }
            for &v in corners {
                if let Some(wanted) = pair.wanted.get_mut(v as usize) {
                    *wanted = true;
                }
            }
            let triangle = self.triangle(middle, number);
            let (t, r) = (View::new(tx, triangle.middle), View::new(rx, triangle.middle));
            pair.triangles.push((number as u32, triangle.cuts(&t, &r, k, fineness.bend_rad)));
        }
        pair
    }

    fn triangle(&self, posed: &PosedSkin, number: usize) -> CurvedTriangle {
        let skin = self.mesh.skin();
        let at = |of: &[DVec3], i: u32| of.get(i as usize).copied().unwrap_or_default();
        let corners = skin.rest().triangles.get(number).copied().unwrap_or_default();
        let sides = skin.sides().get(number).copied().unwrap_or_default();
        CurvedTriangle::new(corners.map(|v| at(&posed.vertices, v)), sides.map(|e| at(&posed.bulges, e)))
    }

    fn image(
        &self,
        stage: &Stage,
        posed: &PosedSkin,
        world: Option<&World>,
        people: &[Snapshot],
        me: usize,
        (index, tx, rx): (ImageIndex, DVec3, DVec3),
        wanted: &[bool],
    ) -> Image {
        let light = |element: &Element| -> Vec<Option<Lit>> {
            let lit = |(&v, &wanted): (&DVec3, &bool)| {
                wanted.then(|| {
                    let i = stage.room.illuminate(element, index, v);
                    Lit { field: i.field, direction: i.direction, distance_m: i.distance_m }
                })
            };
            posed.vertices.iter().zip(wanted).map(lit).collect()
        };
        let mut weights = match world {
            Some(world) => {
                let middle = 0.5 * (tx + rx);
                self_shadow::weights(self.mesh.skin(), posed, world, middle, stage.wavelength_m, wanted)
            }
            None => vec![1.0; posed.vertices.len()],
        };
        for (weight, past) in weights.iter_mut().zip(self.past_people(stage, people, me, index)) {
            *weight *= past;
        }
        let back = stage.rx.first().map_or_else(Vec::new, light);
        Image { index, tx, rx, out: light(&stage.tx), back, weights }
    }

    /// Strength at every vertex, as it multiplies `exp(-j k L)` and an area: the integrand of physical optics with antennas'
    /// aperture and spreading.
    fn strengths(
        &self,
        stage: &Stage,
        posed: &PosedSkin,
        images: &[Image],
        pair: &Pair,
        fineness: &Fineness,
        report: &mut EchoReport,
    ) -> Vec<Complex64> {
        let k = std::f64::consts::TAU / stage.wavelength_m;
        let aperture = stage.wavelength_m / (4.0 * std::f64::consts::PI);
        let factor = Complex64::new(0.0, -k * aperture / std::f64::consts::TAU);
        let skin = Boundary::HalfSpace { permittivity: SKIN_PERMITTIVITY };
        let mut all = vec![Complex64::ZERO; self.cloth.len()];
        let (Some(out), Some(back)) = (images.get(pair.out), images.get(pair.back)) else { return all };
        for (i, strength) in all.iter_mut().enumerate() {
            if !pair.wanted[i] {
                continue;
            }
            let (Some(there), Some(home)) = (out.out[i], back.back[i]) else { continue };
            let (normal, point) = (posed.normals[i], posed.vertices[i]);
            let bisector = there.direction + home.direction;
            let length = bisector.length();
            let cosine = -normal.dot(bisector) / length.max(1e-12);
            if normal.dot(there.direction) >= 0.0 || normal.dot(home.direction) >= 0.0 {
                continue;
            }
            // Grazing highlights fade: forward scattering is not theirs to tell.
            let window = fineness.weight(cosine) * smooth_step((0.5 * length - 0.2) / 0.1);
            let weight = window * out.weights[i] * back.weights[i] * self.cloth[i];
            if weight <= 0.0 {
                continue;
            }
            let clamped = there.distance_m < LEAST_DISTANCE_M || home.distance_m < LEAST_DISTANCE_M;
            report.clamped += usize::from(clamped);
            let spreading = 1.0 / (there.distance_m.max(LEAST_DISTANCE_M) * home.distance_m.max(LEAST_DISTANCE_M));
            let arrival = Arrival { field: there.field, direction: there.direction };
            let heard = heard_by(&arrival, normal, &skin, k, -home.direction, home.field);
            *strength = factor * heard * (spreading * weight * inside_room(stage, point));
        }
        all
    }

    #[allow(clippy::too_many_arguments)]
    fn integrate(
        &self,
        stage: &Stage,
        integrator: &Integrator,
        posed: &PosedSkin,
        (out, back): (&Image, &Image),
        triangles: &[(u32, usize)],
        slopes: &Slopes,
        keys: &mut Vec<Key>,
        rates: &mut Vec<Complex64>,
    ) {
        let k = std::f64::consts::TAU / stage.wavelength_m;
        let sinks: Vec<DVec3> = stage.rx.iter().map(|rx| stage.room.image_position(back.index, rx.position)).collect();
        let at = |of: &[DVec3], i: u32| of.get(i as usize).copied().unwrap_or_default();
        for &(number, cuts) in triangles {
            let corners = self.mesh.skin().rest().triangles.get(number as usize).copied().unwrap_or_default();
            let triangle = self.triangle(posed, number as usize);
            let (t, r) = (View::new(out.tx, triangle.middle), View::new(back.rx, triangle.middle));
            let strengths = corners.map(|v| slopes.at(v));
            let velocities = corners.map(|v| at(&posed.velocities_m_per_s, v));
            let velocity = (velocities[0] + velocities[1] + velocities[2]) / 3.0;
            let (mut amplitude, mut rate) = (Complex64::ZERO, Complex64::ZERO);
            if strengths.iter().any(|(s, _)| *s != Complex64::ZERO) {
                let moments = integrator.moments(&triangle, &t, &r, k, cuts);
                for (i, (moment, (strength, slope))) in moments.into_iter().zip(strengths).enumerate() {
                    let moment = Complex64::new(moment.re.into(), moment.im.into());
                    // How fast the path by the corner grows against that by the middle.
                    let (d, against) = (triangle.corners[i].as_dvec3(), velocities[i] - velocity);
                    let grows = |view: &View| {
                        let away = view.offset / view.distance_m;
                        away.dot(against) + (d.dot(velocity) - away.dot(d) * away.dot(velocity)) / view.distance_m
                    };
                    amplitude += strength * moment;
                    rate += (slope - Complex64::new(0.0, k * (grows(&t) + grows(&r))) * strength) * moment;
                }
            }
            let rate_t = -t.towards().dot(velocity);
            let beat_hz = stage.chirp.beat_hz(
                (t.distance_m + r.distance_m) / SPEED_OF_LIGHT_M_PER_S,
                (rate_t - r.towards().dot(velocity)) / SPEED_OF_LIGHT_M_PER_S,
            );
            for (rx, sink) in sinks.iter().enumerate() {
                let to_rx = *sink - triangle.middle;
                let distance_m = to_rx.length().max(1e-6);
                let rate_r = -to_rx.dot(velocity) / distance_m;
                keys.push(Key {
                    delay_s: (t.distance_m + distance_m) / SPEED_OF_LIGHT_M_PER_S,
                    delay_rate: (rate_t + rate_r) / SPEED_OF_LIGHT_M_PER_S,
                    amplitude: stage.at_adc(rx, amplitude, beat_hz),
                });
                rates.push(stage.at_adc(rx, rate, beat_hz));
            }
        }
    }
}

/// Strengths at one key, and their rates from the keys around it.
struct Slopes<'a> {
    now: &'a [Complex64],
    /// Keys and weights whose sum is the rate.
    parts: Vec<(&'a [Complex64], f64)>,
}

impl<'a> Slopes<'a> {
    /// Differences over equal steps: central ones, and at the ends those of the parabola through three keys.
    fn new(all: &'a [Vec<Complex64>], times_s: &[f64], i: usize) -> Self {
        let last = all.len().saturating_sub(1);
        let step_s = match times_s {
            [first, second, ..] => second - first,
            _ => 1.0,
        };
        let weights: &[(usize, f64)] = match (i, last) {
            (_, 0) => &[],
            (_, 1) => &[(0, -1.0), (1, 1.0)],
            (0, _) => &[(0, -1.5), (1, 2.0), (2, -0.5)],
            (i, last) if i == last => &[(last, 1.5), (last - 1, -2.0), (last - 2, 0.5)],
            (i, _) => &[(i + 1, 0.5), (i - 1, -0.5)],
        };
        let parts = weights.iter().filter_map(|&(key, w)| Some((all.get(key)?.as_slice(), w / step_s))).collect();
        Slopes { now: all.get(i).map(Vec::as_slice).unwrap_or_default(), parts }
    }

    fn at(&self, vertex: u32) -> (Complex64, Complex64) {
        let of = |all: &[Complex64]| all.get(vertex as usize).copied().unwrap_or_default();
        (of(self.now), self.parts.iter().map(|(all, w)| of(all) * *w).sum())
    }
}
