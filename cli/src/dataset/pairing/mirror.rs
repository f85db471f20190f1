//! Scene that mirrors a recording, as a scene file for `simulate`.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use radome_dsp::Waveform;
use radome_files::{MESH_LIMIT_BYTES, TEXT_LIMIT_BYTES, named_by_spec, read, read_text};
use radome_sim::Scene;
use radome_sim::scene_file::StepFile;
use toml::{Table, Value};

/// Scene without people and with a recording's waveform, which becomes a mirror when people are added.
pub struct SceneTemplate {
    /// Table of the scene file, with the meshes' names in its own folder.
    pub table: Table,
    /// Table for a scene file in the dataset's folder, with the meshes' names there.
    pub stored: Table,
    /// Meshes of the room: name in the dataset's folder, and source path.
    meshes: Vec<(String, PathBuf)>,
    /// Scene without people.
    pub scene: Scene,
    /// Whether the file's own waveform differed and was replaced.
    pub waveform_replaced: bool,
}

impl SceneTemplate {
    /// Reads a scene file without its people.
    ///
    /// # Errors
    /// The file cannot be read, is another scene for each seed, or does not take the recording's waveform.
    pub fn load(path: &Path, waveform: &Waveform) -> anyhow::Result<Self> {
        let text = read_text(path, TEXT_LIMIT_BYTES).with_context(|| format!("{} cannot be read", path.display()))?;
        let mut table: Table = toml::from_str(&text).with_context(|| format!("{} is no scene", path.display()))?;
        ensure!(
            table.get("random").and_then(Value::as_table).is_none_or(Table::is_empty),
            "{}: the scene is another for each seed\n\nhint: a recording shows one room: write its values in place of [random]",
            path.display()
        );
        let folder = path.parent().unwrap_or(Path::new(""));
        if let Some(Value::String(relative)) = table.get("receiver") {
            let file =
                named_by_spec(folder, Path::new(relative)).with_context(|| format!("{}: receiver", path.display()))?;
            let receiver = radome_sim::load_receiver(&file)?;
            table.insert("receiver".into(), Value::try_from(&receiver).context("the receiver as TOML")?);
        }
        let scene_waveform = table.get("waveform").cloned();
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
        let difference_hz = (realised.sampled_start_frequency_hz - waveform.sampled_start_frequency_hz).abs();
        if difference_hz > 0.01 * waveform.sampled_bandwidth_hz() {
            bail!(
                "the recording was sampled from {:.4} GHz on, a chip with its settings from {:.4} GHz on: they cannot be mirrored",
                waveform.sampled_start_frequency_hz * 1e-9,
                realised.sampled_start_frequency_hz * 1e-9
            );
        }
        let waveform_replaced = scene_waveform
            .and_then(|waveform| waveform.try_into().ok())
            .and_then(|request| Waveform::realise(request).ok())
            .is_none_or(|own| own.check_compatible(waveform).is_err() || waveform.check_compatible(&own).is_err());
        let mut stored = table.clone();
        let meshes = rename_meshes(&mut stored, folder)?;
        Ok(SceneTemplate { table, stored, meshes, scene, waveform_replaced })
    }

    /// Returns name and content of the mesh files that belong beside the stored scene.
    ///
    /// # Errors
    /// One cannot be read.
    pub fn mesh_files(&self) -> anyhow::Result<Vec<(&str, Vec<u8>)>> {
        let mut files = Vec::new();
        for (name, path) in &self.meshes {
            let bytes = read(path, MESH_LIMIT_BYTES).with_context(|| format!("{} cannot be read", path.display()))?;
            files.push((name.as_str(), bytes));
        }
        Ok(files)
    }

    /// Formats a scene file with these people: the start time and the steps of each.
    ///
    /// # Errors
    /// A step has no form in TOML.
    pub fn with_scripts(
        table: &Table,
        name: &str,
        height_m: f64,
        scripts: &[(f64, Vec<StepFile>)],
    ) -> anyhow::Result<String> {
        let mut table = table.clone();
        table.insert("name".into(), Value::String(name.to_owned()));
        let actors = scripts.iter().map(|(start_s, steps)| {
            let mut actor = Table::new();
            actor.insert("start_s".into(), Value::Float(*start_s));
            actor.insert("height_m".into(), Value::Float(height_m));
            actor.insert("step".into(), Value::try_from(steps).context("the steps as TOML")?);
            anyhow::Ok(Value::Table(actor))
        });
        Ok(with_people(&table, actors.collect::<anyhow::Result<_>>()?).to_string())
    }
}

/// Returns a table with these actors, or without people.
fn with_people(table: &Table, actors: Vec<Value>) -> Table {
    let mut table = table.clone();
    if let Some(Value::Table(people)) = table.get_mut("people") {
        if actors.is_empty() {
            // A desk is the only scenario that needs neither people nor doors.
            people.remove("body");
            let nobody = [("max_people", Value::Integer(0)), ("objects_probability", Value::Float(0.0))];
            people.insert("desk".into(), Value::Table(nobody.map(|(k, v)| (k.to_owned(), v)).into_iter().collect()));
        } else {
            people.insert("actor".into(), Value::Array(actors));
        }
    }
    table
}

/// Renames the meshes of a room for another folder, since a scene may only name files of its own folder. Returns the new name and
/// the path of each mesh.
fn rename_meshes(table: &mut Table, folder: &Path) -> anyhow::Result<Vec<(String, PathBuf)>> {
    let mut found = Vec::new();
    let meshes = table.get_mut("room").and_then(|room| room.get_mut("mesh")).and_then(Value::as_array_mut);
    for (index, mesh) in meshes.into_iter().flatten().enumerate() {
        let Some(Value::String(file)) = mesh.get_mut("file") else { continue };
        let path = folder.join(&*file);
        let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
        if extension == "gltf" && has_external_buffers(&read(&path, MESH_LIMIT_BYTES)?) {
            bail!(
                "{}: its buffers are files beside it, which a mirror would lack\n\nhint: export it as .glb, which is one file",
                path.display()
            );
        }
        *file = format!("mirror-mesh-{index}.{extension}");
        found.push((file.clone(), path));
    }
    Ok(found)
}

/// Returns whether a `.gltf` refers to other files.
fn has_external_buffers(bytes: &[u8]) -> bool {
    let document: serde_json::Value = serde_json::from_slice(bytes).unwrap_or_default();
    let buffers = document.get("buffers").and_then(serde_json::Value::as_array);
    let mut uris = buffers.into_iter().flatten().filter_map(|buffer| buffer.get("uri")?.as_str());
    uris.any(|uri| !uri.starts_with("data:"))
}
