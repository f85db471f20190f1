//! Model files, ONNX files and specs with deliberate damage. They are refused with a reason, without a panic, and
//! without allocations for sizes that are only claimed.

mod hard_cases {
    use std::path::{Path, PathBuf};

    use radome_models::layer::KernelLevel;
    use radome_models::network::{Head, Network, Placement};
    use radome_models::quantum::CircuitSpec;
    use radome_models::standardise::MapReference;
    use radome_models::study::StudySpec;
    use radome_models::train::Superpose;
    use radome_models::{MODEL_LIMIT_BYTES, Model, ModelCard, ModelError, TrainSpec, onnx};
    use safetensors::SafeTensors;

    /// Model of minimum size.
    fn small() -> Model {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fixtures/models/paper-hqnn.safetensors");
        let card = ModelCard::load(&path).expect("a fixture");
        let card = ModelCard { pooled: [1, 1], latent: Default::default(), ..card };
        let network = Network::initialise(&card.network_spec(), 1, 0, KernelLevel::detect()).expect("a network");
        Model { card, network }
    }

    fn saved(folder: &Path) -> (PathBuf, Vec<u8>) {
        let path = folder.join("a.safetensors");
        small().save(&path).expect("writes");
        let bytes = std::fs::read(&path).expect("reads");
        (path, bytes)
    }

    #[test]
    fn models_cut_off_anywhere_are_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let (path, whole) = saved(folder.path());
        let (header, _) = SafeTensors::read_metadata(&whole).expect("a header");
        for length in (0..header + 8).chain((header + 8..whole.len()).step_by(997)).chain([whole.len() - 1]) {
            let error = Model::from_bytes(&path, &whole[..length]).err().expect("cut off");
            assert!(matches!(error, ModelError::NotSafetensors { .. }), "{length}: {error}");
            assert!(error.to_string().contains("a.safetensors: expected"), "{length}: {error}");
        }
        let mut header = whole.clone();
        for length in [u64::MAX, 1 << 62, 100_000_001, whole.len() as u64] {
            header[..8].copy_from_slice(&length.to_le_bytes());
            assert!(matches!(Model::from_bytes(&path, &header), Err(ModelError::NotSafetensors { .. })), "{length}");
        }
    }

    /// Asserts that every number in a card is checked before use, since the card determines the sizes of the network.
    #[test]
    fn cards_with_numbers_beyond_any_network_are_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let (path, _) = saved(folder.path());
        let card = serde_json::to_value(small().card).expect("JSON");
        let load_error = |card: String| {
            let metadata = [("radome".to_owned(), card)].into_iter().collect();
            let none: [(&str, safetensors::tensor::TensorView); 0] = [];
            let bytes = safetensors::serialize(none, Some(metadata)).expect("a file");
            Model::from_bytes(&path, &bytes).err().expect("refused")
        };
        let with = |change: &dyn Fn(&mut serde_json::Value)| {
            let mut card = card.clone();
            change(&mut card);
            load_error(card.to_string()).to_string()
        };
        let most = serde_json::json!(u64::MAX);
        let refused = |pointer: &str, value: &serde_json::Value, expected: &str| {
            let error = with(&|card| *card.pointer_mut(pointer).expect(pointer) = value.clone());
            assert!(error.contains(expected), "{pointer}: {error}");
        };
        refused("/pooled/0", &most, "pooled");
        refused("/pooled/1", &serde_json::json!(0), "pooled");
        refused("/input_shape/1", &most, "input_shape");
        refused("/waveform/request/samples_per_chirp", &most, "at most 32768");
        refused("/waveform/request/chirps_per_frame", &most, "at most 32768");
        refused("/rdm_spec/slow_time", &serde_json::json!({ "frames": { "frames": u64::MAX } }), "at most 32768");
        refused("/temperature", &serde_json::json!(0.0), "temperature: expected a finite number above 0, found 0");
        let sigma_db = "standardisation.sigma_db: expected a finite number above 0, found -1";
        refused("/standardisation/sigma_db", &serde_json::json!(-1.0), sigma_db);
        let latent = serde_json::json!({ "mean": [0.5, 0.5], "sigma": [0.5, 0.0] });
        refused(
            "/latent",
            &latent,
            "latent: expected a finite mean, and a finite sigma above 0, found mean 0.5, sigma 0",
        );
        let cell = serde_json::json!({ "scene": "hall", "class": "one", "mean_db": 0.0, "sigma_db": 0.0 });
        let error = with(&|card| card["standardisation"]["label_leaking_cells"] = serde_json::json!([cell]));
        assert!(error.contains("standardisation of scene hall with class one: expected a finite mean"), "{error}");
        // Its maps have 128 range bins.
        let reference = serde_json::json!({ "over_noise": { "skip_range_bins": 128 } });
        refused("/standardisation/reference", &reference, "fewer than the 128 range bins of a map, found 128");
        refused("/smoothing", &serde_json::json!({ "dwell_s": 0.0 }), "smoothing.dwell_s");
        refused("/latent", &serde_json::json!({ "mean": vec![0.5; 1000], "sigma": vec![0.5; 1000] }), "latent");
        for (key, value) in
            [("qubits", 1_000_000_000u64), ("depth", u64::MAX), ("repetitions", u64::MAX), ("qubits", 0)]
        {
            let head = serde_json::json!({ "kind": "circuit", "circuit": { key: value } });
            let error = with(&|card| card["head"] = head.clone());
            assert!(error.contains(&format!("a.safetensors: head.circuit: {key} is {value}, expected ")), "{error}");
        }
        let deep = "[".repeat(100_000);
        assert!(matches!(load_error(format!("{{\"format_version\": {deep}")), ModelError::Card { .. }));
    }

    #[test]
    fn irregular_and_too_large_model_files_are_not_read() {
        let folder = tempfile::tempdir().expect("a folder");
        for name in ["a.safetensors", "a.onnx"] {
            let path = folder.path().join(name);
            // Sparse file of this length, which takes no space on the disk.
            std::fs::File::create(&path).and_then(|file| file.set_len(MODEL_LIMIT_BYTES + 1)).expect("made");
            let error = ModelCard::load(&path).expect_err("too large").to_string();
            assert!(error.contains(name) && error.contains("at most") && error.contains("hint: "), "{error}");
        }
        let error = Model::load(folder.path()).err().expect("a folder").to_string();
        assert!(error.contains("not a regular file"), "{error}");
        #[cfg(target_os = "linux")]
        {
            let error = Model::load(Path::new("/dev/zero")).err().expect("a device").to_string();
            assert!(error.contains("not a regular file"), "{error}");
        }
    }

    #[test]
    fn onnx_files_with_lengths_beyond_their_end_are_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.onnx");
        let load = |bytes: &[u8]| {
            std::fs::write(&path, bytes).expect("writes");
            ModelCard::load(&path)
        };
        let whole = onnx::export(&small()).expect("exports");
        assert_eq!(load(&whole).expect("whole"), small().card);
        for length in (0..whole.len()).step_by(61).chain([whole.len() - 1]) {
            let error = load(&whole[..length]).expect_err("cut off");
            assert!(matches!(error, ModelError::NotOnnx { .. } | ModelError::NoCard { .. }), "{length}: {error}");
        }
        let hostile: [&[u8]; 6] = [
            // Graph and array of 2^64 - 1 bytes, a number without an end, and invalid wire types.
            &[0x3A, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0x01],
            &[0x3A, 0x0B, 0x2A, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0x01],
            &[0xFF; 64],
            &[0x3B, 0x3C],
            &[0x3E, 0x00],
            &[0x39, 0x00, 0x00],
        ];
        for bytes in hostile {
            let error = load(bytes).expect_err("refused");
            assert!(matches!(error, ModelError::NotOnnx { .. } | ModelError::NoCard { .. }), "{bytes:?}: {error}");
        }
        // Millions of empty messages, none of which is stored.
        let mut many = vec![0x3A, 0x80, 0x80, 0x80, 0x02];
        many.extend([0x2A, 0x00].repeat(2 << 20));
        assert!(matches!(load(&many), Err(ModelError::NoCard { .. })));
    }

    #[test]
    fn settings_out_of_range_are_named() {
        let refused = |change: &dyn Fn(&mut TrainSpec), expected: &str| {
            let mut spec = TrainSpec::default();
            change(&mut spec);
            let error = spec.check().expect_err(expected).to_string();
            assert!(error.contains(expected), "{error}");
        };
        assert!(TrainSpec::default().check().is_ok());
        for count in [0, usize::MAX] {
            refused(&|spec| spec.epochs = count, "epochs");
            refused(&|spec| spec.batch_size = count, "batch_size");
        }
        refused(&|spec| spec.learning_rate = f64::NAN, "learning_rate");
        // Regression test: the error said twice what was expected.
        let circuit = CircuitSpec { qubits: 13, ..Default::default() };
        let head = Head::Circuit { circuit, frozen: false, placement: Placement::Latent };
        let error = TrainSpec { head, ..TrainSpec::default() }.check().expect_err("qubits").to_string();
        assert_eq!(error, "training: head.circuit: qubits is 13, expected 1 to 12");
        refused(&|spec| spec.start_epochs = 0, "start_epochs");
        refused(&|spec| spec.linear_epochs = Some(99), "linear_epochs");
        refused(&|spec| spec.latent_penalty = -1.0, "latent_penalty");
        refused(&|spec| spec.smoothing.weight = Some(0.5), "smoothing.weight");
        let over_noise = |most_db| MapReference::OverNoise { skip_range_bins: 2, most_db };
        // Regression test: a bound below all noise made all cells equal, of which the error blamed a simulation without noise.
        for most_db in [-1.0, 1e-9, 1e9, f32::NAN] {
            refused(&|spec| spec.reference = over_noise(Some(most_db)), "most_db is");
        }
        let mut bounded = TrainSpec { reference: over_noise(Some(3.0)), ..TrainSpec::default() };
        assert!(bounded.check().is_ok());
        bounded.reference = over_noise(Some(50.0));
        assert!(bounded.check().is_ok());
        let leaks_changed_labels = |spec: &mut TrainSpec| {
            (spec.reference, spec.label_leaking_cells) = (over_noise(None), true);
            spec.augmentation.superpose = Some(Superpose { probability: 0.3 });
        };
        refused(&leaks_changed_labels, "label_leaking_cells");
        refused(&|spec| spec.starts = u64::MAX, "starts");
        refused(&|spec| spec.pooled = [usize::MAX, 1], "pooled");
        // Regression test: a study built its dataset before this error.
        refused(&|spec| spec.split.test = 0.9, "split: validation 0.15 and test 0.9");

        let study = |variants: usize, seeds: usize, rates: usize| -> StudySpec {
            let variant = |k| serde_json::json!({ "name": format!("v{k}"), "network": "hqnn" });
            let variants: Vec<serde_json::Value> = (0..variants).map(variant).collect();
            let (seeds, rates): (Vec<usize>, Vec<f64>) = ((0..seeds).collect(), vec![1e-3; rates]);
            let spec =
                serde_json::json!({ "title": "many", "variants": variants, "seeds": seeds, "learning_rates": rates });
            serde_json::from_value(spec).expect("a spec")
        };
        assert!(study(3, 5, 2).check().is_ok());
        for (many, expected) in [(study(1001, 1, 1), "variants"), (study(100, 10_000, 2), "1000000 trainings")] {
            let error = many.check().expect_err(expected).to_string();
            assert!(error.contains(expected), "{error}");
        }
        // Regression test: the first training was lost, because noisy maps were not finite.
        let mut noisy = study(1, 1, 1);
        noisy.snr_db = vec![10.0, -800.0];
        let error = noisy.check().expect_err("infinite noise").to_string();
        assert!(error.contains("snr_db is -800, expected -100 to 100"), "{error}");
        let mut without_epochs = study(1, 1, 1);
        without_epochs.train.epochs = 0;
        assert!(without_epochs.check().is_err());
    }
}
