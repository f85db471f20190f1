//! Adam (Kingma and Ba, ICLR 2015, algorithm 1) with a step size for each array and decoupled weight decay (Loshchilov and
//! Hutter, ICLR 2019, algorithm 2).

use std::collections::BTreeMap;
use std::sync::Mutex;

use candle_core::{CpuStorage, InplaceOp2, Layout, Result, Var, backprop::GradStore};
use rayon::prelude::*;

const BETA1: f32 = 0.9;
const BETA2: f32 = 0.999;
const EPSILON: f32 = 1e-8;
/// Number of values that one task processes.
const CHUNK: usize = 1 << 14;

/// Moments of all arrays.
pub(super) struct Adam {
    moments: Vec<Mutex<Moments>>,
    steps: i32,
}

struct Moments {
    first: Vec<f32>,
    second: Vec<f32>,
}

impl Adam {
    pub(super) fn new<'a>(variables: impl Iterator<Item = &'a Var>) -> Self {
        let zeros = |variable: &Var| vec![0.0; variable.elem_count()];
        let moments = variables.map(|v| Mutex::new(Moments { first: zeros(v), second: zeros(v) })).collect();
        Adam { moments, steps: 0 }
    }

    /// Steps taken.
    pub(super) fn steps(&self) -> i32 {
        self.steps
    }

    /// First and second moments by name.
    pub(super) fn arrays<'a>(&self, names: impl Iterator<Item = &'a str>) -> BTreeMap<String, Vec<f32>> {
        let mut arrays = BTreeMap::new();
        for (name, moments) in names.zip(&self.moments) {
            let moments = moments.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
            arrays.insert(format!("first.{name}"), moments.first.clone());
            arrays.insert(format!("second.{name}"), moments.second.clone());
        }
        arrays
    }

    /// Restores the results of [`Adam::arrays`] and [`Adam::steps`]. Errors name arrays that are missing or of another length.
    pub(super) fn restore<'a>(
        &mut self,
        names: impl Iterator<Item = &'a str>,
        arrays: &BTreeMap<String, Vec<f32>>,
        steps: i32,
    ) -> std::result::Result<(), String> {
        for (name, moments) in names.zip(&mut self.moments) {
            let moments = moments.get_mut().unwrap_or_else(std::sync::PoisonError::into_inner);
            for (prefix, array) in [("first", &mut moments.first), ("second", &mut moments.second)] {
                let key = format!("{prefix}.{name}");
                let found = arrays.get(&key).filter(|found| found.len() == array.len()).ok_or(key)?;
                array.clone_from(found);
            }
        }
        self.steps = steps;
        Ok(())
    }

    /// Takes one step with step sizes `rates` and weight decays `decays` (shares of the values that the step subtracts; 0 beyond
    /// their end). If a gradient is not finite, it takes no step and returns the index of the first such array.
    pub(super) fn step<'a>(
        &mut self,
        variables: impl Iterator<Item = &'a Var> + Clone,
        gradients: &GradStore,
        rates: &[f32],
        decays: &[f32],
    ) -> Result<Option<usize>> {
        for (index, variable) in variables.clone().enumerate() {
            if let Some(gradient) = gradients.get(variable) {
                let finite = |values: &[f32]| Ok(values.par_chunks(CHUNK).all(|c| c.iter().all(|g| g.is_finite())));
                if !crate::layer::with_values("adam", gradient, finite)? {
                    return Ok(Some(index));
                }
            }
        }
        self.steps += 1;
        let (c1, c2) = (1.0 - BETA1.powi(self.steps), 1.0 - BETA2.powi(self.steps));
        let decays = decays.iter().copied().chain(std::iter::repeat(0.0));
        for (((variable, moments), &rate), decay) in variables.zip(&self.moments).zip(rates).zip(decays) {
            // An array without a gradient stays unchanged: its moments are zero.
            let Some(gradient) = gradients.get(variable) else { continue };
            variable.inplace_op2(&gradient.contiguous()?, &Step { moments, rate, retention: 1.0 - decay, c1, c2 })?;
        }
        Ok(None)
    }
}

struct Step<'a> {
    moments: &'a Mutex<Moments>,
    rate: f32,
    /// Factor of the values that weight decay leaves.
    retention: f32,
    /// Bias correction of the first moment.
    c1: f32,
    /// Bias correction of the second moment.
    c2: f32,
}

impl InplaceOp2 for Step<'_> {
    fn name(&self) -> &'static str {
        "adam"
    }

    fn cpu_fwd(&self, values: &mut CpuStorage, at: &Layout, gradient: &CpuStorage, from: &Layout) -> Result<()> {
        let (CpuStorage::F32(values), CpuStorage::F32(gradient)) = (values, gradient) else {
            candle_core::bail!("adam: expected f32 values and gradients");
        };
        let (Some((a, b)), Some((c, d))) = (at.contiguous_offsets(), from.contiguous_offsets()) else {
            candle_core::bail!("adam: values or gradients are not contiguous");
        };
        let (Some(values), Some(gradient)) = (values.get_mut(a..b), gradient.get(c..d)) else {
            candle_core::bail!("adam: layout exceeds storage");
        };
        let mut moments = self.moments.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        let Moments { first, second } = &mut *moments;
        let chunks = values.par_chunks_mut(CHUNK).zip(gradient.par_chunks(CHUNK));
        let moments = first.par_chunks_mut(CHUNK).zip(second.par_chunks_mut(CHUNK));
        chunks.zip(moments).for_each(|((values, gradient), (first, second))| {
            for (((value, &g), m), v) in values.iter_mut().zip(gradient).zip(first).zip(second) {
                *m = BETA1 * *m + (1.0 - BETA1) * g;
                *v = BETA2 * *v + (1.0 - BETA2) * g * g;
                *value = self.retention * *value - self.rate * (*m / self.c1) / ((*v / self.c2).sqrt() + EPSILON);
            }
        });
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::Device;

    /// The first step of Adam has the size of the rate for any gradient, and a quadratic is minimised.
    #[test]
    fn a_quadratic_is_minimised() {
        let x = Var::new(&[3.0f32, -2.0], &Device::Cpu).expect("var");
        let variables = [x.clone()];
        let mut adam = Adam::new(variables.iter());
        let step = |adam: &mut Adam| {
            let gradients = x.sqr().and_then(|t| t.sum_all()).and_then(|t| t.backward()).expect("gradient");
            adam.step(variables.iter(), &gradients, &[0.1], &[]).expect("step");
            x.to_vec1::<f32>().expect("values")
        };
        let first = step(&mut adam);
        assert!((first[0] - 2.9).abs() < 1e-5 && (first[1] + 1.9).abs() < 1e-5);
        let last = (0..300).map(|_| step(&mut adam)).last().expect("steps");
        assert!(last.iter().all(|v| v.abs() < 0.02), "{last:?}");
    }

    /// Decay does not depend on the gradient: at a step size of 0 it is the only change.
    #[test]
    fn decay_is_decoupled() {
        let x = Var::new(&[3.0f32], &Device::Cpu).expect("var");
        let mut adam = Adam::new([x.clone()].iter());
        for _ in 0..10 {
            let gradients = x.sqr().and_then(|t| t.sum_all()).and_then(|t| t.backward()).expect("gradient");
            adam.step([x.clone()].iter(), &gradients, &[0.0], &[0.05]).expect("step");
        }
        let decayed = x.to_vec1::<f32>().expect("values")[0];
        assert!((decayed - 3.0 * 0.95f32.powi(10)).abs() < 1e-5, "{decayed}");
    }
}
