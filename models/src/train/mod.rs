//! Training: from a dataset to a model, reliably and reproducibly.
//!
//! # The recipe, and why
//! The squash before the circuit makes training fragile. From a cold start it is easier for the first steps to shift the
//! common mean of the latent than to draw classes apart; the mean runs onto the flat end of `pi * sigmoid`, no gradient
//! is left, and the loss stays at ln 3. What is done about it:
//! 1. *Centred features.* See [`crate::network::Network::fold_features`]: measured at the start, folded into the weights at the
//!    end.
//! 2. *A linear warm-up.* For the first `linear_epochs` the head sees the latent itself, without squash and
//!    circuit. This control head trains reliably.
//! 3. *A fitted circuit.* Then angles, head and an affine map of the latent (folded into the last dense layer) are
//!    fitted to the latents as they are, from 24 random starts, and the best fit is carried on with: 19 numbers on 256
//!    points, well under a second.
//! 4. *A penalty* on the mean square of the latent keeps it off the ends of the squash.
//! 5. *Several starts* ([`TrainSpec::starts`]); the one with the least validation loss after
//!    [`TrainSpec::start_epochs`] is carried on with. Own step sizes for angles and head; warm-up, then a cosine to a
//!    twentieth.
//! 6. *The best epoch* by balanced accuracy on the validation split, by loss among equals.
//! 7. *Calibration.* One temperature, fitted on the validation split (Guo et al., ICML 2017).
//!
//! What it reaches over seeds, and how it compares with other heads under the same treatment: `docs/studies`. Networks without a
//! narrow latent are trained by the same steps but for 1 to 4, from one start.

mod adam;
mod adapt;
mod augmentation;
mod checkpoint;
mod data;
mod error;
mod head_start;
mod outcome;
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
pub use error::TrainError;
pub use outcome::{EpochReport, TrainOutcome};
pub use recipe::{train, train_with_checkpoint};
pub use smoothing::{FilterSequence, SmoothingFit, fit_smoothing};
pub use spec::{LatentStandardisation, TrainSpec};
pub use trainer::Trainer;
