//! Names of layers by which training and adaptation find them. Arrays in files are named after their layers.
//!
//! A dense layer of any other name is initialised as one without an activation behind it, and learns at the learning rate.

/// The descriptors of a map as a vector ([`Layer::Flatten`](super::Layer::Flatten)). Training normalises them by all maps, and
/// minimises the loss over all maps at once behind them.
pub(crate) const DESCRIPTORS: &str = "descriptors";
/// Pooled maps of a network with a latent. Training normalises its output by some maps.
pub(crate) const POOL: &str = "pool";
/// Standardisation that reads [`DESCRIPTORS`] or [`POOL`] and holds their constants while training, which are folded into the
/// dense layer behind it at the end. In a network of descriptors, adaptation fits the layers behind it.
pub(crate) const FEATURES: &str = "features";
/// Dense layer with a ReLU behind it, which its initial weights allow for. Where the ReLU is [`HIDDEN`] and comes before the
/// latent, training rescales them by some maps.
pub(crate) const HIDDEN_DENSE: &str = "fc1";
/// The ReLU behind [`HIDDEN_DENSE`].
pub(crate) const HIDDEN: &str = "hidden";
/// Dense layer whose output is the latent before its standardisation. Training scales it by some maps, and folds the map of the
/// latent that fits the head into it. In a network of descriptors it learns at `head_rate`.
pub(crate) const LATENT_DENSE: &str = "fc2";
/// Standardisation that reads [`LATENT_DENSE`]. The layers behind it are fitted when the warm-up ends.
pub(crate) const LATENT: &str = "latent";
/// Linear head that reads [`LATENT`] and gives the logits of the warm-up. It exists only in training: it is in no model file, and
/// the number of parameters excludes it.
pub(crate) const WARM_UP: &str = "warm_up";
/// Quantum circuit. Its angles learn at `angle_rate`; the fit at the end of the warm-up starts them anywhere on the circle.
pub(crate) const CIRCUIT: &str = "circuit";
/// Dense layer that gives the logits; it learns at `head_rate`.
pub(crate) const HEAD: &str = "head";
/// Dense layer before [`HEAD`]; it learns at `head_rate`.
pub(crate) const HEAD_HIDDEN: &str = "head_hidden";

/// Name of the layer that an array belongs to.
pub(crate) fn layer_of(array: &str) -> &str {
    array.rsplit_once('.').map_or(array, |(layer, _)| layer)
}
