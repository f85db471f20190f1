use std::io::Write;
use std::path::PathBuf;

use radome_models::{Model, onnx};
use serde_json::json;

use crate::{files, output};

/// `radome export`
#[derive(clap::Args)]
pub struct Arguments {
    /// Model file
    model: PathBuf,
    /// ONNX file to write
    #[arg(short, long)]
    output: PathBuf,
    /// One object
    #[arg(long)]
    json: bool,
}

/// Writes a model as ONNX, which `live`, `evaluate` and every runtime of ONNX can read.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    files::check_parent(&arguments.output)?;
    let model = Model::load(&arguments.model)?;
    let bytes = onnx::export(&model)?;
    files::write_atomically(&arguments.output, |file| Ok(file.write_all(&bytes)?))?;
    let file = arguments.output.display().to_string();
    if arguments.json {
        let input = model.card.input_shape;
        return output::json_line(&json!({ "onnx": file, "bytes": bytes.len(), "input": input }));
    }
    output::text_line(&format!("{file} written"))
}
