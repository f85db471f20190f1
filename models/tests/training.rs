//! Tests of training on made-up maps, and of saving and loading models.

use std::path::Path;

use radome_dsp::rdm::Motion;
use radome_dsp::{Occupancy, Rdm, RdmSpec, Waveform, WaveformRequest};
use radome_models::dataset::{DatasetError, DatasetHeader, Domain, ManifestRow, Split, SplitBy, SplitSpec, merge};
use radome_models::evaluate::evaluate;
use radome_models::layer::KernelLevel;
use radome_models::network::NetworkKind;
use radome_models::occupancy_filter::Smoothing;
use radome_models::standardise::MapReference;
use radome_models::train::{Augmentation, LatentStandardisation, Superpose, Sway};
use radome_models::{
    Classifier, ClassifyError, Dataset, Model, ModelError, NetworkSpec, TrainError, TrainSpec, networks, train,
    train_with_checkpoint, training_warnings,
};

use crate::support::{Maps, dataset, header};

/// Settings of small maps with strong targets, which a network learns in a second.
fn easy() -> Maps {
    Maps { size: 32, sequences: [40, 12, 12], length: 3, snr_db: (20.0, 30.0), ..Maps::default() }
}

fn quick() -> TrainSpec {
    TrainSpec { epochs: 8, linear_epochs: Some(4), starts: 1, start_epochs: 1, ..TrainSpec::default() }
}

/// Every augmentation of training maps with levels over noise.
fn all_augmentations() -> Augmentation {
    Augmentation {
        noise_db: 1.0,
        doppler_flip: true,
        superpose: Some(Superpose { probability: 0.3 }),
        echo_gain_db: Some([-7.0, 7.0]),
        range_stretch: 0.1,
        range_shift_bins: 2,
        velocity_stretch: 0.1,
        sway: Some(Sway { stretch_bins: [2, 5], ..Sway::default() }),
    }
}

/// Few maps and one epoch, for tests in which the result does not matter.
fn brief() -> (Dataset, TrainSpec) {
    let set = dataset(Maps { size: 16, sequences: [3, 2, 1], length: 3, ..Maps::default() });
    (set, TrainSpec { epochs: 2, linear_epochs: Some(1), starts: 2, batch_size: 8, ..quick() })
}

/// Kinds of networks that read descriptors.
fn descriptor_networks() -> impl Iterator<Item = NetworkKind> {
    NetworkKind::ALL.into_iter().filter(|network| network.reads_descriptors())
}

/// Settings for training a network of map descriptors.
fn descriptors(network: NetworkKind, spec: TrainSpec) -> TrainSpec {
    TrainSpec { network, reference: MapReference::OverNoise { skip_range_bins: 0, most_db: None }, ..spec }
}

fn rdm(set: &Dataset, index: usize) -> Rdm {
    set.header().rdm(set.map(index).expect("map"), index as u64)
}

/// Maps of the same noise in all classes, whose motion alone differs.
fn of_motion_alone() -> Dataset {
    let maps = dataset(Maps { size: 16, sequences: [12, 6, 6], length: 3, ..Maps::default() });
    let spec = RdmSpec { motion_over_s: Some(1.0), ..maps.header().rdm_spec };
    let header = DatasetHeader::new(maps.header().waveform.clone(), spec).expect("header");
    let map = |(index, row): (usize, &ManifestRow)| {
        let motion = Motion { spacing_change_rad: 0.4 * row.label.index() as f32, ..Motion::default() };
        // The first maps show nobody.
        (Rdm { motion: Some(motion), ..rdm(&maps, index % 3) }, row.clone())
    };
    Dataset::from_maps(header, maps.rows().iter().enumerate().map(map).collect()).expect("dataset")
}

#[test]
fn networks_of_descriptors_learn_from_motion() {
    let set = of_motion_alone();
    let easy_set = dataset(Maps { size: 16, sequences: [3, 2, 1], length: 3, ..Maps::default() });
    for network in descriptor_networks() {
        let spec =
            descriptors(network, TrainSpec { epochs: 30, linear_epochs: Some(20), learning_rate: 0.02, ..quick() });
        let outcome = train(&set, &spec, &mut |_| ()).expect("train");
        assert!(outcome.validation.balanced_accuracy > 0.99, "{network}: {:?}", outcome.validation);
        // A map without motion is of another kind.
        let [mut original, mut loaded] = saved_and_loaded(outcome.model);
        let map = Rdm { motion: set.rows()[0].motion, ..rdm(&set, 0) };
        assert_eq!(original.classify(&map).expect("classify"), loaded.classify(&map).expect("classify"));
        let error = original.classify(&rdm(&set, 0)).expect_err("no motion");
        assert!(matches!(&error, ClassifyError::OtherMaps { what } if what.contains("no motion")), "{error}");
        // The settings of maps without motion differ.
        let error = evaluate(&mut original, &easy_set, &[0]).expect_err("no motion").to_string();
        assert!(error.contains("motion_over_s null instead of 1.0"), "{error}");
    }
}

/// Networks that read the cells of maps take maps with motion and without.
#[test]
fn networks_of_cells_ignore_motion() {
    let (set, spec) = brief();
    let mut classifier = Classifier::new(train(&set, &spec, &mut |_| ()).expect("train").model);
    let map = rdm(&set, 0);
    let moving = Rdm { motion: Some(Motion::default()), ..map.clone() };
    assert_eq!(classifier.classify(&map).expect("classify"), classifier.classify(&moving).expect("classify"));
    evaluate(&mut classifier, &of_motion_alone(), &[0, 1]).expect("evaluate");
}

/// Trains until the checkpoint holds this number of epochs. The report of the next one panics, which is as abrupt as a signal: an epoch
/// is written after its report.
fn stop_after(epochs: usize, set: &Dataset, spec: &TrainSpec, checkpoint: &Path) {
    let mut count = 0;
    let stopped = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
        let _ = train_with_checkpoint(set, spec, Some(checkpoint), &mut |_| {
            count += 1;
            assert!(count <= epochs, "stop");
        });
    }));
    assert!(stopped.is_err() && checkpoint.exists());
}

/// Saves and loads a model; returns the original and the loaded one. Asserts that the folder holds only the file.
fn saved_and_loaded(model: Model) -> [Classifier; 2] {
    let dir = tempfile::tempdir().expect("folder");
    let path = dir.path().join("model.safetensors");
    model.save(&path).expect("save");
    assert_eq!(std::fs::read_dir(dir.path()).expect("list").count(), 1, "no temporary file is left");
    let both = [Classifier::load(&path).expect("load"), Classifier::new(model)];
    assert_eq!(both[0].card(), both[1].card());
    both
}

/// Asserts that the answer to a map changes by less than `most` at another gain.
fn assert_same_at_another_gain(classifier: &mut Classifier, mut map: Rdm, answer: [f32; 3], most: f32) {
    map.db.iter_mut().for_each(|db| *db += 13.0);
    for (a, b) in answer.iter().zip(classifier.classify(&map).expect("classify")) {
        assert!((a - b).abs() < most, "{a} {b}");
    }
}

#[test]
fn every_seed_learns_to_count() {
    let set = dataset(easy());
    for seed in [11, 22, 33, 42, 55] {
        let outcome = train(&set, &TrainSpec { seed, ..quick() }, &mut |_| {}).expect("training");
        let last = outcome.history.last().expect("history");
        assert!(last.training_balanced_accuracy > 0.9, "seed {seed}: {last:?}");
        let test = outcome.test.expect("test split");
        assert!(test.balanced_accuracy > 0.6, "seed {seed}: {test:?}");
        assert!(test.absent.is_empty() && outcome.warnings.is_empty());
    }
}

/// Asserts that descriptors of a map suffice for counting, with a linear head and with the circuit. The loaded model
/// gives the same answers, and another gain does not change them.
#[test]
fn descriptors_learn_to_count() {
    let set = dataset(easy());
    for network in descriptor_networks() {
        for seed in [11, 22, 33] {
            let spec = TrainSpec { seed, epochs: 12, linear_epochs: Some(6), learning_rate: 5e-3, ..quick() };
            let outcome = train(&set, &descriptors(network, spec), &mut |_| {}).expect("training");
            let last = outcome.history.last().expect("history");
            assert!(last.training_balanced_accuracy > 0.65, "{network:?} seed {seed}: {last:?}");
            let test = outcome.test.expect("test split");
            assert!(test.balanced_accuracy > 0.55, "{network:?} seed {seed}: {test:?}");
            let [mut loaded, mut original] = saved_and_loaded(outcome.model);
            let standardisation = &loaded.card().standardisation;
            assert_eq!((standardisation.mean_db, standardisation.sigma_db), (0.0, 1.0));
            for index in [0, 200, 300] {
                let map = rdm(&set, index);
                let answer = loaded.classify(&map).expect("classify");
                assert_eq!(answer, original.classify(&map).expect("classify"));
                assert_same_at_another_gain(&mut loaded, map, answer, 1e-2);
            }
        }
    }
}

/// Asserts that a training ends for every network, because it finds the layers that it scales and fits.
#[test]
fn every_network_is_trained() {
    let set = dataset(Maps { size: 32, sequences: [3, 2, 1], length: 3, ..Maps::default() });
    let (_, any) = brief();
    for network in networks() {
        let NetworkSpec { kind, head, .. } = NetworkSpec::named(&network.name).expect("known");
        let spec = TrainSpec { network: kind, head, starts: 1, ..any.clone() };
        let spec = if kind.reads_descriptors() { descriptors(kind, spec) } else { spec };
        let outcome = train(&set, &spec, &mut |_| {}).unwrap_or_else(|error| panic!("{}: {error}", network.name));
        assert_eq!(outcome.history.len(), spec.epochs, "{}", network.name);
    }
}

/// Asserts that a loaded model gives the answers of the original, with exchanged axes too, which its card states.
#[test]
fn a_saved_model_answers_as_before() {
    let (set, spec) = brief();
    for transposed in [false, true] {
        let outcome = train(&set, &TrainSpec { transposed, ..spec.clone() }, &mut |_| {}).expect("training");
        let [mut loaded, mut original] = saved_and_loaded(outcome.model);
        assert_eq!((loaded.card().is_transposed(), &loaded.card().dataset_hash), (transposed, &set.hash()));
        assert_eq!(loaded.waveform(), &set.header().waveform);
        for index in 0..6 {
            let map = rdm(&set, index);
            let probabilities = loaded.classify(&map).expect("classify");
            assert_eq!(probabilities, original.classify(&map).expect("classify"));
            assert!((probabilities.iter().sum::<f32>() - 1.0).abs() < 1e-6);
        }
    }
}

#[test]
fn one_seed_gives_one_model_on_any_number_of_threads() {
    let (set, spec) = brief();
    let spec = TrainSpec {
        augmentation: Augmentation { noise_db: 1.0, doppler_flip: true, ..Augmentation::default() },
        ..spec
    };
    let run = |threads: usize, spec: &TrainSpec| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("pool");
        let model = pool.install(|| train(&set, spec, &mut |_| {}).expect("training")).model;
        model.network.values().expect("values")
    };
    let one = run(1, &spec);
    assert_eq!(one, run(3, &spec));
    assert_ne!(one, run(1, &TrainSpec { seed: 12, ..spec.clone() }));
    // The portable level exists on every machine and can be set.
    let portable = TrainSpec { kernel_level: Some(KernelLevel::Portable), ..spec.clone() };
    assert_eq!(run(1, &portable), run(2, &portable));
    // With every augmentation that maps over noise permit.
    let changed = TrainSpec {
        reference: MapReference::OverNoise { skip_range_bins: 2, most_db: Some(40.0) },
        augmentation: all_augmentations(),
        ..spec
    };
    assert_eq!(run(1, &changed), run(3, &changed));
}

#[test]
fn a_stopped_and_continued_training_gives_the_same_model() {
    let (set, spec) = brief();
    let doppler_net = TrainSpec { network: NetworkKind::DopplerNet, ..spec.clone() };
    let large = dataset(Maps { size: 32, sequences: [3, 2, 1], length: 3, ..Maps::default() });
    let described = descriptors(NetworkKind::DescriptorHqnn, spec.clone());
    for (set, spec) in [(&set, spec), (&large, doppler_net), (&set, described)] {
        let whole = train(set, &spec, &mut |_| {}).expect("training");
        let epochs = whole.history.len();
        assert!(epochs >= 2);
        for stop in 1..epochs {
            let dir = tempfile::tempdir().expect("folder");
            let path = dir.path().join("checkpoint");
            stop_after(stop, set, &spec, &path);
            let mut reports = 0;
            let resumed = train_with_checkpoint(set, &spec, Some(&path), &mut |_| reports += 1).expect("training");
            assert_eq!(reports, epochs - stop);
            assert_eq!(resumed.model.network.values().expect("values"), whole.model.network.values().expect("values"));
            assert_eq!(resumed.model.card, whole.model.card);
            // Regression test: a training that was killed before its model was saved was lost.
            let again = train_with_checkpoint(set, &spec, Some(&path), &mut |_| panic!("no epoch is left"));
            assert_eq!(again.expect("training").model.card, whole.model.card);
        }
    }
}

#[test]
fn checkpoints_of_another_training_and_damaged_ones_are_refused() {
    let (set, spec) = brief();
    let dir = tempfile::tempdir().expect("folder");
    let path = dir.path().join("checkpoint");
    stop_after(1, &set, &spec, &path);
    let whole = std::fs::read(&path).expect("read");
    let refused = |spec: &TrainSpec, bytes: &[u8]| {
        std::fs::write(&path, bytes).expect("write");
        train_with_checkpoint(&set, spec, Some(&path), &mut |_| {}).err().expect("refused").to_string()
    };
    let error = refused(&TrainSpec { seed: spec.seed + 1, ..spec.clone() }, &whole);
    assert!(error.contains("other settings") && error.contains("hint:"), "{error}");
    for length in (0..whole.len()).step_by(9973) {
        let error = refused(&spec, &whole[..length]);
        assert!(error.contains("checkpoint"), "{error}");
    }
    let key = b"adam_steps\\\":";
    let in_metadata = whole.windows(key.len()).position(|w| w == key).expect("in the metadata") + key.len();
    for at in [whole.len() - 4, in_metadata] {
        let mut flipped = whole.clone();
        flipped[at] ^= 1;
        let error = refused(&spec, &flipped);
        assert!(error.contains("not those that were written") && error.contains("hint: "), "{error}");
    }
}

/// Asserts that maps of another spec or waveform are refused: with the same shape, errors would otherwise go unnoticed.
#[test]
fn maps_of_another_spec_or_waveform_are_refused() {
    let (set, spec) = brief();
    let card = train(&set, &spec, &mut |_| {}).expect("training").model.card;
    let header = set.header();
    card.check_maps(&header.rdm_spec, &header.waveform).expect("its own");
    let another = RdmSpec { floor_db: header.rdm_spec.floor_db - 10.0, ..header.rdm_spec };
    let refused = |spec: &RdmSpec, waveform: &Waveform| {
        let error = card.check_maps(spec, waveform).expect_err("refused");
        assert!(matches!(error, ClassifyError::OtherMaps { .. }), "{error}");
        error.to_string()
    };
    let error = refused(&another, &header.waveform);
    assert!(error.contains("floor_db") && error.contains("instead of") && error.contains("hint: "), "{error}");
    // The same numbers of chirps and samples, but wider range bins.
    let request = WaveformRequest { end_frequency_hz: 60.2e9, ..header.waveform.request.clone() };
    let narrow = Waveform::realise(request).expect("waveform");
    let error = refused(&header.rdm_spec, &narrow);
    assert!(error.contains("waveform") && error.contains("hint: "), "{error}");
}

#[test]
fn every_standardisation_of_the_latent_is_saved_with_the_model() {
    let (set, spec) = brief();
    for latent in [
        LatentStandardisation::None,
        LatentStandardisation::FrozenByEpoch,
        LatentStandardisation::Running { momentum: 0.1 },
    ] {
        let outcome = train(&set, &TrainSpec { latent, ..spec.clone() }, &mut |_| {}).expect("training");
        let constants = outcome.model.card.latent;
        assert_eq!(constants, outcome.model.network.latent_constants());
        assert_eq!(latent == LatentStandardisation::None, constants == Default::default(), "{latent:?}");
    }
}

/// Asserts that settings beyond the paper's network are saved in the file and apply to the loaded model.
#[test]
fn reference_grid_and_smoothing_are_saved_with_the_model() {
    let (set, spec) = brief();
    let smoothing = Smoothing { dwell_s: 20.0, temperature: 1.2, ..Smoothing::default() };
    let reference = MapReference::OverNoise { skip_range_bins: 2, most_db: Some(15.0) };
    let outcome = train(&set, &TrainSpec { reference, pooled: [4, 6], smoothing, ..spec }, &mut |_| {});
    let [mut loaded, mut original] = saved_and_loaded(outcome.expect("training").model);
    assert_eq!((loaded.card().smoothing, loaded.card().pooled), (smoothing, [4, 6]));
    let map = rdm(&set, 1);
    let answer = loaded.classify(&map).expect("classify");
    assert_eq!(answer, original.classify(&map).expect("classify"));
    assert_same_at_another_gain(&mut loaded, map, answer, 1e-3);
}

/// Regression test: a table that set one key of the filter changed the others, too.
#[test]
fn keys_that_the_smoothing_of_a_spec_leaves_out_have_their_defaults() {
    let read = |text: &str| serde_json::from_str::<TrainSpec>(text).expect("a spec").smoothing;
    let default = Smoothing::default();
    let by_frame = Smoothing { weight: Some(0.5), independent_s: None, ..default };
    for (text, expected) in [
        ("{}", default),
        (r#"{"smoothing":{}}"#, default),
        (r#"{"smoothing":{"dwell_s":3}}"#, Smoothing { dwell_s: 3.0, ..default }),
        (r#"{"smoothing":{"temperature":1.0,"newest":0.0}}"#, Smoothing { temperature: 1.0, newest: 0.0, ..default }),
        (r#"{"smoothing":{"weight":0.5,"unseen_s":3.0}}"#, by_frame),
    ] {
        assert_eq!(read(text), expected, "{text}");
        // What is written is read again.
        let written = serde_json::to_string(&TrainSpec { smoothing: expected, ..TrainSpec::default() }).expect("JSON");
        assert_eq!(read(&written), expected, "{written}");
    }
    let both = read(r#"{"smoothing":{"weight":0.5,"independent_s":1.0}}"#);
    let error = TrainSpec { smoothing: both, ..TrainSpec::default() }.check().expect_err("both").to_string();
    assert!(error.contains("smoothing.weight"), "{error}");
    assert!(serde_json::from_str::<TrainSpec>(r#"{"smoothing":{"temperature":null}}"#).is_err());
}

/// Asserts that a model with the paper's rule refuses maps without labels, which its card states.
#[test]
fn a_model_that_needs_labels_refuses_maps_without_labels() {
    let (set, spec) = brief();
    let outcome = train(&set, &TrainSpec { label_leaking_cells: true, ..spec }, &mut |_| {}).expect("training");
    assert!(outcome.warnings.iter().any(|warning| warning.contains("label")), "{:?}", outcome.warnings);
    let mut classifier = Classifier::new(outcome.model);
    let error = classifier.classify(&rdm(&set, 0)).expect_err("no label").to_string();
    assert!(error.contains("labels") && error.contains("hint:"), "{error}");
    let (row, map) = (&set.rows()[0], set.map(0).expect("map"));
    classifier.classify_row(&map, set.header().shape, row).expect("with its label");
}

/// Asserts that a training starts from given weights: training steps without effect leave them unchanged.
#[test]
fn a_training_starts_from_given_weights() {
    use radome_models::network::Network;
    use safetensors::tensor::{Dtype, TensorView};
    let (set, spec) = brief();
    let spec = TrainSpec {
        network: NetworkKind::ResNet18,
        epochs: 1,
        linear_epochs: Some(0),
        starts: 1,
        learning_rate: 1e-9,
        ..spec
    };
    let network = spec.network_spec();
    let values = Network::initialise(&network, 77, 0, KernelLevel::detect()).and_then(|n| n.values()).expect("values");
    let bytes = |name: &str| values[name].iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
    let arrays: Vec<_> = network.layout().into_iter().map(|(name, shape)| (bytes(&name), name, shape)).collect();
    let views = arrays.iter().map(|(bytes, name, shape)| {
        (name.as_str(), TensorView::new(Dtype::F32, shape.clone(), bytes).expect("an array"))
    });
    let folder = tempfile::tempdir().expect("folder");
    let path = folder.path().join("resnet18.safetensors");
    std::fs::write(&path, safetensors::serialize(views, None).expect("serialised")).expect("writable");
    let started = TrainSpec { weights: Some(path), ..spec };
    let outcome = train(&set, &started, &mut |_| {}).expect("training");
    assert_eq!(outcome.model.card.training.weights_hash.as_ref().map(String::len), Some(64));
    let after = outcome.model.network.values().expect("values");
    for name in ["conv1.weight", "layer4.1.conv2.weight", "fc.weight"] {
        assert!(values[name].iter().zip(&after[name]).all(|(a, b)| (a - b).abs() < 1e-6), "{name}");
    }
    // The paper's network has no matching layers.
    let error = train(&set, &TrainSpec { network: NetworkKind::Hqnn, ..started }, &mut |_| {}).err().expect("refused");
    assert!(matches!(error, TrainError::Weights(_)), "{error}");
}

mod hard_cases {
    use super::*;

    fn trained() -> (Dataset, Model) {
        let (set, spec) = brief();
        let model = train(&set, &spec, &mut |_| {}).expect("training").model;
        (set, model)
    }

    #[test]
    fn damaged_model_files_are_refused_with_their_path() {
        let (_, model) = trained();
        let dir = tempfile::tempdir().expect("folder");
        let path = dir.path().join("model.safetensors");
        model.save(&path).expect("save");
        let whole = std::fs::read(&path).expect("read");
        // No flipped byte in the header causes a panic.
        for at in 0..400 {
            let mut bytes = whole.clone();
            bytes[at] ^= 0x15;
            let _ = Model::from_bytes(&path, &bytes);
        }
        let replaced = |bytes: &[u8], from: &str, to: &str| {
            assert_eq!(from.len(), to.len());
            let mut bytes = bytes.to_vec();
            let at = bytes.windows(from.len()).position(|w| w == from.as_bytes()).expect("in the header");
            bytes[at..at + from.len()].copy_from_slice(to.as_bytes());
            bytes
        };
        let refusal = |bytes: &[u8]| Model::from_bytes(&path, bytes).err().expect("refused");
        let replace = |from: &str, to: &str| refusal(&replaced(&whole, from, to));
        assert!(matches!(replace("format_version\\\":1", "format_version\\\":9"), ModelError::Newer { found: 9, .. }));
        assert!(matches!(replace("\"radome\"", "\"random\""), ModelError::NoCard { .. }));
        assert!(matches!(replace("fc1.weight", "fc7.weight"), ModelError::Inconsistent { .. }));
        // Regression test: a flipped bit in a number of the card changed predictions without an error.
        let mut bytes = whole.clone();
        let key = b"temperature\\\":";
        let at = bytes.windows(key.len()).position(|w| w == key).expect("in the card");
        bytes[at + key.len()] ^= 1;
        let error = refusal(&bytes);
        assert!(matches!(error, ModelError::CardHash { .. }) && error.to_string().contains("hint: "), "{error}");
        // A file of an earlier version has no hash of the card; its key is renamed to one that is not known.
        let older = replaced(&whole, "text_sha256", "Text_sha256");
        Model::from_bytes(&path, &older).expect("not checked");
        let unknown = refusal(&replaced(&older, "hqnn", "hqmm"));
        assert!(matches!(unknown, ModelError::Card { .. }) && unknown.to_string().contains("hqmm"), "{unknown}");
        let mut bytes = whole.clone();
        let last = bytes.len() - 4;
        bytes[last..].copy_from_slice(&f32::NAN.to_le_bytes());
        let error = Model::from_bytes(&path, &bytes).err().expect("NaN").to_string();
        assert!(error.contains("NaN"), "{error}");
        // Regression test: a flipped bit in a number changed predictions without an error.
        let mut bytes = whole.clone();
        bytes[last] ^= 1;
        let error = Model::from_bytes(&path, &bytes).err().expect("damaged");
        assert!(matches!(error, ModelError::Hash { .. }) && error.to_string().contains("hint: "), "{error}");
        // A file of an earlier version has no hashes.
        let older = replaced(&replaced(&bytes, "text_sha256", "Text_sha256"), "arrays_sha256", "Arrays_sha256");
        Model::from_bytes(&path, &older).expect("not checked");
        let error = Classifier::load(&dir.path().join("none")).err().expect("no file").to_string();
        assert!(error.contains("none: reading failed"), "{error}");
    }

    /// Regression test: the error was that all cells are equal, with a hint about simulations without noise.
    #[test]
    fn skipping_every_range_bin_is_an_error() {
        let (set, spec) = brief();
        let reference = MapReference::OverNoise { skip_range_bins: 16, most_db: None };
        let error = train(&set, &TrainSpec { reference, ..spec }, &mut |_| {}).err().expect("refused");
        assert!(matches!(error, TrainError::AllSkipped { skipped: 16, range: 16 }), "{error}");
        assert!(error.to_string().contains("skip_range_bins") && error.to_string().contains("hint: "), "{error}");
    }

    #[test]
    fn maps_that_cannot_be_classified_are_refused() {
        let (set, model) = trained();
        let mut classifier = Classifier::new(model);
        let mut map = rdm(&set, 0);
        map.db[5] = f32::NAN;
        map.db[9] = f32::INFINITY;
        let found = classifier.classify(&map);
        assert!(matches!(found, Err(ClassifyError::NonFinite { cells: 2, first: 5, .. })), "{found:?}");
        let mut map = rdm(&set, 0);
        map.db.pop();
        assert!(matches!(classifier.classify(&map), Err(ClassifyError::Shape { .. })));
        let mut map = rdm(&set, 0);
        map.shape.rx = 3;
        assert!(matches!(classifier.classify(&map), Err(ClassifyError::Shape { .. })));
        // Extreme but finite values give an answer or an error, without a panic or NaN.
        for value in [f32::MAX, -f32::MAX, 0.0] {
            let mut map = rdm(&set, 0);
            map.db.fill(value);
            if let Ok(p) = classifier.classify(&map) {
                assert!(p.iter().all(|v| v.is_finite()), "{p:?}");
            }
        }
    }

    fn flat_maps(labels: &[(Occupancy, Split)], level: impl Fn(usize) -> f32) -> Dataset {
        let header = header(16);
        let map = |(index, &(label, split)): (usize, &(Occupancy, Split))| {
            let mut row = ManifestRow::new(Domain::Sim, "flat", "run", &format!("s{index}"), 0, label);
            row.split = Some(split);
            let db = (0..header.shape.cells()).map(|cell| level(index * 1000 + cell)).collect();
            (header.rdm(db, 0), row)
        };
        let maps = labels.iter().enumerate().map(map).collect();
        Dataset::from_maps(header, maps).expect("dataset")
    }

    fn refused(set: &Dataset, spec: &TrainSpec) -> TrainError {
        train(set, spec, &mut |_| {}).err().expect("refused")
    }

    #[test]
    fn data_that_cannot_be_learnt_from_are_refused() {
        use Occupancy::{Empty, One, Two};
        use Split::{Train, Validation};
        let (_, spec) = brief();
        let varied = |k: usize| ((k * 7919) % 101) as f32;
        let all = [(Empty, Train), (One, Train), (Two, Train), (Empty, Validation), (One, Validation)];
        assert!(matches!(refused(&flat_maps(&all, |_| -200.0), &spec), TrainError::Standardise(_)));
        assert!(matches!(refused(&flat_maps(&all[..3], varied), &spec), TrainError::EmptySplit { .. }));
        let same = [(One, Train), (One, Train), (One, Validation)];
        assert!(matches!(refused(&flat_maps(&same, varied), &spec), TrainError::OneClass { class: One }));
        let none = Dataset::from_maps(header(16), vec![]).expect("empty");
        assert!(matches!(refused(&none, &spec), TrainError::EmptySplit { .. }));
    }

    #[test]
    fn a_missing_class_and_batches_of_one_class_are_trained_on() {
        use Occupancy::{Empty, One};
        use Split::{Train, Validation};
        let set = flat_maps(&[(Empty, Train), (One, Train), (Empty, Validation), (Empty, Train)], |k| {
            ((k * 7919) % 101) as f32
        });
        let spec = TrainSpec { batch_size: 1, ..brief().1 };
        let outcome = train(&set, &spec, &mut |_| {}).expect("training");
        assert_eq!(outcome.validation.absent, [One, Occupancy::Two]);
        assert!(outcome.test.is_none());
        for expected in [
            "train split has no map of class 'two'",
            "validation split has no map of class 'one'",
            "test split is empty",
        ] {
            assert!(outcome.warnings.iter().any(|w| w.contains(expected)), "{expected}: {:?}", outcome.warnings);
        }
    }

    /// Regression test: splits of the dataset were ignored without a warning if a sequence is held out, and classes without a test map
    /// were not named.
    #[test]
    fn a_sequence_that_is_held_out_overrides_the_splits_with_a_warning() {
        let (set, spec) = brief();
        assert_eq!(training_warnings(&set, &spec).expect("splits"), [""; 0]);
        let split = SplitSpec { held_out: Some(set.rows()[0].sequence.clone()), ..SplitSpec::default() };
        let warnings = training_warnings(&set, &TrainSpec { split, ..spec }).expect("splits").join("\n");
        for expected in
            ["splits that 54 of 54 maps have in the dataset do not count", "test split has no map of class 'two'"]
        {
            assert!(warnings.contains(expected), "{expected}: {warnings}");
        }
    }

    /// Regression test: a rule that was not used, because all maps have a split, was ignored without a warning, and the card named it.
    #[test]
    fn a_rule_is_not_used_where_the_dataset_fixes_all_splits() {
        let (set, spec) = brief();
        let rule = SplitSpec { seed: 9, test: 0.6, ..SplitSpec::default() };
        let warnings = |split: SplitSpec| {
            training_warnings(&set, &TrainSpec { split, ..spec.clone() }).expect("splits").join("\n")
        };
        let expected =
            "all 54 maps have a split in the dataset, so seed and shares of the settings' rule (split) do not count";
        let by_rule = warnings(rule.clone());
        assert!(by_rule.contains(expected), "{by_rule}");
        let by_subject = warnings(SplitSpec { by: SplitBy::Subject, ..SplitSpec::default() });
        assert!(!by_subject.contains("do not count"), "{by_subject}");
        // Groups count in other datasets too.
        let by_seed = SplitSpec { by: SplitBy::Seed, ..SplitSpec::default() };
        let card =
            train(&set, &TrainSpec { split: by_seed.clone(), ..spec.clone() }, &mut |_| {}).expect("trains").model.card;
        assert_eq!(card.split, Some(by_seed));
        let card =
            train(&set, &TrainSpec { split: rule.clone(), ..spec.clone() }, &mut |_| {}).expect("trains").model.card;
        assert_eq!(card.split, None);
        // A dataset that was divided by this rule needs no warning, and one that is not divided needs the rule.
        let with_splits = |splits: Option<Vec<Split>>| {
            let maps = (0..set.len()).map(|index| {
                let mut row = set.rows()[index].clone();
                row.split = splits.as_ref().map(|splits| splits[index]);
                (set.header().rdm(set.map(index).expect("a map"), row.frame), row)
            });
            Dataset::from_maps(set.header().clone(), maps.collect()).expect("a dataset")
        };
        let undivided = with_splits(None);
        let divided = with_splits(Some(undivided.splits(&rule).expect("splits")));
        for set in [&undivided, &divided] {
            let warnings = training_warnings(set, &TrainSpec { split: rule.clone(), ..spec.clone() }).expect("splits");
            assert!(!warnings.join("\n").contains("do not count"), "{warnings:?}");
        }
        let card = train(&undivided, &TrainSpec { split: rule.clone(), ..spec.clone() }, &mut |_| {})
            .expect("trains")
            .model
            .card;
        assert_eq!(card.split, Some(rule));
    }

    /// Regression test: the other recordings of a subject, scene or seed were held out with the named one without a warning.
    #[test]
    fn sequences_that_are_held_out_with_their_group_are_named() {
        let (set, spec) = brief();
        let maps = (0..set.len()).map(|index| {
            let mut row = set.rows()[index].clone();
            let is_subject_a = ["s1", "s4", "s7"].contains(&row.sequence.as_str());
            row.subject = Some(if is_subject_a { "a".to_owned() } else { "b".to_owned() });
            (set.header().rdm(set.map(index).expect("a map"), row.frame), row)
        });
        let set = Dataset::from_maps(set.header().clone(), maps.collect()).expect("a dataset");
        let warnings = |by: SplitBy, held_out: &str| {
            let split = SplitSpec { by, held_out: Some(held_out.to_owned()), ..SplitSpec::default() };
            training_warnings(&set, &TrainSpec { split, ..spec.clone() }).expect("splits").join("\n")
        };
        let expected = "sequence 's4' is held out with the other sequences of its subject: 's1', 's7'";
        let by_subject = warnings(SplitBy::Subject, "s4");
        assert!(by_subject.contains(expected), "{by_subject}");
        let by_sequence = warnings(SplitBy::Sequence, "s4");
        assert!(!by_sequence.contains("other sequences of its"), "{by_sequence}");
    }

    /// Regression test: a damaged map of the test split was found only after the training, which was lost.
    #[test]
    fn a_damaged_test_map_is_found_before_the_first_epoch() {
        let (set, spec) = brief();
        let dir = tempfile::tempdir().expect("folder");
        let path = dir.path().join("set");
        merge(&[(dir.path(), &set)], &path, None).expect("written");
        assert_eq!(set.rows().last().and_then(|row| row.split), Some(Split::Test));
        let shard = path.join("maps-00000.npy");
        let mut bytes = std::fs::read(&shard).expect("read");
        let last = bytes.len() - 4;
        bytes[last] ^= 1;
        std::fs::write(&shard, bytes).expect("write");
        let damaged = Dataset::open(&path).expect("opens");
        let error = train(&damaged, &spec, &mut |_| panic!("an epoch")).err().expect("refused");
        assert!(matches!(error, TrainError::Dataset(DatasetError::Hash { index: 53, .. })), "{error}");
    }

    #[test]
    fn a_divergence_names_layer_and_step() {
        let (set, spec) = brief();
        let error = refused(&set, &TrainSpec { learning_rate: 1e30, warm_up_steps: 1, ..spec });
        let TrainError::NonFinite { what, step, .. } = &error else { panic!("{error}") };
        // The log counts starts from 1, and so does the message.
        assert!(error.to_string().contains("not finite at start 1, "), "{error}");
        assert!(*step >= 1 && ["conv", "fc", "head"].iter().any(|layer| what.contains(layer)), "{error}");
    }

    #[test]
    fn descriptors_of_other_maps_than_over_noise_are_refused() {
        let (set, spec) = brief();
        for network in descriptor_networks() {
            let described = descriptors(network, spec.clone());
            for (bad, found) in [
                (TrainSpec { reference: MapReference::Absolute, ..described.clone() }, "absolute"),
                (TrainSpec { transposed: true, ..described.clone() }, "transposed"),
                (TrainSpec { label_leaking_cells: true, ..described.clone() }, "scene and class"),
            ] {
                let error = refused(&set, &bad);
                assert!(matches!(error, TrainError::Maps(_)), "{error}");
                assert!(error.to_string().contains(found) && error.to_string().contains("hint: "), "{error}");
            }
            let mut model = train(&set, &described, &mut |_| {}).expect("training").model;
            let dir = tempfile::tempdir().expect("folder");
            let path = dir.path().join("model.safetensors");
            let mut reload = |change: &dyn Fn(&mut Model)| {
                let original = model.card.clone();
                change(&mut model);
                model.save(&path).expect("save");
                model.card = original;
                Model::load(&path)
            };
            assert!(reload(&|_| {}).is_ok());
            let changes: [fn(&mut Model); 3] = [
                |model| model.card.standardisation.mean_db = 1.0,
                |model| model.card.standardisation.sigma_db = 2.0,
                |model| model.card.standardisation.reference = MapReference::Absolute,
            ];
            for change in changes {
                let error = reload(&change).err().expect("refused");
                assert!(
                    matches!(&error, ModelError::Inconsistent { what, .. } if what == "standardisation"),
                    "{error}"
                );
            }
        }
    }

    /// Augmented echoes would not move as the motion of their maps says.
    #[test]
    fn augmentations_that_motion_does_not_follow_are_refused() {
        let set = of_motion_alone();
        for (augmentation, expected) in [
            (all_augmentations(), "superpose"),
            (Augmentation { velocity_stretch: 0.1, ..Augmentation::default() }, "velocity_stretch"),
            (Augmentation { sway: Some(Sway::default()), ..Augmentation::default() }, "sway"),
        ] {
            for network in descriptor_networks() {
                let spec = descriptors(network, TrainSpec { augmentation: augmentation.clone(), ..quick() });
                let error = refused(&set, &spec);
                assert!(matches!(&error, TrainError::UnfollowedMotion { setting } if *setting == expected), "{error}");
            }
        }
    }

    /// Asserts that changes of echoes need levels over noise: with another reference, the level of an echo is unknown.
    #[test]
    fn augmentations_of_echoes_need_maps_over_noise() {
        let (set, spec) = brief();
        let error = refused(&set, &TrainSpec { augmentation: all_augmentations(), ..spec });
        assert!(matches!(error, TrainError::NeedsOverNoise { setting: "superpose" }), "{error}");
        assert!(error.to_string().contains("hint: add [reference.over_noise]"), "{error}");
    }
}
