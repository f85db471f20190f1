//! Descriptors of a map with a linear head or with the HQNN's: baseline classifiers.
//!
//! ```text
//! map [1][range][doppler], dB over noise, and motion
//!   63 descriptors (layer/descriptors.rs), ranges and velocities in bins: the input of the network
//!   standardise by constants, folded into the dense layer behind
//!
//! descriptor_linear                       descriptor_hqnn
//!   linear 63 -> 3: logits       192        linear 63 -> 2: the latent           128
//!                                           standardise by constants, pi * sigmoid
//!                                           two-qubit circuit, <ZI> and <IZ>       4
//!                                           linear 2 -> 3: logits                  9
//! ```
//! Any [`Head`] can follow the latent, as in the HQNN. Bins and metres are equivalent here: the unit of a descriptor is a factor of
//! its weights, and a model's card fixes the axes of its maps.

use super::graph::{Graph, INPUT, Layer, Value};
use super::hqnn::{self, Head};
use super::names;
use crate::layer::DESCRIPTORS;
use crate::metrics::CLASSES;

/// Descriptors and a linear head.
pub(crate) fn linear() -> Graph {
    let (mut g, features) = features();
    g.output = g.add(names::HEAD, Layer::Linear { inputs: DESCRIPTORS, outputs: CLASSES }, &[features]);
    g
}

/// Descriptors, a latent and a head of the HQNN.
pub(crate) fn hqnn(head: &Head) -> Graph {
    let (g, features) = features();
    hqnn::add_latent_and_head(g, features, DESCRIPTORS, false, head)
}

fn features() -> (Graph, Value) {
    let mut g = Graph::default();
    let descriptors = g.add(names::DESCRIPTORS, Layer::Flatten, &[INPUT]);
    let features = g.add(names::FEATURES, Layer::Standardise { width: DESCRIPTORS }, &[descriptors]);
    (g, features)
}

#[cfg(test)]
mod tests {
    use candle_core::{Device, Tensor};
    use radome_dsp::rdm::Motion;
    use rand::Rng;

    use super::*;
    use crate::layer::{KernelLevel, backward};
    use crate::network::{
        Inference, Mode, Network, NetworkKind, NetworkSpec, Normalisation, Parameter, Placement, networks,
    };
    use crate::quantum::{CircuitSpec, Encoding};

    const SHAPE: [usize; 3] = [4, 24, 33];

    /// Shape of a batch of descriptors.
    const INPUT_SHAPE: [usize; 3] = [SHAPE[0], 1, DESCRIPTORS];

    /// Descriptors of [`maps`], with other motion in each.
    fn inputs() -> Vec<f32> {
        let [_, rows, columns] = SHAPE;
        let motion = |k: usize| {
            Motion::from_array([1.0 - 0.2 * k as f32, 0.1, 0.2 * k as f32, 0.3, 0.5, 0.4 * k as f32, 0.2 * k as f32])
        };
        let input =
            |(k, map): (usize, &[f32])| NetworkKind::DescriptorLinear.input(map.to_vec(), Some(motion(k)), columns);
        maps().chunks_exact(rows * columns).enumerate().flat_map(input).collect()
    }

    /// Noise and echoes up to 40 dB, more of them in each map than in the one before.
    fn maps() -> Vec<f32> {
        let mut rng = crate::random::stream(5, "maps", 0);
        let [batch, rows, columns] = SHAPE;
        let mut maps: Vec<f32> = (0..batch * rows * columns).map(|_| rng.random_range(0.0..9.0)).collect();
        for (k, map) in maps.chunks_exact_mut(rows * columns).enumerate() {
            (0..4 * k).for_each(|_| map[rng.random_range(0..rows * columns)] = rng.random_range(10.0..40.0));
        }
        maps
    }

    fn specs() -> Vec<NetworkSpec> {
        let named = |name: &str| NetworkSpec::named(name).expect("known");
        let all = networks().into_iter().map(|network| named(&network.name));
        let of = |head| NetworkSpec { head, ..named("descriptor_hqnn") };
        let circuit = |circuit, placement| of(Head::Circuit { circuit, frozen: false, placement });
        let angle = CircuitSpec { qubits: 3, encoding: Encoding::Angle, depth: 2, ..Default::default() };
        let heads = [
            of(Head::Linear),
            of(Head::Trigonometric),
            circuit(angle.clone(), Placement::Beside),
            circuit(angle, Placement::Front),
        ];
        all.filter(|spec| spec.kind.reads_descriptors()).chain(heads).collect()
    }

    /// A network with its descriptors normalised to order one, as in training.
    fn network(spec: &NetworkSpec) -> Network {
        let mut network = Network::initialise(spec, 3, 0, KernelLevel::detect()).expect("network");
        let value = network.graph().value("descriptors").expect("descriptors");
        let mut values = network.run(&tensor(), value, Mode::Evaluation).expect("run");
        let rows: Vec<Vec<f32>> = values.take(value).and_then(|t| t.to_vec2()).expect("rows");
        drop(values);
        let mean: Vec<f32> = (0..DESCRIPTORS).map(|k| rows.iter().map(|row| row[k] / SHAPE[0] as f32).sum()).collect();
        let largest = |k: usize| rows.iter().fold(0.1f32, |most, row| most.max((row[k] - mean[k]).abs()));
        let sigma = (0..DESCRIPTORS).map(largest).collect();
        network.parameters_mut().set_normalisation("features", Normalisation { mean, sigma });
        network
    }

    fn tensor() -> Tensor {
        Tensor::from_vec(inputs(), &INPUT_SHAPE[..], &Device::Cpu).expect("tensor")
    }

    fn logits(network: &Network) -> Tensor {
        let output = network.graph().output;
        network.run(&tensor(), output, Mode::Evaluation).and_then(|mut values| values.take(output)).expect("run")
    }

    #[test]
    fn multiply_adds_are_few() {
        let [linear, hqnn] = ["descriptor_linear", "descriptor_hqnn"].map(|name| NetworkSpec::named(name).expect(name));
        assert_eq!(linear.multiply_adds(64, 32), 17 * 64 * 32 + 63 * 3);
        assert!(hqnn.multiply_adds(128, 128) < 300_000);
        assert_eq!(linear.too_small_for(1, 1), None);
    }

    /// Compares gradients by all parameters with differences of a weighted sum of the logits.
    #[test]
    fn gradients_are_those_of_differences() {
        const STEP: f32 = 5e-4;
        for spec in specs() {
            let network = network(&spec);
            let output = network.graph().output;
            let weight = |k: usize| 0.3 + ((k * 7) % 5) as f32 * 0.2;
            let weights: Vec<f32> = (0..3 * SHAPE[0]).map(weight).collect();
            let mode = Mode::Training { seed: 1, step: 1, penalty: 0.0 };
            let mut values = network.run(&tensor(), output, mode).expect("run");
            let weighted = Tensor::from_slice(&weights, (SHAPE[0], 3), &Device::Cpu).expect("weights");
            let loss = (values.take(output).expect("logits") * weighted).and_then(|t| t.sum_all()).expect("loss");
            let gradients = backward(&loss).expect("backward");
            let weighted_sum = || {
                let logits: Vec<f32> = logits(&network).flatten_all().and_then(|t| t.to_vec1()).expect("logits");
                logits.iter().zip(&weights).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum::<f64>()
            };
            for Parameter { name, variable } in network.trained().iter().filter(|p| !p.name.starts_with("warm_up.")) {
                let found = gradients.get(variable).expect(name).flatten_all().and_then(|t| t.to_vec1::<f32>());
                let numbers = network.parameters().numbers(name).expect("numbers");
                for (k, found) in found.expect("gradient").into_iter().enumerate() {
                    let at = |by: f32| {
                        let mut moved = numbers.clone();
                        moved[k] += by;
                        network.parameters().set_numbers(name, &moved).expect("set");
                        weighted_sum()
                    };
                    // The kink of a ReLU may lie between the points, and its gradient is that of one side.
                    let (minus, unmoved, plus) = (at(-STEP), at(0.0), at(STEP));
                    let sides = [(unmoved - minus) / f64::from(STEP), (plus - unmoved) / f64::from(STEP)];
                    network.parameters().set_numbers(name, &numbers).expect("set");
                    let tolerance = 1e-2 * sides[0].abs().max(1.0);
                    let (least, most) = (sides[0].min(sides[1]) - tolerance, sides[0].max(sides[1]) + tolerance);
                    let found = f64::from(found);
                    assert!((least..=most).contains(&found), "{:?} {name} {k}: {found} {sides:?}", spec.head);
                }
            }
        }
    }

    /// Logits agree with constants before the dense layer, with constants folded into it, and in prepared inference.
    #[test]
    fn inference_is_the_training_graph() {
        for spec in specs() {
            let mut network = network(&spec);
            let expected: Vec<f32> = logits(&network).flatten_all().and_then(|t| t.to_vec1()).expect("logits");
            assert_ne!(expected[..3], expected[3..6], "{:?}", spec.head);
            let assert_near = |what: &str, found: &[f32]| {
                for (a, b) in found.iter().zip(&expected) {
                    assert!((a - b).abs() < 1e-3 * b.abs().max(1.0), "{what} {:?}: {a} {b}", spec.head);
                }
            };
            let mut inference = Inference::new(&network).expect("prepared");
            assert_near("prepared", inference.logits(&inputs(), INPUT_SHAPE).expect("run"));
            network.fold_features().expect("fold");
            let mut inference = Inference::new(&network).expect("prepared");
            assert_near("folded", inference.logits(&inputs(), INPUT_SHAPE).expect("run"));
            let values = network.values().expect("values");
            let reloaded = Network::from_values(&spec, &values, KernelLevel::detect()).expect("network");
            let mut inference = Inference::new(&reloaded).expect("prepared");
            assert_near("from numbers", inference.logits(&inputs(), INPUT_SHAPE).expect("run"));
        }
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn a_nan_is_found_in_the_descriptors() {
            let network = network(&specs()[0]);
            let mut cells = maps();
            cells[100] = f32::NAN;
            let [_, rows, columns] = SHAPE;
            cells.truncate(rows * columns);
            let described = NetworkKind::DescriptorLinear.input(cells, None, columns);
            let input = Tensor::from_vec(described, (1, 1, DESCRIPTORS), &Device::Cpu).expect("tensor");
            let mode = Mode::Training { seed: 1, step: 1, penalty: 0.0 };
            let values = network.run(&input, network.graph().output, mode).expect("run");
            assert_eq!(values.first_non_finite().expect("look"), Some("descriptors"));
        }

        #[test]
        fn empty_flat_and_enormous_maps_have_finite_answers() {
            for spec in specs() {
                let mut inference = Inference::new(&network(&spec)).expect("prepared");
                for level in [0.0, -300.0, 12.0, 347.0] {
                    for [rows, columns] in [[1, 1], [64, 64], [3, 200]] {
                        let described = spec.kind.input(vec![level; rows * columns], None, columns);
                        let found = inference.logits(&described, [1, 1, DESCRIPTORS]).expect("run");
                        assert!(found.iter().all(|v| v.is_finite()), "{:?} {level}: {found:?}", spec.head);
                    }
                }
            }
        }
    }
}
