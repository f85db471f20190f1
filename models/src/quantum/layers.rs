//! Simulation of any circuit, layer by layer on a state vector, with adjoint gradients (Jones and Gacon 2020, arXiv:2009.02823).
//!
//! The real parts of all amplitudes are stored before the imaginary parts. Rotations and Hadamards, which are real,
//! therefore act on one list of real numbers. The phases of a whole feature map are one Walsh-Hadamard transform, and
//! so are their gradients. The entangler with all its CX is one permutation: full entanglement in Qiskit's order takes
//! bit `q` to the sum of bits `q` and `q - 1`, as Qiskit's `reverse_linear` does.

use super::closed_form::vectorised;
use super::gates::{Circuit, Layer, pairs};
use super::sin_cos::sin_cos;

/// State vectors of one circuit, and work space.
pub(super) struct Workspace {
    qubits: usize,
    /// `[real or imaginary][basis state]`
    state: Vec<f64>,
    /// State with the observable applied, propagated backwards.
    adjoint: Vec<f64>,
    /// Buffer as long as the state.
    scratch: Vec<f64>,
    /// Cosines and sines of the last phases, `[cosine or sine][basis state]`.
    phases: Vec<f64>,
}

impl Workspace {
    /// Runs the circuit.
    pub(super) fn run(circuit: &Circuit, angles: &[f64]) -> Self {
        let length = 2 << circuit.qubits();
        let mut work = Workspace {
            qubits: circuit.qubits(),
            state: vec![0.0; length],
            adjoint: Vec::new(),
            scratch: vec![0.0; length],
            phases: vec![0.0; length],
        };
        forward(&mut work, circuit, angles);
        work
    }

    /// Probability of each outcome.
    pub(super) fn probabilities(&self) -> Vec<f64> {
        let (re, im) = self.state.split_at(self.state.len() / 2);
        re.iter().zip(im).map(|(re, im)| re * re + im * im).collect()
    }

    /// Gradient by the angle of each rotation gate of the expectations' sum weighted by `cotangent`.
    pub(super) fn gradient(mut self, circuit: &Circuit, angles: &[f64], cotangent: &[f64]) -> Vec<f64> {
        let mut weights = vec![cotangent.iter().sum::<f64>()];
        for g in cotangent.iter().rev() {
            let ones: Vec<f64> = weights.iter().map(|w| w - 2.0 * g).collect();
            weights.extend(ones);
        }
        self.adjoint =
            self.state.chunks(weights.len()).flat_map(|part| part.iter().zip(&weights)).map(|(a, w)| a * w).collect();
        let mut gradient = vec![0.0; angles.len()];
        backward(&mut self, circuit, angles, &mut gradient);
        gradient
    }
}

vectorised! {
    fn forward(work: &mut Workspace, circuit: &Circuit, angles: &[f64]) {
        work.state.fill(0.0);
        work.state[0] = 1.0;
        for (index, &layer) in circuit.layers.iter().enumerate() {
            match layer {
                Layer::Hadamards if index == 0 => {
                    let size = 1 << work.qubits;
                    work.state[..size].fill(1.0 / f64::from(size as u32).sqrt());
                }
                Layer::Hadamards => hadamards(&mut work.state, work.qubits),
                Layer::Phases { angle } => {
                    phases(work, angles, angle);
                    apply_phases::<false>(&mut work.state, &work.phases);
                }
                Layer::Rotations { angle } => {
                    for (q, angle) in angles[angle..].iter().take(work.qubits).enumerate() {
                        let (s, c) = (0.5 * angle).sin_cos();
                        butterflies(&mut work.state, q, |a, b| (c * a - s * b, s * a + c * b));
                    }
                }
                Layer::Entangler => entangle::<false>(&mut work.state, &mut work.scratch),
            }
        }
    }
}

vectorised! {
    fn backward(work: &mut Workspace, circuit: &Circuit, angles: &[f64], gradient: &mut [f64]) {
        for (index, &layer) in circuit.layers.iter().enumerate().rev() {
            match layer {
                // Gates before the first angles have no gradient.
                Layer::Hadamards if index == 0 => {}
                Layer::Hadamards => {
                    hadamards(&mut work.state, work.qubits);
                    hadamards(&mut work.adjoint, work.qubits);
                }
                Layer::Phases { angle } => {
                    phase_gradient(work, &mut gradient[angle..]);
                    if index > 1 {
                        phases(work, angles, angle);
                        apply_phases::<true>(&mut work.state, &work.phases);
                        apply_phases::<true>(&mut work.adjoint, &work.phases);
                    }
                }
                Layer::Rotations { angle } => {
                    for (q, gradient) in gradient[angle..].iter_mut().take(work.qubits).enumerate() {
                        *gradient = rotation_gradient(&work.state, &work.adjoint, q);
                    }
                    if index > 0 {
                        for (q, angle) in angles[angle..].iter().take(work.qubits).enumerate() {
                            let (s, c) = (0.5 * angle).sin_cos();
                            butterflies(&mut work.state, q, |a, b| (c * a + s * b, c * b - s * a));
                            butterflies(&mut work.adjoint, q, |a, b| (c * a + s * b, c * b - s * a));
                        }
                    }
                }
                Layer::Entangler => {
                    entangle::<true>(&mut work.state, &mut work.scratch);
                    entangle::<true>(&mut work.adjoint, &mut work.scratch);
                }
            }
        }
    }
}

/// Replaces each pair of numbers whose indices differ in bit `q`.
#[inline(always)]
fn butterflies(data: &mut [f64], q: usize, f: impl Fn(f64, f64) -> (f64, f64)) {
    // Short strides have loops of a length that the compiler knows.
    match q {
        0 => short_butterflies::<2>(data, f),
        1 => short_butterflies::<4>(data, f),
        2 => short_butterflies::<8>(data, f),
        _ => {
            for pair in data.chunks_exact_mut(2 << q) {
                let (zeros, ones) = pair.split_at_mut(1 << q);
                zeros.iter_mut().zip(ones).for_each(|(a, b)| (*a, *b) = f(*a, *b));
            }
        }
    }
}

#[inline(always)]
fn short_butterflies<const WIDTH: usize>(data: &mut [f64], f: impl Fn(f64, f64) -> (f64, f64)) {
    for pair in data.as_chunks_mut::<WIDTH>().0 {
        for k in 0..WIDTH / 2 {
            (pair[k], pair[k + WIDTH / 2]) = f(pair[k], pair[k + WIDTH / 2]);
        }
    }
}

/// Sums over all qubits with the signs of the Walsh functions, without a factor.
#[inline(always)]
fn walsh_hadamard(data: &mut [f64], qubits: usize) {
    for q in 0..qubits {
        butterflies(data, q, |a, b| (a + b, a - b));
    }
}

#[inline(always)]
fn hadamards(data: &mut [f64], qubits: usize) {
    walsh_hadamard(data, qubits);
    let scale = 1.0 / f64::from(1u32 << qubits).sqrt();
    data.iter_mut().for_each(|v| *v *= scale);
}

/// Bit masks of the phases, in the order of the angles. A phase acts on the basis states with an odd number of ones
/// under its mask.
fn masks(qubits: usize) -> impl Iterator<Item = usize> {
    (0..qubits).map(|q| 1 << q).chain(pairs(qubits).map(|(i, j)| (1 << i) | (1 << j)))
}

/// Computes cosines and sines of the sum of phases of each basis state. A phase acts where a Walsh function is -1, or
/// `(1 - walsh) / 2`, so the sum is a Walsh-Hadamard transform of the angles.
#[inline(always)]
fn phases(work: &mut Workspace, angles: &[f64], first: usize) {
    let size = 1 << work.qubits;
    let sums = &mut work.scratch[..size];
    sums.fill(0.0);
    for (mask, angle) in masks(work.qubits).zip(&angles[first..]) {
        sums[0] += 0.5 * angle;
        sums[mask] -= 0.5 * angle;
    }
    walsh_hadamard(sums, work.qubits);
    let (cosines, sines) = work.phases.split_at_mut(size);
    sin_cos(sums, sines, cosines);
}

/// Multiplies each amplitude by its phase factor, or divides by it if `INVERSE`.
#[inline(always)]
fn apply_phases<const INVERSE: bool>(data: &mut [f64], phases: &[f64]) {
    let (re, im) = data.split_at_mut(data.len() / 2);
    let (cosines, sines) = phases.split_at(re.len());
    for ((re, im), (&c, &s)) in re.iter_mut().zip(im).zip(cosines.iter().zip(sines)) {
        let s = if INVERSE { -s } else { s };
        (*re, *im) = (c * *re - s * *im, s * *re + c * *im);
    }
}

/// Gradient by each phase, `2 Re <adjoint| i odd |state>`, where `odd` selects the states that it acts on: again a
/// Walsh-Hadamard transform.
#[inline(always)]
fn phase_gradient(work: &mut Workspace, gradient: &mut [f64]) {
    let size = 1 << work.qubits;
    let sums = &mut work.scratch[..size];
    let ((re, im), (adjoint_re, adjoint_im)) = (work.state.split_at(size), work.adjoint.split_at(size));
    for (k, sum) in sums.iter_mut().enumerate() {
        *sum = adjoint_im[k] * re[k] - adjoint_re[k] * im[k];
    }
    walsh_hadamard(sums, work.qubits);
    for (mask, gradient) in masks(work.qubits).zip(gradient) {
        *gradient = sums[0] - sums[mask];
    }
}

/// Gradient by the rotation of qubit `q`, `2 Re <adjoint| (-i Y / 2) |state>`: the sum of `adjoint1 state0 - adjoint0
/// state1` over pairs. Eight partial sums on every machine keep the result the same.
#[inline(always)]
fn rotation_gradient(state: &[f64], adjoint: &[f64], q: usize) -> f64 {
    let mut sums = [0.0; 8];
    match q {
        0 => short_gradient::<2>(state, adjoint, &mut sums),
        1 => short_gradient::<4>(state, adjoint, &mut sums),
        2 => short_gradient::<8>(state, adjoint, &mut sums),
        _ => {
            for (state, adjoint) in state.chunks_exact(2 << q).zip(adjoint.chunks_exact(2 << q)) {
                let ((s0, s1), (a0, a1)) = (state.split_at(1 << q), adjoint.split_at(1 << q));
                let states = s0.as_chunks::<8>().0.iter().zip(s1.as_chunks::<8>().0);
                let adjoints = a0.as_chunks::<8>().0.iter().zip(a1.as_chunks::<8>().0);
                for ((s0, s1), (a0, a1)) in states.zip(adjoints) {
                    for k in 0..8 {
                        sums[k] += a1[k] * s0[k] - a0[k] * s1[k];
                    }
                }
            }
        }
    }
    sums.iter().sum()
}

#[inline(always)]
fn short_gradient<const WIDTH: usize>(state: &[f64], adjoint: &[f64], sums: &mut [f64; 8]) {
    for (state, adjoint) in state.as_chunks::<WIDTH>().0.iter().zip(adjoint.as_chunks::<WIDTH>().0) {
        for k in 0..WIDTH / 2 {
            sums[k] += adjoint[k + WIDTH / 2] * state[k] - adjoint[k] * state[k + WIDTH / 2];
        }
    }
}

/// Applies all CX of a full entanglement at once, or undoes them if `INVERSE`.
#[inline(always)]
fn entangle<const INVERSE: bool>(data: &mut [f64], scratch: &mut [f64]) {
    let size = data.len() / 2;
    scratch.copy_from_slice(data);
    for (target, source) in data.chunks_exact_mut(size).zip(scratch.chunks_exact(size)) {
        for k in 0..size {
            let image = (k ^ (k << 1)) & (size - 1);
            if INVERSE {
                target[k] = source[image];
            } else {
                target[image] = source[k];
            }
        }
    }
}
