use std::path::PathBuf;

use radome_models::onnx;
use serde_json::json;

use crate::exit::wrong_use;
use crate::output_file::Overwrite;
use crate::{classifier, files, output};

/// Text below the options in the help.
const NOTES: &str = "\
The input `map` is float32 [batch, 1, range, doppler], standardised; the output `logits` is [batch, 3]: empty, one, two. The \
metadata describe the kind of map and its standardisation, as JSON under the key `radome`. You can therefore use the file in \
place of the model: --model FILE.onnx. This requires onnxruntime:\n\n  \
pip install --no-deps --target .ort onnxruntime==1.31.1 && export ORT_DYLIB_PATH=$PWD/.ort\n\n\
ORT_DYLIB_PATH names the library; without it, the library of python3's onnxruntime is used.\n\n\
In other programs, the probabilities of a frame are softmax(logits / temperature), with `temperature` from that JSON. If it has \
`memory_s`, average logits / temperature over the frames so far before the softmax, with the weights exp(-age / memory_s).\n\n\
Networks whose names begin with descriptor_, and circuits with gate errors, with shots or of more than 8 qubits have no ONNX \
form: use their model files.";

/// `radome model export`
#[derive(clap::Args)]
#[command(after_help = NOTES)]
pub struct Arguments {
    /// Model file (.safetensors)
    model: PathBuf,
    /// ONNX file to write
    #[arg(short, long, value_name = "FILE.onnx")]
    output: PathBuf,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// Writes a model as ONNX (opset 17). Every ONNX runtime can read it, and so can `live`, `evaluate` and all other
/// commands that take a model.
///
/// # Errors
/// The model cannot be read or has no ONNX form, or the file cannot be written.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    arguments.overwrite.check(&arguments.output, &[&arguments.model])?;
    // Other commands recognise an ONNX file by its name.
    if arguments.output.extension().is_none_or(|ending| !ending.eq_ignore_ascii_case("onnx")) {
        wrong_use!("{}: no name of an ONNX file\n\nhint: end its name in .onnx", arguments.output.display());
    }
    let model = classifier::network(&arguments.model)?;
    let bytes = onnx::export(&model)?;
    files::write_bytes(&arguments.output, arguments.overwrite.existing(), &bytes)?;
    let file = arguments.output.display().to_string();
    if arguments.json {
        let input = model.card.map_shape();
        return output::json_line(&json!({ "onnx": file, "bytes": bytes.len(), "input": input }));
    }
    output::text_line(&format!("{file} written"))
}
