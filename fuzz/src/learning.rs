//! Checks of datasets, model files and the specs of trainings, studies and datasets.

use std::collections::HashMap;
use std::path::Path;

use radome_models::dataset::{Dataset, SplitSpec, merge, verify};
use radome_models::network::{TorchvisionWeights, WeightsError};
use radome_models::occupancy_filter::{OccupancyFilter, Smoothing};
use radome_models::study::StudySpec;
use radome_models::{Model, ModelCard, NetworkSpec, TrainSpec};
use safetensors::tensor::{Dtype, TensorView};

use crate::dataset_spec::BuildSpec;
use crate::{files, folder, with_memory_limit};

/// Largest number of weights of a network that the check of a card builds.
const MAX_WEIGHTS: usize = 1 << 20;

/// Asserts that a dataset folder that opens and matches its hashes is written again without change.
pub fn check_dataset(input: &[u8]) {
    let folder = files(&["dataset.json", "manifest.jsonl", "maps-00000.npy", "maps-00001.npy"], input);
    let opened = with_memory_limit((8 << 20) + 256 * input.len(), || Dataset::open(folder.path()));
    let Ok(dataset) = opened else { return };
    let split = SplitSpec::default();
    let _ = verify(&dataset, &split);
    let matches_hashes = with_memory_limit((8 << 20) + 256 * input.len(), || dataset.verify()).is_ok();
    for index in 0..dataset.len() {
        if let Ok(cells) = dataset.map(index) {
            assert_eq!(cells.len(), dataset.header().shape.cells());
            assert!(cells.iter().all(|cell| cell.is_finite()));
        }
    }
    if let Ok(splits) = dataset.splits(&split) {
        assert_eq!(splits.len(), dataset.len());
    }
    if matches_hashes {
        let again = folder.path().join("again");
        merge(&[(folder.path(), &dataset)], &again, None).expect("what was read can be written");
        let again = Dataset::open(&again).expect("what was written opens");
        assert_eq!((again.header(), again.rows()), (dataset.header(), dataset.rows()));
    }
}

/// Asserts that a loaded model file is written and loads as the same model; also loads the bytes as torchvision
/// weights.
pub fn check_model(input: &[u8]) {
    let name = Path::new("a.safetensors");
    if let Ok(model) = with_memory_limit((64 << 20) + 64 * input.len(), || Model::from_bytes(name, input)) {
        check_smoothing(model.card.smoothing);
        let folder = folder();
        let path = folder.path().join("again.safetensors");
        model.save(&path).expect("what was read can be written");
        let again = Model::load(&path).expect("what was written loads");
        assert_eq!(again.card, model.card);
        assert_eq!(again.network.values().expect("numbers"), model.network.values().expect("numbers"));
    }
    let spec = NetworkSpec::named("resnet18").expect("a network");
    let weights =
        with_memory_limit((64 << 20) + 64 * input.len(), || TorchvisionWeights::from_bytes(name, input, &spec));
    assert!(!matches!(weights, Err(WeightsError::NoCounterpart { .. })));
}

/// Checks a model card, with weights if its network is small.
pub fn check_card(text: &str) {
    check_model(&with_card(text));
}

/// Model file with this card, and zeros as the weights of a small network.
pub fn with_card(text: &str) -> Vec<u8> {
    let layout = serde_json::from_str::<ModelCard>(text).map(|card| card.network_spec()).ok().filter(|spec| {
        // The layout of a circuit grows with its depth.
        let head = serde_json::to_string(&spec.head).unwrap_or_default();
        let digits = head.split(|c: char| !c.is_ascii_digit()).map(str::len).max().unwrap_or(0);
        digits <= 4 && spec.pooled.iter().all(|n| *n <= 64)
    });
    let layout = layout.map(|spec| spec.layout()).unwrap_or_default();
    let count: usize = layout.iter().map(|(_, shape)| shape.iter().product::<usize>()).sum();
    let layout = if count <= MAX_WEIGHTS { layout } else { Vec::new() };
    let zeros: Vec<Vec<u8>> = layout.iter().map(|(_, shape)| vec![0; 4 * shape.iter().product::<usize>()]).collect();
    let views = layout.iter().zip(&zeros).map(|((name, shape), zeros)| {
        (name.as_str(), TensorView::new(Dtype::F32, shape.clone(), zeros).expect("as many as its shape says"))
    });
    let metadata = HashMap::from([("radome".to_owned(), text.to_owned())]);
    safetensors::serialize(views, Some(metadata)).expect("a file")
}

/// Checks the parts of an ONNX file that are read without a runtime: the card, and whether the weights are finite.
pub fn check_onnx(input: &[u8]) {
    let folder = folder();
    let path = folder.path().join("a.onnx");
    std::fs::write(&path, input).expect("writes");
    match with_memory_limit((1 << 20) + 64 * input.len(), || ModelCard::load(&path)) {
        Ok(card) => check_smoothing(card.smoothing),
        Err(error) => assert!(!error.to_string().is_empty()),
    }
}

/// Asserts that outputs stay probabilities for all accepted settings.
fn check_smoothing(smoothing: Smoothing) {
    let mut filter = OccupancyFilter::new(smoothing, 0.1);
    for (time_s, frame) in [(0.0, [1.0, 0.0, 0.0]), (0.1, [0.0, 0.0, 1.0]), (0.1, [0.2, 0.3, 0.5]), (1e9, [0.0; 3])] {
        let people = filter.update(time_s, frame);
        assert!(people.iter().all(|p| (0.0..=1.001).contains(p)), "{smoothing:?}: {people:?}");
    }
}

/// Asserts that specs of a training, a study and a dataset are accepted, or refused with a reason.
pub fn check_specs(text: &str) {
    let allowed = (4 << 20) + 1024 * text.len();
    with_memory_limit(allowed, || {
        if let Ok(spec) = toml::from_str::<TrainSpec>(text)
            && spec.check().is_ok()
        {
            check_smoothing(spec.smoothing);
        }
    });
    with_memory_limit(allowed, || {
        let Ok(mut table) = toml::from_str::<toml::Table>(text) else { return };
        for key in ["dataset", "conditions"] {
            table.remove(key);
        }
        let Ok(spec) = table.try_into::<StudySpec>() else { return };
        if spec.check().is_ok() {
            assert!(spec.variants.iter().all(|variant| spec.network(variant).is_ok()));
        }
    });
    if let Err(error) = with_memory_limit(allowed, || BuildSpec::parse(text)) {
        assert!(!format!("{error:#}").is_empty());
    }
}
