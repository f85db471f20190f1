//! Adam (Kingma and Ba, ICLR 2015, algorithm 1) with a step size for each parameter.

use candle_core::{Device, Result, Tensor, Var, backprop::GradStore};

const BETA1: f32 = 0.9;
const BETA2: f32 = 0.999;
const EPSILON: f32 = 1e-8;

/// Moments of all parameters.
pub(super) struct Adam {
    first: Vec<Vec<f32>>,
    second: Vec<Vec<f32>>,
    steps: i32,
}

impl Adam {
    pub(super) fn new(variables: &[Var]) -> Self {
        let zeros: Vec<Vec<f32>> = variables.iter().map(|v| vec![0.0; v.elem_count()]).collect();
        Adam { first: zeros.clone(), second: zeros, steps: 0 }
    }

    /// One step. Gives the index of the first parameter with a gradient that is not finite instead of taking it.
    pub(super) fn step(&mut self, variables: &[Var], grads: &GradStore, rates: &[f32]) -> Result<Option<usize>> {
        let mut gradients = Vec::with_capacity(variables.len());
        for (index, variable) in variables.iter().enumerate() {
            let gradient: Vec<f32> = match grads.get(variable) {
                Some(gradient) => gradient.flatten_all()?.to_vec1()?,
                None => vec![0.0; variable.elem_count()],
            };
            if gradient.iter().any(|g| !g.is_finite()) {
                return Ok(Some(index));
            }
            gradients.push(gradient);
        }
        self.steps += 1;
        let (c1, c2) = (1.0 - BETA1.powi(self.steps), 1.0 - BETA2.powi(self.steps));
        let moments = self.first.iter_mut().zip(&mut self.second);
        for (((variable, gradient), (first, second)), &rate) in variables.iter().zip(&gradients).zip(moments).zip(rates)
        {
            let mut values: Vec<f32> = variable.flatten_all()?.to_vec1()?;
            for (((value, &g), m), v) in values.iter_mut().zip(gradient).zip(first).zip(second) {
                *m = BETA1 * *m + (1.0 - BETA1) * g;
                *v = BETA2 * *v + (1.0 - BETA2) * g * g;
                *value -= rate * (*m / c1) / ((*v / c2).sqrt() + EPSILON);
            }
            variable.set(&Tensor::from_vec(values, variable.shape(), &Device::Cpu)?)?;
        }
        Ok(None)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The first step of Adam has the size of the rate whatever the gradient's, and a quadratic is minimised.
    #[test]
    fn a_quadratic_is_minimised() {
        let x = Var::new(&[3.0f32, -2.0], &Device::Cpu).expect("var");
        let variables = [x.clone()];
        let mut adam = Adam::new(&variables);
        let step = |adam: &mut Adam| {
            let grads = x.sqr().and_then(|t| t.sum_all()).and_then(|t| t.backward()).expect("gradient");
            adam.step(&variables, &grads, &[0.1]).expect("step");
            x.to_vec1::<f32>().expect("values")
        };
        let first = step(&mut adam);
        assert!((first[0] - 2.9).abs() < 1e-5 && (first[1] + 1.9).abs() < 1e-5);
        let last = (0..300).map(|_| step(&mut adam)).last().expect("steps");
        assert!(last.iter().all(|v| v.abs() < 0.02), "{last:?}");
    }
}
