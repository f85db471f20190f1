//! The two-qubit circuit as a layer.

use candle_core::{CpuStorage, CustomOp2, Error, Layout, Result, Shape, Tensor};

use super::{values, with_values};
use crate::quantum;

const NAME: &str = "circuit";

/// `[<ZI>, <IZ>]` of [`quantum::circuit`] for each row of `input` `[batch][2]` (radians) at `theta` `[4]` (radians).
pub fn circuit(input: &Tensor, theta: &Tensor) -> Result<Tensor> {
    input.apply_op2(theta, Circuit)
}

struct Circuit;

fn angles(theta: &[f32]) -> Result<[f64; 4]> {
    match *theta {
        [a, b, c, d] => Ok([a, b, c, d].map(f64::from)),
        _ => Err(Error::Msg(format!("{NAME}: expected 4 angles, got {}", theta.len())).bt()),
    }
}

fn rows(input: &[f32]) -> impl Iterator<Item = [f64; 2]> + '_ {
    input.as_chunks::<2>().0.iter().map(|row| row.map(f64::from))
}

impl CustomOp2 for Circuit {
    fn name(&self) -> &'static str {
        NAME
    }

    fn cpu_fwd(
        &self,
        input: &CpuStorage,
        input_layout: &Layout,
        theta: &CpuStorage,
        theta_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let &[batch, 2] = input_layout.dims() else {
            candle_core::bail!("{NAME}: expected input [batch, 2], got {:?}", input_layout.dims());
        };
        let theta = angles(values(NAME, theta, theta_layout)?)?;
        let result = rows(values(NAME, input, input_layout)?)
            .flat_map(|x| quantum::expectations(x, theta).map(|v| v as f32))
            .collect();
        Ok((CpuStorage::F32(result), Shape::from((batch, 2))))
    }

    fn bwd(
        &self,
        input: &Tensor,
        theta: &Tensor,
        _result: &Tensor,
        gradient: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let mut input_gradient = Vec::with_capacity(input.elem_count());
        let mut theta_gradient = [0.0f64; 4];
        with_values(NAME, input, |x| {
            with_values(NAME, theta, |theta| {
                let theta = angles(theta)?;
                with_values(NAME, gradient, |g| {
                    for (x, [g_zi, g_iz]) in rows(x).zip(rows(g)) {
                        let point = quantum::circuit(x, theta);
                        for k in 0..2 {
                            input_gradient.push((g_zi * point.zi_grad_x[k] + g_iz * point.iz_grad_x[k]) as f32);
                        }
                        for (k, sum) in theta_gradient.iter_mut().enumerate() {
                            *sum += g_zi * point.zi_grad_theta[k] + g_iz * point.iz_grad_theta[k];
                        }
                    }
                    Ok(())
                })
            })
        })?;
        let device = input.device();
        Ok((
            Some(Tensor::from_vec(input_gradient, input.shape(), device)?),
            Some(Tensor::from_slice(&theta_gradient.map(|v| v as f32), theta.shape(), device)?),
        ))
    }
}
