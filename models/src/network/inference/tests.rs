use super::*;
use crate::layer::KernelLevel;
use crate::network::{Head, Mode, NetworkSpec, networks};
use crate::quantum::{CircuitSpec, Encoding};
use crate::train::Trainer;
use candle_core::{Device, Tensor};
use rand::Rng;

/// Shape of the input of a network for a batch of maps.
fn input_shape(spec: &NetworkSpec, [batch, range, doppler]: [usize; 3]) -> [usize; 3] {
    let [rows, columns] = spec.kind.input_size([range, doppler]);
    [batch, rows, columns]
}

/// Inputs, each stronger than the one before, so that logits differ.
fn inputs([batch, rows, columns]: [usize; 3]) -> Vec<f32> {
    let mut rng = crate::random::stream(5, "maps", 0);
    let strength = |index: usize| 0.5 + (index / (rows * columns)) as f32;
    (0..batch * rows * columns).map(|index| strength(index) * rng.random_range(-1.0..1.0)).collect()
}

/// Numbers of a network after a few steps of training, so that its normalisations are not trivial and its logits differ.
fn trained_values(spec: &NetworkSpec) -> std::collections::BTreeMap<String, Vec<f32>> {
    let mut trainer = Trainer::new(spec, 3, 1e-3, KernelLevel::detect()).expect("trainer");
    let (maps, labels) = Trainer::random_inputs(spec, 6, 32, 32).expect("inputs");
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

fn network(spec: &NetworkSpec, values: &std::collections::BTreeMap<String, Vec<f32>>, level: KernelLevel) -> Network {
    let mut network = Network::from_values(spec, values, level).expect("network");
    if spec.kind.has_latent() {
        let width = spec.head.width();
        // Constants that spread the latent over the scaled sigmoid's range.
        let shape = input_shape(spec, [2, 32, 32]);
        let input = Tensor::from_vec(inputs(shape), &shape[..], &Device::Cpu).expect("tensor");
        let latent = network.latent(&input).expect("latent").and_then(|l| l.to_vec2::<f32>().ok()).expect("two rows");
        let of = |f: fn(f32, f32) -> f32| (0..width).map(|k| f(latent[0][k], latent[1][k])).collect();
        let (mean, sigma) = (of(|a, b| 0.4 * a + 0.6 * b), of(|a, b| 2.0 * (a - b).abs() + 1e-6));
        network.set_latent_constants(Normalisation { mean, sigma });
    }
    network
}

fn reference(network: &Network, maps: &[f32], shape: [usize; 3]) -> Vec<f32> {
    let input = Tensor::from_slice(maps, &shape[..], &Device::Cpu).expect("tensor");
    let output = network.graph().output;
    let mut values = network.run(&input, output, Mode::Evaluation).expect("run");
    values.take(output).and_then(|t| t.flatten_all()?.to_vec1()).expect("logits")
}

fn assert_near(what: &str, ours: &[f32], expected: &[f32]) {
    assert_eq!(ours.len(), expected.len(), "{what}");
    for (a, b) in ours.iter().zip(expected) {
        assert!((a - b).abs() < 1e-4 * b.abs().max(1.0), "{what}: {ours:?}, expected {expected:?}");
    }
}

fn specs() -> Vec<(String, NetworkSpec)> {
    let named = |name: String| (name.clone(), NetworkSpec::named(&name).expect("known"));
    let mut specs: Vec<_> = networks().into_iter().map(|network| named(network.name)).collect();
    let circuit = |circuit, placement| NetworkSpec::with_head(Head::Circuit { circuit, frozen: false, placement });
    use crate::network::Placement::{Beside, Front};
    let angle = CircuitSpec { qubits: 3, encoding: Encoding::Angle, depth: 2, ..Default::default() };
    specs.push(("beside".to_owned(), circuit(angle, Beside)));
    specs.push(("front".to_owned(), circuit(CircuitSpec { qubits: 4, repetitions: 2, ..Default::default() }, Front)));
    specs
}

/// Folded and fused steps agree with the separate layers.
#[test]
fn prepared_networks_agree_with_the_networks() {
    for (name, spec) in specs() {
        let values = trained_values(&spec);
        for level in KernelLevel::ALL.into_iter().filter(|level| level.available() == *level) {
            let network = network(&spec, &values, level);
            let mut inference = Inference::new(&network).expect("prepared");
            // Shapes in this order reuse buffers that were larger before.
            for shape in [[1, 128, 128], [5, 64, 61], [2, 33, 40], [1, 32, 32], [2, 64, 61]] {
                let shape = input_shape(&spec, shape);
                let inputs = inputs(shape);
                let logits = inference.logits(&inputs, shape).expect("run");
                assert_near(&format!("{name} {level:?} {shape:?}"), logits, &reference(&network, &inputs, shape));
                assert!(shape[0] == 1 || logits[..3] != logits[3..6], "{name}: {logits:?}");
            }
        }
    }
}

/// Logits have the same bits on one thread or three, alone or in a batch.
#[test]
fn threads_and_batches_change_no_bit() {
    for (name, spec) in specs() {
        let mut inference =
            Inference::new(&network(&spec, &trained_values(&spec), KernelLevel::detect())).expect("prepared");
        let shape @ [_, rows, columns] = input_shape(&spec, [3, 64, 61]);
        let inputs = inputs(shape);
        let mut run = |threads: usize, inputs: &[f32], shape| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
            let logits = pool.install(|| inference.logits(inputs, shape).expect("run").to_vec());
            logits.iter().map(|v| v.to_bits()).collect::<Vec<_>>()
        };
        let batch_bits = run(1, &inputs, shape);
        assert_eq!(batch_bits, run(3, &inputs, shape), "{name}");
        let singles = inputs.chunks_exact(rows * columns);
        let single_bits: Vec<u32> = singles.flat_map(|input| run(2, input, [1, rows, columns])).collect();
        assert_eq!(batch_bits, single_bits, "{name}");
    }
}

mod hard_cases {
    use super::*;

    #[test]
    fn wrong_sizes_are_refused() {
        let spec = NetworkSpec::named("doppler_net").expect("known");
        let mut inference =
            Inference::new(&network(&spec, &trained_values(&spec), KernelLevel::detect())).expect("prepared");
        assert!(inference.logits(&[0.0; 7], [1, 2, 4]).is_err());
        assert!(inference.logits(&[], [0, 32, 32]).is_err());
        let error = inference.logits(&[0.0; 256], [1, 16, 16]).expect_err("too small").to_string();
        assert!(error.contains("conv5"), "{error}");
        // It still works after errors.
        assert_eq!(inference.logits(&inputs([1, 32, 32]), [1, 32, 32]).expect("run").len(), 3);
    }
}
