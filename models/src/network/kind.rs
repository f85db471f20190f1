//! Kinds of networks, and the maps that each can read.

use radome_dsp::rdm::Motion;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::layer::{DESCRIPTORS, descriptors};
use crate::standardise::MapReference;

/// Kind of a network.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum NetworkKind {
    /// The paper's backbone of two convolutions and a narrow latent, with a head.
    #[default]
    Hqnn,
    /// Five convolution blocks, three dense layers.
    DopplerNet,
    /// ResNet-18.
    #[serde(rename = "resnet18")]
    ResNet18,
    /// EfficientNet-B0 with a stem for one channel.
    #[serde(rename = "efficientnet_b0")]
    EfficientNetB0,
    /// EfficientNet-B0 with torchvision's stem, of which each of the three channels sees the map.
    #[serde(rename = "efficientnet_b0_rgb")]
    EfficientNetB0Rgb,
    /// Descriptors of a map and a linear head.
    DescriptorLinear,
    /// Descriptors of a map, a narrow latent and a head.
    DescriptorHqnn,
}

impl std::fmt::Display for NetworkKind {
    /// Writes the name that users type and that files hold.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.serialize(f)
    }
}

/// Error: a network of descriptors cannot read such maps.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error(
    "{network} describes maps in dB over their own noise, range by velocity, but {found}\n\nhint: give the training \
     reference = {{ over_noise = {{ skip_range_bins = 3 }} }}, and neither transposed nor label_leaking_cells"
)]
pub struct UnreadableMaps {
    /// The network.
    pub network: NetworkKind,
    /// Property of the maps that does not fit.
    pub found: &'static str,
}

impl NetworkKind {
    /// All kinds, in the order of lists.
    pub const ALL: [NetworkKind; 7] = [
        NetworkKind::Hqnn,
        NetworkKind::DopplerNet,
        NetworkKind::ResNet18,
        NetworkKind::EfficientNetB0,
        NetworkKind::EfficientNetB0Rgb,
        NetworkKind::DescriptorLinear,
        NetworkKind::DescriptorHqnn,
    ];

    /// Returns whether the network describes maps by [`crate::layer::descriptors`]: it reads dB over noise that are not
    /// standardised. The names of such networks begin with `descriptor_`.
    pub fn reads_descriptors(self) -> bool {
        match self {
            NetworkKind::DescriptorLinear | NetworkKind::DescriptorHqnn => true,
            NetworkKind::Hqnn
            | NetworkKind::DopplerNet
            | NetworkKind::ResNet18
            | NetworkKind::EfficientNetB0
            | NetworkKind::EfficientNetB0Rgb => false,
        }
    }

    /// Input of the network for standardised cells `[range][doppler]` and motion of a map: the cells, or the descriptors.
    pub(crate) fn input(self, cells: Vec<f32>, motion: Option<Motion>, doppler: usize) -> Vec<f32> {
        if self.reads_descriptors() {
            descriptors(&cells, motion.unwrap_or_default(), doppler, 1.0, 1.0).to_vec()
        } else {
            cells
        }
    }

    /// Rows and columns of the network's input for maps with these: those of the map, or one row of descriptors.
    pub(crate) fn input_size(self, map: [usize; 2]) -> [usize; 2] {
        if self.reads_descriptors() { [1, DESCRIPTORS] } else { map }
    }

    /// Returns whether the network has a narrow latent and a [`Head`](super::Head).
    pub fn has_latent(self) -> bool {
        match self {
            NetworkKind::Hqnn | NetworkKind::DescriptorHqnn => true,
            NetworkKind::DopplerNet
            | NetworkKind::ResNet18
            | NetworkKind::EfficientNetB0
            | NetworkKind::EfficientNetB0Rgb
            | NetworkKind::DescriptorLinear => false,
        }
    }

    /// Checks that the network can read maps of this reference and orientation.
    ///
    /// # Errors
    /// The network describes maps, and they are not in dB over noise, or transposed, or standardised by scene and class.
    pub fn check_maps(
        self,
        reference: MapReference,
        transposed: bool,
        label_leaking: bool,
    ) -> Result<(), UnreadableMaps> {
        let found = match reference {
            _ if !self.reads_descriptors() => return Ok(()),
            MapReference::Absolute => "their reference is absolute",
            _ if transposed => "they are transposed",
            _ if label_leaking => "they are standardised by scene and class",
            _ => return Ok(()),
        };
        Err(UnreadableMaps { network: self, found })
    }
}
