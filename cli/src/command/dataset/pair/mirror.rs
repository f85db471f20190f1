//! The scene that mirrors a recording, as a file that `simulate` opens.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use radome_dsp::Waveform;
use radome_sim::Scene;
use radome_sim::scene::file::StepFile;
use toml::{Table, Value};

/// A scene file without its people and with a recording's waveform: what a mirror is made from.
pub struct Stage {
    table: Table,
    /// The scene, empty.
    pub scene: Scene,
    /// Whether the file had another waveform.
    pub waveform_replaced: bool,
}

impl Stage {
    /// Reads a scene file; its people, if it has any, are left out.
    pub fn load(path: &Path, waveform: &Waveform) -> anyhow::Result<Self> {
        let text = std::fs::read_to_string(path).with_context(|| format!("{} cannot be read", path.display()))?;
        let mut table: Table = toml::from_str(&text).with_context(|| format!("{} is no scene", path.display()))?;
        if table.get("random").and_then(Value::as_table).is_some_and(|random| !random.is_empty()) {
            bail!(
                "{}: the scene is another for each seed\n\nhint: a recording shows one room: write its values in place of [random]",
                path.display()
            );
        }
        let folder = path.parent().unwrap_or(Path::new(""));
        if let Some(Value::String(relative)) = table.get("receiver") {
            let receiver = radome_sim::load_receiver(&folder.join(relative))?;
            table.insert("receiver".into(), Value::try_from(&receiver).context("the receiver as TOML")?);
        }
        absolute_meshes(&mut table, folder);
        let own = table.get("waveform").cloned();
        let request = Value::try_from(&waveform.request).context("the waveform as TOML")?;
        table.insert("waveform".into(), request);
        let body = table.get("people").and_then(|p| p.get("body")).cloned();
        let mut people = Table::new();
        if let Some(body) = body {
            people.insert("body".into(), body);
        }
        table.insert("people".into(), Value::Table(people));
        let scene = Scene::parse(&with_people(&table, Vec::new()).to_string(), path)?;
        let realised = scene.waveform();
        realised.check_compatible(waveform).context("the recording's frames are not those of its own settings")?;
        let apart_hz = (realised.sampled_start_frequency_hz - waveform.sampled_start_frequency_hz).abs();
        if apart_hz > 0.01 * waveform.sampled_bandwidth_hz() {
            bail!(
                "the recording was sampled from {:.4} GHz on, a chip with its settings from {:.4} GHz on: they cannot be mirrored",
                waveform.sampled_start_frequency_hz * 1e-9,
                realised.sampled_start_frequency_hz * 1e-9
            );
        }
        let waveform_replaced = own
            .and_then(|own| own.try_into().ok())
            .and_then(|request| Waveform::realise(request).ok())
            .is_none_or(|own| own.check_compatible(waveform).is_err() || waveform.check_compatible(&own).is_err());
        Ok(Stage { table, scene, waveform_replaced })
    }

    /// The scene file with these people: when each begins, and what they do.
    pub fn with_scripts(&self, name: &str, height_m: f64, scripts: &[(f64, Vec<StepFile>)]) -> String {
        let mut table = self.table.clone();
        table.insert("name".into(), Value::String(name.to_owned()));
        let actors = scripts.iter().map(|(start_s, steps)| {
            let mut actor = Table::new();
            actor.insert("start_s".into(), Value::Float(*start_s));
            actor.insert("height_m".into(), Value::Float(height_m));
            actor.insert("step".into(), Value::Array(steps.iter().map(step).collect()));
            Value::Table(actor)
        });
        with_people(&table, actors.collect()).to_string()
    }
}

fn step(step: &StepFile) -> Value {
    let mut table = Table::new();
    if let Some([x, y]) = step.walk_to_m {
        table.insert("walk_to_m".into(), Value::Array(vec![Value::Float(x), Value::Float(y)]));
    }
    for (key, value) in [("speed_m_per_s", step.speed_m_per_s), ("stand_s", step.stand_s), ("sit_s", step.sit_s)] {
        if let Some(value) = value {
            table.insert(key.into(), Value::Float(value));
        }
    }
    Value::Table(table)
}

/// A table with these actors, or with nobody.
fn with_people(table: &Table, actors: Vec<Value>) -> Table {
    let mut table = table.clone();
    if let Some(Value::Table(people)) = table.get_mut("people") {
        if actors.is_empty() {
            // The one program that can be told to have neither people nor doors.
            people.remove("body");
            let nobody = [("max_people", Value::Integer(0)), ("objects_probability", Value::Float(0.0))];
            people.insert("desk".into(), Value::Table(nobody.map(|(k, v)| (k.to_owned(), v)).into_iter().collect()));
        } else {
            people.insert("actor".into(), Value::Array(actors));
        }
    }
    table
}

/// Mirrors lie in another folder than their scenes.
fn absolute_meshes(table: &mut Table, folder: &Path) {
    let meshes = table.get_mut("room").and_then(|room| room.get_mut("mesh")).and_then(Value::as_array_mut);
    for mesh in meshes.into_iter().flatten() {
        if let Some(Value::String(file)) = mesh.get_mut("file") {
            let path: PathBuf = folder.join(&*file);
            *file = std::fs::canonicalize(&path).unwrap_or(path).display().to_string();
        }
    }
}
