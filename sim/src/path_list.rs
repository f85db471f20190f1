//! List of every path between the antennas of a scene at one time, to check a simulation against geometry.
//!
//! The list contains the paths of which frames are made: reflections of walls, points of furniture, and the specular
//! points of people's ellipsoids for each pair of images. People modelled as skins are listed by the ellipsoids under
//! the skin. The list omits the leakage between antennas, small swaying reflectors, and paths by diffuse walls.

use std::f64::consts::TAU;
use std::sync::Arc;

use glam::DVec3;
use num_complex::Complex64;
use radome_dsp::SPEED_OF_LIGHT_M_PER_S;
use serde::Serialize;

use crate::diffraction::{self, Column};
use crate::echo::{EchoReport, Snapshot, audible_pairs, echoes};
use crate::em::image::ImageIndex;
use crate::math::wrapped;
use crate::path_segment::PathSample;
use crate::people::body::{SEGMENT_NAMES, SEGMENTS};
use crate::people::motion::Motion;
use crate::prepared_scene::{PointPath, PreparedScene};
use crate::scenario::Scenario;
use crate::scene::{Scene, SceneError};
use crate::scene_file::ShadowFile;

/// Largest distance of a point from a surface on which it lies, m.
const ON_SURFACE_M: f64 = 1e-6;

/// Options that select the listed paths.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PathListOptions {
    /// Seed of everything random.
    pub seed: u64,
    /// Largest number of people; the scene's own number if `None`.
    pub people: Option<usize>,
    /// Slot of a person: if given, only the paths by way of that person are listed.
    pub person: Option<usize>,
    /// Time from the first frame's first chirp, s.
    pub time_s: f64,
    /// Paths this far below the mean noise of a map cell are left out, dB. Frames with an error of 0.5 dB leave out
    /// paths 10 dB below it.
    pub margin_db: f64,
}

impl PathListOptions {
    /// Latest time accepted from scenarios and packages, s: one day. Motions are followed from the first frame on,
    /// which takes a second of computation for a day.
    pub const LATEST_S: f64 = 86_400.0;
}

impl Default for PathListOptions {
    fn default() -> Self {
        PathListOptions { seed: 1, people: None, person: None, time_s: 0.0, margin_db: 10.0 }
    }
}

/// Kind of object that a path meets.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum PathKind {
    /// Only reflections of walls.
    Walls,
    /// A point of furniture, or of an object on a desk.
    Furniture,
    /// The body of a person.
    Person,
}

/// One path from the transmitter to one receiver.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ListedPath {
    /// Number of the receiving antenna, from 1.
    pub rx: u8,
    /// Kind of object that the path meets.
    pub kind: PathKind,
    /// Surfaces that the path meets, in order: walls and furniture by their names, a person as `person 0 chest`.
    pub surfaces: Vec<String>,
    /// Slot of the person that the path meets.
    pub person: Option<usize>,
    /// Length, m.
    pub length_m: f64,
    /// Delay, s.
    pub delay_s: f64,
    /// Doppler shift at `frequency_hz` of the list, Hz; positive where the path becomes shorter.
    pub doppler_hz: f64,
    /// Received over transmitted power, dB, with antenna patterns of 1 on boresight; before link budget and filters.
    pub gain_db: f64,
    /// Phase of the received field (`e^{+jwt}`) at `frequency_hz` relative to the transmitted one, rad, from -pi to pi.
    pub phase_rad: f64,
    /// Corners of the path from the transmitter to the receiver, m; empty where the path is not unique.
    pub points_m: Vec<[f64; 3]>,
}

/// Paths of a scene at one time.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PathList {
    /// Name of the scene.
    pub scene: String,
    /// Seed of everything random.
    pub seed: u64,
    /// Time, s.
    pub time_s: f64,
    /// Frequency at which phases and Doppler shifts are stated, Hz: the middle of the chirp.
    pub frequency_hz: f64,
    /// Slots of the people who are present.
    pub people: Vec<usize>,
    /// The paths, sorted by receiver, then kind, then delay.
    pub paths: Vec<ListedPath>,
}

/// Inputs of the path list.
struct Lister<'a> {
    scene: &'a Scene,
    prepared: PreparedScene,
    antennas: Vec<u8>,
    frequency_hz: f64,
    columns: Vec<Column>,
}

impl PathList {
    /// Lists the paths of a scene.
    ///
    /// # Errors
    /// If the seed makes no scene of the file's random values.
    pub fn new(scene: &Scene, options: &PathListOptions) -> Result<Self, SceneError> {
        let scene = scene.drawn(options.seed)?;
        let prepared = PreparedScene::new(&scene, options.seed, options.margin_db);
        let scenario = Scenario::new(&scene, options.seed, options.people);
        let present: Vec<(usize, Arc<Motion>)> = scenario.between(options.time_s, options.time_s);
        let snapshots: Vec<Snapshot> = present.iter().map(|(_, m)| Snapshot::new(m, options.time_s)).collect();
        let frequency_hz = prepared.chirp.start_hz + prepared.chirp.slope_hz_per_s * prepared.chirp.middle_s;
        let lister = Lister {
            scene: &scene,
            antennas: scene.waveform().request.rx_antennas.antennas(),
            frequency_hz,
            columns: snapshots.iter().map(|person| person.column).collect(),
            prepared,
        };
        let mut paths = Vec::new();
        if options.person.is_none() {
            lister.add_walls(&mut paths);
            lister.add_furniture(&mut paths);
        }
        for (target, (slot, motion)) in present.iter().enumerate() {
            if options.person.is_none_or(|person| person == *slot) {
                lister.add_person(&snapshots, target, (*slot, motion), options.time_s, &mut paths);
            }
        }
        paths.sort_by(|a, b| {
            let by_delay = a.delay_s.total_cmp(&b.delay_s);
            a.rx.cmp(&b.rx).then(a.kind.cmp(&b.kind)).then(by_delay).then_with(|| a.surfaces.cmp(&b.surfaces))
        });
        let people = present.iter().map(|(slot, _)| *slot).collect();
        let (name, time_s) = (scene.name().to_owned(), options.time_s);
        Ok(PathList { scene: name, seed: options.seed, time_s, frequency_hz, people, paths })
    }
}

impl Lister<'_> {
    /// Makes a listed path from its delay and its field without the propagation phase.
    fn listed(&self, rx: usize, field: Complex64, delay_s: f64, delay_rate: f64) -> ListedPath {
        let phase = field.arg() - TAU * (self.frequency_hz * delay_s).fract();
        ListedPath {
            rx: self.antennas.get(rx).copied().unwrap_or(0),
            kind: PathKind::Walls,
            surfaces: Vec::new(),
            person: None,
            length_m: delay_s * SPEED_OF_LIGHT_M_PER_S,
            delay_s,
            // The subtraction from 0.0 gives a static path 0 and not -0.
            doppler_hz: 0.0 - self.frequency_hz * delay_rate,
            gain_db: 20.0 * field.norm().max(1e-30).log10(),
            phase_rad: wrapped(phase),
            points_m: Vec::new(),
        }
    }

    /// Field of a path from its amplitude at the ADC; `None` where the filters pass nothing.
    fn field(&self, rx: usize, at_adc: Complex64, beat_hz: f64) -> Option<Complex64> {
        let factor = self.prepared.filters.response(beat_hz) * self.prepared.lsb.get(rx).copied()?;
        Some((at_adc / factor).conj()).filter(|field| field.is_finite())
    }

    /// Relative field on a static path past the people.
    fn people_factor(&self, polyline: &[DVec3]) -> Complex64 {
        let wavelength_m = self.prepared.wavelength_m;
        match self.scene.file().people.shadow {
            ShadowFile::Edge => diffraction::past_columns(polyline, &self.columns, wavelength_m).into(),
            ShadowFile::Strip => diffraction::past_strips(polyline, &self.columns, wavelength_m),
        }
    }

    /// Images whose wall reflections are strong enough at some receiver.
    fn wall_images(&self) -> Vec<ImageIndex> {
        let is_audible = |index: &ImageIndex| self.prepared.wall_loudness_lsb(*index) > self.prepared.threshold_lsb;
        let all = self.prepared.room.images(self.scene.file().room.max_reflections);
        all.into_iter().skip(1).filter(is_audible).collect()
    }

    fn add_walls(&self, out: &mut Vec<ListedPath>) {
        for index in self.wall_images() {
            for (i, rx) in self.prepared.rx.iter().enumerate() {
                let (amplitude, length_m) = self.prepared.room.direct(&self.prepared.tx, index, rx);
                let polyline = self.prepared.room.polyline(index, self.prepared.tx.position, rx.position);
                // A wall may end between the receivers.
                if polyline.is_empty() {
                    continue;
                }
                let field = amplitude * self.people_factor(&polyline);
                out.push(ListedPath {
                    surfaces: self.names(&polyline, None),
                    points_m: polyline.iter().map(DVec3::to_array).collect(),
                    ..self.listed(i, field, length_m / SPEED_OF_LIGHT_M_PER_S, 0.0)
                });
            }
        }
    }

    /// Adds the static paths of furniture, which follow those of walls in the list.
    fn add_furniture(&self, out: &mut Vec<ListedPath>) {
        for path in self.prepared.static_paths.iter().skip(self.wall_images().len()) {
            let people_factor = self.people_factor(&path.polyline);
            for (i, tone) in path.tones.iter().enumerate() {
                let beat_hz = tone.cycles_per_sample * self.prepared.chirp.sample_rate_hz;
                let Some(field) = self.field(i, tone.amplitude, beat_hz) else { continue };
                let polyline = path.point.map(|point| self.point_polyline(point, i)).unwrap_or_default();
                // A wall may end between the receivers. Then the path has its names, and no corners.
                let named = if polyline.is_empty() { &path.polyline } else { &polyline };
                out.push(ListedPath {
                    kind: PathKind::Furniture,
                    surfaces: self.names(named, Some("object")),
                    points_m: polyline.iter().map(DVec3::to_array).collect(),
                    ..self.listed(i, field * people_factor, beat_hz / self.prepared.chirp.slope_hz_per_s, 0.0)
                });
            }
        }
    }

    /// Corners of the path to a receiver by way of a point and a pair of images; empty where there is none.
    fn point_polyline(&self, path: PointPath, rx: usize) -> Vec<DVec3> {
        let PointPath { point, tx_image, rx_image } = path;
        let receiver = self.prepared.rx.get(rx);
        receiver.map(|rx| self.prepared.point_polyline(point, tx_image, rx_image, rx.position)).unwrap_or_default()
    }

    /// Names of the surfaces that a path meets between its ends. On a path by way of furniture (`object` is given), a
    /// corner may lie on furniture or on a wall. A corner on neither is called `object`, or `wall`.
    fn names(&self, polyline: &[DVec3], object: Option<&str>) -> Vec<String> {
        let inner = polyline.get(1..polyline.len().saturating_sub(1)).unwrap_or_default();
        let furniture = |p: DVec3| {
            object?;
            let contains_point = |f: &&crate::scene_file::FurnitureFile| {
                let low = DVec3::from_array(f.position_m);
                let high = low + DVec3::from_array(f.size_m);
                p.cmpge(low - ON_SURFACE_M).all() && p.cmple(high + ON_SURFACE_M).all()
            };
            self.scene.file().furniture.iter().find(contains_point).map(|f| f.name.clone())
        };
        let mut names: Vec<String> = Vec::new();
        for (i, corner) in inner.iter().enumerate() {
            // Corners that coincide lie on an edge; each surface of the edge is named once.
            let coinciding =
                inner[..i].iter().rev().take_while(|before| before.distance(*corner) < ON_SURFACE_M).count();
            let wall = || {
                let before = &names[i - coinciding..];
                let surfaces = self.prepared.room.surface_names(*corner);
                let other = surfaces.iter().find(|name| before.iter().all(|before| before != *name));
                other.or(surfaces.first()).map(|name| (*name).to_owned())
            };
            let name = furniture(*corner).or_else(wall).unwrap_or_else(|| object.unwrap_or("wall").to_owned());
            names.push(name);
        }
        names
    }

    /// Adds the paths by way of a person.
    fn add_person(
        &self,
        people: &[Snapshot],
        target: usize,
        (slot, motion): (usize, &Arc<Motion>),
        time_s: f64,
        out: &mut Vec<ListedPath>,
    ) {
        let receivers = self.prepared.rx.len();
        if receivers == 0 {
            return;
        }
        let pairs = audible_pairs(&self.prepared, motion, time_s);
        let mut samples: Vec<PathSample> = Vec::new();
        echoes(&self.prepared, motion, people, target, &pairs, &mut samples, &mut EchoReport::default());
        for (path, samples) in samples.chunks(receivers).enumerate() {
            let segment = path % SEGMENTS;
            let pair = pairs.get(path / SEGMENTS).copied();
            let point_path = pair.and_then(|(p, q)| {
                let point = self.specular_point(people.get(target)?, segment, (p, q))?;
                Some(PointPath { point, tx_image: p, rx_image: q })
            });
            let body = match pair {
                Some(_) => format!("person {slot} {}", SEGMENT_NAMES[segment]),
                None => format!("person {slot} at desk"),
            };
            for (i, sample) in samples.iter().enumerate() {
                let beat_hz = self.prepared.chirp.beat_hz(sample.delay_s, sample.delay_rate);
                let Some(field) = self.field(i, sample.amplitude, beat_hz) else { continue };
                if sample.amplitude.norm() <= self.prepared.threshold_lsb {
                    continue;
                }
                let polyline = point_path.map(|path| self.point_polyline(path, i)).unwrap_or_default();
                out.push(ListedPath {
                    kind: PathKind::Person,
                    surfaces: self.names_with_body(&polyline, pair, &body),
                    person: Some(slot),
                    points_m: polyline.iter().map(DVec3::to_array).collect(),
                    ..self.listed(i, field, sample.delay_s, sample.delay_rate)
                });
            }
        }
    }

    /// Specular point of a body segment for the first receiver, which frames use for all receivers.
    fn specular_point(&self, snapshot: &Snapshot, segment: usize, (p, q): (ImageIndex, ImageIndex)) -> Option<DVec3> {
        let source = self.prepared.room.image_position(p, self.prepared.tx.position);
        let sink = self.prepared.room.image_position(q, self.prepared.rx.first()?.position);
        Some(snapshot.body.get(segment)?.specular_point(source, sink, None)?.point)
    }

    /// Names of the walls before the body, the body, and the walls behind it.
    fn names_with_body(&self, polyline: &[DVec3], pair: Option<(ImageIndex, ImageIndex)>, body: &str) -> Vec<String> {
        let Some((tx_image, _)) = pair.filter(|_| !polyline.is_empty()) else { return vec![body.to_owned()] };
        let mut names = self.names(polyline, None);
        if let Some(name) = names.get_mut(self.prepared.room.order(tx_image) as usize) {
            *name = body.to_owned();
        }
        names
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    fn corridor() -> Scene {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fixtures/scenes/corridor.toml");
        Scene::load(&path).expect("a scene")
    }

    /// The delays, Doppler shifts and phases of walkers agree with their positions a short time later.
    #[test]
    fn doppler_is_the_rate_of_the_phase() {
        let scene = corridor();
        let at = |time_s: f64| {
            let options = PathListOptions { seed: 5, people: Some(1), time_s, margin_db: 20.0, ..Default::default() };
            PathList::new(&scene, &options).expect("a list")
        };
        let step_s = 1e-5;
        let some = |list: &PathList| list.paths.iter().any(|path| path.kind == PathKind::Person);
        let start_s = (0..60).map(|i| 0.5 * f64::from(i)).find(|&t| some(&at(t))).expect("somebody comes");
        let (before, after) = (at(start_s + 1.0 - step_s), at(start_s + 1.0 + step_s));
        let mut checked = 0;
        for path in at(start_s + 1.0).paths.iter().filter(|path| path.kind == PathKind::Person) {
            let same = |list: &PathList| {
                let is_same = |p: &&ListedPath| p.rx == path.rx && p.surfaces == path.surfaces;
                list.paths.iter().find(is_same).map(|p| p.delay_s)
            };
            let (Some(a), Some(b)) = (same(&before), same(&after)) else { continue };
            let doppler_hz = -after.frequency_hz * (b - a) / (2.0 * step_s);
            assert!((doppler_hz - path.doppler_hz).abs() < 2.0, "{path:?}: {doppler_hz}");
            checked += 1;
        }
        assert!(checked > 3, "{checked} paths");
    }

    /// Paths by way of furniture and people ended at the transmitter.
    #[test]
    fn paths_begin_at_the_transmitter_and_end_at_their_receiver() {
        let (tx, rx) = corridor().elements();
        let at = |time_s: f64| {
            let options = PathListOptions { seed: 5, people: Some(1), time_s, margin_db: 20.0, ..Default::default() };
            PathList::new(&corridor(), &options).expect("a list").paths
        };
        let all: Vec<ListedPath> = [2.0, 4.0, 6.0, 8.0].into_iter().flat_map(at).collect();
        for kind in [PathKind::Walls, PathKind::Furniture, PathKind::Person] {
            let some: Vec<&ListedPath> = all.iter().filter(|p| p.kind == kind && !p.points_m.is_empty()).collect();
            assert!(!some.is_empty(), "{kind:?}");
            for path in some {
                let ends = [0, path.points_m.len() - 1].map(|corner| DVec3::from_array(path.points_m[corner]));
                let receiver = rx[usize::from(path.rx) - 1].position;
                assert!(ends[0].distance(tx.position) < 1e-9 && ends[1].distance(receiver) < 1e-9, "{path:?}");
            }
        }
    }

    /// Corners between a body or furniture and a receiver were those of the way to the transmitter.
    #[test]
    fn walls_reflect_listed_paths_as_mirrors() {
        let options = PathListOptions { seed: 5, people: Some(1), time_s: 6.0, margin_db: 40.0, ..Default::default() };
        let list = PathList::new(&corridor(), &options).expect("a list");
        let mut checked = [0; 3];
        for path in &list.paths {
            for (corners, name) in path.points_m.windows(3).zip(&path.surfaces) {
                let walls = ["x_low", "x_high", "y_low", "y_high", "floor", "ceiling"];
                let Some(wall) = walls.iter().position(|wall| wall == name) else { continue };
                let [from, at, to] = [0, 1, 2].map(|i| DVec3::from_array(corners[i]));
                let mut mirrored = (at - from).normalize_or_zero();
                mirrored[wall / 2] *= -1.0;
                // Corners on an edge of the room turn twice at once.
                if at.distance(from).min(at.distance(to)) > 1e-3 {
                    assert!(mirrored.distance((to - at).normalize()) < 1e-9, "{name}: {path:?}");
                    checked[path.kind as usize] += 1;
                }
            }
        }
        assert!(checked.iter().all(|count| *count > 10), "{checked:?}");
    }

    #[test]
    fn furniture_and_walls_have_their_names() {
        let options = PathListOptions { people: Some(0), margin_db: 40.0, ..Default::default() };
        let list = PathList::new(&corridor(), &options).expect("a list");
        let has = |name: &str| list.paths.iter().any(|path| path.surfaces.iter().any(|s| s == name));
        assert!(has("radiator") && has("x_high") && has("floor") && !has("wall"), "{list:#?}");
        assert!(list.paths.iter().all(|path| path.doppler_hz == 0.0 && path.phase_rad.abs() <= 0.5 * TAU + 1e-9));
    }
}
