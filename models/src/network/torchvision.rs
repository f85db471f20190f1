//! Initial weights from torchvision: ResNet-18 and EfficientNet-B0 have its names and its layout.
//!
//! Three differences are converted:
//! - The first convolution is summed over its three channels if this network has one, as if each of the three saw the
//!   map.
//! - The 1x1 convolutions of squeeze-and-excitation become dense layers.
//! - A head for other classes stays as it was initialised.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use radome_files::{MODEL_LIMIT_BYTES, read};
use safetensors::tensor::{Dtype, SafeTensors};
use sha2::{Digest, Sha256};
use thiserror::Error;

use super::instance::Network;
use super::kind::NetworkKind;
use super::spec::NetworkSpec;

/// Hint on the conversion of a `.pth` file of torchvision.
const CONVERT_HINT: &str = "hint: convert a .pth in Python, with torch and safetensors installed:\n\
    import torch, safetensors.torch\n\
    safetensors.torch.save_file(torch.load(\"resnet18.pth\"), \"resnet18.safetensors\")";
/// Largest number of names in an error or a report.
const MOST_NAMES: usize = 6;

/// Error: a network cannot start from these weights.
#[derive(Debug, Error)]
#[allow(missing_docs, reason = "the message says what each field is")]
pub enum WeightsError {
    /// The file cannot be read.
    #[error("{path}: reading failed: {source}")]
    Io { path: PathBuf, source: std::io::Error },
    /// The file is not a complete safetensors file.
    #[error("{path}: expected weights as safetensors, but {reason}\n\n{CONVERT_HINT}")]
    NotSafetensors { path: PathBuf, reason: String },
    /// torchvision has no such network.
    #[error(
        "torchvision has no {network}\n\nhint: weights exist for resnet18, efficientnet_b0 and efficientnet_b0_rgb"
    )]
    NoCounterpart { network: NetworkKind },
    /// Arrays that the network needs are not in the file.
    #[error(
        "{path}: the weights are not those of torchvision's {network}: {missing} missing; {unknown} unknown\n\n{CONVERT_HINT}"
    )]
    Missing { path: PathBuf, network: NetworkKind, missing: String, unknown: String },
    /// An array is of another kind than the network's.
    #[error("{path}: {name} is {found}, expected {expected}")]
    Shape { path: PathBuf, name: String, expected: String, found: String },
}

/// Weights that fit a network, and the arrays without a counterpart.
#[derive(Debug, Clone, PartialEq)]
pub struct TorchvisionWeights {
    values: BTreeMap<String, Vec<f32>>,
    hash: String,
    /// Arrays of the network that stay as they are initialised: its head, where the file's is for other classes.
    pub initialised: Vec<String>,
    /// Arrays of the file that are not used, without counts of batches.
    pub unused: Vec<String>,
}

impl TorchvisionWeights {
    /// Reads weights for a network.
    ///
    /// # Errors
    /// [`WeightsError::Io`] if the file cannot be read or is too long, and those of [`TorchvisionWeights::from_bytes`].
    pub fn load(path: &Path, spec: &NetworkSpec) -> Result<Self, WeightsError> {
        let data =
            read(path, MODEL_LIMIT_BYTES).map_err(|source| WeightsError::Io { path: path.to_owned(), source })?;
        Self::from_bytes(path, &data, spec)
    }

    /// Weights in the bytes of the file `path` (used in errors only).
    ///
    /// # Errors
    /// [`WeightsError`] if torchvision has no such network, the bytes are no safetensors, or arrays are missing, of another shape
    /// or not finite.
    pub fn from_bytes(path: &Path, data: &[u8], spec: &NetworkSpec) -> Result<Self, WeightsError> {
        let (stem, head) = match spec.kind {
            NetworkKind::ResNet18 => ("conv1.weight", "fc."),
            NetworkKind::EfficientNetB0 | NetworkKind::EfficientNetB0Rgb => ("features.0.0.weight", "classifier.1."),
            network => return Err(WeightsError::NoCounterpart { network }),
        };
        let tensors = SafeTensors::deserialize(data)
            .map_err(|error| WeightsError::NotSafetensors { path: path.to_owned(), reason: error.to_string() })?;
        let layout = spec.layout();
        let (mut values, mut missing, mut initialised) = (BTreeMap::new(), Vec::new(), Vec::new());
        for (name, shape) in &layout {
            let wrong = |expected: String, found: String| WeightsError::Shape {
                path: path.to_owned(),
                name: name.clone(),
                expected,
                found,
            };
            let Ok(array) = tensors.tensor(name) else {
                let absent = if name.starts_with(head) { &mut initialised } else { &mut missing };
                absent.push(name.clone());
                continue;
            };
            if array.dtype() != Dtype::F32 {
                return Err(wrong("F32".to_owned(), format!("{:?}", array.dtype())));
            }
            let numbers: Vec<f32> = array.data().as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
            if numbers.iter().any(|v| !v.is_finite()) {
                return Err(wrong("finite numbers".to_owned(), "partly NaN or infinite".to_owned()));
            }
            let numbers = match (shape.as_slice(), array.shape()) {
                (ours, theirs) if ours == theirs => numbers,
                (&[o, i], &[to, ti, 1, 1]) if (o, i) == (to, ti) => numbers,
                (&[o, 1, rows, columns], &[to, channels, r, c]) if name == stem && (o, rows, columns) == (to, r, c) => {
                    sum_channels(&numbers, channels, rows * columns)
                }
                (ours, theirs) if name.starts_with(head) && ours[1..] == *theirs.get(1..).unwrap_or_default() => {
                    initialised.push(name.clone());
                    continue;
                }
                (ours, theirs) => return Err(wrong(format!("{ours:?}"), format!("{theirs:?}"))),
            };
            values.insert(name.clone(), numbers);
        }
        let known = |name: &str| layout.iter().any(|(ours, _)| ours == name) || name.ends_with(".num_batches_tracked");
        let mut unused: Vec<String> =
            tensors.names().into_iter().filter(|name| !known(name)).map(str::to_owned).collect();
        unused.sort_unstable();
        if !missing.is_empty() {
            let (missing, unknown) = (list(&missing), list(&unused));
            return Err(WeightsError::Missing { path: path.to_owned(), network: spec.kind, missing, unknown });
        }
        let hash = format!("{:x}", Sha256::digest(data));
        Ok(TorchvisionWeights { values, hash, initialised, unused })
    }

    /// SHA-256 of the file.
    pub fn hash(&self) -> &str {
        &self.hash
    }

    /// Warnings for the user about differences between file and network.
    pub fn warnings(&self) -> Vec<String> {
        let warning =
            |names: &[String], what: &str| (!names.is_empty()).then(|| format!("weights: {} {what}", list(names)));
        let initialised =
            warning(&self.initialised, "of the network stay as initialised: the file has none for these classes");
        let unused = warning(&self.unused, "of the file are not used: the network has no such arrays");
        [initialised, unused].into_iter().flatten().collect()
    }

    /// Overwrites a network's numbers.
    ///
    /// # Errors
    /// The network is another one than the weights were read for.
    pub fn apply(&self, network: &Network) -> candle_core::Result<()> {
        let mut values = network.parameters().values(true)?;
        values.extend(self.values.iter().map(|(name, numbers)| (name.clone(), numbers.clone())));
        network.parameters().set_values(&values)
    }
}

/// `[output][channel][cell]` to `[output][cell]`.
fn sum_channels(weight: &[f32], channels: usize, cells: usize) -> Vec<f32> {
    let outputs = weight.chunks_exact((channels * cells).max(1));
    outputs.flat_map(|o| (0..cells).map(move |cell| o.iter().skip(cell).step_by(cells.max(1)).sum())).collect()
}

/// The first few names and how many more there are; `0 arrays` where there are none.
fn list(names: &[String]) -> String {
    let first = names.iter().take(MOST_NAMES).map(String::as_str).collect::<Vec<_>>().join(", ");
    match names.len() {
        0 => "0 arrays".to_owned(),
        count if count > MOST_NAMES => format!("{count} arrays ({first}, ...)"),
        count => format!("{count} arrays ({first})"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::layer::KernelLevel;
    use safetensors::tensor::TensorView;

    type Arrays = Vec<(String, Vec<usize>, Vec<f32>)>;

    /// Arrays of a file of torchvision: this network's names in its layout, with three channels and this many classes.
    fn file_of(spec: &NetworkSpec, classes: usize) -> Arrays {
        let mut arrays = Arrays::new();
        for (k, (name, mut shape)) in spec.layout().into_iter().enumerate() {
            if name == "conv1.weight" || name == "features.0.0.weight" {
                shape[1] = 3;
            } else if name.contains(".fc1.weight") || name.contains(".fc2.weight") {
                shape.extend([1, 1]);
            } else if name.starts_with("fc.") || name.starts_with("classifier.1.") {
                shape[0] = classes;
            }
            if let Some(norm) = name.strip_suffix("running_var") {
                arrays.push((format!("{norm}num_batches_tracked"), Vec::new(), vec![1.0]));
            }
            let count = shape.iter().product::<usize>();
            arrays.push((name, shape, (0..count).map(|i| 0.01 + ((i * 7 + k) % 13) as f32 / 13.0).collect()));
        }
        arrays
    }

    fn bytes_of(arrays: &Arrays) -> Vec<u8> {
        let data: Vec<Vec<u8>> =
            arrays.iter().map(|(.., v)| v.iter().flat_map(|v| v.to_le_bytes()).collect()).collect();
        let views = arrays.iter().zip(&data).map(|((name, shape, _), data)| {
            (name.as_str(), TensorView::new(Dtype::F32, shape.clone(), data).expect("view"))
        });
        safetensors::serialize(views, None).expect("serialised")
    }

    fn read(arrays: &Arrays, spec: &NetworkSpec) -> Result<TorchvisionWeights, WeightsError> {
        TorchvisionWeights::from_bytes(Path::new("weights.safetensors"), &bytes_of(arrays), spec)
    }

    fn named(name: &str) -> NetworkSpec {
        NetworkSpec::named(name).expect("known")
    }

    #[test]
    fn every_array_is_assigned() {
        for (name, stem, head) in [
            ("resnet18", "conv1.weight", "fc"),
            ("efficientnet_b0", "features.0.0.weight", "classifier.1"),
            ("efficientnet_b0_rgb", "features.0.0.weight", "classifier.1"),
        ] {
            let spec = named(name);
            let arrays = file_of(&spec, 1000);
            let weights = read(&arrays, &spec).expect(name);
            assert_eq!(weights.initialised, [format!("{head}.weight"), format!("{head}.bias")], "{name}");
            assert!(weights.unused.is_empty(), "{name}: {:?}", weights.unused);
            assert_eq!(weights.values.len(), spec.layout().len() - 2, "{name}");
            assert!(weights.warnings().concat().contains(&format!("{head}.weight")));
            let network = Network::initialise(&spec, 3, 0, KernelLevel::detect()).expect("network");
            let before = network.values().expect("values");
            weights.apply(&network).expect("applied");
            let after = network.values().expect("values");
            for (array, _, numbers) in &arrays {
                let Some(after) = after.get(array) else { continue };
                if array.starts_with(head) {
                    assert_eq!(Some(after), before.get(array), "{name}: {array}");
                } else if array == stem && name != "efficientnet_b0_rgb" {
                    let cells = if name == "resnet18" { 49 } else { 9 };
                    let expected = numbers[cells] + numbers[0] + numbers[2 * cells];
                    assert!((after[0] - expected).abs() < 1e-6, "{name}: {} {expected}", after[0]);
                    assert_eq!(3 * after.len(), numbers.len());
                } else {
                    assert_eq!(after, numbers, "{name}: {array}");
                }
            }
        }
    }

    #[test]
    fn a_head_for_the_same_classes_is_read() {
        let spec = named("resnet18");
        let weights = read(&file_of(&spec, 3), &spec).expect("read");
        assert!(weights.initialised.is_empty() && weights.warnings().is_empty());
    }

    /// A stem for one channel with summed weights agrees with a stem for three copies of the map.
    #[test]
    fn a_summed_stem_agrees_with_three_channels() {
        let (one, three) = (named("efficientnet_b0"), named("efficientnet_b0_rgb"));
        let start = Network::initialise(&three, 3, 0, KernelLevel::detect()).expect("network");
        let values = start.values().expect("values");
        let arrays: Arrays =
            three.layout().into_iter().map(|(name, shape)| (name.clone(), shape, values[&name].clone())).collect();
        let map: Vec<f32> = (0..32 * 32).map(|k| ((k * 31) % 17) as f32 / 8.0 - 1.0).collect();
        let mut logits = [&one, &three].map(|spec| {
            let network = Network::initialise(spec, 9, 0, KernelLevel::detect()).expect("network");
            read(&arrays, spec).expect("read").apply(&network).expect("applied");
            let mut inference = crate::network::Inference::new(&network).expect("prepared");
            inference.logits(&map, [1, 32, 32]).expect("run").to_vec()
        });
        let [ours, theirs] = &mut logits;
        for (a, b) in ours.iter().zip(theirs) {
            assert!((a - *b).abs() < 1e-5 * b.abs().max(1.0), "{a} {b}");
        }
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn errors_list_missing_and_unknown_arrays() {
            let spec = named("resnet18");
            let mut arrays = file_of(&spec, 1000);
            arrays.push(("projector.weight".to_owned(), vec![2], vec![0.0; 2]));
            assert_eq!(read(&arrays, &spec).expect("read").unused, ["projector.weight"]);
            arrays.retain(|(name, ..)| name != "layer3.1.bn2.running_var");
            let error = read(&arrays, &spec).expect_err("refused").to_string();
            assert!(error.contains("layer3.1.bn2.running_var") && error.contains("projector.weight"), "{error}");
        }

        #[test]
        fn weights_of_another_network_are_refused() {
            let error = read(&file_of(&named("efficientnet_b0"), 1000), &named("resnet18")).expect_err("refused");
            assert!(matches!(error, WeightsError::Missing { .. }), "{error}");
            let error = read(&file_of(&named("resnet18"), 1000), &named("hqnn")).expect_err("refused");
            assert!(matches!(error, WeightsError::NoCounterpart { network: NetworkKind::Hqnn }), "{error}");
        }

        #[test]
        fn a_wrong_shape_is_named() {
            let spec = named("resnet18");
            let mut arrays = file_of(&spec, 1000);
            for (name, shape, numbers) in &mut arrays {
                if name == "layer2.0.conv1.weight" {
                    shape[0] = 64;
                    numbers.truncate(shape.iter().product());
                }
            }
            let error = read(&arrays, &spec).expect_err("refused").to_string();
            assert!(error.contains("layer2.0.conv1.weight is [64, 64, 3, 3], expected [128, 64, 3, 3]"), "{error}");
        }

        #[test]
        fn the_error_of_a_pickle_says_how_to_convert_it() {
            let error =
                TorchvisionWeights::from_bytes(Path::new("a.pth"), b"PK\x03\x04 a zip archive", &named("resnet18"))
                    .expect_err("refused")
                    .to_string();
            assert!(error.contains("a.pth") && error.contains("safetensors.torch.save_file"), "{error}");
        }

        #[test]
        fn nan_in_weights_is_an_error() {
            let spec = named("resnet18");
            let mut arrays = file_of(&spec, 1000);
            arrays.iter_mut().find(|(name, ..)| name == "bn1.bias").expect("there").2[3] = f32::NAN;
            let error = read(&arrays, &spec).expect_err("refused").to_string();
            assert!(error.contains("bn1.bias"), "{error}");
        }
    }
}
