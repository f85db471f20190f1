//! Trained models: card, file, classification of maps, and ONNX.

mod adapted;
mod card;
mod classifier;
mod file;
pub mod onnx;
pub mod onnx_runtime;

pub use adapted::{Adapted, BeforeAfter, Scores};
pub use card::{MODEL_FORMAT_VERSION, ModelCard, ModelError, TrainingSummary};
pub(crate) use card::{input_axes, input_shape};
pub use classifier::{Classifier, ClassifyError};
pub use file::{BUILT_IN, Model, is_built_in, read};
