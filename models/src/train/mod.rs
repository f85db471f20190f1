//! Training of models from datasets, bit for bit reproducible.
//!
//! # Recipe
//! The `pi * sigmoid` before the circuit makes training fragile. From a random start, the first steps shift the common mean of the
//! latent more easily than they separate classes. The mean reaches the flat end of the sigmoid, where gradients vanish, and the
//! loss stays at ln 3. The recipe prevents this:
//! 1. *Normalised features.* The normalisation is measured at the start and folded into the weights at the end
//!    ([`crate::network::Network::fold_features`]).
//! 2. *Linear warm-up.* For the first `linear_epochs`, a linear head reads the latent directly, without `pi * sigmoid` and circuit.
//!    This head trains reliably.
//! 3. *Fitted circuit.* Then angles, head and an affine map of the latent (folded into the last dense layer) are fitted to the
//!    latents from 24 random starts, and the training continues from the best fit: 19 numbers on 256 points, well under a second.
//! 4. *Penalty* on the mean square of the latent, which keeps it off the flat ends of the sigmoid.
//! 5. *Several starts* ([`TrainSpec::starts`]). The training continues with the one of least validation loss after
//!    [`TrainSpec::start_epochs`]. Angles and head have their own step sizes; the step size warms up and then falls by a cosine to
//!    a twentieth.
//! 6. *Best epoch* by balanced accuracy on the validation split, by loss among equals.
//! 7. *All maps at once.* The training of a network of descriptors may end with a minimisation of the loss over all
//!    training maps ([`FullBatch`]), which hardly depends on the seed.
//! 8. *Calibration.* One temperature, fitted on the validation split (Guo et al., ICML 2017).
//!
//! Networks without a narrow latent are trained by the same steps without 1 to 4; those of descriptors keep step 1. They have as
//! many starts as the settings say, except in a study ([`crate::study`]), which gives them one.
//!
//! `docs/studies` has results over seeds and comparisons of heads under equal treatment.

mod adam;
mod adapt;
mod augmentation;
mod checkpoint;
mod data;
mod error;
mod full_batch;
mod head_start;
mod maps;
mod memory;
mod minimise;
mod outcome;
mod parameter_vector;
mod recipe;
mod run;
mod smoothing;
mod spec;
mod start;
mod temperature;
mod trainer;

pub use crate::model::{Adapted, BeforeAfter, Scores};
pub use adapt::{AdaptError, AdaptFrame, AdaptRecording, Adaptation, Adapter, Fit};
pub use augmentation::{Augmentation, Superpose, Sway};
pub use checkpoint::CheckpointLock;
pub(crate) use data::Indices;
pub use data::training_warnings;
pub use error::TrainError;
pub(crate) use maps::Maps;
pub(crate) use memory::check_memory;
pub(crate) use outcome::StepTimes;
pub use outcome::{EpochReport, TrainOutcome};
pub(crate) use recipe::{time_steps, train_on};
pub use recipe::{train, train_with_checkpoint};
pub use smoothing::{FilterSequence, SmoothingFit, fit_smoothing};
pub use spec::{FullBatch, LatentStandardisation, TrainSpec};
pub use trainer::Trainer;
