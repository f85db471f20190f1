//! Where the circuit starts: angles, head and placement of the latent, fitted to latents that a linear head has already
//! drawn apart.
//!
//! The backbone is trained with the plain linear head first, which never failed here. Its latent shows the classes as
//! clusters; what is left is a problem of 19 numbers on a few hundred points, small enough to be solved many times over
//! from random angles and rotations, and the best solution is taken. Everything in f64, in closed form.

use rand::Rng;

use crate::quantum;
use crate::stream;

/// Random starts of the search.
const SEARCHES: u64 = 24;
/// Adam steps of each.
const STEPS: i32 = 200;
const RATE: f64 = 0.05;
/// Angles, head weight (3 x 2), head bias (3), latent map (2 x 2), latent offset (2).
const NUMBERS: usize = 4 + 6 + 3 + 4 + 2;

/// Angles, head and the map `u = matrix z + offset` of the latent.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct CircuitStart {
    pub theta: [f64; 4],
    pub head_weight: [f64; 6],
    pub head_bias: [f64; 3],
    pub matrix: [f64; 4],
    pub offset: [f64; 2],
    pub loss: f64,
}

/// The points of the search: centred latents of unit variance, labels and class weights.
pub(super) struct Points<'a> {
    pub latents: &'a [[f64; 2]],
    pub labels: &'a [usize],
    pub class_weights: &'a [f32],
    /// Weight of the mean square of `u`.
    pub penalty: f64,
    /// Whether the map of the latent may change, or is the identity.
    pub move_latent: bool,
    /// Standard deviation of `u` at the start.
    pub sigma: f64,
}

/// The best of many fits.
pub(super) fn search(points: &Points, seed: u64, start: u64) -> CircuitStart {
    let fits = (0..SEARCHES).map(|index| {
        let mut rng = stream(seed, "circuit start", start * SEARCHES + index);
        let mut v = [0.0; NUMBERS];
        v[..4].iter_mut().for_each(|t| *t = rng.random_range(-std::f64::consts::PI..std::f64::consts::PI));
        v[4..10].iter_mut().for_each(|w| *w = rng.random_range(-1.0..1.0));
        let (s, c) = if points.move_latent {
            let angle: f64 = rng.random_range(0.0..std::f64::consts::TAU);
            (points.sigma * angle.sin(), points.sigma * angle.cos())
        } else {
            (0.0, 1.0)
        };
        v[13..17].copy_from_slice(&[c, -s, s, c]);
        fit(points, v)
    });
    // The first of equals; NaN loses against everything.
    let mut best: Option<([f64; NUMBERS], f64)> = None;
    for (v, loss) in fits {
        if best.is_none_or(|(_, b)| loss < b || b.is_nan()) {
            best = Some((v, loss));
        }
    }
    let (v, loss) = best.unwrap_or(([0.0; NUMBERS], f64::NAN));
    CircuitStart {
        theta: [v[0], v[1], v[2], v[3]],
        head_weight: [v[4], v[5], v[6], v[7], v[8], v[9]],
        head_bias: [v[10], v[11], v[12]],
        matrix: [v[13], v[14], v[15], v[16]],
        offset: [v[17], v[18]],
        loss,
    }
}

fn fit(points: &Points, mut v: [f64; NUMBERS]) -> ([f64; NUMBERS], f64) {
    let (mut first, mut second) = ([0.0; NUMBERS], [0.0; NUMBERS]);
    for step in 1..=STEPS {
        let (_, gradient) = loss_and_gradient(points, &v);
        let free = if points.move_latent { NUMBERS } else { 13 };
        for k in 0..free {
            first[k] = 0.9 * first[k] + 0.1 * gradient[k];
            second[k] = 0.999 * second[k] + 0.001 * gradient[k] * gradient[k];
            let (m, s) = (first[k] / (1.0 - 0.9f64.powi(step)), second[k] / (1.0 - 0.999f64.powi(step)));
            v[k] -= RATE * m / (s.sqrt() + 1e-8);
        }
    }
    let loss = loss_and_gradient(points, &v).0;
    (v, loss)
}

fn loss_and_gradient(points: &Points, v: &[f64; NUMBERS]) -> (f64, [f64; NUMBERS]) {
    let (mut loss, mut g) = (0.0, [0.0; NUMBERS]);
    let weight = |label: usize| points.class_weights.get(label).copied().map_or(0.0, f64::from);
    let total: f64 = points.labels.iter().map(|&l| weight(l)).sum::<f64>().max(1e-12);
    let count = points.latents.len().max(1) as f64;
    for (z, &label) in points.latents.iter().zip(points.labels) {
        let u = [v[13] * z[0] + v[14] * z[1] + v[17], v[15] * z[0] + v[16] * z[1] + v[18]];
        let s = u.map(|u| 1.0 / (1.0 + (-u).exp()));
        let point = quantum::circuit(s.map(|s| std::f64::consts::PI * s), [v[0], v[1], v[2], v[3]]);
        let e = [point.zi, point.iz];
        let logits: [f64; 3] = std::array::from_fn(|c| v[4 + 2 * c] * e[0] + v[5 + 2 * c] * e[1] + v[10 + c]);
        let largest = logits.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let p = logits.map(|l| (l - largest).exp());
        let sum: f64 = p.iter().sum();
        let w = weight(label) / total;
        loss -= w * (p.get(label).copied().unwrap_or(0.0) / sum).max(1e-300).ln();
        let mut de = [0.0; 2];
        for c in 0..3 {
            let d = w * (p[c] / sum - if c == label { 1.0 } else { 0.0 });
            for k in 0..2 {
                g[4 + 2 * c + k] += d * e[k];
                de[k] += d * v[4 + 2 * c + k];
            }
            g[10 + c] += d;
        }
        for (k, g) in g.iter_mut().take(4).enumerate() {
            *g += de[0] * point.zi_grad_theta[k] + de[1] * point.iz_grad_theta[k];
        }
        for k in 0..2 {
            let dx = de[0] * point.zi_grad_x[k] + de[1] * point.iz_grad_x[k];
            // The penalty is the mean over points and components, as in the steps of the training.
            loss += points.penalty * u[k] * u[k] / (2.0 * count);
            let du = dx * std::f64::consts::PI * s[k] * (1.0 - s[k]) + points.penalty * u[k] / count;
            g[13 + 2 * k] += du * z[0];
            g[14 + 2 * k] += du * z[1];
            g[17 + k] += du;
        }
    }
    (loss, g)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand_distr::{Distribution, Normal};

    fn clusters() -> (Vec<[f64; 2]>, Vec<usize>) {
        let mut rng = stream(4, "clusters", 0);
        let normal = Normal::new(0.0, 0.25).expect("normal");
        let centres = [[-1.2, -0.7], [1.2, -0.7], [0.0, 1.4]];
        (0..150)
            .map(|k| {
                let c = centres[k % 3];
                ([c[0] + normal.sample(&mut rng), c[1] + normal.sample(&mut rng)], k % 3)
            })
            .unzip()
    }

    #[test]
    fn the_gradient_is_that_of_the_loss() {
        let (latents, labels) = clusters();
        let points = Points {
            latents: &latents,
            labels: &labels,
            class_weights: &[1.0, 0.5, 2.0],
            penalty: 0.1,
            move_latent: true,
            sigma: 0.7,
        };
        let mut rng = stream(4, "numbers", 0);
        let v: [f64; NUMBERS] = std::array::from_fn(|_| rng.random_range(-1.0..1.0));
        let (_, gradient) = loss_and_gradient(&points, &v);
        for k in 0..NUMBERS {
            let at = |by: f64| {
                let mut moved = v;
                moved[k] += by;
                loss_and_gradient(&points, &moved).0
            };
            let difference = (at(1e-6) - at(-1e-6)) / 2e-6;
            assert!((difference - gradient[k]).abs() < 1e-8, "{k}: {difference} {}", gradient[k]);
        }
    }

    /// Three clusters in general position are separated by the circuit, whatever its random start.
    #[test]
    fn three_clusters_are_told_apart() {
        let (latents, labels) = clusters();
        for seed in 0..3 {
            let points = Points {
                latents: &latents,
                labels: &labels,
                class_weights: &[1.0; 3],
                penalty: 0.02,
                move_latent: true,
                sigma: 0.7,
            };
            let found = search(&points, seed, 0);
            assert!(found.loss < 0.15, "seed {seed}: {}", found.loss);
        }
    }
}
