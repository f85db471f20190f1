//! Scenes: the checked and resolved content of scene files.

pub(crate) mod ground;
pub mod surfaces;

mod actors;
mod check;
mod draft;
mod plan;
mod room;

pub use plan::Opening;
pub use room::Outline;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::{DMat3, DVec3};
use radome_dsp::{RxMask, SPEED_OF_LIGHT_M_PER_S, Waveform, WaveformError};
use radome_files::{TEXT_LIMIT_BYTES, named_by_spec, parse_toml, read_text};
use thiserror::Error;

use crate::em::image::{BoxRoom, Element, Wall};
use crate::em::pattern::Pattern;
use crate::file_error::FileError;
use crate::people::motion::Steps;
use crate::receiver::{InvalidConstant, Receiver};
use crate::scene_file::draw::{Draw, drawn, longest_list};
use crate::scene_file::{BodyFile, SceneFile};
use room::RoomMeshes;
use surfaces::Surfaces;

/// Error of a scene that cannot be used.
#[derive(Debug, Error)]
pub enum SceneError {
    /// A file cannot be read.
    #[error("{path}: cannot be read: {source}")]
    Read {
        /// Path of the file.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// A file is not valid TOML, or has a wrong key or type.
    #[error("{}: {message}", path_and_line(.path, *.line))]
    Parse {
        /// Path of the file.
        path: PathBuf,
        /// Line number, from 1; none if it is not known which of several lines it is.
        line: Option<usize>,
        /// Message of the parser: the text found and the text expected.
        message: String,
    },
    /// A value is not allowed.
    #[error("{}: {key} is {value}, expected {expected}", path_and_line(.path, *.line))]
    Value {
        /// Path of the file.
        path: PathBuf,
        /// Line number, from 1; the file's first line if the key is not written there. None if several lines have the key,
        /// and it is not known which of them it is.
        line: Option<usize>,
        /// Key of the value.
        key: String,
        /// Value that was given.
        value: String,
        /// Description of the allowed values.
        expected: String,
    },
    /// A key of `[random]` cannot be drawn.
    #[error("{path}:{line}: random: {key}: found {found}, expected {expected}")]
    Random {
        /// Path of the file.
        path: PathBuf,
        /// Line number, from 1; the file's first line if the key is not written there.
        line: usize,
        /// Key of `[random]`.
        key: String,
        /// Content that was found.
        found: String,
        /// Description of the allowed content.
        expected: String,
    },
    /// Values within the ranges of `[random]` do not form a valid scene.
    #[error("{path}: values drawn from [random] ({which}) make no scene: {reason}")]
    Drawn {
        /// Path of the file.
        path: PathBuf,
        /// Values that were drawn.
        which: String,
        /// Reason, with line numbers of the scene that has those values.
        reason: String,
    },
    /// A file that the scene refers to, an actor's or a room's, cannot be used.
    #[error("{path}:{line}: {file}: {source}")]
    File {
        /// Path of the scene file.
        path: PathBuf,
        /// Line of the scene file that names the file.
        line: usize,
        /// Path of the file.
        file: PathBuf,
        /// Place in the file, problem and remedy.
        source: Box<FileError>,
    },
    /// The chip cannot produce the waveform.
    #[error("{path}:{line}: {source}")]
    Waveform {
        /// Path of the scene file.
        path: PathBuf,
        /// Line of the waveform's table.
        line: usize,
        /// Reason why the chip cannot produce it.
        source: WaveformError,
    },
}

/// Positions of the transmit and receive antennas on the package, in the radar's frame (x boresight, y left, z up), m.
/// The receivers form an L with RX3 in the corner, 2.5 mm apart: RX1 & RX3 give azimuth, RX2 & RX3 elevation. The
/// distance from TX to the corner is an estimate.
pub const ANTENNA_OFFSETS_M: AntennaOffsets = AntennaOffsets {
    tx: DVec3::new(0.0, -0.003, 0.0),
    rx: [DVec3::new(0.0, 0.0045, 0.0), DVec3::new(0.0, 0.002, 0.0025), DVec3::new(0.0, 0.002, 0.0)],
};

/// Positions of antennas relative to the package; see [`ANTENNA_OFFSETS_M`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AntennaOffsets {
    /// Position of the transmitter, m.
    pub tx: DVec3,
    /// Positions of the receivers RX1, RX2, RX3, m.
    pub rx: [DVec3; 3],
}

/// A scene, checked and ready to be simulated.
#[derive(Debug, Clone)]
pub struct Scene {
    file: SceneFile,
    path: PathBuf,
    waveform: Waveform,
    receiver: Receiver,
    /// Receiver that replaces the file's receiver.
    receiver_override: Option<Receiver>,
    /// Model of people's bodies that replaces the file's model.
    body_override: Option<BodyFile>,
    /// Text of the file, if its `[random]` table has keys.
    random_text: Option<Arc<str>>,
    outlines: Arc<[Outline]>,
    meshes: Arc<RoomMeshes>,
    walls: [Wall; 6],
    steps: Vec<Steps>,
}

impl Scene {
    /// Reads a scene file and the files that it refers to. These are in its folder, or where
    /// [`radome_files::named_by_spec`] allows.
    ///
    /// # Errors
    /// [`SceneError`] if the scene, or a file that it refers to, cannot be used.
    pub fn load(path: &Path) -> Result<Self, SceneError> {
        let text = read(path)?;
        Self::parse(&text, path)
    }

    /// Reads a scene from a file and replaces some keys of its `[waveform]`. Line numbers in errors then refer to the
    /// changed text.
    ///
    /// # Errors
    /// Those of [`Scene::load`].
    pub fn load_with_waveform(path: &Path, keys: &toml::Table) -> Result<Self, SceneError> {
        let text = read(path)?;
        if keys.is_empty() {
            return Self::parse(&text, path);
        }
        let mut table: toml::Table = toml::from_str(&text).map_err(|e| parse_error(path, &text, &e))?;
        if let Some(toml::Value::Table(waveform)) = table.get_mut("waveform") {
            waveform.extend(keys.clone());
        }
        Self::parse(&table.to_string(), path)
    }

    /// Makes a scene of empty space before a radar with a waveform. It shows the receiver's own output.
    ///
    /// # Errors
    /// [`SceneError`] if no scene can have the waveform.
    pub fn empty_space(waveform: &Waveform) -> Result<Self, SceneError> {
        let request = toml::to_string(&waveform.request).unwrap_or_default();
        let open = room::WALLS.map(|(name, ..)| format!("{name} = {{ material = \"open\" }}\n"));
        let text = format!(
            "format = 1\nname = \"nothing\"\n[room]\nsize_m = [50.0, 50.0, 50.0]\n{}[radar]\nposition_m = [25.0, 25.0, 25.0]\n\
             [people.desk]\nmax_people = 0\nobjects_probability = 0.0\n[waveform]\n{request}",
            open.concat()
        );
        Self::parse(&text, Path::new("(nothing)"))
    }

    /// Parses a scene from text. `path` is used in messages, and receiver files are relative to it.
    ///
    /// # Errors
    /// Those of [`Scene::load`], except for reading the scene's own file.
    pub fn parse(text: &str, path: &Path) -> Result<Self, SceneError> {
        /// Largest number of values of a list that are tried. Each takes as long as reading the scene. The first and
        /// the last value are tried with the ends of the ranges.
        const MOST_TRIED: usize = 100;
        let mut scene = Self::parse_fixed(text, path)?;
        if !scene.file.random.is_empty() {
            scene.random_text = Some(text.into());
            let last = longest_list(&scene.file.random).saturating_sub(1);
            let listed = (1..last.min(MOST_TRIED)).map(Draw::Listed);
            for draw in [Draw::Least, Draw::Greatest].into_iter().chain(listed) {
                scene.drawn_at(draw)?;
            }
        }
        Ok(scene)
    }

    /// Draws the scene of a seed. It is this scene if the file has no `[random]` table.
    ///
    /// # Errors
    /// [`SceneError`] if the drawn values do not form a valid scene, or the receiver's file cannot be read any more.
    pub fn drawn(&self, seed: u64) -> Result<Self, SceneError> {
        self.drawn_at(Draw::Seed(seed))
    }

    /// Draws the scene with the values that `draw` chooses.
    fn drawn_at(&self, draw: Draw) -> Result<Self, SceneError> {
        let Some(text) = &self.random_text else { return Ok(self.clone()) };
        let path = &self.path;
        let mut table: toml::Table = toml::from_str(text).map_err(|e| parse_error(path, text, &e))?;
        if let Some(toml::Value::String(relative)) = table.get("receiver")
            && self.file.random.keys().any(|key| key.starts_with("receiver."))
        {
            let receiver_path = referenced_path(path, relative)?;
            let receiver = read(&receiver_path)?;
            let receiver = toml::from_str(&receiver).map_err(|e| parse_error(&receiver_path, &receiver, &e))?;
            table.insert("receiver".to_owned(), toml::Value::Table(receiver));
        }
        let table = drawn(&table, &self.file.random, draw).map_err(|error| SceneError::Random {
            path: path.clone(),
            line: line_of_key(text, &error.key),
            key: error.key,
            found: error.found,
            expected: error.expected.to_owned(),
        })?;
        let drawn_text = table.to_string();
        let parse = || Self::parse_fixed(&drawn_text, path);
        // Warnings were given when the file was read, for the ends of all ranges and for listed values. They are not
        // repeated for each seed.
        let parsed = match draw {
            Draw::Seed(_) => tracing::subscriber::with_default(tracing::subscriber::NoSubscriber::default(), parse),
            Draw::Least | Draw::Greatest | Draw::Listed(_) => parse(),
        };
        let scene = parsed.map_err(|reason| SceneError::Drawn {
            path: path.clone(),
            which: match draw {
                Draw::Seed(seed) => format!("seed {seed}"),
                Draw::Least => "all the least".to_owned(),
                Draw::Greatest => "all the greatest".to_owned(),
                Draw::Listed(index) => format!("number {} of each list", index + 1),
            },
            reason: reason.to_string(),
        })?;
        let scene = scene.with_receivers(self.waveform.request.rx_antennas);
        let scene = match self.body_override {
            Some(body) => scene.with_body(body),
            None => scene,
        };
        Ok(match &self.receiver_override {
            Some(receiver) => scene.with_receiver(receiver.clone()),
            None => scene,
        })
    }

    /// Parses a scene with the values that its text states, without drawing those of `[random]`.
    fn parse_fixed(text: &str, path: &Path) -> Result<Self, SceneError> {
        let mut file: SceneFile = parse_toml(text).map_err(|e| parse_error(path, text, &e))?;
        let receiver = match &file.receiver {
            None => Receiver::typical(),
            Some(toml::Value::String(relative)) => load_receiver(&referenced_path(path, relative)?)?,
            Some(inline) => {
                let receiver: Receiver = inline.clone().try_into().map_err(|e: toml::de::Error| {
                    let message = format!("receiver: {}", without_type_names(e.message()));
                    SceneError::Parse { path: path.to_owned(), line: Some(line_of_key(text, "receiver")), message }
                })?;
                check_receiver(&receiver, path, text)?;
                receiver
            }
        };
        let waveform = Waveform::realise(file.waveform.clone()).map_err(|source| {
            let line = line_of_key(text, "[waveform]");
            SceneError::Waveform { path: path.to_owned(), line, source }
        })?;
        let scene_error = |invalid: check::InvalidValue| invalid.into_scene_error(path, text);
        check::check_materials(&file).map_err(scene_error)?;
        check::check_radar_outside_furniture(&file).map_err(scene_error)?;
        plan::check_and_fill(&mut file).map_err(scene_error)?;
        let (mut outlines, meshes) = room::read_meshes(&mut file, path, text, waveform.centre_frequency_hz())?;
        room::fill_cross_sections(&mut file, waveform.centre_frequency_hz());
        check::check(&file).map_err(scene_error)?;
        plan::check_places(&file).map_err(scene_error)?;
        let walls = room::walls(&file, &waveform).map_err(scene_error)?;
        room::warn_of_bands_within(&file, &meshes, &waveform);
        surfaces::sources::warn_of_small_faces(&file, &meshes, path);
        let steps = actors::load(&file, path, text)?;
        if let Some(plan) = &file.room.plan {
            (_, outlines) = plan::faces(&file, plan, waveform.centre_frequency_hz());
        }
        let path = path.to_owned();
        let (outlines, meshes) = (outlines.into(), Arc::new(meshes));
        Ok(Scene {
            file,
            path,
            waveform,
            receiver,
            receiver_override: None,
            body_override: None,
            random_text: None,
            outlines,
            meshes,
            walls,
            steps,
        })
    }

    /// The waveform as the chip realises it.
    pub fn waveform(&self) -> &Waveform {
        &self.waveform
    }

    /// Constants of the receiver.
    pub fn receiver(&self) -> &Receiver {
        &self.receiver
    }

    /// The scene as its file states it.
    pub fn file(&self) -> &SceneFile {
        &self.file
    }

    /// Source of the person's steps for each `[[people.actor]]`.
    pub fn steps(&self) -> &[Steps] {
        &self.steps
    }

    /// Outlines of the room's meshes or of the faces of its plan; none where the room is a box.
    pub fn outlines(&self) -> &[Outline] {
        &self.outlines
    }

    /// Whether a piece of furniture, by its index, stands for walls within the room's meshes. Its box may hold a part of the
    /// floor.
    pub fn is_wall_of_mesh(&self, furniture: usize) -> bool {
        ground::is_wall(self, furniture)
    }

    /// Openings of the room's plan; none without a plan.
    pub fn openings(&self) -> Vec<Opening<'_>> {
        self.file.room.plan.as_ref().map_or_else(Vec::new, plan::openings)
    }

    /// Name of the scene.
    pub fn name(&self) -> &str {
        &self.file.name
    }

    /// Path from which the scene was read.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Replaces the receiver.
    pub fn with_receiver(mut self, receiver: Receiver) -> Self {
        self.receiver_override = Some(receiver.clone());
        self.receiver = receiver;
        self
    }

    /// Replaces the enabled receive antennas. For ellipsoids, the signal of one antenna does not depend on the later
    /// antennas, to the bit. Skins are evaluated from the middle of all antennas. The error of that is far below the
    /// tolerance.
    pub fn with_receivers(mut self, rx_antennas: RxMask) -> Self {
        self.file.waveform.rx_antennas = rx_antennas;
        self.waveform.request.rx_antennas = rx_antennas;
        self
    }

    /// Replaces the body model of people. People at a desk have no skin, so they keep their model.
    pub fn with_body(mut self, body: BodyFile) -> Self {
        if self.file.people.desk.is_none() {
            self.file.people.body = body;
            self.body_override = Some(body);
        }
        self
    }

    /// Rotation from room axes to radar axes (x boresight, y left, z up).
    pub fn radar_from_world(&self) -> DMat3 {
        let azimuth = self.file.radar.azimuth_deg.to_radians();
        let tilt = self.file.radar.tilt_down_deg.to_radians();
        (DMat3::from_rotation_z(azimuth) * DMat3::from_rotation_y(tilt)).transpose()
    }

    /// Position of the radar, m.
    pub fn radar_position(&self) -> DVec3 {
        DVec3::from_array(self.file.radar.position_m)
    }

    /// Wave number in the middle of the sampled band, 1/m.
    pub fn wavenumber_per_m(&self) -> f64 {
        std::f64::consts::TAU * self.waveform.centre_frequency_hz() / SPEED_OF_LIGHT_M_PER_S
    }

    /// The room with its walls.
    pub fn room(&self) -> BoxRoom {
        let room = &self.file.room;
        let (size_m, wavenumber_per_m) = (DVec3::from_array(room.size_m), self.wavenumber_per_m());
        BoxRoom::with_diffuse_share(size_m, self.walls, wavenumber_per_m, room.transmission, room.diffuse_share)
    }

    /// All surfaces in room coordinates: walls, floors and furniture. They are computed anew at each call.
    pub fn surfaces(&self) -> Surfaces {
        surfaces::sources::surfaces(&self.file, &self.walls, &self.meshes, self.waveform.centre_frequency_hz())
    }

    /// The transmitter and the waveform's enabled receivers, vertical polarisation.
    pub fn elements(&self) -> (Element, Vec<Element>) {
        let enabled = self.waveform.request.rx_antennas.antennas();
        let all = self.receivers_of_board();
        let rx = enabled.iter().filter_map(|&antenna| all.get(usize::from(antenna) - 1)).copied().collect();
        (self.element(ANTENNA_OFFSETS_M.tx), rx)
    }

    /// All receivers of the board, enabled or not.
    pub fn receivers_of_board(&self) -> Vec<Element> {
        ANTENNA_OFFSETS_M.rx.iter().map(|&offset| self.element(offset)).collect()
    }

    /// Antenna at a place on the board, m.
    fn element(&self, offset: DVec3) -> Element {
        let radar_from_world = self.radar_from_world();
        let world_from_radar = radar_from_world.transpose();
        let antenna = &self.receiver.antenna;
        let pattern = Pattern::new(
            antenna.azimuth_beamwidth_deg.to_radians(),
            antenna.elevation_beamwidth_deg.to_radians(),
            antenna.side_lobe_floor_db,
        );
        Element {
            position: self.radar_position() + world_from_radar * offset,
            polarisation: world_from_radar * DVec3::Z,
            radar_from_world,
            pattern,
        }
    }
}

/// Reads and checks a receiver file.
///
/// # Errors
/// [`SceneError`] if the file cannot be read, is malformed, or has a value that is out of range.
pub fn load_receiver(path: &Path) -> Result<Receiver, SceneError> {
    let text = read(path)?;
    let receiver: Receiver = parse_toml(&text).map_err(|e| parse_error(path, &text, &e))?;
    check_receiver(&receiver, path, &text)?;
    Ok(receiver)
}

fn check_receiver(receiver: &Receiver, path: &Path, text: &str) -> Result<(), SceneError> {
    match receiver.first_invalid() {
        None => Ok(()),
        Some(InvalidConstant { key, value, expected }) => Err(SceneError::Value {
            path: path.to_owned(),
            line: line_of_value(text, key, &value),
            key: key.to_owned(),
            value,
            expected,
        }),
    }
}

fn read(path: &Path) -> Result<String, SceneError> {
    read_text(path, TEXT_LIMIT_BYTES).map_err(|source| SceneError::Read { path: path.to_owned(), source })
}

/// Error of a file that a scene names.
fn file_error(scene: &Path, text: &str, name: &str, source: FileError) -> SceneError {
    let file = scene.parent().unwrap_or(Path::new("")).join(name);
    SceneError::File { path: scene.to_owned(), line: line_of_key(text, name), file, source: Box::new(source) }
}

/// Returns the path of a TOML file that a scene file names.
fn referenced_path(scene: &Path, name: &str) -> Result<PathBuf, SceneError> {
    let folder = scene.parent().unwrap_or(Path::new(""));
    named_by_spec(folder, Path::new(name)).map_err(|source| SceneError::Read { path: folder.join(name), source })
}

/// Error of TOML that cannot be parsed, with its line.
fn parse_error(path: &Path, text: &str, error: &toml::de::Error) -> SceneError {
    let message = without_type_names(error.message());
    let line = match error.span() {
        Some(span) => Some(line_of(text, span.start)),
        // A surplus value has no place, and the message ends with the path of its key.
        None => {
            let key = message.trim_end_matches('`').rsplit(['.', '`']).next().unwrap_or_default();
            match lines_of_key(text, key).collect::<Vec<_>>().as_slice() {
                [] => Some(1),
                [(line, _)] => Some(*line),
                _ => None,
            }
        }
    };
    SceneError::Parse { path: path.to_owned(), line, message }
}

/// Line number of a byte, from 1.
fn line_of(text: &str, offset: usize) -> usize {
    1 + text.bytes().take(offset).filter(|&b| b == b'\n').count()
}

/// Replaces names of Rust types in a message of the parser by plain words.
fn without_type_names(message: &str) -> String {
    let Some((found, expected)) = message.rsplit_once("expected ") else { return message.to_owned() };
    let words = match expected.split(' ').next().unwrap_or_default() {
        "struct" => "a table",
        "u8" => "a whole number from 0 to 255",
        "u32" => "a whole number from 0 to 4294967295",
        "u64" | "usize" => "a whole number of 0 or more",
        "f64" => "a number",
        _ => return message.to_owned(),
    };
    format!("{found}expected {words}")
}

/// Path of a file with the number of a line, if that is known.
fn path_and_line(path: &Path, line: Option<usize>) -> String {
    line.map_or_else(|| path.display().to_string(), |line| format!("{}:{line}", path.display()))
}

/// First line on which a key (or a table header) is written; 1 if nowhere.
fn line_of_key(text: &str, key: &str) -> usize {
    lines_of_key(text, key).next().map_or(1, |(line, _)| line)
}

/// Line on which a key has a value. If several lines have the key, it is the only one that also has the value, or
/// `None` if there is not exactly one. 1 if the key is written nowhere.
fn line_of_value(text: &str, key: &str, value: &str) -> Option<usize> {
    // Numbers may be written in several ways, as 2 and 2.0.
    let numbers = |text: &str| -> Vec<f64> {
        let words = text.split(|c: char| !(c.is_ascii_alphanumeric() || "+-._".contains(c)));
        words.filter_map(|word| word.replace('_', "").parse().ok()).collect()
    };
    let value_numbers = numbers(value);
    let has_value = |rest: &str| {
        if value_numbers.is_empty() { rest.contains(value) } else { numbers(rest).starts_with(&value_numbers) }
    };
    match lines_of_key(text, key).collect::<Vec<_>>().as_slice() {
        [] => Some(1),
        [(line, _)] => Some(*line),
        several => {
            let mut matching = several.iter().filter(|(_, rest)| has_value(rest)).map(|(line, _)| *line);
            matching.next().filter(|_| matching.next().is_none())
        }
    }
}

/// Lines on which a key (or a table header) is written: the number of each, from 1, and what follows the key.
fn lines_of_key<'a>(text: &'a str, key: &'a str) -> impl Iterator<Item = (usize, &'a str)> {
    let is_edge = |c: Option<char>| c.is_none_or(|c| !(c.is_alphanumeric() || c == '_'));
    (1..).zip(text.lines()).filter_map(move |(number, line)| {
        let line = line.split('#').next().unwrap_or("");
        let mut parts = line.match_indices(key).map(move |(at, _)| (&line[..at], &line[at + key.len()..]));
        let is_whole =
            |(before, after): &(&str, &str)| is_edge(before.chars().next_back()) && is_edge(after.chars().next());
        parts.find(is_whole).map(|(_, after)| (number, after))
    })
}
