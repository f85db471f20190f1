//! Layers as operations of candle's graph: functions of one to three arrays with hand-written gradients.

use std::collections::HashMap;
use std::sync::{Arc, LazyLock, Mutex, MutexGuard, OnceLock, Weak};

use candle_core::{CpuStorage, CustomOp1, CustomOp2, CustomOp3, Layout, Result, Shape, Storage, Tensor, TensorId};

use super::tensor::{values, with_values};

/// One input of a layer: its values in row-major order and its shape.
#[derive(Clone, Copy)]
pub(super) struct Argument<'a> {
    pub values: &'a [f32],
    pub dims: &'a [usize],
}

/// Gradients of a layer's inputs, in their order; `None` where none is needed.
pub(super) type Gradients = Vec<Option<Vec<f32>>>;

/// A layer of one to three inputs and one output.
pub(super) trait Operation: Send + Sync + 'static {
    /// Checks the shapes and computes the output.
    fn forward(&self, inputs: &[Argument<'_>]) -> Result<(Vec<f32>, Shape)>;

    /// Computes gradients of the inputs. `gradient` is that of `output`. It is passed by value, so that an input's gradient can
    /// reuse its memory.
    fn backward(&self, inputs: &[Argument<'_>], output: &[f32], gradient: Vec<f32>) -> Result<Gradients>;
}

/// Whether the backward pass computes the gradient of a layer's input.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InputGradient {
    /// The input comes from another layer.
    Needed,
    /// The input is data.
    Unused,
}

/// Applies `operation` to tensors as one node of candle's graph. Errors contain `name`.
pub(super) fn apply(name: &'static str, inputs: &[&Tensor], operation: impl Operation) -> Result<Tensor> {
    let node = Arc::new(Node {
        name,
        operation: Box::new(operation),
        inputs: inputs.iter().map(|&t| t.clone()).collect(),
        output: OnceLock::new(),
    });
    let handle = Handle(node.clone());
    let output = match *inputs {
        [a] => a.apply_op1(handle),
        [a, b] => a.apply_op2(b, handle),
        [a, b, c] => a.apply_op3(b, c, handle),
        _ => candle_core::bail!("{name}: {} inputs", inputs.len()),
    }?;
    // If no input depends on a variable, candle has dropped the operation, and no backward pass will need it.
    if Arc::strong_count(&node) > 1 {
        let _ = node.output.set(output.id());
        nodes().insert(output.id(), Arc::downgrade(&node));
    }
    Ok(output)
}

/// Node that computed a tensor, if it is a layer of this crate.
pub(super) fn node_of(tensor: &Tensor) -> Option<Arc<Node>> {
    nodes().get(&tensor.id())?.upgrade()
}

/// Layers by the tensors that they computed, because candle does not expose its operations. A node is dropped with its tensor.
static NODES: LazyLock<Mutex<HashMap<TensorId, Weak<Node>>>> = LazyLock::new(Mutex::default);

fn nodes() -> MutexGuard<'static, HashMap<TensorId, Weak<Node>>> {
    NODES.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
}

/// Layer applied to tensors.
pub(super) struct Node {
    name: &'static str,
    operation: Box<dyn Operation>,
    pub inputs: Vec<Tensor>,
    output: OnceLock<TensorId>,
}

impl Drop for Node {
    fn drop(&mut self) {
        if let Some(id) = self.output.get() {
            nodes().remove(id);
        }
    }
}

impl Node {
    /// Gradients of the inputs from the gradient of the output.
    ///
    /// # Errors
    /// A tensor is not f32 on the CPU, or the layer has no such gradient.
    pub fn backward(&self, output: &Tensor, gradient: Vec<f32>) -> Result<Gradients> {
        let name = self.name;
        let contiguous = self.inputs.iter().map(|t| t.contiguous()).collect::<Result<Vec<_>>>()?;
        let locked: Vec<_> = contiguous.iter().map(|t| t.storage_and_layout()).collect();
        let arguments = locked
            .iter()
            .map(|(storage, layout)| match &**storage {
                Storage::Cpu(cpu) => Ok(Argument { values: values(name, cpu, layout)?, dims: layout.dims() }),
                _ => candle_core::bail!("{name}: a tensor is not on the CPU"),
            })
            .collect::<Result<Vec<_>>>()?;
        with_values(name, output, |output| self.operation.backward(&arguments, output, gradient))
    }
}

/// Adapter of a node to candle's custom operations.
struct Handle(Arc<Node>);

impl Handle {
    fn run<'a>(&self, inputs: &[(&'a CpuStorage, &'a Layout)]) -> Result<(CpuStorage, Shape)> {
        let argument = |&(storage, layout): &(&'a CpuStorage, &'a Layout)| {
            values(self.0.name, storage, layout).map(|values| Argument { values, dims: layout.dims() })
        };
        let arguments = inputs.iter().map(argument).collect::<Result<Vec<_>>>()?;
        let (output, shape) = self.0.operation.forward(&arguments)?;
        Ok((CpuStorage::F32(output), shape))
    }

    fn gradients(&self, output: &Tensor, gradient: &Tensor) -> Result<Vec<Option<Tensor>>> {
        let gradient = with_values(self.0.name, gradient, |g| Ok(g.to_vec()))?;
        let gradients = self.0.backward(output, gradient)?;
        self.0
            .inputs
            .iter()
            .zip(gradients)
            .map(|(input, g)| g.map(|g| Tensor::from_vec(g, input.shape(), input.device())).transpose())
            .collect()
    }
}

impl CustomOp1 for Handle {
    fn name(&self) -> &'static str {
        self.0.name
    }

    fn cpu_fwd(&self, a: &CpuStorage, la: &Layout) -> Result<(CpuStorage, Shape)> {
        self.run(&[(a, la)])
    }

    fn bwd(&self, _a: &Tensor, output: &Tensor, gradient: &Tensor) -> Result<Option<Tensor>> {
        Ok(self.gradients(output, gradient)?.pop().flatten())
    }
}

impl CustomOp2 for Handle {
    fn name(&self) -> &'static str {
        self.0.name
    }

    fn cpu_fwd(&self, a: &CpuStorage, la: &Layout, b: &CpuStorage, lb: &Layout) -> Result<(CpuStorage, Shape)> {
        self.run(&[(a, la), (b, lb)])
    }

    fn bwd(
        &self,
        _a: &Tensor,
        _b: &Tensor,
        output: &Tensor,
        gradient: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let mut gradients = self.gradients(output, gradient)?.into_iter();
        Ok((gradients.next().flatten(), gradients.next().flatten()))
    }
}

impl CustomOp3 for Handle {
    fn name(&self) -> &'static str {
        self.0.name
    }

    fn cpu_fwd(
        &self,
        a: &CpuStorage,
        la: &Layout,
        b: &CpuStorage,
        lb: &Layout,
        c: &CpuStorage,
        lc: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        self.run(&[(a, la), (b, lb), (c, lc)])
    }

    fn bwd(
        &self,
        _a: &Tensor,
        _b: &Tensor,
        _c: &Tensor,
        output: &Tensor,
        gradient: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let mut gradients = self.gradients(output, gradient)?.into_iter();
        Ok((gradients.next().flatten(), gradients.next().flatten(), gradients.next().flatten()))
    }
}
