//! `radome schema`: JSON schemas of hand-written TOML files, with which editors complete and check keys.

use radome_dsp::WaveformRequest;
use radome_models::TrainSpec;
use radome_sim::Receiver;
use radome_sim::scene_file::SceneFile;
use schemars::generate::SchemaSettings;
use schemars::transform::RecursiveTransform;
use schemars::{JsonSchema, Schema};
use serde_json::{Value, json};

use super::model::StudyFile;
use crate::dataset::spec::BuildSpec;
use crate::output;

/// `radome schema`
#[derive(clap::Args)]
pub struct Arguments {
    /// Kind of file
    kind: Kind,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum Kind {
    /// Scene
    Scene,
    /// Receiver of a scene
    Receiver,
    /// Dataset to build
    Dataset,
    /// Settings of a training
    Training,
    /// Study
    Study,
    /// Waveform of a board
    Waveform,
}

/// Prints the schema of a kind of file.
///
/// # Errors
/// Standard output cannot be written.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let schema = match arguments.kind {
        Kind::Scene => schema::<SceneFile>(),
        Kind::Receiver => schema::<Receiver>(),
        Kind::Dataset => schema::<BuildSpec>(),
        Kind::Training => schema::<TrainSpec>(),
        Kind::Study => schema::<StudyFile>(),
        Kind::Waveform => schema::<WaveformRequest>(),
    };
    output::text_line(&serde_json::to_string_pretty(&schema)?)
}

fn schema<T: JsonSchema>() -> Schema {
    // Taplo supports drafts up to 7.
    let settings = SchemaSettings::draft07().with_transform(RecursiveTransform(adapt_to_toml));
    settings.into_generator().into_root_schema_for::<T>()
}

/// Removes null, which TOML lacks, and defaults that are tables: the keys of a table have their own defaults.
fn adapt_to_toml(schema: &mut Schema) {
    if let Some(Value::Array(types)) = schema.get_mut("type") {
        types.retain(|name| name != "null");
        if let [only] = types.as_slice() {
            let only = only.clone();
            schema.insert("type".to_owned(), only);
        }
    }
    for (keyword, null) in [("enum", Value::Null), ("anyOf", json!({ "type": "null" }))] {
        if let Some(Value::Array(choices)) = schema.get_mut(keyword) {
            choices.retain(|choice| *choice != null);
        }
    }
    let Some(default) = schema.get("default") else { return };
    let has_tables = default.as_array().is_some_and(|values| values.iter().any(Value::is_object));
    if default.is_null() || default.is_object() || has_tables {
        schema.remove("default");
    } else if let Some(short) = shortest_of_f32(default) {
        schema.insert("default".to_owned(), short);
    }
}

/// Shortest number that parses to the same f32: 0.3 instead of 0.30000001192092896. `None` for other values.
fn shortest_of_f32(value: &Value) -> Option<Value> {
    let number = value.as_f64().filter(|number| value.is_f64() && f64::from(*number as f32) == *number)?;
    (number as f32).to_string().parse::<f64>().ok().map(Value::from)
}
