//! ONNX networks run by onnxruntime. Its library is found and loaded when the first ONNX file is opened; nothing else needs it.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Arc, Mutex, PoisonError};

use ort::environment::Environment;
use ort::logging::LogLevel;
use ort::session::Session;
use ort::value::{TensorElementType, TensorRef, ValueType};
use thiserror::Error;

/// Name of the input of an ONNX network.
pub const INPUT_NAME: &str = "map";
/// Name of the output of an ONNX network.
pub const OUTPUT_NAME: &str = "logits";
/// Environment variable with the path of the library, or of a folder that holds it or an installation of it.
const LIBRARY_VARIABLE: &str = "ORT_DYLIB_PATH";
const INSTALL_HINT: &str =
    "hint: pip install --no-deps --target .ort onnxruntime==1.31.1 && export ORT_DYLIB_PATH=$PWD/.ort";
/// Logits of a network, one for each class.
const CLASSES: i64 = 3;

/// Error of running an ONNX network.
#[derive(Debug, Error)]
#[allow(missing_docs, reason = "the message says what each field is")]
pub enum OnnxError {
    /// The library was not found.
    #[error("ONNX files are run by onnxruntime, which is not installed: {searched}\n\n{INSTALL_HINT}")]
    NoLibrary { searched: String },
    /// The library cannot be loaded or is too old.
    #[error("onnxruntime cannot be loaded: {reason}\n\n{INSTALL_HINT}")]
    Library { reason: String },
    /// The runtime refuses the file.
    #[error("{path}: onnxruntime cannot load it: {reason}")]
    Refused { path: PathBuf, reason: String },
    /// The file has other inputs or outputs than a network of this crate.
    #[error("{path}: {what} is {found}, expected {expected}\n\nhint: `radome model export` writes such files")]
    Signature { path: PathBuf, what: &'static str, expected: String, found: String },
    /// A run failed.
    #[error("onnxruntime: {reason}")]
    Run { reason: String },
}

/// A network that onnxruntime runs.
pub struct OnnxSession {
    session: Session,
    /// Rows and columns of a map.
    size: [usize; 2],
}

impl OnnxSession {
    /// Opens the bytes of the file `path` (used in errors only) for maps of `rows` x `columns`.
    ///
    /// # Errors
    /// [`OnnxError::NoLibrary`] or [`OnnxError::Library`] if onnxruntime cannot be loaded, [`OnnxError::Refused`] if it refuses the
    /// file, and [`OnnxError::Signature`] if input or output are others than those of a network here.
    pub fn new(path: &Path, data: &[u8], rows: usize, columns: usize) -> Result<Self, OnnxError> {
        let refused = |reason: String| OnnxError::Refused { path: path.to_owned(), reason };
        let threads = rayon::current_num_threads();
        let session = Session::builder(&environment()?)
            .and_then(|builder| Ok(builder.with_intra_threads(threads)?))
            .and_then(|mut builder| builder.commit_from_memory(data))
            .map_err(|error| refused(error.to_string()))?;
        let signature = |what, expected: String, found: String| {
            Err(OnnxError::Signature { path: path.to_owned(), what, expected, found })
        };
        match session.inputs() {
            [input]
                if input.name() == INPUT_NAME && matches_shape(input.dtype(), &[1, rows as i64, columns as i64]) => {}
            inputs => {
                let found: Vec<String> = inputs.iter().map(|i| format!("{} {}", i.name(), i.dtype())).collect();
                let expected = format!("{INPUT_NAME}, float32 [batch, 1, {rows}, {columns}]");
                return signature("input", expected, found.join(", "));
            }
        }
        match session.outputs() {
            [output] if output.name() == OUTPUT_NAME && matches_shape(output.dtype(), &[CLASSES]) => {}
            outputs => {
                let found: Vec<String> = outputs.iter().map(|o| format!("{} {}", o.name(), o.dtype())).collect();
                return signature("output", format!("{OUTPUT_NAME}, float32 [batch, {CLASSES}]"), found.join(", "));
            }
        }
        Ok(OnnxSession { session, size: [rows, columns] })
    }

    /// Logits `[batch][3]` of standardised maps `[batch][row][column]`.
    ///
    /// # Errors
    /// [`OnnxError::Run`] if the number of cells is not that of whole maps, or onnxruntime fails.
    pub fn logits(&mut self, maps: &[f32]) -> Result<Vec<f32>, OnnxError> {
        let failed = |error: ort::Error| OnnxError::Run { reason: error.to_string() };
        let [rows, columns] = self.size;
        let batch = maps.len() / (rows * columns).max(1);
        let input = TensorRef::from_array_view(([batch, 1, rows, columns], maps)).map_err(failed)?;
        let outputs = self.session.run(ort::inputs![INPUT_NAME => input]).map_err(failed)?;
        let Some(logits) = outputs.get(OUTPUT_NAME) else {
            return Err(OnnxError::Run { reason: format!("there is no output {OUTPUT_NAME}") });
        };
        let (_, logits) = logits.try_extract_tensor::<f32>().map_err(failed)?;
        Ok(logits.to_vec())
    }
}

/// Returns whether a value is a batch of float32 arrays of this shape. A dynamic size matches any size.
fn matches_shape(value: &ValueType, shape: &[i64]) -> bool {
    let ValueType::Tensor { ty: TensorElementType::Float32, shape: found, .. } = value else { return false };
    found.len() == shape.len() + 1
        && found.iter().skip(1).zip(shape).all(|(&found, &size)| found == -1 || found == size)
}

/// onnxruntime's environment. It is stored, because a process can have only one.
fn environment() -> Result<Environment, OnnxError> {
    static ENVIRONMENT: Mutex<Option<Environment>> = Mutex::new(None);
    let mut environment = ENVIRONMENT.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(environment) = &*environment {
        return Ok(environment.clone());
    }
    let library = |reason: String| OnnxError::Library { reason };
    let path = find_library()?;
    // The loader takes relative paths from the program's folder first.
    let path = path.canonicalize().map_err(|error| library(format!("{}: {error}", path.display())))?;
    let found = ort::init_from(path)
        .map_err(|error| library(error.to_string()))?
        .with_telemetry(false)
        .with_logger(Arc::new(|level, category, _, _, message| match level {
            LogLevel::Error | LogLevel::Fatal => tracing::warn!("onnxruntime {category}: {message}"),
            _ => tracing::debug!("onnxruntime {category}: {message}"),
        }))
        .build()
        .map_err(|error| library(error.to_string()))?;
    found.set_log_level(LogLevel::Warning);
    Ok(environment.insert(found).clone())
}

/// Finds the library by the environment variable or in a Python installation's onnxruntime. The working directory is not searched,
/// because others may have put files there.
fn find_library() -> Result<PathBuf, OnnxError> {
    if let Some(value) = std::env::var_os(LIBRARY_VARIABLE).filter(|value| !value.is_empty()) {
        let path = PathBuf::from(&value);
        let no_library =
            || OnnxError::NoLibrary { searched: format!("{LIBRARY_VARIABLE} is {}, which holds none", path.display()) };
        return if path.is_file() { Ok(path) } else { installed_in(&path).ok_or_else(no_library) };
    }
    let python = if cfg!(windows) { "python" } else { "python3" };
    // Finds the package without importing it, which takes a second.
    let script = "import importlib.util as u; s = u.find_spec('onnxruntime'); print(s.submodule_search_locations[0] if s else '')";
    // Isolated mode (-I) keeps Python from searching its working directory and PYTHONPATH. It runs in a directory that only the
    // administrator can write, so that a relative entry of PATH cannot name another python.
    let output =
        Command::new(python).args(["-I", "-c", script]).current_dir(if cfg!(windows) { "C:\\" } else { "/" }).output();
    let package =
        output.ok().map(|output| String::from_utf8_lossy(&output.stdout).trim().to_owned()).unwrap_or_default();
    let folder = Some(Path::new(&package)).filter(|folder| folder.is_absolute());
    if let Some(library) = folder.and_then(installed_in) {
        return Ok(library);
    }
    let searched = format!("{LIBRARY_VARIABLE} is not set, and `{python} -I` finds no onnxruntime");
    Err(OnnxError::NoLibrary { searched })
}

/// The library in a folder, or in the Python package that is installed there. Its name carries a version.
fn installed_in(folder: &Path) -> Option<PathBuf> {
    let is_library = |name: &OsStr| {
        let name = name.to_string_lossy();
        (name.starts_with("libonnxruntime.so") || name.starts_with("libonnxruntime.") && name.ends_with(".dylib"))
            || name == "onnxruntime.dll"
    };
    let folders = [folder.to_owned(), folder.join("capi"), folder.join("onnxruntime/capi")];
    let files = folders.iter().filter_map(|folder| std::fs::read_dir(folder).ok()).flatten().filter_map(Result::ok);
    files.filter(|file| is_library(&file.file_name())).map(|file| file.path()).max()
}
