use super::spec::named_specs;
use super::*;
use crate::layer::KernelLevel;
use candle_core::{Device, Tensor};
use rand::Rng;

fn maps(batch: usize, range: usize, doppler: usize) -> Tensor {
    let mut rng = crate::random::stream(5, "maps", 0);
    let cells: Vec<f32> = (0..batch * range * doppler).map(|_| rng.random_range(-1.0..1.0)).collect();
    Tensor::from_vec(cells, (batch, range, doppler), &Device::Cpu).expect("tensor")
}

/// Numbers of parameters that the paper states, those of torchvision, and sums by hand for the paper's controls and descriptors.
#[test]
fn every_network_has_the_known_number_of_parameters() {
    const BEFORE_HEAD: usize = 66_447 - 4 - 9;
    let expected = [
        ("hqnn", 66_447),
        ("estimator_matched", 66_443),
        ("dequantization", 66_449),
        ("squashed_linear", BEFORE_HEAD + 9),
        ("squashed_dequantization", BEFORE_HEAD + 6 + 9),
        ("trigonometric", BEFORE_HEAD + 5 * 3 + 3),
        ("frozen_angles", 66_447 - 4),
        ("doppler_net", 2_558_307),
        ("resnet18", 11_171_779),
        ("efficientnet_b0", 4_010_815),
        ("efficientnet_b0_rgb", 4_011_391),
        ("descriptor_linear", 63 * 3 + 3),
        ("descriptor_hqnn", 63 * 2 + 2 + 4 + 9),
    ];
    let found: Vec<(String, usize)> =
        named_specs().into_iter().map(|(name, spec)| (name, spec.parameter_count())).collect();
    assert_eq!(found, expected.map(|(name, parameters)| (name.to_owned(), parameters)));
}

/// Errors name a network as files and commands do. Regression test: they printed the names of the code.
#[test]
fn kinds_are_written_as_users_type_them() {
    for kind in NetworkKind::ALL {
        let name = kind.to_string();
        assert_eq!(serde_json::json!(kind), name.as_str());
        assert_eq!(NetworkSpec::named(&name).map(|spec| spec.kind), Some(kind));
        assert_eq!(name.starts_with("descriptor_"), kind.reads_descriptors(), "help texts and docs say so: {name}");
    }
    let error = kind::UnreadableMaps { network: NetworkKind::DescriptorLinear, found: "they are transposed" };
    assert!(error.to_string().starts_with("descriptor_linear describes maps"), "{error}");
}

/// [`NetworkKind::ALL`] has every kind, so that each can be trained by its name.
#[test]
fn every_kind_is_listed() {
    let schema = serde_json::json!(schemars::schema_for!(NetworkKind));
    let variants = schema["oneOf"].as_array().expect("variants").iter().map(|variant| variant["const"].clone());
    assert_eq!(variants.collect::<Vec<_>>(), NetworkKind::ALL.map(|kind| serde_json::json!(kind)));
}

/// ResNet-18 is known for 1.82 G multiply-adds at 3 x 224 x 224; ours differ by the stem's two channels and the classes.
#[test]
fn multiply_adds_are_the_known_ones() {
    let resnet = NetworkSpec::named("resnet18").expect("known").multiply_adds(224, 224);
    let stem = 2 * 64 * 49 * 112 * 112;
    assert_eq!(resnet + stem + 997 * 512, 1_814_073_344);
    let b0 = NetworkSpec::named("efficientnet_b0_rgb").expect("known").multiply_adds(224, 224);
    assert!((b0 as f64 + 997.0 * 1280.0 - 385.8e6).abs() < 2e6, "{b0}");
    let hqnn = NetworkSpec::named("hqnn").expect("known").multiply_adds(128, 128);
    assert!((21.0e6..22.0e6).contains(&(hqnn as f64)), "{hqnn}");
}

#[test]
fn folding_the_feature_scale_leaves_the_answer_alone() {
    let spec = NetworkSpec { kind: NetworkKind::Hqnn, pooled: [3, 4], head: Head::default() };
    let mut network = Network::initialise(&spec, 5, 0, KernelLevel::detect()).expect("network");
    let input = maps(2, 40, 48);
    let mut rng = crate::random::stream(5, "features", 0);
    let features = 32 * 3 * 4;
    network.parameters_mut().set_normalisation(
        "features",
        Normalisation {
            mean: (0..features).map(|_| rng.random_range(0.0..1.0)).collect(),
            sigma: (0..features).map(|_| rng.random_range(0.5..2.0)).collect(),
        },
    );
    let latent =
        |n: &Network| n.latent(&input).and_then(|l| l.expect("latent").flatten_all()?.to_vec1::<f32>()).expect("run");
    let before = latent(&network);
    network.fold_features().expect("fold");
    for (a, b) in before.iter().zip(latent(&network)) {
        assert!((a - b).abs() < 1e-4 * a.abs().max(1.0), "{a} {b}");
    }
}

/// Every network has logits, and every trained number that they depend on has a gradient.
#[test]
fn every_network_runs_and_learns() {
    for (name, spec) in &named_specs() {
        let network = Network::initialise(spec, 3, 0, KernelLevel::detect()).expect(name);
        let [rows, columns] = spec.kind.input_size([64, 64]);
        let input = maps(3, rows, columns);
        let output = network.graph().output;
        let mut values = network.run(&input, output, Mode::Training { seed: 1, step: 1, penalty: 0.0 }).expect(name);
        let logits = values.take(output).expect(name);
        assert_eq!(logits.dims(), [3, 3], "{name}");
        let gradients = logits.sqr().and_then(|t| t.sum_all()).and_then(|t| t.backward()).expect(name);
        for Parameter { name: parameter, variable } in network.trained() {
            let found = gradients.get(variable).is_some();
            assert_eq!(found, !parameter.starts_with("warm_up."), "{name}: {parameter}");
        }
        assert_eq!(network.logits(&input).expect(name).dims(), [3, 3]);
    }
}

/// Training finds the layers of every network by their names.
#[test]
fn layers_that_training_looks_for_are_there() {
    for (name, spec) in named_specs() {
        let graph = spec.graph();
        let has = |layer: &str| graph.value(layer).is_some();
        let (reads_descriptors, has_latent) = (spec.kind.reads_descriptors(), spec.kind.has_latent());
        assert_eq!(graph.nodes.iter().any(|node| node.layer == Layer::Flatten), reads_descriptors, "{name}");
        for (layer, expected) in [
            (names::DESCRIPTORS, reads_descriptors),
            (names::POOL, has_latent && !reads_descriptors),
            (names::FEATURES, has_latent || reads_descriptors),
            (names::LATENT, has_latent),
            (names::WARM_UP, has_latent),
        ] {
            assert_eq!(has(layer), expected, "{name}: {layer}");
        }
        assert!(has(names::LATENT_DENSE) || !has_latent, "{name}");
    }
}

/// The circuit is a linear function of the trigonometric features, so a head on them can represent it.
#[test]
fn the_trigonometric_head_can_represent_the_circuit() {
    let level = KernelLevel::detect();
    let circuit = Network::initialise(&NetworkSpec::named("hqnn").expect("known"), 3, 0, level).expect("network");
    let spec = NetworkSpec::named("trigonometric").expect("known");
    let mut values = circuit.values().expect("values");
    let theta: Vec<f64> = values["circuit.theta"].iter().map(|&v| f64::from(v)).collect();
    let [(s0, c0), (s1, c1), (s2, c2), (s3, c3)] = [0, 1, 2, 3].map(|k| f64::sin_cos(theta[k]));
    let zi = [c3 * c0 * s1, c3 * s0 * c1, c3 * s0 * s1, -s3 * c1, 0.0];
    let iz = [s2 * s0 * c1, s2 * c0 * s1, -s2 * c0 * c1, 0.0, -c2 * s0];
    let head = values["head.weight"].clone();
    let folded = (0..3).flat_map(|class| {
        let (a, b) = (f64::from(head[2 * class]), f64::from(head[2 * class + 1]));
        (0..5).map(move |k| (a * zi[k] + b * iz[k]) as f32).collect::<Vec<_>>()
    });
    values.insert("head.weight".to_owned(), folded.collect());
    let twin = Network::from_values(&spec, &values, level).expect("network");
    let logits = |n: &Network| n.logits(&maps(4, 32, 32)).and_then(|t| t.flatten_all()?.to_vec1::<f32>()).expect("run");
    for (a, b) in logits(&circuit).iter().zip(logits(&twin)) {
        assert!((a - b).abs() < 1e-5, "{a} {b}");
    }
}

mod hard_cases {
    use super::*;

    #[test]
    fn maps_that_are_too_small_are_named() {
        let spec = NetworkSpec::named("doppler_net").expect("known");
        assert_eq!(spec.too_small_for(16, 64).as_deref(), Some("pool5"));
        assert_eq!(spec.too_small_for(32, 32), None);
    }

    /// Regression test: training continued without the layer, and measured the map instead or fitted nothing.
    #[test]
    fn a_layer_that_training_does_not_find_is_named() {
        let spec = NetworkSpec::named("resnet18").expect("known");
        let network = Network::initialise(&spec, 3, 0, KernelLevel::detect()).expect("network");
        let error = network.value_of(names::LATENT).expect_err("missing").to_string();
        assert!(error.starts_with("resnet18 has no layer named latent") && error.contains("hint: "), "{error}");
    }

    #[test]
    fn a_missing_or_short_array_is_named() {
        let spec = NetworkSpec::named("hqnn").expect("known");
        let network = Network::initialise(&spec, 3, 0, KernelLevel::detect()).expect("network");
        let mut values = network.values().expect("values");
        values.remove("fc2.bias");
        let error = Network::from_values(&spec, &values, KernelLevel::detect()).err().expect("refused");
        assert!(error.to_string().contains("fc2.bias"), "{error}");
        values.insert("fc2.bias".to_owned(), vec![0.0; 3]);
        let error = Network::from_values(&spec, &values, KernelLevel::detect()).err().expect("refused");
        assert!(error.to_string().contains("fc2.bias has 3 values"), "{error}");
    }

    /// Logits are finite where the scaled sigmoid saturates.
    #[test]
    fn logits_of_a_saturated_latent_are_finite() {
        let spec = NetworkSpec::named("hqnn").expect("known");
        let network = Network::initialise(&spec, 3, 0, KernelLevel::detect()).expect("network");
        for scale in [1e-30f32, 1e4, 1e30] {
            let weight = network.parameters().numbers("fc2.weight").expect("weight");
            let weight: Vec<f32> = weight.iter().map(|w| w.signum() * scale).collect();
            network.parameters().set_numbers("fc2.weight", &weight).expect("set");
            let logits: Vec<f32> =
                network.logits(&maps(1, 16, 16)).and_then(|t| t.flatten_all()?.to_vec1()).expect("run");
            assert!(logits.iter().all(|v| v.is_finite()), "{scale}: {logits:?}");
        }
    }

    #[test]
    fn first_non_finite_names_the_layer_of_a_nan() {
        let spec = NetworkSpec::named("hqnn").expect("known");
        let network = Network::initialise(&spec, 3, 0, KernelLevel::detect()).expect("network");
        network.parameters().set_numbers("fc1.bias", &[f32::NAN; 64]).expect("set");
        let values = network
            .run(&maps(1, 16, 16), network.graph().output, Mode::Training { seed: 1, step: 1, penalty: 0.0 })
            .expect("run");
        assert_eq!(values.first_non_finite().expect("look"), Some("fc1"));
    }
}
