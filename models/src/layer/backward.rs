//! The backward pass over a graph of this crate's layers.

use std::collections::hash_map::Entry;
use std::collections::{HashMap, HashSet};

use candle_core::backprop::GradStore;
use candle_core::{Result, Tensor, TensorId};
use rayon::prelude::*;

use super::activation::CHUNK;
use super::operation::node_of;
use super::tensor::with_values;

/// Computes the gradients of all variables that the scalar `loss` depends on. The result is that of `loss.backward()`, several
/// times faster.
///
/// For each gradient, candle fills an array with zeros, adds to it and copies the sum. This pass moves gradients from layer to
/// layer. At an operation that is no layer of this crate, candle computes the gradients of this operation and of all before it.
/// Gradients of tensors that are not variables are dropped.
///
/// # Errors
/// A layer of the graph has no gradient by an input that asks for one, or a tensor operation fails.
pub fn backward(loss: &Tensor) -> Result<GradStore> {
    let order = loss.sorted_nodes();
    let tracked: HashSet<TensorId> = order.iter().map(|t| t.id()).collect();
    let mut pending: HashMap<TensorId, Vec<f32>> = HashMap::new();
    pending.insert(loss.id(), vec![1.0; loss.elem_count()]);
    for &tensor in &order {
        if tensor.is_variable() {
            continue;
        }
        let Some(gradient) = pending.remove(&tensor.id()) else { continue };
        if let Some(node) = node_of(tensor) {
            let gradients = node.backward(tensor, gradient)?;
            for (input, gradient) in node.inputs.iter().zip(gradients) {
                if let Some(gradient) = gradient
                    && tracked.contains(&input.id())
                {
                    accumulate(&mut pending, input.id(), gradient);
                }
            }
        } else {
            let gradient = Tensor::from_vec(gradient, tensor.shape(), tensor.device())?;
            let store = (tensor * gradient)?.sum_all()?.backward()?;
            for variable in order.iter().filter(|t| t.is_variable()) {
                if let Some(gradient) = store.get(variable) {
                    let gradient = with_values("backward", &gradient.flatten_all()?, |g| Ok(g.to_vec()))?;
                    accumulate(&mut pending, variable.id(), gradient);
                }
            }
        }
    }
    let mut store = GradStore::default();
    for tensor in order.iter().filter(|t| t.is_variable()) {
        if let Some(gradient) = pending.remove(&tensor.id()) {
            store.insert(tensor, Tensor::from_vec(gradient, tensor.shape(), tensor.device())?);
        }
    }
    Ok(store)
}

/// Adds a gradient to that of the tensor `id`.
fn accumulate(pending: &mut HashMap<TensorId, Vec<f32>>, id: TensorId, gradient: Vec<f32>) {
    match pending.entry(id) {
        Entry::Vacant(entry) => {
            entry.insert(gradient);
        }
        Entry::Occupied(mut entry) => {
            let sums = entry.get_mut().par_chunks_mut(CHUNK).zip(gradient.par_chunks(CHUNK));
            sums.for_each(|(sums, gradient)| sums.iter_mut().zip(gradient).for_each(|(s, &g)| *s += g));
        }
    }
}
