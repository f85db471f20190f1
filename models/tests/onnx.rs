//! Compares exported networks in onnxruntime with the originals, where onnxruntime is installed (`tests/run` installs
//! it).

#![allow(clippy::print_stderr)]

use std::collections::BTreeMap;
use std::path::Path;

use candle_core::{Device, Tensor};
use radome_dsp::{MapFlags, Rdm};
use radome_models::layer::KernelLevel;
use radome_models::network::{Head, Network, Normalisation, Placement};
use radome_models::onnx::{self, ExportError};
use radome_models::onnx_runtime::{OnnxError, OnnxSession};
use radome_models::quantum::{CircuitSpec, Encoding, Execution, Noise, Shots};
use radome_models::train::Trainer;
use radome_models::{Classifier, Model, ModelCard, ModelError, NetworkSpec, networks, stream};
use radome_skip::skip;
use rand::Rng;

/// Largest difference of logits, absolute below one and relative above.
const TOLERANCE: f32 = 1e-4;

/// Random maps of increasing strength, so that logits differ.
fn maps([batch, range, doppler]: [usize; 3]) -> Vec<f32> {
    let mut rng = stream(5, "maps", 0);
    let strength = |index: usize| 0.5 + (index / (range * doppler)) as f32;
    (0..batch * range * doppler).map(|index| strength(index) * rng.random_range(-1.0..1.0)).collect()
}

fn logits(network: &Network, maps: &[f32], shape: [usize; 3]) -> Vec<f32> {
    let input = Tensor::from_slice(maps, &shape[..], &Device::Cpu).expect("tensor");
    network.logits(&input).and_then(|t| t.flatten_all()?.to_vec1()).expect("logits")
}

/// Weights of a network after a few training steps, so that its normalisations have an effect and its logits differ.
fn trained(spec: &NetworkSpec) -> BTreeMap<String, Vec<f32>> {
    let mut trainer = Trainer::new(spec, 3, 1e-3, KernelLevel::detect()).expect("trainer");
    let (maps, labels) = Trainer::random_inputs(spec, 6, 32, 32).expect("maps");
    for _ in 0..15 {
        trainer.step(&maps, &labels).expect("step");
    }
    let mut values = trainer.network().values().expect("values");
    // Both hidden units may be inactive. With opposed weights one of them is active.
    if let Some([a, b, c, d]) = values.get_mut("head_hidden.weight").map(Vec::as_mut_slice) {
        (*c, *d) = (-*a, -*b);
    }
    values
}

/// Network for maps of this size whose latent covers the range of the scaled sigmoid, and whose logits are of order
/// one.
fn scaled_network(spec: &NetworkSpec, mut values: BTreeMap<String, Vec<f32>>, [range, doppler]: [usize; 2]) -> Network {
    let shape = [2, range, doppler];
    let maps = maps(shape);
    let build = |values: &_| {
        let mut network = Network::from_values(spec, values, KernelLevel::detect()).expect("network");
        let input = Tensor::from_slice(&maps, &shape[..], &Device::Cpu).expect("tensor");
        if let Some(latent) = network.latent(&input).expect("latent") {
            let rows: Vec<Vec<f32>> = latent.to_vec2().expect("two rows");
            let combine = |f: fn(f32, f32) -> f32| rows[0].iter().zip(&rows[1]).map(|(&a, &b)| f(a, b)).collect();
            let (mean, sigma) = (combine(|a, b| 0.4 * a + 0.6 * b), combine(|a, b| 2.0 * (a - b).abs() + 1e-6));
            network.set_latent_constants(Normalisation { mean, sigma });
        }
        network
    };
    let found = logits(&build(&values), &maps, shape);
    let largest = found.iter().fold(0.0f32, |m, v| m.max(v.abs()));
    let is_last = |(_, shape): &(String, Vec<usize>)| matches!(shape[..], [3, _]);
    let (last, _) = spec.layout().into_iter().rfind(is_last).expect("a last layer");
    for value in values.get_mut(&last).expect("its weights") {
        *value *= 2.0 / largest.max(0.01);
    }
    build(&values)
}

/// Session of onnxruntime. Returns `None` and counts the test as skipped where it is not installed.
fn session(bytes: &[u8], [rows, columns]: [usize; 2]) -> Option<OnnxSession> {
    match OnnxSession::new(Path::new("exported.onnx"), bytes, rows, columns) {
        Ok(session) => Some(session),
        Err(error @ OnnxError::NoLibrary { .. }) => {
            skip("onnxruntime", &error.to_string());
            None
        }
        Err(error) => panic!("{error}"),
    }
}

/// Largest difference of logits, relative to logits above one; `None` without onnxruntime.
fn difference(name: &str, spec: &NetworkSpec, values: &BTreeMap<String, Vec<f32>>, size: [usize; 2]) -> Option<f32> {
    let network = scaled_network(spec, values.clone(), size);
    let bytes = onnx::export_network(&network, size[0], size[1]).unwrap_or_else(|error| panic!("{name}: {error}"));
    if let Some(folder) = std::env::var_os("RADOME_KEEP_ONNX") {
        let file = format!("{name}-{}x{}.onnx", size[0], size[1]).replace(' ', "-");
        std::fs::write(Path::new(&folder).join(file), &bytes).expect("writable");
    }
    let mut session = session(&bytes, size)?;
    let shape = [2, size[0], size[1]];
    let maps = maps(shape);
    let (ours, theirs) = (logits(&network, &maps, shape), session.logits(&maps).expect("run"));
    assert_eq!(ours.len(), theirs.len(), "{name}");
    assert!(ours.iter().any(|v| v.abs() > 0.1) && ours[..3] != ours[3..], "{name}: {ours:?}");
    let worst = ours.iter().zip(&theirs).map(|(a, b)| (a - b).abs() / a.abs().max(1.0)).fold(0.0, f32::max);
    assert!(worst < TOLERANCE, "{name} {size:?}: {worst}: {ours:?}, onnxruntime {theirs:?}");
    Some(worst)
}

const SIZES: [[usize; 2]; 3] = [[128, 128], [64, 61], [32, 32]];

#[test]
fn every_network_agrees_with_onnxruntime() {
    for network in networks() {
        let spec = NetworkSpec::named(&network.name).expect("known");
        if spec.kind.reads_descriptors() {
            continue;
        }
        let values = trained(&spec);
        for size in SIZES {
            let Some(worst) = difference(&network.name, &spec, &values, size) else { return };
            eprintln!("{} {size:?}: {worst:.1e}", network.name);
        }
    }
}

#[test]
fn every_circuit_agrees_with_onnxruntime() {
    let encodings = [(Encoding::ZzFeatureMap, 1), (Encoding::ZzFeatureMap, 2), (Encoding::Angle, 1)];
    let mut largest = 0.0f32;
    for (encoding, repetitions) in encodings {
        for qubits in 1..=6 {
            for depth in 0..=3 {
                for readout_flip in [0.0, 0.03] {
                    let noise = Noise { readout_flip, ..Default::default() };
                    let circuit = CircuitSpec { qubits, encoding, repetitions, depth, noise, ..Default::default() };
                    let placement = [Placement::Latent, Placement::Beside, Placement::Front][depth % 3];
                    let name = format!("{encoding:?} {repetitions} {qubits} {depth} {readout_flip} {placement:?}");
                    let spec = NetworkSpec::with_head(Head::Circuit { circuit, frozen: false, placement });
                    let Some(worst) = difference(&name, &spec, &trained(&spec), [32, 32]) else { return };
                    largest = largest.max(worst);
                }
            }
        }
    }
    eprintln!("circuits: {largest:.1e}");
}

#[test]
fn shipped_models_agree_with_their_onnx_files() {
    let folder = tempfile::tempdir().expect("folder");
    let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fixtures/models");
    let files = std::fs::read_dir(models).expect("models").filter_map(Result::ok).map(|file| file.path());
    for path in files.filter(|path| path.extension().is_some_and(|e| e == "safetensors")) {
        let model = Model::load(&path).expect("a model");
        if model.card.network.reads_descriptors() {
            assert!(matches!(onnx::export(&model), Err(ExportError::Descriptors { .. })), "{}", path.display());
            continue;
        }
        let file = folder.path().join("exported.ONNX");
        std::fs::write(&file, onnx::export(&model).expect("exported")).expect("writable");
        assert_eq!(ModelCard::load(&file).expect("a card"), model.card);
        let Some(mut theirs) = classifier(&file) else { return };
        assert_alike(&path.display().to_string(), &mut Classifier::new(model), &mut theirs);
    }
}

/// Classifier of an ONNX file. Returns `None` and counts the test as skipped where onnxruntime is not installed.
fn classifier(file: &Path) -> Option<Classifier> {
    match Classifier::load(file) {
        Ok(classifier) => Some(classifier),
        Err(error @ ModelError::Onnx(OnnxError::NoLibrary { .. })) => {
            skip("onnxruntime", &error.to_string());
            None
        }
        Err(error) => panic!("{error}"),
    }
}

/// Asserts that two classifiers give the same probabilities for random maps.
fn assert_alike(name: &str, ours: &mut Classifier, theirs: &mut Classifier) {
    let shape = ours.rdm_spec().shape(ours.waveform()).expect("a shape");
    for index in 0..20 {
        let mut rng = stream(5, "decibels", index);
        let db: Vec<f32> = (0..shape.cells()).map(|_| rng.random_range(-95.0..-40.0 + index as f32)).collect();
        let (range_step_m, velocity_step_m_per_s) = ours.rdm_spec().steps(ours.waveform());
        let flags = MapFlags::default();
        let map = Rdm { shape, db, range_step_m, velocity_step_m_per_s, sequence: index, flags, motion: None };
        let [a, b] = [&mut *ours, &mut *theirs].map(|classifier| classifier.classify(&map).expect("probabilities"));
        assert!(a.iter().zip(&b).all(|(a, b)| (a - b).abs() < 1e-5), "{name}: {a:?} {b:?}");
    }
}

/// Regression test: the input of a model whose network sees range and Doppler exchanged had them exchanged, too. Files that were exported
/// so are still read.
#[test]
fn files_of_transposed_models_read_maps_by_range_and_doppler() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fixtures/models/desk-hqnn.safetensors");
    let model = |card: ModelCard| Model { card, network: Model::load(&path).expect("a model").network };
    let card = ModelCard::load(&path).expect("a card");
    let [_, range, doppler] = card.map_shape();
    assert_ne!(range, doppler);
    let exchanged = ModelCard { input_shape: [1, doppler, range], ..card.clone() };
    let axes = ["channel", "doppler", "range"].map(str::to_owned);
    let transposed = ModelCard { axes, ..exchanged.clone() };
    assert_eq!(transposed.map_shape(), [1, range, doppler]);
    let exported = onnx::export(&model(transposed.clone())).expect("exported");
    // A file as it was exported before: the graph reads exchanged axes, which the card names.
    let mut earlier = onnx::export(&model(exchanged)).expect("exported");
    let axes = [r#""axes":["channel","range","doppler"]"#, r#""axes":["channel","doppler","range"]"#];
    for [from, to] in [axes, ["text_sha256", "Text_sha256"]] {
        let at = earlier.windows(from.len()).rposition(|window| window == from.as_bytes()).expect("in the card");
        earlier[at..at + to.len()].copy_from_slice(to.as_bytes());
    }
    let folder = tempfile::tempdir().expect("folder");
    let file = folder.path().join("some.onnx");
    let mut ours = Classifier::new(model(transposed.clone()));
    for (name, bytes, of_file) in [("exported", exported, card), ("exported before", earlier, transposed)] {
        std::fs::write(&file, bytes).expect("writable");
        assert_eq!(ModelCard::load(&file).expect("a card"), of_file, "{name}");
        let Some(mut theirs) = classifier(&file) else { return };
        assert_alike(name, &mut ours, &mut theirs);
    }
}

mod hard_cases {
    use super::*;

    /// Asserts that these files are refused before any runtime is loaded.
    #[test]
    fn foreign_files_and_files_without_a_card_are_refused() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fixtures/models/paper-hqnn.safetensors");
        let model = Model::load(&path).expect("a model");
        let whole = onnx::export(&model).expect("exported");
        let folder = tempfile::tempdir().expect("folder");
        let file = folder.path().join("some.onnx");
        let refusal = |bytes: &[u8]| {
            std::fs::write(&file, bytes).expect("writable");
            Classifier::load(&file).err().expect("refused")
        };
        for bytes in [&std::fs::read(&path).expect("readable")[..], b"{\"this\": \"is json\"}", &[0xff; 999]] {
            let error = refusal(bytes);
            assert!(matches!(error, ModelError::NotOnnx { .. } | ModelError::NoCard { .. }), "{error}");
        }
        let bare = onnx::export_network(&model.network, 32, 32).expect("exported");
        let error = refusal(&bare);
        assert!(matches!(error, ModelError::NoCard { .. }) && error.to_string().contains("'radome' entry"), "{error}");
        // Makes a number NaN: the first one after the array's name, a tag, and a length of three bytes.
        let mut numbers = whole;
        let name = numbers.windows(10).rposition(|window| window == b"fc1.weight").expect("an array");
        numbers[name + 14..name + 18].copy_from_slice(&[0xff; 4]);
        let error = refusal(&numbers);
        assert!(
            matches!(error, ModelError::Inconsistent { .. }) && error.to_string().contains("fc1.weight"),
            "{error}"
        );
    }

    /// Regression test: a damaged number was accepted if it was finite, and any in the card.
    #[test]
    fn a_number_that_was_not_exported_is_refused() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fixtures/models/paper-hqnn.safetensors");
        let mut bytes = onnx::export(&Model::load(&path).expect("a model")).expect("exported");
        let folder = tempfile::tempdir().expect("folder");
        let file = folder.path().join("some.onnx");
        let load = |bytes: &[u8]| {
            std::fs::write(&file, bytes).expect("writable");
            ModelCard::load(&file)
        };
        load(&bytes).expect("whole");
        let last = |bytes: &[u8], text: &[u8]| bytes.windows(text.len()).rposition(|window| window == text);
        // Changes the last bit of the first number after the array's name, a tag, and a length of three bytes.
        let name = last(&bytes, b"fc1.weight").expect("an array");
        bytes[name + 14] ^= 1;
        let error = load(&bytes).expect_err("damaged");
        assert!(matches!(error, ModelError::Hash { .. }) && error.to_string().contains("hint: "), "{error}");
        // Changes the last bit of the first digit of a number in the card.
        let mut of_card = bytes.clone();
        let number = last(&bytes, b"\"dwell_s\":").expect("a number") + 10;
        of_card[number] ^= 1;
        let error = load(&of_card).expect_err("damaged");
        assert!(matches!(error, ModelError::CardHash { .. }) && error.to_string().contains("hint: "), "{error}");
        // A file of an earlier version has no hashes.
        for key in [&b"text_sha256"[..], b"arrays_sha256"] {
            let key = last(&bytes, key).expect("a hash");
            bytes[key] = b'_';
        }
        load(&bytes).expect("without hashes");
    }

    #[test]
    fn large_noisy_and_measured_circuits_are_refused() {
        let shots = Execution::Shots(Shots { count: 100, seed: 1, gradient: Default::default() });
        let noise = Noise { depolarising_one_qubit: 0.01, ..Default::default() };
        for (circuit, reason) in [
            (CircuitSpec { qubits: 9, ..Default::default() }, "9 qubits"),
            (CircuitSpec { execution: shots, ..Default::default() }, "shots"),
            (CircuitSpec { noise, ..Default::default() }, "gates err"),
        ] {
            let spec = NetworkSpec::with_head(Head::Circuit { circuit, frozen: false, placement: Placement::Latent });
            let network = Network::initialise(&spec, 3, 0, KernelLevel::detect()).expect("network");
            let error = onnx::export_network(&network, 32, 32).expect_err("refused");
            assert!(matches!(error, ExportError::Circuit { .. }) && error.to_string().contains(reason), "{error}");
        }
    }

    #[test]
    fn networks_of_descriptors_are_refused() {
        let specs = networks().into_iter().map(|network| NetworkSpec::named(&network.name).expect("known"));
        for spec in specs.filter(|spec| spec.kind.reads_descriptors()) {
            let network = Network::initialise(&spec, 3, 0, KernelLevel::detect()).expect("network");
            let error = onnx::export_network(&network, 32, 32).expect_err("refused");
            assert!(matches!(error, ExportError::Descriptors { .. }), "{error}");
            assert!(error.to_string().contains("hint: "), "{error}");
        }
    }

    #[test]
    fn maps_that_are_too_small_are_refused_with_the_layer() {
        let spec = NetworkSpec::named("doppler_net").expect("known");
        let network = Network::initialise(&spec, 3, 0, KernelLevel::detect()).expect("network");
        let error = onnx::export_network(&network, 16, 16).expect_err("refused").to_string();
        assert!(error.contains("pool5"), "{error}");
    }

    /// Asserts that a file for maps of another size is refused when it is opened, not at the first map.
    #[test]
    fn a_file_for_other_maps_is_refused() {
        let spec = NetworkSpec::named("hqnn").expect("known");
        let network = Network::initialise(&spec, 3, 0, KernelLevel::detect()).expect("network");
        let bytes = onnx::export_network(&network, 32, 32).expect("exported");
        match OnnxSession::new(Path::new("small.onnx"), &bytes, 64, 61) {
            Err(OnnxError::NoLibrary { .. }) => {}
            Err(error @ OnnxError::Signature { .. }) => {
                assert!(error.to_string().contains("[batch, 1, 64, 61]"), "{error}")
            }
            Err(error) => panic!("{error}"),
            Ok(_) => panic!("accepted"),
        }
    }
}
